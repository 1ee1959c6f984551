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
"""Whether the data show that the signs of the IMU's axes are right, and when to ask them."""

from ins_align.estimator import MapEstimator

# What is in doubt is judged again when the data have grown by the first share, and by the second
# beyond so many epochs; signs are confirmed when every other choice has so much more chi-square.
GROWTH = 0.05, 0.3
SOON = 200
GAIN = 12.0
RIGHT = (1, 1)
WRONG = {
    (1, -1): 'the accelerations reversed (sign of gravity instead of specific force?)',
    (-1, 1): 'the angular rates reversed',
    (-1, -1): 'one IMU axis reversed (left-handed axes?)',
}


class Occasions:
    """
    When to judge again: not at every epoch, for it takes fits of all that is stored.

    Parameters
    ----------
    first : int
        Epochs that the first judgement waits for.

    """

    def __init__(self, first: int = 0) -> None:
        """Nothing was judged yet."""
        self._next = float(first)

    def come(self, estimator: MapEstimator) -> bool:
        """Whether it is time, and if so, set the next one."""
        if estimator.measured < estimator.FIRST_FIT or estimator.count < self._next:
            return False
        self._next = estimator.count * (1 + GROWTH[estimator.count > SOON])
        return True


class SignCheck:
    """
    Asks now and then whether another choice of signs would fit the data as well.

    A wrong sign, or one wrong axis (which is all three wrong in a body frame turned half around),
    fits as well as the right ones until the vehicle has turned.
    """

    def __init__(self) -> None:
        """Start in doubt."""
        self._doubt = 'the signs of the IMU axes are not judged yet'
        self.restart()

    def restart(self) -> None:
        """Judge at the next question: the estimator is another one."""
        self._occasions = Occasions()

    def doubt(self, estimator: MapEstimator) -> str:
        """Return why the data do not show yet that the signs are right, or nothing."""
        if self._doubt and self._occasions.come(estimator):
            chi2 = sign_evidence(estimator)
            right = chi2.pop(RIGHT)
            rival = min(chi2, key=chi2.__getitem__)
            if chi2[rival] > right + GAIN:
                self._doubt = ''
            elif chi2[rival] > right - GAIN:
                self._doubt = ('the signs of the IMU axes are not confirmed by the motion yet: '
                               'turn')
            else:
                self._doubt = f'the data fit better with {WRONG[rival]}: check the IMU axes'
        return self._doubt


def sign_evidence(estimator: MapEstimator) -> dict[tuple[int, int], float]:
    """
    Fit the stored epochs afresh with the signs of gyros and accelerometers as they are or not.

    Returns
    -------
    dict
        Chi-square by (sign of the gyros, sign of the accelerometers), in units of what is usual
        for the right signs.

    """
    raw = estimator.raw_intervals()
    chi2 = {}
    scale = 1.0
    for signs in (RIGHT, *WRONG):
        solution = estimator.fitted_afresh(estimator.prior.mirrored(*signs), raw.mirrored(*signs))
        if signs == RIGHT:
            scale = max(1.0, solution.chi2 / max(solution.dof, 1))
        chi2[signs] = solution.chi2 / scale
    return chi2
