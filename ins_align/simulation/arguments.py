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
"""Checks of what a simulation is asked for."""

from collections.abc import Callable
import math
from typing import Any

from ins_align.config import ImuNoise, parameters, PRESETS
from ins_align.simulation.scenarios import SCENARIOS
import numpy as np

VELOCITY_FRAMES = ('enu', 'ned')
IMU_AXES = {'': (1.0, 1.0, 1.0), 'x': (-1.0, 1.0, 1.0), 'y': (1.0, -1.0, 1.0),
            'z': (1.0, 1.0, -1.0)}

LATENESS_MARGIN = 0.5  # s, of gnss_lateness over the latency
_MAX_SAMPLES = 20_000_000


class SimulationError(ValueError):
    """A simulation cannot be made as asked; the text says why."""


def checked_arguments(arguments: dict[str, Any]) -> ImuNoise:
    """Raise SimulationError for an argument without sense; return the IMU's noise."""
    def number(value: Any) -> bool:
        return isinstance(value, (int, float, np.number)) and not isinstance(value, bool) \
            and math.isfinite(value)

    def check(names: str, expected: str, fits: Callable[[Any], bool]) -> None:
        for name in names.split():
            if not fits(arguments[name]):
                raise SimulationError(f'{name} must be {expected}, got {arguments[name]!r}')

    check('scenario', f'one of {", ".join(SCENARIOS)}', lambda value: value in tuple(SCENARIOS))
    check('imu_grade', f'one of {", ".join(PRESETS)} or an ImuNoise with figures above 0',
          lambda value: all(number(figure) and figure > 0 for figure in value[:4])
          if isinstance(value, ImuNoise) else value in tuple(PRESETS))
    check('seed', 'an integer, 0 or above',
          lambda value: number(value) and value == int(value) and value >= 0)
    check('imu_rate gnss_rate', 'a number of Hz above 0 and up to 10000',
          lambda value: number(value) and 0 < value <= 10000)
    check('duration', 'a number of seconds above 0',
          lambda value: value is None or number(value) and value > 0)
    check('velocity_std position_std position_drift_std outlier_velocity outlier_position '
          'gyro_misalignment_std accel_scale_std accel_misalignment_std '
          'rate_random_walk gnss_phase stand_still',
          'a number, 0 or above', lambda value: number(value) and value >= 0)
    # As far as the parameters go that make up for them.
    most = {parameter.name: parameter.maximum for parameter in parameters()
            if parameter.maximum is not None}
    latency = most['gnss_lateness'] - LATENESS_MARGIN
    check('gnss_latency', f'a number of seconds from 0 to {latency:g}',
          lambda value: number(value) and 0 <= value <= latency)
    check('gnss_delay', f'a number of seconds from 0 to {most["gnss_delay"]:g}',
          lambda value: number(value) and 0 <= value <= most['gnss_delay'])
    check('gyro_scale_std', f'a number from 0 to {most["gyro_scale_std"]:g}',
          lambda value: number(value) and 0 <= value <= most['gyro_scale_std'])
    check('velocity_std_vertical position_std_vertical gyro_bias_std accel_bias_std',
          'a number, 0 or above', lambda value: value is None or number(value) and value >= 0)
    check('position_drift_time', 'a number of seconds above 0',
          lambda value: number(value) and value > 0)
    check('imu_jitter', 'a number from 0 to below 0.5',
          lambda value: number(value) and 0 <= value < 0.5)
    check('outlier_rate', 'a number from 0 to 1', lambda value: number(value) and 0 <= value <= 1)
    check('latitude_deg', 'a number of degrees between -89 and 89',
          lambda value: number(value) and -89 <= value <= 89)
    check('altitude', 'a number of metres from -1000 to 100000',
          lambda value: number(value) and -1e3 <= value <= 1e5)
    check('longitude_deg heading_deg crab_deg', 'a finite number', number)
    check('mount_rpy_deg', 'three finite numbers',
          lambda value: np.shape(value) == (3,) and all(map(number, value)))
    check('lever_arm', 'three numbers of metres from -{0:g} to {0:g}'.format(most['lever_arm']),
          lambda value: np.shape(value) == (3,) and all(map(number, value))
          and max(map(abs, value)) <= most['lever_arm'])
    check('outages', 'pairs of a start and a later end in seconds',
          lambda value: all(np.shape(pair) == (2,) and pair[0] < pair[1] for pair in value))
    check('velocity_frame', 'enu or ned', lambda value: value in VELOCITY_FRAMES)
    check('flip_axis flip_gyro', 'x, y, z or empty', lambda value: value in tuple(IMU_AXES))
    check('accel_sign', '1 or -1', lambda value: value in (1, -1))
    duration = arguments['duration']
    if duration is None:
        duration = SCENARIOS[arguments['scenario']].duration + arguments['stand_still']
    rate = max(arguments['imu_rate'], arguments['gnss_rate'])
    if duration * rate > _MAX_SAMPLES:
        raise SimulationError(f'{duration:g} s at {rate:g} Hz are too many '
                              f'samples, the limit is {_MAX_SAMPLES}')
    grade = arguments['imu_grade']
    return grade if isinstance(grade, ImuNoise) else PRESETS[grade]
