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

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
import io
import math
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.geometry.rotation import Array, quaternion_from_matrix, roll_pitch_yaw
import numpy as np

_ATTITUDE_COLUMNS = 'qx,qy,qz,qw,sigma_e_deg,sigma_n_deg,sigma_u_deg'
CSV_HEADER = 'stamp_ns,t_s,state,' + ','.join(
    prefix + name for prefix in ('', 'current_') for name in _ATTITUDE_COLUMNS.split(','))


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
    reason : str
        For the state.
    started_over : str
        Why the alignment started over since the epoch before; empty where it did not.

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
    reason: str = ''
    started_over: str = ''


class Change(NamedTuple):
    """An epoch with another state than the one before, or of an alignment that started over."""

    stamp_ns: int
    t_s: float
    state: State
    reason: str


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

    @classmethod
    def configured(cls, config: Config) -> 'Nuisance':
        """Return what is known before the first epoch."""
        noise, zero = config.imu_noise, np.zeros(3)
        return cls(zero, np.full(3, noise.gyro_bias_std), zero, np.full(3, noise.accel_bias_std),
                   np.array(config.lever_arm), np.full(3, config.lever_arm_std),
                   config.gnss_delay, config.gnss_delay_std)


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


@dataclass(frozen=True, kw_only=True)
class Result:
    """
    What came of an alignment of recorded data.

    Attributes
    ----------
    config : Config
    status : Status
        At the end.
    epochs : tuple of Epoch
        Those without GNSS, too.

    """

    config: Config
    status: Status
    epochs: tuple[Epoch, ...]

    @property
    def initial(self) -> Attitude | None:
        """Return the attitude at t0 as it is known at the end."""
        return self.status.initial

    @property
    def current(self) -> Attitude | None:
        """Return the attitude at the last epoch."""
        return self.status.current

    @property
    def aligned(self) -> bool:
        """Whether the recording ends with a declared alignment."""
        return self.status.state is State.ALIGNED

    @property
    def declared(self) -> Attitude | None:
        """Return the initial attitude as the node publishes it at the last declaration."""
        declared, before = None, None
        for epoch in self.epochs:
            if epoch.state is State.ALIGNED and before is not State.ALIGNED:
                declared = epoch.initial
            before = epoch.state
        return declared

    @property
    def changes(self) -> list[Change]:
        """Return the changes of the state, from the first epoch on, with their reasons."""
        changes, before = [], None
        for epoch in self.epochs:
            if epoch.state is not before or epoch.started_over:
                reason = '; '.join(filter(None, [epoch.started_over, epoch.reason]))
                changes.append(Change(epoch.stamp_ns, epoch.t_s, epoch.state, reason))
            before = epoch.state
        return changes

    @property
    def first_t0_ns(self) -> int | None:
        """Return the stamp from which `Epoch.t_s` is counted; None: there is no epoch."""
        if not self.epochs:
            return None
        return self.epochs[0].stamp_ns - round(self.epochs[0].t_s * 1e9)

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``--json`` writes; numbers that are not finite are None."""
        status = self.status
        return {
            'aligned': self.aligned,
            'state': status.state.value,
            'reason': status.reason,
            'changes': [{'stamp': change.stamp_ns, 't_s': change.t_s, 'state': change.state.value,
                         'reason': change.reason} for change in self.changes],
            't0': status.t0_ns,
            'time_to_align_s': status.time_to_align_s,
            'initial_attitude': attitude_json(status.initial),
            'declared_attitude': _stamped(self.declared),
            'final_attitude': _stamped(status.current),
            'gyro_bias_rad_s': _finite(status.gyro_bias),
            'accel_bias_m_s2': _finite(status.accel_bias),
            'lever_arm_m': _finite(status.lever_arm),
            'gnss_delay_s': _finite([status.gnss_delay])[0],
            'counts': dict(status.counts),
        }

    def to_csv(self) -> str:
        """Return the table that ``--csv`` writes, a row per GNSS epoch."""
        out = io.StringIO()
        out.write(CSV_HEADER + '\n')
        for epoch in self.epochs:
            if epoch.dry:
                continue
            cells = [str(epoch.stamp_ns), f'{epoch.t_s:.9f}', epoch.state.value]
            for attitude in (epoch.initial, epoch.current):
                numbers = [math.nan] * 7 if attitude is None else [
                    *attitude.quaternion_xyzw.tolist(), *attitude.sigma_deg.tolist()]
                cells += [repr(number) if math.isfinite(number) else '' for number in numbers]
            out.write(','.join(cells) + '\n')
        return out.getvalue()


def _stamped(attitude: Attitude | None) -> dict[str, Any] | None:
    values = attitude_json(attitude)
    if attitude is None or values is None:
        return None
    return {'stamp': attitude.stamp_ns, **values}


def attitude_json(attitude: Attitude | None) -> dict[str, Any] | None:
    """Return an attitude as ``--json`` writes it."""
    if attitude is None:
        return None
    roll, pitch, yaw = _finite([attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg])
    return {'quaternion_xyzw': _finite(attitude.quaternion_xyzw), 'roll_deg': roll,
            'pitch_deg': pitch, 'yaw_deg': yaw, 'sigma_deg': _finite(attitude.sigma_deg)}


def _finite(values: Iterable[float]) -> list[float | None]:
    """Return plain numbers as JSON has them: none that are not finite."""
    return [float(value) if math.isfinite(value) else None for value in values]
