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
Experiment ``weak-spots``: the cases in which an alignment is most easily wrong and sure of itself.

Searches have found them one by one; here each is a row of one table, so that versions can be
compared. An aligner is asked nothing but what everybody can ask it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Aligner, Attitude, Epoch, State
from ins_align.config import Config
from ins_align.experiments import disturbances as of
from ins_align.experiments import recordings
from ins_align.experiments.common import BINS, config_for, error_of, JsonDict, parallel, Report
from ins_align.experiments.spoilt import SECOND, Stream, stream_of
from ins_align.geometry.rotation import Array
from ins_align.gnss.messages import Fix, Velocity
from ins_align.simulation.simulate import give, simulate, Simulation
import numpy as np

RUNS = 24
DURATION = 90.0         # s, unless a case says otherwise
LOT = 100               # IMU samples given at once
UPDATE_EVERY = 5.0      # s
LONGEST = 5.0           # s that an epoch stands for
RECORDING, STARTS = 'car_drive0708', (0.0, 100.0, 200.0, 300.0, 400.0)      # s
HEADER = ('case', 'runs', 'declared', 'at the end', 'declared beyond 3', 'beyond 3', 'beyond 5',
          'beyond 5, s', 'worst, sigma', 'heading, deg', 'aligned, %', 'after, s')

Message = tuple[int, str, Any]      # when it arrives, ns, what it is, and itself


class Case(NamedTuple):
    """
    One row of the table.

    Attributes
    ----------
    name : str
    motions : tuple of pairs
        Scenario and grade of IMU, run in turn.
    spoil : callable, optional
        Changes a `Stream`, with a random generator.
    simulate, config : dict
        Arguments of `simulate`, and what the aligner is told in place of the truth.
    part : int
        There are so many times fewer runs, because they are long.
    between : bool
        The attitude between epochs is judged.

    """

    name: str
    motions: tuple[tuple[str, str], ...]
    spoil: Callable[[Stream, np.random.Generator], None] | None = None
    simulate: JsonDict = {}
    config: JsonDict = {}
    part: int = 1
    between: bool = False


CAR, FLIGHT, HOVER, LAUNCH = (((scenario, 'mems'),)
                              for scenario in ('car', 'flight', 'hover', 'launch'))
MIXED = tuple(product(('flight', 'car', 'hover'), ('mems', 'tactical')))
TOLD = {'gnss_delay_std': 0.0, 'lever_arm_std': 0.05}
LONG, LATER, HOURS = {'duration': 120.0}, {'duration': 150.0}, {'duration': 900.0}
EXACT = {'velocity_std': 0.0}           # noise is added by what spoils it
RTK, WANDERING = {'position_std': 0.05}, {'position_std': 0.5, 'position_drift_std': 1.5}
AWAY = {'duration': 300.0, 'outages': ((60.0, 300.0),)}
GARAGE = {'duration': 2040.0, 'stand_still': 1980.0, 'outages': ((0.55, 1980.0),)}
BUMPY = {'duration': 390.0, 'stand_still': 300.0, 'gnss_delay': 0.15}

CASES = (
    Case('nothing wrong', MIXED),
    Case('a throw, nothing wrong', LAUNCH),
    # Told wrongly
    Case('told for certain, and right', MIXED, config=TOLD),
    *(Case(f'told for certain, delay {by:g} s off', MIXED, simulate={'gnss_delay': by},
           config=TOLD) for by in (0.05, 0.1, 0.2)),
    *(Case(f'told for certain, lever arm {off:g} m off', MIXED, partial(of.told_lever, off=off),
           config=TOLD) for off in (1.0, 2.0)),
    Case('MEMS told to be tactical', CAR + FLIGHT, None, LONG, {'imu_grade': 'tactical'}),
    Case('tactical told to be navigation', (('car', 'tactical'), ('flight', 'tactical')), None,
         LONG, {'imu_grade': 'navigation'}),
    # Noise of GNSS
    *(Case(f'velocity errors that last {time:g} s', MIXED, partial(of.lasting, time_s=time),
           EXACT) for time in (1.0, 2.0)),
    Case('multipath: 0.5 m/s for 5 to 15 s, every 20 to 100 s', CAR,
         partial(of.multipath, size=0.5), HOURS, part=4),
    Case('velocities of 0.03, 0.1, 0.5 m/s in turn, stated 0.1', CAR, of.stepping,
         {**HOURS, **EXACT}, part=4),
    Case('vertical velocity 10 times as noisy as stated', CAR, partial(of.states, std=0.1),
         {'velocity_std_vertical': 1.0}),
    *(Case(f'{rest / 60:g} min at rest, noise {factor:g} times as stated', CAR + LAUNCH,
           partial(of.states, std=0.1 / factor),
           {'duration': rest + 60.0, 'stand_still': rest}, part=part)
      for rest, part in ((120.0, 2), (600.0, 6)) for factor in (1.2, 1.5)),
    Case('positions alone, wander by 1.5 m, stated 0.5 m', CAR + FLIGHT, of.positions,
         {**LONG, **WANDERING}),
    Case('positions alone, wander by 1.5 m, stated so', CAR + FLIGHT,
         partial(of.positions, stated=1.58), {**LONG, **WANDERING}),
    Case('positions alone, 5 m off for 5 to 15 s, stated 0.05 m', CAR + FLIGHT,
         partial(of.positions, offsets=5.0), {**LONG, **RTK}),
    # GNSS that comes and goes
    Case('GNSS every 5 s, navigation grade', (('flight', 'navigation'),), None,
         {'gnss_rate': 0.2, 'duration': 100.0}),
    Case('1 Hz sent again at 5 Hz', CAR + FLIGHT, of.resent),
    Case('GNSS stays away after 60 s', CAR + FLIGHT, None, AWAY, part=3),
    Case('GNSS stays away after 60 s, vif', (('flight', 'tactical'),), None,
         {**AWAY, 'duration': 600.0, 'outages': ((60.0, 600.0),)}, {'method': 'vif'}, part=6),
    Case('tunnels of 60 to 150 s, last velocity beside no fix', CAR, of.tunnels,
         {'duration': 600.0}, part=4),
    Case('no fix at 0, 0 for 20 s', CAR + FLIGHT, of.looking),
    Case('three epochs, then 33 min in a garage', CAR, None, GARAGE, part=12),
    Case('velocities stop after 30 s, positions 1 m', CAR, partial(of.velocities, last_s=30.0),
         {**LATER, 'position_std': 1.0}),
    Case('velocities from 5 s on, positions wander', HOVER, partial(of.velocities, first_s=5.0),
         WANDERING),
    Case('vertical velocity is no number', CAR + FLIGHT, of.no_vertical),
    # Clocks
    Case('IMU stamped in bunches of 2 to 5', CAR + FLIGHT, of.bunches),
    Case('IMU stamped late by 4 ms, exponential', CAR + FLIGHT,
         partial(of.late_stamps, mean_s=0.004)),
    Case('one IMU stamp 5 s ahead', CAR + FLIGHT, partial(of.one_stamp, at_s=50.5, wild_s=5.0)),
    Case('IMU stamps stand still after 60 s', CAR + FLIGHT, partial(of.one_stamp, at_s=60.0)),
    Case('delay steps by 80 ms at 60 s', HOVER, partial(of.delay_step, at_s=60.0, by_s=0.08),
         LONG),
    Case('clocks drift apart by 100 ppm', CAR + FLIGHT, partial(of.clock_drift, part=1e-4),
         HOURS, part=4),
    # The IMU
    Case('IMU sends no numbers after 60 s', CAR + FLIGHT, partial(of.no_numbers, at_s=60.0)),
    Case('parked for 3 h, IMU silent, biases walked', FLIGHT,
         partial(of.parked, at_s=60.0, hours=3.0), LONG),
    Case('IMU losses of 50 to 450 ms every 10 s', CAR, partial(of.gaps, length=(0.05, 0.45)),
         LONG),
    Case('IMU losses of 50 to 600 ms, attitude between epochs', LAUNCH + FLIGHT,
         partial(of.gaps, length=(0.05, 0.6)), between=True),
    Case('nothing wrong, attitude between epochs', LAUNCH + FLIGHT + HOVER, between=True),
    *(Case(f'gyros warm up by 0.5 deg/s in 60 s, {motions[0][0]}', motions, of.warm_up, LONG)
      for motions in (CAR, FLIGHT)),
    *(Case(f'white vibration, 1 m/s^2 and 3 deg/s, from {start:g} s on', CAR + FLIGHT,
           partial(of.vibration, start_s=start), LATER) for start in (0.0, 25.0, 85.0)),
    Case('vibration at 27 Hz, IMU at 25 Hz', CAR + FLIGHT, partial(of.vibration, tone_hz=27.0),
         {'imu_rate': 25.0}),
    Case('5 min at rest, vibration 0.2 m/s^2 and 0.3 deg/s, delay 0.15 s', CAR + LAUNCH,
         partial(of.vibration, force=0.2, rate_deg=0.3), BUMPY, part=4),
    *(Case(f'gyro {axis} alone reversed, {motions[0][0]}', motions, None, {'flip_gyro': axis})
      for axis, motions in (('x', LAUNCH), ('z', LAUNCH), ('z', CAR))),
    Case('gyros with half their rates', CAR, of.half_rates),
    Case('gyros 20 ms later than accelerometers', LAUNCH, of.late_gyros),
    *(Case(f'gyro bias jumps by 0.1 deg/s at {at_s:g} s, {axes} of 3', CAR, partial(
        of.bias_jump, sensor='gyro', size=np.radians(0.1), at_s=at_s, axes=axes), LONG)
      for axes, at_s in ((1, 60.0), (3, 30.0))),
    Case('accelerometer bias jumps by 0.1 m/s^2 at 60 s, 1 of 3', HOVER,
         partial(of.bias_jump, sensor='accel', size=0.1, at_s=60.0), LONG),
)


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run every case with `runs`, or a part of it, and those of the recording if it is there."""
    runs = runs or RUNS
    tasks = [(number, index) for number, case in enumerate(CASES)
             for index in range(max(1, runs // case.part))]
    results = parallel(run_case, tasks, jobs, 'weak spots')
    found = [(case.name, [result for task, result in zip(tasks, results) if task[0] == number])
             for number, case in enumerate(CASES)]
    paths = sorted(data_dir.glob(f'{RECORDING}*')) if data_dir else []
    found += [(f'recorded car, {name}', [run_recorded(paths[0], start, sign, told)
                                         for start in STARTS])
              for name, sign, told in (('lever arm told to 3 cm', 1.0, {'lever_arm_std': 0.03}),
                                       ('gyro z reversed', -1.0, {})) if paths]
    report = Report('weak-spots', 'Where it is wrong and sure of itself', out,
                    f' --runs {runs}' + (' --data DIR' if paths else ''))
    report.text(
        f'{runs} runs of each case, fewer where they are long, of {DURATION:g} s unless the case '
        'needs more. Car and flight in turn, or a hover, a throw, all of these; MEMS grade unless '
        'said otherwise; nothing is told to the aligner but what the case says. Errors of the '
        'current attitude against truth, the worst of tilt and heading in stated sigmas: at the '
        f'first declaration, and at any time at which it was called ALIGNED; runs beyond '
        f'{BINS[0]:g} and {BINS[1]:g}, the seconds beyond {BINS[1]:g} of the longest, the worst '
        'error in sigmas and, of heading, in degrees, the part of the time at which it was '
        'ALIGNED, and after how many seconds of data it was declared, the median.')
    if not paths:
        report.text('The recorded car is left out: --data DIR names the folder of it.')
    report.table('Weak spots', HEADER, [row(*case) for case in found])
    report.write({'runs': runs, 'cases': dict(found)})


def run_case(task: tuple[int, int]) -> JsonDict:
    """Simulate one run of a case, spoil it, feed it and judge what comes out."""
    number, index = task
    case = CASES[number]
    scenario, grade = case.motions[index % len(case.motions)]
    simulation = simulate(scenario, **{'imu_grade': grade, 'seed': index, 'duration': DURATION,
                                       **case.simulate})
    stream = stream_of(simulation)
    if case.spoil is not None:
        case.spoil(stream, np.random.default_rng([6, index]))
    aligner = Aligner(config_for(simulation, **{**stream.config, **case.config}))
    result = follow(aligner, messages(stream, 7 if case.between else LOT),
                    partial(truth, simulation, stream), case.between)
    return {'scenario': scenario, 'grade': grade, 'seed': index, **result}


def messages(stream: Stream, lot: int) -> Iterator[Message]:
    """Yield what is sent in the order of arrival, IMU samples in lots."""
    gnss: list[Message] = [
        (row['arrival'], 'fix', Fix(int(row['stamp']), *row['lla'].tolist(), row['covariance'],
                                    int(row['status']))) for row in stream.fix]
    gnss += [(row['arrival'], 'velocity', Velocity(
        int(row['stamp']), row['velocity'], row['covariance'])) for row in stream.velocity]
    gnss.sort(key=itemgetter(0))
    arrivals, place = stream.imu['arrival'], 0
    for message in [*gnss, None]:
        end = len(arrivals) if message is None else int(
            np.searchsorted(arrivals, message[0], side='right'))
        for first in range(place, end, lot):
            rows = stream.imu[first:min(first + lot, end)]
            yield rows['arrival'][-1], 'imu', (rows['stamp'], rows['gyro'], rows['accel'])
        place = end
        if message is not None:
            yield message


def truth(simulation: Simulation, stream: Stream, stamps: list[int]) -> list[Array]:
    """Return true attitudes at stamps of the IMU's clock, which may be late or set."""
    late = stream.imu['stamp'] - stream.imu['arrival']
    places = np.searchsorted(stream.imu['stamp'][::LOT], stamps) - 1
    medians = [int(np.median(late[k:k + LOT])) for k in range(0, len(late), LOT)]
    true = np.array(stamps) - np.array(medians)[np.maximum(places, 0)]
    return list(simulation.attitude_at(np.clip(true, stream.first, stream.last)))


def run_recorded(path: Path, start_s: float, z_sign: float, told: JsonDict) -> JsonDict:
    """Align a recording from some time to its end."""
    recording = recordings.load(path)
    signs = np.array([1.0, 1.0, z_sign])
    first = int(np.searchsorted(recording.imu.stamps_ns,
                                recording.start_ns + round(start_s * SECOND)))
    sent = ((now, kind, (payload[0], payload[1] * signs, payload[2]) if kind == 'imu' else payload)
            for now, kind, payload in recording.sent(first, int(recording.imu_before[-1])))
    aligner = Aligner(Config(lever_arm=recordings.KNOWN_LEVER_ARMS[RECORDING], **told))
    return {'start_s': start_s, **follow(
        aligner, sent, lambda stamps: [recording.reference.attitude_at(s) for s in stamps],
        std_deg=recording.reference_std_deg)}


def follow(aligner: Aligner, sent: Iterator[Message],
           true: Callable[[list[int]], list[Array | None]], between: bool = False,
           std_deg: Array | None = None) -> JsonDict:
    """
    Feed an aligner and judge what it declares.

    Parameters
    ----------
    aligner : Aligner
        One that has seen nothing.
    sent : iterator
        Messages in the order of arrival.
    true : callable
        Gives the true attitudes at stamps, None where they are not known.
    between : bool
        Ask for the attitude after every message instead of looking at the epochs.
    std_deg : ndarray, shape (3,), optional
        Of the truth.

    """
    seen: list[tuple[int, Attitude | None]] = []    # when, and what is called aligned then
    start = due = 0
    for now, kind, payload in sent:
        if kind == 'imu':
            start = start or int(payload[0][0])
        give(aligner, kind, payload)
        if between or now >= due:
            seen += look(aligner, aligner.update(), between)
            due = now + round(UPDATE_EVERY * SECOND)
    seen += look(aligner, aligner.flush(), between)
    stamps = np.array([stamp for stamp, _ in seen], np.int64)
    held = np.clip(np.diff(stamps, append=stamps[-1:]) / SECOND, 0.0, LONGEST)
    places = [k for k, (_, attitude) in enumerate(seen) if attitude is not None]
    attitudes = [attitude for _, attitude in seen if attitude is not None]
    known = [(k, error_of(attitude, C_true, std_deg)) for k, attitude, C_true in zip(
        places, attitudes, true([a.stamp_ns for a in attitudes]) if attitudes else [])
        if C_true is not None]
    sigmas = np.array([max(error.tilt_sigmas, error.heading_sigmas) for _, error in known])
    beyond = [k for (k, _), sigma in zip(known, sigmas) if sigma > BINS[1]]
    return {'end': aligner.status().state is State.ALIGNED,
            'declared_s': (stamps[known[0][0]] - start) / SECOND if known else None,
            'declared_sigmas': sigmas[0] if known else None,
            'worst_sigmas': np.max(sigmas, initial=0.0),
            'worst_heading_deg': max((abs(error.angles_deg[2]) for _, error in known),
                                     default=0.0),
            'beyond_s': np.sum(held[beyond]),
            'aligned_part': np.sum(held[places]) / max(np.sum(held), 1e-9)}


def look(aligner: Aligner, epochs: list[Epoch],
         between: bool) -> list[tuple[int, Attitude | None]]:
    """Return what is called aligned: of the epochs, or where there are none of the moment."""
    if epochs and not between:
        return [(epoch.stamp_ns, epoch.current if epoch.state is State.ALIGNED else None)
                for epoch in epochs]
    status, newest = aligner.status(), aligner.newest_imu_ns
    attitude = aligner.attitude_now() if between else status.current
    return [] if newest is None else [
        (newest, attitude if status.state is State.ALIGNED else None)]


def row(name: str, results: list[JsonDict]) -> list[Any]:
    """Return a row of the table."""
    declared = [result for result in results if result['declared_s'] is not None]

    def most(key: str, digits: str) -> str | None:
        return format(max(result[key] for result in declared), digits) if declared else None

    return [name, len(results), len(declared), sum(result['end'] for result in results),
            sum(result['declared_sigmas'] > BINS[0] for result in declared),
            *(sum(result['worst_sigmas'] > limit for result in declared) for limit in BINS),
            most('beyond_s', '.1f'), most('worst_sigmas', '.1f'), most('worst_heading_deg', '.2g'),
            f"{100 * np.mean([result['aligned_part'] for result in results]):.0f}",
            f"{np.median([result['declared_s'] for result in declared]):.1f}" if declared
            else None]
