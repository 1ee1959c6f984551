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
The reference: the estimation problem as one least-squares problem with a dense noise covariance.

It shares neither integration nor recursion with the package: attitude, velocity and position are
integrated by the trapezoidal rule over the IMU samples, the Earth model is that of python-ins, and
the covariance of the random-walk errors of all epochs is one dense matrix. On the true motion the
inverse of the information matrix is the Cramer-Rao bound; the tests solve measured data with the
same functions. The cost grows with the cube of the number of epochs: 500 take about a second.

Here an IMU has white noise and constant biases, but no scale factor errors or rate random walk.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from ins_align.config import ImuNoise
from ins_align.geometry.rotation import Array, Index, skew
from ins_align.gnss.messages import ENU_FROM_NED
from ins_align.simulation.simulate import Simulation
import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.transform import Rotation

# Columns of the unknowns.
ATTITUDE, GYRO_BIAS, ACCEL_BIAS = slice(0, 3), slice(3, 6), slice(6, 9)
START_VELOCITY, START_POSITION = slice(9, 12), slice(12, 15)
LEVER_ARM, DELAY = slice(15, 18), slice(18, 19)
SIZE = 19
# Sigma of an angle that is uniform on the circle (rad); this prior keeps the information matrix
# regular where the motion does not show the heading.
_ATTITUDE_STD = math.pi / math.sqrt(3)
SWING_STEP = 0.1        # s, step of the differences that give the angular acceleration


@dataclass(frozen=True)
class Bound:
    """Cramer-Rao bound of the initial attitude after each GNSS epoch."""

    time: Array         # (K,), s since t0, the first epoch
    covariance: Array   # (K, 3, 3), of the small rotation about the axes of ENU, rad^2

    def at(self, seconds: float) -> Array:
        """Return the bound after the last epoch up to `seconds` after t0."""
        return self.covariance[np.searchsorted(self.time, seconds + 1e-6) - 1]


def bound(simulation: Simulation, positions: bool = False, lever_arm_std: float = 0.0,
          delay_std: float = 0.0) -> Bound:
    """
    Return the Cramer-Rao bound on the true motion of a simulation, with its stated noise.

    GNSS measures velocities, or with `positions` these instead. Lever arm (sigma in m per axis)
    and delay (s) are unknowns too if their sigma is above 0.
    """
    noise = simulation.imu_noise
    if noise.gyro_scale_std > 0 or noise.rate_random_walk > 0:
        raise ValueError('the bound knows only noise and constant biases of an IMU')
    # Stamps of GNSS are later than the measurements by the delay.
    epochs = simulation.gnss_stamps_ns - round(simulation.meta['gnss_delay'] * 1e9)
    path = _true_path(simulation, epochs)
    columns, prior = prior_of(noise, positions, lever_arm_std, delay_std)
    stated = simulation.position_covariance if positions else simulation.velocity_covariance
    whitened = whiten(noise_covariance(path, noise, stated, positions),
                      design_of(path, simulation.lever_arm, positions)[:, columns])
    each = whitened.reshape(len(epochs), -1, len(columns))
    information = np.cumsum(each.transpose(0, 2, 1) @ each, axis=0) + prior
    return Bound(path.time, np.array([inverse_of(matrix)[:3, :3] for matrix in information]))


@dataclass(frozen=True)
class Path:
    """
    Integrals over the motion at K epochs, in n0 axes.

    U and P are the first and second integral of the specific force, Theta is that of C. H_v and
    H_p, shape (K, 3, 15), are the derivatives of the IMU's velocity and position with respect to
    all unknowns but lever arm and delay. M, shape (K, 7, 7), holds the integrals of z z^T with
    z = (1, U, t U - P).
    """

    time: Array
    C: Array              # C_n0b
    U: Array
    P: Array
    Theta: Array
    H_v: Array
    H_p: Array
    M: Array
    omega: Array          # of the body with respect to inertial space, body axes
    omega_dot: Array
    acceleration: Array   # over ground
    v_ground: Array
    C_n0n: Array


def cumulative(time: Array, values: Array) -> Array:
    """Integrate by the trapezoidal rule along the first axis, from 0 on."""
    return np.asarray(cumulative_trapezoid(values, time, axis=0, initial=0))


def path_along(time: Array, C: Array, omega: Array, f: Array, at: Array, C_n0n: Array,
               g_n: Array, v_n: Array) -> Path:
    """Integrate over a grid of instants (N,); `at` (K,) are the indices of the epochs in it."""
    force = np.einsum('nij,nj->ni', C, f)
    U = cumulative(time, force)
    P = cumulative(time, U)
    Theta = cumulative(time, C)
    unit = np.broadcast_to(np.eye(3), C.shape)
    H_v = np.concatenate([-skew(U), cumulative(time, skew(force) @ Theta), -Theta, unit, 0 * C],
                         axis=-1)
    H_p = cumulative(time, H_v)
    H_p[..., START_POSITION] = unit
    z = np.hstack([np.ones((len(time), 1)), U, time[:, None] * U - P])
    M = cumulative(time, z[:, :, None] * z[:, None, :])
    gravity = np.einsum('nij,nj->ni', C_n0n, g_n)
    return Path(time[at], C[at], U[at], P[at], Theta[at], H_v[at], H_p[at], M[at], omega[at],
                _rate_of_change(time, omega)[at], force[at] + gravity,
                np.einsum('nij,nj->ni', C_n0n, v_n), C_n0n)


def _rate_of_change(time: Array, omega: Array) -> Array:
    """Return the angular acceleration: second differences of the angle, which smooth noise."""
    angle = cumulative(time, omega)
    middle = np.clip(time, time[0] + SWING_STEP, time[-1] - SWING_STEP)
    before, here, after = (
        np.stack([np.interp(middle + step, time, column) for column in angle.T], axis=1)
        for step in (-SWING_STEP, 0.0, SWING_STEP))
    return (after - 2 * here + before) / SWING_STEP ** 2


def grid_of(imu_ns: np.ndarray, epochs_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of the epochs and the samples between them, ns, and where epochs are."""
    inside = (imu_ns > epochs_ns[0]) & (imu_ns < epochs_ns[-1])
    grid = np.union1d(imu_ns[inside], epochs_ns)
    return grid, np.searchsorted(grid, epochs_ns)


def interpolated(stamps_ns: np.ndarray, values: Array, wanted_ns: np.ndarray) -> Array:
    origin = stamps_ns[0]
    return CubicSpline((stamps_ns - origin) * 1e-9, values)((wanted_ns - origin) * 1e-9)


def _true_path(simulation: Simulation, epochs_ns: np.ndarray) -> Path:
    grid, at = grid_of(simulation.imu_stamps_ns, epochs_ns)
    time = (grid - grid[0]) * 1e-9
    stamps = simulation.truth_stamps_ns
    # Longitudes go round at the antimeridian, the Earth-fixed matrices do not.
    lla = simulation.truth_lla.copy()
    lla[:, 1] = np.unwrap(lla[:, 1], period=360.0)
    lla = interpolated(stamps, lla, grid)
    C_n0n = matrices_n0n(lla, lla[0], time)
    C = C_n0n @ simulation.attitude_at(grid)
    return path_along(time, C, interpolated(stamps, simulation.truth_gyro, grid),
                      interpolated(stamps, simulation.truth_accel, grid), at, C_n0n[at],
                      gravity_n(lla[at]),
                      interpolated(stamps, simulation.truth_velocity, epochs_ns))


def matrices_en(lla: Array) -> Array:
    from pyins.transform import mat_en_from_ll

    return mat_en_from_ll(lla[:, 0], lla[:, 1]) @ ENU_FROM_NED


def matrices_earth(time: Array) -> Array:
    from pyins.earth import RATE

    return Rotation.from_rotvec(RATE * time[:, None] * [0.0, 0.0, 1.0]).as_matrix()


def matrices_n0n(lla: Array, start: Array, time: Array) -> Array:
    return matrices_en(start[None])[0].T @ matrices_earth(time) @ matrices_en(lla)


def gravity_n(lla: Array) -> Array:
    from pyins.earth import gravity

    return np.stack([0 * lla[:, 0], 0 * lla[:, 0], -gravity(lla[:, 0], lla[:, 2])], axis=-1)


def lever_velocity(path: Path, lever_b: Array) -> Array:
    """Return the velocity of the antenna with respect to the IMU, in n0."""
    return np.einsum('nij,nj->ni', path.C, np.cross(path.omega, lever_b))


def design_of(path: Path, lever_b: Array, positions: bool = False) -> Array:
    """Return the derivatives of the measurements with respect to the unknowns, (3 K, 19)."""
    H = np.zeros((len(path.time), 3, SIZE))
    if positions:
        H[..., :LEVER_ARM.start] = path.H_p
        lever = path.C @ lever_b
        H[..., LEVER_ARM] = path.C
        H[..., DELAY] = -path.v_ground[..., None]
    else:
        H[..., :LEVER_ARM.start] = path.H_v
        lever = lever_velocity(path, lever_b)
        H[..., GYRO_BIAS] += path.C @ skew(lever_b)
        H[..., LEVER_ARM] = path.C @ skew(path.omega)
        swung = (np.cross(path.omega_dot, lever_b)
                 + np.cross(path.omega, np.cross(path.omega, lever_b)))
        H[..., DELAY] = -(path.acceleration + np.einsum('nij,nj->ni', path.C, swung))[..., None]
    H[..., ATTITUDE] -= skew(lever)
    H[..., GYRO_BIAS] += skew(lever) @ path.Theta
    return H.reshape(-1, SIZE)


def noise_covariance(path: Path, noise: ImuNoise, stated: Array, positions: bool = False) -> Array:
    """
    Return the covariance of all measurements from IMU random walks and GNSS noise, (3 K, 3 K).

    An angle error that arises at s changes the measurement at t by ``-[x x]`` times itself, with
    ``x = B z(s)``: ``U(t) - U(s)`` for a velocity, ``P(t) - P(s) - (t - s) U(s)`` for a position.
    Its effect through the lever arm, centimetres of motion per rad, is neglected.
    """
    n = len(path.time)
    early, late = path.time[:, None], path.time[None]
    B = np.zeros((n, 3, 7))
    # `pushed` is the integral, up to the earlier epoch, of the product of what an acceleration
    # error at s does to both epochs: 1 for a velocity, t - s for a position.
    if positions:
        B[..., 0] = path.P
        B[..., 1:4] = -path.time[:, None, None] * np.eye(3)
        B[..., 4:] = np.eye(3)
        pushed = early ** 2 * late / 2 - early ** 3 / 6
    else:
        B[..., 0] = path.U
        B[..., 1:4] = -np.eye(3)
        pushed = early
    # X[i, a, j, b]: integral of x_i[a] x_j[b] up to epoch i, which holds for i <= j.
    X = ((B @ path.M).reshape(3 * n, 7) @ B.reshape(3 * n, 7).T).reshape(n, 3, n, 3)
    trace = np.einsum('iaja->ij', X)
    V = -noise.angle_random_walk ** 2 * X.transpose(0, 3, 2, 1)
    diagonal = noise.angle_random_walk ** 2 * trace + noise.velocity_random_walk ** 2 * pushed
    for axis in range(3):
        V[:, axis, :, axis] += diagonal
    V = V.reshape(3 * n, 3 * n)
    upper = np.kron(np.triu(np.ones((n, n))), np.ones((3, 3)))
    V = np.where(upper > 0, V, V.T)
    V.reshape(n, 3, n, 3)[range(n), :, range(n), :] += (
        path.C_n0n @ stated @ path.C_n0n.swapaxes(-1, -2))
    return V


def prior_of(noise: ImuNoise, positions: bool, lever_arm_std: float,
             delay_std: float) -> tuple[Index, Array]:
    """Return the columns of the unknowns that are estimated, and their prior information."""
    std = np.zeros(SIZE)
    std[ATTITUDE] = _ATTITUDE_STD
    std[GYRO_BIAS], std[ACCEL_BIAS] = noise.gyro_bias_std, noise.accel_bias_std
    std[START_VELOCITY] = math.inf
    std[START_POSITION] = math.inf if positions else 0.0
    std[LEVER_ARM], std[DELAY] = lever_arm_std, delay_std
    columns = np.flatnonzero(std)
    return columns, np.diag(std[columns] ** -2.0)


def whiten(V: Array, columns: Array) -> Array:
    """
    Multiply columns by the inverse of the lower Cholesky factor of V.

    The first rows of the result depend on the first rows of V and of the columns alone, so sums
    over them belong to the problem that ends there.
    """
    return solve_triangular(cholesky(V, lower=True), columns, lower=True)


def inverse_of(matrix: Array) -> Array:
    """
    Invert a symmetric positive definite matrix whose rows differ widely in scale.

    The result is nan if there is no information about some unknown, as about the velocity after a
    single position.
    """
    if not np.diag(matrix).all():
        return np.full(matrix.shape, math.nan)
    scale = 1 / np.sqrt(np.diag(matrix))
    return np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
