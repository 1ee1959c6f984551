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
"""Intervals between GNSS epochs as the estimation takes them, and the errors that sensors have."""

from dataclasses import dataclass
from typing import NamedTuple

from ins_align.geometry.rotation import apply, Array, exp_so3, log_so3
import numpy as np


class SensorErrors(NamedTuple):
    """
    Errors of gyros and accelerometers that stay: true = measured - matrix @ measured - bias.

    A matrix has scale factor errors on its diagonal and misalignments beside it.
    """

    gyro_bias: Array        # (3,), rad/s
    gyro_matrix: Array      # (3, 3)
    accel_bias: Array       # (3,), m/s^2
    accel_matrix: Array     # (3, 3)

    @staticmethod
    def none() -> 'SensorErrors':
        """Return those of perfect sensors."""
        return SensorErrors.of(np.zeros(24))

    @staticmethod
    def of(vector: Array) -> 'SensorErrors':
        """Return those that make up a vector, shape (24,), the matrices row by row."""
        return SensorErrors(vector[:3], vector[3:12].reshape(3, 3), vector[12:15],
                            vector[15:].reshape(3, 3))


@dataclass(frozen=True)
class Intervals:
    """
    Preintegrated IMU data of K intervals, each in the body frame at the interval's start.

    Attributes
    ----------
    duration : ndarray, shape (K,)
        Seconds.
    R : ndarray, shape (K, 3, 3)
        Rotation from the body frame at the end to the one at the start.
    v, p : ndarray, shape (K, 3)
        Integral and double integral of the specific force, m/s and m.
    J_Rg, J_vg, J_pg, J_va, J_pa : ndarray, shape (K, 3, 12)
        Derivatives to bias and matrix of the gyros (g) and of the accelerometers (a), in the order
        of `SensorErrors.of`: of the rotation as a left error (``R <- exp_so3(J_Rg d) R``), of v,
        of p.
    Q : ndarray, shape (K, 9, 9)
        Covariance of the errors (rotation at the start, v, p) that the sensors' noise leaves.
    Q_excess : ndarray, shape (K, 9, 9)
        The same for the noise that was measured in excess of what is stated.
    omega : ndarray, shape (K, 3)
        Angular rate at the end of the interval, as measured.
    gained, turned : ndarray, shape (K, RUNGS, 3)
        Before the end of the interval, as measured; see `Recent`.

    """

    duration: Array
    R: Array
    v: Array
    p: Array
    J_Rg: Array
    J_vg: Array
    J_pg: Array
    J_va: Array
    J_pa: Array
    Q: Array
    Q_excess: Array
    omega: Array
    gained: Array
    turned: Array

    def take(self, index: 'slice | Array') -> 'Intervals':
        """Return the intervals of `index`."""
        return Intervals(**{name: array[index] for name, array in vars(self).items()})

    def end(self) -> 'Intervals':
        """Return the interval of no length, and without noise, at the end of a single one."""
        none = {name: np.zeros_like(array) for name, array in vars(self).items()}
        return Intervals(**none | {'R': np.eye(3)[None], 'omega': self.omega,
                                   'gained': self.gained, 'turned': self.turned})

    def mirrored(self, signs: Array) -> 'Intervals':
        """
        Return what the intervals would be with the signs of sensors changed, leading axes (K, M).

        `signs`, shape (M, 4), are those of the gyros x, y, z and of the accelerometers. To second
        order in the rotation over an interval, with rate and force steady in it: good for telling
        the signs apart.
        """
        gyro, accel = signs[:, :3], signs[:, 3:]
        wider = {name: array[:, None] for name, array in vars(self).items()}
        if (signs == 1).all():
            shape = self.duration.size, len(signs)
            return Intervals(**wider | {
                name: np.broadcast_to(array, shape + array.shape[2:])
                for name, array in wider.items() if name != 'duration'} | {
                    'duration': self.duration})
        turn = log_so3(self.R)[:, None]
        # Forces act on average half and, for the way, a third of the rotation after the start.
        half, third = (exp_so3(part * gyro * turn) @ exp_so3(-part * turn) for part in (1/2, 1/3))
        ones = np.ones((len(signs), 3))
        # What a bias does stays; an entry of a matrix is one in proportion to what is mirrored.
        of_gyro = np.hstack([ones, np.tile(gyro, 3)])[:, None]
        of_accel = np.hstack([ones, np.tile(accel, 9)])[:, None]
        force = accel[:, None]
        return Intervals(**wider | {
            'duration': self.duration, 'R': exp_so3(gyro * turn),
            'v': accel * apply(half, wider['v']), 'p': accel * apply(third, wider['p']),
            'J_Rg': of_gyro * (half @ wider['J_Rg']),
            'J_vg': force * of_gyro * (half @ wider['J_vg']),
            'J_pg': force * of_gyro * (third @ wider['J_pg']),
            'J_va': of_accel * (half @ wider['J_va']), 'J_pa': of_accel * (third @ wider['J_pa']),
            'omega': gyro * wider['omega'], 'gained': force * wider['gained'],
            'turned': gyro[:, None] * wider['turned']})
