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
"""Surveys the samples of an IMU: unit, noise, bias, end of its range, dead band."""

from __future__ import annotations

import math
from typing import NamedTuple

from ins_align.checks import degrees_fault, turn_ratio
from ins_align.config import Config, ImuNoise, PRESETS
from ins_align.geometry.earth import EARTH_RATE
from ins_align.geometry.rotation import Array
from ins_align.gnss.motion import GRID, Series
from ins_align.imu.noise import force_fault, RangeCheck, white_noise
from ins_align.recordings.topic_survey import rounded, Surveyed
import numpy as np

WINDOW = 2.0  # s in which noise is measured
QUIET = 0.1  # of all windows, the quietest: where nothing is at rest motion disturbs least there
AVERAGING = 0.1  # s: filtered sensors are white only beyond some samples
NOISE_MARGIN = 1.5  # times a preset's noise still counts as that preset
BIAS_SIGMAS = 2.5
REST_SPEED = 0.3  # m/s below which a vehicle may stand
REST_RATE, REST_FORCE = math.radians(1.0), 0.3  # rad/s, m/s^2: scatter of half seconds at rest
MIN_REST = 5.0  # s
MIN_ZEROS, MIN_ZERO_SHARE = 20, 0.01  # samples that are exactly 0 because of a dead band
# What a chip reaches in a minute or two of turns, deg.
CHIP_THRESHOLDS = {'tilt_std_threshold': 1.0, 'heading_std_threshold': 2.0}


class Sensor(NamedTuple):
    """How the figures of a sensor are printed: units, and their sizes in SI units."""

    name: str
    unit: str
    size: float
    walk_unit: str
    walk_size: float


SENSORS = (Sensor('gyroscopes', 'deg/s', math.radians(1.0), 'deg/sqrt(h)', math.radians(1.0) / 60),
           Sensor('accelerometers', 'm/s^2', 1.0, 'm/s/sqrt(h)', 1.0 / 60.0))


def survey_imu(imu: Surveyed, samples: Series, velocities: Series, gravity: float) -> None:
    """
    Add to an IMU what its samples tell.

    Of rates, rad/s, and specific forces, m/s^2, finite, shape (N, 6), and of GNSS velocities, m/s,
    as from `on_grid`, over the same seconds; the latter may be empty. Gravity is in m/s^2.
    """
    times, values = samples
    if times.size < 20:
        imu.add('it has too few usable samples', fault=True)
        return
    sizes = np.linalg.norm(values.reshape(-1, 2, 3), axis=2)
    force, max_rate = float(np.mean(sizes[:, 1])), float(np.quantile(sizes[:, 0], 0.999))
    up = values[:, 3:].mean(axis=0)
    up /= np.linalg.norm(up) or 1.0
    grid, cells = _cells(times, values)
    ratio = turn_ratio(grid, cells[:, :3], up, velocities)
    rates = degrees_fault(max_rate, grid, *np.split(cells, 2, axis=1), velocities)
    if max_rate == 0.0:
        rates = 'all angular rates are 0'
    elif ratio is not None and ratio < 0.0 and not rates:
        rates = ('in left turns the rate about the upward axis is negative: a sign of the '
                 'gyroscopes or of the specific force is wrong (+9.8 along up at rest)')
    for fault in filter(None, (force_fault(force), rates)):
        imu.add(fault, fault=True)
    x, y, z = up.tolist()
    imu.add(f'specific force: {force:.2f} m/s^2 on average, mean direction '
            f'({x:+.2f}, {y:+.2f}, {z:+.2f})', mean_force=force, up=[x, y, z])
    if imu.faults:
        return  # the rest would be in wrong units, or of other axes
    if z < 0.5:
        imu.add('on average the specific force does not point along the z axis of the IMU: the '
                'attitude will be that of the axes as they are, however the IMU is mounted')
    imu.add(f'angular rate: up to {math.degrees(max_rate):.0f} deg/s',
            max_rate_deg_s=math.degrees(max_rate), turn_ratio=ratio)
    _add_end_of_range(imu, samples)
    _add_noise(imu, samples, _longest_rest(grid, cells, velocities), gravity)


def _add_end_of_range(imu: Surveyed, samples: Series) -> None:
    """Say which sensors were at the end of their range, and where that is."""
    check = RangeCheck()
    check.add((samples.times * 1e9).astype(np.int64), samples.vectors)
    largest = np.abs(samples.vectors).reshape(-1, 2, 3).max(axis=(0, 2))
    for sensor, value, count in zip(SENSORS, largest, np.count_nonzero(check.densities, axis=0)):
        if count:
            imu.add(f'{sensor.name} at the end of their range, {value / sensor.size:.4g} '
                    f'{sensor.unit}, in {count} samples: let the driver set a larger one')


def _add_noise(imu: Surveyed, samples: Series, rest: tuple[float, float] | None, gravity: float,
               ) -> None:
    """Add dead bands, noise, biases and grade, of all or of what is at rest."""
    times, values = samples
    part = slice(None) if rest is None else slice(*np.searchsorted(times, rest))
    rate, force = values[part].mean(axis=0).reshape(2, 3)
    off_gravity = float(np.linalg.norm(force) - gravity)
    interval = float(np.median(np.diff(times)))
    walks, hidden = _walks(times[part], values[part], 0.5 if rest else QUIET).tolist(), [0.0, 0.0]
    for k, (sensor, triad) in enumerate(zip(SENSORS, np.split(values, 2, axis=1))):
        band, zeros = _dead_band(triad)
        # Noise of this size carries smaller values over it.
        if walks[k] < band * math.sqrt(interval):
            imu.add(f'{sensor.name} have a dead band: less than {band / sensor.size:.2g} '
                    f'{sensor.unit} becomes 0, {zeros:.0%} of the samples of an axis',
                    **{f'{sensor.name}_dead_band': band})
            hidden[k] = band / math.sqrt(3.0)  # uniform, 1 sigma: an error that lasts
            walks[k] = max(walks[k], hidden[k] * math.sqrt(interval))
    # What the Earth's rate does not explain is bias, in whatever direction.
    bias = abs(float(np.linalg.norm(rate)) - EARTH_RATE) / math.sqrt(3.0)
    measured = ImuNoise(*walks, *map(math.hypot, hidden, (bias, off_gravity) if rest else (0, 0)))
    grade, covers = _grade(measured)
    preset = PRESETS[grade if rest else Config.imu_grade]
    settings = {}
    # Noise is measured by the alignment itself; what a dead band hides does not look noisy.
    if hidden[0] and measured.angle_random_walk > preset.angle_random_walk:
        settings['angle_random_walk'] = rounded(math.degrees(60.0 * measured.angle_random_walk))
    if measured.gyro_bias_std > preset.gyro_bias_std * (1.0 if hidden[0] else BIAS_SIGMAS):
        settings['gyro_bias_std'] = rounded(math.degrees(measured.gyro_bias_std))
    if measured.accel_bias_std > preset.accel_bias_std * BIAS_SIGMAS:
        settings['accel_bias_std'] = rounded(measured.accel_bias_std)
    shown = ', '.join(f'{walk / sensor.walk_size:.2g} {sensor.walk_unit}'
                      for walk, sensor in zip(walks, SENSORS))
    imu.add(f'noise: {shown}' + ('' if rest else ' at most, measured in motion'),
            angle_random_walk=math.degrees(60.0 * walks[0]), velocity_random_walk=60.0 * walks[1])
    if rest is None:
        imu.add(f'imu_grade: {Config.imu_grade} is the default; not seen at rest, which would '
                'show biases' + f'; its noise is no worse than that of {grade}' * covers,
                settings, imu_grade=grade)
        return
    degrees_s = np.degrees(rate).tolist()
    imu.add(f'at rest for {rest[1] - rest[0]:.0f} s: rate '
            f'({", ".join(f"{each:+.4f}" for each in degrees_s)}) deg/s, specific '
            f'force {off_gravity:+.3f} m/s^2 off gravity', settings,
            rest_s=rest[1] - rest[0], rest_rate_deg_s=degrees_s, rest_force_error=off_gravity)
    noisy = any(walk > NOISE_MARGIN * limit and not lost
                for walk, limit, lost in zip(walks, preset, hidden))
    imu.add(f'suits imu_grade {grade}' if covers else f'worse than imu_grade {grade}'
            + ': more noise is measured while aligning' * noisy,
            {} if grade == Config.imu_grade else
            {'imu_grade': grade, **(CHIP_THRESHOLDS if grade == 'chip' else {})},
            imu_grade=grade)


def _grade(measured: ImuNoise) -> tuple[str, bool]:
    """
    Return the preset that suits what was measured, and whether it covers all of it.

    One worse than the default suits where both biases ask for it: they are of another kind of
    sensor. One bias is a parameter, and more noise is measured while aligning.
    """
    margins = NOISE_MARGIN, NOISE_MARGIN, BIAS_SIGMAS, BIAS_SIGMAS
    for name, preset in PRESETS.items():
        covered = [value <= margin * limit for value, margin, limit
                   in zip(measured, margins, preset)]
        if all(covered) or (name == Config.imu_grade and any(covered[2:])):
            break
    return name, all(covered)


def _dead_band(values: Array) -> tuple[float, float]:
    """
    Return what size is lost since axes read 0 instead, and how often the worst axis does.

    Of values of shape (N, 3). A filter may do so, and the rounding of a coarse sensor.
    """
    band = zeros = 0.0
    for axis in values.T:
        sizes = np.abs(axis[axis != 0.0])
        count = axis.size - sizes.size
        if sizes.size and count > max(MIN_ZEROS, MIN_ZERO_SHARE * axis.size):
            smallest = float(sizes.min())
            # Further out there are values as usual: else these zeros are something else.
            if np.count_nonzero(sizes < 2.0 * smallest) > MIN_ZEROS:
                # What rounds has nothing between one and two of its steps either, and loses half.
                rounds = not np.any((sizes > 1.1 * smallest) & (sizes < 1.9 * smallest))
                band = max(band, smallest * (0.5 if rounds else 1.0))
                zeros = max(zeros, count / axis.size)
    return band, zeros


def _walks(times: Array, values: Array, quiet: float) -> Array:
    """Return white noise of gyros and accelerometers, per sqrt(Hz), shape (2,), of quiet times."""
    walks, interval = np.zeros(2), float(np.median(np.diff(times)))
    for average in {1, max(round(AVERAGING / interval), 1)}:
        count = times.size // average
        stamps, means = (column[:count * average].reshape(count, average, -1).mean(axis=1)
                         for column in (times * 1e9, values))
        edges = np.arange(0, count, max(round(WINDOW / (interval * average)), 8))
        if edges.size > 1:
            walks = np.maximum(walks, np.quantile(white_noise(
                stamps[:, 0].astype(np.int64), means, edges[:-1], edges[1:]), quiet, axis=0))
    return walks


def _cells(times: Array, samples: Array) -> tuple[Array, Array]:
    """Average over cells of GRID seconds; return their middles and averages."""
    index = ((times - times[0]) / GRID).astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(index) > 0]))
    counts = np.diff(np.append(starts, times.size))[:, None]
    return times[0] + (index[starts] + 0.5) * GRID, np.add.reduceat(samples, starts) / counts


def _longest_rest(grid: Array, cells: Array, velocities: Series) -> tuple[float, float] | None:
    """Return when the longest time at rest begins and ends, s; None if there is none."""
    if velocities.times.size < 2:
        return None
    speed = np.interp(grid, velocities.times, np.hypot(*velocities.vectors[:, :2].T))
    after = np.clip(np.searchsorted(velocities.times, grid), 1, velocities.times.size - 1)
    near = np.abs(grid - velocities.times[after - 1]) < 2.0 * GRID
    still = np.concatenate([[False], near & (speed < REST_SPEED), [False]])
    runs = np.flatnonzero(np.diff(still.astype(np.int8))).reshape(-1, 2).tolist()
    for start, end in sorted(runs, key=lambda run: run[0] - run[1]):
        # The first and the last second may belong to stopping and setting off.
        rest = slice(start + 2, end - 2)
        if (end - start) * GRID >= MIN_REST and np.all(
                cells[rest].std(axis=0) < np.repeat([REST_RATE, REST_FORCE], 3)):
            first, last = grid[rest][[0, -1]].tolist()
            return first - 0.5 * GRID, last + 0.5 * GRID
    return None
