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
"""Motion from GNSS: tracks, the frame of a velocity, manoeuvres."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
import math
from typing import NamedTuple

from ins_align.geometry.rotation import Array
import numpy as np

EARTH_RADIUS = 6_371_000.0  # m, mean sphere: distances to 0.5 percent
GRID = 0.5  # s, spacing of velocities that are compared
MAX_GAP = 3.0  # s without GNSS over which nothing is interpolated
MANOEUVRE_SPEED, MANOEUVRE_TIME = 5.0, 20.0  # change of velocity, m/s, within so many s
# Distance over which velocity and position are compared: m, and at least so many sigmas of a
# position; times, s, in which a vehicle may cover it, and how many distances it takes.
MIN_DISTANCE, DISTANCE_SIGMAS = 10.0, 10.0
# Positions with a sigma of at most so much (m) do not wander: where a vehicle is faster (m/s),
# they are compared over less (m).
SHARP_STD, SHARP_SPEED, SHARP_DISTANCE = 0.1, 0.5, 2.0
SPANS = 2.0, 4.0, 8.0, 16.0, 30.0
MIN_WINDOWS = 4
MAX_FRAME_ANGLE = math.radians(20.0)
MIN_CONCENTRATION = 0.9  # mean length of unit vectors above which directions agree


class Series(NamedTuple):
    """Vectors over time."""

    times: Array  # (N,), s, increasing
    vectors: Array  # (N, 3), ENU


EMPTY = Series(np.zeros(0), np.zeros((0, 3)))


@dataclass(frozen=True)
class VelocityFrame:
    """How a velocity compares with the change of position."""

    frame: str  # enu, ned, turned, body, contradiction or unknown
    windows: int  # number of distances that were compared
    angle_deg: float | None = None  # of a turned frame against ENU, counter-clockwise
    speed_ratio: float | None = None  # integral of velocity over change of position


def series_of(times: Array, vectors: Array) -> Series:
    """Sort vectors, (N, M), by their times, (N,), s; of equal times the first counts."""
    times, first = np.unique(times, return_index=True)
    return Series(times, vectors[first])


def series_of_rows(rows: Collection[tuple[float, ...]]) -> Series:
    """Return a series of rows that begin with the time; it is empty if there are none."""
    return series_of(*np.split(np.array(rows), [1], axis=1)) if rows else EMPTY


def track(positions_deg: Series) -> Series:
    """
    Return positions, latitude and longitude, degrees, and altitude, as ENU metres from the first.

    Each step east or north is that on a sphere at the latitude where it is made.
    """
    latitude, longitude = np.radians(positions_deg.vectors[:, :2]).T
    metres = positions_deg.vectors - positions_deg.vectors[:1]
    steps = np.remainder(np.diff(longitude) + np.pi, 2.0 * np.pi) - np.pi
    metres[1:, 0] = np.cumsum(steps * np.cos(latitude[1:])) * EARTH_RADIUS
    metres[:, 1] = (latitude - latitude[:1]) * EARTH_RADIUS
    metres[:1] = 0.0
    return Series(positions_deg.times, metres)


def position_noise(positions: Series) -> float:
    """Return an upper bound of the white noise of positions, 1 sigma per axis, m."""
    if positions.times.size < 5:
        return math.inf
    second = np.diff(positions.vectors[:, :2], n=2, axis=0)
    return float(np.median(np.abs(second)) / 0.6745 / math.sqrt(6.0))


def without_wild_positions(positions: Series) -> Series:
    """
    Leave out positions that are far from the median of the five around them.

    Far is half of the distance over which they are compared with velocities. The first two and
    the last two positions cannot be judged and stay.
    """
    vectors = positions.vectors
    if vectors.shape[0] < 5:
        return positions
    medians = np.median(np.lib.stride_tricks.sliding_window_view(vectors, 5, axis=0), axis=-1)
    limit = 0.5 * max(MIN_DISTANCE, DISTANCE_SIGMAS * position_noise(positions))
    off = np.abs(vectors[2:-2] - medians)
    near = np.ones(vectors.shape[0], bool)
    # Receivers are about half as good vertically.
    near[2:-2] = (np.hypot(off[:, 0], off[:, 1]) < limit) & (off[:, 2] < 2.0 * limit)
    return Series(positions.times[near], vectors[near])


def velocity_from_positions(positions: Series) -> Series:
    """Differentiate positions every GRID s, over a time that leaves about 0.35 m/s of noise."""
    if positions.times.size < 2:
        return EMPTY
    span = min(max(4.0 * position_noise(positions), 2.0), 20.0)
    times = _grid(positions.times)
    before, after = (_at(positions, times + sign * span / 2) for sign in (-1.0, 1.0))
    return _finite(times, (after - before) / span)


def differences(positions: Series) -> Series:
    """Return the velocity between neighbouring positions."""
    times, vectors = positions
    return EMPTY if times.size < 2 else Series(
        0.5 * (times[1:] + times[:-1]), np.diff(vectors, axis=0) / np.diff(times)[:, None])


def on_grid(velocities: Series) -> Series:
    """Return velocities every GRID s, without single outliers."""
    if velocities.times.size < 3:
        return velocities
    v = velocities.vectors.copy()
    v[1:-1] = np.median([v[:-2], v[1:-1], v[2:]], axis=0)
    times = _grid(velocities.times)
    return _finite(times, _at(Series(velocities.times, v), times))


def velocity_frame(velocities: Series, positions: Series, sharp: bool = False) -> VelocityFrame:
    """
    Find the frame of velocities, m/s, taken as ENU, from the change of position, ENU, m.

    The frame is 'unknown' if the vehicle covered fewer than MIN_WINDOWS distances, which may be
    shorter if positions are `sharp`.
    """
    moved, travelled = _distances(velocities, positions, sharp)
    count = moved.shape[0]
    if count < MIN_WINDOWS:
        return VelocityFrame('unknown', count)
    moved_h, travelled_h = moved[:, 0] + 1j * moved[:, 1], travelled[:, 0] + 1j * travelled[:, 1]
    ratio = float(np.median(np.abs(travelled_h) / np.abs(moved_h)))
    if not 0.7 < ratio < 1.4:
        return VelocityFrame('contradiction', count, speed_ratio=ratio)
    as_enu = _mean_direction(moved_h * travelled_h.conj())
    as_ned = _mean_direction(moved_h * (1j * travelled_h.conj()).conj())
    frames = [(abs(mean), name) for name, mean in (('enu', as_enu), ('ned', as_ned))
              if abs(mean) > MIN_CONCENTRATION and abs(np.angle(mean)) < MAX_FRAME_ANGLE]
    if frames:
        return VelocityFrame(max(frames)[1], count, speed_ratio=ratio)
    if abs(as_enu) > MIN_CONCENTRATION:
        return VelocityFrame('turned', count, float(np.degrees(-np.angle(as_enu))), ratio)
    return VelocityFrame('body', count, speed_ratio=ratio)


def least_distance(seconds: float, sharp: bool) -> float:
    """Return the least distance, m, covered in some time, over which velocities are compared."""
    if not sharp or seconds < SPANS[0]:
        return MIN_DISTANCE
    return min(MIN_DISTANCE, max(SHARP_DISTANCE, SHARP_SPEED * seconds))


def find_manoeuvres(velocities: Series) -> tuple[float, float | None]:
    """
    Find changes of the horizontal velocity, which make a heading observable.

    Returns the largest within MANOEUVRE_TIME, m/s, and when the first of MANOEUVRE_SPEED begins,
    s. Velocities are two or more, every GRID s.
    """
    times, v = velocities.times, velocities.vectors[:, :2]
    largest = 0.0
    until = np.full(times.size, math.inf)  # when the change since each time is MANOEUVRE_SPEED
    for lag in range(1, min(round(MANOEUVRE_TIME / GRID), times.size - 1) + 1):
        change = np.hypot(*(v[lag:] - v[:-lag]).T)
        change[times[lag:] - times[:-lag] > MANOEUVRE_TIME] = 0.0
        largest = max(largest, float(change.max()))
        np.minimum(until[:-lag], np.where(change >= MANOEUVRE_SPEED, times[lag:], math.inf),
                   out=until[:-lag])
    ends = until[np.isfinite(until)]
    # The latest of all times from which the first change counts is when it begins.
    return largest, float(times[until <= ends[0]][-1]) if ends.size else None


def _distances(velocities: Series, positions: Series, sharp: bool) -> tuple[Array, Array]:
    """Return the change of position and the integral of velocity, (K, 3), over K distances."""
    best = np.zeros((0, 3)), np.zeros((0, 3))
    if velocities.times.size < 2 or positions.times.size < 2:
        return best
    steps, v = np.diff(velocities.times), velocities.vectors
    # The fourth column is the number of gaps.
    integral = np.zeros((v.shape[0], 4))
    integral[1:] = np.cumsum(np.column_stack(
        [0.5 * (v[1:] + v[:-1]) * steps[:, None], steps > MAX_GAP]), axis=0)
    noise = DISTANCE_SIGMAS * position_noise(positions)
    for span in SPANS:
        starts = np.unique(np.floor(positions.times / span)) * span
        moved, travelled = (
            _at(series, starts + span) - _at(series, starts)
            for series in (positions, Series(velocities.times, integral)))
        least = max(least_distance(span, sharp), noise)
        good = (np.hypot(moved[:, 0], moved[:, 1]) >= least) & (travelled[:, 3] == 0.0)
        if np.count_nonzero(good) > best[0].shape[0]:
            best = moved[good], travelled[good, :3]
    return best


def _mean_direction(numbers: np.ndarray) -> complex:
    """Return the mean of complex numbers, each divided by its magnitude."""
    lengths = np.abs(numbers)
    return complex(np.mean(numbers / np.where(lengths > 0.0, lengths, np.inf)))


def _grid(times: Array) -> Array:
    # Only near the data, because clocks may jump by years.
    cells = np.unique((times / GRID).astype(np.int64))
    cells = np.unique(cells[:, None] + np.arange(round(MAX_GAP / GRID)))
    return cells[(cells * GRID >= times[0]) & (cells * GRID <= times[-1])] * GRID


def _at(series: Series, times: Array) -> Array:
    """Interpolate at times; NaN outside the series and in its gaps."""
    after = np.clip(np.searchsorted(series.times, times), 1, series.times.size - 1)
    start, end = series.times[after - 1], series.times[after]
    values = np.column_stack([np.interp(times, series.times, column)
                              for column in series.vectors.T])
    values[(times < start) | (times > end) | (end - start > MAX_GAP)] = np.nan
    return values


def _finite(times: Array, vectors: Array) -> Series:
    good = np.isfinite(vectors).all(axis=1)
    return Series(times[good], vectors[good])
