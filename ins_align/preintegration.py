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
From IMU samples to intervals between GNSS epochs.

ROS gives angular rate and specific force at instants, with jitter and gaps. Between neighbouring
samples both are taken as linear in time; a GNSS stamp inside a sampling step splits it by
interpolation. All samples of an interval, and all intervals of a batch, are handled as arrays.
"""

from dataclasses import dataclass, fields

import numpy as np

from ins_align.rotation import (Array, cross, cumulative_rotations, exp_so3, left_jacobian, skew)


@dataclass(frozen=True)
class Intervals:
    """
    Preintegrated IMU data of K intervals, each in the body frame at the interval's start.

    Attributes
    ----------
    duration : ndarray, shape (K,)
        Seconds.
    R : ndarray, shape (K, 3, 3)
        Rotation from the body frame at the end to the one at the start.
    v, p : ndarray, shape (K, 3)
        Integral and double integral of the specific force, m/s and m.
    J_Rg, J_vg, J_pg, J_pa : ndarray, shape (K, 3, 3)
        Derivatives to the gyro bias (g) and accelerometer bias (a): of the rotation as a left
        error (``R <- exp_so3(J_Rg d) R``), of v, of p. That of v to the accelerometer bias is the
        same integral as J_Rg.
    gyro_moments : ndarray, shape (K, 9, 9)
        Covariance of the errors (rotation, v, p) for unit angle random walk, rad/sqrt(s).
    accel_moments : ndarray, shape (K, 9, 9)
        The same for unit velocity random walk, m/s/sqrt(s).
    omega, f : ndarray, shape (K, 3)
        Angular rate and specific force at the end of the interval.
    """

    duration: Array
    R: Array
    v: Array
    p: Array
    J_Rg: Array
    J_vg: Array
    J_pg: Array
    J_pa: Array
    gyro_moments: Array
    accel_moments: Array
    omega: Array
    f: Array

    @staticmethod
    def empty(capacity: int) -> 'Intervals':
        """Room for `capacity` intervals, to be filled by `put`."""
        shapes = {'duration': (), 'v': (3,), 'p': (3,), 'omega': (3,), 'f': (3,),
                  'gyro_moments': (9, 9), 'accel_moments': (9, 9)}
        return Intervals(**{field.name: np.zeros((capacity,) + shapes.get(field.name, (3, 3)))
                            for field in fields(Intervals)})

    def put(self, index: int, other: 'Intervals', other_index: int) -> None:
        """Copy one interval of `other` into place `index`."""
        for name, array in vars(self).items():
            array[index] = getattr(other, name)[other_index]

    def take(self, index: 'slice | Array') -> 'Intervals':
        """Return the intervals of `index`."""
        return Intervals(**{name: array[index] for name, array in vars(self).items()})

    def bias_corrected(self, gyro_bias: Array, accel_bias: Array) -> 'Intervals':
        """
        First-order correction for a change of the biases, shape (3,) or (K, 3).

        Noise and derivatives are left as they are: they change in second order only.
        """
        turn = (self.J_Rg @ gyro_bias[..., None])[..., 0]
        return Intervals(**{
            **vars(self),
            'R': exp_so3(turn) @ self.R,
            'v': self.v + (self.J_vg @ gyro_bias[..., None]
                           + self.J_Rg @ accel_bias[..., None])[..., 0],
            'p': self.p + (self.J_pg @ gyro_bias[..., None]
                           + self.J_pa @ accel_bias[..., None])[..., 0],
            'omega': self.omega - gyro_bias, 'f': self.f - accel_bias})


def split_at_epochs(stamps: Array, gyro: Array, accel: Array,
                    epochs: Array) -> tuple[Array, Array, Array]:
    """
    Cut a run of samples into the intervals between epochs.

    Parameters
    ----------
    stamps : ndarray, shape (N,)
        Sample times, seconds, strictly increasing, first <= epochs[0], last >= epochs[-1].
    gyro, accel : ndarray, shape (N, 3)
    epochs : ndarray, shape (K + 1,)
        Strictly increasing.

    Returns
    -------
    dt : ndarray, shape (K, n)
        Steps of each interval; shorter intervals are padded with steps of zero length.
    gyro, accel : ndarray, shape (K, n + 1, 3)
        Values at the ends of the steps.
    """
    # Sample numbers inside each open interval (start, end).
    first = np.searchsorted(stamps, epochs[:-1], side='right')
    last = np.searchsorted(stamps, epochs[1:], side='left')
    width = int(np.max(last - first)) + 2
    inner = first[:, None] + np.arange(-1, width - 1)
    inner = np.minimum(inner, last[:, None])
    knots = stamps[np.clip(inner, 0, stamps.size - 1)]
    np.clip(knots, epochs[:-1, None], epochs[1:, None], out=knots)
    knots[:, -1] = epochs[1:]
    # Linear interpolation to the knots; a knot that is a sample gets weight 0 or 1.
    right = np.clip(np.searchsorted(stamps, knots, side='left'), 1, stamps.size - 1)
    left = right - 1
    weight = ((knots - stamps[left]) / (stamps[right] - stamps[left]))[..., None]
    return (np.diff(knots, axis=1), gyro[left] * (1 - weight) + gyro[right] * weight,
            accel[left] * (1 - weight) + accel[right] * weight)


def preintegrate(dt: Array, omega: Array, f: Array) -> Intervals:
    """
    Integrate the steps of K intervals.

    Within a step rate and force are linear in time, which gives the second-order coning and
    sculling terms of [1]_ and [2]_ in the form that neighbouring samples allow.

    Parameters
    ----------
    dt : ndarray, shape (K, n)
        Seconds; zero for padding.
    omega, f : ndarray, shape (K, n + 1, 3)
        Bias-corrected rate, rad/s, and specific force, m/s^2, at the ends of the steps.

    Returns
    -------
    Intervals

    References
    ----------
    .. [1] P. G. Savage, "Strapdown inertial navigation integration algorithm design, part 1:
       attitude algorithms", J. Guidance, Control, and Dynamics 21(1), 1998.
    .. [2] P. G. Savage, part 2: velocity and position algorithms, 21(2), 1998.
    """
    omega0, omega1 = omega[:, :-1], omega[:, 1:]
    f0, f1 = f[:, :-1], f[:, 1:]
    h = dt[..., None]
    theta = 0.5 * h * (omega0 + omega1)
    force = 0.5 * h * (f0 + f1)
    coning = h * h / 12 * cross(omega0, omega1)
    sculling = h * h / 12 * (cross(omega0, f1) + cross(f0, omega1))
    jacobian = left_jacobian(theta)
    step_v = (jacobian @ force[..., None])[..., 0] + sculling
    step_p = h * h / 6 * (2 * f0 + f1) + h ** 3 / 6 * cross(omega0, 0.5 * (f0 + f1))

    turned = cumulative_rotations(exp_so3(theta + coning))
    A = np.empty_like(turned)                     # from the start of each step to the interval's
    A[:, 0] = np.eye(3)
    A[:, 1:] = turned[:, :-1]
    u = (A @ step_v[..., None])[..., 0]
    v_end = np.cumsum(u, axis=1)
    v_start = v_end - u
    p_step = h * v_start + (A @ step_p[..., None])[..., 0]
    p_end = np.cumsum(p_step, axis=1)

    # Derivatives: the bias turns the rest of the interval by -integral of A.
    A_step = A @ jacobian * dt[..., None, None]
    A_sum = np.cumsum(A_step, axis=1)
    turn_mid = A_sum - 0.5 * A_step
    v_g_step = skew(u) @ turn_mid
    v_g = np.cumsum(v_g_step, axis=1)
    hh = dt[..., None, None]
    p_g = np.sum(hh * (v_g - 0.5 * v_g_step), axis=1)
    p_a = np.sum(hh * turn_mid, axis=1)

    duration = np.sum(dt, axis=1)
    v, p = v_end[:, -1], p_end[:, -1]
    remaining = duration[:, None] - np.cumsum(dt, axis=1) + 0.5 * dt
    v_rest = v[:, None] - 0.5 * (v_start + v_end)
    v_mid = 0.5 * (v_start + v_end)
    p_mid = p_end - 0.5 * p_step
    p_rest = p[:, None] - p_mid - v_mid * remaining[..., None]
    gyro_moments, accel_moments = _noise_moments(dt, remaining, v_rest, p_rest)
    return Intervals(duration, turned[:, -1], v, p, -A_sum[:, -1], v_g[:, -1], p_g, -p_a,
                     gyro_moments, accel_moments, omega[:, -1], f[:, -1])


def _noise_moments(dt: Array, remaining: Array, v_rest: Array,
                   p_rest: Array) -> tuple[Array, Array]:
    """
    Covariance of the errors (rotation, v, p) for unit white noise in each sensor.

    Isotropic noise stays isotropic under the rotation of the body, so that only the velocity and
    distance still to come after each step (v_rest, p_rest) matter.
    """
    count = dt.shape[0]
    eye = np.eye(3)
    # Steps as columns: the rotation error of a step, seen in rotation, v and p at the end.
    lever = np.zeros((count, dt.shape[1], 9, 3))
    lever[:, :, :3] = eye
    lever[:, :, 3:6] = -skew(v_rest)
    lever[:, :, 6:] = -skew(p_rest)
    lever *= np.sqrt(dt)[..., None, None]
    columns = lever.transpose(0, 2, 1, 3).reshape(count, 9, -1)
    gyro = columns @ columns.transpose(0, 2, 1)
    accel = np.zeros((count, 9, 9))
    for row, col, power in ((3, 3, 0), (3, 6, 1), (6, 3, 1), (6, 6, 2)):
        # The variance of a step's own mid-point rule, dt^3 / 12, keeps a single step regular.
        moment = np.sum(dt * remaining ** power, axis=1)
        if power == 2:
            moment = moment + np.sum(dt ** 3, axis=1) / 12
        accel[:, row:row + 3, col:col + 3] = moment[:, None, None] * eye
    return gyro, accel
