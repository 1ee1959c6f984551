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
"""A status as diagnostics have it: its level, and names with values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from ins_align.mounting import base_attitude, Mounting
from ins_align.results import State, Status
import numpy as np

OK, WARN, ERROR = range(3)  # diagnostic_msgs/DiagnosticStatus


def level_of(state: State) -> int:
    """Return the level of a state."""
    return {State.ALIGNED: OK, State.FAULT: ERROR}.get(state, WARN)


def status_values(status: Status) -> Iterator[tuple[str, str]]:
    """List what a status says as names and values, angles in degrees."""
    yield 'state', status.state.value
    yield 'reason', status.reason
    for name, value in (('stamp_ns', status.stamp_ns), ('t0_ns', status.t0_ns)):
        yield name, '' if value is None else str(value)
    yield 'time_to_align_s', _text(status.time_to_align_s)
    for name, attitude in (('initial', status.initial), ('current', status.current)):
        angles = sigma = None
        if attitude is not None:
            angles = attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg
            sigma = attitude.sigma_deg
        yield f'{name}_roll_pitch_yaw_deg', _text(angles)
        yield f'{name}_sigma_east_north_up_deg', _text(sigma)
    yield 'current_heading_deg', _text(
        None if status.current is None else status.current.heading_deg)
    for name, estimate, sigma, unit in (
            ('gyro_bias', status.gyro_bias, status.gyro_bias_std, 'rad_s'),
            ('accel_bias', status.accel_bias, status.accel_bias_std, 'm_s2'),
            ('lever_arm', status.lever_arm, status.lever_arm_std, 'm'),
            ('gnss_delay', status.gnss_delay, status.gnss_delay_std, 's')):
        yield f'{name}_{unit}', _text(estimate)
        yield f'{name}_std_{unit}', _text(sigma)
    for name, count in status.counts.items():
        yield name, str(count)


def base_values(status: Status, mounting: Mounting | None) -> Iterator[tuple[str, str]]:
    """List the attitude of the configured base like `status_values`."""
    if mounting is None or not mounting.config.base_frame:
        return
    yield 'base_frame', mounting.config.base_frame
    for name, attitude in (('initial', status.initial), ('current', status.current)):
        base = base_attitude(attitude, mounting.base)
        yield f'base_{name}_roll_pitch_yaw_deg', _text(
            None if base is None else (base.roll_deg, base.pitch_deg, base.yaw_deg))


def _text(value: float | Sequence[float] | np.ndarray | None) -> str:
    """Write a number or several; nothing where nothing is known."""
    if value is None:
        return ''
    return ' '.join(f'{number:.6g}' for number in np.atleast_1d(value))
