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
"""Replay: the same numbers whatever the format, the blocks, the reference."""

from contextlib import closing, contextmanager
from dataclasses import replace
import json
from pathlib import Path
import re
import sqlite3

from alignment import feed
import ins_align
from ins_align.aligner import Aligner, Attitude
from ins_align.config import Config
from ins_align.geometry.rotation import log_so3, matrix_from_rpy, quaternion_from_matrix
from ins_align.offline import replay
from ins_align.recordings import bag
from ins_align.recordings.decode import ImuSamples
from ins_align.recordings.info import inspect
from ins_align.results import CSV_HEADER, Reference
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest
from recordings import real_recording, write_recording

CONFIG = Config(lever_arm=(1.0, 1.0, 1.0))


@contextmanager
def copied(flight, path):
    """Open a copy of the flight's database, to change it."""
    with closing(sqlite3.connect(path)) as copy:
        with closing(sqlite3.connect(flight / 'flight.db3')) as database:
            database.backup(copy)
        yield copy
        copy.commit()


@pytest.fixture(scope='module')
def simulation():
    return simulate('flight', seed=3, duration=30.0)


@pytest.fixture(scope='module')
def flight(simulation, tmp_path_factory):
    path = tmp_path_factory.mktemp('replay') / 'flight'
    write_bag(simulation, path, 'sqlite3')
    return path


@pytest.fixture(scope='module')
def result(flight):
    return replay(flight, CONFIG)


def numbers(result):
    """Return all that a result says but the name of the recording."""
    return {**result.to_json(), 'bag': None}, result.to_csv()


def test_same_as_the_messages_without_a_recording(simulation, result):
    aligner = Aligner(CONFIG)
    epochs = feed(aligner, simulation)
    assert [epoch.stamp_ns for epoch in epochs] == [epoch.stamp_ns for epoch in result.epochs]
    np.testing.assert_array_equal(aligner.status().initial.quaternion_xyzw,
                                  result.status.initial.quaternion_xyzw)
    assert aligner.status().counts == result.status.counts


@pytest.mark.parametrize('block', [1, 7, 1000])
def test_blocks_do_not_matter(flight, result, monkeypatch, block):
    monkeypatch.setattr(bag, 'BLOCK', block)
    assert numbers(replay(flight, CONFIG)) == numbers(result)


def test_format_does_not_matter(simulation, result, tmp_path):
    write_bag(simulation, tmp_path / 'flight', 'mcap')
    assert numbers(replay(tmp_path / 'flight', CONFIG)) == numbers(result)


def test_reference_is_not_read_by_the_alignment(flight, result, tmp_path):
    """A reference that lies changes the comparison and nothing else."""
    with copied(flight, tmp_path / 'liar.db3') as liar:
        liar.execute('UPDATE messages SET data = (SELECT data FROM messages m WHERE '
                     "m.topic_id = (SELECT id FROM topics WHERE name='/reference/imu') LIMIT 1) "
                     "WHERE topic_id = (SELECT id FROM topics WHERE name='/reference/imu')")
    other = replay(tmp_path / 'liar.db3', CONFIG)
    assert numbers(other) == numbers(result)
    assert other.reference.attitude_at(result.status.current.stamp_ns) is None
    assert result.reference.attitude_at(result.status.current.stamp_ns) is not None


def test_error_against_truth(simulation, result):
    initial = result.status.initial
    C_reference = result.reference.attitude_at(initial.stamp_ns)
    rotation_deg = np.degrees(log_so3(C_reference @ initial.C_nb.T))
    assert np.all(np.abs(rotation_deg) < 5.0 * initial.sigma_deg)
    np.testing.assert_allclose(
        result.reference.attitude_at(result.status.current.stamp_ns),
        simulation.attitude_at(result.status.current.stamp_ns), atol=1e-4)


def test_json_and_csv_agree(result):
    text = json.dumps(result.to_json(), allow_nan=False)
    final = json.loads(text)['final_attitude']
    lines = result.to_csv().splitlines()
    assert lines[0] == CSV_HEADER
    assert len(lines) == 1 + len(result.epochs)
    last = dict(zip(lines[0].split(','), lines[-1].split(',')))
    assert int(last['stamp_ns']) == final['stamp']
    assert [float(last['current_q' + axis]) for axis in 'xyzw'] == final['quaternion_xyzw']
    assert [float(last[f'current_sigma_{axis}_deg']) for axis in 'enu'] == final['sigma_deg']
    assert last['state'] == result.status.state.value


def documented(title):
    """Return the names in the first column of the table with this title."""
    page = (Path(__file__).parents[1] / 'docs' / 'output.md').read_text(encoding='utf-8')
    table = re.search(rf'^\| {title} \|.*\n\|[-|]+\n((?:\|.*\n)+)', page, re.MULTILINE)
    return [name for row in table[1].splitlines()
            for name in re.findall(r'`(\w+)`', row.split('|')[1])]


def test_page_names_every_field(result):
    content = result.to_json()
    attitude = [name for name in content['final_attitude'] if name != 'stamp']
    fields = documented('field')
    assert sorted(fields) == sorted([*content, *attitude])
    columns = CSV_HEADER.split(',')
    assert documented('column')[:10] == columns[:10]
    assert [f'current_{name}' for name in columns[3:10]] == columns[10:]
    assert documented('column')[10:] == [columns[10], columns[-1]]


def test_page_names_every_count(result):
    counts = documented('count')
    assert set(result.status.counts) <= set(counts)
    package = Path(ins_align.__file__).parent
    source = ''.join(path.read_text() for path in package.rglob('*.py'))
    named = re.findall(r"""(?:counts\[|reject\()'(\w+)'[\])]""", source)
    assert len(named) > 20
    assert set(named) <= set(counts)


def test_window_is_by_recorded_time(flight, simulation):
    part = replay(flight, CONFIG, start=10.0, duration=5.0)
    assert part.status.counts['imu'] == 500
    assert part.track.shape == (25, 3)
    assert replay(flight, CONFIG, start=10.0).status.counts['imu'] == \
        len(simulation.imu_stamps_ns) - 1000
    assert replay(flight, CONFIG, duration=10.0).status.counts['imu'] == 1000


def test_track_is_of_fixes_that_are_some(tmp_path, simulation):
    """Receivers say 0, 0 while they look for satellites."""
    places = simulation.lla_deg.copy()
    places[:10] = 0.0
    write_bag(replace(simulation, lla_deg=places), tmp_path / 'cold')
    result = replay(tmp_path / 'cold', CONFIG)
    assert result.status.counts['fix_no_fix'] == 10
    assert len(result.track) == len(simulation.gnss_stamps_ns) - 10
    assert np.ptp(result.track[:, 1]) < 1.0


def test_progress_goes_up_to_one(flight):
    seen = []
    replay(flight, CONFIG, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0


def test_what_cannot_be_decoded_is_counted(flight, tmp_path):
    with copied(flight, tmp_path / 'spoilt.db3') as spoilt:
        for topic, every in (('/imu/data_raw', 100), ('/fix', 10), ('/fix_velocity', 10)):
            spoilt.execute("UPDATE messages SET data = x'00010000ff' WHERE id IN (SELECT id FROM "
                           '(SELECT id, row_number() OVER (ORDER BY id) AS number FROM messages '
                           'WHERE topic_id = (SELECT id FROM topics WHERE name = ?)) '
                           'WHERE number % ? = 0)', (topic, every))
    counts = replay(tmp_path / 'spoilt.db3', CONFIG).status.counts
    assert counts['imu_undecodable'] == 30
    assert counts['fix_undecodable'] == 15
    assert counts['velocity_undecodable'] == 15
    assert counts['imu'] == 3001 - 30


def test_first_velocity_that_is_damaged(flight, tmp_path):
    with copied(flight, tmp_path / 'spoilt.db3') as spoilt:
        spoilt.execute("UPDATE messages SET data = x'00010000' WHERE id = (SELECT min(id) "
                       'FROM messages WHERE topic_id = (SELECT id FROM topics '
                       "WHERE name = '/fix_velocity'))")
    result, info = replay(tmp_path / 'spoilt.db3', CONFIG), inspect(tmp_path / 'spoilt.db3')
    assert result.warnings == () and result.topics.velocity.name == '/fix_velocity'
    assert result.status.counts['velocity_undecodable'] == 1
    assert info.chosen['velocity'] == '/fix_velocity' and 'velocity_frame' not in info.command


def test_body_frame_velocity_is_counted(flight, tmp_path):
    """Found by type it is left out; named by the user it is refused message by message."""
    path = write_recording(tmp_path / 'a', 'sqlite3', 3.0)
    database = sqlite3.connect(path / 'a.db3')
    rows = database.execute('SELECT messages.id, data FROM messages JOIN topics ON '
                            "topic_id = topics.id WHERE name = '/fix_velocity'").fetchall()
    for key, data in rows:
        database.execute('UPDATE messages SET data = ? WHERE id = ?',
                         (data.replace(b'gps\0', b'imu\0'), key))
    database.commit()
    database.close()
    found, named = replay(path), replay(path, velocity_topic='/fix_velocity')
    assert found.topics.velocity is None
    assert named.status.counts['velocity_body_frame'] == len(rows) == 15
    insisting = replay(path, Config(use_velocity=True), velocity_topic='/fix_velocity')
    assert insisting.status.reason.startswith(
        "no GNSS velocity yet: the velocity is given in the body frame 'imu'")
    for result in (found, named):
        warning, = result.warnings
        assert "/fix_velocity cannot be used: the velocity is given in the body frame 'imu'" \
            in warning
    assert replay(path, Config(use_velocity=False)).warnings == ()


def test_positions_only(flight):
    alone = replay(flight, replace(CONFIG, use_velocity=False))
    assert alone.topics.velocity is None
    assert 'velocity' not in alone.status.counts
    assert alone.status.initial is not None


def test_uav_velocity_integration_formula():
    """From 165 s for 30 s of the flight: heading at t0 within 5 deg of the reference."""
    result = replay(real_recording('uav_thor75'), Config(method='vif'), start=165.0, duration=30.0)
    rpy = result.reference.errors_deg(result.status.initial)
    assert abs(rpy[2]) < 5.0
    assert np.all(np.abs(rpy[:2]) < 2.0)


def attitudes(angles, stamps):
    return np.array(stamps), quaternion_from_matrix(matrix_from_rpy(angles))


def test_reference_is_interpolated():
    reference = Reference(attitudes([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]], [0, 10 ** 9]))
    np.testing.assert_allclose(
        reference.attitude_at(5 * 10 ** 8), matrix_from_rpy([0.0, 0.0, np.pi]), atol=1e-12)
    np.testing.assert_allclose(reference.attitude_at(0), matrix_from_rpy([0.0, 0.0, 3.0]),
                               atol=1e-12)
    assert reference.attitude_at(-1) is None
    assert reference.attitude_at(10 ** 9 + 1) is None


def test_reference_has_gaps():
    known = attitudes([[0.0, 0.0, 0.1]] * 3, [0, 10 ** 9, 4 * 10 ** 9])
    assert Reference(known).attitude_at(5 * 10 ** 8) is not None
    assert Reference(known).attitude_at(2 * 10 ** 9) is None


def test_attitudes_that_are_not_known_are_left_out():
    stamps, quaternions = attitudes([[0.0, 0.0, 0.1]] * 5, range(5))
    covariances = np.full((5, 9), 0.1)
    covariances[1, 0] = -1.0
    quaternions[2], quaternions[3, 1] = 0.0, np.nan
    samples = ImuSamples(stamps, np.hstack([quaternions, covariances]), np.ones(5, bool))
    known_stamps, known, known_covariances = samples.orientations()
    np.testing.assert_array_equal(known_stamps, [0, 4])
    np.testing.assert_array_equal(known, quaternions[[0, 4]])
    np.testing.assert_array_equal(known_covariances, covariances[[0, 4]])


def test_reference_comes_in_parts_in_any_order():
    angles = np.random.default_rng(1).uniform(-1.0, 1.0, (4, 3))
    parts = [attitudes(angles[[2, 3]], [200, 300]), attitudes(angles[[0, 1, 0]],
                                                              [0, 100, 200])]
    assert Reference(parts[0]).attitude_at(100) is None
    reference = Reference(*parts)
    for stamp, rpy in zip((0, 100, 200, 300), angles):  # of two for one stamp the first
        np.testing.assert_allclose(reference.attitude_at(stamp), matrix_from_rpy(rpy), atol=1e-12)


def test_errors_are_estimate_less_reference_and_wrap():
    reference = Reference(attitudes([[0.1, 0.0, 3.1]] * 2, [0, 1]))
    C_nb = matrix_from_rpy([0.1, 0.02, -3.1])
    rpy = reference.errors_deg(Attitude(0, C_nb, np.eye(3)))
    np.testing.assert_allclose(rpy, np.degrees([0.0, 0.02, 2.0 * np.pi - 6.2]), atol=1e-9)
    assert np.isnan(reference.errors_deg(Attitude(2, C_nb, np.eye(3)))).all()
