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

from collections.abc import Callable
from functools import lru_cache
import itertools
import math
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.experiments import ExperimentError
from ins_align.experiments.common import (
    BINS, Column, draw, error_of, JsonDict, median, most, parallel, Report)
from ins_align.experiments.spoilt import SECOND
from ins_align.geometry.rotation import Array
from ins_align.gnss.messages import Fix, Velocity
from ins_align.gnss.motion import series_of, track
from ins_align.offline import align
from ins_align.recordings import BagError
from ins_align.recordings.decode import ImuSamples, Orientations
from ins_align.recordings.reader import read, REFERENCE_TOPIC, Request
from ins_align.results import Reference, State
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


class Part(NamedTuple):
    """The arguments of `align`."""

    stamps: np.ndarray
    gyro: Array
    accel: Array
    fixes: list[Fix]
    velocities: list[Velocity]


class Recording(NamedTuple):
    """Messages of a recording, and its reference."""

    name: str
    imu: ImuSamples
    gnss: list[tuple[int, Fix | Velocity]]      # each with how many IMU samples came before it
    reference: Reference
    reference_std_deg: Array                    # (3,) about east, north, up

    @property
    def duration(self) -> float:
        """Seconds."""
        return float(self.imu.stamps_ns[-1] - self.imu.stamps_ns[0]) * 1e-9

    @property
    def lever_arm(self) -> JsonDict:
        """Return the lever arm as a parameter, where it is known."""
        known = KNOWN_LEVER_ARMS.get(self.name)
        return {} if known is None else {'lever_arm': known}

    def attitudes_at(self, stamps_ns: list[int]) -> list[Array | None]:
        """Return the reference's ``C_nb`` at stamps, None where there is none."""
        return [self.reference.attitude_at(stamp) for stamp in stamps_ns]

    def part(self, start_s: float, duration: float) -> Part:
        """Return what `align` takes, for so long from a time on, s."""
        stamps_ns = self.imu.stamps_ns
        first, last = np.searchsorted(stamps_ns, stamps_ns[0] + np.rint(np.array(
            [start_s, start_s + duration]) * SECOND).astype(np.int64)).tolist()
        messages = [message for before, message in self.gnss if first < before <= last]
        return Part(*(array[first:last] for array in (stamps_ns, self.imu.gyro, self.imu.accel)),
                    [message for message in messages if isinstance(message, Fix)],
                    [message for message in messages if isinstance(message, Velocity)])


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
    name = path.name.split('.')[0]
    stated = np.degrees(np.sqrt(np.median(np.abs(orientations.covariances[:, [0, 4, 8]]), axis=0)))
    tilt, heading = REFERENCE_STD_DEG.get(name, (0.0, 0.0))
    return Recording(
        name, imu, [(start + before, message) for start, part in zip(earlier, parts)
                    for before, message in part.gnss if isinstance(message, (Fix, Velocity))],
        Reference(orientations.known()), np.maximum(stated, [tilt, tilt, heading]))


class Window(NamedTuple):
    """What came of one window of a recording; K epochs with an attitude."""

    start_s: float
    time: Array             # (K,), s since t0
    aligned: Array          # (K,) bool
    error_deg: Array        # (K, 3), of the current attitude about east, north, up
    sigmas: Array           # (K, 2), tilt and heading in sigmas, that of the reference included
    course_deg: Array       # (K,), error of the course over ground as heading, nan when slow
    moves: bool             # real motion in its first minute
    covers_minute: bool

    @property
    def declared_s(self) -> float | None:
        """When it was declared first, s since t0; None if it was not."""
        return next(iter(self.time[self.aligned].tolist()), None)


Chosen = list[tuple[Window, int]]           # epochs of windows, by their places
Windows = dict[str, dict[str, list[Window]]]        # by recording and method


def run_window(task: tuple[Path, float, float, JsonDict]) -> Window:
    """Align a window of a recording: from when on and how long, s; parameters of `Config`."""
    path, start_s, duration, config = task
    recording = load(path)
    part = recording.part(start_s, duration)
    stamps, velocities = _velocities(part)
    rows = []
    for epoch in align(*part, **{**recording.lever_arm, **config}).epochs:
        if epoch.dry or epoch.current is None:
            continue
        [C_true] = recording.attitudes_at([epoch.current.stamp_ns])
        if C_true is not None:
            error = error_of(epoch.current, C_true, recording.reference_std_deg)
            rows.append([epoch.t_s, epoch.state is State.ALIGNED, *error.angles_deg,
                         error.tilt_sigmas, error.heading_sigmas,
                         _course_error(epoch.stamp_ns, C_true, stamps, velocities)])
    table = np.array(rows).reshape(-1, 8)
    minute = velocities[stamps <= stamps[:1] + round(MOTION_TIME * SECOND)]
    return Window(start_s, table[:, 0], table[:, 1] > 0, table[:, 2:5], table[:, 5:7],
                  table[:, 7], _change(minute) >= MOTION_SPEED,
                  min(recording.duration - start_s, duration) >= MOTION_TIME)


def _velocities(part: Part) -> tuple[np.ndarray, Array]:
    """Horizontal velocities of a window, stamps and ENU; from positions where there are none."""
    measured = [m for m in part.velocities if np.isfinite(m.velocity).all()]
    if measured:
        return (np.array([m.stamp_ns for m in measured]),
                np.array([m.velocity[:2] for m in measured]))
    fixes = np.array([[m.stamp_ns - part.stamps[0], m.latitude_deg, m.longitude_deg, m.altitude_m]
                      for m in part.fixes]).reshape(-1, 4)
    fixes = fixes[np.isfinite(fixes).all(axis=1)]
    if len(fixes) < 3:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    time, places = track(series_of(fixes[:, 0] / SECOND, fixes[:, 1:]))
    # Over half a second, against the noise of a fix.
    step = max(1, int(round(0.25 / np.median(np.diff(time)))))
    moved = (places[2 * step:] - places[:-2 * step])[:, :2]
    return (part.stamps[0] + np.rint(time[step:-step] * SECOND).astype(np.int64),
            moved / (time[2 * step:] - time[:-2 * step])[:, None])


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


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run every window of every recording with every method."""
    assert data is not None
    paths = recordings_in(data)
    if not paths:
        raise ExperimentError(f'no recording with {REFERENCE_TOPIC} in {data}')
    groups = [(path, method) for path in paths for method in METHODS]
    *results, whole = parallel(run_window, [
        *([(path, start, LENGTH, _config_of(path, method)) for start in np.arange(
            0.0, max(load(path).duration - SHORTEST, 0.0) + 1e-6, STEP).tolist()]
          for path, method in groups),
        [(path, 0.0, load(path).duration, {}) for path in paths]], jobs, 'windows')
    windows: Windows = {load(path).name: {} for path in paths}
    for (path, method), each in zip(groups, results):
        windows[load(path).name][method] = each
    report.text(
        f'An alignment starts every {STEP:g} s and runs for up to {LENGTH:g} s with the defaults '
        '(preset mems), the car with its lever arm. note: vif with free_start false; centred: '
        'vif; both are pif where there are no velocities. Errors of the current attitude against '
        'the reference, in sigmas with that of the reference in quadrature.')
    report.text(targets_text([window for methods in windows.values()
                              for window in methods['bank']]))
    rows = [(f'{name}, {method}', each) for name, methods in windows.items()
            for method, each in methods.items()]
    report.table(
        f'At the declaration: median / worst. in {MOTION_TIME:g} s: windows with real motion '
        f'(by {MOTION_SPEED:g} m/s in that time) that declare. Then all epochs while ALIGNED',
        rows, DECLARED_COLUMNS)
    report.table(
        'Errors in deg: median / worst, declared or not; sigmas: of the heading; course: that '
        'over ground, above 1 m/s, taken for it. Windows with real motion; all if none has', [
            (name, [window for window in each if window.moves] or each) for name, each in rows],
        [*NAMES, *itertools.chain(*map(columns_at, TIMES))])
    report.table('Whole recordings, bank: every epoch while ALIGNED', [
        (load(path).name, [window]) for path, window in zip(paths, whole)], [
            *NAMES, ('after, s', '.0f', lambda row: row[1][0].declared_s),
            ('of all, %', '.0f', lambda row: 100 * np.mean(row[1][0].aligned)),
            ('at the end', '', lambda row: bool(row[1][0].aligned[-1])), *HELD_COLUMNS])
    report.figure(figure(windows), '', 'Heading error of the bank in all windows against time; '
                                       'declared parts drawn dark')
    return {name: {method: [window_json(window) for window in each]
                   for method, each in methods.items()} for name, methods in windows.items()}


def _config_of(path: Path, method: str) -> JsonDict:
    """Return a method's parameters: pif instead of vif where there is no velocity."""
    config = METHODS[method]
    known = any(isinstance(message, Velocity) for _, message in load(path).gnss)
    return config | {'method': 'pif'} if config['method'] == 'vif' and not known else config


def targets_text(windows: list[Window]) -> str:
    """Say how much of the declared was right and how much was declared soon."""
    sigmas = np.array(_values(declarations(windows), 'worst'))
    soon, moving = _soon(windows)
    return (
        f'bank: of {len(sigmas)} declared, {np.sum(sigmas <= 3)} are within 3 sigma '
        f'({100 * np.sum(sigmas <= 3) / max(len(sigmas), 1):.0f} %, target 99 %), '
        f'{np.sum(sigmas > 5)} beyond 5 (target none); of {moving} windows with real motion, '
        f'{soon} declare within {MOTION_TIME:g} s ({100 * soon / max(moving, 1):.0f} %, target '
        '90 %). Target of the median heading error then: 1 deg (UAV, car), 3 deg (quadrotor).')


# Tables, whose rows are a name and its windows

def declarations(windows: list[Window]) -> Chosen:
    """Return the epochs of first declarations."""
    return [(window, int(np.argmax(window.aligned))) for window in windows
            if window.aligned.any()]


def epochs_at(windows: list[Window], time: float) -> Chosen:
    """Return the last epoch up to a time of the windows that do not end before it."""
    return [(window, max(int(np.searchsorted(window.time, time + 1e-6)) - 1, 0))
            for window in windows if len(window.time) and window.time[-1] >= time - 1.5]


VALUES: dict[str, Callable[[Window, int], float]] = {
    'heading, deg': lambda window, k: abs(window.error_deg[k, 2]),
    'heading, sigma': lambda window, k: window.sigmas[k, 1],
    'tilt, deg': lambda window, k: np.hypot(*window.error_deg[k, :2]),
    'tilt, sigma': lambda window, k: window.sigmas[k, 0],
    'worst': lambda window, k: window.sigmas[k].max(),
    'course': lambda window, k: abs(window.course_deg[k])}


def _values(chosen: Chosen, name: str) -> list[float]:
    return [value for each in chosen if math.isfinite(value := VALUES[name](*each))]


def _both(values: list[float]) -> str | None:
    """Return the median and the largest of values."""
    return f'{np.median(values):.2g} / {np.max(values):.2g}' if values else None


def _soon(windows: list[Window]) -> tuple[int, int]:
    """Count the windows with real motion that declare within a minute, and all of them."""
    moving = [window for window in windows if window.moves and window.covers_minute]
    return sum(window.declared_s is not None and window.declared_s <= MOTION_TIME
               for window in moving), len(moving)


def _held(windows: list[Window]) -> Array:
    """Return the errors of all epochs while ALIGNED, sigmas."""
    return np.concatenate([window.sigmas[window.aligned].max(axis=1, initial=0.0)
                           for window in windows])


NAMES: list[Column] = [('recording, method', '', lambda row: row[0]),
                       ('windows', '', lambda row: len(row[1]))]
HELD_COLUMNS: list[Column] = [
    ('epochs', '', lambda row: len(_held(row[1]))),
    *((f'> {limit:g} sigma, %', '.1f', lambda row, limit=limit: (
        100 * np.mean(held > limit) if len(held := _held(row[1])) else None)) for limit in BINS),
    ('worst, sigma', '.1f', lambda row: most(_held(row[1])))]
DECLARED_COLUMNS: list[Column] = [
    *NAMES, ('declared', '', lambda row: len(declarations(row[1]))),
    ('after, s', '.0f', lambda row: median([
        window.declared_s for window in row[1] if window.declared_s is not None])),
    ('in 60 s', '', lambda row: '/'.join(map(str, _soon(row[1])))),
    *((name, '', lambda row, name=name: _both(_values(declarations(row[1]), name)))
      for name in ('heading, deg', 'heading, sigma', 'tilt, deg', 'tilt, sigma')),
    *((f'> {limit:g}', '', lambda row, limit=limit: sum(
        sigmas > limit for sigmas in _values(declarations(row[1]), 'worst'))) for limit in BINS),
    *HELD_COLUMNS]


def columns_at(time: float) -> list[Column]:
    """Return the columns of the errors at a time."""
    return [(f'{title} at {time:g} s', '', lambda row, name=name: _both(
        _values(epochs_at(row[1], time), name))) for title, name in (
            ('heading', 'heading, deg'), ('tilt', 'tilt, deg'), ('sigmas', 'heading, sigma'),
            ('course', 'course'))]


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
        'worst_declared_sigmas': window.sigmas[window.aligned].max(axis=0)
        if window.aligned.any() else None,
        **{name: next(([*at.error_deg[k], *at.sigmas[k]] for at, k in chosen), None)
           for name, chosen in (('declared', declarations([window])), *(
               (f'{time:g} s', epochs_at([window], time)) for time in TIMES))}}
