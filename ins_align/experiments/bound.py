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
from ins_align.experiments.common import error_of, exact_config_for, GRADES, parallel, Report, rms
from ins_align.geometry.rotation import Array
from ins_align.report import new_figure
from ins_align.simulation.simulate import epochs_of, simulate, Simulation
import numpy as np

TIMES = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 30.0, 50.0, 70.0, 100.0)
TABLE_TIMES = (10.0, 20.0, 50.0, 100.0)
LARGE_GYRO_BIAS = np.radians(0.5)
LEVER_STD, DELAY, DELAY_STD = 1.0, 0.12, 0.1
UNKNOWN_STD: dict[str, dict[str, float]] = {
    '': {}, 'lever arm': {'lever_arm_std': LEVER_STD}, 'delay': {'delay_std': DELAY_STD}}
POSITIONS = {'RTK 2 cm, 5 Hz': ({'position_std': 0.02}, 0.5),
             'position 1 m white, 1 Hz': ({'position_std': 1.0, 'gnss_rate': 1.0}, 0.25)}
# Targets.
RATIO_LIMIT, NEES_RANGE = 1.10, (0.85, 1.15)

Numbers = dict[str, Any]


class Case(NamedTuple):
    """One row of Monte Carlo: what is simulated, and what of it is known."""

    title: str
    scenario: str
    grade: str
    simulate: Numbers
    position_only: bool = False
    unknown: str = ''           # 'lever arm' or 'delay'
    share: float = 0.5          # of the runs asked for


def cases() -> list[Case]:
    """Return all cases in the order of the tables."""
    moving = ('flight', 'car')
    result = [Case('velocity', *pair, {}, share=1.0) for pair in itertools.product(moving, GRADES)]
    result += [Case('velocity, gyro bias 0.5 deg/s', scenario, 'mems',
                    {'gyro_bias_std': LARGE_GYRO_BIAS}) for scenario in moving]
    result += [Case(title, scenario, grade, arguments, position_only=True, share=share)
               for (title, (arguments, share)), scenario, grade in itertools.product(
                   POSITIONS.items(), moving, GRADES)]
    result += [Case('unknown lever arm', 'flight', grade, {}, unknown='lever arm')
               for grade in GRADES]
    result += [Case('unknown delay', 'flight', grade, {'gnss_delay': DELAY}, unknown='delay')
               for grade in GRADES]
    result.append(Case('standing: north from the Earth rate', 'static', 'navigation', {},
                       share=0.25))
    return result


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run every case and print ratios and normalised errors."""
    runs = runs or 100
    report = Report('bound', 'The estimator at the Cramer-Rao bound', out, f' --runs {runs}')
    report.text(
        'GNSS 5 Hz, 0.1 m/s, lever arm [1 1 1] m unless said otherwise. Errors of the attitude at '
        't0; tilt: both axes. The bound comes from the dense reference on the true motion. '
        'NEES/3: mean normalised squared error of the three angles, 1 when sigma is right. The '
        'last columns are what chance alone leaves of ratio and NEES/3 (1 sigma) with so many '
        'runs. The aligner is told the noise and that lever arm and delay are known, but where '
        'they are the unknown.')
    every = cases()
    bounds = parallel(bounds_of, every, jobs, 'bounds')
    counts = [run_count(case, runs) for case in every]
    tasks = [(case, seed) for case, count in zip(every, counts) for seed in range(count)]
    errors = iter(parallel(run_case, tasks, jobs, 'runs'))
    write(report, runs, [summary(case, bound, list(itertools.islice(errors, count)))
                         for case, bound, count in zip(every, bounds, counts)])


def run_count(case: Case, runs: int) -> int:
    """Return how many runs a case has."""
    return max(1, round(case.share * runs))


def write(report: Report, runs: int, results: list[Numbers]) -> None:
    """Print tables and figure, and write them."""
    reached_text(report, results)
    main_table(report, results)
    unknown_table(report, results)
    moved = [f"{result['title']}, {result['scenario']}, {result['grade']}: "
             f"{result['runs_with_moved_t0']}" for result in results
             if result['runs_with_moved_t0']]
    if moved:
        report.text('Runs in which t0 was moved forward, so that the attitude is that of another '
                    f'instant than the bound: {"; ".join(moved)}.')
    report.figure(figure(results), '', 'Errors of the attitude at t0 (dots: rms; lines: '
                  'Cramer-Rao bound), GNSS velocity')
    report.write({'runs': runs, 'times_s': TIMES, 'cases': results})


def simulation_of(case: Case, seed: int) -> Simulation:
    """Simulate a run of a case; an unknown lever arm is another one in each."""
    arguments = dict(case.simulate)
    if case.unknown == 'lever arm':
        arguments['lever_arm'] = LEVER_STD * np.random.default_rng([3, seed]).standard_normal(3)
    return simulate(case.scenario, imu_grade=case.grade, seed=seed, duration=TIMES[-1] + 0.5,
                    **arguments)


def bounds_of(case: Case) -> tuple[Array, Array]:
    """Bound of tilt (both axes) and heading at all times, degrees, with the case's unknowns."""
    simulation = simulate(case.scenario, imu_grade=case.grade, duration=TIMES[-1] + 0.5,
                          **case.simulate)
    bound = dense.bound(simulation, use_velocity=not case.position_only,
                        use_position=case.position_only, **UNKNOWN_STD[case.unknown])
    P = np.array([np.diag(bound.at(time)) for time in TIMES])
    return np.degrees(np.sqrt(P[:, 0] + P[:, 1])), np.degrees(np.sqrt(P[:, 2]))


def crossing_time(task: tuple[str, str, float, float, dict[str, float]]) -> float | None:
    """
    Return when the bound of the heading crosses a threshold, None if it does not.

    Parameters
    ----------
    task : tuple
        Scenario, grade, seconds to look at, degrees, what of `dense.bound` is unknown.

    """
    scenario, grade, horizon, threshold_deg, unknown = task
    bound = dense.bound(simulate(scenario, imu_grade=grade, duration=horizon), **unknown)
    good = np.degrees(np.sqrt(bound.covariance[:, 2, 2])) <= threshold_deg
    return float(bound.time[np.argmax(good)]) if good.any() else None


def run_case(task: tuple[Case, int]) -> Numbers:
    """Run the aligner; errors at all times."""
    case, seed = task
    simulation = simulation_of(case, seed)
    # Nothing is declared, for that may move t0, and the bound is about the first one.
    changes: Numbers = {'hold_time': 1e3}
    if case.position_only:
        changes['use_velocity'] = False
    if case.unknown == 'lever arm':
        changes |= {'lever_arm': (0.0, 0.0, 0.0), 'lever_arm_std': LEVER_STD}
    if case.unknown == 'delay':
        changes['gnss_delay_std'] = DELAY_STD
    aligner = Aligner(exact_config_for(simulation, **changes))
    attitudes: list[Any] = [None] * len(TIMES)
    for epoch in epochs_of(aligner, simulation, velocity=not case.position_only):
        for k, time in enumerate(TIMES):
            if epoch.t_s <= time + 1e-6:
                attitudes[k] = epoch.initial
    error = np.full((len(TIMES), 3), np.nan)
    nees = np.full(len(TIMES), np.nan)
    for k, attitude in enumerate(attitudes):
        if attitude is not None:
            error[k], _, nees[k] = error_of(attitude, simulation.attitude_at(attitude.stamp_ns))
    status = aligner.status()
    nuisance = None
    if case.unknown == 'lever arm':
        nuisance = (status.lever_arm - simulation.lever_arm, status.lever_arm_std)
    if case.unknown == 'delay':
        nuisance = ([status.gnss_delay - DELAY], [status.gnss_delay_std])
    return {'error': error, 'nees': nees, 'nuisance': nuisance,
            'moved': status.counts.get('rebases', 0)}


def summary(case: Case, bound: tuple[Array, Array], runs: list[Numbers]) -> Numbers:
    """Return the statistics of a case's runs over time."""
    error = np.array([each['error'] for each in runs])
    tilt = rms(np.hypot(error[..., 0], error[..., 1]), axis=0)
    heading = rms(error[..., 2], axis=0)
    nees = np.mean([each['nees'] for each in runs], axis=0) / 3
    result = {'title': case.title, 'scenario': case.scenario, 'grade': case.grade,
              'unknown': case.unknown, 'runs': len(runs),
              'tilt_deg': tilt, 'tilt_bound_deg': bound[0],
              'tilt_ratio': tilt / bound[0], 'heading_deg': heading,
              'heading_bound_deg': bound[1], 'heading_ratio': heading / bound[1], 'nees': nees,
              'runs_with_moved_t0': sum(each['moved'] > 0 for each in runs)}
    if case.unknown:
        errors, stds = (np.array([each['nuisance'][place] for each in runs]) for place in (0, 1))
        result |= {'nuisance_rms': rms(errors), 'nuisance_std': rms(stds),
                   'nuisance_sigmas': rms(errors / stds)}
    return result


def chances(runs: int) -> tuple[float, float]:
    """Return the standard deviations of a heading's ratio and of NEES/3 in so many runs."""
    return 1 / np.sqrt(2 * runs), np.sqrt(2 / 3 / runs)


def reached_text(report: Report, results: list[Numbers]) -> None:
    """Say how many of the table's figures meet their targets."""
    places = [TIMES.index(time) for time in TABLE_TIMES]
    sentences = []
    for title in dict.fromkeys(result['title'] for result in results):
        chosen = [result for result in results if result['title'] == title]
        tilt, heading, nees = (np.array([result[name][places] for result in chosen])
                               for name in ('tilt_ratio', 'heading_ratio', 'nees'))
        slack = 2 * chances(chosen[0]['runs'])[0]
        sentences.append(
            f'- {title}: ratio at most {RATIO_LIMIT:g} in {np.sum(tilt <= RATIO_LIMIT)} of '
            f'{tilt.size} figures for tilt (mean {np.mean(tilt):.2f}, largest {np.max(tilt):.2f}) '
            f'and {np.sum(heading <= RATIO_LIMIT)} for heading (mean {np.mean(heading):.2f}, '
            f'largest {np.max(heading):.2f}; {np.sum(heading > RATIO_LIMIT + slack)} beyond two '
            f'sigma of chance above it); NEES/3 within {NEES_RANGE[0]:g} to {NEES_RANGE[1]:g} in '
            f'{np.sum((nees >= NEES_RANGE[0]) & (nees <= NEES_RANGE[1]))} (mean '
            f'{np.mean(nees):.2f}, {np.min(nees):.2f} to {np.max(nees):.2f})')
    report.text('\n'.join(sentences))


def main_table(report: Report, results: list[Numbers]) -> None:
    """Print all cases at the table's times."""
    rows = []
    for result in results:
        for time in TABLE_TIMES:
            k = TIMES.index(time)
            rows.append([
                f"{result['title']}, {result['scenario']}, {result['grade']}", f'{time:g}',
                *(f'{result[name][k]:.2g}' for name in ('tilt_deg', 'tilt_bound_deg')),
                f"{result['tilt_ratio'][k]:.2f}",
                *(f'{result[name][k]:.2g}' for name in ('heading_deg', 'heading_bound_deg')),
                f"{result['heading_ratio'][k]:.2f}", f"{result['nees'][k]:.2f}", result['runs'],
                *(f'{chance:.2f}' for chance in chances(result['runs']))])
    report.table('Root mean square errors, bounds and their ratios', [
        'case', 't, s', 'tilt, deg', 'bound', 'ratio', 'heading, deg', 'bound', 'ratio',
        'NEES/3', 'runs', '+- ratio', '+- NEES/3'], rows)


def unknown_table(report: Report, results: list[Numbers]) -> None:
    """Print how well lever arm and delay were estimated."""
    rows = [[result['title'], result['grade'],
             *(f'{result[name]:.2g}' for name in ('nuisance_rms', 'nuisance_std')),
             f"{result['nuisance_sigmas']:.2f}"] for result in results if result['unknown']]
    report.table(
        f'Lever arm (prior {LEVER_STD:g} m per axis) and delay (true {DELAY:g} s, prior '
        f'{DELAY_STD:g} s) as unknowns on `flight`, after {TIMES[-1]:g} s; above, the bound knows '
        'no more than the aligner', [
            'case', 'IMU', 'rms error (m or s)', 'stated sigma', 'rms of error/sigma'], rows)


def figure(results: list[Numbers]) -> Any:
    """Draw errors and bounds over time."""
    picture = new_figure(11.0, 7.5)
    axes = picture.subplots(2, 2, sharex=True)
    colours = dict(zip(GRADES, ('#0072B2', '#E69F00', '#D55E00')))
    for column, scenario in enumerate(('flight', 'car')):
        for line, angle in enumerate(('tilt', 'heading')):
            ax = axes[line, column]
            for result in results:
                if result['title'] == 'velocity' and result['scenario'] == scenario:
                    colour = colours[result['grade']]
                    ax.loglog(TIMES, result[f'{angle}_bound_deg'], color=colour,
                              label=f"{result['grade']}, bound")
                    ax.loglog(TIMES, result[f'{angle}_deg'], 'o', color=colour, markersize=5,
                              label=f"{result['grade']}, rms error")
            ax.set_title(f'{scenario}: {angle}')
            ax.set_ylabel('deg')
            ax.grid(which='both', alpha=0.25)
            ax.set_xticks([3, 5, 10, 20, 50, 100], ['3', '5', '10', '20', '50', '100'])
            ax.minorticks_off()
        axes[1, column].set_xlabel('time since t0 (s)')
    axes[0, 0].legend(fontsize=8)
    return picture
