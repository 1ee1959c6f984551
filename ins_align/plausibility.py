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
"""Checks that need no alignment: samples and units of the IMU, velocity against position."""

from collections import deque
import math

from ins_align.earth import Place, way
from ins_align.rotation import Array, Index
import numpy as np

# The specific force averages gravity unless the vehicle falls or its units are wrong (m/s^2).
FORCE_RANGE = 4.0, 30.0
FORCE_SAMPLES = 500
# Distance over which velocity and position are compared: at least this, and so many sigmas.
MIN_DISTANCE = 10.0
DISTANCE_SIGMAS = 8.0
# Mismatch, as a share of the distance, that no noise explains, and how many in a row convict.
MAX_MISMATCH = 0.5
CONVICTING = 4
# So many fixes in a row have to agree, to within the same share of the distance, at its end.
AGREEING = 3
# A spike leaves the mean of its neighbours by at least this (rad/s, m/s^2), by this many times as
# much as the neighbours differ, and as other samples do: of so many before it, this one in the
# order of size, so that one more spike among them does no harm.
SPIKE_RATE, SPIKE_FORCE = 0.5, 5.0
SPIKE_RATIO = 12.0
SPIKE_BEFORE, SPIKE_RANK = 12, 7
# An IMU that has sent the same six values this often and for this long (ns) measures nothing.
STUCK_SAMPLES, STUCK_NS = 8, 250_000_000
# Samples that both checks want to see before those that they judge.
IMU_BEFORE = SPIKE_BEFORE + 2


def without_spikes(stamps: Index, samples: Array) -> tuple[Array, np.ndarray]:
    """
    Replace single samples that the motion cannot have made by what lies between their neighbours.

    The gyros and the accelerometers are judged each on their own. A shock is no spike: what was
    hit rings.

    Parameters
    ----------
    stamps : ndarray of int, shape (N,)
        Increasing.
    samples : ndarray, shape (N, 6)
        Angular rate, rad/s, and specific force, m/s^2. The first `SPIKE_BEFORE` + 1 and the last
        one cannot be judged.

    Returns
    -------
    samples : ndarray, shape (N, 6)
        The same array where nothing was found.
    spikes : ndarray of bool, shape (N,)
        Which ones were replaced.

    """
    spikes = np.zeros((stamps.size, 2), bool)
    if stamps.size < IMU_BEFORE + 1:
        return samples, spikes[:, 0]
    x = samples.reshape(-1, 2, 3)
    away = np.linalg.norm(x[1:-1] - 0.5 * (x[:-2] + x[2:]), axis=2)
    k, sensor = np.nonzero(away[SPIKE_BEFORE:] > [SPIKE_RATE, SPIKE_FORCE])
    if not k.size:
        return samples, spikes[:, 0]
    k += SPIKE_BEFORE
    # The one just before has the spike for a neighbour.
    before = away[k[:, None] - np.arange(2, SPIKE_BEFORE + 1), sensor[:, None]]
    usual = np.sort(before, axis=1)[:, SPIKE_RANK]
    between = np.linalg.norm(x[k + 2, sensor] - x[k, sensor], axis=1)
    spikes[k + 1, sensor] = away[k, sensor] > SPIKE_RATIO * np.maximum(usual, between)
    if not spikes.any():
        return samples, spikes[:, 0]
    k, sensor = np.nonzero(spikes)
    share = (stamps[k] - stamps[k - 1]) / (stamps[k + 1] - stamps[k - 1])
    cleaned = x.copy()
    cleaned[k, sensor] = x[k - 1, sensor] + share[:, None] * (x[k + 1, sensor] - x[k - 1, sensor])
    return cleaned.reshape(-1, 6), spikes[:, 0] | spikes[:, 1]


def stuck(stamps: Index, samples: Array) -> list[tuple[int, int, int]]:
    """
    Find where an IMU sends the same values again and again.

    Parameters
    ----------
    stamps : ndarray of int, shape (N,)
        Increasing, ns.
    samples : ndarray, shape (N, 6)
        Angular rate and specific force.

    Returns
    -------
    list of (int, int, int)
        First and last stamp with the same values, and the one from which on it is no chance.

    """
    new = np.flatnonzero(np.any(samples[1:] != samples[:-1], axis=1)) + 1
    first = np.concatenate([[0], new])
    last = np.concatenate([new, [stamps.size]]) - 1
    long = (last - first >= STUCK_SAMPLES) & (stamps[last] - stamps[first] >= STUCK_NS)
    return [(start, int(stamps[j]), max(start + STUCK_NS, int(stamps[i + STUCK_SAMPLES])))
            for i, j in zip(first[long], last[long]) for start in [int(stamps[i])]]


class ForceCheck:
    """Whether the magnitude of the specific force can be one in m/s^2."""

    def __init__(self) -> None:
        """Start with no samples."""
        self._sum = 0.0
        self._count = 0
        self.fault = ''

    def add(self, total: float, count: int) -> None:
        """Take the sum of so many magnitudes."""
        self._sum += total
        self._count += count
        if self._count < FORCE_SAMPLES:
            return
        mean = self._sum / self._count
        self._sum, self._count = 0.0, 0
        self.fault = '' if FORCE_RANGE[0] < mean < FORCE_RANGE[1] else (
            f'the specific force averages {mean:.3g} m/s^2, gravity is 9.8: check the unit (g?) '
            'and that gravity is not taken out')


class VelocityCheck:
    """Whether the receiver's velocity is the derivative of its position: frame and axes."""

    def __init__(self) -> None:
        """Start with nothing compared."""
        self._origin: Place | None = None
        self._path = 0.0, 0.0
        # East and north of the fix, and of what the velocity makes of the way, since the origin.
        self._recent: deque[tuple[float, ...]] = deque(maxlen=AGREEING)
        self._anchor: tuple[float, ...] | None = None
        self._last: tuple[float, float, float] | None = None
        self.bad_in_a_row = 0
        self._as_ned_in_a_row = 0

    def add(self, time: float, place: Place, v_n: Array, position_std: float) -> None:
        """Take an epoch that has both; seconds, radians, metres, ENU."""
        east, north, _ = v_n.tolist()
        if self._last is not None and 0 < time - self._last[0] < 2.5:
            half = (time - self._last[0]) / 2
            self._path = (self._path[0] + half * (self._last[1] + east),
                          self._path[1] + half * (self._last[2] + north))
        else:
            self._origin = None
        self._last = time, east, north
        if self._origin is None:
            self._origin, self._path, self._anchor = place, (0.0, 0.0), None
            self._recent.clear()
        self._recent.append((*way(self._origin, place)[:2], *self._path))
        if len(self._recent) < AGREEING:
            return
        here = self._recent[AGREEING // 2]
        if self._anchor is None:
            self._anchor = here
            return
        moved_e, moved_n, went_e, went_n = (now - then for now, then in zip(here, self._anchor))
        distance = max(math.hypot(moved_e, moved_n), math.hypot(went_e, went_n))
        tolerance = MAX_MISMATCH * distance
        # A wild fix is no journey, and one after the other they do not agree.
        if (distance < max(MIN_DISTANCE, DISTANCE_SIGMAS * position_std)
                or any(math.dist(other[:2], here[:2]) > tolerance for other in self._recent)):
            return
        bad = math.hypot(moved_e - went_e, moved_n - went_n) > tolerance
        as_ned = math.hypot(moved_e - went_n, moved_n - went_e) < tolerance
        self.bad_in_a_row = self.bad_in_a_row + 1 if bad else 0
        self._as_ned_in_a_row = self._as_ned_in_a_row + 1 if bad and as_ned else 0
        self._origin = None                   # the next journey begins here

    @property
    def fault(self) -> str:
        """Fault in words; empty when nothing is known to be wrong."""
        if self.bad_in_a_row < CONVICTING:
            return ''
        if self._as_ned_in_a_row >= CONVICTING:
            return ('the GNSS velocity contradicts the change of position, and would fit it with '
                    'north and east exchanged: set velocity_frame to the other one (enu, ned)')
        return ('the GNSS velocity contradicts the change of position: check that it is given in '
                'a world frame (velocity_frame) and in m/s')
