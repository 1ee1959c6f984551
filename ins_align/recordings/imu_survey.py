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
"""
Surveys the samples of an IMU: unit, noise, bias, resolution; delay and noise of the GNSS.

The last two are where the motion that the IMU feels fits the velocity of the receiver best. In
windows of some seconds the velocity integration formula holds with a constant rotation,
``v_n(t) + g t = v_0 + C_n0 [integral of C_0b f + C_0b (w x l)]``. Rotation, v_0, biases and lever
arm are fitted in each window by least squares, for one delay after the other. The delay is where
the likelihood is largest, with a noise of its own in each window; the noise is what is left there.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from ins_align.checks import degrees_fault, turn_ratio
from ins_align.config import Config, ImuNoise, PRESETS
from ins_align.geometry.earth import EARTH_RATE
from ins_align.geometry.rotation import Array, cumulative_rotations, exp_so3, skew
from ins_align.gnss.motion import GRID, Series
from ins_align.imu.buffer import MAX_GAP_NS
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

CELL = 0.05  # s over which the IMU is integrated at a time
FIT_WINDOW, MIN_EPOCHS = 10.0, 20  # s and GNSS epochs in a window
MIN_WINDOWS = 3
DELAYS = np.arange(-0.5, 1.25, 0.1)  # s
MAX_DELAY_STD = 0.025  # s: what is known less well is not told
# 1 sigma before the fit: gyro bias, rad/s, lever arm, m, accelerometer bias, m/s^2, for a
# velocity noise of VELOCITY_STD, m/s. Rotation and v_0 are free.
VELOCITY_STD = 0.2
PRIOR_STD = np.repeat([1e4, 1e4, math.radians(0.5), 3.0, 0.5], 3)
MOVING = 1.0  # m/s
MAX_TURN_STD = 0.2  # rad: a rotation that is known less well is open
OUTLIER = 6.0  # times the median size of residuals
LONGEST = 3600.0  # s from the first motion on that are looked at: memory is bounded


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

    Of rates, rad/s, and specific forces, m/s^2, finite, shape (N, 6), at increasing times, s, on
    the scale of GNSS velocities as from `on_grid`, which may be empty; gravity is in m/s^2.
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


@dataclass(frozen=True)
class Delay:
    """GNSS stamps less the times of measurement, on the clock of the IMU, s."""

    mean: float
    std: float
    drift: float  # mean of the second half less that of the first


@dataclass(frozen=True)
class MotionFit:
    """What the fit tells; None: there is not enough motion or data to tell."""

    delay: Delay | None
    velocity_std: tuple[float, float] | None  # horizontal per axis and vertical, m/s


class _Imu:
    """Integrals of an IMU over all of a recording, in the axes of its first sample."""

    def __init__(self, times: Array, gyro: Array, accel: Array) -> None:
        self.start, self.end = float(times[0]), float(times[-1])
        edges = np.arange(self.start, self.end, CELL)
        angle, force = (np.diff(_interpolated_integral(times, values, edges), axis=0)
                        for values in (gyro, accel))
        C_0b = np.concatenate([np.eye(3)[None], cumulative_rotations(exp_so3(angle))])
        middle = C_0b[:-1] @ exp_so3(0.5 * angle)
        force = (middle @ force[..., None])[..., 0]
        attitude = _sums(middle * CELL)  # how an accelerometer bias enters
        rate = np.concatenate([angle[:1], 0.5 * (angle[1:] + angle[:-1]), angle[-1:]]) / CELL
        # Side by side: velocity (3), how a gyro bias, an accelerometer bias, a lever arm enter it.
        self._rows = np.concatenate([_sums(force)[..., None], _sums(
            skew(force) @ (0.5 * (attitude[1:] + attitude[:-1]))), attitude,
            C_0b @ skew(rate)], axis=2)

    def between(self, start: Array, times: Array) -> tuple[Array, Array, Array, Array]:
        """
        Return integrals from the start of M windows, shape (M, 1), to each of n times, (M, n).

        That of the specific force, shape (M, n, 3), and its derivatives to gyro bias,
        accelerometer bias and lever arm, each of shape (M, n, 3, 3).
        """
        before, after = self._at(start), self._at(times)
        velocity, by_gyro, by_accel = np.split((after - before)[..., :7], [1, 4], axis=3)
        return (velocity[..., 0], by_gyro - skew(velocity[..., 0]) @ before[..., 4:7], by_accel,
                after[..., 7:])

    def _at(self, times: Array) -> Array:
        place = (times - self.start) / CELL
        cell = np.clip(place.astype(np.int64), 0, self._rows.shape[0] - 2)
        share = (place - cell)[..., None, None]
        rows: Array = self._rows[cell] * (1.0 - share) + self._rows[cell + 1] * share
        return rows


def fit_motion(times: Array, gyro: Array, accel: Array, velocities: Series, gravity: float,
               offsets: tuple[float, ...] = (0.0,)) -> MotionFit:
    """
    Fit the motion of an IMU to that of a GNSS receiver.

    Samples, shape (N, 3), rad/s and m/s^2, at increasing times, s, and velocities, ENU, m/s, are
    on the same clock but for the delay, which is searched from 0.5 s below to 1.2 s above each of
    the offsets, s.
    """
    delays = np.concatenate([offset + DELAYS for offset in offsets])
    moving = np.flatnonzero(np.hypot(*velocities.vectors[:, :2].T) > MOVING)
    start = velocities.times[moving[0]] - 2.0 * FIT_WINDOW if moving.size else 0.0
    velocities = Series(*(column[(velocities.times >= start) & (
        velocities.times < start + LONGEST)] for column in velocities))
    part = slice(*np.searchsorted(times, [start - delays.max() - 1.0, start + LONGEST]).tolist())
    times, gyro, accel = times[part], gyro[part], accel[part]
    nothing = MotionFit(None, None)
    if velocities.times.size < MIN_WINDOWS * MIN_EPOCHS or times.size < 2:
        return nothing
    windows = _windows(times, velocities.times, delays)
    if windows.shape[0] < MIN_WINDOWS:
        return nothing
    imu = _Imu(times, gyro, accel)
    epochs, v_n = velocities.times[windows], velocities.vectors[windows]
    good = np.ones(windows.shape)
    costs, _, turn_std = zip(*(_fit(imu, epochs - delay, v_n, good, gravity) for delay in delays))
    # Steady motion leaves the heading open, and with it tells nothing of the delay.
    telling = np.median(turn_std, axis=0) < MAX_TURN_STD
    coarse = -1.5 * windows.shape[1] * np.log(costs)[:, telling]
    place = int(np.argmax(coarse.sum(axis=1)))
    size = np.linalg.norm(_fit(imu, epochs - delays[place], v_n, good, gravity)[1], axis=2)
    good = (size < OUTLIER * np.median(size)).astype(float)
    # Once more around the best one, without outliers.
    near = delays[place] + (DELAYS[1] - DELAYS[0]) * np.arange(-1.0, 2.0)
    costs, left, _ = zip(*(_fit(imu, epochs - delay, v_n, good, gravity) for delay in near))
    free = np.maximum(3.0 * good.sum(axis=1) - PRIOR_STD.size, 1.0)
    likelihood = (-0.5 * free * np.log(costs))[:, telling]
    delay, std = _maximum(near, likelihood.sum(axis=1))
    odd, even = (_maximum(near, likelihood[:, half::2].sum(axis=1))[0] for half in (1, 0))
    std = max(std, 0.5 * abs(odd - even))
    first, second = (_maximum(delays, half.sum(axis=1))[0]
                     for half in np.array_split(coarse, 2, axis=1))
    known = (std < MAX_DELAY_STD and np.count_nonzero(telling) >= MIN_WINDOWS
             and 0 < place % DELAYS.size < DELAYS.size - 1)
    # Of windows in motion, if there are: standing, receivers are better than they are.
    chosen = np.hypot(v_n[..., 0], v_n[..., 1]).mean(axis=1) > MOVING
    chosen |= np.count_nonzero(chosen) < MIN_WINDOWS
    # The median does without the outliers; the fit has taken some of the noise away.
    scale = math.sqrt(3.0 * good.sum() / free.sum()) / 0.6745
    residuals = np.abs(left[1][chosen][good[chosen] > 0.0])
    return MotionFit(
        Delay(delay, std, second - first) if known else None,
        (float(np.median(residuals[:, :2]) * scale), float(np.median(residuals[:, 2]) * scale)))


def _windows(times: Array, epochs: Array, delays: Array) -> np.ndarray:
    """Return the epochs of each window, shape (M, n), without gaps and within the IMU data."""
    usual = float(np.median(np.diff(epochs)))
    length = max(round(FIT_WINDOW / usual), MIN_EPOCHS)
    windows = np.arange(epochs.size // length * length).reshape(-1, length)
    first, last = epochs[windows[:, 0]], epochs[windows[:, -1]]
    gaps = np.concatenate([[0], np.cumsum(np.diff(times) > MAX_GAP_NS * 1e-9)])
    edges = [np.interp(edge, times, gaps) for edge in (first - delays.max(), last - delays.min())]
    return windows[(last - first < 1.2 * length * usual) & (edges[0] == edges[1])
                   & (first - delays.max() > times[0]) & (last - delays.min() < times[-1])]


def _fit(imu: _Imu, times: Array, v_n: Array, good: Array, gravity: float,
         ) -> tuple[Array, Array, Array]:
    """
    Fit rotation, velocity at the start, biases and lever arm in M windows of n epochs.

    Of the measurements: times on the clock of the IMU, s, and weights, 0 or 1, of shape (M, n),
    velocities, shape (M, n, 3). Returns the sums of squares, shape (M,), the residuals in ENU,
    shape (M, n, 3), and how well the rotation is known, 1 sigma, rad, shape (M,).
    """
    middle = times.mean(axis=1, keepdims=True)
    felt, by_gyro, by_accel, by_lever = imu.between(middle, times)
    seen = v_n + (times - middle)[..., None] * [0.0, 0.0, gravity]
    weight = (good / np.maximum(good.sum(axis=1, keepdims=True), 1.0))[..., None]
    centred = [vectors - np.sum(weight * vectors, axis=1, keepdims=True)
               for vectors in (seen, felt)]
    U, _, Vt = np.linalg.svd(np.swapaxes(weight * centred[0], 1, 2) @ centred[1])
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    C_n0 = U @ Vt
    count, epochs = times.shape
    start = np.broadcast_to(np.eye(3), by_gyro.shape)
    J = np.concatenate([start, -skew(felt), by_gyro, by_lever, by_accel],
                       axis=3).reshape(count, 3 * epochs, PRIOR_STD.size)
    priors = np.square(VELOCITY_STD / PRIOR_STD)
    weighted = np.swapaxes(J * np.repeat(good, 3, axis=1)[..., None], 1, 2)
    normal = weighted @ J + np.diag(priors)
    for _ in range(2):
        y = (seen @ C_n0 - felt).reshape(count, -1, 1)
        x = np.linalg.solve(normal, weighted @ y)
        left = (y - J @ x)[..., 0]
        cost = np.sum(np.repeat(good, 3, axis=1) * left ** 2, axis=1) + x[..., 0] ** 2 @ priors
        C_n0, turned = C_n0 @ exp_so3(x[:, 3:6, 0]), C_n0
    turn = np.trace(np.linalg.inv(normal)[:, 3:6, 3:6], axis1=1, axis2=2) * cost / good.sum(axis=1)
    return (cost + 1e-12, left.reshape(count, epochs, 3) @ np.swapaxes(turned, 1, 2),
            np.sqrt(turn / 3.0))


def _maximum(delays: Array, likelihood: Array) -> tuple[float, float]:
    """Return where a parabola around the largest value is largest, and its deviation."""
    place = min(max(int(np.argmax(likelihood)), 1), delays.size - 2)
    step = DELAYS[1] - DELAYS[0]
    before, here, after = likelihood[place - 1:place + 2].tolist()
    curvature = (2.0 * here - before - after) / step ** 2
    if curvature <= 0.0:
        return float(delays[place]), math.inf
    return float(delays[place] + (after - before) / (2.0 * step * curvature)), curvature ** -0.5


def _interpolated_integral(times: Array, values: Array, at: Array) -> Array:
    """Integrate by the trapezoidal rule."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times)[:, None]
    return np.column_stack([np.interp(at, times, column) for column in _sums(steps).T])


def _sums(steps: Array) -> Array:
    return np.cumsum(np.concatenate([np.zeros((1, *steps.shape[1:])), steps]), axis=0)
