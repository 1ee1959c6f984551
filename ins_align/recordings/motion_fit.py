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
Fits the motion that an IMU feels to the velocity of a GNSS receiver: its delay and its noise.

In windows of some seconds the velocity integration formula holds with a constant rotation,
``v_n(t) + g t = v_0 + C_n0 [integral of C_0b f + C_0b (w x l)]``. Rotation, v_0, biases and lever
arm are fitted in each window by least squares, for one delay after the other. The delay is where
the likelihood is largest, with a noise of its own in each window; the noise is what is left there.
"""

from __future__ import annotations

import math

from ins_align.estimation.receiver import MOVING
from ins_align.geometry.rotation import (
    Array, cumulative_rotations, exp_so3, nearest_rotation, skew)
from ins_align.gnss.motion import Series
from ins_align.imu.buffer import MAX_GAP_NS
import numpy as np

CELL = 0.05  # s over which the IMU is integrated at a time
FIT_WINDOW, MIN_EPOCHS = 10.0, 20  # s and GNSS epochs in a window
MIN_WINDOWS = 3
DELAYS = np.arange(-0.5, 1.25, 0.1)  # s
MAX_DELAY_STD = 0.05  # s: what is known less well is not told
# Clocks are wrong by whole seconds, or by those between UTC, GPS and TAI (s). Delays around these
# are tried unless one is surely below `USUAL_DELAY` (s): in the first minutes (s), and up to this
# share of the recording, for what has no counterpart then is lost.
WRONG_CLOCKS = (-37.0, -19.0, -18.0, -4.5, -3.0, -1.5, 1.5, 3.0, 4.5, 18.0, 19.0, 37.0)
USUAL_DELAY, FIRST_MINUTES, SHARE = 0.3, 600.0, 0.25
# 1 sigma before the fit: gyro bias, rad/s, lever arm, m, accelerometer bias, m/s^2, for a
# velocity noise of VELOCITY_STD, m/s. Rotation and v_0 are free.
VELOCITY_STD = 0.2
PRIOR_STD = np.repeat([1e4, 1e4, math.radians(0.5), 3.0, 0.5], 3)
MAX_TURN_STD = 0.2  # rad: a rotation that is known less well is open
OUTLIER = 6.0  # times the median size of residuals
LONGEST = 3600.0  # s from the first motion on that are looked at: memory is bounded


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
    the delay, which is searched from 0.5 s below to 1.2 s above each of the offsets, s, and, if it
    is unusual or unknown then, around `WRONG_CLOCKS` too.

    Returns figures, s and m/s, as far as motion and data tell them: ``gnss_delay`` (stamps less
    the times of measurement on the clock of the IMU), ``gnss_delay_std``, ``velocity_noise``
    (horizontal, per axis), ``velocity_noise_vertical``.
    """
    found = _fit_motion(samples, velocities, gravity, offsets, LONGEST)
    if 'gnss_delay' in found and (
            abs(found['gnss_delay']) + 3.0 * found['gnss_delay_std'] < USUAL_DELAY):
        return found
    reach = SHARE * np.ptp(velocities.times) if velocities.times.size else 0.0
    wrong = [offset for offset in WRONG_CLOCKS if abs(offset) < reach]
    far = _fit_motion(samples, velocities, gravity, (*offsets, *wrong), FIRST_MINUTES)
    return far if far.get('gnss_delay_std', math.inf) < MAX_DELAY_STD else found


def _fit_motion(samples: Series, velocities: Series, gravity: float, offsets: tuple[float, ...],
                longest: float) -> dict[str, float]:
    """Fit as `fit_motion`, around these offsets alone, so many seconds from the first motion."""
    delays = np.concatenate([offset + DELAYS for offset in offsets])
    moving = np.flatnonzero(np.hypot(*velocities.vectors[:, :2].T) > MOVING)
    start = velocities.times[moving[0]] - 2.0 * FIT_WINDOW if moving.size else 0.0
    velocities = Series(*(column[(velocities.times >= start) & (
        velocities.times < start + longest)] for column in velocities))
    part = slice(*np.searchsorted(samples.times, [
        start - delays.max() - 1.0, start + longest]).tolist())
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
