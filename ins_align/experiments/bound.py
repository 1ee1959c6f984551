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
Experiments ``bound`` and ``note``: the errors of an aligner that knows its model exactly.

``bound`` compares the errors and sigmas of `method: bank` with the Cramer-Rao bound, which the
dense reference computes on the true motion. ``note`` repeats the simulation of the note with and
without its lever-arm term. The note states a lever arm of [1 1 1] m and 100 runs, and takes the
rest from its predecessor without describing it; here it is scenario `flight`, navigation grade,
velocities of 0.1 m/s at 5 Hz. Errors are those of the attitude at t0 after a time of data.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from ins_align.config import Config
from ins_align.experiments import dense
from ins_align.experiments.common import (
    ANGLES, bound_of, Case, error_of, follow, GRADES, JsonDict, parallel, prepare, Report,
    run_cases)
from ins_align.geometry.rotation import Array, roll_pitch_yaw
from ins_align.report import new_figure
import numpy as np

TIMES = (10.0, 20.0, 50.0, 100.0)       # s since t0, when errors are evaluated
LEVER_STD, DELAY, DELAY_STD = 1.0, 0.12, 0.1    # of an unknown lever arm (m) and delay (s)
# Targets: error over bound at most, and NEES/3 within.
RATIO_LIMIT, NEES_RANGE = 1.10, (0.85, 1.15)


def case_of(name: str, scenario: str, grade: str, config: JsonDict = {}, part: int = 1,
            **arguments: Any) -> Case:
    """Return a case of an aligner that knows its model exactly, but for what `config` says."""
    # Nothing is declared: a declaration may move t0, and the bound is about the first t0.
    return Case(name, ((scenario, grade),), None, {'duration': TIMES[-1] + 0.5, **arguments},
                {'hold_time': 1e3, **config}, part, exact=True)


MOVING = tuple(itertools.product(('flight', 'car'), GRADES))
POSITIONS = {'use_velocity': False}
# In the order of the tables. A lever arm or delay with a sigma is unknown to the bound too.
CASES = (
    *(case_of('velocity', *moving) for moving in MOVING),
    *(case_of('velocity, gyro bias 0.5 deg/s', scenario, 'mems', part=2,
              gyro_bias_std=np.radians(0.5)) for scenario in ('flight', 'car')),
    *(case_of('RTK 2 cm, 5 Hz', *moving, POSITIONS, part=2, position_std=0.02)
      for moving in MOVING),
    *(case_of('position 1 m white, 1 Hz', *moving, POSITIONS, part=4, position_std=1.0,
              gnss_rate=1.0) for moving in MOVING),
    *(case_of('unknown lever arm', 'flight', grade, {
        'lever_arm': (0.0, 0.0, 0.0), 'lever_arm_std': LEVER_STD}, part=2) for grade in GRADES),
    *(case_of('unknown delay', 'flight', grade, {'gnss_delay_std': DELAY_STD}, part=2,
              gnss_delay=DELAY) for grade in GRADES),
    case_of('standing: north from the Earth rate', 'static', 'navigation', part=4))


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``bound``: all cases, with their errors over the bound and their NEES."""
    [bounds] = parallel(bound_of, [CASES], jobs, 'bounds')
    groups = run_cases(run_exact, CASES, runs, jobs)
    results = [each for case, limit, (_, found) in zip(CASES, bounds, groups)
               for each in results_of(case, limit, found)]
    report.text(
        'GNSS 5 Hz, 0.1 m/s, lever arm [1 1 1] m unless said otherwise. Errors of the attitude at '
        't0; tilt: both axes. NEES/3: mean normalised squared error of the three angles, 1 when '
        'sigma is right. Chance alone (1 sigma) moves a ratio by the root of 1/(2 runs), NEES/3 '
        'by that of 2/(3 runs). The aligner is told the noise and that lever arm and delay are '
        f'known, but where they are the unknown (prior {LEVER_STD:g} m per axis; true {DELAY:g} '
        f's, prior {DELAY_STD:g} s).')
    report.table(
        f'Targets: ratio of error and bound at most {RATIO_LIMIT:g}, NEES/3 within '
        f'{NEES_RANGE[0]:g} to {NEES_RANGE[1]:g}; beyond chance: by more than two of its sigmas',
        [target_row(title, [each for each in results if each['title'] == title])
         for title in dict.fromkeys(case.name for case in CASES)])
    report.table('Root mean square errors, bounds and their ratios', map(result_row, results))
    return {'runs': runs, 'results': results}


def run_exact(task: tuple[Case, int]) -> JsonDict:
    """
    Run a case with a seed, and return the errors of the attitude at t0 at each of K epochs.

    ``time`` (K,) is in s since t0, ``nees`` (K,) the normalised squared error; in degrees
    ``error_deg`` (K, 3) is about east, north, up, and ``rpy_deg`` (K, 3) of roll, pitch, yaw.
    """
    case, seed = task
    if 'lever_arm_std' in case.config:      # drawn in each run, while that of the bound is fixed
        lever_arm = LEVER_STD * np.random.default_rng([3, seed]).standard_normal(3)
        case = case._replace(simulate=case.simulate | {'lever_arm': lever_arm})
    simulation, stream, aligner = prepare(case, seed)
    rows = []
    for epoch in itertools.chain(*follow(aligner, stream)):
        if epoch.dry:
            continue
        row = np.full(7, np.nan)
        if epoch.initial is not None:
            C_true = simulation.attitude_at(epoch.initial.stamp_ns)
            error = error_of(epoch.initial, C_true)
            rpy = roll_pitch_yaw(epoch.initial.C_nb) - roll_pitch_yaw(C_true)
            row[:] = [error['nees'], *error['angles_deg'], *np.degrees(
                np.remainder(rpy + np.pi, 2 * np.pi) - np.pi)]
        rows.append([epoch.t_s, *row])
    table = np.array(rows)
    return {'time': table[:, 0], 'nees': table[:, 1], 'error_deg': table[:, 2:5],
            'rpy_deg': table[:, 5:]}


def epochs_at_times(time: Array) -> Any:
    """Return the indices of the last epochs up to each of `TIMES`."""
    return np.searchsorted(time, np.add(TIMES, 1e-6)) - 1


def rms(values: Any) -> Any:
    """Root mean square along the first axis."""
    return np.sqrt(np.mean(np.square(values), axis=0))


def results_of(case: Case, bound: dense.Bound, runs: list[JsonDict]) -> list[JsonDict]:
    """Return the statistics of a case's runs at each of `TIMES`."""
    error, nees = (np.array([run[name][epochs_at_times(run['time'])] for run in runs])
                   for name in ('error_deg', 'nees'))
    [(scenario, grade)], results = case.motions, []
    for k, time in enumerate(TIMES):
        east, north, up = np.diag(bound.at(time))
        result = {'title': case.name, 'scenario': scenario, 'grade': grade, 'time': time,
                  'runs': len(runs), 'nees': np.mean(nees[:, k]) / 3}
        for angle, errors, variance in (('tilt', np.hypot(*error[:, k, :2].T), east + north),
                                        ('heading', error[:, k, 2], up)):
            limit = np.degrees(np.sqrt(variance))
            result |= {f'{angle}_deg': rms(errors), f'{angle}_bound_deg': limit,
                       f'{angle}_ratio': rms(errors) / limit}
        results.append(result)
    return results


def target_row(title: str, results: list[JsonDict]) -> JsonDict:
    """Return the table row on how the cases of one title meet the targets."""
    row: JsonDict = {'case': title, 'figures': len(results)}
    for angle in ANGLES:
        ratios = [each[f'{angle}_ratio'] for each in results]
        row |= {f'{angle} met': sum(ratio <= RATIO_LIMIT for ratio in ratios),
                f'{angle} beyond chance': sum(
                    ratio > RATIO_LIMIT + 2 / np.sqrt(2 * each['runs'])
                    for ratio, each in zip(ratios, results)),
                f'{angle} mean': f'{np.mean(ratios):.2f}',
                f'{angle} largest': f'{max(ratios):.2f}'}
    nees = [each['nees'] for each in results]
    return row | {'NEES/3 met': sum(NEES_RANGE[0] <= each <= NEES_RANGE[1] for each in nees),
                  'mean': f'{np.mean(nees):.2f}', 'least': f'{min(nees):.2f}',
                  'largest': f'{max(nees):.2f}'}


def result_row(result: JsonDict) -> JsonDict:
    """Return the table row of one case at one time."""
    row = {'case': '{title}, {scenario}, {grade}'.format(**result), 't, s': f'{result["time"]:g}'}
    for angle in ANGLES:
        row |= {f'{angle}, deg': f'{result[f"{angle}_deg"]:.2g}',
                f'{angle} bound': f'{result[f"{angle}_bound_deg"]:.2g}',
                f'{angle} ratio': f'{result[f"{angle}_ratio"]:.2f}'}
    return row | {'NEES/3': f'{result["nees"]:.2f}', 'runs': result['runs']}


# The note

SHOWN_FROM = 3.0        # s; larger errors before this time may lie outside the figure
LEVER, NO_LEVER = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
LETTER = {'method': 'vif', 'free_start': False}     # the note to the letter
# Name, lever arm of the vehicle, configuration beside the exact model, whether with MEMS too.
VARIANTS: tuple[tuple[str, tuple[float, ...], JsonDict, bool], ...] = (
    ('not compensated', LEVER, {**LETTER, 'lever_arm': NO_LEVER}, False),
    ('compensated', LEVER, LETTER, True), ('zero lever arm', NO_LEVER, LETTER, False),
    ('not compensated, free start', LEVER, {'method': 'vif', 'lever_arm': NO_LEVER}, False),
    ('compensated, free start', LEVER, {'method': 'vif'}, True),
    ('bank', LEVER, {'method': 'bank'}, True))
NOTE_CASES = tuple(
    case_of(f'{grade}: {name}', 'flight', grade, {'hold_time': Config().hold_time, **config},
            duration=100.0, lever_arm=lever)
    for grade in ('navigation', 'mems') for name, lever, config, mems_too in VARIANTS
    if mems_too or grade == 'navigation')
# The variants in the figure, which are those of the note, and their colours.
SHOWN = {'not compensated': '#D55E00', 'compensated': '#0072B2', 'zero lever arm': '#009E73'}


def run_note(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``note``: all variants with an IMU of navigation grade, some with MEMS too."""
    report.text(
        'Scenario `flight` (100 m/s, S-turns with 40 s period, oscillation of 2 to 3 deg about '
        f'all axes), IMU 100 Hz, GNSS velocity 5 Hz, 0.1 m/s; lever arm {list(LEVER)} m; {runs} '
        'runs. The note does not give its own set-up. Errors of the attitude at t0.')
    results = run_cases(run_exact, NOTE_CASES, runs, jobs)
    time = results[0][1][0]['time']
    errors = {name: np.array([each['rpy_deg'] for each in found]) for name, found in results}
    heading = {name: rms(each[:, epochs_at_times(time), 2]) for name, each in errors.items()}
    for case in NOTE_CASES:
        if case.name.endswith('bank'):
            limit = bound_of(case)
            heading[case.name.replace('bank', 'Cramer-Rao bound')] = np.degrees(np.sqrt(
                [limit.at(t)[2, 2] for t in TIMES]))
    report.table(
        'Heading error, rms in deg. Without "free start" and bank: free_start false, the note to '
        'the letter', [{'variant': name, **{f'{t:g} s': f'{value:.2g}'
                                            for t, value in zip(TIMES, values)}}
                       for name, values in heading.items()])
    report.figure(mean_figure(errors, time), f'Mean errors of {runs} runs, method `vif` without '
                  'free start, as in Fig. 1 of the note, which shows early peaks without '
                  'compensation, gone with it, and compensated like zero lever arm')
    return {'runs': runs, 'times_s': TIMES, 'rms_heading_deg': heading}


def mean_figure(errors: dict[str, Array], time: Array) -> Any:
    """Draw the mean errors (runs, K, 3) of `SHOWN` over time (K,)."""
    means = {name: np.mean(errors[f'navigation: {name}'], axis=0) for name in SHOWN}
    figure = new_figure(8.0, 8.0)
    panels = figure.subplots(3, 1, sharex=True)
    for column, (axes, angle) in enumerate(zip(panels, ('roll', 'pitch', 'heading'))):
        for name, mean in means.items():
            axes.plot(time, mean[:, column], color=SHOWN[name], label=name,
                      linestyle='--' if name == 'zero lever arm' else '-')
        shown = max(np.nanmax(np.abs(mean[time >= SHOWN_FROM, column])) for mean in means.values())
        axes.set(ylabel=f'{angle} (deg)', ylim=(-1.1 * shown, 1.1 * shown), xlim=(0.0, time[-1]))
        axes.grid(alpha=0.25)
    panels[0].set_title(f'mean alignment error (scaled to what is seen after {SHOWN_FROM:g} s)')
    panels[0].legend(fontsize=8)
    panels[-1].set_xlabel('time since t0 (s)')
    return figure
