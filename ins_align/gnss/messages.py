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
ROS messages as numbers, checks of whether they can be used, and the epochs that a method takes.

Objects with the fields of the ROS message are as good as messages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
import re
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.geometry.rotation import Array
import numpy as np
from numpy.typing import ArrayLike


def enu_from_ned(vectors: Array) -> Array:
    """Return vectors, (..., 3), in ENU, without matrix products, so that nan stays in its axis."""
    return vectors[..., [1, 0, 2]] * [1.0, 1.0, -1.0]


ENU_FROM_NED = enu_from_ned(np.eye(3))

# Names of body frames, from REP-105 and drivers, as a whole word of the frame_id.
_BODY_FRAME = re.compile(r'(?:^|[_\-/.])(?:base|body|chassis|footprint|imu|ins|vehicle)\d*'
                         r'(?:$|[_\-/.])', re.IGNORECASE)

# Variances (m^2 or m^2/s^2) below `SMALLEST_VARIANCE` are placeholders. Others are limited, so
# that matrices can be inverted.
SMALLEST_VARIANCE = 1e-12
MIN_VARIANCE, MAX_VARIANCE = 1e-8, 1e6
MIN_EIGENVALUE = 1e-9  # of a correlation matrix; less may be rounding of an impossible one
# No receiver measures more than this; such values would overflow the integrals (m/s, m).
MAX_SPEED, MAX_ALTITUDE = 2000.0, 1e6
NO_FIX = -1  # status
UNKNOWN_ALTITUDE_STD = 1e4  # m, of an altitude that a fix does not have


class MessageError(ValueError):
    """A message that cannot be used; the text says why."""


class Fix(NamedTuple):
    """A GNSS position as it was sent, not checked."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance: np.ndarray | None  # (3, 3), ENU, m^2; None: not known
    status: int  # NavSatStatus: -1 no fix, 0 and above a fix, -2 unknown
    vertical: bool = True  # whether the altitude is measured


class Velocity(NamedTuple):
    """The antenna's velocity as it was sent, not checked."""

    stamp_ns: int
    velocity: np.ndarray  # (3,), ENU, m/s
    covariance: np.ndarray | None  # (3, 3), ENU, m^2/s^2; None: not known
    vertical: bool = True  # whether the vertical velocity is measured


@dataclass(frozen=True)
class AntennaEpoch:
    """Position and velocity of the antenna at a GNSS epoch, as a method takes them."""

    stamp_ns: int
    latitude: float  # radians; dead reckoned when it is not measured
    longitude: float
    altitude: float  # m
    v_n: Array | None  # (3,), ENU, m/s; None: not measured
    velocity_covariance: Array  # (3, 3), ENU, m^2/s^2
    position_measured: bool  # whether the position is a measurement to align with
    position_covariance: Array  # (3, 3), ENU, m^2
    gravity_drift: float = 0.0  # noise of gravity at an unknown place, m/s/sqrt(s)
    fault: str = ''  # of the velocities up to here, in words; '' when none is known
    dry: bool = False  # whether there is no GNSS message: an epoch that divides an outage
    stated: tuple[bool, bool] = (True, True)  # whether noise of velocity and position is stated


def velocities_of(epochs: Sequence[AntennaEpoch]) -> Array:
    """Return the velocities of K epochs, shape (K, 3), zero where none is measured."""
    return np.array([np.zeros(3) if epoch.v_n is None else epoch.v_n for epoch in epochs])


def usable(message: Fix | Velocity) -> tuple[Fix | Velocity, str]:
    """
    Return a message and why it cannot be used: ``no_fix``, ``nan`` or, if it can, ''.

    If only the vertical is nan, as in a 2D fix, it becomes 0 and counts as not measured. The
    covariance is not checked.
    """
    if isinstance(message, Velocity):
        east, north, up = message.velocity.tolist()
        if math.isnan(up):
            up = 0.0
            message = message._replace(velocity=np.array([east, north, up]), vertical=False)
        good = all(abs(value) < MAX_SPEED for value in (east, north, up))
        return message, '' if good else 'nan'
    if math.isnan(message.altitude_m):
        message = message._replace(altitude_m=0.0, vertical=False)
    _, latitude, longitude, altitude, *_ = message
    if message.status == NO_FIX or latitude == longitude == 0.0:
        return message, 'no_fix'
    # nan and infinity are not within the bounds either.
    good = abs(latitude) <= 90.0 and abs(longitude) <= 360.0 and abs(altitude) < MAX_ALTITUDE
    return message, '' if good else 'nan'


def sound_covariance(sent: Array | None, default_std: Sequence[float] = ()) -> Array | None:
    """
    Return a covariance, (3, 3), that is symmetric and positive definite; None: it is unknown.

    A variance that is tiny, negative (-1 marks "unknown") or not finite is unknown. The default
    sigma replaces it unless all three are unknown; without default sigmas a single unknown one
    makes all unknown. Impossible correlations are dropped.
    """
    if sent is None:
        return None
    (ee, en, eu), (ne, nn, nu), (ue, un, uu) = sent.tolist()
    variances, covariances = [ee, nn, uu], [en, eu, ne, nu, ue, un]
    known = [SMALLEST_VARIANCE <= variance < math.inf for variance in variances]
    if not any(known) or not (default_std or all(known)):
        return None
    used = [min(max(variance, MIN_VARIANCE), MAX_VARIANCE) if is_known else std ** 2
            for variance, is_known, std in zip(variances, known, default_std or variances)]
    # With impossible correlations the variance in some direction would be negative.
    if used == variances and any(covariances) and all(
            abs(covariance) <= MAX_VARIANCE for covariance in covariances):
        symmetric: Array = 0.5 * sent + 0.5 * sent.T
        scale = 1.0 / np.sqrt(used)
        if np.linalg.eigvalsh(symmetric * scale * scale[:, None])[0] > MIN_EIGENVALUE:
            return symmetric
    return np.diag(used)


def numbers_of(message: Fix | Velocity) -> list[float]:
    """Return the position (degrees, degrees, m) or the velocity (ENU, m/s) of a message."""
    return message.velocity.tolist() if isinstance(message, Velocity) else list(message[1:4])


def stamp_from_msg(msg: Any) -> int:
    """Return the header's stamp in nanoseconds."""
    stamp = msg.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def imu_from_msg(msg: Any) -> tuple[int, np.ndarray, np.ndarray]:
    """Return stamp, ns, angular rate, rad/s, and specific force, m/s^2, of sensor_msgs/Imu."""
    rate, force = (np.array([vector.x, vector.y, vector.z])
                   for vector in (msg.angular_velocity, msg.linear_acceleration))
    return stamp_from_msg(msg), rate, force


def fixes_from_msgs(msgs: Sequence[Any]) -> list[Fix]:
    """Convert sensor_msgs/NavSatFix; a covariance of unknown type or without meaning is None."""
    return fixes([stamp_from_msg(msg) for msg in msgs],
                 [[msg.latitude, msg.longitude, msg.altitude] for msg in msgs],
                 np.array([msg.position_covariance for msg in msgs], float).reshape(-1, 3, 3),
                 [msg.position_covariance_type for msg in msgs],
                 [msg.status.status for msg in msgs])


def fixes(stamps_ns: ArrayLike, places: ArrayLike, covariances: np.ndarray,
          covariance_types: ArrayLike, status: ArrayLike) -> list[Fix]:
    """
    Return fixes from the columns of N messages, with types and status as in sensor_msgs/NavSatFix.

    Places, (N, 3), are latitude and longitude, degrees, and altitude, m; covariances, (N, 3, 3),
    m^2, are as sent.
    """
    columns = (stamps_ns, *np.asarray(places, float).T, covariance_types, status)
    return [Fix(stamp, latitude, longitude, altitude,
                sound_covariance(covariance) if kind != 0 else None, mode)
            for (stamp, latitude, longitude, altitude, kind, mode), covariance
            in zip(zip(*(np.asarray(column).tolist() for column in columns)), covariances)]


def velocities_from_msgs(msgs: Sequence[Any], config: Config) -> list[Velocity]:
    """Convert messages of ``config.velocity_type``, all in one frame, as `velocities` does."""
    covariances = None
    if config.velocity_type == 'Vector3Stamped':
        linear = [msg.vector for msg in msgs]
    elif config.velocity_type == 'TwistStamped':
        linear = [msg.twist.linear for msg in msgs]
    else:
        linear = [msg.twist.twist.linear for msg in msgs]
        covariances = np.array([msg.twist.covariance for msg in msgs], float).reshape(-1, 6, 6)
    return velocities([stamp_from_msg(msg) for msg in msgs],
                      frame_of_velocity(msgs[0], config.velocity_type),
                      [[each.x, each.y, each.z] for each in linear], covariances, config)


def frame_of_velocity(msg: Any, velocity_type: str) -> str:
    """Return the frame_id of the velocity in a message."""
    return str(msg.child_frame_id if velocity_type == 'Odometry' else msg.header.frame_id)


def velocities(stamps_ns: ArrayLike, frame: str, linear: ArrayLike,
               covariances: np.ndarray | None, config: Config) -> list[Velocity]:
    """
    Return velocities from the columns of N messages with the same frame_id, `frame`.

    `linear`, (N, 3), m/s, is ENU unless ``config.velocity_frame`` is ned. Of covariances, which
    may be those of twists, (N, 6, 6), the first three rows and columns are used, as in
    `sound_covariance`. Raises MessageError if `frame` is a body frame and
    ``config.velocity_frame`` is auto.
    """
    if config.velocity_frame == 'auto' and _BODY_FRAME.search(frame):
        raise MessageError(
            f'the velocity is given in the body frame {frame[:80]!r}: an alignment needs it in a '
            'world frame, east-north-up or north-east-down; if it is in one, whatever its '
            'frame_id says, set velocity_frame to enu or ned')
    velocity = np.array(linear, dtype=float)
    sent: Array = (np.zeros((len(velocity), 3, 3)) if covariances is None
                   else covariances[:, :3, :3])
    if config.velocity_frame == 'ned':
        velocity = enu_from_ned(velocity)
        sent = enu_from_ned(enu_from_ned(sent).swapaxes(1, 2))
    stds = config.velocity_std, config.velocity_std, config.velocity_std_vertical
    return [Velocity(stamp_ns, vector, sound_covariance(covariance, stds)) for
            stamp_ns, vector, covariance in zip(np.asarray(stamps_ns).tolist(), velocity, sent)]
