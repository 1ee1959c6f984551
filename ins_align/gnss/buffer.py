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
"""The queue of GNSS messages: sorted by stamp, paired, those of no use counted by reason."""

from collections import Counter
from collections.abc import Callable
import math
from typing import NamedTuple

from ins_align.geometry.earth import dead_reckon
from ins_align.gnss.messages import Fix, NO_FIX, sound_covariance, usable, Velocity

# A GNSS stamp further than this (ns) ahead of the IMU is of another clock.
MAX_AHEAD_NS = 10_000_000_000
MAX_PENDING = 10_000
# A fix and a velocity that are no further apart than this (ns) are of one epoch: many drivers
# stamp each message when it arrives.
PAIR_NS = 50_000_000
STATUS_UNKNOWN = -2
# A receiver without a fix has no valid velocity, even if it sends one: velocities are ignored
# until the next fix, or for this long (ns).
NO_FIX_NS = 2_000_000_000


class GnssEpoch(NamedTuple):
    """The fix and the velocity of one stamp."""

    stamp_ns: int
    fix: Fix | None = None
    velocity: Velocity | None = None

    @property
    def is_half(self) -> bool:
        """Whether there is a fix alone or a velocity alone."""
        return (self.fix is None) != (self.velocity is None)


class GnssBuffer:
    """
    GNSS messages that are not used yet, by stamp, from which `delay_ns` is taken off.

    `counts` counts them, and also epochs that only repeat the one before or are later than the
    last IMU sample, and velocities of a receiver without a fix. `watch` is called with each
    message, why it cannot be used ('' if it can), and how far it is behind the IMU, ns.
    """

    def __init__(self, lateness_ns: int, counts: Counter[str], delay_ns: int = 0,
                 watch: Callable[[Fix | Velocity, str, int], None] | None = None) -> None:
        self._delay_ns, self._lateness_ns = delay_ns, lateness_ns
        self._ahead_ns = MAX_AHEAD_NS + max(-delay_ns, 0)
        self._counts = counts
        self._watch = watch
        self._pending: dict[int, GnssEpoch] = {}
        self._last_values: tuple[float, ...] = ()   # position and velocity of the last epoch
        # Stamp of the last message without a fix; None: there was a fix since.
        self._no_fix_ns: int | None = None
        # How far the last late or early message was from the newest IMU sample, by its count.
        self.off_ns: dict[str, int] = {}

    def add(self, message: Fix | Velocity, imu_newest_ns: int | None) -> None:
        """Add a message to the epoch of its stamp, if usable and the first of its kind there."""
        kind = 'fix' if isinstance(message, Fix) else 'velocity'
        self._counts[kind] += 1
        stamp_ns = message.stamp_ns - self._delay_ns
        message, fault = usable(message._replace(stamp_ns=stamp_ns))
        behind_ns = 0 if imu_newest_ns is None else imu_newest_ns - stamp_ns
        if self._watch is not None:
            self._watch(message, fault, behind_ns)
        off = behind_ns > self._lateness_ns or behind_ns < -self._ahead_ns
        if fault:
            self._counts[f'{kind}_{fault}'] += 1
            if fault == 'nan' or off:
                return
            message = Fix(stamp_ns, 0.0, 0.0, 0.0, None, NO_FIX)    # without its other numbers
        elif isinstance(message, Fix) and message.status == STATUS_UNKNOWN:
            self._counts['fix_status_unknown'] += 1
        if isinstance(message, Fix) and not message.vertical:
            self._counts['fix_no_altitude'] += 1
        if off:
            name = f'{kind}_late' if behind_ns > 0 else f'{kind}_ahead'
            self._counts[name] += 1
            self.off_ns[name] = abs(behind_ns)
            return
        if len(self._pending) >= MAX_PENDING:
            del self._pending[min(self._pending)]
            self._counts['gnss_overflow'] += 1
        epoch = self._pending.get(stamp_ns, GnssEpoch(stamp_ns))
        if getattr(epoch, kind) is None:
            message = message._replace(covariance=sound_covariance(message.covariance))
            self._pending[stamp_ns] = (epoch._replace(fix=message) if isinstance(message, Fix)
                                       else epoch._replace(velocity=message))
        elif not fault:
            self._counts[f'{kind}_duplicate'] += 1

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest message in the queue; None: it is empty."""
        return min(self._pending, default=None)

    def release(self, upto_ns: int, last: bool = False,
                due_ns: int | None = None) -> list[GnssEpoch]:
        """
        Return the epochs up to a stamp, in order, and remove them from the queue.

        No message up to `due_ns`, by default the stamp, can still come. A fix or a velocity alone
        waits while its other half may come, and so do all later ones. `last`: no more messages
        will come; those after the stamp are dropped.
        """
        due_ns = upto_ns if due_ns is None else due_ns
        stamps = sorted(self._pending)
        released = []
        place = 0
        while place < len(stamps) and stamps[place] <= upto_ns:
            paired_upto_ns = stamps[place] + PAIR_NS
            first, *close = (self._pending[stamp] for stamp in stamps[place:place + 2]
                             if stamp <= paired_upto_ns)
            epoch = _joined(first, *close)
            parts = [first] if epoch is first else [first, *close]
            half_may_come = not last and (
                parts[-1].stamp_ns > due_ns
                or (first.is_half and not close and paired_upto_ns > due_ns))
            if half_may_come or epoch.stamp_ns > upto_ns:
                break
            place += len(parts)
            fix = parts[0].fix or parts[-1].fix     # as it was sent, at its own stamp
            if fix is not None:
                self._no_fix_ns = epoch.stamp_ns if fix.status == NO_FIX else None
            if self._no_fix_ns is not None and epoch.stamp_ns - self._no_fix_ns <= NO_FIX_NS:
                if epoch.velocity is not None:
                    self._counts['velocity_no_fix'] += 1
            elif self._repeats(fix, epoch.velocity):
                self._counts['gnss_repeated'] += 1
            else:
                released.append(epoch)
        for stamp in stamps[:place]:
            del self._pending[stamp]
        if last:
            self._counts['gnss_after_imu'] += len(self._pending)
            self._pending.clear()
        return released

    def _repeats(self, fix: Fix | None, velocity: Velocity | None) -> bool:
        """Return whether a moving epoch is exactly the one before: a driver sends it again."""
        before, self._last_values = self._last_values, ()
        if fix is not None and velocity is not None:
            v_n = velocity.velocity.tolist()
            if any(v_n):
                self._last_values = fix.latitude_deg, fix.longitude_deg, fix.altitude_m, *v_n
        return bool(self._last_values) and self._last_values == before


def _joined(first: GnssEpoch, close: GnssEpoch | None = None) -> GnssEpoch:
    """Return a fix and a velocity as one epoch at the velocity's stamp; otherwise the first."""
    if close is None or not (first.is_half and close.is_half):
        return first
    fix, velocity = first.fix or close.fix, first.velocity or close.velocity
    if fix is None or velocity is None:
        return first
    latitude, longitude, altitude = dead_reckon(
        (math.radians(fix.latitude_deg), math.radians(fix.longitude_deg), fix.altitude_m),
        velocity.velocity, (velocity.stamp_ns - fix.stamp_ns) * 1e-9)
    return GnssEpoch(velocity.stamp_ns, fix._replace(
        stamp_ns=velocity.stamp_ns, latitude_deg=math.degrees(latitude),
        longitude_deg=math.degrees(longitude), altitude_m=altitude), velocity)
