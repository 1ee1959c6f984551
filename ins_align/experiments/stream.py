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
"""Messages of a simulated vehicle as its drivers send them: arrays that can be spoilt."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from ins_align.config import Config
from ins_align.geometry.rotation import Array
from ins_align.gnss.messages import ENU_FROM_NED, fixes, velocities
from ins_align.simulation.simulate import Simulation
from ins_align.simulation.trajectory import displaced
import numpy as np

Random = np.random.Generator
Window = tuple[int, int]        # ns

SECOND = 1_000_000_000
GNSS = 'fix', 'velocity'
_IMU = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('gyro', 'f8', 3), ('accel', 'f8', 3)])
_FIX = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('lla', 'f8', 3),
                 ('covariance', 'f8', (3, 3)), ('covariance_type', 'i4'), ('status', 'i4')])
_VELOCITY = np.dtype([('arrival', 'i8'), ('stamp', 'i8'), ('velocity', 'f8', 3),
                      ('covariance', 'f8', (3, 3)), ('frame_id', 'U16')])


@dataclass
class Stream:
    """
    What the drivers send: a row a message, with ``arrival`` and ``stamp`` in ns.

    Everything else is as in the ROS messages, in the frame that the configuration names.
    """

    imu: np.ndarray
    fix: np.ndarray
    velocity: np.ndarray
    first: int              # stamps between which the vehicle is simulated
    last: int
    config: dict[str, Any] = field(default_factory=dict)        # what else the aligner is told
    resets: list[int] = field(default_factory=list)     # when somebody asks for a new start
    update_every: float = 0.0       # s, in the mean; 0: regularly, once a second
    expected: dict[str, int] = field(default_factory=dict)      # counters known beforehand
    # Stamps from the first on and before the second are off by the third.
    shift: tuple[int, int, int] = 0, 0, 0

    def true_stamps(self, stamps: Any) -> Any:
        """When what bears these stamps has been, by the simulation's clock."""
        start, end, shift = self.shift
        stamps = np.asarray(stamps)
        moved = np.where((stamps >= start) & (stamps < end), stamps - shift, stamps)
        return np.clip(moved, self.first, self.last)

    def moment(self, random: Random, low: float = 0.1, high: float = 0.9) -> int:
        """Draw an instant from a part of the recording."""
        return self.first + int(random.uniform(low, high) * (self.last - self.first))

    def windows(self, random: Random, number: int, shortest: float,
                longest: float) -> list[Window]:
        """Draw windows with a length within limits, in seconds."""
        starts = [self.moment(random) for _ in range(number)]
        return [(start, start + int(random.uniform(shortest, longest) * SECOND))
                for start in starts]

    def seconds(self, name: str) -> Array:
        """Return when messages were sent or samples taken, s since the start."""
        return np.asarray((getattr(self, name)['arrival'] - self.first) / SECOND)

    def keep(self, name: str, chosen: np.ndarray) -> None:
        """Lose all but the chosen messages."""
        setattr(self, name, getattr(self, name)[chosen])

    def lose(self, names: Iterable[str], windows: Iterable[Window]) -> None:
        """Lose the messages with stamps within windows."""
        for window in windows:
            for name in names:
                self.keep(name, ~between(getattr(self, name), window))

    def displace(self, chosen: np.ndarray, away: Array) -> None:
        """Move positions by ENU offsets in metres, or by one for all."""
        here = self.fix['lla'][chosen]
        self.fix['lla'][chosen] = displaced(here, np.broadcast_to(away, here.shape))

    def sent(self, update: Any = ()) -> Iterator[tuple[str, np.ndarray]]:
        """
        Yield what comes in the order of arrival: its kind, and as many rows of it as there are.

        Kinds are the names of the arrays, 'update' at the times given, and 'reset'.
        """
        kinds = 'imu', *GNSS, 'update', 'reset'
        arrivals = [*(getattr(self, name)['arrival'] for name in kinds[:3]),
                    np.asarray(update, np.int64), np.array(self.resets, np.int64)]
        lengths = [len(times) for times in arrivals]
        order = np.argsort(np.concatenate(arrivals), kind='stable')
        kind = np.repeat(range(len(kinds)), lengths)[order]
        places = order - (np.cumsum(lengths) - lengths)[kind]
        for block in np.split(np.arange(len(order)), np.flatnonzero(np.diff(kind)) + 1):
            if len(block):
                name = kinds[kind[block[0]]]
                yield name, (getattr(self, name)[places[block]] if name in kinds[:3]
                             else arrivals[kind[block[0]]][places[block]])


def payloads(config: Config, kind: str, rows: np.ndarray) -> list[Any]:
    """Return what `give` takes, made as the node does; MessageError: unusable velocities."""
    if kind == 'imu':
        return [(rows['stamp'], rows['gyro'], rows['accel'])]
    if kind == 'fix':
        return fixes(rows['stamp'], rows['lla'], rows['covariance'], rows['covariance_type'],
                     rows['status'])
    stated = None if config.velocity_type == 'TwistStamped' else rows['covariance']
    return velocities(rows['stamp'], str(rows['frame_id'][0]), rows['velocity'], stated, config)


def stream_of(simulation: Simulation, frame: str = 'enu') -> Stream:
    """Return the messages of a simulation, velocities in ENU or NED."""
    turn = ENU_FROM_NED if frame == 'ned' else np.eye(3)
    imu = np.zeros(len(simulation.imu_stamps_ns), _IMU)
    imu['arrival'] = imu['stamp'] = simulation.imu_stamps_ns
    imu['gyro'], imu['accel'] = simulation.gyro, simulation.accel
    fix = np.zeros(len(simulation.gnss_stamps_ns), _FIX)
    velocity = np.zeros(len(fix), _VELOCITY)
    for rows in fix, velocity:
        rows['arrival'], rows['stamp'] = simulation.gnss_arrival_ns, simulation.gnss_stamps_ns
    fix['lla'], fix['covariance'] = simulation.lla_deg, simulation.position_covariance
    fix['covariance_type'] = 3
    velocity['velocity'] = simulation.velocity @ turn
    velocity['covariance'] = turn @ simulation.velocity_covariance @ turn
    return Stream(imu, fix, velocity, int(simulation.imu_stamps_ns[0]),
                  int(simulation.imu_stamps_ns[-1]), {'velocity_frame': frame})


def between(rows: np.ndarray, window: Window) -> np.ndarray:
    """Whether messages have stamps within a window."""
    return (rows['stamp'] >= window[0]) & (rows['stamp'] < window[1])


def some(random: Random, rows: np.ndarray, least: float, most: float) -> Array:
    """Choose a part of the rows, one at least."""
    number = max(1, round(random.uniform(least, most) * len(rows)))
    return np.sort(random.choice(len(rows), number, replace=False))


def directions(random: Random, number: int) -> Array:
    """Draw unit vectors, shape (number, 3)."""
    vectors = random.standard_normal((number, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1)[:, None])
