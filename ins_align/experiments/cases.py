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
Cases: simulated vehicles whose messages are spoilt, aligned and judged against the truth.

Every campaign draws cases from numbers, `run_case` runs them in the same way, and its tables have
a row for all runs of a name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
import itertools
import math
from typing import Any, NamedTuple

from ins_align.aligner import Aligner, Epoch, State
from ins_align.experiments.common import (
    BINS, Column, config_for, Error, error_of, JsonDict, median, most)
from ins_align.experiments.spoilt import LOT, Message, SECOND, SENSORS, Stream, stream_of
from ins_align.geometry.rotation import Array
from ins_align.simulation.simulate import give, simulate, Simulation
import numpy as np

UPDATE_EVERY = 5.0      # s
LONGEST = 5.0           # s that an epoch stands for
BETWEEN_LOT = 7         # IMU samples given at once where attitudes between epochs are judged
ANGLES = ('tilt', 'heading')

Truth = Callable[[list[int]], Sequence[Any]]    # ``C_nb`` at stamps, None where it is not known
Groups = list[tuple[str, list[JsonDict]]]       # names and their runs


class Case(NamedTuple):
    """One run: what is simulated, how its messages are spoilt, what is configured."""

    name: str                       # the row of a table
    scenario: str
    simulate: JsonDict              # arguments of `simulate`
    config: JsonDict = {}           # parameters of `Config` in place of the truth
    spoil: Callable[[Stream], Any] | None = None
    between: bool = False           # attitudes between epochs are judged, instead of those there


def combination(index: int, seed: Sequence[int], *axes: Iterable[Any]) -> Any:
    """Return one of the combinations of `axes`; each comes once before any comes twice."""
    combinations = list(itertools.product(*axes))
    turn, place = divmod(index, len(combinations))
    order = np.random.default_rng([*seed, turn]).permutation(len(combinations))
    return combinations[order[place]]


def setup(random: np.random.Generator) -> JsonDict:
    """Draw heading, latitude, lever arm and mount as arguments of `simulate`."""
    return {'heading_deg': random.uniform(-180, 180), 'latitude_deg': random.uniform(-75, 75),
            'lever_arm': random.uniform(-1.5, 1.5, 3).tolist(),
            'mount_rpy_deg': random.uniform(-20, 20, 3).tolist()}


# A run

def run_case(task: Sequence[Any]) -> JsonDict:
    """Run what a function draws, the task being the function and its arguments; judge it."""
    case = task[0](*task[1:])
    simulation, stream, aligner = prepare(case)
    looks = follow(aligner, stream.messages(aligner.config), between=case.between)
    return outcome(case, simulation, stream, aligner, list(itertools.chain(*looks)))


def prepare(case: Case) -> tuple[Simulation, Stream, Aligner]:
    """Simulate, spoil the messages, and configure an aligner for what is left of the truth."""
    simulation = simulate(case.scenario, **case.simulate)
    stream = stream_of(simulation, BETWEEN_LOT if case.between else LOT)
    if case.spoil is not None:
        case.spoil(stream)
    return simulation, stream, Aligner(config_for(simulation, **{**stream.config, **case.config}))


def follow(aligner: Aligner, sent: Iterable[Message], every_s: float = UPDATE_EVERY,
           between: bool = False) -> Iterator[list[Epoch]]:
    """
    Give an aligner messages in the order of arrival, and yield the epochs of each update.

    An update without epochs yields what the status says, as an epoch without GNSS, so that silence
    counts. Updates come every so often, with messages 'update' and 'reset', and at the end;
    `between`: after every message, with the attitude now instead of epochs.
    """
    due = 0.0 if math.isfinite(every_s) else math.inf
    for now, kind, payload in sent:
        if kind in SENSORS:
            give(aligner, kind, payload)
        elif kind == 'reject':
            aligner.reject(payload)
        if between or now >= due or kind in ('update', 'reset'):
            yield _epochs(aligner, aligner.update(), between)
            due = now + every_s * SECOND
        if kind == 'reset':
            aligner.reset()
    yield _epochs(aligner, aligner.flush(), between)


def _epochs(aligner: Aligner, epochs: list[Epoch], between: bool) -> list[Epoch]:
    stamp_ns = aligner.newest_imu_ns
    if stamp_ns is None or (epochs and not between):
        return epochs
    status = aligner.status()
    return [Epoch(stamp_ns, math.nan, status.state, status.initial,
                  aligner.attitude_now() if between else status.current, np.full(3, np.nan),
                  status.gyro_bias, status.accel_bias, dry=True)]


# How it is judged

def outcome(case: Case, simulation: Simulation, stream: Stream, aligner: Aligner,
            epochs: list[Epoch]) -> JsonDict:
    """Return which run it was, how it ended, and how right it was."""
    status = aligner.status()

    def true(stamps: list[int]) -> Array:
        return simulation.attitude_at(stream.true_stamps(stamps))

    return {'name': case.name, 'scenario': case.scenario, 'imu': aligner.config.imu_grade,
            'seed': case.simulate['seed'], 'state': status.state.value, 'reason': status.reason,
            'counts': {name: count for name, count in status.counts.items() if count},
            'least_heading_sigma_deg': min((epoch.initial.sigma_deg[2] for epoch in epochs
                                            if epoch.initial is not None), default=None),
            **moments(epochs, true), **while_aligned(epochs, stream.start_ns, true)}


def moments(epochs: Iterable[Epoch], true: Truth) -> JsonDict:
    """
    Judge the first epoch that is levelled, every declaration, the last epoch if it is aligned.

    The errors are the larger ones of the attitude at t0 and the current one. Lists, empty where
    there was none.
    """
    epochs = [epoch for epoch in epochs if not epoch.dry]
    aligned = [epoch.state is State.ALIGNED for epoch in epochs]
    chosen = {
        'levelled': [epoch for epoch in epochs
                     if epoch.state in (State.LEVELLED, State.ALIGNED)][:1],
        'declared': [epoch for epoch, before, now in zip(epochs, [False, *aligned], aligned)
                     if now and not before],
        'final': epochs[-1:] if any(aligned[-1:]) else []}
    return {name: [moment(epoch.t_s, errors_of([epoch.initial, epoch.current], true))
                   for epoch in each if epoch.initial is not None and epoch.current is not None]
            for name, each in chosen.items()}


def moment(t_s: float, errors: list[Error | None]) -> JsonDict:
    """Return a time, s since t0, and the largest errors of tilt and heading."""
    return {'t_s': t_s, **{name: max(getattr(error, name) for error in errors) for name in (
        'tilt_sigmas', 'heading_sigmas', 'tilt_deg', 'heading_deg')}}


def while_aligned(epochs: Sequence[Epoch], start_ns: int, true: Truth, std_deg: Any = 0.0,
                  times: Iterable[float] = ()) -> JsonDict:
    """
    Judge the current attitude whenever it is called aligned, and after some times since t0.

    `std_deg` (3,) says how well the truth is known; `start_ns` is the stamp of the first sample.
    """
    stamps = np.array([epoch.stamp_ns for epoch in epochs], np.int64)
    held = np.clip(np.diff(stamps, append=stamps[-1:]) / SECOND, 0.0, LONGEST)
    known = [k for k, epoch in enumerate(epochs) if epoch.current is not None]
    errors = {k: error for k, error in zip(known, errors_of(
        [epochs[k].current for k in known], true, std_deg)) if error is not None}
    aligned = [k for k in errors if epochs[k].state is State.ALIGNED]
    sigmas = {k: errors[k].worst_sigmas for k in aligned}
    last_s = max((epochs[k].t_s for k in errors), default=-math.inf)
    at = {f'{time:g}': [moment(epochs[k].t_s, [errors[k]]) for k in [
        k for k in errors if epochs[k].t_s <= time + 1e-6][-1:]]
        for time in times if last_s >= time - 1.5}
    return {'first': [moment(epochs[k].t_s, [errors[k]]) for k in aligned[:1]],
            'declared_s': next(((stamps[k] - start_ns) / SECOND for k in aligned), None),
            'epochs': len(aligned), 'worst_sigmas': most(sigmas.values()),
            'worst_heading_deg': most(errors[k].heading_deg for k in aligned),
            'beyond': [beyond(sigmas.values(), limit) for limit in BINS],
            'beyond_s': np.sum(held[[k for k in aligned if sigmas[k] > BINS[1]]]),
            'aligned_part': np.sum(held[[
                k for k in known if epochs[k].state is State.ALIGNED]]) / max(np.sum(held), 1e-9),
            'at': at}


def errors_of(attitudes: list[Any], true: Truth, std_deg: Any = 0.0) -> list[Error | None]:
    """Compare attitudes with the truth; None where that is not known."""
    truths = true([attitude.stamp_ns for attitude in attitudes]) if attitudes else ()
    return [None if C_true is None else error_of(attitude, C_true, std_deg)
            for attitude, C_true in zip(attitudes, truths)]


# Columns of tables, whose rows are a name and its runs

def groups_of(runs: list[JsonDict], names: Iterable[str]) -> Groups:
    """Group runs by name; the last group is all."""
    return [*((name, [run for run in runs if run['name'] == name]) for name in names),
            ('all', runs)]


def worst(moments: Iterable[JsonDict], *angles: str) -> float | None:
    """Return the largest error of judged moments in sigmas, of some of `ANGLES` or all."""
    return most(moment[f'{angle}_sigmas'] for moment in moments for angle in angles or ANGLES)


def beyond(values: Iterable[float | None], limit: float) -> int:
    """Count values above a limit."""
    return sum(value is not None and value > limit for value in values)


def moment_columns(name: str) -> list[Column]:
    """Return how many runs came to a moment, when, and how wrong each angle was."""
    def of_group(value: Callable[[list[JsonDict]], Any]) -> Callable[[Any], Any]:
        return lambda group: value([run[name][0] for run in group[1] if run[name]])

    def share(found: list[JsonDict], angle: str, limit: float) -> str | None:
        wrong = beyond((moment[f'{angle}_sigmas'] for moment in found), limit)
        return f'{wrong} ({100 * wrong / len(found):.1f} %)' if found else None

    return [
        ('case', '', lambda group: group[0]), ('runs', '', lambda group: len(group[1])),
        ('declared', '', of_group(len)),
        ('median, s', '.1f', of_group(lambda found: median([each['t_s'] for each in found]))),
        *itertools.chain(*(
            [*((f'{angle} beyond {limit:g}', '', of_group(
                lambda found, angle=angle, limit=limit: share(found, angle, limit)))
               for limit in BINS),
             (f'worst {angle}, sigma', '.1f', of_group(
                 lambda found, angle=angle: worst(found, angle))),
             (f'{angle}, deg', '.2g', of_group(
                 lambda found, angle=angle: most(each[f'{angle}_deg'] for each in found)))]
            for angle in ANGLES))]


def _each(name: str, value: Callable[[list[Any]], Any]) -> Callable[[Any], Any]:
    """Return a value of what the runs have under a name, those that have it."""
    return lambda group: value([run[name] for run in group[1] if run[name] is not None])


ALIGNED_COLUMNS: list[Column] = [
    ('case', '', lambda group: group[0]), ('runs', '', lambda group: len(group[1])),
    ('declared', '', _each('declared_s', len)),
    ('at the end', '', _each('state', lambda states: states.count(State.ALIGNED.value))),
    ('declared beyond 3', '', lambda group: beyond(
        (worst(run['first']) for run in group[1]), BINS[0])),
    *((f'beyond {limit:g}', '', _each('worst_sigmas', lambda values, limit=limit: beyond(
        values, limit))) for limit in BINS),
    ('beyond 5, s', '.1f', lambda group: most(
        run['beyond_s'] for run in group[1] if run['declared_s'] is not None)),
    ('worst, sigma', '.1f', _each('worst_sigmas', most)),
    ('heading, deg', '.2g', _each('worst_heading_deg', most)),
    ('aligned, %', '.0f', _each('aligned_part', lambda parts: 100 * np.mean(parts))),
    ('after, s', '.1f', _each('declared_s', median))]
