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
What is left of an IMU's calibration errors beside biases and gyro scale factors, as noise.

A gyro whose axis is misaligned feels a part of the turns about the others, an accelerometer a part
of the forces along them, and a force shifts a gyro's bias (g-sensitivity). What is steady in this
looks like a bias and is estimated as one. What changes is taken for white noise that leaves the
spread of these errors behind; as unknowns they would be 24.
"""

import math
from typing import NamedTuple

from ins_align.recent import AGES, Recent
from ins_align.rotation import Array
import numpy as np

# Over the error of the gyros' scale factors: misalignment of the gyros, misalignment and scale
# factors of the accelerometers, g-sensitivity of the gyros (rad/s per m/s^2).
GYRO_MISALIGNMENT, ACCEL_ERRORS, G_SENSITIVITY = 0.1, 0.3, 0.01
# Motion is averaged over this time (s): of what swings faster nothing remains.
CALM_TIME = 3.0
# What has been so since the start, or for this long (s), looks like a bias.
STEADY_TIME = 60.0


class CalibrationNoise(NamedTuple):
    """
    Noise densities of K intervals.

    Attributes
    ----------
    gyro, accel : ndarray, shape (K, 1)
        rad/sqrt(s), m/s/sqrt(s), about and along any axis.
    across : ndarray, shape (K, 3)
        rad/sqrt(s), about the axes perpendicular to this vector in the body frame.

    """

    gyro: Array
    accel: Array
    across: Array


class CalibrationErrors:
    """
    The noise that a motion makes of the errors of a calibration: how far it is from steady.

    Parameters
    ----------
    gyro_scale_std : float
        Scale factor error of the gyros, 1 sigma, to which the others are in proportion.

    """

    def __init__(self, gyro_scale_std: float) -> None:
        """Nothing was seen yet."""
        self._scale_std = gyro_scale_std
        # Of rate and force, shape (2, 6): the calm motion, and what is steady in it.
        self._means: Array | None = None
        self._age = 0.0

    def noise(self, spacing: Array, recent: Recent) -> CalibrationNoise:
        """
        Return what the motion makes of the sensors' errors.

        Parameters
        ----------
        spacing : ndarray, shape (K,)
            Seconds of each interval.
        recent : Recent
            Motion before the end of each.

        """
        unsteady = np.zeros((spacing.size, 6))
        if self._scale_std > 0:
            motion = np.concatenate([recent.turned[:, -1], recent.gained[:, -1]],
                                    axis=1) / AGES[-1]
            unsteady[:] = [self._step(*step) for step in zip(spacing.tolist(), motion)]
        # A turn that is soon over leaves the spread that misaligned axes give its end.
        density = self._scale_std * math.sqrt(2 * CALM_TIME) * unsteady
        force = np.sqrt(np.sum(np.square(density[:, 3:]), axis=1))[:, None]
        return CalibrationNoise(G_SENSITIVITY * force, ACCEL_ERRORS * force,
                                GYRO_MISALIGNMENT * density[:, :3])

    def _step(self, seconds: float, motion: Array) -> Array:
        """Take the motion at the end of an interval; return how far it is from steady."""
        if self._means is None:
            self._means = np.stack([motion, motion])
        else:
            self._age += seconds
            # Means since the start, then such as forget.
            share = np.maximum(seconds / (self._age + seconds),
                               1 - np.exp(-seconds / np.array([[CALM_TIME], [STEADY_TIME]])))
            self._means = self._means + share * (motion - self._means)
        calm, steady = self._means
        return calm - steady
