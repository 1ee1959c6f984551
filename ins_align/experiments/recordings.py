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

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
import itertools
import math
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Aligner, State
from ins_align.config import Config
from ins_align.experiments import ExperimentError
from ins_align.experiments.common import (
    BINS, Column, draw, Error, error_of, follow, JsonDict, median, most, parallel, Report)
from ins_align.experiments.spoilt import Message, SECOND
from ins_align.geometry.earth import matrix_en, position_n
from ins_align.geometry.rotation import apply, Array
from ins_align.gnss.messages import Velocity
from ins_align.recordings import BagError
from ins_align.recordings.decode import ImuSamples, Orientations, Refused
from ins_align.recordings.reader import read, REFERENCE_TOPIC, Request
from ins_align.results import Reference
import numpy as np

# What is known beside the recording, by the beginning of its name: the lever arm, and how well
# its reference is known (tilt, heading; degrees), where its stated sigma is too good to be true:
# the UAV's differs from the on-board filter by 0.6 and 1.4 deg rms, the quadrotor's has a compass.
KNOWN_LEVER_ARMS = {'car_drive0708': (0.0, 0.05, 0.0)}
REFERENCE_STD_DEG = {'uav_thor75': (0.6, 1.0), 'car_drive0708': (0.2, 0.5),
                     'quad_dot08': (1.0, 2.0)}
MOTION_SPEED, MOTION_TIME = 5.0, 60.0       # m/s of change within so many s is real motion
STEP, LENGTH = 10.0, 120.0      # s
SHORTEST = 10.0                 # s of data that a window has to have
TIMES = (30.0, 60.0, 120.0)
METHODS: dict[str, JsonDict] = {
    'note': {'method': 'vif', 'free_start': False}, 'centred': {'method': 'vif'},
    'bank': {'method': 'bank'}}


@dataclass(frozen=True)
class Recording:
    """Messages of a recording in recorded order, and its reference."""

    name: str
    imu: ImuSamples
    imu_before: np.ndarray          # (M,), IMU samples before each GNSS message
    messages: tuple[Any, ...]       # (M,), Fix or Velocity
    reference: Reference
    reference_std_deg: Array        # (3,) about east, north, up

    @property
    def duration(self) -> float:
        """Seconds."""
        return float(self.imu.stamps_ns[-1] - self.imu.stamps_ns[0]) * 1e-9

    def sample_at(self, seconds: float) -> int:
        """Return the number of the first IMU sample from a time since the start on."""
        return int(np.searchsorted(self.imu.stamps_ns,
                                   self.imu.stamps_ns[0] + round(seconds * SECOND)))

    def attitudes_at(self, stamps_ns: list[int]) -> list[Array | None]:
        """Return the reference's ``C_nb`` at stamps, None where there is none."""
        return [self.reference.attitude_at(stamp) for stamp in stamps_ns]

    def sent(self, first: int, last: int) -> Iterator[Message]:
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
        try:
            load(path)
            paths.append(path)
        except BagError as error:
            print(f'{path.name}: left out: {error}')
    return paths


@lru_cache(maxsize=3)
def load(path: Path) -> Recording:
    """Read and decode a recording; the last few are kept."""
    parts = list(read(Request(path)))
    if parts[0].topics.reference is None:
        raise BagError(f'it has no reference attitude on {REFERENCE_TOPIC}')
    imu = ImuSamples(*map(np.concatenate, zip(*(part.imu for part in parts))))
    orientations = Orientations(
        *map(np.concatenate, zip(*(part.orientations for part in parts))))
    earlier = itertools.accumulate((part.imu.stamps_ns.size for part in parts), initial=0)
    gnss = [(start + before, message) for start, part in zip(earlier, parts)
            for before, message in part.gnss if not isinstance(message, Refused)]
    name = path.name.split('.')[0]
    stated = np.degrees(np.sqrt(np.median(np.abs(orientations.covariances[:, [0, 4, 8]]), axis=0)))
    tilt, heading = REFERENCE_STD_DEG.get(name, (0.0, 0.0))
    return Recording(
        name, imu, np.array([before for before, _ in gnss]),
        tuple(message for _, message in gnss), Reference(orientations.known()),
        np.maximum(stated, [tilt, tilt, heading]))


class Window(NamedTuple):
    """What came of one window of a recording; K epochs with an attitude."""

    start_s: float
    time: Array             # (K,), s since t0
    aligned: Array          # (K,) bool
    error_deg: Array        # (K, 3), of the current attitude about east, north, up
    sigmas: Array           # (K, 2), tilt and heading in sigmas, that of the reference included
    course_deg: Array       # (K,), error of the course over ground as heading, nan when slow
    declared_s: float | None
    declared: Error | None  # with the reference's sigma
    moves: bool             # real motion in its first minute
    covers_minute: bool


def run_window(task: tuple[Path, float, float, JsonDict]) -> Window:
    """Align a window of a recording: from when on and how long, s; parameters of `Config`."""
    path, start_s, duration, config = task
    recording = load(path)
    if recording.name in KNOWN_LEVER_ARMS:
        config = {'lever_arm': KNOWN_LEVER_ARMS[recording.name], **config}
    sent = list(recording.sent(*map(recording.sample_at, (start_s, start_s + duration))))
    stamps, velocities = _velocities([message for _, kind, message in sent if kind != 'imu'])
    rows, declared, declared_s = [], None, None
    for look in follow(Aligner(Config(**config)), sent, 0.0):
        if look.t_s is None or look.current is None:
            continue
        C_true = recording.reference.attitude_at(look.current.stamp_ns)
        if C_true is None:
            continue
        error = error_of(look.current, C_true, recording.reference_std_deg)
        if look.state is State.ALIGNED and declared is None:
            declared, declared_s = error, look.t_s
        rows.append([look.t_s, look.state is State.ALIGNED, *error.angles_deg, error.tilt_sigmas,
                     error.heading_sigmas,
                     _course_error(look.stamp_ns, C_true, stamps, velocities)])
    table = np.array(rows).reshape(-1, 8)
    minute = velocities[stamps <= stamps[0] + round(MOTION_TIME * 1e9)] if len(stamps) else []
    return Window(start_s, table[:, 0], table[:, 1] > 0, table[:, 2:5], table[:, 5:7],
                  table[:, 7], declared_s, declared, _change(minute) >= MOTION_SPEED,
                  min(recording.duration - start_s, duration) >= MOTION_TIME)


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
    angles = np.radians(np.arange(0.0, 180.0, 15.0))
    extents = np.asarray(velocities).reshape(-1, 2) @ [np.cos(angles), np.sin(angles)]
    return float(np.max(np.ptp(extents, axis=0))) if len(extents) else 0.0


def _course_error(stamp_ns: int, C_true: Array, stamps: np.ndarray, velocities: Array) -> float:
    """Error of taking the course over ground for the heading, degrees; nan below 1 m/s."""
    v = velocities[min(int(np.searchsorted(stamps, stamp_ns)), len(stamps) - 1)] \
        if len(stamps) else np.zeros(2)
    if np.hypot(*v) < 1.0:
        return math.nan
    error = np.arctan2(C_true[1, 0], C_true[0, 0]) - np.arctan2(v[1], v[0])
    return float(np.degrees((error + np.pi) % (2 * np.pi) - np.pi))


Windows = dict[str, dict[str, list[Window]]]      # by recording and method


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run every window of every recording with every method."""
    assert data_dir is not None
    paths = recordings_in(data_dir)
    if not paths:
        raise ExperimentError(f'no recording with {REFERENCE_TOPIC} in {data_dir}')
    report = Report('recordings', 'Real recordings', out, ' --data DIR')
    report.text(
        f'An alignment starts every {STEP:g} s and runs for up to {LENGTH:g} s with the defaults '
        '(preset mems), the car with its lever arm. note: vif with free_start false; centred: '
        'vif; both are pif where there are no velocities. Errors of the current attitude against '
        'the reference, in sigmas with that of the reference in quadrature.')
    groups = [(path, method) for path in paths for method in METHODS]
    results = parallel(run_window, [
        [(path, start, LENGTH, _config_of(path, method)) for start in np.arange(
            0.0, max(load(path).duration - SHORTEST, 0.0) + 1e-6, STEP).tolist()]
        for path, method in groups], jobs, 'windows')
    windows: Windows = {load(path).name: {} for path in paths}
    for (path, method), each in zip(groups, results):
        windows[load(path).name][method] = each
    targets_text(report, windows)
    report.table(
        f'At the declaration: median / worst. in {MOTION_TIME:g} s: windows with real motion '
        f'(by {MOTION_SPEED:g} m/s in that time) that declare. Then all epochs while ALIGNED', [
            (f'{name}, {method}', each) for name, methods in windows.items()
            for method, each in methods.items()], DECLARED_COLUMNS)
    report.table(
        'Errors in deg: median / worst, declared or not; sigmas: of the heading; course: that '
        'over ground, above 1 m/s, taken for it. Windows with real motion; all if none has', [
            (f'{name}, {shown}', _moving(methods, shown), shown == 'course')
            for name, methods in windows.items() for shown in (*methods, 'course')], [
                ('recording, method', '', lambda r: r[0]), ('windows', '', lambda r: len(r[1])),
                *itertools.chain(*map(columns_at, TIMES))])
    [whole] = parallel(run_window, [[(path, 0.0, load(path).duration, {}) for path in paths]],
                       jobs, 'whole recordings')
    report.table('Whole recordings, bank: every epoch while ALIGNED', [
        (load(path).name, [window]) for path, window in zip(paths, whole)], [
            ('recording', '', lambda r: r[0]),
            ('after, s', '.0f', lambda r: r[1][0].declared_s),
            ('of all, %', '.0f', lambda r: 100 * np.mean(r[1][0].aligned)),
            ('at the end', '', lambda r: bool(r[1][0].aligned[-1])), *HELD_COLUMNS])
    report.figure(figure(windows), '', 'Heading error of the bank in all windows against time; '
                                       'declared parts drawn dark')
    report.write({name: {method: [window_json(window) for window in each]
                         for method, each in methods.items()}
                  for name, methods in windows.items()})


def _config_of(path: Path, method: str) -> JsonDict:
    """Return a method's parameters: pif instead of vif where there is no velocity."""
    config = METHODS[method]
    if config['method'] == 'vif' and not any(isinstance(m, Velocity) for m in load(path).messages):
        config = config | {'method': 'pif'}
    return config


def _moving(methods: dict[str, list[Window]], shown: str) -> list[Window]:
    """Return the windows with real motion, or all if the bank saw none."""
    bank = methods['bank']
    everything = not any(window.moves for window in bank)
    return [window for window, other in zip(methods.get(shown, bank), bank)
            if other.moves or everything]


def targets_text(report: Report, windows: Windows) -> None:
    """Say of the bank how much of the declared was right and how much was declared soon."""
    every = [(name, window) for name, methods in windows.items() for window in methods['bank']]
    declared = [(name, window, window.declared) for name, window in every
                if window.declared is not None]
    sigmas = np.array([error.worst_sigmas for *_, error in declared])
    soon, moving = _soon([window for _, window in every])
    report.text(
        f'bank: of {len(declared)} declared, {np.sum(sigmas <= 3)} are within 3 sigma '
        f'({100 * np.mean(sigmas <= 3):.0f} %, target 99 %), {np.sum(sigmas > 5)} beyond 5 '
        f'(target none); of {moving} windows with real motion, {soon} declare within '
        f'{MOTION_TIME:g} s ({100 * soon / max(moving, 1):.0f} %, target 90 %). Target of the '
        'median heading error then: 1 deg (UAV, car), 3 deg (quadrotor).'
        if declared else 'The bank declared nothing.')
    report.table('bank: declared beyond 3 sigma', [
        each for each in declared if each[2].worst_sigmas > BINS[0]], [
            ('recording', '', lambda d: d[0]), ('start, s', 'g', lambda d: d[1].start_s),
            ('after, s', '.1f', lambda d: d[1].declared_s),
            ('heading, deg', '.2f', lambda d: d[2].angles_deg[2]),
            ('heading, sigma', '.1f', lambda d: d[2].heading_sigmas),
            ('tilt, deg', '.2f', lambda d: d[2].tilt_deg),
            ('tilt, sigma', '.1f', lambda d: d[2].tilt_sigmas)])


def _soon(windows: list[Window]) -> tuple[int, int]:
    """Count the windows with real motion that declare within a minute, and all of them."""
    moving = [window for window in windows if window.moves and window.covers_minute]
    return sum(window.declared_s is not None and window.declared_s <= MOTION_TIME
               for window in moving), len(moving)


def _held(windows: list[Window]) -> Array:
    """Return the errors of all epochs while ALIGNED, sigmas."""
    return np.concatenate([window.sigmas[window.aligned].max(axis=1, initial=0.0)
                           for window in windows])


def _declared(windows: list[Window], error: Callable[[Error], float]) -> list[float]:
    return [error(window.declared) for window in windows if window.declared is not None]


def _both(values: Any) -> str | None:
    return f'{np.median(values):.2g} / {np.max(values):.2g}' if len(values) else None


# Of the name of a row and its windows.
HELD_COLUMNS: list[Column] = [
    ('epochs', '', lambda r: len(_held(r[1]))),
    *((f'> {limit:g} sigma, %', '.1f', lambda r, limit=limit: (
        100 * np.mean(held > limit) if len(held := _held(r[1])) else None)) for limit in BINS),
    ('worst, sigma', '.1f', lambda r: most(_held(r[1])))]
DECLARED_COLUMNS: list[Column] = [
    ('recording, method', '', lambda r: r[0]), ('windows', '', lambda r: len(r[1])),
    ('declared', '', lambda r: sum(window.declared is not None for window in r[1])),
    ('after, s', '.0f', lambda r: median([
        window.declared_s for window in r[1] if window.declared_s is not None])),
    ('in 60 s', '', lambda r: '/'.join(map(str, _soon(r[1])))),
    *((name, '', lambda r, error=error: _both(_declared(r[1], error))) for name, error in (
        ('heading, deg', lambda e: abs(e.angles_deg[2])),
        ('heading, sigma', lambda e: e.heading_sigmas),
        ('tilt, deg', lambda e: e.tilt_deg), ('tilt, sigma', lambda e: e.tilt_sigmas))),
    *((f'> {limit:g}', '', lambda r, limit=limit: sum(
        _declared(r[1], lambda e: e.worst_sigmas > limit))) for limit in BINS),
    *HELD_COLUMNS]


def columns_at(time: float) -> list[Column]:
    """Return the columns of a time, of a row's name, windows, and whether it is the course."""
    def heading(row: Any) -> str | None:
        _, windows, course = row
        values = np.array([window.course_deg[k] if course else window.error_deg[k, 2]
                           for window, k in _epochs_at(windows, time)])
        return _both(np.abs(values[np.isfinite(values)]))

    def of_attitude(row: Any, value: Callable[[Window, int], float]) -> str | None:
        return None if row[2] else _both([value(*each) for each in _epochs_at(row[1], time)])

    return [(f'heading at {time:g} s', '', heading),
            (f'tilt at {time:g} s', '', lambda row: of_attitude(
                row, lambda window, k: np.hypot(*window.error_deg[k, :2]))),
            (f'sigmas at {time:g} s', '', lambda row: of_attitude(
                row, lambda window, k: window.sigmas[k, 1]))]


def _epochs_at(windows: list[Window], time: float) -> list[tuple[Window, int]]:
    """Return the last epoch up to a time of the windows that do not end before it."""
    return [(window, max(int(np.searchsorted(window.time, time + 1e-6)) - 1, 0))
            for window in windows if len(window.time) and window.time[-1] >= time - 1.5]


def figure(windows: Windows) -> Any:
    """Draw heading errors of the bank over time, window by window."""
    def lines_of(window: Window) -> list[tuple[Any, ...]]:
        # Two a second are enough to see, ten make a large file.
        k = np.flatnonzero(np.diff(np.floor(2.0 * window.time), prepend=-1.0))
        error = np.abs(window.error_deg[k, 2])
        return [(window.time[k], error, {'color': '#bbbbbb', 'linewidth': 0.5}),
                (window.time[k], np.where(window.aligned[k], error, np.nan),
                 {'color': '#CC79A7', 'linewidth': 0.7})]

    return draw(12.0, 3.4 * len(windows) + 0.4, [[{
        'title': f'{name}: bank, every window (declared: dark)',
        'lines': itertools.chain(*map(lines_of, methods['bank'])),
        'ylabel': 'heading error (deg)', 'yscale': 'log', 'ylim': (0.02, 200.0)}]
        for name, methods in windows.items()])


def window_json(window: Window) -> JsonDict:
    """Return the numbers of a window that the tables are made of."""
    return {
        'start_s': window.start_s, 'moves': window.moves, 'declared_s': window.declared_s,
        'declared': None if window.declared is None else window.declared.to_json(),
        'worst_declared_sigmas': window.sigmas[window.aligned].max(axis=0)
        if window.aligned.any() else None,
        'at': {f'{time:g}': next(([*at.error_deg[k], *at.sigmas[k]]
                                  for at, k in _epochs_at([window], time)), None)
               for time in TIMES}}
