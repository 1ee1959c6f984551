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
"""ROS messages to arrays: works on anything with the fields of the ROS message."""

from __future__ import annotations

import math
import re
from typing import Any, NamedTuple

from ins_align.config import Config
import numpy as np

ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# The same without products, in which one component that is not finite would spoil the others.
NED_ORDER, NED_SIGNS = [1, 0, 2], np.array([1.0, 1.0, -1.0])

# Names of the customary body frames (REP-105 and what drivers call the rest), as a whole word of
# the frame_id. A GNSS driver puts "gps", "gnss", "antenna" or a world frame instead.
_BODY_FRAME = re.compile(r'(?:^|[_\-/.])(?:base|body|chassis|footprint|imu|ins|vehicle)\d*'
                         r'(?:$|[_\-/.])', re.IGNORECASE)

# Variances (m^2 or m^2/s^2): below a micrometre a receiver means nothing. What it does mean is
# brought between a tenth of a millimetre and a kilometre, or matrices of it have no inverse.
SMALLEST_VARIANCE = 1e-12
MIN_VARIANCE, MAX_VARIANCE = 1e-8, 1e6


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


class Velocity(NamedTuple):
    """The antenna's velocity as it was sent, not checked."""

    stamp_ns: int
    velocity: np.ndarray  # (3,), ENU, m/s
    covariance: np.ndarray | None  # (3, 3), ENU, m^2/s^2; None: not known


def stamp_from_msg(msg: Any) -> int:
    """Return the header's stamp in nanoseconds."""
    stamp = msg.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def imu_from_msg(msg: Any) -> tuple[int, np.ndarray, np.ndarray]:
    """
    Convert sensor_msgs/Imu; its orientation is not looked at.

    Returns
    -------
    stamp_ns : int
    gyro : ndarray, shape (3,)
        Angular rate, rad/s.
    accel : ndarray, shape (3,)
        Specific force, m/s^2.

    """
    rate, force = msg.angular_velocity, msg.linear_acceleration
    return (stamp_from_msg(msg), np.array([rate.x, rate.y, rate.z]),
            np.array([force.x, force.y, force.z]))


def fix_from_msg(msg: Any) -> Fix:
    """Convert sensor_msgs/NavSatFix; a covariance of unknown type or without sense is None."""
    covariance = None
    if msg.position_covariance_type != 0:
        covariance = np.array(msg.position_covariance, dtype=float).reshape(3, 3)
        covariance = _usable_covariance(covariance, None)
    return Fix(stamp_from_msg(msg), float(msg.latitude), float(msg.longitude),
               float(msg.altitude), covariance, int(msg.status.status))


def velocity_from_msg(msg: Any, config: Config) -> Velocity:
    """
    Convert the velocity message that ``config.velocity_type`` names.

    A variance that is 0 (or less than that of any sensor), negative (-1 marks "unknown") or not
    finite takes the configured value; where all three are like that, the covariance is None.

    Raises
    ------
    MessageError
        If the message says that the velocity is given in a body frame.

    """
    covariance = None
    frame = msg.header.frame_id
    if config.velocity_type == 'TwistStamped':
        linear = msg.twist.linear
    else:
        linear = msg.twist.twist.linear
        covariance = np.array(msg.twist.covariance, dtype=float).reshape(6, 6)[:3, :3]
        if config.velocity_type == 'Odometry':
            frame = msg.child_frame_id  # the frame of nav_msgs/Odometry's twist
    if _BODY_FRAME.search(frame):
        raise MessageError(
            f'the velocity is given in the body frame {frame[:80]!r}: an alignment needs it in a '
            'world frame, east-north-up or north-east-down')
    velocity = np.array([linear.x, linear.y, linear.z], dtype=float)
    if config.velocity_frame == 'ned':
        velocity = velocity[NED_ORDER] * NED_SIGNS
    if covariance is not None:
        if config.velocity_frame == 'ned':
            covariance = covariance[NED_ORDER][:, NED_ORDER] * np.outer(NED_SIGNS, NED_SIGNS)
        covariance = _usable_covariance(
            covariance, (config.velocity_std, config.velocity_std, config.velocity_std_vertical))
    return Velocity(stamp_from_msg(msg), velocity, covariance)


def _usable_covariance(covariance: np.ndarray,
                       default_std: tuple[float, float, float] | None) -> np.ndarray | None:
    """
    Return a symmetric positive definite (3, 3) covariance or None if nothing is known.

    Parameters
    ----------
    covariance : ndarray, shape (3, 3)
        As sent, with whatever drivers put in for "unknown".
    default_std : three floats or None
        Stands in for single unknown variances; None: one unknown variance makes all unknown.

    """
    variances = covariance.diagonal().tolist()
    known = [SMALLEST_VARIANCE <= variance < math.inf for variance in variances]
    if not any(known) or (default_std is None and not all(known)):
        return None
    if default_std is not None and not all(known):
        return np.diag([_bounded(variance) if given else std ** 2 for variance, given, std
                        in zip(variances, known, default_std)])
    bounded = list(map(_bounded, variances))
    diagonal = np.diag(bounded)
    entries = covariance.ravel().tolist()
    if bounded != variances or not any(entries[1:4] + entries[5:8]):
        return diagonal
    symmetric = 0.5 * covariance + 0.5 * covariance.T
    # Correlations without sense must not turn into a negative variance in some direction.
    if np.isfinite(symmetric).all():
        scale = 1.0 / np.sqrt(variances)
        if np.linalg.eigvalsh(symmetric * scale * scale[:, None])[0] > 1e-9:
            return symmetric
    return diagonal


def _bounded(variance: float) -> float:
    return min(max(variance, MIN_VARIANCE), MAX_VARIANCE)
