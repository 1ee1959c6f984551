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
"""
What the node reads: IMU messages as bytes, GNSS topics and their faults, /tf_static, parameters.

Turning every IMU sample into a Python message and back costs several times as much as aligning.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import dataclasses
from importlib import import_module
import struct
from typing import Any, NamedTuple

from ins_align.config import Config, ConfigError, listed_choices
from ins_align.geometry.rotation import Transform
from ins_align.gnss.drivers import LIVE_TYPES, RECEIVERS, type_in_words, VELOCITY_TYPES
from ins_align.gnss.messages import imu_from_msg
from ins_align.mounting import Lookup, transform_from_msg
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.subscription import Subscription
from rclpy.time import Time
from sensor_msgs.msg import Imu

FIX_TOPIC, VELOCITY_TOPIC = 'fix', 'fix_velocity'
# Names under which messages that cannot be used are counted, by topic.
REJECTED_AS = {FIX_TOPIC: 'fix_undecodable', VELOCITY_TOPIC: 'velocity_body_frame'}

# sensor_msgs/Imu in plain CDR, little endian (OMG DDSI-RTPS 2.3, 10.2): a header of four bytes,
# stamp, length of the frame_id, frame_id, and the body, all float64: orientation (4) with its
# covariance (9), angular rate (3 and 9), specific force (3 and 9).
_LITTLE_ENDIAN = b'\x00\x01'
_STAMP, _ORIENTATION, _VECTOR = struct.Struct('<iI'), struct.Struct('<13d'), struct.Struct('<3d')
_STAMP_OFFSET, _FRAME_OFFSET = 4, 16
_RATE_OFFSET, _FORCE_OFFSET, _BODY_BYTES = 8 * 13, 8 * 25, 8 * 37


class ImuSample(NamedTuple):
    """The parts of an IMU message that the alignment uses."""

    stamp_ns: int
    gyro: tuple[float, float, float]  # rad/s
    accel: tuple[float, float, float]  # m/s^2
    frame_id: str


def body_start(data: bytes) -> int | None:
    """Return the offset of the body of a serialised Imu; None if it has another layout."""
    start = _FRAME_OFFSET + int.from_bytes(data[_FRAME_OFFSET - 4:_FRAME_OFFSET], 'little')
    start += -(start - 4) % 8  # float64 are aligned to 8 bytes from the end of the header
    known = data[:2] == _LITTLE_ENDIAN and len(data) == start + _BODY_BYTES
    return start if known else None


def read_imu(data: bytes) -> ImuSample:
    """Read one serialised sensor_msgs/Imu, without its orientation."""
    start = body_start(data)
    if start is None:  # a middleware with another serialisation
        msg = deserialize_message(data, Imu)
        stamp_ns, gyro, accel = imu_from_msg(msg)
        return ImuSample(stamp_ns, tuple(gyro), tuple(accel), msg.header.frame_id)
    seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_OFFSET)
    frame = data[_FRAME_OFFSET:start].split(b'\0', 1)[0]
    return ImuSample(seconds * 1_000_000_000 + nanoseconds,
                     _VECTOR.unpack_from(data, start + _RATE_OFFSET),
                     _VECTOR.unpack_from(data, start + _FORCE_OFFSET),
                     frame.decode(errors='replace'))


def with_orientation(data: bytes, quaternion_xyzw: Sequence[float],
                     covariance: Sequence[float]) -> bytes:
    """Return a serialised sensor_msgs/Imu with another orientation and covariance (row-major)."""
    orientation = (*quaternion_xyzw, *covariance)
    start = body_start(data)
    if start is None:
        msg = deserialize_message(data, Imu)
        turn = msg.orientation
        turn.x, turn.y, turn.z, turn.w = orientation[:4]
        msg.orientation_covariance = orientation[4:]
        return serialize_message(msg)
    changed = bytearray(data)
    _ORIENTATION.pack_into(changed, start, *orientation)
    return bytes(changed)


class Gate(ReentrantCallbackGroup):
    """
    A callback group whose subscription the executor passes over while the gate is closed.

    A turn of the executor takes longer than the work on a message. While no message is urgent,
    messages wait in the subscription's queue, and one turn takes many.
    """

    is_open = False

    def can_execute(self, entity: Any) -> bool:
        """Return whether the executor may take messages."""
        return self.is_open


def queued(subscription: Subscription) -> list[tuple[Any, int]]:
    """Take the messages that wait in a subscription, each with its time of reception, ns."""
    messages: list[tuple[Any, int]] = []
    with subscription.handle:
        while len(messages) < subscription.qos_profile.depth:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            messages.append((taken[0], taken[1]['received_timestamp']))
    return messages


def gnss_topics(config: Config) -> dict[str, str]:
    """Return the message types of the GNSS topics, such as sensor_msgs/msg/NavSatFix."""
    fix_type = LIVE_TYPES[config.fix_type]
    if fix_type in RECEIVERS:   # whose messages have the velocity, too
        return {FIX_TOPIC: fix_type}
    return {FIX_TOPIC: fix_type, VELOCITY_TOPIC: LIVE_TYPES[config.velocity_type]}


def message_class(msgtype: str) -> type:
    """Return the class of a message type; ConfigError: the package of a fix is not installed."""
    package, _, name = msgtype.split('/')
    try:
        found: type = getattr(import_module(f'{package}.msg'), name)
    except ModuleNotFoundError:
        raise ConfigError(
            f'fix_type is {name}, but {package} is not installed: sudo apt install '
            f'ros-$ROS_DISTRO-{package.replace("_", "-")}, or set fix_type to NavSatFix') from None
    return found


def inputs_in_words(node: Node, inputs: Mapping[str, str], config: Config) -> str:
    """Say what a node reads, and with which parameters."""
    topics = ', '.join(f'{node.resolve_topic_name(topic)} ({type_in_words(msgtype)})'
                       for topic, msgtype in inputs.items())
    settings = ', '.join(
        f'{field.name} {getattr(config, field.name)}' for field in dataclasses.fields(Config)
        if field.name == 'lever_arm' or getattr(config, field.name) != field.default)
    return f'reads {topics}; {settings}, other parameters at their defaults'


def topic_faults(node: Node, inputs: Mapping[str, str], expected: Sequence[str]) -> Iterator[str]:
    """
    Yield in words what is wrong with the publishers of topics, given with their types.

    A topic that nobody publishes is a fault only if it is `expected`.
    """
    for topic, wanted in inputs.items():
        name = node.resolve_topic_name(topic)
        publishers = node.get_publishers_info_by_topic(topic)
        types = {info.topic_type for info in publishers}
        if not types and topic in expected:
            yield f'nobody publishes {name}'
        if len(publishers) > 1:
            yield f'{name} has {len(publishers)} publishers: it must have one'
        if not types or wanted in types:
            continue
        other = min(types)
        settable = topic == VELOCITY_TOPIC and other in VELOCITY_TYPES
        hint = f': set velocity_type to {other.split("/")[-1]}' if settable else ''
        yield f'{name} is published as {type_in_words(other)}, not {type_in_words(wanted)}{hint}'


def open_static_tf(node: Node, config: Config) -> Lookup | None:
    """Return a lookup in /tf_static; None if no parameter needs it or tf2_ros is missing."""
    if config.lever_arm_from_tf is False and not config.base_frame:
        return None
    try:
        tf2_ros = import_module('tf2_ros')
    except ModuleNotFoundError:
        return None
    buffer = tf2_ros.Buffer()
    buffer.listener = tf2_ros.TransformListener(buffer, node)  # kept alive
    # Lever arms do not change, and receiving /tf would load a small computer.
    node.destroy_subscription(buffer.listener.tf_sub)

    def lookup(target: str, source: str) -> Transform | None:
        target, source = target.strip('/'), source.strip('/')  # tf2 takes no leading slash
        if not buffer.can_transform(target, source, Time()):
            return None
        return transform_from_msg(buffer.lookup_transform(target, source, Time()).transform)

    return lookup


def parameter_descriptor(field: dataclasses.Field[Any]) -> ParameterDescriptor:
    """Return the description of a field of `Config` for ROS."""
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
