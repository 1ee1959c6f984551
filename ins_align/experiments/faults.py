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

from itertools import pairwise
import math
from pathlib import Path
import pickle
import resource
import traceback
from typing import Any
import warnings

from ins_align.aligner import Aligner, Attitude, Epoch, State
from ins_align.config import Config
from ins_align.experiments.common import (
    BINS, combination, config_for, error_of, GRADES, groups_of, JsonDict, judged, most, parallel,
    Report, setup, whose, without, worse)
from ins_align.experiments.spoilt import FAULTS
from ins_align.experiments.stream import payloads, Random, SECOND, Stream, stream_of
from ins_align.gnss.messages import MessageError
from ins_align.simulation.simulate import give, SCENARIOS, simulate, Simulation
import numpy as np

DURATION = 60.0
UPDATE_EVERY = 1.0  # s
WEIGH_EVERY = 5     # updates
# What an aligner may hold, pickled; the largest part does not depend on the data.
MAX_HELD = 8_000_000
# Reasons for which a message is not used.
REFUSED = {'fix': ('no_fix', 'nan', 'late', 'ahead', 'duplicate'),
           'velocity': ('nan', 'late', 'ahead', 'duplicate')}
# `trial` draws the first three again from the index; the counts are only looked at.
OMITTED = 'simulate', 'config', 'frame', 'counts'


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run the campaign and write its tables."""
    [trials] = parallel(run_trial, [[trial(index) for index in range(runs or 1000)]], jobs,
                        'faults')
    write(out, trials)


def trial(index: int) -> JsonDict:
    """Draw a run: its fault, what is simulated, the frame of the velocities, what is told."""
    fault, scenario, grade = combination(index, [3], FAULTS, SCENARIOS, GRADES)
    random = np.random.default_rng([4, index])
    arguments = {'imu_grade': grade, 'seed': index, 'duration': DURATION, **setup(random)}
    config = {'gnss_lateness': Config().gnss_lateness, 'velocity_type': str(random.choice(
        ['TwistWithCovarianceStamped', 'TwistStamped', 'Odometry']))}
    return {'index': index, 'fault': fault, 'scenario': scenario, 'imu': grade,
            'simulate': arguments, 'config': config, 'frame': str(random.choice(['enu', 'ned']))}


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
                   **declarations(watch.epochs, stream, simulation)}
    return result


def feed(watch: 'Watch', random: Random) -> None:
    """Give the messages to the aligner in the order of arrival, one by one or in blocks."""
    stream, aligner = watch.stream, watch.aligner
    one_by_one = random.random() < 0.5
    for kind, rows in stream.sent(update_times(stream, random)):
        if kind in ('update', 'reset'):
            for _ in rows:
                watch.update()
                if kind == 'reset':
                    aligner.reset()
            continue
        for each in rows if one_by_one and kind == 'imu' else [rows]:
            try:
                for payload in payloads(aligner.config, kind, each):
                    give(aligner, kind, payload)
            except MessageError:
                for _ in rows:
                    aligner.reject('velocity_body_frame')
    watch.take(aligner.flush())
    watch.look()
    watch.weigh()


def update_times(stream: Stream, random: Random) -> np.ndarray:
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
    sent = {'fix': len(stream.fix),
            'velocity': len(stream.velocity) - counts.get('velocity_body_frame', 0)}
    wrong += [f'{name} is {counts.get(name, 0)}, not {number}'
              for name, number in (stream.expected | sent).items()
              if counts.get(name, 0) != number]
    for name, number in sent.items():
        refused = sum(counts.get(f'{name}_{reason}', 0) for reason in REFUSED[name])
        if refused > number:
            wrong.append(f'{refused} of {number} {name} refused')
    # A sample that is late when it comes is not looked at any more, one that is found late later
    # is in both counters.
    imu, samples = counts.get('imu', 0), len(stream.imu)
    left_out = counts.get('imu_late', 0) + counts.get('imu_ahead', 0)
    if not imu <= samples <= imu + left_out:
        wrong.append(f'imu is {imu}, late or ahead are {left_out} of {samples}')
    return wrong


def declarations(epochs: list[Epoch], stream: Stream, simulation: Simulation) -> JsonDict:
    """
    Judge each declaration and the last epoch if it is aligned.

    ``wrong_s`` is how long the current attitude was beyond the last of `BINS` and called aligned.
    """
    def true(stamps: Any) -> Any:
        return simulation.attitude_at(stream.true_stamps(stamps))

    aligned = [epoch.state is State.ALIGNED for epoch in epochs]
    first = [epoch for epoch, (before, now) in zip(epochs, pairwise([False, *aligned]))
             if now and not before]
    held = [epoch.current for epoch, now in zip(epochs, aligned)
            if now and epoch.current is not None]
    wrong = sum(error_of(attitude, C_true).worst_sigmas > BINS[1] for attitude, C_true in zip(
        held, true([attitude.stamp_ns for attitude in held]))) if held else 0
    return {'declared': [judged(epoch, true) for epoch in first],
            'final': judged(epochs[-1], true) if any(aligned[-1:]) else None,
            'wrong_s': wrong / simulation.meta['gnss_rate']}


# Tables

def worst(result: JsonDict) -> float:
    """Largest error in sigmas at any declaration and at the end; nan if there was none."""
    moments = [*result.get('declared', ()), *filter(None, [result.get('final')])]
    return max(map(worse, moments), default=math.nan)


def row(name: str, trials: list[JsonDict]) -> JsonDict:
    """Return a row of the table."""
    sigmas = [worst(t) for t in trials]
    declared = np.array([value for value in sigmas if math.isfinite(value)])
    bins = {f'beyond {limit:g}': int(np.sum(declared > limit)) for limit in BINS}
    return {'fault': name, 'runs': len(trials),
            'exceptions': sum(bool(t['exception']) for t in trials),
            'non-finite': sum(bool(t['non_finite']) for t in trials),
            'miscounted': sum(bool(t.get('miscounted')) for t in trials),
            'declared': len(declared), **bins, 'worst, sigma': most(declared, '.1f'),
            'aligned beyond 5, s': most((t.get('wrong_s', 0.0) for t in trials), '.1f'),
            'held, MB': f"{np.median([t['held'] for t in trials]) * 1e-6:.2f}"}


def write(out: Path, trials: list[JsonDict]) -> None:
    """Print tables and write them."""
    report = Report('faults', 'What drivers get wrong', out, f' --runs {len(trials)}')
    total = row('all', trials)
    report.text(
        f'{len(trials)} runs of {DURATION:g} s over {len(FAULTS)} faults, all scenarios '
        f'({", ".join(SCENARIOS)}) and grades of IMU, with random heading, latitude, mount, '
        'lever arm, velocity message and frame. The fault is in the messages; nothing is told to '
        'the aligner but what the name of the fault says. Samples come one by one or many at a '
        'time.')
    report.text(
        f"{total['exceptions']} runs ended with an exception, {total['non-finite']} gave a "
        'number that is not finite or an attitude that is no rotation, in '
        f"{total['miscounted']} the counters do not fit what was sent, "
        f"{sum(bool(t['warnings']) for t in trials)} made numpy warn (target: none). An aligner "
        f"never held more than {max(t['held'] for t in trials) * 1e-6:.2f} MB (pickled, every "
        f'{WEIGH_EVERY} updates; limit {MAX_HELD * 1e-6:g}); the processes that ran them grew to '
        f"{max(t['resident_kb'] for t in trials) / 1024:.0f} MB.")
    share = total['beyond 3']
    report.text(
        f"{total['declared']} runs were declared ALIGNED at some time, {share} of them "
        f"({share / max(total['declared'], 1):.1%}) beyond {BINS[0]:g} sigma, "
        f"{total['beyond 5']} beyond {BINS[1]:g} (target: at most 1 % and none). The error is "
        'the largest, in stated sigmas, of tilt and heading, of the attitude at t0 and the '
        'current one, at each declaration and at the end where that is still ALIGNED. The time '
        f'is that during which, within a run, the current attitude was beyond {BINS[1]:g} sigma '
        'and still called aligned, the longest.')
    report.table('What became of it, by fault', [
        row(*group) for group in groups_of(trials, FAULTS) if group[1]])
    report.table(f'Declared and beyond {BINS[0]:g} sigma', [
        {**whose(t), 'sigma': f'{worst(t):.1f}',
         'declared, sigma': most(map(worse, t['declared']), '.1f'),
         'end, sigma': None if t['final'] is None else f"{worse(t['final']):.1f}",
         'aligned beyond 5, s': f"{t['wrong_s']:.1f}"} for t in trials if worst(t) > BINS[0]])
    broken = [{**whose(t), 'what': what} for t in trials for what in (
        *t['exception'].strip().splitlines()[-1:], *sorted(set(t['non_finite'])),
        *t.get('miscounted', ()), *t['warnings'])]
    if broken:
        report.table('What broke', broken)
    report.write({'runs': len(trials), 'trials': without(trials, *OMITTED)})
