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
"""The arguments of `simulate`: one table, which the command line and the checks share."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
from functools import partial
import math
from numbers import Real
import reprlib
from typing import Any

from ins_align.config import checked, Config, ConfigError, ImuNoise, PRESETS, UsageError

# Factors of the three axes of the IMU, by the axis whose sign is wrong.
AXIS_SIGNS = {'': (1.0, 1.0, 1.0), 'x': (-1.0, 1.0, 1.0), 'y': (1.0, -1.0, 1.0),
              'z': (1.0, 1.0, -1.0)}

LATENESS_MARGIN = 0.5  # s by which gnss_lateness has to exceed the latency
_MAX_SAMPLES = 20_000_000

# An error can be simulated up to the maximum of the parameter of the aligner for it.
_MAXIMA = {field.name: field.metadata['maximum'] for field in dataclasses.fields(Config)}


def imu_errors_of(noise: ImuNoise) -> dict[str, float]:
    """
    Return the arguments of an IMU that has all errors which the estimator expects of its grade.

    As in the estimator, misalignment and the scale factor errors of the accelerometers are 0.3
    times the scale factor errors of the gyros.
    """
    return {'gyro_scale_std': noise.gyro_scale_std, 'rate_random_walk': noise.rate_random_walk,
            **dict.fromkeys(('gyro_misalignment_std', 'accel_scale_std',
                             'accel_misalignment_std'), 0.3 * noise.gyro_scale_std)}


# Defaults of the grade chip; the other grades have only noise and biases by default.
_CHIP_ERRORS = imu_errors_of(PRESETS['chip'])


class SimulationError(UsageError):
    """A simulation cannot be made as asked; the text says why."""


def _argument(default: Any, text: str, unit: str = '', minimum: float = 0.0,
              maximum: float = math.inf, *, group: str, names: tuple[str, ...] = (),
              choices: tuple[Any, ...] = ()) -> Any:
    """Return a field for a number, for one number per name, or for one of `choices`."""
    return dataclasses.field(default=default, metadata={
        'text': text, 'unit': unit, 'minimum': minimum, 'maximum': maximum, 'group': group,
        'names': names, 'choices': choices})


_imu, _motion, _gnss = (partial(_argument, group=group) for group in ('IMU', 'motion', 'GNSS'))


@dataclass(frozen=True)
class Arguments:
    """
    The arguments of `simulate`, checked; a SimulationError says which one makes no sense.

    Metadata of the fields from ``imu_rate`` on: ``text`` for the help, ``unit``, ``minimum`` and
    ``maximum`` (inclusive), ``choices``, ``names`` of several numbers, and ``group`` of options.
    None as the default makes a field optional.
    """

    scenario: str
    imu_grade: str | ImuNoise = 'mems'
    seed: int = 0
    duration: float | None = None
    ideal: bool = False
    outages: Sequence[tuple[float, float]] = ()

    # At higher rates rounding of perfect readings would show beside the noise of the best grade.
    imu_rate: float = _imu(100.0, 'samples per second', 'Hz', 1e-3, 1e3)
    imu_jitter: float = _imu(0.0, 'samples are off their time by up to this part of the interval '
                             'between them; stamps tell the displaced instants', '1', 0.0, 0.49)
    lever_arm: Sequence[float] = _imu(
        (1.0, 1.0, 1.0), 'IMU to antenna in the IMU frame', 'm', -_MAXIMA['lever_arm'],
        _MAXIMA['lever_arm'], names=('X', 'Y', 'Z'))
    mount_rpy_deg: Sequence[float] = _imu(
        (0.0, 0.0, 0.0), 'attitude of the IMU in the vehicle', 'deg', -math.inf,
        names=('ROLL', 'PITCH', 'YAW'))
    gyro_bias_std: float | None = _imu(
        None, "gyroscope bias, 1 sigma per axis; default: the grade's", 'rad/s', 0.0,
        math.radians(_MAXIMA['gyro_bias_std']))
    accel_bias_std: float | None = _imu(
        None, "accelerometer bias, 1 sigma per axis; default: the grade's", 'm/s^2', 0.0,
        _MAXIMA['accel_bias_std'])
    accel_bias: Sequence[float] | None = _imu(
        None, 'accelerometer bias itself, instead of a drawn one', 'm/s^2',
        -_MAXIMA['accel_bias_std'], _MAXIMA['accel_bias_std'], names=('X', 'Y', 'Z'))
    gyro_scale_std: float | None = _imu(
        None, 'scale factor error of each gyroscope, 1 sigma, 0.01 is one percent; default: 0, '
        'of a chip what its grade states', '1', 0.0, _MAXIMA['gyro_scale_std'])
    gyro_misalignment_std: float | None = _imu(
        None, 'what a gyroscope feels of the rate about each other axis, 1 sigma; default: 0, '
        'of a chip what its grade states', '1')
    accel_scale_std: float | None = _imu(
        None, 'the same of the accelerometers: scale factor error', '1')
    accel_misalignment_std: float | None = _imu(
        None, 'the same of the accelerometers: misalignment', '1')
    rate_random_walk: float | None = _imu(
        None, 'how the biases of the gyroscopes change; default: 0, of a chip what its grade '
        'states', 'rad/s/sqrt(s)', 0.0, math.radians(_MAXIMA['rate_random_walk']) / 60)
    dead_band: Sequence[float] = _imu(
        (0.0, 0.0), 'gyroscopes and accelerometers read 0 below this', 'rad/s and m/s^2',
        names=('GYRO', 'ACCEL'))
    quantum: Sequence[float] = _imu(
        (0.0, 0.0), 'gyroscopes and accelerometers read multiples of this', 'rad/s and m/s^2',
        names=('GYRO', 'ACCEL'))
    flip_axis: str = _imu('', 'this axis of the IMU has the wrong sign', choices=tuple(AXIS_SIGNS))
    flip_gyro: str = _imu('', 'this angular rate alone has the wrong sign',
                          choices=tuple(AXIS_SIGNS))
    accel_sign: int = _imu(1, '-1: the accelerometers have the sign of gravity', choices=(1, -1))

    latitude_deg: float = _motion(48.0, 'where it starts', 'deg', -89.0, 89.0)
    longitude_deg: float = _motion(11.0, 'where it starts', 'deg', -math.inf)
    altitude: float = _motion(300.0, 'where it starts', 'm', -1e3, 1e5)
    heading_deg: float = _motion(
        0.0, 'turns the trajectory: course of the start, counter-clockwise from east', 'deg',
        -math.inf)
    crab_deg: float = _motion(0.0, 'the nose points so far left of the course', 'deg', -math.inf)
    stand_still: float = _motion(0.0, 'at rest before setting off', 's')

    gnss_rate: float = _gnss(5.0, 'epochs per second', 'Hz', 1e-3, 1e4)
    gnss_phase: float = _gnss(0.0137, 'stamp of the first epoch; by default no IMU sample is at '
                              'a GNSS stamp', 's')
    gnss_latency: float = _gnss(0.0, 'messages arrive so long after their stamp', 's', 0.0,
                                _MAXIMA['gnss_lateness'] - LATENESS_MARGIN)
    gnss_delay: float = _gnss(0.0, 'measurements are older than their stamp by this', 's', 0.0,
                              _MAXIMA['gnss_delay'])
    velocity_std: float = _gnss(0.1, 'white noise of the velocity, 1 sigma, horizontal', 'm/s')
    velocity_std_vertical: float | None = _gnss(None, 'and vertical; default: the same', 'm/s')
    position_std: float = _gnss(2.5, 'white noise of the position, 1 sigma, horizontal; vertical '
                                'twice that', 'm')
    velocity_drift_std: float = _gnss(
        0.0, 'errors of the velocity that last (first-order Gauss-Markov), 1 sigma per axis; not '
        'in the stated covariance', 'm/s')
    position_drift_std: float = _gnss(
        0.0, 'errors of the position that last, 1 sigma per axis; not in the stated covariance',
        'm')
    gnss_correlation: float = _gnss(60.0, 'time constant of the errors that last', 's', 1e-3)
    outlier_rate: float = _gnss(0.0, 'part of the epochs that are spoilt', '1', 0.0, 1.0)
    outlier_velocity: float = _gnss(5.0, 'by how much they are, in a random direction', 'm/s')
    outlier_position: float = _gnss(50.0, 'by how much they are, in a random direction', 'm')
    velocity_frame: str = _gnss('enu', 'ned: the receiver sends north-east-down',
                                choices=('enu', 'ned'))

    def __post_init__(self) -> None:
        from ins_align.simulation.scenarios import SCENARIOS  # the help does without numpy

        # `in` a tuple, because a wrong value need not be hashable.
        _require('scenario', self.scenario, f'one of {", ".join(SCENARIOS)}',
                 self.scenario in tuple(SCENARIOS))
        grade = self.imu_grade
        _require('imu_grade', grade, f'one of {", ".join(PRESETS)} or an ImuNoise with figures '
                 'above 0', all(_is_number(figure) and figure > 0 for figure in grade[:4])
                 if isinstance(grade, ImuNoise) else grade in tuple(PRESETS))
        _require('seed', self.seed, 'an integer, 0 or above',
                 _is_number(self.seed) and self.seed == int(self.seed) and self.seed >= 0)
        _require('outages', self.outages, 'pairs of a start and a later end in seconds',
                 all(hasattr(pair, '__len__') and len(pair) == 2 and pair[0] < pair[1]
                     for pair in self.outages))
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.metadata and not (value is None and field.default is None):
                try:
                    checked(field, value)
                except ConfigError as error:
                    raise SimulationError(error) from None
        if self.duration is None:
            object.__setattr__(self, 'duration',
                               SCENARIOS[self.scenario].duration + self.stand_still)
        _require('duration', self.duration, 'a number of seconds above 0',
                 _is_number(self.duration) and self.duration > 0)
        rate = max(self.imu_rate, self.gnss_rate)
        if self.duration * rate > _MAX_SAMPLES:
            raise SimulationError(f'{self.duration:g} s at {rate:g} Hz are too many '
                                  f'samples, the limit is {_MAX_SAMPLES}')
        for name, of_chip in _CHIP_ERRORS.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, of_chip if grade == 'chip' else 0.0)

    @property
    def imu_noise(self) -> ImuNoise:
        """Return the noise of the IMU and the sigmas of its constant errors, in SI units."""
        noise = PRESETS[self.imu_grade] if isinstance(self.imu_grade, str) else self.imu_grade
        return noise._replace(**{name: value for name in ImuNoise._fields
                                 if (value := getattr(self, name, None)) is not None})


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _require(name: str, value: Any, expected: str, fits: bool) -> None:
    if not fits:
        raise SimulationError(f'{name} must be {expected}, got {reprlib.repr(value)}')
