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
"""

from collections import deque
from dataclasses import dataclass, replace
import math

from ins_align.earth import EARTH_RATE
from ins_align.formula import attitude_from_moments
from ins_align.preintegration import Intervals
from ins_align.rotation import Array, cross, exp_so3, skew
from ins_align.unknowns import (ACCEL_BIAS, ATTITUDE, BODY_FIXED, DELAY, GYRO, GYRO_BIAS,
                                GYRO_SCALE, inverse_spd, LEVER_ARM, Prior, prior_of, SIZE,
                                START_POSITION, START_VELOCITY, UNIFORM_ANGLE_STD, Unknowns)
from ins_align.whitening import (Chain, HEADING_RESOLVED_STD, Measurements, POSITION,
                                 sensitivities, VELOCITY, Whitener)
import numpy as np

# What is always known: an angle lies on the circle, a velocity and a position are on the Earth.
WEAK_INFORMATION = np.zeros(SIZE)
WEAK_INFORMATION[ATTITUDE] = UNIFORM_ANGLE_STD ** -2
WEAK_INFORMATION[START_VELOCITY] = 1e4 ** -2
WEAK_INFORMATION[START_POSITION] = 1e7 ** -2
# The motion that the fit attributes to the vehicle has the noise of what was fitted to it, one
# unit of information for each: horizontal slope (tilt) and curvature (gyro bias) of the velocity.
FITTED_DIRECTIONS = 4
# Median of chi-square with three degrees of freedom.
MEDIAN_CHI2_3 = 2.366


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
    estimate_lever_arm, estimate_delay, estimate_gyro_scale : bool
        Otherwise they stay at the prior's mean.
    capacity : int
        Epochs that are stored.

    """

    # Epochs before the first linearisation: fewer leave the q-method no redundancy.
    FIRST_FIT = 4
    # A linearisation moves again when its second-order error exceeds this share of the sigma.
    NONLINEARITY = 0.1
    # It may move once the store has grown by this share, which bounds the mean cost per epoch; far
    # from the point, which does not last, sooner.
    GROWTH = 0.125
    FAR, GROWTH_FAR = 1.0, 0.015
    MAX_ITERATIONS = 8
    # The share of the excess noise is judged when the store has grown by this share, tried at
    # steps of this factor, and moved when the log likelihood gains this much.
    TUNE_FROM, TUNE_GROWTH, TUNE_STEP, TUNE_GAIN = 12, 0.5, 3.0, 1.0
    MIN_EXCESS, MAX_EXCESS = 0.01, 9.0
    MAX_REJECTED = 0.3
    # Ages (s) at which t0 moves on: when no heading is known to within this (rad), though the
    # velocity is (m/s); when neither is; when both are. The first two only once the gyros' biases
    # may have turned the heading by so much (rad): a good IMU finds north at rest.
    IDLE_TIME, IDLE_HEADING_STD, IDLE_VELOCITY_STD = 5.0, 1.2, 0.2
    MAX_IDLE_TIME, MAX_AGE = 60.0, 120.0
    IDLE_HEADING_LOSS = math.radians(0.4)
    # Innovations whose median scales the gate, so that noise beyond what is stated does not
    # turn the good epochs into outliers.
    GATE_WINDOW = 25

    def __init__(self, prior: Prior, *, use_position: bool = False,
                 estimate_lever_arm: bool = False, estimate_delay: bool = False,
                 estimate_gyro_scale: bool = False, capacity: int = 1000,
                 excess: float = 1.0) -> None:
        """Start at t0."""
        wanted = np.ones(SIZE, bool)
        wanted[START_POSITION] = use_position
        wanted[LEVER_ARM] = estimate_lever_arm
        wanted[DELAY] = estimate_delay
        wanted[GYRO_SCALE] = estimate_gyro_scale
        self._columns = np.flatnonzero(wanted)
        self._weak = WEAK_INFORMATION[self._columns]
        self._size = 9 if use_position else 6
        self._prior = prior
        self._capacity = capacity
        self._intervals = Intervals.empty(capacity)
        # With which the intervals were integrated: gyro bias, accelerometer bias, gyro scale.
        self._sensor_errors = np.zeros((capacity, 3, 3))
        self._gnss = Measurements.empty(capacity)
        self.count = 0
        self.solution: Solution | None = None
        self._last_fit = self._last_tuned = 0
        self._nonlinearity = 0.0
        self.excess = excess
        self._gated = True
        self._recent: deque[float] = deque(maxlen=self.GATE_WINDOW)
        self._gate_scale = 1.0

    # Input

    def add(self, interval: Intervals, sensor_errors: tuple[Array, Array, Array],
            gnss: Measurements) -> Array:
        """
        Append an epoch; the first one is t0 and its interval has no length.

        Parameters
        ----------
        interval : Intervals
            One interval, up to the epoch.
        sensor_errors : tuple of ndarray, shape (3,)
            Gyro bias, accelerometer bias and gyro scale factor with which it was integrated.
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
        self._sensor_errors[k] = sensor_errors
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
        # Far from the linearisation point an innovation says nothing about its measurement.
        nis = self._extend(s, slice(k, k + 1),
                           (s.dx, s.P) if self._nonlinearity <= self.FAR else None)
        self._recent.extend(nis[np.isfinite(nis)])
        if len(self._recent) == self.GATE_WINDOW:
            self._gate_scale = max(1.0, float(np.median(self._recent)) / MEDIAN_CHI2_3)
        self._solve(s)
        if self.count >= max(self.TUNE_FROM, self._last_tuned * (1 + self.TUNE_GROWTH)):
            self._tune()
        self._nonlinearity = self.nonlinearity()
        growth = self.GROWTH_FAR if self._nonlinearity > self.FAR else self.GROWTH
        if (self._nonlinearity > self.NONLINEARITY
                and self.count >= self._last_fit * (1 + growth)):
            self._fit()
        return nis

    @property
    def full(self) -> bool:
        """Whether the store is full."""
        return self.count >= self._capacity

    @property
    def stale(self) -> bool:
        """
        Whether a later t0 would serve better, though the store is not full.

        The heading at t0 gets lost with the vertical gyro's bias the longer the vehicle stands or
        flies straight after it. That it does shows when the velocity is known and the heading is
        not. A long chain of a poor IMU says little of its beginning in any case.
        """
        s = self.solution
        if s is None:
            return False
        age = self._gnss.time[self.count - 1]
        if s.P[2, 2] <= self.IDLE_HEADING_STD ** 2:
            return bool(age >= self.MAX_AGE)
        covariance = self.covariance
        bias_std = math.sqrt(np.max(np.diag(covariance)[GYRO_BIAS]))
        if age * bias_std < self.IDLE_HEADING_LOSS:
            return False
        start = np.diag(covariance)[START_VELOCITY]
        still = start[0] + start[1] < 2 * self.IDLE_VELOCITY_STD ** 2
        return bool(age >= (self.IDLE_TIME if still else self.MAX_IDLE_TIME))

    def _extend(self, s: Solution, epochs: slice, gate: 'tuple[Array, Array] | None') -> Array:
        """Take stored epochs into a solution; return the last one's innovations squared."""
        gnss = self._gnss.take(epochs)
        interval = self._corrected(epochs, s.point)
        chain, F, W = s.chain.extended(interval, self.excess)
        Y, L = sensitivities(s.point, chain, gnss, interval)
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

    def _corrected(self, epochs: slice, point: Unknowns) -> Intervals:
        """Return stored intervals as they would be with the sensor errors of a point."""
        used = self._sensor_errors[epochs]
        return self._intervals.take(epochs).corrected(
            point.gyro_bias - used[:, 0], point.accel_bias - used[:, 1],
            point.gyro_scale - used[:, 2])

    # Solution

    def _solve(self, s: Solution) -> None:
        """Solve the normal equations and judge the fit."""
        information = s.information + s.whitener.normal[1:, 1:]
        right = s.whitener.normal[1:, 0] + s.information @ s.mean_step
        information[range(self._columns.size), range(self._columns.size)] += self._weak
        s.P = inverse_spd(information)
        s.dx = s.P @ right
        column = s.P[:, 2]
        feigned = min(s.whitener.spurious + FITTED_DIRECTIONS,
                      1 / column[2] - 1 / UNIFORM_ANGLE_STD ** 2)
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
            if sum(s.whitener.rejected) > self.MAX_REJECTED * self.count:
                # Not a few outliers but a wrong picture: look at everything again.
                s, P = self._start(point), None
                self._extend(s, slice(0, self.count), None)
            self._solve(s)
            if self.nonlinearity(s) <= self.NONLINEARITY:
                break
            point = self.estimate(s)
        return s

    def _fit(self) -> None:
        """Move the linearisation point; while the heading is not resolved, try the q-method."""
        self._last_fit = self.count
        old = self.solution
        resolved = old is not None and self.heading_std < HEADING_RESOLVED_STD
        gate = old.P if old is not None and resolved and self._gated else None
        here = self.estimate()
        known = old is not None or self._prior.information[0, 0] > 0
        starts = [here] if known else []
        if not resolved and self.count >= self.FIRST_FIT:
            starts.append(replace(here, C=self._rough_attitude(here)))
        solutions = [self._converge(start, gate) for start in starts]
        self.solution = min(solutions, key=lambda s: s.chi2)
        self._nonlinearity = self.nonlinearity()

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
        scale = max(s.chi2 / max(s.dof, 1), 1.0)
        return -0.5 * (s.whitener.log_det + s.dof * math.log(scale) + s.chi2 / scale)

    def _rough_attitude(self, point: Unknowns) -> Array:
        """Centred q-method over the store, with the biases and lever arm of `point`."""
        epochs = slice(0, self.count)
        interval = self._corrected(epochs, point)
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
        """Move the linearisation point now if that is worth it at all, growth or hardly."""
        if (self._nonlinearity > self.NONLINEARITY
                and self.count > self._last_fit * (1 + self.GROWTH_FAR)):
            self._fit()

    def sign_evidence(self) -> dict[tuple[int, int], float]:
        """
        Fit the stored epochs afresh with the signs of gyros and accelerometers as they are or not.

        A wrong sign, or one wrong axis (which is all three wrong in a body frame turned half
        around), fits as well as the right ones until the vehicle has turned.

        Returns
        -------
        dict
            Chi-square by (sign of the gyros, sign of the accelerometers), in units of what is
            usual for (1, 1).

        """
        epochs = slice(0, self.count)
        nothing = replace(self._prior.mean, gyro_bias=np.zeros(3), accel_bias=np.zeros(3),
                          gyro_scale=np.zeros(3))
        raw = self._corrected(epochs, nothing)
        gnss = self._gnss.take(epochs)
        chi2 = {}
        scale = 1.0
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            trial = MapEstimator(self._prior.mirrored(*signs), use_position=self._size == 9,
                                 estimate_lever_arm=LEVER_ARM.start in self._columns,
                                 estimate_delay=DELAY.start in self._columns,
                                 estimate_gyro_scale=GYRO_SCALE.start in self._columns,
                                 capacity=gnss.time.size, excess=self.excess)
            trial._intervals, trial._gnss = raw.mirrored(*signs), gnss
            trial.count = gnss.time.size
            trial._gated = False           # or the wrong signs throw out what speaks against them
            trial._fit()
            trial._fit()
            assert trial.solution is not None
            if signs == (1, 1):
                scale = max(1.0, trial.solution.chi2 / max(trial.solution.dof, 1))
            chi2[signs] = trial.solution.chi2 / scale
        return chi2

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
        """Covariance of the 22 unknowns; zero where one is not estimated, shape (22, 22)."""
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

    def _now(self, heading_free: bool = False) -> tuple[Array, Array, Array, Array]:
        """
        Attitude, velocity and position of the IMU in n0 now, relative to the antenna's track.

        The last result is the joint covariance of (attitude, velocity, position, unknowns),
        shape (9 + n, 9 + n). It belongs to the heading of the linearisation point; with
        `heading_free` the attitude is told with that heading too, since any is as good.
        """
        s = self.solution
        if s is None:
            raise RuntimeError('no solution yet')
        x = self.estimate()
        if heading_free:
            x = replace(x, C=exp_so3([0.0, 0.0, -s.dx[2]]) @ x.C)
        time = self._gnss.time[self.count - 1]
        n = self._columns.size
        error = np.zeros(9)
        error[:self._size] = s.whitener.X[:, 0] - s.whitener.X[:, 1:] @ s.dx
        # The stored chain holds the biases of the point; its errors were estimated with the
        # step of the biases as one of the unknowns, so that step is still to be applied.
        dx = np.zeros(SIZE)
        dx[self._columns] = s.dx
        gyro, accel = dx[GYRO], dx[ACCEL_BIAS]
        error[:3] += s.chain.R_g @ gyro
        error[3:6] += s.chain.v_g @ gyro + s.chain.v_a @ accel
        error[6:] += s.chain.p_g @ gyro + s.chain.p_a @ accel
        C = x.C @ exp_so3(error[:3]) @ s.chain.R
        Cv, Cp = x.C @ (s.chain.v + error[3:6]), x.C @ (s.chain.p + error[6:])
        # d(state now) / d(unknowns), d(chain errors)
        J = np.zeros((9, SIZE))
        J[:3, ATTITUDE] = np.eye(3)
        J[:3, GYRO] = x.C @ s.chain.R_g
        J[3:6, ATTITUDE] = -skew(Cv)
        J[3:6, GYRO] = x.C @ s.chain.v_g
        J[3:6, ACCEL_BIAS] = x.C @ s.chain.v_a
        J[3:6, START_VELOCITY] = np.eye(3)
        J[6:, ATTITUDE] = -skew(Cp)
        J[6:, GYRO] = x.C @ s.chain.p_g
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

    def handover(self, C_n0n: Array, shift_v: Array, shift_p: Array, scale: float,
                 wander: Array) -> Prior:
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
        wander : ndarray, shape (22,)
            Variance by which the unknowns may have changed since t0.

        """
        heading_free = not self.heading_std < HEADING_RESOLVED_STD
        C, v, p, joint = self._now(heading_free)
        x = self.estimate()
        T = np.eye(joint.shape[0])
        for block in range(3):
            T[3 * block:3 * block + 3, 3 * block:3 * block + 3] = C_n0n.T
        joint = scale * T @ joint @ T.T
        joint[9:, 9:] += np.diag(wander[self._columns])
        if heading_free:
            # The gyros cannot tell their biases from the Earth's rate seen under a heading that
            # may be anything; the linear picture knows the tangent of that circle only.
            gyro_bias = slice(9 + GYRO_BIAS.start, 9 + GYRO_BIAS.stop)
            least = np.linalg.eigvalsh(joint[gyro_bias, gyro_bias])[0]
            joint[gyro_bias, gyro_bias] += max(EARTH_RATE ** 2 - least, 0.0) * np.eye(3)
        # Places of what is kept in the joint covariance, and in the vector of unknowns.
        kept = np.flatnonzero(np.isin(self._columns, BODY_FIXED))
        if heading_free:
            places, unknowns = np.arange(2), np.arange(2)
        else:
            places = np.arange(self._size)
            unknowns = np.concatenate([places[:3], places[3:] + START_VELOCITY.start - 3])
        places = np.concatenate([places, 9 + kept])
        unknowns = np.concatenate([unknowns, self._columns[kept]])
        mean = Unknowns(C_n0n.T @ C, x.gyro_bias, x.gyro_scale, x.accel_bias,
                        C_n0n.T @ (v + shift_v),
                        C_n0n.T @ (p + shift_p), x.lever_b, x.delay)
        return prior_of(mean, joint[np.ix_(places, places)], unknowns, heading_free)

    def prior_without_attitude(self) -> Prior:
        """Return what is known of biases, lever arm and delay as the prior of a fresh start."""
        if self.solution is None:
            return self._prior
        unknowns = self._columns[np.isin(self._columns, BODY_FIXED)]
        mean = replace(self.estimate(), C=np.eye(3), start_velocity=np.zeros(3),
                       start_position=np.zeros(3))
        return prior_of(mean, self.covariance[np.ix_(unknowns, unknowns)], unknowns, False)
