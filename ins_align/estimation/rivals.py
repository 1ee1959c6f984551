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
The rivals: hypotheses about the sensors beside the configuration.

Each is a change to the filter, a prior probability and a sentence, and is a bank of its own on the
same data. While a rival that is `wrong` is as likely as the configuration and gives another
attitude, no heading is declared. The others are levels, worse IMUs or another lever arm or delay
than configured, which count in results by their likelihood.
"""

from dataclasses import dataclass, replace
import math

from ins_align.config import Config, ImuNoise, PRESETS
from ins_align.estimation.filter import Filters, NEGLIGIBLE
from ins_align.estimation.states import (
    biases, DELAY, DRIFT, FIRST, GYRO, LEVER_ARM, MARGIN, MOUNT, OF_VEHICLE, triads)
from ins_align.geometry.rotation import Array, log_so3
import numpy as np

# Sigmas over that of the gyros' scale factors: of the gyros' misalignment, and of scale factors
# and misalignment of the accelerometers.
GYRO_MISALIGNMENT, ACCEL_ERRORS = 0.3, 0.3
# In this time (s) the biases of the accelerometers change by the first share of their sigma, with
# temperature, and the delay by the second, where nothing synchronises the clocks of IMU and GNSS.
WANDER_TIME, ACCEL_WANDER, DELAY_WANDER = 100.0, 0.1, 0.2
# Means are dropped when their log weight is UNLIKELY below that of the likeliest, and wrong rivals
# when they are HOPELESS below. Levels are never dropped, for they may become true: their evidence
# is held at LEAST below the best, which no mixture includes. A level whose accelerometer biases
# are more improbable than STRAINED (log) has gone astray, which the held evidence does not show:
# it is held lower by the excess.
UNLIKELY, HOPELESS, LEAST, STRAINED = 14.0, 25.0, NEGLIGIBLE + 1.0, 8.0
# Means of a rival that agree to so many sigmas are merged.
ALIKE = 2.0
# A wrong rival whose attitude agrees to so many sigmas does no harm: on a flat floor nothing ever
# shows the signs of two gyros.
HARMLESS = 1.0
# A setting is named for a bias that is so many times its configured sigma, less so many of its
# own sigmas, and not beyond the last, 4 sigmas of ten times the bias: otherwise it is no bias.
LARGE_BIAS, SURELY, NO_BIAS = 2.0, 2.0, 40.0
# Sigma of the velocity of a vehicle sideways and upwards that lasts (m/s: slip of tyres, leeway
# and current, wind); it changes by its sigma in this time (s), as the wind does for an aeroplane
# that turns.
DRIFTS = {'car': 0.1, 'boat': 1.0, 'aeroplane': 10.0}
DRIFT_TIME = 30.0
# Share of the IMU's measured noise beyond the stated one that counts: vibration looks white
# from sample to sample and is less than that over seconds.
SHARE = 1 / 27


@dataclass(frozen=True)
class Rival:
    """Another hypothesis about the sensors."""

    wrong: str = ''  #: what it assumes that must not be aligned with; empty for a level
    remark: str = ''  #: what is said while this level is the likeliest, with places for parameters
    #: Of the gyros x, y, z and of the accelerometers.
    signs: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    gyro: float = 1.0  #: factor on the gyros' errors, and on their rate random walk
    accel: float = 1.0  #: factor on the accelerometers' errors
    grade: str = ''  #: the preset of the IMU whose errors it has at least
    lever_arm_std: float = 0.0  #: at least so much (SI), as the next
    gnss_delay_std: float = 0.0
    #: Of a vehicle: 1 forwards, -1 backwards along its x axis; 0: it moves as it likes.
    along: int = 0
    prior: float = 0.0  #: log of how likely it is before the data, over the configuration

    def sigmas(self, noise: ImuNoise) -> tuple[float, ...]:
        """
        Return the sigmas of the errors of an IMU that is configured as `noise`, in SI units.

        Those of the gyros' biases, the accelerometers' biases, the gyros' rate random walk, the
        gyros' scale factors and the accelerometers' scale factors.
        """
        least = PRESETS[self.grade] if self.grade else noise
        gyro, accel = min(self.gyro, WORSE_SCALE), min(self.accel, WORSE_SCALE)
        return (max(self.gyro * noise.gyro_bias_std, least.gyro_bias_std),
                max(self.accel * noise.accel_bias_std, least.accel_bias_std),
                max(self.gyro * noise.rate_random_walk, least.rate_random_walk),
                max(gyro * noise.gyro_scale_std, least.gyro_scale_std),
                ACCEL_ERRORS * max(accel * noise.gyro_scale_std, least.gyro_scale_std))


# Levels: factors on the biases of gyros and accelerometers, and log prior; the first level is the
# configuration. Scale factors and misalignment are at most so many times larger. The last level is
# also at least as bad as the next worse preset: `mems`, or `chip` for MEMS. Where an IMU of
# navigation grade is configured, with gyro biases below PRECISE of those of `tactical`, a MEMS IMU
# is a contradiction: its biases would explain a velocity in another frame as well.
PRECISE = 0.5
WORSE = ((1, 1, 0), (1, 3, -3), (1, 10, -5), (3, 1, -5.5), (10, 1, -11), (10, 10, -16))
WORSE_SCALE = 3.0
LEVELS = tuple(Rival(gyro=gyro, accel=accel, prior=prior) for gyro, accel, prior in WORSE)
SIGNS = (
    Rival('the accelerations reversed (sign of gravity instead of specific force?)',
          signs=(1.0, 1.0, 1.0, -1.0)),
    Rival('the angular rates reversed', signs=(-1.0, -1.0, -1.0, 1.0)),
    Rival('one IMU axis reversed (left-handed axes?)', signs=(-1.0, -1.0, -1.0, -1.0)),
    Rival('the angular rate about x reversed', signs=(-1.0, 1.0, 1.0, 1.0)),
    Rival('the angular rate about y reversed', signs=(1.0, -1.0, 1.0, 1.0)),
    Rival('the angular rate about z reversed', signs=(1.0, 1.0, -1.0, 1.0)))
GRADE = Rival('errors as large as those of a MEMS IMU', grade='mems', prior=-6.0)
# Levels for a parameter that is configured with a smaller sigma (SI) than this.
CERTAIN = (
    ('lever_arm_std', 0.3, Rival(lever_arm_std=2.0, prior=-6.0, remark=(
        'a lever arm of [{lever}] m fits better than the configured one: check its signs and the '
        'axes of the IMU, or raise lever_arm_std'))),
    ('gnss_delay_std', 0.03, Rival(gnss_delay_std=0.1, prior=-6.0, remark=(
        'GNSS stamps that are {delay:.2f} s late fit better than gnss_delay: check the clocks, '
        'set it, or raise gnss_delay_std'))))


def rivals_of(config: Config) -> tuple[Rival, ...]:
    """Return the rivals of a configuration, which itself comes first."""
    bias = config.imu_noise.gyro_bias_std
    precise = bias < PRECISE * PRESETS['tactical'].gyro_bias_std
    grade = '' if precise else next(
        (grade for grade in ('mems', 'chip') if PRESETS[grade].gyro_bias_std > bias), '')
    levels = (*LEVELS[:-1], replace(LEVELS[-1], grade=grade),
              *(level for name, std, level in CERTAIN if getattr(config, name) < std))
    rivals = (*levels, *(() if config.trust_imu_axes else SIGNS), *((GRADE,) if precise else ()))
    if config.vehicle == 'none':
        return rivals
    return (*(replace(rival, along=1) for rival in rivals),
            *(replace(level, along=-1) for level in levels), *levels)


class Rivals:
    """
    The table of a configuration's rivals, its columns as arrays, and how they are judged.

    Attributes
    ----------
    table : tuple of Rival
        R rivals, of which the first is the configuration.
    signs, prior, along : ndarray, shapes (R, 4), (R,), (R,)
        Their fields.
    mixed : ndarray of bool, shape (R,)
        Whether a rival is part of results. Wrong rivals are not, nor those without the assumption
        on a vehicle where one is configured, which are there to contradict it.
    x : ndarray, shape (m,)
        Parameters of the body before the data.
    P, walk : ndarray, shapes (R, m, m), (R, n)
        Their covariance under each rival, and the random walk of all errors: what the covariance
        gains on its diagonal in a second.

    """

    def __init__(self, config: Config, force: Array) -> None:
        """Make the table; `force` is as in `parameters_of`."""
        self.table = rivals_of(config)
        self.signs = np.array([rival.signs for rival in self.table])
        self.prior = np.array([rival.prior for rival in self.table])
        self.along = np.array([rival.along for rival in self.table])
        self._wrong = np.array([bool(rival.wrong) for rival in self.table])
        self.mixed = ~self._wrong & ((self.along != 0) | (config.vehicle == 'none'))
        (self.x, *_), P, walk = zip(*(parameters_of(config, rival, force) for rival in self.table))
        self.P, self.walk = np.array(P), np.array(walk)

    def use_prior(self, x: Array, P: Array, age: float) -> None:
        """Start from what an earlier alignment found, with a variance that has grown since (s)."""
        body = slice(x.size)                    # parameters of a vehicle may be missing
        self.x[body] = x
        variance = P.diagonal()
        for k in np.flatnonzero(~self._wrong):
            grown = np.minimum(variance + age * self.walk[k, FIRST:][body],
                               self.P[k].diagonal()[body])
            self.P[k, body, body] = P + np.diag(np.maximum(grown - variance, 0.0))

    def select(self, filters: Filters) -> None:
        """Drop means and rivals that are unlikely, merge means that agree."""
        ids, level = filters.ids, filters.evidence
        wrong, along = self._wrong[ids], self.along[ids]
        best = level[filters.best]
        x = filters.x[filters.lead]
        off = x[:, biases(x.shape[1])[1]] - filters.accel_expected
        strain = 0.5 * np.sum(off ** 2 / filters.accel_variance, axis=1)
        least = best - LEAST - np.maximum(strain - STRAINED, 0.0)
        filters.evidence = np.where(wrong, level, np.maximum(level, least)) - best
        if filters.single and not (wrong.any() or along.any()):
            return
        keep = filters.weight > filters.weight[filters.lead][filters.place] - UNLIKELY
        keep &= (~wrong | (filters.evidence - self.prior[ids] > -HOPELESS))[filters.place]
        # The direction in which a vehicle did not set out is dropped for good.
        for direction in {1, -1} & set(along.tolist()):
            there = along == direction
            if np.max(level[there]) < best - LEAST:
                keep &= ~there[filters.place]
        if not keep.all():
            filters.keep(keep)
        filters.merge(ALIKE)

    def doubt(self, filters: Filters, mean: Array, P: Array) -> tuple[str, bool]:
        """
        Ask the wrong rivals whether they speak against a mean attitude with its covariance.

        Both are as `Filters.mixture` returns them. Returns why a heading is not to be declared, or
        '', and whether the data fit better with one of the rivals.
        """
        wrong = self._wrong[filters.ids]
        if not wrong.any():
            return '', False
        # How much likelier each wrong rival is than all levels together.
        level = filters.evidence
        ahead = np.where(wrong, level - np.logaddexp.reduce(level[filters.mixed]), -np.inf)
        if not np.any(ahead > -MARGIN):
            return '', False
        C = np.stack([filters.C0[filters.lead], filters.C[filters.lead]], axis=1)
        away = log_so3(C @ mean.swapaxes(-1, -2)) / np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        ahead[np.abs(away).max(axis=(1, 2)) <= HARMLESS] = -np.inf
        worst = int(np.argmax(ahead))
        if ahead[worst] <= -MARGIN:
            return '', False
        rival = self.table[filters.ids[worst]]
        what, known = (('imu_grade', 'imu_grade is') if rival.grade
                       else ('the IMU axes', 'the signs of the IMU axes are'))
        # The prior of a bad IMU must not make a wrong configuration likely: before it is called
        # wrong, the rival has to fit better than each level does without its prior.
        fits = np.max((level - self.prior[filters.ids])[filters.mixed])
        if level[worst] - fits > MARGIN:
            return f'the data fit better with {rival.wrong}: check {what}', True
        return f'{known} not confirmed by the motion yet: turn and change speed', False


def parameters_of(config: Config, rival: Rival, force: Array) -> tuple[Array, Array, Array]:
    """
    Return the parameters of the body under a rival, x, P and walk of `Rivals`, before the data.

    `force`, (3,), is the specific force, m/s^2, at which all errors of the accelerometers together
    are as large as their biases are said to be.
    """
    noise = config.imu_noise
    matrices = noise.gyro_scale_std > 0
    vehicle = config.vehicle != 'none'
    x, std, walk = np.zeros((3, GYRO + (24 if matrices else 6) + OF_VEHICLE * vehicle))
    accel = triads(x.size)[1].start
    if vehicle:
        drift = config.vehicle_velocity_std or DRIFTS[config.vehicle]
        std[MOUNT], std[DRIFT] = math.radians(config.mount_yaw_std), drift
        walk[DRIFT] = drift ** 2 / DRIFT_TIME
    x[LEVER_ARM] = config.lever_arm
    std[LEVER_ARM] = max(config.lever_arm_std, rival.lever_arm_std)
    std[DELAY] = max(config.gnss_delay_std, rival.gnss_delay_std)
    gyro_std, accel_std, walk_std, gyro_scale, accel_scale = rival.sigmas(noise)
    std[GYRO:GYRO + 3], std[accel:accel + 3] = gyro_std, accel_std
    walk[DELAY] = (DELAY_WANDER * config.gnss_delay_std) ** 2 / WANDER_TIME
    walk[GYRO:GYRO + 3] = walk_std ** 2
    walk[accel:accel + 3] = (ACCEL_WANDER * accel_std) ** 2 / WANDER_TIME
    P = np.diag(std ** 2)
    if matrices:
        P[GYRO + 3:accel, GYRO + 3:accel] = np.diag(gyro_matrix_std(gyro_scale).ravel() ** 2)
        # At the force f the error b + M f of bias b and matrix M has the sigma of the bias.
        told = np.eye(12)
        told[:3, 3:] = -np.kron(np.eye(3), force)
        sigmas = np.repeat([accel_std, accel_scale], [3, 9])
        P[accel:accel + 12, accel:accel + 12] = told @ np.diag(sigmas ** 2) @ told.T
    return x, P, np.concatenate([np.zeros(FIRST), walk])


def level_in_words(level: Rival, config: Config, x: Array, P: Array) -> str:
    """
    Return how the sensors differ from the configuration, as the end of a sentence, or ''.

    `x`, (m,), and `P`, (m, m), are the parameters of the level and their covariance. A setting is
    named where a bias is surely far larger than configured: an IMU that looks worse for other
    reasons gets no better with a setting, and takes longer.
    """
    if level.remark:
        lever = ', '.join(f'{number:.2f}' for number in x[LEVER_ARM].tolist())
        return '; ' + level.remark.format(lever=lever, delay=config.gnss_delay + float(x[DELAY]))
    if level.gyro == level.accel == 1:
        return ''
    noise, std = config.imu_noise, np.sqrt(np.diag(P))
    settings = []
    for name, places, configured, unit in zip(
            ('gyro_bias_std', 'accel_bias_std'), biases(x.size),
            (noise.gyro_bias_std, noise.accel_bias_std), (math.degrees(1.0), 1.0)):
        found = np.abs(x[places])
        if (np.any(found - SURELY * std[places] > LARGE_BIAS * configured)
                and found.max() < NO_BIAS * configured):
            settings.append(f'{name}={unit * found.max():.2g}')
    if level.grade and settings:
        settings = [f'imu_grade={level.grade}']
    if settings:
        return ('; the biases of the IMU are larger than configured, which sigmas allow for: set '
                + ' and '.join(settings))
    worse = [sensors for sensors, factor in (
        ('gyros', level.gyro), ('accelerometers', level.accel)) if factor > 1]
    bias = (f'imu_grade={level.grade}' if level.grade
            else f'{max(level.gyro, level.accel):g} times the bias')
    return (f'; the {" and ".join(worse)} look worse than configured, as with {bias}, '
            'which sigmas allow for: coarse readings, scale factors, vibration or GNSS errors '
            'that last')


def gyro_matrix_std(scale_std: float) -> Array:
    """Return sigmas of scale factors (diagonal) and misalignment of the gyros, shape (3, 3)."""
    return scale_std * np.where(np.eye(3) > 0, 1.0, GYRO_MISALIGNMENT)
