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
The unknowns of an alignment and what is known of them beforehand.

All 37 of them have their place in one vector; an estimator takes those columns that it estimates.
"""

from dataclasses import dataclass, replace
import math

from ins_align.earth import EARTH_RATE
from ins_align.preintegration import SensorErrors
from ins_align.rotation import Array, by_row, exp_so3, Index, log_so3
import numpy as np
from numpy.typing import ArrayLike

# A heading is never known worse than uniform on the circle.
UNIFORM_ANGLE_STD = math.pi / math.sqrt(3)
# Over the error of the gyros' scale factors: their misalignment; scale factors and misalignment of
# the accelerometers.
GYRO_MISALIGNMENT, ACCEL_ERRORS = 0.3, 0.3


@dataclass(frozen=True)
class Unknowns:
    """
    The unknowns, or a point to linearise at.

    Attributes
    ----------
    C : ndarray, shape (3, 3)
        Initial attitude ``C_nb(0)``.
    sensors : SensorErrors
    start_velocity, start_position : ndarray, shape (3,)
        Of the IMU at t0 in n0, relative to the antenna's track (c_v, c_p of docs, "Theory").
    lever_b : ndarray, shape (3,)
        Metres.
    delay : float or, in many at a time, ndarray
        Seconds by which a GNSS measurement is older than its stamp.

    """

    C: Array
    sensors: SensorErrors
    start_velocity: Array
    start_position: Array
    lever_b: Array
    delay: float | Array

    def vector(self) -> Array:
        """All but the attitude, which has three zeros, shape (37,)."""
        return np.concatenate([np.zeros(3), self.sensors.vector(), self.start_velocity,
                               self.start_position, self.lever_b, [self.delay]])

    def moved(self, dx: Array) -> 'Unknowns':
        """Return the point moved by `dx`, shape (..., 37)."""
        return Unknowns(exp_so3(dx[..., ATTITUDE]) @ self.C,
                        SensorErrors.of(self.sensors.vector() + dx[..., SENSORS]),
                        self.start_velocity + dx[..., START_VELOCITY],
                        self.start_position + dx[..., START_POSITION],
                        self.lever_b + dx[..., LEVER_ARM], self.delay + dx[..., DELAY.start])

    def at(self, index: int) -> 'Unknowns':
        """Return one of many."""
        C, sensors, *others = vars(self).values()
        return Unknowns(C[index], SensorErrors(*(array[index] for array in sensors)),
                        *(array[index] for array in others))

    def minus(self, other: 'Unknowns') -> Array:
        """Return the step from `other` to this point, shape (37,)."""
        step = self.vector() - other.vector()
        step[:3] = log_so3(self.C @ other.C.T)
        return step


# Places of the blocks in the full vector of unknowns.
ATTITUDE, GYRO_BIAS, GYRO_MATRIX = slice(0, 3), slice(3, 6), slice(6, 15)
ACCEL_BIAS, ACCEL_MATRIX = slice(15, 18), slice(18, 27)
START_VELOCITY, START_POSITION = slice(27, 30), slice(30, 33)
LEVER_ARM, DELAY = slice(33, 36), slice(36, 37)
SIZE = 37
# Of the antenna: where it is, and when.
ANTENNA = np.r_[LEVER_ARM, DELAY]
# Bias and matrix.
GYRO, ACCEL = slice(GYRO_BIAS.start, GYRO_MATRIX.stop), slice(ACCEL_BIAS.start, ACCEL_MATRIX.stop)
SENSORS = slice(GYRO.start, ACCEL.stop)
# Unknowns that outlive a new t0 and do not depend on the heading.
BODY_FIXED = np.r_[SENSORS, LEVER_ARM, DELAY]


@dataclass(frozen=True)
class Prior:
    """
    What is known of x before the data: a mean and an information matrix over all 37 unknowns.

    With `heading_free` the heading of the mean is arbitrary and carries no information.
    """

    mean: Unknowns
    information: Array
    heading_free: bool

    def _known(self) -> tuple[Index, Array]:
        """Unknowns of which something is known, and their covariance."""
        known = np.flatnonzero(np.diag(self.information))
        return known, inverse_spd(self.information[np.ix_(known, known)])

    def mirrored(self, gyro_sign: float, accel_sign: float) -> 'Prior':
        """Return what is known but for the attitude, were the signs of the sensors changed."""
        known, covariance = self._known()
        kept = np.isin(known, BODY_FIXED)
        unknowns, covariance = known[kept], covariance[np.ix_(kept, kept)]
        # Biases that were learnt under the wrong signs hold the Earth's rate, seen upside down.
        gyro = np.isin(unknowns, np.r_[GYRO_BIAS])
        covariance[gyro, gyro] += (2 * EARTH_RATE) ** 2
        sign = np.ones(SIZE)
        sign[GYRO_BIAS], sign[ACCEL_BIAS] = gyro_sign, accel_sign
        sign = sign[unknowns]
        zero = np.zeros(3)
        sensors = self.mean.sensors
        sensors = sensors._replace(gyro_bias=gyro_sign * sensors.gyro_bias,
                                   accel_bias=accel_sign * sensors.accel_bias)
        mean = replace(self.mean, C=np.eye(3), sensors=sensors, start_velocity=zero,
                       start_position=zero)
        return prior_of(mean, covariance * np.outer(sign, sign), unknowns, False)

    def loosened(self, block: slice, std: float) -> 'Prior':
        """Return what is known if a block of unknowns may be off by `std` besides, 1 sigma."""
        known, of_known = self._known()
        unknowns = np.union1d(known, np.r_[block])
        covariance = np.zeros((SIZE, SIZE))
        covariance[np.ix_(known, known)] = of_known
        covariance[block, block] += std ** 2 * np.eye(block.stop - block.start)
        return prior_of(self.mean, covariance[np.ix_(unknowns, unknowns)], unknowns,
                        self.heading_free)

    def without(self, block: slice) -> 'Prior':
        """Return what is known of the other unknowns."""
        if not self.information[block].any():
            return self
        known, covariance = self._known()
        kept = ~np.isin(known, np.r_[block])
        return prior_of(self.mean, covariance[np.ix_(kept, kept)], known[kept], self.heading_free)

    def with_antenna_of(self, other: 'Prior') -> 'Prior':
        """Return this, which knows nothing of lever arm and delay, with what another knows."""
        known, covariance = other._known()
        places = np.flatnonzero(np.isin(known, ANTENNA))
        information = self.information.copy()
        information[np.ix_(known[places], known[places])] = inverse_spd(
            covariance[np.ix_(places, places)])
        mean = replace(self.mean, lever_b=other.mean.lever_b, delay=other.mean.delay)
        return replace(self, mean=mean, information=information)

    def at(self, point: Unknowns) -> tuple[Array, Array]:
        """
        Return the information about the step from `point`, and the mean of that step.

        What the past has told about tilt and velocity it told about axes of the body: under
        another heading it is information about other axes of the navigation frame.
        """
        mean = self.mean
        turn = point.C @ mean.C.T
        psi = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        Rz = exp_so3([0.0, 0.0, psi])
        if self.heading_free:
            mean = replace(mean, C=Rz @ mean.C)
        information = self.information.copy()
        for block in (ATTITUDE, START_VELOCITY, START_POSITION):
            information[block] = Rz @ information[block]
            information[:, block] = information[:, block] @ Rz.T
        return information, mean.minus(point)


def first_prior(gyro_bias_std: float, accel_bias_std: float, lever_b: Array,
                lever_std: float, delay: float, delay_std: float,
                gyro_scale_std: float = 0.0, force: ArrayLike = (0.0, 0.0, 0.0)) -> Prior:
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
    gyro_scale_std : float
        Per axis, 0.01 is one percent, to which misalignment and the errors of the accelerometers
        are in proportion; 0: none of these.
    force : array_like, shape (3,)
        Specific force, m/s^2, at which all errors of the accelerometers together are as large as
        their biases are said to be.

    """
    std = np.full(SIZE, math.inf)
    std[GYRO_BIAS], std[ACCEL_BIAS] = gyro_bias_std, accel_bias_std
    if gyro_scale_std > 0:
        std[GYRO_MATRIX] = gyro_matrix_std(gyro_scale_std).ravel()
        std[ACCEL_MATRIX] = ACCEL_ERRORS * gyro_scale_std
    if lever_std > 0:
        std[LEVER_ARM] = lever_std
    if delay_std > 0:
        std[DELAY] = delay_std
    zero = np.zeros(3)
    mean = Unknowns(np.eye(3), SensorErrors.none(), zero, zero, np.asarray(lever_b, dtype=float),
                    delay)
    told = np.eye(SIZE)                     # what the sigmas are of, out of the unknowns
    if gyro_scale_std > 0:
        told[ACCEL_BIAS, ACCEL_MATRIX] = by_row(np.eye(3), np.asarray(force, dtype=float))
    return Prior(mean, told.T @ np.diag(std ** -2.0) @ told, False)


def gyro_matrix_std(gyro_scale_std: float) -> Array:
    """Return sigma of scale factors and misalignment, shape (3, 3)."""
    return gyro_scale_std * np.where(np.eye(3) > 0, 1.0, GYRO_MISALIGNMENT)


def prior_of(mean: Unknowns, covariance: Array, unknowns: Index, heading_free: bool) -> Prior:
    """Prior from the covariance of some unknowns; nothing is known of the others."""
    information = np.zeros((SIZE, SIZE))
    information[np.ix_(unknowns, unknowns)] = inverse_spd(covariance)
    return Prior(mean, information, heading_free)


def inverse_spd(matrix: Array) -> Array:
    """
    Inverse of a symmetric positive definite matrix whose rows differ widely in scale.

    Parameters
    ----------
    matrix : ndarray, shape (..., n, n)
        Each on its own.

    """
    scale = 1 / np.sqrt(np.diagonal(matrix, axis1=-2, axis2=-1))
    scale = scale[..., :, None] * scale[..., None, :]
    inverse = np.linalg.inv(matrix * scale) * scale
    return 0.5 * (inverse + inverse.swapaxes(-1, -2))
