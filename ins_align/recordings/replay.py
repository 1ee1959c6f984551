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
"""Replay: one recording prepared and aligned, with results as JSON, CSV and arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable
import dataclasses
from dataclasses import dataclass
import io
import math
import os
from typing import Any, NamedTuple

from ins_align.ahead import run_ahead
from ins_align.alignment import Alignment
from ins_align.checks import InputChecks
from ins_align.config import Config
from ins_align.geometry.rotation import (
    Array, exp_so3, log_so3, matrix_from_quaternion, roll_pitch_yaw)
from ins_align.gnss.buffer import fault_of_fix
from ins_align.gnss.messages import Fix
from ins_align.intake import Intake, Step
from ins_align.mounting import base_attitude
from ins_align.recordings.decode import Attitudes, Refused
from ins_align.recordings.reader import Part, read, Request, Topics
from ins_align.results import Attitude, Epoch, State, Status
import numpy as np

MAX_REFERENCE_GAP_NS = 1_500_000_000  # the reference is not interpolated over more
# What is prepared at one go, at least: up to some thousands, many cost less each than few.
PREPARED_MESSAGES = 2500

_ATTITUDE_COLUMNS = 'qx,qy,qz,qw,sigma_e_deg,sigma_n_deg,sigma_u_deg'
CSV_HEADER = 'stamp_ns,t_s,state,' + ','.join(
    prefix + name for prefix in ('', 'current_') for name in _ATTITUDE_COLUMNS.split(','))


class Reference:
    """
    The attitude that a recording carries to compare with.

    Parameters
    ----------
    *parts : Attitudes
        As for `add`.

    """

    def __init__(self, *parts: Attitudes) -> None:
        self._stamps_ns, self._quaternions = np.zeros(0, np.int64), np.zeros((0, 4))
        self._added = list(parts)

    def add(self, attitudes: Attitudes) -> None:
        """Add more, of whatever stamps."""
        self._added.append(attitudes)

    def _sort(self) -> None:
        """Put what was added in the order of stamps; of one stamp the first counts."""
        columns = zip((self._stamps_ns, self._quaternions), *self._added)
        self._added = []
        stamps, quaternions = map(np.concatenate, columns)
        self._stamps_ns, first = np.unique(stamps, return_index=True)
        self._quaternions = quaternions[first]

    def attitude_at(self, stamp_ns: int) -> Array | None:
        """Return ``C_nb``, shape (3, 3), interpolated; None where there is none close by."""
        if self._added:
            self._sort()
        after = int(np.searchsorted(self._stamps_ns, stamp_ns))
        if after < len(self._stamps_ns) and self._stamps_ns[after] == stamp_ns:
            return matrix_from_quaternion(self._quaternions[after])
        if not 0 < after < len(self._stamps_ns):
            return None
        start, end = (int(stamp) for stamp in self._stamps_ns[after - 1:after + 1])
        if end - start > MAX_REFERENCE_GAP_NS:
            return None
        C_before, C_after = matrix_from_quaternion(self._quaternions[after - 1:after + 1])
        return exp_so3((stamp_ns - start) / (end - start) * log_so3(C_after @ C_before.T)) \
            @ C_before

    def errors_deg(self, attitude: Attitude) -> tuple[Array, Array] | None:
        """
        Compare an attitude with the reference.

        Returns
        -------
        rotation_deg : ndarray, shape (3,)
            Small rotation about east, north, up that takes the attitude to the reference.
        rpy_deg : ndarray, shape (3,)
            Differences of roll, pitch, yaw, attitude less reference.

        """
        C_reference = self.attitude_at(attitude.stamp_ns)
        if C_reference is None:
            return None
        C_nb = matrix_from_quaternion(attitude.quaternion_xyzw)
        difference = roll_pitch_yaw(C_nb) - roll_pitch_yaw(C_reference)
        return (np.degrees(log_so3(C_reference @ C_nb.T)),
                np.degrees(np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi))


@dataclass(frozen=True)
class ReplayResult:
    """What came of a recording."""

    bag: str
    status: Status
    epochs: tuple[Epoch, ...]  # those without GNSS, too
    warnings: tuple[str, ...]
    reference: Reference | None
    topics: Topics
    track: Array  # (K, 3) of usable fixes: stamp, ns since the first; latitude, longitude, degrees
    first_fix_ns: int
    config: Config

    @property
    def aligned(self) -> bool:
        """Whether the recording ends with a declared alignment."""
        return self.status.state is State.ALIGNED

    @property
    def declared(self) -> Attitude | None:
        """Return the initial attitude as the node publishes it at the last declaration."""
        declared, before = None, None
        for epoch in self.epochs:
            if epoch.state is State.ALIGNED and before is not State.ALIGNED:
                declared = epoch.initial
            before = epoch.state
        return declared

    @property
    def first_t0_ns(self) -> int | None:
        """Return the stamp from which `Epoch.t_s` is counted; None: there is no epoch."""
        if not self.epochs:
            return None
        return self.epochs[0].stamp_ns - round(self.epochs[0].t_s * 1e9)

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``--json`` writes; numbers that are not finite are None."""
        status = self.status
        final = _attitude_json(status.current)
        if final is not None and status.current is not None:
            final = {'stamp': status.current.stamp_ns, **final}
        return {
            'bag': self.bag,
            'aligned': self.aligned,
            'state': status.state.value,
            'reason': status.reason,
            't0': status.t0_ns,
            'time_to_align_s': status.time_to_align_s,
            'initial_attitude': _attitude_json(status.initial),
            'final_attitude': final,
            'gyro_bias_rad_s': _finite(status.gyro_bias),
            'accel_bias_m_s2': _finite(status.accel_bias),
            'lever_arm_m': _finite(status.lever_arm),
            'gnss_delay_s': _finite([status.gnss_delay])[0],
            'counts': dict(status.counts),
            **self._base_json(),
        }

    def _base_json(self) -> dict[str, Any]:
        """Return the attitudes of the base, where one is configured."""
        if not self.config.base_frame:
            return {}
        attitudes = {f'base_{name}_attitude': _attitude_json(
            base_attitude(attitude, self.topics.C_imu_base)) for name, attitude in (
                ('initial', self.status.initial), ('final', self.status.current))}
        return {'base_frame': self.config.base_frame, **attitudes}

    def to_csv(self) -> str:
        """Return the table that ``--csv`` writes, a row per GNSS epoch."""
        out = io.StringIO()
        out.write(CSV_HEADER + '\n')
        for epoch in self.epochs:
            if epoch.dry:
                continue
            cells = [str(epoch.stamp_ns), f'{epoch.t_s:.9f}', epoch.state.value]
            for attitude in (epoch.initial, epoch.current):
                numbers = [math.nan] * 7 if attitude is None else [
                    *attitude.quaternion_xyzw.tolist(), *attitude.sigma_deg.tolist()]
                cells += [repr(number) if math.isfinite(number) else '' for number in numbers]
            out.write(','.join(cells) + '\n')
        return out.getvalue()


def replay(path: str | os.PathLike[str], config: Config | None = None, *,
           imu_topic: str | None = None, fix_topic: str | None = None,
           velocity_topic: str | None = None,
           start: float | None = None, duration: float | None = None,
           progress: Callable[[float], None] | None = None,
           read_ahead: bool = False) -> ReplayResult:
    """
    Align a recording.

    Parameters
    ----------
    path : path
        rosbag2 directory or file, ROS 1 bag.
    config : Config, optional
        By default all parameters at their defaults.
    imu_topic, fix_topic, velocity_topic : str, optional
        Where there is more than one candidate.
    start, duration : float, optional
        Part of the recording, seconds from its start, by recorded time.
    progress : callable, optional
        Called with how much has been read, 0 to 1.
    read_ahead : bool
        Let another process read and prepare: the same result in less time.

    Returns
    -------
    ReplayResult

    Raises
    ------
    BagError
        If the recording cannot be read, lacks a topic, or has no messages in the part asked for.
    ProcessDied
        If the other process is killed.

    """
    request = Request(path, config or Config(), imu_topic, fix_topic, velocity_topic, start,
                      duration)
    run: _Run | None = None
    for part in run_ahead(_prepared, request) if read_ahead else _prepared(request):
        run = run or _Run(str(path), part.config, part.topics)
        run.feed(part)
        if progress is not None:
            progress(part.done)
    assert run is not None
    return run.result(part)


class _Prepared(NamedTuple):
    """What an alignment takes of consecutive messages of a recording."""

    topics: Topics
    config: Config
    steps: list[Step]
    fixes: list[tuple[int, float, float]]  # stamp, latitude, longitude, degrees
    attitudes: Attitudes  # of the reference
    counts: Counter[str]  # of all messages so far
    done: float  # how much of the recording this ends at, 0 to 1
    warnings: tuple[str, ...]  # so far
    faults: tuple[str, ...] = ()  # of the messages, in sentences; of the last part


def _prepared(request: Request) -> Generator[_Prepared, None, None]:
    """Read a recording and prepare it; the last part has all counts and warnings."""
    intake: Intake | None = None
    checks = InputChecks(request.config)
    waiting = 0
    for part in read(request):
        intake = intake or Intake(part.config)
        _feed(intake, part)
        checks.add(part.imu.stamps_ns, part.imu.gyro, part.imu.accel, [
            (before, message) for before, message in part.gnss
            if not isinstance(message, Refused)])
        waiting += len(part.imu.stamps_ns) + len(part.gnss)
        fixes = [(message.stamp_ns, message.latitude_deg, message.longitude_deg)
                 for _, message in part.gnss
                 if isinstance(message, Fix) and not fault_of_fix(message)]
        if waiting >= PREPARED_MESSAGES:
            intake.prepare()
            waiting = 0
        prepared = _Prepared(part.topics, part.config, intake.take_steps(), fixes,
                             part.orientations.known(), Counter(intake.counts), part.done,
                             part.warnings)
        yield prepared
    assert intake is not None
    intake.prepare(last=True)
    # Of the last part, which has no messages.
    yield prepared._replace(steps=intake.take_steps(), counts=Counter(intake.counts),
                            faults=tuple(checks.faults()))


def _feed(intake: Intake, part: Part) -> None:
    """Give an intake the messages in the order in which they were recorded."""
    imu = part.imu
    for _ in range(np.count_nonzero(~imu.decoded)):
        intake.reject('imu_undecodable')
    position = 0
    for before, message in (*part.gnss, (len(imu.stamps_ns), None)):
        if before > position:
            between = slice(position, before)
            intake.add_imu_array(imu.stamps_ns[between], imu.gyro[between], imu.accel[between])
            position = before
        if isinstance(message, Refused):
            intake.reject(*message)
        elif isinstance(message, Fix):
            intake.add_fix(message)
        elif message is not None:
            intake.add_velocity(message)


class _Run:
    """One pass over a recording."""

    def __init__(self, path: str, config: Config, topics: Topics) -> None:
        self._path, self._config, self._topics = path, config, topics
        self._alignment = Alignment(config)
        self._epochs: list[Epoch] = []
        self._reference: Reference | None = None
        self._fixes: list[tuple[int, float, float]] = []

    def feed(self, part: _Prepared) -> None:
        """Align with a part."""
        for step in part.steps:
            self._epochs += self._alignment.go(step)
        self._fixes += part.fixes
        if part.attitudes.stamps_ns.size:
            self._reference = self._reference or Reference()
            self._reference.add(part.attitudes)

    def result(self, last: _Prepared) -> ReplayResult:
        """Return what came of all parts."""
        first_fix_ns = self._fixes[0][0] if self._fixes else 0
        track = np.array([(stamp - first_fix_ns, latitude, longitude)
                          for stamp, latitude, longitude in self._fixes]).reshape(-1, 3)
        status = self._alignment.status(last.counts)
        if status.state is not State.ALIGNED and last.faults:
            status = dataclasses.replace(
                status, reason='; '.join([status.reason, *last.faults]))
        return ReplayResult(self._path, status, tuple(self._epochs), last.warnings,
                            self._reference, self._topics, track, first_fix_ns, self._config)


def _attitude_json(attitude: Attitude | None) -> dict[str, Any] | None:
    if attitude is None:
        return None
    roll, pitch, yaw = _finite([attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg])
    return {'quaternion_xyzw': _finite(attitude.quaternion_xyzw), 'roll_deg': roll,
            'pitch_deg': pitch, 'yaw_deg': yaw, 'sigma_deg': _finite(attitude.sigma_deg)}


def _finite(values: Iterable[float]) -> list[float | None]:
    """Return plain numbers as JSON has them: none that are not finite."""
    return [float(value) if math.isfinite(value) else None for value in values]
