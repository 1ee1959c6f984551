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
Faults of real drivers, put into the messages of a simulation before anything has seen them.

A fault changes a `Stream` in place: it drops, repeats, delays, restamps and spoils messages, and
notes which counters of the aligner have to show it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from ins_align.config import Config
from ins_align.geometry.rotation import Array
from ins_align.gnss.messages import ENU_FROM_NED
from ins_align.simulation.simulate import Simulation
from ins_align.simulation.trajectory import displaced
import numpy as np

Random = np.random.Generator

SECOND = 1_000_000_000
HOUR = 3600 * SECOND
GRAVITY = 9.80665  # m/s^2
LATENESS = round(Config().gnss_lateness * SECOND)
_IMU = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('gyro', 'f8', 3), ('accel', 'f8', 3)])
_FIX = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('lla', 'f8', 3),
                 ('covariance', 'f8', (3, 3)), ('covariance_type', 'i4'), ('status', 'i4')])
_VELOCITY = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('velocity', 'f8', 3),
                      ('covariance', 'f8', (3, 3)), ('frame_id', 'U16')])


@dataclass
class Stream:
    """
    What the drivers send: a row a message.

    Attributes
    ----------
    imu, fix, velocity : ndarray
        Structured, with ``arrival`` and ``stamp`` in ns; everything else as in the ROS messages,
        in the frame that the configuration names.
    first, last : int
        Stamps between which the vehicle is simulated.
    config : dict
        What else the aligner is told.
    resets : list of int
        When somebody asks for a new start.
    update_every : float
        Mean time between two updates of the aligner, s; 0: regularly, once a second.
    expected : dict
        Counters of the aligner that are known beforehand.
    shift : tuple of three ints
        Stamps from the first on and before the second are off by the third.

    """

    imu: np.ndarray
    fix: np.ndarray
    velocity: np.ndarray
    first: int
    last: int
    config: dict[str, Any] = field(default_factory=dict)
    resets: list[int] = field(default_factory=list)
    update_every: float = 0.0
    expected: dict[str, int] = field(default_factory=dict)
    shift: tuple[int, int, int] = 0, 0, 0

    def true_stamps(self, stamps: Any) -> Any:
        """When what bears these stamps has been, by the simulation's clock."""
        start, end, shift = self.shift
        stamps = np.asarray(stamps)
        moved = np.where((stamps >= start) & (stamps < end), stamps - shift, stamps)
        return np.clip(moved, self.first, self.last)

    def gnss(self) -> tuple[tuple[str, np.ndarray], ...]:
        """Return fixes and velocities with their names."""
        return ('fix', self.fix), ('velocity', self.velocity)

    def moment(self, random: Random, low: float = 0.1, high: float = 0.9) -> int:
        """Draw an instant from a part of the recording."""
        return self.first + int(random.uniform(low, high) * (self.last - self.first))

    def windows(self, random: Random, number: int, shortest: float,
                longest: float) -> list[tuple[int, int]]:
        """Draw windows with a length within limits, in seconds."""
        starts = [self.moment(random) for _ in range(number)]
        return [(start, start + int(random.uniform(shortest, longest) * SECOND))
                for start in starts]


def stream_of(simulation: Simulation, frame: str = 'enu') -> Stream:
    """Return the messages of a simulation, velocities in ENU or NED."""
    turn = ENU_FROM_NED if frame == 'ned' else np.eye(3)
    imu = np.zeros(len(simulation.imu_stamps_ns), _IMU)
    imu['arrival'] = imu['stamp'] = simulation.imu_stamps_ns
    imu['gyro'], imu['accel'] = simulation.gyro, simulation.accel
    fix = np.zeros(len(simulation.gnss_stamps_ns), _FIX)
    velocity = np.zeros(len(fix), _VELOCITY)
    for rows in fix, velocity:
        rows['arrival'], rows['stamp'] = simulation.gnss_arrival_ns, simulation.gnss_stamps_ns
    fix['lla'], fix['covariance'] = simulation.lla_deg, simulation.position_covariance
    fix['covariance_type'] = 3
    velocity['velocity'] = simulation.velocity @ turn
    velocity['covariance'] = turn @ simulation.velocity_covariance @ turn
    return Stream(imu, fix, velocity, int(simulation.imu_stamps_ns[0]),
                  int(simulation.imu_stamps_ns[-1]), {'velocity_frame': frame})


def _some(random: Random, rows: np.ndarray, least: float, most: float) -> Array:
    """Choose a part of the rows, one at least."""
    number = max(1, round(random.uniform(least, most) * len(rows)))
    return np.sort(random.choice(len(rows), number, replace=False))


def _between(rows: np.ndarray, window: tuple[int, int]) -> np.ndarray:
    return (rows['stamp'] >= window[0]) & (rows['stamp'] < window[1])


def _directions(random: Random, number: int) -> Array:
    vectors = random.standard_normal((number, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1)[:, None])


# GNSS

def none(stream: Stream, random: Random) -> None:
    """Leave everything as it is."""


def outliers(stream: Stream, random: Random) -> None:
    """Spoil single positions and velocities."""
    chosen = _some(random, stream.fix, 0.01, 0.1)
    away = random.uniform(10.0, 100.0, (len(chosen), 1)) * _directions(random, len(chosen))
    stream.fix['lla'][chosen] = displaced(stream.fix['lla'][chosen], away)
    chosen = _some(random, stream.velocity, 0.01, 0.1)
    stream.velocity['velocity'][chosen] += (random.uniform(0.5, 10.0, (len(chosen), 1))
                                            * _directions(random, len(chosen)))


def outages(stream: Stream, random: Random) -> None:
    """Leave out GNSS for seconds."""
    for window in stream.windows(random, random.integers(1, 4), 2.0, 15.0):
        stream.fix = stream.fix[~_between(stream.fix, window)]
        stream.velocity = stream.velocity[~_between(stream.velocity, window)]


def position_jump(stream: Stream, random: Random) -> None:
    """Displace all positions from some moment on."""
    later = stream.fix['stamp'] >= stream.moment(random)
    away = 10 ** random.uniform(1.3, 3.3) * _directions(random, 1)
    stream.fix['lla'][later] = displaced(stream.fix['lla'][later], np.repeat(
        away, np.count_nonzero(later), axis=0))


def null_island(stream: Stream, random: Random) -> None:
    """Send 0, 0 now and then."""
    chosen = _some(random, stream.fix, 0.02, 0.5)
    stream.fix['lla'][chosen, :2] = 0.0
    stream.expected['fix_no_fix'] = len(chosen)


def no_fix(stream: Stream, random: Random) -> None:
    """Say that there is no fix, with an old position or none in the message."""
    chosen = _some(random, stream.fix, 0.02, 0.9)
    stream.fix['status'][chosen] = -1
    stream.fix['lla'][chosen[::2]] = np.nan
    stream.expected['fix_no_fix'] = len(chosen)


def unknown_status(stream: Stream, random: Random) -> None:
    """Say that nothing is known of the fix."""
    stream.fix['status'] = -2
    stream.expected['fix_status_unknown'] = len(stream.fix)


def broken_gnss(stream: Stream, random: Random) -> None:
    """Send nan, inf and what is nowhere."""
    chosen = _some(random, stream.fix, 0.02, 0.5)
    worthless = np.array([np.nan, np.inf, -np.inf, 1e300, -1e7])
    values = random.choice(worthless, len(chosen))
    axes = random.integers(0, 3, len(chosen))
    stream.fix['lla'][chosen, axes] = values
    no_altitude = np.count_nonzero((axes == 2) & np.isnan(values))
    stream.expected['fix_no_altitude'] = no_altitude
    stream.expected['fix_nan'] = len(chosen) - no_altitude
    chosen = _some(random, stream.velocity, 0.02, 0.5)
    values = random.choice(worthless, len(chosen))
    axes = random.integers(0, 3, len(chosen))
    stream.velocity['velocity'][chosen, axes] = values
    # The vertical alone may be missing: the rest is used.
    stream.expected['velocity_nan'] = np.count_nonzero((axes < 2) | ~np.isnan(values))


def unknown_covariance(stream: Stream, random: Random) -> None:
    """Mark covariances as unknown in the ways in which drivers do."""
    marks = np.array([0.0, -1.0, np.nan])
    for rows in stream.fix, stream.velocity:
        chosen = _some(random, rows, 0.5, 1.0)
        mark = random.choice(marks)
        rows['covariance'][chosen] = 0.0
        for axis in range(random.integers(1, 4)):
            rows['covariance'][chosen, axis, axis] = mark
    stream.fix['covariance_type'][_some(random, stream.fix, 0.0, 1.0)] = 0


def nonsense_covariance(stream: Stream, random: Random) -> None:
    """Send covariances that are none, or that no receiver can mean."""
    values = np.array([1e-300, 1e-30, 1e-12, 1e12, 1e30, 1e300, np.inf, -np.inf, -1e300])
    for rows in stream.fix, stream.velocity:
        chosen = _some(random, rows, 0.02, 0.3)
        places = random.integers(0, 3, (2, len(chosen)))
        rows['covariance'][chosen, places[0], places[1]] = random.choice(values, len(chosen))


def small_covariance(stream: Stream, random: Random) -> None:
    """Understate the noise of the receiver."""
    for rows in stream.fix, stream.velocity:
        rows['covariance'] /= random.uniform(2.0, 10.0) ** 2


def one_stamp(stream: Stream, random: Random) -> None:
    """Give one stamp to several messages: what is sent again, or whole seconds."""
    if random.random() < 0.5:
        for name, rows in stream.gnss():
            times = random.integers(1, 4, len(rows))
            setattr(stream, name, np.repeat(rows, times))
            stream.expected[f'{name}_duplicate'] = int(np.sum(times - 1))
        return
    for name, rows in stream.gnss():
        group = np.arange(len(rows)) // 5 * 5
        rows['stamp'] = rows['stamp'][group]
        stream.expected[f'{name}_duplicate'] = int(np.sum(group != np.arange(len(rows))))


def late_gnss(stream: Stream, random: Random) -> None:
    """Send GNSS late, and out of order, but within what is allowed."""
    for name, rows in stream.gnss():
        rows['arrival'] += random.integers(0, LATENESS, len(rows))
        stream.expected[f'{name}_late'] = 0


def too_late_gnss(stream: Stream, random: Random) -> None:
    """Send some of GNSS later than allowed."""
    part = random.uniform(0.1, 1.0)
    for name, rows in stream.gnss():
        chosen = _some(random, rows, 0.1 * part, part)
        rows['arrival'][chosen] += random.integers(LATENESS + SECOND // 20, 5 * SECOND,
                                                   len(chosen))
        newest = np.minimum(rows['arrival'], stream.imu['stamp'][-1])
        stream.expected[f'{name}_late'] = int(np.sum(rows['stamp'] < newest - LATENESS))


def other_clock(stream: Stream, random: Random) -> None:
    """Stamp GNSS with another clock altogether: leap seconds, hours, since the start."""
    shift = int(random.choice([18 * SECOND, -HOUR, HOUR, -stream.first, 24 * HOUR]))
    stream.fix['stamp'] += shift
    stream.velocity['stamp'] += shift


def near_clock(stream: Stream, random: Random) -> None:
    """Stamp GNSS with a clock that is seconds off."""
    shift = int(random.choice([-1, 1]) * random.uniform(0.2, 5.0) * SECOND)
    stream.fix['stamp'] += shift
    stream.velocity['stamp'] += shift


def vertical_absent(stream: Stream, random: Random, told: bool) -> None:
    """Send no vertical velocity, and say so or not."""
    stream.velocity['velocity'][:, 2] = 0.0
    if told:
        stream.config['velocity_vertical'] = 'absent'


def body_frame(stream: Stream, random: Random) -> None:
    """Send velocities of a body frame, and do not say that they are of another."""
    stream.velocity['frame_id'] = 'base_link'
    stream.config['velocity_frame'] = 'auto'
    stream.expected['velocity_body_frame'] = len(stream.velocity)


# IMU

def imu_jitter(stream: Stream, random: Random) -> None:
    """Stamp samples when the computer got round to it."""
    interval = np.median(np.diff(stream.imu['stamp']))
    stream.imu['stamp'] += np.rint(random.uniform(0.1, 0.45) * interval * random.uniform(
        -1, 1, len(stream.imu))).astype(np.int64)


def imu_duplicates(stream: Stream, random: Random) -> None:
    """Send samples twice."""
    chosen = _some(random, stream.imu, 0.01, 0.5)
    stream.imu = np.insert(stream.imu, chosen, stream.imu[chosen])
    stream.expected['imu_duplicate'] = len(chosen)


def imu_out_of_order(stream: Stream, random: Random) -> None:
    """Let samples overtake each other."""
    chosen = _some(random, stream.imu, 0.01, 0.2)
    stream.imu['arrival'][chosen] += random.integers(0, SECOND // 10, len(chosen))
    arrived = stream.imu['stamp'][np.argsort(stream.imu['arrival'], kind='stable')]
    stream.expected['imu_out_of_order'] = int(np.sum(arrived < np.maximum.accumulate(arrived)))


def imu_missing(stream: Stream, random: Random) -> None:
    """Lose samples, single ones and many in a row."""
    stream.imu = np.delete(stream.imu, _some(random, stream.imu, 0.01, 0.2))
    for window in stream.windows(random, random.integers(0, 4), 0.05, 1.5):
        stream.imu = stream.imu[~_between(stream.imu, window)]


def imu_gap(stream: Stream, random: Random) -> None:
    """Send no sample for too long."""
    for window in stream.windows(random, random.integers(1, 3), 2.1, 6.0):
        stream.imu = stream.imu[~_between(stream.imu, window)]


def imu_starts_late(stream: Stream, random: Random) -> None:
    """Begin with GNSS alone."""
    stream.imu = stream.imu[stream.imu['stamp'] > stream.moment(random, 0.05, 0.3)]


def imu_silent(stream: Stream, random: Random) -> None:
    """Send no sample from some moment on, or none at all."""
    end = stream.first if random.random() < 0.1 else stream.moment(random, 0.3, 0.95)
    stream.imu = stream.imu[stream.imu['stamp'] < end]


def imu_broken(stream: Stream, random: Random) -> None:
    """Send nan, inf and what no sensor measures."""
    chosen = _some(random, stream.imu, 0.001, 0.05)
    values = random.choice(np.array([np.nan, np.inf, -np.inf, 1e300, -3e3]), len(chosen))
    axes = random.integers(0, 3, len(chosen))
    half = len(chosen) // 2
    stream.imu['gyro'][chosen[:half], axes[:half]] = values[:half]
    stream.imu['accel'][chosen[half:], axes[half:]] = values[half:]
    stream.expected['imu_nan'] = len(chosen)


def imu_spikes(stream: Stream, random: Random) -> None:
    """Spoil single samples by what a sensor could measure."""
    for name, size in ('gyro', 150.0), ('accel', 1500.0):
        chosen = _some(random, stream.imu, 0.0, 0.002)
        stream.imu[name][chosen] += (10 ** random.uniform(-2, 0, (len(chosen), 1)) * size
                                     * _directions(random, len(chosen)))


def imu_stuck(stream: Stream, random: Random) -> None:
    """Send the same values again and again with new stamps."""
    for window in stream.windows(random, random.integers(1, 3), 1.0, 15.0):
        stuck = np.flatnonzero(_between(stream.imu, window))
        for name in 'gyro', 'accel':
            stream.imu[name][stuck] = stream.imu[name][stuck[0]]


def imu_stamps_stand_still(stream: Stream, random: Random) -> None:
    """Send new values with the same stamp for a while."""
    for window in stream.windows(random, random.integers(1, 4), 0.05, 3.0):
        still = np.flatnonzero(_between(stream.imu, window))
        stream.imu['stamp'][still] = stream.imu['stamp'][still[0]]


def imu_wild_stamps(stream: Stream, random: Random) -> None:
    """Stamp single samples with what was never set or overflowed."""
    for index in random.choice(len(stream.imu), random.integers(1, 4), replace=False):
        stream.imu['stamp'][index] = random.choice([
            0, stream.first - HOUR, stream.last + HOUR, (1 << 31) * SECOND,
            int(stream.imu['stamp'][index]) + 5 * SECOND])


def unit_g(stream: Stream, random: Random) -> None:
    """Send accelerations in g."""
    stream.imu['accel'] /= GRAVITY


def unit_degrees(stream: Stream, random: Random) -> None:
    """Send rates in deg/s."""
    stream.imu['gyro'] = np.degrees(stream.imu['gyro'])


# Clock and callers

def clock_loop(stream: Stream, random: Random) -> None:
    """Play the beginning, then everything: a bag that loops."""
    end = stream.moment(random, 0.2, 0.6)
    for name in 'imu', 'fix', 'velocity':
        rows = getattr(stream, name)
        again = rows.copy()
        again['arrival'] += end - stream.first
        setattr(stream, name, np.concatenate([rows[rows['arrival'] < end], again]))
    stream.expected['clock_jumps'] = 1


def _set_clock(stream: Stream, moment: int, shift: int) -> None:
    """Put all stamps from a moment on off by something."""
    for rows in stream.imu, stream.fix, stream.velocity:
        rows['stamp'][rows['stamp'] >= moment] += shift
    stream.shift = (moment + shift, stream.last + shift + SECOND, shift)


def clock_set(stream: Stream, random: Random, by: int, jumps: int) -> None:
    """Set the clock back or forward."""
    _set_clock(stream, stream.moment(random, 0.2, 0.6), by)
    stream.expected['clock_jumps'] = jumps


def clock_step(stream: Stream, random: Random) -> None:
    """Set the clock by less than what counts as lateness or silence."""
    shift = int(random.choice([-1, 1]) * random.uniform(0.02, 0.9) * SECOND)
    _set_clock(stream, stream.moment(random, 0.2, 0.8), shift)


def resets(stream: Stream, random: Random) -> None:
    """Ask for a new start."""
    stream.resets = [stream.moment(random) for _ in range(random.integers(1, 4))]
    stream.expected['resets'] = len(stream.resets)


def random_updates(stream: Stream, random: Random) -> None:
    """Look for results at random times, seldom or all the time."""
    stream.update_every = float(10 ** random.uniform(-1.5, 1.3))


def several(stream: Stream, random: Random) -> None:
    """Put three of the others together; what they count is not known any more."""
    with np.errstate(invalid='ignore'):         # a position that is infinite may be displaced
        for index in random.choice(len(TOGETHER), 3, replace=False):
            TOGETHER[index](stream, random)
    stream.expected.clear()


FAULTS: dict[str, Callable[[Stream, np.random.Generator], None]] = {
    'none': none, 'outliers': outliers, 'outages': outages, 'position jumps': position_jump,
    'fix at 0, 0': null_island, 'no fix': no_fix, 'status unknown': unknown_status,
    'GNSS nan, inf': broken_gnss, 'covariance 0, -1, nan': unknown_covariance,
    'covariance nonsense': nonsense_covariance, 'covariance too small': small_covariance,
    'several with one stamp': one_stamp,
    'GNSS up to 1 s late': late_gnss, 'GNSS later': too_late_gnss,
    'GNSS clock far off': other_clock, 'GNSS clock seconds off': near_clock,
    'vertical absent, told': partial(vertical_absent, told=True),
    'vertical absent, not told': partial(vertical_absent, told=False),
    'velocity of a body': body_frame, 'IMU jitter': imu_jitter, 'IMU twice': imu_duplicates,
    'IMU out of order': imu_out_of_order, 'IMU samples missing': imu_missing,
    'IMU gap': imu_gap, 'IMU starts late': imu_starts_late, 'IMU falls silent': imu_silent,
    'IMU nan, inf, huge': imu_broken, 'IMU spikes': imu_spikes, 'IMU stuck': imu_stuck,
    'IMU stamps stand still': imu_stamps_stand_still, 'IMU stamps wild': imu_wild_stamps,
    'accelerations in g': unit_g, 'rates in deg/s': unit_degrees, 'clock loops': clock_loop,
    'clock back 1 h': partial(clock_set, by=-HOUR, jumps=1),
    'clock forward 1 h': partial(clock_set, by=HOUR, jumps=0), 'clock steps': clock_step,
    'resets': resets, 'updates at random': random_updates, 'three of these': several}
# Faults that leave the clock and the units alone.
TOGETHER = (outliers, outages, null_island, no_fix, unknown_status, broken_gnss,
            unknown_covariance, nonsense_covariance, small_covariance, one_stamp, late_gnss,
            too_late_gnss, imu_duplicates, imu_out_of_order, imu_missing, imu_gap, imu_broken,
            resets, random_updates)
