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
"""Serialised ROS messages to arrays, IMU messages many at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

from ins_align.bag_files import Topic
from ins_align.messages import imu_from_msg, MessageError, stamp_from_msg
import numpy as np

# sensor_msgs/Imu behind its header: orientation 4 and its covariance 9, angular velocity 3 and 9,
# linear acceleration 3 and 9, all float64 without gaps in both serialisations.
_BODY_BYTES = 8 * (4 + 9 + 3 + 9 + 3 + 9)
_RATE_OFFSET = 8 * (4 + 9)
_FORCE_OFFSET = _RATE_OFFSET + 8 * (3 + 9)
_CDR_LITTLE_ENDIAN = b'\x00\x01'  # OMG DDSI-RTPS 2.3, 10.2: encapsulation of plain CDR
_FRAME_LENGTH = slice(12, 16)  # of the frame_id, in both serialisations


class ImuSamples(NamedTuple):
    """Rates and specific forces in the order of their messages."""

    stamps_ns: np.ndarray  # (N,) int64
    gyro: np.ndarray  # (N, 3), rad/s
    accel: np.ndarray  # (N, 3), m/s^2
    decoded: np.ndarray  # (M,) bool: which of M messages the N samples come from


class Orientations(NamedTuple):
    """Orientations in the order of their messages."""

    stamps_ns: np.ndarray  # (N,) int64
    quaternions: np.ndarray  # (N, 4), (x, y, z, w)
    covariances: np.ndarray  # (N, 9), rad^2


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
    raw = None if start is None else _stacked(messages)
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


def _stacked(messages: Sequence[bytes]) -> np.ndarray | None:
    """Return the bytes of messages of one layout in rows; None if there is more than one."""
    if len(set(map(len, messages))) > 1:
        return None
    raw = np.frombuffer(b''.join(messages), np.uint8).reshape(len(messages), -1)
    alike = ((raw[:, :2] == raw[0, :2]).all()
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
    start = 16 + frame_length
    if encoding == 'cdr':
        if message[:2] != _CDR_LITTLE_ENDIAN:
            return None
        start += -(start - 4) % 8  # float64 is aligned from behind the encapsulation
    return start if len(message) == start + _BODY_BYTES else None


def _columns(raw: np.ndarray, start: int, fields: tuple[tuple[int, int], ...],
             ) -> list[np.ndarray]:
    """Decode messages in rows of bytes, whose numbers start at one place."""
    def column(offset: int, size: int, kind: str) -> np.ndarray:
        return np.ascontiguousarray(raw[:, offset:offset + size]).view(kind)

    # Both begin with four other bytes: the encapsulation, or the sequence number of ROS 1.
    seconds = column(4, 4, '<i4')[:, 0].astype(np.int64)
    nanoseconds = column(8, 4, '<u4')[:, 0]
    return [seconds * 1_000_000_000 + nanoseconds,
            *(column(start + offset, 8 * width, '<f8') for offset, width in fields)]
