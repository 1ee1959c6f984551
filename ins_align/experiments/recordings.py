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
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.experiments import ExperimentError
from ins_align.experiments.common import (
    beyond, BINS, Column, count, error_of, JsonDict, median, moment, most, over, parallel, Report,
    WHICH, while_aligned, worst)
from ins_align.experiments.spoilt import SECOND
from ins_align.geometry.rotation import Array
from ins_align.gnss.messages import Fix, Velocity
from ins_align.gnss.motion import series_of, track
from ins_align.offline import align
from ins_align.recordings import BagError
from ins_align.recordings.decode import ImuSamples
from ins_align.recordings.reader import read, REFERENCE_TOPIC
from ins_align.results import Epoch, Reference
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

    def part(self, start_s: float, duration: float) -> JsonDict:
        """Return the data that `align` takes, for so long from a time on, s."""
        stamps_ns = self.imu.stamps_ns
        first, last = np.searchsorted(stamps_ns, stamps_ns[0] + np.rint(np.array(
            [start_s, start_s + duration]) * SECOND).astype(np.int64)).tolist()
        messages = [message for before, message in self.gnss if first < before <= last]
        return {'stamps': stamps_ns[first:last], 'gyro': self.imu.gyro[first:last],
                'accel': self.imu.accel[first:last],
                'fixes': [each for each in messages if isinstance(each, Fix)],
                'velocities': [each for each in messages if isinstance(each, Velocity)]}


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
    parts = list(read(path))
    if parts[0].topics.reference is None:
        raise BagError(f'it has no reference attitude on {REFERENCE_TOPIC}')
    imu = ImuSamples(*map(np.concatenate, zip(*(part.imu for part in parts))))
    stamps_ns, quaternions, covariances = map(
        np.concatenate, zip(*(part.reference.orientations() for part in parts)))
    earlier = itertools.accumulate((part.imu.stamps_ns.size for part in parts), initial=0)
    name = path.name.split('.')[0]
    stated = np.degrees(np.sqrt(np.median(np.abs(covariances[:, [0, 4, 8]]), axis=0)))
    tilt, heading = REFERENCE_STD_DEG.get(name, (0.0, 0.0))
    return Recording(
        name, imu, [(start + before, message) for start, part in zip(earlier, parts)
                    for before, message in part.gnss if isinstance(message, (Fix, Velocity))],
        Reference((stamps_ns, quaternions)), np.maximum(stated, [tilt, tilt, heading]))


def run_window(task: tuple[Path, float, float, JsonDict, float]) -> JsonDict:
    """
    Align a window of a recording.

    The task: its path, from when on and how long, s, parameters of `Config`, the sign of gyro z.
    """
    path, start_s, duration, config, z_sign = task
    recording = load(path)
    part = recording.part(start_s, duration)
    part['gyro'] = part['gyro'] * [1.0, 1.0, z_sign]
    result = align(**part, **{**recording.lever_arm, **config})
    epochs = [epoch for epoch in result.epochs if not epoch.dry]
    stamps, velocities = _velocities(**part)
    minute = velocities[stamps <= stamps[:1] + round(MOTION_TIME * SECOND)]
    return {'start_s': start_s, 'state': result.status.state.value,
            'moves': _change(minute) >= MOTION_SPEED,
            'covers_minute': min(recording.duration - start_s, duration) >= MOTION_TIME,
            'at': at_times(recording, epochs, stamps, velocities),
            **while_aligned(epochs, int(part['stamps'][0]), recording.attitudes_at,
                            recording.reference_std_deg)}


def at_times(recording: Recording, epochs: list[Epoch], stamps: np.ndarray,
             velocities: Array) -> dict[str, list[JsonDict]]:
    """Judge the last epochs up to `TIMES`, declared or not, and the course over ground there."""
    known = [(epoch, C_true) for epoch in epochs if epoch.current is not None
             for C_true in recording.attitudes_at([epoch.current.stamp_ns]) if C_true is not None]
    found = {}
    for time in TIMES:
        before = [each for each in known if each[0].t_s <= time + 1e-6] or known[:1]
        # A window that ends before has nothing to show.
        for epoch, C_true in before[-1:] if known and known[-1][0].t_s >= time - 1.5 else ():
            error = error_of(epoch.current, C_true, recording.reference_std_deg)
            found[f'{time:g}'] = [{**moment(epoch.t_s, [error]), 'course_deg': _course_error(
                C_true, velocities[np.searchsorted(stamps, epoch.stamp_ns):][:1])}]
    return found


def _velocities(stamps: np.ndarray, fixes: list[Fix], velocities: list[Velocity], **imu: Array,
                ) -> tuple[np.ndarray, Array]:
    """Horizontal velocities of a window, stamps and ENU; from positions where there are none."""
    measured = [m for m in velocities if np.isfinite(m.velocity).all()]
    if measured:
        return (np.array([m.stamp_ns for m in measured]),
                np.array([m.velocity[:2] for m in measured]))
    rows = np.array([[m.stamp_ns - stamps[0], m.latitude_deg, m.longitude_deg, m.altitude_m]
                     for m in fixes]).reshape(-1, 4)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < 3:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    time, places = track(series_of(rows[:, 0] / SECOND, rows[:, 1:]))
    # Over half a second, against the noise of a fix.
    step = max(1, int(round(0.25 / np.median(np.diff(time)))))
    moved = (places[2 * step:] - places[:-2 * step])[:, :2]
    return (stamps[0] + np.rint(time[step:-step] * SECOND).astype(np.int64),
            moved / (time[2 * step:] - time[:-2 * step])[:, None])


def _change(velocities: Any) -> float:
    """Largest difference of two velocities, shape (N, 2), m/s, to 1 %."""
    angles = np.radians(np.arange(0.0, 180.0, 15.0))
    extents = np.asarray(velocities).reshape(-1, 2) @ [np.cos(angles), np.sin(angles)]
    return float(np.max(np.ptp(extents, axis=0))) if len(extents) else 0.0


def _course_error(C_true: Array, v: Array) -> float | None:
    """Error of a velocity (1, 2) as heading, degrees; None if there is none above 1 m/s."""
    if not len(v) or np.hypot(*v[0]) < 1.0:
        return None
    error = np.arctan2(C_true[1, 0], C_true[0, 0]) - np.arctan2(v[0, 1], v[0, 0])
    return float(abs(np.degrees((error + np.pi) % (2 * np.pi) - np.pi)))


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run every window of every recording with every method."""
    assert data is not None
    paths = recordings_in(data)
    if not paths:
        raise ExperimentError(f'no recording with {REFERENCE_TOPIC} in {data}')
    tasks: dict[str, list[Any]] = {}
    for path in paths:
        name, duration = load(path).name, load(path).duration
        starts = np.arange(0.0, max(duration - SHORTEST, 0.0) + 1e-6, STEP).tolist()
        tasks |= {f'{name}, {method}': [(path, start, LENGTH, config, 1.0) for start in starts]
                  for method, config in methods_of(path).items()}
        tasks[f'{name}, bank, all of it'] = [(path, 0.0, duration, {}, 1.0)]
    groups = dict(zip(tasks, parallel(run_window, list(tasks.values()), jobs, 'windows')))
    every = [each for name, group in groups.items() for each in group if name.endswith('bank')]
    report.text(
        f'An alignment starts every {STEP:g} s and runs for up to {LENGTH:g} s with the defaults '
        '(preset mems), the car with its lever arm. note: vif with free_start false; centred: '
        'vif; both are pif where there are no velocities. Errors of the current attitude against '
        'the reference, in sigmas with that of the reference in quadrature. Targets of the bank: '
        'of the declared 99 % within 3 sigma, none beyond 5, with a median heading error of 1 deg '
        f'(UAV, car) and 3 deg (quadrotor); 90 % of the windows with real motion within '
        f'{MOTION_TIME:g} s.')
    report.table(
        f'At the declaration: median / worst. in {MOTION_TIME:g} s: windows with real motion '
        f'(by {MOTION_SPEED:g} m/s in that time) that declare. Then all epochs while ALIGNED',
        [*groups.items(), ('all windows, bank', every)], DECLARED_COLUMNS)
    report.table(
        'Errors in deg: median / worst, declared or not; sigmas: of the heading; course: that '
        'over ground, above 1 m/s, taken for it. Windows with real motion; all if none has', [
            (name, [each for each in group if each['moves']] or group)
            for name, group in groups.items()],
        [*WHICH, *(
            (f'{title} at {time:g} s', '', _both(lambda run, time=time: run['at'].get(
                f'{time:g}', ()), name)) for time in TIMES for title, name in (
                    ('heading', 'heading_deg'), ('tilt', 'tilt_deg'), ('sigmas', 'heading_sigmas'),
                    ('course', 'course_deg')))])
    return groups


def methods_of(path: Path) -> dict[str, JsonDict]:
    """Return the parameters of each method: pif instead of vif where there is no velocity."""
    measured = any(isinstance(message, Velocity) for _, message in load(path).gnss)
    note = {'method': 'vif' if measured else 'pif'}
    return {'note': {**note, 'free_start': False}, 'centred': note, 'bank': {'method': 'bank'}}


# Columns of tables, whose rows are a name and the runs of its windows

def _both(moments_of: Callable[[JsonDict], list[JsonDict]], name: str) -> Callable[[Any], Any]:
    """Return the median and the largest value of moments."""
    def cell(group: tuple[str, list[JsonDict]]) -> str | None:
        values = [moment[name] for run in group[1] for moment in moments_of(run)
                  if moment[name] is not None]
        return f'{np.median(values):.2g} / {np.max(values):.2g}' if values else None

    return cell


def _soon(group: tuple[str, list[JsonDict]]) -> str:
    """Count the windows with real motion that declare within a minute, and all of them."""
    times = [[first['t_s'] for first in run['first']] for run in group[1]
             if run['moves'] and run['covers_minute']]
    return f'{sum(each[0] <= MOTION_TIME for each in times if each)}/{len(times)}'


def _share(group: tuple[str, list[JsonDict]], place: int) -> float | None:
    """Return the part of epochs while ALIGNED that are beyond one of `BINS`, %."""
    epochs = sum(run['epochs'] for run in group[1])
    return 100 * sum(run['beyond'][place] for run in group[1]) / epochs if epochs else None


DECLARED_COLUMNS: list[Column] = [
    *WHICH, over('declared', 'first', count),
    over('after, s', 'first', lambda found: median([
        each[0]['t_s'] for each in found if each]), '.0f'),
    ('in 60 s', '', _soon),
    *((title, '', _both(lambda run: run['first'], name)) for title, name in (
        ('heading, deg', 'heading_deg'), ('heading, sigma', 'heading_sigmas'),
        ('tilt, deg', 'tilt_deg'), ('tilt, sigma', 'tilt_sigmas'))),
    *(over(f'> {limit:g}', 'first', lambda found, limit=limit: beyond(map(worst, found), limit))
      for limit in BINS),
    over('at the end', 'state', lambda states: states.count('ALIGNED')),
    over('epochs', 'epochs', sum),
    *((f'> {limit:g} sigma, %', '.1f', lambda group, place=place: _share(group, place))
      for place, limit in enumerate(BINS)),
    over('worst, sigma', 'worst_sigmas', most, '.1f')]
