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
Experiment ``note``: the note's simulation with and without its lever-arm term, and its remarks.

The note says of its set-up: lever arm [1 1 1] m, 100 runs, the simulation of its predecessor,
which it does not describe. Here: scenario `flight`, navigation grade, velocity 0.1 m/s at 5 Hz.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from ins_align.aligner import Aligner
from ins_align.experiments import dense
from ins_align.experiments.common import (
    Column, draw, exact_config_for, JsonDict, parallel, Report, rms)
from ins_align.geometry.earth import EARTH_RATE, earth_rate_n, LocalLevel
from ins_align.geometry.rotation import apply, Array, cross, roll_pitch_yaw, skew
from ins_align.simulation.simulate import epochs_of, simulate
import numpy as np

DURATION = 100.0
TABLE_TIMES = (10.0, 20.0, 50.0, 100.0)
PEAK_FROM, PEAK_TO = 2.0, 20.0      # s, where the note's Fig. 1 has its lumps
SHOWN_FROM = 3.0                    # s, larger errors before may lie outside of the figure
REMARK_DURATION = 1000.0
ANGLES = ('roll', 'pitch', 'heading')
LEVER, NO_LEVER = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
# Name, lever arm of the vehicle, what the aligner is told beside the grade.
VARIANTS: dict[str, tuple[tuple[float, ...], dict[str, Any]]] = {
    'not compensated': (LEVER, {'method': 'vif', 'free_start': False, 'lever_arm': NO_LEVER}),
    'compensated': (LEVER, {'method': 'vif', 'free_start': False}),
    'zero lever arm': (NO_LEVER, {'method': 'vif', 'free_start': False}),
    'not compensated, free start': (LEVER, {'method': 'vif', 'lever_arm': NO_LEVER}),
    'compensated, free start': (LEVER, {'method': 'vif'}),
    'bank': (LEVER, {'method': 'bank'}),
}
SHOWN = 'not compensated', 'compensated', 'zero lever arm'
ADDED = ('compensated', 'compensated, free start', 'bank')
COLOURS = {'not compensated': '#D55E00', 'compensated': '#0072B2', 'zero lever arm': '#009E73',
           'compensated, free start': '#E69F00', 'bank': '#CC79A7'}

Errors = dict[str, dict[str, Array]]    # by grade and variant: (runs, K, 3), degrees


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run all variants, navigation grade; the note, its free start and bank with MEMS too."""
    runs = runs or 100
    pairs = [*itertools.product(['navigation'], VARIANTS), *itertools.product(['mems'], ADDED)]
    errors: Errors = {'navigation': {}, 'mems': {}}
    for (grade, name), each in zip(pairs, parallel(run_one, [
            [(*pair, seed) for seed in range(runs)] for pair in pairs], jobs, 'runs')):
        errors[grade][name] = np.array(each)
    time = np.arange(errors['navigation']['bank'].shape[1]) / 5.0
    bounds = {grade: bound_of(grade) for grade in errors}
    report = Report('note', "The note's experiment", out, f' --runs {runs}')
    report.text(
        'Scenario `flight` (100 m/s, S-turns with 40 s period, oscillation of 2 to 3 deg about '
        f'all axes), IMU 100 Hz, GNSS velocity 5 Hz, 0.1 m/s; lever arm {list(LEVER)} m; {runs} '
        'runs. The note does not give its own set-up. Errors of the attitude at t0.')
    numbers: JsonDict = {'rms_heading_deg': rms_table(report, errors, bounds, time),
                         'peak_deg': peak_table(report, errors['navigation'], time)}
    report.figure(note_figure(errors['navigation'], time), '', f'Mean errors of {runs} runs, '
                  'method `vif` without free start, as in Fig. 1 of the note')
    report.figure(added_figure(errors, bounds, time), '_added', 'Root mean square errors: the '
                  'note, its free start, bank, and the Cramer-Rao bound')
    numbers['remark_2_1'] = remarks_text(report)
    report.write({'runs': runs, **numbers})


def run_one(task: tuple[str, str, int]) -> Array:
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


def bound_of(grade: str) -> Array:
    """Bound of tilt per axis (root mean square of both) and heading at every epoch, degrees."""
    P = dense.bound(simulate('flight', imu_grade=grade, duration=DURATION)).covariance
    return np.degrees(np.sqrt(np.stack([(P[:, 0, 0] + P[:, 1, 1]) / 2, P[:, 2, 2]], axis=-1)))


def rms_table(report: Report, errors: Errors, bounds: dict[str, Array],
              time: Array) -> dict[str, Array]:
    """Print the heading's rms over time."""
    places = [int(np.argmin(np.abs(time - t))) for t in TABLE_TIMES]
    numbers = {}
    for grade, variants in errors.items():
        numbers |= {f'{grade}: {name}': rms(error[:, places, 2], axis=0)
                    for name, error in variants.items()}
        numbers[f'{grade}: Cramer-Rao bound'] = bounds[grade][places, 1]
    report.table('Heading error, rms in deg. Without "free start" and bank: free_start false, '
                 'the note to the letter', numbers.items(),
                 _columns([f'{t:g} s' for t in TABLE_TIMES]))
    return numbers


def _columns(titles: list[str]) -> list[Column]:
    """Return columns of a variant and its numbers."""
    return [('variant', '', lambda each: each[0]), *(
        (title, '.2g', lambda each, k=k: each[1][k]) for k, title in enumerate(titles))]


def peak_table(report: Report, errors: dict[str, Array], time: Array) -> dict[str, list[float]]:
    """Print the largest mean errors early on, and how far they are from those of no lever arm."""
    early = (time >= PEAK_FROM) & (time <= PEAK_TO)
    none = errors['zero lever arm']
    numbers = {}
    for name in SHOWN:
        mean, apart = np.mean(errors[name], axis=0), np.mean(errors[name] - none, axis=0)
        numbers[name] = [*np.max(np.abs(mean[early]), axis=0), *np.abs(mean[-1]),
                         *np.max(np.abs(apart[early]), axis=0)]
    report.table(
        f'Mean error, deg: largest from {PEAK_FROM:g} to {PEAK_TO:g} s, at {DURATION:g} s, and '
        'largest difference early from that of zero lever arm with the same noise',
        numbers.items(),
        _columns([f'{angle}{when}' for when in ('', ', end', ', apart') for angle in ANGLES]))
    chance = np.max(np.std(none, axis=0, ddof=1)[early], axis=0) / np.sqrt(len(none))
    report.text(
        "The note's Fig. 1 shows early peaks without compensation, gone with it, and compensated "
        'like zero lever arm. What the noise alone leaves in these means (1 sigma): '
        + ', '.join(f'{angle} {value:.2g}' for angle, value in zip(ANGLES, chance)) + ' deg.')
    return numbers


def note_figure(errors: dict[str, Array], time: Array) -> Any:
    """Draw mean errors over time."""
    means = {name: np.mean(errors[name], axis=0) for name in SHOWN}
    panels = []
    for column, angle in enumerate(ANGLES):
        limit = 1.1 * max(np.nanmax(np.abs(mean[time >= SHOWN_FROM, column]))
                          for mean in means.values())
        panels.append([{
            'ylabel': f'{angle} (deg)', 'ylim': (-limit, limit), 'xlim': (0.0, DURATION),
            'lines': [(time, mean[:, column], {
                'color': COLOURS[name], 'label': name,
                'linestyle': '--' if name == 'zero lever arm' else '-'})
                for name, mean in means.items()]}])
    panels[0][0]['title'] = f'mean alignment error (scaled to what is seen after {SHOWN_FROM:g} s)'
    return draw(8.0, 8.0, panels, sharex=True)


def added_figure(errors: Errors, bounds: dict[str, Array], time: Array) -> Any:
    """Draw rms errors and bounds over time."""
    shown = time >= 1.0
    return draw(11.0, 7.5, [[{
        'title': f'{grade} IMU: {angle}', 'ylabel': 'rms error (deg)', 'yscale': 'log',
        'lines': [
            *((time[shown], rms(variants[name][:, shown, chosen], axis=(0, 2)), {
                'color': COLOURS[name], 'label': 'the note' if name == 'compensated' else name})
              for name in ADDED),
            (time[shown], bounds[grade][shown, line],
             {'color': 'k', 'linestyle': '--', 'label': 'Cramer-Rao bound'})]}
        for grade, variants in errors.items()]
        for line, (angle, chosen) in enumerate((('tilt, per axis', slice(0, 2)),
                                                ('heading', slice(2, 3))))],
        sharex=True, sharey='row')


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
