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
"""Serialised ROS messages to arrays and tuples, many messages of one layout at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

from ins_align.bag_files import Topic
from ins_align.config import Config
from ins_align.messages import (
    Fix, fix_from_msg, fixes, imu_from_msg, MessageError, stamp_from_msg, velocities, Velocity,
    velocity_from_msg)
import numpy as np

# sensor_msgs/Imu behind its header: orientation 4 and its covariance 9, angular velocity 3 and 9,
# linear acceleration 3 and 9, all float64 without gaps in both serialisations.
_BODY_BYTES = 8 * (4 + 9 + 3 + 9 + 3 + 9)
_RATE_OFFSET = 8 * (4 + 9)
_FORCE_OFFSET = _RATE_OFFSET + 8 * (3 + 9)
_CDR_LITTLE_ENDIAN = b'\x00\x01'  # OMG DDSI-RTPS 2.3, 10.2: encapsulation of plain CDR
_FRAME_LENGTH = slice(12, 16)  # of the frame_id, in both serialisations
# Velocity messages: strings at the front, then float64 alone; of these the place of the velocity
# (3), that of the covariance of the twist (36) and how many there are.
_VELOCITIES = {'TwistStamped': (1, 0, None, 6),
               'TwistWithCovarianceStamped': (1, 0, 6, 6 + 36),
               'Odometry': (2, 7 + 36, 7 + 36 + 6, 7 + 36 + 6 + 36)}


class ImuSamples(NamedTuple):
    """Rates and specific forces in the order of their messages."""

    stamps_ns: np.ndarray  # (N,) int64
    gyro: np.ndarray  # (N, 3), rad/s
    accel: np.ndarray  # (N, 3), m/s^2
    decoded: np.ndarray  # (M,) bool: which of M messages the N samples come from


class Attitudes(NamedTuple):
    """Orientations that are known, in the order of their messages."""

    stamps_ns: np.ndarray  # (N,) int64
    quaternions: np.ndarray  # (N, 4), (x, y, z, w)


class Orientations(NamedTuple):
    """Orientations in the order of their messages."""

    stamps_ns: np.ndarray  # (N,) int64
    quaternions: np.ndarray  # (N, 4), (x, y, z, w)
    covariances: np.ndarray  # (N, 9), rad^2

    def known(self) -> Attitudes:
        """Return those without a negative variance ("not known") and with a direction."""
        good = (np.isfinite(self.quaternions).all(axis=1)
                & (np.abs(self.quaternions).max(axis=1, initial=0.0) > 1e-3)
                & ~(self.covariances[:, 0] < 0.0))
        return Attitudes(self.stamps_ns[good], self.quaternions[good])


class Refused(NamedTuple):
    """A GNSS message that cannot be used: as what it is counted, and why where that helps."""

    counter: str
    why: str = ''


Columns = TypeVar('Columns', ImuSamples, Orientations)


def joined(parts: Sequence[Columns]) -> Columns:
    """Put columns one behind the other."""
    return type(parts[0])(*map(np.concatenate, zip(*parts)))


@lru_cache(maxsize=None)
def _typestore(encoding: str) -> Any:
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS1_NOETIC if encoding == 'ros1' else Stores.ROS2_JAZZY)


def deserialize(data: bytes, topic: Topic) -> Any:
    """
    Deserialise one message with the rosbags library.

    Raises
    ------
    MessageError
        If the bytes are no message of the topic's type.

    """
    store = _typestore(topic.encoding)
    try:
        if topic.encoding == 'ros1':
            return store.deserialize_ros1(data, topic.msgtype)
        return store.deserialize_cdr(data, topic.msgtype)
    except Exception:  # generated code: damaged bytes end in whatever they run into
        raise MessageError(f'a message of {len(data)} bytes on {topic.name} is no '
                           f'{topic.msgtype}') from None


def decode_imu(messages: Sequence[bytes], topic: Topic) -> ImuSamples:
    """
    Decode serialised sensor_msgs/Imu; messages that cannot be decoded are left out.

    Messages of one layout are taken from their bytes all at once; the rosbags library decodes
    those that differ from the layout that this module knows.
    """
    return ImuSamples(*_decode(messages, topic, ((_RATE_OFFSET, 3), (_FORCE_OFFSET, 3)),
                               imu_from_msg))


def decode_orientations(messages: Sequence[bytes], topic: Topic) -> Orientations:
    """Decode the orientations of serialised sensor_msgs/Imu like `decode_imu`."""
    return Orientations(*_decode(messages, topic, ((0, 4), (8 * 4, 9)), _orientation_from_msg)[:3])


def _orientation_from_msg(msg: Any) -> tuple[int, list[float], np.ndarray]:
    quaternion = msg.orientation
    return (stamp_from_msg(msg), [quaternion.x, quaternion.y, quaternion.z, quaternion.w],
            msg.orientation_covariance)


def _decode(messages: Sequence[bytes], topic: Topic, fields: tuple[tuple[int, int], ...],
            convert: Callable[[Any], tuple[Any, ...]]) -> list[np.ndarray]:
    """
    Return stamps, the fields and which messages could be decoded.

    Parameters
    ----------
    messages, topic
        As for `decode_imu`.
    fields : tuple of (offset, width)
        Where in the body a field starts, bytes, and how many numbers it has.
    convert : callable
        Makes the same of a message of the library.

    """
    start = body_start(messages[0], topic.encoding) if messages else None
    raw = None if start is None else _stacked(messages, topic.encoding)
    if start is not None and raw is not None:
        return _columns(raw, start, fields) + [np.ones(len(messages), bool)]
    count = len(messages)
    columns = [np.zeros(count, np.int64)] + [np.zeros((count, width)) for _, width in fields]
    decoded = np.ones(count, bool)
    for index, message in enumerate(messages):
        start = body_start(message, topic.encoding)
        try:
            values = (convert(deserialize(message, topic)) if start is None
                      else [column[0] for column in _columns(
                          np.frombuffer(message, np.uint8)[None, :], start, fields)])
        except MessageError:
            decoded[index] = False
            continue
        for column, value in zip(columns, values):
            column[index] = value
    return [column if decoded.all() else column[decoded] for column in columns] + [decoded]


def _stacked(messages: Sequence[bytes], encoding: str) -> np.ndarray | None:
    """Return the bytes of messages in rows; None if their lengths or encapsulations differ."""
    length = len(messages[0])
    if length < _FRAME_LENGTH.stop or len(set(map(len, messages))) > 1:
        return None
    raw = np.frombuffer(b''.join(messages), np.uint8).reshape(len(messages), length)
    alike = ((encoding != 'cdr' or (raw[:, :2] == raw[0, :2]).all())
             and (raw[:, _FRAME_LENGTH] == raw[0, _FRAME_LENGTH]).all())
    return raw if alike else None


def body_start(message: bytes, encoding: str) -> int | None:
    """
    Return where the numbers of a sensor_msgs/Imu start, behind its header.

    None: this is not the known layout, by its encapsulation or because header and numbers do not
    add up to its length.
    """
    if len(message) < 16:
        return None
    frame_length = int.from_bytes(message[_FRAME_LENGTH], 'little')
    if encoding == 'cdr' and message[:2] != _CDR_LITTLE_ENDIAN:
        return None
    start = _aligned(16 + frame_length, 8, encoding)
    return start if len(message) == start + _BODY_BYTES else None


def _columns(raw: np.ndarray, start: int, fields: tuple[tuple[int, int], ...],
             ) -> list[np.ndarray]:
    """Decode messages in rows of bytes, whose numbers start at one place."""
    # Both begin with four other bytes: the encapsulation, or the sequence number of ROS 1.
    seconds = _column(raw, 4, '<i4')[:, 0].astype(np.int64)
    nanoseconds = _column(raw, 8, '<u4')[:, 0]
    return [seconds * 1_000_000_000 + nanoseconds,
            *(_column(raw, start + offset, '<f8', width) for offset, width in fields)]


def _column(raw: np.ndarray, start: int, kind: str, width: int = 1) -> np.ndarray:
    size = width * np.dtype(kind).itemsize
    return np.ascontiguousarray(raw[:, start:start + size]).view(kind)


def decode_fixes(messages: Sequence[bytes], topic: Topic) -> list[Fix | Refused]:
    """Decode serialised sensor_msgs/NavSatFix, or say why not."""
    same = _same_layout(messages, topic.encoding, 1)
    if same is not None:
        raw, _, status = same
        # Behind the header an int8 and a uint16, 12 numbers and a byte.
        start = _aligned(_aligned(status + 1, 2, topic.encoding) + 2, 8, topic.encoding)
        kind = start + 8 * 12
        if _ends(raw, kind + 1, topic.encoding):
            stamps, places, covariances = _columns(raw, start, ((0, 3), (8 * 3, 9)))
            return [*fixes(stamps, places, covariances.reshape(-1, 3, 3), raw[:, kind],
                           raw[:, status].view(np.int8))]
    return [_by_library(message, topic, fix_from_msg, 'fix') for message in messages]


def decode_velocities(messages: Sequence[bytes], topic: Topic,
                      config: Config) -> list[Velocity | Refused]:
    """Decode the messages that ``config.velocity_type`` names like `decode_fixes`."""
    strings, place, covariance, count = _VELOCITIES[config.velocity_type]
    same = _same_layout(messages, topic.encoding, strings)
    if same is not None:
        raw, names, end = same
        start = _aligned(end, 8, topic.encoding)
        if _ends(raw, start + 8 * count, topic.encoding):
            fields = [(8 * place, 3)] + ([] if covariance is None else [(8 * covariance, 36)])
            stamps, linear, *twist = _columns(raw, start, tuple(fields))
            try:
                return [*velocities(stamps, names[-1], linear,
                                    twist[0].reshape(-1, 6, 6) if twist else None, config)]
            except MessageError as error:
                return [Refused('velocity_body_frame', str(error))] * len(messages)
    return [_by_library(message, topic, lambda msg: velocity_from_msg(msg, config), 'velocity')
            for message in messages]


def _by_library(message: bytes, topic: Topic, convert: Callable[[Any], Any], name: str) -> Any:
    try:
        msg = deserialize(message, topic)
    except MessageError:
        return Refused(f'{name}_undecodable')
    try:
        return convert(msg)
    except MessageError as error:
        return Refused('velocity_body_frame', str(error))


def _same_layout(messages: Sequence[bytes], encoding: str, strings: int,
                 ) -> tuple[np.ndarray, list[str], int] | None:
    """
    Return messages in rows of bytes, the strings at their front and where these end.

    None if they are not all alike in this, or are serialised in a way that this module does not
    know.
    """
    raw = _stacked(messages, encoding) if messages else None
    if raw is None or (encoding == 'cdr' and messages[0][:2] != _CDR_LITTLE_ENDIAN):
        return None
    names = []
    end = _FRAME_LENGTH.start
    for _ in range(strings):
        start = _aligned(end, 4, encoding) + 4
        end = start + int.from_bytes(messages[0][start - 4:start], 'little')
        name = messages[0][start:end]
        if encoding == 'cdr':  # where a string ends with a zero, which its length counts
            if not name.endswith(b'\0'):
                return None
            name = name[:-1]
        try:
            names.append(name.decode())
        except UnicodeDecodeError:
            return None
    front = raw[:, _FRAME_LENGTH.start:end]
    return (raw, names, end) if (front == front[0]).all() else None


def _aligned(position: int, size: int, encoding: str) -> int:
    """Return where the next value of a size lies, in CDR as counted behind the encapsulation."""
    return position + (-(position - 4) % size if encoding == 'cdr' else 0)


def _ends(raw: np.ndarray, end: int, encoding: str) -> bool:
    """Whether messages are so long; some serialisations of CDR fill the last four bytes."""
    return end <= raw.shape[1] <= (end + 3 if encoding == 'cdr' else end)
