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
"""Checks that need no alignment: units of the IMU, velocity against position."""

import math

from ins_align.earth import ecef_from_lla, matrix_en
from ins_align.rotation import Array
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


class ForceCheck:
    """Whether the magnitude of the specific force can be one in m/s^2."""

    def __init__(self) -> None:
        """Start with no samples."""
        self._sum = 0.0
        self._count = 0
        self.fault = ''

    def add(self, f: Array) -> None:
        """Take samples, shape (N, 3)."""
        self._sum += float(np.sum(np.sqrt(np.sum(f * f, axis=1))))
        self._count += f.shape[0]
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
        self._anchor: Array | None = None
        self._C_ne = np.eye(3)
        self._travelled = np.zeros(3)
        self._far = False
        self._last: tuple[float, Array] | None = None
        self.bad_in_a_row = 0
        self._as_ned_in_a_row = 0

    def add(self, time: float, latitude: float, longitude: float, altitude: float,
            v_n: Array, position_std: float) -> None:
        """Take an epoch that has both; seconds, radians, metres, ENU."""
        r_e = ecef_from_lla(latitude, longitude, altitude)
        if self._last is not None and 0 < time - self._last[0] < 2.5:
            self._travelled = self._travelled + (time - self._last[0]) / 2 * (v_n + self._last[1])
        else:
            self._anchor = None
        self._last = time, v_n
        if self._anchor is None:
            self._restart(r_e, latitude, longitude)
            return
        moved = (self._C_ne @ (r_e - self._anchor))[:2]
        travelled = self._travelled[:2]
        distance = max(math.hypot(*moved), math.hypot(*travelled))
        far, before = distance >= max(MIN_DISTANCE, DISTANCE_SIGMAS * position_std), self._far
        self._far = far
        if not (far and before):              # a single bad fix is no journey
            return
        bad = math.hypot(*(moved - travelled)) > MAX_MISMATCH * distance
        as_ned = math.hypot(*(moved - travelled[::-1])) < MAX_MISMATCH * distance
        self.bad_in_a_row = self.bad_in_a_row + 1 if bad else 0
        self._as_ned_in_a_row = self._as_ned_in_a_row + 1 if bad and as_ned else 0
        self._restart(r_e, latitude, longitude)

    def _restart(self, r_e: Array, latitude: float, longitude: float) -> None:
        self._anchor, self._travelled, self._far = r_e, np.zeros(3), False
        self._C_ne = matrix_en(latitude, longitude).T

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
