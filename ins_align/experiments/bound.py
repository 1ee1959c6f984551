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
Experiments ``bound`` and ``note``: what an aligner that knows the very model reaches.

``bound`` has the errors of `method: bank` against the Cramer-Rao bound, and its sigma. The bound
comes from the dense reference on the true motion. ``note`` has the note's simulation with and
without its lever-arm term, and its remarks. The note says of its set-up: lever arm [1 1 1] m, 100
runs, the simulation of its predecessor, which it does not describe. Here: scenario `flight`,
navigation grade, velocity 0.1 m/s at 5 Hz. Errors are those of the attitude at t0 after so many
seconds of data.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Aligner
from ins_align.experiments import dense
from ins_align.experiments.common import (
    Column, draw, error_of, exact_config_for, field, GRADES, JsonDict, parallel, Report, rms)
from ins_align.geometry.earth import EARTH_RATE, earth_rate_n, LocalLevel
from ins_align.geometry.rotation import apply, Array, cross, roll_pitch_yaw, skew
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
    """Run ``bound``: every case; print ratios and normalised errors."""
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
        'flight', 'car')] for angle in ('tilt', 'heading')], sharex=True),
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


# The note

DURATION = 100.0
PEAK_FROM, PEAK_TO = 2.0, 20.0      # s, where the note's Fig. 1 has its lumps
SHOWN_FROM = 3.0                    # s, larger errors before may lie outside of the figure
REMARK_DURATION = 1000.0
ANGLES = ('roll', 'pitch', 'heading')
LEVER, NO_LEVER = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
# Name, lever arm of the vehicle, what the aligner is told beside the grade.
VARIANTS: dict[str, tuple[tuple[float, ...], JsonDict]] = {
    'not compensated': (LEVER, {'method': 'vif', 'free_start': False, 'lever_arm': NO_LEVER}),
    'compensated': (LEVER, {'method': 'vif', 'free_start': False}),
    'zero lever arm': (NO_LEVER, {'method': 'vif', 'free_start': False}),
    'not compensated, free start': (LEVER, {'method': 'vif', 'lever_arm': NO_LEVER}),
    'compensated, free start': (LEVER, {'method': 'vif'}),
    'bank': (LEVER, {'method': 'bank'}),
}
NOTE_RUNS = (*(('navigation', name) for name in VARIANTS), ('mems', 'compensated'),
             ('mems', 'compensated, free start'), ('mems', 'bank'))
# Those of the figure, as in the note.
SHOWN = {'not compensated': '#D55E00', 'compensated': '#0072B2', 'zero lever arm': '#009E73'}


def run_note(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``note``: all variants, navigation grade; some of them with MEMS too."""
    report.text(
        'Scenario `flight` (100 m/s, S-turns with 40 s period, oscillation of 2 to 3 deg about '
        f'all axes), IMU 100 Hz, GNSS velocity 5 Hz, 0.1 m/s; lever arm {list(LEVER)} m; {runs} '
        'runs. The note does not give its own set-up. Errors of the attitude at t0.')
    errors = dict(zip(NOTE_RUNS, map(np.array, parallel(run_variant, [
        [(*each, seed) for seed in range(runs)] for each in NOTE_RUNS], jobs, 'runs'))))
    time = np.arange(errors['navigation', 'bank'].shape[1]) / 5.0
    heading = [(f'{grade}: {name}', rms(each[..., 2], axis=0))
               for (grade, name), each in errors.items()]
    heading += [(f'{grade}: Cramer-Rao bound', heading_bound(grade))
                for grade in ('navigation', 'mems')]
    table = {name: {f'{t:g} s': each[np.argmin(np.abs(time - t))] for t in TABLE_TIMES}
             for name, each in heading}
    peaks = peaks_of(errors, time)
    for title, numbers in (
            ('Heading error, rms in deg. Without "free start" and bank: free_start false, the '
             'note to the letter', table),
            (f'Mean error, deg: largest from {PEAK_FROM:g} to {PEAK_TO:g} s, at {DURATION:g} s, '
             'and largest difference early from that of zero lever arm with the same noise',
             peaks)):
        report.table(title, [{'variant': name, **row} for name, row in numbers.items()], [
            field('variant', 'variant'),
            *(field(name, name, '.2g') for name in next(iter(numbers.values())))])
    none = errors['navigation', 'zero lever arm']
    chance = np.max(np.std(none, axis=0, ddof=1)[early(time)], axis=0) / np.sqrt(len(none))
    report.text(
        "The note's Fig. 1 shows early peaks without compensation, gone with it, and compensated "
        'like zero lever arm. What the noise alone leaves in these means (1 sigma): '
        + ', '.join(f'{angle} {value:.2g}' for angle, value in zip(ANGLES, chance)) + ' deg.')
    report.figure(mean_figure(errors, time), f'Mean errors of {runs} runs, method `vif` without '
                  'free start, as in Fig. 1 of the note')
    return {'runs': runs, 'rms_heading_deg': table, 'peak_deg': peaks,
            'remark_2_1': remarks_text(report)}


def run_variant(task: tuple[str, str, int]) -> Array:
    """Return errors of roll, pitch, yaw, degrees, at every epoch, shape (K, 3)."""
    grade, name, seed = task
    lever, told = VARIANTS[name]
    simulation = simulate('flight', imu_grade=grade, seed=seed, duration=DURATION,
                          lever_arm=lever)
    aligner = Aligner(exact_config_for(simulation, **told))
    errors = np.full((len(simulation.gnss_stamps_ns), 3), np.nan)
    for epoch in epochs_of(aligner, simulation):
        if epoch.initial is not None:
            rpy, true_rpy = (roll_pitch_yaw(C) for C in (
                epoch.initial.C_nb, simulation.attitude_at(epoch.initial.stamp_ns)))
            errors[np.searchsorted(simulation.gnss_stamps_ns, epoch.stamp_ns)] = np.degrees(
                np.remainder(rpy - true_rpy + np.pi, 2 * np.pi) - np.pi)
    return errors


def heading_bound(grade: str) -> Array:
    """Bound of the heading at every epoch, degrees."""
    P = dense.bound(simulate('flight', imu_grade=grade, duration=DURATION)).covariance
    return np.degrees(np.sqrt(P[:, 2, 2]))


def early(time: Array) -> Array:
    """Whether it is the time in which the note has its lumps."""
    return (time >= PEAK_FROM) & (time <= PEAK_TO)


def peaks_of(errors: dict[tuple[str, str], Array], time: Array) -> dict[str, dict[str, float]]:
    """Return the largest mean errors early on, and how far they are from those of no lever arm."""
    means = {name: np.mean(errors['navigation', name], axis=0) for name in SHOWN}
    apart = {name: mean - means['zero lever arm'] for name, mean in means.items()}
    return {name: {
        f'{angle}{when}': np.max(np.abs(values[rows, axis]))
        for when, values, rows in (('', mean, early(time)), (', end', mean, time == time[-1]),
                                   (', apart', apart[name], early(time)))
        for axis, angle in enumerate(ANGLES)} for name, mean in means.items()}


def mean_figure(errors: dict[tuple[str, str], Array], time: Array) -> Any:
    """Draw mean errors over time."""
    means = {name: np.mean(errors['navigation', name], axis=0) for name in SHOWN}
    shown = np.max([np.nanmax(np.abs(mean[time >= SHOWN_FROM]), axis=0)
                    for mean in means.values()], axis=0)
    return draw(8.0, 8.0, [[{
        'title': '' if column else
        f'mean alignment error (scaled to what is seen after {SHOWN_FROM:g} s)',
        'ylabel': f'{angle} (deg)', 'ylim': 1.1 * shown[column] * np.array([-1.0, 1.0]),
        'xlim': (0.0, DURATION), 'lines': [(time, mean[:, column], {
            'color': SHOWN[name], 'label': name,
            'linestyle': '--' if name == 'zero lever arm' else '-'})
            for name, mean in means.items()]}]
        for column, angle in enumerate(ANGLES)], sharex=True)


def remarks_text(report: Report) -> JsonDict:
    """Print how large the terms of Remarks 2.1 and 2.2 are."""
    seconds, remainder, limit, term, integral = remarks_of(REMARK_DURATION)
    share = np.max(remainder[1:] / limit[1:])
    moments = [(t, np.searchsorted(seconds, t)) for t in (1.0, 10.0, 100.0)]
    report.text(
        f'Remark 2.1: over {REMARK_DURATION:g} s the short form of (9) misses at most '
        f'{remainder.max():.2g} m/s; the limit 2 W^2 t |l| is {limit[-1]:.2g} m/s at the end; the '
        f'remainder is at most {share:.2f} of it. Remark 2.2: after '
        + ', '.join(f'{t:g} s the lever-arm term is {term[k]:.2g} m/s, the integral '
                    f'{integral[k]:.3g} m/s' for t, k in moments) + '.')
    return {'largest_m_s': remainder.max(), 'limit_at_end_m_s': limit[-1],
            'largest_share_of_limit': share}


def remarks_of(duration: float) -> tuple[Array, Array, Array, Array, Array]:
    """
    Terms of (9) on the true motion, five arrays (N,).

    Time, s; then, m/s: what the short form leaves out, its limit, the lever-arm term, the integral
    of the specific force.
    """
    truth = simulate('flight', ideal=True, duration=duration, gnss_rate=1.0)
    time = (truth.truth_stamps_ns - truth.truth_stamps_ns[0]) * 1e-9
    lever_b, C_nb = np.array(LEVER), truth.truth_C_nb
    latitude, longitude = np.radians(truth.truth_lla[:, :2]).T
    C_b0b = C_nb[0].T @ LocalLevel(latitude[0], longitude[0]).matrix(
        time, latitude, longitude) @ C_nb
    omega_ie_n = earth_rate_n(latitude)
    omega_eb_b = truth.truth_gyro - np.einsum('nji,nj->ni', C_nb, omega_ie_n)
    remainder = exact_lever_remainder(time, C_b0b, omega_eb_b, C_nb[0].T @ omega_ie_n[0],
                                      lever_b)
    turned = apply(C_b0b, cross(truth.truth_gyro, lever_b))
    integral = dense.cumulative(time, apply(C_b0b, truth.truth_accel))
    return (time, np.linalg.norm(remainder, axis=1),
            2 * EARTH_RATE ** 2 * time * np.linalg.norm(lever_b),
            np.linalg.norm(turned - turned[0], axis=1), np.linalg.norm(integral, axis=1))


def exact_lever_remainder(time: Array, C_b0b: Array, omega_eb_b: Array, omega_ie_b0: Array,
                          lever_b: Array) -> Array:
    """
    Difference of the exact form of (9) from the short one: the oracle of Remark 2.1.

    For times (N,) from t0 on, attitudes to t0 (N, 3, 3), rates to the Earth (N, 3), the Earth rate
    in b0 and the lever arm (3,) in SI units; (N, 3), m/s, at most ``W^2 t |lever|``.
    """
    rate = skew(omega_eb_b)
    omega_ie_b = C_b0b.transpose(0, 2, 1) @ omega_ie_b0
    exact = C_b0b @ rate - rate[0] + skew(omega_ie_b0) @ dense.cumulative(time, C_b0b @ rate)
    omega_ib_b = omega_eb_b + omega_ie_b
    short = C_b0b @ skew(omega_ib_b) - skew(omega_ib_b[0])
    return (exact - short) @ lever_b
