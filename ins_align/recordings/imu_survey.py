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
"""What the IMU data of a recording tell before any alignment: units, noise, biases at rest."""

from __future__ import annotations

from dataclasses import dataclass
import math

from ins_align.checks import degrees_fault, turn_ratio
from ins_align.config import PRESETS
from ins_align.geometry.earth import EARTH_RATE
from ins_align.geometry.rotation import Array
from ins_align.imu.plausibility import force_fault, RangeCheck
from ins_align.recordings.decode import ImuSamples
from ins_align.recordings.motion_survey import GRID, Series
import numpy as np

WINDOW = 2.0  # s in which noise is measured
QUIET = 0.1  # of all windows, the quietest: where nothing is at rest motion disturbs least there
AVERAGING = 0.1  # s: filtered sensors are white only beyond some samples
NOISE_MARGIN = 1.5  # times a preset's noise still counts as that preset
BIAS_SIGMAS = 3.0
REST_SPEED = 0.3  # m/s below which a vehicle may stand
REST_RATE, REST_FORCE = math.radians(1.0), 0.3  # rad/s, m/s^2: scatter of half seconds at rest
MIN_REST = 5.0  # s


@dataclass(frozen=True)
class ImuFacts:
    """Figures of an IMU as it was recorded; vectors are tuples, in the axes of the IMU."""

    mean_force: float  # of the magnitude, m/s^2
    up: tuple[float, ...]  # direction of the mean specific force
    max_rate_deg_s: float  # of 99.9 percent
    angle_random_walk: float  # deg/sqrt(h), per axis, at rest; otherwise an upper bound
    velocity_random_walk: float  # m/s/sqrt(h)
    rest_s: float  # longest time at rest
    rest_rate_deg_s: tuple[float, ...] | None  # mean rate there: bias and the Earth's rate
    rest_force_error: float | None  # magnitude there less gravity, m/s^2
    turn_ratio: float | None  # rate about the vertical over that of the course
    faults: tuple[str, ...]
    too_small: tuple[str, ...]  # sensors at the end of their range, in words
    grade: str  # preset whose figures cover these, or come closest
    grade_covers: bool
    grade_is_sure: bool  # noise and biases have been seen at rest


def survey_imu(samples: ImuSamples, times: Array, velocities: Series | None,
               gravity: float) -> ImuFacts | None:
    """
    Measure an IMU.

    Parameters
    ----------
    samples : ImuSamples
        Finite ones.
    times : ndarray, shape (N,)
        Of the samples, s, increasing, on the scale of `velocities`.
    velocities : Series or None
        GNSS velocity on a grid, ENU, m/s; None: there is none.
    gravity : float
        Where the vehicle is, m/s^2.

    Returns
    -------
    ImuFacts or None
        None: there are too few samples.

    """
    if times.size < 20 or times[-1] <= times[0]:
        return None
    interval = float(np.median(np.diff(times)))
    magnitudes = np.sqrt(np.sum(samples.accel ** 2, axis=1))
    mean_force = float(np.mean(magnitudes))
    up = samples.accel.mean(axis=0)
    up = up / (np.sqrt(up @ up) or 1.0)
    rates = np.sqrt(np.sum(samples.gyro ** 2, axis=1))
    max_rate = float(np.quantile(rates, 0.999))
    grid, gyro, accel = _cells(samples, times)
    ratio = turn_ratio(grid, gyro, up, velocities)
    faults = [fault for fault in [force_fault(mean_force)] if fault]
    if degrees := degrees_fault(max_rate, ratio):
        faults.append(degrees)
    elif ratio is not None and ratio < 0.0:
        faults.append('in left turns the rate about the upward axis is negative: a sign of the '
                      'gyroscopes or of the specific force is wrong (+9.8 along up at rest)')
    if max_rate == 0.0:
        faults.append('all angular rates are 0')
    rest = _longest_rest(grid, gyro, accel, velocities)
    rest_rate = rest_force = None
    part, quiet = slice(None), QUIET
    if rest:
        rest_rate = gyro[rest].mean(axis=0)
        mean = accel[rest].mean(axis=0)
        rest_force = float(np.sqrt(mean @ mean) - gravity)
        part, quiet = slice(*np.searchsorted(times, grid[[rest[0], rest[-1]]]).tolist()), 0.5
    walk = math.degrees(_random_walk(samples.gyro[part], interval, quiet)) * 60.0
    force_walk = _random_walk(samples.accel[part], interval, quiet) * 60.0
    grade, covered = _grade(walk, force_walk, rest_rate, rest_force)
    return ImuFacts(
        mean_force, tuple(up.tolist()), math.degrees(max_rate), walk, force_walk,
        len(rest) * GRID if rest else 0.0,
        None if rest_rate is None else tuple(np.degrees(rest_rate).tolist()), rest_force, ratio,
        tuple(faults), _at_end_of_range(samples), grade, covered,
        rest_rate is not None)


def _at_end_of_range(samples: ImuSamples) -> tuple[str, ...]:
    """Say which sensors were at the end of their range, and where that is."""
    check = RangeCheck()
    check.add(samples.stamps_ns, np.hstack([samples.gyro, samples.accel]))
    gyro, accel = np.count_nonzero(check.densities, axis=0)
    return tuple(
        f'{name} at the end of their range, {np.abs(values).max():.4g} {unit}, in {count} '
        'samples: let the driver set a larger one'
        for name, values, unit, count in (('gyroscopes', samples.gyro, 'rad/s', gyro),
                                          ('accelerometers', samples.accel, 'm/s^2', accel))
        if count)


def _random_walk(values: Array, interval: float, quiet: float) -> float:
    """Return the white noise of a sensor, its unit times sqrt(s), at a quantile of windows."""
    walks = [0.0]
    for average in {1, max(round(AVERAGING / interval), 1)}:
        count = values.shape[0] // average
        means = values[:count * average].reshape(count, average, 3).mean(axis=1)
        second = np.diff(means, n=2, axis=0) ** 2
        length = max(round(WINDOW / (interval * average)), 5)
        windows = second.shape[0] // length
        if windows:
            variance = second[:windows * length].reshape(windows, length, 3).mean(axis=(1, 2)) / 6
            walks.append(math.sqrt(float(np.quantile(variance, quiet)) * interval * average))
    return max(walks)


def _cells(samples: ImuSamples, times: Array) -> tuple[Array, Array, Array]:
    """Average over cells of GRID seconds: their middles, rates and specific forces."""
    index = ((times - times[0]) / GRID).astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(index) > 0]))
    counts = np.diff(np.append(starts, times.size))[:, None]
    return (times[0] + (index[starts] + 0.5) * GRID,
            np.add.reduceat(samples.gyro, starts) / counts,
            np.add.reduceat(samples.accel, starts) / counts)


def _longest_rest(grid: Array, gyro: Array, accel: Array, velocities: Series | None,
                  ) -> list[int]:
    """Return the cells of the longest time at rest; empty if there is none."""
    if velocities is None or velocities.times.size < 2:
        return []
    speed = np.interp(grid, velocities.times, np.hypot(*velocities.vectors[:, :2].T))
    after = np.clip(np.searchsorted(velocities.times, grid), 1, velocities.times.size - 1)
    near = np.abs(grid - velocities.times[after - 1]) < 2.0 * GRID
    still = np.concatenate([[False], near & (speed < REST_SPEED), [False]])
    edges = np.flatnonzero(np.diff(still.astype(np.int8)))
    runs = sorted(zip(edges[::2].tolist(), edges[1::2].tolist()),
                  key=lambda run: run[0] - run[1])
    for start, end in runs:
        if (end - start) * GRID < MIN_REST:
            break
        # The first and the last second may belong to stopping and setting off.
        cells = range(start + 2, end - 2)
        if (gyro[cells].std(axis=0).max() < REST_RATE
                and accel[cells].std(axis=0).max() < REST_FORCE):
            return list(cells)
    return []


def _grade(walk: float, force_walk: float, rest_rate: Array | None,
           rest_force: float | None) -> tuple[str, bool]:
    """Return the best preset that covers what was measured, or the last, and whether it does."""
    for name, preset in PRESETS.items():
        if (walk > NOISE_MARGIN * math.degrees(preset.angle_random_walk) * 60.0
                or force_walk > NOISE_MARGIN * preset.velocity_random_walk * 60.0):
            continue
        if rest_rate is not None and rest_force is not None:
            # What the Earth's rate does not explain is bias, in whatever direction.
            bias = abs(float(np.sqrt(rest_rate @ rest_rate)) - EARTH_RATE)
            if (bias > BIAS_SIGMAS * math.sqrt(3.0) * preset.gyro_bias_std
                    or abs(rest_force) > BIAS_SIGMAS * preset.accel_bias_std):
                continue
        return name, True
    return name, False
