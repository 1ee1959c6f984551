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
Experiments that measure how well the package works; one command runs each of them.

Each prints its tables and writes ``NAME.md``, ``NAME.json`` and figures.
"""

from __future__ import annotations

from pathlib import Path
import pkgutil

from ins_align.config import UsageError

# Title, function and default number of runs (0: it takes none), in the order of `all`.
NAMES = {
    'note': ("The note's experiment", 'bound:run_note', 100),
    'bound': ('The estimator at the Cramer-Rao bound', 'bound:run', 100),
    'declare': ('Declared means right', 'declare:run', 1000),
    'declare-worse': ('IMUs worse than configured', 'declare:run_worse', 500),
    'faults': ('What drivers get wrong', 'faults:run', 1000),
    'weak-spots': ('Faults that are hard to see', 'weak_spots:run', 24),
    'vehicle': ('The motion of a vehicle as a constraint', 'weak_spots:run_vehicle', 24),
    'settings': ('Correct configurations of all kinds', 'declare:run_settings', 200),
    'recordings': ('Real recordings', 'recordings:run', 0)}
# Experiments that need recordings, and those that use them where there are some.
NEED_DATA, TAKE_DATA = ('recordings',), ('vehicle', 'recordings')
# Not part of `all`: it measures the machine too and needs ROS. Its runs are minutes of data.
MEASUREMENTS = {'bench': ('Speed', 'bench:run', 60)}


class ExperimentError(UsageError):
    """An experiment cannot be run as asked."""


def run(name: str, out_dir: str | Path, data_dir: str | Path | None = None,
        runs: int | None = None, jobs: int | None = None) -> None:
    """
    Run one of `NAMES` or `MEASUREMENTS`, or 'all' of `NAMES`, and write pages to `out_dir`.

    `data_dir` is a folder of recordings with a reference attitude on ``/reference/imu``, `runs`
    the number of Monte Carlo runs, `jobs` the number of parallel processes, by default one per
    processor. Raises ExperimentError if there is no such experiment or an input is wrong.
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
    from ins_align.experiments.common import Report     # after the checks: it loads scipy

    for each in NAMES if name == 'all' else (name,):
        if each in NEED_DATA and data_dir is None:
            print(f'{each}: left out, it needs recordings (--data DIR)')
            continue
        title, path, default = (NAMES | MEASUREMENTS)[each]
        data, number = Path(data_dir) if data_dir and each in TAKE_DATA else None, runs or default
        report = Report(each, title, out, (f' --runs {number}' if default else '')
                        + (' --data DIR' if data else ''))
        experiment = pkgutil.resolve_name(f'ins_align.experiments.{path}')
        report.write(experiment(report, number, jobs, data))
