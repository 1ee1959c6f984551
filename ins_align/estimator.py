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
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
import math

from ins_align.excess import ExcessJudge, SHARES
from ins_align.fit import Innovation, NOTHING_NEW
from ins_align.formula import attitude_from_moments
from ins_align.preintegration import Intervals, SensorErrors
from ins_align.rotation import apply, Array, cross, Index
from ins_align.solution import Course, NoiseLevels, Solution
from ins_align.unknowns import (ACCEL_MATRIX, DELAY, GYRO_BIAS, GYRO_MATRIX, LEVER_ARM, Prior,
                                SIZE, START_POSITION, START_VELOCITY, Unknowns)
from ins_align.whitening import (Chain, GATE, Gate, HEADING_RESOLVED_STD, Measurements, POSITION,
                                 Rows, VELOCITY, Whitened)
import numpy as np

# Median of chi-square with three degrees of freedom.
MEDIAN_CHI2_3 = 2.366
# Noise until the data say that it is more: a share of the excess of the IMU's, the receiver's as
# stated.
FIRST_NOISE = NoiseLevels(SHARES[0])
# Normalised innovation squared and normalised innovation by kind (velocity 0, position 1).
Tests = dict[int, tuple[float, Array]]


class MapEstimator:
    """
    Recursive generalised least squares for the initial attitude and the nuisances with it.

    Epochs and intervals are stored, so that the linearisation point can move; when the store is
    full, `handover.prior_from_now` gives the prior with which the next estimator starts.

    Parameters
    ----------
    prior : Prior
    use_position : bool
        Whether position rows will come.
    estimate_lever_arm, estimate_delay, estimate_matrices : bool
        Otherwise they stay at the prior's mean.
    capacity : int
        Epochs that are stored.
    noise : NoiseLevels
        At first.
    rate_random_walk : float
        Of the gyros' biases, rad/s/sqrt(s); 0: they stay what they are.
    excess_judge : ExcessJudge, optional
        With what is known from earlier epochs.

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
    # Noise is judged when the store has grown by this share.
    TUNE_FROM, TUNE_GROWTH = 12, 0.5
    # That of the IMU is tried at steps of these factors, down and up, to a largest one, and moved
    # when the log likelihood gains so much. A walk that is a factor of e larger has to gain more,
    # a smaller one may lose it. (Once a heading is declared, the excess is judged otherwise.)
    EXCESS_STEPS, MAX_EXCESS, EXCESS_GAIN = ((1 / 9,), (9.0,)), 3.0, 3.0
    WALK_STEPS, MAX_WALK = ((1 / 3, 1 / 9), (3.0, 9.0)), 27.0
    WALK_GAIN, WALK_COST = 1.0, 5.0
    # The receiver's is taken for understated when the residuals' variance is so many times what it
    # should be and at least so much of it is white, as what does not fit the model is not; from
    # then on it follows when they differ by this factor.
    LOUD, WHITE, FOLLOW = 3.0, 0.7, 1.3
    # A fit that refuses more than the first share of its epochs takes them all. A solution that
    # refused more than the second is fitted again: the few that agree may do so by chance.
    MAX_REJECTED, OVERFIT = 0.3, 0.5
    # Chi-square per degree of freedom from which on a fit looks for outliers among its residuals.
    MISFIT = 4.0
    # From this chi-square per degree of freedom on the minimum may be a wrong one, as those are a
    # step of a walker apart: others are looked for from these delays (s) on whenever the store has
    # grown by this factor.
    DOUBTFUL, OTHER_DELAYS, AFRESH_GROWTH = 2.0, (0.0, 0.1, 0.2), 2
    # Ages (s) at which t0 moves on: when no heading is known to within this (rad), though the
    # velocity is (m/s) and the unknown turn is about the vertical to within this (rad: a vehicle
    # that gathers speed soon shows its heading); when neither is; when both are. The first two
    # only once the gyros' biases may have turned the heading by so much (rad): a good IMU finds
    # north at rest.
    IDLE_TIME, IDLE_HEADING_STD, IDLE_VELOCITY_STD, IDLE_AXIS_TILT = 5.0, 1.2, 0.2, 0.02
    MAX_IDLE_TIME, MAX_AGE = 60.0, 120.0
    IDLE_HEADING_LOSS = math.radians(0.4)
    # Innovations whose median scales the gate, so that noise beyond what is stated does not
    # turn the good epochs into outliers.
    GATE_WINDOW = 25

    def __init__(self, prior: Prior, *, use_position: bool = False,
                 estimate_lever_arm: bool = False, estimate_delay: bool = False,
                 estimate_matrices: bool = False, capacity: int = 1000,
                 noise: NoiseLevels = FIRST_NOISE, rate_random_walk: float = 0.0,
                 excess_judge: ExcessJudge | None = None) -> None:
        """Start at t0."""
        wanted = np.ones(SIZE, bool)
        wanted[START_POSITION] = use_position
        wanted[LEVER_ARM] = estimate_lever_arm
        wanted[DELAY] = estimate_delay
        wanted[GYRO_MATRIX] = wanted[ACCEL_MATRIX] = estimate_matrices
        self.columns = np.flatnonzero(wanted)
        self.size = 9 if use_position else 6
        self.prior = prior
        self._capacity = capacity
        self._intervals = Intervals.empty(capacity)
        self._gnss = Measurements.empty(capacity)
        # Outliers when they came.
        self._refused = np.zeros((capacity, 2), bool)
        self.count = self.measured = 0              # epochs, and those with a measurement
        self.solution: Solution | None = None
        self._last_fit = self._last_tuned = self._last_afresh = 0
        self.noise = noise
        self._excess_judge = excess_judge or ExcessJudge()
        self._rate_random_walk = rate_random_walk
        # What other noise would have made of the epochs up to one, at this linearisation point.
        self._trials: dict[NoiseLevels, tuple[Solution, int]] = {}
        self.gated = True
        self._recent: deque[float] = deque(maxlen=self.GATE_WINDOW)
        self._gate_scale = 1.0

    # Input

    def add(self, intervals: Intervals, gnss: Measurements) -> Iterator[Innovation]:
        """
        Append epochs one after the other; the very first one is t0, its interval has no length.

        Stops early, after an epoch at which the linearisation point has moved: what was made of
        those behind it is of no use. Whoever iterates may call `settle` in between.

        Parameters
        ----------
        intervals : Intervals
            K of them, integrated with sensor errors of zero.
        gnss : Measurements
            The K epochs at their ends.

        Yields
        ------
        Innovation
            Of one epoch after the other.

        Raises
        ------
        RuntimeError
            When the store is full.

        """
        if self.full:
            raise RuntimeError('the store is full: hand over to a new estimator')
        count = min(gnss.time.size, self._capacity - self.count)
        places = slice(self.count, self.count + count)
        self._intervals.put(places, intervals.take(slice(0, count)))
        self._gnss.put(places, gnss.take(slice(0, count)))
        measured: list[bool] = np.any(gnss.present[:count], axis=1).tolist()
        s = self.solution
        if s is None:
            yield from self._first(measured)
            return
        rows = self._rows(s, places)
        wanted = gnss.present[:count, :s.kinds].copy()
        done, ahead = 0, count
        refused: Tests = {}                       # of the next epoch
        while done < count:
            part = slice(done, done + ahead)
            course = s.course(rows.take(part), wanted[part])
            ahead = min(2 * ahead, count)
            for k, tests in enumerate(self._tests(s, course)):
                wild = [kind for kind, (nis, _) in tests.items()
                        if not nis < GATE * self._gate_scale]
                if wild:
                    # Once more from here, without it; where there is one, there may be many.
                    wanted[done, wild[0]] = False
                    self._refused[self.count, wild[0]] = True
                    s.rejected[wild[0]] += 1
                    s.rejected_epochs += not refused
                    refused[wild[0]] = tests[wild[0]]
                    ahead = 1
                    break
                s.move_to(course, k)
                self.count += 1
                self.measured += measured[done]
                done += 1
                yield self._taken(s, tests | refused)
                if self.solution is not s:
                    return
                refused = {}

    def _first(self, measured: list[bool]) -> Iterator[Innovation]:
        """Append epochs, with or without a measurement, until there is a solution."""
        for is_measured in measured:
            self.count += 1
            self.measured += is_measured
            if self.prior.information[0, 0] > 0 or self.measured >= self.FIRST_FIT:
                self._fit()
            yield NOTHING_NEW
            if self.solution is not None:
                return

    def _tests(self, s: Solution, course: Course) -> Iterator[Tests]:
        """Yield the tests of each epoch's innovations, where they mean something."""
        nis, normalised = s.tested(course)
        # Far from the linearisation point an innovation says nothing about its measurement.
        near = np.concatenate([[s.nonlinearity], course.nonlinearity[:-1]]) <= self.FAR
        look = (course.whitened.used & near[:, None]).tolist()
        for k, values in enumerate(nis.tolist()):
            yield {kind: (value, normalised[k, kind]) for kind, value in enumerate(values)
                   if look[k][kind]}

    def _taken(self, s: Solution, tests: Tests) -> Innovation:
        """Do what is due after an epoch: tune, move the linearisation point."""
        tested = [nis for nis, _ in tests.values() if math.isfinite(nis)]
        self._recent.extend(tested)
        if len(self._recent) == self.GATE_WINDOW:
            median = sorted(self._recent)[self.GATE_WINDOW // 2]
            self._gate_scale = max(1.0, median / MEDIAN_CHI2_3)
        last = self.count - 1
        self._excess_judge.hear(self._intervals.Q[last], self._intervals.Q_excess[last])
        self._tune(s)
        growth = self.GROWTH_FAR if s.nonlinearity > self.FAR else self.GROWTH
        overfit = s.rejected_epochs > self.OVERFIT * self.measured
        if ((s.nonlinearity > self.NONLINEARITY or self._misfits(s) or overfit)
                and self.count >= self._last_fit * (1 + growth)):
            self._fit()
        if not tested:
            return NOTHING_NEW
        return Innovation(sum(tested) / (3 * len(tested)), tests[min(tests)][1])

    @property
    def full(self) -> bool:
        """Whether the store is full."""
        return self.count >= self._capacity

    @property
    def idle(self) -> bool:
        """Whether nothing shows the heading yet."""
        s = self.solution
        return s is None or bool(s.P[2, 2] > self.IDLE_HEADING_STD ** 2)

    @property
    def stale(self) -> bool:
        """
        Whether a later t0 would serve better, though the store is not full.

        The heading at t0 gets lost with the vertical gyro's bias the longer the vehicle stands or
        flies straight after it. That it does shows when the velocity is known and the heading is
        not. A long chain of a poor IMU says little of its beginning in any case, nor does one
        whose errors have grown out of the linear picture.
        """
        s = self.solution
        if s is None:
            return False
        age = self.time
        if not self.idle:
            return bool(age >= self.MAX_AGE or (s.bent > self.NONLINEARITY
                                                and self.heading_std < HEADING_RESOLVED_STD))
        variances = self.variances
        bias_std = math.sqrt(np.max(variances[GYRO_BIAS]))
        if age * bias_std < self.IDLE_HEADING_LOSS:
            return False
        start = variances[START_VELOCITY]
        still = (start[0] + start[1] < 2 * self.IDLE_VELOCITY_STD ** 2
                 and self.free_axis_tilt < self.IDLE_AXIS_TILT)
        return bool(age >= (self.IDLE_TIME if still else self.MAX_IDLE_TIME))

    @property
    def _all(self) -> slice:
        """Epochs that are stored."""
        return slice(0, self.count)

    def _rows(self, s: Solution, epochs: slice, alike: Rows | None = None) -> Rows:
        """Return what a solution makes of stored epochs behind its own; see `Solution.rows`."""
        return s.rows(self._gnss.take(epochs), self._corrected(epochs, s.point.sensors), alike)

    def _run(self, s: Solution, rows: Rows, gate: Gate | None, refused: np.ndarray) -> Whitened:
        """Take all stored epochs into an empty solution; without a gate those not refused."""
        present = self._gnss.present[:self.count, :s.kinds]
        wanted = present if gate is not None else self._unrefused(s, refused, self._all)
        return s.run(rows, present, wanted, gate, self._gate_scale)

    def _unrefused(self, s: Solution, refused: np.ndarray, epochs: slice) -> np.ndarray:
        """Return which measurements of stored epochs are there and not refused."""
        return self._gnss.present[epochs, :s.kinds] & ~refused[epochs, :s.kinds]

    def _corrected(self, epochs: slice, sensors: SensorErrors) -> Intervals:
        """Return stored intervals as they are with these sensor errors."""
        return self._intervals.take(epochs).corrected(sensors.vector())

    # Solution

    def _start(self, point: Unknowns, prior: Prior | None = None, columns: Index | None = None,
               noise: NoiseLevels | None = None) -> Solution:
        """Return an empty solution; with another prior, unknowns or noise where given."""
        noise = noise or self.noise
        return Solution(point, prior or self.prior, self.columns if columns is None else columns,
                        self.size, noise, self._rate_random_walk * noise.walk)

    def _converge(self, point: Unknowns, P: 'Array | None', refused: np.ndarray) -> Solution:
        """
        Gauss-Newton over the store from a starting point.

        What of the store is `refused`, shape (count, 2), is not taken where nothing gates; it is
        changed to what the solution goes without.
        """
        for _ in range(self.MAX_ITERATIONS):
            s = self._start(point)
            rows = self._rows(s, self._all)
            whitened = self._run(s, rows, None if P is None else Gate(s.dx, P), refused)
            if s.rejected_epochs > self.MAX_REJECTED * self.measured:
                # Not a few outliers but a wrong picture: look at everything again.
                s, P = self._start(point), None
                refused[:] = False
                whitened = self._run(s, rows, None, refused)
            if s.nonlinearity <= self.NONLINEARITY:
                if not (self.gated and self._misfits(s)
                        and self._refuse_wild(s.residuals(whitened)[0], refused)):
                    break
                P = None
            point = s.estimate
        return s

    def _misfits(self, s: Solution) -> bool:
        """Whether a solution leaves residuals that no noise makes."""
        return s.chi2 > self.MISFIT * max(s.dof, 1)

    def _refuse_wild(self, squares: Array, refused: np.ndarray) -> bool:
        """Refuse the residuals that are wild beside the others, if there are few."""
        wild = np.zeros(squares.shape, bool)
        for kind, of_kind in enumerate(squares.T):
            usual = np.median(of_kind[of_kind > 0.0]) if of_kind.any() else 0.0
            wild[:, kind] = of_kind > GATE * max(1.0, usual / MEDIAN_CHI2_3)
        refused = refused[:, :squares.shape[1]]
        few = np.count_nonzero(refused | wild) <= self.MAX_REJECTED * self.measured
        if few:
            refused |= wild
        return bool(few and wild.any())

    def _fit(self) -> None:
        """Move the linearisation point from where it is; while that is doubtful, from others."""
        self._last_fit = self.count
        self._trials.clear()
        old = self.solution
        resolved = old is not None and self.heading_std < HEADING_RESOLVED_STD
        gate = old.P if old is not None and resolved and self.gated else None
        here, before = self.estimate(), self.prior.mean
        starts = [here] if old is not None or self.prior.information[0, 0] > 0 else []
        enough = self.measured >= self.FIRST_FIT
        if enough and not resolved:
            starts.append(replace(here, C=self._rough_attitude(here)))
        elif (enough and old is not None and old.chi2 > self.DOUBTFUL * max(old.dof, 1)
                and self.count >= self.AFRESH_GROWTH * self._last_afresh):
            self._last_afresh = self.count
            delays = self.OTHER_DELAYS if DELAY.start in self.columns else (0.0,)
            rough = replace(before, C=self._rough_attitude(before))
            starts += [replace(rough, delay=before.delay + delay) for delay in delays]
        fits = []
        for start in starts:
            refused = self._refused[:self.count].copy()
            s = self._converge(start, gate if start is here else None, refused)
            fits.append((s.chi2 + GATE * self._gate_scale * sum(s.rejected), s, refused))
        _, self.solution, self._refused[:self.count] = min(fits, key=lambda fit: fit[0])

    def _tune(self, s: Solution) -> None:
        """Judge how noisy IMU and receiver are, where it is time."""
        before = self.noise
        if self._excess_judge.due:
            self._judge_excess(s)
        if self.count >= max(self.TUNE_FROM, self._last_tuned * (1 + self.TUNE_GROWTH)):
            self._last_tuned = self.count
            if (not self._excess_judge.competent
                    and np.any(self._intervals.Q_excess[:self.count])):
                # Vibration is less than it seems, and other errors grow with it.
                self._tune_imu(s, 'excess', self.EXCESS_STEPS, self.MAX_EXCESS, self.EXCESS_GAIN)
            if self._rate_random_walk > 0.0:
                # Gyros that warm up drift faster than they do later.
                self._tune_imu(s, 'walk', self.WALK_STEPS, self.MAX_WALK, self.WALK_GAIN,
                               self.WALK_COST)
            if s.chi2 > self.LOUD * s.dof or max(self.noise.gnss) > 1.0:
                self._tune_gnss(s.estimate)
        if self.noise != before:
            self._fit()

    def _rerun(self, point: Unknowns, prior: Prior | None = None, columns: Index | None = None,
               noise: NoiseLevels | None = None) -> tuple[Solution, Whitened]:
        """Take the stored epochs once more, as `_start` has it."""
        solution = self._start(point, prior, columns, noise)
        return solution, self._run(solution, self._rows(solution, self._all), None,
                                   self._refused[:self.count])

    def _likelihood_with(self, s: Solution, noise: NoiseLevels, alike: dict[int, Rows]) -> float:
        """
        Return the log likelihood of the stored epochs with other noise, linearised where `s` is.

        A trial goes on from the epoch that it had reached when it was asked last. `alike`: rows
        of other trials at this epoch, by where they begin.
        """
        trial, done = self._trials.get(noise) or (self._start(s.point, noise=noise), 0)
        epochs = slice(done, self.count)
        rows = alike[done] = self._rows(trial, epochs, alike.get(done))
        wanted = self._unrefused(trial, self._refused, epochs)
        trial.run(rows, wanted, wanted, None, 1.0)
        self._trials[noise] = trial, self.count
        return trial.log_likelihood

    def _judge_excess(self, s: Solution) -> None:
        """Have it judged what share of the excess of the IMU's noise is believed."""
        alike: dict[int, Rows] = {}
        likelihoods = [self._likelihood_with(s, self.noise._replace(excess=share), alike)
                       for share in SHARES]
        self.noise = self.noise._replace(excess=self._excess_judge.share(np.array(likelihoods)))

    def _tune_imu(self, s: Solution, name: str, steps: Iterable[Sequence[float]], most: float,
                  gain: float, cost: float = 0.0) -> None:
        """
        Judge by the likelihood a level of the IMU's noise.

        The overall scale is left to the a-posteriori factor. Where a step is for the worse, a
        larger one that way is not tried.
        """
        best, likelihood = self.noise, s.log_likelihood + gain
        alike: dict[int, Rows] = {}
        for one_way in steps:
            for step in one_way:
                trial = step * getattr(self.noise, name)
                if not 0.99 * getattr(FIRST_NOISE, name) <= trial <= 1.01 * most:
                    break
                noise = self.noise._replace(**{name: trial})
                tried = self._likelihood_with(s, noise, alike)
                if tried - cost * math.log(step) > likelihood:
                    best, likelihood = noise, tried - cost * math.log(step)
                if tried < s.log_likelihood:
                    break
        self.noise = best

    def _tune_gnss(self, point: Unknowns) -> None:
        """Judge by the residuals how far a receiver understates its noise."""
        solution, whitened = self._rerun(point)
        normalised = solution.residuals(whitened)[1]
        factors = list(self.noise.gnss)
        for kind in range(solution.kinds):
            residuals = normalised[whitened.used[:, kind], kind]
            if len(residuals) < self.TUNE_FROM:
                continue
            # Of noise that is white a difference of two has twice the variance.
            level, white = (float(np.median(np.sum(rows ** 2, axis=1))) / MEDIAN_CHI2_3
                            for rows in (residuals, np.diff(residuals, axis=0) / math.sqrt(2)))
            limit = self.FOLLOW if factors[kind] > 1.0 else self.LOUD
            if level < 1 / limit or level > limit and white > self.WHITE * level:
                factors[kind] = max(1.0, factors[kind] * level)
        self.noise = self.noise._replace(gnss=(factors[0], factors[1]))

    def _rough_attitude(self, point: Unknowns) -> Array:
        """Centred q-method over the store, with the sensor errors and lever arm of `point`."""
        interval = self._corrected(self._all, point.sensors)
        chain = Chain.start().extended(interval)
        gnss = self._gnss.take(self._all)
        moments = np.zeros((3, 3))
        total = 0.0
        for kind, rows in enumerate((VELOCITY, POSITION)):
            use = gnss.present[:, kind]
            if np.count_nonzero(use) < self.FIRST_FIT - 1 or (kind and total > 0):
                continue
            lever = (cross(point.sensors.rate(interval.omega), point.lever_b) if kind == 0
                     else point.lever_b)
            integral = chain.v if kind == 0 else chain.p
            a = (integral + apply(chain.R, lever))[use]
            both = np.hstack([gnss.s[use, rows], a])
            basis = np.vander(gnss.time[use], 1 + kind)
            both = both - basis @ np.linalg.lstsq(basis, both, rcond=None)[0]
            moments += both[:, :3].T @ both[:, 3:]
            total += float(np.sum(both * both))
        return attitude_from_moments(moments, total)[0]

    def settle(self, last: bool = False) -> None:
        """
        Move the linearisation point now if that is worth it at all, growth or hardly.

        `last`: move it to the estimate of a resolved heading in any case, because the covariance
        is about to be handed on: the joint of tilt and biases can be so much sharper than each of
        them that even a small step of the heading feigns information on both.
        """
        grown = self.count > self._last_fit * (1 + self.GROWTH_FAR)
        if self.solution is not None and (self.heading_std < HEADING_RESOLVED_STD if last
                                          else grown and not self.converged):
            self._fit()

    def fitted_afresh(self, prior: Prior, intervals: Intervals) -> Solution:
        """
        Fit the stored epochs once more, with another prior and other intervals; nothing changes.

        No epoch is rejected, whatever it says.

        Parameters
        ----------
        prior : Prior
            Another one.
        intervals : Intervals
            Integrated with sensor errors of zero.

        """
        other = MapEstimator(prior, use_position=self.size == 9,
                             estimate_lever_arm=LEVER_ARM.start in self.columns,
                             estimate_delay=DELAY.start in self.columns,
                             estimate_matrices=GYRO_MATRIX.start in self.columns,
                             capacity=self.count, noise=self.noise,
                             rate_random_walk=self._rate_random_walk)
        other._intervals, other._gnss = intervals, self._gnss.take(self._all)
        other.count, other.measured = self.count, self.measured
        other.gated = False
        other._fit()
        other._fit()
        assert other.solution is not None
        return other.solution

    def loosened(self, free: Iterable[tuple[slice, float]], reconsider: bool = False) -> Solution:
        """
        Solve once more, linearised where it is, for unknowns that are less known; nothing changes.

        Parameters
        ----------
        free : iterable of (slice, float)
            Blocks of the 37 unknowns, which need not be among those that are estimated, and by how
            much they may be off beside what is known of them, 1 sigma.
        reconsider : bool
            Take what was refused as an outlier where it is none for unknowns that are so free.

        Raises
        ------
        RuntimeError
            Before the first solution.

        """
        prior, columns = self.prior, self.columns
        for block, std in free:
            prior, columns = prior.loosened(block, std), np.union1d(columns, np.r_[block])
        refused = self._refused[:self.count]
        solution = self._start(self._solved.point, prior, columns)
        rows = self._rows(solution, self._all)
        self._run(solution, rows, None, refused)
        if reconsider and refused.any():
            gate = Gate(solution.dx, solution.P)
            solution = self._start(solution.point, prior, columns)
            self._run(solution, rows, gate, refused)
        return solution

    def gnss_share(self, of_prior: float) -> float:
        """
        Return how much of the attitude's variance comes from the GNSS.

        Of the angle, then or now, of which most does.

        Parameters
        ----------
        of_prior : float
            How much of the prior's variances does.

        Raises
        ------
        RuntimeError
            Before the first solution.

        """
        s = self._solved
        velocities, positions = self.noise.gnss
        # With twice the noise there is so much more of the variance.
        noisier, _ = self._rerun(
            s.point, replace(self.prior, information=self.prior.information / (1.0 + of_prior)),
            noise=self.noise._replace(gnss=(2.0 * velocities, 2.0 * positions)))
        more = np.concatenate([noisier.P.diagonal()[:3] / s.P.diagonal()[:3],
                               noisier.covariance.diagonal() / s.covariance.diagonal()])
        return float(np.clip(np.max(more) - 1.0, 0.0, 1.0))

    def raw_intervals(self) -> Intervals:
        """Return the stored intervals, as they are with sensor errors of zero."""
        return self._intervals.take(self._all)

    # Results

    @property
    def _solved(self) -> Solution:
        if self.solution is None:
            raise RuntimeError('no solution yet')
        return self.solution

    @property
    def converged(self) -> bool:
        """Whether the estimate is close to the linearisation point."""
        return self.solution is not None and self.solution.nonlinearity <= self.NONLINEARITY

    @property
    def time(self) -> float:
        """Seconds from t0 to the last epoch."""
        return float(self._gnss.time[self.count - 1])

    def estimate(self) -> Unknowns:
        """Return the estimate."""
        return self.prior.mean if self.solution is None else self.solution.estimate

    @property
    def variances(self) -> Array:
        """Variances of the 37 unknowns; zero where one is not estimated, shape (37,)."""
        full = np.zeros(SIZE)
        if self.solution is not None:
            full[self.columns] = self.solution.P.diagonal()
        return full

    @property
    def free_axis_tilt(self) -> float:
        """
        Angle between the vertical and the axis about which the attitude is known least, rad.

        Of a vehicle that gathers speed that axis is the specific force.
        """
        if self.solution is None:
            return 0.0
        east, north, up = self.solution.P[:3, 2].tolist()
        return math.hypot(east, north) / up

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
        s = self._solved
        return s.C, s.covariance
