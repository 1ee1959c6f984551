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
Disturbances that last, put into the messages of a simulation: of sensors, receivers and clocks.

Each changes a `Stream` in place and leaves the ``arrival`` of an IMU sample, which is when it was
measured. Those of `ins_align.experiments.spoilt` are mistakes of drivers; these are harder to see.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
import math

from ins_align.config import PRESETS
from ins_align.experiments.spoilt import Random, SECOND, Stream
from ins_align.geometry.rotation import Array
from ins_align.simulation.trajectory import displaced
import numpy as np


def _time(rows: np.ndarray, stream: Stream) -> Array:
    return np.asarray((rows['arrival'] - stream.first) / SECOND)


def _spells(random: Random, time: Array, length: tuple[float, float],
            apart: tuple[float, float]) -> Iterator[np.ndarray]:
    """Yield the places of what lies in each of the windows of such lengths, so far apart."""
    start = random.uniform(*apart)
    while start < time[-1]:
        end = start + random.uniform(*length)
        yield np.flatnonzero((time >= start) & (time < end))
        start = end + random.uniform(*apart)


def bunches(stream: Stream, random: Random) -> None:
    """Stamp 2 to 5 IMU samples when the last of them is read, 60 us apart."""
    size, k = random.integers(2, 6), np.arange(len(stream.imu))
    last = np.minimum(k // size * size + size - 1, len(k) - 1)
    stream.imu['stamp'] = stream.imu['stamp'][last] + k % size * 60_000


def late_stamps(stream: Stream, random: Random, mean_s: float) -> None:
    """Stamp IMU samples when the computer gets round to it, in their order."""
    late = np.rint(random.exponential(mean_s * SECOND, len(stream.imu))).astype(np.int64)
    stream.imu['stamp'] = np.maximum.accumulate(stream.imu['stamp'] + late) + np.arange(len(late))


def one_stamp(stream: Stream, random: Random, at_s: float, wild_s: float = 0.0) -> None:
    """Put one IMU stamp into the future; or let all be the same from some time on."""
    k = int(np.searchsorted(_time(stream.imu, stream), at_s))
    stream.imu['stamp'][k:k + 1 if wild_s else None] = (
        stream.imu['stamp'][k] + round(wild_s * SECOND))


def no_numbers(stream: Stream, random: Random, at_s: float) -> None:
    """Send an angular rate that is no number from some time on."""
    stream.imu['gyro'][_time(stream.imu, stream) >= at_s, 1] = np.nan


def gaps(stream: Stream, random: Random, length: tuple[float, float]) -> None:
    """Lose all IMU samples for a while, every 10 s."""
    lost = _spells(random, _time(stream.imu, stream), length, (10.0, 10.0))
    stream.imu = np.delete(stream.imu, np.concatenate([np.zeros(0, np.intp), *lost]))


def parked(stream: Stream, random: Random, at_s: float, hours: float) -> None:
    """Let the clock go on for hours without a message; biases walk as the preset says."""
    for rows in stream.imu, stream.fix, stream.velocity:
        rows['stamp'][_time(rows, stream) >= at_s] += round(3600 * hours) * SECOND
    walked = PRESETS['mems'].rate_random_walk * math.sqrt(3600 * hours)
    stream.imu['gyro'][_time(stream.imu, stream) >= at_s] += walked * random.standard_normal(3)


def warm_up(stream: Stream, random: Random) -> None:
    """Let all gyroscopes drift to 0.5 deg/s, either way, with a time constant of 60 s."""
    drift = math.radians(0.5) * (1.0 - np.exp(-_time(stream.imu, stream) / 60.0))
    stream.imu['gyro'] += drift[:, None] * random.choice([-1.0, 1.0], 3)


def vibration(stream: Stream, random: Random, start_s: float = 0.0, force: float = 1.0,
              rate_deg: float = 3.0, tone_hz: float = 0.0) -> None:
    """Shake the IMU from a time on, white or with one tone; sizes are 1 sigma."""
    time = _time(stream.imu, stream)[:, None]
    for name, size in ('gyro', math.radians(rate_deg)), ('accel', force):
        wave = random.standard_normal((len(time), 3))
        if tone_hz:
            wave = math.sqrt(2.0) * np.sin(2 * np.pi * (tone_hz * time + random.random(3)))
        stream.imu[name] += size * wave * (time >= start_s)


def bias_jump(stream: Stream, random: Random, sensor: str, size: float, at_s: float,
              axes: int = 1) -> None:
    """Let the biases of one sensor or more of the three jump, either way."""
    later = np.flatnonzero(_time(stream.imu, stream) >= at_s)
    chosen = random.permutation(3)[:axes]
    stream.imu[sensor][np.ix_(later, chosen)] += size * random.choice([-1.0, 1.0], axes)


def late_gyros(stream: Stream, random: Random) -> None:
    """Send rates that are two samples older than the accelerations."""
    stream.imu['gyro'][2:] = stream.imu['gyro'][:-2].copy()


def half_rates(stream: Stream, random: Random) -> None:
    """Set gyroscopes to half the range that the driver takes for theirs."""
    stream.imu['gyro'] *= 0.5


def delay_step(stream: Stream, random: Random, at_s: float, by_s: float) -> None:
    """Stamp GNSS later, and send it later, from some time on."""
    for rows in stream.fix, stream.velocity:
        for name in 'stamp', 'arrival':
            rows[name] += np.where(_time(rows, stream) >= at_s, round(by_s * SECOND), 0)


def clock_drift(stream: Stream, random: Random, part: float) -> None:
    """Let the clock of GNSS run fast."""
    for rows in stream.fix, stream.velocity:
        for name in 'stamp', 'arrival':
            rows[name] += np.rint(part * (rows['arrival'] - stream.first)).astype(np.int64)


def states(stream: Stream, random: Random, std: float, vertical: float = 0.0) -> None:
    """State another noise of the velocities than they have."""
    stream.velocity['covariance'] = np.diag([std, std, vertical or std]) ** 2


def lasting(stream: Stream, random: Random, time_s: float, std: float = 0.1) -> None:
    """Add to velocities without noise one of first order, and state its size."""
    states(stream, random, std)
    errors = std * random.standard_normal((len(stream.velocity), 3))
    rho = math.exp(-0.2 / time_s)
    for before, error in pairwise(errors):
        error *= math.sqrt(1.0 - rho ** 2)
        error += rho * before
    stream.velocity['velocity'] += errors


def stepping(stream: Stream, random: Random) -> None:
    """Add to velocities without noise one of steps of 10 to 60 s, and state the middle one."""
    states(stream, random, 0.1)
    for chosen in _spells(random, _time(stream.velocity, stream), (10.0, 60.0), (0.0, 0.0)):
        stream.velocity['velocity'][chosen] += (
            random.choice([0.03, 0.1, 0.5]) * random.standard_normal((len(chosen), 3)))


def multipath(stream: Stream, random: Random, size: float, *, position: bool = False) -> None:
    """Put velocities or positions off in one direction for 5 to 15 s, every 20 to 100 s."""
    rows = stream.fix if position else stream.velocity
    for chosen in _spells(random, _time(rows, stream), (5.0, 15.0), (20.0, 100.0)):
        away = random.standard_normal(3)
        away *= size / np.linalg.norm(away)
        if position:
            rows['lla'][chosen] = displaced(rows['lla'][chosen], np.tile(away, (len(chosen), 1)))
        else:
            rows['velocity'][chosen] += away


def tunnels(stream: Stream, random: Random) -> None:
    """Repeat the last message, the fix as none, for 60 to 150 s, every 30 to 90 s."""
    for chosen in _spells(random, _time(stream.fix, stream), (60.0, 150.0), (30.0, 90.0)):
        stream.fix['status'][chosen] = -1
        stream.fix['lla'][chosen] = stream.fix['lla'][chosen[:1]]
        stream.velocity['velocity'][chosen] = stream.velocity['velocity'][chosen[:1]]


def looking(stream: Stream, random: Random) -> None:
    """Look for satellites for 20 s: no fix at 0, 0, which stands still."""
    early = _time(stream.fix, stream) < 20.0
    stream.fix['status'][early] = -1
    stream.fix['lla'][early] = stream.velocity['velocity'][early] = 0.0


def resent(stream: Stream, random: Random) -> None:
    """Send each fifth epoch five times with new stamps."""
    slow = np.arange(len(stream.fix)) // 5 * 5
    stream.fix['lla'] = stream.fix['lla'][slow]
    stream.velocity['velocity'] = stream.velocity['velocity'][slow]


def velocities(stream: Stream, random: Random, first_s: float = 0.0,
               last_s: float = math.inf) -> None:
    """Send velocities only between two times."""
    time = _time(stream.velocity, stream)
    stream.velocity = stream.velocity[(time >= first_s) & (time < last_s)]


def positions(stream: Stream, random: Random, offsets: float = 0.0, stated: float = 0.0) -> None:
    """Send no velocities; state another noise of the positions, put them off in spells."""
    stream.velocity = stream.velocity[:0]
    if stated:
        stream.fix['covariance'] = np.diag([stated, stated, 2 * stated]) ** 2
    if offsets:
        multipath(stream, random, offsets, position=True)


def no_vertical(stream: Stream, random: Random) -> None:
    """Send a vertical velocity that is no number."""
    stream.velocity['velocity'][:, 2] = np.nan


def told_lever(stream: Stream, random: Random, off: float) -> None:
    """Tell a lever arm that is off in some direction; the true one is 1, 1, 1."""
    away = random.standard_normal(3)
    stream.config['lever_arm'] = tuple(1.0 + off * away / np.linalg.norm(away))
