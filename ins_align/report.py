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
import itertools
import math
import shutil
import textwrap
from typing import Any, TYPE_CHECKING

from ins_align.results import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHANGES_AT_ENDS = 3  # of the state: the first and the last so many are in the table


def format_table(rows: Sequence[Sequence[Any]], header: Sequence[str] = (),
                 indent: str = '') -> str:
    """
    Align columns of text: the first to the left, all others to the right.

    Cells are text; floats get four significant digits, None is a dash. An indent is in front of
    every line; there is no newline at the end.
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


def summary(result: Result) -> str:
    """Return the table that ``ins_align replay`` prints of a recording."""
    status = result.status
    lines = [result.bag, *_wrapped(f'{result.state_in_words}: {status.reason}', '  '),
             *_list_of_changes(result)]
    declared = None if status.initial is None else result.declared
    rows = []
    for name, attitude in (
            ('declared', declared), ('initial', status.initial), ('final', status.current)):
        if attitude is None:
            continue
        row = [name, f'{result.t_s(attitude.stamp_ns):.1f}']
        row += [f'{angle:.3f}' for angle in (
            *attitude.roll_pitch_yaw_deg, attitude.heading_deg)]
        row += [f'{sigma:.3f}' for sigma in attitude.sigma_deg]
        if result.reference is not None:
            row += ['-' if math.isnan(error) else f'{error:+.3f}'
                    for error in result.reference.errors_deg(attitude)]
        rows.append(row)
    if rows:
        header = ['attitude, deg', 'at, s', 'roll', 'pitch', 'yaw', 'heading', 'sigma e',
                  'n', 'u']
        if result.reference is not None:
            header += ['error roll', 'pitch', 'yaw']
        lines += ['', format_table(rows, header, '  '),
                  '  all times since the first t0, stamp '
                  f'{(result.first_t0_ns or 0) * 1e-9:.3f} s; declared: '
                  'at its t0, as the node publishes it', '', _nuisance_table(result)]
    counts = ', '.join(f'{name} {count}' for name, count in sorted(status.counts.items()) if count)
    return '\n'.join([*lines, '', f'  counts: {counts or "nothing read"}'])


def _list_of_changes(result: Result) -> list[str]:
    """Tell each change of the state, of many the first and the last."""
    told = [_wrapped(f'{span.first.state.value}: {span.reason}', f'  {span.first.t_s:8.1f} s  ')
            for span in result.spans]
    if len(told) < 2:
        return []  # what it says is the state at the end
    left_out = len(told) - 2 * CHANGES_AT_ENDS
    if left_out > 1:
        told[CHANGES_AT_ENDS:-CHANGES_AT_ENDS] = [
            [f'{"":14}... {left_out} more, all of them in --json']]
    return ['', *itertools.chain(*told)]


def _wrapped(text: str, begin: str) -> list[str]:
    """Break a sentence into lines as wide as the terminal, of which the others are indented."""
    return textwrap.wrap(
        text, max(shutil.get_terminal_size().columns, 2 * len(begin)), initial_indent=begin,
        subsequent_indent=' ' * (len(begin) + 2), break_long_words=False, break_on_hyphens=False)


def _nuisance_table(result: Result) -> str:
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


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure that needs no display, inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout='constrained')
    FigureCanvasAgg(figure)
    return figure
