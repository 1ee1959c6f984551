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
"""Surveys topics that an alignment could read: what their messages hold, and their timing."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.geometry.rotation import Array
from ins_align.gnss.drivers import type_in_words
from ins_align.gnss.messages import numbers_of, usable
from ins_align.gnss.motion import Series, series_of
from ins_align.imu.buffer import MAX_ACCELERATION, MAX_RATE
from ins_align.recordings import Topic
from ins_align.recordings.bag import Bag, FIRST
from ins_align.recordings.decode import decode, Gnss, ImuSamples, KINDS, Refused
from ins_align.recordings.reader import candidates, doubt
import numpy as np

MAX_ASTRAY = 60.0  # s that the age of a usable stamp may differ from the median age
GAP_INTERVALS = 3.5  # usual intervals without a message that make a gap


def rounded(value: float) -> float:
    """Round a value to two significant digits, for a parameter."""
    return float(f'{value:.2g}')


def set_arguments(settings: Mapping[str, Any]) -> list[str]:
    """Return the arguments of ``--set`` for some parameters."""
    return [f'{name}={str(value).lower()}' for name, value in settings.items()]


@dataclass(kw_only=True)
class Surveyed:
    """Findings about a recording or a topic."""

    lines: list[str] = field(default_factory=list)  # sentences that ``ins_align info`` prints
    # Numbers by name, in SI units unless the name ends with another unit.
    figures: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)  # parameters that an alignment needs
    faults: list[str] = field(default_factory=list)  # sentences on why it cannot be used

    def add(self, text: str, settings: Mapping[str, Any] | None = None, *, fault: bool = False,
            **figures: Any) -> None:
        """Add a finding: a sentence ('' adds none), the parameters that it sets, and figures."""
        if fault:
            self.faults.append(text)
        elif text:
            sets = ', '.join(set_arguments(settings or {}))
            self.lines.append(text + (sets and f' (sets {sets})'))
        self.settings |= settings or {}
        self.figures |= figures


class Columns(NamedTuple):
    """The contents of N messages of a topic."""

    recorded_ns: np.ndarray  # (N,) int64
    stamps_ns: np.ndarray  # (N,) int64
    # Imu: (N, 6), angular rate, rad/s, and specific force, m/s^2. Fix: (N, 3), latitude and
    # longitude, degrees, and altitude, m. Velocity: (N, 3), read as ENU, m/s.
    values: Array
    usable: np.ndarray  # (N,) bool: finite, within bounds, and with a fix
    no_fix: np.ndarray  # (N,) bool
    sigmas: Array  # (N, 2), m or m/s, horizontal and vertical; nan if no covariance is stated
    vertical: np.ndarray  # (N,) bool: whether altitude or vertical velocity is not nan


NOTHING = Columns(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)),
                  np.zeros(0, bool), np.zeros(0, bool), np.zeros((0, 2)), np.zeros(0, bool))


def columns_of(times_ns: np.ndarray, decoded: ImuSamples | Sequence[Gnss]) -> Columns:
    """Return the columns of messages recorded at some times, without undecodable ones."""
    if isinstance(decoded, ImuSamples):
        values = np.hstack([decoded.gyro, decoded.accel])
        good = (np.abs(values) < np.repeat([MAX_RATE, MAX_ACCELERATION], 3)).all(axis=1)
        return Columns(times_ns[decoded.decoded], decoded.stamps_ns, values, good,
                       np.zeros_like(good), np.full((good.size, 2), np.nan), good)
    rows = []
    for time_ns, message in zip(times_ns.tolist(), decoded):
        if not isinstance(message, Refused):
            found, fault = usable(message)
            values = numbers_of(found)
            covariance = message.covariance
            east, north, up = (math.nan,) * 3 if covariance is None else covariance.diagonal()
            rows.append((time_ns, message.stamp_ns, values, not fault, fault == 'no_fix',
                         (math.sqrt((east + north) / 2.0), math.sqrt(up)), found.vertical))
    return Columns(*map(np.array, zip(*rows))) if rows else NOTHING


@dataclass(init=False)
class Recorded(Surveyed):
    """Survey of a topic that an alignment could read, with its messages in recorded order."""

    name: str
    msgtype: str
    kind: str  # imu, fix or velocity

    def __init__(self, topic: Topic, kind: str, start_ns: int, first: Sequence[bytes],
                 messages: int, parts: Sequence[Columns]) -> None:
        """Survey a topic by its first messages, the number of all and their decoded parts."""
        super().__init__()
        self.name, self.msgtype, self.kind = topic.name, type_in_words(topic.msgtype), kind
        # Why the messages may not be what their type promises; '' if there is no doubt.
        self.doubt = doubt(first, topic)
        data = Columns(*map(np.concatenate, zip(*parts))) if parts else NOTHING
        self.recorded_ns, self.stamps_ns, self.values = data[:3]
        self.usable = data.usable  # without stamps that are astray, see below
        self._start_ns, self._age_ns = start_ns, 0
        count = self.stamps_ns.size
        self.add('', messages=messages)
        if not count:
            self.add(self.doubt or 'its messages cannot be decoded', fault=True)
            return
        ages_ns = self.recorded_ns - self.stamps_ns
        # The upper median is one of the ages, never the mean of the ages by two clocks.
        self._age_ns = int(np.sort(ages_ns)[count // 2])
        astray = np.abs(ages_ns - self._age_ns) > MAX_ASTRAY * 1e9
        self.usable = data.usable & ~astray
        stamps_ns = self.stamps_ns[~astray]
        self._add_timing(np.unique(stamps_ns), ages_ns[~astray] * 1e-9)
        for name, number, text in (
                ('undecodable', messages - count, 'messages cannot be decoded'),
                ('astray', int(np.count_nonzero(astray)),
                 f'stamps are more than {MAX_ASTRAY:g} s off the others'),
                ('out_of_order', int(np.count_nonzero(np.diff(stamps_ns) <= 0)),
                 'stamps are not later than the one before')):
            self.add(f'{number} {text}' if number else '', **{name: number})
        self.add('', usable_share=float(np.mean(self.usable)))
        if kind == 'fix':
            share = float(np.mean(data.no_fix))
            self.add(f'without a fix: {share:.1%}', no_fix_share=share)
        if kind != 'imu':
            self.add('', vertical_share=float(np.mean(data.vertical)))
            self._add_sigmas(data.sigmas)

    def _add_sigmas(self, sigmas: Array) -> None:
        """Add the median of the stated sigmas, and in how many messages there are any."""
        stated = sigmas[np.isfinite(sigmas[:, 0])]
        share = len(stated) / len(sigmas)
        if not share:
            self.add('states no covariance', covariance_share=share)
            return
        sigma = np.median(stated, axis=0).tolist()
        horizontal, vertical = (f'{std:.2g} {"m" if self.kind == "fix" else "m/s"}'
                                for std in sigma)
        self.add(f'states sigmas of {horizontal} horizontally, {vertical} vertically'
                 + ('' if share == 1.0 else f' in {share:.0%} of the messages'),
                 covariance_share=share, sigma=sigma)

    def _add_timing(self, stamps_ns: np.ndarray, ages: Array) -> None:
        """Add rate, gaps and ages of messages with these increasing stamps, ns, and ages, s."""
        intervals = np.diff(stamps_ns) * 1e-9
        usual = float(np.median(intervals)) if intervals.size else math.inf
        gaps = int(np.count_nonzero(intervals > GAP_INTERVALS * usual))
        first, last = ((self.recorded_ns[[0, -1]] - self._start_ns) * 1e-9).tolist()
        self.add('', rate_hz=1.0 / usual or None, first_s=first, last_s=last,
                 stamp_age_s=self.age_s, gaps=gaps,
                 stamp_age_spread_s=float(np.ptp(np.quantile(ages, (0.01, 0.99)))))
        if gaps:
            place = int(np.argmax(intervals))
            start_ns = int(stamps_ns[place]) - self._start_ns + self._age_ns
            self.add('', longest_gap_s=float(intervals[place]),
                     longest_gap_start_s=start_ns * 1e-9)

    @property
    def age_s(self) -> float:
        """Median of recorded time minus stamp, s; 0 if there is no message."""
        return self._age_ns * 1e-9

    def series(self) -> Series:
        """
        Return the usable values over increasing times, s from the start of the recording.

        The times are the stamps plus the median age of the messages, which makes different clocks
        comparable. Of equal stamps the first counts.
        """
        times_ns = self.stamps_ns[self.usable] - self._start_ns + self._age_ns
        return series_of(times_ns.astype(float) * 1e-9, self.values[self.usable])


def read_candidates(bag: Bag) -> list[Recorded]:
    """Read and survey every topic that an alignment could read, sorted by name."""
    topics = sorted(candidates(bag, KINDS))
    first: dict[Topic, list[bytes]] = defaultdict(list)
    counts: Counter[Topic] = Counter()
    parts: dict[tuple[Topic, str], list[Columns]] = defaultdict(list)
    for block in bag.blocks(topics):
        for number, (topic, messages) in enumerate(zip(topics, block.messages)):
            first[topic] += messages[:FIRST - len(first[topic])]
            counts[topic] += len(messages)
            times_ns = block.times_ns[block.topics == number]
            # The frame_id of a velocity is ignored: the motion will show its frame.
            decoded = decode(messages, topic, Config(velocity_frame='enu'))
            for kind, data in decoded.items():
                parts[topic, kind].append(columns_of(times_ns, data))
    return [Recorded(topic, kind, bag.start_ns, first[topic], counts[topic],
                     parts[topic, kind])
            for topic in topics for kind in KINDS[topic.msgtype]]
