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
Experiment ``soak``: hours of data through the node as fast as it takes them, with what goes wrong.

``--runs`` is how many minutes of data. Rounds of ten minutes with an outage; before each but the
first either a reset, or the clock is set back and the same stamps come again.
"""

from __future__ import annotations

from pathlib import Path
import re
import signal
import subprocess
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from ins_align.experiments.common import Report
from ins_align.experiments.nodes import script_of, TYPES
from ins_align.simulation.simulate import simulate
import rclpy
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

MINUTES = 120
ROUND = 600.0  # s
OUTAGE = (250.0, 280.0)  # s
PAUSE_NS = 1_000_000_000  # between rounds, shorter than a gap that counts
LEAD = 1500  # IMU messages on the way, of 2000 that the node's queue holds
RATE = 15.0  # times real time: more would fill the queue between two reports of the node
TIMEOUT = 60.0  # s
NODE = [sys.executable, '-m', 'ins_align.ros.main', '--ros-args',
        '-p', 'lever_arm:=[1.0, 1.0, 1.0]',
        # The same delay on the way is longer on the clock of data that is played faster.
        '-p', 'gnss_lateness:=5.0']
RELIABLE = [f'qos_overrides./{topic}.subscription.reliability:=reliable' for topic in TYPES]


def run(out: Path, data_dir: Path | None, runs: int | None, jobs: int | None) -> None:
    """Play all rounds to one node and look at its memory and its counts after each."""
    minutes = runs or MINUTES
    duration = min(ROUND, 20.0 * minutes)
    script = script_of(simulate('car', duration=duration, outages=[OUTAGE]))
    command = NODE + [word for override in RELIABLE for word in ('-p', override)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    rclpy.init()
    try:
        player = _Player(process.pid)
        start = time.monotonic()
        for number in range(max(1, round(60.0 * minutes / duration))):
            player.play_round(script, number)
        took = time.monotonic() - start
        player.close()
    finally:
        rclpy.try_shutdown()
        process.send_signal(signal.SIGINT)
        status = process.wait(20.0)
    report = Report('soak', 'Soak', out, f' --runs {minutes}')
    report.text(f'{minutes} minutes of data, IMU 100 Hz, GNSS 5 Hz, played to the node '
                f'{60.0 * minutes / took:.0f} times faster than real time; exit status {status} '
                f'in the end. Each round has {OUTAGE[1] - OUTAGE[0]:g} s without GNSS.')
    report.table('After each round', list(player.rows[0]),
                 [list(row.values()) for row in player.rows])
    report.table('Sent, asked for or made, and what the node has counted', ['', 'sent', 'counted'],
                 [[name, *pair] for name, pair in player.totals().items()])
    report.write({'rows': player.rows, 'totals': player.totals(), 'exit_status': status,
                  'times_real_time': 60.0 * minutes / took})


class _Player:
    """Plays the drivers and looks at the node."""

    def __init__(self, pid: int) -> None:
        self.rows: list[dict[str, Any]] = []
        self._pid = pid
        self._status: dict[str, str] = {}
        self._sent = dict.fromkeys(TYPES, 0)
        self._resets = self._jumps = 0
        self._shift_ns = 0
        self._node = rclpy.create_node('soak')
        self._publishers = {topic: self._node.create_publisher(kind, topic, QoSProfile(depth=4000))
                            for topic, kind in TYPES.items()}
        self._node.create_subscription(DiagnosticArray, '/ins_align/status', self._on_status, 10)
        self._reset = self._node.create_client(Trigger, '/ins_align/reset')
        self._wait(lambda: all(publisher.get_subscription_count()
                               for publisher in self._publishers.values()) and self._status)
        time.sleep(2.0)  # the other side has to find us too

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()

    def play_round(self, script: list[tuple[int, str, bytes]], number: int) -> None:
        """Play a script once, after a reset or a jump of the clock, and add a row."""
        event = ''
        if number % 2 == 1:
            event, self._resets = 'reset', self._resets + 1
            future = self._reset.call_async(Trigger.Request())
            self._wait(future.done)
        elif number:
            event, self._jumps = 'clock set back', self._jumps + 1
        if event != 'clock set back' and number:
            self._shift_ns += script[-1][0] - script[0][0] + PAUSE_NS
        start, first = time.monotonic(), script[0][0]
        for time_ns, topic, message in script:
            wait = start + (time_ns - first) * 1e-9 / RATE - time.monotonic()
            if wait > 0.0:
                time.sleep(wait)
            else:
                start -= wait  # no burst to catch up
            if topic == 'imu/data_raw' and self._sent[topic] >= self._imu_counted() + LEAD:
                self._wait(lambda: self._sent['imu/data_raw'] < self._imu_counted() + LEAD)
            self._publishers[topic].publish(_shifted(message, self._shift_ns))
            self._sent[topic] += 1
        self._wait(lambda: self._counted('velocity') >= self._sent['fix_velocity']
                   and self._imu_counted() >= self._sent['imu/data_raw'])
        seen = self._status
        self._wait(lambda: self._status is not seen)
        self.rows.append({
            'round': number + 1, 'began with': event or '-', 'state': self._status['state'],
            'time to align, s': self._status['time_to_align_s'] or '-',
            'resident, MB': f'{_resident_mb(self._pid):.1f}',
            'epochs used': self._counted('epochs_used')})

    def totals(self) -> dict[str, tuple[int, int]]:
        """Return what was sent and what was counted by name."""
        names = {'imu': 'imu/data_raw', 'fix': 'fix', 'velocity': 'fix_velocity'}
        pairs = {name: (self._sent[topic], self._counted(name)) for name, topic in names.items()}
        pairs['imu'] = self._sent['imu/data_raw'], self._imu_counted()
        pairs['resets'] = self._resets, self._counted('resets')
        pairs['clock_jumps'] = self._jumps, self._counted('clock_jumps')
        pairs['lost on the way'] = 0, sum(
            self._counted(name) for name in ('fix_late', 'velocity_late', 'gnss_overflow'))
        return pairs

    def _counted(self, name: str) -> int:
        return int(self._status.get(name, 0))

    def _imu_counted(self) -> int:
        # The first sample after a jump of the clock is taken for one that is late.
        return sum(map(self._counted, ('imu', 'imu_late', 'imu_ahead')))

    def _on_status(self, msg: DiagnosticArray) -> None:
        self._status = {value.key: value.value for value in msg.status[0].values}

    def _wait(self, condition: Any) -> None:
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            rclpy.spin_once(self._node, timeout_sec=0.2)
            if time.monotonic() > deadline:
                raise RuntimeError(f'the node does not answer: {self._status}')


def _shifted(message: bytes, shift_ns: int) -> bytes:
    """Move the stamp of a serialised message: two 32 bit words behind four bytes."""
    stamp = (int.from_bytes(message[4:8], 'little') * 1_000_000_000
             + int.from_bytes(message[8:12], 'little') + shift_ns)
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return (message[:4] + seconds.to_bytes(4, 'little') + nanoseconds.to_bytes(4, 'little')
            + message[12:])


def _resident_mb(pid: int) -> float:
    """Resident memory of a process."""
    found = re.search(r'VmRSS:\s+(\d+)', Path(f'/proc/{pid}/status').read_text('ascii'))
    return float(found[1]) / 1024 if found else float('nan')
