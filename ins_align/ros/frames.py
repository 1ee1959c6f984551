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
"""Lever arm and mounting from TF while a node runs."""

from __future__ import annotations

from collections import deque
from importlib import import_module
from typing import Any

from ins_align.config import Config, ConfigError
from ins_align.geometry.rotation import Transform
from ins_align.gnss.messages import Fix, Velocity
from ins_align.mounting import find_mounting, Mounting, transform_from_msg
from ins_align.ros.inputs import ImuSample
from rclpy.node import Node
from rclpy.time import Time

# A robot's model is published once, to all who join: it is there as soon as the sensors are.
WAIT = 2.0  # s, for what may not be there, from when both frame_ids are known
MAX_HELD = 4000
MESSAGES = ImuSample, Fix, Velocity


def open_buffer(node: Node, config: Config) -> Any | None:
    """Return a tf2_ros.Buffer that hears /tf_static; None: not wanted, or there is no tf2_ros."""
    if config.lever_arm_from_tf is False and not config.base_frame:
        return None
    try:
        tf2_ros = import_module('tf2_ros')
    except ModuleNotFoundError:
        return None
    buffer = tf2_ros.Buffer()
    listener = tf2_ros.TransformListener(buffer, node)
    # A lever arm does not move, and /tf is too much for a small computer.
    node.destroy_subscription(listener.tf_sub)
    buffer.listener = listener  # which would otherwise be gone
    return buffer


class MountingSearch:
    """
    Looks for the transforms that the parameters want, once messages have told their frames.

    Without a `tf2_ros.Buffer` there is no TF: a ConfigError if the parameters cannot do without.
    """

    def __init__(self, config: Config, buffer: Any | None) -> None:
        self._config, self._buffer = config, buffer
        self._required = config.lever_arm_from_tf is True or bool(config.base_frame)
        if self._required and buffer is None:
            raise ConfigError('lever_arm_from_tf is true or base_frame is set, but tf2_ros is not '
                              'installed: sudo apt install ros-$ROS_DISTRO-tf2-ros-py')
        self.antenna_frame = self._imu_frame = ''
        self._lever_arm = config.lever_arm  # that is in use
        self._held: deque[tuple[int, Any]] = deque(maxlen=MAX_HELD)
        self.restart()

    def restart(self) -> None:
        """Look again: the IMU is another one."""
        self.mounting: Mounting | None = None
        self.waits_for = 'the transforms of IMU and antenna' if self._required else ''
        self._since: float | None = None
        self._held.clear()

    def take(self, items: list[tuple[int, Any]], now: float,
             ) -> tuple[list[tuple[int, Any]], Mounting | None]:
        """
        Look for the transforms; keep the messages until they are known or given up.

        Returns what to align with now, which is all that was kept where a lever arm was found,
        and once what TF says. `now` is in seconds.
        """
        if self.mounting is not None:
            return items, None
        messages = [item for item in items if isinstance(item[1], MESSAGES)]
        others = [item for item in items if not isinstance(item[1], MESSAGES)]
        self._held.extend(messages)
        self._imu_frame = next((item.frame_id for _, item in reversed(messages)
                                if isinstance(item, ImuSample)), self._imu_frame)
        self.mounting = self._find(now)
        if self.mounting is None:
            return others if self._required else items, None
        self.waits_for = ''
        anew = self._required or self.mounting.config.lever_arm != self._lever_arm
        self._lever_arm = self.mounting.config.lever_arm
        held = list(self._held)
        self._held.clear()
        return [*others, *held] if anew else items, self.mounting

    def _find(self, now: float) -> Mounting | None:
        """Return what TF says, or that it says nothing; None while that is not known."""
        if self._buffer is None:
            return Mounting(self._config, None)
        if not (self._imu_frame and self.antenna_frame):
            return None
        self._since = now if self._since is None else self._since
        found = find_mounting(self._lookup, self._imu_frame, self.antenna_frame, self._config)
        if found.missing and (self._required or now - self._since < WAIT):
            if self._required:
                self.waits_for = f'the transform {" and that ".join(found.missing)}'
            return None
        return found

    def _lookup(self, target: str, source: str) -> Transform | None:
        assert self._buffer is not None
        if not self._buffer.can_transform(target, source, Time()):
            return None
        return transform_from_msg(self._buffer.lookup_transform(target, source, Time()).transform)
