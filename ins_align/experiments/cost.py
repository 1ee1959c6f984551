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
"""Experiment ``cost``: time per GNSS epoch and memory over minutes of data, an hour by default."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import time
from typing import Any

from ins_align.aligner import Aligner
from ins_align.config import Config
from ins_align.experiments.common import config_for, exact_config_for, parallel, Report
from ins_align.report import new_figure
from ins_align.simulation.simulate import give, simulate
import numpy as np

MINUTES = 60
TABLE_MINUTES = (1, 2, 5, 10, 20, 40, 60)
CASES: dict[str, tuple[str, Callable[..., Config], dict[str, Any]]] = {
    'car, defaults': ('car', config_for, {}),
    'car, lever arm, delay, scale factors known': ('car', exact_config_for, {}),
    'car, velocity and position': ('car', config_for, {'use_position': True}),
    'static, defaults': ('static', config_for, {}),
}


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Run every case alone, over so many minutes as `runs` says; `jobs` does not matter."""
    minutes = runs or MINUTES
    report = Report('cost', 'Cost over time', out, f' --runs {minutes}')
    report.text(f'{minutes} minutes of MEMS data, IMU 100 Hz, GNSS 5 Hz: processor time of one '
                'thread per GNSS epoch, IMU samples included, and resident memory at the end of '
                'the minute.')
    results = parallel(run_case, [(name, 60.0 * minutes) for name in CASES], 1, 'cases',
                       apart=True)
    rows = []
    shown = [minute for minute in TABLE_MINUTES if minute <= minutes]
    for name, result in zip(CASES, results):
        us, mb = np.array(result['us_per_epoch']), np.array(result['resident_mb'])
        rows.append([name, *(f'{us[minute - 1]:.0f}' for minute in shown),
                     f'{us[-1] / us[0]:.2f}', f'{mb[0]:.0f}', f'{mb[-1] - mb[0]:+.1f}',
                     f"{result['largest_ms']:.0f}", result['rebases']])
    report.table('Microseconds per GNSS epoch', [
        'case', *(f'minute {minute}' for minute in shown), 'last/first', 'MB, minute 1',
        'growth, MB', 'longest epoch, ms', 't0 moved'], rows)
    report.figure(figure(results), '', 'Processor time per GNSS epoch and growth of resident '
                                       'memory')
    report.write(dict(zip(CASES, results)))


def run_case(task: tuple[str, float]) -> dict[str, Any]:
    """Feed one recording of so many seconds and look at clock and memory every minute."""
    name, duration = task
    scenario, configure, changes = CASES[name]
    simulation = simulate(scenario, imu_grade='mems', duration=duration)
    aligner = Aligner(configure(simulation, **changes))
    us_per_epoch, resident = [], []
    epochs, spent, largest = 0, 0.0, 0.0
    end_ns = simulation.imu_stamps_ns[0] + 60_000_000_000
    for kind, payload in simulation.messages():
        start = time.process_time()
        give(aligner, kind, payload)
        if kind == 'imu':
            epochs += len(aligner.update())
        used = time.process_time() - start
        spent += used
        largest = max(largest, used)
        if kind == 'imu' and payload[0][-1] >= end_ns - 1:
            us_per_epoch.append(1e6 * spent / max(epochs, 1))
            resident.append(resident_mb())
            epochs, spent = 0, 0.0
            end_ns += 60_000_000_000
    return {'us_per_epoch': us_per_epoch, 'resident_mb': resident, 'largest_ms': 1e3 * largest,
            'rebases': aligner.status().counts.get('rebases', 0)}


def resident_mb() -> float:
    """Resident memory of this process; nan where the system does not tell."""
    try:
        for line in Path('/proc/self/status').read_text('ascii').splitlines():
            if line.startswith('VmRSS:'):
                return float(line.split()[1]) / 1024
    except OSError:
        pass
    return float('nan')


def figure(results: list[dict[str, Any]]) -> Any:
    """Draw time and memory over the minutes."""
    picture = new_figure(10.0, 4.0)
    left, right = picture.subplots(1, 2)
    for name, result in zip(CASES, results):
        minutes = np.arange(1, len(result['us_per_epoch']) + 1)
        left.plot(minutes, result['us_per_epoch'], label=name)
        right.plot(minutes, np.array(result['resident_mb']) - result['resident_mb'][0],
                   label=name)
    left.set_ylabel('processor time per GNSS epoch (us)')
    left.set_ylim(bottom=0.0)
    right.set_ylabel('resident memory since minute 1 (MB)')
    for ax in (left, right):
        ax.set_xlabel('minute of data')
        ax.grid(alpha=0.3)
    left.legend(fontsize=8)
    return picture
