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
"""What the experiments share: processes, errors against truth, tables and pages."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import io
import itertools
import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.geometry.rotation import Array, log_so3
from ins_align.outputs import write_whole
from ins_align.processes import pool, processors
from ins_align.report import format_table, new_figure
from ins_align.results import Attitude
from ins_align.simulation.simulate import Simulation
import numpy as np

# Of simulated data nothing comes late, but an unknown delay wants IMU samples beyond the stamp.
LATENESS = 0.5
GRADES = ('navigation', 'tactical', 'mems')
BINS = (3.0, 5.0)       # sigmas that are counted
COLOURS = 64            # of a figure

JsonDict = dict[str, Any]
Column = tuple[str, str, Callable[[Any], Any]]  # title, format, and the value of a row's object


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


class Error(NamedTuple):
    """Error of an attitude against the truth."""

    angles_deg: Array       # (3,), about east, north, up
    nees: float             # normalised squared error of the three angles
    tilt_sigmas: float      # the larger one of two, each in its stated sigma
    heading_sigmas: float

    @property
    def worst_sigmas(self) -> float:
        """Larger one of tilt and heading."""
        return max(self.tilt_sigmas, self.heading_sigmas)

    @property
    def tilt_deg(self) -> float:
        """Angle between the verticals."""
        return float(np.hypot(*self.angles_deg[:2]))

    @property
    def heading_deg(self) -> float:
        """Size of the angle about the vertical."""
        return float(abs(self.angles_deg[2]))


def error_of(attitude: Attitude, C_true: Array, extra_std_deg: Any = 0.0) -> Error:
    """Compare an attitude with ``C_nb``, whose own sigma (3,), if any, is added in quadrature."""
    phi = log_so3(C_true @ attitude.C_nb.T)
    covariance = attitude.covariance + np.diag(np.radians(np.broadcast_to(extra_std_deg, 3)) ** 2)
    sigmas = np.abs(phi) / np.sqrt(np.diag(covariance))
    return Error(np.degrees(phi), float(phi @ np.linalg.solve(covariance, phi)),
                 float(np.max(sigmas[:2])), float(sigmas[2]))


def field(title: str, name: str, digits: str = '') -> Column:
    """Return the column of what rows, which are dictionaries, have under a name."""
    return title, digits, lambda row: row[name]


def most(values: Iterable[float]) -> float | None:
    """Return the largest value, None if there is none."""
    return max(values, default=None)


def median(values: Any) -> float | None:
    """Return the median, None if there is nothing."""
    return float(np.median(values)) if len(values) else None


def rms(values: Any, axis: Any = None) -> Any:
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values), axis=axis))


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
