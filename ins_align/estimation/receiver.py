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
"""What innovations say of the receiver: how large its noise is, and how long its errors last."""

import math

from ins_align.geometry.rotation import Array
import numpy as np

# The noise is taken to be larger than stated when innovations are LOUD times as large in the mean
# square; that of a receiver that states none, or whose velocities are QUIET, is estimated, from
# LEAST_NOISE of the variance on. It follows at a rate, the mean square of velocities at another, a
# single epoch counting up to the last.
LOUD, QUIET, LEAST_NOISE, FOLLOW, LATELY, CLIP = 2.0, 0.25, 1e-2, 0.02, 0.05, 5.0
# Velocities below this (m/s) do not count as quiet: receivers smooth what stands.
MOVING = 1.0
# Errors of receivers, which filter, last so long (s). A mean of innovations over that time, which
# forgets at most this share with each, shows it; so much more than white noise makes of it is
# chance. Positions that come more often and state no noise say no more.
ERRORS_LAST, LASTING, CHANCE = 1.0, 0.2, 0.5
# Factor on variances that is worth a word.
MENTIONED = 1.5
# Epochs over which the mean square of innovations is taken, and those it is believed to be 1 for.
MEMORY, BELIEVED = 300, 30


class ReceiverNoise:
    """
    Follows the noise of a receiver.

    Attributes
    ----------
    misfit : float
        Mean square of normalised innovations.

    """

    def __init__(self) -> None:
        """Believe what is stated."""
        # Log of factors on variances, those configured and those stated: of velocity and position,
        # horizontal and vertical.
        self._noise = np.zeros((2, 2, 2))
        self._quiet = np.ones(2)    # mean square of velocities in motion, horizontal and vertical
        # When velocities and positions were heard last, and their intervals, up to `ERRORS_LAST`.
        self._heard_at, self._interval = [0.0, 0.0], [ERRORS_LAST, ERRORS_LAST]
        self.misfit = self._lasting = 1.0
        self._heard, self._mean = BELIEVED, np.zeros((2, 3))

    def start(self, kind: int, stated: bool, factor: float) -> None:
        """Begin with a factor on the variances of velocities (kind 0) or positions (1)."""
        self._noise[int(stated), kind] = math.log(factor)

    def factors(self, kind: int, stated: bool) -> Array:
        """Return factors on the sigmas of velocities or positions, east, north, up."""
        return np.exp(0.5 * self._noise[int(stated), kind, [0, 0, 1]])

    def hear(self, kind: int, stated: bool, moving: bool, square: float,
             normalised: Array, seconds: float) -> None:
        """
        Follow an innovation.

        It is of a velocity (kind 0) or a position (1), whose noise is stated or configured, while
        the antenna moves or not; normalised and squared, per row, and over its sigmas, east,
        north, up, (3,); so many seconds after the start.
        """
        interval, self._heard_at[kind] = seconds - self._heard_at[kind], seconds
        self._interval[kind] += LATELY * (min(interval, ERRORS_LAST) - self._interval[kind])
        alike = ERRORS_LAST / self._interval[kind]      # epochs whose errors may be the same
        east, north, up = np.square(normalised).tolist()
        noise = self._noise[int(stated), kind]
        heard = np.minimum([0.5 * (east + north), up], CLIP)
        estimated = np.full(2, not stated)
        if stated and kind == 0:
            if moving:
                self._quiet += LATELY * (heard - self._quiet)
            estimated = (noise < 0.0) | (self._quiet < QUIET)
        least = np.where(estimated & (moving | (not stated)),
                         math.log(LEAST_NOISE * (alike if kind else 1.0)), np.minimum(noise, 0.0))
        noise += FOLLOW * (heard - np.where(estimated, 1.0, LOUD))
        np.maximum(noise, least, out=noise)
        self._heard += 1
        share = 1 / min(self._heard, MEMORY)
        self.misfit += share * (min(square, CLIP) - self.misfit)
        # Of large ones the direction counts: they are outliers, or the heading is being found.
        mean = self._mean[kind]
        newest = min(LASTING, 1 / alike)
        mean += newest * (normalised / max(1.0, math.sqrt(square / CLIP)) - mean)
        long_run = float(mean @ mean) / 3 * (2 - newest) / newest
        self._lasting += share * (long_run - self._lasting)

    @property
    def inflation(self) -> float:
        """Factor on variances of results: innovations are larger than they should be, or last."""
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
