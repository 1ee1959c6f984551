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
from concurrent.futures import ProcessPoolExecutor
import io
import itertools
import json
import math
import multiprocessing
import os
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

from ins_align.aligner import Attitude, Epoch, State
from ins_align.config import Config
from ins_align.geometry.rotation import Array, log_so3
from ins_align.outputs import write_whole
from ins_align.processes import processors, VARIABLES
from ins_align.report import format_table
from ins_align.simulation.simulate import Simulation
import numpy as np

# Of simulated data nothing comes late, but an unknown delay wants IMU samples beyond the stamp.
LATENESS = 0.5
GRADES = ('navigation', 'tactical', 'mems')
COLOURS = 64        # of a figure
BINS = (3.0, 5.0)   # sigmas that are counted

JsonDict = dict[str, Any]


def parallel(function: Callable[[Any], Any], tasks: Sequence[Any],
             jobs: int | None = None, name: str = '') -> list[Any]:
    """
    Map a function of a module over tasks in processes of one thread each.

    Parameters
    ----------
    function : callable
        Takes one task.
    tasks : sequence
        Tasks that share a trajectory should be neighbours: a process keeps the last few.
    jobs : int, optional
        By default one a processor; 1 stays in this process.
    name : str, optional
        Shown with the progress on a terminal.

    """
    from tqdm import tqdm

    jobs = min(jobs or processors(), max(len(tasks), 1))

    def shown(results: Iterable[Any]) -> list[Any]:
        return list(tqdm(results, name, len(tasks), disable=None))  # None: not on a terminal

    if jobs == 1:
        return shown(map(function, tasks))
    # A fresh interpreter reads the number of threads when it imports numpy.
    with patch.dict(os.environ, dict.fromkeys(VARIABLES, '1')), ProcessPoolExecutor(
            jobs, multiprocessing.get_context('spawn')) as pool:
        return shown(pool.map(function, tasks,
                              chunksize=max(1, min(10, len(tasks) // (4 * jobs)))))


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


def counted(sigmas: Any) -> list[int]:
    """Count errors within the first of `BINS`, between them, and beyond the second."""
    sigmas = np.asarray(sigmas, dtype=float)
    return [int(np.sum(sigmas <= BINS[0])), int(np.sum((sigmas > BINS[0]) & (sigmas <= BINS[1]))),
            int(np.sum(sigmas > BINS[1]))]


def config_for(simulation: Simulation, **changes: Any) -> Config:
    """Return the defaults with a simulation's IMU grade and lever arm."""
    values: dict[str, Any] = {
        'lever_arm': tuple(simulation.lever_arm.tolist()), 'gnss_lateness': LATENESS,
        'imu_grade': simulation.meta['imu_grade']}
    values.update(changes)
    return Config(**values)


def exact_config_for(simulation: Simulation, **changes: Any) -> Config:
    """Return the very model of a simulation; lever arm and delay are known."""
    noise = simulation.imu_noise
    values: dict[str, Any] = {
        'imu_grade': 'custom', 'angle_random_walk': 60 * math.degrees(noise.angle_random_walk),
        'velocity_random_walk': 60 * noise.velocity_random_walk,
        'gyro_bias_std': math.degrees(noise.gyro_bias_std),
        'accel_bias_std': noise.accel_bias_std, 'gyro_scale_std': noise.gyro_scale_std,
        'rate_random_walk': 60 * math.degrees(noise.rate_random_walk),
        'lever_arm_std': 0.0, 'gnss_delay_std': 0.0}
    values.update(changes)
    return config_for(simulation, **values)


class Error(NamedTuple):
    """
    Error of an attitude against the truth.

    Attributes
    ----------
    angles_deg : ndarray, shape (3,)
        About east, north, up.
    sigma_deg : ndarray, shape (3,)
        Stated.
    nees : float
        Normalised squared error of the three angles.

    """

    angles_deg: Array
    sigma_deg: Array
    nees: float

    @property
    def tilt_sigmas(self) -> float:
        """Larger one of the two tilts, each in its sigma."""
        return float(np.max(np.abs(self.angles_deg[:2]) / self.sigma_deg[:2]))

    @property
    def heading_sigmas(self) -> float:
        """Heading in its sigma."""
        return float(abs(self.angles_deg[2]) / self.sigma_deg[2])

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers."""
        return {'error_deg': self.angles_deg.tolist(), 'sigma_deg': self.sigma_deg.tolist(),
                'tilt_sigmas': self.tilt_sigmas, 'heading_sigmas': self.heading_sigmas}


def error_of(attitude: Attitude, C_true: Array, extra_std_deg: Array | None = None) -> Error:
    """
    Compare an attitude with the truth.

    Parameters
    ----------
    attitude : Attitude
        The estimate.
    C_true : ndarray, shape (3, 3)
        ``C_nb``.
    extra_std_deg : ndarray, shape (3,), optional
        Of the truth itself, about east, north, up; added in quadrature.

    """
    phi = log_so3(C_true @ attitude.C_nb.T)
    covariance = attitude.covariance
    if extra_std_deg is not None:
        covariance = covariance + np.diag(np.radians(extra_std_deg) ** 2)
    return Error(np.degrees(phi), np.degrees(np.sqrt(np.diag(covariance))),
                 float(phi @ np.linalg.solve(covariance, phi)))


def first_in(epochs: Iterable[Epoch], *states: State) -> Epoch | None:
    """Return the first epoch in one of the states."""
    return next((epoch for epoch in epochs if epoch.state in states), None)


def rms(values: Any, axis: int | None = None) -> Any:
    """Root mean square."""
    return np.sqrt(np.mean(np.square(values), axis=axis))


class Report:
    """
    Collects the text of an experiment, prints it, writes it.

    Parameters
    ----------
    name : str
    title : str
    out : Path
    command : str
        What else than the name stands in the command that makes it.

    """

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

    def table(self, title: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
        """Add a table."""
        table = format_table(rows, header)
        self._parts.append(f'{title}\n\n```text\n{table}\n```')
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
