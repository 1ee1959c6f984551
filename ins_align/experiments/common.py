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
What the experiments share: cases and their runs, errors against truth, tables and pages.

A run is a `Case` with a seed: the aligner takes the messages, and its attitudes are compared with
the truth. An experiment lists its cases or draws them; a table has a row for all runs of a name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
import itertools
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Aligner, Attitude, Epoch, State
from ins_align.config import Config
from ins_align.experiments import dense
from ins_align.experiments.spoilt import Random, SECOND, SENSORS, Stream, stream_of
from ins_align.geometry.rotation import Array, log_so3
from ins_align.outputs import write_whole
from ins_align.processes import run_all
from ins_align.report import format_table
from ins_align.simulation.simulate import give, noise_parameters, simulate, Simulation
import numpy as np

# s; simulated messages are not late, but an unknown delay needs IMU samples beyond the stamp.
LATENESS = 0.5
GRADES = ('navigation', 'tactical', 'mems')
SIGMA_LIMITS = (3.0, 5.0)   # errors above these are counted
UPDATE_EVERY = 5.0          # s between updates of the aligner
LONGEST = 5.0               # s for which the state of an epoch counts at most
ANGLES = ('tilt', 'heading')

JsonDict = dict[str, Any]
Truth = Callable[[list[int]], Sequence[Any]]    # stamps -> true ``C_nb``, None where unknown
Groups = list[tuple[str, list[JsonDict]]]       # a name and its runs, for each row of a table


def parallel(function: Callable[[Any], Any], groups: Sequence[Sequence[Any]], jobs: int | None,
             name: str = '') -> list[list[Any]]:
    """
    Apply a function to the tasks of several groups as `run_all` does; return results by group.

    Raises the first exception. Tasks that share a trajectory should follow each other, because a
    process caches the last few. On a terminal a progress bar shows the name.
    """
    from tqdm import tqdm

    tasks, results = [*itertools.chain(*groups)], []
    for result in tqdm(run_all(function, tasks, jobs), name, len(tasks), disable=None):
        if isinstance(result, Exception):
            raise result
        results.append(result)
    every = iter(results)
    return [list(itertools.islice(every, len(group))) for group in groups]


# Runs

class Case(NamedTuple):
    """What is simulated, what spoils its messages, and how the aligner is configured."""

    name: str
    motions: tuple[tuple[str, str], ...]    # scenarios with IMU grades; seeds take them in turn
    spoil: Callable[[Stream, Random], Any] | None = None    # changes the messages in place
    simulate: JsonDict = {}         # further arguments of `simulate`
    config: JsonDict = {}           # parameters of `Config` that replace those of the simulation
    part: int = 1                   # one run for this many of those asked for, as it takes long
    between: bool = False           # judge attitudes between epochs instead of those at epochs
    exact: bool = False             # the aligner knows noise, lever arm and delay exactly
    drawn: Callable[[int], JsonDict] | None = None  # seed -> further arguments of `simulate`


def run_cases(function: Callable[[Any], Any], cases: Sequence[Case], runs: int, jobs: int | None,
              first: int = 0) -> Groups:
    """Apply a function to each case with each of its seeds; return the results by name."""
    return list(zip((case.name for case in cases), parallel(function, [
        [(case, first + k) for k in range(max(1, runs // case.part))] for case in cases], jobs,
        'runs')))


def combination(index: int, seed: Sequence[int], *axes: Iterable[Any]) -> Any:
    """Return one combination of values of the axes; each is drawn once before any is twice."""
    combinations = list(itertools.product(*axes))
    turn, position = divmod(index, len(combinations))
    order = np.random.default_rng([*seed, turn]).permutation(len(combinations))
    return combinations[order[position]]


def setup(random: Random) -> JsonDict:
    """Draw heading, latitude, lever arm and mount as arguments of `simulate`."""
    return {'heading_deg': random.uniform(-180, 180), 'latitude_deg': random.uniform(-75, 75),
            'lever_arm': random.uniform(-1.5, 1.5, 3).tolist(),
            'mount_rpy_deg': random.uniform(-20, 20, 3).tolist()}


def run_case(task: tuple[Case, int]) -> JsonDict:
    """Run a case with a seed, and judge it."""
    case, seed = task
    simulation, stream, aligner = prepare(case, seed)
    epochs = [*itertools.chain(*follow(aligner, stream))]
    return outcome(case.name, simulation, stream, aligner, epochs)


def simulated(case: Case, seed: int = 0) -> Simulation:
    """Simulate a case with a seed, without what spoils it."""
    scenario, grade = case.motions[seed % len(case.motions)]
    drawn = case.drawn(seed) if case.drawn else {}
    return simulate(scenario, **{'imu_grade': grade, 'seed': seed, **drawn, **case.simulate})


def bound_of(case: Case) -> dense.Bound:
    """Return the Cramer-Rao bound of a case; what its configuration leaves open is unknown."""
    return dense.bound(
        simulated(case), not case.config.get('use_velocity', True),
        case.config.get('lever_arm_std', 0.0), case.config.get('gnss_delay_std', 0.0))


def prepare(case: Case, seed: int) -> tuple[Simulation, Stream, Aligner]:
    """Simulate a case, spoil its messages, and create the aligner for them."""
    simulation = simulated(case, seed)
    stream = stream_of(simulation, case.between)
    if case.spoil is not None:
        case.spoil(stream, np.random.default_rng([6, seed]))
    configure = exact_config_for if case.exact else config_for
    return simulation, stream, Aligner(configure(simulation, **{**stream.config, **case.config}))


def follow(aligner: Aligner, stream: Stream) -> Iterator[list[Epoch]]:
    """
    Give a stream to an aligner in the order of arrival, and yield the epochs of each update.

    The aligner is updated at each reset, at the end, and at `updates` of the stream or, if it has
    none, every `UPDATE_EVERY`; with `between` after every message. Then, and if there are no new
    epochs, it yields the status as one epoch without GNSS, so that times without GNSS count.
    """
    due = 0.0
    for now, kind, payload in itertools.chain(stream.messages(aligner.config),
                                              [(stream.last, 'end', None)]):
        if kind in SENSORS:
            give(aligner, kind, payload)
        elif kind == 'reject':
            aligner.reject(payload)
        if not (stream.between or kind in ('update', 'reset', 'end')
                or now >= due and not stream.updates.size):
            continue
        epochs = aligner.flush() if kind == 'end' else aligner.update()
        stamp_ns = aligner.newest_imu_ns
        if stamp_ns is not None and (stream.between or not epochs):
            status = aligner.status()
            current = aligner.attitude_now() if stream.between else status.current
            epochs = [Epoch(stamp_ns, math.nan, status.state, status.initial, current,
                            np.full(3, np.nan), status.gyro_bias, status.accel_bias,
                            status.gyro_bias_std, np.zeros((3, 3)), dry=True)]
        yield epochs
        due = now + UPDATE_EVERY * SECOND
        if kind == 'reset':
            aligner.reset()


def config_for(simulation: Simulation, **changes: Any) -> Config:
    """Return the default configuration with the IMU grade and lever arm of a simulation."""
    return Config(**{'lever_arm': tuple(simulation.lever_arm.tolist()), 'gnss_lateness': LATENESS,
                     'imu_grade': simulation.meta['imu_grade'], **changes})


def exact_config_for(simulation: Simulation, **changes: Any) -> Config:
    """Return a configuration with the noise of a simulation and known lever arm and delay."""
    return config_for(simulation, **{
        'imu_grade': 'custom', **noise_parameters(simulation.imu_noise), 'lever_arm_std': 0.0,
        'gnss_delay_std': 0.0, **changes})


# Errors against the truth

def error_of(attitude: Attitude, C_true: Array, extra_std_deg: Any = 0.0) -> JsonDict:
    """
    Compare an attitude with the true ``C_nb``.

    `extra_std_deg` (3,), the sigma of the truth itself about east, north and up, is added in
    quadrature. Returns the errors about these axes (``angles_deg``), their normalised square
    ``nees``, and tilt and heading in degrees and in sigmas, for the tilt those of its worse axis.
    """
    phi = log_so3(C_true @ attitude.C_nb.T)
    covariance = attitude.covariance + np.diag(np.radians(np.broadcast_to(extra_std_deg, 3)) ** 2)
    angles, sigmas = np.degrees(phi), np.abs(phi) / np.sqrt(np.diag(covariance))
    return {'angles_deg': angles, 'nees': float(phi @ np.linalg.solve(covariance, phi)),
            'tilt_sigmas': float(np.max(sigmas[:2])), 'heading_sigmas': float(sigmas[2]),
            'tilt_deg': float(np.hypot(*angles[:2])), 'heading_deg': float(abs(angles[2]))}


def outcome(name: str, simulation: Simulation, stream: Stream, aligner: Aligner,
            epochs: list[Epoch]) -> JsonDict:
    """Return which run it was, how it ended, and how large its errors were."""
    status = aligner.status()

    def true(stamps: list[int]) -> Array:
        return simulation.attitude_at(stream.true_stamps(stamps))

    return {'name': name, 'scenario': simulation.meta['scenario'],
            'imu': aligner.config.imu_grade, 'seed': simulation.meta['seed'],
            'state': status.state.value, 'reason': status.reason,
            'counts': {counter: count for counter, count in status.counts.items() if count},
            'least_heading_sigma_deg': min((epoch.initial.sigma_deg[2] for epoch in epochs
                                            if epoch.initial is not None), default=None),
            **judge_events(epochs, true), **while_aligned(epochs, stream.start_ns, true)}


def judge_events(epochs: Iterable[Epoch], true: Truth) -> JsonDict:
    """
    Judge the first levelled epoch, each declaration, and the last epoch if it is aligned.

    Of the attitude at t0 and the current one the larger errors count. Each entry is a list, which
    is empty if there is no such epoch.
    """
    epochs = [epoch for epoch in epochs if not epoch.dry]
    aligned = [epoch.state is State.ALIGNED for epoch in epochs]
    chosen = {
        'levelled': [epoch for epoch in epochs
                     if epoch.state in (State.LEVELLED, State.ALIGNED)][:1],
        'declared': [epoch for epoch, before, now in zip(epochs, [False, *aligned], aligned)
                     if now and not before],
        'final': [epoch for epoch in epochs[-1:] if epoch.state is State.ALIGNED]}
    return {name: [judged(epoch.t_s, errors_of([epoch.initial, epoch.current], true))
                   for epoch in each if epoch.initial is not None and epoch.current is not None]
            for name, each in chosen.items()}


def judged(t_s: float, errors: list[JsonDict]) -> JsonDict:
    """Return a time, s since t0, with the largest tilt and heading among several errors."""
    return {'t_s': t_s, **{name: max(error[name] for error in errors) for name in (
        'tilt_sigmas', 'heading_sigmas', 'tilt_deg', 'heading_deg')}}


def while_aligned(epochs: Sequence[Epoch], start_ns: int, true: Truth,
                  std_deg: Any = 0.0) -> JsonDict:
    """
    Judge the current attitude in all epochs that are aligned.

    `start_ns` is the stamp of the first IMU sample; `std_deg` (3,) is the sigma of the truth about
    east, north and up. ``first`` is a list of the errors at the first declaration, ``declared_s``
    its time; ``beyond`` counts epochs with known truth above each of `SIGMA_LIMITS`, ``beyond_s``
    is the time above the last of these.
    """
    stamps = np.array([epoch.stamp_ns for epoch in epochs], np.int64)
    lasts_s = np.clip(np.diff(stamps, append=stamps[-1:]) / SECOND, 0.0, LONGEST)
    aligned = [k for k, epoch in enumerate(epochs)
               if epoch.state is State.ALIGNED and epoch.current is not None]
    errors = {k: error for k, error in zip(aligned, errors_of(
        [epochs[k].current for k in aligned], true, std_deg)) if error is not None}
    sigmas = {k: worst([error]) for k, error in errors.items()}
    return {'first': [judged(epochs[k].t_s, [errors[k]]) for k in [*errors][:1]],
            'declared_s': next(((stamps[k] - start_ns) / SECOND for k in errors), None),
            'epochs': len(errors), 'worst_sigmas': max(sigmas.values(), default=None),
            'worst_heading_deg': max((error['heading_deg'] for error in errors.values()),
                                     default=None),
            'beyond': [beyond(sigmas.values(), limit) for limit in SIGMA_LIMITS],
            'beyond_s': np.sum(lasts_s[[k for k in errors if sigmas[k] > SIGMA_LIMITS[-1]]]),
            'aligned_part': np.sum(lasts_s[aligned]) / max(np.sum(lasts_s), 1e-9)}


def errors_of(attitudes: list[Any], true: Truth, std_deg: Any = 0.0) -> list[Any]:
    """Compare attitudes with the truth as `error_of` does; None where it is not known."""
    truths = true([attitude.stamp_ns for attitude in attitudes]) if attitudes else ()
    return [None if C_true is None else error_of(attitude, C_true, std_deg)
            for attitude, C_true in zip(attitudes, truths)]


# Tables and pages; a row of a table is a dictionary of titles and cells

def cell(statistic: Callable[[Any], Any], values: Iterable[float], digits: str) -> str | None:
    """Return a statistic of values as text, None if there are no values."""
    values = [*values]
    return format(statistic(values), digits) if values else None


def groups_of(runs: list[JsonDict], names: Iterable[str]) -> Groups:
    """Return the runs of each name, and last all runs."""
    return [*((name, [run for run in runs if run['name'] == name]) for name in names),
            ('all', runs)]


def worst(errors: Iterable[JsonDict]) -> float | None:
    """Return the largest error of tilt and heading in sigmas, None if there are no errors."""
    return max((error[f'{angle}_sigmas'] for error in errors for angle in ANGLES), default=None)


def beyond(values: Iterable[Any], limit: float) -> int:
    """Count values above a limit."""
    return sum(value > limit for value in values)


def event_row(name: str, runs: list[JsonDict], kind: str) -> JsonDict:
    """Return how many runs have an entry of `events`, when, and how large the errors were."""
    found = [run[kind][0] for run in runs if run[kind]]
    row = {'case': name, 'runs': len(runs), 'declared': len(found),
           'median, s': cell(np.median, (event['t_s'] for event in found), '.1f')}
    for angle in ANGLES:
        sigmas = [event[f'{angle}_sigmas'] for event in found]
        for limit in SIGMA_LIMITS:
            wrong = beyond(sigmas, limit)
            row[f'{angle} beyond {limit:g}'] = (
                f'{wrong} ({100 * wrong / len(found):.1f} %)' if found else None)
        row[f'worst {angle}, sigma'] = cell(max, sigmas, '.1f')
        row[f'{angle}, deg'] = cell(max, (event[f'{angle}_deg'] for event in found), '.2g')
    return row


def aligned_row(name: str, runs: list[JsonDict]) -> JsonDict:
    """Return how many runs were aligned, when, for how long, and how large the errors were."""
    declared = [run for run in runs if run['first']]
    sigmas = [run['worst_sigmas'] for run in declared]
    return {'case': name, 'runs': len(runs), 'declared': len(declared),
            'at the end': sum(run['state'] == State.ALIGNED.value for run in runs),
            'declared beyond 3': beyond((worst(run['declared'][:1] or run['first'])
                                         for run in declared), 3.0),
            **{f'beyond {limit:g}': beyond(sigmas, limit) for limit in SIGMA_LIMITS},
            'beyond 5, s': cell(max, (run['beyond_s'] for run in declared), '.1f'),
            'worst, sigma': cell(max, sigmas, '.1f'),
            'heading, deg': cell(max, (run['worst_heading_deg'] for run in declared), '.2g'),
            'aligned, %': cell(np.mean, (100 * run['aligned_part'] for run in runs), '.0f'),
            'after, s': cell(np.median, (run['declared_s'] for run in declared), '.1f')}


class Report:
    """The page of an experiment: it collects the parts, then prints and writes them."""

    def __init__(self, name: str, title: str, out: Path, command: str = '') -> None:
        """Begin the page with its title and its command; `command` has the further options."""
        self._name, self._out = name, out
        self._parts = [f'# {title}', f'`ins_align experiment {name} --out DIR{command}`']

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(text)

    def table(self, title: str, rows: Iterable[JsonDict]) -> None:
        """Add a table; the rows have the same keys, the titles of its columns. None is a dash."""
        rows = list(rows)
        table = format_table([[*row.values()] for row in rows], [*rows[0]])
        self._parts.append(f'{title}\n\n```text\n{table}\n```')

    def figure(self, figure: Any, caption: str) -> None:
        """Write a figure as PNG and add it with its caption."""
        file = f'{self._name}.png'
        write_whole(self._out / file, lambda png: figure.savefig(png, format='png', dpi=110))
        self._parts.append(f'![{caption}]({file})\n\n{caption}')

    def write(self, numbers: Any) -> None:
        """Print the page, write it, and write the numbers as JSON."""
        page = '\n\n'.join(self._parts)
        print(page)
        for suffix, text in (('md', page), ('json', json.dumps(_plain(numbers), indent=1))):
            content = f'{text}\n'.encode()
            write_whole(self._out / f'{self._name}.{suffix}', lambda file: file.write(content))


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it; numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f'{value:.6g}') if math.isfinite(value) else None
    return value
