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
"""Recordings of every format: whole, cut off, damaged; their topics; their messages as arrays."""

from contextlib import closing
import shutil
import sqlite3
import struct
import subprocess

from hypothesis import given, settings
from hypothesis import strategies as st
from ins_align.config import Config
from ins_align.gnss.drivers import VELOCITY_TYPES
from ins_align.gnss.messages import fix_from_msg, imu_from_msg, MessageError, velocity_from_msg
from ins_align.recordings import bag as bags
from ins_align.recordings import BagError, Topic
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import (
    decode_gnss, decode_imu, deserialize, FIX_TYPE, Refused)
from ins_align.recordings.reader import choose_topics
import numpy as np
import pytest
from recordings import (
    FIX, FORMATS, IMU, indexed_mcap, make_header, make_imu, make_twist, MCAP, mcap_chunk,
    mcap_message, mcap_of, mcap_record, mcap_string, messages_of, real_recording, ros1_records,
    START_NS, TWIST, typestore, write_messages, write_recording)
from rosbags.highlevel import AnyReader

ODOMETRY, STAMPED = 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/TwistStamped'
VECTOR, TF = 'geometry_msgs/msg/Vector3Stamped', 'tf2_msgs/msg/TFMessage'


def by_library(path):
    with AnyReader([path]) as reader:
        return [(connection.topic, time_ns, bytes(data))
                for connection, time_ns, data in reader.messages()]


def by_bag(path):
    with Bag(path) as bag:
        records = [(topic.name, time_ns, data) for topic, time_ns, data in messages_of(bag)]
        return records, bag.warnings


def storage_file(path):
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != '.yaml')


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """One recording a format, to be copied by those who spoil it, and its messages."""
    folder = tmp_path_factory.mktemp('recordings')
    paths = {kind: write_recording(folder / (kind.replace(' ', '_') + (
        '.bag' if kind.startswith('ros1') else '')), kind, 40.0) for kind in FORMATS}
    return {kind: (path, by_library(path)) for kind, path in paths.items()}


@pytest.fixture
def copy(recordings, tmp_path):
    """Return a function that copies the file of a format and edits it."""
    def make(kind, edit=lambda content: content):
        source = storage_file(recordings[kind][0])
        target = tmp_path / source.name
        target.write_bytes(edit(source.read_bytes()))
        return target, recordings[kind][1]
    return make


# Formats

@pytest.mark.parametrize('kind', FORMATS)
def test_same_messages_in_the_same_order_as_rosbags(recordings, kind):
    path, expected = recordings[kind]
    assert len(expected) == 4400
    assert by_bag(path) == by_bag(storage_file(path)) == (expected, [])
    with Bag(path) as bag:
        assert (bag.start_ns, bag.end_ns) == (expected[0][1], expected[-1][1])
        assert {(topic.name, topic.msgtype) for topic in bag.topics} == {
            ('/imu/data_raw', IMU), ('/fix', FIX), ('/fix_velocity', TWIST)}
        assert all('std_msgs/Header' in topic.definition for topic in bag.topics)
        start, stop = START_NS + 10 ** 10, START_NS + 2 * 10 ** 10
        times = [block.times_ns for block in bag.blocks(bag.topics, start, stop)]
        assert np.concatenate(times).tolist() == [
            time_ns for _, time_ns, _ in expected if start <= time_ns < stop]


@pytest.mark.parametrize('name', ['uav_thor75', 'car_drive0708', 'quad_dot08.bag'])
def test_real_recordings(name):
    path = real_recording(name)
    assert by_bag(path) == (by_library(path), [])
    with Bag(path) as bag:
        topics = choose_topics(bag, Config())
        assert topics.imu.name == '/imu/data_raw' and topics.reference.name == '/reference/imu'
        assert (topics.velocity is None) == name.startswith('quad')


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'ros1 bz2'])
@pytest.mark.parametrize('parts', [[(0, 30), (30, 70), (70, 100)], [(70, 100), (0, 70)],
                                   [(0, 100, 3), (1, 100, 3), (2, 100, 3)]])
def test_several_files_in_any_order_and_of_the_same_time(tmp_path, kind, parts):
    path = tmp_path / 'split'
    path.mkdir()
    store = typestore(kind.startswith('ros1'))
    for number, part in enumerate(parts):
        source = storage_file(write_messages(tmp_path / f's{number}.bag', kind, [
            ('/a', k, make_imu(store, k, (k, 0, 0), (0, 0, 9.8))) for k in range(*part)],
            {'/a': IMU}))
        shutil.copy(source, path / f'{number}{source.suffix}')
    records, warnings = by_bag(path)
    assert [time_ns for _, time_ns, _ in records] == [*range(100)] and warnings == []


def test_files_that_metadata_lists(recordings, tmp_path):
    path = tmp_path / 'mcap'
    shutil.copytree(recordings['mcap'][0], path)
    shutil.copy(path / 'mcap.mcap', path / 'other.mcap')
    assert by_bag(path) == (recordings['mcap'][1], [])
    text = (path / 'metadata.yaml').read_text()
    (path / 'metadata.yaml').write_text(text.replace(
        '- mcap.mcap', '- ../../mcap.mcap\n    - "gone.mcap"'))
    assert by_bag(path) == (recordings['mcap'][1], [f'gone.mcap is missing from {path}'])
    (path / 'mcap.mcap').write_bytes(b'')
    (path / 'metadata.yaml').unlink()
    assert by_bag(path) == (recordings['mcap'][1], ['mcap.mcap is empty'])


@pytest.mark.parametrize('name', (
    'a b', 'a?mode=rw.db3', 'a#b.db3', '50%25.db3', "a'b.db3", 'ü.db3', 'a\udcff.db3'))
def test_a_database_may_have_any_name(recordings, tmp_path, name):
    path, expected = recordings['sqlite3']
    shutil.copy(storage_file(path), tmp_path / name)
    (tmp_path / f'{name}-wal').write_bytes(b'left behind')
    records, (warning,) = by_bag(tmp_path / name)
    assert records == expected and 'PRAGMA wal_checkpoint' in warning


def test_rows_of_a_database_that_are_no_messages(copy):
    path, expected = copy('sqlite3')
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE messages SET data = 'text' WHERE id % 7 = 0")
        database.execute('UPDATE messages SET data = 0.5 WHERE id % 11 = 0')
        database.commit()
    records, _ = by_bag(path)
    assert [record[:2] for record in records] == [record[:2] for record in expected]
    assert {data for _, _, data in records} - {data for _, _, data in expected} == {b''}


def test_a_damaged_message_of_a_compressed_database_costs_no_others(copy):
    path, expected = copy('sqlite3 messages')
    with closing(sqlite3.connect(path)) as database:
        database.execute("UPDATE messages SET data = x'00' WHERE timestamp = ?", expected[0][1:2])
        database.commit()
    assert by_bag(path) == ([(*expected[0][:2], b'\0'), *expected[1:]], [])


# Cut off, damaged, hostile

@pytest.mark.parametrize('kind', ['mcap', 'mcap chunks', 'mcap messages', 'mcap file'])
@pytest.mark.parametrize('kept', [0.5, 0.95, 0.999])
@pytest.mark.parametrize('filled', [False, True])
def test_cut_off_mcap_is_read_as_far_as_it_goes(copy, kind, kept, filled):
    """A file system that lost power leaves one of the right length filled with zeros."""
    def edit(content):
        front = content[:int(len(content) * kept)]
        return front.ljust(len(content), b'\0') if filled else front
    path, expected = copy(kind, edit)
    records, warnings = by_bag(path)
    assert 'as far as it goes' in warnings[-1]
    # The last one may straddle the first zero; what was packed at once may be lost whole.
    assert records[:-1] == expected[:len(records)][:-1]
    lost = 0.1 if kind in ('mcap', 'mcap messages') else 1.0
    assert len(records) > (kept - lost) * 4400
    with Bag(path) as bag:
        assert bag.end_ns == (records[-1][1] if records else 0)


@pytest.mark.parametrize('chunked', [True, False])
@pytest.mark.parametrize('missing', [None, 1, 20, 41, 60, 200])
def test_mcap_without_an_index(tmp_path, chunked, missing):
    messages = [mcap_message(k % 2, k, b'%d' % k) for k in range(30)]
    parts = [mcap_chunk(b''.join(messages[k:k + 10])) for k in (0, 10, 20)]
    (tmp_path / 'a').write_bytes(mcap_of(*(parts if chunked else messages), closed=not missing)[
        :None if missing is None else -missing])
    records, warnings = by_bag(tmp_path / 'a')
    assert records == [(f'/{k % 2}', k, b'%d' % k) for k in range(len(records))]
    assert len(records) >= 30 - (missing or 0) / 30 - bool(missing)
    assert len(warnings) == bool(missing)
    with Bag(tmp_path / 'a') as bag:
        assert bag.topics[0] == ('/0', IMU, 'cdr', 'definition')


def test_messages_that_are_counted_and_cannot_be_found(copy):
    """Without a checksum of its chunk, a damaged record is left out without an error."""
    def edit(content):
        head = struct.pack('<BQ', 5, 22 + len(expected[0][2]))
        return spoilt(content.index(head, len(content) // 2), b'\x80')(content)
    expected = copy('mcap')[1]
    path, _ = copy('mcap', edit)
    records, warnings = by_bag(path)
    assert len(records) == 4399 and warnings == [
        'mcap.mcap is damaged: 4399 of 4400 messages on /fix, /fix_velocity, /imu/data_raw could '
        'be read']
    with Bag(path) as bag:
        assert [*bag.blocks(bag.topics, START_NS)] and bag.warnings == []


def spoilt(at, piece):
    return lambda content: content[:at] + piece + content[at + len(piece):]


def not_indexed(content):
    return spoilt(content.index(b'index_pos=') + 10, bytes(8))(content)


@pytest.mark.parametrize('kind, edit, message', [
    ('sqlite3', lambda content: content[:len(content) // 2], r'sqlite3 \S+ .dump'),
    ('sqlite3', spoilt(200_000, b'\xff' * 20_000), r'sqlite3 \S+ .dump'),
    ('sqlite3', lambda content: content[:50], r'sqlite3 \S+ .dump'),
    ('mcap', spoilt(500_000, b'\xff' * 20_000), r'mcap recover \S+'),
    ('mcap', lambda content: MCAP, 'no IMU topic .*it has no topics'),
    ('mcap', lambda content: mcap_of(mcap_chunk(b'x', compression='rar')), "with 'rar', which is"),
    ('mcap', lambda content: mcap_of(mcap_chunk(b'', 1 << 31)), 'claims a chunk of 2147483648 by'),
    ('mcap', lambda content: mcap_of(*5 * [mcap_chunk(b'', 1 << 28)]), 'claims a chunk of 268435'),
    ('mcap', lambda content: mcap_of(mcap_message(0, 1, bytes(70_000))), 'of 65537 bytes or more'),
    ('mcap', lambda content: mcap_of(mcap_message(0, 1 << 63, b'')), 'cannot be read'),
    ('ros1', not_indexed, 'rosbag reindex ros1.bag'),
    ('ros1 lz4', lambda content: content[:len(content) // 2], 'rosbag reindex ros1_lz4.bag'),
    ('ros1 bz2', spoilt(100_000, b'\xff' * 20_000), 'rosbag reindex ros1_bz2.bag'),
    ('ros1', lambda content: b'#ROSBAG V1.2\n' + content[13:], 'version 102 is not supported'),
    ('ros1', lambda content: b'#ROSBAG V2.0\n', 'cannot be read'),
    ('ros1', lambda content: b'', 'is empty'),
    ('ros1', lambda content: b'hello', 'no recording: neither mcap, sqlite3 nor ROS 1'),
    ('ros1', lambda content: b'\x28\xb5\x2f\xfdxx', 'is empty'),
])
def test_what_cannot_be_read_gets_a_sentence(copy, kind, edit, message):
    path, _ = copy(kind, edit)
    with pytest.raises(BagError, match=message) as info:
        with Bag(path) as bag:
            [*bag.blocks(bag.topics)]
            choose_topics(bag, Config())
    assert str(info.value).isprintable() and str(path.name) in str(info.value)


@pytest.mark.parametrize('kind', ['sqlite3', 'sqlite3 file'])
def test_the_command_that_is_named_mends_a_database(copy, kind):
    if not all(map(shutil.which, ('sqlite3', 'zstd'))):
        pytest.skip('no sqlite3 or no zstd is installed')
    path, expected = copy(kind, lambda content: content[:len(content) * 4 // 5])
    with pytest.raises(BagError) as info, Bag(path) as bag:
        [*bag.blocks(bag.topics)]
    command = str(info.value).partition('this may mend it: ')[2]
    subprocess.run(command, shell=True, cwd=path.parent, capture_output=True)
    records, _ = by_bag(path.parent / 'mended.db3')
    # One may straddle the end.
    assert len(records) > 3000 and len({*records} - {*expected}) <= 1


def test_a_folder_of_recordings_asks_for_a_choice(tmp_path):
    for name, kind in (('b', 'mcap'), ('c', 'sqlite3'), ('a.bag', 'ros1')):
        write_recording(tmp_path / name, kind, 1.0)
    with pytest.raises(BagError, match=r'folder of recordings \(a.bag, b, c\): name one'):
        Bag(tmp_path)
    shutil.copy(next((tmp_path / 'b').glob('*.mcap')), tmp_path / 'd.mcap')
    for name in ('b', 'c'):
        shutil.rmtree(tmp_path / name)
    with pytest.raises(BagError, match=r'folder of recordings \(a.bag, d.mcap\)'):
        Bag(tmp_path)
    (tmp_path / 'a.bag').unlink()
    assert Bag(tmp_path).topics


def test_nothing_there(tmp_path):
    with pytest.raises(BagError, match='does not exist'):
        Bag(tmp_path / 'none')
    with pytest.raises(BagError, match='holds no recording'):
        Bag(tmp_path)
    with closing(sqlite3.connect(tmp_path / 'a.db3')) as database:
        database.execute('CREATE TABLE t(x)')
    with pytest.raises(BagError, match='missing tables'):
        Bag(tmp_path / 'a.db3')


@pytest.mark.parametrize('kind', ['mcap chunks', 'mcap messages', 'sqlite3', 'ros1'])
def test_message_that_is_too_long(tmp_path, kind):
    message = make_twist(typestore(kind == 'ros1'), START_NS, (1.0, 2.0, 3.0), 'x' * (1 << 21))
    path = write_messages(tmp_path / 'a', kind, [('/v', START_NS, message)], {'/v': TWIST})
    with pytest.raises(BagError, match='2097... bytes or more on /v|too big|more than the 65536'):
        by_bag(path)


@pytest.mark.parametrize('kind', ['mcap', 'mcap messages', 'sqlite3'])
def test_transforms_may_be_longer(tmp_path, kind):
    """All fixed frames of a robot are one message."""
    types = typestore().types
    transform = types['geometry_msgs/msg/Transform'](
        types['geometry_msgs/msg/Vector3'](1.0, 0.0, 0.0),
        types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0))
    for name, size in (('a', 1 << 19), ('b', 1 << 21)):
        message = types[TF]([types['geometry_msgs/msg/TransformStamped'](
            make_header(typestore(), START_NS, 'x' * size), 'y', transform)])
        write_messages(tmp_path / name, kind, [('/tf_static', START_NS, message)],
                       {'/tf_static': TF})
    assert by_bag(tmp_path / 'a') == (by_library(tmp_path / 'a'), [])
    with pytest.raises(BagError, match='2097... bytes or more on /tf|too big|more than the 1048'):
        by_bag(tmp_path / 'b')
    if kind == 'mcap':
        path = storage_file(tmp_path / 'a')
        path.write_bytes(path.read_bytes()[:-20])
        records, _ = by_bag(path)
        assert len(records[0][2]) > 1 << 19


@pytest.mark.parametrize('times, size, message', [
    ([(0, 9)] * 3, 35, None), ([(0, 9)], (1 << 28) + 1, 'claims a chunk of 268435457 bytes'),
    ([(k, k) for k in range(5)], 1 << 28, '1342177280 in all and 268435456 of the same time'),
    ([(0, 9)] * 5, 1 << 28, 'and 1342177280 of the same time')])
def test_claims_of_an_index(tmp_path, times, size, message):
    path = tmp_path / 'a.mcap'
    path.write_bytes(indexed_mcap(times, mcap_message(0, 7, b'data'), size))
    if message is None:
        assert by_bag(path) == ([('/0', 7, b'data')] * 3, [])
    else:
        with pytest.raises(BagError, match=message):
            Bag(path)


def test_index_of_a_ros1_file_that_counts_a_part_many_times(copy):
    def edit(content):
        infos = b''.join(content[start:end] for kind, start, end in ros1_records(content)
                         if kind == 6)
        count = content.index(b'chunk_count=') + 12
        number, = struct.unpack_from('<I', content, count)
        return spoilt(count, struct.pack('<I', 100 * number))(content) + 99 * infos
    path, _ = copy('ros1', edit)
    with pytest.raises(BagError, match='index larger.*rosbag reindex'):
        Bag(path)


def test_ros1_file_that_is_unpacked_time_and_again(recordings, monkeypatch):
    monkeypatch.setattr(bags, 'MAX_PASSES', 0)
    with pytest.raises(BagError, match='time and again'):
        by_bag(recordings['ros1 lz4'][0])


def test_too_many_topics(tmp_path):
    channels = b''.join(mcap_record(4, struct.pack('<HH', key, 0) + mcap_string(
        f'/{key}') + mcap_string('cdr') + mcap_string('')) for key in range(10_001))
    (tmp_path / 'a').write_bytes(MCAP + channels)
    with pytest.raises(BagError, match='10001 topics'):
        Bag(tmp_path / 'a')


# Topics

def topics_of(tmp_path, topics, config=None, kind='mcap', **names):
    path = tmp_path / ('a.bag' if kind == 'ros1' else 'a')
    if not path.exists():
        write_recording(path, kind, 0.3, topics)
    with Bag(path) as bag:
        return choose_topics(bag, config or Config(), **names)


@pytest.mark.parametrize('kind', ['mcap', 'ros1'])
def test_reference_is_never_taken(tmp_path, kind):
    topics = {'/reference/imu': IMU, '/fix': FIX}
    with pytest.raises(BagError, match='no IMU topic'):
        topics_of(tmp_path, topics, kind=kind)
    with pytest.raises(BagError, match='must not read it'):
        topics_of(tmp_path, topics, kind=kind, imu='reference/imu')


def test_candidates_are_listed(tmp_path):
    topics = {'/a/imu': IMU, '/b/imu': IMU, '/fix': FIX}
    with pytest.raises(BagError, match='/a/imu, /b/imu.*--imu-topic'):
        topics_of(tmp_path, topics)
    chosen = topics_of(tmp_path, topics, imu='b/imu')
    assert chosen.imu.name == '/b/imu'
    assert chosen.velocity is chosen.reference is None
    with pytest.raises(BagError, match=r'no topic /x; it has /a/imu \(.*, /b/imu \(.*, /fix \('):
        topics_of(tmp_path, topics, imu='/x')
    with pytest.raises(BagError, match='is of type sensor_msgs/NavSatFix, but IMU needs'):
        topics_of(tmp_path, topics, imu='/fix')


def test_missing_topic(tmp_path):
    with pytest.raises(BagError, match='no position topic.*NavSatFix.*it has /imu'):
        topics_of(tmp_path, {'/imu': IMU})


def test_imu_that_measures_nothing_is_no_candidate(tmp_path):
    store = typestore()
    messages = [(name, START_NS, make_imu(store, START_NS, (0, 0, 0), (0, 0, 0),
                                          measured=name == '/b')) for name in ('/a', '/b')]
    write_messages(tmp_path / 'a', 'mcap', messages, {'/a': IMU, '/b': IMU, '/fix': FIX})
    with Bag(tmp_path / 'a') as bag:
        assert choose_topics(bag, Config()).imu.name == '/b'
        warning, = bag.warnings
        assert '/a cannot be used: its messages say that it does not measure angular' in warning


def velocities(tmp_path, child='map', names=('/a', '/b', '/c')):
    """Write a velocity of each type."""
    store = typestore()
    types = store.types
    message = make_twist(store, START_NS, (1.0, 2.0, 3.0))
    pose = types['geometry_msgs/msg/PoseWithCovariance'](types['geometry_msgs/msg/Pose'](
        types['geometry_msgs/msg/Point'](0.0, 0.0, 0.0),
        types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)), np.zeros(36))
    messages = [message, types[STAMPED](message.header, message.twist.twist),
                types[ODOMETRY](message.header, child, pose, message.twist)]
    write_messages(tmp_path / 'a', 'mcap', [(name, START_NS, message) for name, message
                                            in zip(names, messages) if name],
                   {'/imu': IMU, '/fix': FIX, **{
                       name: kind for name, kind in zip(names, (TWIST, STAMPED, ODOMETRY))
                       if name}})
    return Bag(tmp_path / 'a')


@pytest.mark.parametrize('child, names, left', [
    ('map', ('/a', '/b', '/c'), '/b (TwistStamped), /c (Odometry)'),
    ('base_link', ('/a', '/b', '/c'), '/b (TwistStamped)'),
    ('map', ('/a', '/cmd_vel', '/c'), '/c (Odometry)'),
    ('base_link', ('/a', '/reference/b', '/c'), '')])
def test_velocities_of_several_types(tmp_path, child, names, left):
    with velocities(tmp_path, child, names) as bag:
        assert choose_topics(bag, Config()).velocity.name == '/a'
        assert bag.warnings == ([f'the velocity is read from /a (TwistWithCovarianceStamped), not '
                                 f'from {left}: --velocity-topic chooses'] if left else [])
    with Bag(tmp_path / 'a') as bag:
        choose_topics(bag, Config(), velocity='/a')
        assert choose_topics(bag, Config(use_velocity=False)).velocity is None
        assert bag.warnings == []


def test_velocity_that_is_none_of_an_antenna(tmp_path):
    with velocities(tmp_path, 'base_link', (None, '/cmd_vel', '/c')) as bag:
        assert choose_topics(bag, Config()).velocity is None
        assert choose_topics(bag, Config(), velocity='/c').velocity.msgtype == ODOMETRY
        warning, = bag.warnings
        assert warning.startswith('/c cannot be used: the velocity is given in the body frame ')


def test_velocity_of_another_type_is_found(tmp_path):
    with velocities(tmp_path, names=(None, '/b', '/c')) as bag:
        assert choose_topics(bag, Config(velocity_type='Odometry')).velocity.name == '/c'
        with pytest.raises(BagError, match='more than one velocity topic .*--velocity-topic'):
            choose_topics(bag, Config())


# Decoding

def serialized(encoding, msgtype=IMU, frame_id='imu_link', little_endian=True, seed=0, count=5):
    """Serialise messages in which every number is another one."""
    rng = np.random.default_rng(seed)
    store = typestore(encoding == 'ros1')

    def made(name, *values):
        return store.types[f'geometry_msgs/msg/{name}'](*values)

    raws = []
    for k in range(count):
        header = make_header(store, START_NS + k * 10_000_001, frame_id, k)
        twist = made('Twist', *(made('Vector3', *rng.normal(size=3)) for _ in range(2)))
        factor = rng.normal(size=(6, 6))
        uncertain = made('TwistWithCovariance', twist, (factor @ factor.T).ravel())
        pose = made('Pose', made('Point', *rng.normal(size=3)),
                    made('Quaternion', *rng.normal(size=4)))
        rest = {IMU: (pose.orientation, rng.normal(size=9), twist.linear, rng.normal(size=9),
                      twist.angular, rng.normal(size=9)),
                FIX: (store.types['sensor_msgs/msg/NavSatStatus'](k - 1, 1),
                      *rng.uniform(-90, 90, 3), (factor @ factor.T)[:3, :3].ravel(), k % 4),
                TWIST: (uncertain,), STAMPED: (twist,), VECTOR: (twist.linear,),
                ODOMETRY: (frame_id, made('PoseWithCovariance', pose, np.zeros(36)), uncertain)}
        message = store.types[msgtype](header, *rest[msgtype])
        raws.append(bytes(store.serialize_ros1(message, msgtype) if encoding == 'ros1' else
                          store.serialize_cdr(message, msgtype, little_endian=little_endian)))
    return raws


def assert_decoded(raws, encoding):
    """Compare with rosbags; a frame_id is not read."""
    topic = Topic('/imu', IMU, encoding)
    samples = decode_imu(raws, topic)
    found = zip(samples.stamps_ns, samples.gyro, samples.accel, samples.numbers[:, :4],
                samples.numbers[:, 4:13])
    for raw, decoded in zip(raws, samples.decoded):
        values = next(found) if decoded else None
        try:
            message = deserialize(raw, topic)
        except MessageError:
            continue
        assert decoded
        stamp_ns, *vectors = imu_from_msg(message)
        turn = [getattr(message.orientation, axis) for axis in 'xyzw']
        for mine, other in zip(values, (stamp_ns, *vectors, turn,
                                        message.orientation_covariance)):
            np.testing.assert_array_equal(mine, other)
    assert next(found, None) is None
    return samples.decoded


@pytest.mark.parametrize('encoding, little', [('cdr', True), ('cdr', False), ('ros1', True)])
def test_imu_as_rosbags(encoding, little):
    alike = [serialized(encoding, frame_id=frame_id, little_endian=little, count=2)
             for frame_id in ('', 'a', 'imu', 'imu_link', 'imu_lin2', 'a/long/name/of', 'ü')]
    for raws in (*alike, [raw for pair in zip(*alike) for raw in pair]):
        assert assert_decoded(raws, encoding).all()


def test_imu_messages_that_are_none_are_left_out():
    raws = serialized('cdr') + serialized('cdr', little_endian=False)
    spoilt = [b'', raws[0], b'\x00', raws[1][:100], raws[7], b'\xff' * 324, raws[3][:-1],
              b'\0\7' + raws[4][2:]]
    assert assert_decoded(spoilt, 'cdr').nonzero()[0].tolist() == [1, 4]
    nothing = decode_imu([], Topic('/imu', IMU, 'cdr'))
    assert [array.shape for array in nothing] == [(0,), (0, 37), (0,)]


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(['cdr', 'ros1']), st.lists(st.tuples(
    st.integers(0, 4), st.integers(0, 330), st.binary(max_size=24)), max_size=6))
def test_imu_of_any_bytes(encoding, edits):
    raws = serialized(encoding)
    for index, at, replacement in edits:
        raws[index] = spoilt(at, replacement)(raws[index])
    assert_decoded(raws, encoding)


@pytest.mark.parametrize('encoding, little', [('cdr', True), ('cdr', False), ('ros1', True)])
@pytest.mark.parametrize('frame', ['auto', 'ned'])
@pytest.mark.parametrize('msgtype', [FIX_TYPE, *VELOCITY_TYPES])
def test_gnss_as_one_by_one(encoding, little, msgtype, frame):
    topic = Topic('/gnss', msgtype, encoding)
    config = Config(velocity_frame=frame)
    raws = [b''] + [raw for group in zip(*(
        serialized(encoding, msgtype, frame_id, little) for frame_id in ('gps', 'base_link', 'ü')
        )) for raw in group] + [b'\xff' * 200]
    (kind, messages), = decode_gnss(raws, topic, config).items()
    assert kind == ('fix' if msgtype == FIX else 'velocity')
    assert messages[0] == messages[-1] == Refused(f'{kind}_undecodable')
    for raw, message in zip(raws[1:-1], messages[1:-1]):
        read = deserialize(raw, topic)
        if kind == 'velocity' and b'base_link' in raw and frame == 'auto':
            assert message.counter == 'velocity_body_frame' and "'base_link'" in message.why
            continue
        expected = fix_from_msg(read) if kind == 'fix' else velocity_from_msg(read, config)
        for mine, other in zip(message, expected):
            assert type(mine) is type(other)
            np.testing.assert_array_equal(mine, other)
