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
"""Raw messages to arrays and tuples: IMU messages in bulk from their bytes, GNSS with rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

from ins_align.config import Config
from ins_align.gnss.drivers import (
    DRIVER_TYPES, imu_from_driver, receiver_from_msg, RECEIVERS, type_in_words)
from ins_align.gnss.messages import Fix, fixes, MessageError, velocities, Velocity
from ins_align.recordings import Topic
import numpy as np
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

IMU_TYPE = 'sensor_msgs/msg/Imu'
# sensor_msgs/Imu ends with 37 float64, as ROS 1 and CDR have them: of each field the place of its
# first number and how many they are.
IMU_NUMBERS = 37
IMU_FIELDS = {
    'orientation': (0, 4), 'orientation_covariance': (4, 9),
    'angular_velocity': (13, 3), 'linear_acceleration': (25, 3)}
# In front of them a header: four bytes that differ (encapsulation of CDR, sequence number of
# ROS 1), seconds, nanoseconds, length of the frame_id and the frame_id.
HEADER_BYTES = 16
# Byte order by what the message begins with: OMG DDSI-RTPS 2.3, 10.2.
BYTE_ORDERS = {'cdr': {'<': b'\x00\x01', '>': b'\x00\x00'}, 'ros1': {'<': b''}}


class GnssFields(NamedTuple):
    """Where a GNSS message has what an alignment reads, as paths of attributes."""

    kind: str  # fix or velocity
    values: str  # latitude and longitude, degrees, and altitude, m; or x, y, z, m/s
    covariance: str  # (9,), m^2, or that of a twist, (36,), m^2/s^2; '': there is none
    more: str  # of a fix the type of its covariance and its status, of a velocity its frame


GNSS_TYPES = {
    'sensor_msgs/msg/NavSatFix': GnssFields(
        'fix', 'latitude longitude altitude', 'position_covariance',
        'position_covariance_type status.status'),
    'geometry_msgs/msg/TwistWithCovarianceStamped': GnssFields(
        'velocity', 'twist.twist.linear.x twist.twist.linear.y twist.twist.linear.z',
        'twist.covariance', 'header.frame_id'),
    'geometry_msgs/msg/TwistStamped': GnssFields(
        'velocity', 'twist.linear.x twist.linear.y twist.linear.z', '', 'header.frame_id'),
    'nav_msgs/msg/Odometry': GnssFields(
        'velocity', 'twist.twist.linear.x twist.twist.linear.y twist.twist.linear.z',
        'twist.covariance', 'child_frame_id'),
    'geometry_msgs/msg/Vector3Stamped': GnssFields(
        'velocity', 'vector.x vector.y vector.z', '', 'header.frame_id'),
}


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
Key = TypeVar('Key', int, str)


def joined(parts: Sequence[Columns]) -> Columns:
    """Put columns one behind the other."""
    return type(parts[0])(*map(np.concatenate, zip(*parts)))


def decode_imu(messages: Sequence[bytes], encoding: str) -> ImuSamples:
    """Decode serialised sensor_msgs/Imu; what is none is left out."""
    return ImuSamples(*_decode(messages, encoding, 'angular_velocity', 'linear_acceleration'))


def decode_imu_topic(messages: Sequence[bytes], topic: Topic) -> ImuSamples:
    """Decode an IMU topic, sensor_msgs/Imu or a driver's own, like `decode_imu`."""
    if topic.msgtype == IMU_TYPE:
        return decode_imu(messages, topic.encoding)
    decoded = np.zeros(len(messages), bool)
    rows = []
    for place, data in enumerate(messages):
        with suppress(MessageError):
            rows.append(imu_from_driver(deserialize(data, topic), topic.msgtype))
            decoded[place] = True
    stamps, gyro, accel = zip(*rows) if rows else ((), (), ())
    return ImuSamples(np.array(stamps, np.int64), np.reshape(gyro, (-1, 3)),
                      np.reshape(accel, (-1, 3)), decoded)


def decode_orientations(messages: Sequence[bytes], encoding: str) -> Orientations:
    """Decode the orientations of serialised sensor_msgs/Imu like `decode_imu`."""
    return Orientations(
        *_decode(messages, encoding, 'orientation', 'orientation_covariance')[:-1])


def _decode(messages: Sequence[bytes], encoding: str, *names: str) -> list[np.ndarray]:
    """Return stamps, the named fields, and which of the messages could be decoded."""
    count = len(messages)
    columns = [np.zeros(count, np.int64), *(np.zeros((count, IMU_FIELDS[name][1]))
                                            for name in names)]
    decoded = np.zeros(count, bool)
    alike = _places_by(list(map(len, messages)))
    for length, places in alike.items():
        start = length - 8 * IMU_NUMBERS
        if start < HEADER_BYTES:
            continue
        data = b''.join([messages[place] for place in places])
        for order, mark in BYTE_ORDERS[encoding].items():
            rows = np.frombuffer(data, _layout(length, order, len(mark), names))
            end = HEADER_BYTES + rows['frame_length'].astype(np.int64)
            if encoding == 'cdr':  # numbers of eight bytes are aligned, counted from byte 4
                end += -(end - 4) % 8
            good = (end == start) & (rows['mark'] == np.void(mark) if mark else True)
            stamps = rows['sec'].astype(np.int64) * 1_000_000_000 + rows['nanosec']
            found = [stamps, *(rows[name].astype(float) for name in names)]
            if len(alike) == 1 and good.all():  # as usual: nothing has to be sorted out
                return [*found, good]
            chosen = np.array(places)[good]
            decoded[chosen] = True
            for column, values in zip(columns, found):
                column[chosen] = values[good]
    return [column[decoded] for column in columns] + [decoded]


def _places_by(keys: Sequence[Key]) -> dict[Key, Sequence[int]]:
    """Return where each key is."""
    if len(set(keys)) == 1:  # as usual
        return {keys[0]: range(len(keys))}
    places: dict[Key, list[int]] = {}
    for place, key in enumerate(keys):
        places.setdefault(key, []).append(place)
    return {**places}


@lru_cache(maxsize=64)
def _layout(length: int, order: str, mark: int, names: tuple[str, ...]) -> np.dtype[Any]:
    """Return where a message of a length has what is read of it."""
    start = length - 8 * IMU_NUMBERS
    numbers = {name: (f'({IMU_FIELDS[name][1]},){order}f8', start + 8 * IMU_FIELDS[name][0])
               for name in names}
    places = {'mark': (f'V{mark}', 0), 'sec': (f'{order}i4', 4), 'nanosec': (f'{order}u4', 8),
              'frame_length': (f'{order}u4', 12), **numbers}
    formats, offsets = zip(*places.values())
    return np.dtype({'names': list(places), 'formats': formats, 'offsets': offsets,
                     'itemsize': length})


@lru_cache(maxsize=16)
def _typestore(encoding: str, msgtype: str, definition: str) -> Any:
    """Return a store of types that has one, by the definition where it is a driver's."""
    store = get_typestore(Stores.ROS1_NOETIC if encoding == 'ros1' else Stores.ROS2_JAZZY)
    if msgtype in DRIVER_TYPES and definition:
        store.register({name: content for name, content
                        in get_types_from_msg(definition, msgtype).items()
                        if name not in store.types})
    return store


def deserialize(data: bytes, topic: Topic) -> Any:
    """
    Deserialise one message with rosbags.

    Raises
    ------
    MessageError
        If the bytes are none, or nothing defines the type.

    """
    if topic.msgtype in DRIVER_TYPES and not topic.definition:
        raise MessageError(
            f'the recording has no definition of {type_in_words(topic.msgtype)}: record as mcap, '
            'where the package of that message is installed, or "ros2 bag convert" it there to '
            'mcap')
    try:
        store = _typestore(topic.encoding, topic.msgtype,
                           topic.definition if topic.msgtype in DRIVER_TYPES else '')
        if topic.encoding == 'ros1':
            return store.deserialize_ros1(data, topic.msgtype)
        return store.deserialize_cdr(data, topic.msgtype)
    except Exception:  # generated code: damaged bytes end in whatever they run into
        raise MessageError(f'a message of {len(data)} bytes on {topic.name} is no '
                           f'{topic.msgtype}') from None


def decode_by_kind(messages: Sequence[bytes], topic: Topic, config: Config,
                   ) -> dict[str, Sequence[Fix | Velocity | Refused]]:
    """Decode a GNSS topic: its fixes or its velocities, of one of RECEIVERS both."""
    if topic.msgtype not in RECEIVERS:
        return {GNSS_TYPES[topic.msgtype].kind: decode_gnss(messages, topic, config)}
    both = [_of_receiver(data, topic, config) for data in messages]
    return {'fix': [fix for fix, _ in both], 'velocity': [velocity for _, velocity in both]}


def decode_gnss(messages: Sequence[bytes], topic: Topic, config: Config,
                ) -> list[Fix | Velocity | Refused]:
    """Decode messages of one of GNSS_TYPES, or say of each why not."""
    kind, values, covariance, more = GNSS_TYPES[topic.msgtype]
    read = attrgetter('header.stamp.sec', 'header.stamp.nanosec',
                      *f'{values} {more} {covariance}'.split())
    decoded: list[Fix | Velocity | Refused] = [Refused(f'{kind}_undecodable')] * len(messages)
    rows: list[tuple[Any, ...]] = []
    for place, data in enumerate(messages):
        with suppress(MessageError):
            rows.append((place, *read(deserialize(data, topic))))
    for frame, alike in _places_by([row[6] if kind == 'velocity' else '' for row in rows]).items():
        places, seconds, nanoseconds, x, y, z, *rest = zip(*(rows[place] for place in alike))
        stamps = np.array(seconds) * 1_000_000_000 + np.array(nanoseconds)
        numbers = np.array([x, y, z], float).T
        covariances = np.array(rest[-1]) if covariance else None
        found: Sequence[Fix | Velocity | Refused]
        if kind == 'fix':
            assert covariances is not None
            found = fixes(stamps, numbers, covariances.reshape(-1, 3, 3), rest[0], rest[1])
        else:
            try:
                found = velocities(stamps, frame, numbers, None if covariances is None else
                                   covariances.reshape(-1, 6, 6), config)
            except MessageError as error:
                found = [Refused('velocity_body_frame', str(error))] * len(alike)
        for place, message in zip(places, found):
            decoded[place] = message
    return decoded


def _of_receiver(data: bytes, topic: Topic, config: Config,
                 ) -> tuple[Fix | Refused, Velocity | Refused]:
    """Return position and velocity of a message of one of RECEIVERS."""
    try:
        return receiver_from_msg(deserialize(data, topic), topic.msgtype, config)
    except MessageError as error:
        return (Refused('fix_undecodable', str(error)),
                Refused('velocity_undecodable', str(error)))
