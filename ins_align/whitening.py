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
Whitening: residuals and sensitivities of the integration formulas, freed of the IMU's noise.

The random-walk errors of the integrated IMU data are carried as what they amount to at t0: errors
of the initial attitude, of the start velocity and, with positions, of the start position, in n0.
Seen so they are a plain random walk, and a measurement's derivative to them is its derivative to
those unknowns. So it is with how far the gyros' biases have walked since t0: a step of theirs is
one of the biases at t0 less what that would have done until then. Measurement rows: velocity
first, then position; both in n0.
"""

from dataclasses import dataclass

from ins_align.preintegration import Intervals
from ins_align.recent import AGES, exact, smooth
from ins_align.rotation import (apply, Array, by_row, cross, cumulative_rotations, exp_so3, Index,
                                running_sum, skew)
from ins_align.unknowns import (ACCEL, ACCEL_BIAS, ACCEL_MATRIX, ATTITUDE, DELAY, GYRO, GYRO_BIAS,
                                GYRO_MATRIX, inverse_spd, LEVER_ARM, SIZE, START_POSITION,
                                START_VELOCITY, Unknowns)
import numpy as np

# Below this heading sigma (rad) the problem is as good as linear in the heading.
HEADING_RESOLVED_STD = 0.35
# Chi-square gate of three rows of innovation: one in 60 000 of good ones fails.
GATE = 25.0
VELOCITY, POSITION = slice(0, 3), slice(3, 6)
# Between these delays (s) the motion before the epoch leads back, or a little on.
MIN_DELAY, MAX_DELAY = -0.1, AGES[-1]
# The unknowns that the errors of the chain look like, but for biases that walk.
START = np.r_[ATTITUDE, START_VELOCITY, START_POSITION]
# Epochs whose joint covariance is factored at one go: fewer cost calls, more cost operations.
BLOCK = 8


@dataclass
class Measurements:
    """
    GNSS epochs on the navigation side, in n0; K of them, the first at t0.

    Attributes
    ----------
    time : ndarray, shape (K,)
        Seconds since t0.
    s : ndarray, shape (K, 6)
        s_v and s_p of `InertialTrack`.
    covariance : ndarray, shape (K, 2, 3, 3)
        Of the velocity and of the position.
    present : ndarray of bool, shape (K, 2)
        Whether the velocity and the position rows hold a measurement.
    gravity, offset : ndarray, shape (K, 3)
        Gravity in n0, and what has to be added to s_v for the velocity over ground in n0.

    """

    time: Array
    s: Array
    covariance: Array
    present: np.ndarray
    gravity: Array
    offset: Array

    @staticmethod
    def empty(capacity: int) -> 'Measurements':
        """Room for `capacity` epochs."""
        return Measurements(np.zeros(capacity), np.zeros((capacity, 6)),
                            np.zeros((capacity, 2, 3, 3)), np.zeros((capacity, 2), bool),
                            np.zeros((capacity, 3)), np.zeros((capacity, 3)))

    def take(self, index: slice) -> 'Measurements':
        """Return the epochs of `index`."""
        return Measurements(*(array[index] for array in vars(self).values()))

    def put(self, index: slice, other: 'Measurements') -> None:
        """Copy the epochs of `other` into the places `index`."""
        for name, array in vars(self).items():
            array[index] = getattr(other, name)


@dataclass
class Chain:
    """The integrated IMU data up to an epoch, and their derivatives to the sensors' errors."""

    R: Array                # C_b0b
    v: Array                # int C_b0b f
    p: Array                # int int C_b0b f
    R_g: Array              # left error of R to bias and matrix of the gyros, (3, 12)
    v_g: Array
    p_g: Array
    v_a: Array              # to those of the accelerometers
    p_a: Array

    @staticmethod
    def start() -> 'Chain':
        """Return the chain at t0."""
        return Chain(np.eye(3), np.zeros(3), np.zeros(3), *(np.zeros((3, 12)) for _ in range(5)))

    def at(self, index: int | slice) -> 'Chain':
        """Return one or some epochs of a chain over many."""
        return Chain(*(array[index] for array in vars(self).values()))

    def extended(self, interval: Intervals) -> 'Chain':
        """Chain K intervals; the result has a leading axis of K, at the end of each interval."""
        turned = cumulative_rotations(np.concatenate([self.R[None], interval.R]))
        R, R_end = turned[:-1], turned[1:]
        h = interval.duration[:, None, None]
        u, w = apply(R, interval.v), apply(R, interval.p)
        skew_u, skew_w = skew(u), skew(w)

        def total(start: Array, steps: Array) -> tuple[Array, Array]:
            """Values before and after each interval."""
            after = running_sum(start, steps)
            return np.concatenate([start[None], after[:-1]]), after

        R_g, R_g_end = total(self.R_g, R @ interval.J_Rg)
        v_g, v_g_end = total(self.v_g, R @ interval.J_vg - skew_u @ R_g)
        v_a, v_a_end = total(self.v_a, R @ interval.J_va)
        v, v_end = total(self.v, u)
        p_end = total(self.p, w + interval.duration[:, None] * v)[1]
        p_g_end = total(self.p_g, h * v_g + R @ interval.J_pg - skew_w @ R_g)[1]
        p_a_end = total(self.p_a, h * v_a + R @ interval.J_pa)[1]
        return Chain(R_end, v_end, p_end, R_g_end, v_g_end, p_g_end, v_a_end, p_a_end)


def chain_noise(C: Array, time: Array, chain: Chain, interval: Intervals, size: int,
                excess: float = 1.0, rate_random_walk: float = 0.0) -> Array:
    """
    Covariance that each interval's noise adds to the errors of the chain, as seen at t0.

    Parameters
    ----------
    C : ndarray, shape (3, 3)
        Initial attitude.
    time : ndarray, shape (K,)
        Seconds since t0, at the end of each interval.
    chain : Chain
        At the same K epochs.
    interval : Intervals
        The K intervals.
    size : int
        9 with the start position, 6 without.
    excess : float
        Share of the noise measured in excess of the stated one that is believed.
    rate_random_walk : float
        Of the gyros' biases, rad/s/sqrt(s); 0: they stay what they are.

    Returns
    -------
    ndarray, shape (K, n, n)
        n is `size`, or 3 more for the biases where they walk.

    """
    turn = (C @ chain.R) @ interval.R.transpose(0, 2, 1)       # from the interval's start to n0
    spread = np.zeros((time.size, size, size))
    arm = skew(apply(C, chain.v))
    spread[:, :3, :3] = spread[:, 3:6, 3:6] = turn
    spread[:, 3:6, :3] = arm @ turn
    if size == 9:
        t = time[:, None, None]
        spread[:, 6:, :3] = (skew(apply(C, chain.p)) - t * arm) @ turn
        spread[:, 6:, 3:6] = -t * turn
        spread[:, 6:, 6:] = turn
    Q = interval.Q[:, :size, :size] + excess * interval.Q_excess[:, :size, :size]
    noise = spread @ Q @ spread.transpose(0, 2, 1)
    if rate_random_walk == 0.0:
        return noise
    step = np.concatenate([-bias_seen_at_start(C, time, chain, size),
                           np.broadcast_to(np.eye(3), (time.size, 3, 3))], axis=1)
    step *= rate_random_walk * np.sqrt(interval.duration)[:, None, None]
    walk = step @ step.transpose(0, 2, 1)
    walk[:, :size, :size] += noise
    return walk


def bias_seen_at_start(C: Array, time: Array, chain: Chain, size: int) -> Array:
    """
    Return what a gyro bias does to the chain up to each of K epochs, as seen at t0.

    Parameters
    ----------
    C, time, chain, size
        As for `chain_noise`.

    Returns
    -------
    ndarray, shape (K, size, 3)

    """
    R_g = C @ chain.R_g[:, :, :3]
    v = C @ chain.v_g[:, :, :3] + skew(apply(C, chain.v)) @ R_g
    if size == 6:
        return np.concatenate([R_g, v], axis=1)
    p = C @ chain.p_g[:, :, :3] + skew(apply(C, chain.p)) @ R_g - time[:, None, None] * v
    return np.concatenate([R_g, v, p], axis=1)


def sensitivities(point: Unknowns, chain: Chain, gnss: Measurements, interval: Intervals,
                  kinds: int = 2) -> Array:
    """
    Residuals of K epochs and their derivatives, at a linearisation point.

    Parameters
    ----------
    point : Unknowns
        Where to linearise.
    chain : Chain
        K epochs of it.
    gnss : Measurements
        The same K epochs.
    interval : Intervals
        Those that end at the epochs, corrected for the sensors' errors of the point.
    kinds : int
        2: of velocities and positions; 1: of velocities alone.

    Returns
    -------
    ndarray, shape (K, kinds, 3, 38)
        The residual ``s - model`` in the first column, then the derivative of the model to each
        unknown.

    """
    K = gnss.time.size
    C, lever = point.C, point.lever_b
    # On the way to the solution the delay may be absurd: from there on the model goes straight.
    delay = min(max(float(point.delay), MIN_DELAY), MAX_DELAY)
    beyond = point.delay - delay
    CR = C @ chain.R
    moved_v = apply(C, chain.v)                                     # in n0
    # What the receiver saw happened a delay before: there the motion before the epoch leads back.
    sensors = point.sensors
    _, measured_v, measured_p = exact(interval.gained, delay)
    measured_rate, measured_turn, _ = exact(interval.turned, delay)
    rate, turn = sensors.rate(measured_rate), sensors.rate(measured_turn, delay)
    rate += 0.5 * cross(turn, rate)
    # A lever arm swings with the vibration too.
    vibration = interval.omega - exact(interval.turned, 0.0)[0]
    omega = rate + sensors.rate(vibration, 0.0)
    CR_seen = CR @ exp_so3(-turn)
    swung = apply(CR_seen, cross(omega, lever))
    seen_v = moved_v - apply(CR, sensors.force(measured_v, delay)) + swung
    start_velocity = point.start_velocity + gnss.offset                 # over ground
    Y = np.zeros((K, kinds, 3, 1 + SIZE))
    H = Y[..., 1:]
    eye = np.eye(3)
    C_R_g, C_v_g, C_v_a = C @ chain.R_g, C @ chain.v_g, C @ chain.v_a
    # What is told in the body frame of now turns with the gyros' errors since t0. And they are in
    # the rates with which the lever arm swings, and turned since.
    arm, turned_arm = CR_seen @ skew(lever), CR_seen @ skew(cross(omega, lever))
    # Vibration is no use in a derivative. The rate changes with time as it does not with age.
    force = sensors.force(smooth(interval.gained, delay)[0])
    rate_change = sensors.rate(smooth(interval.turned, delay)[1], 0.0)
    whirled = cross(rate, cross(omega, lever)) - cross(rate_change, lever)

    Y[:, 0, :, 0] = (gnss.s[:, VELOCITY] - point.start_velocity - seen_v + delay * gnss.gravity)
    v = H[:, 0]
    v[:, :, ATTITUDE] = -skew(seen_v)
    v[:, :, GYRO] = C_v_g - skew(seen_v - moved_v) @ C_R_g
    v[:, :, GYRO_BIAS] += arm - delay * turned_arm
    v[:, :, GYRO_MATRIX] += (by_row(arm, measured_rate + vibration)
                             - by_row(turned_arm, measured_turn))
    v[:, :, ACCEL] = C_v_a
    v[:, :, ACCEL_BIAS] += delay * CR
    v[:, :, ACCEL_MATRIX] += by_row(CR, measured_v)
    v[:, :, START_VELOCITY] = eye
    v[:, :, LEVER_ARM] = CR_seen @ skew(omega)
    v[:, :, DELAY.start] = -(apply(CR, force) + apply(CR_seen, whirled) + gnss.gravity)

    if kinds == 2:
        moved_p = apply(C, chain.p)
        gained_p = sensors.force(measured_p, delay ** 2 / 2)
        seen_p = moved_p - delay * moved_v + apply(CR, gained_p) + CR_seen @ lever
        Y[:, 1, :, 0] = (gnss.s[:, POSITION] - point.start_position
                         - gnss.time[:, None] * point.start_velocity - seen_p
                         + delay * (start_velocity - delay / 2 * gnss.gravity))
        p = H[:, 1]
        p[:, :, ATTITUDE] = -skew(seen_p)
        p[:, :, GYRO] = (C @ chain.p_g - delay * C_v_g
                         - skew(seen_p - moved_p + delay * moved_v) @ C_R_g)
        p[:, :, GYRO_BIAS] -= delay * arm
        p[:, :, GYRO_MATRIX] -= by_row(arm, measured_turn)
        p[:, :, ACCEL] = C @ chain.p_a - delay * C_v_a
        p[:, :, ACCEL_BIAS] -= delay ** 2 / 2 * CR
        p[:, :, ACCEL_MATRIX] -= by_row(CR, measured_p)
        p[:, :, START_VELOCITY] = (gnss.time - delay)[:, None, None] * eye
        p[:, :, START_POSITION] = eye
        p[:, :, LEVER_ARM] = CR_seen
        p[:, :, DELAY.start] = -(start_velocity + seen_v - delay * gnss.gravity)
    Y[..., 0] -= beyond * H[..., DELAY.start]
    return Y


@dataclass
class Rows:
    """What a linearisation point makes of K stored epochs, of 1 or 2 kinds of measurement."""

    chain: Chain
    noise: Array            # of the chain over each interval, (K, size, size)
    Y: Array                # residual and columns of the unknowns, (K, kinds, 3, 1 + n)
    covariance: Array       # of velocity and position, (K, kinds, 3, 3)
    time: Array             # seconds since t0, (K,)

    def take(self, index: slice) -> 'Rows':
        """Return those of some epochs."""
        return Rows(self.chain.at(index), self.noise[index], self.Y[index],
                    self.covariance[index], self.time[index])


@dataclass
class Gate:
    """
    Present estimates, for the innovations to be tested against: leading axes as these have.

    Attributes
    ----------
    dx : ndarray, shape (..., n)
        Step from the linearisation point.
    P : ndarray, shape (..., n, n)
        Its covariance.

    """

    dx: Array
    P: Array

    def test(self, innovation: Array, S: Array) -> tuple[Array, Array]:
        """
        Return normalised innovations squared and, row by row, the innovations over their sigma.

        Parameters
        ----------
        innovation : ndarray, shape (..., 3, 1 + n)
            From `Whitened`.
        S : ndarray, shape (..., 3, 3)
            Its covariance for known unknowns.

        Returns
        -------
        nis : ndarray, shape (...)
        normalised : ndarray, shape (..., 3)

        """
        columns = innovation[..., 1:]
        residual = innovation[..., 0] - apply(columns, self.dx)
        spread = columns @ self.P @ columns.swapaxes(-1, -2)
        # A large error of heading shows along the motion too, not only across.
        free = np.asarray(self.P[..., 2, 2] > HEADING_RESOLVED_STD ** 2)
        if free.any():
            level = spread[..., 0, 0] + spread[..., 1, 1]
            spread[..., :2, :2] = np.where(free[..., None, None], level[..., None, None]
                                           * np.eye(2), spread[..., :2, :2])
        spread += S
        weighted = np.linalg.solve(spread, residual[..., None])[..., 0]
        return (np.sum(residual * weighted, axis=-1),
                residual / np.sqrt(np.diagonal(spread, axis1=-2, axis2=-1)))


@dataclass
class Whitened:
    """
    The state of a `Whitener` after each of K epochs, and what it saw.

    Attributes
    ----------
    P, X, normal, rows, spurious, log_det : ndarray
        As in `Whitener`, with a leading axis of K, or of 1 for the last epoch alone.
    used : ndarray of bool, shape (K, kinds)
        Which measurements were taken.
    innovation : ndarray, shape (K, kinds, 3, 1 + n)
        Residual and columns, freed of what the errors of the chain are known to be; zero where
        nothing was taken.
    S : ndarray, shape (K, kinds, 3, 3)
        Their covariance; the unit matrix where nothing was taken.

    """

    P: Array
    X: Array
    normal: Array
    rows: Index
    spurious: Array
    log_det: Array
    used: np.ndarray
    innovation: Array
    S: Array


class Whitener:
    """
    The small Kalman filter over the chain's errors, and the normal equations that it feeds.

    Parameters
    ----------
    columns : ndarray of int, shape (n,)
        Unknowns that are estimated, out of the 37.
    size : int
        9 when positions are used, 6 when velocities alone are.
    walks : bool
        Whether the gyros' biases walk, which are three more errors then.

    Attributes
    ----------
    P : ndarray, shape (m, m)
        Covariance of the chain's errors for known unknowns.
    X : ndarray, shape (m, 1 + n)
        What they are known to be: a constant and its derivatives to the unknowns.
    normal : ndarray, shape (1 + n, 1 + n)
        Sum of the whitened rows' squares and products, the residual's first.
    rows : int
        So many.
    spurious : float
        Information on the heading that the noise of the IMU feigns.
    log_det : float
        Of the covariance of all innovations.

    """

    def __init__(self, columns: Index, size: int, walks: bool = False) -> None:
        """Start at t0, where the chain has no error."""
        self.columns = np.concatenate([[0], 1 + columns])
        # The unknowns whose derivatives are those to the errors of the chain.
        alike = np.concatenate([START[:size], np.r_[GYRO_BIAS]]) if walks else START[:size]
        self._alike_columns = 1 + np.searchsorted(columns, alike)
        self.P = np.zeros((alike.size, alike.size))
        self.X = np.zeros((alike.size, self.columns.size))
        self.normal = np.zeros((self.columns.size, self.columns.size))
        self.rows = 0
        self.spurious = 0.0
        self.log_det = 0.0

    def move_to(self, whitened: Whitened, k: int) -> None:
        """Go to the state after one of the epochs."""
        self.P, self.X, self.normal = whitened.P[k], whitened.X[k], whitened.normal[k]
        self.rows = int(whitened.rows[k])
        self.spurious, self.log_det = float(whitened.spurious[k]), float(whitened.log_det[k])

    def whitened(self, rows: Rows, wanted: np.ndarray, gate: Gate | None = None,
                 gate_scale: float = 1.0) -> Whitened:
        """
        Filter K epochs that follow the present one; the whitener itself stays where it is.

        Parameters
        ----------
        rows : Rows
            Of these epochs.
        wanted : ndarray of bool, shape (K, kinds)
            The measurements to take.
        gate : Gate, optional
            One for all: a measurement that it does not let through is not taken.
        gate_scale : float
            Factor on the gate.

        """
        Y, covariance = rows.Y, rows.covariance
        K, kinds = wanted.shape
        D = Y[..., self._alike_columns]
        D_T = D.swapaxes(-1, -2)
        used = wanted.copy()
        P, X = self.P, self.X
        P_after, X_after = np.empty((K,) + P.shape), np.empty((K,) + X.shape)
        innovation = np.zeros(Y.shape)
        own = np.zeros((K, kinds, 3, 3))
        S_of = np.zeros((K, kinds, 3, 3)) + np.eye(3)
        inverse_of = np.zeros((K, kinds, 3, 3))
        determinant_of = np.ones((K, kinds))
        for k, present in enumerate(wanted.tolist()):
            P = P + rows.noise[k]
            for kind in range(kinds):
                if not present[kind]:
                    continue
                d = D[k, kind]
                PD = P @ D_T[k, kind]
                seen = d @ PD
                S = seen + covariance[k, kind]
                new = Y[k, kind] - d @ X
                if gate is not None and not gate.test(new, S)[0] < GATE * gate_scale:
                    used[k, kind] = False
                    continue
                inverse, determinant_of[k, kind] = _inverse3(S)
                gain = PD @ inverse
                X = X + gain @ new
                P = P - gain @ PD.T
                P = 0.5 * (P + P.T)              # or rounding grows in the antisymmetric part
                innovation[k, kind], S_of[k, kind] = new, S
                own[k, kind], inverse_of[k, kind] = seen, inverse
            P_after[k], X_after[k] = P, X
        squares = innovation.swapaxes(-1, -2) @ (inverse_of @ innovation)
        feigned = _feigned(inverse_of, own)

        def total(start: float, steps: Array) -> Array:
            return running_sum(np.array(start), np.sum(steps, axis=1))

        return Whitened(P_after, X_after, running_sum(self.normal, np.sum(squares, axis=1)),
                        self.rows + np.cumsum(3 * np.count_nonzero(used, axis=1)),
                        total(self.spurious, feigned),
                        total(self.log_det, np.log(determinant_of)), used, innovation, S_of)

    def whitened_at_once(self, rows: Rows, wanted: np.ndarray) -> Whitened:
        """
        Filter epochs like `whitened`, several times faster, for the state after the last.

        The errors of the chain are a random walk: the covariance of the measurements of a block
        of epochs can be written down. Its Cholesky factor makes of them, row after row, the same
        innovations as a filter does.
        """
        K, kinds = wanted.shape
        there = wanted[:, :, None, None]
        covariance = np.where(there, rows.covariance, np.eye(3))
        Y = np.where(there, rows.Y, 0.0).reshape(K, 3 * kinds, -1)
        D_of = Y[..., self._alike_columns]
        P, X, normal = self.P, self.X, self.normal
        white = np.empty(Y.shape)
        roots = np.empty((K, kinds, 3, 3))
        for start in range(0, K, BLOCK):
            block = slice(start, min(start + BLOCK, K))
            count = block.stop - start
            walked = P + np.cumsum(rows.noise[block], axis=0)
            PD = (D_of[block] @ walked).reshape(-1, len(P))
            D = D_of[block].reshape(PD.shape)
            S = D @ PD.T                            # of which the lower triangle holds
            one = np.arange(count)[:, None], np.arange(kinds), slice(None)
            shape, own = 2 * (count, kinds, 3), 2 * one
            S.reshape(shape)[own] += covariance[block]
            try:
                root = np.linalg.cholesky(S)
            except np.linalg.LinAlgError:           # rounding, or numbers that are none
                return self.whitened(rows, wanted)
            new = Y[block].reshape(len(D), -1) - D @ X
            both = np.linalg.solve(root, np.hstack([new, PD]))
            new, PD = both[:, :-len(P)], both[:, -len(P):]
            X = X + PD.T @ new
            P = walked[-1] - PD.T @ PD
            P = 0.5 * (P + P.T)
            normal = normal + new.T @ new
            white[block] = new.reshape(count, 3 * kinds, -1)
            roots[block] = root.reshape(shape)[own]
        S_of = roots @ roots.swapaxes(-1, -2)
        feigned = _feigned(inverse_spd(S_of), S_of - covariance)
        log_det = 2.0 * np.sum(np.log(np.diagonal(roots, axis1=-2, axis2=-1)))
        return Whitened(P[None], X[None], normal[None],
                        np.array([self.rows + 3 * np.count_nonzero(wanted)]),
                        np.array([self.spurious + np.sum(feigned)]),
                        np.array([self.log_det + log_det]), wanted,
                        roots @ white.reshape(rows.Y.shape), S_of)


def _feigned(inverse: Array, own: Array) -> Array:
    """
    Information on the heading that the noise of the IMU feigns, shape (K, kinds).

    The heading's column is made of integrated IMU data, whose own errors look like motion: this is
    the information that they would feign, in expectation (errors in variables).

    Parameters
    ----------
    inverse : ndarray, shape (K, kinds, 3, 3)
        Of the covariance of each innovation.
    own : ndarray, shape (K, kinds, 3, 3)
        The part of that covariance which the errors of the chain make.

    """
    return np.sum(inverse[..., :2, :] * own[..., :2, :], axis=(-2, -1))


def _inverse3(matrix: Array) -> tuple[Array, float]:
    """Inverse and determinant of a symmetric positive definite matrix, shape (3, 3)."""
    (a, b, c), (_, d, e), (_, _, f) = matrix.tolist()
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * aa + b * bb + c * cc
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    return np.array([[aa, bb, cc], [bb, dd, ee], [cc, ee, ff]]) / determinant, determinant
