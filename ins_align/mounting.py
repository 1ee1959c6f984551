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
"""Where the antenna and the vehicle's base are, from the robot's tree of frames (TF)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
import dataclasses
from typing import Any, NamedTuple

from ins_align.config import Config, ConfigError
from ins_align.geometry.rotation import Array, matrix_from_quaternion, Transform
from ins_align.results import Event, Severity
import numpy as np

ROUNDING = 1e-6  # m: numbers of a robot's model that differ less are the same
# A robot's model is published once, to all who join: it is there as soon as the sensors are.
WAIT = 2.0  # s, for what may not be there, from when both sensors have sent
MAX_HELD = 4000

# Target and source frame to the transform between them, None where there is none.
Lookup = Callable[[str, str], 'Transform | None']


def transform_from_msg(msg: Any) -> Transform:
    """Convert geometry_msgs/Transform; numbers that are none end in nan."""
    turn, way = msg.rotation, msg.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    with np.errstate(invalid='ignore'):
        quaternion /= np.linalg.norm(quaternion)
    return Transform(matrix_from_quaternion(quaternion), np.array([way.x, way.y, way.z]))


class FixedFrames:
    """The fixed part of a tree of frames, as /tf_static has it."""

    def __init__(self) -> None:
        """Start without any frame."""
        self._parents: dict[str, tuple[str, Transform]] = {}

    def add(self, msg: Any) -> None:
        """Take a geometry_msgs/TransformStamped; of one child the last counts."""
        self._parents[msg.child_frame_id.strip('/')] = (
            msg.header.frame_id.strip('/'), transform_from_msg(msg.transform))

    def lookup(self, target: str, source: str) -> Transform | None:
        """Return the transform from source to target, None where they are not connected."""
        (root, from_target), (other_root, from_source) = map(self._to_root, (target, source))
        return from_target.inverse().after(from_source) if root == other_root else None

    def _to_root(self, frame: str) -> tuple[str, Transform]:
        frame, transform = frame.strip('/'), Transform(np.eye(3), np.zeros(3))
        for _ in self._parents:  # as many steps as there can be: a loop has no end
            if frame in self._parents:
                frame, step = self._parents[frame]
                transform = step.after(transform)
        return frame, transform


class Mounting(NamedTuple):
    """What TF says, and what follows from it."""

    config: Config  # with the lever arm to align with
    base: Transform | None  # from the configured base to the IMU
    words: Sequence[Event] = ()  # what was taken from TF, what contradicts it
    missing: Sequence[str] = ()  # transforms that parameters insist on and TF lacks, in words
    complete: bool = True  # whether all is there that would be used


def find_mounting(lookup: Lookup, imu_frame: str, antenna_frame: str, config: Config) -> Mounting:
    """
    Look up lever arm and mounting, as ``lever_arm_from_tf`` and ``base_frame`` want them.

    `lookup` returns the transform from its second argument to its first, or None; the frames are
    the frame_id of the IMU's and of the position messages.
    """
    words: list[Event] = []
    missing: list[str] = []
    base, complete = None, True
    if config.lever_arm_from_tf is not False:
        to_antenna = lookup(imu_frame, antenna_frame) if imu_frame and antenna_frame else None
        complete = to_antenna is not None
        if to_antenna is not None:
            config = _with_lever_arm(config, to_antenna.translation, (imu_frame, antenna_frame),
                                     words)
        elif config.lever_arm_from_tf is True:
            missing.append(f'from {antenna_frame!r} (antenna) to {imu_frame!r} (IMU)')
    if config.base_frame:
        base = lookup(imu_frame, config.base_frame) if imu_frame else None
        if base is None:
            missing.append(f'from {config.base_frame!r} (base) to {imu_frame!r} (IMU)')
    return Mounting(config, base, words, missing, complete)


def _with_lever_arm(config: Config, found: Array, frames: tuple[str, str],
                    words: list[Event]) -> Config:
    """Return the configuration with the lever arm of TF where it is to be used."""
    is_set = config.lever_arm != Config.lever_arm
    numbers = ', '.join(f'{number:.4g}' for number in np.round(found, 4) + 0.0)     # no -0
    in_tf = f'[{numbers}] m (from {frames[0]} to {frames[1]})'
    use = config.lever_arm_from_tf is True or not is_set
    try:
        from_tf = dataclasses.replace(config, lever_arm=tuple(found.tolist()))
    except ConfigError:
        words.append(Event(Severity.WARNING, f'the lever arm that TF has is none: {in_tf}'))
        return config
    if is_set and np.any(np.abs(found - config.lever_arm) > config.lever_arm_std + ROUNDING):
        words.append(Event(
            Severity.WARNING,
            f'lever_arm is {list(config.lever_arm)} m, but TF has {in_tf}, which differs by more '
            f'than lever_arm_std ({config.lever_arm_std:g} m): '
            f'{"that of TF" if use else "the parameter"} is used'))
    elif use:
        words.append(Event(Severity.INFO, f'lever arm from TF: {in_tf}'))
    return from_tf if use else config


class MountingSearch:
    """
    Looks for the transforms that the parameters want while messages arrive.

    It begins once both sensors have sent messages. Without a `lookup` there is no TF: a
    ConfigError if the parameters cannot do without.
    """

    def __init__(self, config: Config, lookup: Lookup | None) -> None:
        self._config, self._lookup = config, lookup
        self._required = config.lever_arm_from_tf is True or bool(config.base_frame)
        if self._required and lookup is None:
            raise ConfigError('lever_arm_from_tf is true or base_frame is set, but tf2_ros is not '
                              'installed: sudo apt install ros-$ROS_DISTRO-tf2-ros-py')
        self.antenna_frame: str | None = None  # until a position has come
        self._imu_frame: str | None = None
        self._lever_arm = config.lever_arm  # that is in use
        self._held: deque[tuple[int, Any]] = deque(maxlen=MAX_HELD)
        self.restart()

    def restart(self) -> None:
        """Look again: the IMU is another one."""
        self.mounting: Mounting | None = None
        self.waits_for = 'a message of the IMU and a position' if self._required else ''
        self._since: float | None = None
        self._held.clear()

    def take(self, items: list[tuple[int, Any]], now: float,
             ) -> tuple[list[tuple[int, Any]], Mounting | None]:
        """
        Look for the transforms; keep the messages until they are known or given up.

        Items are messages and, callable, requests, with when they came, ns; IMU samples have a
        `frame_id`. Returns what to align with now, which is all that was kept where a lever arm
        was found, and once what TF says. `now` is in seconds.
        """
        if self.mounting is not None:
            return items, None
        messages = [item for item in items if not callable(item[1])]
        requests = [item for item in items if callable(item[1])]
        self._held.extend(messages)
        self._imu_frame = next((item.frame_id for _, item in reversed(messages)
                                if hasattr(item, 'frame_id')), self._imu_frame)
        self.mounting = self._find(now)
        if self.mounting is None:
            return requests if self._required else items, None
        self.waits_for = ''
        anew = self._required or self.mounting.config.lever_arm != self._lever_arm
        self._lever_arm = self.mounting.config.lever_arm
        held = list(self._held)
        self._held.clear()
        return [*requests, *held] if anew else items, self.mounting

    def _find(self, now: float) -> Mounting | None:
        """Return what TF says, or that it says nothing; None while that is not known."""
        if self._lookup is None:
            return Mounting(self._config, None)
        if self._imu_frame is None or self.antenna_frame is None:
            return None
        self._since = now if self._since is None else self._since
        found = find_mounting(self._lookup, self._imu_frame, self.antenna_frame, self._config)
        if found.missing:
            self.waits_for = f'the transform {" and that ".join(found.missing)}'
        elif found.complete or now - self._since >= WAIT:
            return found
        return None
