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
The estimator at the Cramer-Rao bound: recursive generalised least squares, ``method: map``.

The unknowns x are the initial attitude and whatever makes the integration formulas miss: sensor
biases, the start, the lever arm, the GNSS delay. The random-walk errors of the integrated IMU data
are a Markov process; a small Kalman filter over them whitens the residuals and every column of
their sensitivity to x at once, and the normal equations accumulate (docs, "Theory").

Layout of the errors of the chain: ``epsilon = (rotation in b0, velocity, position)``; measurement
rows: velocity first, then position; both in n0.
"""

from collections import deque
from dataclasses import dataclass, replace
import math
from typing import Any

from ins_align.formula import attitude_from_moments
from ins_align.preintegration import Intervals
from ins_align.rotation import Array, cross, cumulative_rotations, exp_so3, log_so3, skew
import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.integer[Any]]

# A heading is never known worse than uniform on the circle.
UNIFORM_ANGLE_STD = math.pi / math.sqrt(3)
# Below this heading sigma (rad) the problem is as good as linear in the heading.
HEADING_RESOLVED_STD = 0.35
MEDIAN_CHI2_3 = 2.366
# Chi-square gate of three rows of innovation: one in 60 000 of good ones fails.
GATE = 25.0
VELOCITY, POSITION = slice(0, 3), slice(3, 6)


@dataclass(frozen=True)
class Unknowns:
    """
    The unknowns, or a point to linearise at.

    Attributes
    ----------
    C : ndarray, shape (3, 3)
        Initial attitude ``C_nb(0)``.
    gyro_bias, accel_bias : ndarray, shape (3,)
        rad/s, m/s^2; measured minus true.
    start_velocity, start_position : ndarray, shape (3,)
        Of the IMU at t0 in n0, relative to the antenna's track (c_v, c_p of method.md).
    lever_b : ndarray, shape (3,)
        Metres.
    delay : float
        Seconds by which a GNSS measurement is older than its stamp.

    """

    C: Array
    gyro_bias: Array
    accel_bias: Array
    start_velocity: Array
    start_position: Array
    lever_b: Array
    delay: float

    def vector(self) -> Array:
        """All but the attitude, which has three zeros, shape (19,)."""
        return np.concatenate([np.zeros(3), self.gyro_bias, self.accel_bias, self.start_velocity,
                               self.start_position, self.lever_b, [self.delay]])

    def moved(self, dx: Array) -> 'Unknowns':
        """Return the point moved by `dx`, shape (19,)."""
        return Unknowns(exp_so3(dx[:3]) @ self.C, self.gyro_bias + dx[3:6],
                        self.accel_bias + dx[6:9], self.start_velocity + dx[9:12],
                        self.start_position + dx[12:15], self.lever_b + dx[15:18],
                        float(self.delay + dx[18]))

    def minus(self, other: 'Unknowns') -> Array:
        """Return the step from `other` to this point, shape (19,)."""
        step = self.vector() - other.vector()
        step[:3] = log_so3(self.C @ other.C.T)
        return step


# Places of the blocks in the full vector of unknowns.
ATTITUDE, GYRO_BIAS, ACCEL_BIAS = slice(0, 3), slice(3, 6), slice(6, 9)
START_VELOCITY, START_POSITION = slice(9, 12), slice(12, 15)
LEVER_ARM, DELAY = slice(15, 18), slice(18, 19)
SIZE = 19
# Unknowns that outlive a new t0 and do not depend on the heading.
BODY_FIXED = np.r_[GYRO_BIAS, ACCEL_BIAS, LEVER_ARM, DELAY]


@dataclass(frozen=True)
class Prior:
    """
    What is known of x before the data: a mean and an information matrix over all 19 unknowns.

    With `heading_free` the heading of the mean is arbitrary and carries no information.
    """

    mean: Unknowns
    information: Array
    heading_free: bool

    def at(self, point: Unknowns) -> tuple[Array, Array]:
        """Return the information about the step from `point`, and the mean of that step."""
        mean, information = self.mean, self.information
        if self.heading_free:
            turn = point.C @ mean.C.T
            psi = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
            Rz = exp_so3([0.0, 0.0, psi])
            mean = replace(mean, C=Rz @ mean.C)
            information = information.copy()
            information[:3] = Rz @ information[:3]
            information[:, :3] = information[:, :3] @ Rz.T
        return information, mean.minus(point)


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

    def put(self, index: int, other: 'Measurements') -> None:
        """Copy the single epoch of `other` into place `index`."""
        for name, array in vars(self).items():
            array[index] = getattr(other, name)[0]


@dataclass
class Chain:
    """The integrated IMU data up to an epoch, and their derivatives to the biases."""

    R: Array                # C_b0b
    v: Array                # int C_b0b f
    p: Array                # int int C_b0b f
    R_g: Array              # left error of R to the gyro bias
    v_g: Array
    v_a: Array
    p_g: Array
    p_a: Array

    @staticmethod
    def start() -> 'Chain':
        """Return the chain at t0."""
        zero = np.zeros((3, 3))
        return Chain(np.eye(3), np.zeros(3), np.zeros(3), zero, zero, zero, zero, zero)

    def at(self, index: int) -> 'Chain':
        """Return one epoch of a chain over many."""
        return Chain(*(array[index] for array in vars(self).values()))

    def extended(self, interval: Intervals,
                 excess: float = 1.0) -> tuple['Chain', Array, Array]:
        """
        Chain K intervals.

        Parameters
        ----------
        interval : Intervals
        excess : float
            Share of the noise measured in excess of the stated one that is believed.

        Returns
        -------
        chain : Chain
            With a leading axis of K, at the end of each interval.
        F : ndarray, shape (K, 9, 9)
            Transition of the chain's errors over each interval.
        W : ndarray, shape (K, 9, 9)
            What the interval's noise adds to their covariance.

        """
        K = interval.duration.size
        R_end = self.R @ cumulative_rotations(interval.R)
        R = np.concatenate([self.R[None], R_end[:-1]])
        h = interval.duration[:, None, None]
        u = (R @ interval.v[..., None])[..., 0]
        w = (R @ interval.p[..., None])[..., 0]
        skew_u, skew_w = skew(u), skew(w)

        def total(start: Array, steps: Array) -> tuple[Array, Array]:
            """Values before and after each interval."""
            after = start + np.cumsum(steps, axis=0)
            return after - steps, after

        RJ = R @ interval.J_Rg
        R_g, R_g_end = total(self.R_g, RJ)
        v_g, v_g_end = total(self.v_g, R @ interval.J_vg - skew_u @ R_g)
        v_a, v_a_end = total(self.v_a, RJ)
        v, v_end = total(self.v, u)
        p_end = total(self.p, w + interval.duration[:, None] * v)[1]
        p_g_end = total(self.p_g, h * v_g + R @ interval.J_pg - skew_w @ R_g)[1]
        p_a_end = total(self.p_a, h * v_a + R @ interval.J_pa)[1]

        F = np.zeros((K, 9, 9))
        F[:, range(9), range(9)] = 1.0
        F[:, 3:6, :3] = -skew_u
        F[:, 6:, :3] = -skew_w
        F[:, 6:, 3:6] = h * np.eye(3)
        turn = np.zeros((K, 9, 9))
        turn[:, :3, :3] = turn[:, 3:6, 3:6] = turn[:, 6:, 6:] = R
        W = turn @ (interval.Q + excess * interval.Q_excess) @ turn.transpose(0, 2, 1)
        return Chain(R_end, v_end, p_end, R_g_end, v_g_end, v_a_end, p_g_end, p_a_end), F, W


def sensitivities(point: Unknowns, chain: Chain, gnss: Measurements, omega: Array,
                  f: Array) -> tuple[Array, Array]:
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
    omega, f : ndarray, shape (K, 3)
        Angular rate and specific force at the epochs, bias-corrected.

    Returns
    -------
    Y : ndarray, shape (K, 6, 20)
        The residual ``s - model`` in the first column, then the derivative of the model to each
        unknown.
    L : ndarray, shape (K, 6, 9)
        Derivative of the model to the chain's errors.

    """
    K = gnss.time.size
    C, lever = point.C, point.lever_b
    CR = C @ chain.R
    spun = cross(omega, lever)
    lever_v = (CR @ spun[..., None])[..., 0]               # in n0
    lever_p = CR @ lever
    Ca_v = chain.v @ C.T + lever_v
    Ca_p = chain.p @ C.T + lever_p
    acceleration = (CR @ f[..., None])[..., 0] + gnss.gravity
    ground_velocity = point.start_velocity + Ca_v + gnss.offset
    Y = np.zeros((K, 6, 1 + SIZE))
    Y[:, VELOCITY, 0] = (gnss.s[:, VELOCITY] - point.start_velocity - Ca_v
                         + point.delay * acceleration)
    Y[:, POSITION, 0] = (gnss.s[:, POSITION] - point.start_position
                         - gnss.time[:, None] * point.start_velocity - Ca_p
                         + point.delay * (ground_velocity - 0.5 * point.delay * acceleration))
    H = Y[:, :, 1:]
    lever_v_skew, lever_p_skew = skew(lever_v), skew(lever_p)
    eye = np.eye(3)
    H[:, VELOCITY, ATTITUDE] = -skew(Ca_v)
    H[:, POSITION, ATTITUDE] = -skew(Ca_p)
    C_R_g = C @ chain.R_g
    H[:, VELOCITY, GYRO_BIAS] = C @ chain.v_g - lever_v_skew @ C_R_g + CR @ skew(lever)
    H[:, POSITION, GYRO_BIAS] = C @ chain.p_g - lever_p_skew @ C_R_g
    H[:, VELOCITY, ACCEL_BIAS] = C @ chain.v_a
    H[:, POSITION, ACCEL_BIAS] = C @ chain.p_a
    H[:, VELOCITY, START_VELOCITY] = eye
    H[:, POSITION, START_VELOCITY] = (gnss.time - point.delay)[:, None, None] * eye
    H[:, POSITION, START_POSITION] = eye
    H[:, VELOCITY, LEVER_ARM] = CR @ skew(omega)
    H[:, POSITION, LEVER_ARM] = CR
    H[:, VELOCITY, 18] = -acceleration
    H[:, POSITION, 18] = -(ground_velocity - point.delay * acceleration)
    L = np.zeros((K, 6, 9))
    L[:, VELOCITY, :3] = -lever_v_skew @ C
    L[:, POSITION, :3] = -lever_p_skew @ C
    L[:, VELOCITY, 3:6] = C
    L[:, POSITION, 6:] = C
    return Y, L


class Whitener:
    """
    The small Kalman filter over the chain's errors, and the normal equations that it feeds.

    Parameters
    ----------
    columns : ndarray of int
        Unknowns that are estimated, out of the 19.
    size : int
        9 when positions are used, 6 when velocities alone are.

    """

    def __init__(self, columns: Index, size: int) -> None:
        """Start at t0, where the chain has no error."""
        self._columns = np.concatenate([[0], 1 + columns])
        self._size = size
        self.P = np.zeros((size, size))
        self.X = np.zeros((size, self._columns.size))
        self.normal = np.zeros((self._columns.size, self._columns.size))
        self.rows = 0
        self.rejected = [0, 0]
        self.spurious = 0.0
        self.log_det = 0.0

    def predict(self, F: Array, W: Array) -> None:
        """Go over an interval with transition `F` and noise `W`, shape (9, 9)."""
        F = F[:self._size, :self._size]
        self.X = F @ self.X
        self.P = F @ self.P @ F.T + W[:self._size, :self._size]

    def update(self, kind: int, Y: Array, L: Array, covariance: Array,
               gate: 'tuple[Array, Array] | None', gate_scale: float) -> float:
        """
        Take the three rows of a velocity (kind 0) or position (kind 1).

        Parameters
        ----------
        kind : int
            0 or 1.
        Y, L : ndarray, shapes (3, 20), (3, 9)
            From `sensitivities`.
        covariance : ndarray, shape (3, 3)
            Of the measurement.
        gate : (dx, P) or None
            Step to the present estimate and its covariance; the innovation is tested against it.
        gate_scale : float
            Factor on the gate.

        Returns
        -------
        float
            Normalised innovation squared, nan where it was not tested.

        """
        L = L[:, :self._size]
        innovation = Y[:, self._columns] - L @ self.X
        PL = self.P @ L.T
        S = L @ PL + covariance
        nis = math.nan
        if gate is not None:
            residual = innovation[:, 0] - innovation[:, 1:] @ gate[0]
            spread = innovation[:, 1:] @ gate[1] @ innovation[:, 1:].T
            if gate[1][2, 2] > HEADING_RESOLVED_STD ** 2:
                # A large error of heading shows along the motion too, not only across.
                spread[:2, :2] = (spread[0, 0] + spread[1, 1]) * np.eye(2)
            spread += S
            nis = float(residual @ np.linalg.solve(spread, residual))
            if not nis < GATE * gate_scale:
                self.rejected[kind] += 1
                return nis
        weighted = np.linalg.solve(S, np.hstack([innovation, PL.T]))
        count = self._columns.size
        self.normal += innovation.T @ weighted[:, :count]
        # The heading's column is made of integrated IMU data, whose own errors look like motion:
        # this is the information that they would feign, in expectation (errors in variables).
        feigned = weighted[:, count:] @ L.T
        self.spurious += float(feigned[0, 0] + feigned[1, 1])
        self.X = self.X + PL @ weighted[:, :count]
        P = self.P - PL @ weighted[:, count:]
        self.P = 0.5 * (P + P.T)                  # or rounding grows in the antisymmetric part
        self.rows += 3
        self.log_det += float(np.linalg.slogdet(S)[1])
        return nis


@dataclass
class Solution:
    """
    The normal equations at one linearisation point, and what follows from them.

    Attributes
    ----------
    point : Unknowns
    chain : Chain
        At the last epoch, with the biases of `point`.
    whitener : Whitener
    dx : ndarray, shape (n,)
        Step from the point to the estimate, of the unknowns that are estimated.
    P : ndarray, shape (n, n)
        Covariance of the estimate.
    chi2 : float
        Sum of squares of the whitened residuals at the estimate, prior included.
    dof : int

    """

    point: Unknowns
    information: Array
    mean_step: Array
    chain: Chain
    whitener: Whitener
    dx: Array
    P: Array
    chi2: float = math.nan
    dof: int = 0


class MapEstimator:
    """
    Recursive generalised least squares for the initial attitude and the nuisances with it.

    Epochs and intervals are stored, so that the linearisation point can move; when the store is
    full, `handover` gives the prior with which the next estimator starts at the present epoch.

    Parameters
    ----------
    prior : Prior
    use_position : bool
        Whether position rows will come.
    estimate_lever_arm, estimate_delay : bool
        Otherwise they stay at the prior's mean.
    capacity : int
        Epochs that are stored.

    """

    # Epochs before the first linearisation: fewer leave the q-method no redundancy.
    FIRST_FIT = 4
    # A linearisation moves again when its second-order error exceeds this share of the sigma.
    NONLINEARITY = 0.1
    # It may move once the store has grown by this share, which bounds the mean cost per epoch.
    GROWTH = 0.125
    MAX_ITERATIONS = 4
    # The share of the excess noise is judged when the store has grown by this share, tried at
    # steps of this factor, and moved when the log likelihood gains this much.
    TUNE_FROM, TUNE_GROWTH, TUNE_STEP, TUNE_GAIN = 12, 0.5, 3.0, 1.0
    MIN_EXCESS, MAX_EXCESS = 0.01, 9.0
    # Innovations whose median scales the gate, so that noise beyond what is stated does not
    # turn the good epochs into outliers.
    GATE_WINDOW = 25

    def __init__(self, prior: Prior, *, use_position: bool = False,
                 estimate_lever_arm: bool = False, estimate_delay: bool = False,
                 capacity: int = 1000, excess: float = 1.0) -> None:
        """Start at t0."""
        wanted = np.ones(SIZE, bool)
        wanted[START_POSITION] = use_position
        wanted[LEVER_ARM] = estimate_lever_arm
        wanted[DELAY] = estimate_delay
        self._columns = np.flatnonzero(wanted)
        self._size = 9 if use_position else 6
        self._prior = prior
        self._capacity = capacity
        self._intervals = Intervals.empty(capacity)
        self._biases = np.zeros((capacity, 6))         # with which the intervals were integrated
        self._gnss = Measurements.empty(capacity)
        self.count = 0
        self.solution: Solution | None = None
        self._last_fit = self._last_tuned = 0
        self.fits = 0
        self.excess = excess
        self._recent: deque[float] = deque(maxlen=self.GATE_WINDOW)
        self._gate_scale = 1.0

    # Input

    def add(self, interval: Intervals, gyro_bias: Array, accel_bias: Array,
            gnss: Measurements) -> Array:
        """
        Append an epoch; the first one is t0 and its interval has no length.

        Parameters
        ----------
        interval : Intervals
            One interval, up to the epoch.
        gyro_bias, accel_bias : ndarray, shape (3,)
            With which it was integrated.
        gnss : Measurements
            One epoch.

        Returns
        -------
        ndarray, shape (2,)
            Normalised innovation squared of velocity and position; nan where there was none.

        Raises
        ------
        RuntimeError
            When the store is full.

        """
        if self.full:
            raise RuntimeError('the store is full: hand over to a new estimator')
        k = self.count
        self._intervals.put(k, interval, 0)
        self._biases[k, :3], self._biases[k, 3:] = gyro_bias, accel_bias
        self._gnss.put(k, gnss)
        self.count += 1
        if self.solution is None:
            nis = np.full(2, math.nan)
            if self._prior.information[0, 0] > 0:
                self._fit()
            elif self.count >= self.FIRST_FIT:
                self._fit()
            return nis
        s = self.solution
        nis = self._extend(s, slice(k, k + 1), (s.dx, s.P))
        self._recent.extend(nis[np.isfinite(nis)])
        if len(self._recent) == self.GATE_WINDOW:
            self._gate_scale = max(1.0, float(np.median(self._recent)) / MEDIAN_CHI2_3)
        self._solve(s)
        if self.count >= max(self.TUNE_FROM, self._last_tuned * (1 + self.TUNE_GROWTH)):
            self._tune()
        if (self.nonlinearity() > self.NONLINEARITY
                and self.count >= self._last_fit * (1 + self.GROWTH)):
            self._fit()
        return nis

    @property
    def full(self) -> bool:
        """Whether the store is full."""
        return self.count >= self._capacity

    def _extend(self, s: Solution, epochs: slice, gate: 'tuple[Array, Array] | None') -> Array:
        """Take stored epochs into a solution; return the last one's innovations squared."""
        gnss = self._gnss.take(epochs)
        biases = self._biases[epochs]
        interval = self._intervals.take(epochs).bias_corrected(
            s.point.gyro_bias - biases[:, :3], s.point.accel_bias - biases[:, 3:])
        chain, F, W = s.chain.extended(interval, self.excess)
        Y, L = sensitivities(s.point, chain, gnss, interval.omega, interval.f)
        nis = np.full(2, math.nan)
        for k in range(gnss.time.size):
            s.whitener.predict(F[k], W[k])
            for kind, rows in enumerate((VELOCITY, POSITION)):
                if gnss.present[k, kind]:
                    nis[kind] = s.whitener.update(kind, Y[k, rows], L[k, rows],
                                                  gnss.covariance[k, kind], gate,
                                                  self._gate_scale)
        s.chain = chain.at(-1)
        return nis

    # Solution

    def _solve(self, s: Solution) -> None:
        """Solve the normal equations and judge the fit."""
        information = s.information + s.whitener.normal[1:, 1:]
        right = s.whitener.normal[1:, 0] + s.information @ s.mean_step
        information[ATTITUDE, ATTITUDE] += np.eye(3) / UNIFORM_ANGLE_STD ** 2
        s.P = _inverse(information)
        s.dx = s.P @ right
        column = s.P[:, 2]
        feigned = min(s.whitener.spurious, 1 / column[2] - 1 / UNIFORM_ANGLE_STD ** 2)
        s.P = s.P + np.outer(column, column) * feigned / (1 - feigned * column[2])
        s.chi2 = float(s.whitener.normal[0, 0] + s.mean_step @ s.information @ s.mean_step
                       - right @ s.dx)
        s.dof = (s.whitener.rows - self._columns.size
                 + int(np.count_nonzero(np.diag(s.information))))

    def _start(self, point: Unknowns) -> Solution:
        """Return an empty solution at a linearisation point."""
        information, step = self._prior.at(point)
        n = self._columns.size
        return Solution(point, information[np.ix_(self._columns, self._columns)],
                        step[self._columns], Chain.start(),
                        Whitener(self._columns, self._size), np.zeros(n), np.zeros((n, n)))

    def _converge(self, point: Unknowns, P: 'Array | None') -> Solution:
        """Gauss-Newton over the store from a starting point."""
        for _ in range(self.MAX_ITERATIONS):
            s = self._start(point)
            self._extend(s, slice(0, self.count),
                         None if P is None else (np.zeros(self._columns.size), P))
            self._solve(s)
            self.fits += 1
            if self.nonlinearity(s) <= self.NONLINEARITY:
                break
            point = self.estimate(s)
        return s

    def _fit(self) -> None:
        """Move the linearisation point; while the heading is not resolved, try the q-method."""
        self._last_fit = self.count
        old = self.solution
        if old is None:
            starts = [self._prior.mean]
        else:
            starts = [self.estimate()]
        resolved = old is not None and self.heading_std < HEADING_RESOLVED_STD
        gate = old.P if old is not None and resolved else None
        if not resolved and self.count >= self.FIRST_FIT:
            rough = self._rough_attitude(starts[0])
            if old is None and not self._prior.information[0, 0] > 0:
                starts = []
            starts.append(replace(starts[0] if starts else self._prior.mean, C=rough))
        solutions = [self._converge(start, gate) for start in starts]
        self.solution = min(solutions, key=lambda s: s.chi2)

    def _tune(self) -> None:
        """
        Judge by the likelihood how much of the noise in excess counts.

        Vibration looks like white noise between samples and is less than that over seconds; and
        other errors grow with it. The overall scale is left to the a-posteriori factor.
        """
        self._last_tuned = self.count
        old = self.solution
        if old is None or not np.any(self._intervals.Q_excess[:self.count]):
            return
        excess, best, gain = self.excess, self._likelihood(old), self.TUNE_GAIN
        for trial in (excess / self.TUNE_STEP, excess * self.TUNE_STEP):
            if not self.MIN_EXCESS <= trial <= self.MAX_EXCESS:
                continue
            self.excess = trial
            solution = self._start(self.estimate(old))
            self._extend(solution, slice(0, self.count), None)
            self._solve(solution)
            likelihood = self._likelihood(solution)
            if likelihood > best + gain:
                excess, best, gain = trial, likelihood, 0.0
        self.excess = excess
        self._fit()

    @staticmethod
    def _likelihood(s: Solution) -> float:
        """Log likelihood at the best overall scale of all covariances, but for a constant."""
        scale = max(s.chi2 / s.dof, 1.0)
        return -0.5 * (s.whitener.log_det + s.dof * math.log(scale) + s.chi2 / scale)

    def _rough_attitude(self, point: Unknowns) -> Array:
        """Centred q-method over the store, with the biases and lever arm of `point`."""
        epochs = slice(0, self.count)
        biases = self._biases[epochs]
        interval = self._intervals.take(epochs).bias_corrected(
            point.gyro_bias - biases[:, :3], point.accel_bias - biases[:, 3:])
        chain = Chain.start().extended(interval)[0]
        gnss = self._gnss.take(epochs)
        moments = np.zeros((3, 3))
        total = 0.0
        for kind, rows in enumerate((VELOCITY, POSITION)):
            use = gnss.present[:, kind]
            if np.count_nonzero(use) < self.FIRST_FIT - 1 or (kind and total > 0):
                continue
            lever = cross(interval.omega, point.lever_b) if kind == 0 else point.lever_b
            integral = chain.v if kind == 0 else chain.p
            a = (integral + (chain.R @ np.broadcast_to(
                lever, integral.shape)[..., None])[..., 0])[use]
            both = np.hstack([gnss.s[use, rows], a])
            basis = np.vander(gnss.time[use], 1 + kind)
            both = both - basis @ np.linalg.lstsq(basis, both, rcond=None)[0]
            moments += both[:, :3].T @ both[:, 3:]
            total += float(np.sum(both * both))
        return attitude_from_moments(moments, total)[0]

    def nonlinearity(self, solution: 'Solution | None' = None) -> float:
        """Second-order error of the present linearisation, in sigmas of tilt or heading."""
        s = self.solution if solution is None else solution
        if s is None:
            return math.inf
        time = self._gnss.time[self.count - 1]
        tilt = math.hypot(s.dx[0], s.dx[1]) + time * float(np.linalg.norm(s.dx[GYRO_BIAS]))
        turn = abs(float(s.dx[2]))
        sigma = np.sqrt(np.diag(s.P)[:3])
        return max(tilt * (0.5 * tilt + turn) / float(min(sigma[:2])),
                   0.5 * turn * turn / float(sigma[2]))

    def settle(self) -> None:
        """Move the linearisation point now if it is worth it at all, growth or not."""
        if self.solution is not None and self.nonlinearity() > self.NONLINEARITY:
            self._fit()

    # Results

    def estimate(self, solution: 'Solution | None' = None) -> Unknowns:
        """Return the estimate, or that of another solution."""
        s = self.solution if solution is None else solution
        if s is None:
            return self._prior.mean
        dx = np.zeros(SIZE)
        dx[self._columns] = s.dx
        return s.point.moved(dx)

    @property
    def covariance(self) -> Array:
        """Covariance of the 19 unknowns; zero where one is not estimated, shape (19, 19)."""
        full = np.zeros((SIZE, SIZE))
        if self.solution is not None:
            full[np.ix_(self._columns, self._columns)] = self.solution.P
        return full

    @property
    def heading_std(self) -> float:
        """Stated sigma of the heading, rad."""
        return math.inf if self.solution is None else math.sqrt(self.solution.P[2, 2])

    def current(self) -> tuple[Array, Array]:
        """
        Return the attitude at the last epoch with respect to n0, ``C_n0b``, and its covariance.

        Returns
        -------
        C_n0b : ndarray, shape (3, 3)
        covariance : ndarray, shape (3, 3)
            Of the left error in n0, rad^2.

        Raises
        ------
        RuntimeError
            Before the first solution.

        """
        C, _, _, spread = self._now()
        return C, spread[:3, :3]

    def _now(self) -> tuple[Array, Array, Array, Array]:
        """
        Attitude, velocity and position of the IMU in n0 now, relative to the antenna's track.

        The last result is the joint covariance of (attitude, velocity, position, unknowns),
        shape (9 + n, 9 + n).
        """
        s = self.solution
        if s is None:
            raise RuntimeError('no solution yet')
        x = self.estimate()
        time = self._gnss.time[self.count - 1]
        n = self._columns.size
        error = np.zeros(9)
        error[:self._size] = s.whitener.X[:, 0] - s.whitener.X[:, 1:] @ s.dx
        # The stored chain holds the biases of the point; its errors were estimated with the
        # step of the biases as one of the unknowns, so that step is still to be applied.
        dx = np.zeros(SIZE)
        dx[self._columns] = s.dx
        bias = dx[GYRO_BIAS], dx[ACCEL_BIAS]
        error[:3] += s.chain.R_g @ bias[0]
        error[3:6] += s.chain.v_g @ bias[0] + s.chain.v_a @ bias[1]
        error[6:] += s.chain.p_g @ bias[0] + s.chain.p_a @ bias[1]
        C = x.C @ exp_so3(error[:3]) @ s.chain.R
        Cv, Cp = x.C @ (s.chain.v + error[3:6]), x.C @ (s.chain.p + error[6:])
        # d(state now) / d(unknowns), d(chain errors)
        J = np.zeros((9, SIZE))
        J[:3, ATTITUDE] = np.eye(3)
        J[:3, GYRO_BIAS] = x.C @ s.chain.R_g
        J[3:6, ATTITUDE] = -skew(Cv)
        J[3:6, GYRO_BIAS] = x.C @ s.chain.v_g
        J[3:6, ACCEL_BIAS] = x.C @ s.chain.v_a
        J[3:6, START_VELOCITY] = np.eye(3)
        J[6:, ATTITUDE] = -skew(Cp)
        J[6:, GYRO_BIAS] = x.C @ s.chain.p_g
        J[6:, ACCEL_BIAS] = x.C @ s.chain.p_a
        J[6:, START_VELOCITY] = time * np.eye(3)
        J[6:, START_POSITION] = np.eye(3)
        E = np.zeros((9, self._size))
        for block in range(self._size // 3):
            E[3 * block:3 * block + 3, 3 * block:3 * block + 3] = x.C
        total = np.vstack([J[:, self._columns] - E @ s.whitener.X[:, 1:], np.eye(n)])
        covariance = total @ s.P @ total.T
        covariance[:9, :9] += E @ s.whitener.P @ E.T
        return (C, x.start_velocity + Cv, x.start_position + time * x.start_velocity + Cp,
                covariance)

    def handover(self, C_n0n: Array, shift_v: Array, shift_p: Array, scale: float) -> Prior:
        """
        Return what is known now as the prior of an estimator whose t0 is the last epoch.

        While the heading is not resolved, the linear picture of how it hangs together with the
        rest is not good for long: then tilt, biases, lever arm and delay are kept, the heading
        and the start are not.

        Parameters
        ----------
        C_n0n : ndarray, shape (3, 3)
            How far the local level has turned since t0.
        shift_v, shift_p : ndarray, shape (3,)
            s_v and s_p of an antenna track that starts at the last epoch, minus those of this one,
            in n0 axes.
        scale : float
            Factor on the covariance, for data that fit worse than stated.

        """
        C, v, p, joint = self._now()
        x = self.estimate()
        T = np.eye(joint.shape[0])
        for block in range(3):
            T[3 * block:3 * block + 3, 3 * block:3 * block + 3] = C_n0n.T
        joint = scale * T @ joint @ T.T
        heading_free = not math.sqrt(joint[2, 2]) < HEADING_RESOLVED_STD
        # Places of what is kept in the joint covariance, and in the vector of unknowns.
        kept = np.flatnonzero(np.isin(self._columns, BODY_FIXED))
        if heading_free:
            places, unknowns = np.arange(2), np.arange(2)
        else:
            places = np.arange(self._size)
            unknowns = np.concatenate([places[:3], places[3:] + START_VELOCITY.start - 3])
        places = np.concatenate([places, 9 + kept])
        unknowns = np.concatenate([unknowns, self._columns[kept]])
        mean = Unknowns(C_n0n.T @ C, x.gyro_bias, x.accel_bias, C_n0n.T @ (v + shift_v),
                        C_n0n.T @ (p + shift_p), x.lever_b, x.delay)
        return _prior(mean, joint[np.ix_(places, places)], unknowns, heading_free)

    def prior_without_attitude(self) -> Prior:
        """Return what is known of biases, lever arm and delay as the prior of a fresh start."""
        if self.solution is None:
            return self._prior
        unknowns = self._columns[np.isin(self._columns, BODY_FIXED)]
        mean = replace(self.estimate(), C=np.eye(3), start_velocity=np.zeros(3),
                       start_position=np.zeros(3))
        return _prior(mean, self.covariance[np.ix_(unknowns, unknowns)], unknowns, False)


def _prior(mean: Unknowns, covariance: Array, unknowns: Index, heading_free: bool) -> Prior:
    """Prior from the covariance of some unknowns; nothing is known of the others."""
    information = np.zeros((SIZE, SIZE))
    information[np.ix_(unknowns, unknowns)] = _inverse(covariance)
    return Prior(mean, information, heading_free)


def _inverse(matrix: Array) -> Array:
    """Inverse of a symmetric positive definite matrix whose rows differ widely in scale."""
    scale = 1 / np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    return 0.5 * (inverse + inverse.T)


def first_prior(gyro_bias_std: float, accel_bias_std: float, lever_b: Array,
                lever_std: float, delay: float, delay_std: float) -> Prior:
    """
    Return the prior before any data: biases, lever arm and delay; nothing else.

    Parameters
    ----------
    gyro_bias_std, accel_bias_std : float
        rad/s, m/s^2, per axis.
    lever_b : array_like, shape (3,)
        Lever arm, metres.
    lever_std, delay, delay_std : float
        Metres per axis, seconds.

    """
    std = np.full(SIZE, math.inf)
    std[GYRO_BIAS], std[ACCEL_BIAS] = gyro_bias_std, accel_bias_std
    if lever_std > 0:
        std[LEVER_ARM] = lever_std
    if delay_std > 0:
        std[DELAY] = delay_std
    mean = Unknowns(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3),
                    np.asarray(lever_b, dtype=float), delay)
    return Prior(mean, np.diag(std ** -2.0), False)
