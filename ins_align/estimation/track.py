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
"""Both sides of the formulas, in frames that do not rotate: of the antenna and of the IMU."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TYPE_CHECKING

from ins_align.estimation.states import Measured
from ins_align.geometry.earth import gravitation_n, ground_velocity_n, matrix_n0n, position_n
from ins_align.geometry.rotation import apply, Array, cross, cumulative_rotations, running_sum
from ins_align.gnss.messages import AntennaEpoch, velocities_of
import numpy as np

if TYPE_CHECKING:
    from ins_align.imu.preintegration import Intervals

# Sigma (m/s, m) from which on a vertical velocity or position is not measured.
UNMEASURED = 100.0


@dataclass(frozen=True)
class InertialTrack:
    """
    The navigation side of the formulas in the non-rotating frame n0.

    It starts at the epoch where n0 is frozen: t0, or in a bank the one at which it last anchored.

    ``s_p = C_n0e Rz(W t) r_e(t) - int int gravitation`` and its derivative ``s_v`` are the
    integrals of the note: ``s_v - v_n(0)`` is its left side (9), ``s_p - t v_n(0)`` that of the
    position form. Only gravitation is interpolated between epochs, so gaps do no harm. Both are
    relative to the position at the start, against rounding.
    """

    origin: tuple[float, float]  #: latitude and longitude at the start, radians
    time: Array  #: (...), s since the start
    C_n0n: Array  #: (..., 3, 3)
    still_v: Array  #: (..., 3), s_v of an antenna that rests on the Earth here, m/s
    s_p: Array  #: (..., 3), m
    gravitation: Array  #: (..., 3), in n0 axes, m/s^2
    int_gravitation: Array  #: (..., 3), m/s; and twice, m
    int_int_gravitation: Array
    origin_r: Array  #: (3,), position and ground velocity at the start
    origin_v: Array

    @staticmethod
    def start(latitude: float, longitude: float, altitude: float) -> 'InertialTrack':
        """Freeze n0, with the antenna there: radians and metres."""
        zero = np.zeros(3)
        return InertialTrack(
            (latitude, longitude), np.zeros(()), np.eye(3), zero, zero,
            gravitation_n(latitude, altitude), zero, zero, position_n(latitude, altitude),
            ground_velocity_n(latitude, altitude))

    def extended(self, time: Array, latitude: Array, longitude: Array,
                 altitude: Array) -> 'InertialTrack':
        """
        Follow the antenna through K epochs.

        Parameters
        ----------
        time : ndarray, shape (K,)
            Seconds since the start, increasing.
        latitude, longitude, altitude : ndarray, shape (K,)
            Of the antenna, radians and metres.

        Returns
        -------
        InertialTrack
            With a leading axis of K.

        """
        C_n0n = matrix_n0n(self.origin, time, latitude, longitude)
        gravitation = apply(C_n0n, gravitation_n(latitude, altitude))
        before = np.concatenate([self.gravitation[None], gravitation[:-1]])
        h = np.diff(time, prepend=self.time)[:, None]
        steps = h / 2 * (before + gravitation)
        int_gravitation = running_sum(self.int_gravitation, steps)
        int_int_gravitation = running_sum(
            self.int_int_gravitation,
            h * (int_gravitation - steps) + h * h / 6 * (2 * before + gravitation))
        return InertialTrack(
            self.origin, time, C_n0n,
            apply(C_n0n, ground_velocity_n(latitude, altitude)) - self.origin_v - int_gravitation,
            (apply(C_n0n, position_n(latitude, altitude)) - self.origin_r
             - time[:, None] * self.origin_v - int_int_gravitation),
            gravitation, int_gravitation, int_int_gravitation, self.origin_r, self.origin_v)

    def along(self, epochs: Sequence[AntennaEpoch], n0_ns: int) -> 'InertialTrack':
        """Follow the antenna through GNSS epochs; `n0_ns` is the stamp at which n0 was frozen."""
        return self.extended(
            np.array([epoch.stamp_ns - n0_ns for epoch in epochs]) * 1e-9,
            *(np.array([getattr(epoch, name) for epoch in epochs])
              for name in ('latitude', 'longitude', 'altitude')))

    def at(self, index: int | slice) -> 'InertialTrack':
        """Return one epoch of a track over many, or some of them."""
        return replace(self, **{name: getattr(self, name)[index] for name in (
            'time', 'C_n0n', 'still_v', 's_p', 'gravitation', 'int_gravitation',
            'int_int_gravitation')})

    def s_v(self, v_n: Array) -> Array:
        """Velocity side for antenna velocities `v_n` (ENU, m/s), shape (..., 3)."""
        return apply(self.C_n0n, v_n) + self.still_v

    def measured(self, epochs: Sequence[AntennaEpoch], use_position: bool) -> Measured:
        """Return what the GNSS measures at the epochs of the track."""
        C_n0n = self.C_n0n[:, None]
        covariance = np.array([epoch.covariances for epoch in epochs])
        present = np.array([epoch.measured for epoch in epochs]) & [True, use_position]
        vertical = np.any(present & (covariance[..., 2, 2] < UNMEASURED ** 2), axis=1)
        if use_position:            # epochs between positions must not reset the vertical
            vertical |= ~present[:, 1]
        return Measured(
            np.stack([self.s_v(velocities_of(epochs)), self.s_p], axis=1),
            C_n0n @ covariance @ C_n0n.swapaxes(-1, -2), present.tolist(), vertical.tolist(),
            [epoch.stated for epoch in epochs], self.still_v)


class BodyTrack(NamedTuple):
    """
    The body side of the formulas in the non-rotating frame b0, the body at t0.

    ``a_v - a_v(0)`` is the right side of the note's (9), short form, ``a_p - a_p(0) - t a_v(0)``
    that of the position form (Remark 2.3).
    """

    C_b0b: Array = np.eye(3)  #: (..., 3, 3)
    omega: Array = np.zeros(3)  #: (..., 3), angular rate in the body, rad/s
    int_f: Array = np.zeros(3)  #: (..., 3), integral of C_b0b f, m/s; and twice, m
    int_int_f: Array = np.zeros(3)

    def along(self, imu: 'Intervals') -> 'BodyTrack':
        """
        Follow the body through K intervals; the result has a leading axis of K.

        An interval of zero length at t0 gives the rate there.
        """
        C = cumulative_rotations(np.concatenate([self.C_b0b[None], imu.R]))
        steps = apply(C[:-1], imu.v)
        int_f = running_sum(self.int_f, steps)
        int_int_f = running_sum(self.int_int_f, imu.duration[:, None] * (int_f - steps)
                                + apply(C[:-1], imu.p))
        return BodyTrack(C[1:], imu.omega, int_f, int_int_f)

    def at(self, k: int) -> 'BodyTrack':
        """Return one epoch of a track over many."""
        return BodyTrack(*(values[k] for values in self))

    def a_v(self, lever_b: Array) -> Array:
        """Velocity, ``int C_b0b f + C_b0b (omega x lever_b)``, lever arm in m, shape (..., 3)."""
        return self.int_f + apply(self.C_b0b, cross(self.omega, lever_b))

    def a_p(self, lever_b: Array) -> Array:
        """Position, ``int int C_b0b f + C_b0b lever_b``, lever arm in m, shape (..., 3)."""
        return self.int_int_f + apply(self.C_b0b, lever_b)
