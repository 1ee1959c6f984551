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
Linearised motion and measurements of many epochs.

Errors are those of `filter`, in the body frame, so derivatives hold no attitude and serve all
means of a rival (docs, "Theory").
"""

from copy import copy

from ins_align.estimation.states import (
    DELAY, FIRST, LEVER_ARM, Linearised, PHI, RHO, triads, XI)
from ins_align.geometry.rotation import apply, Array, by_row, cross, exp_so3, skew
from ins_align.imu.preintegration import Intervals
from ins_align.imu.recent import AGES, interpolated, smoothed
import numpy as np

# A delay is followed along the recent motion within these (s), and linearly beyond.
EARLIEST, LATEST = -0.1, AGES[-1]
_EYE = np.eye(3)


def linearised(point: Array, interval: Intervals, Q: Array, use_position: bool,
               base: Array | None = None) -> Linearised:
    """
    Linearise K epochs.

    Parameters
    ----------
    point : ndarray, shape (M, m)
        Parameters of each rival; their delays are equal, and within `EARLIEST` and `LATEST`.
    interval : Intervals
        Before each epoch and with the signs of each rival, of leading axes (K, M).
    Q : ndarray, shape (K, 1, 9, 9)
        Their covariance of (rotation, velocity, position) in the frame at the start.
    use_position : bool
        Whether positions are measured too.
    base : ndarray, shape (3,), optional
        Position of the vehicle's base in the frame of the IMU, m.

    """
    M, m = point.shape
    K = interval.duration.size
    gyro, accel = triads(m)
    size = accel.stop - accel.start             # of a bias, or of a bias and a matrix
    J = np.zeros((K, M, 9, m))
    J[:, :, PHI, gyro], J[:, :, XI, gyro] = interval.J_Rg[..., :size], interval.J_vg[..., :size]
    J[:, :, RHO, gyro], J[:, :, XI, accel] = interval.J_pg[..., :size], interval.J_va[..., :size]
    J[:, :, RHO, accel] = interval.J_pa[..., :size]
    change = apply(J, point)
    R = exp_so3(change[..., PHI]) @ interval.R
    moved = np.concatenate([interval.v, interval.p], axis=-1) + change[..., 3:]
    T = R.swapaxes(-1, -2)
    F = np.zeros((K, M, 9, FIRST + m))
    F[..., PHI, PHI] = F[..., XI, XI] = F[..., RHO, RHO] = T
    F[..., XI, PHI], F[..., RHO, PHI] = -T @ skew(moved[..., :3]), -T @ skew(moved[..., 3:])
    F[..., RHO, XI] = interval.duration[:, None, None, None] * T
    for rows in (PHI, XI, RHO):
        F[..., rows, FIRST:] = T @ J[..., rows, :]
    # The position that a late receiver measures lacks what was gained during the delay.
    delay = point[:, DELAY, None, None]
    F[..., RHO, PHI] -= delay * F[..., XI, PHI]
    F[..., RHO, FIRST:] -= delay * F[..., XI, FIRST:]
    F[..., RHO, FIRST + DELAY] = -apply(T, moved[..., :3])
    turn = np.zeros((K, M, 9, 9))
    turn[..., PHI, PHI] = turn[..., XI, XI] = turn[..., RHO, RHO] = T
    turn[..., RHO, XI] = -delay * T
    seen = _Seen(point, interval)
    H, expected = np.zeros((K, 2, M, 3, FIRST + m)), np.zeros((K, 2, M, 3))
    H[:, 0], expected[:, 0] = seen.velocity()
    if use_position:
        H[:, 1], expected[:, 1] = seen.position()
    return Linearised(point.copy(), interval.duration.tolist(), R, moved, J, F,
                      turn @ Q @ turn.swapaxes(-1, -2), H, expected,
                      None if base is None else seen.base(base))


class _Seen:
    """Measurements of a late receiver, in the body frame; K epochs, M rivals."""

    def __init__(self, point: Array, interval: Intervals) -> None:
        """Go back from the epochs to the times of the measurements."""
        self.shape = interval.duration.size, len(point), 3, FIRST + point.shape[1]
        gyro, accel = (point[:, triad] for triad in triads(point.shape[1]))
        self.delay = delay = float(point[0, DELAY])
        force, self.gained, self.gained_p = interpolated(interval.gained, delay)
        rate, self.turned, _ = interpolated(interval.turned, delay)
        # The lever arm swings with the vibration too.
        vibration = interval.omega - interpolated(interval.turned, 0.0)[0]

        def corrected(measured: Array, errors: Array, biases: float) -> Array:
            """Return the integrals of a triad without its errors."""
            true = measured - biases * errors[:, :3]
            if errors.shape[1] > 3:
                true = true - apply(errors[:, 3:].reshape(-1, 3, 3), measured)
            return true

        turn = corrected(self.turned, gyro, delay)
        calm = corrected(rate, gyro, 1.0)
        calm = calm + 0.5 * cross(turn, calm)
        self.rate = rate + vibration
        self.omega = calm + corrected(vibration, gyro, 0.0)
        self.back = exp_so3(-turn)
        self.fallen = corrected(self.gained, accel, delay)
        self.fallen_p = corrected(self.gained_p, accel, delay ** 2 / 2)
        # Derivatives use the motion without vibration. Age runs against time.
        self._calm = calm
        self._calm_force = corrected(smoothed(interval.gained, delay)[0], accel, 1.0)
        self._change = corrected(smoothed(interval.turned, delay)[1], gyro, 0.0)
        self._carry(point[:, LEVER_ARM])

    def _carry(self, lever: Array) -> None:
        """Set the lever arm, and the velocity and acceleration of its end."""
        self.lever = np.broadcast_to(lever, self.omega.shape)
        swing = cross(self.omega, self.lever)
        self.swing = apply(self.back, swing)
        whirled = cross(self._calm, swing) - cross(self._change, self.lever)
        self.acceleration = self._calm_force + apply(self.back, whirled)

    def base(self, position: Array) -> tuple[Array, Array, Array]:
        """Return `Linearised.base`, which is the velocity of an antenna at the base."""
        other = copy(self)
        other._carry(position)
        H, expected = other.velocity()
        H[..., FIRST:][..., LEVER_ARM] = 0.0        # it is not that of the antenna
        return H, expected, self.back

    def velocity(self) -> tuple[Array, Array]:
        """Return the derivatives, shape (K, M, 3, n), and u minus the velocity, (K, M, 3)."""
        swing = skew(self.swing)
        arm = self.back @ skew(self.lever)
        H = self._derivatives(skew(self.fallen) - swing, self.back @ skew(self.omega),
                              -self.acceleration, arm, arm - self.delay * swing, -swing,
                              self.delay, self.gained)
        H[..., XI] = _EYE
        return H, self.fallen - self.swing

    def position(self) -> tuple[Array, Array]:
        """Return the derivatives, shape (K, M, 3, n), and w minus the position, (K, M, 3)."""
        arm = apply(self.back, self.lever)
        H = self._derivatives(-skew(self.fallen_p + arm), self.back, self.fallen - self.swing,
                              np.zeros(arm.shape + (3,)), -self.delay * skew(arm), -skew(arm),
                              -self.delay ** 2 / 2, -self.gained_p)
        H[..., RHO] = _EYE
        return H, -self.fallen_p - arm

    def _derivatives(self, to_phi: Array, to_lever: Array, to_delay: Array, to_rate: Array,
                     to_gyro_bias: Array, to_turn: Array, to_accel_bias: float,
                     force: Array) -> Array:
        """Assemble the derivatives; those to matrices follow from rates and forces."""
        H = np.zeros(self.shape)
        x = H[..., FIRST:]
        H[..., PHI], x[..., LEVER_ARM], x[..., DELAY] = to_phi, to_lever, to_delay
        gyro, accel = (x[..., triad] for triad in triads(x.shape[-1]))
        gyro[..., :3], accel[..., :3] = to_gyro_bias, to_accel_bias * _EYE
        if gyro.shape[-1] > 3:
            gyro[..., 3:] = by_row(to_rate, self.rate) + by_row(to_turn, self.turned)
            accel[..., 3:] = by_row(np.broadcast_to(_EYE, to_turn.shape), force)
        return H
