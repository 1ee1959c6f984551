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
What is told for certain, and what the data say against it.

That is a lever arm, a delay, or that the biases of the IMU are as small as its grade has them.
"""

from typing import NamedTuple

from ins_align.config import Config, PRESETS
from ins_align.estimator import MapEstimator
from ins_align.rotation import Array, log_so3
from ins_align.signs import Occasions
from ins_align.unknowns import ACCEL_BIAS, ATTITUDE, DELAY, GYRO_BIAS, LEVER_ARM, Unknowns
import numpy as np


class _Told(NamedTuple):
    """
    Unknowns that are said to be known.

    Attributes
    ----------
    free : tuple of (slice, float)
        Their places, and what they may be off by where they are not known (SI).
    certain_std : float
        Told to be known better than this, the first of them, they are looked at (SI).
    gain : float
        That another one fits better is no chance when it has so much less chi-square: one in
        100 000.

    """

    free: tuple[tuple[slice, float], ...]
    certain_std: float
    gain: float


LEVER_TOLD = _Told(((LEVER_ARM, 2.0),), 0.3, 26.0)
DELAY_TOLD = _Told(((DELAY, 0.1),), 0.03, 20.0)
_POOR = PRESETS['mems']
BIASES_TOLD = _Told(((GYRO_BIAS, _POOR.gyro_bias_std), (ACCEL_BIAS, _POOR.accel_bias_std)),
                    0.3 * _POOR.gyro_bias_std, 33.0)
# At this share of the gain a heading is not declared any more.
HELD_BACK = 0.5


class ToldCheck:
    """
    Asks now and then whether the data fit better when something is not as it was told.

    Parameters
    ----------
    config : Config

    """

    def __init__(self, config: Config) -> None:
        """Start without doubt."""
        self._config = config
        self._looked_at = [told for told, std in (
            (LEVER_TOLD, config.lever_arm_std), (DELAY_TOLD, config.gnss_delay_std),
            (BIASES_TOLD, config.imu_noise.gyro_bias_std)) if std < told.certain_std]
        self._gain, self._words = 0.0, ''
        self._judged_at = 0                 # epochs that were stored then
        self.restart()

    def restart(self) -> None:
        """
        Judge another estimator from now on.

        An objection stays until as many epochs as have raised it do not share it.
        """
        self._occasions = Occasions(self._judged_at if self._gain > 1.0 else 0)

    def ask(self, estimator: MapEstimator, lasting: float = 1.0) -> None:
        """
        Ask the data for something else than was told, if it is time.

        Parameters
        ----------
        estimator : MapEstimator
            With the data.
        lasting : float
            By how much variances are larger than if the errors of the GNSS were white.

        """
        if self._looked_at and estimator.converged and self._occasions.come(estimator):
            told, self._gain, free = max(
                ((told, *_gain(told, estimator, lasting)) for told in self._looked_at),
                key=lambda tried: tried[1])
            self._words, self._judged_at = self._in_words(told, free), estimator.count

    @property
    def unconfirmed(self) -> str:
        """Words against declaring a heading, or none."""
        return self._words if self._gain > HELD_BACK else ''

    @property
    def objection(self) -> str:
        """Words of the data against what was told, or none."""
        return self._words if self._gain > 1.0 else ''

    def _in_words(self, told: _Told, estimate: Unknowns) -> str:
        config = self._config
        if told is DELAY_TOLD:
            return (seem_late(float(config.gnss_delay + estimate.delay), config)
                    + ', set gnss_delay, or raise gnss_delay_std')
        if told is BIASES_TOLD:
            gyro = _listed(np.degrees(estimate.sensors.gyro_bias), '.2g')
            accel = _listed(estimate.sensors.accel_bias, '.2g')
            return (f'the data fit better with biases of [{gyro}] deg/s and [{accel}] m/s^2, more '
                    f'than imu_grade {config.imu_grade} expects: set the grade of the IMU, or '
                    'raise gyro_bias_std and accel_bias_std')
        return (f'the data fit better with a lever arm of [{_listed(estimate.lever_b, ".2f")}] m: '
                'check lever_arm (its signs, the axes of the IMU), or raise lever_arm_std')


def _listed(vector: Array, digits: str) -> str:
    return ', '.join(format(number, digits) for number in vector.tolist())


def seem_late(delay: float, config: Config) -> str:
    """Return the beginning of a sentence: stamps are late by so many seconds, not as told."""
    return (f'the GNSS stamps seem to be {delay:.2f} s late, gnss_delay is {config.gnss_delay:g} '
            f'and gnss_delay_std {config.gnss_delay_std:g}: check the clocks')


def _gain(told: _Told, estimator: MapEstimator, lasting: float) -> tuple[float, Unknowns]:
    """Return what the data gain if it is not so, over what is no chance; and the estimate then."""
    free, solution = estimator.loosened(told.free), estimator.solution
    assert solution is not None
    if free.dof != solution.dof:
        # A refit may have taken epochs that were outliers when they came: compare like with like.
        solution = estimator.loosened(())
    scale = max(1.0, solution.chi2 / max(solution.dof, 1))
    moved = max(float(np.max(np.abs(log_so3(C_free @ C.T)) / np.sqrt(scale * np.diag(P))))
                for C_free, C, P in ((free.estimate.C, solution.estimate.C,
                                      solution.P[ATTITUDE, ATTITUDE]),
                                     (free.C, solution.C, solution.covariance)))
    usual = max(1.0, free.chi2 / max(free.dof, 1))
    if told is not BIASES_TOLD:         # residuals of an IMU worse than told last too
        usual *= lasting
    # What hardly moves the attitude does little harm.
    return (solution.chi2 - free.chi2) / (usual * told.gain) * min(moved, 1.0) ** 2, free.estimate
