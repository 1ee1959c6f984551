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
from contextlib import suppress
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.geometry.rotation import Array
from ins_align.gnss.drivers import type_in_words
from ins_align.gnss.messages import MessageError, numbers_of
from ins_align.gnss.motion import Series, series_of, VelocityFrame
from ins_align.imu.buffer import MAX_ACCELERATION, MAX_RATE
from ins_align.recordings import Topic
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import (
    decode_gnss, decode_imu, deserialize, Gnss, IMU_TYPE, ImuSamples, KINDS, Refused, unmeasured,
    VELOCITY_TYPES)
from ins_align.recordings.imu_survey import ImuFacts
from ins_align.recordings.reader import is_command, may_be_velocity, REFERENCE_NAMESPACE
import numpy as np

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


@dataclass
class TopicInfo:
    """A topic that an alignment could read."""

    name: str
    msgtype: str
    kind: str  # imu, fix or velocity
    timing: Timing = Timing(0, 0)
    faults: tuple[str, ...] = ()  # each makes the topic useless as it is
    usable_share: float = 0.0  # of the messages: finite and, of fixes, with a fix
    no_fix_share: float | None = None  # of fixes
    covariance_share: float | None = None  # of GNSS messages that state a covariance
    sigma: tuple[float, float] | None = None  # stated, horizontal and vertical, median
    frame: VelocityFrame | None = None  # of velocities
    vertical_absent: bool = False  # of velocities: the vertical one is always 0
    imu: ImuFacts | None = None


class Recorded(TopicInfo):
    """
    A topic with all its messages, in recorded order.

    Attributes
    ----------
    recorded_ns, stamps_ns : ndarray of int, shape (N,)
    values : ndarray, shape (N, 6) or (N, 3)
        Rate and specific force; latitude, longitude, degrees, and altitude, m; or velocity as if
        it were ENU, m/s.
    usable : ndarray of bool, shape (N,)
        Finite, with a stamp near the others and, of fixes, with a fix.
    refused : str
        Why velocities are refused for their frame_id, in words; empty: they are not.
    unmeasured : str
        That an IMU says that it does not measure what is needed, in words.

    """

    def __init__(self, topic: Topic, kind: str, bag_start_ns: int) -> None:
        super().__init__(topic.name, type_in_words(topic.msgtype), kind)
        self.topic, self._start_ns, self._age_ns = topic, bag_start_ns, 0
        self.recorded_ns = self.stamps_ns = np.zeros(0, np.int64)
        self.values: Array = np.zeros((0, 6 if kind == 'imu' else 3))
        self.usable = np.zeros(0, bool)
        self.refused = self.unmeasured = self._why = ''
        self._undecodable = self._without_fix = 0
        self._sigmas: list[tuple[float, float]] = []  # of messages that state a covariance
        self._parts: list[tuple[Any, ...]] = []  # recorded_ns, stamps_ns, values, usable
        if kind == 'velocity' and is_command(topic):
            self.faults = ('its name is that of a command, not of a measurement',)

    def add(self, times_ns: np.ndarray, first: bytes, decoded: ImuSamples | Sequence[Gnss],
            ) -> None:
        """Take consecutive messages, decoded, of which the first one is given as it was."""
        if not self._parts:
            self._look_at(first)
        if isinstance(decoded, ImuSamples):
            stamps_ns, gyro, accel, good = decoded
            usable = ((np.abs(gyro) < MAX_RATE) & (np.abs(accel) < MAX_ACCELERATION)).all(axis=1)
            self._undecodable += int(np.count_nonzero(~good))
            self._parts.append((times_ns[good], stamps_ns, np.hstack([gyro, accel]), usable))
            return
        rows = []
        for time_ns, message in zip(times_ns.tolist(), decoded):
            if isinstance(message, Refused):
                self._undecodable += 1
                self._why = self._why or message.why
                continue
            values, fault = numbers_of(message)
            self._without_fix += fault == 'no_fix'
            rows.append((time_ns, message.stamp_ns, values, not fault))
            if (covariance := message.covariance) is not None:
                self._sigmas.append((math.sqrt((covariance[0, 0] + covariance[1, 1]) / 2.0),
                                     math.sqrt(covariance[2, 2])))
        if rows:
            self._parts.append(tuple(map(np.array, zip(*rows))))

    def _look_at(self, data: bytes) -> None:
        """See what a message says that it does not measure, or in what frame it is."""
        if self.topic.msgtype in VELOCITY_TYPES:
            message, = decode_gnss([data], self.topic, Config())['velocity']
            self.refused = message.why if isinstance(message, Refused) else ''
        if self.topic.msgtype == IMU_TYPE:
            with suppress(MessageError):
                what = ' and '.join(unmeasured(deserialize(data, self.topic)))
                self.unmeasured = what and (f'its messages say that it does not measure {what} '
                                            '(covariance -1)')

    def finish(self) -> None:
        """Put together what has been added, and say what it tells of itself."""
        if self._parts:
            self.recorded_ns, self.stamps_ns, self.values, self.usable = map(
                np.concatenate, zip(*self._parts))
            self._parts = []
        count = self.stamps_ns.size
        if not count:
            self.timing = Timing(self._undecodable, self._undecodable)
            self.faults += (self._why or 'its messages cannot be decoded' if self._undecodable
                            else 'it has no messages',)
            return
        ages_ns = self.recorded_ns - self.stamps_ns
        # The median: one of the ages, no mean of two clocks.
        self._age_ns = int(np.sort(ages_ns)[count // 2])
        astray = np.abs(ages_ns - self._age_ns) > MAX_ASTRAY * 1e9
        self.timing = self._timing(ages_ns * 1e-9, astray)
        self.usable &= ~astray
        self.usable_share = float(np.mean(self.usable))
        if self.kind == 'fix':
            self.no_fix_share = self._without_fix / count
        if self.kind != 'imu':
            self.covariance_share = len(self._sigmas) / count
        if self._sigmas:
            horizontal, vertical = np.median(self._sigmas, axis=0).tolist()
            self.sigma = horizontal, vertical

    @property
    def age_s(self) -> float:
        """Usual recorded time less stamp; 0 where there is no message."""
        return self.timing.stamp_age_s or 0.0

    def series(self) -> Series:
        """
        Return the usable values over increasing seconds of the recording.

        Stamps are moved by the median age of the messages: clocks that differ do not matter. Of
        one stamp the first counts.
        """
        times_ns = self.stamps_ns[self.usable] - self._start_ns + self._age_ns
        return series_of(times_ns.astype(float) * 1e-9, self.values[self.usable])

    def _timing(self, ages: Array, astray: np.ndarray) -> Timing:
        """Return when messages came, whose ages are given in seconds."""
        in_order = self.stamps_ns[~astray]
        stamps_ns = np.unique(in_order)
        intervals = np.diff(stamps_ns) * 1e-9
        usual = float(np.median(intervals)) if intervals.size else math.inf
        gaps = np.flatnonzero(intervals > GAP_INTERVALS * usual)
        longest = None
        if gaps.size:
            place = gaps[np.argmax(intervals[gaps])]
            start_ns = int(stamps_ns[place]) - self._start_ns + self._age_ns
            longest = Gap(start_ns * 1e-9, float(intervals[place]))
        first, last = ((self.recorded_ns[[0, -1]] - self._start_ns) * 1e-9).tolist()
        return Timing(
            ages.size + self._undecodable, self._undecodable, 1.0 / usual or None, first, last,
            float(np.median(ages)), float(np.ptp(np.quantile(ages[~astray], (0.01, 0.99)))),
            int(np.count_nonzero(astray)), int(np.count_nonzero(np.diff(in_order) <= 0)),
            gaps.size, longest)


def read_candidates(bag: Bag) -> list[Recorded]:
    """Read every topic that an alignment could read, sorted by name."""
    topics = sorted(topic for topic in bag.topics if topic.msgtype in KINDS
                    and may_be_velocity(topic) and REFERENCE_NAMESPACE not in topic.name)
    recorded = {topic: [Recorded(topic, kind, bag.start_ns or 0) for kind in KINDS[topic.msgtype]]
                for topic in topics}
    for block in bag.blocks(topics):
        for number, (topic, messages) in enumerate(zip(topics, block.messages)):
            if not messages:
                continue
            # Frames in their headers may be wrong: the motion will tell.
            decoded = ({'imu': decode_imu(messages, topic)} if KINDS[topic.msgtype] == ('imu',)
                       else decode_gnss(messages, topic, Config(velocity_frame='enu')))
            for data in recorded[topic]:
                data.add(block.times_ns[block.topics == number], messages[0], decoded[data.kind])
    candidates = [data for each in recorded.values() for data in each]
    for data in candidates:
        data.finish()
    return candidates
