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

from collections.abc import Iterable, Sequence
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


class BodyFrameError(MessageError):
    """A velocity in a body frame."""


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
    position_measured: bool  # whether the position is a measurement to align with
    # Of velocity and position, (3, 3), ENU, m^2/s^2 and m^2, as they are used
    covariances: tuple[Array, Array]
    gravity_drift: float = 0.0  # noise of gravity at an unknown place, m/s/sqrt(s)
    fault: str = ''  # of the velocities up to here, in words; '' when none is known
    dry: bool = False  # whether there is no GNSS message: an epoch that divides an outage
    stated: tuple[bool, bool] = (True, True)  # whether noise of velocity and position is stated

    @property
    def measured(self) -> tuple[bool, bool]:
        """Whether velocity and position are measured."""
        return self.v_n is not None, self.position_measured


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


def fix_from_msg(msg: Any) -> Fix:
    """Convert sensor_msgs/NavSatFix."""
    return fix_from_numbers(
        stamp_from_msg(msg), [msg.latitude, msg.longitude, msg.altitude], msg.position_covariance,
        msg.position_covariance_type, msg.status.status)


def fix_from_numbers(stamp_ns: int, place: Iterable[float], covariance: ArrayLike | None,
                     covariance_type: int = 3, status: int = 0) -> Fix:
    """
    Return a fix; a covariance of type 0 or without meaning is not known.

    The place is latitude and longitude, degrees, and altitude, m. The covariance, nine numbers,
    m^2, is as sent, None: it is not known; its type and the status are as in
    sensor_msgs/NavSatFix.
    """
    sent = (None if covariance is None or covariance_type == 0
            else np.array(covariance, dtype=float).reshape(3, 3))
    latitude, longitude, altitude = map(float, place)
    return Fix(int(stamp_ns), latitude, longitude, altitude, sound_covariance(sent), int(status))


def velocity_from_msg(msg: Any, config: Config) -> Velocity:
    """Convert a message of one of the types of ``velocity_type``; checks its frame_id."""
    covariance = None
    if hasattr(msg, 'vector'):  # Vector3Stamped
        linear = msg.vector
    elif hasattr(msg.twist, 'linear'):  # TwistStamped
        linear = msg.twist.linear
    else:
        linear = msg.twist.twist.linear
        covariance = np.reshape(msg.twist.covariance, (6, 6))[:3, :3]
    refuse_body_frame(str(getattr(msg, 'child_frame_id', msg.header.frame_id)), config)
    return velocity_from_numbers(config, stamp_from_msg(msg), [linear.x, linear.y, linear.z],
                                 covariance)


def refuse_body_frame(frame: str, config: Config) -> None:
    """Raise BodyFrameError if a frame_id is that of a body and ``velocity_frame`` is auto."""
    if config.velocity_frame == 'auto' and _BODY_FRAME.search(frame):
        raise BodyFrameError(
            f'the velocity is given in the body frame {frame[:80]!r}: an alignment needs it in a '
            'world frame, east-north-up or north-east-down; if it is in one, whatever its '
            'frame_id says, set velocity_frame to enu or ned')


def velocity_from_numbers(config: Config, stamp_ns: int, linear: ArrayLike,
                          covariance: ArrayLike | None, frame: str = '') -> Velocity:
    """
    Return a velocity; `linear`, (3,), m/s, is ENU unless ``config.velocity_frame`` is ned.

    The covariance, nine numbers, m^2/s^2, is as sent, None: it is not known. `frame`, enu or ned,
    takes the place of ``config.velocity_frame``.
    """
    velocity = np.array(linear, dtype=float)
    sent = None if covariance is None else np.array(covariance, dtype=float).reshape(3, 3)
    if (frame or config.velocity_frame) == 'ned':
        velocity = enu_from_ned(velocity)
        sent = None if sent is None else enu_from_ned(enu_from_ned(sent).T)
    stds = config.velocity_std, config.velocity_std, config.velocity_std_vertical
    return Velocity(int(stamp_ns), velocity, sound_covariance(sent, stds))
