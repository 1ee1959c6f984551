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
"""The queue of IMU samples: sorted by stamp and cut into steps between GNSS epochs, with noise."""

from collections import Counter
from collections.abc import Callable, Iterable
from typing import NamedTuple

from ins_align.config import ImuNoise
from ins_align.geometry.rotation import Array, Index
from ins_align.imu.noise import (
    gap_and_jitter, GAP_ANGULAR_ACCELERATION, GAP_JERK, gap_noise, RangeCheck, SPIKE_BEFORE,
    stuck, white_noise, without_spikes)
from ins_align.imu.preintegration import Noise, split_at_epochs, Steps
from ins_align.imu.recent import AGES, Recent, recent_motion
import numpy as np
from numpy.typing import ArrayLike

# No sensor measures more than this; such values would overflow the integrals (rad/s, m/s^2).
MAX_RATE, MAX_ACCELERATION = 200.0, 2000.0
_LIMITS = np.repeat([MAX_RATE, MAX_ACCELERATION], 3)[:, None]
# The IMU may be silent for this long (ns); then the attitude is lost and alignment starts over.
MAX_GAP_NS = 500_000_000
NO_SAMPLE = f'no IMU sample for more than {MAX_GAP_NS * 1e-9:g} s'
SAME_VALUES = 'the IMU sends the same values again and again'
# Samples kept before those still wanted: two for interpolation, the others to find spikes.
KEPT_BEFORE = SPIKE_BEFORE + 4
# The clock was set back once this many samples in a row are behind the newest one, increase, and
# belong to a time of which other samples had already come.
SET_BACK_SAMPLES = 8
# White noise is measured over the interval and this time (ns) before it; what is measured counts
# when it is this many times the stated noise.
NOISE_WINDOW_NS = 500_000_000
NOISE_EXCESS = 1.25
# Samples are kept for the noise window and for the largest delay of a receiver (ns).
KEPT_NS = max(NOISE_WINDOW_NS, round(1e9 * AGES[-1]))
# Number of samples that are cut at once. Those that an epoch only looks back at count less.
MAX_CUT_SAMPLES, LOOK_BACK_DIVISOR = 6144, 6


class Silence(NamedTuple):
    """A time from which an attitude cannot be carried on, because the IMU measured too little."""

    start_ns: int
    end_ns: int
    counter: str    # name of the count
    why: str        # the reason in words


class ImuBuffer:
    """
    IMU samples that are not integrated yet, sorted by their stamps and counted in `counts`.

    Samples may arrive out of order by up to `lateness_ns`. `stated` is the noise that the sensors
    have at least. `watch` is called with samples as they came, stamps, (N,), and values, (N, 6).
    """

    def __init__(self, lateness_ns: int, counts: Counter[str],
                 stated: ImuNoise = ImuNoise(0.0, 0.0, 0.0, 0.0),
                 watch: Callable[[Index, Array], None] | None = None) -> None:
        self._lateness_ns = lateness_ns
        self._reach_ns = max(lateness_ns, MAX_GAP_NS)
        self._counts = counts
        self._stated = np.array(stated[:2])
        self._watch = watch
        # Stamps, (N,), strictly increasing, ns; angular rate, rad/s, and specific force, m/s^2,
        # (N, 6), in Fortran order so that each axis is contiguous.
        self.stamps = np.zeros(0, np.int64)
        self.samples = np.zeros((0, 6), order='F')
        # Stamps and samples, one or many at a time, that are not sorted into these yet.
        self._new: list[tuple[ArrayLike, ArrayLike]] = []
        self.newest_ns: int | None = None           # stamp of the newest sample accepted
        # Either one sample far ahead of the newest or several in a row behind it, which wait until
        # later ones show whether the clock has changed.
        self.held: list[tuple[int, tuple[float, ...]]] = []
        # Samples up to here have been cut; those that arrive after that are late.
        self.used_ns = -(1 << 62)
        self._range = RangeCheck()
        self._checked_ns = -(1 << 62)       # the range is checked up to here
        self.due_ns = -(1 << 62)            # no message up to here can still come in time
        self._silences: list[Silence] = []

    def add(self, stamp_ns: int, gyro: Iterable[float], accel: Iterable[float]) -> bool:
        """Add a sample; return False if the clock was set back, with all samples since `held`."""
        sample = stamp_ns, (*gyro, *accel)
        if self.newest_ns is None:
            self._append(sample)
            return True
        if self.held and self.held[0][0] > self.newest_ns:
            ahead = self.held.pop()             # the only one
            if stamp_ns >= ahead[0] - self._lateness_ns:
                self._append(ahead)             # samples go on from there
            else:
                self._counts['imu_ahead'] += 1
        behind_ns = self.newest_ns - stamp_ns
        if behind_ns > 0:
            if self.held and not 0 < stamp_ns - self.held[-1][0] < 1_000_000_000:
                self._release_held()
            self.held.append(sample)
            return not self._set_back(behind_ns > self._lateness_ns)
        self._release_held()
        if behind_ns < -self._reach_ns:
            self.held.append(sample)
        else:
            self._append(sample)
        return True

    def add_in_order(self, stamps_ns: Index, gyro: Array, accel: Array) -> bool:
        """
        Add samples, shapes (N,), (N, 3), (N, 3), if they are in order and follow the newest one.

        Otherwise add none of them and return False.
        """
        newest_ns = stamps_ns[:1] - 1 if self.newest_ns is None else self.newest_ns
        gaps_ns = np.diff(stamps_ns, prepend=newest_ns)
        if self.held or np.any((gaps_ns <= 0) | (gaps_ns > self._reach_ns)):
            return False
        if stamps_ns.size:
            self._new.append((stamps_ns, np.hstack([gyro, accel])))
            self.newest_ns = int(stamps_ns[-1])
        return True

    def _append(self, sample: tuple[int, tuple[float, ...]]) -> None:
        stamp_ns, values = sample
        self._new.append(((stamp_ns,), (values,)))
        if self.newest_ns is None or stamp_ns > self.newest_ns:
            self.newest_ns = stamp_ns

    def _set_back(self, far: bool) -> bool:
        """
        Return whether the samples held behind the newest one are of a clock that was set back.

        `far`: they are further behind than samples may arrive out of order.
        """
        if far:
            return len(self.held) > 1           # a single one is late
        if len(self.held) < SET_BACK_SAMPLES:
            return False
        # Samples that are only late fill a gap. After a clock was set back there are others of
        # the same time: equal ones were sent twice.
        self.consolidate()
        behind = np.array([(stamp, *values) for stamp, values in self.held])
        inside = slice(*np.searchsorted(self.stamps, behind[[0, -1], 0]))
        present = np.column_stack([self.stamps[inside], self.samples[inside]])
        if len(np.unique(np.vstack([present, behind]), axis=0)) > 1.5 * len(behind):
            return True
        self._release_held()
        return False

    def _release_held(self) -> None:
        """Add the samples held behind the newest one, or count those that are too late."""
        for sample in self.held:
            if self.newest_ns is not None and sample[0] < self.newest_ns - self._lateness_ns:
                self._counts['imu_late'] += 1
            else:
                self._counts['imu_out_of_order'] += 1
                self._append(sample)
        self.held.clear()

    def consolidate(self, last: bool = False) -> None:
        """
        Sort the new samples into the arrays, without those that are invalid, late or duplicate.

        `last`: no more samples will come.
        """
        if last and self.held and self.newest_ns is not None:
            if self.held[0][0] > self.newest_ns:
                self._counts['imu_ahead'] += 1
                self.held.clear()
            self._release_held()
        if not self._new:
            return
        new, self._new = self._new, []
        stamps = np.concatenate([stamps for stamps, _ in new])
        samples = np.asfortranarray(np.concatenate([samples for _, samples in new])).T
        if self._watch is not None:
            self._watch(stamps, samples.T)
        self._counts['imu'] += stamps.size
        with np.errstate(invalid='ignore'):
            good = np.all(np.abs(samples) < _LIMITS, axis=0)
        self._counts['imu_nan'] += int(np.count_nonzero(~good))
        late = stamps <= self.used_ns
        self._counts['imu_late'] += int(np.count_nonzero(good & late))
        good &= ~late
        stamps = np.concatenate([self.stamps, stamps[good]])
        samples = np.concatenate([self.samples.T, samples[:, good]], axis=1)
        if np.any(stamps[1:] <= stamps[:-1]):
            order = np.argsort(stamps, kind='stable')
            stamps, samples = stamps[order], samples[:, order]
            first = np.concatenate([[True], stamps[1:] > stamps[:-1]])
            self._counts['imu_duplicate'] += int(np.count_nonzero(~first))
            stamps, samples = stamps[first], samples[:, first]
        self.stamps, self.samples = stamps, samples.T

    def settled_ns(self, last: bool = False) -> int | None:
        """
        Return the stamp up to which epochs can be cut; None while there are too few samples.

        No late sample can precede it any more; `last`: no more will come. Checks the samples up to
        there, for `silence` and the noise of steps.
        """
        self.consolidate(last)
        if self.newest_ns is None or self.stamps.size < 4:
            return None
        self.due_ns = self.newest_ns - (0 if last else self._lateness_ns)
        settled = int(np.searchsorted(self.stamps, self.due_ns, side='right'))
        # Interpolation at an epoch needs two samples after it, and the check for spikes a third.
        upto_ns = min(int(self.stamps[max(settled, 3) - 3]), self.due_ns)
        self._find_silences(upto_ns)
        return upto_ns

    @property
    def silent(self) -> bool:
        """Whether samples still come, but none has been usable for longer than the largest gap."""
        return (self.newest_ns is not None and self.stamps.size > 0
                and self.newest_ns - self._lateness_ns - int(self.stamps[-1]) > MAX_GAP_NS)

    def rates_since(self, stamp_ns: int) -> tuple[Index, Array, Array, float]:
        """
        Return stamps, (N,), and rates, (N, 3), rad/s, after a stamp, without spikes.

        Also the rates before the stamp, the last one at it, and the median interval of samples, s.
        """
        self.consolidate()
        first = int(np.searchsorted(self.stamps, stamp_ns, side='right'))
        rates = without_spikes(self.stamps, self.samples)[0][:, :3]
        rate = [np.interp(0.0, self.stamps - stamp_ns, axis) for axis in rates.T]
        usual = 1e-9 * float(np.median(np.diff(self.stamps)))
        return self.stamps[first:], rates[first:], np.vstack([rates[:first], rate]), usual

    def forget_before(self, stamp_ns: int) -> None:
        """Drop the samples that no epoch at or after a stamp needs."""
        after = int(np.searchsorted(self.stamps, stamp_ns - KEPT_NS, side='right'))
        first = max(after - KEPT_BEFORE, 0)
        self.stamps, self.samples = self.stamps[first:], self.samples[first:]
        self._range.forget_before(stamp_ns)

    # Steps between epochs

    def _find_silences(self, upto_ns: int) -> None:
        """Find silences, for which samples up to a stamp are checked for the end of the range."""
        stamps = self.stamps
        first, last = np.searchsorted(stamps, [self._checked_ns, upto_ns], side='right').tolist()
        samples, _ = without_spikes(stamps[:last + 1], self.samples[:last + 1])
        before = self._range.stamps.size
        self._range.add(stamps[first:last], samples[first:last])
        self._counts['imu_saturated'] += self._range.stamps.size - before
        self._checked_ns = max(self._checked_ns, upto_ns)
        gaps = np.flatnonzero(np.diff(stamps) > MAX_GAP_NS)
        # An epoch needs two samples after it: a silence begins before the last two.
        self._silences = [Silence(start, end, 'imu_gap', NO_SAMPLE) for start, end in zip(
            stamps[np.maximum(gaps - 2, 0)].tolist(), stamps[gaps + 1].tolist())]
        # An epoch is cut once the IMU is ahead of it by the lateness. What is known only after
        # that does not count, or results would depend on when epochs are cut.
        self._silences += [Silence(max(start, known - self._lateness_ns), end, 'imu_stuck',
                                   SAME_VALUES)
                           for start, end, known in stuck(stamps, self.samples)]
        self._silences += [Silence(stamp - 1, stamp, 'imu_blind', 'the gyros are at the end of '
                                   'their range: let the driver set a larger one')
                           for stamp in self._range.blind]

    def silence(self, start_ns: int, end_ns: int) -> Silence | None:
        """Return a silence between two stamps, or at one given twice; None: there is none."""
        return next((silence for silence in self._silences
                     if silence.start_ns < end_ns and silence.end_ns > start_ns), None)

    def parts(self, epochs_ns: list[int]) -> list[slice]:
        """Divide epochs into slices that are cut one after the other, to limit memory."""
        stamps = self.stamps
        place, first = np.searchsorted(stamps, [epochs_ns, np.subtract(epochs_ns, KEPT_NS)])
        size = place - place[0] + np.cumsum(place - first) // LOOK_BACK_DIVISOR
        starts = np.flatnonzero(np.diff(size // MAX_CUT_SAMPLES, prepend=-1)).tolist()
        return [slice(*ends) for ends in zip(starts, [*starts[1:], len(epochs_ns)])]

    def start(self, stamp_ns: int) -> tuple[Steps, Noise, Recent]:
        """Return the zero-length interval at the first epoch of an alignment, as from `cut`."""
        self.used_ns = stamp_ns
        return self.cut([stamp_ns], [0.0])

    def cut(self, epochs_ns: list[int], gravity_drift: list[float],
            ) -> tuple[Steps, Noise, Recent]:
        """
        Return what `preintegrate` takes for the intervals that end at K increasing epochs.

        The first begins at the last epoch that was cut. `gravity_drift` is the noise in each that
        comes from gravity at an unknown place, m/s/sqrt(s).
        """
        stamps = self.stamps
        ends_ns = np.array([self.used_ns, *epochs_ns])
        ends = np.searchsorted(stamps, ends_ns, side='left') + 2
        first = np.searchsorted(stamps, ends_ns[:-1] - NOISE_WINDOW_NS)
        stamps = stamps[:ends[-1] + 1]
        samples, spikes = without_spikes(stamps, self.samples[:stamps.size])
        self._counts['imu_spike'] += int(np.count_nonzero(spikes[ends[0] - 2:ends[-1] - 2]))
        stamps, samples = stamps[:ends[-1]], samples[:ends[-1]]
        steps = split_at_epochs(stamps, samples, ends_ns)
        measured = white_noise(stamps, samples, first, ends[1:])
        excess = np.where(measured > NOISE_EXCESS * self._stated, np.sqrt(np.maximum(
            measured ** 2 - self._stated ** 2, 0.0)), 0.0)
        gap, jitter = gap_and_jitter(stamps, first, ends[1:], steps.dt)
        self._counts['imu_gap'] += int(np.count_nonzero(gap))
        lost = [gap_noise(gap, at_ends, samples[:, triad], first, ends[1:], most)
                for at_ends, triad, most in (
                    (steps.omega, slice(0, 3), GAP_ANGULAR_ACCELERATION),
                    (steps.f, slice(3, 6), GAP_JERK))]
        beyond = self._range.beyond(stamps, ends_ns, steps.dt)
        noise = Noise(
            _combined(self._stated[0], lost[0], jitter * _rms(steps.omega_dot), beyond[0]),
            _combined(self._stated[1], lost[1], jitter * _rms(steps.f_dot), beyond[1],
                      np.array(gravity_drift)[:, None]),
            excess[:, :1], excess[:, 1:])
        self.used_ns = epochs_ns[-1]
        self.forget_before(self.used_ns)
        return steps, noise, recent_motion(stamps, samples, ends_ns[1:])


def _combined(*densities: 'Array | float') -> Array:
    """Return the density of the sum of independent noises."""
    return np.asarray(np.sqrt(sum(map(np.square, densities))))


def _rms(slope: Array) -> Array:
    """Return the root mean square over the axes at the end of each step, shape (K, n)."""
    return np.sqrt(np.mean(np.square(slope[:, 1:]), axis=2))
