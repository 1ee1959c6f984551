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
Experiment ``recordings``: real recordings, aligned from every tenth second on.

A recording is decoded once and stays in memory; each window of it is aligned by itself and
compared with the recording's reference.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Aligner
from ins_align.config import Config
from ins_align.experiments import ExperimentError
from ins_align.experiments.common import draw, Error, error_of, JsonDict, most, parallel, Report
from ins_align.geometry.earth import matrix_en, position_n
from ins_align.geometry.rotation import apply, Array
from ins_align.gnss.messages import Velocity
from ins_align.recordings import BagError
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import ImuSamples, Orientations, Refused
from ins_align.recordings.reader import choose_topics, read, Request
from ins_align.results import Epoch, Reference, State
from ins_align.simulation.simulate import give
import numpy as np

# What is known beside the recording, by the beginning of its name: the lever arm, and how well
# its reference is known (tilt, heading; degrees), where its stated sigma is too good to be true:
# the UAV's differs from the on-board filter by 0.6 and 1.4 deg rms, the quadrotor's has a compass.
KNOWN_LEVER_ARMS = {'car_drive0708': (0.0, 0.05, 0.0)}
REFERENCE_STD_DEG = {'uav_thor75': (0.6, 1.0), 'car_drive0708': (0.2, 0.5),
                     'quad_dot08': (1.0, 2.0)}
SUFFIXES = ('.bag', '.mcap', '.db3')
MOTION_SPEED, MOTION_TIME = 5.0, 60.0       # m/s of change within so many s is real motion
STEP, LENGTH = 10.0, 120.0      # s
SHORTEST = 10.0                 # s of data that a window has to have
TIMES = (30.0, 60.0, 120.0)
METHODS: dict[str, dict[str, Any]] = {
    'note': {'method': 'vif', 'free_start': False},
    'centred': {'method': 'vif'},
    'bank': {'method': 'bank'},
}


@dataclass(frozen=True)
class Recording:
    """Messages of a recording in recorded order, and its reference."""

    name: str
    imu: ImuSamples
    imu_before: np.ndarray          # (M,), IMU samples before each GNSS message
    messages: tuple[Any, ...]       # (M,), Fix or Velocity
    reference: Reference
    reference_std_deg: Array        # (3,) about east, north, up
    start_ns: int
    end_ns: int

    @property
    def duration(self) -> float:
        """Seconds."""
        return (self.end_ns - self.start_ns) * 1e-9

    def sent(self, first: int, last: int) -> Iterator[tuple[int, str, Any]]:
        """Yield when it comes (ns), what it is and itself, from one IMU sample to another."""
        imu, place = self.imu, first
        for end, message in [*zip(self.imu_before.tolist(), self.messages), (last, None)]:
            if not first < end <= last:
                continue
            now = int(imu.stamps_ns[end - 1])
            if end > place:
                yield now, 'imu', (imu.stamps_ns[place:end], imu.gyro[place:end],
                                   imu.accel[place:end])
            place = end
            if message is not None:
                yield now, 'velocity' if isinstance(message, Velocity) else 'fix', message


def recordings_in(folder: Path) -> list[Path]:
    """Return the recordings in a folder that carry a reference."""
    paths = []
    for path in sorted(folder.iterdir()):
        if path.suffix not in SUFFIXES and not (path / 'metadata.yaml').is_file():
            continue
        try:
            with Bag(path) as bag:
                if choose_topics(bag, Config()).reference is not None:
                    paths.append(path)
        except BagError as error:
            print(f'{path.name}: left out: {error}')
    return paths


@lru_cache(maxsize=3)
def load(path: Path) -> Recording:
    """Read and decode a recording; the last few are kept."""
    parts = list(read(Request(path)))
    if parts[0].topics.reference is None:
        raise BagError(f'{path} has no reference')
    imu = ImuSamples(*map(np.concatenate, zip(*(part.imu for part in parts))))
    orientations = Orientations(
        *map(np.concatenate, zip(*(part.orientations for part in parts))))
    gnss = []
    earlier = 0
    for part in parts:
        gnss += [(earlier + before, message) for before, message in part.gnss
                 if not isinstance(message, Refused)]
        earlier += part.imu.stamps_ns.size
    name = path.name.split('.')[0]
    return Recording(
        name, imu, np.array([before for before, _ in gnss]),
        tuple(message for _, message in gnss), Reference(orientations.known()),
        _reference_std(name, orientations), int(imu.stamps_ns[0]), int(imu.stamps_ns[-1]))


def _reference_std(name: str, orientations: Orientations) -> Array:
    """Sigma of the reference about east, north, up, degrees: stated, or what is known better."""
    stated = np.degrees(np.sqrt(np.median(np.abs(orientations.covariances[:, [0, 4, 8]]), axis=0)))
    tilt, heading = REFERENCE_STD_DEG.get(name, (0.0, 0.0))
    return np.maximum(stated, [tilt, tilt, heading])


class Window(NamedTuple):
    """What came of one window of a recording; K epochs with an attitude."""

    start_s: float
    time: Array             # (K,), s since t0
    aligned: Array          # (K,) bool
    error_deg: Array        # (K, 3), of the current attitude about east, north, up
    sigmas: Array           # (K, 2), tilt and heading in sigmas, that of the reference included
    declared_s: float | None
    declared: Error | None  # with the reference's sigma
    moves: bool             # real motion in its first minute
    covers_minute: bool
    course_deg: Array       # (K,), error of the course over ground as heading, nan when slow


def run_window(path: Path, start_s: float, duration: float, **told: Any) -> Window:
    """Align so many seconds of a recording, with parameters of `Config` beside its lever arm."""
    recording = load(path)
    if recording.name in KNOWN_LEVER_ARMS:
        told = {'lever_arm': KNOWN_LEVER_ARMS[recording.name], **told}
    aligner = Aligner(Config(**told))
    first, last = (int(np.searchsorted(recording.imu.stamps_ns,
                                       recording.start_ns + round(t * 1e9)))
                   for t in (start_s, start_s + duration))
    messages = []
    for _, kind, payload in recording.sent(first, last):
        give(aligner, kind, payload)
        if kind != 'imu':
            messages.append(payload)
    return _judged(recording, start_s, duration, aligner.flush(), messages)


def _judged(recording: Recording, start_s: float, duration: float, epochs: list[Epoch],
            messages: list[Any]) -> Window:
    rows, declared, declared_s = [], None, None
    stamps, velocities = _velocities(messages)
    for epoch in epochs:
        attitude = epoch.current
        C_true = None if attitude is None else recording.reference.attitude_at(attitude.stamp_ns)
        if attitude is None or C_true is None:
            continue
        error = error_of(attitude, C_true, recording.reference_std_deg)
        aligned = epoch.state is State.ALIGNED
        if aligned and declared is None:
            declared, declared_s = error, epoch.t_s
        rows.append([epoch.t_s, aligned, *error.angles_deg, error.tilt_sigmas,
                     error.heading_sigmas,
                     _course_error(epoch.stamp_ns, C_true, stamps, velocities)])
    table = np.array(rows).reshape(-1, 8)
    minute = velocities[stamps <= stamps[0] + round(MOTION_TIME * 1e9)] if len(stamps) else []
    return Window(start_s, table[:, 0], table[:, 1] > 0, table[:, 2:5], table[:, 5:7],
                  declared_s, declared, _change(minute) >= MOTION_SPEED,
                  recording.duration - start_s >= MOTION_TIME and duration >= MOTION_TIME,
                  table[:, 7])


def _velocities(messages: list[Any]) -> tuple[np.ndarray, Array]:
    """Horizontal velocities of a window, stamps and ENU; from positions where there are none."""
    measured = [m for m in messages if isinstance(m, Velocity) and np.isfinite(m.velocity).all()]
    if measured:
        return (np.array([m.stamp_ns for m in measured]),
                np.array([m.velocity[:2] for m in measured]))
    fixes = [m for m in messages if np.isfinite([m.latitude_deg, m.longitude_deg]).all()]
    if len(fixes) < 3:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    stamps = np.array([m.stamp_ns for m in fixes])
    place = np.radians([[m.latitude_deg, m.longitude_deg] for m in fixes])
    r_e = apply(matrix_en(*place.T), position_n(place[:, 0], [m.altitude_m for m in fixes]))
    moved = (r_e - r_e[0]) @ matrix_en(*place[0])
    # Over half a second, against the noise of a fix.
    step = max(1, int(round(0.25e9 / np.median(np.diff(stamps)))))
    seconds = (stamps[2 * step:] - stamps[:-2 * step]) * 1e-9
    return (stamps[step:len(stamps) - step],
            ((moved[2 * step:] - moved[:-2 * step]) / seconds[:, None])[:, :2])


def _change(velocities: Any) -> float:
    """Largest difference of two velocities, shape (N, 2), m/s, to 1 %."""
    if len(velocities) < 2:
        return 0.0
    angles = np.radians(np.arange(0.0, 180.0, 15.0))
    extents = np.ptp(np.asarray(velocities) @ [np.cos(angles), np.sin(angles)], axis=0)
    return float(np.max(extents))


def _course_error(stamp_ns: int, C_true: Array, stamps: np.ndarray, velocities: Array) -> float:
    """Error of taking the course over ground for the heading, degrees; nan below 1 m/s."""
    if not len(stamps):
        return float('nan')
    v = velocities[min(int(np.searchsorted(stamps, stamp_ns)), len(stamps) - 1)]
    if np.hypot(*v) < 1.0:
        return float('nan')
    error = np.arctan2(C_true[1, 0], C_true[0, 0]) - np.arctan2(v[1], v[0])
    return float(np.degrees((error + np.pi) % (2 * np.pi) - np.pi))


Windows = dict[str, dict[str, list[Window]]]      # by recording and method


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
    groups = [(path, method) for path in paths for method in METHODS]
    results = parallel(run_task, [
        [(*group, start) for start in np.arange(
            0.0, max(load(group[0]).duration - SHORTEST, 0.0) + 1e-6, STEP).tolist()]
        for group in groups], jobs, 'windows')
    windows: Windows = {load(path).name: {} for path in paths}
    for (path, method), each in zip(groups, results):
        windows[load(path).name][method] = each
    targets_text(report, windows)
    by_method = [(name, method, each) for name, methods in windows.items()
                 for method, each in methods.items()]
    report.table(
        'At the declaration: median / worst. in 60 s: windows with real motion (velocity changes '
        f'by {MOTION_SPEED:g} m/s within {MOTION_TIME:g} s) that declare within '
        f'{MOTION_TIME:g} s. Then all epochs while ALIGNED',
        [declared_row(f'{name}, {method}', each) for name, method, each in by_method])
    report.table(
        'Errors in deg after so many seconds: median / worst, declared or not; sigmas: '
        'of the heading; course: the course over ground, above 1 m/s, taken for the '
        'heading. Windows with real motion (all of a recording that has none)', [
            row for name, method, each in by_method
            for row in time_rows(name, method, each, windows[name]['bank'])])
    [whole] = parallel(run_whole, [paths], jobs, 'whole recordings')
    report.table('Whole recordings, bank: every epoch while ALIGNED', [
        {'recording': load(path).name, 'after, s': _median([window.declared_s or np.nan]),
         'of all, %': f'{100 * np.mean(window.aligned):.0f}',
         'at the end': bool(window.aligned[-1]), **_while_aligned([window])}
        for path, window in zip(paths, whole)])
    report.figure(figure(windows), '', 'Heading error of the bank in all windows against time; '
                                       'declared parts drawn dark')
    report.write({name: {method: [window_json(window) for window in each]
                         for method, each in methods.items()}
                  for name, methods in windows.items()})


def run_task(task: tuple[Path, str, float]) -> Window:
    """Run a window with a method, which is pif instead of vif where there is no velocity."""
    path, method, start = task
    told = dict(METHODS[method])
    if told['method'] == 'vif' and not any(isinstance(m, Velocity) for m in load(path).messages):
        told['method'] = 'pif'
    return run_window(path, start, LENGTH, **told)


def run_whole(path: Path) -> Window:
    """Run the default method on all of a recording."""
    return run_window(path, 0.0, load(path).duration)


def targets_text(report: Report, windows: Windows) -> None:
    """Say of the bank how much of the declared was right and how much was declared soon."""
    every = [(name, window) for name, methods in windows.items() for window in methods['bank']]
    declared = [(name, window, window.declared) for name, window in every
                if window.declared is not None]
    sigmas = np.array([error.worst_sigmas for *_, error in declared])
    soon, moving = _soon([window for _, window in every])
    report.text(
        f'bank over all recordings: of {len(declared)} declared, {np.sum(sigmas <= 3)} are within '
        f'3 sigma ({100 * np.mean(sigmas <= 3):.0f} %, target 99 %) and {np.sum(sigmas > 5)} '
        f'beyond 5 (target none); of {moving} windows with real motion, {soon} declare '
        f'within {MOTION_TIME:g} s ({100 * soon / max(moving, 1):.0f} %, target 90 %). '
        'Target of the median heading error at the declaration: 1 deg (UAV, car), 3 deg '
        '(quadrotor).' if declared else 'the bank declared nothing.')
    report.table('bank: declared beyond 3 sigma', [
        {'recording': name, 'start, s': f'{window.start_s:g}',
         'after, s': f'{window.declared_s:.1f}', 'heading, deg': f'{error.angles_deg[2]:.2f}',
         'heading, sigma': f'{error.heading_sigmas:.1f}', 'tilt, deg': f'{error.tilt_deg:.2f}',
         'tilt, sigma': f'{error.tilt_sigmas:.1f}'}
        for name, window, error in declared if error.worst_sigmas > 3])


def declared_row(name: str, windows: list[Window]) -> JsonDict:
    """Say what was declared, when, and how well."""
    errors = [window.declared for window in windows if window.declared is not None]
    times = [window.declared_s for window in windows if window.declared_s is not None]
    worst = np.array([error.worst_sigmas for error in errors])
    return {'recording, method': name, 'windows': len(windows), 'declared': len(errors),
            'after, s': _median(times), 'in 60 s': '/'.join(map(str, _soon(windows))),
            'heading, deg': _both([abs(error.angles_deg[2]) for error in errors]),
            'heading, sigma': _both([error.heading_sigmas for error in errors]),
            'tilt, deg': _both([error.tilt_deg for error in errors]),
            'tilt, sigma': _both([error.tilt_sigmas for error in errors]),
            '> 3': int(np.sum(worst > 3)), '> 5': int(np.sum(worst > 5)),
            **_while_aligned(windows)}


def time_rows(name: str, method: str, windows: list[Window],
              bank: list[Window]) -> list[JsonDict]:
    """Say errors after fixed times, of windows with real motion, and beside `bank` the course."""
    moving = any(window.moves for window in bank)
    chosen = [window for window, other in zip(windows, bank) if other.moves or not moving]
    row: JsonDict = {'recording, method': f'{name}, {method}', 'windows': len(chosen)}
    course: JsonDict = {'recording, method': f'{name}, course', 'windows': len(chosen)}
    for time in TIMES:
        there = [window for window in chosen if errors_at(window, time) is not None]
        errors = np.array([errors_at(window, time) for window in there]).reshape(-1, 5)
        off = np.array([np.abs(window.course_deg[_place(window, time)]) for window in there])
        columns = f'heading at {time:g} s', f'tilt at {time:g} s', f'sigmas at {time:g} s'
        row |= zip(columns, (_both(np.abs(errors[:, 2])), _both(np.hypot(*errors[:, :2].T)),
                             _both(errors[:, 4])))
        course |= zip(columns, (_both(off[np.isfinite(off)]), None, None))
    return [row, course] if method == 'bank' else [row]


def errors_at(window: Window, time: float) -> np.ndarray | None:
    """Return three errors and two sigmas at a time; None when the window ends before."""
    if not len(window.time) or window.time[-1] < time - 1.5:
        return None
    k = _place(window, time)
    return np.concatenate([window.error_deg[k], window.sigmas[k]])


def _place(window: Window, time: float) -> int:
    return max(int(np.searchsorted(window.time, time + 1e-6)) - 1, 0)


def _soon(windows: list[Window]) -> tuple[int, int]:
    """Count the windows with real motion that declare within a minute, and all of them."""
    moving = [window for window in windows if window.moves and window.covers_minute]
    return sum(window.declared_s is not None and window.declared_s <= MOTION_TIME
               for window in moving), len(moving)


def _while_aligned(windows: list[Window]) -> JsonDict:
    held = np.concatenate([window.sigmas[window.aligned].max(axis=1, initial=0.0)
                           for window in windows])
    return {'epochs': len(held), **{
        f'> {limit} sigma, %': f'{100 * np.mean(held > limit):.1f}' if len(held) else None
        for limit in (3, 5)}, 'worst, sigma': most(held, '.1f')}


def _median(values: Any) -> str | None:
    return f'{np.median(values):.0f}' if len(values) else None


def _both(values: Any) -> str | None:
    return f'{np.median(values):.2g} / {np.max(values):.2g}' if len(values) else None


def figure(windows: Windows) -> Any:
    """Draw heading errors of the bank over time, window by window."""
    panels = []
    for name, methods in windows.items():
        lines = []
        for window in methods['bank']:
            # Two a second are enough to see, ten make a large file.
            step = max(1, len(window.time) // max(1, int(2 * np.ptp(window.time)))
                       if len(window.time) else 1)
            time, aligned = window.time[::step], window.aligned[::step]
            error = np.abs(window.error_deg[::step, 2])
            lines += [(time, error, {'color': '#bbbbbb', 'linewidth': 0.5}),
                      (time, np.where(aligned, error, np.nan),
                       {'color': '#CC79A7', 'linewidth': 0.7})]
        panels.append([{
            'title': f'{name}: bank, every window (declared: dark)', 'lines': lines,
            'ylabel': 'heading error (deg)', 'yscale': 'log', 'ylim': (0.02, 200.0)}])
    return draw(12.0, 3.4 * len(windows) + 0.4, panels)


def window_json(window: Window) -> JsonDict:
    """Return the numbers of a window that the tables are made of."""
    return {
        'start_s': window.start_s, 'moves': window.moves, 'declared_s': window.declared_s,
        'declared': None if window.declared is None else window.declared.to_json(),
        'worst_declared_sigmas': window.sigmas[window.aligned].max(axis=0)
        if window.aligned.any() else None,
        'at': {f'{time:g}': errors_at(window, time) for time in TIMES}}
