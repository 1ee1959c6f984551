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
Experiment ``bench``: speed, each figure against something measured in the same run.

``--runs`` is how many minutes of data are replayed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, ExitStack
import os
from pathlib import Path
import pickle
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from ins_align.aligner import Aligner
from ins_align.experiments.common import config_for, Report
from ins_align.simulation.simulate import give, simulate
import numpy as np

MINUTES = 60
REPEATS = 3
CPU_SECONDS = 20.0
EPOCH_SECONDS = 600.0
TARGETS = {'mcap': '2.0', 'sqlite3': '3.0'}     # of replay over a bare pass, by storage
NODES = 'ins_align.experiments.nodes'
COUNT = """
from pathlib import Path
import sys
from rosbags.highlevel import AnyReader
with AnyReader([Path(sys.argv[1])]) as reader:
    print(sum(1 for _ in reader.messages()))
"""


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Measure everything one after the other, without anything else beside it."""
    minutes = runs or MINUTES
    report = Report('bench', 'Speed', out, f' --runs {minutes}')
    report.text('Ratios against something measured in the same run on the same machine; for '
                'replay and start the median of three goes, for the node processor time of the '
                'whole process while both run beside each other on the same messages.')
    rows: list[list[str]] = []
    with tempfile.TemporaryDirectory() as folder:
        for storage in TARGETS:
            rows.append(replay_against_bare_pass(Path(folder), storage, minutes))
        rows += node_rows(Path(folder))
    rows += epoch_rows()
    rows.append(start_row())
    report.table('Ours, what it is measured against, their ratio and what it should be at most',
                 ['', 'ours', 'other', 'ratio', 'target'], rows)
    report.write([dict(zip(('name', 'ours', 'other', 'ratio', 'target'), row)) for row in rows])


def row_of(name: str, ours: float, other: float, unit: str, target: str) -> list[str]:
    """Make a row of the table."""
    return [name, f'{ours:.3g} {unit}', f'{other:.3g} {unit}', f'{ours / other:.2f}', target]


def elapsed(command: Sequence[str]) -> float:
    """Run a process and return how long it took, s."""
    start = time.perf_counter()
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    if done.returncode not in (0, 1):
        raise RuntimeError(done.stderr)
    return time.perf_counter() - start


def medians(*commands: Sequence[str]) -> list[float]:
    """Run commands in turns and return the median time of each, s."""
    times = [[elapsed(command) for command in commands] for _ in range(REPEATS)]
    return [statistics.median(column) for column in zip(*times)]


def replay_against_bare_pass(folder: Path, storage: str, minutes: int) -> list[str]:
    """Replay a recording, and only count its messages."""
    bag = folder / f'bag_{storage}'
    _command('simulate', str(bag), '--scenario', 'car', '--imu-rate', '200', '--duration',
             str(60 * minutes), '--storage', storage)
    ours, bare = medians(_cli('replay', str(bag), '--params', str(bag / 'ins_align.yaml')),
                         [sys.executable, '-c', COUNT, str(bag)])
    return row_of(f'replay of {minutes} min, {storage}; bare pass', ours, bare, 's',
                  TARGETS[storage])


def _cli(*arguments: str) -> list[str]:
    return [sys.executable, '-m', 'ins_align.cli', *arguments]


def _command(*arguments: str) -> None:
    subprocess.run(_cli(*arguments), check=True, stdout=subprocess.DEVNULL)


def node_rows(folder: Path) -> list[list[str]]:
    """Compare processor times of nodes."""
    script = folder / 'script.pickle'
    script.write_bytes(pickle.dumps(_script(CPU_SECONDS + 15.0)))
    rows = []
    for name, title in (('bare', 'node, nobody listens; node that does nothing'),
                        ('republish', 'node, ~/imu listened to; node that republishes')):
        with ExitStack() as stack:
            other = stack.enter_context(_process('-m', NODES, name))
            ours = stack.enter_context(_process(
                '-m', 'ins_align.ros.main', '--ros-args', '-p', 'lever_arm:=[1.0, 1.0, 1.0]'))
            if name == 'republish':
                stack.enter_context(_process('-m', NODES, 'listen'))
            time.sleep(3.0)
            stack.enter_context(_process('-m', NODES, 'play', str(script)))
            time.sleep(8.0)
            before = _cpu_seconds(ours), _cpu_seconds(other)
            time.sleep(CPU_SECONDS)
            spent = [100.0 * (_cpu_seconds(pid) - start) / CPU_SECONDS
                     for pid, start in zip((ours, other), before)]
        rows.append(row_of(title, *spent, '% CPU', '1.15'))
    return rows


def _script(seconds: float) -> Any:
    # In a process of its own, this one need not have ROS to be imported.
    from ins_align.experiments.nodes import script_of

    return script_of(simulate('car', imu_rate=200.0, gnss_rate=10.0, duration=seconds))


@contextmanager
def _process(*arguments: str) -> Iterator[int]:
    """Run a Python process, give its number and interrupt it in the end."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL)
    try:
        yield process.pid
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(20.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _cpu_seconds(pid: int) -> float:
    """Processor time of a process, user and system."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def epoch_rows() -> list[list[str]]:
    """Measure the time of every GNSS epoch with its IMU samples, and how memory grows."""
    data = simulate('car', duration=EPOCH_SECONDS)
    aligner = Aligner(config_for(data))
    times, resident = [], []
    start = time.process_time()
    for kind, payload in data.messages():
        give(aligner, kind, payload)
        if kind == 'velocity':
            aligner.update()
            now = time.process_time()
            times.append(1e3 * (now - start))
            start = now
            resident.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    grown = resident[-1] - resident[len(resident) // 10]
    return [[f'GNSS epoch of the estimator, {len(times)}: median; longest',
             f'{np.median(times):.3g} ms', f'{max(times):.3g} ms', '', '20 ms'],
            [f'largest memory in {EPOCH_SECONDS / 60:g} min; its growth after a tenth of them',
             f'{resident[-1]:.0f} MB', f'{grown:.1f} MB', '', '']]


def start_row() -> list[str]:
    """Compare the start of the command with that of Python."""
    ours, other = medians(_cli('--help'), [sys.executable, '-c', 'pass'])
    return ['ins_align --help; start of Python', f'{ours:.3g} s', f'{other:.3g} s',
            f'{ours / other:.2f}', 'less than 0.5 s longer']
