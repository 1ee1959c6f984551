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
"""Where the antenna and the vehicle's base frame are on the robot, from its frame tree (TF)."""

from collections import deque
from collections.abc import Callable, Collection, Sequence
import dataclasses
from typing import Any, NamedTuple

from ins_align.config import Config, ConfigError
from ins_align.geometry.rotation import (
    Array, matrix_from_quaternion, quaternion_from_matrix, Transform)
from ins_align.results import Event, Severity
import numpy as np

ROUNDING = 1e-6  # m: smaller differences between lever arms are rounding
# Fixed transforms are published once and kept for late subscribers, so they arrive about when the
# first sensor messages do.
# s, for an optional transform, after both sensors have sent messages, and until it is looked up
# again: it may come much later, as from a driver that starts last.
WAIT = 2.0
MAX_HELD = 4000  # messages

# Returns the transform from a source frame to a target frame (target, source), None if unknown.
Lookup = Callable[[str, str], 'Transform | None']


def transform_from_msg(msg: Any) -> Transform:
    """Convert geometry_msgs/Transform; an invalid quaternion gives nan."""
    turn, way = msg.rotation, msg.translation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    with np.errstate(invalid='ignore'):
        quaternion /= np.linalg.norm(quaternion)
    return Transform(matrix_from_quaternion(quaternion), np.array([way.x, way.y, way.z]))


def turn_to_base(msg: Any, base: Transform, base_frame: str) -> None:
    """
    Turn a sensor_msgs/Imu with an orientation in ENU into the axes of the base, in place.

    `base` is from the base to the IMU. The covariance of the orientation is about east, north, up
    and stays the same.
    """
    turn, C_imu_base = msg.orientation, base.rotation
    C_nb = matrix_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w])) @ C_imu_base
    turn.x, turn.y, turn.z, turn.w = quaternion_from_matrix(C_nb).tolist()
    for name in ('angular_velocity', 'linear_acceleration'):
        vector = getattr(msg, name)
        vector.x, vector.y, vector.z = (
            np.array([vector.x, vector.y, vector.z]) @ C_imu_base).tolist()
        covariance = getattr(msg, f'{name}_covariance')
        if covariance[0] != -1.0:  # which means that the message has no such vector
            setattr(msg, f'{name}_covariance',
                    (C_imu_base.T @ np.reshape(covariance, (3, 3)) @ C_imu_base).ravel())
    msg.header.frame_id = base_frame


class FixedFrames:
    """The frame tree of /tf_static."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Transform]] = {}

    def add(self, msg: Any) -> None:
        """Take a geometry_msgs/TransformStamped; it replaces an earlier one of the same child."""
        self._parents[msg.child_frame_id.strip('/')] = (
            msg.header.frame_id.strip('/'), transform_from_msg(msg.transform))

    def lookup(self, target: str, source: str) -> Transform | None:
        """Return the transform from source to target, None where they are not connected."""
        (root, from_target), (other_root, from_source) = map(self._to_root, (target, source))
        return from_target.inverse().after(from_source) if root == other_root else None

    def _to_root(self, frame: str) -> tuple[str, Transform]:
        frame, transform = frame.strip('/'), Transform(np.eye(3), np.zeros(3))
        for _ in self._parents:  # bounded, because the tree may contain a loop
            if frame in self._parents:
                frame, step = self._parents[frame]
                transform = step.after(transform)
        return frame, transform


class Mounting(NamedTuple):
    """Configuration and base frame according to TF."""

    config: Config  # with the lever arm to use
    base: Transform | None  # from base_frame to the IMU frame
    words: Sequence[Event] = ()  # what was taken from TF, and what contradicts it
    missing: Sequence[str] = ()  # transforms that parameters require and TF lacks, in words
    complete: bool = True  # False: a transform to the antenna may still come


def find_mounting(lookup: Lookup, imu_frame: str, antenna_frame: str, config: Config) -> Mounting:
    """Look up what the parameters ask for between the frame_ids of IMU and position messages."""
    words: list[Event] = []
    missing: list[str] = []
    base, complete = None, True
    if config.lever_arm_from_tf is not False:
        # A driver of both sensors may use one frame_id: that says nothing about the lever arm.
        told_apart = imu_frame.strip('/') != antenna_frame.strip('/')
        to_antenna = (lookup(imu_frame, antenna_frame)
                      if told_apart and imu_frame and antenna_frame else None)
        complete = to_antenna is not None
        if to_antenna is not None:
            config = _with_lever_arm(config, to_antenna.translation, (imu_frame, antenna_frame),
                                     words)
        elif config.lever_arm_from_tf is True:
            missing.append(f'from {antenna_frame!r} (antenna) to {imu_frame!r} (IMU)')
    if config.base_frame:
        base = lookup(imu_frame, config.base_frame) if imu_frame else None
        if base is None or not all(np.isfinite(part).all() for part in base):
            missing.append(f'from {config.base_frame!r} (base) to {imu_frame!r} (IMU)')
    return Mounting(config, base, words, missing, complete)


def _with_lever_arm(config: Config, found: Array, frames: tuple[str, str],
                    words: list[Event]) -> Config:
    """Return the configuration, with the lever arm of TF if that is to be used; add to `words`."""
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
    Looks for the transforms that the parameters ask for, while messages arrive.

    The search begins when both sensors have sent messages. `lookup` is None where there is no TF;
    if the parameters require a transform then, a ConfigError is raised.
    """

    def __init__(self, config: Config, lookup: Lookup | None) -> None:
        self._config, self._lookup = config, lookup
        self._required = config.lever_arm_from_tf is True or bool(config.base_frame)
        if self._required and lookup is None:
            raise ConfigError('lever_arm_from_tf is true or base_frame is set, but tf2_ros is not '
                              'installed: sudo apt install ros-$ROS_DISTRO-tf2-ros-py')
        self.antenna_frame: str | None = None  # None: no position yet
        self._lever_arm = config.lever_arm  # in use
        self._held: deque[tuple[int, Any]] = deque(maxlen=MAX_HELD)
        self.restart()

    def restart(self) -> None:
        """Search again, because the IMU is a different one."""
        self.mounting: Mounting | None = None
        self.waits_for = 'a message of the IMU and a position' if self._required else ''
        self._since: float | None = None
        self._again = 0.0  # when to look for what is missing, s
        self._imu_frame: str | None = None
        self.forget()

    def forget(self) -> None:
        """Drop the messages that are kept, because the alignment starts over."""
        self._held.clear()

    def take(self, items: list[tuple[int, Any]], now: float,
             other_frames: Collection[str] = (),
             ) -> tuple[list[tuple[int, Any]], Mounting | None]:
        """
        Search on; return the items to process now, and the mounting when it is found.

        Items are messages and requests (which are callable) with the time when they came, ns; IMU
        samples have a `frame_id`; `other_frames` are those of IMUs that are not aligned. Messages
        are kept for `WAIT`, or until a transform that is required is there. Then all of them are
        returned, if they had to wait or the lever arm has changed. `now` is in seconds.
        """
        before = self.mounting
        if before is not None and (before.complete or now < self._again):
            return items, None
        self._imu_frame = next((item.frame_id for _, item in reversed(items)
                                if getattr(item, 'frame_id', None) not in (None, *other_frames)),
                               self._imu_frame)
        self.mounting = self._find(now)
        if self.mounting is None:
            self._held.extend(item for item in items if not callable(item[1]))
            return [item for item in items if not self._required or callable(item[1])], None
        self._again = now + WAIT
        if before is not None and not self.mounting.complete:
            return items, None
        self.waits_for = ''
        anew = self._required or self.mounting.config.lever_arm != self._lever_arm
        self._lever_arm = self.mounting.config.lever_arm
        held = list(self._held)
        self.forget()
        return [*held, *items] if anew else items, self.mounting

    def _find(self, now: float) -> Mounting | None:
        """Return the mounting; None while the search goes on."""
        if self._lookup is None:
            return Mounting(self._config, None)
        if self._imu_frame is None or self.antenna_frame is None:
            return None
        self._since = now if self._since is None else self._since
        found = find_mounting(self._lookup, self._imu_frame, self.antenna_frame, self._config)
        if found.missing:
            self.waits_for = f'the transform {" and that ".join(found.missing)}'
        elif found.complete or now - self._since >= WAIT:
            if not found.complete and self._config.lever_arm == Config.lever_arm:
                found = found._replace(words=[*found.words, Event(Severity.INFO, (
                    f'TF has no transform from the antenna ({self.antenna_frame!r}) to the IMU '
                    f'({self._imu_frame!r}) yet: lever_arm [0, 0, 0] m is used until it has'))])
            return found
        return None
