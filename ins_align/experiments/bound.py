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
Experiment ``bound``: errors of `method: bank` against the Cramer-Rao bound, and its sigma.

The bound comes from the dense reference on the true motion. Errors are those of the attitude at
t0 after so many seconds of data.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Aligner
from ins_align.experiments import dense
from ins_align.experiments.common import (
    Column, draw, error_of, exact_config_for, field, GRADES, JsonDict, parallel, Report, rms)
from ins_align.geometry.rotation import Array
from ins_align.simulation.simulate import epochs_of, simulate
import numpy as np

TIMES = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 30.0, 50.0, 70.0, 100.0)
TABLE_TIMES = (10.0, 20.0, 50.0, 100.0)
LEVER_STD, DELAY, DELAY_STD = 1.0, 0.12, 0.1
# Of `dense.bound`.
UNKNOWN_STD: dict[str, dict[str, float]] = {
    '': {}, 'lever arm': {'lever_arm_std': LEVER_STD}, 'delay': {'delay_std': DELAY_STD}}
# Targets.
RATIO_LIMIT, NEES_RANGE = 1.10, (0.85, 1.15)


class Case(NamedTuple):
    """One row of Monte Carlo: what is simulated, and what of it is known."""

    title: str
    scenario: str
    grade: str
    simulate: JsonDict = {}
    position_only: bool = False
    unknown: str = ''           # 'lever arm' or 'delay'
    share: float = 0.5          # of the runs asked for


MOVING = tuple(itertools.product(('flight', 'car'), GRADES))
# In the order of the tables.
CASES = (
    *(Case('velocity', *moving, share=1.0) for moving in MOVING),
    *(Case('velocity, gyro bias 0.5 deg/s', scenario, 'mems', {'gyro_bias_std': np.radians(0.5)})
      for scenario in ('flight', 'car')),
    *(Case('RTK 2 cm, 5 Hz', *moving, {'position_std': 0.02}, position_only=True)
      for moving in MOVING),
    *(Case('position 1 m white, 1 Hz', *moving, {'position_std': 1.0, 'gnss_rate': 1.0},
           position_only=True, share=0.25) for moving in MOVING),
    *(Case('unknown lever arm', 'flight', grade, unknown='lever arm') for grade in GRADES),
    *(Case('unknown delay', 'flight', grade, {'gnss_delay': DELAY}, unknown='delay')
      for grade in GRADES),
    Case('standing: north from the Earth rate', 'static', 'navigation', share=0.25))


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run every case and print ratios and normalised errors."""
    [bounds] = parallel(bounds_of, [CASES], jobs, 'bounds')
    results = parallel(run_case, [
        [(case, seed) for seed in range(max(1, round(case.share * runs)))] for case in CASES],
        jobs, 'runs')
    summaries = [summary(*each) for each in zip(CASES, bounds, results)]
    rows = [row for result in summaries for row in rows_of(result)]
    report.text(
        'GNSS 5 Hz, 0.1 m/s, lever arm [1 1 1] m unless said otherwise. Errors of the attitude at '
        't0; tilt: both axes. The bound comes from the dense reference on the true motion. '
        'NEES/3: mean normalised squared error of the three angles, 1 when sigma is right. The '
        'last columns are what chance alone leaves of ratio and NEES/3 (1 sigma) with so many '
        'runs. The aligner is told the noise and that lever arm and delay are known, but where '
        'they are the unknown.')
    report.table(
        f'Targets: ratio of error and bound at most {RATIO_LIMIT:g}, NEES/3 within '
        f'{NEES_RANGE[0]:g} to {NEES_RANGE[1]:g}; beyond chance: by more than two of its sigmas', [
            (title, [row for row in rows if row['title'] == title])
            for title in dict.fromkeys(case.title for case in CASES)], TARGET_COLUMNS)
    report.table('Root mean square errors, bounds and their ratios', rows, ROW_COLUMNS)
    report.table(
        f'Lever arm (prior {LEVER_STD:g} m per axis) and delay (true {DELAY:g} s, prior '
        f'{DELAY_STD:g} s) as unknowns on `flight`, after {TIMES[-1]:g} s; above, the bound knows '
        'no more than the aligner', [result for result in summaries if result['unknown']], [
            field('case', 'title'), field('IMU', 'grade'),
            field('rms error (m or s)', 'nuisance_rms', '.2g'),
            field('stated sigma', 'nuisance_std', '.2g'),
            field('rms of error/sigma', 'nuisance_sigmas', '.2f')])
    report.figure(draw(11.0, 7.5, [[panel(summaries, scenario, angle) for scenario in (
        'flight', 'car')] for angle in ('tilt', 'heading')], sharex=True), '',
        'Errors of the attitude at t0 (dots: rms; lines: Cramer-Rao bound), GNSS velocity')
    return {'runs': runs, 'times_s': TIMES, 'cases': summaries}


def bounds_of(case: Case) -> tuple[Array, Array]:
    """Bound of tilt (both axes) and heading at all times, degrees, with the case's unknowns."""
    simulation = simulate(case.scenario, imu_grade=case.grade, duration=TIMES[-1] + 0.5,
                          **case.simulate)
    bound = dense.bound(simulation, use_velocity=not case.position_only,
                        use_position=case.position_only, **UNKNOWN_STD[case.unknown])
    P = np.array([np.diag(bound.at(time)) for time in TIMES])
    return np.degrees(np.sqrt(P[:, 0] + P[:, 1])), np.degrees(np.sqrt(P[:, 2]))


def run_case(task: tuple[Case, int]) -> JsonDict:
    """Run the aligner; errors at all times."""
    case, seed = task
    # Nothing is declared, for that may move t0, and the bound is about the first one.
    config: JsonDict = {'hold_time': 1e3}
    arguments = dict(case.simulate)
    if case.position_only:
        config['use_velocity'] = False
    if case.unknown == 'lever arm':     # another one in each run
        arguments['lever_arm'] = LEVER_STD * np.random.default_rng([3, seed]).standard_normal(3)
        config |= {'lever_arm': (0.0, 0.0, 0.0), 'lever_arm_std': LEVER_STD}
    if case.unknown == 'delay':
        config['gnss_delay_std'] = DELAY_STD
    simulation = simulate(case.scenario, imu_grade=case.grade, seed=seed, duration=TIMES[-1] + 0.5,
                          **arguments)
    aligner = Aligner(exact_config_for(simulation, **config))
    epochs = list(epochs_of(aligner, simulation, velocity=not case.position_only))
    error, nees = np.full((len(TIMES), 3), np.nan), np.full(len(TIMES), np.nan)
    for k, time in enumerate(TIMES):
        last = [epoch.initial for epoch in epochs if epoch.t_s <= time + 1e-6][-1:]
        for attitude in filter(None, last):
            error[k], _, nees[k], *_ = error_of(attitude,
                                                simulation.attitude_at(attitude.stamp_ns))
    status = aligner.status()
    nuisance = ([status.gnss_delay - DELAY], [status.gnss_delay_std])
    if case.unknown == 'lever arm':
        nuisance = (status.lever_arm - simulation.lever_arm, status.lever_arm_std)
    return {'error': error, 'nees': nees, 'nuisance': nuisance}


def summary(case: Case, bound: tuple[Array, Array], runs: list[JsonDict]) -> JsonDict:
    """Return the statistics of a case's runs over time."""
    error = np.array([each['error'] for each in runs])
    result = {'title': case.title, 'scenario': case.scenario, 'grade': case.grade,
              'unknown': case.unknown, 'runs': len(runs)}
    for angle, limit, errors in zip(('tilt', 'heading'), bound, (
            np.hypot(error[..., 0], error[..., 1]), error[..., 2])):
        result |= {f'{angle}_deg': rms(errors, axis=0), f'{angle}_bound_deg': limit,
                   f'{angle}_ratio': rms(errors, axis=0) / limit}
    result['nees'] = np.mean([each['nees'] for each in runs], axis=0) / 3
    if case.unknown:
        errors, stds = (np.array([each['nuisance'][place] for each in runs]) for place in (0, 1))
        result |= {'nuisance_rms': rms(errors), 'nuisance_std': rms(stds),
                   'nuisance_sigmas': rms(errors / stds)}
    return result


def rows_of(result: JsonDict) -> list[JsonDict]:
    """Return the statistics of a case at each time of the table, and what chance leaves."""
    runs = result['runs']
    return [{**{name: value[TIMES.index(time)] if np.ndim(value) else value
                for name, value in result.items()},
             'time': time, 'ratio_chance': 1 / np.sqrt(2 * runs),
             'nees_chance': np.sqrt(2 / 3 / runs)} for time in TABLE_TIMES]


def _target_columns(angle: str) -> list[Column]:
    """Return how many ratios of like cases meet their target, of a title and its rows."""
    name = f'{angle}_ratio'
    return [
        (f'{angle} met', '', lambda g: sum(row[name] <= RATIO_LIMIT for row in g[1])),
        (f'{angle} beyond chance', '', lambda g: sum(
            row[name] > RATIO_LIMIT + 2 * row['ratio_chance'] for row in g[1])),
        (f'{angle} mean', '.2f', lambda g: np.mean([row[name] for row in g[1]])),
        (f'{angle} largest', '.2f', lambda g: max(row[name] for row in g[1]))]


TARGET_COLUMNS: list[Column] = [
    ('case', '', lambda g: g[0]), ('figures', '', lambda g: len(g[1])),
    *_target_columns('tilt'), *_target_columns('heading'),
    ('NEES/3 met', '', lambda g: sum(
        NEES_RANGE[0] <= row['nees'] <= NEES_RANGE[1] for row in g[1])),
    ('mean', '.2f', lambda g: np.mean([row['nees'] for row in g[1]])),
    *((title, '.2f', lambda g, choose=choose: choose(row['nees'] for row in g[1]))
      for title, choose in (('least', min), ('largest', max)))]
ROW_COLUMNS: list[Column] = [
    ('case', '', lambda row: '{title}, {scenario}, {grade}'.format(**row)),
    field('t, s', 'time', 'g'),
    *(field(f'{angle}{title}', f'{angle}{name}', digits) for angle in ('tilt', 'heading')
      for title, name, digits in ((', deg', '_deg', '.2g'), (' bound', '_bound_deg', '.2g'),
                                  (' ratio', '_ratio', '.2f'))),
    field('NEES/3', 'nees', '.2f'), field('runs', 'runs'),
    field('+- ratio', 'ratio_chance', '.2f'), field('+- NEES/3', 'nees_chance', '.2f')]


def panel(results: list[JsonDict], scenario: str, angle: str) -> JsonDict:
    """Return errors and bounds over time for `draw`."""
    lines: list[Any] = []
    for grade, colour in zip(GRADES, ('#0072B2', '#E69F00', '#D55E00')):
        result = next(result for result in results if (
            result['title'], result['scenario'], result['grade']) == ('velocity', scenario, grade))
        lines += [(TIMES, result[f'{angle}_bound_deg'],
                   {'color': colour, 'label': f'{grade}, bound'}),
                  (TIMES, result[f'{angle}_deg'], {
                      'color': colour, 'label': f'{grade}, rms error', 'marker': 'o',
                      'markersize': 5, 'linestyle': ''})]
    return {'title': f'{scenario}: {angle}', 'ylabel': 'deg', 'yscale': 'log', 'lines': lines}
