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
"""Experiment ``recordings``: real recordings, aligned from every tenth second on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ins_align.experiments import ExperimentError
from ins_align.experiments.common import parallel, Report
from ins_align.experiments.recorded import (
    load, MOTION_SPEED, MOTION_TIME, recordings_in, run_window, Window)
from ins_align.report import new_figure
import numpy as np

STEP, LENGTH = 10.0, 120.0      # s
SHORTEST = 10.0                 # s of data that a window has to have
TIMES = (30.0, 60.0, 120.0)
METHODS: dict[str, dict[str, Any]] = {
    'note': {'method': 'vif', 'free_start': False},
    'centred': {'method': 'vif'},
    'bank': {'method': 'bank'},
}
COLOURS = {'note': '#0072B2', 'centred': '#E69F00', 'bank': '#CC79A7'}


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run every window of every recording with every method."""
    assert data_dir is not None
    paths = recordings_in(data_dir)
    if not paths:
        raise ExperimentError(f'no recording with /reference/imu in {data_dir}')
    report = Report('recordings', 'Real recordings', out, ' --data DIR')
    report.text(
        f'An alignment starts every {STEP:g} s and runs for up to {LENGTH:g} s; everything but '
        'the method is the default (preset mems), only the car has its lever arm. note: vif with '
        'free_start false; centred: vif. A recording without velocities has no vif: there the '
        'two use pif. Errors are those of the current attitude against the reference, in sigmas '
        'with that of the reference in quadrature.')
    windows = collect(paths, jobs)
    targets_text(report, windows)
    declared_table(report, windows)
    time_table(report, windows)
    whole_table(report, paths, jobs)
    report.figure(figure(windows), '', 'Heading error of all windows against time; declared '
                                       'parts of the bank drawn dark')
    numbers = {name: {method: [window_json(window) for window in each]
                      for method, each in methods.items()} for name, methods in windows.items()}
    report.write(numbers)


def collect(paths: list[Path], jobs: int | None) -> dict[str, dict[str, list[Window]]]:
    """Return the windows by recording and method."""
    tasks = []
    for path in paths:
        starts = np.arange(0.0, max(load(path).duration - SHORTEST, 0.0) + 1e-6, STEP)
        tasks += [(path, method, float(start)) for method in METHODS for start in starts]
    results = parallel(run_task, tasks, jobs, 'windows')
    windows: dict[str, dict[str, list[Window]]] = {}
    for (path, method, _), window in zip(tasks, results):
        methods = windows.setdefault(load(path).name, {name: [] for name in METHODS})
        methods[method].append(window)
    return windows


def run_task(task: tuple[Path, str, float]) -> Window:
    """Run a window with a method, which is pif instead of vif where there is no velocity."""
    path, method, start = task
    told = dict(METHODS[method])
    if told['method'] == 'vif' and not any(hasattr(m, 'velocity') for m in load(path).messages):
        told['method'] = 'pif'
    return run_window(path, start, LENGTH, **told)


def run_whole(path: Path) -> Window:
    """Run the default method on all of a recording."""
    return run_window(path, 0.0, load(path).duration)


def whole_table(report: Report, paths: list[Path], jobs: int | None) -> None:
    """Print how right every epoch is that is called aligned, from end to end."""
    rows = []
    for path, window in zip(paths, parallel(run_whole, paths, jobs, 'whole recordings')):
        held = window.sigmas[window.aligned].max(axis=1, initial=0.0)
        rows.append([load(path).name, _median([window.declared_s or np.nan], '.0f'), len(held),
                     f'{100 * np.mean(window.aligned):.0f}', bool(window.aligned[-1]),
                     *(f'{100 * np.mean(held > limit):.1f}' if len(held) else None
                       for limit in (3, 5)), f'{held.max(initial=0.0):.1f}'])
    report.table('Whole recordings, bank: every epoch while ALIGNED', [
        'recording', 'after, s', 'epochs', 'of all, %', 'at the end', '> 3 sigma, %',
        '> 5 sigma, %', 'worst, sigma'], rows)


def targets_text(report: Report, windows: dict[str, dict[str, list[Window]]]) -> None:
    """Say of the bank how much of the declared was right and how much was declared soon."""
    every = [(name, window) for name, methods in windows.items() for window in methods['bank']]
    declared = [(name, window, window.declared) for name, window in every
                if window.declared is not None]
    sigmas = np.array([max(error.tilt_sigmas, error.heading_sigmas) for *_, error in declared])
    moving = [window for _, window in every if window.moves and window.covers_minute]
    soon = sum(window.declared_s is not None and window.declared_s <= MOTION_TIME
               for window in moving)
    report.text(
        f'bank over all recordings: of {len(declared)} declared, {np.sum(sigmas <= 3)} are within '
        f'3 sigma ({100 * np.mean(sigmas <= 3):.0f} %, target 99 %) and {np.sum(sigmas > 5)} '
        f'beyond 5 (target none); of {len(moving)} windows with real motion, {soon} declare '
        f'within {MOTION_TIME:g} s ({100 * soon / max(len(moving), 1):.0f} %, target 90 %). '
        'Target of the median heading error at the declaration: 1 deg (UAV, car), 3 deg '
        '(quadrotor).' if declared else 'the bank declared nothing.')
    report.table('bank: declared beyond 3 sigma', [
        'recording', 'start, s', 'after, s', 'heading, deg', 'sigmas', 'tilt, deg', 'sigmas'], [
        [name, f'{window.start_s:g}', f'{window.declared_s:.1f}', f'{error.angles_deg[2]:.2f}',
         f'{error.heading_sigmas:.1f}', f'{np.hypot(*error.angles_deg[:2]):.2f}',
         f'{error.tilt_sigmas:.1f}']
        for (name, window, error), worst in zip(declared, sigmas) if worst > 3])


def declared_table(report: Report, windows: dict[str, dict[str, list[Window]]]) -> None:
    """Print what was declared, when, and how well."""
    rows, ever = [], []
    for name, methods in windows.items():
        for method, each in methods.items():
            errors = [window.declared for window in each if window.declared is not None]
            times = [window.declared_s for window in each if window.declared_s is not None]
            moving = [window for window in each if window.moves and window.covers_minute]
            soon = [window for window in moving
                    if window.declared_s is not None and window.declared_s <= MOTION_TIME]
            tilt = np.array([np.hypot(*error.angles_deg[:2]) for error in errors])
            heading = np.array([abs(error.angles_deg[2]) for error in errors])
            sigmas = np.array([[error.tilt_sigmas, error.heading_sigmas] for error in errors]
                              ).reshape(-1, 2)
            rows.append([
                f'{name}, {method}', len(each), len(errors), _median(times, '.0f'),
                f'{len(soon)}/{len(moving)}', _both(heading), _both(sigmas[:, 1]), _both(tilt),
                _both(sigmas[:, 0]), int(np.sum(sigmas.max(axis=1) > 3)),
                int(np.sum(sigmas.max(axis=1) > 5))])
            held = np.concatenate([window.sigmas[window.aligned] for window in each])
            ever.append([f'{name}, {method}', len(held),
                         *(f'{100 * np.mean(held.max(axis=1) > limit):.1f}' if len(held) else None
                           for limit in (3, 5)),
                         f'{held.max():.1f}' if len(held) else None])
    report.table(
        'At the declaration: median / worst. in 60 s: windows with real motion (velocity changes '
        f'by {MOTION_SPEED:g} m/s within {MOTION_TIME:g} s) that declare within '
        f'{MOTION_TIME:g} s', [
            'recording, method', 'windows', 'declared', 'after, s', 'in 60 s', 'heading, deg',
            'sigmas', 'tilt, deg', 'sigmas', '> 3', '> 5'], rows)
    report.table('All epochs while declared', [
        'recording, method', 'epochs', '> 3 sigma, %', '> 5 sigma, %', 'worst, sigma'], ever)


def time_table(report: Report, windows: dict[str, dict[str, list[Window]]]) -> None:
    """Print errors after fixed times, of windows with real motion."""
    rows = []
    for name, methods in windows.items():
        moving = [window.moves for window in methods['bank']]
        if not any(moving):
            moving = [True] * len(moving)
        for method, each in methods.items():
            row: list[Any] = [f'{name}, {method}', sum(moving)]
            for time in TIMES:
                at = [errors_at(window, time) for window, moves in zip(each, moving) if moves]
                errors = np.array([error for error in at if error is not None]).reshape(-1, 5)
                row += [_both(np.abs(errors[:, 2])), _both(np.hypot(errors[:, 0], errors[:, 1])),
                        _both(errors[:, 4])]
            rows.append(row)
    header = ['recording, method', 'windows']
    for time in TIMES:
        header += [f'heading at {time:g} s', 'tilt', 'sigmas']
    report.table('Errors in deg after so many seconds: median / worst, declared or not; sigmas: '
                 'of the heading. Windows with real motion (all of a recording that has none)',
                 header, rows)


def errors_at(window: Window, time: float) -> np.ndarray | None:
    """Return three errors and two sigmas at a time; None when the window ends before."""
    if not len(window.time) or window.time[-1] < time - 1.5:
        return None
    k = max(int(np.searchsorted(window.time, time + 1e-6)) - 1, 0)
    return np.concatenate([window.error_deg[k], window.sigmas[k]])


def _median(values: Any, form: str) -> str | None:
    return format(float(np.median(values)), form) if len(values) else None


def _both(values: Any) -> str | None:
    if not len(values):
        return None
    return f'{np.median(values):.2g} / {np.max(values):.2g}'


def figure(windows: dict[str, dict[str, list[Window]]]) -> Any:
    """Draw heading errors over time: the bank's window by window, and the medians of all."""
    picture = new_figure(12.0, 3.4 * len(windows) + 0.4)
    axes = picture.subplots(len(windows), 2, squeeze=False, sharey='row')
    grid = np.arange(1.0, LENGTH + 1.0)
    for (name, methods), (left, right) in zip(windows.items(), axes):
        for window in methods['bank']:
            # Two a second are enough to see, ten make a large file.
            step = max(1, round(0.5 * len(window.time) / max(np.ptp(window.time), 1.0))
                       if len(window.time) else 1)
            time, aligned = window.time[::step], window.aligned[::step]
            error = np.abs(window.error_deg[::step, 2])
            left.semilogy(time, error, color='#bbbbbb', linewidth=0.5)
            left.semilogy(time, np.where(aligned, error, np.nan), color=COLOURS['bank'],
                          linewidth=0.7)
        moving = [window.moves for window in methods['bank']]
        if not any(moving):
            moving = [True] * len(moving)
        for method, each in methods.items():
            chosen = [window for window, moves in zip(each, moving) if moves]
            right.semilogy(grid, _median_over(chosen, grid, 'error_deg'), color=COLOURS[method],
                           label=f'{method}: median error')
        chosen = [window for window, moves in zip(methods['bank'], moving) if moves]
        right.semilogy(grid, _median_over(chosen, grid, 'sigma_deg'), 'k--',
                       label='bank: median stated sigma')
        left.set_title(f'{name}: bank, every window (declared: dark)')
        right.set_title(f'{name}: medians, windows with real motion' if any(
            window.moves for window in methods['bank']) else f'{name}: medians, all windows')
        left.set_ylabel('heading error (deg)')
        left.set_ylim(0.02, 200.0)
        longest = max((window.time[-1] for window in methods['bank'] if len(window.time)),
                      default=LENGTH)
        for ax in (left, right):
            ax.set_xlim(0.0, longest)
            ax.grid(which='both', alpha=0.2)
            ax.set_xlabel('time since t0 (s)')
        right.legend(fontsize=8)
    return picture


def _median_over(windows: list[Window], grid: np.ndarray, name: str) -> np.ndarray:
    """Median of |heading| of windows that reach so far, over a grid of times."""
    values = np.full((len(windows), len(grid)), np.nan)
    for row, window in zip(values, windows):
        if len(window.time):
            column = np.abs(getattr(window, name)[:, 2])
            row[:] = np.interp(grid, window.time, column, left=np.nan, right=np.nan)
    reached = np.isfinite(values).any(axis=0)
    medians = np.full(len(grid), np.nan)
    medians[reached] = np.nanmedian(values[:, reached], axis=0)
    return medians


def window_json(window: Window) -> dict[str, Any]:
    """Return the numbers of a window that the tables are made of."""
    return {
        'start_s': window.start_s, 'moves': window.moves, 'declared_s': window.declared_s,
        'declared': None if window.declared is None else window.declared.to_json(),
        'worst_declared_sigmas': window.sigmas[window.aligned].max(axis=0)
        if window.aligned.any() else None,
        'at': {f'{time:g}': errors_at(window, time) for time in TIMES}}
