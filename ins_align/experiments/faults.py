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
Experiment ``faults``: what real drivers get wrong, crossed with motions and grades of IMU.

Nothing may break: no exception, no number that is not finite, no memory that grows, no message
that is not counted; and what is declared all the same has to be right.
"""

from __future__ import annotations

import math
from pathlib import Path
import pickle
import resource
import traceback
from types import SimpleNamespace
from typing import Any
import warnings

from ins_align.aligner import Aligner, Attitude, Epoch, State
from ins_align.config import Config
from ins_align.experiments.common import (
    BINS, combination, config_for, counted, error_of, GRADES, JsonDict, parallel, Report, setup)
from ins_align.experiments.spoilt import FAULTS, SECOND, Stream, stream_of
from ins_align.gnss.messages import fix_from_msg, imu_from_msg, MessageError, velocity_from_msg
from ins_align.simulation.simulate import SCENARIOS, simulate, Simulation
import numpy as np

DURATION = 60.0
UPDATE_EVERY = 1.0  # s
WEIGH_EVERY = 5     # updates
# What an aligner may hold, pickled; the largest part does not depend on the data.
MAX_HELD = 8_000_000
# Reasons for which a message is not used.
REFUSED = {'fix': ('no_fix', 'nan', 'late', 'ahead', 'duplicate'),
           'velocity': ('nan', 'late', 'ahead', 'duplicate')}
HEADER = ('fault', 'runs', 'exceptions', 'non-finite', 'miscounted', 'declared', 'within 3',
          '3 to 5', 'beyond 5', 'worst, sigma', 'aligned beyond 5, s', 'held, MB')
# `trial` draws the first three again from the index; the counts are only looked at.
OMITTED = 'simulate', 'config', 'frame', 'counts'


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run the campaign and write its tables."""
    trials = parallel(run_trial, [trial(index) for index in range(runs or 1000)], jobs, 'faults')
    write(out, trials)


def trial(index: int) -> JsonDict:
    """
    Draw a run: what is simulated, which fault it gets and what the aligner is told.

    Returns
    -------
    dict
        ``index``, ``fault``, ``scenario``, the arguments of `simulate`, the ``frame`` of the
        velocities and those parameters of `Config` that differ from what suits the simulation.

    """
    fault, scenario, grade = combination(index, [3], FAULTS, SCENARIOS, GRADES)
    random = np.random.default_rng([4, index])
    arguments = {'imu_grade': grade, 'seed': index, 'duration': DURATION, **setup(random)}
    config = {'gnss_lateness': Config().gnss_lateness, 'velocity_type': str(random.choice(
        ['TwistWithCovarianceStamped', 'TwistStamped', 'Odometry']))}
    return {'index': index, 'fault': fault, 'scenario': scenario, 'simulate': arguments,
            'config': config, 'frame': str(random.choice(['enu', 'ned']))}


def run_trial(task: JsonDict) -> JsonDict:
    """Run what `trial` drew and look at everything that comes out."""
    simulation = simulate(task['scenario'], **task['simulate'])
    stream = stream_of(simulation, task['frame'])
    random = np.random.default_rng([5, task['index']])
    FAULTS[task['fault']](stream, random)
    aligner = Aligner(config_for(simulation, **task['config'], **stream.config))
    watch = Watch(aligner, stream)
    exception = ''
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter('always')
        try:
            feed(watch, random)
        except Exception:  # whatever it is, it is what this experiment looks for
            exception = traceback.format_exc(limit=-3)
    result: JsonDict = {**task, 'exception': exception,
                        'warnings': sorted({str(warning.message) for warning in warned}),
                        'non_finite': watch.non_finite, 'held': watch.held,
                        'resident_kb': resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}
    if not exception:
        status = aligner.status()
        result |= {'state': status.state.value, 'reason': status.reason, 'counts': status.counts,
                   'miscounted': miscounted(status.counts, stream),
                   **judged(watch.epochs, stream, simulation)}
    return result


# Feeding

def feed(watch: 'Watch', random: np.random.Generator) -> None:
    """Give the messages to the aligner in the order of arrival, one by one or in blocks."""
    stream, aligner = watch.stream, watch.aligner
    one_by_one = random.random() < 0.5
    sources = [('imu', stream.imu), ('fix', stream.fix), ('velocity', stream.velocity)]
    arrivals = [rows['arrival'] for _, rows in sources]
    arrivals += [update_times(stream, random), np.array(stream.resets, np.int64)]
    order = np.argsort(np.concatenate(arrivals), kind='stable')
    ends = np.cumsum([len(times) for times in arrivals])
    kinds = np.searchsorted(ends, order, side='right')
    places = order - (ends - [len(times) for times in arrivals])[kinds]
    cuts = np.flatnonzero(np.diff(kinds)) + 1
    for block in np.split(np.arange(len(order)), cuts) if len(order) else []:
        kind, rows = kinds[block[0]], places[block]
        if kind < 3:
            name, messages = sources[kind]
            _SEND[name](aligner, messages[rows], one_by_one)
            continue
        for _ in rows:
            watch.update()
            if kind == 4:
                aligner.reset()
    watch.take(aligner.flush())
    watch.look()
    watch.weigh()


def update_times(stream: Stream, random: np.random.Generator) -> np.ndarray:
    """When somebody looks for results."""
    end = max((int(rows['arrival'].max()) for rows in (stream.imu, stream.fix, stream.velocity)
               if len(rows)), default=stream.first)
    duration = (end - stream.first) / SECOND
    if stream.update_every == 0:
        steps = np.full(int(duration / UPDATE_EVERY) + 1, UPDATE_EVERY)
    else:
        steps = random.exponential(stream.update_every,
                                   int(2 * duration / stream.update_every) + 1)
    return stream.first + np.rint(np.cumsum(steps) * SECOND).astype(np.int64)


def _header(stamp_ns: int, frame_id: str = '') -> SimpleNamespace:
    sec, nanosec = divmod(stamp_ns, SECOND)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame_id)


def _vector(values: np.ndarray) -> SimpleNamespace:
    x, y, z = values.tolist()
    return SimpleNamespace(x=x, y=y, z=z)


def _send_imu(aligner: Aligner, rows: np.ndarray, one_by_one: bool) -> None:
    if not one_by_one:
        aligner.add_imu(rows['stamp'], rows['gyro'], rows['accel'])
        return
    for row in rows:
        aligner.add_imu(*imu_from_msg(SimpleNamespace(
            header=_header(int(row['stamp'])), angular_velocity=_vector(row['gyro']),
            linear_acceleration=_vector(row['accel']))))


def _send_fixes(aligner: Aligner, rows: np.ndarray, one_by_one: bool) -> None:
    for row in rows:
        latitude, longitude, altitude = row['lla'].tolist()
        aligner.add_fix(fix_from_msg(SimpleNamespace(
            header=_header(int(row['stamp'])), latitude=latitude, longitude=longitude,
            altitude=altitude, position_covariance=row['covariance'].ravel(),
            position_covariance_type=int(row['covariance_type']),
            status=SimpleNamespace(status=int(row['status'])))))


def _send_velocities(aligner: Aligner, rows: np.ndarray, one_by_one: bool) -> None:
    config = aligner.config
    for row in rows:
        frame_id = str(row['frame_id'])
        twist = SimpleNamespace(linear=_vector(row['velocity']))
        message = SimpleNamespace(header=_header(int(row['stamp']), frame_id), twist=twist,
                                  child_frame_id=frame_id)
        if config.velocity_type != 'TwistStamped':
            covariance = np.zeros((6, 6))
            covariance[:3, :3] = row['covariance']
            message.twist = SimpleNamespace(twist=twist, covariance=covariance.ravel())
        try:
            aligner.add_velocity(velocity_from_msg(message, config))
        except MessageError:
            aligner.reject('velocity_body_frame')


_SEND = {'imu': _send_imu, 'fix': _send_fixes, 'velocity': _send_velocities}


# What is looked at

class Watch:
    """Looks at what an aligner gives and at what it keeps."""

    def __init__(self, aligner: Aligner, stream: Stream) -> None:
        """Start with nothing seen."""
        self.aligner = aligner
        self.stream = stream
        self.epochs: list[Epoch] = []
        self.non_finite: list[str] = []
        self.held = 0
        self._updates = 0

    def update(self) -> None:
        """Let the aligner work and look at what it says."""
        self.take(self.aligner.update())
        self.look()
        self._updates += 1
        if self._updates % WEIGH_EVERY == 0:
            self.weigh()

    def take(self, epochs: list[Epoch]) -> None:
        """Look at epochs and keep them."""
        for epoch in epochs:
            # An innovation that was not tested is nan by its definition, never infinite.
            self._check('epoch', [epoch.t_s, epoch.gyro_bias, epoch.accel_bias,
                                  np.nan_to_num(epoch.innovation, posinf=np.inf,
                                                neginf=np.inf)])
            self._attitude('epoch', epoch.initial)
            self._attitude('epoch', epoch.current)
        self.epochs.extend(epochs)

    def look(self) -> None:
        """Look at what can be asked for at any time."""
        status = self.aligner.status()
        self._check('status', [value for name, value in vars(status).items() if name in (
            'gyro_bias', 'gyro_bias_std', 'accel_bias', 'accel_bias_std', 'lever_arm',
            'lever_arm_std', 'gnss_delay', 'gnss_delay_std', 'time_to_align_s')
            and value is not None])
        self._attitude('status', status.initial)
        self._attitude('status', status.current)
        self._attitude('declared', self.aligner.declared)
        self._attitude('now', self.aligner.attitude_now())
        self.aligner.take_events()

    def weigh(self) -> None:
        """Measure all that the aligner holds."""
        self.held = max(self.held, len(pickle.dumps(vars(self.aligner))))

    def _attitude(self, what: str, attitude: Attitude | None) -> None:
        if attitude is None:
            return
        self._check(what, [attitude.C_nb, attitude.covariance, attitude.sigma_deg])
        if not (abs(np.linalg.norm(attitude.quaternion_xyzw) - 1.0) < 1e-9
                and np.abs(attitude.C_nb @ attitude.C_nb.T - np.eye(3)).max() < 1e-9):
            self.non_finite.append(f'{what}: no rotation')
        if attitude.covariance.diagonal().min() <= 0:
            self.non_finite.append(f'{what}: no covariance')

    def _check(self, what: str, values: list[Any]) -> None:
        if not all(np.isfinite(value).all() for value in values):
            self.non_finite.append(f'{what}: not finite')


def miscounted(counts: dict[str, int], stream: Stream) -> list[str]:
    """Compare counters with what was sent; return what does not fit, in words."""
    wrong = [f'{name} is {count}' for name, count in counts.items() if count < 0]
    counted = dict.fromkeys(stream.expected, 0) | counts
    wrong += [f'{name} is {counted[name]}, not {number}'
              for name, number in stream.expected.items() if counted[name] != number]
    body_frame = counts.get('velocity_body_frame', 0)
    for name, number in ('fix', len(stream.fix)), ('velocity', len(stream.velocity) - body_frame):
        if counts.get(name, 0) != number:
            wrong.append(f'{name} is {counts.get(name, 0)}, not {number}')
        refused = sum(counts.get(f'{name}_{reason}', 0) for reason in REFUSED[name])
        if refused > number:
            wrong.append(f'{refused} of {number} {name} refused')
    # A sample that is late when it comes is not looked at any more, one that is found late later
    # is in both counters.
    imu, sent = counts.get('imu', 0), len(stream.imu)
    left_out = counts.get('imu_late', 0) + counts.get('imu_ahead', 0)
    if not imu <= sent <= imu + left_out:
        wrong.append(f'imu is {imu}, late or ahead are {left_out} of {sent}')
    return wrong


def judged(epochs: list[Epoch], stream: Stream, simulation: Simulation) -> JsonDict:
    """
    Compare with the truth what was declared.

    Returns
    -------
    dict
        ``declared``: errors at each declaration, as initial and current attitude, ``final``:
        those of the last epoch if it is aligned, and ``wrong_s``, for how long the current
        attitude was beyond the last of `BINS` while it was called aligned.

    """
    first = [epoch for before, epoch in zip([None, *epochs], epochs)
             if epoch.state is State.ALIGNED
             and (before is None or before.state is not State.ALIGNED)]
    aligned = [epoch.current for epoch in epochs
               if epoch.state is State.ALIGNED and epoch.current is not None]
    wrong = sum(max(pair) > BINS[1] for pair in _sigmas(aligned, stream, simulation))
    return {'declared': [_both(epoch, stream, simulation) for epoch in first],
            'final': (_both(epochs[-1], stream, simulation)
                      if epochs and epochs[-1].state is State.ALIGNED else None),
            'wrong_s': wrong / simulation.meta['gnss_rate']}


def _both(epoch: Epoch, stream: Stream, simulation: Simulation) -> JsonDict:
    assert epoch.initial is not None and epoch.current is not None  # it is aligned
    initial, current = _sigmas([epoch.initial, epoch.current], stream, simulation)
    return {'t_s': epoch.t_s, 'initial': initial, 'current': current}


def _sigmas(attitudes: list[Attitude], stream: Stream,
            simulation: Simulation) -> list[tuple[float, float]]:
    """Errors of tilt and heading in stated sigmas."""
    if not attitudes:
        return []
    truth = simulation.attitude_at(stream.true_stamps([a.stamp_ns for a in attitudes]))
    errors = [error_of(*pair) for pair in zip(attitudes, truth)]
    return [(error.tilt_sigmas, error.heading_sigmas) for error in errors]


# Tables

def worst(result: JsonDict) -> float:
    """Largest error in sigmas at any declaration and at the end; nan if there was none."""
    moments = [*result.get('declared', ()), *filter(None, [result.get('final')])]
    return max((max(*moment['initial'], *moment['current']) for moment in moments),
               default=math.nan)


def row(name: str, trials: list[JsonDict]) -> list[Any]:
    """Return a row of the table."""
    sigmas = np.array([worst(t) for t in trials])
    declared = np.isfinite(sigmas)
    return [name, len(trials), sum(bool(t['exception']) for t in trials),
            sum(bool(t['non_finite']) for t in trials),
            sum(bool(t.get('miscounted')) for t in trials), int(np.sum(declared)),
            *counted(sigmas),
            f'{sigmas[declared].max():.1f}' if declared.any() else None,
            f"{max(t.get('wrong_s', 0.0) for t in trials):.1f}",
            f"{np.median([t['held'] for t in trials]) * 1e-6:.2f}"]


def write(out: Path, trials: list[JsonDict]) -> None:
    """Print tables and write them."""
    report = Report('faults', 'What drivers get wrong', out, f' --runs {len(trials)}')
    total = row('all', trials)
    numbers = dict(zip(HEADER, total))
    report.text(
        f'{len(trials)} runs of {DURATION:g} s over {len(FAULTS)} faults, all scenarios '
        f'({", ".join(SCENARIOS)}) and grades of IMU, with random heading, latitude, mount, '
        'lever arm, velocity message and frame. The fault is in the messages; nothing is told to '
        'the aligner but what the name of the fault says. Samples come one by one or many at a '
        'time.')
    report.text(
        f"{numbers['exceptions']} runs ended with an exception, {numbers['non-finite']} gave a "
        'number that is not finite or an attitude that is no rotation, in '
        f"{numbers['miscounted']} the counters do not fit what was sent, "
        f"{sum(bool(t['warnings']) for t in trials)} made numpy warn (target: none). An aligner "
        f"never held more than {max(t['held'] for t in trials) * 1e-6:.2f} MB (pickled, every "
        f'{WEIGH_EVERY} updates; limit {MAX_HELD * 1e-6:g}); the processes that ran them grew to '
        f"{max(t['resident_kb'] for t in trials) / 1024:.0f} MB.")
    share = numbers['3 to 5'] + numbers['beyond 5']
    report.text(
        f"{numbers['declared']} runs were declared ALIGNED at some time, {share} of them "
        f"({share / max(numbers['declared'], 1):.1%}) beyond {BINS[0]:g} sigma, "
        f"{numbers['beyond 5']} beyond {BINS[1]:g} (target: at most 1 % and none). The error is "
        'the largest, in stated sigmas, of tilt and heading, of the attitude at t0 and the '
        'current one, at each declaration and at the end where that is still ALIGNED. The time '
        f'is that during which, within a run, the current attitude was beyond {BINS[1]:g} sigma '
        'and still called aligned, the longest.')
    report.table('What became of it, by fault', HEADER, [
        *(row(name, chosen) for name in FAULTS
          if (chosen := [t for t in trials if t['fault'] == name])), total])
    report.table(f'Declared and beyond {BINS[0]:g} sigma', [
        'index', 'fault', 'scenario', 'IMU', 'sigma', 'declared, sigma', 'end, sigma',
        'aligned beyond 5, s'], [
        [t['index'], t['fault'], t['scenario'], t['simulate']['imu_grade'], f'{worst(t):.1f}',
         f"{worst(t | {'final': None}):.1f}",
         None if t['final'] is None else f"{worst(t | {'declared': []}):.1f}",
         f"{t['wrong_s']:.1f}"] for t in trials if worst(t) > BINS[0]])
    broken = [[t['index'], t['fault'], t['scenario'], t['simulate']['imu_grade'], what]
              for t in trials for what in (
                  *t['exception'].strip().splitlines()[-1:], *sorted(set(t['non_finite'])),
                  *t.get('miscounted', ()), *t['warnings'])]
    if broken:
        report.table('What broke', ['index', 'fault', 'scenario', 'IMU', 'what'], broken)
    report.write({'runs': len(trials), 'trials': [
        {key: value for key, value in t.items() if key not in OMITTED} for t in trials]})
