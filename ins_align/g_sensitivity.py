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
What forces make of the gyros' bias, as noise.

A force shifts a gyro's bias (g-sensitivity). What is steady in this looks like a bias and is
estimated as one. What changes is taken for white noise that leaves the spread of this error
behind; as unknowns it would be nine. Scale factors and misalignment are unknowns.
"""

import math

from ins_align.recent import AGES, Recent
from ins_align.rotation import Array
import numpy as np

# rad/s per m/s^2, over the error of the gyros' scale factors.
G_SENSITIVITY = 0.01
# A force is averaged over this time (s): of what swings faster nothing remains.
CALM_TIME = 3.0
# What has been so since the start, or for this long (s), looks like a bias.
STEADY_TIME = 60.0


class GSensitivity:
    """
    The noise that a force makes of the gyros' biases: how far it is from steady.

    Parameters
    ----------
    gyro_scale_std : float
        Scale factor error of the gyros, 1 sigma, to which g-sensitivity is in proportion.

    """

    def __init__(self, gyro_scale_std: float) -> None:
        """Nothing was seen yet."""
        self._scale_std = gyro_scale_std
        # Shape (2, 3): the calm force, and what is steady in it.
        self._means: Array | None = None
        self._age = 0.0

    def noise(self, spacing: Array, recent: Recent) -> Array:
        """
        Return what the force makes of the gyros' biases.

        Parameters
        ----------
        spacing : ndarray, shape (K,)
            Seconds of each interval.
        recent : Recent
            Motion before the end of each.

        Returns
        -------
        ndarray, shape (K, 1)
            Noise density about any axis, rad/sqrt(s).

        """
        unsteady = np.zeros((spacing.size, 3))
        if self._scale_std > 0:
            self._follow(spacing, recent.gained[:, -1] / AGES[-1], unsteady)
        # A push that is soon over leaves the spread that such gyros give its end.
        size = np.sqrt(np.sum(np.square(unsteady), axis=1, keepdims=True))
        return G_SENSITIVITY * self._scale_std * math.sqrt(2 * CALM_TIME) * size

    def _follow(self, spacing: Array, forces: Array, unsteady: Array) -> None:
        """Take the force at the end of each interval; put how far it is from steady."""
        if self._means is None:
            self._means = np.stack([forces[0], forces[0]])
            spacing, forces, unsteady = spacing[1:], forces[1:], unsteady[1:]
        ages = np.cumsum(np.append(self._age, spacing))
        self._age = ages[-1]
        # Means since the start, then such as forget.
        seconds = spacing[:, None]
        shares = np.maximum(seconds / (ages[1:, None] + seconds),
                            1 - np.exp(-seconds / np.array([CALM_TIME, STEADY_TIME])))
        for share, force, away in zip(shares[..., None], forces, unsteady):
            self._means = self._means + share * (force - self._means)
            away[:] = self._means[0] - self._means[1]
