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
"""What the experiments share: runs, how they are judged, tables and pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import io
import itertools
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Aligner, Attitude, Epoch, State
from ins_align.config import Config
from ins_align.experiments.spoilt import Message, SECOND, SENSORS, Stream, stream_of
from ins_align.geometry.rotation import Array, log_so3
from ins_align.outputs import write_whole
from ins_align.processes import pool, processors
from ins_align.report import format_table, new_figure
from ins_align.simulation.simulate import give, simulate, Simulation
import numpy as np

# Of simulated data nothing comes late, but an unknown delay wants IMU samples beyond the stamp.
LATENESS = 0.5
GRADES = ('navigation', 'tactical', 'mems')
BINS = (3.0, 5.0)       # sigmas that are counted
COLOURS = 64            # of a figure
UPDATE_EVERY = 5.0      # s
LONGEST = 5.0           # s that a look stands for
ANGLES = {'tilt': slice(0, 2), 'heading': slice(2, 3)}      # what is counted, and its axes

JsonDict = dict[str, Any]
Groups = list[tuple[str, list[JsonDict]]]       # of trials, with names
Column = tuple[str, str, Callable[[Any], Any]]  # title, format, and the value of a row's object
Truth = Callable[[Any], Any]                    # attitudes at stamps


def parallel(function: Callable[[Any], Any], groups: Sequence[Sequence[Any]], jobs: int | None,
             name: str = '') -> list[list[Any]]:
    """
    Map a function of a module over groups of tasks; in processes, by default one a processor.

    Tasks that share a trajectory should be neighbours: a process keeps the last few. The name is
    shown with the progress on a terminal.
    """
    from tqdm import tqdm

    every = list(itertools.chain(*groups))
    jobs = min(jobs or processors(), max(len(every), 1))

    def grouped(results: Iterable[Any]) -> list[list[Any]]:
        shown = iter(tqdm(results, name, len(every), disable=None))     # None: not on a terminal
        return [list(itertools.islice(shown, len(group))) for group in groups]

    if jobs == 1:
        return grouped(map(function, every))
    with pool(jobs) as executor:
        return grouped(executor.map(function, every,
                                    chunksize=max(1, min(10, len(every) // (4 * jobs)))))


# What is run

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


def config_for(simulation: Simulation, **changes: Any) -> Config:
    """Return the defaults with a simulation's IMU grade and lever arm."""
    return Config(**{'lever_arm': tuple(simulation.lever_arm.tolist()), 'gnss_lateness': LATENESS,
                     'imu_grade': simulation.meta['imu_grade'], **changes})


def exact_config_for(simulation: Simulation, **changes: Any) -> Config:
    """Return the very model of a simulation; lever arm and delay are known."""
    noise = simulation.imu_noise
    return config_for(simulation, **{
        'imu_grade': 'custom', 'angle_random_walk': 60 * math.degrees(noise.angle_random_walk),
        'velocity_random_walk': 60 * noise.velocity_random_walk,
        'gyro_bias_std': math.degrees(noise.gyro_bias_std),
        'accel_bias_std': noise.accel_bias_std, 'gyro_scale_std': noise.gyro_scale_std,
        'rate_random_walk': 60 * math.degrees(noise.rate_random_walk),
        'lever_arm_std': 0.0, 'gnss_delay_std': 0.0, **changes})


def prepare(scenario: str, arguments: JsonDict, config: JsonDict, frame: str = 'enu',
            spoil: Callable[[Stream], Any] | None = None) -> tuple[Simulation, Stream, Aligner]:
    """Simulate, spoil the messages, and configure an aligner for what is left of the truth."""
    simulation = simulate(scenario, **arguments)
    stream = stream_of(simulation, frame)
    if spoil is not None:
        spoil(stream)
    return simulation, stream, Aligner(config_for(simulation, **{**stream.config, **config}))


class Look(NamedTuple):
    """What an aligner says at an epoch, or between epochs: there `t_s` is None."""

    stamp_ns: int
    t_s: float | None
    state: State
    initial: Attitude | None
    current: Attitude | None


def follow(aligner: Aligner, sent: Iterable[Message], every_s: float = UPDATE_EVERY,
           between: bool = False, watch: Callable[[list[Epoch]], Any] | None = None) -> list[Look]:
    """
    Give an aligner messages in the order of arrival, and look at what it says every so often.

    Without epochs it is looked at as well, so that silence counts; `every_s` 0: when the messages
    have an 'update'. `between` asks for the attitude after every message instead of looking at
    epochs; `watch` gets the epochs of each update.
    """
    looks: list[Look] = []

    def look(epochs: list[Epoch]) -> None:
        if watch is not None:
            watch(epochs)
        if epochs and not between:
            looks.extend(Look(*(getattr(epoch, name) for name in Look._fields))
                         for epoch in epochs)
        elif aligner.newest_imu_ns is not None:
            status = aligner.status()
            looks.append(Look(aligner.newest_imu_ns, None, status.state, status.initial,
                              aligner.attitude_now() if between else status.current))

    due = 0.0 if every_s else math.inf
    for now, kind, payload in sent:
        if kind in SENSORS:
            give(aligner, kind, payload)
        elif kind == 'reject':
            aligner.reject(payload)
        if between or now >= due or kind in ('update', 'reset'):
            look(aligner.update())
            due = now + every_s * SECOND if every_s else math.inf
        if kind == 'reset':
            aligner.reset()
    look(aligner.flush())
    return looks


# How it is judged

class Error(NamedTuple):
    """Error of an attitude against the truth."""

    angles_deg: Array       # (3,), about east, north, up
    sigma_deg: Array        # (3,), stated
    nees: float             # normalised squared error of the three angles
    tilt_sigmas: float      # the larger one of two, each in its sigma
    heading_sigmas: float

    @property
    def worst_sigmas(self) -> float:
        """Larger one of tilt and heading."""
        return max(self.tilt_sigmas, self.heading_sigmas)

    @property
    def tilt_deg(self) -> float:
        """Angle between the verticals."""
        return float(np.hypot(*self.angles_deg[:2]))

    def to_json(self) -> JsonDict:
        """Return plain numbers."""
        return {'error_deg': self.angles_deg.tolist(), 'sigma_deg': self.sigma_deg.tolist(),
                'tilt_sigmas': self.tilt_sigmas, 'heading_sigmas': self.heading_sigmas}


def error_of(attitude: Attitude, C_true: Array, extra_std_deg: Array | None = None) -> Error:
    """Compare an attitude with ``C_nb``, whose own sigma (3,), if any, is added in quadrature."""
    phi = log_so3(C_true @ attitude.C_nb.T)
    covariance = attitude.covariance
    if extra_std_deg is not None:
        covariance = covariance + np.diag(np.radians(extra_std_deg) ** 2)
    angles, sigma = np.degrees(phi), np.degrees(np.sqrt(np.diag(covariance)))
    sigmas = np.abs(angles) / sigma
    return Error(angles, sigma, float(phi @ np.linalg.solve(covariance, phi)),
                 float(np.max(sigmas[:2])), float(sigmas[2]))


def judged(look: Look | None, true: Truth) -> JsonDict | None:
    """Compare the attitudes of a look with the truth at their stamps."""
    if look is None or look.initial is None or look.current is None:
        return None
    return {'t_s': look.t_s} | {
        name: error_of(attitude, true(attitude.stamp_ns)).to_json()
        for name, attitude in (('initial', look.initial), ('current', look.current))}


def moments(looks: Iterable[Look], true: Truth) -> JsonDict:
    """Judge the first epoch that is levelled, the last if it is aligned, every declaration."""
    epochs = [look for look in looks if look.t_s is not None]
    aligned = [look.state is State.ALIGNED for look in epochs]
    levelled = (look for look in epochs if look.state in (State.LEVELLED, State.ALIGNED))
    declared = [judged(look, true) for look, before, now in zip(
        epochs, [False, *aligned], aligned) if now and not before]
    return {'levelled': judged(next(levelled, None), true),
            'aligned': declared[0] if declared else None, 'declared': declared,
            'final': judged(epochs[-1], true) if any(aligned[-1:]) else None}


def while_aligned(looks: Sequence[Look], start_ns: int, true: Truth,
                  std_deg: Array | None = None) -> JsonDict:
    """
    Judge the current attitude whenever it is called aligned.

    `true` may have None where nothing is known, `std_deg` (3,) says how well; `start_ns` is the
    stamp of the first sample.
    """
    stamps = np.array([look.stamp_ns for look in looks], np.int64)
    held = np.clip(np.diff(stamps, append=stamps[-1:]) / SECOND, 0.0, LONGEST)
    aligned = {k: look.current for k, look in enumerate(looks)
               if look.state is State.ALIGNED and look.current is not None}
    truths = true([attitude.stamp_ns for attitude in aligned.values()]) if aligned else []
    errors = {k: error_of(attitude, C_true, std_deg)
              for (k, attitude), C_true in zip(aligned.items(), truths) if C_true is not None}
    first = next(iter(errors), None)
    wrong = [k for k, error in errors.items() if error.worst_sigmas > BINS[1]]
    return {'declared_s': None if first is None else (stamps[first] - start_ns) / SECOND,
            'declared_sigmas': None if first is None else errors[first].worst_sigmas,
            'worst_sigmas': max((e.worst_sigmas for e in errors.values()), default=0.0),
            'worst_heading_deg': max((abs(e.angles_deg[2]) for e in errors.values()),
                                     default=0.0),
            'beyond_s': np.sum(held[wrong]),
            'aligned_part': np.sum(held[[*aligned]]) / max(np.sum(held), 1e-9)}


def worse(moment: JsonDict | None, *angles: str) -> float:
    """
    Error of a judged moment in sigmas; -1 if there was none.

    The worse of the attitude at t0 and the current one, of any of `ANGLES` or of all.
    """
    return -1.0 if moment is None else max(
        moment[name][f'{angle}_sigmas'] for name in ('initial', 'current')
        for angle in angles or ANGLES)


def most(values: Iterable[float]) -> float | None:
    """Return the largest value, None if there is none."""
    return max(values, default=None)


def median(values: Any) -> float | None:
    """Return the median, None if there is nothing."""
    return float(np.median(values)) if len(values) else None


def rms(values: Any, axis: Any = None) -> Any:
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values), axis=axis))


def without(trials: list[JsonDict], *omitted: str) -> list[JsonDict]:
    """Return trials without what need not be written."""
    return [{key: value for key, value in t.items() if key not in omitted} for t in trials]


# Pages

class Report:
    """Collects the text of an experiment, prints it, writes it with the command that makes it."""

    def __init__(self, name: str, title: str, out: Path, command: str = '') -> None:
        """Start with the title and the command."""
        self._name = name
        self._out = out
        self._parts = [f'# {title}', f'`ins_align experiment {name} --out DIR{command}`']
        print(f'{title}\n')

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self._parts.append(text)
        print(text + '\n')

    def table(self, title: str, objects: Iterable[Any], columns: Sequence[Column]) -> None:
        """Add a table with a row for each object; a value that is None becomes a dash."""
        rows = [[None if (value := value_of(each)) is None else format(value, digits)
                 for _, digits, value_of in columns] for each in objects]
        table = format_table(rows, [name for name, *_ in columns]) if rows else 'none'
        self._parts.append(f'{title}\n\n```text\n{table}\n```' if rows else f'{title}: none.')
        print(f'{title}\n\n{table}\n', flush=True)

    def figure(self, figure: Any, suffix: str, caption: str) -> None:
        """Write a figure as PNG and refer to it."""
        from PIL import Image

        file = f'{self._name}{suffix}.png'
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=110)
        # A palette makes the files of the documentation a third as large.
        image = Image.open(drawn).convert('RGB').quantize(COLOURS)
        write_whole(self._out / file, lambda png: image.save(png, 'PNG', optimize=True))
        self._parts.append(f'![{caption}]({file})\n\n{caption}')
        print(f'{self._out / file}: {caption}\n')

    def write(self, numbers: Any) -> None:
        """Write the text and the numbers."""
        for suffix, text in (('md', '\n\n'.join(self._parts)),
                             ('json', json.dumps(_plain(numbers), indent=1))):
            content = f'{text}\n'.encode()
            write_whole(self._out / f'{self._name}.{suffix}', lambda file: file.write(content))


def whose() -> list[Column]:
    """Return the columns that say which trial it is."""
    return [(title, '', lambda t, key=key: t[key]) for title, key in (
        ('index', 'index'), ('fault', 'fault'), ('scenario', 'scenario'), ('IMU', 'imu'))]


def groups_of(trials: list[JsonDict], faults: Iterable[str]) -> Groups:
    """Group trials by fault; the last group is all."""
    return [*((name, [t for t in trials if t['fault'] == name]) for name in faults),
            ('all', trials)]


def draw(width: float, height: float, panels: Sequence[Sequence[JsonDict]], **shared: Any) -> Any:
    """
    Draw lines over time in a grid of panels, inches; what they share is for ``subplots``.

    A panel has what ``Axes.set`` takes, and ``lines``: x, y and style of each.
    """
    picture = new_figure(width, height)
    grid = picture.subplots(len(panels), len(panels[0]), squeeze=False, **shared)
    for axes, panel in zip(grid.ravel(), itertools.chain(*panels)):
        for x, y, style in panel['lines']:
            axes.plot(x, y, **style)
        axes.set(**{name: value for name, value in panel.items() if name != 'lines'})
        axes.grid(which='both', alpha=0.25)
    for axes in grid[-1]:
        axes.set_xlabel('time since t0 (s)')
    if grid[0, 0].get_legend_handles_labels()[1]:
        grid[0, 0].legend(fontsize=8)
    return picture


def _plain(value: Any) -> Any:
    """Return what JSON can hold; numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f'{value:.6g}') if math.isfinite(value) else None
    return value
