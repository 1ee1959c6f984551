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
"""What an alignment yields: its state, attitudes, epochs, events, the status."""

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

from ins_align.geometry.rotation import Array, quaternion_from_matrix, roll_pitch_yaw
import numpy as np


class State(str, Enum):
    """State of an alignment."""

    WAITING_FOR_IMU = 'WAITING_FOR_IMU'
    WAITING_FOR_GNSS = 'WAITING_FOR_GNSS'
    ALIGNING = 'ALIGNING'
    LEVELLED = 'LEVELLED'
    ALIGNED = 'ALIGNED'
    FAULT = 'FAULT'


@dataclass(frozen=True)
class Verdict:
    """State and the reason for it."""

    state: State
    reason: str


class Severity(Enum):
    """How a log shows an event."""

    INFO = 'info'
    WARNING = 'warning'
    ERROR = 'error'


class Event(NamedTuple):
    """A sentence worth a log line."""

    severity: Severity
    text: str


@dataclass(frozen=True)
class Attitude:
    """
    An attitude of the IMU frame in ENU.

    Attributes
    ----------
    stamp_ns : int
    C_nb : ndarray, shape (3, 3)
        Body to ENU.
    covariance : ndarray, shape (3, 3)
        Of the small rotation about the axes of ENU, rad^2.

    """

    stamp_ns: int
    C_nb: Array
    covariance: Array

    @cached_property
    def quaternion_xyzw(self) -> Array:
        """Body to ENU, w >= 0, shape (4,)."""
        return quaternion_from_matrix(self.C_nb)

    @cached_property
    def _rpy_deg(self) -> list[float]:
        return list(np.degrees(roll_pitch_yaw(self.C_nb)).tolist())

    @property
    def roll_deg(self) -> float:
        """Roll, degrees."""
        return self._rpy_deg[0]

    @property
    def pitch_deg(self) -> float:
        """Pitch, degrees; nose down is positive (REP-103)."""
        return self._rpy_deg[1]

    @property
    def yaw_deg(self) -> float:
        """Heading as yaw: degrees counter-clockwise from east."""
        return self._rpy_deg[2]

    @property
    def heading_deg(self) -> float:
        """Heading as a compass has it: degrees clockwise from true north, 0 to 360."""
        return (90.0 - self.yaw_deg) % 360.0

    @property
    def sigma_deg(self) -> Array:
        """One sigma about east, north, up, degrees, shape (3,)."""
        return np.degrees(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Epoch:
    """
    What came of an epoch.

    Attributes
    ----------
    stamp_ns : int
    t_s : float
        Seconds since the first t0.
    state : State
    initial, current : Attitude or None
    innovation : ndarray, shape (3,)
        East, north, up: what the measured velocity (or position, where only that is used) did not
        agree with the estimate before it, over its sigma; nan where nothing was tested.
    gyro_bias, accel_bias : ndarray, shape (3,)
        rad/s, m/s^2.
    dry : bool
        Whether it is without GNSS, on the way through an outage.

    """

    stamp_ns: int
    t_s: float
    state: State
    initial: Attitude | None
    current: Attitude | None
    innovation: Array
    gyro_bias: Array
    accel_bias: Array
    dry: bool = False


@dataclass(frozen=True)
class Nuisance:
    """
    Estimates beside the attitude, with their sigmas.

    Attributes
    ----------
    gyro_bias, accel_bias, lever_arm : ndarray, shape (3,)
        At the last epoch, rad/s; m/s^2; IMU to antenna in the IMU frame, m.
    gyro_bias_std, accel_bias_std, lever_arm_std : ndarray, shape (3,)
        So they are of each.
    gnss_delay, gnss_delay_std : float
        Of the GNSS behind its stamps, s.

    """

    gyro_bias: Array
    gyro_bias_std: Array
    accel_bias: Array
    accel_bias_std: Array
    lever_arm: Array
    lever_arm_std: Array
    gnss_delay: float
    gnss_delay_std: float


@dataclass(frozen=True)
class Status:
    """The aligner's state in numbers; see the attributes' names and units."""

    state: State
    reason: str
    stamp_ns: int | None
    t0_ns: int | None
    time_to_align_s: float | None
    initial: Attitude | None
    current: Attitude | None
    gyro_bias: Array
    gyro_bias_std: Array
    accel_bias: Array
    accel_bias_std: Array
    lever_arm: Array
    lever_arm_std: Array
    gnss_delay: float
    gnss_delay_std: float
    counts: dict[str, int]
