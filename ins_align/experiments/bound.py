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

from collections.abc import Sequence
import itertools
from pathlib import Path
from typing import Any

from ins_align.aligner import Aligner
from ins_align.config import Config
from ins_align.experiments import dense
from ins_align.experiments.common import (
    Case, Column, error_of, exact_config_for, field, GRADES, JsonDict, line_figure, parallel,
    Report, rms)
from ins_align.geometry.earth import EARTH_RATE, earth_rate_n, LocalLevel
from ins_align.geometry.rotation import apply, Array, cross, roll_pitch_yaw, skew
from ins_align.simulation.simulate import epochs_of, simulate
import numpy as np

TIMES = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 30.0, 50.0, 70.0, 100.0)
TABLE_TIMES = (10.0, 20.0, 50.0, 100.0)
LEVER_STD, DELAY, DELAY_STD = 1.0, 0.12, 0.1
# Targets.
RATIO_LIMIT, NEES_RANGE = 1.10, (0.85, 1.15)


def case_of(name: str, scenario: str, grade: str, config: JsonDict = {}, **arguments: Any) -> Case:
    """Return a case; `config` is beside the very model of its simulation."""
    return Case(name, scenario, {'imu_grade': grade, 'duration': TIMES[-1] + 0.5, **arguments},
                config)


MOVING = tuple(itertools.product(('flight', 'car'), GRADES))
POSITIONS = {'use_velocity': False}
# In the order of the tables. What has a sigma in the configuration is unknown to the bound too.
CASES = (
    *(case_of('velocity', *moving) for moving in MOVING),
    *(case_of('velocity, gyro bias 0.5 deg/s', scenario, 'mems', gyro_bias_std=np.radians(0.5))
      for scenario in ('flight', 'car')),
    *(case_of('RTK 2 cm, 5 Hz', *moving, POSITIONS, position_std=0.02) for moving in MOVING),
    *(case_of('position 1 m white, 1 Hz', *moving, POSITIONS, position_std=1.0, gnss_rate=1.0)
      for moving in MOVING),
    *(case_of('unknown lever arm', 'flight', grade, {
        'lever_arm': (0.0, 0.0, 0.0), 'lever_arm_std': LEVER_STD}) for grade in GRADES),
    *(case_of('unknown delay', 'flight', grade, {'gnss_delay_std': DELAY_STD}, gnss_delay=DELAY)
      for grade in GRADES),
    case_of('standing: north from the Earth rate', 'static', 'navigation'))
# Of the runs asked for.
SHARES = {case.name: 0.5 for case in CASES} | {
    'velocity': 1.0, 'position 1 m white, 1 Hz': 0.25, 'standing: north from the Earth rate': 0.25}


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``bound``: every case; print ratios and normalised errors."""
    [bounds] = parallel(bound_of, [CASES], jobs, 'bounds')
    summaries = [summary(*each) for each in zip(CASES, bounds, run_all(CASES, runs, jobs))]
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
            for title in SHARES], TARGET_COLUMNS)
    report.table('Root mean square errors, bounds and their ratios', rows, ROW_COLUMNS)
    report.table(
        f'Lever arm (prior {LEVER_STD:g} m per axis) and delay (true {DELAY:g} s, prior '
        f'{DELAY_STD:g} s) as unknowns on `flight`, after {TIMES[-1]:g} s; above, the bound knows '
        'no more than the aligner', [result for result in summaries if 'nuisance_rms' in result], [
            field('case', 'title'), field('IMU', 'grade'),
            field('rms error (m or s)', 'nuisance_rms', '.2g'),
            field('stated sigma', 'nuisance_std', '.2g'),
            field('rms of error/sigma', 'nuisance_sigmas', '.2f')])
    report.figure(line_figure(11.0, 7.5, [[panel(summaries, scenario, angle) for scenario in (
        'flight', 'car')] for angle in ('tilt', 'heading')], sharex=True),
        'Errors of the attitude at t0 (dots: rms; lines: Cramer-Rao bound), GNSS velocity')
    return {'runs': runs, 'times_s': TIMES, 'cases': summaries}


def run_all(cases: Sequence[Case], runs: int, jobs: int | None) -> list[list[JsonDict]]:
    """Run every case with its share of the runs."""
    return parallel(run_exact, [
        [(case, seed) for seed in range(max(1, round(SHARES.get(case.name, 1.0) * runs)))]
        for case in cases], jobs, 'runs')


def bound_of(case: Case) -> dense.Bound:
    """Return the bound of a case, with what is unknown in it."""
    velocity = case.config.get('use_velocity', True)
    return dense.bound(
        simulate(case.scenario, **case.simulate), use_velocity=velocity, use_position=not velocity,
        lever_arm_std=case.config.get('lever_arm_std', 0.0),
        delay_std=case.config.get('gnss_delay_std', 0.0))


def run_exact(task: tuple[Case, int]) -> JsonDict:
    """
    Run an aligner that knows the very model.

    At its K epochs: time (K,), s since t0, and of the attitude at t0 errors about east, north, up
    (K, 3) and of roll, pitch, yaw (K, 3), degrees, and the normalised squared error (K,). At the
    end errors and sigmas of what is unknown.
    """
    case, seed = task
    changes: JsonDict = {'seed': seed}
    if 'lever_arm_std' in case.config:      # another one in each run
        changes['lever_arm'] = LEVER_STD * np.random.default_rng([3, seed]).standard_normal(3)
    simulation = simulate(case.scenario, **case.simulate, **changes)
    # Nothing is declared, for that may move t0, and the bound is about the first one.
    aligner = Aligner(exact_config_for(simulation, **{'hold_time': 1e3, **case.config}))
    rows = []
    for epoch in epochs_of(aligner, simulation, velocity=case.config.get('use_velocity', True)):
        row = np.full(7, np.nan)
        if epoch.initial is not None:
            C_true = simulation.attitude_at(epoch.initial.stamp_ns)
            error = error_of(epoch.initial, C_true)
            rpy = roll_pitch_yaw(epoch.initial.C_nb) - roll_pitch_yaw(C_true)
            row[:] = [error['nees'], *error['angles_deg'], *np.degrees(
                np.remainder(rpy + np.pi, 2 * np.pi) - np.pi)]
        rows.append([epoch.t_s, *row])
    table, status = np.array(rows), aligner.status()
    nuisance = ([status.gnss_delay - DELAY], [status.gnss_delay_std])
    if 'lever_arm_std' in case.config:
        nuisance = (status.lever_arm - simulation.lever_arm, status.lever_arm_std)
    return {'time': table[:, 0], 'nees': table[:, 1], 'error_deg': table[:, 2:5],
            'rpy_deg': table[:, 5:], 'nuisance': nuisance}


def summary(case: Case, bound: dense.Bound, runs: list[JsonDict]) -> JsonDict:
    """Return the statistics of a case's runs over time."""
    def at_times(name: str) -> Array:
        return np.array([run[name][np.searchsorted(run['time'], np.add(TIMES, 1e-6)) - 1]
                         for run in runs])

    error, P = at_times('error_deg'), np.array([np.diag(bound.at(time)) for time in TIMES])
    result = {'title': case.name, 'scenario': case.scenario, 'grade': case.simulate['imu_grade'],
              'runs': len(runs), 'nees': np.mean(at_times('nees'), axis=0) / 3}
    for angle, errors, variance in (('tilt', np.hypot(*error.T[:2]).T, P[:, 0] + P[:, 1]),
                                    ('heading', error[..., 2], P[:, 2])):
        limit = np.degrees(np.sqrt(variance))
        result |= {f'{angle}_deg': rms(errors, axis=0), f'{angle}_bound_deg': limit,
                   f'{angle}_ratio': rms(errors, axis=0) / limit}
    if {'lever_arm_std', 'gnss_delay_std'} & {*case.config}:
        errors, stds = (np.array([run['nuisance'][place] for run in runs]) for place in (0, 1))
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
    """Return errors and bounds over time for `line_figure`."""
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

PEAK_FROM, PEAK_TO = 2.0, 20.0      # s, where the note's Fig. 1 has its lumps
SHOWN_FROM = 3.0                    # s, larger errors before may lie outside of the figure
REMARK_DURATION = 1000.0
ANGLES = ('roll', 'pitch', 'heading')
LEVER, NO_LEVER = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
LETTER = {'method': 'vif', 'free_start': False}
# Name, lever arm of the vehicle, what the aligner is told beside its very model; with MEMS too?
VARIANTS: tuple[tuple[str, tuple[float, ...], JsonDict, bool], ...] = (
    ('not compensated', LEVER, {**LETTER, 'lever_arm': NO_LEVER}, False),
    ('compensated', LEVER, LETTER, True), ('zero lever arm', NO_LEVER, LETTER, False),
    ('not compensated, free start', LEVER, {'method': 'vif', 'lever_arm': NO_LEVER}, False),
    ('compensated, free start', LEVER, {'method': 'vif'}, True),
    ('bank', LEVER, {'method': 'bank'}, True))
NOTE_CASES = tuple(
    case_of(f'{grade}: {name}', 'flight', grade, {'hold_time': Config().hold_time, **told},
            duration=100.0, lever_arm=lever)
    for grade in ('navigation', 'mems') for name, lever, told, too in VARIANTS
    if too or grade == 'navigation')
# Those of the figure, as in the note.
SHOWN = {'not compensated': '#D55E00', 'compensated': '#0072B2', 'zero lever arm': '#009E73'}


def run_note(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``note``: all variants, navigation grade; some of them with MEMS too."""
    report.text(
        'Scenario `flight` (100 m/s, S-turns with 40 s period, oscillation of 2 to 3 deg about '
        f'all axes), IMU 100 Hz, GNSS velocity 5 Hz, 0.1 m/s; lever arm {list(LEVER)} m; {runs} '
        'runs. The note does not give its own set-up. Errors of the attitude at t0.')
    results = run_all(NOTE_CASES, runs, jobs)
    time = results[0][0]['time']
    errors = {case.name: np.array([each['rpy_deg'] for each in found])
              for case, found in zip(NOTE_CASES, results)}
    places = np.searchsorted(time, np.add(TABLE_TIMES, 1e-6)) - 1
    heading = {name: rms(each[:, places, 2], axis=0) for name, each in errors.items()}
    for case in NOTE_CASES:
        if case.name.endswith('bank'):
            limit = bound_of(case)
            heading[case.name.replace('bank', 'Cramer-Rao bound')] = np.degrees(np.sqrt(
                [limit.at(t)[2, 2] for t in TABLE_TIMES]))
    table = {name: {f'{t:g} s': value for t, value in zip(TABLE_TIMES, values)}
             for name, values in heading.items()}
    peaks = peaks_of(errors, time)
    for title, numbers in (
            ('Heading error, rms in deg. Without "free start" and bank: free_start false, the '
             'note to the letter', table),
            (f'Mean error, deg: largest from {PEAK_FROM:g} to {PEAK_TO:g} s, at the end, '
             'and largest difference early from that of zero lever arm with the same noise',
             peaks)):
        report.table(title, [{'variant': name, **row} for name, row in numbers.items()], [
            field('variant', 'variant'),
            *(field(name, name, '.2g') for name in next(iter(numbers.values())))])
    none = errors['navigation: zero lever arm']
    chance = np.max(np.std(none, axis=0, ddof=1)[early(time)], axis=0) / np.sqrt(len(none))
    report.text(
        "The note's Fig. 1 shows early peaks without compensation, gone with it, and compensated "
        'like zero lever arm. What the noise alone leaves in these means (1 sigma): '
        + ', '.join(f'{angle} {value:.2g}' for angle, value in zip(ANGLES, chance)) + ' deg.')
    report.figure(mean_figure(errors, time), f'Mean errors of {runs} runs, method `vif` without '
                  'free start, as in Fig. 1 of the note')
    return {'runs': runs, 'rms_heading_deg': table, 'peak_deg': peaks,
            'remark_2_1': remarks_text(report)}


def early(time: Array) -> Array:
    """Whether it is the time in which the note has its lumps."""
    return (time >= PEAK_FROM) & (time <= PEAK_TO)


def peaks_of(errors: dict[str, Array], time: Array) -> dict[str, dict[str, float]]:
    """Return the largest mean errors early on, and how far they are from those of no lever arm."""
    means = {name: np.mean(errors[f'navigation: {name}'], axis=0) for name in SHOWN}
    apart = {name: mean - means['zero lever arm'] for name, mean in means.items()}
    return {name: {
        f'{angle}{when}': np.max(np.abs(values[rows, axis]))
        for when, values, rows in (('', mean, early(time)), (', end', mean, time == time[-1]),
                                   (', apart', apart[name], early(time)))
        for axis, angle in enumerate(ANGLES)} for name, mean in means.items()}


def mean_figure(errors: dict[str, Array], time: Array) -> Any:
    """Draw mean errors over time."""
    means = {name: np.mean(errors[f'navigation: {name}'], axis=0) for name in SHOWN}
    shown = np.max([np.nanmax(np.abs(mean[time >= SHOWN_FROM]), axis=0)
                    for mean in means.values()], axis=0)
    return line_figure(8.0, 8.0, [[{
        'title': '' if column else
        f'mean alignment error (scaled to what is seen after {SHOWN_FROM:g} s)',
        'ylabel': f'{angle} (deg)', 'ylim': 1.1 * shown[column] * np.array([-1.0, 1.0]),
        'xlim': (0.0, time[-1]), 'lines': [(time, mean[:, column], {
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
