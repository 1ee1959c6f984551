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
The normal equations at one linearisation point: what stored epochs add to them, their solution.

The estimator decides where the point lies and when it moves.
"""

from dataclasses import dataclass
import math
from typing import NamedTuple

from ins_align.preintegration import Intervals
from ins_align.rotation import apply, Array, exp_so3, Index
from ins_align.unknowns import (ATTITUDE, GYRO, GYRO_BIAS, inverse_spd, Prior, SIZE,
                                START_POSITION, START_VELOCITY, UNIFORM_ANGLE_STD, Unknowns)
from ins_align.whitening import (Chain, chain_noise, GATE, Gate, Measurements, Rows, sensitivities,
                                 Whitened, Whitener)
import numpy as np

# What is always known: an angle lies on the circle, a velocity and a position are on the Earth.
WEAK_INFORMATION = np.zeros(SIZE)
WEAK_INFORMATION[ATTITUDE] = UNIFORM_ANGLE_STD ** -2
WEAK_INFORMATION[START_VELOCITY] = 1e4 ** -2
WEAK_INFORMATION[START_POSITION] = 1e7 ** -2
# The motion that the fit attributes to the vehicle has the noise of what was fitted to it, one
# unit of information for each: horizontal slope (tilt) and curvature (gyro bias) of the velocity.
FITTED_DIRECTIONS = 4


class NoiseLevels(NamedTuple):
    """
    How far the noise is another one than is stated, as the data say.

    Attributes
    ----------
    excess : float
        Share that is believed of the IMU noise measured in excess of the stated one.
    gnss : tuple of float
        Factors on the covariances of velocities and positions.
    walk : float
        Factor on the rate random walk of the gyros' biases.

    """

    excess: float
    gnss: tuple[float, float] = (1.0, 1.0)
    walk: float = 1.0


@dataclass
class Course:
    """
    A solution after each of K epochs.

    Attributes
    ----------
    chain : Chain
    whitened : Whitened
    time : ndarray, shape (K,)
    dx, P, estimate, chi2, dof, nonlinearity, bent, C, turned, gyro_bias, covariance
        As in `Solution`, with a leading axis of K.

    """

    chain: Chain
    whitened: Whitened
    time: Array
    dx: Array
    P: Array
    estimate: Unknowns
    chi2: Array
    dof: Index
    nonlinearity: Array
    bent: Array
    C: Array
    turned: Array
    covariance: Array
    gyro_bias: Array


class Solution:
    """
    The normal equations at one linearisation point, and what follows from them.

    Parameters
    ----------
    point : Unknowns
    prior : Prior
    columns : ndarray of int, shape (n,)
        Unknowns that are estimated, out of the 37.
    size : int
        9 when positions are used, 6 when velocities alone are.
    noise : NoiseLevels
    rate_random_walk : float
        Of the gyros' biases, rad/s/sqrt(s).

    Attributes
    ----------
    columns : ndarray of int, shape (n,)
        As told.
    rejected : list of int
        Velocities and positions that were taken for outliers.
    rejected_epochs : int
        Epochs with any of these.
    time : float
        Of the last epoch, seconds since t0.
    dx : ndarray, shape (n,)
        Step from the point to the estimate, of the unknowns that are estimated.
    P : ndarray, shape (n, n)
        Covariance of the estimate.
    estimate : Unknowns
    chi2 : float
        Sum of squares of the whitened residuals at the estimate, prior included.
    dof : int
    nonlinearity : float
        Second-order error of the linearisation, in sigmas of tilt or heading.
    bent : float
        So it is with the errors of the chain, which is linearised where they are zero.
    C, covariance : ndarray, shape (3, 3)
        Attitude at the last epoch with respect to n0, ``C_n0b``, and the covariance of its left
        error, rad^2.
    turned : ndarray, shape (3, n)
        Derivative of that attitude's left error to the unknowns that are estimated.
    gyro_bias : ndarray, shape (3,)
        Of the gyros at the last epoch, rad/s; that of `estimate` is the one at t0.

    """

    def __init__(self, point: Unknowns, prior: Prior, columns: Index, size: int,
                 noise: NoiseLevels, rate_random_walk: float = 0.0) -> None:
        """Start empty, at t0."""
        information, step = prior.at(point)
        self.point = self.estimate = point
        self.columns, self._size, self._noise = columns, size, noise
        self._rate_random_walk = rate_random_walk
        self.information = information[np.ix_(columns, columns)]
        self._mean_step = step[columns]
        self._weak = np.diag(WEAK_INFORMATION[columns])
        self._known = int(np.count_nonzero(self.information.diagonal()))
        self._gyro = np.flatnonzero((columns >= GYRO.start) & (columns < GYRO.stop))
        self._chain = Chain.start()
        self._whitener = Whitener(columns, size, rate_random_walk > 0)
        self._reached: tuple[Course, int] | None = None     # where these two are to go
        self.rejected, self.rejected_epochs = [0, 0], 0
        self.time = 0.0
        self.dx = np.zeros(columns.size)
        self.P = np.zeros((columns.size, columns.size))
        self.chi2 = self.nonlinearity = math.nan
        self.bent = 0.0
        self.dof = 0
        self.C, self.covariance = point.C, np.zeros((3, 3))
        self.turned = np.zeros((3, columns.size))
        self.gyro_bias = point.sensors.gyro_bias

    def rows(self, gnss: Measurements, interval: Intervals, alike: Rows | None = None) -> Rows:
        """
        Linearise K epochs that follow the chain; their intervals with the point's biases.

        `alike`: those of the same epochs and unknowns at the same point, with other noise.
        """
        kinds = self.kinds
        if alike is None:
            chain = self.chain.extended(interval)
            Y = sensitivities(self.point, chain, gnss, interval, kinds)[..., self.whitener.columns]
        else:
            chain, Y = alike.chain, alike.Y
        noise = chain_noise(self.point.C, gnss.time, chain, interval, self._size,
                            self._noise.excess, self._rate_random_walk)
        covariance = gnss.covariance * np.array(self._noise.gnss)[:, None, None]
        return Rows(chain, noise, Y, covariance[:, :kinds], gnss.time)

    @property
    def kinds(self) -> int:
        """Kinds of measurements: velocities, or velocities and positions."""
        return 2 if self._size == 9 else 1

    def run(self, rows: Rows, present: np.ndarray, wanted: np.ndarray, gate: Gate | None,
            gate_scale: float) -> Whitened:
        """Take what is wanted of epochs at one go; outliers by one gate for all."""
        whitened = self.whitener.whitened_at_once(rows, wanted)
        if gate is not None:
            nis, _ = gate.test(whitened.innovation, whitened.S)
            if not np.all(nis < GATE * gate_scale):
                whitened = self.whitener.whitened(rows, wanted, gate, gate_scale)
        rejected = present & ~whitened.used
        for kind, count in enumerate(np.count_nonzero(rejected, axis=0).tolist()):
            self.rejected[kind] += count
        self.rejected_epochs += int(np.count_nonzero(rejected.any(axis=1)))
        self.move_to(self._course(rows, whitened, slice(-1, None)), 0)
        return whitened

    def residuals(self, whitened: Whitened) -> tuple[Array, Array]:
        """
        Return what `run` took as residuals at the estimate; 0 where nothing was taken.

        Returns
        -------
        squares : ndarray, shape (K, kinds)
            Normalised.
        normalised : ndarray, shape (K, kinds, 3)
            Over their sigma.

        """
        return Gate(self.dx, np.zeros_like(self.P)).test(whitened.innovation, whitened.S)

    def course(self, rows: Rows, wanted: np.ndarray) -> Course:
        """Return what the solution would be after each of K epochs if it took what is wanted."""
        return self._course(rows, self.whitener.whitened(rows, wanted), slice(None))

    def tested(self, course: Course) -> tuple[Array, Array]:
        """Test the innovations of a course, each against the estimate before it; see `Gate`."""
        before = Gate(np.concatenate([self.dx[None], course.dx[:-1]])[:, None],
                      np.concatenate([self.P[None], course.P[:-1]])[:, None])
        return before.test(course.whitened.innovation, course.whitened.S)

    def move_to(self, course: Course, k: int) -> None:
        """Go to where the solution is after one of the epochs."""
        self._reached = course, k
        self.time = float(course.time[k])
        self.dx, self.P, self.estimate = course.dx[k], course.P[k], course.estimate.at(k)
        self.chi2, self.dof = float(course.chi2[k]), int(course.dof[k])
        self.nonlinearity, self.bent = float(course.nonlinearity[k]), float(course.bent[k])
        self.C, self.covariance = course.C[k], course.covariance[k]
        self.turned = course.turned[k]
        self.gyro_bias = course.gyro_bias[k]

    @property
    def chain(self) -> Chain:
        """At the last epoch, with the biases of `point`."""
        self._follow()
        return self._chain

    @property
    def whitener(self) -> Whitener:
        """At the last epoch."""
        self._follow()
        return self._whitener

    def _follow(self) -> None:
        """Bring chain and whitener to the last epoch, where few ask for them."""
        if self._reached is not None:
            course, k = self._reached
            self._chain, self._reached = course.chain.at(k), None
            self._whitener.move_to(course.whitened, k)

    def _course(self, rows: Rows, whitened: Whitened, index: slice) -> Course:
        """Solve the normal equations and judge the fit after each epoch of `index`."""
        whitened = Whitened(*(array[index] for array in vars(whitened).values()))
        chain, time = rows.chain.at(index), rows.time[index]
        normal = whitened.normal
        prior = self.information @ self._mean_step
        right = normal[:, 1:, 0] + prior
        P = inverse_spd(self.information + normal[:, 1:, 1:] + self._weak)
        dx = apply(P, right)
        column = P[:, :, 2]
        feigned = np.minimum(whitened.spurious + FITTED_DIRECTIONS,
                             1 / column[:, 2] - 1 / UNIFORM_ANGLE_STD ** 2)
        P += (column[:, :, None] * column[:, None, :]
              * (feigned / (1 - feigned * column[:, 2]))[:, None, None])
        step = np.zeros((dx.shape[0], SIZE))
        step[:, self.columns] = dx
        estimate = self.point.moved(step)
        # The attitude and the biases now.
        errors_of = np.zeros((len(time), 3, whitened.P.shape[1]))
        errors_of[:, :, :3] = np.eye(3)
        gyro_bias = estimate.sensors.gyro_bias
        if self._rate_random_walk > 0:
            errors_of[:, :, -3:] = self.point.C @ chain.R_g[:, :, :3]
            walked = whitened.X[:, -3:]
            gyro_bias = gyro_bias + walked[:, :, 0] - apply(walked[:, :, 1:], dx)
        X = errors_of @ whitened.X
        turned = -X[:, :, 1:]
        turned[:, :, ATTITUDE] += np.eye(3)
        turned[:, :, self._gyro] += (estimate.C @ chain.R_g)[
            :, :, self.columns[self._gyro] - GYRO.start]
        errors = X[:, :, 0] - apply(X[:, :, 1:], dx)
        before, after = exp_so3(np.stack([errors, apply(chain.R_g, step[:, GYRO])]))
        C = before @ estimate.C @ after @ chain.R
        return Course(chain, whitened, time, dx, P, estimate,
                      normal[:, 0, 0] + self._mean_step @ prior - np.sum(right * dx, axis=1),
                      whitened.rows - dx.shape[1] + self._known,
                      _nonlinearity(step, P, time),
                      0.5 * np.sum(errors ** 2, axis=1) / np.sqrt(_tilt_variance(P)), C,
                      turned, turned @ P @ turned.transpose(0, 2, 1)
                      + errors_of @ whitened.P @ errors_of.transpose(0, 2, 1), gyro_bias)

    def step(self) -> Array:
        """Step from the point to the estimate, of all unknowns, shape (37,)."""
        dx = np.zeros(SIZE)
        dx[self.columns] = self.dx
        return dx

    def chain_errors(self) -> Array:
        """Estimated errors of the chain at the last epoch, as seen at t0, shape (m,)."""
        return self.whitener.X[:, 0] - self.whitener.X[:, 1:] @ self.dx

    def gyro_bias_covariance(self) -> Array:
        """Covariance of `gyro_bias`, shape (3, 3)."""
        J = np.eye(self.columns.size)[self._gyro[:3]]
        if self._rate_random_walk == 0.0:
            return J @ self.P @ J.T
        J -= self.whitener.X[-3:, 1:]
        return J @ self.P @ J.T + self.whitener.P[-3:, -3:]

    @property
    def log_likelihood(self) -> float:
        """Log likelihood at the best overall scale of all covariances, but for a constant."""
        scale = max(self.chi2 / max(self.dof, 1), 1.0)
        return -0.5 * (self.whitener.log_det + self.dof * math.log(scale) + self.chi2 / scale)


def _nonlinearity(step: Array, P: Array, time: Array) -> Array:
    """Second-order error of a step, shape (K, 37), in sigmas of tilt or heading, shape (K,)."""
    tilt_e, tilt_n, turn = np.abs(step[:, ATTITUDE].T)
    tilt = np.hypot(tilt_e, tilt_n) + time * np.sqrt(np.sum(step[:, GYRO_BIAS] ** 2, axis=1))
    return np.maximum(tilt * (0.5 * tilt + turn) / np.sqrt(_tilt_variance(P)),
                      0.5 * turn * turn / np.sqrt(P[:, 2, 2]))


def _tilt_variance(P: Array) -> Array:
    """Variance of the tilt about the axis where it is known best, rad^2, shape (K,)."""
    return np.minimum(P[:, 0, 0], P[:, 1, 1])
