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
What has arrived and is not used up yet: IMU samples and GNSS messages, put in order.

Messages arrive late, twice, out of order or broken. What cannot be used is counted by reason; an
epoch is released once the IMU is far enough ahead of it, so that results depend on what arrived
and not on when somebody looked.
"""

from collections import Counter, deque
from dataclasses import dataclass
import math

from ins_align.earth import carried
from ins_align.messages import Fix, Velocity
from ins_align.plausibility import IMU_BEFORE
from ins_align.rotation import Array
import numpy as np

# Beyond these no sensor measures; such values would overflow the integrals (rad/s, m/s^2, m/s, m).
MAX_RATE, MAX_ACCELERATION, MAX_SPEED, MAX_ALTITUDE = 200.0, 2000.0, 2000.0, 1e6
_LIMITS = np.repeat([MAX_RATE, MAX_ACCELERATION], 3)[:, None]
# The IMU may be silent for this long; then the attitude is lost and alignment starts over (ns).
MAX_GAP_NS = 500_000_000
# A GNSS stamp this far ahead of the IMU comes from another clock (ns).
MAX_AHEAD_NS = 10_000_000_000
MAX_PENDING = 10_000
# A fix and a velocity that are no further apart than this are of one epoch: many drivers stamp
# each message when it arrives (ns).
PAIR_NS = 50_000_000
NO_FIX, STATUS_UNKNOWN = -1, -2
# A receiver without a fix does not know its velocity either, whatever it sends: none is taken
# until the next fix, or for this long (ns).
NO_FIX_NS = 2_000_000_000
# IMU samples that are kept before those wanted: interpolation needs two, the checks the rest.
KEPT_BEFORE = 2 + IMU_BEFORE
# So many IMU samples in a row that go in order, behind the newest one, through a time that others
# have gone through before them: not late, but of a clock that was set back.
SET_BACK_SAMPLES = 8


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

    """

    def __init__(self, lateness_ns: int, counts: Counter[str]) -> None:
        """Start empty."""
        self._lateness_ns = lateness_ns
        self._reach_ns = max(lateness_ns, MAX_GAP_NS)
        self._counts = counts
        self.stamps = np.zeros(0, np.int64)
        # In Fortran order, so that each axis of a sensor is contiguous in memory.
        self.samples = np.zeros((0, 6), order='F')
        self._new_stamps: list[int] = []
        self._new_samples: list[tuple[float, ...]] = []
        self._new_arrays: list[tuple[np.ndarray, Array, Array]] = []
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
            if stamp_ns >= ahead[0] - self._lateness_ns:
                self._append(*ahead)
            else:
                self._counts['imu_ahead'] += 1
        if self.newest_ns is not None and stamp_ns > self.newest_ns + self._reach_ns:
            self._ahead = stamp_ns, gyro, accel
        else:
            self._append(stamp_ns, gyro, accel)

    def _append(self, stamp_ns: int, gyro: Array, accel: Array) -> None:
        newest = self.newest_ns
        if newest is not None and stamp_ns < newest - self._lateness_ns:
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
        self._new_stamps.append(stamp_ns)
        self._new_samples.append((*gyro, *accel))

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
        self._flatten()
        self._new_arrays.append((np.asarray(stamps_ns, np.int64), gyro, accel))
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

    def _flatten(self) -> None:
        """Turn single samples into an array."""
        if self._new_stamps:
            samples = np.array(self._new_samples, float)
            self._new_arrays.append((np.array(self._new_stamps, np.int64), samples[:, :3],
                                     samples[:, 3:]))
            self._new_stamps, self._new_samples = [], []

    def consolidate(self, last: bool = False) -> None:
        """
        Sort what is new into the arrays, without what is broken, late or there twice.

        `last`: nothing comes any more.
        """
        if last and self._ahead is not None:
            self._counts['imu_ahead'] += 1
            self._ahead = None
        self._flatten()
        if not self._new_arrays:
            return
        stamps, gyro, accel = map(np.concatenate, zip(*self._new_arrays))
        samples = np.concatenate([gyro.T, accel.T])
        self._new_arrays = []
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

    def forget_before(self, stamp_ns: int) -> None:
        """Drop samples before `stamp_ns`, but for those that are still looked at."""
        first = max(int(np.searchsorted(self.stamps, stamp_ns, side='right')) - KEPT_BEFORE, 0)
        self.stamps, self.samples = self.stamps[first:], self.samples[first:]


def fault_of_fix(fix: Fix) -> str:
    """Return what a fix that cannot be used is counted as: ``no_fix``, ``nan``, or ''."""
    fix = with_an_altitude(fix)
    position = fix.latitude_deg, fix.longitude_deg, fix.altitude_m
    if fix.status == NO_FIX or position[:2] == (0.0, 0.0):
        return 'no_fix'
    return '' if (all(map(math.isfinite, position)) and abs(fix.latitude_deg) <= 90.0
                  and abs(fix.longitude_deg) <= 360.0
                  and abs(fix.altitude_m) < MAX_ALTITUDE) else 'nan'


def with_an_altitude(fix: Fix) -> Fix:
    """Return a fix whose altitude is 0, and not measured, where it is nan: in a 2D fix."""
    return fix._replace(altitude_m=0.0, vertical=False) if math.isnan(fix.altitude_m) else fix


def usable_velocity(velocity: Velocity) -> Velocity | None:
    """Return what can be used of a velocity, without its vertical where that is nan."""
    east, north, up = velocity.velocity.tolist()
    if math.isnan(up):
        up = 0.0
        velocity = velocity._replace(velocity=np.array([east, north, up]), vertical=False)
    return velocity if all(abs(value) < MAX_SPEED for value in (east, north, up)) else None


@dataclass
class GnssEpoch:
    """What the receiver said at one stamp."""

    stamp_ns: int
    fix: Fix | None = None
    velocity: Velocity | None = None

    @property
    def is_half(self) -> bool:
        """Whether there is a fix or a velocity alone."""
        return (self.fix is None) != (self.velocity is None)

    def with_other_half(self, other: 'GnssEpoch') -> 'GnssEpoch | None':
        """Join a fix and a velocity at the velocity's stamp; None if that is not what they are."""
        fix, velocity = self.fix or other.fix, self.velocity or other.velocity
        if fix is None or velocity is None or not (self.is_half and other.is_half):
            return None
        latitude, longitude, altitude = carried(
            (math.radians(fix.latitude_deg), math.radians(fix.longitude_deg), fix.altitude_m),
            velocity.velocity, (velocity.stamp_ns - fix.stamp_ns) * 1e-9)
        return GnssEpoch(velocity.stamp_ns, fix._replace(
            stamp_ns=velocity.stamp_ns, latitude_deg=math.degrees(latitude),
            longitude_deg=math.degrees(longitude), altitude_m=altitude), velocity)


class GnssBuffer:
    """
    GNSS messages that are not used yet, by stamp.

    Parameters
    ----------
    lateness_ns : int
        How much later than newer IMU samples a message may arrive.
    counts : Counter
        Where messages are counted, and epochs that only repeat the one before
        (``gnss_repeated``) or are behind the end of the IMU (``gnss_after_imu``), and velocities
        of a receiver that has no fix (``velocity_no_fix``).
    pair_ns : int
        A fix and a velocity that are no further apart are of one epoch; 0: where the stamp is one.

    Attributes
    ----------
    off_ns : dict
        Of ``fix_late``, ``fix_ahead``, ``velocity_late``, ``velocity_ahead``: how far from the
        newest IMU sample the last one was.

    """

    def __init__(self, lateness_ns: int, counts: Counter[str], pair_ns: int = 0) -> None:
        """Start empty."""
        self._lateness_ns = lateness_ns
        self._counts = counts
        self._pair_ns = pair_ns
        self._pending: dict[int, GnssEpoch] = {}
        self._said: tuple[float, ...] = ()          # position and velocity, released last
        self._fix_ns = -(1 << 62)                   # the last fix that was released
        self._no_fix_ns: deque[int] = deque(maxlen=MAX_PENDING)
        self.off_ns: dict[str, int] = {}

    def add_fix(self, fix: Fix, imu_newest_ns: int | None) -> None:
        """Take a position, or count why not."""
        self._counts['fix'] += 1
        fix = with_an_altitude(fix)
        if fault := fault_of_fix(fix):
            self._counts[f'fix_{fault}'] += 1
            if fault == 'no_fix' and not self._off(fix.stamp_ns, imu_newest_ns):
                self._no_fix_ns.append(fix.stamp_ns)
        else:
            if fix.status == STATUS_UNKNOWN:
                self._counts['fix_status_unknown'] += 1
            if not fix.vertical:
                self._counts['fix_no_altitude'] += 1
            epoch = self._epoch(fix.stamp_ns, imu_newest_ns, 'fix')
            if epoch is not None and epoch.fix is None:
                epoch.fix = fix
            elif epoch is not None:
                self._counts['fix_duplicate'] += 1

    def add_velocity(self, velocity: Velocity, imu_newest_ns: int | None) -> None:
        """Take a velocity, or count why not."""
        self._counts['velocity'] += 1
        usable = usable_velocity(velocity)
        if usable is None:
            self._counts['velocity_nan'] += 1
            return
        velocity = usable
        epoch = self._epoch(velocity.stamp_ns, imu_newest_ns, 'velocity')
        if epoch is not None and epoch.velocity is None:
            epoch.velocity = velocity
        elif epoch is not None:
            self._counts['velocity_duplicate'] += 1

    def _off(self, stamp_ns: int, imu_newest_ns: int | None) -> str:
        """Return how a stamp is too far from the IMU to be used: ``late``, ``ahead`` or ''."""
        if imu_newest_ns is None:
            return ''
        if stamp_ns < imu_newest_ns - self._lateness_ns:
            return 'late'
        return 'ahead' if stamp_ns > imu_newest_ns + MAX_AHEAD_NS else ''

    def _epoch(self, stamp_ns: int, imu_newest_ns: int | None, kind: str) -> GnssEpoch | None:
        """Return the pending epoch of a stamp; None and a count when it cannot be used."""
        off = self._off(stamp_ns, imu_newest_ns)
        if imu_newest_ns is not None and off:
            reason = f'{kind}_{off}'
            self._counts[reason] += 1
            self.off_ns[reason] = abs(stamp_ns - imu_newest_ns)
            return None
        if len(self._pending) >= MAX_PENDING:
            oldest = min(self._pending)
            del self._pending[oldest]
            self._counts['gnss_overflow'] += 1
        return self._pending.setdefault(stamp_ns, GnssEpoch(stamp_ns))

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest message that waits."""
        return min(self._pending, default=None)

    def release(self, upto_ns: int, last: bool = False) -> list[GnssEpoch]:
        """
        Return and forget the epochs up to a stamp, in order.

        A fix or a velocity alone waits for its other half, if that may still come, and what is
        behind it waits too; `last`: nothing comes any more, what is behind that stamp is left out.
        """
        stamps = sorted(self._pending)
        released = []
        place = 0
        while place < len(stamps) and stamps[place] <= upto_ns:
            epoch = self._pending[stamps[place]]
            close = next((self._pending[stamp] for stamp in stamps[place + 1:place + 2]
                          if stamp <= epoch.stamp_ns + self._pair_ns), None)
            joint = None if close is None else epoch.with_other_half(close)
            half_may_come = (epoch.is_half and close is None and not last
                             and epoch.stamp_ns + self._pair_ns > upto_ns)
            if half_may_come or (joint is not None and joint.stamp_ns > upto_ns):
                break
            parts = [epoch] if close is None or joint is None else [epoch, close]
            place += len(parts)
            if any(part.fix for part in parts):
                self._fix_ns = epoch.stamp_ns
            if self._repeats(parts):
                self._counts['gnss_repeated'] += 1
            elif self._is_without_fix(joint or epoch):
                self._counts['velocity_no_fix'] += 1
            else:
                released.append(joint or epoch)
        for stamp in stamps[:place]:
            del self._pending[stamp]
        if self._no_fix_ns:
            self._no_fix_ns = deque((stamp for stamp in self._no_fix_ns
                                     if stamp > upto_ns - NO_FIX_NS), MAX_PENDING)
        if last:
            self._counts['gnss_after_imu'] += len(self._pending)
            self._pending.clear()
        return released

    def _is_without_fix(self, epoch: GnssEpoch) -> bool:
        """Whether an epoch is a velocity of a receiver that said last that it has no fix."""
        upto_ns = epoch.stamp_ns + self._pair_ns
        said_ns = max((stamp for stamp in self._no_fix_ns if stamp <= upto_ns),
                      default=self._fix_ns)
        return (epoch.fix is None and said_ns > self._fix_ns
                and epoch.stamp_ns - said_ns <= NO_FIX_NS)

    def _repeats(self, parts: list[GnssEpoch]) -> bool:
        """
        Whether an epoch says to the last bit what the one before said, and that it moves.

        No receiver measures that: a driver sends its last message again.
        """
        fix = next((part.fix for part in parts if part.fix), None)
        velocity = next((part.velocity for part in parts if part.velocity), None)
        before, self._said = self._said, ()
        if fix is not None and velocity is not None:
            v_n = velocity.velocity.tolist()
            if any(v_n):
                self._said = fix.latitude_deg, fix.longitude_deg, fix.altitude_m, *v_n
        return bool(self._said) and self._said == before
