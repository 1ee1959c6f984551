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
Experiments: what is known of the package in numbers, each made by one command.

Each prints its tables and writes ``NAME.md``, ``NAME.json`` and figures.
"""

from __future__ import annotations

import importlib
from pathlib import Path

# Module and function of each, in the order in which `all` runs them.
NAMES = {'note': 'note.run', 'bound': 'bound.run', 'declare': 'declare.run',
         'declare-worse': 'declare.run_worse', 'faults': 'faults.run',
         'weak-spots': 'weak_spots.run', 'vehicle': 'weak_spots.run_vehicle',
         'recordings': 'recordings.run'}
NEED_DATA = ('recordings',)
# Only by name: it measures the machine too, and needs ROS.
MEASUREMENTS = {'bench': 'bench.run'}


class ExperimentError(ValueError):
    """An experiment cannot be run as asked."""


def run(name: str, out_dir: str | Path, data_dir: str | Path | None = None,
        runs: int | None = None, jobs: int | None = None) -> None:
    """
    Run one of `NAMES` or `MEASUREMENTS`, or 'all' of the former; pages go to `out_dir`.

    `data_dir` has recordings that carry a reference attitude on ``/reference/imu``; `runs` is of
    Monte Carlo, `jobs` processes at a time, by default one a processor. ExperimentError says that
    there is no such experiment or that it lacks its input.
    """
    known = (*NAMES, 'all', *MEASUREMENTS)
    if name not in known:
        raise ExperimentError(f'no experiment {name!r}: there are {", ".join(known)}')
    if runs is not None and runs < 1 or jobs is not None and jobs < 1:
        raise ExperimentError('runs and jobs must be at least 1')
    if name in NEED_DATA and data_dir is None:
        raise ExperimentError(f'{name} needs recordings: --data DIR names their folder')
    if data_dir is not None and not Path(data_dir).is_dir():
        raise ExperimentError(f'there is no directory {data_dir}')
    out = Path(out_dir)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExperimentError(f'cannot write to {out}: {error.strerror}') from None
    for each in NAMES if name == 'all' else (name,):
        if each in NEED_DATA and data_dir is None:
            print(f'{each}: left out, it needs recordings (--data DIR)')
            continue
        module, function = (NAMES | MEASUREMENTS)[each].split('.')
        getattr(importlib.import_module(f'ins_align.experiments.{module}'), function)(
            out, None if data_dir is None else Path(data_dir), runs, jobs)
