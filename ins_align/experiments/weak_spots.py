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
Experiments ``weak-spots`` and ``vehicle``: where an alignment is easily wrong with small sigmas.

Searches have found the weak spots one by one; here each is a row of one table, so that versions
can be compared. ``vehicle`` simulates cars on straight roads and in streets, and motions that
contradict the parameter ``vehicle``; if there are recordings it aligns the recorded car too.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product
import math
from pathlib import Path
from typing import Any

from ins_align.config import CHIP_THRESHOLDS, PRESETS
from ins_align.experiments.common import (
    aligned_row, Case, Groups, JsonDict, parallel, Report, run_case, run_cases)
from ins_align.experiments.spoilt import directions, GNSS, Random, SECOND, Stream
from ins_align.geometry.rotation import Array
from ins_align.simulation.simulate import gauss_markov
import numpy as np

DURATION = 90.0         # s, unless a case says otherwise
RECORDING = 'car_drive0708'
MOUNT_STD_DEG = 1.0     # of pitch and yaw


# What spoils a stream. IMU samples keep their arrival, which is when they were measured.

def _spells(random: Random, time: Array, length: tuple[float, float],
            apart: tuple[float, float]) -> Iterator[np.ndarray]:
    """Yield the indices of times (s) in windows; their lengths and distances are from ranges."""
    start = random.uniform(*apart)
    while start < time[-1]:
        end = start + random.uniform(*length)
        yield np.flatnonzero((time >= start) & (time < end))
        start = end + random.uniform(*apart)


def _told_lever(stream: Stream, random: Random, off: float) -> None:
    """Configure a lever arm that is `off` m away from the true one, [1 1 1] m."""
    stream.config['lever_arm'] = tuple(1.0 + off * directions(random, 1)[0])


def _states(stream: Stream, random: Random, std: float) -> None:
    """State a wrong sigma of the velocities, m/s."""
    stream.velocity['covariance'] = std ** 2 * np.eye(3)


def _lasting(stream: Stream, random: Random, time_s: float) -> None:
    """Add first-order Gauss-Markov errors of 0.1 m/s to velocities, and state that sigma."""
    _states(stream, random, 0.1)
    stream.velocity['velocity'] += gauss_markov(stream.seconds('velocity'), 0.1, time_s, random)


def _stepping(stream: Stream, random: Random) -> None:
    """Add noise to velocities whose sigma changes every 10 to 60 s; state the middle one."""
    _states(stream, random, 0.1)
    for chosen in _spells(random, stream.seconds('velocity'), (10.0, 60.0), (0.0, 0.0)):
        stream.add_error('velocity', chosen, random.choice([0.03, 0.1, 0.5])
                         * random.standard_normal((len(chosen), 3)))


def _multipath(stream: Stream, random: Random, size: float, name: str = 'velocity') -> None:
    """Add an error of one size and random direction for 5 to 15 s, every 20 to 100 s."""
    for chosen in _spells(random, stream.seconds(name), (5.0, 15.0), (20.0, 100.0)):
        stream.add_error(name, chosen, size * directions(random, 1))


def _positions(stream: Stream, random: Random, offsets: float = 0.0, stated: float = 0.0) -> None:
    """Send no velocities; state another sigma of positions (m), or add errors (m) at times."""
    stream.velocity = stream.velocity[:0]
    if stated:
        stream.fix['covariance'] = np.diag([stated, stated, 2 * stated]) ** 2
    if offsets:
        _multipath(stream, random, offsets, 'fix')


def _resent(stream: Stream, random: Random) -> None:
    """Measure at every fifth epoch only, and repeat that measurement at the others."""
    measured = np.arange(len(stream.fix)) // 5 * 5
    stream.fix['lla'] = stream.fix['lla'][measured]
    stream.velocity['velocity'] = stream.velocity['velocity'][measured]


def _tunnels(stream: Stream, random: Random) -> None:
    """Lose the fix for 60 to 150 s at a time, and repeat the last position and velocity."""
    for chosen in _spells(random, stream.seconds('fix'), (60.0, 150.0), (30.0, 90.0)):
        stream.fix['status'][chosen] = -1
        stream.fix['lla'][chosen] = stream.fix['lla'][chosen[:1]]
        stream.velocity['velocity'][chosen] = stream.velocity['velocity'][chosen[:1]]


def _looking(stream: Stream, random: Random) -> None:
    """Have no fix for 20 s: the position is 0, 0 and the velocity 0."""
    early = stream.seconds('fix') < 20.0
    stream.fix['status'][early] = -1
    stream.fix['lla'][early] = stream.velocity['velocity'][early] = 0.0


def _bunches(stream: Stream, random: Random) -> None:
    """Stamp the IMU samples of a bunch when they are read: from its last one on, 60 us apart."""
    size, k = random.integers(2, 6), np.arange(len(stream.imu))
    last = np.minimum(k // size * size + size - 1, len(k) - 1)
    stream.stamp_imu(stream.imu['stamp'][last] + k % size * 60_000)


def _late_stamps(stream: Stream, random: Random, mean_s: float) -> None:
    """Stamp IMU samples late by exponentially distributed times, without reordering them."""
    late = np.rint(random.exponential(mean_s * SECOND, len(stream.imu))).astype(np.int64)
    stream.stamp_imu(np.maximum.accumulate(stream.imu['stamp'] + late) + np.arange(len(late)))


def _one_stamp(stream: Stream, random: Random, at_s: float, wild_s: float = 0.0) -> None:
    """Set the IMU stamp at a time ahead by `wild_s`; if that is 0, all later ones repeat it."""
    k, stamps = int(np.searchsorted(stream.seconds('imu'), at_s)), stream.imu['stamp'].copy()
    stamps[k:k + 1 if wild_s else None] = stamps[k] + round(wild_s * SECOND)
    stream.stamp_imu(stamps)


def _gnss_clock(stream: Stream, random: Random, at_s: float = 0.0, by_s: float = 0.0,
                part: float = 0.0) -> None:
    """Shift stamps and arrivals of GNSS by `by_s` from `at_s` on, and let them drift by `part`."""
    for rows in stream.fix, stream.velocity:
        since = rows['arrival'] - stream.first
        late = np.where(since >= at_s * SECOND, round(by_s * SECOND), 0)
        for time in 'stamp', 'arrival':
            rows[time] += late + np.rint(part * since).astype(np.int64)


def _parked(stream: Stream, random: Random, at_s: float, hours: float) -> None:
    """Let hours pass without messages; gyro biases drift by the random walk of the preset."""
    for name in 'imu', *GNSS:
        getattr(stream, name)['stamp'][stream.seconds(name) >= at_s] += round(
            3600 * hours) * SECOND
    stream.stamp_imu(stream.imu['stamp'])
    drift_std = PRESETS['mems'].rate_random_walk * math.sqrt(3600 * hours)
    stream.imu['gyro'][stream.seconds('imu') >= at_s] += drift_std * random.standard_normal(3)


def _gaps(stream: Stream, random: Random, length: tuple[float, float]) -> None:
    """Drop IMU samples every 10 s; the lengths of the gaps are from a range (s)."""
    lost = _spells(random, stream.seconds('imu'), length, (10.0, 10.0))
    stream.imu = np.delete(stream.imu, np.concatenate([np.zeros(0, np.intp), *lost]))


def _warm_up(stream: Stream, random: Random) -> None:
    """Let gyro biases approach 0.5 deg/s with a time constant of 60 s."""
    drift = math.radians(0.5) * (1.0 - np.exp(-stream.seconds('imu') / 60.0))
    stream.imu['gyro'] += drift[:, None] * random.choice([-1.0, 1.0], 3)


def _vibration(stream: Stream, random: Random, start_s: float = 0.0, force: float = 1.0,
               rate_deg: float = 3.0, tone_hz: float = 0.0) -> None:
    """Add vibration (rms in m/s^2 and deg/s) from a time on, white or of one frequency."""
    time = stream.seconds('imu')[:, None]
    for name, size in ('gyro', math.radians(rate_deg)), ('accel', force):
        wave = random.standard_normal((len(time), 3))
        if tone_hz:
            wave = math.sqrt(2.0) * np.sin(2 * np.pi * (tone_hz * time + random.random(3)))
        stream.imu[name] += size * wave * (time >= start_s)


def _bias_jump(stream: Stream, random: Random, sensor: str, size: float, at_s: float,
               axes: int = 1) -> None:
    """Change the bias of a sensor at a time by plus or minus `size`, on some of its axes."""
    later = np.flatnonzero(stream.seconds('imu') >= at_s)
    chosen = random.permutation(3)[:axes]
    stream.imu[sensor][np.ix_(later, chosen)] += size * random.choice([-1.0, 1.0], axes)


def _velocities_within(stream: Stream, random: Random, start_s: float, end_s: float) -> None:
    time = stream.seconds('velocity')
    stream.keep('velocity', (time >= start_s) & (time < end_s))


def _send_nan(stream: Stream, random: Random, name: str, field: str, axis: int,
              start_s: float = 0.0) -> None:
    getattr(stream, name)[field][stream.seconds(name) >= start_s, axis] = np.nan


def _half_rates(stream: Stream, random: Random) -> None:
    stream.imu['gyro'] *= 0.5


def _late_gyros(stream: Stream, random: Random) -> None:
    stream.imu['gyro'][2:] = stream.imu['gyro'][:-2].copy()


CAR, FLIGHT, HOVER, LAUNCH = (((scenario, 'mems'),)
                              for scenario in ('car', 'flight', 'hover', 'launch'))
MIXED = tuple(product(('flight', 'car', 'hover'), ('mems', 'tactical')))
CHIPS = tuple((scenario, 'chip') for scenario in ('car', 'flight', 'launch', 'hover'))
OF_CHIPS = {'imu_grade': 'chip', **CHIP_THRESHOLDS}
CERTAIN = {'gnss_delay_std': 0.0, 'lever_arm_std': 0.05}   # configured as known
LONG, LONGER, QUARTER_HOUR = {'duration': 120.0}, {'duration': 150.0}, {'duration': 900.0}
NOISELESS = {'velocity_std': 0.0}       # what spoils the messages adds the noise
RTK, WANDERING = {'position_std': 0.05}, {'position_std': 0.5, 'position_drift_std': 1.5}
AWAY = {'duration': 300.0, 'outages': ((60.0, 300.0),)}
GARAGE = {'duration': 2040.0, 'stand_still': 1980.0, 'outages': ((0.55, 1980.0),)}
BUMPY = {'duration': 390.0, 'stand_still': 300.0, 'gnss_delay': 0.15}

SPOTS = tuple(case._replace(simulate={'duration': DURATION, **case.simulate}) for case in (
    Case('nothing wrong', MIXED),
    Case('a throw, nothing wrong', LAUNCH),
    Case('a chip, nothing wrong', CHIPS, None, {}, OF_CHIPS),
    *(Case(f'a chip, {rest:g} s at rest before', CHIPS, None,
           {'duration': rest + 90.0, 'stand_still': rest}, OF_CHIPS, part=part)
      for rest, part in ((20.0, 1), (120.0, 2))),
    # Wrong configurations
    Case('told for certain, and right', MIXED, config=CERTAIN),
    *(Case(f'told for certain, delay {by:g} s off', MIXED, simulate={'gnss_delay': by},
           config=CERTAIN) for by in (0.05, 0.1, 0.2)),
    *(Case(f'told for certain, lever arm {off:g} m off', MIXED, partial(_told_lever, off=off),
           config=CERTAIN) for off in (1.0, 2.0)),
    Case('MEMS told to be tactical', CAR + FLIGHT, None, LONG, {'imu_grade': 'tactical'}),
    Case('tactical told to be navigation', (('car', 'tactical'), ('flight', 'tactical')), None,
         LONG, {'imu_grade': 'navigation'}),
    # Noise of GNSS
    *(Case(f'velocity errors that last {time:g} s', MIXED, partial(_lasting, time_s=time),
           NOISELESS) for time in (1.0, 2.0)),
    Case('velocity errors that last 1 s, at 20 Hz', MIXED, partial(_lasting, time_s=1.0),
         {**NOISELESS, 'gnss_rate': 20.0}),
    Case('multipath: 0.5 m/s for 5 to 15 s, every 20 to 100 s', CAR,
         partial(_multipath, size=0.5), QUARTER_HOUR, part=4),
    Case('velocities of 0.03, 0.1, 0.5 m/s in turn, stated 0.1', CAR, _stepping,
         {**QUARTER_HOUR, **NOISELESS}, part=4),
    Case('vertical velocity 10 times as noisy as stated', CAR, partial(_states, std=0.1),
         {'velocity_std_vertical': 1.0}),
    *(Case(f'{rest / 60:g} min at rest, noise {factor:g} times as stated', CAR + LAUNCH,
           partial(_states, std=0.1 / factor),
           {'duration': rest + 60.0, 'stand_still': rest}, part=part)
      for rest, part in ((120.0, 2), (600.0, 6)) for factor in (1.2, 1.5)),
    Case('positions alone, wander by 1.5 m, stated 0.5 m', CAR + FLIGHT, _positions,
         {**LONG, **WANDERING}),
    Case('positions alone, wander by 1.5 m, stated so', CAR + FLIGHT,
         partial(_positions, stated=1.58), {**LONG, **WANDERING}),
    Case('positions alone, 5 m off for 5 to 15 s, stated 0.05 m', CAR + FLIGHT,
         partial(_positions, offsets=5.0), {**LONG, **RTK}),
    # GNSS that comes and goes
    Case('GNSS every 5 s, navigation grade', (('flight', 'navigation'),), None,
         {'gnss_rate': 0.2, 'duration': 100.0}),
    Case('1 Hz sent again at 5 Hz', CAR + FLIGHT, _resent),
    Case('no GNSS for two minutes from 15 s on', CAR + FLIGHT + HOVER, None,
         {'duration': 170.0, 'outages': ((15.0, 135.0),)}),
    Case('GNSS stays away after 60 s', CAR + FLIGHT, None, AWAY, part=3),
    Case('GNSS stays away after 60 s, vif', (('flight', 'tactical'),), None,
         {**AWAY, 'duration': 600.0, 'outages': ((60.0, 600.0),)}, {'method': 'vif'}, part=6),
    Case('tunnels of 60 to 150 s, last velocity beside no fix', CAR, _tunnels,
         {'duration': 600.0}, part=4),
    Case('no fix at 0, 0 for 20 s', CAR + FLIGHT, _looking),
    Case('three epochs, then 33 min in a garage', CAR, None, GARAGE, part=12),
    Case('velocities stop after 30 s, positions 1 m', CAR,
         partial(_velocities_within, start_s=0.0, end_s=30.0), {**LONGER, 'position_std': 1.0}),
    Case('velocities from 5 s on, positions wander', HOVER,
         partial(_velocities_within, start_s=5.0, end_s=math.inf), WANDERING),
    Case('vertical velocity is no number', CAR + FLIGHT,
         partial(_send_nan, name='velocity', field='velocity', axis=2)),
    # Clocks
    Case('IMU stamped in bunches of 2 to 5', CAR + FLIGHT, _bunches),
    Case('IMU stamped late by 4 ms, exponential', CAR + FLIGHT,
         partial(_late_stamps, mean_s=0.004)),
    Case('one IMU stamp 5 s ahead', CAR + FLIGHT, partial(_one_stamp, at_s=50.5, wild_s=5.0)),
    Case('IMU stamps stand still after 60 s', CAR + FLIGHT, partial(_one_stamp, at_s=60.0)),
    Case('delay steps by 80 ms at 60 s', HOVER, partial(_gnss_clock, at_s=60.0, by_s=0.08),
         LONG),
    Case('clocks drift apart by 100 ppm', CAR + FLIGHT, partial(_gnss_clock, part=1e-4),
         QUARTER_HOUR, part=4),
    # The IMU
    Case('IMU sends no numbers after 60 s', CAR + FLIGHT,
         partial(_send_nan, name='imu', field='gyro', axis=1, start_s=60.0)),
    Case('parked for 3 h, IMU silent, biases walked', FLIGHT,
         partial(_parked, at_s=60.0, hours=3.0), LONG),
    Case('IMU losses of 50 to 450 ms every 10 s', CAR, partial(_gaps, length=(0.05, 0.45)),
         LONG),
    Case('IMU losses of 50 to 600 ms, attitude between epochs', LAUNCH + FLIGHT,
         partial(_gaps, length=(0.05, 0.6)), between=True),
    Case('nothing wrong, attitude between epochs', LAUNCH + FLIGHT + HOVER, between=True),
    *(Case(f'gyros warm up by 0.5 deg/s in 60 s, {motions[0][0]}', motions, _warm_up, LONG)
      for motions in (CAR, FLIGHT)),
    *(Case(f'white vibration, 1 m/s^2 and 3 deg/s, from {start:g} s on', CAR + FLIGHT,
           partial(_vibration, start_s=start), LONGER) for start in (0.0, 25.0, 85.0)),
    Case('vibration at 27 Hz, IMU at 25 Hz', CAR + FLIGHT, partial(_vibration, tone_hz=27.0),
         {'imu_rate': 25.0}),
    Case('5 min at rest, vibration 0.2 m/s^2 and 0.3 deg/s, delay 0.15 s', CAR + LAUNCH,
         partial(_vibration, force=0.2, rate_deg=0.3), BUMPY, part=4),
    *(Case(f'gyro {axis} alone reversed, {motions[0][0]}', motions, None, {'flip_gyro': axis})
      for axis, motions in (('x', LAUNCH), ('z', LAUNCH), ('z', CAR))),
    Case('gyros with half their rates', CAR, _half_rates),
    Case('gyros 20 ms later than accelerometers', LAUNCH, _late_gyros),
    *(Case(f'gyro bias jumps by 0.1 deg/s at {at_s:g} s, {axes} of 3', CAR, partial(
        _bias_jump, sensor='gyro', size=np.radians(0.1), at_s=at_s, axes=axes), LONG)
      for axes, at_s in ((1, 60.0), (3, 30.0))),
    Case('accelerometer bias jumps by 0.1 m/s^2 at 60 s, 1 of 3', HOVER,
         partial(_bias_jump, sensor='accel', size=0.1, at_s=60.0), LONG),
))


# The motion of a vehicle as a constraint

def _mounted(seed: int, mount_deg: tuple[float, ...] = ()) -> JsonDict:
    """Draw the course and, unless it is given, the mounting error (roll, pitch, yaw; deg)."""
    random = np.random.default_rng([8, seed])
    drawn = MOUNT_STD_DEG * random.standard_normal(3) * [0.0, 1.0, 1.0]
    return {'heading_deg': float(random.uniform(-180.0, 180.0)),
            'mount_rpy_deg': mount_deg or drawn.tolist()}


def _vehicle(name: str, scenario: str, arguments: JsonDict, vehicle: str = 'car',
             mount_deg: tuple[float, ...] = (), trust: bool = True) -> Case:
    """Return a case of `vehicle`; the sigma of the mounting error is configured."""
    return Case(name, ((scenario, 'mems'),), None, arguments, {
        'vehicle': vehicle, 'mount_yaw_std': MOUNT_STD_DEG, 'trust_imu_axes': trust,
        'heading_std_threshold': 2.0}, drawn=partial(_mounted, mount_deg=mount_deg))


ROAD, STREETS, OFF = {'duration': 40.0}, {'duration': 60.0}, (0.0, 0.0, 5.0)
VEHICLE_SPOTS = (
    _vehicle('straight road, 10 m/s', 'highway', ROAD),
    _vehicle('the same, vehicle: none', 'highway', ROAD, 'none'),
    _vehicle('the same, axes not trusted', 'highway', ROAD, trust=False),
    _vehicle('the same, 10 s at rest before', 'highway', {'duration': 50.0, 'stand_still': 10.0}),
    _vehicle('the same, boat', 'highway', ROAD, 'boat'),
    _vehicle('streets', 'car', STREETS),
    _vehicle('streets, vehicle: none', 'car', STREETS, 'none'),
    _vehicle('backing out, then streets', 'reverse', STREETS),
    _vehicle('flight with 8 deg of crab, aeroplane', 'flight', {**STREETS, 'crab_deg': 8.0},
             'aeroplane'),
    _vehicle('boat that yaws by 20 deg, boat', 'swing', STREETS, 'boat'),
    # Motions and mountings that contradict the configuration
    _vehicle('streets, mounted 5 deg off', 'car', STREETS, mount_deg=OFF),
    _vehicle('straight road, mounted 5 deg off', 'highway', ROAD, mount_deg=OFF),
    _vehicle('streets backwards', 'car', {**STREETS, 'crab_deg': 180.0}),
    _vehicle('a drift of 20 deg to and fro', 'swing', STREETS),
    _vehicle('towed 70 deg across', 'car', {**STREETS, 'crab_deg': 70.0}),
    _vehicle('on a ferry, 70 deg across, in waves', 'swing', {**STREETS, 'crab_deg': 70.0}),
)
# Configurations with which the recorded car is aligned.
RECORDED: dict[str, JsonDict] = {
    'none': {}, 'vehicle: car': {'vehicle': 'car'},
    'vehicle: car, heading_std_threshold: 2': {'vehicle': 'car', 'heading_std_threshold': 2.0}}


# Runs

def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``weak-spots``."""
    found = run_cases(run_case, SPOTS, runs, jobs)
    report.text(
        f'{runs} runs of each case, fewer where they are long, of {DURATION:g} s unless the case '
        'needs more. Car and flight alternate, or hover, throw or all of these; MEMS grade unless '
        'the case says otherwise; nothing is configured but what it says.')
    report.table('Weak spots', [aligned_row(*each) for each in found])
    return {'runs': runs, 'cases': dict(found)}


def run_vehicle(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``vehicle``, with the recorded car if `data` has it."""
    from ins_align.experiments.recordings import (
        declared_row, recordings_in, run_window, STEP, windows_of)

    paths = recordings_in(data, f'{RECORDING}*')[:1] if data else []
    found = run_cases(run_case, VEHICLE_SPOTS, runs, jobs)
    report.text(
        f'{runs} runs of each case, MEMS, GNSS velocity 0.1 m/s at 5 Hz, the mounting off by '
        f'{MOUNT_STD_DEG:g} deg (1 sigma, pitch and yaw) and stated so, `vehicle: car` unless the '
        'case says otherwise, `trust_imu_axes` and a heading threshold of 2 deg. Columns as in '
        'weak-spots; "not used": the runs at whose end the reason says that the motion '
        'contradicts `vehicle`.')
    report.table('Simulated', [{**aligned_row(name, group), 'not used': sum(
        'contradicts vehicle' in each['reason'] for each in group)} for name, group in found])
    recorded: Groups = []
    for path in paths:
        recorded = list(zip(RECORDED, parallel(
            run_window, [windows_of(path, config) for config in RECORDED.values()], jobs,
            'recorded car')))
        report.table(f'The recorded car, started anew every {STEP:g} s',
                     [declared_row(*each) for each in recorded])
    return {'runs': runs, 'cases': dict(found), 'recorded': dict(recorded)}
