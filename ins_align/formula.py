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
The note: velocity and position integration formulas with lever arm, and attitude from them.

Y. Wu, "Further results on 'Velocity/position integration formula (I): application to in-flight
coarse alignment'", and the free start, the position form (Remark 2.3) and the form in a
non-rotating frame that this package adds (docs, "Theory").
"""

from dataclasses import dataclass, replace

from ins_align.earth import (earth_rate_n, gravitation_n, gravity_n, ground_velocity_n,
                             LocalLevel, position_n)
from ins_align.preintegration import Intervals
from ins_align.rotation import (Array, cross, matrix_from_quaternion, orthonormalized,
                                running_sum, skew)
import numpy as np


class BodyIntegrals:
    """
    The body side of the formulas, accumulated interval by interval from t0.

    Attributes
    ----------
    time : float
        Seconds since t0.
    C_b0b : ndarray, shape (3, 3)
    omega_ib_b : ndarray, shape (3,)
        Angular rate now; `omega_ib_b0` at t0.
    int_f, int_int_f : ndarray, shape (3,)
        Single and double integral of ``C_b0b f_b``.

    """

    def __init__(self, lever_b: Array, omega_ib_b0: Array) -> None:
        """Start at t0."""
        self.lever_b = np.asarray(lever_b, dtype=float)
        self.omega_ib_b0 = self.omega_ib_b = np.asarray(omega_ib_b0, dtype=float)
        self.time = 0.0
        self.C_b0b = np.eye(3)
        self.int_f = np.zeros(3)
        self.int_int_f = np.zeros(3)

    def advance(self, interval: Intervals, k: int) -> None:
        """Append interval `k` of `interval`."""
        duration = interval.duration[k]
        self.int_int_f = (self.int_int_f + duration * self.int_f
                          + self.C_b0b @ interval.p[k])
        self.int_f = self.int_f + self.C_b0b @ interval.v[k]
        self.C_b0b = orthonormalized(self.C_b0b @ interval.R[k])
        self.omega_ib_b = interval.omega[k]
        self.time += duration

    @property
    def a_v(self) -> Array:
        """``int C_b0b f + C_b0b (omega_ib x lever)``: the free-start body velocity."""
        return self.int_f + self.C_b0b @ cross(self.omega_ib_b, self.lever_b)

    @property
    def a_p(self) -> Array:
        """``int int C_b0b f + C_b0b lever``: the free-start body position."""
        return self.int_int_f + self.C_b0b @ self.lever_b

    @property
    def alpha_v(self) -> Array:
        """Right side of the note's (9), short form."""
        return self.a_v - cross(self.omega_ib_b0, self.lever_b)

    @property
    def alpha_p(self) -> Array:
        """Right side of the position form, Remark 2.3."""
        return (self.a_p - self.lever_b
                - self.time * cross(self.omega_ib_b0, self.lever_b))


class NavigationIntegrals:
    """
    The navigation side of the note's formulas, from GNSS velocity, taken linear between epochs.

    The integrals carry the note's terms: `int_omega_v` is ``int C_n0n (omega_ie x v_n)``,
    `int_g` is ``int C_n0n g_n``, `int_v` is ``int C_n0n v_n``; `int_int_...` one more integral.
    C_n0n is known in closed form at both ends of an interval, so that the trapezoidal rule on the
    n0 vectors replaces the first-order expansions in ``omega_in T``.

    Parameters
    ----------
    latitude, longitude, altitude : float
        Of the antenna at t0, radians and metres.
    v_n : array_like, shape (3,)
        Antenna velocity at t0, ENU, m/s.

    """

    def __init__(self, latitude: float, longitude: float, altitude: float, v_n: Array) -> None:
        """Start at t0."""
        self._n0 = LocalLevel(latitude, longitude)
        self.time = 0.0
        self.C_n0n = np.eye(3)
        self.v_n0 = self.v_n = np.asarray(v_n, dtype=float)
        self._integrands = self._vectors(latitude, altitude)
        self._before: tuple[float, Array] | None = None
        self.int_omega_v, self.int_int_omega_v = np.zeros(3), np.zeros(3)
        self.int_g, self.int_int_g = np.zeros(3), np.zeros(3)
        self.int_v = np.zeros(3)

    def _vectors(self, latitude: float, altitude: float) -> tuple[Array, Array, Array]:
        return (self.C_n0n @ cross(earth_rate_n(latitude), self.v_n),
                self.C_n0n @ gravity_n(latitude, altitude),
                self.C_n0n @ self.v_n)

    def advance(self, time: float, latitude: float, longitude: float, altitude: float,
                v_n: Array) -> None:
        """Append the GNSS epoch `time` seconds after t0."""
        h = time - self.time
        self.time, self.v_n = time, np.asarray(v_n, dtype=float)
        self.C_n0n = self._n0.matrix(time, latitude, longitude)
        omega_v0, g0, v0 = self._integrands
        self._integrands = omega_v1, g1, v1 = self._vectors(latitude, altitude)
        self.int_int_omega_v = (self.int_int_omega_v + h * self.int_omega_v
                                + h * h / 6 * (2 * omega_v0 + omega_v1))
        self.int_omega_v = self.int_omega_v + h / 2 * (omega_v0 + omega_v1)
        self.int_int_g = self.int_int_g + h * self.int_g + h * h / 6 * (2 * g0 + g1)
        self.int_g = self.int_g + h / 2 * (g0 + g1)
        self.int_v = self.int_v + self._area(h, v0, v1)
        self._before = (h, v0)

    def _area(self, h: float, v0: Array, v1: Array) -> Array:
        """Integral of the last interval under the parabola through the last three epochs."""
        if self._before is None or not 0.5 <= h / self._before[0] <= 2.0:
            return h / 2 * (v0 + v1)
        g, v = self._before
        return h / 6 * ((3 * g + 2 * h) / (g + h) * v1 + (3 * g + h) / g * v0
                        - h * h / (g * (g + h)) * v)

    @property
    def s_v(self) -> Array:
        """Free-start left side: ``C_n0n v_n + int C_n0n (omega_ie x v_n) - int C_n0n g_n``."""
        return self.C_n0n @ self.v_n + self.int_omega_v - self.int_g

    @property
    def s_p(self) -> Array:
        """Free-start position: one more integral, from velocity."""
        return self.int_v + self.int_int_omega_v - self.int_int_g

    @property
    def beta_v(self) -> Array:
        """Left side of the note's (9)."""
        return self.s_v - self.v_n0

    @property
    def beta_p(self) -> Array:
        """Left side of the position form, Remark 2.3."""
        return self.s_p - self.time * self.v_n0


@dataclass(frozen=True)
class InertialTrack:
    """
    The navigation side in the non-rotating frame n0, from positions and velocities as they come.

    ``s_p = C_n0e Rz(W t) r_e(t) - int int gravitation`` and its derivative ``s_v`` differ from
    the integrated forms of `NavigationIntegrals` by a constant and a term in t, which a free
    start takes out; nothing between epochs has to be interpolated but gravitation, so gaps do no
    harm. Both are kept relative to a point that is fixed in the Earth at t0, against rounding.

    Attributes
    ----------
    n0 : LocalLevel
    time : ndarray, shape (...)
        Seconds since t0.
    C_n0n : ndarray, shape (..., 3, 3)
    still_v : ndarray, shape (..., 3)
        s_v of an antenna that rests on the Earth here, m/s.
    s_p : ndarray, shape (..., 3)
        Metres.
    gravity, gravitation : ndarray, shape (..., 3)
        In n0 axes, m/s^2.
    int_gravitation, int_int_gravitation : ndarray, shape (..., 3)
    origin_r, origin_v : ndarray, shape (3,)
        Position and ground velocity at t0.

    """

    n0: LocalLevel
    time: Array
    C_n0n: Array
    still_v: Array
    s_p: Array
    gravity: Array
    gravitation: Array
    int_gravitation: Array
    int_int_gravitation: Array
    origin_r: Array
    origin_v: Array

    @staticmethod
    def start(latitude: float, longitude: float, altitude: float) -> 'InertialTrack':
        """Start at t0, with the antenna there: radians and metres."""
        zero = np.zeros(3)
        return InertialTrack(
            LocalLevel(latitude, longitude), np.zeros(()), np.eye(3), zero, zero,
            gravity_n(latitude, altitude), gravitation_n(latitude, altitude), zero, zero,
            position_n(latitude, altitude), ground_velocity_n(latitude, altitude))

    def extended(self, time: Array, latitude: Array, longitude: Array,
                 altitude: Array) -> 'InertialTrack':
        """
        Follow the antenna through K epochs.

        Parameters
        ----------
        time : ndarray, shape (K,)
            Seconds since t0, increasing.
        latitude, longitude, altitude : ndarray, shape (K,)
            Of the antenna, radians and metres.

        Returns
        -------
        InertialTrack
            With a leading axis of K.

        """
        C_n0n = self.n0.matrix(time, latitude, longitude)

        def seen(vector_n: Array) -> Array:
            return (C_n0n @ vector_n[..., None])[..., 0]

        gravity_here = gravity_n(latitude, altitude)
        ground_velocity = ground_velocity_n(latitude, altitude)
        gravitation = seen(gravity_here + cross(earth_rate_n(latitude), ground_velocity))
        before = np.concatenate([self.gravitation[None], gravitation[:-1]])
        h = np.diff(time, prepend=self.time)[:, None]
        steps = h / 2 * (before + gravitation)
        int_gravitation = running_sum(self.int_gravitation, steps)
        int_int_gravitation = running_sum(
            self.int_int_gravitation,
            h * (int_gravitation - steps) + h * h / 6 * (2 * before + gravitation))
        return InertialTrack(
            self.n0, time, C_n0n, seen(ground_velocity) - self.origin_v - int_gravitation,
            (seen(position_n(latitude, altitude)) - self.origin_r
             - time[:, None] * self.origin_v - int_int_gravitation),
            seen(gravity_here), gravitation, int_gravitation, int_int_gravitation,
            self.origin_r, self.origin_v)

    def at(self, index: int | tuple[()]) -> 'InertialTrack':
        """Return one epoch of a track over many; () of a track that is of one."""
        return replace(self, **{name: getattr(self, name)[index] for name in (
            'time', 'C_n0n', 'still_v', 's_p', 'gravity', 'gravitation', 'int_gravitation',
            'int_int_gravitation')})

    def s_v(self, v_n: Array) -> Array:
        """Velocity side for antenna velocities `v_n` (ENU, m/s), shape (..., 3)."""
        return (self.C_n0n @ v_n[..., None])[..., 0] + self.still_v


class AttitudeMoments:
    """
    Sums from which ``min_C sum |s - (unknown start) - C a|^2`` is solved: constant memory.

    Parameters
    ----------
    nuisance : int
        0: the note to the letter, nothing but C is unknown. 1: a free constant (velocity form).
        2: a free constant and a free slope (position form).

    """

    def __init__(self, nuisance: int) -> None:
        """Start with empty sums."""
        self._nuisance = nuisance
        self.count = 0
        self._moments = np.zeros((6 + nuisance, 6 + nuisance))

    def add(self, s: Array, a: Array, regressors: tuple[float, ...] = ()) -> None:
        """Add one pair; `regressors` are the values that multiply the unknown start."""
        row = np.concatenate([s, a, regressors])
        self._moments += np.outer(row, row)
        self.count += 1

    def solve(self) -> tuple[Array, float, Array]:
        """
        Davenport's q-method on the moments left when the nuisance parameters are regressed out.

        Returns
        -------
        C : ndarray, shape (3, 3)
            The attitude.
        residual : float
            Weighted residual sum of squares.
        A : ndarray, shape (3, 3)
            Moments of a about the regression.

        """
        m = self._moments[:6, :6]
        if self._nuisance:
            z = self._moments[6:, 6:]
            zm = self._moments[6:, :6]
            m = m - zm.T @ np.linalg.pinv(z, hermitian=True) @ zm
        C, residual = attitude_from_moments(m[:3, 3:], float(np.trace(m)))
        return C, residual, m[3:, 3:]


def attitude_from_moments(B: Array, total: float) -> tuple[Array, float]:
    """
    Davenport's q-method for ``sum |s - C a|^2`` with vectors that are not normalised.

    Parameters
    ----------
    B : ndarray, shape (3, 3)
        ``sum s a^T``.
    total : float
        ``sum |s|^2 + |a|^2``.

    Returns
    -------
    C : ndarray, shape (3, 3)
    residual : float
        Smallest eigenvalue of ``K = total I - 2 D``, the residual sum (not negative).

    """
    D = np.empty((4, 4))
    D[:3, :3] = B + B.T - np.trace(B) * np.eye(3)
    D[:3, 3] = D[3, :3] = B[2, 1] - B[1, 2], B[0, 2] - B[2, 0], B[1, 0] - B[0, 1]
    D[3, 3] = np.trace(B)
    values, vectors = np.linalg.eigh(total * np.eye(4) - 2 * D)
    return matrix_from_quaternion(vectors[:, 0]), max(float(values[0]), 0.0)


def exact_lever_remainder(time: Array, C_b0b: Array, omega_eb_b: Array, omega_ie_b0: Array,
                          lever_b: Array) -> Array:
    """
    Difference of the exact form of (9) from the short one: the oracle of Remark 2.1.

    Parameters
    ----------
    time : ndarray, shape (N,)
        Seconds, starting at t0.
    C_b0b : ndarray, shape (N, 3, 3)
        Attitude relative to t0.
    omega_eb_b : ndarray, shape (N, 3)
        Angular rate to the Earth.
    omega_ie_b0 : ndarray, shape (3,)
        Earth rate in b0.
    lever_b : ndarray, shape (3,)
        Lever arm, metres.

    Returns
    -------
    ndarray, shape (N, 3)
        m/s; at most ``W^2 t |lever|``.

    """
    rate = skew(omega_eb_b)
    swept = C_b0b @ rate
    h = np.diff(time)[:, None, None]
    integral = np.concatenate([np.zeros((1, 3, 3)),
                               np.cumsum(h / 2 * (swept[1:] + swept[:-1]), axis=0)])
    omega_ie_b = (C_b0b.transpose(0, 2, 1) @ omega_ie_b0)
    exact = C_b0b @ rate - rate[0] + skew(omega_ie_b0) @ integral
    omega_ib_b = omega_eb_b + omega_ie_b
    short = C_b0b @ skew(omega_ib_b) - skew(omega_ib_b[0])
    return (exact - short) @ lever_b
