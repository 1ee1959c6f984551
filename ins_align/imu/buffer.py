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
"""IMU samples that have arrived and are not integrated yet, in the order of their stamps."""

from collections import Counter

from ins_align.geometry.rotation import Array, Index
from ins_align.imu.noise import IMU_BEFORE, without_spikes
import numpy as np
from numpy.typing import ArrayLike

# Beyond these no sensor measures; such values would overflow the integrals (rad/s, m/s^2).
MAX_RATE, MAX_ACCELERATION = 200.0, 2000.0
_LIMITS = np.repeat([MAX_RATE, MAX_ACCELERATION], 3)[:, None]
# The IMU may be silent for this long; then the attitude is lost and alignment starts over (ns).
MAX_GAP_NS = 500_000_000
# IMU samples that are kept before those wanted: interpolation needs two, the checks the rest.
KEPT_BEFORE = 2 + IMU_BEFORE
# So many IMU samples in a row that go in order, behind the newest one, through a time that others
# have gone through before them: not late, but of a clock that was set back.
SET_BACK_SAMPLES = 8
# Why samples were left out, by the name under which they are counted.
_LEFT_OUT = {'imu_undecodable': 'that cannot be decoded',
             'imu_nan': 'without numbers or with impossible ones',
             'imu_duplicate': 'with the stamp of another (does the driver set stamps?)',
             'imu_late': 'too late'}


class ImuBuffer:
    """
    IMU samples that are not integrated yet, in the order of their stamps.

    Parameters
    ----------
    lateness_ns : int
        How far out of order a sample may arrive.
    counts : Counter
        Where samples are counted: ``imu``, ``imu_nan``, ``imu_duplicate``, ``imu_out_of_order``,
        ``imu_late``, ``imu_ahead``.

    Attributes
    ----------
    stamps : ndarray of int, shape (N,)
        Of what is sorted, strictly increasing, ns.
    samples : ndarray, shape (N, 6)
        Angular rate, rad/s, and specific force, m/s^2; in Fortran order, so that each axis is
        contiguous in memory.
    newest_ns : int or None
        The newest stamp that has come.
    used_ns : int
        Up to here samples are used: what comes later and is older is late.
    jumped_to_ns : int or None
        Where the clock has jumped back to.

    """

    def __init__(self, lateness_ns: int, counts: Counter[str]) -> None:
        """Start empty."""
        self.lateness_ns = lateness_ns
        self._reach_ns = max(lateness_ns, MAX_GAP_NS)
        self._counts = counts
        self.stamps = np.zeros(0, np.int64)
        self.samples = np.zeros((0, 6), order='F')
        # What is not sorted into these yet: stamps and samples, of one sample or of many.
        self._new: list[tuple[ArrayLike, ArrayLike]] = []
        self.newest_ns: int | None = None
        self.used_ns = -(1 << 62)
        self._suspect_ns: int | None = None
        # A sample far ahead of the others, until the next one shows whether time goes on there.
        self._ahead: tuple[int, Array, Array] | None = None
        # The samples in a row behind the newest one: that one, the first, the last, how many.
        self._behind: tuple[int | None, int, int, int] = None, 0, 0, 0
        self.jumped_to_ns: int | None = None

    def add(self, stamp_ns: int, gyro: Array, accel: Array) -> None:
        """Append one sample."""
        if self._ahead is not None:
            ahead, self._ahead = self._ahead, None
            if stamp_ns >= ahead[0] - self.lateness_ns:
                self._append(*ahead)
            else:
                self._counts['imu_ahead'] += 1
        if self.newest_ns is not None and stamp_ns > self.newest_ns + self._reach_ns:
            self._ahead = stamp_ns, gyro, accel
        else:
            self._append(stamp_ns, gyro, accel)

    def _append(self, stamp_ns: int, gyro: Array, accel: Array) -> None:
        newest = self.newest_ns
        if newest is not None and stamp_ns < newest - self.lateness_ns:
            self._old_sample(stamp_ns)
            return
        self._suspect_ns = None
        if newest is None or stamp_ns > newest:
            self.newest_ns = stamp_ns
        elif stamp_ns < newest:
            self._counts['imu_out_of_order'] += 1
            if self._set_back(stamp_ns):
                self.jumped_to_ns = stamp_ns
                return
        self._new.append(((stamp_ns,), ((*gyro, *accel),)))

    def add_many(self, stamps_ns: np.ndarray, gyro: Array, accel: Array) -> int:
        """
        Append samples, shapes (N,), (N, 3), (N, 3); the same as one by one.

        Returns
        -------
        int
            How many were taken: all, or those before the one at which the clock has jumped.

        """
        if stamps_ns.size == 0:
            return 0
        before_ns = self.newest_ns if stamps_ns.size == 1 else stamps_ns[-2]
        ordered = (self._ahead is None and (stamps_ns[1:] > stamps_ns[:-1]).all()
                   and (self.newest_ns is None or stamps_ns[0] > self.newest_ns)
                   and (before_ns is None or stamps_ns[-1] <= before_ns + self._reach_ns))
        if not ordered:
            for k, (stamp_ns, g, a) in enumerate(zip(stamps_ns.tolist(), gyro, accel)):
                self.add(stamp_ns, g, a)
                if self.jumped_to_ns is not None:
                    return k
            return int(stamps_ns.size)
        self._suspect_ns = None
        self._new.append((stamps_ns, np.hstack([gyro, accel])))
        self.newest_ns = int(stamps_ns[-1])
        return int(stamps_ns.size)

    def _old_sample(self, stamp_ns: int) -> None:
        """One sample from long ago is late; a second one after it means a clock set back."""
        suspect = self._suspect_ns
        if suspect is not None and 0 <= stamp_ns - suspect < 1_000_000_000:
            self.jumped_to_ns = stamp_ns
            return
        self._suspect_ns = stamp_ns
        self._counts['imu_late'] += 1

    def _set_back(self, stamp_ns: int) -> bool:
        """Whether samples behind the newest one are of a clock that was set back a little."""
        newest, first, last, number = self._behind
        if newest != self.newest_ns or stamp_ns <= last:
            first, number = stamp_ns, 0
        self._behind = self.newest_ns, first, stamp_ns, number + 1
        if (number + 1) % SET_BACK_SAMPLES:
            return False
        # Samples that were only late fill a hole; others of their time would stand beside them.
        # Those with the very stamps of others cannot be told from samples sent twice.
        self.consolidate()
        inside = np.searchsorted(self.stamps, stamp_ns) - np.searchsorted(self.stamps, first)
        return bool(inside > 1.5 * number)

    def consolidate(self, last: bool = False) -> None:
        """
        Sort what is new into the arrays, without what is broken, late or there twice.

        `last`: nothing comes any more.
        """
        if last and self._ahead is not None:
            self._counts['imu_ahead'] += 1
            self._ahead = None
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

        Nothing late can precede it any more; `last`: nothing comes any more at all.
        """
        self.consolidate(last)
        if self.newest_ns is None or self.stamps.size < 4:
            return None
        settled_ns = self.newest_ns - (0 if last else self.lateness_ns)
        settled = int(np.searchsorted(self.stamps, settled_ns, side='right'))
        # Interpolation at an epoch wants two samples after it, and whether they are spikes shows
        # in the next one.
        return int(self.stamps[max(settled, 3) - 3])

    @property
    def silent(self) -> bool:
        """Whether samples come, but for too long none that could be used."""
        return (self.newest_ns is not None and self.stamps.size > 0
                and self.newest_ns - self.lateness_ns - int(self.stamps[-1]) > MAX_GAP_NS)

    def left_out(self, before: Counter[str]) -> str:
        """List in words what was left out since the counts were those `before`."""
        return ', '.join(f'{count} {why}' for name, why in _LEFT_OUT.items()
                         if (count := self._counts[name] - before[name]))

    def rates_since(self, stamp_ns: int) -> tuple[Index, Array, Array] | None:
        """
        Return the angular rates after a stamp, rad/s, without spikes; None where there is a gap.

        Stamps, shape (N,), rates, (N, 3), and the rate at the stamp itself, (3,).
        """
        self.consolidate()
        first = int(np.searchsorted(self.stamps, stamp_ns, side='right'))
        if np.any(np.diff(self.stamps[first:], prepend=stamp_ns) > MAX_GAP_NS):
            return None
        looked_at = max(first - IMU_BEFORE, 0)
        stamps = self.stamps[looked_at:]
        rates = without_spikes(stamps, self.samples[looked_at:])[0][:, :3]
        rate = np.array([np.interp(0.0, stamps - stamp_ns, axis) for axis in rates.T])
        return stamps[first - looked_at:], rates[first - looked_at:], rate

    def forget_before(self, stamp_ns: int) -> None:
        """Drop samples before `stamp_ns`, but for those that are still looked at."""
        first = max(int(np.searchsorted(self.stamps, stamp_ns, side='right')) - KEPT_BEFORE, 0)
        self.stamps, self.samples = self.stamps[first:], self.samples[first:]
