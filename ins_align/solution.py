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

from ins_align.preintegration import Intervals
from ins_align.rotation import Array, Index
from ins_align.unknowns import (ATTITUDE, GYRO_BIAS, inverse_spd, Prior, SIZE, START_POSITION,
                                START_VELOCITY, UNIFORM_ANGLE_STD, Unknowns)
from ins_align.whitening import (Chain, chain_noise, Measurements, POSITION, sensitivities,
                                 VELOCITY, Whitener)
import numpy as np

# What is always known: an angle lies on the circle, a velocity and a position are on the Earth.
WEAK_INFORMATION = np.zeros(SIZE)
WEAK_INFORMATION[ATTITUDE] = UNIFORM_ANGLE_STD ** -2
WEAK_INFORMATION[START_VELOCITY] = 1e4 ** -2
WEAK_INFORMATION[START_POSITION] = 1e7 ** -2
# The motion that the fit attributes to the vehicle has the noise of what was fitted to it, one
# unit of information for each: horizontal slope (tilt) and curvature (gyro bias) of the velocity.
FITTED_DIRECTIONS = 4
Gate = tuple[Array, Array]               # step to the present estimate, and its covariance


@dataclass
class Rows:
    """What a linearisation point makes of stored epochs; K of them."""

    chain: Chain
    noise: Array            # of the chain over each interval, (K, size, size)
    Y: Array                # residual and columns of the unknowns, (K, 6, 1 + n)
    covariance: Array       # of velocity and position, (K, 2, 3, 3)
    present: list[list[bool]]
    time: list[float]


class Solution:
    """
    The normal equations at one linearisation point, and what follows from them.

    Parameters
    ----------
    point : Unknowns
    prior : Prior
    columns : ndarray of int, shape (n,)
        Unknowns that are estimated, out of the 22.
    size : int
        9 when positions are used, 6 when velocities alone are.
    excess : float
        Share that is believed of the IMU noise measured in excess of the stated one.

    Attributes
    ----------
    chain : Chain
        At the last epoch, with the biases of `point`.
    whitener : Whitener
    dx : ndarray, shape (n,)
        Step from the point to the estimate, of the unknowns that are estimated.
    P : ndarray, shape (n, n)
        Covariance of the estimate.
    estimate : Unknowns
    chi2 : float
        Sum of squares of the whitened residuals at the estimate, prior included.
    dof : int

    """

    def __init__(self, point: Unknowns, prior: Prior, columns: Index, size: int,
                 excess: float) -> None:
        """Start empty, at t0."""
        information, step = prior.at(point)
        self.point = self.estimate = point
        self._columns, self._size, self._excess = columns, size, excess
        self.information = information[np.ix_(columns, columns)]
        self._mean_step = step[columns]
        self._weak = np.diag(WEAK_INFORMATION[columns])
        self.chain = Chain.start()
        self.whitener = Whitener(columns, size)
        self.dx = np.zeros(columns.size)
        self.P = np.zeros((columns.size, columns.size))
        self.chi2 = math.nan
        self.dof = 0
        self.time = 0.0                           # of the last epoch, seconds since t0

    def rows(self, gnss: Measurements, interval: Intervals) -> Rows:
        """Linearise K epochs that follow the chain; their intervals with the point's biases."""
        chain = self.chain.extended(interval)
        Y = sensitivities(self.point, chain, gnss, interval)
        noise = chain_noise(self.point.C, gnss.time, chain, interval, self._size, self._excess)
        return Rows(chain, noise, Y[:, :, self.whitener.columns], gnss.covariance,
                    gnss.present.tolist(), gnss.time.tolist())

    def add(self, rows: Rows, k: int, gate: 'Gate | None',
            gate_scale: float) -> list[tuple[float, Array]]:
        """Take one epoch into the normal equations; return the innovations of what is there."""
        self.time = rows.time[k]
        self.whitener.P += rows.noise[k]
        return [self.whitener.update(kind, rows.Y[k, block], rows.covariance[k, kind], gate,
                                     gate_scale)
                for kind, block in enumerate((VELOCITY, POSITION)) if rows.present[k][kind]]

    def solve(self) -> None:
        """Solve the normal equations and judge the fit."""
        whitener = self.whitener
        prior = self.information @ self._mean_step
        right = whitener.normal[1:, 0] + prior
        self.P = inverse_spd(self.information + whitener.normal[1:, 1:] + self._weak)
        self.dx = self.P @ right
        column = self.P[:, 2]
        feigned = min(whitener.spurious + FITTED_DIRECTIONS,
                      1 / column[2] - 1 / UNIFORM_ANGLE_STD ** 2)
        self.P += np.outer(column, column) * (feigned / (1 - feigned * column[2]))
        self.chi2 = float(whitener.normal[0, 0] + self._mean_step @ prior - right @ self.dx)
        self.dof = (whitener.rows - self.dx.size
                    + int(np.count_nonzero(self.information.diagonal())))
        self.estimate = self.point.moved(self.step())

    def step(self) -> Array:
        """Step from the point to the estimate, of all unknowns, shape (22,)."""
        dx = np.zeros(SIZE)
        dx[self._columns] = self.dx
        return dx

    def chain_errors(self) -> Array:
        """Estimated errors of the chain at the last epoch, as seen at t0, shape (6,) or (9,)."""
        return self.whitener.X[:, 0] - self.whitener.X[:, 1:] @ self.dx

    def nonlinearity(self) -> float:
        """Second-order error of the linearisation, in sigmas of tilt or heading."""
        tilt_e, tilt_n, turn = self.dx[ATTITUDE].tolist()
        tilt = (math.hypot(tilt_e, tilt_n)
                + self.time * math.hypot(*self.dx[GYRO_BIAS].tolist()))
        turn = abs(turn)
        variances = self.P.diagonal()[ATTITUDE].tolist()
        return max(tilt * (0.5 * tilt + turn) / math.sqrt(min(variances[:2])),
                   0.5 * turn * turn / math.sqrt(variances[2]))

    @property
    def log_likelihood(self) -> float:
        """Log likelihood at the best overall scale of all covariances, but for a constant."""
        scale = max(self.chi2 / max(self.dof, 1), 1.0)
        return -0.5 * (self.whitener.log_det + self.dof * math.log(scale) + self.chi2 / scale)
