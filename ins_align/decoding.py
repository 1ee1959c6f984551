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

from ins_align.bag_files import Messages, Topic
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
_UNKNOWN = -1  # where the numbers of another layout start
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


Position = TypeVar('Position', int, np.ndarray)
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


def decode_imu(messages: Messages, topic: Topic) -> ImuSamples:
    """
    Decode serialised sensor_msgs/Imu; messages that cannot be decoded are left out.

    Messages of one layout are taken from their bytes all at once; the rosbags library decodes
    those that differ from the layout that this module knows.
    """
    return ImuSamples(*_decode(messages, topic, ((_RATE_OFFSET, 3), (_FORCE_OFFSET, 3)),
                               imu_from_msg))


def decode_orientations(messages: Messages, topic: Topic) -> Orientations:
    """Decode the orientations of serialised sensor_msgs/Imu like `decode_imu`."""
    return Orientations(*_decode(messages, topic, ((0, 4), (8 * 4, 9)), _orientation_from_msg)[:3])


def _orientation_from_msg(msg: Any) -> tuple[int, list[float], np.ndarray]:
    quaternion = msg.orientation
    return (stamp_from_msg(msg), [quaternion.x, quaternion.y, quaternion.z, quaternion.w],
            msg.orientation_covariance)


def _decode(messages: Messages, topic: Topic, fields: tuple[tuple[int, int], ...],
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
    starts = _body_starts(messages, topic.encoding)
    if starts.size and starts[0] != _UNKNOWN and (starts == starts[0]).all():
        return _columns(messages, int(starts[0]), fields) + [np.ones(starts.size, bool)]
    columns = [np.zeros(starts.size, np.int64)] + [np.zeros((starts.size, width))
                                                   for _, width in fields]
    decoded = np.ones(starts.size, bool)
    for start in np.unique(starts[starts != _UNKNOWN]).tolist():
        places = np.flatnonzero(starts == start)
        for column, values in zip(columns, _columns(messages.take(places), start, fields)):
            column[places] = values
    for index in np.flatnonzero(starts == _UNKNOWN).tolist():
        try:
            converted = convert(deserialize(messages[index], topic))
        except MessageError:
            decoded[index] = False
            continue
        for column, value in zip(columns, converted):
            column[index] = value
    return [column if decoded.all() else column[decoded] for column in columns] + [decoded]


def body_start(message: bytes, encoding: str) -> int | None:
    """
    Return where the numbers of a sensor_msgs/Imu start, behind its header.

    None: this is not the known layout, by its encapsulation or because header and numbers do not
    add up to its length.
    """
    if len(message) < _FRAME_LENGTH.stop:
        return None
    frame_length = int.from_bytes(message[_FRAME_LENGTH], 'little')
    if encoding == 'cdr' and message[:2] != _CDR_LITTLE_ENDIAN:
        return None
    start = _aligned(_FRAME_LENGTH.stop + frame_length, 8, encoding)
    return start if len(message) == start + _BODY_BYTES else None


def _body_starts(messages: Messages, encoding: str) -> np.ndarray:
    """Return what `body_start` does for each message, shape (N,), _UNKNOWN for None."""
    starts = np.full(len(messages), _UNKNOWN)
    long = np.flatnonzero(messages.lengths >= _FRAME_LENGTH.stop)
    heads = messages.take(long).rows(0, _FRAME_LENGTH.stop)
    start = _aligned(_FRAME_LENGTH.stop + heads.view('<u4')[:, 3].astype(np.int64), 8, encoding)
    known = messages.lengths[long] == start + _BODY_BYTES
    if encoding == 'cdr':
        known &= (heads[:, :2] == np.frombuffer(_CDR_LITTLE_ENDIAN, np.uint8)).all(axis=1)
    starts[long[known]] = start[known]
    return starts


def _columns(messages: Messages, start: int, fields: tuple[tuple[int, int], ...],
             ) -> list[np.ndarray]:
    """Decode messages whose numbers start at one place."""
    # Both begin with four other bytes: the encapsulation, or the sequence number of ROS 1.
    stamps = messages.rows(4, 8)
    seconds = stamps.view('<i4')[:, 0].astype(np.int64)
    nanoseconds = stamps.view('<u4')[:, 1]
    return [seconds * 1_000_000_000 + nanoseconds,
            *(messages.rows(start + offset, 8 * width).view('<f8') for offset, width in fields)]


def decode_fixes(messages: Messages, topic: Topic) -> list[Fix | Refused]:
    """Decode serialised sensor_msgs/NavSatFix, or say why not."""
    same = _same_layout(messages, topic.encoding, 1)
    if same is not None:
        _, status = same
        # Behind the header an int8 and a uint16, 12 numbers and a byte.
        start = _aligned(_aligned(status + 1, 2, topic.encoding) + 2, 8, topic.encoding)
        kind = start + 8 * 12
        if _ends(messages, kind + 1, topic.encoding):
            stamps, places, covariances = _columns(messages, start, ((0, 3), (8 * 3, 9)))
            return [*fixes(stamps, places, covariances.reshape(-1, 3, 3),
                           messages.rows(kind, 1)[:, 0],
                           messages.rows(status, 1)[:, 0].view(np.int8))]
    return [_by_library(message, topic, fix_from_msg, 'fix') for message in messages]


def decode_velocities(messages: Messages, topic: Topic,
                      config: Config) -> list[Velocity | Refused]:
    """Decode the messages that ``config.velocity_type`` names like `decode_fixes`."""
    strings, place, covariance, count = _VELOCITIES[config.velocity_type]
    same = _same_layout(messages, topic.encoding, strings)
    if same is not None:
        names, end = same
        start = _aligned(end, 8, topic.encoding)
        if _ends(messages, start + 8 * count, topic.encoding):
            fields = [(8 * place, 3)] + ([] if covariance is None else [(8 * covariance, 36)])
            stamps, linear, *twist = _columns(messages, start, tuple(fields))
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


def _same_layout(messages: Messages, encoding: str, strings: int,
                 ) -> tuple[list[str], int] | None:
    """
    Return the strings at the front of the messages and where these end.

    None if they are not all alike in this and in their lengths, or are serialised in a way that
    this module does not know.
    """
    lengths = messages.lengths
    if not lengths.size or lengths[0] < _FRAME_LENGTH.stop or (lengths != lengths[0]).any():
        return None
    first = messages[0]
    if encoding == 'cdr' and first[:2] != _CDR_LITTLE_ENDIAN:
        return None
    names = []
    end = _FRAME_LENGTH.start
    for _ in range(strings):
        start = _aligned(end, 4, encoding) + 4
        end = start + int.from_bytes(first[start - 4:start], 'little')
        name = first[start:end]
        if encoding == 'cdr':  # where a string ends with a zero, which its length counts
            if not name.endswith(b'\0'):
                return None
            name = name[:-1]
        try:
            names.append(name.decode())
        except UnicodeDecodeError:
            return None
    if end > len(first):
        return None
    front = messages.rows(0, end)
    alike = (front == front[0])[:, _FRAME_LENGTH.start:].all()
    if encoding == 'cdr':
        alike &= (front[:, :2] == front[0, :2]).all()
    return (names, end) if alike else None


def _aligned(position: Position, size: int, encoding: str) -> Position:
    """Return where the next value of a size lies, in CDR as counted behind the encapsulation."""
    return position + (-(position - 4) % size if encoding == 'cdr' else 0)


def _ends(messages: Messages, end: int, encoding: str) -> bool:
    """Whether messages of one length end here; some serialisations of CDR fill four bytes."""
    return end <= messages.lengths[0] <= (end + 3 if encoding == 'cdr' else end)
