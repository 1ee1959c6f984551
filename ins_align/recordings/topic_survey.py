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
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import decode, Gnss, ImuSamples, KINDS, Refused
from ins_align.recordings.reader import candidates, doubt
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


class Columns(NamedTuple):
    """What N messages of a topic say."""

    recorded_ns: np.ndarray  # (N,) int64
    stamps_ns: np.ndarray  # (N,) int64
    # (N, 6), rate and specific force; or (N, 3), latitude, longitude, degrees, and altitude, m, or
    # velocity as if it were ENU, m/s.
    values: Array
    usable: np.ndarray  # (N,) bool: finite, and with a fix
    no_fix: np.ndarray  # (N,) bool
    sigmas: Array  # (N, 2), horizontal and vertical; nan where no covariance is stated
    vertical: np.ndarray  # (N,) bool: with an altitude or a vertical velocity that is not nan


NOTHING = Columns(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)),
                  np.zeros(0, bool), np.zeros(0, bool), np.zeros((0, 2)), np.zeros(0, bool))


def columns_of(times_ns: np.ndarray, decoded: ImuSamples | Sequence[Gnss]) -> Columns:
    """Return what messages say, recorded at some times; what cannot be decoded is left out."""
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
            known = message.covariance is not None
            east, north, up = message.covariance.diagonal() if known else (math.nan,) * 3
            rows.append((time_ns, message.stamp_ns, values, not fault, fault == 'no_fix',
                         (math.sqrt((east + north) / 2.0), math.sqrt(up)), found.vertical))
    return Columns(*map(np.array, zip(*rows))) if rows else NOTHING


@dataclass(init=False)
class Recorded(Surveyed):
    """A topic that an alignment could read, with all its messages in recorded order."""

    name: str
    msgtype: str
    kind: str  # imu, fix or velocity

    def __init__(self, topic: Topic, kind: str, start_ns: int, first: bytes | None,
                 messages: int, parts: Sequence[Columns]) -> None:
        """Put together what so many messages say, of a recording that begins at a time, ns."""
        super().__init__()
        self.name, self.msgtype, self.kind = topic.name, type_in_words(topic.msgtype), kind
        # Why a velocity would be refused for its frame_id, or what an IMU does not measure.
        self.doubt = doubt(first, topic)
        data = Columns(*map(np.concatenate, zip(*parts))) if parts else NOTHING
        self.recorded_ns, self.stamps_ns, self.values = data[:3]
        self.usable = data.usable  # with a stamp near the others, besides
        self._start_ns, self._age_ns = start_ns, 0
        count = self.stamps_ns.size
        self.add('', messages=messages)
        if not count:
            self.add(self.doubt or 'its messages cannot be decoded', fault=True)
            return
        ages_ns = self.recorded_ns - self.stamps_ns
        # The median: one of the ages, no mean of two clocks.
        self._age_ns = int(np.sort(ages_ns)[count // 2])
        astray = np.abs(ages_ns - self._age_ns) > MAX_ASTRAY * 1e9
        self.usable = data.usable & ~astray
        in_order = self.stamps_ns[~astray]
        self._add_timing(np.unique(in_order), ages_ns[~astray] * 1e-9)
        for name, number, text in (
                ('undecodable', messages - count, 'messages cannot be decoded'),
                ('astray', int(np.count_nonzero(astray)),
                 f'stamps are more than {MAX_ASTRAY:g} s off the others'),
                ('out_of_order', int(np.count_nonzero(np.diff(in_order) <= 0)),
                 'stamps are not later than the one before')):
            self.add(number and f'{number} {text}' or '', **{name: number})
        self.add('', usable_share=float(np.mean(self.usable)))
        if kind == 'fix':
            share = float(np.mean(data.no_fix))
            self.add(f'without a fix: {share:.1%}', no_fix_share=share)
        if kind != 'imu':
            self.add('', vertical_share=float(np.mean(data.vertical)))
            self._add_sigmas(data.sigmas)

    def _add_sigmas(self, sigmas: Array) -> None:
        """Say what sigmas are stated, and in how many messages."""
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
        """Add when messages came: stamps in order, and ages in seconds."""
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


def read_candidates(bag: Bag) -> list[Recorded]:
    """Read every topic that an alignment could read, sorted by name."""
    topics = sorted(candidates(bag, KINDS))
    first: dict[Topic, bytes] = {}
    counts: Counter[Topic] = Counter()
    parts: dict[tuple[Topic, str], list[Columns]] = defaultdict(list)
    for block in bag.blocks(topics):
        for number, (topic, messages) in enumerate(zip(topics, block.messages)):
            if not messages:
                continue
            first.setdefault(topic, messages[0])
            counts[topic] += len(messages)
            times_ns = block.times_ns[block.topics == number]
            # Frames in their headers may be wrong: the motion will tell.
            decoded = decode(messages, topic, Config(velocity_frame='enu'))
            for kind, data in decoded.items():
                parts[topic, kind].append(columns_of(times_ns, data))
    return [Recorded(topic, kind, bag.start_ns, first.get(topic), counts[topic],
                     parts[topic, kind])
            for topic in topics for kind in KINDS[topic.msgtype]]
