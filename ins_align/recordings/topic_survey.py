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
"""The topics of a recording that an alignment could read: all their messages, and their timing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.geometry.rotation import Array
from ins_align.gnss.drivers import INERTIAL_UNITS, RECEIVERS
from ins_align.gnss.messages import (
    fault_of_fix, Fix, MessageError, usable_velocity, Velocity, with_an_altitude)
from ins_align.gnss.motion import Series, series_of
from ins_align.imu.buffer import MAX_ACCELERATION, MAX_RATE
from ins_align.recordings import Topic
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import (
    decode_by_kind, decode_gnss, decode_imu_topic, deserialize, GNSS_TYPES, IMU_TYPE, Refused)
from ins_align.recordings.reader import may_be_velocity, REFERENCE_NAMESPACE
import numpy as np

KINDS = ('imu', 'fix', 'velocity')
MAX_ASTRAY = 60.0  # s: a stamp further off the recorded time than the others is not used
GAP_INTERVALS = 3.5  # times the usual interval without a message is a gap


class Gap(NamedTuple):
    """Time without messages, seconds."""

    start_s: float  # of the recording
    duration_s: float


@dataclass(frozen=True)
class Timing:
    """When the messages of a topic came; seconds of the recording."""

    count: int
    undecodable: int
    rate_hz: float | None = None
    first_s: float | None = None  # recorded
    last_s: float | None = None
    stamp_age_s: float | None = None  # recorded time less the header's stamp, median
    stamp_age_spread_s: float | None = None  # 98 percent of the ages lie within this
    astray: int = 0  # stamps more than MAX_ASTRAY off the usual age
    out_of_order: int = 0  # stamps that are not later than the one before
    gaps: int = 0
    longest_gap: Gap | None = None


class Recorded:
    """
    All messages of a topic, in recorded order.

    Attributes
    ----------
    kind : str
        One of KINDS.
    recorded_ns, stamps_ns : ndarray of int, shape (N,)
    values : ndarray, shape (N, 6) or (N, 3)
        Rate and specific force; latitude, longitude, degrees, and altitude, m; or velocity as if
        it were ENU, m/s.
    sigmas : ndarray, shape (N, 2)
        Stated, horizontal and vertical; NaN: none.
    usable : ndarray of bool, shape (N,)
        Finite, with a stamp near the others and, of fixes, with a fix.
    refused : str
        Why most velocities are refused for their frame_id, in words; empty: they are not.
    unmeasured : str
        That an IMU says that it does not measure what is needed, in words.

    """

    def __init__(self, topic: Topic, kind: str, bag_start_ns: int) -> None:
        self.topic, self.kind, self._start_ns = topic, kind, bag_start_ns
        self.recorded_ns = self.stamps_ns = np.zeros(0, np.int64)
        self.values: Array = np.zeros((0, 6 if kind == 'imu' else 3))
        self.sigmas: Array = np.zeros((0, 2))
        self.usable = np.zeros(0, bool)
        self.no_fix = self.undecodable = 0
        self.refused = self.unmeasured = self.undecodable_why = ''
        self._refusals: list[str] = []
        self._rows: list[tuple[Any, ...]] = []

    def add(self, times_ns: np.ndarray, messages: Sequence[bytes]) -> None:
        """Decode messages."""
        if self.kind == 'imu':
            if not self._rows and self.topic.msgtype == IMU_TYPE:
                self._look_at(messages[0])
            samples = decode_imu_topic(messages, self.topic)
            self.undecodable += int(np.count_nonzero(~samples.decoded))
            self._rows.append((times_ns[samples.decoded], samples.stamps_ns,
                               np.hstack([samples.gyro, samples.accel])))
            return
        decoded = decode_by_kind(messages, self.topic, Config())[self.kind]
        refusals = [message.why for message in decoded
                    if isinstance(message, Refused) and message.why]
        if refusals and self.topic.msgtype in RECEIVERS:
            self.undecodable_why = refusals[0]
        elif refusals:  # for their frame_id, which may be wrong: the motion will tell
            self._refusals += refusals
            decoded = decode_gnss(messages, self.topic, Config(velocity_frame='enu'))
        for time_ns, message in zip(times_ns.tolist(), decoded):
            if isinstance(message, Refused):
                self.undecodable += 1
            else:
                self._add_gnss(time_ns, message)

    def finish(self) -> None:
        """Turn what has been added into arrays."""
        rows, self._rows = self._rows, []
        if not rows:
            return
        if self.kind == 'imu':
            self.recorded_ns, self.stamps_ns, self.values = map(np.concatenate, zip(*rows))
            limits = np.repeat([MAX_RATE, MAX_ACCELERATION], 3)
            self.usable = np.asarray(np.all(np.abs(self.values) < limits, axis=1))
        else:
            self.recorded_ns, self.stamps_ns, self.values, self.sigmas, self.usable = map(
                np.array, zip(*rows))
        self.usable &= ~self._astray()
        if len(self._refusals) > 0.5 * self.stamps_ns.size:
            self.refused = self._refusals[0]

    @property
    def age_ns(self) -> int:
        """Median of recorded time less stamp: one of the ages, no mean of two clocks."""
        ages = self.recorded_ns - self.stamps_ns
        return int(np.partition(ages, ages.size // 2)[ages.size // 2]) if ages.size else 0

    def times(self) -> Array:
        """
        Return the usable stamps as seconds of the recording, shape (M,).

        They are moved by the median age of the messages: clocks that differ do not matter.
        """
        return (self.stamps_ns[self.usable] - self._start_ns + self.age_ns).astype(float) * 1e-9

    def series(self) -> Series:
        """Return the usable values over increasing time; of one stamp the first counts."""
        return series_of(self.times(), self.values[self.usable])

    def timing(self) -> Timing:
        """Return when messages came."""
        count = self.stamps_ns.size + self.undecodable
        if not self.stamps_ns.size:
            return Timing(count, self.undecodable)
        ages = (self.recorded_ns - self.stamps_ns) * 1e-9
        astray = self._astray()
        in_order = self.stamps_ns[~astray]
        intervals = np.diff(np.unique(in_order)) * 1e-9
        usual = float(np.median(intervals)) if intervals.size else math.inf
        gaps = np.flatnonzero(intervals > GAP_INTERVALS * usual)
        longest = None
        if gaps.size:
            place = gaps[np.argmax(intervals[gaps])]
            start_ns = int(np.unique(in_order)[place]) - self._start_ns + self.age_ns
            longest = Gap(start_ns * 1e-9, float(intervals[place]))
        first, last = ((self.recorded_ns[[0, -1]] - self._start_ns) * 1e-9).tolist()
        return Timing(
            count, self.undecodable, 1.0 / usual or None, first, last, float(np.median(ages)),
            float(np.ptp(np.quantile(ages[~astray], (0.01, 0.99)))),
            int(np.count_nonzero(astray)), int(np.count_nonzero(np.diff(in_order) <= 0)),
            gaps.size, longest)

    def _astray(self) -> np.ndarray:
        """Return which stamps are of another time than the others."""
        ages = self.recorded_ns - self.stamps_ns
        return np.asarray(np.abs(ages - self.age_ns) > MAX_ASTRAY * 1e9)

    def _look_at(self, data: bytes) -> None:
        """See whether an IMU says that it does not measure what is needed."""
        try:
            message = deserialize(data, self.topic)
        except MessageError:
            return
        what = [what for what, covariance in (
            ('angular rate', message.angular_velocity_covariance),
            ('specific force', message.linear_acceleration_covariance)) if covariance[0] == -1.0]
        if what:
            self.unmeasured = (f'its messages say that it does not measure {" and ".join(what)} '
                               '(covariance -1)')

    def _add_gnss(self, time_ns: int, message: Fix | Velocity) -> None:
        if isinstance(message, Fix):
            message = with_an_altitude(message)
            values = [message.latitude_deg, message.longitude_deg, message.altitude_m]
            fault = fault_of_fix(message)
            usable = not fault
            self.no_fix += fault == 'no_fix'
        else:
            velocity = usable_velocity(message)
            usable = velocity is not None
            values = (velocity or message).velocity.tolist()
        covariance = message.covariance
        sigmas = (math.nan, math.nan) if covariance is None else (
            math.sqrt((covariance[0, 0] + covariance[1, 1]) / 2.0), math.sqrt(covariance[2, 2]))
        self._rows.append((time_ns, message.stamp_ns, values, sigmas, usable))


def read_candidates(bag: Bag) -> list[Recorded]:
    """
    Read every topic that an alignment could read, sorted by kind and name.

    Raises
    ------
    BagError
        If the recording cannot be read.

    """
    candidates = sorted((Recorded(topic, kind, bag.start_ns or 0) for topic in bag.topics
                         for kind in _kinds(topic) if REFERENCE_NAMESPACE not in topic.name),
                        key=lambda data: (KINDS.index(data.kind), data.topic.name))
    topics = list(dict.fromkeys(data.topic for data in candidates))
    for block in bag.blocks(topics):
        for data in candidates:
            number = topics.index(data.topic)
            if messages := block.messages[number]:
                data.add(block.times_ns[block.topics == number], messages)
    for data in candidates:
        data.finish()
    return candidates


def _kinds(topic: Topic) -> Sequence[str]:
    """Return what an alignment could read of a topic: some of KINDS."""
    if topic.msgtype == IMU_TYPE or topic.msgtype in INERTIAL_UNITS:
        return ['imu']
    if topic.msgtype in RECEIVERS:
        return ['fix', 'velocity']
    if topic.msgtype not in GNSS_TYPES or not may_be_velocity(topic):
        return []
    return [GNSS_TYPES[topic.msgtype].kind]
