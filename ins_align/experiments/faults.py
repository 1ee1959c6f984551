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

from collections.abc import Sequence
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
    BINS, Column, combination, error_of, follow, GRADES, groups_of, JsonDict, Look, moments, most,
    parallel, prepare, Report, setup, Truth, whose, without, worse)
from ins_align.experiments.spoilt import FAULTS, Random, SECOND, SENSORS, Stream
from ins_align.simulation.simulate import SCENARIOS
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
OMITTED = 'simulate', 'config', 'frame', 'counts', 'levelled', 'aligned'


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run the campaign and write its tables."""
    [trials] = parallel(run_trial, [[trial(index) for index in range(runs or 1000)]], jobs,
                        'faults')
    write(out, trials)


def trial(index: int) -> JsonDict:
    """Draw a run: its fault, what is simulated, the frame of the velocities, the parameters."""
    fault, scenario, grade = combination(index, [3], FAULTS, SCENARIOS, GRADES)
    random = np.random.default_rng([4, index])
    arguments = {'imu_grade': grade, 'seed': index, 'duration': DURATION, **setup(random)}
    config = {'gnss_lateness': Config().gnss_lateness, 'velocity_type': str(random.choice(
        ['TwistWithCovarianceStamped', 'TwistStamped', 'Odometry']))}
    return {'index': index, 'fault': fault, 'scenario': scenario, 'imu': grade,
            'simulate': arguments, 'config': config, 'frame': str(random.choice(['enu', 'ned']))}


def run_trial(task: JsonDict) -> JsonDict:
    """Run what `trial` drew and look at everything that comes out."""
    random = np.random.default_rng([5, task['index']])
    simulation, stream, aligner = prepare(
        task['scenario'], task['simulate'], task['config'], task['frame'],
        lambda stream: FAULTS[task['fault']](stream, random))
    watch = Watch(aligner)
    exception = ''
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter('always')
        try:
            looks = feed(watch, stream, random)
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
                   **declarations(looks, simulation.meta['gnss_rate'], lambda stamps:
                                  simulation.attitude_at(stream.true_stamps(stamps)))}
    return result


def feed(watch: 'Watch', stream: Stream, random: Random) -> list[Look]:
    """Give the messages to the aligner in the order of arrival, one by one or in blocks."""
    lot = 1 if random.random() < 0.5 else len(stream.imu) + 1
    looks = follow(watch.aligner, stream.messages(watch.aligner.config, lot,
                                                  update_times(stream, random)), 0.0, watch=watch)
    watch.weigh()
    return looks


def update_times(stream: Stream, random: Random) -> np.ndarray:
    """When somebody looks for results."""
    end = max((int(rows['arrival'].max()) for name in SENSORS
               if len(rows := getattr(stream, name))), default=stream.first)
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

    def __init__(self, aligner: Aligner) -> None:
        """Start with nothing seen."""
        self.aligner = aligner
        self.non_finite: list[str] = []
        self.held = 0
        self._updates = 0

    def __call__(self, epochs: list[Epoch]) -> None:
        """Look at the epochs of an update, and at what can be asked for at any time."""
        for epoch in epochs:
            # An innovation that was not tested is nan by its definition, never infinite.
            self._check('epoch', [epoch.t_s, epoch.gyro_bias, epoch.accel_bias,
                                  np.nan_to_num(epoch.innovation, posinf=np.inf,
                                                neginf=np.inf)], epoch.initial, epoch.current)
        status = self.aligner.status()
        self._check('status', [value for name, value in vars(status).items() if name in (
            'gyro_bias', 'gyro_bias_std', 'accel_bias', 'accel_bias_std', 'lever_arm',
            'lever_arm_std', 'gnss_delay', 'gnss_delay_std', 'time_to_align_s')
            and value is not None], status.initial, status.current)
        self._check('declared', [], self.aligner.declared)
        self._check('now', [], self.aligner.attitude_now())
        self.aligner.take_events()
        self._updates += 1
        if self._updates % WEIGH_EVERY == 0:
            self.weigh()

    def weigh(self) -> None:
        """Measure all that the aligner holds."""
        self.held = max(self.held, len(pickle.dumps(vars(self.aligner))))

    def _check(self, what: str, values: list[Any], *attitudes: Attitude | None) -> None:
        for attitude in attitudes:
            if attitude is None:
                continue
            values += [attitude.C_nb, attitude.covariance, attitude.sigma_deg]
            if not (abs(np.linalg.norm(attitude.quaternion_xyzw) - 1.0) < 1e-9
                    and np.abs(attitude.C_nb @ attitude.C_nb.T - np.eye(3)).max() < 1e-9):
                self.non_finite.append(f'{what}: no rotation')
            if attitude.covariance.diagonal().min() <= 0:
                self.non_finite.append(f'{what}: no covariance')
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


def declarations(looks: Sequence[Look], gnss_rate: float, true: Truth) -> JsonDict:
    """
    Judge each declaration and the last epoch if it is aligned.

    ``wrong_s`` is how long the current attitude was beyond the last of `BINS` and called aligned.
    """
    held = [look.current for look in looks if look.t_s is not None
            and look.state is State.ALIGNED and look.current is not None]
    wrong = sum(error_of(attitude, C_true).worst_sigmas > BINS[1] for attitude, C_true in zip(
        held, true([attitude.stamp_ns for attitude in held]))) if held else 0
    return {**moments(looks, true), 'wrong_s': wrong / gnss_rate}


# Tables

def worst(result: JsonDict) -> float:
    """Largest error in sigmas at any declaration and at the end; nan if there was none."""
    judged = [*result.get('declared', ()), *filter(None, [result.get('final')])]
    return max(map(worse, judged), default=math.nan)


def beyond(trials: list[JsonDict], limit: float) -> int:
    """Count the trials that were declared and wrong."""
    return sum(worst(t) > limit for t in trials)


def count(trials: list[JsonDict], what: str) -> int:
    """Count the trials in which there was an exception, say."""
    return sum(bool(t.get(what)) for t in trials)


COLUMNS: list[Column] = [
    ('fault', '', lambda g: g[0]), ('runs', '', lambda g: len(g[1])),
    ('exceptions', '', lambda g: count(g[1], 'exception')),
    ('non-finite', '', lambda g: count(g[1], 'non_finite')),
    ('miscounted', '', lambda g: count(g[1], 'miscounted')),
    ('declared', '', lambda g: beyond(g[1], -math.inf)),
    *((f'beyond {limit:g}', '', lambda g, limit=limit: beyond(g[1], limit)) for limit in BINS),
    ('worst, sigma', '.1f', lambda g: most(w for t in g[1] if math.isfinite(w := worst(t)))),
    ('aligned beyond 5, s', '.1f', lambda g: most(t.get('wrong_s', 0.0) for t in g[1])),
    ('held, MB', '.2f', lambda g: np.median([t['held'] for t in g[1]]) * 1e-6)]


def write(out: Path, trials: list[JsonDict]) -> None:
    """Print tables and write them."""
    report = Report('faults', 'What drivers get wrong', out, f' --runs {len(trials)}')
    report.text(
        f'{len(trials)} runs of {DURATION:g} s over {len(FAULTS)} faults, all scenarios '
        f'({", ".join(SCENARIOS)}) and grades of IMU, with random heading, latitude, mount, '
        'lever arm, velocity message and frame. The fault is in the messages; nothing is told to '
        'the aligner but what the name of the fault says. Samples come one by one or many at a '
        'time.')
    report.text(
        f"{count(trials, 'exception')} runs ended with an exception, "
        f"{count(trials, 'non_finite')} gave a number that is not finite or an attitude that is "
        f"no rotation, in {count(trials, 'miscounted')} the counters do not fit what was sent, "
        f"{count(trials, 'warnings')} made numpy warn (target: none). An aligner "
        f"never held more than {max(t['held'] for t in trials) * 1e-6:.2f} MB (pickled, every "
        f'{WEIGH_EVERY} updates; limit {MAX_HELD * 1e-6:g}); the processes that ran them grew to '
        f"{max(t['resident_kb'] for t in trials) / 1024:.0f} MB.")
    declared, share, gross = (beyond(trials, limit) for limit in (-math.inf, *BINS))
    report.text(
        f'{declared} runs were declared ALIGNED at some time, {share} of them '
        f'({share / max(declared, 1):.1%}) beyond {BINS[0]:g} sigma, '
        f'{gross} beyond {BINS[1]:g} (target: at most 1 % and none). The error is '
        'the largest, in stated sigmas, of tilt and heading, of the attitude at t0 and the '
        'current one, at each declaration and at the end where that is still ALIGNED. The time '
        f'is that during which, within a run, the current attitude was beyond {BINS[1]:g} sigma '
        'and still called aligned, the longest.')
    report.table('What became of it, by fault', [
        group for group in groups_of(trials, FAULTS) if group[1]], COLUMNS)
    report.table(
        f'Declared and beyond {BINS[0]:g} sigma', [t for t in trials if worst(t) > BINS[0]], [
            *whose(), ('sigma', '.1f', worst),
            ('declared, sigma', '.1f', lambda t: most(map(worse, t['declared']))),
            ('end, sigma', '.1f', lambda t: t['final'] and worse(t['final'])),
            ('aligned beyond 5, s', '.1f', lambda t: t['wrong_s'])])
    broken = [{**t, 'what': what} for t in trials for what in (
        *t['exception'].strip().splitlines()[-1:], *sorted(set(t['non_finite'])),
        *t.get('miscounted', ()), *t['warnings'])]
    if broken:
        report.table('What broke', broken, [*whose(), ('what', '', lambda t: t['what'])])
    report.write({'runs': len(trials), 'trials': without(trials, *OMITTED)})
