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
Experiments ``declare``, ``declare-worse`` and ``settings``: whether what is declared is right.

``declare`` simulates all scenarios with all faults that a user can make. Is the attitude right
when ALIGNED is declared? Is nothing declared where the heading cannot be observed? How much longer
does a declaration take than the data require? In ``declare-worse`` IMUs and receivers are worse
than configured. In ``settings`` everything is as configured, with rates, noises, lever arms and
mountings of all sizes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import itertools
import math
from pathlib import Path
from typing import Any

from ins_align.aligner import State
from ins_align.config import CHIP_THRESHOLDS, Config, PRESETS
from ins_align.experiments.common import (
    aligned_row, bound_of, Case, cell, combination, event_row, follow, GRADES, groups_of,
    JsonDict, parallel, prepare, Report, run_case, run_cases, setup)
from ins_align.experiments.spoilt import Random, Stream, vertical_absent
from ins_align.simulation.arguments import imu_errors_of
from ins_align.simulation.simulate import CAMPAIGN_SCENARIOS
import numpy as np

DURATION = 100.0
STAND_STILL = 20.0      # s at rest at the start of half the runs of declare-worse
SILENT_DURATION = 600.0
HORIZON = 120.0         # s within which the bound has to cross the threshold
THRESHOLD_DEG = 1.0
WAIT_LIMIT = 1.5        # target: median time to a declaration over that of the bound, at most
# First seeds of the second and third part; the three parts share none.
SILENT_SEED, TIME_SEED = 100_000, 200_000


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run the three parts of ``declare``; `runs` is for the first, the others have fewer."""
    [found] = parallel(run_case, [[(draw(seed), seed) for seed in range(runs)]], jobs, 'declare')
    silent = run_cases(run_case, SILENT, runs, jobs, SILENT_SEED)
    waits = time_to_heading(runs, jobs)
    report.text(
        f'{runs} runs of {DURATION:g} s over all scenarios ({", ".join(CAMPAIGN_SCENARIOS)}), '
        'grades of IMU and faults, none of which is configured, with random heading, latitude, '
        'mount and lever arm.')
    groups = groups_of(found, FAULTS)
    for title, kind in (
            ('When ALIGNED was declared first', 'declared'),
            ('At the end, where still ALIGNED', 'final'),
            ('When LEVELLED (or ALIGNED at once) was declared first. At rest and in steady '
             'straight motion an IMU with its z axis or all accelerations reversed cannot be told '
             'from one that is mounted upside down', 'levelled')):
        report.table(title, [event_row(*group, kind) for group in groups])
    report.table(
        f'MEMS for {SILENT_DURATION:g} s without a change of velocity: LEVELLED, and ALIGNED',
        [{**event_row(name, group, 'levelled'),
          'ALIGNED': sum(bool(each['declared']) for each in group),
          'least heading sigma, deg': cell(
              min, (each['least_heading_sigma_deg'] for each in group), '.1f')}
         for name, group in silent])
    time_table(report, waits)
    return {'runs': found, 'silent': [each for _, group in silent for each in group],
            'time_to_heading': waits}


# Part 1: faults

def _outliers(random: Random) -> JsonDict:
    return {'outlier_rate': random.uniform(0.01, 0.1),
            'outlier_velocity': random.uniform(0.5, 10.0),
            'outlier_position': random.uniform(10.0, 100.0)}


def _outages(random: Random) -> JsonDict:
    starts = random.uniform(5.0, DURATION - 10.0, random.integers(1, 4))
    return {'outages': [[start, start + random.uniform(2.0, 15.0)] for start in starts]}


def _lever(random: Random) -> JsonDict:
    direction = random.standard_normal(3)
    return {'lever_arm': (random.uniform(0.1, 2.0) * direction
                          / np.linalg.norm(direction)).tolist()}


# Each fault draws arguments of `simulate`.
FAULTS: dict[str, Callable[[Random], JsonDict]] = {
    'none': lambda random: {}, 'outliers': _outliers, 'outages': _outages,
    'delay': lambda random: {'gnss_delay': random.uniform(0.02, 0.2)},
    'lever arm left out': _lever,
    'several of these': lambda random: (
        _outliers(random) | _outages(random) | FAULTS['delay'](random) | _lever(random)),
    'NED taken for ENU': lambda random: {'velocity_frame': 'ned'},
    'one IMU axis flipped': lambda random: {'flip_axis': str(random.choice(['x', 'y', 'z']))},
    'one gyro flipped': lambda random: {'flip_gyro': str(random.choice(['x', 'y', 'z']))},
    'sign of gravity': lambda random: {'accel_sign': -1}}
LEVER_LEFT_OUT = 'lever arm left out', 'several of these'


def draw(index: int) -> Case:
    """Draw a run of ``declare``."""
    fault, scenario, grade = combination(index, [], FAULTS, CAMPAIGN_SCENARIOS, GRADES)
    random = np.random.default_rng([1, index])
    arguments: JsonDict = {
        'duration': DURATION, 'lever_arm': random.uniform(-1.5, 1.5, 3).tolist(),
        'heading_deg': random.uniform(-180, 180), 'latitude_deg': random.uniform(-75, 75),
        'mount_rpy_deg': random.uniform(-20, 20, 3).tolist()}
    return Case(fault, ((scenario, grade),), None, arguments | FAULTS[fault](random),
                {'lever_arm': (0.0, 0.0, 0.0)} if fault in LEVER_LEFT_OUT else {})


# Part 2: silence

def _mount(seed: int) -> JsonDict:
    return {'mount_rpy_deg': np.random.default_rng([2, seed]).uniform(-20, 20, 3)}


# Motions in which the heading cannot be observed.
SILENT = tuple(Case(scenario, ((scenario, 'mems'),), None, {'duration': SILENT_DURATION},
                    part=80, drawn=_mount) for scenario in ('straight', 'static'))


# Part 3: time

def time_to_heading(runs: int, jobs: int | None) -> list[JsonDict]:
    """Return the times to a declared heading, where and when its bound meets the threshold."""
    cases = [time_case(*kind)
             for kind in itertools.product((*CAMPAIGN_SCENARIOS, 'robot'), GRADES, (True, False))]
    [crossings] = parallel(crossing_time, [cases], jobs, 'bounds')
    reachable = [each for each in zip(cases, crossings) if each[1] is not None]
    times = run_cases(run_time, [case for case, _ in reachable], runs, jobs, TIME_SEED)
    waits = []
    for (case, bound_s), (_, declared_s) in zip(reachable, times):
        [(scenario, grade)] = case.motions
        # A run that is not declared counts as infinitely long.
        median_s = float(np.median([np.inf if t is None else t for t in declared_s]))
        waits.append({'scenario': scenario, 'imu': grade, 'exact': case.exact,
                      'bound_s': bound_s, 'median_s': median_s, 'ratio': median_s / bound_s,
                      'declared_s': declared_s})
    return waits


def time_case(scenario: str, grade: str, exact: bool) -> Case:
    """Return a case with noise, lever arm and delay known, or with the default configuration."""
    # The declaration is to wait for the heading, not for the tilt.
    config = {'tilt_std_threshold': THRESHOLD_DEG} if exact else {
        'lever_arm_std': Config.lever_arm_std, 'gnss_delay_std': Config.gnss_delay_std}
    return Case('time', ((scenario, grade),), None, {'duration': HORIZON}, config, 10, exact=exact)


def crossing_time(case: Case) -> float | None:
    """Return when the bound of the heading crosses the threshold, s, None if it does not."""
    limit = bound_of(case)
    good = np.degrees(np.sqrt(limit.covariance[:, 2, 2])) <= THRESHOLD_DEG
    return float(limit.time[np.argmax(good)]) if good.any() else None


def run_time(task: tuple[Case, int]) -> float | None:
    """Return when a case with a seed is declared, s, None if it is not."""
    _, stream, aligner = prepare(*task)
    return next((epoch.t_s for epoch in itertools.chain.from_iterable(follow(aligner, stream))
                 if epoch.state is State.ALIGNED and not epoch.dry), None)


def time_table(report: Report, waits: list[JsonDict]) -> None:
    """Add the table of what `time_to_heading` returns."""
    default = Config()
    met = [wait['ratio'] <= WAIT_LIMIT for wait in waits if wait['exact']]
    report.table(
        f'Time to a declared heading of {THRESHOLD_DEG:g} deg: median, and when the Cramer-Rao '
        f'bound crosses it within {HORIZON:g} s, which is that of the heading at t0: the present '
        'one, which a declaration waits for, may be known sooner. All known: noise, lever arm and '
        'delay, with a threshold as large for the tilt; else the defaults, lever arm '
        f'({default.lever_arm_std:g} m) and delay ({default.gnss_delay_std:g} s) unknown to the '
        f'bound too. A declaration has to hold for {default.hold_time:g} s. With all known, '
        f'{sum(met)} of {len(met)} ratios are at most {WAIT_LIMIT:g} (target: all)',
        [{'scenario': wait['scenario'], 'IMU': wait['imu'], 'all known': wait['exact'],
          'bound, s': f"{wait['bound_s']:.1f}", 'median, s': f"{wait['median_s']:.1f}",
          'ratio': f"{wait['ratio']:.2f}", 'runs': len(wait['declared_s']),
          'not declared': wait['declared_s'].count(None)} for wait in waits])


# declare-worse: IMUs worse than configured

PAIR = ' and '
_MEMS = PRESETS['mems']
# Each fault sets arguments of `simulate`.
WORSE: dict[str, JsonDict] = {
    'accelerometer bias x 10': {'accel_bias_std': 10 * _MEMS.accel_bias_std},
    'scale, misalignment x 3': imu_errors_of(
        _MEMS._replace(gyro_scale_std=3 * _MEMS.gyro_scale_std, rate_random_walk=0.0)),
    'noise x 3': {'imu_grade': _MEMS._replace(
        angle_random_walk=3 * _MEMS.angle_random_walk,
        velocity_random_walk=3 * _MEMS.velocity_random_walk)},
    'quantum 0.57 deg/s': {'quantum': (math.radians(0.57), 0.0)},
    'dead band 0.5 deg/s': {'dead_band': (math.radians(0.5), 0.0)},
    # As of receivers that filter: errors of 0.3 to 0.9 m/s in a turn where 0.07 is stated.
    'GNSS errors that last': {'velocity_drift_std': 0.3, 'gnss_correlation': 3.0},
}
# No fault, each fault alone, and all pairs.
COMBINATIONS: tuple[tuple[str, ...], ...] = (
    (), *((name,) for name in WORSE), *itertools.combinations(WORSE, 2))


def run_worse(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``declare-worse``."""
    [found] = parallel(run_case, [[(draw_worse(seed), seed) for seed in range(runs)]],
                       jobs, 'declare-worse')
    report.text(
        f'{runs} runs of {DURATION:g} s over all scenarios ({", ".join(CAMPAIGN_SCENARIOS)}), '
        f'half of them with {STAND_STILL:g} s at rest first, with random heading, latitude, mount '
        'and lever arm, configured as `mems` with the right lever arm. A fault has the runs in '
        'which it is alone and those of its pairs.')
    alone = groups_of(found, ('none', *WORSE))
    pairs = [(f'{name}, in pairs', [each for each in found if PAIR in each['name']
                                    and name in each['name'].split(PAIR)]) for name in WORSE]
    groups = [*alone[:-1], *pairs, alone[-1]]
    for title, kind in (('First declared LEVELLED (or ALIGNED at once)', 'levelled'),
                        ('First declared ALIGNED', 'declared')):
        report.table(title, [event_row(*group, kind) for group in groups])
    return {'runs': found}


def draw_worse(seed: int) -> Case:
    """Draw a run of ``declare-worse``."""
    faults, scenario = combination(seed, [3], COMBINATIONS, CAMPAIGN_SCENARIOS)
    random = np.random.default_rng([4, seed])
    arguments = {'duration': DURATION, **setup(random),
                 'stand_still': STAND_STILL * random.integers(2)}
    for fault in faults:
        arguments |= WORSE[fault]
    return Case(PAIR.join(faults) or 'none', ((scenario, 'mems'),), None, arguments,
                {'imu_grade': 'mems'})


# settings: everything is as configured

MOVING = tuple(name for name in CAMPAIGN_SCENARIOS if name not in ('straight', 'static'))
# What the GNSS measures, and the parameters that say so.
HORIZONTAL = 'horizontal velocities'
MEASURED: dict[str, JsonDict] = {
    'velocities': {}, HORIZONTAL: {'velocity_vertical': 'absent'},
    'positions': {'use_velocity': False}, 'both': {'use_position': True}}


def run_settings(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``settings``."""
    [found] = parallel(run_case, [[(draw_settings(seed), seed) for seed in range(runs)]],
                       jobs, 'settings')
    report.text(
        f'{runs} runs without faults that are configured correctly, except that half of the '
        f'receivers do not state their noise: motions ({", ".join(MOVING)}) after up to three '
        'minutes at rest, IMUs at 25 to 400 Hz mounted in any way, GNSS at 1 to 20 Hz, '
        'velocities of 0.02 to 0.3 m/s, positions of 0.02 to 2.5 m, delays to 0.15 s, lever arms '
        'to 12 m that are known to 0.05 or 1 m per axis.')
    report.table('By grade of the IMU, and by what the GNSS measures', [
        aligned_row(name, [each for each in found if name in each['name'].split(PAIR)])
        for name in (*PRESETS, *MEASURED)] + [aligned_row('all', found)])
    return {'runs': found}


def draw_settings(seed: int) -> Case:
    """Draw a run of ``settings``."""
    scenario, grade, measured, stated = combination(
        seed, [7], MOVING, PRESETS, MEASURED, (True, False))
    random = np.random.default_rng([7, seed])

    def one_of(*values: float) -> float:
        return float(random.choice(values))

    rest, gnss_rate = one_of(0, 0, 3, 20, 60, 180), one_of(1, 2, 5, 10, 20)
    lever_arm = one_of(0.3, 1.5, 8.0) * random.uniform(-1, 1, 3)
    lever_std = one_of(0.05, 1.0)
    turn = np.array([180, 90, 180] if random.random() < 0.5 else [10, 10, 10])
    arguments = {
        **setup(random), 'duration': rest + DURATION, 'stand_still': rest,
        'lever_arm': lever_arm.tolist(),
        'mount_rpy_deg': (turn * random.uniform(-1, 1, 3)).tolist(),
        'gnss_rate': gnss_rate, 'imu_rate': max(one_of(25, 50, 100, 200, 400), 2 * gnss_rate),
        'imu_jitter': one_of(0, 0, 0.3), 'gnss_delay': one_of(0, 0, 0.05, 0.15),
        'velocity_std': one_of(0.02, 0.1, 0.3), 'position_std': one_of(0.02, 0.5, 2.5),
        **imu_errors_of(PRESETS[grade])}
    config = {
        'lever_arm': tuple((lever_arm + lever_std * random.standard_normal(3)).tolist()),
        'lever_arm_std': lever_std, **MEASURED[measured],
        **(CHIP_THRESHOLDS if grade == 'chip' else {})}
    return Case(f'{grade}{PAIR}{measured}', ((scenario, grade),),
                partial(_send, stated=stated, vertical=measured != HORIZONTAL), arguments, config)


def _send(stream: Stream, random: Random, stated: bool, vertical: bool) -> None:
    """Remove the stated covariances, or the vertical velocities, unless they are to be sent."""
    if not stated:
        stream.velocity['covariance'] = stream.fix['covariance'] = 0.0
        stream.fix['covariance_type'] = 0
    if not vertical:
        vertical_absent(stream, random)
