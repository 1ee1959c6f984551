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
"""What the experiments share: parallel runs, errors against truth, and the files they write."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import io
import itertools
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.aligner import Attitude, Epoch
from ins_align.config import Config
from ins_align.geometry.rotation import Array, log_so3
from ins_align.outputs import write_whole
from ins_align.processes import pool, processors
from ins_align.report import format_table, new_figure
from ins_align.simulation.simulate import Simulation
import numpy as np

# Of simulated data nothing comes late, but an unknown delay wants IMU samples beyond the stamp.
LATENESS = 0.5
GRADES = ('navigation', 'tactical', 'mems')
COLOURS = 64        # of a figure
BINS = (3.0, 5.0)   # sigmas that are counted

JsonDict = dict[str, Any]
Groups = list[tuple[str, list[JsonDict]]]      # of trials, with names


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


# Errors against the truth

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


# What is counted of a moment, and its axes.
ANGLES = {'tilt': slice(0, 2), 'heading': slice(2, 3)}


def judged(epoch: Epoch | None, true: Callable[[Any], Array]) -> JsonDict | None:
    """Compare the attitudes of an epoch with the truth at their stamps."""
    if epoch is None or epoch.initial is None or epoch.current is None:
        return None
    return {'t_s': epoch.t_s} | {
        name: error_of(attitude, true(attitude.stamp_ns)).to_json()
        for name, attitude in (('initial', epoch.initial), ('current', epoch.current))}


def worse(moment: JsonDict | None, *angles: str) -> float:
    """
    Error of a judged moment in sigmas; -1 if there was none.

    The worse of the attitude at t0 and the current one, of any of `ANGLES` or of all.
    """
    return -1.0 if moment is None else max(
        moment[name][f'{angle}_sigmas'] for name in ('initial', 'current')
        for angle in angles or ANGLES)


def first_in(epochs: Iterable[Epoch], *states: Any) -> Epoch | None:
    """Return the first epoch in one of the states."""
    return next((epoch for epoch in epochs if epoch.state in states), None)


def most(values: Iterable[float], digits: str) -> str | None:
    """Return the largest value as text, None if there is none."""
    values = list(values)
    return format(max(values), digits) if values else None


def without(trials: list[JsonDict], *omitted: str) -> list[JsonDict]:
    """Return trials without what need not be written."""
    return [{key: value for key, value in t.items() if key not in omitted} for t in trials]


def rms(values: Any, axis: Any = None) -> Any:
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values), axis=axis))


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

    def table(self, title: str, rows: Iterable[JsonDict]) -> None:
        """Add a table of rows that have their columns' names."""
        rows = list(rows)
        table = format_table([list(row.values()) for row in rows], list(rows[0]) if rows else ())
        self._parts.append(f'{title}\n\n```text\n{table}\n```' if rows else f'{title}: none.')
        print(f'{title}\n\n{table or "none"}\n', flush=True)

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


def groups_of(trials: list[JsonDict], faults: Iterable[str]) -> Groups:
    """Group trials by fault; the last group is all."""
    return [*((name, [t for t in trials if t['fault'] == name]) for name in faults),
            ('all', trials)]


def moment_table(report: Report, title: str, groups: Groups, moment: str) -> None:
    """Print when groups of trials came to a moment, and how many were beyond the limits."""
    rows = []
    for name, trials in groups:
        declared = [t[moment] for t in trials if t[moment] is not None]
        times = [each['t_s'] for each in declared]
        row = {'fault': name, 'runs': len(trials), 'declared': len(declared),
               'median, s': f'{np.median(times):.1f}' if times else None}
        for angle, axes in ANGLES.items():
            sigmas = np.array([worse(each, angle) for each in declared])
            for limit in BINS:
                share = f'{np.sum(sigmas > limit)} ({100 * np.mean(sigmas > limit):.1f} %)' \
                    if declared else None
                row[f'{angle} beyond {limit:g}'] = share
            row[f'worst {angle}, sigma'] = most(sigmas, '.1f')
            row[f'{angle}, deg'] = most(
                (np.max(np.abs(each[which]['error_deg'][axes])) for each in declared
                 for which in ('initial', 'current')), '.2g')
        rows.append(row)
    report.table(title, rows)


def whose(trial: JsonDict) -> JsonDict:
    """Return the columns that say which trial it is."""
    return {'index': trial['index'], 'fault': trial['fault'], 'scenario': trial['scenario'],
            'IMU': trial['imu']}


def offender_table(report: Report, trials: list[JsonDict], *moments: str) -> list[JsonDict]:
    """Print and return the trials that are beyond the first of `BINS` at one of the moments."""
    report.table(f'Beyond {BINS[0]:g} sigma', [
        {**whose(t), 'moment': moment,
         **{f'{angle}, sigma': f'{worse(t[moment], angle):.1f}' for angle in ANGLES},
         'after, s': f"{t[moment]['t_s']:.1f}"}
        for moment in moments for t in trials if worse(t[moment]) > BINS[0]])
    return [t for t in trials if max(worse(t[moment]) for moment in moments) > BINS[0]]


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
