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
"""What the GNSS data of a recording tell before any alignment: velocity frame, manoeuvres."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import NamedTuple

from ins_align.geometry.rotation import Array
import numpy as np

EARTH_RADIUS = 6_371_000.0  # m, mean sphere: distances to 0.5 percent
GRID = 0.5  # s, spacing on which velocities are compared
MAX_GAP = 3.0  # s without GNSS over which nothing is interpolated
MANOEUVRE_SPEED, MANOEUVRE_TIME = 5.0, 20.0  # m/s of change within so many s
WEAK_SPEED = 1.0  # m/s: a change below this shows no heading with a usual receiver
MIN_DISTANCE = 10.0  # m over which velocity and position are compared,
DISTANCE_SIGMAS = 10.0  # and so many sigmas of a position
MIN_STEP, STEP_SIGMAS = 1.0, 5.0  # m, so many sigmas: turns between such steps are seen
MAX_WINDOW = 30.0  # s: who takes longer for the distance is not compared
MIN_WINDOWS = 4
MAX_FRAME_ANGLE = math.radians(20.0)
MIN_CONCENTRATION = 0.9  # mean length of unit vectors above which directions agree


class Series(NamedTuple):
    """Vectors over time."""

    times: Array  # (N,), s, increasing
    vectors: Array  # (N, 3), ENU


@dataclass(frozen=True)
class VelocityFrame:
    """How a velocity compares with the change of position."""

    frame: str  # enu, ned, turned, body, contradiction or unknown
    windows: int  # distances that were compared
    angle_deg: float | None = None  # of a turned frame against ENU, counter-clockwise
    speed_ratio: float | None = None  # velocity over change of position
    upside_down: bool = False  # the vertical velocity has the wrong sign


@dataclass(frozen=True)
class Manoeuvres:
    """Changes of the horizontal velocity."""

    max_speed: float  # m/s
    largest_change: float  # m/s, within MANOEUVRE_TIME
    starts: tuple[float, ...]  # s, where a change by MANOEUVRE_SPEED begins


def track(times: Array, latitude_deg: Array, longitude_deg: Array, altitude: Array) -> Series:
    """
    Return positions in metres from the first; times in seconds, all of shape (N,).

    Source: each step on a sphere, east and north where it is made.
    """
    order = np.argsort(times, kind='stable')
    order = order[np.concatenate([[True], np.diff(times[order]) > 0.0])] if times.size else order
    latitude, longitude = np.radians(latitude_deg[order]), np.radians(longitude_deg[order])
    steps_east = np.remainder(np.diff(longitude) + np.pi, 2.0 * np.pi) - np.pi
    east = np.cumsum(steps_east * np.cos(latitude[1:])) * EARTH_RADIUS
    vectors = np.zeros((order.size, 3))
    vectors[1:, 0] = east
    vectors[:, 1] = (latitude - latitude[:1]) * EARTH_RADIUS
    vectors[:, 2] = altitude[order] - altitude[order][:1]
    return Series(times[order], vectors)


def position_noise(positions: Series) -> float:
    """Return an upper bound of the white noise of positions, 1 sigma per axis, m."""
    if positions.times.size < 5:
        return math.inf
    second = np.diff(positions.vectors[:, :2], n=2, axis=0)
    return float(np.median(np.abs(second)) / 0.6745 / math.sqrt(6.0))


def without_wild_positions(positions: Series) -> Series:
    """
    Leave out positions that are far from the median of the five around them.

    Far is half of a distance over which velocity and position are compared: less would turn it by
    no more than noise does. A median keeps what goes one way, however fast. The first and the
    last two positions have no five around them and stay.
    """
    vectors = positions.vectors
    if vectors.shape[0] < 5:
        return positions
    medians = np.median(np.lib.stride_tricks.sliding_window_view(vectors, 5, axis=0), axis=-1)
    limit = 0.5 * _compared_distance(position_noise(positions))
    off = np.abs(vectors[2:-2] - medians)
    near = np.ones(vectors.shape[0], bool)
    # Receivers are about half as good vertically.
    near[2:-2] = (np.hypot(off[:, 0], off[:, 1]) < limit) & (off[:, 2] < 2.0 * limit)
    return Series(positions.times[near], vectors[near])


def velocity_from_positions(positions: Series) -> Series:
    """Differentiate positions over a time that leaves 0.35 m/s of their noise."""
    if positions.times.size < 2:
        return Series(np.zeros(0), np.zeros((0, 3)))
    span = min(max(4.0 * position_noise(positions), 2.0), 20.0)
    times = _grid(positions.times)
    before, after = (_at(positions, times + sign * span / 2) for sign in (-1.0, 1.0))
    return _finite(Series(times, (after - before) / span))


def on_grid(velocities: Series) -> Series:
    """Return velocities every GRID seconds, without single outliers."""
    if velocities.times.size < 2:
        return velocities
    vectors = velocities.vectors
    if vectors.shape[0] >= 3:
        vectors = vectors.copy()
        vectors[1:-1] = np.median([vectors[:-2], vectors[1:-1], vectors[2:]], axis=0)
    times = _grid(velocities.times)
    return _finite(Series(times, _at(Series(velocities.times, vectors), times)))


def velocity_frame(velocities: Series, positions: Series) -> VelocityFrame:
    """
    Tell the frame of velocities from the change of position.

    Parameters
    ----------
    velocities : Series
        Taken as ENU, m/s.
    positions : Series
        ENU, m.

    """
    moved, travelled, lengths = _distances(velocities, positions)
    count = moved.shape[0]
    if count < MIN_WINDOWS:
        return VelocityFrame('unknown', count)
    ratio = float(np.median(lengths[:, 1] / lengths[:, 0]))
    moved_h, travelled_h = moved[:, 0] + 1j * moved[:, 1], travelled[:, 0] + 1j * travelled[:, 1]
    as_enu = _mean_direction(moved_h * travelled_h.conj())
    as_ned = _mean_direction(moved_h * (1j * travelled_h.conj()).conj())
    good_speed = 0.7 < ratio < 1.4
    frames = [(abs(mean), name) for name, mean in (('enu', as_enu), ('ned', as_ned))
              if abs(mean) > MIN_CONCENTRATION and abs(np.angle(mean)) < MAX_FRAME_ANGLE]
    angle = None
    if frames and good_speed:
        frame = max(frames)[1]
    elif not good_speed:
        frame = 'contradiction'
    elif abs(as_enu) > MIN_CONCENTRATION:
        frame, angle = 'turned', float(np.degrees(-np.angle(as_enu)))
    else:
        frame = 'body'
    up = travelled[:, 2] if frame != 'ned' else -travelled[:, 2]
    climbs = float(np.sum(moved[:, 2] * up)) if frame in ('enu', 'ned') else 0.0
    clear = abs(climbs) > 0.5 * float(np.sum(moved[:, 2] ** 2)) > 0.5 * MIN_DISTANCE ** 2
    return VelocityFrame(frame, count, angle, ratio, clear and climbs < 0.0)


def find_manoeuvres(velocities: Series) -> Manoeuvres | None:
    """
    Find changes of the horizontal velocity, which are what shows a heading.

    Parameters
    ----------
    velocities : Series
        As from `on_grid` or `velocity_from_positions`.

    Returns
    -------
    Manoeuvres or None
        None: there are too few velocities.

    """
    times, v = velocities.times, velocities.vectors[:, :2]
    if times.size < 2:
        return None
    change = np.zeros(times.size)  # from its time on, the largest within MANOEUVRE_TIME
    until = np.full(times.size, math.inf)  # when it first exceeds MANOEUVRE_SPEED
    for lag in range(1, min(round(MANOEUVRE_TIME / GRID), times.size - 1) + 1):
        elapsed = times[lag:] - times[:-lag]
        step = np.hypot(*(v[lag:] - v[:-lag]).T)
        step[elapsed > MANOEUVRE_TIME] = 0.0
        np.maximum(change[:-lag], step, out=change[:-lag])
        np.minimum(until[:-lag], np.where(step >= MANOEUVRE_SPEED, times[lag:], math.inf),
                   out=until[:-lag])
    starts = []
    free_from = -math.inf
    for index in np.flatnonzero(np.isfinite(until)).tolist():
        if times[index] >= free_from:
            # Of all starts of this change the latest: when it really begins.
            same = index + np.flatnonzero(until[index:] <= until[index])[-1]
            starts.append(float(times[same]))
            free_from = until[index]
    return Manoeuvres(float(np.hypot(*v.T).max()), float(change.max()), tuple(starts))


def _distances(velocities: Series, positions: Series) -> tuple[Array, Array, Array]:
    """
    Return change of position, integral of velocity, shape (K, 3), and the lengths of both ways.

    Of K windows; the lengths, shape (K, 2), are those of the ways with all their turns.
    """
    none = np.zeros((0, 3))
    if velocities.times.size < 2 or positions.times.size < 2:
        return none, none, np.zeros((0, 2))
    noise = position_noise(positions)
    distance = _compared_distance(noise)
    steps = np.diff(velocities.times)
    middles = 0.5 * (velocities.vectors[1:] + velocities.vectors[:-1])
    speeds = np.hypot(*middles[:, :2].T)
    integral = np.vstack([np.zeros((1, 4)), np.cumsum(
        np.column_stack([middles, speeds]) * steps[:, None], axis=0)])
    inside = ((positions.times >= velocities.times[0])
              & (positions.times <= velocities.times[-1]))
    times, moved = positions.times[inside], positions.vectors[inside]
    travelled = np.column_stack([np.interp(times, velocities.times, column)
                                 for column in integral.T])
    # After each gap, of either, the count of windows starts afresh.
    gap_ends = velocities.times[1:][steps > MAX_GAP]
    gaps = np.searchsorted(gap_ends, times) + np.concatenate(
        [[0], np.cumsum(np.diff(times) > MAX_GAP)])[:times.size]
    starts, ends = [], []
    start = 0
    for index, (time, east, north) in enumerate(
            zip(times.tolist(), *moved[:, :2].T.tolist())):
        if gaps[index] != gaps[start] or time - times[start] > MAX_WINDOW:
            start = index
        elif math.hypot(east - moved[start, 0], north - moved[start, 1]) >= distance:
            starts.append(start)
            ends.append(index)
            start = index
    change = travelled[ends] - travelled[starts]
    lengths = _length(moved[:, :2], max(MIN_STEP, STEP_SIGMAS * noise))
    return (moved[ends] - moved[starts], change[:, :3],
            np.column_stack([lengths[ends] - lengths[starts], change[:, 3]]))


def _compared_distance(noise: float) -> float:
    return max(MIN_DISTANCE, DISTANCE_SIGMAS * noise)


def _length(places: Array, step: float) -> Array:
    """Length of the way to each of N places, shape (N, 2), in steps that noise does not make."""
    lengths: list[float] = []
    corner: list[float] = []
    so_far = 0.0
    for place in places.tolist():
        corner = corner or place
        since = math.dist(place, corner)
        lengths.append(so_far + since)
        if since >= step:
            corner, so_far = place, lengths[-1]
    return np.array(lengths)


def _mean_direction(numbers: np.ndarray) -> complex:
    lengths = np.abs(numbers)
    return complex(np.mean(numbers[lengths > 0.0] / lengths[lengths > 0.0])) \
        if (lengths > 0.0).any() else 0j


def _grid(times: Array) -> Array:
    if times.size < 2:
        return np.zeros(0)
    # Only around data: clocks may jump by years.
    cells = np.unique((times / GRID).astype(np.int64))
    cells = np.unique(cells[:, None] + np.arange(round(MAX_GAP / GRID)))
    return cells[(cells * GRID >= times[0]) & (cells * GRID <= times[-1])] * GRID


def _at(series: Series, times: Array) -> Array:
    """Interpolate; NaN outside and in gaps."""
    after = np.clip(np.searchsorted(series.times, times), 1, series.times.size - 1)
    start, end = series.times[after - 1], series.times[after]
    values = np.column_stack([np.interp(times, series.times, column)
                              for column in series.vectors.T])
    values[(times < start) | (times > end) | (end - start > MAX_GAP)] = np.nan
    return values


def _finite(series: Series) -> Series:
    good = np.isfinite(series.vectors).all(axis=1)
    return Series(series.times[good], series.vectors[good])
