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
"""Replay: one recording through one aligner, with results as JSON, CSV and arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
import dataclasses
from dataclasses import dataclass
import io
import itertools
import math
import os
from typing import Any

from ins_align.aligner import Aligner
from ins_align.bag_files import BagError, Topic
from ins_align.bags import Bag, Block, Topics
from ins_align.config import Config
from ins_align.declaration import State
from ins_align.decoding import decode_imu, decode_orientations, deserialize, Orientations
from ins_align.messages import fix_from_msg, MessageError, velocity_from_msg
from ins_align.results import Attitude, Epoch, Status
from ins_align.rotation import (
    Array, exp_so3, log_so3, matrix_from_quaternion, roll_pitch_yaw)
import numpy as np

MAX_REFERENCE_GAP_NS = 1_500_000_000  # the reference is not interpolated over more

_ATTITUDE_COLUMNS = 'qx,qy,qz,qw,sigma_e_deg,sigma_n_deg,sigma_u_deg'
CSV_HEADER = 'stamp_ns,t_s,state,' + ','.join(
    prefix + name for prefix in ('', 'current_') for name in _ATTITUDE_COLUMNS.split(','))


class Reference:
    """
    The attitude that a recording carries to compare with.

    Parameters
    ----------
    orientations : Orientations
        Those with a negative variance ("not known") or without a direction are left out.

    """

    def __init__(self, orientations: Orientations) -> None:
        good = (np.isfinite(orientations.quaternions).all(axis=1)
                & (np.abs(orientations.quaternions).max(axis=1, initial=0.0) > 1e-3)
                & ~(orientations.covariances[:, 0] < 0.0))
        stamps, first = np.unique(orientations.stamps_ns[good], return_index=True)
        self._stamps_ns = stamps
        self._quaternions = orientations.quaternions[good][first]

    def attitude_at(self, stamp_ns: int) -> Array | None:
        """Return ``C_nb``, shape (3, 3), interpolated; None where there is none close by."""
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
    epochs: tuple[Epoch, ...]
    warnings: tuple[str, ...]
    reference: Reference | None
    topics: Topics
    track: Array  # (K, 3) of every fix: stamp, ns since the first; latitude, longitude, degrees
    first_fix_ns: int
    config: Config

    @property
    def aligned(self) -> bool:
        """Whether the recording ends with a declared alignment."""
        return self.status.state is State.ALIGNED

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
        }

    def to_csv(self) -> str:
        """Return the table that ``--csv`` writes, a row per GNSS epoch."""
        out = io.StringIO()
        out.write(CSV_HEADER + '\n')
        for epoch in self.epochs:
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
           progress: Callable[[float], None] | None = None) -> ReplayResult:
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

    Returns
    -------
    ReplayResult

    Raises
    ------
    BagError
        If the recording cannot be read or lacks a topic.

    """
    with Bag(path) as bag:
        try:
            topics = bag.choose_topics(config or Config(), imu_topic, fix_topic, velocity_topic)
        except BagError as error:
            reasons = f' ({bag.warnings[0]})' if bag.warnings else ''
            raise BagError(f'{error}{reasons}') from None
        config = config or Config()
        if topics.velocity_type is not None:
            config = dataclasses.replace(config, velocity_type=topics.velocity_type)
        run = _Run(Aligner(config), config, topics)
        try:
            for block, done in _blocks(bag, run.read, start, duration):
                run.feed(block)
                if progress is not None:
                    progress(done)
        except OSError as error:
            raise BagError(f'{path} cannot be read: {error.strerror}') from None
        return run.result(str(path), bag.warnings)


def _blocks(bag: Bag, topics: Sequence[Topic], start: float | None, duration: float | None,
            ) -> Iterator[tuple[Block, float]]:
    """Yield messages many at a time, and how much of the recording they end at."""
    first = bag.start_ns or 0
    start_ns = first + round((start or 0.0) * 1e9)
    stop_ns = None if duration is None else start_ns + round(duration * 1e9)
    end = bag.end_ns or start_ns
    if stop_ns is not None:
        end = min(end, stop_ns)
    for block in bag.blocks(topics, start_ns, stop_ns):
        done = (block.times_ns[-1] - start_ns) / (end - start_ns) if end > start_ns else 1.0
        yield block, min(max(done, 0.0), 1.0)


class _Run:
    """One pass over a recording."""

    def __init__(self, aligner: Aligner, config: Config, topics: Topics) -> None:
        self._aligner = aligner
        self._config = config
        self._topics = topics
        self.read = tuple(topic for topic in (topics.imu, topics.fix, topics.velocity,
                                              topics.reference) if topic is not None)
        self._epochs: list[Epoch] = []
        self._references: list[Orientations] = []
        self._fixes: list[tuple[int, float, float]] = []

    def feed(self, block: Block) -> None:
        """Give a block of messages to the aligner, the IMU's decoded all at once."""
        topics = self._topics
        kinds = np.array([0 if topic is topics.imu else 1 if topic is topics.reference else 2
                          for topic in self.read])[np.array(block.topics)]
        imu_messages = list(itertools.compress(block.messages, (kinds == 0).tolist()))
        samples = decode_imu(imu_messages, topics.imu)
        if not samples.decoded.all():
            for _ in range(np.count_nonzero(~samples.decoded)):
                self._aligner.reject('imu_undecodable')
        # For each message of the block: how many usable IMU samples come before it.
        before = np.zeros(len(kinds), np.int64)
        before[kinds == 0] = samples.decoded
        before = np.cumsum(before)
        position = 0
        for index in np.flatnonzero(kinds == 2).tolist():
            end = int(before[index])
            self._add_imu(samples, position, end)
            position = end
            if self.read[block.topics[index]] is topics.fix:
                self._add_fix(block.messages[index])
            else:
                self._add_velocity(block.messages[index])
        self._add_imu(samples, position, len(samples.stamps_ns))
        self._epochs += self._aligner.update()
        if topics.reference is not None and (kinds == 1).any():
            self._references.append(decode_orientations(
                list(itertools.compress(block.messages, (kinds == 1).tolist())),
                topics.reference))

    def result(self, bag: str, warnings: list[str]) -> ReplayResult:
        """Return what came of all blocks."""
        self._epochs += self._aligner.flush()
        reference = None
        if self._references:
            reference = Reference(Orientations(
                *(np.concatenate(columns) for columns in zip(*self._references))))
        first_fix_ns = self._fixes[0][0] if self._fixes else 0
        track = np.array([(stamp - first_fix_ns, latitude, longitude)
                          for stamp, latitude, longitude in self._fixes]).reshape(-1, 3)
        return ReplayResult(bag, self._aligner.status(), tuple(self._epochs), tuple(warnings),
                            reference, self._topics, track, first_fix_ns, self._config)

    def _add_imu(self, samples: Any, start: int, end: int) -> None:
        if end > start:
            self._aligner.add_imu(samples.stamps_ns[start:end], samples.gyro[start:end],
                                  samples.accel[start:end])

    def _add_fix(self, data: bytes) -> None:
        try:
            fix = fix_from_msg(deserialize(data, self._topics.fix))
        except MessageError:
            self._aligner.reject('fix_undecodable')
            return
        self._fixes.append((fix.stamp_ns, fix.latitude_deg, fix.longitude_deg))
        self._aligner.add_fix(fix)

    def _add_velocity(self, data: bytes) -> None:
        assert self._topics.velocity is not None
        try:
            message = deserialize(data, self._topics.velocity)
        except MessageError:
            self._aligner.reject('velocity_undecodable')
            return
        try:
            self._aligner.add_velocity(velocity_from_msg(message, self._config))
        except MessageError:
            self._aligner.reject('velocity_body_frame')


def _attitude_json(attitude: Attitude | None) -> dict[str, Any] | None:
    if attitude is None:
        return None
    roll, pitch, yaw = _finite([attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg])
    return {'quaternion_xyzw': _finite(attitude.quaternion_xyzw), 'roll_deg': roll,
            'pitch_deg': pitch, 'yaw_deg': yaw, 'sigma_deg': _finite(attitude.sigma_deg)}


def _finite(values: Iterable[float]) -> list[float | None]:
    """Return plain numbers as JSON has them: none that are not finite."""
    return [float(value) if math.isfinite(value) else None for value in values]
