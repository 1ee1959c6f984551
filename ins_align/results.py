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
"""Results of an alignment: state, attitudes, epochs, events, status; as JSON and table."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import dataclasses
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
import math
from typing import Any, NamedTuple, TYPE_CHECKING

from ins_align.config import Config
from ins_align.geometry.rotation import (
    Array, exp_so3, log_so3, matrix_from_quaternion, quaternion_from_matrix, roll_pitch_yaw,
    Transform)
import numpy as np

if TYPE_CHECKING:
    from ins_align.recordings.reader import Topics

OK, WARN, ERROR = range(3)  # levels of diagnostic_msgs/DiagnosticStatus
MAX_REFERENCE_GAP_NS = 1_500_000_000  # the reference is not interpolated over longer gaps

# Estimates other than the attitude, with the unit as written in names of outputs.
ESTIMATES = {'gyro_bias': 'rad_s', 'accel_bias': 'm_s2', 'lever_arm': 'm', 'gnss_delay': 's'}
# Properties of an attitude and of an epoch that also have topics of these names: angles for
# plots, and estimates in the axes of the IMU for those who start a filter of their own.
FOR_PLOTS = 'roll_pitch_yaw_deg', 'sigma_deg'
BIASES = 'gyro_bias', 'accel_bias'
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
    """Severity of an event in a log."""

    INFO = 'info'
    WARNING = 'warning'
    ERROR = 'error'


class Event(NamedTuple):
    """A sentence for the log."""

    severity: Severity
    text: str


@dataclass(frozen=True)
class Attitude:
    """An attitude of the IMU frame in ENU."""

    stamp_ns: int
    C_nb: Array  #: (3, 3), body to ENU
    covariance: Array  #: (3, 3), of the attitude error as a rotation about east, north, up, rad^2

    @cached_property
    def quaternion_xyzw(self) -> Array:
        """Quaternion, body to ENU, w >= 0, shape (4,)."""
        return quaternion_from_matrix(self.C_nb)

    @cached_property
    def roll_pitch_yaw_deg(self) -> list[float]:
        """Roll, pitch, yaw, degrees: pitch positive nose down, yaw counter-clockwise from east."""
        return list(np.degrees(roll_pitch_yaw(self.C_nb)).tolist())

    @property
    def roll_deg(self) -> float:
        """Roll, degrees."""
        return self.roll_pitch_yaw_deg[0]

    @property
    def pitch_deg(self) -> float:
        """Pitch, degrees, positive nose down (REP-103)."""
        return self.roll_pitch_yaw_deg[1]

    @property
    def yaw_deg(self) -> float:
        """Yaw, degrees counter-clockwise from east."""
        return self.roll_pitch_yaw_deg[2]

    @property
    def heading_deg(self) -> float:
        """Heading, degrees clockwise from true north, 0 to 360."""
        return (90.0 - self.yaw_deg) % 360.0

    @property
    def sigma_deg(self) -> Array:
        """One sigma about east, north, up, degrees, shape (3,)."""
        return np.degrees(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Epoch:
    """State and estimates after an epoch."""

    stamp_ns: int
    t_s: float  #: s since the first t0
    state: State
    initial: Attitude | None  #: at t0
    current: Attitude | None  #: at this epoch
    #: (3,), east, north, up: innovation of the velocity (of the position where only that is
    #: used) over its sigma; nan where nothing was tested.
    innovation: Array
    gyro_bias: Array  #: (3,), rad/s
    accel_bias: Array  #: (3,), m/s^2
    gyro_bias_std: Array  #: (3,), rad/s
    gyro_matrix: Array  #: (3, 3), see `Nuisance`
    dry: bool = False  #: whether the epoch has no measurement and only divides a GNSS outage
    reason: str = ''  #: why the state is as it is
    #: Why the alignment started over since the previous epoch; empty if it did not.
    started_over: str = ''


class Span(NamedTuple):
    """The first and last of consecutive epochs of one alignment in one state."""

    first: Epoch
    last: Epoch

    @property
    def reason(self) -> str:
        """Return why the span began: the reason for the state, after that of a restart."""
        return '; '.join(filter(None, [self.first.started_over, self.first.reason]))


@dataclass(frozen=True)
class Nuisance:
    """Estimates other than the attitude, at the last epoch, with their sigmas."""

    gyro_bias: Array  #: (3,), rad/s
    gyro_bias_std: Array
    #: (3, 3), scale factors and, beside the diagonal, misalignment of the gyros:
    #: true = measured - gyro_matrix @ measured - gyro_bias
    gyro_matrix: Array
    accel_bias: Array  #: (3,), m/s^2
    accel_bias_std: Array
    lever_arm: Array  #: (3,), IMU to antenna in the IMU frame, m
    lever_arm_std: Array
    gnss_delay: float  #: by which a measurement is older than its stamp, s
    gnss_delay_std: float

    @classmethod
    def configured(cls, config: Config) -> 'Nuisance':
        """Return what the configuration says, for use before the first epoch."""
        noise, zero = config.imu_noise, np.zeros(3)
        return cls(zero, np.full(3, noise.gyro_bias_std), np.zeros((3, 3)),
                   zero, np.full(3, noise.accel_bias_std),
                   np.array(config.lever_arm), np.full(3, config.lever_arm_std),
                   config.gnss_delay, config.gnss_delay_std)


@dataclass(frozen=True, kw_only=True)
class Status(Nuisance):
    """The state of an alignment, with its reason, attitudes, estimates and counts."""

    state: State
    reason: str
    stamp_ns: int | None
    t0_ns: int | None
    time_to_align_s: float | None
    initial: Attitude | None
    current: Attitude | None
    counts: dict[str, int]


class Reference:
    """
    The reference attitude of a recording, from parts of stamps, ns, and quaternions.

    Parts may be in any order. Of equal stamps the first counts.
    """

    def __init__(self, *parts: tuple[np.ndarray, np.ndarray]) -> None:
        stamps, quaternions = map(np.concatenate, zip(*parts))
        self._stamps_ns, first = np.unique(stamps, return_index=True)
        self._quaternions = quaternions[first]

    def attitude_at(self, stamp_ns: int) -> Array | None:
        """Return ``C_nb``, shape (3, 3), interpolated; None outside and in long gaps."""
        stamps_ns = self._stamps_ns
        after = int(np.searchsorted(stamps_ns, stamp_ns))
        if stamp_ns in stamps_ns[after:after + 1]:
            return matrix_from_quaternion(self._quaternions[after])
        if not 0 < after < len(stamps_ns):
            return None
        start, end = stamps_ns[after - 1:after + 1].tolist()
        if end - start > MAX_REFERENCE_GAP_NS:
            return None
        C_before, C_after = matrix_from_quaternion(self._quaternions[after - 1:after + 1])
        return exp_so3((stamp_ns - start) / (end - start) * log_so3(C_after @ C_before.T)) \
            @ C_before

    def errors_deg(self, attitude: Attitude) -> Array:
        """Return errors of roll, pitch, yaw, degrees, shape (3,); nan without a reference."""
        C_reference = self.attitude_at(attitude.stamp_ns)
        if C_reference is None:
            return np.full(3, np.nan)
        difference = roll_pitch_yaw(attitude.C_nb) - roll_pitch_yaw(C_reference)
        return np.degrees(np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi)


@dataclass(frozen=True, kw_only=True, repr=False)
class Result:
    """Result of an alignment of recorded data."""

    config: Config
    status: Status  #: at the end
    epochs: tuple[Epoch, ...]  #: including those that divide outages
    bag: str = ''  #: path of the recording; this and the following are empty for arrays
    warnings: tuple[str, ...] = ()
    reference: Reference | None = None
    topics: Topics | None = None
    #: (K, 3), usable fixes: stamp, ns; latitude and longitude, degrees.
    track: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def initial(self) -> Attitude | None:
        """Return the attitude at t0 as estimated at the end."""
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
        """Return the initial attitude as the node would publish it at the last declaration."""
        aligned = self.spans_of(State.ALIGNED)
        return aligned[-1].first.initial if aligned else None

    @cached_property
    def spans(self) -> list[Span]:
        """Return the sequence of states, with that of the final status if it differs."""
        status = self.status
        end = [dataclasses.replace(epoch, state=status.state, reason=status.reason,
                                   started_over='')
               for epoch in self.epochs[-1:] if epoch.state is not status.state]
        spans: list[Span] = []
        for epoch in (*self.epochs, *end):
            if spans and spans[-1].first.state is epoch.state and not epoch.started_over:
                spans[-1] = Span(spans[-1].first, epoch)
            else:
                spans.append(Span(epoch, epoch))
        return spans

    def spans_of(self, state: State) -> list[Span]:
        """Return the spans in a state."""
        return [span for span in self.spans if span.first.state is state]

    @property
    def state_in_words(self) -> str:
        """Return the final state and when ALIGNED was first declared, s since the first t0."""
        state, aligned = self.status.state.value, self.spans_of(State.ALIGNED)
        if not aligned:
            return state
        after = f'after {aligned[0].first.t_s:.1f} s'
        return (f'{state} {after}' if self.aligned and len(aligned) == 1 else
                f'{state} (first ALIGNED {after}, declarations: {len(aligned)})')

    def __repr__(self) -> str:
        now = self.current
        attitude = 'no attitude' if now is None else (
            f'roll {now.roll_deg:.2f}, pitch {now.pitch_deg:.2f}, '
            f'heading {now.heading_deg:.2f} +- {now.sigma_deg[2]:.2f} deg '
            f'(tilt +- {now.sigma_deg[:2].max():.2f} deg) at stamp {now.stamp_ns}')
        return f'Result({self.state_in_words}, {attitude}, {len(self.epochs)} epochs)'

    def t_s(self, attitude: Attitude) -> float:
        """Return the time of `initial`, `declared` or `current`, s since the first t0."""
        epoch = (self.spans_of(State.ALIGNED)[-1].first if attitude is self.declared
                 else self.epochs[-1])
        return epoch.t_s - (epoch.stamp_ns - attitude.stamp_ns) * 1e-9

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``--json`` writes; numbers that are not finite are None."""
        status = self.status
        content = {
            'bag': self.bag,
            'aligned': self.aligned,
            'state': status.state.value,
            'reason': status.reason,
            'changes': [{'stamp': span.first.stamp_ns, 't_s': span.first.t_s,
                         'state': span.first.state.value, 'reason': span.reason}
                        for span in self.spans],
            't0': status.t0_ns,
            'time_to_align_s': status.time_to_align_s,
            'initial_attitude': attitude_json(status.initial),
            'declared_attitude': attitude_json(self.declared, stamped=True),
            'final_attitude': attitude_json(status.current, stamped=True),
            **{f'{name}_{unit}': _finite(getattr(status, name))
               for name, unit in ESTIMATES.items()},
            'counts': dict(status.counts),
        }
        if self.topics is not None and self.config.base_frame:
            content['base_frame'] = self.config.base_frame
            for name, attitude in (('initial', status.initial), ('final', status.current)):
                content[f'base_{name}_attitude'] = attitude_json(
                    base_attitude(attitude, self.topics.base))
        return content

    def to_csv(self) -> str:
        """Return the table that ``--csv`` writes, with a row per GNSS epoch."""
        epochs = [epoch for epoch in self.epochs if not epoch.dry]
        rows = zip([f'{epoch.stamp_ns},{epoch.t_s:.9f},{epoch.state.value}' for epoch in epochs],
                   _attitude_cells([epoch.initial for epoch in epochs]),
                   _attitude_cells([epoch.current for epoch in epochs]))
        return '\n'.join([CSV_HEADER, *map(','.join, rows), ''])


def _attitude_cells(attitudes: Sequence[Attitude | None]) -> Iterator[str]:
    """Yield the cells of each attitude, empty where there is none; converts all at once."""
    unknown = np.full((2, 3, 3), np.nan)
    C_nb, covariances = np.array([
        unknown if each is None else (each.C_nb, each.covariance) for each in attitudes
    ]).reshape(-1, 2, 3, 3).swapaxes(0, 1)
    sigmas = np.degrees(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)))
    for numbers in np.hstack([quaternion_from_matrix(C_nb), sigmas]).tolist():
        yield ','.join(repr(number) if math.isfinite(number) else '' for number in numbers)


def in_order_of_time(epochs: Iterable[Epoch]) -> tuple[Epoch, ...]:
    """Return epochs whose `t_s` increases also where it begins anew after a clock was set back."""
    before_s = last_s = 0.0
    moved = []
    for epoch in epochs:
        if epoch.t_s < last_s:
            before_s += last_s
        last_s = epoch.t_s
        moved.append(dataclasses.replace(epoch, t_s=before_s + last_s))
    return tuple(moved)


def base_attitude(attitude: Attitude | None, base: Transform | None) -> Attitude | None:
    """Return the attitude of the base frame; None if the attitude or the base is unknown."""
    if attitude is None or base is None:
        return None
    return dataclasses.replace(attitude, C_nb=attitude.C_nb @ base.rotation)


def attitude_json(attitude: Attitude | None, stamped: bool = False) -> dict[str, Any] | None:
    """Return an attitude as ``--json`` writes it."""
    if attitude is None:
        return None
    return {**({'stamp': attitude.stamp_ns} if stamped else {}),
            **{name: _finite(getattr(attitude, name)) for name in (
                'quaternion_xyzw', 'roll_deg', 'pitch_deg', 'yaw_deg', 'sigma_deg')}}


def _finite(value: Any) -> Any:
    """Return a number or an array for JSON, with None for what is not finite."""
    if np.ndim(value):
        return [_finite(each) for each in value]
    return float(value) if math.isfinite(value) else None


def level_of(state: State) -> int:
    """Return the level of a state in `diagnostic_msgs`."""
    return {State.ALIGNED: OK, State.FAULT: ERROR}.get(state, WARN)


def status_values(status: Status, base_frame: str = '', base: Transform | None = None,
                  ) -> dict[str, str]:
    """Return a status, with the attitude of a base frame, as texts by name; angles in degrees."""
    values: dict[str, Any] = {
        'state': status.state.value, 'reason': status.reason, 'stamp_ns': status.stamp_ns,
        't0_ns': status.t0_ns, 'time_to_align_s': status.time_to_align_s}
    attitudes = ('initial', status.initial), ('current', status.current)
    for name, attitude in attitudes:
        values[f'{name}_roll_pitch_yaw_deg'] = attitude and attitude.roll_pitch_yaw_deg
        values[f'{name}_sigma_east_north_up_deg'] = attitude and attitude.sigma_deg
    values['current_heading_deg'] = status.current and status.current.heading_deg
    for name, unit in ESTIMATES.items():
        values[f'{name}_{unit}'] = getattr(status, name)
        values[f'{name}_std_{unit}'] = getattr(status, f'{name}_std')
    values.update(status.counts)
    if base_frame:
        values['base_frame'] = base_frame
        for name, attitude in attitudes:
            of_base = base_attitude(attitude, base)
            values[f'base_{name}_roll_pitch_yaw_deg'] = of_base and of_base.roll_pitch_yaw_deg
    return {name: _text(value) for name, value in values.items()}


def _text(value: Any) -> str:
    if value is None:
        return ''
    if isinstance(value, (str, int)):
        return str(value)
    return ' '.join(f'{number:.6g}' for number in np.atleast_1d(value))
