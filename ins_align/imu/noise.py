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
"""Faults of IMU samples and the noise that they add, measured white noise, wrong units."""

import math
from typing import Any

from ins_align.geometry.rotation import Array, Index
import numpy as np

# Limits of the mean specific force (m/s^2) over this time (s). It averages to gravity, unless the
# vehicle falls, flies loops (up to 6 g) or the unit is wrong.
FORCE_RANGE = 4.0, 60.0
FORCE_TIME = 5.0
# A spike differs from the mean of its neighbours by at least this much (rad/s, m/s^2), and by this
# many times as much as the neighbours differ from each other and as earlier samples differ from
# the mean of theirs. Of the latter the one of this rank counts, from below, among so many samples
# before the spike: three are larger, as many as another spike makes.
SPIKE_RATE, SPIKE_FORCE = 0.5, 5.0
SPIKE_RATIO = 12.0
SPIKE_BEFORE, SPIKE_RANK = 12, 7
# An IMU is stuck that has repeated the same six values this often and for this long (ns).
STUCK_SAMPLES, STUCK_NS = 8, 250_000_000
# The largest value of an axis is the end of its range if it is at least this large (rad/s, m/s^2),
# more than at rest, and has come this often while so many other axes changed, and this many times
# as often as the next smaller value: with a coarse resolution smaller values repeat, too. The true
# motion may exceed the end by this share.
END_RATE, END_FORCE = 0.5, 15.0
END_TIMES, END_CHANGING, PILED_UP = 5, 3, 4
BEYOND_END = 0.5
# The attitude is lost when the gyros may have missed this angle (rad).
BLIND_ANGLE = 0.35
# A step this many times the usual one holds lost samples. In it the rate may have differed from
# the mean of both ends by half of their difference, by as much as it varies around the step, and
# by what this angular acceleration makes (rad/s^2); so may the specific force, with this jerk
# (m/s^3). Where samples of the recordings are left out, rotations err by 0.3 to 0.7 sigma.
GAP_STEPS = 2.5
GAP_ANGULAR_ACCELERATION, GAP_JERK = 0.2, 2.0
# Samples come in bunches, stamped on arrival, where the median step is less than this share of
# this quantile of the steps, which then is the usual pause between bunches.
BUNCHED, PAUSES = 0.2, 0.95
# Standard deviation of the stamps over the median absolute deviation of the steps between them.
JITTER_OF_MEDIAN = 1.4826 / math.sqrt(2)


def without_spikes(stamps: Index, samples: Array) -> tuple[Array, np.ndarray]:
    """
    Replace single samples that no motion can cause by interpolation between their neighbours.

    Gyros and accelerometers are judged separately. A shock is no spike, because it rings. Of the
    samples, (N, 6), rad/s and m/s^2, the first `SPIKE_BEFORE` + 1 and the last cannot be judged.
    Returns the samples, the same array if none is a spike, and which were replaced, (N,).
    """
    spikes = np.zeros((stamps.size, 2), bool)
    x = samples.reshape(-1, 2, 3)
    away = np.sqrt(np.sum(np.square(x[1:-1] - 0.5 * (x[:-2] + x[2:])), axis=2))
    k, sensor = np.nonzero(away[SPIKE_BEFORE:] > [SPIKE_RATE, SPIKE_FORCE])
    if not k.size:
        return samples, spikes[:, 0]
    k += SPIKE_BEFORE
    # Without the sample just before the spike, which has the spike for a neighbour.
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
    Find where an IMU repeats the same values, in stamps, (N,), ns, and samples, (N, 6).

    Returns of each such time the first and the last stamp, and from when on it was certain, ns.
    """
    new = np.flatnonzero(np.any(samples[1:] != samples[:-1], axis=1)) + 1
    first = np.concatenate([[0], new])
    last = np.concatenate([new, [stamps.size]]) - 1
    long = (last - first >= STUCK_SAMPLES) & (stamps[last] - stamps[first] >= STUCK_NS)
    first, start = first[long], stamps[first[long]]
    certain = np.maximum(start + STUCK_NS, stamps[first + STUCK_SAMPLES])
    return list(zip(start.tolist(), stamps[last[long]].tolist(), certain.tolist()))


class RangeCheck:
    """Detects an IMU at the end of its range, where an extreme value comes again and again."""

    def __init__(self) -> None:
        # For the six axes, then for the axes reversed: the two largest values so far, and how
        # often each has come.
        self._times = [{end: 0} for end in 2 * (3 * [END_RATE] + 3 * [END_FORCE])]
        self._last = np.zeros(6)            # the last sample
        # Stamps of the last samples within the range, of gyros and of accelerometers, ns.
        self._within_ns: Index | None = None
        # Of the last sample at the end of the range: when the gyros were within it before, ns, and
        # the angle missed since, in whole multiples of `BLIND_ANGLE`.
        self._since_ns, self._angles = 0, 0.0
        # Stamps of M samples at the end of the range, ns, and noise densities, (M, 2), of the
        # motion that gyros and accelerometers may miss until the next, rad/sqrt(s), m/s/sqrt(s).
        self.stamps, self.densities = np.zeros(0, np.int64), np.zeros((0, 2))
        # Stamps at which the gyros may have missed another `BLIND_ANGLE` since they were last
        # within the range, ns.
        self.blind: list[int] = []

    def add(self, stamps: Index, samples: Array) -> None:
        """Add samples that follow the last: stamps, (N,), ns, and values, (N, 6)."""
        if not stamps.size:
            return
        at_end = self._at_end(samples).reshape(-1, 2, 3)
        self._last = samples[-1]
        if not at_end.any():
            self._within_ns = stamps[[-1, -1]]
            return
        if self._within_ns is None:
            self._within_ns = stamps[[0, 0]]
        beyond = np.any(at_end, axis=2)
        within = np.maximum.accumulate(np.where(beyond, self._within_ns, stamps[:, None]))
        self._within_ns = within[-1]
        k = np.flatnonzero(np.any(beyond, axis=1))
        missed = BEYOND_END * np.max(np.abs(samples[k].reshape(-1, 2, 3)) * at_end[k], axis=2)
        seconds = (stamps[k, None] - within[k]) * 1e-9
        self.stamps = np.concatenate([self.stamps, stamps[k]])
        # The error is constant: an angle or velocity grows with time, not with its square root.
        self.densities = np.concatenate([self.densities, missed * np.sqrt(2 * seconds)])
        since = np.append(self._since_ns, within[k, 0])
        angles = np.append(self._angles, missed[:, 0] * seconds[:, 0] // BLIND_ANGLE)
        before = np.where(np.diff(since) == 0, angles[:-1], 0.0)
        self.blind += stamps[k[angles[1:] > before]].tolist()
        self._since_ns, self._angles = since[-1], angles[-1]

    def beyond(self, stamps: Index, ends_ns: Index, dt: Array) -> Array:
        """
        Return the noise densities, shape (2, K, n), of motion beyond the range.

        `stamps` are those of samples, `ends_ns`, (K + 1,), and `dt`, (K, n), ends and steps of
        intervals.
        """
        beyond = np.zeros((2,) + dt.shape)
        inside = slice(*np.searchsorted(self.stamps, ends_ns[[0, -1]]))
        saturated = self.stamps[inside]
        if saturated.size:
            interval = np.searchsorted(ends_ns, saturated, side='right') - 1
            # Each interval's first step begins at its start, which may be between two samples.
            first = np.searchsorted(stamps, ends_ns[:-1], side='right') - 1
            step = np.searchsorted(stamps, saturated) - first[interval]
            beyond[:, interval, step] = self.densities[inside].T
        return beyond

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what was found before a stamp."""
        kept = self.stamps >= stamp_ns
        self.stamps, self.densities = self.stamps[kept], self.densities[kept]
        self.blind = [blind_ns for blind_ns in self.blind if blind_ns >= stamp_ns]

    def _at_end(self, samples: Array) -> np.ndarray:
        """Return which values are at the end of the range, shape (N, 6)."""
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

    Third divided differences remove what is quadratic over four samples, as motion is; vibration
    counts as noise. `first` and `last`, (K,), are indices of a window's first sample and of the
    one after its last; samples are (N, 6). Returns means over the axes, (K, 2), rad/sqrt(s) and
    m/s/sqrt(s); 0 for fewer than eight samples.
    """
    count = last - first - 3
    enough = count >= 5
    if not np.any(enough):
        return np.zeros((first.size, 2))
    n = stamps_ns.size - 3
    # Times between four samples in a row: a, b and c from each to the next.
    one, two, abc = ((stamps_ns[k:] - stamps_ns[:-k]) * 1e-9 for k in (1, 2, 3))
    a, b, c = one[:-2], one[1:-1], one[2:]
    ab, bc = two[:-1], two[1:]
    weights = 1 / np.stack([-(a * ab * abc), a * b * bc, -(ab * b * c), abc * bc * c])
    weights /= np.sqrt(np.sum(weights ** 2, axis=0))
    noise = np.zeros((6, n + 1))
    for i in range(4):
        noise[:, :-1] += weights[i] * samples.T[:, i:i + n]
    # Windows that are too short get valid indices; what they yield is not used.
    first, last, count = (np.where(enough, x, y) for x, y in ((first, 0), (last, n), (count, 1)))
    sums = np.add.reduceat(np.square(noise), np.stack([first, last - 3], axis=1).ravel(),
                           axis=1)[:, ::2]
    spacing = (stamps_ns[last - 1] - stamps_ns[first]) * 1e-9 / (last - first - 1)
    density = np.sqrt(sums.T.reshape(-1, 2, 3).mean(axis=2) * (spacing / count)[:, None])
    return np.where(enough[:, None], density, 0.0)


def gap_and_jitter(stamps_ns: Index, first: Index, last: Index, dt: Array) -> tuple[Array, Array]:
    """
    Return the steps with lost samples, (K, n), s, the others as 0, and factors for jitter, (K, n).

    The noise density of jitter is the factor times the change of the samples per second. K windows
    of the stamps, as in `white_noise`, show the usual step and jitter.
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
    # In bunches the pause is the usual step, and errors of the stamps are uniform over it.
    gap = np.where(dt > GAP_STEPS * np.where(bunched, pause, usual), dt, 0.0)
    jitter = JITTER_OF_MEDIAN * np.where(bunched, 0.3 * pause, deviation)
    return gap, jitter * np.sqrt(dt)


def gap_noise(gap: Array, ends: Array, samples: Array, first: Index, last: Index,
              most: float) -> Array:
    """
    Return the noise densities of the steps with lost samples, (K, n).

    `gap`, (K, n), are these steps, s, the others 0; `ends`, (K, n + 1, 3), the rates or forces at
    the ends of all steps; the samples, (N, 3), have K windows as in `white_noise`; `most` is the
    angular acceleration or jerk.
    """
    if not gap.any():
        return gap
    varies = np.array([np.var(samples[window], axis=0).mean()
                       for window in map(slice, first, last)])
    differs = np.mean(np.square(np.diff(ends, axis=1)), axis=2)
    return np.sqrt(gap * variance_in_gap(gap, varies[:, None], differs, most))


def variance_in_gap(gap: Any, varies: Any, differs: Any, most: float) -> Any:
    """
    Return the variance of the mean rate or force in a step with lost samples, as large as `gap`.

    `varies` is the variance around the step, `differs` the square of the difference of both ends,
    each a mean over the axes; `most` as in `gap_noise`. Numbers or arrays.
    """
    return varies + 0.25 * differs + (most * gap) ** 2


def force_fault(mean: float) -> str:
    """Return what is wrong with a mean magnitude of the specific force, m/s^2; '' if nothing."""
    if FORCE_RANGE[0] < mean < FORCE_RANGE[1]:
        return ''
    return (f'the specific force averages {mean:.3g} m/s^2, gravity is 9.8: check the unit (g?) '
            'and that gravity is not taken out')


class ForceCheck:
    """Checks whether the mean specific force is plausible; `fault` is the result in words."""

    def __init__(self) -> None:
        self._sum = self._seconds = 0.0
        self.fault = ''

    def add(self, mean: float, seconds: float) -> None:
        """Add a mean magnitude, m/s^2, over a time, s."""
        self._sum += mean * seconds
        self._seconds += seconds
        if self._seconds >= FORCE_TIME:
            self.fault = force_fault(self._sum / self._seconds)
            self._sum = self._seconds = 0.0
