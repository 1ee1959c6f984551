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
"""The noise of the receiver, estimated from innovations: how large it is, how long it lasts."""

import math

from ins_align.geometry.rotation import Array
import numpy as np

# The noise is taken to be larger than stated when the mean square of normalised innovations is
# above LOUD. Where a receiver states none, or that mean square is below QUIET for velocities, the
# noise is estimated, down to LEAST_NOISE of the variance. FOLLOW and LATELY are the gains, per
# epoch, of the noise and of the mean square of velocities; one epoch counts up to CLIP.
LOUD, QUIET, LEAST_NOISE, FOLLOW, LATELY, CLIP = 2.0, 0.25, 1e-2, 0.02, 0.05, 5.0
# Velocities below this (m/s) do not count as quiet: receivers smooth them at rest.
MOVING = 1.0
# Errors of receivers, which filter, last so long (s). The mean of innovations over that time, with
# a gain of at most LASTING per epoch, shows it where its square exceeds that of white noise by
# CHANCE. Positions without a covariance that come more often give no more information.
ERRORS_LAST, LASTING, CHANCE = 1.0, 0.2, 0.5
# Factor on variances that is worth a word.
MENTIONED = 1.5
# Epochs over which the mean square of innovations is taken, and those it is believed to be 1 for.
MEMORY, BELIEVED = 300, 30


class ReceiverNoise:
    """
    Estimates the noise of a receiver.

    Attributes
    ----------
    misfit : float
        Mean square of normalised innovations.

    """

    def __init__(self) -> None:
        """Start with what the receiver states."""
        # Log of factors on variances: configured or stated, of velocity or position, horizontal or
        # vertical.
        self._noise = np.zeros((2, 2, 2))
        self._quiet = np.ones(2)    # mean square of velocities in motion, horizontal and vertical
        # Times of the last velocity and position, and mean intervals, up to `ERRORS_LAST`, s.
        self._last, self._interval = [0.0, 0.0], [ERRORS_LAST, ERRORS_LAST]
        self.misfit = self._lasting = 1.0
        self._count, self._mean = BELIEVED, np.zeros((2, 3))

    def start(self, kind: int, stated: bool, factor: float) -> None:
        """Begin with a factor on the variances of velocities (kind 0) or positions (1)."""
        self._noise[int(stated), kind] = math.log(factor)

    def factors(self, kind: int, stated: bool) -> Array:
        """Return factors on the sigmas of velocities or positions, east, north, up."""
        return np.exp(0.5 * self._noise[int(stated), kind, [0, 0, 1]])

    def follow(self, kind: int, stated: bool, moving: bool, square: float,
               normalised: Array, seconds: float) -> None:
        """
        Adapt the noise to an innovation.

        Parameters
        ----------
        kind : int
            0: of a velocity, 1: of a position.
        stated : bool
            Whether the receiver states its noise, or it is configured.
        moving : bool
            Whether the antenna moves.
        square : float
            Normalised innovation squared, per row.
        normalised : ndarray, shape (3,)
            Innovation over its sigmas, east, north, up.
        seconds : float
            Since the start.

        """
        interval, self._last[kind] = seconds - self._last[kind], seconds
        self._interval[kind] += LATELY * (min(interval, ERRORS_LAST) - self._interval[kind])
        alike = ERRORS_LAST / self._interval[kind]      # epochs with the same error
        east, north, up = np.square(normalised).tolist()
        noise = self._noise[int(stated), kind]
        squares = np.minimum([0.5 * (east + north), up], CLIP)
        estimated = np.full(2, not stated)
        if stated and kind == 0:
            if moving:
                self._quiet += LATELY * (squares - self._quiet)
            estimated = (noise < 0.0) | (self._quiet < QUIET)
        least = np.where(estimated & (moving | (not stated)),
                         math.log(LEAST_NOISE * (alike if kind else 1.0)), np.minimum(noise, 0.0))
        noise += FOLLOW * (squares - np.where(estimated, 1.0, LOUD))
        np.maximum(noise, least, out=noise)
        self._count += 1
        share = 1 / min(self._count, MEMORY)
        self.misfit += share * (min(square, CLIP) - self.misfit)
        # Large innovations are clipped: they are outliers, or the heading is not known yet.
        mean = self._mean[kind]
        newest = min(LASTING, 1 / alike)
        mean += newest * (normalised / max(1.0, math.sqrt(square / CLIP)) - mean)
        long_run = float(mean @ mean) / 3 * (2 - newest) / newest
        self._lasting += share * (long_run - self._lasting)

    @property
    def inflation(self) -> float:
        """Factor on variances of results, for innovations that are too large or that last."""
        return max(1.0, self.misfit, self._lasting - CHANCE)

    def in_words(self) -> str:
        """Return how the noise is larger than stated or configured, as the end of a sentence."""
        words = ''.join(f'; the GNSS {name} are {math.exp(noise / 2):.2g} times as noisy as '
                        + whose for whose, noises in zip(('configured', 'stated'),
                                                         self._noise.max(axis=2))
                        for name, noise in zip(('velocities', 'positions'), noises)
                        if math.exp(noise) > MENTIONED)
        if self._lasting - CHANCE > max(MENTIONED, self.misfit):
            words += ('; errors of the GNSS last from epoch to epoch: sigmas are '
                      f'{math.sqrt(self.inflation):.1f} times larger')
        return words
