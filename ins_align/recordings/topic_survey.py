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

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import math
from typing import Any

from ins_align.config import Config
from ins_align.geometry.rotation import Array
from ins_align.gnss.drivers import type_in_words
from ins_align.gnss.messages import MessageError, numbers_of
from ins_align.gnss.motion import Series, series_of
from ins_align.imu.buffer import MAX_ACCELERATION, MAX_RATE
from ins_align.recordings import Topic
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import (
    decode_gnss, decode_imu, deserialize, Gnss, IMU_TYPE, ImuSamples, KINDS, Refused, unmeasured,
    VELOCITY_TYPES)
from ins_align.recordings.reader import is_command, may_be_velocity, REFERENCE_NAMESPACE
import numpy as np

MAX_ASTRAY = 60.0  # s: a stamp further off the recorded time than the others is not used
GAP_INTERVALS = 3.5  # times the usual interval without a message is a gap


def rounded(value: float) -> float:
    """Return a value with two digits, as a parameter is set."""
    return float(f'{value:.2g}')


def in_words(settings: Mapping[str, Any]) -> list[str]:
    """Return parameters as ``--set`` takes them."""
    return [f'{name}={str(value).lower()}' for name, value in settings.items()]


@dataclass(kw_only=True)
class Surveyed:
    """What has been found out about a recording or a topic."""

    lines: list[str] = field(default_factory=list)  # sentences, which ``ins_align info`` prints
    # Numbers by name, in SI units where the name has no other.
    figures: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)  # parameters that an alignment needs
    faults: list[str] = field(default_factory=list)  # why it is useless as it is

    def add(self, text: str, settings: Mapping[str, Any] | None = None, *, fault: bool = False,
            **figures: Any) -> None:
        """Add a finding: a sentence ('': none), parameters that it sets, figures by name."""
        if fault:
            self.faults.append(text)
        elif text:
            sets = ', '.join(in_words(settings or {}))
            self.lines.append(text + (sets and f' (sets {sets})'))
        self.settings |= settings or {}
        self.figures |= figures


@dataclass(init=False)
class Recorded(Surveyed):
    """
    A topic that an alignment could read, with all its messages in recorded order.

    Figures of all are ``messages``, ``rate_hz``, ``first_s`` and ``last_s`` (recorded),
    ``stamp_age_s`` (recorded time less the header's stamp, median), ``stamp_age_spread_s`` (98
    percent of the ages lie within this), ``gaps``, ``longest_gap_s`` and ``longest_gap_start_s``;
    all but the first are missing where there is no message. Seconds are those of the recording.
    """

    name: str
    msgtype: str
    kind: str  # imu, fix or velocity

    def __init__(self, topic: Topic, kind: str, bag_start_ns: int) -> None:
        super().__init__()
        self.name, self.msgtype, self.kind = topic.name, type_in_words(topic.msgtype), kind
        self.topic, self._start_ns, self._age_ns = topic, bag_start_ns, 0
        self.recorded_ns = self.stamps_ns = np.zeros(0, np.int64)
        # (N, 6), rate and specific force; or (N, 3), latitude, longitude, degrees, and altitude,
        # m, or velocity as if it were ENU, m/s.
        self.values: Array = np.zeros((0, 6 if kind == 'imu' else 3))
        self.usable = np.zeros(0, bool)  # finite, with a stamp near the others and with a fix
        # In words: why velocities would be refused for their frame_id, or what an IMU says it does
        # not measure; why messages cannot be decoded.
        self.doubt = self._why = ''
        self._undecodable = self._without_fix = 0
        self._sigmas: list[tuple[float, float]] = []  # of messages that state a covariance
        self._parts: list[tuple[Any, ...]] = []  # recorded_ns, stamps_ns, values, usable
        if kind == 'velocity' and is_command(topic):
            self.add('its name is that of a command, not of a measurement', fault=True)

    def take(self, times_ns: np.ndarray, first: bytes, decoded: ImuSamples | Sequence[Gnss],
             ) -> None:
        """Take consecutive messages, decoded, of which the first one is given as it was."""
        if not self._parts:
            self._look_at(first)
        if isinstance(decoded, ImuSamples):
            gyro, accel, good = decoded.gyro, decoded.accel, decoded.decoded
            usable = ((np.abs(gyro) < MAX_RATE) & (np.abs(accel) < MAX_ACCELERATION)).all(axis=1)
            self._undecodable += int(np.count_nonzero(~good))
            self._parts.append((times_ns[good], decoded.stamps_ns, np.hstack([gyro, accel]),
                                usable))
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
            self.doubt = message.why if isinstance(message, Refused) else ''
        if self.topic.msgtype == IMU_TYPE:
            with suppress(MessageError):
                what = ' and '.join(unmeasured(deserialize(data, self.topic)))
                self.doubt = what and (f'its messages say that it does not measure {what} '
                                       '(covariance -1)')

    def finish(self) -> None:
        """Put together what has been taken, and say what it tells of itself."""
        if self._parts:
            self.recorded_ns, self.stamps_ns, self.values, self.usable = map(
                np.concatenate, zip(*self._parts))
            self._parts = []
        count = self.stamps_ns.size
        self.add('', messages=count + self._undecodable)
        if not count:
            self.add(self._why or 'its messages cannot be decoded' if self._undecodable
                     else 'it has no messages', fault=True)
            return
        ages_ns = self.recorded_ns - self.stamps_ns
        # The median: one of the ages, no mean of two clocks.
        self._age_ns = int(np.sort(ages_ns)[count // 2])
        astray = np.abs(ages_ns - self._age_ns) > MAX_ASTRAY * 1e9
        self.usable &= ~astray
        in_order = self.stamps_ns[~astray]
        self._add_timing(np.unique(in_order), ages_ns * 1e-9, astray)
        for name, number, text in (
                ('undecodable', self._undecodable, 'messages cannot be decoded'),
                ('astray', int(np.count_nonzero(astray)),
                 f'stamps are more than {MAX_ASTRAY:g} s off the others'),
                ('out_of_order', int(np.count_nonzero(np.diff(in_order) <= 0)),
                 'stamps are not later than the one before')):
            self.add(number and f'{number} {text}' or '', **{name: number})
        self.add('', usable_share=float(np.mean(self.usable)))
        if self.kind == 'fix':
            share = self._without_fix / count
            self.add(f'without a fix: {share:.1%}', no_fix_share=share)
        if self.kind != 'imu':
            self._add_sigma(len(self._sigmas) / count)

    def _add_sigma(self, share: float) -> None:
        """Say what sigma a share of the messages states."""
        if not self._sigmas:
            self.add('states no covariance', covariance_share=share)
            return
        sigma = np.median(self._sigmas, axis=0).tolist()
        horizontal, vertical = (f'{std:.2g} {"m" if self.kind == "fix" else "m/s"}'
                                for std in sigma)
        self.add(f'states sigmas of {horizontal} horizontally, {vertical} vertically'
                 + ('' if share == 1.0 else f' in {share:.0%} of the messages'),
                 covariance_share=share, sigma=sigma)

    @property
    def age_s(self) -> float:
        """Usual recorded time less stamp; 0 where there is no message."""
        return self._age_ns * 1e-9

    def series(self) -> Series:
        """
        Return the usable values over increasing seconds of the recording.

        Stamps are moved by the median age of the messages: clocks that differ do not matter. Of
        one stamp the first counts.
        """
        times_ns = self.stamps_ns[self.usable] - self._start_ns + self._age_ns
        return series_of(times_ns.astype(float) * 1e-9, self.values[self.usable])

    def _add_timing(self, stamps_ns: np.ndarray, ages: Array, astray: np.ndarray) -> None:
        """Add when messages came: stamps in order, and ages in seconds."""
        intervals = np.diff(stamps_ns) * 1e-9
        usual = float(np.median(intervals)) if intervals.size else math.inf
        gaps = int(np.count_nonzero(intervals > GAP_INTERVALS * usual))
        first, last = ((self.recorded_ns[[0, -1]] - self._start_ns) * 1e-9).tolist()
        self.add('', rate_hz=1.0 / usual or None, first_s=first, last_s=last,
                 stamp_age_s=self.age_s, gaps=gaps, stamp_age_spread_s=float(
                     np.ptp(np.quantile(ages[~astray], (0.01, 0.99)))))
        if gaps:
            place = int(np.argmax(intervals))
            start_ns = int(stamps_ns[place]) - self._start_ns + self._age_ns
            self.add('', longest_gap_s=float(intervals[place]),
                     longest_gap_start_s=start_ns * 1e-9)


def read_candidates(bag: Bag) -> list[Recorded]:
    """Read every topic that an alignment could read, sorted by name."""
    topics = sorted(topic for topic in bag.topics if topic.msgtype in KINDS
                    and may_be_velocity(topic) and REFERENCE_NAMESPACE not in topic.name)
    recorded = {topic: [Recorded(topic, kind, bag.start_ns) for kind in KINDS[topic.msgtype]]
                for topic in topics}
    for block in bag.blocks(topics):
        for number, (topic, messages) in enumerate(zip(topics, block.messages)):
            if not messages:
                continue
            # Frames in their headers may be wrong: the motion will tell.
            decoded = ({'imu': decode_imu(messages, topic)} if KINDS[topic.msgtype] == ('imu',)
                       else decode_gnss(messages, topic, Config(velocity_frame='enu')))
            for data in recorded[topic]:
                data.take(block.times_ns[block.topics == number], messages[0], decoded[data.kind])
    candidates = [data for each in recorded.values() for data in each]
    for data in candidates:
        data.finish()
    return candidates
