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
True motion of a simulated vehicle and what perfect sensors on it would measure.

The IMU's readings come from python-ins (PyPI), which derives them from a trajectory with its own
Earth model. The antenna is evaluated from the motion in closed form at the very instant of
measurement, which need not be that of an IMU sample.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
import math
from typing import NamedTuple

from ins_align.geometry.earth import ECCENTRICITY2, matrix_en, SEMI_MAJOR_AXIS
from ins_align.geometry.rotation import Array, cross, log_so3, matrix_from_rpy
from ins_align.gnss.messages import ENU_FROM_NED
from ins_align.simulation import scenarios
import numpy as np

FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
START_NS = 1_750_000_000_000_000_000  # stamp of t = 0

# Splines are inexact at their ends: so many samples more on both sides are thrown away. An error
# there falls by 0.27 per sample.
_PADDING = 32
_JITTER_SEED = 1
_RATE_STEP = 1e-3  # s


def displaced(lla: Array, offset: Array) -> Array:
    """Move positions (n, 3) in degrees and m by offsets (n, 3) in ENU of some metres."""
    meridian, normal = _radii(np.radians(lla[:, 0]))
    return lla + np.stack([
        np.degrees(offset[:, 1] / (meridian + lla[:, 2])),
        np.degrees(offset[:, 0] / (normal + lla[:, 2]) / np.cos(np.radians(lla[:, 0]))),
        offset[:, 2]], axis=-1)


def wrapped(lla: Array) -> Array:
    """Bring longitudes into [-180, 180)."""
    result = lla.copy()
    result[:, 1] = (result[:, 1] + 180.0) % 360.0 - 180.0
    return result


def _radii(latitude: Array) -> tuple[Array, Array]:
    """Radii of curvature of the ellipsoid: meridian and prime vertical."""
    square = 1 - ECCENTRICITY2 * np.sin(latitude) ** 2
    normal = SEMI_MAJOR_AXIS / np.sqrt(square)
    return normal * (1 - ECCENTRICITY2) / square, normal


class Trajectory(NamedTuple):
    """
    What does not depend on noise, mount and antenna; v is the vehicle, forward-left-up.

    N samples at the IMU's instants; velocities ENU, positions in degrees, degrees, metres.
    """

    motion: Callable[[Array], scenarios.Motion]
    stamps_ns: np.ndarray    # (N,)
    C_nv: Array              # (N, 3, 3)
    velocity: Array          # (N, 3)
    lla: Array               # (N, 3), longitude in [-180, 180)
    gyro: Array              # (N, 3)
    accel: Array             # (N, 3)
    lla_spline: Callable[[Array], Array]  # (n, 3), longitude continuous

    def antenna(self, time: Array, C_vb: Array, lever_arm: Array) -> tuple[Array, Array]:
        """Position (n, 3) in degrees and m and velocity (n, 3) in ENU of the antenna."""
        velocity, rpy = self.motion(time)
        lla = self.lla_spline(time)
        C_nb = matrix_from_rpy(rpy) @ C_vb
        # Five-point difference of the attitude about each instant.
        near, far = (log_so3(
            np.swapaxes(self._attitude(time - step), 1, 2) @ self._attitude(time + step))
            / (2 * step) for step in (_RATE_STEP, 2 * _RATE_STEP))
        omega_nb_b = (4 * near - far) / 3 @ C_vb
        latitude = np.radians(lla[:, 0])
        meridian, normal = _radii(latitude)
        turn = velocity[:, 0] / (normal + lla[:, 2])
        omega_en_n = np.stack([-velocity[:, 1] / (meridian + lla[:, 2]), turn,
                               turn * np.tan(latitude)], axis=-1)
        omega_eb_b = omega_nb_b + np.einsum('nji,nj->ni', C_nb, omega_en_n)
        lever_n = C_nb @ lever_arm
        velocity = velocity + np.einsum('nij,nj->ni', C_nb, cross(omega_eb_b, lever_arm))
        antenna = displaced(lla, lever_n)
        # East, north and up at the antenna are not those at the IMU.
        C_imu, C_antenna = (matrix_en(*np.radians(p[:, :2]).T) for p in (lla, antenna))
        velocity = np.einsum('nji,njk,nk->ni', C_antenna, C_imu, velocity)
        return antenna, velocity

    def _attitude(self, time: Array) -> Array:
        return matrix_from_rpy(self.motion(time).rpy)


@lru_cache(maxsize=4)
def trajectory_of(
        scenario: str, duration: float, imu_rate: float, imu_jitter: float, latitude_deg: float,
        longitude_deg: float, altitude: float, heading_deg: float, crab_deg: float,
        stand_still: float) -> Trajectory:
    """Make the trajectory of `simulate`'s arguments; the last few are kept, read-only."""
    from pyins.sim import generate_imu
    from pyins.transform import mat_from_rph
    from scipy.interpolate import CubicHermiteSpline

    motion = scenarios.motion_function(scenario, duration, math.radians(heading_deg),
                                       math.radians(crab_deg), stand_still)
    index = np.arange(-_PADDING, int(duration * imu_rate + 1e-6) + 1 + _PADDING, dtype=float)
    if imu_jitter > 0:
        jitter = np.random.default_rng(_JITTER_SEED)
        index += jitter.uniform(-imu_jitter, imu_jitter, len(index))
    stamps = np.rint(index / imu_rate * 1e9).astype(np.int64)
    time = stamps * 1e-9
    velocity, rpy = motion(time)
    roll, pitch, yaw = np.degrees(rpy).T
    before = velocity[:_PADDING + 1].mean(axis=0, keepdims=True) * time[0]
    start = displaced(np.array([[latitude_deg, longitude_deg, altitude]]), before)
    truth, imu = generate_imu(time, start[0], np.stack([roll, -pitch, 90 - yaw], axis=-1),
                              velocity @ ENU_FROM_NED, 'rate')
    lla = truth[['lat', 'lon', 'alt']].to_numpy()
    latitude = np.radians(lla[:, 0])
    meridian, normal = _radii(latitude)
    slope = np.stack([np.degrees(velocity[:, 1] / (meridian + lla[:, 2])),
                      np.degrees(velocity[:, 0] / (normal + lla[:, 2]) / np.cos(latitude)),
                      velocity[:, 2]], axis=-1)
    keep = slice(_PADDING, -_PADDING)
    C_nv = ENU_FROM_NED @ mat_from_rph(truth[['roll', 'pitch', 'heading']].to_numpy()[keep]) \
        @ FLU_FROM_FRD
    arrays = (START_NS + stamps[keep], C_nv,
              truth[['VN', 'VE', 'VD']].to_numpy()[keep] @ ENU_FROM_NED, wrapped(lla[keep]),
              imu[['gyro_x', 'gyro_y', 'gyro_z']].to_numpy()[keep] @ FLU_FROM_FRD,
              imu[['accel_x', 'accel_y', 'accel_z']].to_numpy()[keep] @ FLU_FROM_FRD)
    for array in arrays:
        array.setflags(write=False)  # shared by every simulation that has this trajectory
    return Trajectory(motion, *arrays, CubicHermiteSpline(time, lla, slope))
