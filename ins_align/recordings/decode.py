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
"""Decodes messages: of sensor_msgs/Imu many at once with numpy, all others with rosbags."""

from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.gnss.drivers import (
    DRIVER_TYPES, gnss_from_msg, imu_from_driver, INERTIAL_UNITS, RECEIVERS, type_in_words,
    VELOCITY_TYPES)
from ins_align.gnss.messages import BodyFrameError, Fix, imu_from_msg, MessageError, Velocity
from ins_align.recordings import Topic
import numpy as np
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

IMU_TYPE, FIX_TYPE = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/NavSatFix'
TF_TYPE = 'tf2_msgs/msg/TFMessage'
# Types whose definition is read from the recording; rosbags has none of TF in ROS 1.
DEFINED_TYPES = {*DRIVER_TYPES, TF_TYPE}
VECTOR_TYPE = 'geometry_msgs/msg/Vector3Stamped'  # not always a velocity
# Kinds of measurement in the messages of a type.
KINDS = {IMU_TYPE: ('imu',), **dict.fromkeys(INERTIAL_UNITS, ('imu',)), FIX_TYPE: ('fix',),
         **dict.fromkeys(VELOCITY_TYPES, ('velocity',)),
         **dict.fromkeys(RECEIVERS, ('fix', 'velocity'))}
# A serialised sensor_msgs/Imu is a header (4 bytes, in cdr the encapsulation and in ROS 1 the
# sequence number; seconds, nanoseconds, length of the frame_id, frame_id) and 37 float64:
# orientation, angular rate, specific force, each with its covariance.
HEADER_BYTES, IMU_NUMBERS = 16, 37
ORIENTATION, ORIENTATION_COVARIANCE = slice(0, 4), slice(4, 13)
GYRO, ACCEL = slice(13, 16), slice(25, 28)


class ImuSamples(NamedTuple):
    """Samples of an IMU in the order of their messages."""

    stamps_ns: np.ndarray  # (N,) int64
    numbers: np.ndarray  # (N, 37), as in sensor_msgs/Imu; 0 for what a driver's message lacks
    decoded: np.ndarray  # (M,) bool: which of the M messages could be decoded

    @property
    def gyro(self) -> np.ndarray:
        """Angular rates, (N, 3), rad/s."""
        return self.numbers[:, GYRO]

    @property
    def accel(self) -> np.ndarray:
        """Specific forces, (N, 3), m/s^2."""
        return self.numbers[:, ACCEL]

    def orientations(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        Return the orientations that are finite, not zero, and whose variance is not negative.

        Stamps, (K,), ns, quaternions (x, y, z, w), (K, 4), and covariances, (K, 9), rad^2.
        """
        quaternions = self.numbers[:, ORIENTATION]
        covariances = self.numbers[:, ORIENTATION_COVARIANCE]
        known = (np.isfinite(quaternions).all(axis=1)
                 & (np.abs(quaternions).max(axis=1, initial=0.0) > 1e-3)
                 & ~(covariances[:, 0] < 0.0))
        return self.stamps_ns[known], quaternions[known], covariances[known]


class Refused(NamedTuple):
    """A GNSS message that cannot be used."""

    counter: str  # under which it is counted
    why: str = ''  # in words, if there is more to say


Gnss = Fix | Velocity | Refused


def decode(messages: Sequence[bytes], topic: Topic, config: Config) -> dict[str, Any]:
    """Decode messages of a topic; by kind, `ImuSamples` for imu, a list of `Gnss` for others."""
    if KINDS[topic.msgtype] == ('imu',):
        return {'imu': decode_imu(messages, topic)}
    return decode_gnss(messages, topic, config)


def decode_imu(messages: Sequence[bytes], topic: Topic) -> ImuSamples:
    """Decode messages of an IMU, sensor_msgs/Imu or a driver's; those that fail are left out."""
    if topic.msgtype == IMU_TYPE and len(set(map(len, messages))) == 1:
        rows = np.frombuffer(b''.join(messages), np.uint8).reshape(len(messages), -1)
        if (found := _decode_imu_rows(rows, topic.encoding)) is not None:
            return ImuSamples(*found, np.ones(len(messages), bool))
    stamps_ns = np.zeros(len(messages), np.int64)
    numbers = np.zeros((len(messages), IMU_NUMBERS))
    decoded = np.zeros(len(messages), bool)
    for place, data in enumerate(messages):
        with suppress(MessageError):
            message = deserialize(data, topic)
            stamps_ns[place], numbers[place, GYRO], numbers[place, ACCEL] = (
                imu_from_msg(message) if topic.msgtype == IMU_TYPE else
                imu_from_driver(message, topic.msgtype))
            if topic.msgtype == IMU_TYPE:
                q = message.orientation
                numbers[place, ORIENTATION] = q.x, q.y, q.z, q.w
                numbers[place, ORIENTATION_COVARIANCE] = message.orientation_covariance
            decoded[place] = True
    return ImuSamples(stamps_ns[decoded], numbers[decoded], decoded)


def _decode_imu_rows(data: np.ndarray, encoding: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return stamps and numbers of N serialised sensor_msgs/Imu; None if layouts differ."""
    start = data.shape[1] - 8 * IMU_NUMBERS
    if start < HEADER_BYTES:
        return None
    seconds, nanoseconds, frame_length = data[:, 4:HEADER_BYTES].copy().view('<u4').T
    end = HEADER_BYTES + frame_length.astype(np.int64)
    if encoding == 'cdr':
        end += -(end - 4) % 8  # numbers of eight bytes are aligned, counted from byte 4
        if np.any(data[:, :2] != (0, 1)):  # little endian: OMG DDSI-RTPS 2.3, 10.2
            return None
    if np.any(end != start):
        return None
    return (seconds.astype(np.int32).astype(np.int64) * 1_000_000_000 + nanoseconds,
            data[:, start:].copy().view('<f8'))


def decode_gnss(messages: Sequence[bytes], topic: Topic, config: Config) -> dict[str, list[Gnss]]:
    """Decode messages with positions, velocities or both: by kind, one `Gnss` per message."""
    rows = [_decode_gnss_message(data, topic, config) for data in messages]
    return {kind: [row[column] for row in rows]
            for column, kind in enumerate(KINDS[topic.msgtype])}


def _decode_gnss_message(data: bytes, topic: Topic, config: Config) -> Sequence[Gnss]:
    """Decode one message: one `Gnss` for each of its kinds."""
    try:
        return gnss_from_msg(deserialize(data, topic), topic.msgtype, config)
    except BodyFrameError as error:
        return [Refused('velocity_body_frame', str(error))]
    except MessageError as error:
        # Damaged messages of standard types are only counted.
        why = str(error) if topic.msgtype in RECEIVERS else ''
        return [Refused(f'{kind}_undecodable', why) for kind in KINDS[topic.msgtype]]


def short_name(msgtype: str) -> str:
    """Return a message type without its package."""
    return msgtype.rsplit('/', 1)[-1]


@lru_cache(maxsize=16)
def _typestore(encoding: str, msgtype: str, definition: str) -> Any:
    """Return a store of types, with one added if its definition is given."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == 'ros1' else Stores.ROS2_JAZZY)
    if definition:
        store.register({name: content for name, content
                        in get_types_from_msg(definition, msgtype).items()
                        if name not in store.types})
    return store


def deserialize(data: bytes, topic: Topic) -> Any:
    """Deserialise a message; a MessageError says that it is damaged or its type not defined."""
    if topic.msgtype in DRIVER_TYPES and not topic.definition:
        raise MessageError(
            f'the recording has no definition of {type_in_words(topic.msgtype)}: record as mcap, '
            'where the package of that message is installed, or "ros2 bag convert" it there to '
            'mcap')
    try:
        store = _typestore(topic.encoding, topic.msgtype,
                           topic.definition if topic.msgtype in DEFINED_TYPES else '')
        if topic.encoding == 'ros1':
            return store.deserialize_ros1(data, topic.msgtype)
        return store.deserialize_cdr(data, topic.msgtype)
    except Exception:  # damaged bytes cause errors of every kind in generated code
        raise MessageError(f'a message of {len(data)} bytes on {topic.name} is no '
                           f'{topic.msgtype}') from None
