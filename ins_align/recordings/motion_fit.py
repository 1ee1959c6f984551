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
Estimates delay and noise of a GNSS velocity by fitting it to the motion that an IMU measures.

In windows of some seconds the velocity integration formula holds with a constant rotation,
``v_n(t) + g t = v_0 + C_n0 [integral of C_0b f + C_0b (w x l)]``. For each of several delays, a
least-squares fit in each window gives rotation, v_0, biases and lever arm. The delay is where the
likelihood is largest, with a noise of its own in each window; the residuals there show the noise.
"""

import math

from ins_align.estimation.receiver import MOVING
from ins_align.geometry.rotation import (
    Array, cumulative_rotations, exp_so3, nearest_rotation, skew)
from ins_align.gnss.motion import Series
from ins_align.imu.buffer import MAX_GAP_NS
import numpy as np

CELL = 0.05  # s, the step of the integration of the IMU
FIT_WINDOW, MIN_EPOCHS = 10.0, 20  # usual length of a window, s, and least number of GNSS epochs
MIN_WINDOWS = 3
DELAYS = np.arange(-0.5, 1.25, 0.1)  # s, tried around each offset
DELAY_STEP = DELAYS[1] - DELAYS[0]
MAX_DELAY_STD = 0.05  # s: a delay that is less well known is not returned
# Clocks are wrong by a few seconds, or by the differences between UTC, GPS and TAI. Unless a delay
# is found that is surely below `USUAL_DELAY` (s), delays around these offsets (s) are tried with
# the first minutes (s) of the data. An offset is at most a share of the duration, since it leaves
# that much of the data without a counterpart.
WRONG_CLOCKS = (-37.0, -19.0, -18.0, -4.5, -3.0, -1.5, 1.5, 3.0, 4.5, 18.0, 19.0, 37.0)
USUAL_DELAY, FIRST_MINUTES, MAX_OFFSET_SHARE = 0.3, 600.0, 0.25
# 1 sigma before the fit of v_0, m/s, rotation, rad (both practically free), gyro bias, rad/s,
# lever arm, m, accelerometer bias, m/s^2, for a velocity noise of VELOCITY_STD, m/s.
VELOCITY_STD = 0.2
PRIOR_STD = np.repeat([1e4, 1e4, math.radians(0.5), 3.0, 0.5], 3)
MAX_ROTATION_STD = 0.2  # rad: a window whose rotation is less well known does not show the delay
OUTLIER = 6.0  # times the median size of residuals
MAX_FITTED_TIME = 3600.0  # s, from the first motion on, which bounds the memory


class _Imu:
    """Integrals of all IMU samples, in the axes of the IMU at the first sample."""

    def __init__(self, times: Array, gyro: Array, accel: Array) -> None:
        self._start = float(times[0])
        edges = np.arange(self._start, float(times[-1]), CELL)
        angle, force = (np.diff(_interpolated_integral(times, values, edges), axis=0)
                        for values in (gyro, accel))
        C_0b = np.concatenate([np.eye(3)[None], cumulative_rotations(exp_so3(angle))])
        middle = C_0b[:-1] @ exp_so3(0.5 * angle)
        force = (middle @ force[..., None])[..., 0]
        attitude = _sums(middle * CELL)  # derivative of the velocity to an accelerometer bias
        rate = np.concatenate([angle[:1], 0.5 * (angle[1:] + angle[:-1]), angle[-1:]]) / CELL
        # At each edge, side by side: the velocity, (3, 1), and its derivatives, (3, 3) each, to
        # gyro bias, accelerometer bias and lever arm.
        self._rows = np.concatenate([_sums(force)[..., None], _sums(
            skew(force) @ (0.5 * (attitude[1:] + attitude[:-1]))), attitude,
            C_0b @ skew(rate)], axis=2)

    def between(self, start: Array, times: Array) -> tuple[Array, Array, Array, Array]:
        """
        Return integrals from one time in each of M windows, (M, 1), to n others, (M, n), s.

        These are the integral of the specific force, shape (M, n, 3), m/s, and its derivatives to
        gyro bias, accelerometer bias and lever arm, each of shape (M, n, 3, 3).
        """
        before, after = self._at(start), self._at(times)
        velocity, by_gyro, by_accel = np.split((after - before)[..., :7], [1, 4], axis=3)
        return (velocity[..., 0], by_gyro - skew(velocity[..., 0]) @ before[..., 4:7], by_accel,
                after[..., 7:])

    def _at(self, times: Array) -> Array:
        place = (times - self._start) / CELL
        cell = np.clip(place.astype(np.int64), 0, self._rows.shape[0] - 2)
        share = (place - cell)[..., None, None]
        rows: Array = self._rows[cell] * (1.0 - share) + self._rows[cell + 1] * share
        return rows


def fit_motion(samples: Series, velocities: Series, gravity: float,
               offsets: tuple[float, ...] = (0.0,)) -> dict[str, float]:
    """
    Fit the motion of an IMU to that of a GNSS receiver.

    Samples, shape (N, 6), rad/s and m/s^2, and velocities, ENU, m/s, have the same clock apart
    from the delay. It is searched from 0.5 s below to 1.2 s above each of the offsets, s, and if
    it is then unusual or unknown, around `WRONG_CLOCKS` too.

    Returns those figures, s and m/s, that the data show: ``gnss_delay`` (stamp minus the time of
    measurement by the clock of the IMU), ``gnss_delay_std``, ``velocity_noise`` (horizontal, per
    axis), ``velocity_noise_vertical``.
    """
    found = _fit_motion(samples, velocities, gravity, offsets, MAX_FITTED_TIME)
    if 'gnss_delay' in found and found['gnss_delay_std'] < min(
            MAX_DELAY_STD, (USUAL_DELAY - abs(found['gnss_delay'])) / 3.0):
        return found
    reach = MAX_OFFSET_SHARE * np.ptp(velocities.times) if velocities.times.size else 0.0
    wrong = [offset for offset in WRONG_CLOCKS if abs(offset) < reach]
    far = _fit_motion(samples, velocities, gravity, (*offsets, *wrong), FIRST_MINUTES)
    (delay, std), (far_delay, far_std) = (
        [fit.get(name, math.inf) for name in ('gnss_delay', 'gnss_delay_std')]
        for fit in (found, far))
    if abs(far_delay - delay) > DELAY_STEP and far_std < max(std, MAX_DELAY_STD):
        found = far     # otherwise `found` is of more data
    if found.get('gnss_delay_std', 0.0) >= MAX_DELAY_STD:
        del found['gnss_delay'], found['gnss_delay_std']
    return found


def _fit_motion(samples: Series, velocities: Series, gravity: float, offsets: tuple[float, ...],
                longest: float) -> dict[str, float]:
    """
    Fit as `fit_motion`, around these offsets only, `longest` s from the first motion on.

    The delay is returned if it shows at all; its sigma is infinite at an end of what was tried.
    """
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
    costs, residuals, rotation_std = zip(*(
        _fit(imu, epochs - delay, v_n, good, gravity) for delay in delays))
    # Steady motion leaves the heading open and does not show the delay either.
    telling = np.median(rotation_std, axis=0) < MAX_ROTATION_STD
    coarse = -1.5 * windows.shape[1] * np.log(costs)[:, telling]
    place = int(np.argmax(coarse.sum(axis=1)))
    size = np.linalg.norm(residuals[place], axis=2)
    good = (size < OUTLIER * np.median(size)).astype(float)
    # Once more around the best delay, without outliers.
    near = delays[place] + DELAY_STEP * np.arange(-1.0, 2.0)
    costs, residuals, _ = zip(*(_fit(imu, epochs - delay, v_n, good, gravity) for delay in near))
    free = np.maximum(3.0 * good.sum(axis=1) - PRIOR_STD.size, 1.0)
    likelihood = (-0.5 * free * np.log(costs))[:, telling]
    delay, std = _maximum(near, likelihood.sum(axis=1))
    if not 0 < place % DELAYS.size < DELAYS.size - 1:
        std = math.inf      # it may be further off
    # If the clocks drift, the two halves of the recording show different delays.
    halves = [_maximum(near, half.sum(axis=1))[0]
              for half in np.array_split(likelihood, 2, axis=1)]
    shown = np.count_nonzero(telling) >= MIN_WINDOWS
    figures = {'gnss_delay': delay,
               'gnss_delay_std': max(std, 0.5 * abs(halves[1] - halves[0]))} if shown else {}
    # Noise in motion, if enough windows have it: at rest, receivers look better than they are.
    chosen = np.hypot(v_n[..., 0], v_n[..., 1]).mean(axis=1) > MOVING
    chosen |= np.count_nonzero(chosen) < MIN_WINDOWS
    # Scaled for the noise that the fit absorbs, and from the median to 1 sigma.
    scale = math.sqrt(3.0 * good.sum() / free.sum()) / 0.6745
    size = scale * np.abs(residuals[1][chosen][good[chosen] > 0.0])
    return figures | {'velocity_noise': float(np.median(size[:, :2])),
                      'velocity_noise_vertical': float(np.median(size[:, 2]))}


def _windows(times: Array, epochs: Array, delays: Array) -> np.ndarray:
    """Return the epochs of windows without gaps and within the IMU data, indices, (M, n)."""
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
    Fit v_0 and rotation at the middle, biases and lever arm in M windows of n epochs.

    The measurements have times by the clock of the IMU, (M, n), s, velocities in ENU, (M, n, 3),
    m/s, and weights `good`, 0 or 1, (M, n). Returns the sums of squares, (M,), the residuals in
    ENU, (M, n, 3), m/s, and the uncertainty of the rotation, 1 sigma, rad, (M,).
    """
    middle = times.mean(axis=1, keepdims=True)
    from_imu, by_gyro, by_accel, by_lever = imu.between(middle, times)
    from_gnss = v_n + (times - middle)[..., None] * [0.0, 0.0, gravity]
    used_epochs = np.maximum(good.sum(axis=1), 1.0)
    weight = (good / used_epochs[:, None])[..., None]
    centred = [vectors - np.sum(weight * vectors, axis=1, keepdims=True)
               for vectors in (from_gnss, from_imu)]
    C_n0 = nearest_rotation(np.swapaxes(weight * centred[0], 1, 2) @ centred[1])
    count, epochs = times.shape
    by_v_0 = np.broadcast_to(np.eye(3), by_gyro.shape)
    J = np.concatenate([by_v_0, -skew(from_imu), by_gyro, by_lever, by_accel],
                       axis=3).reshape(count, 3 * epochs, PRIOR_STD.size)
    priors = np.square(VELOCITY_STD / PRIOR_STD)
    good_rows = np.repeat(good, 3, axis=1)
    weighted = np.swapaxes(J * good_rows[..., None], 1, 2)
    normal = weighted @ J + np.diag(priors)
    for _ in range(2):
        y = (from_gnss @ C_n0 - from_imu).reshape(count, -1, 1)
        x = np.linalg.solve(normal, weighted @ y)
        residuals = (y - J @ x)[..., 0]
        cost = np.sum(good_rows * residuals ** 2, axis=1) + x[..., 0] ** 2 @ priors
        C_n0, used = C_n0 @ exp_so3(x[:, 3:6, 0]), C_n0
    variance = np.trace(
        np.linalg.inv(normal)[:, 3:6, 3:6], axis1=1, axis2=2) * cost / used_epochs
    return (cost + 1e-12, residuals.reshape(count, epochs, 3) @ np.swapaxes(used, 1, 2),
            np.sqrt(variance / 3.0))


def _maximum(delays: Array, likelihood: Array) -> tuple[float, float]:
    """Return where a parabola through three log likelihoods is largest, and its sigma, s."""
    before, here, after = likelihood.tolist()
    curvature = (2.0 * here - before - after) / DELAY_STEP ** 2
    if curvature <= 0.0:
        return float(delays[1]), math.inf
    return (float(delays[1] + (after - before) / (2.0 * DELAY_STEP * curvature)),
            curvature ** -0.5)


def _interpolated_integral(times: Array, values: Array, at: Array) -> Array:
    """Integrate by the trapezoidal rule; return the integral at some times."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times)[:, None]
    return np.column_stack([np.interp(at, times, column) for column in _sums(steps).T])


def _sums(steps: Array) -> Array:
    """Return the cumulative sums along the first axis, from 0 on."""
    return np.cumsum(np.concatenate([np.zeros((1, *steps.shape[1:])), steps]), axis=0)
