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
"""The table and the figure of a replay."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import itertools
import math
from operator import attrgetter
from pathlib import Path
import shlex
import shutil
import textwrap
from typing import Any, TYPE_CHECKING

from ins_align.geometry.rotation import Array
from ins_align.gnss.motion import Series, track
from ins_align.recordings import one_line
from ins_align.results import Attitude, Result, State
import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CHANGES_AT_ENDS = 3  # so many first and last changes of the state are in the table
# Okabe and Ito's palette for colour-blind readers.
STATE_COLOURS = {
    State.WAITING_FOR_IMU: '#999999', State.WAITING_FOR_GNSS: '#999999',
    State.ALIGNING: '#E69F00', State.LEVELLED: '#56B4E9', State.ALIGNED: '#009E73',
    State.FAULT: '#D55E00'}
COLOURS = '#0072B2', '#CC79A7', '#D55E00'  # roll, pitch, yaw; x, y, z; east, north, up
HEADING = COLOURS[2]
INNOVATION_LIMIT = 5.0  # least end of the axis of innovations, sigmas
LOST_SIGMA_DEG = 60.0  # an angle with a larger sigma is not drawn
THIN = {'linewidth': 0.8, 'linestyle': ':'}  # for lines that show limits


def format_table(rows: Sequence[Sequence[Any]], header: Sequence[str] = (),
                 indent: str = '') -> str:
    """
    Return a table as text, with the first column aligned to the left, the others to the right.

    Floats have four significant digits, None is a dash. `indent` begins every line.
    """
    cells = [[_cell(cell) for cell in row] for row in rows]
    if header:
        cells.insert(0, list(header))
    columns = list(itertools.zip_longest(*cells, fillvalue=''))
    widths = [max(map(len, column)) for column in columns]
    lines = ['  '.join([first.ljust(widths[0]), *map(str.rjust, others, widths[1:])]).rstrip()
             for first, *others in zip(*columns)]
    if header:
        lines.insert(1, '  '.join('-' * size for size in widths))
    return '\n'.join(indent + line for line in lines)


def _cell(value: Any) -> str:
    if value is None:
        return '-'
    if isinstance(value, float):
        return f'{value:.4g}' if math.isfinite(value) else '-'
    return str(value)


def summary(result: Result) -> str:
    """Return what ``ins_align replay`` prints of a recording."""
    status = result.status
    lines = [result.bag, *_wrapped(f'{result.state_in_words}: {status.reason}', '  '),
             *_changes(result)]
    declared = None if status.initial is None else result.declared
    rows = []
    for name, attitude in (
            ('declared', declared), ('initial', status.initial), ('final', status.current)):
        if attitude is None:
            continue
        errors = () if result.reference is None else result.reference.errors_deg(attitude)
        rows.append([
            name, f'{result.t_s(attitude):.1f}',
            *(f'{angle:.3f}' for angle in (
                *attitude.roll_pitch_yaw_deg, attitude.heading_deg, *attitude.sigma_deg)),
            *('-' if math.isnan(error) else f'{error:+.3f}' for error in errors)])
    if rows:
        header = ['attitude, deg', 'at, s', 'roll', 'pitch', 'yaw', 'heading', 'sigma e',
                  'n', 'u']
        if result.reference is not None:
            header += ['error roll', 'pitch', 'yaw']
        first_t0_s = result.epochs[0].stamp_ns * 1e-9 - result.epochs[0].t_s
        lines += ['', format_table(rows, header, '  '),
                  f'  times are since the first t0, stamp {first_t0_s:.3f} s',
                  '  declared: at t0, as the node published it; initial: at t0, as known in the '
                  'end; final: in the end', '', _nuisance_table(result)]
    counts = ', '.join(f'{name} {count}' for name, count in sorted(status.counts.items()) if count)
    lines += ['', f'  counts: {counts or "nothing read"}']
    if result.bag and not result.aligned:
        lines += ['', '  to find what is wrong with units, frames, clocks: '
                      f'ins_align info {shlex.quote(result.bag)}']
    return '\n'.join(lines)


def _changes(result: Result) -> list[str]:
    """Return lines on the changes of the state; of many, on the first and the last ones."""
    told = [_wrapped(f'{span.first.state.value}: {span.reason}', f'  {span.first.t_s:8.1f} s  ')
            for span in result.spans]
    if len(told) < 2:
        return []  # it is the final state, which is shown anyway
    left_out = len(told) - 2 * CHANGES_AT_ENDS
    if left_out > 1:
        told[CHANGES_AT_ENDS:-CHANGES_AT_ENDS] = [
            [f'{"":14}... {left_out} more, all of them in --json']]
    return ['', *itertools.chain(*told)]


def _wrapped(text: str, begin: str) -> list[str]:
    """Break a sentence into lines as wide as the terminal, with a hanging indent."""
    return textwrap.wrap(
        text, max(shutil.get_terminal_size().columns, 2 * len(begin)), initial_indent=begin,
        subsequent_indent=' ' * (len(begin) + 2), break_long_words=False, break_on_hyphens=False)


def _nuisance_table(result: Result) -> str:
    status = result.status
    rows = []
    for name, scale, value, std in (
            ('gyro bias, deg/s', math.degrees(1.0), status.gyro_bias, status.gyro_bias_std),
            ('accel bias, m/s^2', 1.0, status.accel_bias, status.accel_bias_std),
            ('lever arm, m', 1.0, status.lever_arm, status.lever_arm_std),
            ('GNSS delay, s', 1.0, status.gnss_delay, status.gnss_delay_std)):
        values, sigmas = np.atleast_1d(value) * scale, np.atleast_1d(std) * scale
        rows.append([name, *(f'{number:+.4f}' for number in values), *[''] * (3 - len(values)),
                     # Sigma 0: configured and not estimated.
                     *(f'{sigma:.4f}' if sigma else '-' for sigma in sigmas)])
    return format_table(rows, ['estimate', 'x', 'y', 'z', 'sigma x', 'y', 'z'], '  ')


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure, inches, that needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout='constrained')
    FigureCanvasAgg(figure)
    return figure


def plot(result: Result) -> Figure:
    """Draw attitude, sigmas, innovations, biases and track; errors if there is a reference."""
    history = _History(result)
    figure = new_figure(16.0, 11.0)
    figure.suptitle(f'{one_line(Path(result.bag).name or result.bag)}: {result.state_in_words}',
                    fontsize=13, parse_math=False)
    left, right = map(figure.add_subfigure, figure.add_gridspec(1, 2, width_ratios=(3, 2)))
    tilt, yaw, sigmas, innovations = left.subplots(4, 1, sharex=True)
    heights = [1.0] * (2 if history.errors is None else 3) + [2.2]
    gyro, accel, *error, way = right.subplots(len(heights), 1, height_ratios=heights)
    _angles(tilt, 'roll, pitch (deg)', history, result, {'roll': 0, 'pitch': 1})
    _angles(yaw, 'yaw (deg, counter-\nclockwise from east)', history, result, {'yaw': 2})
    _sigmas(sigmas, history, result)
    _innovations(innovations, history)
    _biases(gyro, 'gyro bias (deg/s)', history.time, np.degrees(history.gyro_bias),
            np.degrees(result.status.gyro_bias_std))
    _biases(accel, 'accelerometer\nbias (m/s\u00b2)', history.time, history.accel_bias,
            result.status.accel_bias_std)
    for axes in error:
        _errors(axes, history)
    _track(way, result)
    upper = [gyro, accel, *error]
    for axes in upper[:-1]:
        axes.sharex(upper[-1])
        axes.tick_params(labelbottom=False)
    for axes in (innovations, upper[-1]):
        axes.set_xlabel('time since t0 (s)')
    for axes in (tilt, yaw, sigmas, innovations, *upper):
        _shade(axes, result, named=axes is tilt)
    for axes in (tilt, yaw, sigmas, innovations, *upper, way):
        axes.grid(alpha=0.3)
        _add_legend(axes, columns=7 if axes.figure is left else 5)
    return figure


class _History:
    """Epochs as arrays; those without GNSS or attitude are nan, so that no line crosses them."""

    def __init__(self, result: Result) -> None:
        epochs = result.epochs
        known = np.array([not epoch.dry and epoch.initial is not None
                          and epoch.current is not None for epoch in epochs], bool)

        def rows(value: Callable[[Any], Any]) -> np.ndarray:
            found = np.full((len(epochs), 3), np.nan)
            for place in np.flatnonzero(known):
                found[place] = value(epochs[place])
            return found

        self.time = np.where(known, [epoch.t_s for epoch in epochs], np.nan)
        self.angles = rows(lambda epoch: epoch.current.roll_pitch_yaw_deg)
        self.sigma = rows(lambda epoch: _sigma(epoch.current))
        self.initial_sigma = rows(lambda epoch: _sigma(epoch.initial))
        self.innovations, self.gyro_bias, self.accel_bias = (
            rows(attrgetter(name)) for name in ('innovation', 'gyro_bias', 'accel_bias'))
        self.aligned = known & np.array([epoch.state is State.ALIGNED for epoch in epochs], bool)
        self.errors = self.reference = None
        if result.reference is not None:
            errors_deg = result.reference.errors_deg
            self.errors = rows(lambda epoch: errors_deg(epoch.current))
            self.reference = np.remainder(self.angles - self.errors + 180.0, 360.0) - 180.0


def _sigma(attitude: Attitude) -> list[float]:
    """Return sigmas of roll, pitch and yaw, degrees: that of tilt, the larger one, twice."""
    east, north, up = attitude.sigma_deg.tolist()
    return [max(east, north), max(east, north), up]


def _broken_at_wraps(angle: Array, *arrays: Array) -> Iterator[Array]:
    """Yield the arrays with a gap where the angle wraps from one end of the scale to the other."""
    wraps = np.flatnonzero(np.abs(np.diff(angle)) > 180.0) + 1
    return (np.insert(array, wraps, np.nan) for array in arrays)


def _angles(axes: Axes, label: str, history: _History, result: Result,
            columns: dict[str, int]) -> None:
    """Draw angles with the reference, and the declared ones at their t0."""
    axes.set_ylabel(label)
    if not np.isfinite(history.time).any():
        axes.text(0.5, 0.5, 'no attitude', transform=axes.transAxes, ha='center')
        return
    bands = []
    for name, column in columns.items():
        sigma = history.sigma[:, column]
        angle = np.where(sigma < LOST_SIGMA_DEG, history.angles[:, column], np.nan)
        time, angle, sigma = _broken_at_wraps(angle, history.time, angle, sigma)
        axes.plot(time, angle, color=COLOURS[column], linewidth=2.0, label=name)
        bands.append((name, column, time, angle - sigma, angle + sigma))
    if history.reference is not None:
        for angle in history.reference[:, [*columns.values()]].T:
            axes.plot(*_broken_at_wraps(angle, history.time, angle), 'k--', linewidth=0.8,
                      label='reference')
    if (declared := result.declared) is not None:
        for column in columns.values():
            axes.errorbar(result.t_s(declared), declared.roll_pitch_yaw_deg[column],
                          _sigma(declared)[column], fmt='kD', markersize=4.0, capsize=3.0,
                          label='declared, at its t0')
    limits = axes.get_ylim()  # the first, wide part of the bands must not set them
    for name, column, time, low, high in bands:
        axes.fill_between(time, low, high, color=COLOURS[column], alpha=0.25, linewidth=0,
                          label=f'{name}, 1 sigma')
    axes.set_ylim(limits)


def _sigmas(axes: Axes, history: _History, result: Result) -> None:
    axes.set_ylabel('1 sigma (deg)')
    axes.set_yscale('log')
    for name, column, threshold in (('tilt', 0, result.config.tilt_std_threshold),
                                    ('heading', 2, result.config.heading_std_threshold)):
        colour = COLOURS[column]
        axes.plot(history.time, history.sigma[:, column], color=colour, linewidth=1.2,
                  label=f'{name}, current')
        axes.plot(history.time, history.initial_sigma[:, column], ':', color=colour, linewidth=1.0,
                  label=f'{name}, at t0')
        axes.axhline(threshold, color=colour, linestyle='--', linewidth=0.8, label='threshold')


def _innovations(axes: Axes, history: _History) -> None:
    axes.set_ylabel('innovation of\nthe GNSS (sigma)')
    if not np.isfinite(history.innovations).any():
        return
    # Outliers may be of any size; they are drawn at the edge.
    limit = max(INNOVATION_LIMIT, 1.5 * float(np.nanquantile(np.abs(history.innovations), 0.99)))
    for name, colour, values in zip(('east', 'north', 'up'), COLOURS, history.innovations.T):
        axes.plot(history.time, values.clip(-limit, limit), '.', color=colour, markersize=3.0,
                  label=name)
    for level in (3.0, -3.0):
        axes.axhline(level, color='black', label='3 sigma', **THIN)
    axes.set_ylim(-1.05 * limit, 1.05 * limit)


def _biases(axes: Axes, label: str, time: Array, biases: Array, std: Array) -> None:
    """Draw three biases, with their sigma at the end."""
    axes.set_ylabel(label)
    known = np.flatnonzero(np.isfinite(time))
    if not known.size:
        return
    for name, colour, values in zip('xyz', COLOURS, biases.T):
        axes.plot(time, values, color=colour, linewidth=1.2, label=name)
    for colour, value, sigma in zip(COLOURS, biases[known[-1]], std):
        axes.errorbar(time[known[-1]], value, sigma, fmt='none', ecolor=colour, capsize=3.0,
                      label='1 sigma at the end')
    settled = biases[known[len(known) // 10:]]  # the first estimates vary too much
    low, high = settled.min() - std.max(), settled.max() + std.max()
    margin = 0.1 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)


def _errors(axes: Axes, history: _History) -> None:
    axes.set_ylabel('error against\nreference (deg)')
    errors = history.errors
    assert errors is not None
    finite = np.isfinite(errors).all(axis=1)
    if not finite.any():
        axes.text(0.5, 0.5, 'the reference does not cover these epochs',
                  transform=axes.transAxes, ha='center')
        return
    for name, colour, values in zip(('roll', 'pitch', 'yaw'), COLOURS, errors.T):
        axes.plot(history.time, values, color=colour, linewidth=1.0, label=name)
    for level in (3.0, -3.0):
        axes.plot(history.time, level * history.sigma[:, 2], color=HEADING,
                  label='heading, 3 sigma', **THIN)
    # The axis fits the errors after convergence; the first ones after a start may be of any size.
    settled = finite & (history.aligned if history.aligned.any()
                        else history.time >= np.median(history.time[finite]))
    limit = max(1.0, 2.0 * float(np.abs(errors[settled if settled.any() else finite]).max()))
    axes.set_ylim(-limit, limit)


def _track(axes: Axes, result: Result) -> None:
    """Draw the fixes, coloured by state."""
    axes.set_xlabel('east (m)')
    axes.set_ylabel('north (m)')
    axes.set_aspect('equal', adjustable='datalim')
    fixes = result.track[np.isfinite(result.track).all(axis=1)]
    if not len(fixes):
        return
    east, north = track(Series(fixes[:, 0], fixes[:, 1:])).vectors.T
    epochs = sorted(result.epochs, key=attrgetter('stamp_ns'))  # the clock may have been set back
    stamps = np.array([epoch.stamp_ns for epoch in epochs], float)
    index = np.searchsorted(stamps, fixes[:, 0], side='right') - 1
    states = [epochs[i].state if i >= 0 else State.WAITING_FOR_GNSS for i in index]
    axes.plot(east, north, color='#cccccc', linewidth=0.8)
    for state, colour in STATE_COLOURS.items():
        if state in states:
            there = [one is state for one in states]
            axes.plot(east[there], north[there], '.', color=colour, markersize=5.0,
                      label=state.value)
    axes.plot(east[0], north[0], 'k^', markersize=8.0, label='start')


def _shade(axes: Axes, result: Result, named: bool) -> None:
    """Shade the times in which something was declared; label them if `named`."""
    for words, state in (('roll and pitch declared', State.LEVELLED),
                         ('declared aligned', State.ALIGNED)):
        for first, last in result.spans_of(state):
            axes.axvspan(first.t_s, last.t_s, color=STATE_COLOURS[state], alpha=0.1, linewidth=0)
            axes.axvline(first.t_s, color=STATE_COLOURS[state], linewidth=1.2,
                         label=words if named else None)


def _add_legend(axes: Axes, columns: int) -> None:
    """Put a legend above the axes, where it covers nothing; equal labels appear once."""
    handles: dict[str, Any] = {}
    for handle, name in zip(*axes.get_legend_handles_labels()):
        handles.setdefault(name, handle)
    if handles:
        axes.legend(handles.values(), handles.keys(), loc='lower left', bbox_to_anchor=(0.0, 1.0),
                    fontsize=8, frameon=False, ncols=columns, borderpad=0.2, columnspacing=1.2,
                    handletextpad=0.5)
