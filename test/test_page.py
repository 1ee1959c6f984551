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
"""The page of a replay: its numbers are those of the other outputs, and it needs no network."""

import base64
import dataclasses
from html import unescape
from html.parser import HTMLParser
import json
import shutil
import sys

from ins_align.cli import main
from ins_align.config import Config
from ins_align.offline import replay
from ins_align.page import MAX_MARKS, page
from ins_align.report import plot
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip('plotly')

# Of a recording; what it holds has no slash, which would end a folder.
NAME = '<script>document.title = "run"<:script><b>&amp;<:b> <img src=x onerror=alert(1)> $x$'


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Make the outputs of a simulated flight with the command itself."""
    folder = tmp_path_factory.mktemp('page')
    write_bag(simulate('flight', seed=1, duration=30.0), folder / 'flight')
    assert main(['replay', str(folder / 'flight'), '--lever-arm', '1', '1', '1',
                 *(word for suffix in ('json', 'csv', 'html') for word in (
                     '--plot' if suffix == 'html' else f'--{suffix}',
                     str(folder / f'flight.{suffix}')))]) == 0
    return folder


@pytest.fixture(scope='module')
def result(folder):
    return replay(folder / 'flight', Config(lever_arm=(1.0, 1.0, 1.0)))


def embedded(html):
    """Return the traces, layout and configuration in a page."""
    text = html[html.rindex('Plotly.newPlot('):]
    decoder, found = json.JSONDecoder(), []
    for begin in ('[', '{', '{'):
        start = text.index(begin)
        value, length = decoder.raw_decode(text[start:])
        text = text[start + length:]
        found.append(value)
    return found


def numbers(values):
    """Return numbers as an array, which newer versions of plotly write in base64."""
    if isinstance(values, dict):
        return np.frombuffer(base64.b64decode(values['bdata']), values['dtype']).astype(float)
    return np.array([np.nan if value is None else value for value in values], float)


def trace_of(traces, axes, name):
    """Return time and value of the points that a trace has, by name and vertical axis."""
    trace, = [one for one in traces if (one['yaxis'], one['name']) == (axes, name)]
    x, y = numbers(trace['x']), numbers(trace['y'])
    there = np.isfinite(x + y)
    return x[there], y[there]


class Tags(HTMLParser):
    """The tags of a page and what they refer to."""

    def __init__(self, html):
        super().__init__()
        self.names, self.references = [], []
        self.feed(html)

    def handle_starttag(self, tag, attributes):
        self.names.append(tag)
        self.references += [value for name, value in attributes if name in ('src', 'href')]


def test_series_are_those_of_the_table(folder):
    traces, _, _ = embedded((folder / 'flight.html').read_text(encoding='utf-8'))
    header, *lines = (folder / 'flight.csv').read_text().splitlines()
    rows = [dict(zip(header.split(','), line.split(','))) for line in lines]
    rows = [row for row in rows if row['current_qx']]
    time = [float(row['t_s']) for row in rows]
    turn = Rotation.from_quat([[float(row[f'current_q{axis}']) for axis in 'xyzw']
                               for row in rows])
    yaw, pitch, roll = turn.as_euler('ZYX', degrees=True).T
    sigma = np.array([[float(row[f'current_sigma_{axis}_deg']) for axis in 'enu'] for row in rows])
    level = sigma[:, :2].max(axis=1)
    for axes, name, values in (('y4', 'tilt, current', level),
                               ('y4', 'heading, current', sigma[:, 2])):
        x, y = trace_of(traces, axes, name)
        assert x == pytest.approx(time) and y == pytest.approx(values)
    for axes, name, values, std in (('y2', 'roll', roll, level), ('y2', 'pitch', pitch, level),
                                    ('y3', 'yaw', yaw, sigma[:, 2])):
        shown = std < 60.0
        x, y = trace_of(traces, axes, name)
        assert x == pytest.approx(np.array(time)[shown]) and y == pytest.approx(values[shown])
        x, y = trace_of(traces, axes, f'{name}, 1 sigma')
        for k in np.flatnonzero(shown)[::20]:
            assert [values[k] - std[k], values[k] + std[k]] == pytest.approx(
                sorted(y[np.abs(x - time[k]) < 1e-6]))


def test_states_reasons_and_declaration_are_those_of_the_json(folder):
    traces, layout, _ = embedded((folder / 'flight.html').read_text(encoding='utf-8'))
    content = json.loads((folder / 'flight.json').read_text())
    marks = [(x, layout['yaxis']['ticktext'][int(y)], unescape(text.replace('<br>', ' ')))
             for trace in traces if trace['yaxis'] == 'y' and 'hovertext' in trace
             for x, y, text in zip(numbers(trace['x']), numbers(trace['y']), trace['hovertext'])]
    assert sorted(marks) == [(change['t_s'], change['state'], change['reason'])
                             for change in content['changes']]
    declared = content['declared_attitude']
    marks = [float(numbers(trace['y'])[0]) for trace in traces
             if trace['name'] == 'declared, at its t0']
    assert marks == pytest.approx([declared[f'{name}_deg'] for name in ('roll', 'pitch', 'yaw')])
    aligned = next(change for change in content['changes'] if change['state'] == 'ALIGNED')
    shaded = [shape for shape in layout['shapes'] if shape['type'] == 'rect']
    assert {shape['x0'] for shape in shaded} == {aligned['t_s']}
    assert len(shaded) == 8  # every panel but the track


def test_page_and_picture_say_the_same(result):
    traces, layout, _ = embedded(page(result))
    figure = plot(result)
    assert layout['title']['text'] == figure.get_suptitle()
    named = {trace['name'] for trace in traces if trace['showlegend']}
    names = {text.get_text() for axes in figure.axes if axes.get_legend()
             for text in axes.get_legend().get_texts()}
    assert names == named
    labels = {axis['title']['text'].replace('<br>', '\n') for name, axis in layout.items()
              if name.startswith('yaxis')}
    assert labels == {'', *(axes.get_ylabel() for axes in figure.axes)}


def test_page_loads_nothing_and_sends_nothing(folder):
    html = (folder / 'flight.html').read_text(encoding='utf-8')
    tags = Tags(html)
    assert tags.references == []
    assert not {'link', 'img', 'iframe', 'object', 'embed'} & set(tags.names)
    _, _, configuration = embedded(html)
    offered = {button for group in configuration['modeBarButtons'] for button in group}
    assert offered == {'zoom2d', 'pan2d', 'resetScale2d', 'toImage'}


def test_names_are_text(folder, result):
    html = page(dataclasses.replace(result, bag=NAME))
    names = Tags(html).names
    assert names == Tags((folder / 'flight.html').read_text(encoding='utf-8')).names
    assert unescape(embedded(html)[1]['title']['text']).startswith(f'{NAME}: ALIGNED')


def test_nothing_is_drawn_across_an_outage(result):
    epochs = [epoch for epoch in result.epochs if not 12.0 < epoch.t_s < 20.0]
    traces, _, _ = embedded(page(dataclasses.replace(result, epochs=tuple(epochs))))
    bands = [trace for trace in traces if trace.get('fill') == 'toself']
    assert len(bands) == 3
    for trace in bands:
        x = numbers(trace['x'])
        assert np.isnan(x[-1])
        pieces = [piece[np.isfinite(piece)] for piece in np.split(x, np.flatnonzero(np.isnan(x)))]
        pieces = [piece for piece in pieces if piece.size]
        assert {piece[0] > 16.0 for piece in pieces} == {False, True}
        for piece in pieces:
            assert not (piece.min() <= 12.0 and piece.max() >= 20.0)
            assert piece.tolist() == piece[::-1].tolist()  # there above and back below


def test_page_without_reference_epochs_or_attitude(result):
    for less in (dataclasses.replace(result, reference=None),
                 dataclasses.replace(result, epochs=()),
                 dataclasses.replace(result, epochs=(), track=np.zeros((0, 3))),
                 dataclasses.replace(result, epochs=result.epochs[:1])):
        traces, layout, _ = embedded(page(less))
        assert ('no attitude' in json.dumps(layout.get('annotations'))) == (
            len(less.epochs) < 2)
        assert any(trace['name'] == 'roll' for trace in traces) == (len(less.epochs) > 1)


def test_many_marks_are_a_line(result):
    count = MAX_MARKS + 1
    track = np.stack([np.linspace(0.0, 30e9, count), np.linspace(48.0, 48.1, count),
                      np.full(count, 11.0)], axis=-1)
    traces, _, _ = embedded(page(dataclasses.replace(result, track=track)))
    modes = {trace['name']: trace['mode'] for trace in traces if trace['name'] in (
        'east', 'ALIGNED')}
    assert modes == {'east': 'markers', 'ALIGNED': 'lines'}


def test_without_plotly_it_says_what_to_install(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, 'plotly', None)
    path = tmp_path / 'a.HTML'
    assert main(['replay', str(folder / 'flight'), '--plot', str(path)]) == 2
    assert capsys.readouterr().err == (
        f'ins_align replay: --plot {path} needs plotly, which is not installed: '
        'pip install plotly\n')


@pytest.fixture(scope='module')
def browser():
    api = pytest.importorskip('playwright.sync_api')
    with api.sync_playwright() as tools:
        try:
            browser = tools.chromium.launch(
                executable_path=shutil.which('chromium') or shutil.which('google-chrome'))
        except api.Error as error:
            pytest.skip(f'no browser: {str(error).splitlines()[0]}')
        yield browser
        browser.close()


@pytest.fixture
def opened(browser, folder, result, tmp_path):
    """Open a page with a name that wants to be markup; return it with what it asked for."""
    path = tmp_path / 'a.html'
    path.write_text(page(dataclasses.replace(result, bag=NAME)))
    view, seen = browser.new_page(viewport={'width': 1400, 'height': 1000}), []
    view.on('request', lambda request: seen.append(request.url))
    view.on('pageerror', lambda error: seen.append(str(error)))
    view.goto(path.as_uri())
    view.wait_for_selector('.scatterlayer .trace path')
    yield view, path.as_uri(), seen
    view.close()


def range_of(view, axis):
    return view.evaluate(f'document.querySelector(".js-plotly-plot")._fullLayout.{axis}.range')


def test_a_browser_draws_it_and_asks_for_nothing_else(opened, result):
    view, uri, seen = opened
    panels = view.locator('.cartesianlayer > .subplot').count()
    assert panels == 1 + len(plot(result).axes)
    assert view.locator('.gtitle').text_content().startswith(f'{NAME}: ALIGNED')
    assert view.title() != 'run'
    for button in view.locator('.modebar-btn').all():
        assert 'hare' not in (button.get_attribute('data-title') or '')
    assert seen == [uri]


def test_in_a_browser_zooming_one_panel_zooms_all_over_time(opened):
    view, uri, seen = opened
    track = range_of(view, 'xaxis9')
    box = view.locator('.draglayer .x2y2 .nsewdrag').bounding_box()
    y = box['y'] + 0.5 * box['height']
    view.mouse.move(box['x'] + 0.4 * box['width'], y)
    view.mouse.down()
    view.mouse.move(box['x'] + 0.6 * box['width'], y, steps=5)
    view.mouse.up()
    view.wait_for_function(
        'document.querySelector(".js-plotly-plot")._fullLayout.xaxis8.range[0] > 8')
    ranges = [range_of(view, f'xaxis{number}') for number in ('', *range(2, 9))]
    assert all(one == ranges[0] for one in ranges) and ranges[0][1] < 22.0
    assert range_of(view, 'xaxis9') == track
    assert seen == [uri]


def test_in_a_browser_the_pointer_shows_the_reason(opened, result):
    view, _, _ = opened
    box = view.locator('.subplot.xy .points path').last.bounding_box()
    view.mouse.move(box['x'] + 0.5 * box['width'], box['y'] + 0.5 * box['height'])
    view.wait_for_selector('.hoverlayer .hovertext')
    shown = view.locator('.hoverlayer').text_content()
    assert result.changes[-1].reason.split(',')[0] in shown
