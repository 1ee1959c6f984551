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
"""Checks of units, coordinates and clocks that need no alignment; they say what to change."""

from __future__ import annotations

from collections import deque
from dataclasses import fields, replace
import math

from ins_align.config import Config, STANDARD_GRAVITY
from ins_align.geometry.rotation import Array, cumulative_rotations, exp_so3, Index
from ins_align.gnss.buffer import MAX_AHEAD_NS
from ins_align.gnss.messages import Fix, numbers_of, Velocity
from ins_align.gnss.motion import (
    GRID, on_grid, Series, series_of_rows, track, velocity_frame, velocity_from_positions,
    VelocityFrame, without_wild_positions)
from ins_align.imu.buffer import MAX_ACCELERATION, MAX_RATE
from ins_align.results import State, Verdict
import numpy as np

ANY_GYRO_RATE = 70.0  # rad/s: usual gyroscopes measure at most 4000 deg/s, which is less
TOO_FAST_SHARE = 1e-3  # of the samples may exceed that, as spikes
# The specific force is summed over so many cells of GRID s; so many sums are needed to judge.
LENGTH_CELLS, MIN_LENGTHS = 20, 20
# Ratio of a sum's length to the expected one: the lower quartile is below the first where rates
# are wrong; of such sums, the median with the right rates is within the second of 1.
SHORTER, AS_LONG = 0.85, 0.15
MIN_MISFIT = 0.1  # by how much log(speed ratio) must be closer to 0 with exchanged positions
_MAXIMA = {field.name: field.metadata['maximum'] for field in fields(Config)}
MAX_LATENESS, MAX_DELAY = _MAXIMA['gnss_lateness'], _MAXIMA['gnss_delay']  # s
LATE_SHARE, MIN_LATE = 0.1, 10  # share and number of late GNSS messages that are reported
BEYOND_THE_POLES = 'latitudes are beyond the poles: they are exchanged with the longitudes'
CELLS, GNSS_MESSAGES = 600, 3000  # that are kept: the latest 5 minutes, at up to 10 Hz


def degrees_fault(too_fast: bool, times: Array, gyro: Array, accel: Array, velocities: Series,
                  ) -> str:
    """
    Return in words that the angular rates are in deg/s, or ''.

    They are if they are `too_fast`, or if the specific force shows it: rotated by the rates and
    integrated over some seconds, it is as long as the change of velocity less gravity, whatever
    the attitude and the axes are. Rates that are 57 times too large make it shorter.

    `times` are increasing, s, shape (N,); `gyro`, rad/s, and `accel`, m/s^2, are means over GRID s
    around them, shape (N, 3); `velocities` are as from `on_grid`.
    """
    if not too_fast:
        lengths = _lengths(times, gyro, accel, velocities)
        if not (lengths.size >= MIN_LENGTHS and np.quantile(lengths, 0.25) < SHORTER):
            return ''
        in_degrees = _lengths(times, np.radians(gyro), accel, velocities)
        # Only the sums that do not fit tell: where nothing turns, both units fit.
        if not abs(np.median(in_degrees[lengths < SHORTER]) - 1.0) < AS_LONG:
            return ''
    return 'the angular rates look like deg/s: they must be rad/s'


def _lengths(times: Array, gyro: Array, accel: Array, velocities: Series) -> Array:
    """Return ratios of the lengths of integrated specific force to the expected ones, (K,)."""
    if velocities.times.size < 2 or times.size <= LENGTH_CELLS:
        return np.zeros(0)
    f_b0 = cumulative_rotations(exp_so3(GRID * gyro)) @ accel[..., None]
    ends = times + 0.5 * GRID
    v_n = np.column_stack([np.interp(ends, velocities.times, v) for v in velocities.vectors.T])
    measured, expected = (sums[LENGTH_CELLS:] - sums[:-LENGTH_CELLS]
                          for sums in (np.cumsum(GRID * f_b0[..., 0], axis=0), v_n))
    seconds = ends[LENGTH_CELLS:] - ends[:-LENGTH_CELLS]
    good = ((seconds < GRID * (LENGTH_CELLS + 0.5)) & (ends[:-LENGTH_CELLS] > velocities.times[0])
            & (ends[LENGTH_CELLS:] < velocities.times[-1]))
    expected[:, 2] += STANDARD_GRAVITY * seconds
    return np.linalg.norm(measured[good], axis=1) / np.linalg.norm(expected[good], axis=1)


def exchange_fault(positions_deg: Series, velocities: Series) -> str:
    """
    Return in words that latitude and longitude are exchanged, or ''.

    Positions are latitude, longitude, degrees, and altitude, m; velocities, m/s, are taken as ENU.
    """
    vectors = positions_deg.vectors
    if vectors.shape[0] < 2 or np.abs(vectors[:, 1]).max() > 90.0:
        return ''

    def compared(order: list[int]) -> VelocityFrame:
        positions = track(Series(positions_deg.times, vectors[:, order]))
        return velocity_frame(velocities, without_wild_positions(positions))

    as_sent = compared([0, 1, 2])
    # Velocities in NED would fit the positions as they were sent, in length too.
    if (as_sent.frame in ('enu', 'unknown')
            or _misfit(as_sent) <= _misfit(compared([1, 0, 2])) + MIN_MISFIT):
        return ''
    return ('the GNSS velocity fits the change of position with latitude and longitude exchanged: '
            'they are exchanged in the positions')


def _misfit(frame: VelocityFrame) -> float:
    """Return the absolute log(speed ratio); infinite where no turn makes directions fit."""
    ratio = frame.speed_ratio if frame.frame in ('enu', 'ned', 'turned') else None
    return abs(math.log(ratio)) if ratio else math.inf


def beyond_the_poles(latitude_deg: float, longitude_deg: float) -> bool:
    """Whether a position is possible only with latitude and longitude exchanged."""
    return abs(longitude_deg) <= 90.0 < abs(latitude_deg) <= 180.0


def lateness_advice(lateness: float, delay: float = 0.0) -> tuple[str, str]:
    """
    Return advice for GNSS messages that are `lateness` s late, and the gnss_lateness to set.

    `delay`, s, is negative where gnss_delay corrects a clock that is behind.
    """
    other_delay = max(delay - lateness, -MAX_DELAY)
    value = f'{min(math.ceil(2.0 * lateness) / 2.0 + 0.5, MAX_LATENESS):g}'
    return (f'GNSS messages come up to {lateness:.1f} s later than newer IMU samples: set '
            f'gnss_lateness to {value}; if it is their clock that is behind, and not the '
            f'messages, set gnss_delay={other_delay:.1f} instead'), value


class InputChecks:
    """Checks messages of one clock as they arrive, in bounded memory."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._cells: dict[int, Array] = {}  # count, sums of rate and specific force, (7,)
        self._samples = self._too_fast = self._beyond_the_poles = 0
        self._late: deque[float] = deque(maxlen=10 * MIN_LATE)
        self._fixes: deque[tuple[float, ...]] = deque(maxlen=GNSS_MESSAGES)
        self._velocities: deque[tuple[float, ...]] = deque(maxlen=GNSS_MESSAGES)

    def add_gnss(self, message: Fix | Velocity, fault: str, behind_ns: int) -> None:
        """Take a message as a `GnssBuffer` shows it, its stamp less gnss_delay."""
        self._late.append(behind_ns * 1e-9 - max(self._config.gnss_delay, 0.0))
        if -behind_ns > MAX_AHEAD_NS:
            return  # of another clock
        numbers = numbers_of(message)
        if not fault:
            rows = self._velocities if isinstance(message, Velocity) else self._fixes
            rows.append((message.stamp_ns * 1e-9, *numbers))
        elif isinstance(message, Fix) and beyond_the_poles(*numbers[:2]):
            self._beyond_the_poles += 1

    def add_imu(self, stamps_ns: Index, samples: Array) -> None:
        """Take samples as an `ImuBuffer` shows them: stamps, ns, (N,); rad/s and m/s^2, (N, 6)."""
        rates, forces = np.abs(samples).reshape(-1, 2, 3).max(axis=2).T
        self._samples += stamps_ns.size
        self._too_fast += np.count_nonzero(rates > ANY_GYRO_RATE)
        good = (rates < 60.0 * MAX_RATE) & (forces < MAX_ACCELERATION)
        index, place = np.unique((stamps_ns[good] * 1e-9 / GRID).astype(np.int64),
                                 return_inverse=True)
        sums = np.zeros((index.size, 7))
        np.add.at(sums, place, np.column_stack([np.ones(place.size), samples[good]]))
        for cell, row in zip(index.tolist(), sums):
            self._cells[cell] = self._cells.get(cell, 0.0) + row
        while len(self._cells) > CELLS:
            del self._cells[next(iter(self._cells))]

    def judge(self, verdict: Verdict) -> Verdict:
        """Return a verdict with what is wrong, faults first."""
        if faults := self.faults():
            verdict = Verdict(State.FAULT, '; '.join(faults))
        return replace(verdict, reason='; '.join([verdict.reason, *self.late_messages()]))

    def faults(self) -> list[str]:
        """Return a sentence for each fault of units or coordinates."""
        fixes, velocities = map(series_of_rows, (self._fixes, self._velocities))
        motion = on_grid(velocities) if velocities.times.size > 1 else velocity_from_positions(
            track(fixes))
        cells = sorted(self._cells)
        sums = np.array([self._cells[cell] for cell in cells]).reshape(-1, 7)
        degrees = degrees_fault(
            self._too_fast > TOO_FAST_SHARE * self._samples, (np.array(cells) + 0.5) * GRID,
            *np.split(sums[:, 1:] / sums[:, :1], 2, axis=1), motion)
        exchanged = BEYOND_THE_POLES if self._beyond_the_poles > MIN_LATE else ''
        # Of late messages, positions and velocities may have different clocks.
        if not self.late_messages():
            exchanged = exchange_fault(fixes, velocities) or exchanged
        return [fault for fault in (degrees, exchanged) if fault]

    def late_messages(self) -> list[str]:
        """Return a sentence if GNSS messages come too late, else nothing."""
        late = [lateness for lateness in self._late if lateness > self._config.gnss_lateness]
        if len(late) >= max(MIN_LATE, LATE_SHARE * len(self._late)) and max(late) < MAX_LATENESS:
            return [lateness_advice(float(np.quantile(late, 0.99)),
                                    min(self._config.gnss_delay, 0.0))[0]]
        return []
