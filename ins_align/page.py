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
"""A picture of a result as a page: one file that loads nothing, to zoom and to point at."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from itertools import accumulate
from textwrap import wrap
from typing import Any, TYPE_CHECKING

from ins_align.geometry.rotation import Array
from ins_align.panels import Curve, OVER_TIME, Panel, Picture, picture, STATE_COLOURS
from ins_align.results import Result, State
import numpy as np

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

DASHES = {'-': 'solid', '--': 'dash', ':': 'dot'}
SYMBOLS = {'.': 'circle', 'D': 'diamond', '^': 'triangle-up', '': 'circle'}
LEFT, RIGHT = (0.0, 0.57), (0.65, 1.0)  # the columns, as parts of the width
# Not all that plotly has: one of them sends the figure to a server.
BUTTONS = [['zoom2d', 'pan2d', 'resetScale2d', 'toImage']]
MAX_MARKS = 5000                        # of a curve; more make a browser slow: a line instead
GAP = 0.06                              # between panels, as a part of the height
NOTE_WIDTH = 80                         # characters


def page(result: Result) -> str:
    """Return the page of a recording, HTML."""
    html: str = page_figure(result).to_html(
        include_plotlyjs=True, default_height='max(97vh, 900px)',
        config={'displaylogo': False, 'responsive': True, 'modeBarButtons': BUTTONS})
    return html


def page_figure(result: Result) -> Figure:
    """Draw the picture of a recording, with its states and the reasons for them above."""
    from plotly.graph_objects import Figure

    shown = picture(result)
    states, axis = _states(result, shown)
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {
        'template': 'plotly_white', 'hovermode': 'closest', 'font': {'size': 11},
        'title': {'text': _literal(shown.title), 'x': 0.5, 'y': 0.99, 'yanchor': 'top'},
        'margin': {'l': 70, 'r': 20, 't': 30, 'b': 50}, 'shapes': [], 'annotations': []}
    number = ''  # of the axes, as plotly has it: none, 2, 3 ...
    for across, panels, heights in (
            (LEFT, [states, *shown.left], [0.6] + [1.0] * len(shown.left)),
            (RIGHT, shown.right, [1.0] * (len(shown.right) - 1) + [2.2])):
        below = [1.0 - part / sum(heights) for part in accumulate(heights)]
        for panel, bottom, top in zip(panels, below, [1.0, *below]):
            _lay_out(layout, panel, number, across, (max(bottom, 0.0), top - GAP))
            names: set[str] = set()
            for trace in (trace for curve in panel.curves for trace in _traces(curve, number)):
                name = trace['name']
                data.append({**trace, 'legendgroup': number + name,
                             'showlegend': bool(name) and name not in names})
                names.add(name)
            if panel.x_label == OVER_TIME:
                _shade(layout['shapes'], shown, number)
            last, number = number, str(int(number or 1) + 1)
        layout[f'xaxis{last}']['title'] = {'text': panel.x_label}
    layout['yaxis'].update(axis)
    return Figure(data, layout)


def _literal(text: str) -> str:
    """Return a text in which plotly finds no tags; it does not know the entities of quotes."""
    return escape(text, quote=False)


def _states(result: Result, shown: Picture) -> tuple[Panel, dict[str, Any]]:
    """Return the states over time, with their reasons where they change, and their axis."""
    changes = result.changes
    present = [state for state in State if state in {change.state for change in changes}]
    times = [change.t_s for change in changes] + [epoch.t_s for epoch in result.epochs[-1:]]
    rows = [present.index(change.state) for change in changes]
    curves = [Curve('', '#999999', np.repeat(times, 2)[1:-1], np.repeat(rows, 2))]
    for row, state in enumerate(present):
        of_state = [change for change in changes if change.state is state]
        curves.append(Curve(
            '', STATE_COLOURS[state], np.array([change.t_s for change in of_state]),
            np.full(len(of_state), row), '.', 9.0,
            notes=[change.reason for change in of_state]))
    names = {span.name: span.colour for span in shown.spans}  # for the legend
    curves += [Curve(name, colour, np.full(1, np.nan), np.full(1, np.nan))
               for name, colour in names.items()]
    return (Panel('', curves, (-0.5, max(len(present), 1) - 0.5)),
            {'tickvals': list(range(len(present))), 'ticktext': [one.value for one in present]})


def _lay_out(layout: dict[str, Any], panel: Panel, number: str, across: Sequence[float],
             upright: Sequence[float]) -> None:
    """Add the axes and the legend of a panel."""
    over_time = panel.x_label == OVER_TIME
    layout[f'xaxis{number}'] = {'domain': across, 'anchor': f'y{number}'}
    layout[f'yaxis{number}'] = {
        'domain': upright, 'anchor': f'x{number}', 'range': panel.limits,
        'type': 'log' if panel.log else 'linear',
        'title': {'text': panel.label.replace('\n', '<br>')}}
    if not over_time:
        layout[f'yaxis{number}']['scaleanchor'] = f'x{number}'
    elif number:
        layout[f'xaxis{number}']['matches'] = 'x'
    layout[f'legend{number}'] = {
        'x': across[0], 'y': upright[1], 'yanchor': 'bottom', 'orientation': 'h',
        'font': {'size': 10}, 'bgcolor': 'rgba(0,0,0,0)'}
    if panel.note:
        layout['annotations'].append({
            'text': panel.note, 'showarrow': False, 'x': 0.5, 'y': 0.5,
            'xref': f'x{number} domain', 'yref': f'y{number} domain'})


def _traces(curve: Curve, number: str) -> Iterator[dict[str, Any]]:
    """Yield what plotly draws of a curve: the band first, then the line or the marks."""
    common = {'type': 'scatter', 'xaxis': f'x{number}', 'yaxis': f'y{number}',
              'legend': f'legend{number}'}
    trace: dict[str, Any] = {
        **common, 'name': curve.name, 'x': curve.x, 'y': curve.y, 'mode': 'lines',
        'hoverinfo': 'all' if curve.name or curve.notes else 'skip'}
    if curve.is_line:
        if curve.sigma is not None:
            x, y = _outline(curve.x, curve.y, curve.sigma)
            yield {**common, 'name': f'{curve.name}, 1 sigma', 'x': x, 'y': y, 'mode': 'lines',
                   'line': {'width': 0, 'color': curve.colour}, 'fill': 'toself', 'opacity': 0.25,
                   'hoverinfo': 'skip'}
        trace['line'] = {'color': curve.colour, 'width': curve.size, 'dash': DASHES[curve.style]}
    elif len(curve.x) > MAX_MARKS:
        trace['line'] = {'color': curve.colour, 'width': 0.3 * curve.size}
    else:
        trace['mode'] = 'markers'
        trace['marker'] = {'color': curve.colour, 'symbol': SYMBOLS[curve.style],
                           'size': curve.size * (1.0 if curve.style == '.' else 1.8)}
        if curve.sigma is not None:
            trace['error_y'] = {'array': curve.sigma, 'thickness': 1.2, 'width': 3}
    if curve.notes:
        trace['hovertext'] = ['<br>'.join(map(_literal, wrap(note, NOTE_WIDTH)))
                              for note in curve.notes]
    yield trace


def _outline(x: Array, y: Array, sigma: Array) -> tuple[Array, Array]:
    """Return the closed outlines of a band, one for each piece between gaps, nan between them."""
    there = np.isfinite(x + y + sigma).astype(int)
    pieces = np.flatnonzero(np.diff(there, prepend=0, append=0)).reshape(-1, 2)

    def around(upper: Array, lower: Array) -> Array:
        return np.concatenate([np.zeros(0), *(part for start, end in pieces for part in (
            upper[start:end], lower[start:end][::-1], [np.nan]))])

    return around(x, x), around(y + sigma, y - sigma)


def _shade(shapes: list[dict[str, Any]], shown: Picture, number: str) -> None:
    """Add the spans to a panel over time."""
    for span in shown.spans:
        common = {'xref': f'x{number}', 'yref': f'y{number} domain', 'x0': span.start, 'y0': 0,
                  'y1': 1, 'layer': 'below'}
        shapes += [
            {**common, 'type': 'rect', 'x1': span.end, 'fillcolor': span.colour, 'opacity': 0.1,
             'line': {'width': 0}},
            {**common, 'type': 'line', 'x1': span.start,
             'line': {'color': span.colour, 'width': 1.2}}]
