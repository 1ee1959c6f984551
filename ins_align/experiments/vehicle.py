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
Experiment ``vehicle``: a heading from what a vehicle knows of its motion.

A car that goes straight on, and motions that are not what ``vehicle`` says. The base of all is the
IMU, mounted with an error that the seed draws, of `MOUNT_STD_DEG`.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

from ins_align.aligner import Aligner
from ins_align.experiments import recordings
from ins_align.experiments.common import config_for, JsonDict, parallel, Report
from ins_align.experiments.stream import stream_of
from ins_align.experiments.weak_spots import follow, messages, RECORDING, row, truth
from ins_align.simulation.simulate import simulate
import numpy as np

RUNS = 24
MOUNT_STD_DEG = 1.0
LOT = 50                # IMU samples given at once
CONFIG: JsonDict = {'vehicle': 'car', 'mount_yaw_std': MOUNT_STD_DEG, 'trust_imu_axes': True,
                    'heading_std_threshold': 2.0}
EVERY = 10.0            # s from start to start of the recorded car
RECORDED: tuple[JsonDict, ...] = ({}, {'vehicle': 'car'},
                                  {'vehicle': 'car', 'heading_std_threshold': 2.0})


class Case(NamedTuple):
    """A row of the table."""

    name: str
    scenario: str
    simulate: JsonDict = {}
    config: JsonDict = {}
    mount_deg: tuple[float, ...] = ()   # of all runs, instead of those drawn


ROAD = {'duration': 40.0}
STREETS = {'duration': 60.0}
OFF = (0.0, 0.0, 5.0)
CASES = (
    Case('straight road, 10 m/s', 'highway', ROAD),
    Case('the same, vehicle: none', 'highway', ROAD, {'vehicle': 'none'}),
    Case('the same, axes not trusted', 'highway', ROAD, {'trust_imu_axes': False}),
    Case('the same, 10 s at rest before', 'highway', {'duration': 50.0, 'stand_still': 10.0}),
    Case('the same, boat', 'highway', ROAD, {'vehicle': 'boat'}),
    Case('streets', 'car', STREETS),
    Case('streets, vehicle: none', 'car', STREETS, {'vehicle': 'none'}),
    Case('backing out, then streets', 'reverse', STREETS),
    Case('flight with 8 deg of crab, aeroplane', 'flight', {**STREETS, 'crab_deg': 8.0},
         {'vehicle': 'aeroplane'}),
    Case('boat that yaws by 20 deg, boat', 'swing', STREETS, {'vehicle': 'boat'}),
    # Not what `vehicle` says
    Case('streets, mounted 5 deg off', 'car', STREETS, mount_deg=OFF),
    Case('straight road, mounted 5 deg off', 'highway', ROAD, mount_deg=OFF),
    Case('streets backwards', 'car', {**STREETS, 'crab_deg': 180.0}),
    Case('a drift of 20 deg to and fro', 'swing', STREETS),
    Case('towed 70 deg across', 'car', {**STREETS, 'crab_deg': 70.0}),
    Case('on a ferry, 70 deg across, in waves', 'swing', {**STREETS, 'crab_deg': 70.0}),
)


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run every case; the recorded car too if it is there."""
    runs = runs or RUNS
    results = parallel(run_case, [[(number, seed) for seed in range(runs)]
                                  for number in range(len(CASES))], jobs, 'vehicle')
    found = {case.name: each for case, each in zip(CASES, results)}
    paths = sorted(data_dir.glob(f'{RECORDING}*')) if data_dir else []
    report = Report('vehicle', 'What a vehicle knows of its motion', out,
                    f' --runs {runs}' + (' --data DIR' if paths else ''))
    report.text(
        f'{runs} runs of each case, MEMS, GNSS velocity 0.1 m/s at 5 Hz, the mounting off by '
        f'{MOUNT_STD_DEG:g} deg (1 sigma, pitch and yaw) and stated so, `vehicle: car` unless the '
        'case says otherwise, `trust_imu_axes` and a heading threshold of 2 deg. Columns as in '
        'weak-spots; "not used": the runs at whose end the reason says that the motion '
        'contradicts `vehicle`.')
    report.table('Simulated', [
        row(name, of_case) | {'not used': sum(result['not_used'] for result in of_case)}
        for name, of_case in found.items()])
    if paths:
        starts = np.arange(0.0, max(recordings.load(paths[0]).duration - EVERY, 0.0), EVERY)
        windows = parallel(run_recorded, [[(paths[0], told, start) for start in starts.tolist()]
                                          for told in RECORDED], jobs, 'recorded car')
        report.table('The recorded car, started anew every 10 s', [
            recordings.declared_row(
                ', '.join(f'{name}: {value}' for name, value in told.items()) or 'none', each)
            for told, each in zip(RECORDED, windows)])
    report.write({'runs': runs, 'cases': found})


def run_case(task: tuple[int, int]) -> JsonDict:
    """Simulate one run of a case and judge what is declared."""
    number, seed = task
    case, random = CASES[number], np.random.default_rng([8, seed])
    mount = MOUNT_STD_DEG * random.standard_normal(3) * [0.0, 1.0, 1.0]
    simulation = simulate(case.scenario, **{
        'seed': seed, 'heading_deg': float(random.uniform(-180.0, 180.0)),
        'mount_rpy_deg': case.mount_deg or mount.tolist(), **case.simulate})
    stream = stream_of(simulation)
    aligner = Aligner(config_for(simulation, **{**CONFIG, **stream.config, **case.config}))
    result = follow(aligner, messages(stream, aligner.config, LOT),
                    partial(truth, simulation, stream))
    return {**result, 'seed': seed,
            'not_used': 'contradicts vehicle' in aligner.status().reason}


def run_recorded(task: tuple[Path, JsonDict, float]) -> recordings.Window:
    """Align a window of a recording."""
    path, told, start = task
    return recordings.run_window(path, start, 120.0, **told)
