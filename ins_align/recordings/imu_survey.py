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

import math
from typing import NamedTuple

from ins_align.checks import ANY_GYRO_RATE, degrees_fault
from ins_align.config import CHIP_THRESHOLDS, Config, ImuNoise, PRESETS
from ins_align.estimation.receiver import MOVING
from ins_align.geometry.earth import EARTH_RATE
from ins_align.geometry.rotation import (
    Array, cumulative_rotations, exp_so3, nearest_rotation, skew)
from ins_align.gnss.motion import GRID, Series
from ins_align.imu.buffer import MAX_GAP_NS, SAME_VALUES
from ins_align.imu.noise import force_fault, white_noise
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
ON_LATTICE = 0.1  # of a quantum: how far a value may be off its multiples
MIN_REPEATS = 3  # samples for each value: with fewer the digits of a text may be the quantum
MIN_ZEROS, MIN_ZERO_SHARE = 20, 0.01  # samples that are exactly 0 because of a dead band

CELL = 0.05  # s over which the IMU is integrated at a time
FIT_WINDOW, MIN_EPOCHS = 10.0, 20  # s and GNSS epochs in a window
MIN_WINDOWS = 3
DELAYS = np.arange(-0.5, 1.25, 0.1)  # s
MAX_DELAY_STD = 0.05  # s: what is known less well is not told
# 1 sigma before the fit: gyro bias, rad/s, lever arm, m, accelerometer bias, m/s^2, for a
# velocity noise of VELOCITY_STD, m/s. Rotation and v_0 are free.
VELOCITY_STD = 0.2
PRIOR_STD = np.repeat([1e4, 1e4, math.radians(0.5), 3.0, 0.5], 3)
MAX_TURN_STD = 0.2  # rad: a rotation that is known less well is open
OUTLIER = 6.0  # times the median size of residuals
LONGEST = 3600.0  # s from the first motion on that are looked at: memory is bounded


class Sensor(NamedTuple):
    """How the figures of a sensor are printed: units, and their sizes in SI units."""

    name: str
    unit: str
    size: float
    walk_unit: str  # of 1 / 60 of that size in SI units


SENSORS = (Sensor('gyroscopes', 'deg/s', math.radians(1.0), 'deg/sqrt(h)'),
           Sensor('accelerometers', 'm/s^2', 1.0, 'm/s/sqrt(h)'))


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
    rates = (SAME_VALUES if not np.ptp(values, axis=0).any() else
             'all angular rates are 0' if max_rate == 0.0 else
             degrees_fault(max_rate > ANY_GYRO_RATE, grid, *np.split(cells, 2, axis=1),
                           velocities))
    for fault in filter(None, (force_fault(force), rates)):
        imu.add(fault, fault=True)
    x, y, z = up.tolist()
    imu.add(f'specific force: {force:.2f} m/s^2 on average, mean direction '
            f'({x:+.2f}, {y:+.2f}, {z:+.2f})', mean_force=force, up=[x, y, z])
    if imu.faults:
        return  # the rest would be in wrong units
    if z < 0.5:
        imu.add('on average the specific force does not point along the z axis of the IMU: the '
                'attitude will be that of the axes as they are, however the IMU is mounted')
    imu.add(f'angular rate: up to {math.degrees(max_rate):.0f} deg/s',
            max_rate_deg_s=math.degrees(max_rate))
    _add_noise(imu, samples, _longest_rest(grid, cells, velocities), gravity)


def _add_noise(imu: Surveyed, samples: Series, rest: tuple[float, float] | None, gravity: float,
               ) -> None:
    """Add resolution, noise, biases and grade, of all or of what is at rest."""
    times, values = samples
    part = slice(None) if rest is None else slice(*np.searchsorted(times, rest))
    rate, force = values[part].mean(axis=0).reshape(2, 3)
    off_gravity = float(np.linalg.norm(force) - gravity)
    widths = np.array([_add_resolution(imu, sensor, triad)
                       for sensor, triad in zip(SENSORS, np.split(values, 2, axis=1))])
    walks = _walks(times[part], values[part], 0.5 if rest else QUIET)
    root = math.sqrt(np.median(np.diff(times)))
    # Noise of half a quantum carries small values over it; less leaves an error that lasts.
    hidden = walks < widths * root
    lost = np.where(hidden, widths / math.sqrt(3.0), 0.0)  # uniform, 1 sigma
    walks = np.maximum(walks, lost * root)
    # What the Earth's rate does not explain is bias, in whatever direction.
    bias = abs(float(np.linalg.norm(rate)) - EARTH_RATE) / math.sqrt(3.0)
    measured = ImuNoise(*walks, *map(math.hypot, lost, (bias, off_gravity) if rest else (0, 0)))
    grade, covers = _grade(measured)
    preset = PRESETS[grade if rest else Config.imu_grade]
    settings, biases = {}, {}
    # Other noise is measured by the alignment itself; what is rounded away does not look noisy.
    if hidden[0] and measured.angle_random_walk > preset.angle_random_walk:
        settings['angle_random_walk'] = rounded(math.degrees(60.0 * measured.angle_random_walk))
    if measured.gyro_bias_std > preset.gyro_bias_std * (1.0 if hidden[0] else BIAS_SIGMAS):
        biases['gyro_bias_std'] = rounded(math.degrees(measured.gyro_bias_std))
    if measured.accel_bias_std > preset.accel_bias_std * BIAS_SIGMAS:
        biases['accel_bias_std'] = rounded(measured.accel_bias_std)
    shown = [f'{60.0 * walk / sensor.size:.2g} {sensor.walk_unit}'
             + ' of rounding' * bool(rounding)
             for walk, rounding, sensor in zip(walks, hidden, SENSORS)]
    imu.add(f'noise: {", ".join(shown)}' + ('' if rest else ' at most, measured in motion'),
            settings if rest else settings | biases,
            angle_random_walk=math.degrees(60.0 * walks[0]),
            velocity_random_walk=float(60.0 * walks[1]))
    if rest is None:
        imu.add(f'imu_grade: {Config.imu_grade} is the default; not seen at rest, which would '
                'show biases' + f'; its noise is no worse than that of {grade}' * covers,
                imu_grade=grade)
        return
    degrees_s = np.degrees(rate).tolist()
    within = [f' +- {width / sensor.size:.2g}' * bool(rounding)
              for width, rounding, sensor in zip(widths, hidden, SENSORS)]
    imu.add(f'at rest for {rest[1] - rest[0]:.0f} s: rate '
            f'({", ".join(f"{each:+.4f}" for each in degrees_s)}){within[0]} deg/s, specific '
            f'force {off_gravity:+.3f}{within[1]} m/s^2 off gravity', biases,
            rest_s=rest[1] - rest[0], rest_rate_deg_s=degrees_s, rest_force_error=off_gravity)
    noisy = np.any(~hidden & (walks > NOISE_MARGIN * np.array(preset[:2])))
    imu.add(f'suits imu_grade {grade}' if covers else f'worse than imu_grade {grade}'
            + ': more noise is measured while aligning' * bool(noisy),
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


def _add_resolution(imu: Surveyed, sensor: Sensor, values: Array) -> float:
    """
    Add the resolution of a sensor, values of shape (N, 3), of its coarsest axis.

    Returns the largest error of what is rounded to a multiple of the quantum or to 0.
    """
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
    dead_band *= dead_band > 1.5 * quantum
    exactly = f': {zeros:.0%} of the samples of an axis are exactly 0' * (zeros > 0.01)
    for figure, text, value in (
            ('quantum', 'round to multiples of', quantum),
            ('dead_band', 'have a dead band: nothing between 0 and', dead_band)):
        line = f'{sensor.name} {text} {value / sensor.size:.2g} {sensor.unit}{exactly}'
        imu.add(line if value else '', **{f'{sensor.name}_{figure}': value})
    return max(0.5 * quantum, dead_band)


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
    # A vehicle that is carried stands for GNSS; of a long rest that is disturbed the rest counts.
    limits = np.repeat([REST_RATE, REST_FORCE], 3)
    calm = np.all(np.abs(np.diff(cells, axis=0)) < 2.0 * limits, axis=1)
    calm = np.append(calm, True) & np.insert(calm, 0, True)
    still = np.concatenate([[False], near & calm & (speed < REST_SPEED), [False]])
    runs = np.flatnonzero(np.diff(still.astype(np.int8))).reshape(-1, 2).tolist()
    for start, end in sorted(runs, key=lambda run: run[0] - run[1]):
        # The first and the last second may belong to stopping and setting off.
        rest = slice(start + 2, end - 2)
        if (end - start) * GRID >= MIN_REST and np.all(
                cells[rest].std(axis=0) < limits):
            first, last = grid[rest][[0, -1]].tolist()
            return first - 0.5 * GRID, last + 0.5 * GRID
    return None


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


def fit_motion(samples: Series, velocities: Series, gravity: float,
               offsets: tuple[float, ...] = (0.0,)) -> dict[str, float]:
    """
    Fit the motion of an IMU to that of a GNSS receiver.

    Samples, shape (N, 6), rad/s and m/s^2, and velocities, ENU, m/s, are on the same clock but for
    the delay, which is searched from 0.5 s below to 1.2 s above each of the offsets, s.

    Returns figures, s and m/s, as far as motion and data tell them: ``gnss_delay`` (stamps less
    the times of measurement on the clock of the IMU), ``gnss_delay_std``, ``velocity_noise``
    (horizontal, per axis), ``velocity_noise_vertical``.
    """
    delays = np.concatenate([offset + DELAYS for offset in offsets])
    moving = np.flatnonzero(np.hypot(*velocities.vectors[:, :2].T) > MOVING)
    start = velocities.times[moving[0]] - 2.0 * FIT_WINDOW if moving.size else 0.0
    velocities = Series(*(column[(velocities.times >= start) & (
        velocities.times < start + LONGEST)] for column in velocities))
    part = slice(*np.searchsorted(samples.times, [
        start - delays.max() - 1.0, start + LONGEST]).tolist())
    times, values = samples.times[part], samples.vectors[part]
    if velocities.times.size < MIN_WINDOWS * MIN_EPOCHS or times.size < 2:
        return {}
    windows = _windows(times, velocities.times, delays)
    if windows.shape[0] < MIN_WINDOWS:
        return {}
    imu = _Imu(times, *np.split(values, 2, axis=1))
    epochs, v_n = velocities.times[windows], velocities.vectors[windows]
    good = np.ones(windows.shape)
    costs, left, turn_std = zip(*(
        _fit(imu, epochs - delay, v_n, good, gravity) for delay in delays))
    # Steady motion leaves the heading open, and with it tells nothing of the delay.
    telling = np.median(turn_std, axis=0) < MAX_TURN_STD
    coarse = -1.5 * windows.shape[1] * np.log(costs)[:, telling]
    place = int(np.argmax(coarse.sum(axis=1)))
    size = np.linalg.norm(left[place], axis=2)
    good = (size < OUTLIER * np.median(size)).astype(float)
    # Once more around the best one, without outliers.
    near = delays[place] + (DELAYS[1] - DELAYS[0]) * np.arange(-1.0, 2.0)
    costs, left, _ = zip(*(_fit(imu, epochs - delay, v_n, good, gravity) for delay in near))
    free = np.maximum(3.0 * good.sum(axis=1) - PRIOR_STD.size, 1.0)
    likelihood = (-0.5 * free * np.log(costs))[:, telling]
    delay, std = _maximum(near, likelihood.sum(axis=1))
    known = (std < MAX_DELAY_STD and np.count_nonzero(telling) >= MIN_WINDOWS
             and 0 < place % DELAYS.size < DELAYS.size - 1)
    # Of clocks that drift apart the halves of the recording show another delay.
    halves = [_maximum(near, half.sum(axis=1))[0]
              for half in np.array_split(likelihood, 2, axis=1)]
    figures = {'gnss_delay': delay,
               'gnss_delay_std': max(std, 0.5 * abs(halves[1] - halves[0]))} if known else {}
    # Of windows in motion, if there are: standing, receivers are better than they are.
    chosen = np.hypot(v_n[..., 0], v_n[..., 1]).mean(axis=1) > MOVING
    chosen |= np.count_nonzero(chosen) < MIN_WINDOWS
    # The fit has taken some of the noise away; the median does without the outliers.
    scale = math.sqrt(3.0 * good.sum() / free.sum()) / 0.6745
    size = scale * np.abs(left[1][chosen][good[chosen] > 0.0])
    return figures | {'velocity_noise': float(np.median(size[:, :2])),
                      'velocity_noise_vertical': float(np.median(size[:, 2]))}


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
    C_n0 = nearest_rotation(np.swapaxes(weight * centred[0], 1, 2) @ centred[1])
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
