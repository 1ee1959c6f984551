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
"""Experiment ``compare``: heading from course over ground, the note, its free start, the bank."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ins_align.aligner import Aligner
from ins_align.experiments.common import config_for, error_of, parallel, Report
from ins_align.geometry.rotation import Array
from ins_align.report import new_figure
from ins_align.simulation.simulate import epochs_of, simulate
import numpy as np

TIMES = np.arange(1.0, 101.0)
TABLE_TIMES = (5.0, 10.0, 20.0, 50.0, 100.0)
SLOWEST = 1.0           # m/s, below there is no course
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    'flight': ('flight', {}),
    'flight, navigation grade': ('flight', {'imu_grade': 'navigation'}),
    'crab in wind (12 deg)': ('flight', {'crab_deg': 12.0}),
    'car, lever arm 0.1 m': ('car', {'lever_arm': (0.1, 0.0, 0.0)}),
    'car, lever arm 5 m': ('car', {'lever_arm': (4.0, 0.0, 3.0)}),
    'reverse': ('reverse', {}),
    'launch': ('launch', {}),
    'hover': ('hover', {}),
    'straight': ('straight', {}),
}
METHODS: dict[str, dict[str, Any]] = {
    'note': {'method': 'vif', 'free_start': False},
    'centred': {'method': 'vif'},
    'bank': {'method': 'bank'},
}
NAMES = ('course', *METHODS)
COLOURS = {'course': '#009E73', 'note': '#0072B2', 'centred': '#E69F00', 'bank': '#CC79A7'}


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run all methods on the same data; recordings too where they are given."""
    runs = runs or 20
    report = Report('compare', 'The same data, four methods', out, f' --data DIR --runs {runs}')
    report.text(
        f'Error of the current heading: median of {runs} runs of each simulated case (MEMS unless '
        'said otherwise, lever arm [1 1 1] m unless said otherwise, GNSS 5 Hz, 0.1 m/s), and of '
        'the windows with real motion of each recording (experiment `recordings`). course: the '
        f'direction of the GNSS velocity, where it exceeds {SLOWEST:g} m/s, for the heading. '
        'note: vif with free_start false; centred: vif; bank: the default. All are told the '
        "vehicle's lever arm where it is known.")
    tasks = [(name, seed) for name in CASES for seed in range(runs)]
    results = parallel(run_one, tasks, jobs, 'runs')
    medians = {name: median_over(results[number * runs:(number + 1) * runs])
               for number, name in enumerate(CASES)}
    if data_dir is not None:
        medians |= recorded(data_dir, jobs)
    rows = []
    for name, methods in medians.items():
        for method, values in zip(NAMES, methods):
            rows.append([f'{name}: {method}', *(
                None if np.isnan(values[int(time) - 1]) else f'{values[int(time) - 1]:.2g}'
                for time in TABLE_TIMES)])
    report.table('Median heading error, deg', ['case: method', *(
        f'{time:g} s' for time in TABLE_TIMES)], rows)
    report.figure(figure(medians), '', 'Median heading error over time')
    report.write({'runs': runs, 'times_s': TIMES,
                  'median_heading_error_deg': {name: dict(zip(NAMES, methods))
                                               for name, methods in medians.items()}})


def run_one(task: tuple[str, int]) -> Array:
    """Return absolute heading errors, degrees, at all times, shape (4, T)."""
    name, seed = task
    scenario, arguments = CASES[name]
    simulation = simulate(scenario, seed=seed, duration=TIMES[-1] + 0.5, **arguments)
    errors = np.full((len(NAMES), len(TIMES)), np.nan)
    stamps = simulation.gnss_stamps_ns
    for line, told in enumerate(METHODS.values(), 1):
        for epoch in epochs_of(Aligner(config_for(simulation, **told)), simulation):
            k = int(epoch.t_s + 1e-6) - 1
            if 0 <= k < len(TIMES) and epoch.current is not None:
                C_true = simulation.attitude_at(epoch.stamp_ns)
                errors[line, k] = abs(error_of(epoch.current, C_true).angles_deg[2])
    for stamp, velocity in zip(stamps, simulation.velocity):
        k = int((stamp - stamps[0]) * 1e-9 + 1e-6) - 1
        if 0 <= k < len(TIMES) and np.hypot(*velocity[:2]) > SLOWEST:
            C_true = simulation.attitude_at(stamp)
            difference = np.degrees(np.arctan2(C_true[1, 0], C_true[0, 0])
                                    - np.arctan2(velocity[1], velocity[0]))
            errors[0, k] = abs((difference + 180) % 360 - 180)
    return errors


def median_over(errors: Any) -> Array:
    """Median over runs of what is there, shape (4, T)."""
    errors = np.asarray(errors)
    medians = np.full(errors.shape[1:], np.nan)
    there = np.isfinite(errors).any(axis=0)
    medians[there] = np.nanmedian(errors[:, there], axis=0)
    return medians


def recorded(data_dir: Path, jobs: int | None) -> dict[str, Array]:
    """Medians over the windows of the recordings."""
    from ins_align.experiments.recorded import recordings_in
    from ins_align.experiments.recordings import collect

    medians = {}
    for name, methods in collect(recordings_in(data_dir), jobs).items():
        moving = [window.moves for window in methods['bank']]
        errors = np.full((sum(moving), len(NAMES), len(TIMES)), np.nan)
        for line, method in enumerate(METHODS, 1):
            chosen = [window for window, moves in zip(methods[method], moving) if moves]
            for row, window in zip(errors, chosen):
                for values, column in ((line, window.error_deg[:, 2]), (0, window.course_deg)):
                    k = (window.time + 1e-6).astype(int) - 1
                    inside = (k >= 0) & (k < len(TIMES))
                    row[values, k[inside]] = np.abs(column[inside])
        if len(errors):
            medians[name] = median_over(errors)
    return medians


def figure(medians: dict[str, Array]) -> Any:
    """Draw a panel for every case."""
    columns = 3
    lines = -(-len(medians) // columns)
    picture = new_figure(12.0, 2.6 * lines + 0.5)
    axes = picture.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for ax, (name, methods) in zip(axes.flat, medians.items()):
        for method, values in zip(NAMES, methods):
            ax.semilogy(TIMES, values, color=COLOURS[method], label=method)
        ax.set_title(name)
        ax.grid(alpha=0.25)
        ax.set_ylim(0.003, 200.0)
    for ax in axes[:, 0]:
        ax.set_ylabel('heading error (deg)')
    for ax in axes[-1]:
        ax.set_xlabel('time since t0 (s)')
    for ax in axes.flat[len(medians):]:
        ax.set_visible(False)
    axes[0, 0].legend(fontsize=8, ncols=2)
    return picture
