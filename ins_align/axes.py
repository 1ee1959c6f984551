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
Sensors whose axes are not square to each other, as noise.

A gyro that is a little off its axis feels a part of the turns about the others, an accelerometer a
part of the forces along them, and a force shakes a gyro's bias. What is steady in this looks like
a bias and is estimated as one. What changes is taken for white noise with the spread that the
errors have after some seconds; as unknowns they would be 24.
"""

import math
from typing import NamedTuple

from ins_align.recent import AGES, Recent
from ins_align.rotation import Array
import numpy as np

# Over the error of the gyros' scale factors: how far the axes of gyros and of accelerometers are
# off, and what a force does to a gyro, rad/s per m/s^2.
GYRO_AXES, ACCEL_AXES, G_SENSITIVITY = 0.2, 0.3, 0.01
# Motion is averaged over this time (s): of what swings faster nothing remains.
CALM_TIME = 3.0
# What has been so since the start, or for this long (s), looks like a bias.
STEADY_TIME = 60.0


class AxesNoise(NamedTuple):
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


class Axes:
    """
    The motion that has become steady, and what of it has not.

    Parameters
    ----------
    gyro_scale_std : float
        Scale factor error of the gyros, 1 sigma; 0: axes are square.

    """

    def __init__(self, gyro_scale_std: float) -> None:
        """Nothing was seen yet."""
        self._scale_std = gyro_scale_std
        self._calm: Array | None = None         # rate and force
        self._steady = np.zeros(6)
        self._age = 0.0

    def noise(self, spacing: Array, recent: Recent) -> AxesNoise:
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
        # With it a turn that is soon over leaves the very spread that wrong axes give its end.
        density = self._scale_std * math.sqrt(2 * CALM_TIME) * unsteady
        force = np.sqrt(np.sum(np.square(density[:, 3:]), axis=1))[:, None]
        return AxesNoise(G_SENSITIVITY * force, ACCEL_AXES * force, GYRO_AXES * density[:, :3])

    def _step(self, seconds: float, motion: Array) -> Array:
        """Take the motion at the end of an interval; return how far it is from steady."""
        if self._calm is None:
            self._calm = self._steady = motion
        else:
            self._age += seconds
            self._calm = self._calm + (1 - math.exp(-seconds / CALM_TIME)) * (motion - self._calm)
            # The mean since the start, then one that forgets.
            share = max(seconds / (self._age + seconds), 1 - math.exp(-seconds / STEADY_TIME))
            self._steady = self._steady + share * (motion - self._steady)
        return self._calm - self._steady
