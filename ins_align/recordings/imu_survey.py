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
"""What IMU data tell before any alignment: units, resolution, noise, biases at rest."""

from __future__ import annotations

from dataclasses import dataclass
import math

from ins_align.checks import degrees_fault, turn_ratio
from ins_align.config import Config, ImuNoise, PRESETS
from ins_align.geometry.earth import EARTH_RATE
from ins_align.geometry.rotation import Array
from ins_align.gnss.motion import GRID, Series
from ins_align.imu.noise import force_fault, RangeCheck
import numpy as np

WINDOW = 2.0  # s in which noise is measured
QUIET = 0.1  # of all windows, the quietest: where nothing is at rest motion disturbs least there
AVERAGING = 0.1  # s: filtered sensors are white only beyond some samples
NOISE_MARGIN = 1.5  # times a preset's noise still counts as that preset
BIAS_SIGMAS = 2.5
REST_SPEED = 0.3  # m/s below which a vehicle may stand
REST_RATE, REST_FORCE = math.radians(1.0), 0.3  # rad/s, m/s^2: scatter of half seconds at rest
MIN_REST = 5.0  # s
ON_LATTICE = 0.1  # of a quantum: how far a value may be off its multiples
MIN_REPEATS = 3  # samples for each value: with fewer the digits of a text may be the quantum
MIN_ZEROS, MIN_ZERO_SHARE = 20, 0.01  # samples that are exactly 0 because of a dead band


@dataclass(frozen=True)
class Resolution:
    """How finely a sensor tells small values, of its coarsest axis, rad/s or m/s^2."""

    quantum: float  # 0: none is seen
    dead_band: float  # no value between 0 and this; 0: there is none
    zeros: float  # share of samples that are exactly 0

    @property
    def half_width(self) -> float:
        """Largest error of what is rounded to a multiple of the quantum or to 0."""
        return max(0.5 * self.quantum, self.dead_band)


@dataclass(frozen=True)
class ImuFacts:
    """Figures of an IMU as it was recorded; vectors are tuples, in the axes of the IMU."""

    mean_force: float  # of the magnitude, m/s^2
    up: tuple[float, ...]  # direction of the mean specific force
    max_rate_deg_s: float  # of 99.9 percent
    gyro: Resolution
    accel: Resolution
    angle_random_walk: float  # deg/sqrt(h), per axis, at rest; otherwise an upper bound
    velocity_random_walk: float  # m/s/sqrt(h)
    rounds: tuple[bool, bool]  # gyros, accelerometers: noise is too small to show biases
    rest_s: float  # longest time at rest
    rest_rate_deg_s: tuple[float, ...] | None  # mean rate there: bias and the Earth's rate
    rest_force_error: float | None  # magnitude there less gravity, m/s^2
    turn_ratio: float | None  # rate about the vertical over that of the course
    faults: tuple[str, ...]
    too_small: tuple[str, ...]  # sensors at the end of their range, in words
    grade: str  # preset whose figures cover these, or come closest
    grade_covers: bool
    settings: tuple[str, ...]  # parameters that these figures ask for, with values


def survey_imu(times: Array, samples: Array, velocities: Series, gravity: float,
               ) -> ImuFacts | None:
    """
    Measure an IMU; None: there are too few samples.

    Parameters
    ----------
    times : ndarray, shape (N,)
        s, increasing, on the scale of `velocities`.
    samples : ndarray, shape (N, 6)
        Angular rate, rad/s, and specific force, m/s^2; finite.
    velocities : Series
        GNSS velocity as from `on_grid`; empty: there is none.
    gravity : float
        Where the vehicle is, m/s^2.

    """
    if times.size < 20 or times[-1] <= times[0]:
        return None
    interval = float(np.median(np.diff(times)))
    sensors = samples[:, :3], samples[:, 3:]
    sizes = np.linalg.norm(samples.reshape(-1, 2, 3), axis=2)
    mean_force, max_rate = float(np.mean(sizes[:, 1])), float(np.quantile(sizes[:, 0], 0.999))
    up = sensors[1].mean(axis=0)
    up /= np.linalg.norm(up) or 1.0
    grid, cells = _cells(times, samples)
    ratio = turn_ratio(grid, cells[:, :3], up, velocities)
    degrees = degrees_fault(max_rate, ratio)
    faults = [force_fault(mean_force), degrees]
    if ratio is not None and ratio < 0.0 and not degrees:
        faults.append('in left turns the rate about the upward axis is negative: a sign of the '
                      'gyroscopes or of the specific force is wrong (+9.8 along up at rest)')
    if max_rate == 0.0:
        faults.append('all angular rates are 0')
    rest = _longest_rest(grid, cells, velocities)
    part, quiet = slice(None), QUIET
    rate = force = None
    if rest:
        mean = cells[rest].mean(axis=0)
        rate, force = mean[:3], float(np.linalg.norm(mean[3:]) - gravity)
        part, quiet = slice(*np.searchsorted(times, grid[[rest[0], rest[-1]]]).tolist()), 0.5
    resolutions = [_resolution(values) for values in sensors]
    walks, lost = zip(*(_noise(values[part], resolution.half_width, interval, quiet)
                        for values, resolution in zip(sensors, resolutions)))
    # What the Earth's rate does not explain is bias, in whatever direction.
    biases = (0.0 if rate is None else abs(float(np.linalg.norm(rate)) - EARTH_RATE)
              / math.sqrt(3.0), 0.0 if force is None else abs(force))
    measured = ImuNoise(walks[0], walks[1], math.hypot(biases[0], lost[0]),
                        math.hypot(biases[1], lost[1]))
    grade, covers = _grade(measured)
    return ImuFacts(
        mean_force, tuple(up.tolist()), math.degrees(max_rate), *resolutions,
        math.degrees(walks[0]) * 60.0, walks[1] * 60.0, (lost[0] > 0.0, lost[1] > 0.0),
        len(rest) * GRID, None if rate is None else tuple(np.degrees(rate).tolist()), force, ratio,
        tuple(filter(None, faults)), _at_end_of_range(times, samples), grade, covers,
        _settings(measured, grade, rate is not None, lost[0] > 0.0))


def _settings(measured: ImuNoise, grade: str, at_rest: bool, rounds: bool) -> tuple[str, ...]:
    """Return the grade where it is known, and what it does not cover."""
    settings = [f'imu_grade={grade}'] if at_rest and grade != Config.imu_grade else []
    preset = PRESETS[grade if at_rest else Config.imu_grade]
    if measured.gyro_bias_std > BIAS_SIGMAS * preset.gyro_bias_std or (
            rounds and measured.gyro_bias_std > preset.gyro_bias_std):
        settings.append(f'gyro_bias_std={math.degrees(measured.gyro_bias_std):.2g}')
    if measured.accel_bias_std > BIAS_SIGMAS * preset.accel_bias_std:
        settings.append(f'accel_bias_std={measured.accel_bias_std:.2g}')
    # Other noise is measured by the alignment itself; what is rounded away does not look noisy.
    if rounds and measured.angle_random_walk > preset.angle_random_walk:
        settings.append(f'angle_random_walk={math.degrees(measured.angle_random_walk) * 60.0:.2g}')
    return tuple(settings)


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


def _resolution(values: Array) -> Resolution:
    """Return the resolution of a sensor, values of shape (N, 3)."""
    quantum = dead_band = zeros = 0.0
    for axis in values.T:
        levels = np.unique(axis)
        steps = np.diff(levels)
        # Across a dead band there is no step of the quantum.
        inner = steps[(levels[1:] != 0.0) & (levels[:-1] != 0.0)]
        if inner.size and axis.size > MIN_REPEATS * levels.size:
            q = float(np.median(inner[inner < 1.5 * inner.min()]))
            if np.mean(np.abs(inner / q - np.round(inner / q)) < ON_LATTICE) > 0.99:
                quantum = max(quantum, q)
        sizes = np.abs(axis[axis != 0.0])
        count = axis.size - sizes.size
        zeros = max(zeros, count / axis.size)
        if sizes.size and count > max(MIN_ZEROS, MIN_ZERO_SHARE * axis.size):
            smallest = float(sizes.min())
            # Further out there are values as usual: else these zeros are something else.
            if np.count_nonzero(sizes < 2.0 * smallest) > MIN_ZEROS and smallest > dead_band:
                dead_band = smallest
    return Resolution(quantum, dead_band if dead_band > 1.5 * quantum else 0.0, zeros)


def _at_end_of_range(times: Array, samples: Array) -> tuple[str, ...]:
    """Say which sensors were at the end of their range, and where that is."""
    check = RangeCheck()
    check.add((times * 1e9).astype(np.int64), samples)
    largest = np.abs(samples).reshape(-1, 2, 3).max(axis=(0, 2))
    return tuple(
        f'{name} at the end of their range, {value:.4g} {unit}, in {count} samples: let the '
        'driver set a larger one' for name, value, unit, count in zip(
            ('gyroscopes', 'accelerometers'), largest, ('rad/s', 'm/s^2'),
            np.count_nonzero(check.densities, axis=0)) if count)


def _noise(values: Array, half_width: float, interval: float, quiet: float) -> tuple[float, float]:
    """Return the white noise of a sensor, per sqrt(Hz), and the bias that rounding hides."""
    walk = 0.0
    for average in {1, max(round(AVERAGING / interval), 1)}:
        count = values.shape[0] // average
        means = values[:count * average].reshape(count, average, 3).mean(axis=1)
        second = np.diff(means, n=2, axis=0) ** 2
        length = max(round(WINDOW / (interval * average)), 5)
        windows = second.shape[0] // length
        if windows:
            variance = second[:windows * length].reshape(windows, length, 3).mean(axis=(1, 2)) / 6
            walk = max(walk, math.sqrt(
                float(np.quantile(variance, quiet)) * interval * average))
    # Noise of half a quantum carries small values over it; less leaves an error that lasts.
    if walk / math.sqrt(interval) >= half_width:
        return walk, 0.0
    lost = half_width / math.sqrt(3.0)  # uniform, 1 sigma
    return max(walk, lost * math.sqrt(interval)), lost


def _cells(times: Array, samples: Array) -> tuple[Array, Array]:
    """Average over cells of GRID seconds; return their middles and averages."""
    index = ((times - times[0]) / GRID).astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(index) > 0]))
    counts = np.diff(np.append(starts, times.size))[:, None]
    return times[0] + (index[starts] + 0.5) * GRID, np.add.reduceat(samples, starts) / counts


def _longest_rest(grid: Array, cells: Array, velocities: Series) -> list[int]:
    """Return the cells of the longest time at rest; empty if there is none."""
    if velocities.times.size < 2:
        return []
    speed = np.interp(grid, velocities.times, np.hypot(*velocities.vectors[:, :2].T))
    after = np.clip(np.searchsorted(velocities.times, grid), 1, velocities.times.size - 1)
    near = np.abs(grid - velocities.times[after - 1]) < 2.0 * GRID
    still = np.concatenate([[False], near & (speed < REST_SPEED), [False]])
    runs = np.flatnonzero(np.diff(still.astype(np.int8))).reshape(-1, 2).tolist()
    for start, end in sorted(runs, key=lambda run: run[0] - run[1]):
        # The first and the last second may belong to stopping and setting off.
        rest = list(range(start + 2, end - 2))
        if (end - start) * GRID >= MIN_REST and np.all(
                cells[rest].std(axis=0) < np.repeat([REST_RATE, REST_FORCE], 3)):
            return rest
    return []
