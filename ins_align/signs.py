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
from ins_align.rotation import Array
from ins_align.unknowns import ATTITUDE, GYRO_MATRIX
import numpy as np

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
BETTER = 'the data fit better with {}: check the IMU axes'
UNCONFIRMED = 'the signs of the IMU axes are not confirmed by the motion yet: turn'
_SCALES = GYRO_MATRIX.start + np.array([0, 4, 8])
# Scale factor error of a gyroscope that is reversed; the sigma with which the data are asked for
# it; and what turns the attitude by less than so many sigmas does no harm.
REVERSED, SCALE_STD, HARMLESS = 2.0, 2.0, 2.0


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
    Asks whether other signs would fit the data as well.

    All signs of a sensor wrong, or one wrong axis (which is all wrong in a body frame turned half
    around), fit as well as the right ones until the vehicle has turned; that is asked now and
    then. One gyroscope that is reversed alone does no harm until the vehicle has turned about it;
    that is asked whenever it matters.
    """

    def __init__(self) -> None:
        """Start in doubt."""
        self._doubt_of_all = UNCONFIRMED
        self._explained = False             # by what is named there
        self._gyros_right = np.zeros(3, bool)
        self.restart()

    def restart(self) -> None:
        """Judge at the next question: the estimator is another one."""
        self._occasions = Occasions()
        self._least = np.zeros(3)           # evidence against a reversed gyro from this estimator

    def doubt(self, estimator: MapEstimator) -> str:
        """Return why the data do not show yet that the signs are right, or nothing."""
        of_one_gyro = self._doubt_of_one_gyro(estimator)
        if self._doubt_of_all and self._occasions.come(estimator):
            self._judge_all(estimator)
        # Where all of them are reversed one alone seems to be, too, and the other way round.
        return self._doubt_of_all if self._explained else of_one_gyro or self._doubt_of_all

    def _judge_all(self, estimator: MapEstimator) -> None:
        chi2, dof = sign_evidence(estimator)
        right = chi2.pop(RIGHT)
        rival = min(chi2, key=chi2.__getitem__)
        gain = GAIN * max(1.0, right / dof)
        self._explained = False
        if chi2[rival] > right + gain:
            self._doubt_of_all = ''
        elif chi2[rival] > right - gain:
            self._doubt_of_all = UNCONFIRMED
        else:
            self._doubt_of_all = BETTER.format(WRONG[rival])
            self._explained = chi2[rival] < estimator.MISFIT * dof

    def _doubt_of_one_gyro(self, estimator: MapEstimator) -> str:
        if self._gyros_right.all():
            return ''
        evidence, harm = one_gyro_evidence(estimator)
        # What was refused as outliers may be what spoke for it, and a fit that goes astray speaks
        # against it for a moment: that anything spoke for it counts until t0 moves.
        self._least = np.minimum(self._least, evidence)
        reversed_ = ~self._gyros_right & (self._least < -GAIN)
        if reversed_.any():
            axis = 'xyz'[int(np.argmin(np.where(reversed_, self._least, 0.0)))]
            return BETTER.format(f'the angular rate about {axis} reversed')
        self._gyros_right |= evidence + self._least > GAIN
        return UNCONFIRMED if np.any(~self._gyros_right & (harm > HARMLESS)) else ''


def sign_evidence(estimator: MapEstimator) -> tuple[dict[tuple[int, int], float], int]:
    """
    Fit the stored epochs afresh with the signs of gyros and accelerometers as they are or not.

    Returns
    -------
    chi2 : dict
        Chi-square by (sign of the gyros, sign of the accelerometers).
    dof : int
        Its degrees of freedom, at least 1.

    """
    raw = estimator.raw_intervals()
    fits = {signs: estimator.fitted_afresh(estimator.prior.mirrored(*signs), raw.mirrored(*signs))
            for signs in (RIGHT, *WRONG)}
    return {signs: fit.chi2 for signs, fit in fits.items()}, max(fits[RIGHT].dof, 1)


def one_gyro_evidence(estimator: MapEstimator) -> tuple[Array, Array]:
    """
    Ask the stored epochs for the scale factors of the gyroscopes, of which nothing is known.

    Returns
    -------
    evidence : ndarray, shape (3,)
        Chi-square of one being reversed, over that of its being right, in units of what is usual.
    harm : ndarray, shape (3,)
        By how many of its stated sigmas the attitude, then or now, would be another one.

    """
    told = estimator.solution
    assert told is not None
    free = estimator.loosened([(slice(place, place + 1), SCALE_STD) for place in _SCALES],
                              reconsider=True)
    places = np.searchsorted(free.columns, _SCALES)
    scale = free.estimate.sensors.gyro_matrix.diagonal()
    variance = free.P[places, places]
    usual = max(1.0, free.chi2 / max(free.dof, 1))
    turns = np.stack([free.P[ATTITUDE, places], free.turned @ free.P[:, places]])
    sigmas = np.sqrt(usual * np.stack([told.P.diagonal()[:3], told.covariance.diagonal()]))
    harm = np.max(np.abs(REVERSED * turns / variance) / sigmas[..., None], axis=(0, 1))
    return ((scale - REVERSED) ** 2 - scale ** 2) / (variance * usual), harm
