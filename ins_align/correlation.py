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
What errors of the GNSS that last from epoch to epoch make of sigmas.

Receivers filter their velocities. The mean of N errors with the autocorrelations rho_k has
1 + 2 sum rho_k times the variance that it would have if they were white; the sum is weighted as by
Newey and West (1987, doi:10.2307/1913610).
"""

import math

from ins_align.estimator import MapEstimator
from ins_align.rotation import Array
from ins_align.signs import Occasions
import numpy as np

# Epochs over which errors may hang together, and over how many the mean counts.
LAGS, MEMORY = 10, 300
# In sigmas of what white noise shows by chance, two rows to an epoch; what is more is believed.
# That is asked at every epoch, for hours.
SIGNIFICANT = 5.0
_WEIGHTS = 2.0 * (1.0 - np.arange(1, LAGS + 1) / (LAGS + 1))
_CHANCE = math.sqrt(float(_WEIGHTS @ _WEIGHTS) / 2.0)


class Correlation:
    """
    Watches innovations for errors that last, and asks what they do to the attitude.

    Attributes
    ----------
    gnss : float
        By how much variances that come from the GNSS are larger than if its errors were white.

    """

    def __init__(self) -> None:
        """Take errors for white."""
        self.gnss = 1.0
        self._products = np.zeros(LAGS)
        self._square = self._count = 0.0
        self._last = np.zeros((LAGS, 3))            # the newest first
        self._share = self._earlier_share = 0.0     # of the GNSS in the attitude's variance
        self._occasions = Occasions()

    def restart(self) -> None:
        """Go on with another estimator, which knows from the one before what that found out."""
        self._earlier_share, self._occasions = self._share, Occasions()

    def add(self, normalised: Array) -> None:
        """Take the innovation of the next epoch, in its sigmas, shape (3,); nan: there is none."""
        length = math.hypot(*normalised.tolist())
        if math.isnan(length):
            return
        # Outliers come in groups, and innovations are large for a while when the heading is found:
        # of large ones the direction counts.
        now = normalised / max(length, 1.0)
        keep = 1.0 - 1.0 / MEMORY
        self._products = keep * self._products + self._last @ now
        self._square = keep * self._square + float(now @ now)
        self._count = keep * self._count + 1.0
        self._last[1:] = self._last[:-1]
        self._last[0] = now
        if self._square > 0.0:
            chance = SIGNIFICANT * _CHANCE / math.sqrt(self._count)
            lasting = float(_WEIGHTS @ self._products) / self._square
            self.gnss = 1.0 + max(0.0, lasting - chance)

    def ask(self, estimator: MapEstimator) -> None:
        """Ask for the share of the GNSS, if it is time and makes a difference."""
        if self.gnss > 1.0 and estimator.converged and self._occasions.come(estimator):
            self._share = estimator.gnss_share(self._earlier_share)

    @property
    def attitude(self) -> float:
        """By how much variances of the attitude are larger."""
        return 1.0 + self._share * (self.gnss - 1.0)
