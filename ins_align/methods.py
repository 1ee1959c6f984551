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
The alignment methods behind one face: the note's (``vif``, ``pif``) and ``map``.

A method takes GNSS epochs with the IMU intervals before them and tells the initial attitude (at
its t0), the current one, and how well its model fits.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from ins_align.antenna import AntennaEpoch
from ins_align.config import Config, STANDARD_GRAVITY
from ins_align.correlation import Correlation
from ins_align.estimator import FIRST_NOISE, MapEstimator
from ins_align.excess import ExcessJudge
from ins_align.fit import Fit, no_fit, NOTHING_NEW
from ins_align.formula import AttitudeMoments, BodyIntegrals, InertialTrack, NavigationIntegrals
from ins_align.handover import aged, prior_from_now, prior_without_attitude, wander
from ins_align.preintegration import Intervals, SensorErrors
from ins_align.results import Nuisance, State
from ins_align.rotation import Array, orthonormalized
from ins_align.signs import SignCheck
from ins_align.solution import NoiseLevels
from ins_align.told import ToldCheck
from ins_align.unknowns import (ACCEL_BIAS, ATTITUDE, DELAY, first_prior, GYRO_BIAS, LEVER_ARM,
                                Prior, START_POSITION, UNIFORM_ANGLE_STD, Unknowns)
from ins_align.whitening import Measurements
import numpy as np

# After t0 has moved, the fit so far counts like this many rows.
PAST_DOF = 300
# Beside velocities positions gain little and hurt when their errors wander: where a method may
# choose, it takes them when no velocity came for this long (ns).
VELOCITY_STOPPED_NS = 10_000_000_000
# It leaves them out again when velocities have come for this long (ns).
VELOCITY_BACK_NS = 2_000_000_000
# Epochs for which what follows is worked out at one go: few right after the linearisation point
# has moved, because then it will soon again.
MAX_AHEAD = 128


class Method(Protocol):
    """What the aligner asks of a method."""

    t0_ns: int
    moved: int                          # how often t0 was moved forward

    def advance(self, epochs: Sequence[AntennaEpoch], imu: Intervals) -> Iterator[AntennaEpoch]:
        """Take epochs and the IMU intervals before each; yield each when the results are its."""

    def initial(self) -> tuple[Array, Array] | None:
        """Return ``C_nb(t0)`` and the covariance of its error in ENU."""

    def current(self) -> tuple[Array, Array] | None:
        """Return ``C_nb`` at the last epoch and the covariance of its error in ENU."""

    def fit(self) -> Fit:
        """Return how well the data fit."""

    def settle(self) -> None:
        """Bring the estimate to its best before a decision."""

    def renew(self) -> None:
        """Move t0 to the last epoch before the next one is taken, where a method can."""

    def judged(self, contradicted: bool, state: State) -> None:
        """Hear whether the data contradict the model, and what is declared."""

    def unconfirmed(self) -> str:
        """Return what speaks against a heading: of signs, or of what is told for certain."""

    def nuisance(self) -> Nuisance:
        """Return biases, lever arm and delay."""

    def sensor_errors(self) -> SensorErrors:
        """Return the errors of gyros and accelerometers at the last epoch."""

    def prior_without_attitude(self) -> Prior | None:
        """Return what a fresh start may keep."""


class MapMethod:
    """
    The recursive estimator, handed over to a later t0 whenever its store is full.

    Parameters
    ----------
    config : Config
    epoch : AntennaEpoch
        t0.
    imu : Intervals
        Of no length, at t0.
    use_position : bool
    prior : Prior, optional
        From an earlier alignment, as of t0.
    capacity : int
        Epochs that the estimator stores.

    """

    def __init__(self, config: Config, epoch: AntennaEpoch, imu: Intervals, use_position: bool,
                 prior: Prior | None = None, capacity: int = 1000) -> None:
        """Start at t0."""
        self._config = config
        self._use_position = use_position
        self._velocity_ns = epoch.stamp_ns      # the last one
        self._velocities_since_ns: int | None = None
        self._capacity = capacity
        self.moved = 0
        noise = config.imu_noise
        self._estimates_matrices = noise.gyro_scale_std > 0
        self._wander = wander(config)
        self._first_prior = first_prior(
            noise.gyro_bias_std, noise.accel_bias_std, np.array(config.lever_arm),
            config.lever_arm_std, 0.0, config.gnss_delay_std, noise.gyro_scale_std,
            _force_at_rest(imu))
        self._signs = SignCheck()
        self._told = ToldCheck(config)
        self._correlation = Correlation()
        self._excess_judge = ExcessJudge()
        self._ahead = 1
        self._offered = 0
        self._rejected = [0, 0, 0]          # velocities, positions, epochs before t0
        self._past = 0.0, 0
        self._innovation = NOTHING_NEW
        self._start(epoch, prior or self._first_prior)
        self._take_start(epoch, imu)

    def _start(self, epoch: AntennaEpoch, prior: Prior,
               noise: NoiseLevels = FIRST_NOISE) -> None:
        self.t0_ns = epoch.stamp_ns
        self._renewed = self._good = self._contradicted = False
        self._reached: tuple[InertialTrack, int | tuple[()]] = InertialTrack.start(
            epoch.latitude, epoch.longitude, epoch.altitude), ()
        if not self._use_position:
            prior = prior.without(START_POSITION)
        self._estimator = MapEstimator(
            prior, use_position=self._use_position,
            estimate_lever_arm=self._config.lever_arm_std > 0,
            estimate_delay=self._config.gnss_delay_std > 0, capacity=self._capacity,
            estimate_matrices=self._estimates_matrices, noise=noise,
            rate_random_walk=self._config.imu_noise.rate_random_walk,
            excess_judge=self._excess_judge)

    @property
    def _track(self) -> InertialTrack:
        """Track at the last epoch."""
        track, place = self._reached
        return track.at(place)

    def _take_start(self, epoch: AntennaEpoch, imu: Intervals) -> None:
        """Take the epoch at t0."""
        for _ in self._take([epoch], imu):
            pass

    def advance(self, epochs: Sequence[AntennaEpoch], imu: Intervals) -> Iterator[AntennaEpoch]:
        """Take epochs and the IMU intervals before each; yield each when the results are its."""
        done = 0
        while done < len(epochs):
            if self._due():
                self._move_start()
            solution = self._estimator.solution
            part = slice(done, done + self._ahead)
            for epoch in self._take(epochs[part], imu.take(part)):
                done += 1
                yield epoch
                if self._due():
                    break
            stayed = self._estimator.solution is solution
            self._ahead = min(2 * self._ahead, MAX_AHEAD) if stayed else 1

    def _due(self) -> bool:
        """Whether t0 is to move."""
        return self._renewed or self._estimator.full or self._estimator.stale

    def renew(self) -> None:
        """Move t0 to the last epoch before the next one is taken."""
        self._renewed = self._estimator.solution is not None

    def judged(self, contradicted: bool, state: State) -> None:
        """Hear whether the data contradict the model, and what is declared."""
        self._contradicted = contradicted
        self._good |= state in (State.LEVELLED, State.ALIGNED)
        self._excess_judge.declared |= state is State.ALIGNED

    @property
    def _lost(self) -> bool:
        """
        Whether what is estimated is no knowledge to be handed on.

        A heading that never was good enough and does not fit the data is none, nor is what else
        was found with it.
        """
        return self._contradicted and not self._good and not self._estimator.idle

    def _take(self, epochs: Sequence[AntennaEpoch], imu: Intervals) -> Iterator[AntennaEpoch]:
        """Take epochs as long as the estimator stays where it is."""
        track = self._track.extended(
            np.array([epoch.stamp_ns - self.t0_ns for epoch in epochs]) * 1e-9,
            *(np.array([getattr(epoch, name) for epoch in epochs])
              for name in ('latitude', 'longitude', 'altitude')))
        use_position = self._use_position
        present = np.array([[epoch.v_n is not None, epoch.position_measured and use_position]
                            for epoch in epochs])
        v_n = np.array([np.zeros(3) if epoch.v_n is None else epoch.v_n for epoch in epochs])
        covariance = np.array([[epoch.velocity_covariance, epoch.position_covariance]
                               for epoch in epochs])
        C_n0n = track.C_n0n[:, None]
        gnss = Measurements(track.time, np.hstack([track.s_v(v_n), track.s_p]),
                            C_n0n @ covariance @ C_n0n.transpose(0, 1, 3, 2), present,
                            track.gravity, -track.still_v)
        for k, self._innovation in enumerate(self._estimator.add(imu, gnss)):
            self._reached, self._last_epoch = (track, k), epochs[k]
            self._last_interval = imu, k
            self._correlation.add(self._innovation.normalised)
            self._offered += bool(present[k].any())
            self._look_for_velocity(epochs[k])
            yield epochs[k]
            if self._use_position != use_position:
                return                              # the next ones have positions too, or none

    def _look_for_velocity(self, epoch: AntennaEpoch) -> None:
        """Use positions, from a later t0, where velocities have stopped, until they are back."""
        stopped = epoch.stamp_ns - self._velocity_ns > VELOCITY_STOPPED_NS
        if epoch.v_n is not None:
            if self._velocities_since_ns is None or stopped:
                self._velocities_since_ns = epoch.stamp_ns
            self._velocity_ns = epoch.stamp_ns
            if (self._config.use_position == 'auto'
                    and epoch.stamp_ns - self._velocities_since_ns >= VELOCITY_BACK_NS):
                self._use_position = False
        elif self._config.use_position == 'auto' and epoch.position_measured and stopped:
            self._use_position = True
            self._renewed |= self._estimator.size == 6 and self._estimator.solution is not None

    def _move_start(self) -> None:
        """Move t0 to the last epoch; what was learnt becomes the prior."""
        self.settle(last=True)
        track = self._track
        fit = self.fit()
        if self._estimator.solution is None:                    # full of epochs without GNSS
            prior = aged(self._estimator.prior, self._config, float(track.time))
        elif self._lost:
            prior, self._past = self._first_prior, (0.0, 0)
            self._correlation = Correlation()
            self._excess_judge = ExcessJudge()
        else:
            prior = prior_from_now(self._estimator, track.C_n0n, -track.still_v, -track.s_p,
                                   fit.significant_scale, self._wander * track.time)
            self._past = PAST_DOF * fit.chi2 / max(fit.dof, 1), PAST_DOF
        self._rejected = [fit.rejected_velocity, fit.rejected_position, fit.rejected]
        self._signs.restart()
        self._told.restart()
        self._correlation.restart()
        self._excess_judge.restart()
        self.moved += 1
        start = replace(self._last_epoch, v_n=None, position_measured=False)
        self._start(start, prior, self._estimator.noise)
        imu, k = self._last_interval
        self._take_start(start, imu.take(slice(k, k + 1)).end())

    def initial(self) -> tuple[Array, Array] | None:
        """Return ``C_nb(t0)`` and the covariance of its error in ENU."""
        solution = self._estimator.solution
        if solution is None:
            return None
        return solution.estimate.C, solution.P[ATTITUDE, ATTITUDE]

    def current(self) -> tuple[Array, Array] | None:
        """Return ``C_nb`` at the last epoch and the covariance of its error in ENU."""
        if self._estimator.solution is None:
            return None
        C_n0b, covariance = self._estimator.current()
        track, place = self._reached
        C_nn0 = track.C_n0n[place].T
        return C_nn0 @ C_n0b, C_nn0 @ covariance @ C_nn0.T

    def fit(self) -> Fit:
        """Return how well the data fit."""
        solution = self._estimator.solution
        if solution is None:
            return no_fit(self._offered, self._config.gnss_delay)
        velocities, positions, epochs = (before + since for before, since in zip(
            self._rejected, (*solution.rejected, solution.rejected_epochs)))
        past_chi2, past_dof = self._past
        return Fit(past_chi2 + solution.chi2, past_dof + solution.dof, self._innovation,
                   self._estimator.converged, velocities, positions, epochs, self._offered,
                   self._delay(solution.estimate), self._estimator.noise.gnss,
                   self._estimator.noise.walk, self._told.objection,
                   self._correlation.attitude)

    def settle(self, last: bool = False) -> None:
        """Relinearise now if that is worth it; doubt what was told, and that errors are white."""
        self._estimator.settle(last)
        self._told.ask(self._estimator, self._correlation.gnss)
        self._correlation.ask(self._estimator)

    def unconfirmed(self) -> str:
        """Return what speaks against a heading: of signs, or of what is told for certain."""
        signs = '' if self._config.trust_imu_axes else self._signs.doubt(self._estimator)
        return signs or self._told.unconfirmed

    def nuisance(self) -> Nuisance:
        """Return biases, lever arm and delay."""
        x = self._estimator.estimate()
        std = np.sqrt(self._estimator.variances)
        solution = self._estimator.solution
        if solution is not None:
            std[GYRO_BIAS] = np.sqrt(solution.gyro_bias_covariance().diagonal())
        return Nuisance(self.sensor_errors().gyro_bias, std[GYRO_BIAS],
                        x.sensors.accel_bias, std[ACCEL_BIAS],
                        x.lever_b, std[LEVER_ARM], self._delay(x), float(std[DELAY][0]))

    def _delay(self, x: Unknowns) -> float:
        """Return the delay of the GNSS, of which the configured part is not in the unknowns."""
        return float(self._config.gnss_delay + x.delay)

    def sensor_errors(self) -> SensorErrors:
        """Return the errors of gyros and accelerometers at the last epoch."""
        sensors, solution = self._estimator.estimate().sensors, self._estimator.solution
        return sensors if solution is None else sensors._replace(gyro_bias=solution.gyro_bias)

    def prior_without_attitude(self) -> Prior | None:
        """Return what a fresh start may keep, as of the last epoch."""
        return None if self._lost else prior_without_attitude(self._estimator)


def _mean_variance(covariance: Array) -> float:
    """Mean of the three axes' variances."""
    return float(np.trace(covariance)) / 3


def _force_at_rest(imu: Intervals) -> Array:
    """Specific force of a vehicle that stands as it did at t0, about, shape (3,)."""
    force = imu.gained[0, -1]
    return np.asarray(STANDARD_GRAVITY * force / max(float(np.linalg.norm(force)), 1e-3))


class NoteMethod:
    """
    The note's velocity (``vif``) or position (``pif``) integration formula with lever arm.

    Errors of the IMU are not known to it: its sigma comes from the centred moments, the noise of
    the receiver and the residuals; those of the gyros count where the GNSS is silent. ``pif``
    takes positions where no velocity comes; the start velocity is then always free.

    Parameters
    ----------
    config : Config
    epoch : AntennaEpoch
        t0.
    imu : Intervals
        Of no length, at t0.
    use_position : bool
        For ``pif``: integrate positions, not velocities.

    """

    def __init__(self, config: Config, epoch: AntennaEpoch, imu: Intervals,
                 use_position: bool) -> None:
        """Start at t0."""
        self.t0_ns = epoch.stamp_ns
        self.moved = 0
        self._config = config
        self._lever_b = np.array(config.lever_arm)
        self._free = config.free_start
        self._position_form = config.method == 'pif'
        self._from_positions = self._position_form and use_position
        self._body = BodyIntegrals(self._lever_b, imu.omega[0])
        place = epoch.latitude, epoch.longitude, epoch.altitude
        self._track = InertialTrack.start(*place)
        self._navigation: NavigationIntegrals | None = None
        if epoch.v_n is not None:
            self._navigation = NavigationIntegrals(*place, epoch.v_n)
        nuisance = 0
        if self._position_form:
            nuisance = 2 if self._free else int(self._from_positions)
        elif self._free:
            nuisance = 1
        self._moments = AttitudeMoments(nuisance)
        self._nuisance = nuisance
        self._offered = 0
        self._variance = 0.0                # of what the receiver says, summed over pairs
        self._start_variance = _mean_variance(epoch.position_covariance if self._from_positions
                                              else epoch.velocity_covariance)
        self._solution: tuple[Array, Array] | None = None
        self._solved_s = 0.0
        self._residual = 0.0
        if self._free or self._from_positions:
            self._pair(epoch)

    def advance(self, epochs: Sequence[AntennaEpoch], imu: Intervals) -> Iterator[AntennaEpoch]:
        """Take epochs and the IMU intervals before each; yield each when the results are its."""
        for k, epoch in enumerate(epochs):
            self._body.advance(imu, k)
            time = (epoch.stamp_ns - self.t0_ns) * 1e-9
            place = epoch.latitude, epoch.longitude, epoch.altitude
            self._track = self._track.extended(*np.array([time, *place])[:, None]).at(0)
            if epoch.v_n is not None and self._navigation is not None:
                self._navigation.advance(time, *place, epoch.v_n)
            self._pair(epoch)
            yield epoch

    def _pair(self, epoch: AntennaEpoch) -> None:
        """Add the pair of vectors of an epoch and solve."""
        body, time = self._body, float(self._track.time)
        if self._from_positions:
            if not epoch.position_measured:
                return
            regressors = (1.0, time) if self._free else (time,)
            first = 0.0 if self._free else 1.0
            self._moments.add(self._track.s_p, body.a_p - first * self._lever_b, regressors)
            self._variance += _mean_variance(epoch.position_covariance)
        elif epoch.v_n is not None and self._navigation is not None:
            navigation = self._navigation
            if self._position_form:
                if self._free:
                    self._moments.add(navigation.s_p, body.a_p, (1.0, time))
                else:
                    self._moments.add(navigation.beta_p, body.alpha_p)
            elif self._free:
                self._moments.add(navigation.s_v, body.a_v, (1.0,))
            else:
                self._moments.add(navigation.beta_v, body.alpha_v)
            self._variance += _mean_variance(epoch.velocity_covariance)
        else:
            return
        self._offered += 1
        if self._moments.count < 3:
            return
        C, residual, A = self._moments.solve()
        A_n = C @ A @ C.T
        information = np.trace(A_n) * np.eye(3) - A_n
        self._residual = residual
        self._solved_s = time
        white, common = self._noise()
        # What is common to all pairs does not average out.
        self._solution = C, np.linalg.inv(information / (white + self._moments.count * common)
                                          + np.eye(3) / UNIFORM_ANGLE_STD ** 2)

    def _noise(self) -> tuple[float, float]:
        """Return the variance of a pair that is white, and that which all pairs have together."""
        variance = self._variance / self._offered
        start = 0.0 if self._free else self._start_variance
        if not self._position_form or self._from_positions:
            return variance, start
        # Integrated velocities walk at random; a free start takes out all but 1/15 of it, and what
        # the first one is off grows with time.
        time = float(self._track.time)
        walk = variance * time / self._offered * time
        return 0.0, walk / 15 if self._free else walk / 2 + start * time ** 2 / 3

    def initial(self) -> tuple[Array, Array] | None:
        """Return ``C_nb(t0)`` and the covariance of its error in ENU."""
        return self._solution

    def current(self) -> tuple[Array, Array] | None:
        """Return ``C_nb`` at the last epoch and the covariance of its error in ENU."""
        if self._solution is None:
            return None
        C, covariance = self._solution
        C_nn0 = self._track.C_n0n.T
        # Where no measurement comes, the gyros alone carry it on.
        noise, silent_s = self._config.imu_noise, float(self._track.time) - self._solved_s
        drift = noise.angle_random_walk ** 2 * silent_s + (noise.gyro_bias_std * silent_s) ** 2
        return (orthonormalized(C_nn0 @ C @ self._body.C_b0b),
                C_nn0 @ covariance @ C_nn0.T + drift * np.eye(3))

    def fit(self) -> Fit:
        """Return how well the data fit."""
        dof = 3 * self._moments.count - 3 - 3 * self._nuisance
        if self._solution is None or dof <= 0:
            return no_fit(self._offered, self._config.gnss_delay)
        return Fit(self._residual / sum(self._noise()), dof, NOTHING_NEW, True, 0, 0, 0,
                   self._offered, self._config.gnss_delay)

    def settle(self) -> None:
        """Nothing to bring: the estimate is closed form."""

    def renew(self) -> None:
        """Nothing to renew: t0 stays."""

    def judged(self, contradicted: bool, state: State) -> None:
        """Nothing to hear: t0 stays."""

    def unconfirmed(self) -> str:
        """Return nothing: there is no test of the signs."""
        return ''

    def nuisance(self) -> Nuisance:
        """Return what is assumed: no biases, lever arm and delay as configured."""
        zero = np.zeros(3)
        return Nuisance(zero, zero, zero, zero, self._lever_b, zero, self._config.gnss_delay, 0.0)

    def sensor_errors(self) -> SensorErrors:
        """Return zeros."""
        return SensorErrors.none()

    def prior_without_attitude(self) -> Prior | None:
        """Nothing but the attitude is estimated."""
        return None
