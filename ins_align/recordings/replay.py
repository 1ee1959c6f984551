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
"""Replay: one recording, aligned and compared with the reference that it carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import os
from typing import Any

from ins_align.config import Config
from ins_align.geometry.rotation import (
    Array, exp_so3, log_so3, matrix_from_quaternion, roll_pitch_yaw)
from ins_align.gnss.messages import fault_of_fix, Fix
from ins_align.mounting import base_attitude
from ins_align.offline import OfflineAligner
from ins_align.processes import run_ahead
from ins_align.recordings.reader import read, Request, Topics
from ins_align.results import Attitude, attitude_json, Result
import numpy as np

MAX_REFERENCE_GAP_NS = 1_500_000_000  # the reference is not interpolated over more


class Reference:
    """
    The attitude that a recording carries to compare with.

    Parameters
    ----------
    *parts : tuple of ndarray
        Stamps, ns, and quaternions as from `Orientations.known`, at least one part, in any order;
        of one stamp the first counts.

    """

    def __init__(self, *parts: tuple[np.ndarray, np.ndarray]) -> None:
        stamps, quaternions = map(np.concatenate, zip(*parts))
        self._stamps_ns, first = np.unique(stamps, return_index=True)
        self._quaternions = quaternions[first]

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


@dataclass(frozen=True, kw_only=True)
class ReplayResult(Result):
    """
    What came of a recording.

    Attributes
    ----------
    bag : str
        Its path.
    warnings : tuple of str
    reference : Reference or None
    topics : Topics
    track : ndarray, shape (K, 3)
        Of usable fixes: stamp, ns since the first; latitude and longitude, degrees.
    first_fix_ns : int

    """

    bag: str
    warnings: tuple[str, ...]
    reference: Reference | None
    topics: Topics
    track: Array
    first_fix_ns: int

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``--json`` writes; numbers that are not finite are None."""
        return {'bag': self.bag, **super().to_json(), **self._base_json()}

    def _base_json(self) -> dict[str, Any]:
        """Return the attitudes of the base, where one is configured."""
        if not self.config.base_frame:
            return {}
        attitudes = {f'base_{name}_attitude': attitude_json(
            base_attitude(attitude, self.topics.base)) for name, attitude in (
                ('initial', self.status.initial), ('final', self.status.current))}
        return {'base_frame': self.config.base_frame, **attitudes}


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
        Let another process read: the same result in less time.

    Returns
    -------
    ReplayResult

    Raises
    ------
    BagError
        If the recording cannot be read, lacks a topic, or has no messages in the part asked for.
    BrokenProcessPool
        If the other process is killed.

    """
    request = Request(path, config or Config(), imu_topic, fix_topic, velocity_topic, start,
                      duration)
    run: OfflineAligner | None = None
    fixes: list[tuple[int, float, float]] = []
    orientations: list[tuple[np.ndarray, np.ndarray]] = []
    for part in run_ahead(read, request) if read_ahead else read(request):
        run = run or OfflineAligner(part.config, part.topics.base)
        run.reject('imu_undecodable', np.count_nonzero(~part.imu.decoded))
        run.add(part.imu.stamps_ns, part.imu.gyro, part.imu.accel, part.gnss)
        fixes += [(message.stamp_ns, message.latitude_deg, message.longitude_deg)
                  for _, message in part.gnss
                  if isinstance(message, Fix) and not fault_of_fix(message)]
        orientations.append(part.orientations.known())
        if progress is not None:
            progress(part.done)
    assert run is not None
    status, epochs = run.finish()
    first_fix_ns = fixes[0][0] if fixes else 0
    track = np.array([(stamp_ns - first_fix_ns, *place)
                      for stamp_ns, *place in fixes]).reshape(-1, 3)
    there = any(stamps_ns.size for stamps_ns, _ in orientations)
    return ReplayResult(
        config=part.config, status=status, epochs=epochs, bag=str(path), warnings=part.warnings,
        reference=Reference(*orientations) if there else None, topics=part.topics, track=track,
        first_fix_ns=first_fix_ns)
