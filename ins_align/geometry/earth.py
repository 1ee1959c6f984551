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
The Earth: WGS-84 ellipsoid, normal gravity, and the rotation of the local level (C_n0n).

Latitude and longitude are radians, altitude is metres above the ellipsoid. All functions except
`dead_reckon` and `enu_offset` take arrays and work over leading axes.
"""

import math

from ins_align.geometry.rotation import Array, cross
import numpy as np
from numpy.typing import ArrayLike

# WGS-84 defining and derived constants (NGA.STND.0036_1.0.0_WGS84, 2014).
SEMI_MAJOR_AXIS = 6378137.0            # m
FLATTENING = 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
EARTH_RATE = 7.292115e-5               # rad/s
GRAVITY_EQUATOR = 9.7803253359         # m/s^2
SOMIGLIANA_K = 0.00193185265241
# omega^2 a^2 b / GM, the ratio of centrifugal to gravitational acceleration at the equator.
GRAVITY_RATIO = 0.00344978650684

Place = tuple[float, float, float]     # latitude, longitude (radians), altitude (m)


def normal_gravity(latitude: ArrayLike, altitude: ArrayLike) -> Array:
    """
    Return the magnitude of normal gravity, m/s^2 (Somigliana, second order in altitude).

    Source: WGS 84 standard, equations 4-1 and 4-3. The direction is taken along -up; below 20 km
    the deflection with altitude is under 2e-5 rad at 45 degrees and is left out.
    """
    altitude = np.asarray(altitude, dtype=float)
    sin2 = np.sin(latitude) ** 2
    surface = (GRAVITY_EQUATOR * (1 + SOMIGLIANA_K * sin2)
               / np.sqrt(1 - ECCENTRICITY2 * sin2))
    ratio = altitude / SEMI_MAJOR_AXIS
    return surface * (1 - 2 * (1 + FLATTENING + GRAVITY_RATIO - 2 * FLATTENING * sin2) * ratio
                      + 3 * ratio ** 2)


def dead_reckon(place: Place, v_n: Array, dt: float) -> Place:
    """
    Return the place after `dt` seconds, of either sign, at a velocity (ENU, m/s).

    The Earth is taken as a sphere, which is good to 1 % of the distance.
    """
    latitude, longitude, altitude = place
    east, north, up = v_n.tolist()
    return (latitude + north * dt / SEMI_MAJOR_AXIS,
            longitude + east * dt / (SEMI_MAJOR_AXIS * max(math.cos(latitude), 1e-3)),
            altitude + up * dt)


def enu_offset(start: Place, end: Place) -> tuple[float, float, float]:
    """Return the way from start to end in metres east, north and up, on the same sphere."""
    east = math.remainder(end[1] - start[1], 2 * math.pi) * max(math.cos(start[0]), 1e-3)
    return SEMI_MAJOR_AXIS * east, SEMI_MAJOR_AXIS * (end[0] - start[0]), end[2] - start[2]


def matrix_en(latitude: ArrayLike, longitude: ArrayLike) -> Array:
    """Return ``C_en``, shape (..., 3, 3): its columns are east, north and up."""
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    sin_lon, cos_lon = np.sin(longitude), np.cos(longitude)
    matrix = np.zeros(np.broadcast_shapes(np.shape(sin_lat), np.shape(sin_lon)) + (3, 3))
    matrix[..., 0, 0] = -sin_lon
    matrix[..., 1, 0] = cos_lon
    matrix[..., 0, 1] = -sin_lat * cos_lon
    matrix[..., 1, 1] = -sin_lat * sin_lon
    matrix[..., 2, 1] = cos_lat
    matrix[..., 0, 2] = cos_lat * cos_lon
    matrix[..., 1, 2] = cos_lat * sin_lon
    matrix[..., 2, 2] = sin_lat
    return matrix


def matrix_earth_turned(time: ArrayLike) -> Array:
    """Return ``Rz(W t)``: from the Earth-fixed frame now to that of `time` seconds before."""
    angle = EARTH_RATE * np.asarray(time, dtype=float)
    matrix = np.zeros(angle.shape + (3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = np.cos(angle)
    matrix[..., 1, 0] = np.sin(angle)
    matrix[..., 0, 1] = -matrix[..., 1, 0]
    matrix[..., 2, 2] = 1.0
    return matrix


def gravity_n(latitude: ArrayLike, altitude: ArrayLike) -> Array:
    """Return normal gravity ``g_n`` in ENU, shape (..., 3), m/s^2."""
    magnitude = normal_gravity(latitude, altitude)
    vector = np.zeros(np.shape(magnitude) + (3,))
    vector[..., 2] = -magnitude
    return vector


def earth_rate_n(latitude: ArrayLike) -> Array:
    """Return the Earth rate ``omega_ie_n`` in ENU, shape (..., 3), rad/s."""
    vector = np.zeros(np.shape(latitude) + (3,))
    vector[..., 1] = EARTH_RATE * np.cos(latitude)
    vector[..., 2] = EARTH_RATE * np.sin(latitude)
    return vector


def position_n(latitude: ArrayLike, altitude: ArrayLike) -> Array:
    """Return the position from the Earth's centre in ENU axes, shape (..., 3), metres."""
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    prime_vertical = SEMI_MAJOR_AXIS / np.sqrt(1 - ECCENTRICITY2 * sin_lat ** 2)
    vector = np.zeros(np.broadcast_shapes(np.shape(latitude), np.shape(altitude)) + (3,))
    vector[..., 1] = -prime_vertical * ECCENTRICITY2 * sin_lat * cos_lat
    vector[..., 2] = (prime_vertical * (1 - ECCENTRICITY2 * sin_lat ** 2)
                      + np.asarray(altitude, dtype=float))
    return vector


def gravitation_n(latitude: ArrayLike, altitude: ArrayLike) -> Array:
    """Return gravitation, ``g_n + omega_ie x (omega_ie x r)``, in ENU, m/s^2."""
    rate = earth_rate_n(latitude)
    return gravity_n(latitude, altitude) + cross(rate, ground_velocity_n(latitude, altitude))


def ground_velocity_n(latitude: ArrayLike, altitude: ArrayLike) -> Array:
    """Return ``omega_ie x r``, the inertial velocity of a point at rest on the Earth, ENU, m/s."""
    return cross(earth_rate_n(latitude), position_n(latitude, altitude))


def matrix_n0n(origin: tuple[float, float], time: ArrayLike, latitude: ArrayLike,
               longitude: ArrayLike) -> Array:
    """
    Return ``C_n0n(t) = C_en(0)^T Rz(W t) C_en(t)``, shape (..., 3, 3), `time` s after t0.

    n0 is the local level frozen at t0, at `origin`; no integration is needed (docs, "Theory").
    """
    return matrix_en(*origin).T @ matrix_earth_turned(time) @ matrix_en(latitude, longitude)
