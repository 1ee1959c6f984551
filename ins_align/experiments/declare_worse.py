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
Experiment ``declare-worse``: what a declaration is worth with an IMU worse than configured.

Every run is configured as `mems` with the right lever arm, and its IMU or receiver has one or two
of `FAULTS`, of which the aligner knows nothing. ``run_trial(trial(seed))`` makes one of them.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path

from ins_align.config import PRESETS
from ins_align.experiments.common import (
    combination, Groups, JsonDict, moment_table, offender_table, parallel, Report, setup, without)
from ins_align.experiments.declare import DRAWN, run_trial
from ins_align.simulation.simulate import SCENARIOS
import numpy as np

RUNS = 500
DURATION = 100.0
STAND_STILL = 20.0      # s, of every other run
_MEMS = PRESETS['mems']
# The estimator takes misalignment and the errors of the accelerometers for 3 tenths of the gyros'
# scale factor errors.
_AXES = 3 * 0.3 * _MEMS.gyro_scale_std
# What each changes of the arguments of `simulate`.
FAULTS: dict[str, JsonDict] = {
    'accelerometer bias x 10': {'accel_bias_std': 10 * _MEMS.accel_bias_std},
    'scale, misalignment x 3': {
        'gyro_scale_std': 3 * _MEMS.gyro_scale_std, 'gyro_misalignment_std': _AXES,
        'accel_scale_std': _AXES, 'accel_misalignment_std': _AXES},
    'noise x 3': {'imu_grade': _MEMS._replace(
        angle_random_walk=3 * _MEMS.angle_random_walk,
        velocity_random_walk=3 * _MEMS.velocity_random_walk)},
    'quantum 0.57 deg/s': {'quantum': (math.radians(0.57), 0.0)},
    'dead band 0.5 deg/s': {'dead_band': (math.radians(0.5), 0.0)},
    # Receivers with filters: 0.3 to 0.9 m/s in a turn where 0.07 is stated.
    'GNSS errors that last': {'velocity_drift_std': 0.3, 'gnss_correlation': 3.0},
}
# Nothing wrong, each, and pairs.
COMBINATIONS: tuple[tuple[str, ...], ...] = (
    (), *((name,) for name in FAULTS), *itertools.combinations(FAULTS, 2))
MOMENTS = {'levelled': 'LEVELLED (or ALIGNED at once)', 'aligned': 'ALIGNED'}


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run seeds 0 to `runs`; print tables and write them."""
    [trials] = parallel(run_trial, [[trial(seed) for seed in range(runs or RUNS)]], jobs,
                        'declare-worse')
    write(out, trials)


def trial(seed: int, faults: tuple[str, ...] | None = None,
          scenario: str | None = None) -> JsonDict:
    """Draw a run as `declare.trial` does; its faults and scenario may be given."""
    drawn, drawn_scenario = combination(seed, [3], COMBINATIONS, SCENARIOS)
    faults = drawn if faults is None else faults
    random = np.random.default_rng([4, seed])
    arguments = {'seed': seed, 'duration': DURATION, **setup(random),
                 'stand_still': STAND_STILL * random.integers(2)}
    for fault in faults:
        arguments |= FAULTS[fault]
    return {'index': seed, 'fault': ' and '.join(faults) or 'none', 'faults': faults,
            'scenario': scenario or drawn_scenario, 'imu': 'mems', 'simulate': arguments,
            'config': {'imu_grade': 'mems'}}


def write(out: Path, trials: list[JsonDict]) -> None:
    """Print tables and write them."""
    report = Report('declare-worse', 'IMUs worse than configured', out, f' --runs {len(trials)}')
    report.text(
        f'{len(trials)} runs of {DURATION:g} s over all scenarios ({", ".join(SCENARIOS)}), half '
        f'of them with {STAND_STILL:g} s at rest first, with random heading, latitude, mount and '
        'lever arm. All are configured as `mems` with the right lever arm. Errors against truth '
        'in stated sigmas: the worse of the attitude at t0 and the current one, and of the two '
        'axes of the tilt. A fault has the runs in which it is alone and those of its pairs. '
        'Target: at most 1 % beyond 3 sigma, none beyond 5.')
    groups: Groups = [('none', [t for t in trials if not t['faults']])]
    for name in FAULTS:
        groups += [(label, [t for t in trials if name in t['faults'] and len(t['faults']) == size])
                   for size, label in ((1, name), (2, f'{name}, in pairs'))]
    for moment, title in MOMENTS.items():
        moment_table(report, f'First declared {title}', [*groups, ('all', trials)], moment)
    offender_table(report, trials, *MOMENTS)
    report.write({'runs': without(trials, *DRAWN)})
