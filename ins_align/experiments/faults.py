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
Experiment ``faults``: faults of real drivers, combined with all scenarios and grades of IMU.

Nothing may break: there must be no exception, no number that is not finite, no memory that grows
and no message that is not counted. What is declared in spite of the fault has to be right.
"""

from __future__ import annotations

from pathlib import Path
import pickle
import traceback
from typing import Any
import warnings

from ins_align.aligner import Aligner, Epoch
from ins_align.config import Config
from ins_align.experiments.common import (
    beyond, Case, cell, combination, follow, GRADES, groups_of, JsonDict, outcome, parallel,
    prepare, Report, setup, SIGMA_LIMITS, worst)
from ins_align.experiments.spoilt import FAULTS, Random, SECOND, SENSORS, Stream
from ins_align.simulation.simulate import CAMPAIGN_SCENARIOS
import numpy as np

DURATION = 60.0
UPDATE_EVERY = 1.0  # s
WEIGH_EVERY = 5     # updates from one measurement of the size to the next
# Largest size of a pickled aligner, bytes; most of it does not depend on the data.
MAX_HELD = 8_000_000
# Ends of the counters of messages that are not used.
REFUSED = {'fix': ('no_fix', 'nan', 'late', 'ahead', 'duplicate'),
           'velocity': ('nan', 'late', 'ahead', 'duplicate')}


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``faults``."""
    [found] = parallel(run_watched, [range(runs)], jobs, 'faults')
    report.text(
        f'{runs} runs of {DURATION:g} s over {len(FAULTS)} faults, all scenarios '
        f'({", ".join(CAMPAIGN_SCENARIOS)}) and grades of IMU, with random heading, latitude, '
        'mount, lever arm, velocity message and frame. The fault is in the messages; nothing is '
        'configured but what the name of the fault says. Samples come one by one or many at a '
        'time. Runs are counted that end in an exception, that yield a number that is not finite '
        'or an attitude that is no rotation, that have a counter which does not fit what was '
        'sent, that make numpy warn. Errors are those at declarations and at the end; held is '
        f'the largest size of a pickled aligner, of which {MAX_HELD * 1e-6:g} MB are allowed.')
    report.table('What became of it, by fault',
                 [row_of(*group) for group in groups_of(found, FAULTS) if group[1]])
    return {'runs': found}


def draw(index: int) -> Case:
    """Draw a run; its `spoil` also draws the size of IMU batches and the times of updates."""
    fault, scenario, grade = combination(index, [3], FAULTS, CAMPAIGN_SCENARIOS, GRADES)
    random = np.random.default_rng([4, index])
    arguments = {'duration': DURATION, **setup(random)}
    config = {'gnss_lateness': Config().gnss_lateness, 'velocity_type': str(random.choice(
        ['TwistWithCovarianceStamped', 'TwistStamped', 'Odometry']))}
    arguments['velocity_frame'] = str(random.choice(['enu', 'ned']))

    def spoil(stream: Stream, _: Random) -> None:
        random = np.random.default_rng([5, index])
        stream.config['velocity_frame'] = arguments['velocity_frame']
        FAULTS[fault](stream, random)
        stream.batch = 1 if random.random() < 0.5 else len(stream.imu) + 1
        stream.updates = update_times(stream, random)

    return Case(fault, ((scenario, grade),), spoil, arguments, config)


def update_times(stream: Stream, random: Random) -> np.ndarray:
    """Return when the aligner is updated, ns: regularly, or at random if the fault says so."""
    end = max(int(getattr(stream, name)['arrival'].max(initial=stream.first)) for name in SENSORS)
    every = stream.update_every or UPDATE_EVERY
    number = (end - stream.first) / SECOND / every
    steps = (random.exponential(every, int(2 * number) + 1) if stream.update_every
             else np.full(int(number) + 1, every))
    return stream.first + np.rint(np.cumsum(steps) * SECOND).astype(np.int64)


def run_watched(index: int) -> JsonDict:
    """Run what `draw` draws from a seed, and check everything that the aligner returns."""
    case = draw(index)
    simulation, stream, aligner = prepare(case, index)
    epochs: list[Epoch] = []
    non_finite: set[str] = set()
    held, exception = 0, ''
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter('always')
        try:
            for update, each in enumerate(follow(aligner, stream), 1):
                epochs += each
                non_finite.update(broken(aligner, each))
                aligner.take_events()
                if update % WEIGH_EVERY == 0:
                    held = max(held, weight(aligner))
            held = max(held, weight(aligner))
        except Exception:  # of whatever kind: this experiment looks for it
            exception = traceback.format_exc(limit=-3)
    result = {'name': case.name, 'seed': index, 'declared': [], 'final': [], 'beyond_s': 0.0,
              'exception': exception, 'non_finite': sorted(non_finite), 'held': held,
              'miscounted': [], 'warnings': sorted({str(each.message) for each in warned})}
    if not exception:
        result |= outcome(case.name, simulation, stream, aligner, epochs)
        result['miscounted'] = miscounted(result['counts'], stream)
    return result


# Checks

def weight(aligner: Aligner) -> int:
    """Return the size of a pickled aligner, bytes."""
    return len(pickle.dumps(vars(aligner)))


def broken(aligner: Aligner, epochs: list[Epoch]) -> list[str]:
    """Return, in words, what of epochs and status is not finite, no rotation or no covariance."""
    status = aligner.status()
    # An innovation that was not tested is nan by definition, but never infinite.
    numbers = [('epoch', value) for epoch in epochs for value in (
        0.0 if epoch.dry else epoch.t_s, epoch.gyro_bias, epoch.accel_bias,
        np.nan_to_num(epoch.innovation, posinf=np.inf, neginf=np.inf))]
    numbers += [('status', value) for value in vars(status).values()
                if isinstance(value, (float, np.ndarray))]
    wrong = []
    for what, attitude in (
            *(('epoch', each) for epoch in epochs for each in (epoch.initial, epoch.current)),
            ('status', status.initial), ('status', status.current),
            ('declared', aligner.declared), ('now', aligner.attitude_now())):
        if attitude is not None:
            numbers += [(what, attitude.C_nb), (what, attitude.covariance)]
            if not (abs(np.linalg.norm(attitude.quaternion_xyzw) - 1.0) < 1e-9
                    and np.abs(attitude.C_nb @ attitude.C_nb.T - np.eye(3)).max() < 1e-9):
                wrong.append(f'{what}: no rotation')
            if attitude.covariance.diagonal().min() <= 0:
                wrong.append(f'{what}: no covariance')
    return wrong + [f'{what}: not finite' for what, value in numbers
                    if not np.isfinite(value).all()]


def miscounted(counts: dict[str, int], stream: Stream) -> list[str]:
    """Compare counters with what was sent; return, in words, what does not fit."""
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
    # A sample that is late on arrival is not in the counter `imu`; one that turns out to be late
    # afterwards is in both.
    imu, samples = counts.get('imu', 0), len(stream.imu)
    left_out = counts.get('imu_late', 0) + counts.get('imu_ahead', 0)
    if not imu <= samples <= imu + left_out:
        wrong.append(f'imu is {imu}, late or ahead are {left_out} of {samples}')
    return wrong


def error(run: JsonDict) -> float | None:
    """Return the largest error in sigmas at declarations and at the end, None without these."""
    return worst([*run['declared'], *run['final']])


def row_of(name: str, runs: list[JsonDict]) -> JsonDict:
    """Return the table row of the runs of a fault."""
    errors = [each for each in map(error, runs) if each is not None]
    row = {'case': name, 'runs': len(runs)}
    for title, what in (('exceptions', 'exception'), ('non-finite', 'non_finite'),
                        ('miscounted', 'miscounted'), ('warnings', 'warnings')):
        row[title] = sum(bool(run[what]) for run in runs)
    return {**row, 'declared': len(errors),
            **{f'beyond {limit:g}': beyond(errors, limit) for limit in SIGMA_LIMITS},
            'worst, sigma': cell(max, errors, '.1f'),
            'aligned beyond 5, s': cell(max, (run['beyond_s'] for run in runs), '.1f'),
            'held, MB': cell(max, (run['held'] * 1e-6 for run in runs), '.2f')}
