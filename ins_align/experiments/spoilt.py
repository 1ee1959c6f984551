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
Messages of a simulated vehicle as drivers send them, and the faults of real drivers in them.

A fault changes a `Stream` in place: it drops, repeats, delays, restamps or spoils messages, and
notes the counters of the aligner that it determines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
import itertools
from operator import itemgetter
from typing import Any

from ins_align.config import Config, STANDARD_GRAVITY
from ins_align.geometry.rotation import Array
from ins_align.gnss.messages import (
    BodyFrameError, fix_from_numbers, refuse_body_frame, velocity_from_numbers)
from ins_align.simulation.scenarios import displaced
from ins_align.simulation.simulate import Simulation
import numpy as np

Random = np.random.Generator
Window = tuple[int, int]            # ns
Message = tuple[int, str, Any]      # arrival (ns), kind, content

SECOND = 1_000_000_000
HOUR = 3600 * SECOND
LATENESS_NS = round(Config().gnss_lateness * SECOND)
BATCH = 100             # IMU samples given at once, which have one offset in `Stream.clock`
BETWEEN_BATCH = 7       # the same where attitudes between epochs are judged
GNSS = 'fix', 'velocity'
SENSORS = 'imu', *GNSS
_IMU = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('gyro', 'f8', 3), ('accel', 'f8', 3)])
_FIX = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('lla', 'f8', 3),
                 ('covariance', 'f8', (3, 3)), ('covariance_type', 'i4'), ('status', 'i4')])
_VELOCITY = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('velocity', 'f8', 3),
                      ('covariance', 'f8', (3, 3)), ('frame_id', 'U16')])


@dataclass
class Stream:
    """
    What the drivers send: arrays with a row per message, ``arrival`` and ``stamp`` in ns.

    The other fields are as in the ROS messages, in the frame that the configuration names.
    """

    imu: np.ndarray
    fix: np.ndarray
    velocity: np.ndarray
    first: int              # first and last stamp of the simulation, ns
    last: int
    batch: int = BATCH      # IMU samples given at once
    config: dict[str, Any] = field(default_factory=dict)        # further parameters of `Config`
    resets: list[int] = field(default_factory=list)     # times of resets, ns
    updates: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))  # of updates, ns
    update_every: float = 0.0       # mean interval of updates at random, s; 0: they are regular
    between: bool = False           # update after every message, to judge the attitude then
    expected: dict[str, int] = field(default_factory=dict)      # counters known beforehand
    # Stamps at which the clock's offset changes, and the offsets before, between and after, ns.
    clock: tuple[Any, Any] = (), (0,)

    @property
    def start_ns(self) -> int:
        """Return the stamp of the first IMU sample."""
        return int(next(iter(self.imu['stamp']), self.first))

    def true_stamps(self, stamps: Any) -> Any:
        """Return the times of the simulation, ns, that belong to stamps."""
        edges, offsets = map(np.asarray, self.clock)
        passed = np.searchsorted(edges, stamps, side='right')
        return np.clip(stamps - offsets[passed], self.first, self.last)

    def stamp_imu(self, stamps: np.ndarray) -> None:
        """Stamp IMU samples anew; they still arrive when they are measured."""
        self.imu['stamp'] = stamps
        late = stamps - self.imu['arrival']
        self.clock = stamps[::BATCH][1:], [int(np.median(late[k:k + BATCH]))
                                           for k in range(0, len(late), BATCH)]

    def moment(self, random: Random, low: float = 0.1, high: float = 0.9) -> int:
        """Draw a time, ns; `low` and `high` are parts of the duration."""
        return self.first + int(random.uniform(low, high) * (self.last - self.first))

    def windows(self, random: Random, number: tuple[int, int],
                length: tuple[float, float]) -> list[Window]:
        """Draw windows; number (the upper end excluded) and length (s) are from ranges."""
        starts = [self.moment(random) for _ in range(random.integers(*number))]
        return [(start, start + int(random.uniform(*length) * SECOND)) for start in starts]

    def seconds(self, name: str) -> Array:
        """Return the arrivals of messages, s since the start."""
        return (getattr(self, name)['arrival'] - self.first) / SECOND

    def keep(self, name: str, chosen: np.ndarray) -> None:
        """Drop all messages but the chosen ones."""
        setattr(self, name, getattr(self, name)[chosen])

    def add_error(self, name: str, chosen: np.ndarray, error: Array) -> None:
        """Add ENU errors, one each or one for all, to chosen positions (m) or velocities (m/s)."""
        if name == 'velocity':
            self.velocity['velocity'][chosen] += error
        else:
            lla = self.fix['lla'][chosen]
            self.fix['lla'][chosen] = displaced(lla, np.broadcast_to(error, lla.shape))

    def messages(self, config: Config) -> Iterator[Message]:
        """
        Yield the messages in the order of arrival, IMU samples in batches.

        Kinds are the names of the arrays, 'update', 'reset', and 'reject', whose content is the
        reason why a message cannot be used.
        """
        fix, sent, nothing = self.fix, self.velocity, itertools.repeat(None)
        stated = nothing if config.velocity_type == 'TwistStamped' else sent['covariance']
        measured: Iterable[Any] = map(partial(velocity_from_numbers, config), sent['stamp'],
                                      sent['velocity'], stated)
        try:
            refuse_body_frame(''.join(set(sent['frame_id'])), config)
        except BodyFrameError:
            measured = itertools.repeat('velocity_body_frame')
        events = sorted(((int(time), kind, payload) for kind, times, payloads in (
            ('imu', self.imu['arrival'], itertools.count()),
            ('fix', fix['arrival'], map(fix_from_numbers, *(
                fix[name] for name in fix.dtype.names[1:]))),
            ('velocity', sent['arrival'], measured),
            ('update', self.updates, nothing), ('reset', self.resets, nothing))
            for time, payload in zip(times, payloads)), key=itemgetter(0))
        for kind, block in itertools.groupby(events, itemgetter(1)):
            while some := [*itertools.islice(block, self.batch if kind == 'imu' else 1)]:
                time, _, payload = some[-1]
                if kind == 'imu':
                    batch = self.imu[[index for _, _, index in some]]
                    payload = batch['stamp'], batch['gyro'], batch['accel']
                yield time, 'reject' if isinstance(payload, str) else kind, payload


def stream_of(simulation: Simulation, between: bool = False) -> Stream:
    """Return the messages of a simulation; its velocities are configured as ENU."""
    imu = np.zeros(len(simulation.imu_stamps_ns), _IMU)
    imu['arrival'] = imu['stamp'] = simulation.imu_stamps_ns
    imu['gyro'], imu['accel'] = simulation.gyro, simulation.accel
    fix = np.zeros(len(simulation.gnss_stamps_ns), _FIX)
    velocity = np.zeros(len(fix), _VELOCITY)
    for rows in fix, velocity:
        rows['arrival'], rows['stamp'] = simulation.gnss_arrival_ns, simulation.gnss_stamps_ns
    fix['lla'], fix['covariance'] = simulation.lla_deg, simulation.position_covariance
    fix['covariance_type'] = 3
    velocity['velocity'] = simulation.velocity
    velocity['covariance'] = simulation.velocity_covariance
    return Stream(imu, fix, velocity, int(simulation.imu_stamps_ns[0]),
                  int(simulation.imu_stamps_ns[-1]), BETWEEN_BATCH if between else BATCH,
                  {'velocity_frame': 'enu'}, between=between)


def within(rows: np.ndarray, window: Window) -> np.ndarray:
    """Return which messages have stamps within a window."""
    return (rows['stamp'] >= window[0]) & (rows['stamp'] < window[1])


def choose_rows(random: Random, rows: np.ndarray, least: float, most: float) -> Array:
    """Draw the indices of a part of the rows, sorted; `least` to `most` of them, at least one."""
    number = max(1, round(random.uniform(least, most) * len(rows)))
    return np.sort(random.choice(len(rows), number, replace=False))


def directions(random: Random, number: int) -> Array:
    """Draw unit vectors, shape (number, 3)."""
    vectors = random.standard_normal((number, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def _lose(stream: Stream, random: Random, names: Sequence[str], number: tuple[int, int],
          length: tuple[float, float]) -> None:
    """Drop the messages with stamps within some windows."""
    for window in stream.windows(random, number, length):
        for name in names:
            stream.keep(name, ~within(getattr(stream, name), window))


# Faults of GNSS

def _outliers(stream: Stream, random: Random) -> None:
    for name, least, most in ('fix', 10.0, 100.0), ('velocity', 0.5, 10.0):
        chosen = choose_rows(random, getattr(stream, name), 0.01, 0.1)
        stream.add_error(name, chosen, random.uniform(least, most, (len(chosen), 1))
                         * directions(random, len(chosen)))


def _position_jump(stream: Stream, random: Random) -> None:
    later = stream.fix['stamp'] >= stream.moment(random)
    stream.add_error('fix', later, 10 ** random.uniform(1.3, 3.3) * directions(random, 1))


def _null_island(stream: Stream, random: Random) -> None:
    chosen = choose_rows(random, stream.fix, 0.02, 0.5)
    stream.fix['lla'][chosen, :2] = 0.0
    stream.expected['fix_no_fix'] = len(chosen)


def _no_fix(stream: Stream, random: Random) -> None:
    """Set the status to no fix; every other such message has no position."""
    chosen = choose_rows(random, stream.fix, 0.02, 0.9)
    stream.fix['status'][chosen] = -1
    stream.fix['lla'][chosen[::2]] = np.nan
    stream.expected['fix_no_fix'] = len(chosen)


def _unknown_status(stream: Stream, random: Random) -> None:
    stream.fix['status'] = -2
    stream.expected['fix_status_unknown'] = len(stream.fix)


def _broken_gnss(stream: Stream, random: Random) -> None:
    """Send nan, inf and values that are impossible."""
    missing = {}
    for name, vector in ('fix', 'lla'), ('velocity', 'velocity'):
        rows = getattr(stream, name)
        chosen = choose_rows(random, rows, 0.02, 0.5)
        values = random.choice(np.array([np.nan, np.inf, -np.inf, 1e300, -1e7]), len(chosen))
        axes = random.integers(0, 3, len(chosen))
        rows[vector][chosen, axes] = values
        # A message whose vertical component alone is nan is used.
        missing[name] = np.count_nonzero((axes == 2) & np.isnan(values))
        stream.expected[f'{name}_nan'] = len(chosen) - missing[name]
    stream.expected['fix_no_altitude'] = missing['fix']


def _unknown_covariance(stream: Stream, random: Random) -> None:
    """Mark covariances as unknown in the various ways of drivers."""
    for rows in stream.fix, stream.velocity:
        chosen = choose_rows(random, rows, 0.5, 1.0)
        mark = random.choice(np.array([0.0, -1.0, np.nan]))
        rows['covariance'][chosen] = 0.0
        for axis in range(random.integers(1, 4)):
            rows['covariance'][chosen, axis, axis] = mark
    stream.fix['covariance_type'][choose_rows(random, stream.fix, 0.0, 1.0)] = 0


def _nonsense_covariance(stream: Stream, random: Random) -> None:
    """Send covariances with impossible elements."""
    values = np.array([1e-300, 1e-30, 1e-12, 1e12, 1e30, 1e300, np.inf, -np.inf, -1e300])
    for rows in stream.fix, stream.velocity:
        chosen = choose_rows(random, rows, 0.02, 0.3)
        i, j = random.integers(0, 3, (2, len(chosen)))
        rows['covariance'][chosen, i, j] = random.choice(values, len(chosen))


def _small_covariance(stream: Stream, random: Random) -> None:
    for rows in stream.fix, stream.velocity:
        rows['covariance'] /= random.uniform(2.0, 10.0) ** 2


def _one_stamp(stream: Stream, random: Random) -> None:
    """Give one stamp to several messages: send them again, or have stamps of whole seconds."""
    again = random.random() < 0.5
    for name in GNSS:
        rows = getattr(stream, name)
        indices = np.arange(len(rows))
        if again:
            source = np.repeat(indices, random.integers(1, 4, len(rows)))
            stream.keep(name, source)
            stream.expected[f'{name}_duplicate'] = len(source) - len(rows)
        else:
            source = indices // 5 * 5
            rows['stamp'] = rows['stamp'][source]
            stream.expected[f'{name}_duplicate'] = int(np.sum(source != indices))


def _late_gnss(stream: Stream, random: Random) -> None:
    """Send GNSS late and out of order, but within `gnss_lateness`."""
    for name in GNSS:
        rows = getattr(stream, name)
        rows['arrival'] += random.integers(0, LATENESS_NS, len(rows))
        stream.expected[f'{name}_late'] = 0


def _too_late_gnss(stream: Stream, random: Random) -> None:
    part = random.uniform(0.1, 1.0)
    for name in GNSS:
        rows = getattr(stream, name)
        chosen = choose_rows(random, rows, 0.1 * part, part)
        rows['arrival'][chosen] += random.integers(LATENESS_NS + SECOND // 20, 5 * SECOND,
                                                   len(chosen))
        newest = np.minimum(rows['arrival'], stream.imu['stamp'][-1])
        stream.expected[f'{name}_late'] = int(np.sum(rows['stamp'] < newest - LATENESS_NS))


def _gnss_clock(stream: Stream, shift: int) -> None:
    for rows in stream.fix, stream.velocity:
        rows['stamp'] += shift


def vertical_absent(stream: Stream, random: Random, **config: str) -> None:
    """Send 0 for the vertical velocity, as NMEA drivers do."""
    stream.velocity['velocity'][:, 2] = 0.0
    stream.config |= config


def _body_frame(stream: Stream, random: Random) -> None:
    stream.velocity['frame_id'] = 'base_link'
    stream.config['velocity_frame'] = 'auto'
    stream.expected['velocity_body_frame'] = len(stream.velocity)


# Faults of the IMU

def _imu_jitter(stream: Stream, random: Random) -> None:
    interval = np.median(np.diff(stream.imu['stamp']))
    stream.imu['stamp'] += np.rint(random.uniform(0.1, 0.45) * interval * random.uniform(
        -1, 1, len(stream.imu))).astype(np.int64)


def _imu_duplicates(stream: Stream, random: Random) -> None:
    chosen = choose_rows(random, stream.imu, 0.01, 0.5)
    stream.imu = np.insert(stream.imu, chosen, stream.imu[chosen])
    stream.expected['imu_duplicate'] = len(chosen)


def _imu_out_of_order(stream: Stream, random: Random) -> None:
    chosen = choose_rows(random, stream.imu, 0.01, 0.2)
    stream.imu['arrival'][chosen] += random.integers(0, SECOND // 10, len(chosen))
    arrived = stream.imu['stamp'][np.argsort(stream.imu['arrival'], kind='stable')]
    stream.expected['imu_out_of_order'] = int(np.sum(arrived < np.maximum.accumulate(arrived)))


def _imu_missing(stream: Stream, random: Random) -> None:
    """Drop single samples, and many in a row."""
    stream.imu = np.delete(stream.imu, choose_rows(random, stream.imu, 0.01, 0.2))
    _lose(stream, random, ['imu'], (0, 4), (0.05, 1.5))


def _imu_silent(stream: Stream, random: Random) -> None:
    """Send no samples from some time on, or none at all."""
    end = stream.first if random.random() < 0.1 else stream.moment(random, 0.3, 0.95)
    stream.keep('imu', stream.imu['stamp'] < end)


def _imu_broken(stream: Stream, random: Random) -> None:
    """Send nan, inf and values beyond the range of any sensor."""
    chosen = choose_rows(random, stream.imu, 0.001, 0.05)
    values = random.choice(np.array([np.nan, np.inf, -np.inf, 1e300, -3e3]), len(chosen))
    axes = random.integers(0, 3, len(chosen))
    half = len(chosen) // 2
    stream.imu['gyro'][chosen[:half], axes[:half]] = values[:half]
    stream.imu['accel'][chosen[half:], axes[half:]] = values[half:]
    stream.expected['imu_nan'] = len(chosen)


def _imu_spikes(stream: Stream, random: Random) -> None:
    """Add spikes to single samples, within the range of sensors."""
    for name, size in ('gyro', 150.0), ('accel', 1500.0):
        chosen = choose_rows(random, stream.imu, 0.0, 0.002)
        stream.imu[name][chosen] += (10 ** random.uniform(-2, 0, (len(chosen), 1)) * size
                                     * directions(random, len(chosen)))


def _freeze(stream: Stream, random: Random, fields: Sequence[str], number: tuple[int, int],
            length: tuple[float, float]) -> None:
    """Let fields of IMU samples repeat those of the first sample in each of some windows."""
    for window in stream.windows(random, number, length):
        chosen = np.flatnonzero(within(stream.imu, window))
        for name in fields:
            stream.imu[name][chosen] = stream.imu[name][chosen[0]]


def _imu_wild_stamps(stream: Stream, random: Random) -> None:
    """Give single samples stamps that are 0, overflowed or far off."""
    for index in random.choice(len(stream.imu), random.integers(1, 4), replace=False):
        stream.imu['stamp'][index] = random.choice([
            0, stream.first - HOUR, stream.last + HOUR, (1 << 31) * SECOND,
            int(stream.imu['stamp'][index]) + 5 * SECOND])


# Faults of clocks, and resets and updates

def _clock_loop(stream: Stream, random: Random) -> None:
    """Send the beginning of the recording, then all of it, as a bag that loops."""
    end = stream.moment(random, 0.2, 0.6)
    for name in SENSORS:
        rows = getattr(stream, name)
        again = rows.copy()
        again['arrival'] += end - stream.first
        setattr(stream, name, np.concatenate([rows[rows['arrival'] < end], again]))
    stream.expected['clock_jumps'] = 1


def _set_clock(stream: Stream, random: Random, shift: int, latest: float = 0.6,
               **expected: int) -> None:
    """Shift all stamps from some moment on by `shift` (ns)."""
    moment = stream.moment(random, 0.2, latest)
    for rows in stream.imu, stream.fix, stream.velocity:
        rows['stamp'][rows['stamp'] >= moment] += shift
    stream.clock = [moment + shift, stream.last + shift + SECOND], [0, shift, 0]
    stream.expected |= expected


def _clock_step(stream: Stream, random: Random) -> None:
    """Set the clock by less than counts as late or as an outage."""
    shift = int(random.choice([-1, 1]) * random.uniform(0.02, 0.9) * SECOND)
    _set_clock(stream, random, shift, 0.8)


def _resets(stream: Stream, random: Random) -> None:
    stream.resets = [stream.moment(random) for _ in range(random.integers(1, 4))]
    stream.expected['resets'] = len(stream.resets)


def _random_updates(stream: Stream, random: Random) -> None:
    """Update at random times, between rarely and very often."""
    stream.update_every = float(10 ** random.uniform(-1.5, 1.3))


def _several(stream: Stream, random: Random) -> None:
    """Combine three other faults; the counters cannot be told beforehand any more."""
    with np.errstate(invalid='ignore'):         # outliers may be added to infinite positions
        for index in random.choice(len(TOGETHER), 3, replace=False):
            FAULTS[TOGETHER[index]](stream, random)
    stream.expected.clear()


FAULTS: dict[str, Callable[[Stream, Random], Any]] = {
    'none': lambda stream, random: None,
    'outliers': _outliers,
    'outages': partial(_lose, names=GNSS, number=(1, 4), length=(2.0, 15.0)),
    'position jumps': _position_jump, 'fix at 0, 0': _null_island, 'no fix': _no_fix,
    'status unknown': _unknown_status, 'GNSS nan, inf': _broken_gnss,
    'covariance 0, -1, nan': _unknown_covariance, 'covariance nonsense': _nonsense_covariance,
    'covariance too small': _small_covariance, 'several with one stamp': _one_stamp,
    'GNSS up to 1 s late': _late_gnss, 'GNSS later': _too_late_gnss,
    # By leap seconds, an hour, a day, or to time since the start.
    'GNSS clock far off': lambda stream, random: _gnss_clock(stream, int(random.choice(
        [18 * SECOND, -HOUR, HOUR, -stream.first, 24 * HOUR]))),
    'GNSS clock seconds off': lambda stream, random: _gnss_clock(stream, int(
        random.choice([-1, 1]) * random.uniform(0.2, 5.0) * SECOND)),
    'vertical absent, told': partial(vertical_absent, velocity_vertical='absent'),
    'vertical absent, not told': vertical_absent,
    'velocity of a body': _body_frame, 'IMU jitter': _imu_jitter, 'IMU twice': _imu_duplicates,
    'IMU out of order': _imu_out_of_order, 'IMU samples missing': _imu_missing,
    'IMU gap': partial(_lose, names=['imu'], number=(1, 3), length=(2.1, 6.0)),
    'IMU starts late': lambda stream, random: stream.keep(
        'imu', stream.imu['stamp'] > stream.moment(random, 0.05, 0.3)),
    'IMU falls silent': _imu_silent, 'IMU nan, inf, huge': _imu_broken, 'IMU spikes': _imu_spikes,
    'IMU stuck': partial(_freeze, fields=('gyro', 'accel'), number=(1, 3), length=(1.0, 15.0)),
    'IMU stamps stand still': partial(
        _freeze, fields=['stamp'], number=(1, 4), length=(0.05, 3.0)),
    'IMU stamps wild': _imu_wild_stamps,
    'accelerations in g': lambda stream, random: np.divide(
        stream.imu['accel'], STANDARD_GRAVITY, out=stream.imu['accel']),
    'rates in deg/s': lambda stream, random: np.degrees(
        stream.imu['gyro'], out=stream.imu['gyro']),
    'clock loops': _clock_loop,
    'clock back 1 h': partial(_set_clock, shift=-HOUR, clock_jumps=1),
    'clock forward 1 h': partial(_set_clock, shift=HOUR, clock_jumps=0),
    'clock steps': _clock_step, 'resets': _resets, 'updates at random': _random_updates,
    'three of these': _several}
# Faults that can be combined: they do not change the clock or units.
TOGETHER = ('outliers', 'outages', 'fix at 0, 0', 'no fix', 'status unknown', 'GNSS nan, inf',
            'covariance 0, -1, nan', 'covariance nonsense', 'covariance too small',
            'several with one stamp', 'GNSS up to 1 s late', 'GNSS later', 'IMU twice',
            'IMU out of order', 'IMU samples missing', 'IMU gap', 'IMU nan, inf, huge', 'resets',
            'updates at random')
