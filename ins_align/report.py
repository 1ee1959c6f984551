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
"""What a person sees of a result: tables of plain text and figures."""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path
from typing import Any, IO, TYPE_CHECKING

from ins_align.recordings import one_line
from ins_align.results import Epoch, State
import numpy as np

if TYPE_CHECKING:
    from ins_align.recordings.replay import ReplayResult
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which the colour-blind can tell apart.
STATE_COLOURS = {
    State.WAITING_FOR_IMU: '#999999', State.WAITING_FOR_GNSS: '#999999',
    State.ALIGNING: '#E69F00', State.LEVELLED: '#56B4E9', State.ALIGNED: '#009E73',
    State.FAULT: '#D55E00'}
ROLL, PITCH, HEADING = '#0072B2', '#CC79A7', '#D55E00'
AXES_OF_ENU = (('east', ROLL), ('north', PITCH), ('up', HEADING))
AXES_OF_IMU = (('x', ROLL), ('y', PITCH), ('z', HEADING))
DECLARED_GREEN = STATE_COLOURS[State.ALIGNED]
INNOVATION_LIMIT = 5.0  # sigmas shown at least
METRES_PER_DEGREE = 6_371_000.0 * math.pi / 180.0  # of latitude, mean sphere: good for a picture
BREAK_INTERVALS = 5.0  # a line ends where epochs are further apart than so many usual distances
CHANGES_AT_ENDS = 3  # of the state: the first and the last so many are in the table
LOST_SIGMA_DEG = 60.0  # above this a heading is not worth drawing


def format_table(rows: Sequence[Sequence[Any]], header: Sequence[str] = (),
                 indent: str = '') -> str:
    """
    Align columns of text: the first to the left, all others to the right.

    Parameters
    ----------
    rows : sequence of rows
        Cells are text; floats get four significant digits, None is a dash.
    header : sequence of str, optional
        Names of the columns.
    indent : str, optional
        In front of every line.

    Returns
    -------
    str
        Without a newline at the end.

    """
    cells = [[_cell(cell) for cell in row] for row in rows]
    if header:
        cells.insert(0, list(header))
    width = max((len(row) for row in cells), default=0)
    cells = [row + [''] * (width - len(row)) for row in cells]
    widths = [max(len(row[column]) for row in cells) for column in range(width)]
    lines = ['  '.join([row[0].ljust(widths[0])]
                       + [cell.rjust(size) for cell, size in zip(row[1:], widths[1:])]).rstrip()
             for row in cells if row]
    if header:
        lines.insert(1, '  '.join('-' * size for size in widths))
    return '\n'.join(indent + line for line in lines)


def _cell(value: Any) -> str:
    if value is None:
        return '-'
    if isinstance(value, float):
        return f'{value:.4g}' if math.isfinite(value) else '-'
    return str(value)


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


def _state_in_words(result: ReplayResult) -> str:
    """Return the state at the end, and when it was declared, s since the first t0."""
    state = result.status.state
    spans = declared_spans(result.epochs)
    after = f' after {spans[-1][0]:.1f} s' if spans and state is State.ALIGNED else ''
    return f'{state.value}{after}'


def summary(result: ReplayResult) -> str:
    """Return the table that ``ins_align replay`` prints of a recording."""
    status = result.status
    lines = [result.bag, f'  {_state_in_words(result)}: {status.reason}']
    lines += _list_of_changes(result)
    declared = None if status.initial is None else result.declared
    attitudes = [('declared', declared), ('initial', status.initial), ('final', status.current)]
    start_ns = result.first_t0_ns or 0
    rows = []
    for name, attitude in attitudes:
        if attitude is None:
            continue
        row = [name, f'{(attitude.stamp_ns - start_ns) * 1e-9:.1f}']
        row += [f'{angle:.3f}' for angle in (
            attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg, attitude.heading_deg)]
        row += [f'{sigma:.3f}' for sigma in attitude.sigma_deg]
        if result.reference is not None:
            errors = result.reference.errors_deg(attitude)
            row += ['-'] * 3 if errors is None else [f'{error:+.3f}' for error in errors[1]]
        rows.append(row)
    if rows:
        header = ['attitude, deg', 'at, s', 'roll', 'pitch', 'yaw', 'heading', 'sigma e',
                  'n', 'u']
        if result.reference is not None:
            header += ['error roll', 'pitch', 'yaw']
        lines += ['', format_table(rows, header, '  '),
                  f'  all times since the first t0, stamp {start_ns * 1e-9:.3f} s; declared: '
                  'at its t0, as the node publishes it', '', _nuisance_table(result)]
    counts = ', '.join(f'{name} {count}' for name, count in sorted(status.counts.items()) if count)
    return '\n'.join([*lines, '', f'  counts: {counts or "nothing read"}'])


def _list_of_changes(result: ReplayResult) -> list[str]:
    """Return a line for each change of the state, of many for the first and the last."""
    lines = [f'  {change.t_s:8.1f} s  {change.state.value}: {change.reason}'
             for change in result.changes]
    if len(lines) < 2:
        return []  # what it says is the state at the end
    left_out = len(lines) - 2 * CHANGES_AT_ENDS
    if left_out > 1:
        lines[CHANGES_AT_ENDS:-CHANGES_AT_ENDS] = [
            f'{"":13}... {left_out} more, all of them in --json']
    return ['', *lines]


def _nuisance_table(result: ReplayResult) -> str:
    status = result.status
    rows = []
    for name, scale, values, stds in (
            ('gyro bias, deg/s', math.degrees(1.0), status.gyro_bias, status.gyro_bias_std),
            ('accel bias, m/s^2', 1.0, status.accel_bias, status.accel_bias_std),
            ('lever arm, m', 1.0, status.lever_arm, status.lever_arm_std)):
        rows.append([name, *(f'{value * scale:+.4f}' for value in values),
                     *(_sigma(std * scale) for std in stds)])
    rows.append(['GNSS delay, s', f'{status.gnss_delay:+.4f}', '', '',
                 _sigma(status.gnss_delay_std)])
    return format_table(rows, ['estimate', 'x', 'y', 'z', 'sigma x', 'y', 'z'], '  ')


def _sigma(value: float) -> str:
    return f'{value:.4f}' if value else '-'  # 0: given, not estimated


def save_figure(figure: Figure, file: IO[bytes], suffix: str) -> None:
    """Write a figure to an open file in the format that a suffix names."""
    figure.savefig(file, format=suffix.lstrip('.').lower(), dpi=120)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display, inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout='constrained')
    FigureCanvasAgg(figure)
    return figure


def plot(result: ReplayResult) -> Figure:
    """
    Draw a recording over time.

    Attitude with its sigma, where it was declared, the sigmas against their thresholds, normalised
    innovations, biases, the error where there is a reference, and the track by state.
    """
    figure = new_figure(16.0, 11.0)
    status = result.status
    name = one_line(Path(result.bag).name or result.bag)
    figure.suptitle(f'{name}: {_state_in_words(result)}', fontsize=13, parse_math=False)
    columns = figure.add_gridspec(1, 2, width_ratios=(3, 2))
    left, right = figure.add_subfigure(columns[0]), figure.add_subfigure(columns[1])
    series = _Series(result)
    tilt, heading, sigma, innovation = left.subplots(4, 1, sharex=True)
    _plot_angles(tilt, series, ((0, 'roll', ROLL), (1, 'pitch', PITCH)))
    _plot_angles(heading, series, ((2, 'yaw', HEADING),))
    tilt.set_ylabel('roll, pitch (deg)')
    heading.set_ylabel('yaw (deg, counter-\nclockwise from east)')
    _plot_sigma(sigma, series, result)
    _plot_innovations(innovation, series, result)
    heights = [1.0] * (2 if series.errors is None else 3) + [2.2]
    *upper, track = right.subplots(len(heights), 1, height_ratios=heights)
    gyro, accel, *error = upper
    _plot_bias(gyro, series.time, np.degrees(series.gyro_bias), np.degrees(status.gyro_bias_std))
    _plot_bias(accel, series.time, series.accel_bias, status.accel_bias_std)
    gyro.set_ylabel('gyro bias (deg/s)')
    accel.set_ylabel('accelerometer\nbias (m/s$^2$)')
    if series.errors is not None:
        _plot_errors(error[0], series, series.errors)
    for axes in upper[:-1]:
        axes.sharex(upper[-1])
        axes.tick_params(labelbottom=False)
    for axes in (innovation, upper[-1]):
        axes.set_xlabel('time since t0 (s)')
    _plot_track(track, result)
    for axes in (tilt, heading, sigma, innovation, *upper):
        _shade_states(axes, series, axes is tilt)
    _mark_declared(tilt, heading, result)
    for axes in (tilt, heading, sigma, innovation, *upper, track):
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            # Above the axes: nothing that is drawn can lie under it.
            axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), fontsize=8, frameon=False,
                        ncols=7 if axes.figure is left else 5, borderpad=0.2,
                        columnspacing=1.2, handletextpad=0.5)
    if not len(series.time):
        tilt.text(0.5, 0.5, 'no attitude', transform=tilt.transAxes, ha='center')
    return figure


class _Series:
    """
    A result's epochs with an attitude, as arrays over time.

    Where an alignment starts over or hears nothing for long lies a row of nan, so that nothing is
    drawn across.
    """

    def __init__(self, result: ReplayResult) -> None:
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
        self.declared = declared_spans(result.epochs)
        self.levelled = declared_spans(result.epochs, State.LEVELLED)
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


def _plot_angles(axes: Axes, series: _Series, lines: tuple[tuple[int, str, str], ...]) -> None:
    if not len(series.time):
        return
    angles = np.where(series.angle_sigma < LOST_SIGMA_DEG, series.angles, np.nan)
    for column, name, colour in lines:
        axes.plot(*_broken_at_wraps(series.time, angles[:, column]), color=colour, linewidth=2.0,
                  label=name)
    if series.reference is not None:
        for number, (column, _, _) in enumerate(lines):
            axes.plot(*_broken_at_wraps(series.time, series.reference[:, column]), color='black',
                      linewidth=0.8, linestyle='--', label=None if number else 'reference')
    limits = axes.get_ylim()  # the first sigmas would make flat lines of these
    for column, name, colour in lines:
        angle, sigma = angles[:, column], series.angle_sigma[:, column]
        axes.fill_between(series.time, angle - sigma, angle + sigma, color=colour, alpha=0.25,
                          linewidth=0, label=f'{name}, 1 sigma', where=_continues(angle))
    axes.set_ylim(limits)


def _continues(angle: np.ndarray) -> np.ndarray:
    """Whether no wrap lies before or after."""
    steps = np.abs(np.diff(angle)) > 180.0
    return ~(np.concatenate([steps, [False]]) | np.concatenate([[False], steps]))


def _broken_at_wraps(time: np.ndarray, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put a gap where a line would run from one end of the scale to the other."""
    wraps = np.flatnonzero(np.abs(np.diff(angle)) > 180.0) + 1
    return np.insert(time, wraps, np.nan), np.insert(angle, wraps, np.nan)


def _plot_sigma(axes: Axes, series: _Series, result: ReplayResult) -> None:
    axes.set_ylabel('1 sigma (deg)')
    if not len(series.time):
        return
    for column, name, colour in ((0, 'tilt', ROLL), (2, 'heading', HEADING)):
        now = series.angle_sigma[:, column]
        first = series.initial_sigma
        first = first[:, 2] if column else first[:, :2].max(axis=1)
        threshold = (result.config.heading_std_threshold if column
                     else result.config.tilt_std_threshold)
        axes.semilogy(series.time, now, color=colour, linewidth=1.2, label=f'{name}, current')
        axes.semilogy(series.time, first, color=colour, linewidth=1.0, linestyle=':',
                      label=f'{name}, at t0')
        axes.axhline(threshold, color=colour, linewidth=0.8, linestyle='--', alpha=0.7)
        axes.annotate('threshold', (1.0, threshold), xycoords=('axes fraction', 'data'),
                      xytext=(3, 0), textcoords='offset points', ha='left', va='center',
                      fontsize=7, color=colour)


def _plot_innovations(axes: Axes, series: _Series, result: ReplayResult) -> None:
    kind = 'velocity' if result.topics.velocity is not None else 'position'
    axes.set_ylabel(f'innovation of the\n{kind} (sigma)')
    finite = np.isfinite(series.innovations).any(axis=1)
    if not finite.any():
        return
    # Outliers may be anything: they are drawn at the edge.
    limit = max(INNOVATION_LIMIT, 1.5 * float(np.nanquantile(np.abs(series.innovations), 0.99)))
    for column, (name, colour) in enumerate(AXES_OF_ENU):
        axes.plot(series.time[finite],
                  np.clip(series.innovations[finite, column], -limit, limit), color=colour,
                  linestyle='none', marker='.', markersize=3, label=name)
    for level in (-3.0, 3.0):
        axes.axhline(level, color='black', linewidth=0.8, linestyle=':',
                     label='3 sigma' if level > 0.0 else None)
    axes.set_ylim(-1.05 * limit, 1.05 * limit)


def _plot_bias(axes: Axes, time: np.ndarray, biases: np.ndarray, std: np.ndarray) -> None:
    """Draw three biases, and at the end how well they are known."""
    if not len(time):
        return
    for column, (name, colour) in enumerate(AXES_OF_IMU):
        axes.plot(time, biases[:, column], color=colour, linewidth=1.2, label=name)
        axes.errorbar(time[-1:], biases[-1:, column], yerr=std[column], color=colour,
                      capsize=3.0, linewidth=1.2,
                      label='1 sigma at the end' if column == 2 else None)
    # The first seconds tell nothing yet.
    settled = biases[len(biases) // 10:]
    low, high = np.nanmin(settled) - std.max(), np.nanmax(settled) + std.max()
    margin = 0.1 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)


def _plot_errors(axes: Axes, series: _Series, errors: np.ndarray) -> None:
    axes.set_ylabel('error against\nreference (deg)')
    finite = np.isfinite(errors).all(axis=1)
    if not finite.any():
        axes.set_title('the reference does not cover these epochs', fontsize=10)
        return
    for column, name, colour in ((0, 'roll', ROLL), (1, 'pitch', PITCH), (2, 'yaw', HEADING)):
        axes.plot(series.time, errors[:, column], color=colour, linewidth=1.0, label=name)
    for sign, label in ((1.0, 'heading, 3 sigma'), (-1.0, None)):
        axes.plot(series.time, sign * 3.0 * series.sigma[:, 2], color=HEADING, linewidth=0.8,
                  linestyle=':', label=label)
    # What is seen of an error is its end: its first seconds, of every start, are as large as an
    # angle can be.
    settled = finite & (series.aligned if series.declared
                        else series.time >= np.median(series.time[finite]))
    largest = np.abs(errors[settled if settled.any() else finite]).max()
    limit = max(1.0, 2.0 * largest)
    axes.set_ylim(-limit, limit)


def _plot_track(axes: Axes, result: ReplayResult) -> None:
    axes.set_xlabel('east (m)')
    axes.set_ylabel('north (m)')
    track = result.track[np.isfinite(result.track).all(axis=1)]
    if not len(track):
        return
    latitude, longitude = track[0, 1:]
    north = (track[:, 1] - latitude) * METRES_PER_DEGREE
    east = (np.remainder(track[:, 2] - longitude + 180.0, 360.0) - 180.0) \
        * METRES_PER_DEGREE * math.cos(math.radians(latitude))
    stamps = np.array([epoch.stamp_ns - result.first_fix_ns for epoch in result.epochs])
    index = np.searchsorted(stamps, track[:, 0], side='right') - 1
    states = [result.epochs[i].state if i >= 0 else State.WAITING_FOR_GNSS for i in index]
    axes.plot(east, north, color='#cccccc', linewidth=0.8, zorder=1)
    for state, colour in STATE_COLOURS.items():
        chosen = np.array([s is state for s in states])
        if chosen.any():
            axes.scatter(east[chosen], north[chosen], s=7, color=colour, zorder=2,
                         label=state.value)
    axes.plot(east[0], north[0], marker='^', color='black', markersize=8, linestyle='none',
              label='start', zorder=3)
    axes.set_aspect('equal', adjustable='datalim')


def _shade_states(axes: Axes, series: _Series, named: bool) -> None:
    """Shade the times that were ALIGNED or LEVELLED; one legend with the names is enough."""
    for spans, colour, label in (
            (series.levelled, STATE_COLOURS[State.LEVELLED], 'roll and pitch declared'),
            (series.declared, DECLARED_GREEN, 'declared aligned')):
        for number, (start, end) in enumerate(spans):
            axes.axvspan(start, end, color=colour, alpha=0.1, linewidth=0)
            axes.axvline(start, color=colour, linewidth=1.2,
                         label=label if named and number == 0 else None)


def _mark_declared(tilt: Axes, heading: Axes, result: ReplayResult) -> None:
    """Draw the attitude as it was declared, with its sigma, where it holds: at its t0."""
    declared = result.declared
    if declared is None or result.first_t0_ns is None:
        return
    time = (declared.stamp_ns - result.first_t0_ns) * 1e-9
    level, up = max(declared.sigma_deg[:2]), declared.sigma_deg[2]
    for axes, angle, sigma, label in (
            (tilt, declared.roll_deg, level, 'declared, at its t0'),
            (tilt, declared.pitch_deg, level, None), (heading, declared.yaw_deg, up, None)):
        axes.errorbar([time], [angle], yerr=[sigma], color='black', marker='D', markersize=4,
                      capsize=3.0, linewidth=1.0, linestyle='none', label=label, zorder=5)
