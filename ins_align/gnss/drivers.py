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
"""Messages of receivers and autopilots that are not sensor_msgs, read according to a table."""

from __future__ import annotations

import calendar
from collections.abc import Callable, Mapping, Sequence
import math
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.gnss.messages import (
    Fix, fix_from_msg, fix_from_numbers, MessageError, stamp_from_msg, Velocity,
    velocity_from_msg, velocity_from_numbers)
import numpy as np

FRD_SIGNS = np.array([1.0, -1.0, -1.0])
UTC_KNOWN = 3  # bits of date and time in the field valid of UBX-NAV-PVT


class NoTimeError(MessageError):
    """A message of a receiver that does not know the time yet."""


def _utc_ns(msg: Any) -> int:
    """Return the time of a UBX-NAV-PVT message, ns."""
    if msg.valid & UTC_KNOWN != UTC_KNOWN:
        raise NoTimeError('the receiver does not know date and time yet')
    seconds = calendar.timegm((msg.year, msg.month, msg.day, msg.hour, msg.min, msg.sec))
    return seconds * 1_000_000_000 + int(msg.nano)


def _microseconds_ns(msg: Any) -> int:
    return int(msg.timestamp) * 1000


class Receiver(NamedTuple):
    """
    Where position and velocity are in a message: fields, with factors to the units stated here.

    Standard deviations are horizontal, per axis, then vertical; a single one is for both, and
    without any the configured ones are used.
    """

    stamp: Callable[[Any], int]  # ns
    has_fix: Callable[[Any], bool]
    position: Mapping[str, float]  # latitude and longitude, degrees; altitude, m
    position_std: Mapping[str, float]  # m; or a covariance, m^2, with its type as in NavSatFix
    velocity: Mapping[str, float]  # m/s
    frame: str  # of the velocity: enu, ned, or track (speed, course from north in degrees, climb)
    velocity_std: Mapping[str, float]  # m/s
    has_velocity: Callable[[Any], bool] = lambda msg: True
    unknown: tuple[float, ...] = ()  # values that mean "unknown"


RECEIVERS = {
    # github.com/swri-robotics/gps_umd: errors are stated as 95 percent bounds.
    'gps_msgs/msg/GPSFix': Receiver(
        stamp_from_msg, lambda msg: msg.status.status >= 0,
        {'latitude': 1.0, 'longitude': 1.0, 'altitude': 1.0}, {'position_covariance': 1.0},
        {'speed': 1.0, 'track': 1.0, 'climb': 1.0}, 'track', {'err_speed': 0.5, 'err_climb': 0.5}),
    # github.com/KumarRobotics/ublox: fixes of 2D, 3D and 3D with dead reckoning that are valid.
    'ublox_msgs/msg/NavPVT': Receiver(
        _utc_ns, lambda msg: msg.fix_type in (2, 3, 4) and bool(msg.flags & 1),
        {'lat': 1e-7, 'lon': 1e-7, 'height': 1e-3}, {'h_acc': 1e-3, 'v_acc': 1e-3},
        {'vel_n': 1e-3, 'vel_e': 1e-3, 'vel_d': 1e-3}, 'ned', {'s_acc': 1e-3}),
    # SBF reference guide, PVTGeodetic: accuracies are twice the distance RMS, and 2 sigma.
    'septentrio_gnss_driver/msg/PVTGeodetic': Receiver(
        stamp_from_msg, lambda msg: msg.error == 0 and msg.mode & 15 != 0,
        {'latitude': math.degrees(1.0), 'longitude': math.degrees(1.0), 'height': 1.0},
        {'h_accuracy': 0.01 / math.sqrt(8.0), 'v_accuracy': 0.01 / 2.0},
        {'ve': 1.0, 'vn': 1.0, 'vu': 1.0}, 'enu', {}, unknown=(-2e10, 65535)),
    # github.com/PX4/px4_msgs
    'px4_msgs/msg/SensorGps': Receiver(
        _microseconds_ns, lambda msg: msg.fix_type >= 2,
        {'latitude_deg': 1.0, 'longitude_deg': 1.0, 'altitude_ellipsoid_m': 1.0},
        {'eph': 1.0, 'epv': 1.0}, {'vel_n_m_s': 1.0, 'vel_e_m_s': 1.0, 'vel_d_m_s': 1.0}, 'ned',
        {'s_variance_m_s': 1.0}, has_velocity=lambda msg: bool(msg.vel_ned_valid)),
}
INERTIAL_UNITS = ('px4_msgs/msg/SensorCombined',)
DRIVER_TYPES = (*RECEIVERS, *INERTIAL_UNITS)
VELOCITY_TYPES = ('geometry_msgs/msg/TwistWithCovarianceStamped', 'geometry_msgs/msg/TwistStamped',
                  'nav_msgs/msg/Odometry', 'geometry_msgs/msg/Vector3Stamped')
# The types which the node can read, by the parameters fix_type and velocity_type.
LIVE_TYPES = {name.rsplit('/', 1)[-1]: name for name in (
    'sensor_msgs/msg/NavSatFix', 'gps_msgs/msg/GPSFix', 'ublox_msgs/msg/NavPVT', *VELOCITY_TYPES)}


def gnss_from_msg(msg: Any, msgtype: str, config: Config) -> Sequence[Fix | Velocity]:
    """Convert a message with a position, a velocity or both; a MessageError says why it fails."""
    if msgtype in RECEIVERS:
        return receiver_from_msg(msg, msgtype, config)
    return [velocity_from_msg(msg, config) if msgtype in VELOCITY_TYPES else fix_from_msg(msg)]


def receiver_from_msg(msg: Any, msgtype: str, config: Config) -> tuple[Fix, Velocity]:
    """
    Convert a message of one of `RECEIVERS`; sigmas that are not stated are those of `config`.

    Raises NoTimeError if the receiver does not know the time yet, and MessageError if a field is
    missing or in another unit.
    """
    row = RECEIVERS[msgtype]
    try:
        stamp_ns, has_fix = row.stamp(msg), row.has_fix(msg)
        position = _numbers(msg, row, row.position)
        velocity_numbers = _numbers(msg, row, row.velocity)
        position_std, velocity_std = (_numbers(msg, row, fields)
                                      for fields in (row.position_std, row.velocity_std))
        has_velocity = row.has_velocity(msg)
    except AttributeError as error:
        raise _no_field(msgtype, error) from None
    for field, degrees, limit in zip(row.position, position, (90.0, 360.0)):
        if has_fix and abs(degrees) > limit:
            raise MessageError(
                f'{field} of {type_in_words(msgtype)} comes to {degrees:.6g} deg: it must be in '
                f'units of {row.position[field]:.6g} deg')
    fix = fix_from_numbers(stamp_ns, position, _covariance(position_std),
                           getattr(msg, 'position_covariance_type', 2), 0 if has_fix else -1)
    frame = row.frame
    if frame == 'track':
        speed, course, climb = velocity_numbers
        east, north = math.sin(math.radians(course)), math.cos(math.radians(course))
        velocity_numbers, frame = [speed * east, speed * north, climb], 'enu'
    return fix, velocity_from_numbers(
        config, stamp_ns, velocity_numbers if has_velocity else [math.nan] * 3,
        _covariance(velocity_std) if velocity_std else None, frame)


def imu_from_driver(msg: Any, msgtype: str) -> tuple[int, np.ndarray, np.ndarray]:
    """Return ns, rad/s and m/s^2 of px4_msgs/SensorCombined; MessageError: a field is missing."""
    try:
        return (_microseconds_ns(msg), FRD_SIGNS * np.asarray(msg.gyro_rad, float),
                FRD_SIGNS * np.asarray(msg.accelerometer_m_s2, float))
    except AttributeError as error:
        raise _no_field(msgtype, error) from None


def type_in_words(msgtype: str) -> str:
    """Return a message type as users know it, such as sensor_msgs/Imu."""
    return msgtype.replace('/msg/', '/')


def _no_field(msgtype: str, error: AttributeError) -> MessageError:
    return MessageError(f'{type_in_words(msgtype)} has no field {error.name} here: its '
                        'definition is of another version than the ones that are known')


def _numbers(msg: Any, row: Receiver, fields: Mapping[str, float]) -> list[Any]:
    """Return the fields, numbers or arrays, in the units of `Receiver`; nan where unknown."""
    values = [getattr(msg, field) for field in fields]
    return [math.nan if np.ndim(value) == 0 and value in row.unknown else np.multiply(value, unit)
            for value, unit in zip(values, fields.values())]


def _covariance(std: list[Any]) -> np.ndarray:
    """
    Return a covariance, nine numbers, from sigmas (horizontal, vertical) or as sent.

    It has the sign of the sigmas: negative ones are not known.
    """
    if np.ndim(std[0]):
        return np.asarray(std[0])
    sigmas = np.diag([std[0], std[0], std[-1]])
    return sigmas * np.abs(sigmas)
