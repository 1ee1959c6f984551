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
"""Real recordings in memory: decoded once, aligned window by window, against their reference."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Aligner
from ins_align.config import Config
from ins_align.experiments.common import Error, error_of
from ins_align.geometry.earth import ecef_from_lla, matrix_en
from ins_align.geometry.rotation import Array
from ins_align.recordings import BagError
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import ImuSamples, joined, Orientations, Refused
from ins_align.recordings.reader import choose_topics, read, Request
from ins_align.recordings.replay import Reference
from ins_align.results import Epoch
import numpy as np

# What is known beside the recording, by the beginning of its name: the lever arm, and how well
# its reference is known (tilt, heading; degrees), where its stated sigma is too good to be true:
# the UAV's differs from the on-board filter by 0.6 and 1.4 deg rms, the quadrotor's has a compass.
KNOWN_LEVER_ARMS = {'car_drive0708': (0.0, 0.05, 0.0)}
REFERENCE_STD_DEG = {'uav_thor75': (0.6, 1.0), 'car_drive0708': (0.2, 0.5),
                     'quad_dot08': (1.0, 2.0)}
SUFFIXES = ('.bag', '.mcap', '.db3')
MOTION_SPEED, MOTION_TIME = 5.0, 60.0       # m/s of change within so many s is real motion


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
    imu = joined([part.imu for part in parts])
    orientations = joined([part.orientations for part in parts])
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
    sigma_deg: Array        # (K, 3), stated
    sigmas: Array           # (K, 2), tilt and heading in sigmas, that of the reference included
    declared_s: float | None
    declared: Error | None  # with the reference's sigma
    moves: bool             # real motion in its first minute
    covers_minute: bool
    course_deg: Array       # (K,), error of the course over ground as heading, nan when slow


def run_window(path: Path, start_s: float, duration: float, **told: Any) -> Window:
    """
    Align a part of a recording.

    Parameters
    ----------
    path : Path
        The recording.
    start_s, duration : float
        Seconds from the first IMU sample.
    **told
        Parameters of `Config`.

    """
    recording = load(path)
    if recording.name in KNOWN_LEVER_ARMS:
        told = {'lever_arm': KNOWN_LEVER_ARMS[recording.name], **told}
    aligner = Aligner(Config(**told))
    stamps = recording.imu.stamps_ns
    first, last = (int(np.searchsorted(stamps, recording.start_ns + round(t * 1e9)))
                   for t in (start_s, start_s + duration))
    chosen = np.flatnonzero((recording.imu_before > first) & (recording.imu_before <= last))
    place = first
    for m in chosen:
        end = int(recording.imu_before[m])
        _add_imu(aligner, recording.imu, place, end)
        place = end
        message = recording.messages[m]
        if hasattr(message, 'velocity'):
            aligner.add_velocity(message)
        else:
            aligner.add_fix(message)
    _add_imu(aligner, recording.imu, place, last)
    return _judged(recording, start_s, duration, aligner.flush(),
                   [recording.messages[m] for m in chosen])


def _add_imu(aligner: Aligner, imu: ImuSamples, start: int, end: int) -> None:
    if end > start:
        aligner.add_imu(imu.stamps_ns[start:end], imu.gyro[start:end], imu.accel[start:end])


def _judged(recording: Recording, start_s: float, duration: float, epochs: list[Epoch],
            messages: list[Any]) -> Window:
    rows = []
    declared = None
    declared_s = None
    stamps, velocities = _velocities(messages)
    for epoch in epochs:
        attitude = epoch.current
        C_true = None if attitude is None else recording.reference.attitude_at(attitude.stamp_ns)
        if attitude is None or C_true is None:
            continue
        error = error_of(attitude, C_true, recording.reference_std_deg)
        aligned = epoch.state.value == 'ALIGNED'
        if aligned and declared is None:
            declared, declared_s = error, epoch.t_s
        rows.append([epoch.t_s, aligned, *error.angles_deg, *attitude.sigma_deg,
                     error.tilt_sigmas, error.heading_sigmas,
                     _course_error(epoch.stamp_ns, C_true, stamps, velocities)])
    table = np.array(rows).reshape(-1, 11)
    minute = velocities[stamps <= stamps[0] + round(MOTION_TIME * 1e9)] if len(stamps) else []
    return Window(start_s, table[:, 0], table[:, 1] > 0, table[:, 2:5], table[:, 5:8],
                  table[:, 8:10], declared_s, declared, _change(minute) >= MOTION_SPEED,
                  recording.duration - start_s >= MOTION_TIME and duration >= MOTION_TIME,
                  table[:, 10])


def _velocities(messages: list[Any]) -> tuple[np.ndarray, Array]:
    """Horizontal velocities of a window, stamps and ENU; from positions where there are none."""
    measured = [m for m in messages if hasattr(m, 'velocity') and np.isfinite(m.velocity).all()]
    if measured:
        return (np.array([m.stamp_ns for m in measured]),
                np.array([m.velocity[:2] for m in measured]))
    fixes = [m for m in messages if np.isfinite([m.latitude_deg, m.longitude_deg]).all()]
    if len(fixes) < 3:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    stamps = np.array([m.stamp_ns for m in fixes])
    place = np.radians([[m.latitude_deg, m.longitude_deg] for m in fixes])
    r_e = ecef_from_lla(*place.T, [m.altitude_m for m in fixes])
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
