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
"""Tables, figures, and files that are written whole or not at all."""

import dataclasses
import math
import os
import re
from types import SimpleNamespace

from ins_align.config import Config
from ins_align.offline import replay
from ins_align.outputs import process, Task, write_whole
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import deserialize
from ins_align.report import format_table, plot, STATE_COLOURS, summary
from ins_align.results import State
from ins_align.simulation.simulate import simulate, write_bag
from matplotlib.colors import to_rgb
import numpy as np
import pytest
from recordings import messages_of, write_messages

DECLARED_GREEN = STATE_COLOURS[State.ALIGNED]


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    monkeypatch.setenv('COLUMNS', '1000')


@pytest.fixture(scope='module')
def result(tmp_path_factory):
    path = tmp_path_factory.mktemp('report') / 'flight'
    write_bag(simulate('flight', seed=1, duration=30.0), path)
    return replay(path, Config(lever_arm=(1.0, 1.0, 1.0)))


def test_table_is_aligned():
    text = format_table([['a', 1.23456, 'x'], ['longer', None, 12], ['n', math.nan]],
                        ['name', 'value', 'text'], '  ')
    assert text.splitlines() == [
        '  name    value  text',
        '  ------  -----  ----',
        '  a       1.235     x',
        '  longer      -    12',
        '  n           -']


def test_table_of_nothing():
    assert format_table([]) == ''
    assert format_table([['a', 1]]) == 'a  1'


def test_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / 'a.txt'
    write_whole(path, lambda file: file.write(b'first'))
    assert path.read_bytes() == b'first'

    def fail(file):
        file.write(b'sec')
        raise RuntimeError('on the way')

    with pytest.raises(RuntimeError):
        write_whole(path, fail)
    assert path.read_bytes() == b'first'
    write_whole(path, lambda file: file.write(b'third'))
    assert path.read_bytes() == b'third'
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / 'store').mkdir()
    link, target = tmp_path / 'link.txt', tmp_path / 'store' / 'real.txt'
    link.symlink_to(target)
    for content in (b'first', b'second'):
        write_whole(link, lambda file: file.write(content))
        assert link.is_symlink() and target.read_bytes() == content
    assert list(target.parent.iterdir()) == [target]


def test_what_is_no_file_is_not_replaced(tmp_path):
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    with pytest.raises(OSError, match='no file'):
        write_whole(pipe, lambda file: file.write(b'content'))
    assert pipe.is_fifo() and list(tmp_path.iterdir()) == [pipe]


def with_states(result, *epochs):
    """Return a result with epochs 1 s apart, of states with reasons and why it started over."""
    state, reason, _ = epochs[-1]
    return dataclasses.replace(
        result, status=dataclasses.replace(result.status, state=State(state), reason=reason),
        epochs=tuple(
            dataclasses.replace(result.epochs[0], t_s=float(k), state=State(state), reason=reason,
                                started_over=why)
            for k, (state, reason, why) in enumerate(epochs)))


def changes_in(text):
    """Return the lines of a summary that tell the changes of the state."""
    return [' '.join(line.split()) for line in text.splitlines()
            if re.match(r' +[\d.]+ s  [A-Z]| +\.\.\. ', line)]


def test_changes_of_the_state_are_told_with_their_reasons(result):
    assert changes_in(summary(with_states(
        result, ('ALIGNING', 'few epochs', ''), ('ALIGNING', 'fewer', ''), ('ALIGNED', 'sure', ''),
        ('ALIGNED', 'very sure', ''), ('ALIGNING', 'residuals', ''),
        ('ALIGNING', 'few epochs', 'alignment starts over: a jump')))) == [
            '0.0 s ALIGNING: few epochs', '2.0 s ALIGNED: sure', '4.0 s ALIGNING: residuals',
            '5.0 s ALIGNING: alignment starts over: a jump; few epochs']
    assert changes_in(summary(with_states(result, ('ALIGNING', 'few epochs', '')))) == []


@pytest.mark.parametrize('count, left_out', [(6, 0), (7, 0), (8, 2), (500, 494)])
def test_many_changes_are_cut_in_the_table_and_whole_in_json(result, count, left_out):
    many = with_states(result, *((('ALIGNED', 'ALIGNING')[k % 2], f'reason {k}', '')
                                 for k in range(count)))
    lines = changes_in(summary(many))
    assert len(lines) == (7 if left_out else count)
    assert lines[2].endswith('reason 2') and lines[-3].endswith(f'reason {count - 3}')
    assert (lines[3] == f'... {left_out} more, all of them in --json') == bool(left_out)
    assert [change['reason'] for change in many.to_json()['changes']] == [
        f'reason {k}' for k in range(count)]


@pytest.mark.parametrize('states, words', [
    ('A', 'ALIGNING'), ('AD', 'ALIGNED after 1.0 s'), ('DD', 'ALIGNED after 0.0 s'),
    ('ADDLD', 'ALIGNED (first ALIGNED after 1.0 s, declarations: 2)'),
    ('DADADL', 'LEVELLED (first ALIGNED after 0.0 s, declarations: 3)')])
def test_headline_gives_the_first_declaration(result, states, words):
    names = {'A': 'ALIGNING', 'D': 'ALIGNED', 'L': 'LEVELLED'}
    told = with_states(result, *((names[state], 'why', '') for state in states))
    assert told.state_in_words == words
    assert f'  {words}: ' in summary(told)


@pytest.mark.parametrize('columns', [60, 100])
def test_long_reasons_are_wrapped(result, monkeypatch, columns):
    monkeypatch.setenv('COLUMNS', str(columns))
    reason = 'a sentence that goes on and on, as sentences may; ' * 5
    text = summary(with_states(result, ('ALIGNING', 'short', ''), ('ALIGNED', reason, '')))
    told = text[text.index('\n\n') + 2:text.index('attitude, deg')].rstrip().splitlines()
    assert told[0].split() == ['0.0', 's', 'ALIGNING:', 'short']
    assert ' '.join(' '.join(told[1:]).split()) == f'1.0 s ALIGNED: {reason.strip()}'
    assert len(told) > 3 and max(map(len, told)) <= columns
    start = told[1].index('ALIGNED')
    assert all(line[:start + 2].isspace() for line in told[2:])


def test_times_go_on_where_the_clock_is_set_back(tmp_path):
    """A recording that was played twice, one after the other."""
    truth = simulate('flight', seed=1, duration=20.0)
    write_bag(truth, tmp_path / 'flight')
    with Bag(tmp_path / 'flight') as bag:
        topics = [topic for topic in bag.topics if not topic.name.startswith('/reference')]
        messages = [(topic.name, time, deserialize(data, topic))
                    for topic, time, data in messages_of(bag, topics)]
    later = round(25e9)
    path = write_messages(tmp_path / 'twice', 'mcap', [*messages, *(
        (name, time + later, message) for name, time, message in messages)],
        {topic.name: topic.msgtype for topic in topics})
    result = replay(path, Config(lever_arm=(1.0, 1.0, 1.0)))
    assert result.status.counts['clock_jumps'] == 1
    times = [epoch.t_s for epoch in result.epochs]
    assert times == sorted(times) and times[-1] > 35.0
    changed = [float(line.split()[0]) for line in changes_in(summary(result))]
    assert len(changed) >= 4 and changed == sorted(changed)
    again = next(span for span in result.spans if 'clock' in span.reason)
    assert 18.0 < again.first.t_s < 22.0
    row = next(line.split() for line in summary(result).splitlines()
               if line.split()[:1] == ['final'])
    assert float(row[1]) == pytest.approx(times[-1], abs=0.1)
    # Declared before the clock was set back, and not again: at t0 on that clock.
    lost = dataclasses.replace(result.status, state=State.ALIGNING)
    once = dataclasses.replace(result, status=lost, epochs=tuple(
        epoch if epoch.t_s < again.first.t_s else dataclasses.replace(epoch, state=State.ALIGNING)
        for epoch in result.epochs))
    row = next(line.split() for line in summary(once).splitlines()
               if line.split()[:1] == ['declared'])
    seconds = (once.declared.stamp_ns - result.epochs[0].stamp_ns) * 1e-9
    assert float(row[1]) == pytest.approx(seconds, abs=0.1)


def test_summary_says_what_matters(result):
    text = summary(result)
    assert f'ALIGNED after {result.status.time_to_align_s:.1f} s: heading sigma ' in text
    assert result.status.reason in text
    initial = result.status.initial
    assert f'{initial.yaw_deg:.3f}' in text and f' {initial.heading_deg:.3f} ' in text
    north = initial.C_nb.T @ [0.0, 1.0, 0.0]    # seen from the vehicle, at 0 deg ahead
    assert np.degrees(np.arctan2(north[1], north[0])) % 360.0 == pytest.approx(
        initial.heading_deg, abs=3.0)           # level to so much
    assert 'error roll' in text
    assert 'imu 3001' in text
    assert 'error roll' not in summary(dataclasses.replace(result, reference=None))


def test_summary_without_an_attitude(result):
    status = dataclasses.replace(result.status, initial=None, current=None, counts={},
                                 time_to_align_s=None)
    text = summary(dataclasses.replace(result, status=status))
    assert text.splitlines()[-1] == '  counts: nothing read'
    assert 'roll' not in text


@pytest.mark.parametrize('suffix, magic', [('.pdf', b'%PDF'), ('.SVG', b'<?xml')])
def test_figure_is_saved(result, tmp_path, suffix, magic):
    path = tmp_path / ('a' + suffix)
    done = process(Task('flight', {'path': result.bag, 'duration': 5.0}, plot=str(path)))
    assert done.text and path.read_bytes().startswith(magic)


def drawn(figure):
    """Return every axes by its label after a layout."""
    figure.draw_without_rendering()
    return figure.axes


def test_figure_has_labels_with_units_and_no_overlap(result):
    figure = plot(result)
    axes = drawn(figure)
    assert len(axes) == 8
    for one in axes:
        assert re.search(r'\((deg|m\)|m/s|sigma)', one.get_ylabel()), one.get_ylabel()
    assert [one.get_xlabel() for one in axes if one.get_xlabel()] == [
        'time since t0 (s)', 'time since t0 (s)', 'east (m)']
    renderer = figure.canvas.get_renderer()
    boxes = [one.get_window_extent(renderer) for one in axes]
    texts = [one.yaxis.label.get_window_extent(renderer) for one in axes]
    for index, text in enumerate(texts):
        assert not any(text.overlaps(other) for other in texts[index + 1:] + boxes)
    legends = [one.get_legend().get_window_extent(renderer) for one in axes if one.get_legend()]
    for index, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[index + 1:])
        assert not any(box.shrunk(0.99, 0.97).overlaps(legend) for legend in legends)
    for legend in legends:
        assert figure.bbox.x0 <= legend.x0 and legend.x1 <= figure.bbox.x1


def test_figure_marks_the_declaration(result):
    first = next(epoch.t_s for epoch in result.epochs if epoch.state.value == 'ALIGNED')
    tilt = plot(result).axes[0]
    marks = [line for line in tilt.lines if line.get_label() == 'declared aligned']
    assert [line.get_xdata()[0] for line in marks] == [first]
    # In one legend, and in it the attitude as the node publishes it, at its t0.
    names = [[text.get_text() for text in axes.get_legend().get_texts()]
             for axes in plot(result).axes if axes.get_legend()]
    assert ['declared aligned' in of_one for of_one in names].count(True) == 1
    assert 'declared, at its t0' in names[0]


def test_what_was_declared_is_in_the_table(result):
    """As known when it was declared, which is what the node publishes, not at the end."""
    epoch = next(epoch for epoch in result.epochs if epoch.state is State.ALIGNED)
    declared = epoch.initial
    assert result.declared is declared
    row = next(line.split() for line in summary(result).splitlines()
               if line.split()[:1] == ['declared'])
    seconds = (declared.stamp_ns - result.epochs[0].stamp_ns) * 1e-9 + result.epochs[0].t_s
    assert row[1:5] == [f'{seconds:.1f}', *(f'{angle:.3f}' for angle in (
        declared.roll_deg, declared.pitch_deg, declared.yaw_deg))]
    not_declared = dataclasses.replace(result, epochs=result.epochs[:2])
    assert not_declared.declared is None and 'declared  ' not in summary(not_declared)


def test_roll_and_pitch_alone_are_shaded_too(result):
    epochs = [dataclasses.replace(epoch, state=State.LEVELLED) if epoch.t_s < 5.0 else epoch
              for epoch in result.epochs]
    figure = plot(dataclasses.replace(result, epochs=tuple(epochs)))
    colours = {patch.get_facecolor()[:3] for patch in figure.axes[0].patches}
    assert colours == {to_rgb(STATE_COLOURS[State.LEVELLED]), to_rgb(DECLARED_GREEN)}


def test_figure_shows_every_angle_whole(result):
    steep = [dataclasses.replace(epoch, current=epoch.current and SimpleNamespace(
        roll_pitch_yaw_deg=np.add(epoch.current.roll_pitch_yaw_deg, [0.0, 80.0, 0.0]),
        sigma_deg=epoch.current.sigma_deg))
        for epoch in result.epochs]
    reference = SimpleNamespace(errors_deg=lambda attitude: np.full(3, 100.0))
    tilt = plot(dataclasses.replace(result, epochs=tuple(steep), reference=reference)).axes[0]
    low, high = tilt.get_ylim()
    lines = [line.get_ydata() for line in tilt.lines if len(line.get_xdata()) > 10]
    assert len(lines) == 4  # two of the reference
    assert max(map(np.nanmax, lines)) > 75.0 and min(map(np.nanmin, lines)) < -75.0
    for values in lines:
        assert low < np.nanmin(values) and np.nanmax(values) < high


def test_figure_takes_every_name(result):
    figure = plot(dataclasses.replace(result, bag='/data/$a_{b_$ \udcff'))
    drawn(figure)
    assert figure.get_suptitle().startswith('$a_{b_$ ?: ALIGNED')


@pytest.fixture(scope='module')
def restarted(tmp_path_factory):
    """Replay a drive whose IMU says nothing from 20 s to 21.5 s."""
    truth = simulate('car', seed=1, duration=40.0)
    seconds = (truth.imu_stamps_ns - truth.imu_stamps_ns[0]) * 1e-9
    heard = (seconds < 20.0) | (seconds > 21.5)
    names = ('imu_stamps_ns', 'gyro', 'accel', 'truth_C_nb', 'truth_gyro', 'truth_accel')
    path = tmp_path_factory.mktemp('report') / 'silent'
    write_bag(dataclasses.replace(truth, **{name: getattr(truth, name)[heard] for name in names}),
              path)
    result = replay(path, Config(lever_arm=(1.0, 1.0, 1.0)))
    first = result.epochs[0].stamp_ns
    epochs = [dataclasses.replace(epoch, t_s=(epoch.stamp_ns - first) * 1e-9)
              for epoch in result.epochs]
    return dataclasses.replace(result, epochs=tuple(epochs))


@pytest.fixture(scope='module')
def dry(tmp_path_factory):
    """Replay a drive of 100 s whose GNSS says nothing from 20 s to 30 s and from 40 s on."""
    truth = simulate('car', imu_grade='mems', seed=1, duration=100.0)
    seconds = (truth.gnss_stamps_ns - truth.gnss_stamps_ns[0]) * 1e-9
    heard = (seconds < 20.0) | (seconds > 30.0) & (seconds < 40.0)
    names = ('gnss_stamps_ns', 'gnss_arrival_ns', 'lla_deg', 'velocity')
    path = tmp_path_factory.mktemp('report') / 'dry'
    write_bag(dataclasses.replace(truth, **{name: getattr(truth, name)[heard] for name in names}),
              path)
    return replay(path, Config(lever_arm=(1.0, 1.0, 1.0)))


def test_what_is_declared_lasts_into_an_outage(dry):
    (start, end), = [(first.t_s, last.t_s) for first, last in dry.spans_of(State.ALIGNED)]
    assert start < 20.0 and 42.0 < end < 98.0 and dry.status.state is not State.ALIGNED
    told = changes_in(summary(dry))
    assert f'{start:.1f} s ALIGNED: ' in ' '.join(told)
    withdrawn = next(span for span in dry.spans if span.first.t_s > end)
    assert withdrawn.first.state is not State.ALIGNED and 'no GNSS for' in withdrawn.reason
    assert (f'{withdrawn.first.t_s:.1f} s {withdrawn.first.state.value}: {withdrawn.reason}'
            in told)
    bands = [patch.get_extents().transformed(axes.transData.inverted())
             for axes in drawn(plot(dry))[:1] for patch in axes.patches
             if patch.get_facecolor()[:3] == to_rgb(DECLARED_GREEN)]
    assert [(band.x0, band.x1) for band in bands] == [pytest.approx((start, end))]


def test_why_it_started_over_is_told(restarted):
    again, = [span for span in restarted.spans if 'starts over' in span.reason]
    assert again.first.state is State.ALIGNING and 20.0 < again.first.t_s < 23.0
    assert 'starts over: no IMU sample' in again.reason and again.reason in summary(restarted)
    changes = restarted.to_json()['changes']
    assert [change['state'] for change in changes].count('ALIGNED') == 2
    assert [change['stamp'] for change in changes] == [
        span.first.stamp_ns for span in restarted.spans]


def test_the_table_has_no_row_without_gnss(dry):
    times = [float(line.split(',')[1]) for line in dry.to_csv().splitlines()[1:]]
    assert len(times) > 100 and times[-1] < 40.0
    assert not [time for time in times if 20.0 < time < 30.0]


def test_nothing_is_drawn_across_a_restart(restarted):
    shown = [epoch.t_s for epoch in restarted.epochs if epoch.initial and epoch.current]
    figure = plot(restarted)
    drawn(figure)
    bands = 0
    for axes in figure.axes[:-1]:  # the last one is the track
        for line in axes.lines:
            time, value = np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)
            if len(time) < 10 or line.get_linestyle() == 'None':
                continue  # a mark at one time or one level; points
            there = np.isfinite(time + value)
            joined = there[1:] & there[:-1]
            assert joined.any()
            assert not np.any(joined & (time[:-1] < 20.7) & (time[1:] > 20.7)), line.get_label()
            assert set(time[there]) <= set(shown)
        for collection in axes.collections:
            for path in collection.get_paths():
                times = path.vertices[:, 0]
                bands += times.max() < 20.7
                assert times.max() < 20.7 or times.min() > 20.7
    assert bands >= 3  # roll, pitch, yaw
    tilt = figure.axes[0]
    roll = lines_of(tilt)['roll']
    assert np.nanmin(roll.get_xdata()) == shown[0] and np.nanmax(roll.get_xdata()) == shown[-1]
    declared = [line for line in tilt.lines if line.get_color() == DECLARED_GREEN]
    assert [line.get_xdata()[0] > 20.7 for line in declared] == [False, True]


def test_error_is_shown_as_it_is_while_declared(restarted):
    """The first seconds after a restart, with any heading, do not make the rest a flat line."""
    axes = next(one for one in plot(restarted).axes
                if one.get_ylabel().startswith('error'))
    assert axes.get_ylim()[1] < 10.0


def test_nothing_is_drawn_across_an_outage(dry):
    time = lines_of(plot(dry).axes[5])['z'].get_xdata()
    shown = np.flatnonzero(np.isfinite(time))
    (start, end), = [time[[a, b]] for a, b in zip(shown, shown[1:]) if b > a + 1]
    assert 19.0 < start <= 20.5 and 29.5 < end < 31.0


def lines_of(axes):
    """Return the lines of an axes by their label."""
    return {line.get_label(): line for line in axes.lines}


def test_figure_shows_innovations_and_biases(result):
    axes = {one.get_ylabel().replace('\n', ' '): one for one in plot(result).axes}
    shown = [epoch for epoch in result.epochs if epoch.current is not None]
    up = lines_of(axes['innovation of the GNSS (sigma)'])['up'].get_ydata()
    tested = [epoch.innovation[2] for epoch in shown if np.isfinite(epoch.innovation).any()]
    assert len(tested) > 100
    assert np.clip(tested, -5.0, 5.0) == pytest.approx(up[np.isfinite(up)].clip(-5.0, 5.0))
    z = lines_of(axes['gyro bias (deg/s)'])['z'].get_ydata()
    assert z[np.isfinite(z)] == pytest.approx(
        np.degrees([epoch.gyro_bias[2] for epoch in shown]))
    x = lines_of(axes['accelerometer bias (m/s\u00b2)'])['x'].get_ydata()
    assert x[np.isfinite(x)] == pytest.approx([epoch.accel_bias[0] for epoch in shown])


def test_the_track_has_its_states_where_the_clock_was_set_back_too(result):
    """The second half of the recording with stamps before those of the first."""
    def points(of):
        lines = plot(of).subfigs[1].axes[-1].get_lines()
        return {line.get_label(): len(line.get_xdata()) for line in lines}

    middle, back = result.epochs[len(result.epochs) // 2].stamp_ns, 100 * 10 ** 9
    track = result.track.copy()
    track[track[:, 0] >= middle, 0] -= back
    assert len(points(result)) > 3 and points(result) == points(dataclasses.replace(
        result, track=track, epochs=tuple(
            dataclasses.replace(epoch, stamp_ns=epoch.stamp_ns - back * (epoch.stamp_ns >= middle))
            for epoch in result.epochs)))


def test_outliers_are_drawn_at_the_edge(result):
    epochs = list(result.epochs)
    index = len(epochs) // 2
    epochs[index] = dataclasses.replace(epochs[index], innovation=np.array([1e6, -1e6, 0.0]))
    figure = plot(dataclasses.replace(result, epochs=tuple(epochs)))
    axes = next(one for one in figure.axes if one.get_ylabel().startswith('innovation'))
    low, high = axes.get_ylim()
    assert high < 20.0
    for name in ('east', 'north', 'up'):
        values = lines_of(axes)[name].get_ydata()
        assert low < np.nanmin(values) and np.nanmax(values) < high


def test_figure_without_reference_or_epochs(result):
    assert len(drawn(plot(dataclasses.replace(result, reference=None)))) == 7
    empty = dataclasses.replace(result, epochs=(), track=np.zeros((0, 3)))
    assert len(drawn(plot(empty))) == 8
    unknown = SimpleNamespace(errors_deg=lambda attitude: np.full(3, np.nan))
    assert len(drawn(plot(dataclasses.replace(result, reference=unknown)))) == 8
    untested = [dataclasses.replace(epoch, innovation=np.full(3, np.nan))
                for epoch in result.epochs]
    assert len(drawn(plot(dataclasses.replace(result, epochs=tuple(untested))))) == 8
