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
Preintegration of IMU samples over the intervals between GNSS epochs.

In a step, the time between neighbouring samples, angular rate and specific force are taken as
cubics; a GNSS stamp inside a step splits it.
"""

from dataclasses import dataclass
from typing import NamedTuple

from ins_align.geometry.rotation import (
    apply, Array, cross, cumulative_rotations, exp_and_left_jacobian, exp_so3, Index, log_so3,
    orthonormalized, product, skew)
from ins_align.imu.recent import Recent
import numpy as np
from numpy.typing import ArrayLike

# Where one of two neighbouring steps is shorter than this share of the other, the slope at the
# sample between them is taken over both as one: noise makes the slope over the shorter one.
UNEVEN = 0.1
# The derivatives take this many steps of the IMU as one.
DERIVATIVE_STEPS = 4


@dataclass(frozen=True)
class Intervals:
    """
    Preintegrated IMU data of K intervals, each in the body frame at the interval's start.

    Errors of rotation multiply from the left (``R <- exp_so3(J_Rg d) R``). J are derivatives to
    bias and matrix, row by row, of the gyros (g) or of the accelerometers (a), whose errors are
    constant: ``true = measured - matrix @ measured - bias``.
    """

    duration: Array     # (K,), s
    R: Array            # (K, 3, 3), from the body frame at the end to the one at the start
    v: Array            # (K, 3), integral of the specific force, m/s
    p: Array            # (K, 3), double integral, m
    J_Rg: Array         # (K, 3, 12)
    J_vg: Array
    J_pg: Array
    J_va: Array
    J_pa: Array
    Q: Array            # (K, 9, 9), of the errors (rotation, v, p) that the sensors' noise leaves
    Q_excess: Array     # the same, of the noise measured beyond the stated one
    force: Array        # (K,), mean magnitude of the specific force, m/s^2
    omega: Array        # (K, 3), angular rate at the end, as measured, rad/s
    gained: Array       # (K, RUNGS, 3), as measured before the end; see `Recent`
    turned: Array       # (K, RUNGS, 3)

    def take(self, index: 'slice | Array') -> 'Intervals':
        """Return the intervals of `index`."""
        return Intervals(**{name: array[index] for name, array in vars(self).items()})

    def end(self) -> 'Intervals':
        """Return the interval of zero length, without noise, at the end of a single interval."""
        zero = {name: np.zeros_like(array) for name, array in vars(self).items()}
        return Intervals(**zero | {'R': np.eye(3)[None], 'omega': self.omega,
                                   'gained': self.gained, 'turned': self.turned})

    def mirrored(self, signs: Array) -> 'Intervals':
        """
        Return the intervals with the signs of sensors changed, with leading axes (K, M).

        `signs`, shape (M, 4), are 1 or -1 for the gyros x, y, z and for all accelerometers; if
        none is changed, the leading axes are (K, 1). The result is of second order in an
        interval's rotation, for constant rate and force: enough to tell signs apart.
        """
        gyro, accel = signs[:, :3], signs[:, 3:]
        wider = {name: array[:, None] for name, array in vars(self).items()}
        wider['duration'] = self.duration
        if (signs == 1).all():
            return Intervals(**wider)
        turn = log_so3(self.R)[:, None]
        # A force acts on average after half of the rotation, and on the position after a third.
        half, third = (exp_so3(part * gyro * turn) @ exp_so3(-part * turn) for part in (1/2, 1/3))
        ones = np.ones((len(signs), 3))
        # A bias keeps its sign; an entry of a matrix is multiplied by what is mirrored.
        of_gyro = np.hstack([ones, np.tile(gyro, 3)])[:, None]
        of_accel = np.hstack([ones, np.tile(accel, 9)])[:, None]
        force = accel[:, None]
        return Intervals(**wider | {
            'R': exp_so3(gyro * turn),
            'v': accel * apply(half, wider['v']), 'p': accel * apply(third, wider['p']),
            'J_Rg': of_gyro * (half @ wider['J_Rg']),
            'J_vg': force * of_gyro * (half @ wider['J_vg']),
            'J_pg': force * of_gyro * (third @ wider['J_pg']),
            'J_va': of_accel * (half @ wider['J_va']), 'J_pa': of_accel * (third @ wider['J_pa']),
            'omega': gyro * wider['omega'], 'gained': force * wider['gained'],
            'turned': gyro[:, None] * wider['turned']})


class Noise(NamedTuple):
    """White noise of the sensors in each step, shape () or (K, n), rad/sqrt(s), m/s/sqrt(s)."""

    angle_random_walk: ArrayLike = 0.0      # stated
    velocity_random_walk: ArrayLike = 0.0
    gyro_excess: ArrayLike = 0.0            # measured beyond the stated one
    accel_excess: ArrayLike = 0.0


class Steps(NamedTuple):
    """IMU samples, and their derivatives to time, cut into K intervals of n steps."""

    dt: Array           # (K, n), s; shorter intervals are padded with steps of zero length
    omega: Array        # (K, n + 1, 3), angular rate at the ends of the steps, rad/s
    f: Array            # (K, n + 1, 3), specific force, m/s^2
    omega_dot: Array    # (K, n + 1, 3), rad/s^2
    f_dot: Array        # (K, n + 1, 3), m/s^3


def split_at_epochs(stamps_ns: Index, samples: Array, epochs_ns: Index) -> Steps:
    """
    Cut samples, (N, 6), rad/s and m/s^2, into the K intervals between K + 1 epochs.

    Values at an epoch are interpolated with the cubic of the neighbouring samples and their
    central differences. Stamps increase strictly, and all epochs lie between the first and the
    last one; two equal epochs make an interval of zero length.
    """
    samples = samples.T
    slopes = _slopes(samples, np.diff(stamps_ns) * 1e-9)
    # Values and slopes at the epochs.
    right = np.clip(np.searchsorted(stamps_ns, epochs_ns), 1, stamps_ns.size - 1)
    left = right - 1
    h = (stamps_ns[right] - stamps_ns[left]) * 1e-9
    t = (epochs_ns - stamps_ns[left]) * 1e-9 / h
    rise = samples[:, right] - samples[:, left]
    bend0, bend1 = h * slopes[:, left] - rise, rise - h * slopes[:, right]
    value = samples[:, left] + t * rise + t * (1 - t) * ((1 - t) * bend0 + t * bend1)
    slope = (rise + (1 - 2 * t) * ((1 - t) * bend0 + t * bend1)
             + t * (1 - t) * (bend1 - bend0)) / h
    # In the columns, the samples and then the epochs.
    known = np.block([[samples, value], [slopes, slope]])
    # The ends of an interval's steps: its start, the samples inside, and its end, as padding too.
    first = np.searchsorted(stamps_ns, epochs_ns[:-1], side='right')
    last = np.searchsorted(stamps_ns, epochs_ns[1:], side='left')
    inner = first + np.arange(-1, max(int(np.max(last - first)), 0) + 1)[:, None]
    end = stamps_ns.size + np.arange(1, epochs_ns.size)
    knots = np.where(inner < last, inner, end)
    knots[0] = end - 1
    omega, f, omega_dot, f_dot = known.take(knots, axis=1).reshape(4, 3, *knots.shape)
    return Steps(np.diff(np.concatenate([stamps_ns, epochs_ns])[knots], axis=0).T * 1e-9,
                 omega.T, f.T, omega_dot.T, f_dot.T)


def _slopes(samples: Array, spacing: Array) -> Array:
    """Return central differences of samples, shape (6, N), one-sided at the first and last."""
    rise = np.diff(samples) / spacing
    before, after = spacing[:-1], spacing[1:]
    uneven = np.minimum(before, after) < UNEVEN * np.maximum(before, after)
    first, second = np.where(uneven, [before, after], [after, before])
    inner = (first * rise[:, :-1] + second * rise[:, 1:]) / (before + after)
    return np.concatenate([rise[:, :1], inner, rise[:, -1:]], axis=1)


def preintegrate(steps: Steps, noise: Noise, recent: Recent) -> Intervals:
    """
    Integrate the steps of K intervals as if the sensors had no errors.

    Angle and velocity increments come from the cubic through both ends of a step: the trapezoidal
    rule with end corrections, whose noise cancels from step to step. Coning and sculling terms are
    of second order [1]_, [2]_, in a form for rates at instants.

    References
    ----------
    .. [1] P. G. Savage, "Strapdown inertial navigation integration algorithm design, part 1:
       attitude algorithms", J. Guidance, Control, and Dynamics 21(1), 1998.
    .. [2] P. G. Savage, part 2: velocity and position algorithms, 21(2), 1998.

    """
    # In Fortran order, so that each component of vectors and matrices is contiguous in memory.
    dt, omega, f, omega_dot, f_dot = map(np.asfortranarray, steps)
    omega0, omega1 = omega[:, :-1], omega[:, 1:]
    f0, f1 = f[:, :-1], f[:, 1:]
    h = dt[..., None]
    h2_12 = h * h / 12
    theta = h / 2 * (omega0 + omega1) - h2_12 * np.diff(omega_dot, axis=1)
    both = f0 + f1
    force = h / 2 * both - h2_12 * np.diff(f_dot, axis=1)
    coning = h2_12 * cross(omega0, omega1)
    sculling = h2_12 * (cross(omega0, f1) + cross(f0, omega1))
    turn, jacobian = exp_and_left_jacobian(theta + coning)
    step_v = _applied(jacobian, force) + sculling
    step_p = 2 * h2_12 * (f0 + both) + h * h2_12 * cross(omega0, both)

    turned = cumulative_rotations(turn)
    A = np.empty_like(turn)         # from the body frame at a step's start to the interval's
    A[:, 0] = np.eye(3)
    A[:, 1:] = turned[:, :-1]
    u = _applied(A, step_v)
    v_end = np.cumsum(u, axis=1)
    v_start = v_end - u
    v_mid = 0.5 * (v_start + v_end)
    p_step = h * v_start + _applied(A, step_p)
    p_end = np.cumsum(p_step, axis=1)

    passed = np.cumsum(dt, axis=1)
    duration = passed[:, -1]
    magnitude = (np.cumsum(0.5 * dt * np.linalg.norm(both, axis=2), axis=1)[:, -1]
                 / np.maximum(duration, 1e-9))
    remaining = duration[:, None] - passed + 0.5 * dt       # from the middle of each step on
    derivatives = _derivatives(dt, product(A, h[..., None] * jacobian), u, *(
        0.5 * (values[:, :-1] + values[:, 1:]) for values in (omega, f)))

    v, p = v_end[:, -1], p_end[:, -1]
    v_rest = v[:, None] - v_mid
    p_rest = p[:, None] - (p_end - 0.5 * p_step) - v_mid * remaining[..., None]
    Q, Q_excess = (_covariance(*densities, dt, v_rest, p_rest, remaining)
                   for densities in (noise[:2], noise[2:]))
    # The rotations of many intervals, over hours, are multiplied by each other.
    R = orthonormalized(turned[:, -1])
    return Intervals(*map(np.ascontiguousarray, (
        duration, R, v, p, *derivatives, Q, Q_excess, magnitude, omega[:, -1], *recent)))


def _covariance(gyro: ArrayLike, accel: ArrayLike, dt: Array, v_rest: Array, p_rest: Array,
                remaining: Array) -> Array:
    """Return the covariance, (K, 9, 9), of the errors at the end from noise of both sensors."""
    if not (np.any(gyro) or np.any(accel)):
        return np.zeros((dt.shape[0], 9, 9))
    return (_of_gyros(np.square(gyro) * dt, v_rest, p_rest)
            + _of_accelerometers(np.square(accel) * dt, dt, remaining))


def _applied(matrix: Array, vectors: Array) -> Array:
    """Return ``matrix @ vector`` as `product` does, shapes (..., 3, 3) and (..., 3)."""
    return product(matrix, vectors[..., None])[..., 0]


def _total(values: Array) -> Array:
    """
    Return the sum over steps of values, shape (K, n, ...), added one after the other.

    No bit of an interval's sum depends on K, or on steps of zero length at its end.
    """
    if len(values) == 1:          # contiguous, which np.sum would add pairwise
        return np.cumsum(values, axis=1)[:, -1]
    return np.sum(np.asfortranarray(values), axis=1)


def _derivatives(dt: Array, turns: Array, u: Array, rate: Array,
                 force: Array) -> tuple[Array, Array, Array, Array, Array]:
    """
    Return J_Rg, J_vg, J_pg, J_va, J_pa of `Intervals`.

    A gyro bias turns the rest of the interval by minus the integral of the attitude, `turns` of
    each step, (K, n, 3, 3); an entry of a matrix acts as a bias times the mean rate or force of
    the step, (K, n, 3). `u`, (K, n, 3), is the velocity gained in each step. A few steps are taken
    as one, with an error of second order in their motion.
    """
    def together(values: Array) -> Array:
        sums = values[:, ::DERIVATIVE_STEPS].copy(order='K')
        for k in range(1, DERIVATIVE_STEPS):
            more = values[:, k::DERIVATIVE_STEPS]
            sums[:, :more.shape[1]] += more
        return sums

    seconds = together(dt)
    turns, u = together(turns), together(u)
    per_second = 1 / np.maximum(seconds, 1e-9)[..., None]
    by_gyros, by_accelerometers = (np.empty(seconds.shape + (3, 12), order='F')
                                   for _ in range(2))
    for by, measured in (by_gyros, rate), (by_accelerometers, force):
        mean = per_second * together(dt[..., None] * measured)
        by[..., :3] = turns
        for k in range(3):
            np.multiply(turns[..., k, None], mean[..., None, :],
                        out=by[..., 3 + 3 * k:6 + 3 * k])
    turned_by = np.cumsum(by_gyros, axis=1)
    pushes = cross(u[..., None, :], (turned_by - 0.5 * by_gyros).swapaxes(2, 3)).swapaxes(2, 3)
    # The velocity gained in a step adds to the position for the time that remains.
    passed = np.cumsum(seconds, axis=1)
    remaining = (passed[:, -1:] - passed + 0.5 * seconds)[..., None, None]
    return (-turned_by[:, -1], _total(pushes), _total(remaining * pushes),
            -_total(by_accelerometers), -_total(remaining * by_accelerometers))


def _of_gyros(variance: Array, v_rest: Array, p_rest: Array) -> Array:
    """
    Return the covariance, (K, 9, 9), of the errors (rotation, v, p) from errors of angle.

    An error of a step's angle increment turns the velocity and distance that are still to come,
    `v_rest` and `p_rest`, (K, n, 3). Its variance, (K, n), is isotropic, also after rotations.
    """
    # Sums of products of [1, v_rest, p_rest]; those of [I, -[v_rest x], -[p_rest x]] follow.
    variance = np.asfortranarray(variance)
    rest = np.empty(variance.shape + (7,), order='F')
    rest[..., 0], rest[..., 1:4], rest[..., 4:] = 1.0, v_rest, p_rest
    weighted = variance[..., None] * rest
    moment = np.empty((variance.shape[0], 7, 7))
    for i in range(7):
        moment[:, i, i:] = moment[:, i:, i] = _total(weighted[..., i, None] * rest[..., i:])
    eye = np.eye(3)
    Q = np.zeros((variance.shape[0], 3, 3, 3, 3))       # blocks are [:, i, :, j]
    Q[:, 0, :, 0] = moment[:, :1, :1] * eye
    turned = skew(moment[:, 0, 1:].reshape(-1, 2, 3))
    Q[:, 1:, :, 0], Q[:, 0, :, 1:] = -turned, turned.transpose(0, 2, 1, 3)
    # [a x] [b x]^T = (a . b) I - b a^T
    products = moment[:, 1:, 1:].reshape(-1, 2, 3, 2, 3)
    dot = np.trace(products, axis1=2, axis2=4)
    Q[:, 1:, :, 1:] = (dot[:, :, None, :, None] * eye[:, None] - products.transpose(0, 1, 4, 3, 2))
    return Q.reshape(-1, 9, 9)


def _of_accelerometers(variance: Array, dt: Array, remaining: Array) -> Array:
    """
    Return the covariance, (K, 9, 9), of the errors (rotation, v, p) from errors of velocity.

    An error of a step's velocity increment, with this variance, (K, n), adds to the distance in
    the time that remains after the middle of the step, (K, n).
    """
    Q = np.zeros((variance.shape[0], 3, 3, 3, 3))
    # dt^2 / 12 is the variance within the step itself.
    v, vp, p = (np.cumsum(variance * weight, axis=1)[:, -1]
                for weight in (1.0, remaining, remaining ** 2 + dt ** 2 / 12))
    blocks = np.array([[v, vp], [vp, p]]).transpose(2, 0, 1)
    Q[:, 1:, :, 1:] = blocks[:, :, None, :, None] * np.eye(3)[:, None]
    return Q.reshape(-1, 9, 9)
