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
"""The place of the GNSS antenna: paired GNSS messages become the epochs that a method takes."""

from __future__ import annotations

from collections import Counter, deque
import math

from ins_align.config import Config
from ins_align.geometry.earth import (
    dead_reckon, enu_offset, GRAVITY_EQUATOR, Place, SEMI_MAJOR_AXIS)
from ins_align.geometry.rotation import Array
from ins_align.gnss.buffer import GnssEpoch
from ins_align.gnss.messages import AntennaEpoch, Fix, UNKNOWN_ALTITUDE_STD
from ins_align.gnss.motion import least_distance, SHARP_STD
import numpy as np

# A fix further from the predicted place than this (m), and as much again for every second since
# the last fix, is not believed until there are this many in a row.
MAX_FIX_JUMP = 300.0
FIX_JUMPS_BELIEVED = 5
# A place older than this (s) is not carried on with the velocity.
MAX_CARRIED = 60.0
_UNKNOWN_VERTICAL_STD = 1e3     # m/s
# A variance this many times smaller than the usual one, the median of this many epochs or the
# configured one if that is less, is not believed: a receiver that is ten times better repeats it.
# In the first epoch 1 mm (1 mm/s) and more is believed.
BETTER_THAN_USUAL, USUAL_EPOCHS = 100.0, 11
BEST_VARIANCE = 1e-6
# Receivers that are slower than this (m/s) hold their course: where the speed changes, by more
# than this (m/s), and the course does not (rad), a velocity is wrong by as much as itself, or this
# (m/s).
SLOW, OTHER_SPEED, SAME_COURSE, LEAST_HELD = 1.5, 1e-3, math.radians(0.02), 0.3
# Velocity and position are compared over `least_distance`, and at least so many sigmas.
DISTANCE_SIGMAS = 8.0
# A mismatch of more than this share of the distance is not noise, if this many fixes in a row
# agree to within it. This many mismatches in a row are a fault, and fewer where all would fit with
# east and north exchanged.
MAX_MISMATCH, AGREEING = 0.5, 3
FAULT_MISMATCHES, FAULT_MISMATCHES_AS_NED = 4, 3


class Antenna:
    """Follows the antenna from epoch to epoch, and counts what is not believed."""

    def __init__(self, config: Config, counts: Counter[str]) -> None:
        self._config = config
        self._counts = counts
        self._place: Place | None = None
        self._altitude_known = False
        # Stamps of the place, of the last fix believed, and of the last epoch with a measurement.
        self._place_ns = self._fix_ns = self._measured_ns = 0
        self._v_n: Array | None = None  # the last velocity, unless it is too old
        self._velocity_ns = 0
        self._speed = 0.0
        self._jumps = 0     # in a row
        self._vertical = config.velocity_vertical == 'measured'
        self._vertical_seen = False     # whether a vertical velocity was ever other than 0
        self._check = VelocityCheck()
        self._velocity_noise = StatedNoise(
            config.velocity_std, config.velocity_std_vertical, _UNKNOWN_VERTICAL_STD, counts,
            'velocity_covariance')
        self._position_noise = StatedNoise(
            config.position_std, config.position_std_vertical, UNKNOWN_ALTITUDE_STD, counts,
            'fix_covariance')

    @property
    def jumped(self) -> bool:
        """Whether so many fixes in a row were far away that the antenna must be there."""
        return self._jumps >= FIX_JUMPS_BELIEVED

    def gravity_drift(self, stamp_ns: int) -> float:
        """
        Return the uncertainty of gravity since the last GNSS as a noise density, m/s/sqrt(s).

        The direction of gravity depends on the place. An unknown motion of v t turns it by
        v t / R, which adds g v t^2 / 2 R to the velocity: as much as white noise of this density.
        """
        silent = max(stamp_ns - self._measured_ns, 0) * 1e-9
        return GRAVITY_EQUATOR / SEMI_MAJOR_AXIS * self._speed * silent ** 1.5

    def epoch(self, message: GnssEpoch) -> AntennaEpoch | None:
        """Return the epoch of the antenna from GNSS messages; None while the place is unknown."""
        velocity, fix = message.velocity, message.fix
        v_n = None if velocity is None else np.asarray(velocity.velocity, float)
        if message.stamp_ns - self._velocity_ns > MAX_CARRIED * 1e9:
            self._v_n = None
        believed = self._locate(message.stamp_ns, fix, self._v_n if v_n is None else v_n)
        if self._place is None or self.jumped:
            return None
        position_covariance = self._position_noise.covariance(
            fix.covariance if fix is not None and believed else None,
            fix is None or fix.vertical)
        if v_n is not None or believed:
            self._measured_ns = message.stamp_ns
        held = 0.0 if v_n is None else self._held_variance(v_n)
        if v_n is not None:
            self._v_n, self._velocity_ns = v_n, message.stamp_ns
            self._speed = math.hypot(*v_n.tolist())
            self._look_for_vertical(v_n, velocity is not None and velocity.vertical)
            if believed:
                variances = position_covariance.diagonal().tolist()
                self._check.add(message.stamp_ns * 1e-9, self._place, v_n,
                                math.sqrt(max(variances[:2])))
        velocity_covariance = self._velocity_noise.covariance(
            None if velocity is None else velocity.covariance,
            self._vertical and (velocity is None or velocity.vertical))
        if held:
            self._counts['velocity_course_held'] += 1
            velocity_covariance = velocity_covariance + np.diag([held, held, 0.0])
        return AntennaEpoch(message.stamp_ns, *self._place, v_n, believed,
                            (velocity_covariance, position_covariance),
                            self.gravity_drift(message.stamp_ns),
                            fault='' if self._v_n is None else self._check.fault,
                            dry=fix is None and velocity is None,
                            stated=(velocity is None or velocity.covariance is not None
                                    or held > 0.0,
                                    fix is None or fix.covariance is not None))

    def _held_variance(self, v_n: Array) -> float:
        """Return the variance of a slow velocity that repeats the course, or 0; m^2/s^2."""
        if self._v_n is None:
            return 0.0
        before, now = (complex(*velocity[:2].tolist()) for velocity in (self._v_n, v_n))
        turned = before.conjugate() * now
        if (abs(turned.imag) < SAME_COURSE * turned.real and abs(now) < SLOW
                and abs(abs(now) - abs(before)) > OTHER_SPEED):
            return max(float(v_n[:2] @ v_n[:2]), LEAST_HELD ** 2)
        return 0.0

    def _look_for_vertical(self, v_n: Array, measured: bool) -> None:
        """Detect a receiver that does not measure the vertical: it moves and states only 0."""
        east, north, up = v_n.tolist()
        if not measured:
            self._counts['velocity_no_vertical'] += 1
        elif up != 0.0:
            self._vertical_seen = True
            self._vertical = self._config.velocity_vertical == 'measured'
        elif not self._vertical_seen and (east != 0.0 or north != 0.0):
            self._vertical = False
            self._counts['velocity_no_vertical'] += 1

    def _locate(self, stamp_ns: int, fix: Fix | None, v_n: Array | None) -> bool:
        """Carry the place on to an epoch; return whether there is a fix that is believed."""
        dt = (stamp_ns - self._place_ns) * 1e-9
        if (fix is not None and fix.vertical and self._place is not None
                and not self._altitude_known):
            self._place = (*self._place[:2], fix.altitude_m)
        predicted = self._place
        if predicted is not None and v_n is not None and dt < MAX_CARRIED:
            predicted = dead_reckon(predicted, v_n, dt)
        if fix is not None:
            place = (math.radians(fix.latitude_deg), math.radians(fix.longitude_deg),
                     fix.altitude_m if fix.vertical or predicted is None else predicted[2])
            silent = (stamp_ns - self._fix_ns) * 1e-9
            if (predicted is None
                    or math.hypot(*enu_offset(predicted, place)) <= MAX_FIX_JUMP * (1 + silent)):
                self._jumps = 0
                self._altitude_known |= fix.vertical
                if self._place is not None and v_n is None and dt > 0:
                    self._speed = math.hypot(*enu_offset(self._place, place)) / dt
                self._place, self._place_ns, self._fix_ns = place, stamp_ns, stamp_ns
                return True
            self._counts['fix_jump'] += 1
            self._jumps += 1
        if predicted is not None:
            self._place, self._place_ns = predicted, stamp_ns
        return False


class StatedNoise:
    """
    Covariances of a receiver: those stated, as far as they are believed, or those configured.

    `std` and `std_vertical` are the configured sigmas, for messages without a covariance;
    `unknown_std` is that of a vertical that is not measured. `counter` is the name that counts
    covariances which are not believed.
    """

    def __init__(self, std: float, std_vertical: float, unknown_std: float, counts: Counter[str],
                 counter: str) -> None:
        self._default = np.diag([std ** 2, std ** 2, std_vertical ** 2])
        self._unknown_variance = unknown_std ** 2
        self._counts, self._counter = counts, counter
        self._recent: list[deque[float]] = [deque(maxlen=USUAL_EPOCHS) for _ in range(3)]

    def covariance(self, stated: Array | None, vertical: bool = True) -> Array:
        """Return the covariance to use, (3, 3), ENU; `vertical`: the vertical is measured."""
        covariance = self._default if stated is None else self._believed(stated)
        if not vertical:
            covariance = covariance.copy()
            covariance[2, :2] = covariance[:2, 2] = 0.0
            covariance[2, 2] = self._unknown_variance
        return covariance

    def _believed(self, covariance: Array) -> Array:
        """Return a stated covariance with variances that are too small replaced by usual ones."""
        factors = []
        for variance, recent, default in zip(covariance.diagonal().tolist(), self._recent,
                                             self._default.diagonal().tolist()):
            recent.append(variance)
            usual = default
            if (default > BETTER_THAN_USUAL * variance
                    and (len(recent) > 1 or variance >= BEST_VARIANCE)):
                usual = min(sorted(recent)[len(recent) // 2], default)
            factors.append(usual / variance if usual > BETTER_THAN_USUAL * variance else 1.0)
        if max(factors) == 1.0:
            return covariance
        self._counts[self._counter] += 1
        scale = np.sqrt(factors)
        return covariance * scale * scale[:, None]


class VelocityCheck:
    """Checks the frame and the axes of the velocity against the change of position."""

    def __init__(self) -> None:
        self._origin: Place | None = None
        # Horizontal vectors are complex numbers: east is the real part, north the imaginary one.
        self._path = 0j                     # integral of the velocity since the origin
        # Position, path and time since the origin: at the latest epochs, and where the distance
        # begins.
        self._recent: deque[tuple[complex, complex, float]] = deque(maxlen=AGREEING)
        self._anchor: tuple[complex, complex, float] | None = None
        self._last: tuple[float, complex] | None = None     # time and velocity
        self._bad_in_a_row = self._as_ned_in_a_row = 0

    def add(self, time: float, place: Place, v_n: Array, position_std: float) -> None:
        """Take an epoch with position and velocity (ENU); seconds, radians, metres."""
        velocity = complex(*v_n[:2].tolist())
        if self._last is not None and 0 < time - self._last[0] < 2.5:
            self._path += (time - self._last[0]) / 2 * (self._last[1] + velocity)
        else:
            self._origin = None
        self._last = time, velocity
        if self._origin is None:
            self._origin, self._path, self._anchor = place, 0j, None
            self._recent.clear()
        self._recent.append((complex(*enu_offset(self._origin, place)[:2]), self._path, time))
        if len(self._recent) < AGREEING:
            return
        here = self._recent[AGREEING // 2]
        if self._anchor is None:
            self._anchor = here
            return
        moved, travelled = here[0] - self._anchor[0], here[1] - self._anchor[1]
        distance = max(abs(moved), abs(travelled))
        least = least_distance(here[2] - self._anchor[2], position_std <= SHARP_STD)
        tolerance = MAX_MISMATCH * distance
        # A wild fix does not count as motion, and several of them do not agree.
        if (distance < max(least, DISTANCE_SIGMAS * position_std)
                or any(abs(other - here[0]) > tolerance for other, _, _ in self._recent)):
            return
        bad = abs(moved - travelled) > tolerance
        as_ned = abs(moved - 1j * travelled.conjugate()) < tolerance    # east and north exchanged
        self._origin = None                   # the next distance begins here
        if as_ned and not bad:
            return                            # towards north-east both frames are the same
        self._bad_in_a_row = self._bad_in_a_row + 1 if bad else 0
        self._as_ned_in_a_row = self._as_ned_in_a_row + 1 if as_ned else 0

    @property
    def fault(self) -> str:
        """Fault in words; '' when none is known."""
        if self._as_ned_in_a_row >= FAULT_MISMATCHES_AS_NED:
            return ('the GNSS velocity contradicts the change of position, and would fit it with '
                    'north and east exchanged: set velocity_frame to the other one (enu, ned)')
        if self._bad_in_a_row >= FAULT_MISMATCHES:
            return ('the GNSS velocity contradicts the change of position: check that it is given '
                    'in a world frame (velocity_frame) and in m/s')
        return ''
