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
Experiment ``declare``: whether what is declared is right, and how soon it is declared.

Simulated vehicles of every kind with every fault that a user can make: is the attitude right
when the aligner says that it is aligned? Does it keep silent where heading cannot be observed? How
long does it wait beyond the time that the data need?
"""

from __future__ import annotations

from collections.abc import Callable
import itertools
from pathlib import Path

from ins_align.aligner import Aligner, State
from ins_align.config import Config
from ins_align.experiments.bound import crossing_time
from ins_align.experiments.common import (
    BINS, combination, config_for, exact_config_for, first_in, GRADES, groups_of, JsonDict, judged,
    moment_table, most, offender_table, parallel, Report, without, worse)
from ins_align.simulation.simulate import epochs_of, feed, SCENARIOS, simulate
import numpy as np

DURATION = 100.0
SILENT_DURATION = 600.0
HORIZON = 120.0         # s; within this the bound has to cross the threshold
THRESHOLD_DEG = 1.0
WAIT_LIMIT = 1.5        # median over bound, the target
# Seeds of the three parts do not meet.
SILENT_SEED, TIME_SEED = 100_000, 200_000
# A run of the second and the third part for so many of the first.
SILENT_PART, TIME_PART = 80, 10
DRAWN = 'simulate', 'config'        # `trial` draws them again from the index


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run all three parts; `runs` is that of the first, the others have a part of it."""
    runs = runs or 1000
    [trials] = parallel(run_trial, [[trial(index) for index in range(runs)]], jobs, 'faults')
    [silent] = parallel(run_trial, [[
        silent_trial(scenario, SILENT_SEED + seed) for scenario, seed in itertools.product(
            ('straight', 'static'), range(max(runs // SILENT_PART, 1)))]], jobs, 'silence')
    waits = time_to_heading(max(runs // TIME_PART, 1), jobs)
    report = Report('declare', 'Declared means right', out, f' --runs {runs}')
    offenders = aligned_tables(report, trials)
    levelled_tables(report, trials)
    silent_table(report, silent)
    time_table(report, waits)
    report.write({'runs': runs, 'beyond_3_sigma': offenders, 'trials': without(trials, *DRAWN),
                  'silent': without(silent, *DRAWN), 'time_to_heading': waits})


# Part 1: faults

def _outliers(random: np.random.Generator) -> JsonDict:
    return {'outlier_rate': random.uniform(0.01, 0.1),
            'outlier_velocity': random.uniform(0.5, 10.0),
            'outlier_position': random.uniform(10.0, 100.0)}


def _outages(random: np.random.Generator) -> JsonDict:
    starts = random.uniform(5.0, DURATION - 10.0, random.integers(1, 4))
    return {'outages': [[start, start + random.uniform(2.0, 15.0)] for start in starts]}


def _delay(random: np.random.Generator) -> JsonDict:
    return {'gnss_delay': random.uniform(0.02, 0.2)}


def _lever(random: np.random.Generator) -> JsonDict:
    direction = random.standard_normal(3)
    return {'lever_arm': (random.uniform(0.1, 2.0) * direction
                          / np.linalg.norm(direction)).tolist()}


# What each draws to change of the arguments of `simulate`.
FAULTS: dict[str, Callable[[np.random.Generator], JsonDict]] = {
    'none': lambda random: {}, 'outliers': _outliers, 'outages': _outages, 'delay': _delay,
    'lever arm left out': _lever,
    'several of these': lambda random: (
        _outliers(random) | _outages(random) | _delay(random) | _lever(random)),
    'NED taken for ENU': lambda random: {'velocity_frame': 'ned'},
    'one IMU axis flipped': lambda random: {'flip_axis': str(random.choice(['x', 'y', 'z']))},
    'one gyro flipped': lambda random: {'flip_gyro': str(random.choice(['x', 'y', 'z']))},
    'sign of gravity': lambda random: {'accel_sign': -1}}
LEVER_LEFT_OUT = 'lever arm left out', 'several of these'


def trial(index: int) -> JsonDict:
    """Draw a run: ``fault``, ``scenario``, arguments of `simulate`, parameters of `Config`."""
    fault, scenario, grade = combination(index, [], FAULTS, SCENARIOS, GRADES)
    random = np.random.default_rng([1, index])
    lever = random.uniform(-1.5, 1.5, 3)
    arguments: JsonDict = {
        'imu_grade': grade, 'seed': index, 'duration': DURATION,
        'heading_deg': random.uniform(-180, 180), 'latitude_deg': random.uniform(-75, 75),
        'lever_arm': lever.tolist(), 'mount_rpy_deg': random.uniform(-20, 20, 3).tolist()}
    config = {'lever_arm': (0.0, 0.0, 0.0)} if fault in LEVER_LEFT_OUT else {}
    return {'index': index, 'fault': fault, 'scenario': scenario, 'imu': grade,
            'simulate': arguments | FAULTS[fault](random), 'config': config}


def run_trial(task: JsonDict) -> JsonDict:
    """
    Align what was drawn and judge what was declared.

    To the task come ``levelled`` and ``aligned``, the first such epochs (see `judged`; None: never
    declared), ``final``, the last one if it is aligned, and what there is at the end.
    """
    simulation = simulate(task['scenario'], **task['simulate'])
    aligner = Aligner(config_for(simulation, **task['config']))
    epochs = feed(aligner, simulation)
    status = aligner.status()
    moments = {'levelled': first_in(epochs, State.LEVELLED, State.ALIGNED),
               'aligned': first_in(epochs, State.ALIGNED),
               'final': first_in(epochs[-1:], State.ALIGNED)}
    return {**task, 'state': status.state.value, 'reason': status.reason,
            'counts': {name: count for name, count in aligner.counts.items() if count},
            'least_heading_sigma_deg': min((epoch.initial.sigma_deg[2] for epoch in epochs
                                            if epoch.initial is not None), default=None),
            **{name: judged(epoch, simulation.attitude_at) for name, epoch in moments.items()}}


def aligned_tables(report: Report, trials: list[JsonDict]) -> list[JsonDict]:
    """Print what ALIGNED was worth; return what was declared beyond the first bin."""
    report.text(
        f'{len(trials)} runs of {DURATION:g} s over all scenarios ({", ".join(SCENARIOS)}), '
        'grades of IMU and faults, with random heading, latitude, mount and lever arm. Errors '
        'against truth in stated sigmas: of the tilt the worse of two axes, and the worse of the '
        'attitude at t0 and the current one. None of the faults is told to the aligner. Target, '
        f'with 1000 runs: at most 1 % beyond {BINS[0]:g} sigma and none beyond {BINS[1]:g}.')
    groups = groups_of(trials, FAULTS)
    moment_table(report, 'When ALIGNED was declared first', groups, 'aligned')
    moment_table(report, 'At the end, where still ALIGNED', groups, 'final')
    return without(offender_table(report, trials, 'aligned', 'final'), *DRAWN)


def levelled_tables(report: Report, trials: list[JsonDict]) -> None:
    """Print what LEVELLED was worth, which claims the tilt alone."""
    report.text(
        'LEVELLED is counted apart. It claims the tilt alone, and a vehicle at rest, or in steady '
        'straight motion, cannot show a wrong sign: the data of an IMU with its z axis or all '
        'accelerations reversed are those of one that is mounted upside down. Such a vehicle is '
        'levelled wrongly until it turns or changes speed.')
    moment_table(report, 'When LEVELLED (or ALIGNED at once) was declared first',
                 groups_of(trials, FAULTS), 'levelled')
    gross = [t for t in trials if worse(t['levelled'], 'tilt') > BINS[1]]
    report.table(f'Of those with a tilt beyond {BINS[1]:g} sigma: what became of them', [
        {'fault': fault, 'scenario': scenario, 'runs': len(chosen),
         'still levelled at the end': sum(t['state'] == State.LEVELLED.value for t in chosen),
         'aligned at any time': sum(t['aligned'] is not None for t in chosen)}
        for fault, scenario in itertools.product(FAULTS, SCENARIOS)
        if (chosen := [t for t in gross if (t['fault'], t['scenario']) == (fault, scenario)])])


# Part 2: silence

def silent_trial(scenario: str, seed: int) -> JsonDict:
    """Draw ten minutes of motion that does not show the heading."""
    mount = np.random.default_rng([2, seed]).uniform(-20, 20, 3)
    return {'scenario': scenario, 'seed': seed, 'config': {}, 'simulate': {
        'imu_grade': 'mems', 'seed': seed, 'duration': SILENT_DURATION, 'mount_rpy_deg': mount}}


def silent_table(report: Report, silent: list[JsonDict]) -> None:
    """Print how often heading was declared where it cannot be known."""
    rows = []
    for scenario in ('straight', 'static'):
        chosen = [s for s in silent if s['scenario'] == scenario]
        levels = [s['levelled'] for s in chosen if s['levelled'] is not None]
        rows.append({
            'scenario': scenario, 'runs': len(chosen),
            'heading declared': sum(s['aligned'] is not None for s in chosen),
            'level declared': len(levels),
            'worst tilt, sigma': most(
                (level['initial']['tilt_sigmas'] for level in levels), '.1f'),
            'least heading sigma, deg':
                f"{min(s['least_heading_sigma_deg'] for s in chosen):.1f}"})
    report.table(f'MEMS for {SILENT_DURATION:g} s without a change of velocity', rows)


# Part 3: time

def time_to_heading(runs: int, jobs: int | None) -> list[JsonDict]:
    """Time to a declared heading and times at which the bounds cross the threshold."""
    pairs = list(itertools.product(SCENARIOS, GRADES))
    default = Config()
    unknown = {'lever_arm_std': default.lever_arm_std, 'delay_std': default.gnss_delay_std}
    crossings = parallel(crossing_time, [
        [(*pair, HORIZON, THRESHOLD_DEG, nuisance) for nuisance in ({}, unknown)]
        for pair in pairs], jobs, 'bounds')
    reachable = [each for each in zip(pairs, crossings) if each[1][0] is not None]
    times = iter(parallel(run_time, [
        [(*pair, TIME_SEED + seed, exact) for seed in range(runs)]
        for pair, _ in reachable for exact in (True, False)], jobs, 'times'))
    return [{'scenario': scenario, 'grade': grade, 'bound_s': bound_s,
             'bound_unknown_s': unknown_s, 'median_s': _median(exact),
             'ratio': _median(exact) / bound_s, 'declared_s': exact,
             'default_median_s': _median(by_default), 'default_declared_s': by_default}
            for ((scenario, grade), (bound_s, unknown_s)), exact, by_default in zip(
                reachable, times, times)]


def _median(times: list[float | None]) -> float:
    """Median; what was not declared took for ever."""
    return float(np.median([np.inf if t is None else t for t in times]))


def run_time(task: tuple[str, str, int, bool]) -> float | None:
    """Seconds until the heading is declared, None if it is not; with the exact model or not."""
    scenario, grade, seed, exact = task
    simulation = simulate(scenario, imu_grade=grade, seed=seed, duration=HORIZON)
    # The heading is to be what is waited for, not the tilt.
    config = (exact_config_for(simulation, tilt_std_threshold=THRESHOLD_DEG) if exact
              else config_for(simulation))
    epoch = first_in(epochs_of(Aligner(config), simulation), State.ALIGNED)
    return None if epoch is None else epoch.t_s


def time_table(report: Report, waits: list[JsonDict]) -> None:
    """Print the waits."""
    default = Config()
    rows = []
    for wait in waits:
        cells: JsonDict = {'scenario': wait['scenario'], 'IMU': wait['grade']}
        for name, bound, median, times in (
                ('', 'bound_s', 'median_s', 'declared_s'),
                ('default ', 'bound_unknown_s', 'default_median_s', 'default_declared_s')):
            known = wait[bound] is not None
            cells |= {f'{name}bound, s': f'{wait[bound]:.1f}' if known else None,
                      f'{name}median, s': f'{wait[median]:.1f}',
                      f'{name}ratio': f'{wait[median] / wait[bound]:.2f}' if known else None,
                      f'{name}not declared': sum(t is None for t in wait[times])}
        rows.append(cells)
    met = sum(wait['ratio'] <= WAIT_LIMIT for wait in waits)
    report.text(f'Time to a declared heading: the median is within {WAIT_LIMIT:g} times the '
                f'bound in {met} of {len(waits)} cases in which the bound crosses '
                f'{THRESHOLD_DEG:g} deg within {HORIZON:g} s (target: all). The bound knows that '
                'the axes of the IMU are right; the aligner waits for motion that shows it.')
    report.table(
        f'Time to a declared heading of {THRESHOLD_DEG:g} deg: median of '
        f"{len(waits[0]['declared_s']) if waits else 0} runs, and the "
        'time at which the Cramer-Rao bound crosses it. First with lever arm and delay known to '
        'both and a threshold of 1 deg for the tilt too; then with all parameters at their '
        f'defaults, against the bound with lever arm and delay unknown ({default.lever_arm_std:g} '
        f'm, {default.gnss_delay_std:g} s). A declaration has to hold for {default.hold_time:g} s '
        'before it is made.', rows)
