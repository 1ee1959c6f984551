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
"""What a picture of a result shows: panels with curves, which `report` and `page` draw."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

from ins_align.geometry.rotation import Array
from ins_align.recordings import one_line
from ins_align.results import Epoch, Result, State
import numpy as np

# Okabe and Ito's palette, which the colour-blind can tell apart.
STATE_COLOURS = {
    State.WAITING_FOR_IMU: '#999999', State.WAITING_FOR_GNSS: '#999999',
    State.ALIGNING: '#E69F00', State.LEVELLED: '#56B4E9', State.ALIGNED: '#009E73',
    State.FAULT: '#D55E00'}
ROLL, PITCH, HEADING = '#0072B2', '#CC79A7', '#D55E00'
ANGLES = (('roll', ROLL), ('pitch', PITCH), ('yaw', HEADING))
AXES_OF_ENU = (('east', ROLL), ('north', PITCH), ('up', HEADING))
AXES_OF_IMU = (('x', ROLL), ('y', PITCH), ('z', HEADING))
INNOVATION_LIMIT = 5.0  # sigmas shown at least
METRES_PER_DEGREE = 6_371_000.0 * math.pi / 180.0  # of latitude, mean sphere: good for a picture
BREAK_INTERVALS = 5.0  # a line ends where epochs are further apart than so many usual distances
LOST_SIGMA_DEG = 60.0  # above this a heading is not worth drawing
OVER_TIME = 'time since t0 (s)'


@dataclass(frozen=True)
class Curve:
    """
    A line or a row of marks.

    Attributes
    ----------
    name : str
        In the legend, once for all of a panel that have it; empty: not in it.
    colour : str
    x, y : ndarray, shape (N,)
        A line ends at nan.
    style : str
        As matplotlib has it: the line ``-``, ``--`` or ``:``; the marks ``.``, ``D`` or ``^``;
        empty: nothing but the sigma.
    size : float
        Width of the line or of the marks, points.
    sigma : ndarray, shape (N,), optional
        Drawn as a band along a line, as bars at marks.
    notes : sequence of str
        A sentence for each point, where there is a pointer to show it.

    """

    name: str
    colour: str
    x: Array
    y: Array
    style: str = '-'
    size: float = 1.2
    sigma: Array | None = None
    notes: Sequence[str] = ()

    @property
    def is_line(self) -> bool:
        """Whether the points are joined."""
        return self.style in ('-', '--', ':')


@dataclass(frozen=True)
class Panel:
    """Curves that have their axes in common; `note` says why there are none."""

    label: str  # of the vertical axis, with the unit
    curves: list[Curve]
    limits: tuple[float, float] | None = None
    log: bool = False
    note: str = ''
    x_label: str = OVER_TIME


@dataclass(frozen=True)
class Span:
    """A time that is shaded in all panels over time, with a line where it starts."""

    name: str
    colour: str
    start: float
    end: float


@dataclass(frozen=True)
class Picture:
    """Two columns of panels from top to bottom; the last one on the right is the track."""

    title: str
    left: list[Panel]
    right: list[Panel]
    spans: list[Span]


def picture(result: Result) -> Picture:
    """
    Return what a picture of a recording shows.

    Attitude with its sigma, where it was declared, the sigmas against their thresholds, normalised
    innovations, biases, the error where there is a reference, and the track by state.
    """
    series, status = _Series(result), result.status
    name = one_line(Path(result.bag).name or result.bag)
    right = [_biases('gyro bias (deg/s)', series.time, np.degrees(series.gyro_bias),
                     np.degrees(status.gyro_bias_std)),
             _biases('accelerometer\nbias (m/s\u00b2)', series.time, series.accel_bias,
                     status.accel_bias_std)]
    if series.errors is not None:
        right.append(_errors(series, series.errors))
    return Picture(
        f'{name}: {state_in_words(result)}',
        [_angles('roll, pitch (deg)', series, result, ((0, 'roll', ROLL), (1, 'pitch', PITCH))),
         _angles('yaw (deg, counter-\nclockwise from east)', series, result,
                 ((2, 'yaw', HEADING),)),
         _sigmas(series, result), _innovations(series, result)],
        [*right, _track(result)],
        [Span(words, STATE_COLOURS[state], *span)
         for words, state in (('roll and pitch declared', State.LEVELLED),
                              ('declared aligned', State.ALIGNED))
         for span in declared_spans(result.epochs, state)])


def declared_spans(epochs: Sequence[Epoch], state: State = State.ALIGNED,
                   ) -> list[tuple[float, float]]:
    """Return the first and the last epoch of each time in a state, s since the first t0."""
    spans: list[tuple[float, float]] = []
    inside = False
    for epoch in epochs:
        start = spans[-1][0] if inside else epoch.t_s
        if epoch.state is state:
            spans[len(spans) - inside:] = [(start, epoch.t_s)]
        inside = epoch.state is state
    return spans


def state_in_words(result: Result) -> str:
    """Return the state at the end, and when it was declared, s since the first t0."""
    state = result.status.state
    spans = declared_spans(result.epochs)
    after = f' after {spans[-1][0]:.1f} s' if spans and state is State.ALIGNED else ''
    return f'{state.value}{after}'


class _Series:
    """
    A result's epochs with an attitude, as arrays over time.

    Where an alignment starts over or hears nothing for long lies a row of nan, so that nothing is
    drawn across.
    """

    def __init__(self, result: Result) -> None:
        epochs = [epoch for epoch in result.epochs if not epoch.dry]
        pairs = [(epoch, epoch.initial, epoch.current) for epoch in epochs
                 if epoch.current is not None and epoch.initial is not None]
        time = np.array([epoch.t_s for epoch, _, _ in pairs])
        breaks = _breaks(epochs, time)

        def rows(values: Sequence[Any]) -> np.ndarray:
            return np.insert(np.array(values, float).reshape(-1, 3), breaks, np.nan, axis=0)

        self.time = np.insert(time, breaks, np.nan)
        self.angles = rows([[now.roll_deg, now.pitch_deg, now.yaw_deg] for _, _, now in pairs])
        self.sigma = rows([now.sigma_deg for _, _, now in pairs])
        self.initial_sigma = rows([first.sigma_deg for _, first, _ in pairs])
        # Roll and pitch turn about axes in the plane of level: the larger sigma holds for both.
        self.angle_sigma = np.stack([self.sigma[:, :2].max(axis=1, initial=0.0)] * 2
                                    + [self.sigma[:, 2]], axis=-1)
        self.innovations, self.gyro_bias, self.accel_bias = (
            rows([getattr(epoch, name) for epoch, _, _ in pairs])
            for name in ('innovation', 'gyro_bias', 'accel_bias'))
        self.aligned = np.insert(
            np.array([epoch.state is State.ALIGNED for epoch, _, _ in pairs], bool), breaks, False)
        self.errors = self.reference = None
        if result.reference is not None:
            none = (np.full(3, np.nan), np.full(3, np.nan))
            errors = [result.reference.errors_deg(now) or none for _, _, now in pairs]
            self.errors = rows([rpy for _, rpy in errors])
            self.reference = np.remainder(self.angles - self.errors + 180.0, 360.0) - 180.0


def _breaks(epochs: Sequence[Epoch], time: np.ndarray) -> np.ndarray:
    """Return before which of the epochs with an attitude, at these times, a line ends."""
    steps = np.diff(time)
    far = steps > BREAK_INTERVALS * np.median(steps) if steps.size else steps > 0.0
    # What starts over has no attitude at t0 for some epochs.
    there = np.flatnonzero([epoch.current is not None and epoch.initial is not None
                            for epoch in epochs])
    return 1 + np.flatnonzero(far | (np.diff(there) > 1))


def _broken_at_wraps(angle: Array, *arrays: Array) -> Iterator[Array]:
    """Put a gap into arrays where a line would run from one end of the scale to the other."""
    wraps = np.flatnonzero(np.abs(np.diff(angle)) > 180.0) + 1
    return (np.insert(array, wraps, np.nan) for array in arrays)


def _angles(label: str, series: _Series, result: Result,
            lines: tuple[tuple[int, str, str], ...]) -> Panel:
    """Return angles with the reference, and as they were declared: at their t0."""
    if not len(series.time):
        return Panel(label, [], note='no attitude')
    curves = []
    for column, name, colour in lines:
        sigma = series.angle_sigma[:, column]
        angle = np.where(sigma < LOST_SIGMA_DEG, series.angles[:, column], np.nan)
        time, angle, sigma = _broken_at_wraps(angle, series.time, angle, sigma)
        curves.append(Curve(name, colour, time, angle, size=2.0, sigma=sigma))
    if series.reference is not None:
        for column, _, _ in lines:
            angle = series.reference[:, column]
            curves.append(Curve('reference', 'black', *_broken_at_wraps(angle, series.time, angle),
                                '--', 0.8))
    declared = result.declared
    if declared is not None:
        time = np.array([result.t_s(declared.stamp_ns)])
        angles = declared.roll_deg, declared.pitch_deg, declared.yaw_deg
        level, up = max(declared.sigma_deg[:2]), declared.sigma_deg[2]
        for column, _, _ in lines:
            curves.append(Curve('declared, at its t0', 'black', time, np.array([angles[column]]),
                                'D', 4.0, np.array([up if column == 2 else level])))
    # The first sigmas would make flat lines of the angles.
    return Panel(label, curves, _around(np.concatenate([curve.y for curve in curves])))


def _around(values: Array) -> tuple[float, float] | None:
    """Return limits with some space around values."""
    values = values[np.isfinite(values)]
    if not values.size:
        return None
    margin = 0.05 * np.ptp(values) or 1.0
    return float(values.min() - margin), float(values.max() + margin)


def _level(name: str, colour: str, time: Array, value: float, style: str) -> Curve:
    """Return a level as long as the time, of which some is finite."""
    ends = np.array([np.nanmin(time), np.nanmax(time)])
    return Curve(name, colour, ends, np.full(2, value), style, 0.8)


def _sigmas(series: _Series, result: Result) -> Panel:
    curves = []
    config, first = result.config, series.initial_sigma
    for column, name, colour, at_t0, threshold in (
            (0, 'tilt', ROLL, first[:, :2].max(axis=1, initial=0.0), config.tilt_std_threshold),
            (2, 'heading', HEADING, first[:, 2], config.heading_std_threshold)):
        if len(series.time):
            curves += [
                Curve(f'{name}, current', colour, series.time, series.angle_sigma[:, column]),
                Curve(f'{name}, at t0', colour, series.time, at_t0, ':', 1.0),
                _level('threshold', colour, series.time, threshold, '--')]
    return Panel('1 sigma (deg)', curves, log=True)


def _innovations(series: _Series, result: Result) -> Panel:
    kind = 'velocity' if result.topics and result.topics.velocity else 'position'
    label = f'innovation of the\n{kind} (sigma)'
    if not np.isfinite(series.innovations).any():
        return Panel(label, [])
    # Outliers may be anything: they are drawn at the edge.
    limit = max(INNOVATION_LIMIT, 1.5 * float(np.nanquantile(np.abs(series.innovations), 0.99)))
    values = series.innovations.clip(-limit, limit)
    curves = [Curve(name, colour, series.time, values[:, column], '.', 3.0)
              for column, (name, colour) in enumerate(AXES_OF_ENU)]
    curves += [_level('3 sigma', 'black', series.time, level, ':') for level in (3.0, -3.0)]
    return Panel(label, curves, (-1.05 * limit, 1.05 * limit))


def _biases(label: str, time: Array, biases: Array, std: Array) -> Panel:
    """Return three biases, and at the end how well they are known."""
    if not len(time):
        return Panel(label, [])
    curves = [Curve(name, colour, time, biases[:, column])
              for column, (name, colour) in enumerate(AXES_OF_IMU)]
    curves += [Curve('1 sigma at the end', colour, time[-1:], biases[-1:, column], '',
                     sigma=std[column:column + 1])
               for column, (_, colour) in enumerate(AXES_OF_IMU)]
    # The first seconds tell nothing yet.
    settled = biases[len(biases) // 10:]
    low, high = np.nanmin(settled) - std.max(), np.nanmax(settled) + std.max()
    margin = 0.1 * (high - low) or 1.0
    return Panel(label, curves, (float(low - margin), float(high + margin)))


def _errors(series: _Series, errors: Array) -> Panel:
    label = 'error against\nreference (deg)'
    finite = np.isfinite(errors).all(axis=1)
    if not finite.any():
        return Panel(label, [], note='the reference does not cover these epochs')
    curves = [Curve(name, colour, series.time, errors[:, column], size=1.0)
              for column, (name, colour) in enumerate(ANGLES)]
    curves += [Curve('heading, 3 sigma', HEADING, series.time, level * series.sigma[:, 2], ':',
                     0.8) for level in (3.0, -3.0)]
    # What is seen of an error is its end: its first seconds, of every start, are as large as an
    # angle can be.
    settled = finite & (series.aligned if series.aligned.any()
                        else series.time >= np.median(series.time[finite]))
    largest = np.abs(errors[settled if settled.any() else finite]).max()
    limit = max(1.0, 2.0 * float(largest))
    return Panel(label, curves, (-limit, limit))


def _track(result: Result) -> Panel:
    """Return the fixes by the state at each."""
    track = result.track[np.isfinite(result.track).all(axis=1)]
    if not len(track):
        return Panel('north (m)', [], x_label='east (m)')
    latitude, longitude = track[0, 1:]
    north = (track[:, 1] - latitude) * METRES_PER_DEGREE
    east = (np.remainder(track[:, 2] - longitude + 180.0, 360.0) - 180.0) \
        * METRES_PER_DEGREE * math.cos(math.radians(latitude))
    stamps = np.array([epoch.stamp_ns - result.first_fix_ns for epoch in result.epochs])
    index = np.searchsorted(stamps, track[:, 0], side='right') - 1
    states = [result.epochs[i].state if i >= 0 else State.WAITING_FOR_GNSS for i in index]
    since = track[:, 0] + (result.first_fix_ns - (result.first_t0_ns or result.first_fix_ns))
    times = [f'{seconds:.1f} s' for seconds in (since * 1e-9).tolist()]
    curves = [Curve('', '#cccccc', east, north, size=0.8)]
    for state, colour in STATE_COLOURS.items():
        if state in states:
            there = np.where([s is state for s in states], 1.0, np.nan)
            curves.append(Curve(state.value, colour, there * east, there * north, '.', 5.0,
                                notes=times))
    curves.append(Curve('start', 'black', east[:1], north[:1], '^', 8.0))
    return Panel('north (m)', curves, x_label='east (m)')
