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

A method takes GNSS epochs with the IMU steps before them and tells the initial attitude (at its
t0), the current one, and how well its model fits.
"""

from dataclasses import dataclass, replace
import math
from typing import Protocol

from ins_align.config import Config
from ins_align.earth import gravity_n
from ins_align.estimator import MapEstimator
from ins_align.formula import AttitudeMoments, BodyIntegrals, InertialTrack, NavigationIntegrals
from ins_align.preintegration import Noise, preintegrate, Steps
from ins_align.rotation import Array, orthonormalized
from ins_align.unknowns import (ACCEL_BIAS, ATTITUDE, DELAY, first_prior, GYRO_BIAS, LEVER_ARM,
                                Prior, SIZE, UNIFORM_ANGLE_STD)
from ins_align.whitening import Measurements
import numpy as np

# Biases wander by this share of their prior sigma in this time (s).
WANDER, WANDER_TIME = 0.1, 100.0
# After t0 has moved, the fit so far counts like this many rows.
PAST_DOF = 300
# The signs of the sensors are judged again when the data have grown by the first share, and by
# the second beyond so many epochs; they are confirmed when every other choice of signs has so much
# more chi-square.
EVIDENCE_GROWTH = 0.05, 0.3
EVIDENCE_SOON = 200
EVIDENCE_GAIN = 12.0
WRONG_SIGNS = {
    (1, -1): 'the accelerations reversed (sign of gravity instead of specific force?)',
    (-1, 1): 'the angular rates reversed',
    (-1, -1): 'one IMU axis reversed (left-handed axes?)',
}


@dataclass(frozen=True)
class Epoch:
    """
    A GNSS epoch as a method takes it.

    Attributes
    ----------
    stamp_ns : int
    latitude, longitude, altitude : float
        Of the antenna, radians and metres; always there.
    v_n : ndarray, shape (3,), or None
        Antenna velocity, ENU, m/s.
    velocity_covariance, position_covariance : ndarray, shape (3, 3)
        ENU.
    position_measured : bool
        Whether the position is a measurement to align with.

    """

    stamp_ns: int
    latitude: float
    longitude: float
    altitude: float
    v_n: Array | None
    velocity_covariance: Array
    position_measured: bool
    position_covariance: Array


@dataclass(frozen=True)
class ImuSteps:
    """IMU steps up to an epoch and the white noise in them."""

    steps: Steps
    noise: Noise


@dataclass(frozen=True)
class Fit:
    """How well the data fit the model: sums, and the last epoch's innovations."""

    chi2: float
    dof: int
    nis: float                  # of the last epoch, per row; nan without
    converged: bool
    rejected_velocity: int
    rejected_position: int
    offered: int                # epochs that were offered to the model, rejected ones included

    @property
    def factor(self) -> float:
        """A-posteriori factor on sigmas, at least 1."""
        return math.sqrt(max(1.0, self.chi2 / self.dof)) if self.dof > 0 else math.inf

    @property
    def significant_scale(self) -> float:
        """Factor on covariances that are handed on: 1 unless the misfit cannot be chance."""
        if self.dof <= 0 or self.chi2 / self.dof < 1 + 3 * math.sqrt(2 / self.dof):
            return 1.0
        return self.chi2 / self.dof


@dataclass(frozen=True)
class Nuisance:
    """Estimates beside the attitude, with their sigmas."""

    gyro_bias: Array
    gyro_bias_std: Array
    accel_bias: Array
    accel_bias_std: Array
    lever_arm: Array
    lever_arm_std: Array
    gnss_delay: float
    gnss_delay_std: float


class Method(Protocol):
    """What the aligner asks of a method."""

    t0_ns: int
    moved: int                          # how often t0 was moved forward

    def advance(self, epoch: Epoch, imu: ImuSteps) -> None:
        """Take the next epoch and the IMU steps before it."""

    def initial(self) -> tuple[Array, Array] | None:
        """Return ``C_nb(t0)`` and the covariance of its error in ENU."""

    def current(self) -> tuple[Array, Array] | None:
        """Return ``C_nb`` at the last epoch and the covariance of its error in ENU."""

    def fit(self) -> Fit:
        """Return how well the data fit."""

    def settle(self) -> None:
        """Bring the estimate to its best before a decision."""

    def unconfirmed(self) -> str:
        """Return why the data do not show yet that the sensors' signs are right, or nothing."""

    def nuisance(self) -> Nuisance:
        """Return biases, lever arm and delay."""

    def sensor_errors(self) -> tuple[Array, Array, Array]:
        """Return gyro bias, accelerometer bias and gyro scale factor errors."""

    def prior_without_attitude(self) -> Prior | None:
        """Return what a fresh start may keep."""


class MapMethod:
    """
    The recursive estimator, handed over to a later t0 whenever its store is full.

    Parameters
    ----------
    config : Config
    epoch : Epoch
        t0.
    imu : ImuSteps
        Of no length, at t0.
    use_position : bool
    prior : Prior, optional
        From an earlier alignment.
    capacity : int
        Epochs that the estimator stores.

    """

    def __init__(self, config: Config, epoch: Epoch, imu: ImuSteps, use_position: bool,
                 prior: Prior | None = None, capacity: int = 1000) -> None:
        """Start at t0."""
        self._config = config
        self._use_position = use_position
        self._capacity = capacity
        self.moved = 0
        noise = config.imu_noise
        self._wander = np.zeros(SIZE)
        self._wander[GYRO_BIAS] = (WANDER * noise.gyro_bias_std) ** 2 / WANDER_TIME
        self._wander[ACCEL_BIAS] = (WANDER * noise.accel_bias_std) ** 2 / WANDER_TIME
        if prior is None:
            prior = first_prior(noise.gyro_bias_std, noise.accel_bias_std,
                                np.array(config.lever_arm), config.lever_arm_std,
                                0.0, config.gnss_delay_std, noise.gyro_scale_std)
        self._doubt = 'the signs of the IMU axes are not judged yet'
        self._next_evidence = 0.0
        self._offered = 0
        self._rejected = [0, 0]
        self._past = 0.0, 0
        self._start(epoch, prior)
        self._nis = math.nan
        self._add(epoch, imu)

    def _start(self, epoch: Epoch, prior: Prior, excess: float = 1.0) -> None:
        self.t0_ns = epoch.stamp_ns
        self._track = InertialTrack(epoch.latitude, epoch.longitude, epoch.altitude)
        self._estimator = MapEstimator(
            prior, use_position=self._use_position,
            estimate_lever_arm=self._config.lever_arm_std > 0,
            estimate_delay=self._config.gnss_delay_std > 0, capacity=self._capacity,
            estimate_gyro_scale=self._config.imu_noise.gyro_scale_std > 0, excess=excess)

    def advance(self, epoch: Epoch, imu: ImuSteps) -> None:
        """Take the next epoch and the IMU steps before it."""
        if self._estimator.full or self._estimator.stale:
            self._move_start()
        time = (epoch.stamp_ns - self.t0_ns) * 1e-9
        self._track.advance(time, epoch.latitude, epoch.longitude, epoch.altitude)
        self._add(epoch, imu)

    def _add(self, epoch: Epoch, imu: ImuSteps) -> None:
        track = self._track
        C_n0n = track.C_n0n
        present = [epoch.v_n is not None, epoch.position_measured and self._use_position]
        still = track.s_v(np.zeros(3))
        s_v = still if epoch.v_n is None else track.s_v(epoch.v_n)
        gnss = Measurements(
            np.array([track.time]), np.concatenate([s_v, track.s_p])[None],
            (C_n0n @ np.stack([epoch.velocity_covariance, epoch.position_covariance])
             @ C_n0n.T)[None],
            np.array([present]), (C_n0n @ gravity_n(epoch.latitude, epoch.altitude))[None],
            -still[None])
        errors = self.sensor_errors()
        gyro_bias, accel_bias, gyro_scale = errors
        interval = preintegrate(imu.steps, gyro_bias, accel_bias, imu.noise, gyro_scale)
        nis = self._estimator.add(interval, errors, gnss)
        self._last, self._last_epoch = imu, epoch
        self._offered += any(present)
        self._nis = float(np.nanmean(nis)) / 3 if np.any(np.isfinite(nis)) else math.nan

    def _move_start(self) -> None:
        """Move t0 to the last epoch; what was learnt becomes the prior."""
        track, steps = self._track, self._last.steps
        fit = self.fit()
        prior = self._estimator.handover(track.C_n0n, -track.s_v(np.zeros(3)), -track.s_p,
                                         fit.significant_scale, self._wander * track.time)
        self._rejected = [fit.rejected_velocity, fit.rejected_position]
        self._past = PAST_DOF * fit.chi2 / max(fit.dof, 1), PAST_DOF
        self._next_evidence = 0.0
        self.moved += 1
        start = replace(self._last_epoch, v_n=None, position_measured=False)
        self._start(start, prior, self._estimator.excess)
        instant = Steps(np.zeros((1, 1)), *(np.repeat(array[:, -1:], 2, axis=1) for array in (
            steps.omega, steps.f, steps.omega_dot, steps.f_dot)))
        self._add(start, ImuSteps(instant, Noise()))

    def initial(self) -> tuple[Array, Array] | None:
        """Return ``C_nb(t0)`` and the covariance of its error in ENU."""
        if self._estimator.solution is None:
            return None
        return (self._estimator.estimate().C,
                self._estimator.covariance[ATTITUDE, ATTITUDE])

    def current(self) -> tuple[Array, Array] | None:
        """Return ``C_nb`` at the last epoch and the covariance of its error in ENU."""
        if self._estimator.solution is None:
            return None
        C_n0b, covariance = self._estimator.current()
        C_nn0 = self._track.C_n0n.T
        return C_nn0 @ C_n0b, C_nn0 @ covariance @ C_nn0.T

    def fit(self) -> Fit:
        """Return how well the data fit."""
        solution = self._estimator.solution
        if solution is None:
            return Fit(math.nan, 0, math.nan, False, 0, 0, self._offered)
        rejected = solution.whitener.rejected
        past_chi2, past_dof = self._past
        return Fit(past_chi2 + solution.chi2, past_dof + solution.dof, self._nis,
                   self._estimator.nonlinearity() <= self._estimator.NONLINEARITY,
                   self._rejected[0] + rejected[0], self._rejected[1] + rejected[1],
                   self._offered)

    def settle(self) -> None:
        """Relinearise now if that is worth it at all."""
        self._estimator.settle()

    def unconfirmed(self) -> str:
        """Return why the data do not show yet that the sensors' signs are right, or nothing."""
        if self._doubt and self._estimator.count >= self._next_evidence:
            growth = EVIDENCE_GROWTH[self._estimator.count > EVIDENCE_SOON]
            self._next_evidence = self._estimator.count * (1 + growth)
            chi2 = self._estimator.sign_evidence()
            right = chi2.pop((1, 1))
            rival = min(chi2, key=chi2.__getitem__)
            if chi2[rival] > right + EVIDENCE_GAIN:
                self._doubt = ''
            elif chi2[rival] > right - EVIDENCE_GAIN:
                self._doubt = ('the signs of the IMU axes are not confirmed by the motion yet: '
                               'turn')
            else:
                self._doubt = f'the data fit better with {WRONG_SIGNS[rival]}: check the IMU axes'
        return self._doubt

    def nuisance(self) -> Nuisance:
        """Return biases, lever arm and delay."""
        x = self._estimator.estimate()
        std = np.sqrt(np.maximum(np.diag(self._estimator.covariance), 0.0))
        return Nuisance(x.gyro_bias, std[GYRO_BIAS], x.accel_bias, std[ACCEL_BIAS],
                        x.lever_b, std[LEVER_ARM], self._config.gnss_delay + x.delay,
                        float(std[DELAY][0]))

    def sensor_errors(self) -> tuple[Array, Array, Array]:
        """Return gyro bias, accelerometer bias and gyro scale factor errors."""
        x = self._estimator.estimate()
        return x.gyro_bias, x.accel_bias, x.gyro_scale

    def prior_without_attitude(self) -> Prior | None:
        """Return what a fresh start may keep."""
        return self._estimator.prior_without_attitude()


class NoteMethod:
    """
    The note's velocity (``vif``) or position (``pif``) integration formula with lever arm.

    Sensor biases are not known to it. Its sigma comes from the centred moments and the residuals.
    ``pif`` takes positions where no velocity comes; the start velocity is then always free.

    Parameters
    ----------
    config : Config
    epoch : Epoch
        t0.
    imu : ImuSteps
        Of no length, at t0.
    use_position : bool
        For ``pif``: integrate positions, not velocities.

    """

    def __init__(self, config: Config, epoch: Epoch, imu: ImuSteps, use_position: bool) -> None:
        """Start at t0."""
        self.t0_ns = epoch.stamp_ns
        self.moved = 0
        self._config = config
        self._lever_b = np.array(config.lever_arm)
        self._free = config.free_start
        self._position_form = config.method == 'pif'
        self._from_positions = self._position_form and use_position
        self._zero = np.zeros(3)
        self._body = BodyIntegrals(self._lever_b, imu.steps.omega[0, -1])
        place = epoch.latitude, epoch.longitude, epoch.altitude
        self._track = InertialTrack(*place)
        self._start_place = place
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
        self._variance = 0.0
        self._solution: tuple[Array, Array] | None = None
        self._residual = 0.0
        if self._free or self._from_positions:
            self._pair(epoch)

    def advance(self, epoch: Epoch, imu: ImuSteps) -> None:
        """Take the next epoch and the IMU steps before it."""
        interval = preintegrate(imu.steps, self._zero, self._zero, Noise())
        self._body.advance(interval, 0)
        time = (epoch.stamp_ns - self.t0_ns) * 1e-9
        place = epoch.latitude, epoch.longitude, epoch.altitude
        self._track.advance(time, *place)
        if epoch.v_n is not None and self._navigation is not None:
            self._navigation.advance(time, *place, epoch.v_n)
        self._pair(epoch)

    def _pair(self, epoch: Epoch) -> None:
        """Add the pair of vectors of an epoch and solve."""
        body, time = self._body, self._track.time
        if self._from_positions:
            if not epoch.position_measured:
                return
            regressors = (1.0, time) if self._free else (time,)
            first = 0.0 if self._free else 1.0
            self._moments.add(self._track.s_p, body.a_p - first * self._lever_b, regressors)
            self._variance += float(np.trace(epoch.position_covariance)) / 3
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
            self._variance += float(np.trace(epoch.velocity_covariance)) / 3
        else:
            return
        self._offered += 1
        if self._moments.count < 3:
            return
        C, residual, A = self._moments.solve()
        A_n = C @ A @ C.T
        information = np.trace(A_n) * np.eye(3) - A_n
        self._residual = residual
        variance = self._variance / self._offered
        self._solution = C, np.linalg.inv(information / variance
                                          + np.eye(3) / UNIFORM_ANGLE_STD ** 2)

    def initial(self) -> tuple[Array, Array] | None:
        """Return ``C_nb(t0)`` and the covariance of its error in ENU."""
        return self._solution

    def current(self) -> tuple[Array, Array] | None:
        """Return ``C_nb`` at the last epoch and the covariance of its error in ENU."""
        if self._solution is None:
            return None
        C, covariance = self._solution
        C_nn0 = self._track.C_n0n.T
        return orthonormalized(C_nn0 @ C @ self._body.C_b0b), C_nn0 @ covariance @ C_nn0.T

    def fit(self) -> Fit:
        """Return how well the data fit."""
        dof = 3 * self._moments.count - 3 - 3 * self._nuisance
        if self._solution is None or dof <= 0:
            return Fit(math.nan, 0, math.nan, False, 0, 0, self._offered)
        variance = self._variance / self._offered
        return Fit(self._residual / variance, dof, math.nan, True, 0, 0, self._offered)

    def settle(self) -> None:
        """Nothing to bring: the estimate is closed form."""

    def unconfirmed(self) -> str:
        """Return nothing: there is no test of the signs."""
        return ''

    def nuisance(self) -> Nuisance:
        """Return what is assumed: no biases, lever arm and delay as configured."""
        zero = np.zeros(3)
        return Nuisance(zero, zero, zero, zero, self._lever_b, zero, self._config.gnss_delay, 0.0)

    def sensor_errors(self) -> tuple[Array, Array, Array]:
        """Return zeros."""
        return self._zero, self._zero, self._zero

    def prior_without_attitude(self) -> Prior | None:
        """Nothing but the attitude is estimated."""
        return None
