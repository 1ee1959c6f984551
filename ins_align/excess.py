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
How much of the IMU noise that is measured in excess of what is stated is believed.

Vibration looks like white noise from sample to sample and is less than that over seconds. How much
less, only the innovations of the GNSS show, and that takes seconds.
"""

from ins_align.rotation import Array
import numpy as np

# Shares of the excess that may be right. By how much the log likelihood of one may be below the
# best one's; and by how much of what earlier epochs say is handed on: it may be another vibration.
SHARES = (1 / 27, 1 / 9, 1 / 3, 1.0)
IN_DOUBT, REMEMBERED = 3.0, 10.0
# Excess counts when its variance is so many times the stated one. It is judged again when its sum
# over all epochs is so many times what it was, or their number is.
LOUD, GROWTH = 10.0, 2.0
# Where the covariance of an interval has variances of the rotation and the velocity.
_ROTATION, _VELOCITY = 0, 3


class ExcessJudge:
    """
    Judges what share of the excess is believed once a heading is declared.

    Until then too much noise makes it late, afterwards too little makes it wrong: vibration that
    sets in counts in full until the data show that it is less.

    Attributes
    ----------
    declared : bool
        Whether a heading is, or was.

    """

    def __init__(self) -> None:
        """Hear of nothing yet."""
        self.declared = False
        self._earlier = self._evidence = np.zeros(len(SHARES))
        self.restart()

    def restart(self) -> None:
        """Go on with another estimator, whose epochs come after those of the one before."""
        self._earlier = np.maximum(self._evidence, -REMEMBERED)
        # Epochs, and the excess of rotation and velocity in all of them; those when last judged.
        self._heard, self._judged = np.zeros(3), np.zeros(3)

    def hear(self, stated: Array, excess: Array) -> None:
        """
        Take the noise of the next epoch's interval, from a declaration on.

        Parameters
        ----------
        stated, excess : ndarray, shape (9, 9)
            `Q` and `Q_excess` of `Intervals`.

        """
        if not self.declared:
            return
        self._heard[0] += 1.0
        for place, own in ((1, _ROTATION), (2, _VELOCITY)):
            if excess[own, own] > LOUD * stated[own, own]:
                self._heard[place] += excess[own, own]

    @property
    def competent(self) -> bool:
        """Whether there is something to judge since a declaration."""
        return bool(self._heard[1:].any())

    @property
    def due(self) -> bool:
        """Whether it is time to judge."""
        return self.competent and bool(np.any(self._heard > GROWTH * self._judged))

    def share(self, log_likelihoods: Array) -> float:
        """
        Return the largest share that may be right.

        Parameters
        ----------
        log_likelihoods : ndarray
            Of all epochs of the present estimator, with each of `SHARES`.

        """
        self._judged = self._heard.copy()
        evidence = self._earlier + log_likelihoods
        self._evidence = evidence - evidence.max()
        return max(share for share, compared in zip(SHARES, self._evidence)
                   if compared >= -IN_DOUBT)
