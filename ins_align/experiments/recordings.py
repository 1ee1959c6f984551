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
Experiment ``recordings``: real recordings, with a new alignment every ten seconds.

Each process decodes a recording once and keeps it in memory; each window of it is aligned on its
own and compared with the reference attitude of the recording.
"""

from __future__ import annotations

from functools import lru_cache
import itertools
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.experiments import ExperimentError
from ins_align.experiments.common import (
    beyond, cell, errors_of, JsonDict, judged, parallel, Report, SIGMA_LIMITS, while_aligned,
    worst)
from ins_align.experiments.spoilt import SECOND
from ins_align.geometry.rotation import Array
from ins_align.gnss.messages import Fix, Velocity
from ins_align.gnss.motion import series_of, track, velocity_from_positions
from ins_align.offline import align
from ins_align.recordings import BagError
from ins_align.recordings.decode import ImuSamples
from ins_align.recordings.reader import read, REFERENCE_TOPIC
from ins_align.results import Epoch, Reference
import numpy as np

# By the name of a recording up to the first dot: its parameters, and the least sigma of its
# reference (tilt, heading; degrees), where the stated one is too good to be true: the UAV's
# differs from the on-board filter by 0.6 and 1.4 deg rms, the quadrotor's has a compass.
KNOWN: dict[str, tuple[JsonDict, float, float]] = {
    'uav_thor75': ({}, 0.6, 1.0), 'car_drive0708': ({'lever_arm': (0.0, 0.05, 0.0)}, 0.2, 0.5),
    'quad_dot08': ({}, 1.0, 2.0)}
MOTION_SPEED, MOTION_TIME = 5.0, 60.0   # velocity change (m/s) in a time (s) that is real motion
STEP, LENGTH = 10.0, 120.0      # s from window to window, and of a window
SHORTEST = 10.0                 # s of data that a window has at least
TIMES = (30.0, 60.0, 120.0)     # s since t0, when errors are tabulated


class Recording(NamedTuple):
    """Messages of a recording, and its reference attitude."""

    name: str
    config: JsonDict                            # parameters of `Config` that are known
    imu: ImuSamples
    gnss: list[tuple[int, Fix | Velocity]]      # each with how many IMU samples came before it
    reference: Reference
    reference_std_deg: Array                    # (3,) about east, north, up

    @property
    def duration(self) -> float:
        """Return the time from the first IMU sample to the last, s."""
        return float(self.imu.stamps_ns[-1] - self.imu.stamps_ns[0]) * 1e-9

    def attitudes_at(self, stamps_ns: list[int]) -> list[Array | None]:
        """Return ``C_nb`` of the reference at stamps, None where it has none."""
        return [self.reference.attitude_at(stamp) for stamp in stamps_ns]

    def part(self, start_s: float, duration: float) -> JsonDict:
        """Return the arguments of `align` for a window; start and duration in s."""
        stamps_ns = self.imu.stamps_ns
        first, last = np.searchsorted(stamps_ns, stamps_ns[0] + np.rint(np.array(
            [start_s, start_s + duration]) * SECOND).astype(np.int64)).tolist()
        messages = [message for before, message in self.gnss if first < before <= last]
        return {'stamps': stamps_ns[first:last], 'gyro': self.imu.gyro[first:last],
                'accel': self.imu.accel[first:last],
                'fixes': [each for each in messages if isinstance(each, Fix)],
                'velocities': [each for each in messages if isinstance(each, Velocity)]}


def recordings_in(folder: Path, pattern: str = '*') -> list[Path]:
    """Return the recordings in a folder that carry a reference, of names that fit a pattern."""
    paths = []
    for path in sorted(folder.glob(pattern)):
        try:
            load(path)
            paths.append(path)
        except BagError as error:
            print(f'{path.name}: left out: {error}')
    return paths


@lru_cache(maxsize=3)
def load(path: Path) -> Recording:
    """Read and decode a recording; the last three stay in memory."""
    parts = list(read(path))
    if parts[0].topics.reference is None:
        raise BagError(f'it has no reference attitude on {REFERENCE_TOPIC}')
    imu = ImuSamples(*map(np.concatenate, zip(*(part.imu for part in parts))))
    stamps_ns, quaternions, covariances = map(
        np.concatenate, zip(*(part.reference.orientations() for part in parts)))
    earlier = itertools.accumulate((part.imu.stamps_ns.size for part in parts), initial=0)
    name = path.name.split('.')[0]
    stated = np.degrees(np.sqrt(np.median(np.abs(covariances[:, [0, 4, 8]]), axis=0)))
    config, tilt, heading = KNOWN.get(name, ({}, 0.0, 0.0))
    gnss = [(start + before, message) for start, part in zip(earlier, parts)
            for before, message in part.gnss if isinstance(message, (Fix, Velocity))]
    return Recording(name, config, imu, gnss, Reference((stamps_ns, quaternions)),
                     np.maximum(stated, [tilt, tilt, heading]))


def windows_of(path: Path, config: JsonDict) -> list[Any]:
    """Return the tasks for `run_window`, one every `STEP` seconds of a recording."""
    starts = np.arange(0.0, max(load(path).duration - SHORTEST, 0.0) + 1e-6, STEP)
    return [(path, start, LENGTH, config) for start in starts.tolist()]


def run_window(task: tuple[Path, float, float, JsonDict]) -> JsonDict:
    """
    Align a window of a recording and judge it.

    The task is the path, start and duration of the window (s), and parameters of `Config`.
    """
    path, start_s, duration, config = task
    recording = load(path)
    part = recording.part(start_s, duration)
    result = align(**part, **{**recording.config, **config})
    epochs = [epoch for epoch in result.epochs if not epoch.dry]
    return {'start_s': start_s, 'state': result.status.state.value,
            'moves': _moves(**part),
            'covers_minute': min(recording.duration - start_s, duration) >= MOTION_TIME,
            'at': at_times(recording, epochs),
            **while_aligned(epochs, int(part['stamps'][0]), recording.attitudes_at,
                            recording.reference_std_deg)}


def _moves(stamps: np.ndarray, fixes: list[Fix], velocities: list[Velocity], **imu: Array) -> bool:
    """Return whether the horizontal velocity, or that of positions, changes much in a minute."""
    measured = [m for m in velocities if np.isfinite(m.velocity).all()]
    rows = [(m.stamp_ns - stamps[0], *m.velocity) for m in measured] or [
        (m.stamp_ns - stamps[0], m.latitude_deg, m.longitude_deg, m.altitude_m) for m in fixes]
    table = np.array(rows, float).reshape(-1, 4)
    table = table[np.isfinite(table).all(axis=1)]
    series = series_of(table[:, 0] / SECOND, table[:, 1:])
    times, v = series if measured else velocity_from_positions(track(series))
    v = v[times <= times[:1] + MOTION_TIME, :2]
    # The extents in these directions contain the largest change to 1 %.
    angles = np.radians(np.arange(0.0, 180.0, 15.0))
    extents = np.ptp(v @ [np.cos(angles), np.sin(angles)], axis=0) if len(v) else np.zeros(1)
    return bool(extents.max() >= MOTION_SPEED)


def at_times(recording: Recording, epochs: list[Epoch]) -> dict[str, JsonDict]:
    """Judge the last epoch up to each of `TIMES` that the window reaches, declared or not."""
    shown = [epoch for epoch in epochs if epoch.current is not None]
    errors = errors_of([epoch.current for epoch in shown], recording.attitudes_at,
                       recording.reference_std_deg)
    known = [judged(epoch.t_s, [error]) for epoch, error in zip(shown, errors)
             if error is not None]
    found = {}
    for time in TIMES:
        before = [each for each in known if each['t_s'] <= time + 1e-6]
        if before and known[-1]['t_s'] >= time - 1.5:
            found[f'{time:g}'] = before[-1]
    return found


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``recordings``: all windows of all recordings with all methods."""
    assert data is not None
    paths = recordings_in(data)
    if not paths:
        raise ExperimentError(f'no recording with {REFERENCE_TOPIC} in {data}')
    tasks: dict[str, list[Any]] = {}
    for path in paths:
        recording = load(path)
        measured = any(isinstance(message, Velocity) for _, message in recording.gnss)
        note = {'method': 'vif' if measured else 'pif'}
        for method, config in (('note', {**note, 'free_start': False}), ('centred', note),
                               ('bank', {'method': 'bank'})):
            tasks[f'{recording.name}, {method}'] = windows_of(path, config)
        tasks[f'{recording.name}, bank, all of it'] = [(path, 0.0, recording.duration, {})]
    groups = dict(zip(tasks, parallel(run_window, list(tasks.values()), jobs, 'windows')))
    every = [each for name, group in groups.items() for each in group if name.endswith('bank')]
    report.text(
        f'An alignment starts every {STEP:g} s and runs for up to {LENGTH:g} s with the defaults '
        '(preset mems), the car with its lever arm. note: vif with free_start false; centred: '
        'vif; both are pif where there are no velocities. Errors of the current attitude against '
        'the reference, in sigmas with that of the reference in quadrature.')
    report.table(
        f'At the declaration: median / worst. in {MOTION_TIME:g} s: windows with real motion '
        f'(by {MOTION_SPEED:g} m/s in that time) that declare. Then all epochs while ALIGNED',
        [declared_row(name, group)
         for name, group in (*groups.items(), ('all windows, bank', every))])
    report.table(
        'Errors in deg: median / worst, declared or not; sigmas: of the heading. Windows with '
        'real motion; all if none has', [
            times_row(name, [each for each in group if each['moves']] or group)
            for name, group in groups.items()])
    return groups


# Rows of tables, each from a name and the results of its windows

def _both(events: list[JsonDict], name: str) -> str | None:
    """Return the median and the largest value of a named error."""
    values = [event[name] for event in events]
    return f'{np.median(values):.2g} / {np.max(values):.2g}' if values else None


def declared_row(name: str, runs: list[JsonDict]) -> JsonDict:
    """Return when windows declare, and the errors then and in all epochs while ALIGNED."""
    first = [run['first'][0] for run in runs if run['first']]
    moving = [run['first'] for run in runs if run['moves'] and run['covers_minute']]
    soon = sum(each[0]['t_s'] <= MOTION_TIME for each in moving if each)
    epochs = sum(run['epochs'] for run in runs)
    row = {'case': name, 'runs': len(runs), 'declared': len(first),
           'after, s': cell(np.median, (each['t_s'] for each in first), '.0f'),
           'in 60 s': f'{soon}/{len(moving)}'}
    for title, key in (('heading, deg', 'heading_deg'), ('heading, sigma', 'heading_sigmas'),
                       ('tilt, deg', 'tilt_deg'), ('tilt, sigma', 'tilt_sigmas')):
        row[title] = _both(first, key)
    row |= {f'> {limit:g}': beyond((worst([each]) for each in first), limit)
            for limit in SIGMA_LIMITS}
    row |= {'at the end': sum(run['state'] == 'ALIGNED' for run in runs), 'epochs': epochs}
    for k, limit in enumerate(SIGMA_LIMITS):
        row[f'> {limit:g} sigma, %'] = (
            f"{100 * sum(run['beyond'][k] for run in runs) / epochs:.1f}" if epochs else None)
    return row | {'worst, sigma': cell(
        max, (run['worst_sigmas'] for run in runs if run['first']), '.1f')}


def times_row(name: str, runs: list[JsonDict]) -> JsonDict:
    """Return the errors of windows at each of `TIMES`."""
    row = {'case': name, 'runs': len(runs)}
    for time in map('{:g}'.format, TIMES):
        found = [run['at'][time] for run in runs if time in run['at']]
        for title, key in (('heading', 'heading_deg'), ('tilt', 'tilt_deg'),
                           ('sigmas', 'heading_sigmas')):
            row[f'{title} at {time} s'] = _both(found, key)
    return row
