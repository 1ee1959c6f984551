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
IMU samples that have arrived, put in order, and cut into steps between GNSS epochs.

The steps come with their white noise: what is stated, what is measured, and what makes the samples
miss the motion (gaps, stamps that jitter, the end of the sensors' range, gravity at a place that
is not known).
"""

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from ins_align.config import ImuNoise
from ins_align.geometry.rotation import Array, Index
from ins_align.imu.noise import (
    gap_and_jitter, GAP_ANGULAR_ACCELERATION, GAP_JERK, IMU_BEFORE, RangeCheck, stuck, white_noise,
    without_spikes)
from ins_align.imu.preintegration import Noise, split_at_epochs, Steps
from ins_align.imu.recent import AGES, Recent, recent_motion
import numpy as np
from numpy.typing import ArrayLike

# Beyond these no sensor measures; such values would overflow the integrals (rad/s, m/s^2).
MAX_RATE, MAX_ACCELERATION = 200.0, 2000.0
_LIMITS = np.repeat([MAX_RATE, MAX_ACCELERATION], 3)[:, None]
# The IMU may be silent for this long; then the attitude is lost and alignment starts over (ns).
MAX_GAP_NS = 500_000_000
NO_SAMPLE = f'no IMU sample for more than {MAX_GAP_NS * 1e-9:g} s'
SAME_VALUES = 'the IMU sends the same values again and again'
# IMU samples that are kept before those wanted: interpolation needs two, the checks the rest.
KEPT_BEFORE = 2 + IMU_BEFORE
# So many IMU samples in a row that go in order, behind the newest one, through a time that others
# have gone through before them: not late, but of a clock that was set back.
SET_BACK_SAMPLES = 8
# Noise is measured over the interval and this long before it (ns); it counts when it is this
# many times the stated one.
NOISE_WINDOW_NS = 500_000_000
NOISE_EXCESS = 1.25
# Samples are kept for that, and for as long as a receiver may be late.
KEPT_NS = max(NOISE_WINDOW_NS, round(1e9 * AGES[-1]))
# How many IMU samples are cut at one go; those that an epoch looks back at count for a sixth.
MAX_CUT_SAMPLES, LOOKED_AT = 6144, 6


class Silence(NamedTuple):
    """A time in which the IMU says too little: stamps, the count's name, why in words."""

    start_ns: int
    end_ns: int
    counter: str
    why: str


class ImuBuffer:
    """
    IMU samples that are not integrated yet, in the order of their stamps.

    Samples may arrive out of order by `lateness_ns`. What becomes of them is counted by names
    that begin with ``imu``; `stated` is the noise that the sensors have at least.
    """

    def __init__(self, lateness_ns: int, counts: Counter[str],
                 stated: ImuNoise = ImuNoise(0.0, 0.0, 0.0, 0.0)) -> None:
        """Start empty."""
        self._lateness_ns = lateness_ns
        self._reach_ns = max(lateness_ns, MAX_GAP_NS)
        self._counts = counts
        self._stated = np.array(stated[:2])
        # What is sorted: stamps, (N,), strictly increasing, ns; angular rate, rad/s, and specific
        # force, m/s^2, (N, 6), in Fortran order, so that each axis is contiguous in memory.
        self.stamps = np.zeros(0, np.int64)
        self.samples = np.zeros((0, 6), order='F')
        # What is not sorted into these yet: stamps and samples, of one sample or of many.
        self._new: list[tuple[ArrayLike, ArrayLike]] = []
        self.newest_ns: int | None = None           # that has come
        # Samples that may be of another clock, until those behind them tell: one far ahead of the
        # newest, or some in a row behind it.
        self.held: list[tuple[int, tuple[float, ...]]] = []
        # Up to here samples are cut: what comes later and is older is late.
        self.used_ns = -(1 << 62)
        self._range = RangeCheck()
        self._checked_ns = 0                # up to where it has seen them
        self._silences: list[Silence] = []

    def add(self, stamp_ns: int, gyro: Iterable[float], accel: Iterable[float]) -> bool:
        """Take a sample; return False if the clock was set back: since then come those `held`."""
        sample = stamp_ns, (*gyro, *accel)
        if self.newest_ns is None:
            self._append(sample)
            return True
        if self.held and self.held[0][0] > self.newest_ns:
            ahead = self.held.pop()
            if stamp_ns >= ahead[0] - self._lateness_ns:
                self._append(ahead)             # time goes on there
            else:
                self._counts['imu_ahead'] += 1
        behind_ns = self.newest_ns - stamp_ns
        if behind_ns > 0:
            if self.held and not 0 < stamp_ns - self.held[-1][0] < 1_000_000_000:
                self._let_go()
            self.held.append(sample)
            return not self._set_back(behind_ns > self._lateness_ns)
        self._let_go()
        if behind_ns < -self._reach_ns:
            self.held.append(sample)
        else:
            self._append(sample)
        return True

    def add_in_order(self, stamps_ns: Index, gyro: Array, accel: Array) -> bool:
        """
        Take samples, shapes (N,), (N, 3), (N, 3), if all of them go on from the newest one.

        False: they do not, and none is taken.
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
        """Whether the samples held, behind the newest one, are of a clock that was set back."""
        if far:
            return len(self.held) > 1           # a single one from long ago is late
        if len(self.held) < SET_BACK_SAMPLES:
            return False
        # Samples that were only late fill a hole; others of their time would stand beside them.
        # Those with the very stamps of others cannot be told from samples sent twice.
        self.consolidate()
        behind = [stamp for stamp, _ in self.held]
        inside = slice(*np.searchsorted(self.stamps, [behind[0], behind[-1]]))
        if np.union1d(self.stamps[inside], behind).size > 1.5 * len(behind):
            return True
        self._let_go()
        return False

    def _let_go(self) -> None:
        """Take samples that were held behind the newest one, or count them: they were late."""
        for sample in self.held:
            if self.newest_ns is not None and sample[0] < self.newest_ns - self._lateness_ns:
                self._counts['imu_late'] += 1
            else:
                self._counts['imu_out_of_order'] += 1
                self._append(sample)
        self.held.clear()

    def consolidate(self, last: bool = False) -> None:
        """
        Sort what is new into the arrays, without what is broken, late or there twice.

        `last`: nothing comes any more.
        """
        if last and self.held and self.newest_ns is not None:
            if self.held[0][0] > self.newest_ns:
                self._counts['imu_ahead'] += 1
                self.held.clear()
            self._let_go()
        if not self._new:
            return
        new, self._new = self._new, []
        stamps = np.concatenate([stamps for stamps, _ in new])
        samples = np.asfortranarray(np.concatenate([samples for _, samples in new])).T
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

        Nothing late can precede it any more; `last`: nothing comes any more at all. Up to there
        samples are checked, for `silence` and the noise of steps.
        """
        self.consolidate(last)
        if self.newest_ns is None or self.stamps.size < 4:
            return None
        settled_ns = self.newest_ns - (0 if last else self._lateness_ns)
        settled = int(np.searchsorted(self.stamps, settled_ns, side='right'))
        # Interpolation at an epoch wants two samples after it, and whether they are spikes shows
        # in the next one.
        upto_ns = int(self.stamps[max(settled, 3) - 3])
        self._check(upto_ns)
        return upto_ns

    @property
    def silent(self) -> bool:
        """Whether samples come, but for too long none that could be used."""
        return (self.newest_ns is not None and self.stamps.size > 0
                and self.newest_ns - self._lateness_ns - int(self.stamps[-1]) > MAX_GAP_NS)

    def rates_since(self, stamp_ns: int) -> tuple[Index, Array, Array, float]:
        """
        Return the angular rates after a stamp, rad/s, without spikes.

        Stamps, shape (N,), rates, (N, 3), the rate at the stamp itself, (3,), and the usual
        interval between samples, s.
        """
        self.consolidate()
        first = int(np.searchsorted(self.stamps, stamp_ns, side='right'))
        rates = without_spikes(self.stamps, self.samples)[0][:, :3]
        rate = np.array([np.interp(0.0, self.stamps - stamp_ns, axis) for axis in rates.T])
        usual = 1e-9 * float(np.median(np.diff(self.stamps)))
        return self.stamps[first:], rates[first:], rate, usual

    def forget_before(self, stamp_ns: int) -> None:
        """Drop samples that no epoch at or after a stamp looks back at."""
        first = int(np.searchsorted(self.stamps, stamp_ns - KEPT_NS, side='right')) - KEPT_BEFORE
        self.stamps, self.samples = self.stamps[max(first, 0):], self.samples[max(first, 0):]
        self._range.forget_before(stamp_ns)

    # Steps between epochs

    def _check(self, upto_ns: int) -> None:
        """Look for times in which the IMU says too little, and for the end of its range."""
        stamps = self.stamps
        first, last = np.searchsorted(stamps, [self._checked_ns, upto_ns], side='right').tolist()
        samples, _ = without_spikes(stamps[:last + 1], self.samples[:last + 1])
        before = self._range.stamps.size
        self._range.add(stamps[first:last], samples[first:last])
        self._counts['imu_saturated'] += self._range.stamps.size - before
        self._checked_ns = max(self._checked_ns, upto_ns)
        gaps = np.flatnonzero(np.diff(stamps) > MAX_GAP_NS)
        self._silences = [Silence(start, end, 'imu_gap', NO_SAMPLE) for start, end in
                          zip(stamps[gaps].tolist(), stamps[gaps + 1].tolist())]
        # An epoch is taken when the IMU is ahead by the lateness: what is known by then counts.
        self._silences += [Silence(max(start, known - self._lateness_ns), end, 'imu_stuck',
                                   SAME_VALUES)
                           for start, end, known in stuck(stamps, self.samples)]
        self._silences += [Silence(stamp - 1, stamp, 'imu_blind', 'the gyros are at the end of '
                                   'their range: let the driver set a larger one')
                           for stamp in self._range.blind]

    def silence(self, start_ns: int, end_ns: int) -> Silence | None:
        """Return why the IMU says too little between two stamps, or at one."""
        return next((silence for silence in self._silences
                     if silence.start_ns < end_ns and silence.end_ns > start_ns), None)

    def parts(self, epochs_ns: list[int]) -> list[slice]:
        """Divide epochs into parts to be cut one after the other, so that memory is bounded."""
        stamps = self.stamps
        place, first = np.searchsorted(stamps, [epochs_ns, np.subtract(epochs_ns, KEPT_NS)])
        size = place - place[0] + np.cumsum(place - first) // LOOKED_AT
        starts = np.flatnonzero(np.diff(size // MAX_CUT_SAMPLES, prepend=-1)).tolist()
        return [slice(*ends) for ends in zip(starts, [*starts[1:], len(epochs_ns)])]

    def start(self, stamp_ns: int) -> tuple[Steps, Noise, Recent]:
        """Return the steps of no length at the first epoch of an alignment; see `cut`."""
        self.used_ns = stamp_ns
        return self.cut([stamp_ns], [0.0])

    def cut(self, epochs_ns: list[int], gravity_drift: list[float],
            ) -> tuple[Steps, Noise, Recent]:
        """
        Return what `preintegrate` takes: up to each epoch, in increasing order, since the last.

        `gravity_drift`: noise of gravity for want of a place, m/s/sqrt(s), before each.
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
        beyond = self._range.beyond(stamps, ends_ns, steps.dt)
        noise = Noise(
            _together(self._stated[0], GAP_ANGULAR_ACCELERATION * gap,
                      jitter * _rms(steps.omega_dot), beyond[0]),
            _together(self._stated[1], GAP_JERK * gap, jitter * _rms(steps.f_dot), beyond[1],
                      np.array(gravity_drift)[:, None]),
            excess[:, :1], excess[:, 1:])
        self.used_ns = epochs_ns[-1]
        self.forget_before(self.used_ns)
        return steps, noise, recent_motion(stamps, samples, ends_ns[1:])


def _together(*densities: 'Array | float') -> Array:
    """Return the density of noises that are independent of each other."""
    return np.asarray(np.sqrt(sum(map(np.square, densities))))


def _rms(slope: Array) -> Array:
    """Return the root mean square of the three axes at the end of each step, shape (K, n)."""
    return np.sqrt(np.mean(np.square(slope[:, 1:]), axis=2))
