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
What makes IMU samples miss the motion, and how much noise that is.

Spikes, samples that repeat, the end of the sensors' range, lost samples, stamps that jitter,
white noise as it is measured, and units that cannot be right.
"""

import math

from ins_align.geometry.rotation import Array, Index
import numpy as np

# The specific force averages gravity, over this time (s), unless the vehicle falls, flies loops
# (up to 6 g) or its units are wrong (m/s^2).
FORCE_RANGE = 4.0, 60.0
FORCE_TIME = 5.0
# A spike leaves the mean of its neighbours by at least this (rad/s, m/s^2), by this many times as
# much as the neighbours differ, and as other samples do: of so many before it, this one in the
# order of size, so that one more spike among them does no harm.
SPIKE_RATE, SPIKE_FORCE = 0.5, 5.0
SPIKE_RATIO = 12.0
SPIKE_BEFORE, SPIKE_RANK = 12, 7
# An IMU that has sent the same six values this often and for this long (ns) measures nothing.
STUCK_SAMPLES, STUCK_NS = 8, 250_000_000
# A value that is the largest of its axis, and not of an IMU at rest (rad/s, m/s^2), is
# the end of the range once it has come so often while so many other values change, and this many
# times as often as the next smaller value: coarse values repeat without an end. The motion may go
# beyond it by this share.
END_RATE, END_FORCE = 0.5, 15.0
END_TIMES, END_CHANGING, PILED_UP = 5, 3, 4
BEYOND_END = 0.5
# An attitude is lost when the gyros may have missed this angle (rad).
BLIND_ANGLE = 0.35
# Samples that both checks want to see before those that they judge.
IMU_BEFORE = SPIKE_BEFORE + 2
# A step this many times the usual one holds lost samples; what the motion can do meanwhile
# (angular acceleration, rad/s^2, and jerk, m/s^3) is added to its noise.
GAP_STEPS = 2.5
GAP_ANGULAR_ACCELERATION, GAP_JERK = 2.0, 20.0
# Samples come in bunches, stamped on arrival, where the usual step is so much shorter than the
# longest but for one in twenty: then those are the usual pauses.
BUNCHED, PAUSES = 0.2, 0.95
# Standard deviation of stamps over the median of what the steps between them deviate.
JITTER_OF_MEDIAN = 1.4826 / math.sqrt(2)


def without_spikes(stamps: Index, samples: Array) -> tuple[Array, np.ndarray]:
    """
    Replace single samples that the motion cannot have made by what lies between their neighbours.

    The gyros and the accelerometers are judged each on their own. A shock is no spike: what was
    hit rings. Of samples, (N, 6), rad/s and m/s^2, the first `SPIKE_BEFORE` + 1 and the last one
    cannot be judged. Returns them, the same array where nothing was found, and which ones were
    replaced, (N,).
    """
    spikes = np.zeros((stamps.size, 2), bool)
    if stamps.size < IMU_BEFORE + 1:
        return samples, spikes[:, 0]
    x = samples.reshape(-1, 2, 3)
    away = np.sqrt(np.sum(np.square(x[1:-1] - 0.5 * (x[:-2] + x[2:])), axis=2))
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
    cleaned = x.copy(order='K')
    cleaned[k, sensor] = x[k - 1, sensor] + share[:, None] * (x[k + 1, sensor] - x[k - 1, sensor])
    return cleaned.reshape(-1, 6), spikes[:, 0] | spikes[:, 1]


def stuck(stamps: Index, samples: Array) -> list[tuple[int, int, int]]:
    """
    Find where an IMU sends the same values again and again, stamps (N,), ns, samples (N, 6).

    Returns the first and the last stamp of each, and the one from which on it is no chance.
    """
    new = np.flatnonzero(np.any(samples[1:] != samples[:-1], axis=1)) + 1
    first = np.concatenate([[0], new])
    last = np.concatenate([new, [stamps.size]]) - 1
    long = (last - first >= STUCK_SAMPLES) & (stamps[last] - stamps[first] >= STUCK_NS)
    return [(start, int(stamps[j]), max(start + STUCK_NS, int(stamps[i + STUCK_SAMPLES])))
            for i, j in zip(first[long], last[long]) for start in [int(stamps[i])]]


class RangeCheck:
    """Notices that an IMU is at the end of its range: an extreme comes again and again."""

    def __init__(self) -> None:
        """Start with no samples."""
        # Of each value and its negative the two largest that came, and how often they did.
        self._times = [{end: 0} for end in 2 * (3 * [END_RATE] + 3 * [END_FORCE])]
        self._last = np.zeros(6)
        # The last sample within the range, of gyros and accelerometers, ns.
        self._within_ns = np.zeros(2, np.int64)
        self._angles = 0.0                  # so many times the blind angle
        # Of M samples at the end of the range, ns, and what the motion may have been beyond it
        # from each to the next, (M, 2), as noise of gyros and accelerometers, rad/sqrt(s) and
        # m/s/sqrt(s).
        self.stamps, self.densities = np.zeros(0, np.int64), np.zeros((0, 2))
        # Where the gyros may have missed another `BLIND_ANGLE` since they were within it, ns.
        self.blind: list[int] = []

    def add(self, stamps: Index, samples: Array) -> None:
        """Take samples, stamps in ns, shape (N,), and values, (N, 6), that follow the last."""
        if not stamps.size:
            return
        at_end = self._at_end(samples).reshape(-1, 2, 3)
        self._last = samples[-1]
        if not at_end.any():
            self._within_ns[:] = stamps[-1]
            return
        beyond = np.any(at_end, axis=2)
        within = np.maximum.accumulate(np.where(beyond, self._within_ns, stamps[:, None]))
        self._within_ns = within[-1]
        k = np.flatnonzero(np.any(beyond, axis=1))
        missed = BEYOND_END * np.max(np.abs(samples[k].reshape(-1, 2, 3)) * at_end[k], axis=2)
        seconds = (stamps[k, None] - within[k]) * 1e-9
        self.stamps = np.concatenate([self.stamps, stamps[k]])
        # The error lasts: the angle or velocity grows with the time, not with its root.
        self.densities = np.concatenate([self.densities, missed * np.sqrt(2 * seconds)])
        angles = np.concatenate([[self._angles], missed[:, 0] * seconds[:, 0] // BLIND_ANGLE])
        self.blind += stamps[k[angles[1:] > angles[:-1]]].tolist()
        self._angles = angles[-1]

    def beyond(self, stamps: Index, ends_ns: Index, dt: Array) -> Array:
        """Return densities, shape (2, K, n), of the steps `dt` between ends, of samples so far."""
        beyond = np.zeros((2,) + dt.shape)
        inside = slice(*np.searchsorted(self.stamps, ends_ns[[0, -1]]))
        saturated = self.stamps[inside]
        if saturated.size:
            interval = np.searchsorted(ends_ns, saturated, side='right') - 1
            # An interval's first step begins at its start, at a sample or between two.
            first = np.searchsorted(stamps, ends_ns[:-1], side='right') - 1
            step = np.searchsorted(stamps, saturated) - first[interval]
            beyond[:, interval, step] = self.densities[inside].T
        return beyond

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what was found before a stamp."""
        if self.stamps.size:
            kept = self.stamps >= stamp_ns
            self.stamps, self.densities = self.stamps[kept], self.densities[kept]
            self.blind = [blind_ns for blind_ns in self.blind if blind_ns >= stamp_ns]

    def _at_end(self, samples: Array) -> np.ndarray:
        """Which values are at the end of the range, shape (N, 6)."""
        at_end = np.zeros(samples.shape, bool)
        signed = np.hstack([samples, -samples])
        reached = np.flatnonzero(signed.max(axis=0) >= list(map(min, self._times)))
        if reached.size:
            changed = np.diff(np.vstack([self._last, samples]), axis=0) != 0.0
            changing = np.count_nonzero(changed, axis=1)
        for column in reached.tolist():
            times, axis = self._times[column], column % 6
            for k in np.flatnonzero(signed[:, column] >= min(times)).tolist():
                value = float(signed[k, column])
                times.setdefault(value, 0)
                if len(times) > 2:
                    del times[min(times)]
                if value in times:
                    times[value] += int(changing[k] - changed[k, axis] >= END_CHANGING)
                if value == max(times):
                    others = sum(times.values()) - times[value]
                    at_end[k, axis] |= times[value] >= max(END_TIMES, PILED_UP * others)
        return at_end


def white_noise(stamps_ns: Index, samples: Array, first: Index, last: Index) -> Array:
    """
    Return the white noise densities of gyros and accelerometers in K windows of the data.

    Third divided differences take out everything that is quadratic over four samples, which
    motion is, and leave what is new in each sample. Vibration counts as noise. Of samples, (N, 6),
    a window has its first one and the one after its last, (K,). Returns means over the axes,
    (K, 2), rad/sqrt(s) and m/s/sqrt(s); 0 for fewer than eight samples.
    """
    count = last - first - 3
    enough = count >= 5
    if not np.any(enough):
        return np.zeros((first.size, 2))
    n = stamps_ns.size - 3
    # From each of four samples to the next ones.
    one, two, three = ((stamps_ns[k:] - stamps_ns[:-k]) * 1e-9 for k in (1, 2, 3))
    (a, b, c), (ab, bc) = ([spacing[i:i + n] for i in range(count)]
                           for spacing, count in ((one, 3), (two, 2)))
    weights = 1 / np.stack([-(a * ab * three), a * b * bc, -(ab * b * c), three * bc * c])
    weights /= np.sqrt(np.sum(weights ** 2, axis=0))
    left = np.zeros((6, n + 1))
    for i in range(4):
        left[:, :-1] += weights[i] * samples.T[:, i:i + n]
    first, last, count = (np.where(enough, x, y) for x, y in ((first, 0), (last, n), (count, 1)))
    sums = np.add.reduceat(np.square(left), np.stack([first, last - 3], axis=1).ravel(),
                           axis=1)[:, ::2]
    spacing = (stamps_ns[last - 1] - stamps_ns[first]) * 1e-9 / (last - first - 1)
    density = np.sqrt(sums.T.reshape(-1, 2, 3).mean(axis=2) * (spacing / count)[:, None])
    return np.where(enough[:, None], density, 0.0)


def gap_and_jitter(stamps_ns: Index, first: Index, last: Index, dt: Array) -> tuple[Array, Array]:
    """
    Return what becomes of steps, `dt` of shape (K, n), with lost samples and jittering stamps.

    The first is to be multiplied with what the motion can do in a gap, the second with what it
    does to a sample whose stamp jitters: its change per second. Densities then. What is usual is
    that in K windows of the stamps, as in `white_noise`.
    """
    steps, last = np.diff(stamps_ns) * 1e-9, last - 1
    count = (last - first)[:, None]
    place = np.arange(np.max(count))
    windows = np.where(place < count, steps[first[:, None] + np.minimum(place, count - 1)], np.inf)

    def ranked(values: Array, rank: Index) -> Array:
        return np.take_along_axis(np.sort(values, axis=1), rank, axis=1)

    half = count // 2
    usual, pause = ranked(windows, np.hstack([half, (PAUSES * count).astype(int)])).T[..., None]
    deviation = ranked(np.abs(windows - usual), half)
    bunched = usual < BUNCHED * pause
    # Of bunches the pause is the usual step, and they are spread evenly over it.
    gap = np.where(dt > GAP_STEPS * np.where(bunched, pause, usual), dt, 0.0)
    jitter = JITTER_OF_MEDIAN * np.where(bunched, 0.3 * pause, deviation)
    # An error of acceleration * dt^2 over the step, as a density: squared, over dt.
    return gap ** 1.5, jitter * np.sqrt(dt)


def force_fault(mean: float) -> str:
    """Say what is wrong with a mean magnitude of the specific force, m/s^2; '' if nothing is."""
    return '' if FORCE_RANGE[0] < mean < FORCE_RANGE[1] else (
        f'the specific force averages {mean:.3g} m/s^2, gravity is 9.8: check the unit (g?) '
        'and that gravity is not taken out')


class ForceCheck:
    """Whether the magnitude of the specific force can be one in m/s^2."""

    def __init__(self) -> None:
        """Start with no samples."""
        self._sum = self._seconds = 0.0
        self.fault = ''

    def add(self, mean: float, seconds: float) -> None:
        """Take the mean magnitude over so many seconds, m/s^2."""
        self._sum += mean * seconds
        self._seconds += seconds
        if self._seconds >= FORCE_TIME:
            self.fault = force_fault(self._sum / self._seconds)
            self._sum = self._seconds = 0.0
