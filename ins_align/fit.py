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
"""How well the data fit the model, as a method tells it and the declaration judges it."""

from dataclasses import dataclass
import math

from ins_align.rotation import Array
import numpy as np


@dataclass(frozen=True)
class Innovation:
    """
    What was new in an epoch.

    Attributes
    ----------
    nis : float
        Normalised innovation squared, per row; nan where nothing was tested.
    normalised : ndarray, shape (3,)
        Innovation of the velocity (of the position where only that is used) over its sigma.

    """

    nis: float
    normalised: Array


NOTHING_NEW = Innovation(math.nan, np.full(3, math.nan))


@dataclass(frozen=True)
class Fit:
    """How well the data fit the model: sums, and the last epoch's innovation."""

    chi2: float
    dof: int
    innovation: Innovation
    converged: bool
    rejected_velocity: int
    rejected_position: int
    rejected: int               # epochs with any of these
    offered: int                # epochs that were offered to the model, rejected ones included
    delay: float                # of the GNSS, seconds; the told one where none is estimated
    # Variances of velocities and positions over the stated ones.
    gnss_noise: tuple[float, float] = (1.0, 1.0)
    walk: float = 1.0           # rate random walk of the gyros over the stated one
    objection: str = ''         # what the data say against what is told, in words
    lasting: float = 1.0        # factor on variances: errors of the GNSS last

    @property
    def factor(self) -> float:
        """A-posteriori factor on sigmas, at least 1."""
        if self.dof <= 0:
            return math.inf
        return math.sqrt(max(1.0, self.lasting * self.chi2 / self.dof))

    @property
    def lasting_factor(self) -> float:
        """Part of that factor, at least 1: errors of the GNSS last."""
        return 1.0 if self.dof <= 0 else self.factor / math.sqrt(max(1.0, self.chi2 / self.dof))

    @property
    def significant_scale(self) -> float:
        """Factor on covariances that are handed on: 1 unless the misfit cannot be chance."""
        if self.dof <= 0 or self.chi2 / self.dof < 1 + 3 * math.sqrt(2 / self.dof):
            return 1.0
        return self.chi2 / self.dof


def no_fit(offered: int, delay: float) -> Fit:
    """Return what is known before there is a solution."""
    return Fit(math.nan, 0, NOTHING_NEW, False, 0, 0, 0, offered, delay)
