# Copyright 2026 The ins_align Authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What the node says of its topics and parameters, and when the log has a reason again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import dataclasses
import re
from typing import Any

from ins_align.config import Config, listed_choices
from ins_align.gnss.drivers import type_in_words
from ins_align.ros.inputs import VELOCITY_TOPIC, VELOCITY_TYPES
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.node import Node

LOG_AGAIN = 10.0  # s after which a reason that has stayed is worth another line
_NUMBER = re.compile(r'[-+]?\d[\d.]*(?:e[-+]?\d+)?')


class ReasonLog:
    """Decides when a state with its reason is worth a line in the log."""

    def __init__(self) -> None:
        """Start with nothing logged."""
        self._logged: dict[str, float] = {}  # when texts, without their numbers, were logged last
        self._present = ''

    def due(self, text: str, now: float, again: bool) -> bool:
        """
        Return whether to log a text, which counts as logged then.

        That is when it has become another one, but for its numbers, or, if it is to be logged
        `again` and again, has stayed; not within `LOG_AGAIN` of the last time.
        """
        kind = _NUMBER.sub('#', text)
        stays, self._present = kind == self._present, kind
        self._logged = {logged: when for logged, when in self._logged.items()
                        if now - when < LOG_AGAIN}
        if kind in self._logged or (stays and not again):
            return False
        self._logged[kind] = now
        return True


def type_name(msg_type: type) -> str:
    """Return the full name of a message type: sensor_msgs/msg/Imu."""
    return f'{msg_type.__module__.split(".")[0]}/msg/{msg_type.__name__}'


def inputs_in_words(node: Node, inputs: Mapping[str, type], config: Config) -> str:
    """Say what a node reads, and with which parameters."""
    topics = ', '.join(f'{node.resolve_topic_name(topic)} ({type_in_words(type_name(msg_type))})'
                       for topic, msg_type in inputs.items())
    default = Config()
    changed = ''.join(
        f', {own.name} {getattr(config, own.name)}' for own in dataclasses.fields(Config)
        if own.name != 'lever_arm'
        and getattr(config, own.name) != getattr(default, own.name))
    return (f'reads {topics}; lever_arm {list(config.lever_arm)} m{changed}, '
            'other parameters at their defaults')


def topic_faults(node: Node, inputs: Mapping[str, type], expected: Sequence[str],
                 ) -> Iterator[str]:
    """
    Look at the publishers of the topics that a node reads, and say what is wrong with them.

    `inputs` are message types by topic; topics that are `expected` are worth a word where nobody
    publishes them.
    """
    for topic, msg_type in inputs.items():
        name = node.resolve_topic_name(topic)
        types = {info.topic_type for info in node.get_publishers_info_by_topic(topic)}
        wanted = type_name(msg_type)
        if not types and topic in expected:
            yield f'nobody publishes {name}'
        if not types or wanted in types:
            continue
        other = min(types)
        known = [parameter for parameter, velocity in VELOCITY_TYPES.items()
                 if topic == VELOCITY_TOPIC and type_name(velocity) == other]
        hint = f': set velocity_type to {known[0]}' if known else ''
        yield f'{name} is published as {type_in_words(other)}, not {type_in_words(wanted)}{hint}'


def parameter_descriptor(field: dataclasses.Field[Any]) -> ParameterDescriptor:
    """Describe one field of `Config` to ROS."""
    line = field.metadata
    unit = f' [{line["unit"]}]' if line['unit'] else ''
    descriptor = ParameterDescriptor(
        description=line['description'] + unit, read_only=line['read_only'])
    if line['choices']:
        descriptor.additional_constraints = f'one of: {listed_choices(line["choices"])}'
    if line['maximum'] is not None:
        descriptor.floating_point_range = [FloatingPointRange(
            from_value=line['minimum'], to_value=line['maximum'])]
    return descriptor
