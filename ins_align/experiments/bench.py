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
Experiment ``bench``: speed, each figure relative to another one measured in the same run.

``--runs`` is the number of minutes of data that are replayed. ``python -m
ins_align.experiments.bench`` starts one of the processes that run beside the node: ``bare`` has
the subscriptions of the node and does nothing, ``republish`` publishes each IMU message unchanged,
``listen`` subscribes to what is published, and ``play BAG`` publishes a recording in real time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, ExitStack, suppress
import os
from pathlib import Path
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from ins_align.aligner import Aligner
from ins_align.experiments.common import config_for, JsonDict, Report
from ins_align.simulation.simulate import give, simulate

REPEATS = 3
CPU_SECONDS = 20.0
EPOCH_SECONDS = 600.0
# Largest ratio of the times of a replay and of a bare pass over the messages, by storage.
TARGETS = {'mcap': '2.0', 'sqlite3': '3.0'}
COUNT = """
from pathlib import Path
import sys
from rosbags.highlevel import AnyReader
with AnyReader([Path(sys.argv[1])]) as reader:
    print(sum(1 for _ in reader.messages()))
"""
CLI = '-m', 'ins_align.cli'
BESIDE = '-m', 'ins_align.experiments.bench'
NODE = '-m', 'ins_align.ros.main', '--ros-args', '-p', 'lever_arm:=[1.0, 1.0, 1.0]'


def run(report: Report, runs: int, jobs: int | None, data: Path | None) -> Any:
    """Run ``bench``: all measurements, one after the other."""
    report.text('Ratios against something measured in the same run on the same machine; for '
                'replay and start the median of three goes, for the node processor time of the '
                'whole process while both run beside each other on the same messages.')
    with tempfile.TemporaryDirectory() as folder:
        rows = [*(replay_against_bare_pass(Path(folder), storage, runs) for storage in TARGETS),
                *node_rows(Path(folder)), *epoch_rows(), row(
                    'ins_align --help; start of Python',
                    *medians([*CLI, '--help'], ['-c', 'pass']), 's', 'less than 0.5 s longer')]
    report.table('Ours, what it is measured against, their ratio and what it should be at most',
                 rows)
    return rows


def row(name: str, ours: float, other: float, unit: str, target: str = '') -> JsonDict:
    """Make a row of two measurements and their ratio."""
    return {'name': name, 'ours': f'{ours:.3g} {unit}', 'other': f'{other:.3g} {unit}',
            'ratio': f'{ours / other:.2f}' if other else '', 'target': target}


def elapsed(arguments: Sequence[str]) -> float:
    """Run a Python process and return how long it took, s."""
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL,
                          stderr=subprocess.PIPE, text=True)
    # 1: a replay that has not aligned, unless Python ended so.
    if done.returncode not in (0, 1) or 'Traceback' in done.stderr:
        raise RuntimeError(done.stderr)
    return time.perf_counter() - start


def medians(*processes: Sequence[str]) -> list[float]:
    """Run Python processes in turn, several times, and return the median time of each, s."""
    times = [[elapsed(arguments) for arguments in processes] for _ in range(REPEATS)]
    return [statistics.median(column) for column in zip(*times)]


def recorded(folder: Path, *options: str) -> str:
    """Simulate a recording, named like the last option, and return its path."""
    bag = str(folder / options[-1])
    elapsed([*CLI, 'simulate', bag, '--scenario', 'car', '--imu-rate', '200', *options])
    return bag


def replay_against_bare_pass(folder: Path, storage: str, minutes: int) -> JsonDict:
    """Compare the time of a replay with that of counting the messages of the recording."""
    bag = recorded(folder, '--duration', f'{60 * minutes}', '--storage', storage)
    return row(f'replay of {minutes} min, {storage}; bare pass', *medians(
        [*CLI, 'replay', bag, '--params', f'{bag}/ins_align.yaml'], ['-c', COUNT, bag]), 's',
        TARGETS[storage])


def node_rows(folder: Path) -> list[JsonDict]:
    """Compare the processor time of the node with that of simpler nodes on the same messages."""
    bag = recorded(folder, '--gnss-rate', '10', '--duration', f'{CPU_SECONDS + 15.0}')
    rows = []
    for title, *beside in (('node, nobody listens; node that does nothing', 'bare'),
                           ('node, ~/imu listened to; node that republishes', 'republish',
                            'listen')):
        with ExitStack() as stack:
            nodes = [stack.enter_context(_process(*each))
                     for each in (NODE, *((*BESIDE, name) for name in beside))]
            time.sleep(3.0)
            stack.enter_context(_process(*BESIDE, 'play', bag))
            time.sleep(8.0)
            before = [_cpu_seconds(pid) for pid in nodes[:2]]
            time.sleep(CPU_SECONDS)
            spent = [100.0 * (_cpu_seconds(pid) - start) / CPU_SECONDS
                     for pid, start in zip(nodes, before)]
        rows.append(row(title, *spent, '% CPU', '1.15'))
    return rows


@contextmanager
def _process(*arguments: str) -> Iterator[int]:
    """Run a Python process, yield its process id, and interrupt it at the end."""
    process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL)
    try:
        yield process.pid
    finally:
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(20.0)
        process.kill()
        process.wait()


def _cpu_seconds(pid: int) -> float:
    """Return the processor time of a process, user and system, s."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def epoch_rows() -> list[JsonDict]:
    """Measure the processor time of each GNSS epoch with its IMU samples, and the memory."""
    data = simulate('car', duration=EPOCH_SECONDS)
    aligner = Aligner(config_for(data))
    times, resident = [], []
    start = time.process_time()
    for kind, payload in data.messages():
        give(aligner, kind, payload)
        if kind == 'velocity':
            aligner.update()
            times.append(1e3 * (time.process_time() - start))
            pages = int(Path('/proc/self/statm').read_text().split()[1])
            resident.append(pages * resource.getpagesize() / 2 ** 20)
            start = time.process_time()
    return [row(f'epoch with velocity at 5 Hz, {len(times)}: longest; median', max(times),
                statistics.median(times), 'ms', 'longest 20 ms'),
            row(f'memory after {EPOCH_SECONDS / 60:g} min; after a tenth of them',
                resident[-1], resident[len(resident) // 10], 'MB')]


# The processes beside the node

def _spin(name: str, node: Any, types: dict[str, Any]) -> None:
    """Run the node ``bare``, ``republish`` or ``listen``."""
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    def nothing(msg: Any) -> None:
        pass

    imu_type = types['/imu/data_raw']
    if name == 'listen':
        for topic in '/republish/imu', '/ins_align/imu':
            node.create_subscription(imu_type, topic, nothing, 100, raw=True)
        types = {}
    for topic, kind in types.items():
        take = nothing
        if name == 'republish' and kind is imu_type:
            take = node.create_publisher(imu_type, '~/imu', 100).publish
        node.create_subscription(kind, topic, take, QoSProfile(
            depth=2000 if kind is imu_type else 200, reliability=ReliabilityPolicy.BEST_EFFORT))
    # The timer wakes the executor, which would miss a signal that comes between two waits.
    node.create_timer(1.0, lambda: None)
    rclpy.spin(node)


def _play(bag: str, node: Any, types: dict[str, Any]) -> None:
    """Publish the messages of a recording at the times at which they were recorded."""
    from rosbags.highlevel import AnyReader

    with AnyReader([Path(bag)]) as reader:
        script = [(connection.topic, time_ns, data) for connection, time_ns, data
                  in reader.messages() if connection.topic in types]
    publish = {topic: node.create_publisher(kind, topic, 1000).publish
               for topic, kind in types.items()}
    time.sleep(2.0)     # for publishers and subscribers to discover each other
    start = time.monotonic() - script[0][1] * 1e-9
    for topic, time_ns, data in script:
        time.sleep(max(0.0, start + time_ns * 1e-9 - time.monotonic()))
        publish[topic](bytes(data))


def main(name: str, *arguments: str) -> int:
    """Run one of the processes beside the node until it is interrupted."""
    from geometry_msgs.msg import TwistWithCovarianceStamped
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import Imu, NavSatFix

    rclpy.init()
    node = rclpy.create_node(name)
    # The topics to which the node subscribes.
    types = {'/imu/data_raw': Imu, '/fix': NavSatFix, '/fix_velocity': TwistWithCovarianceStamped}
    with suppress(ExternalShutdownException):
        if name == 'play':
            _play(*arguments, node, types)
        else:
            _spin(name, node, types)
    return 0


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
