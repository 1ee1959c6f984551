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
"""Recordings of every format, whole, cut off, damaged and hostile, against the rosbags library."""

import shutil
import sqlite3
import struct

from hypothesis import assume, given, HealthCheck, settings, strategies as st
from ins_align import bag_files, mcap_file, sqlite_file
from ins_align.bag_files import Block, decompress, Messages, ros2_type, ZSTD_MAGIC
from ins_align.bags import Bag, BagError
from ins_align.config import Config
from ins_align.decoding import decode_imu
import numpy as np
import pytest
from recordings import (
    FIX, FORMATS, IMU, make_imu, make_twist, mcap_record, mcap_string, real_recording, START_NS,
    TWIST, typestore, write_messages, write_recording)
from rosbags.highlevel import AnyReader

ODOMETRY, STAMPED = 'nav_msgs/msg/Odometry', 'geometry_msgs/msg/TwistStamped'


def by_library(path):
    with AnyReader([path]) as reader:
        return [(connection.topic, time_ns, bytes(data))
                for connection, time_ns, data in reader.messages()]


def by_bag(path, **window):
    with Bag(path) as bag:
        records = [(topic.name, time_ns, data)
                   for topic, time_ns, data in bag.messages(bag.topics, **window)]
        return records, bag.warnings


def storage_file(path):
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != '.yaml')


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """One recording a format, to be copied by those who spoil it."""
    folder = tmp_path_factory.mktemp('recordings')
    names = {kind: kind.replace(' ', '_') + ('.bag' if kind.startswith('ros1') else '')
             for kind in FORMATS}
    return {kind: write_recording(folder / name, kind, 40.0) for kind, name in names.items()}


@pytest.fixture(scope='module')
def short_recordings(tmp_path_factory):
    """Name and bytes of a storage file of each format."""
    folder = tmp_path_factory.mktemp('short')
    files = {kind: storage_file(write_recording(folder / kind.replace(' ', '_'), kind, 1.0))
             for kind in FORMATS}
    return {kind: (file.name, file.read_bytes()) for kind, file in files.items()}


@pytest.fixture
def copy(recordings, tmp_path):
    """Return a function that copies the recording of a format."""
    def make(kind):
        source = recordings[kind]
        target = tmp_path / source.name
        if source.is_dir():
            shutil.copytree(source, target)
        else:
            shutil.copy(source, target)
        return target
    return make


@pytest.mark.parametrize('kind', FORMATS)
def test_same_messages_in_the_same_order_as_the_library(recordings, kind):
    records, warnings = by_bag(recordings[kind])
    assert warnings == []
    assert records == by_library(recordings[kind])
    assert len(records) == 4400


@pytest.mark.parametrize('name', ['uav_thor75', 'car_drive0708', 'quad_dot08.bag'])
def test_real_recordings(name):
    path = real_recording(name)
    records, warnings = by_bag(path)
    assert warnings == []
    assert records == by_library(path)
    with Bag(path) as bag:
        topics = bag.choose_topics(Config())
        assert topics.imu.name == '/imu/data_raw'
        assert topics.reference.name == '/reference/imu'
        assert (topics.velocity is None) == name.startswith('quad')
        assert bag.start_ns == records[0][1]
        assert bag.end_ns == records[-1][1]


@given(st.lists(st.binary(max_size=9), max_size=8), st.lists(st.integers(0, 7), max_size=8))
def test_messages_in_one_buffer(raws, places):
    messages = Messages.of(raws)
    assert [*messages] == [messages[k] for k in range(len(messages))] == raws
    places = np.array([place % len(raws) for place in places if raws], int)
    some = Messages.joined([messages.take(places), messages])
    assert [*some] == [*some.alone()] == [raws[place] for place in places] + raws
    long = some.take(np.flatnonzero(some.lengths >= 3))
    assert [row.tobytes() for row in long.rows(1, 2)] == [raw[1:3] for raw in some if len(raw) > 2]


@pytest.mark.parametrize('kind', FORMATS)
def test_window_of_time(recordings, kind):
    start, stop = START_NS + 10 ** 10, START_NS + 2 * 10 ** 10
    records, _ = by_bag(recordings[kind], start_ns=start, stop_ns=stop)
    assert records == [r for r in by_library(recordings[kind]) if start <= r[1] < stop]
    assert by_bag(recordings[kind], start_ns=-1, stop_ns=start)[0] + records == by_bag(
        recordings[kind], stop_ns=stop)[0]
    for start, stop in ((1 << 63, None), (1 << 64, 1 << 65), (-2, -1)):  # int64 holds neither
        assert by_bag(recordings[kind], start_ns=start, stop_ns=stop) == ([], [])


@pytest.mark.parametrize('kind', [kind for kind in FORMATS if not kind.startswith('ros1')])
def test_without_metadata(copy, kind):
    path = copy(kind)
    expected = by_library(path)
    (path / 'metadata.yaml').unlink()
    records, warnings = by_bag(path)
    assert records == expected
    assert len(warnings) == 1 and 'metadata.yaml' in warnings[0]


@pytest.mark.parametrize('text', ['', '[', 'a: 1', 'rosbag2_bagfile_information: 3',
                                  'rosbag2_bagfile_information: {relative_file_paths: [1]}'])
def test_damaged_metadata(copy, text):
    path = copy('mcap')
    expected = by_library(path)
    (path / 'metadata.yaml').write_text(text)
    records, warnings = by_bag(path)
    assert records == expected
    assert 'metadata.yaml' in warnings[0]


@pytest.mark.parametrize('kind', FORMATS)
def test_bare_file(recordings, kind):
    expected = by_library(recordings[kind])
    assert by_bag(storage_file(recordings[kind])) == (expected, [])


@pytest.mark.parametrize('kind', FORMATS)
@pytest.mark.parametrize('kept', [0.3, 0.6, 0.95])
def test_cut_off_is_read_as_far_as_it_goes(copy, kind, kept):
    path = copy(kind)
    expected = by_library(path)
    file = storage_file(path)
    content = file.read_bytes()
    file.write_bytes(content[:int(len(content) * kept)])
    records, warnings = by_bag(path)
    assert any('as far as it goes' in warning for warning in warnings)
    # Exactly the front of the recording, and not less than what the format forces us to lose:
    # a tenth, the last megabyte of a chunk where the packer keeps it (bz2: blocks of 900 kB).
    assert records == expected[:len(records)]
    if kind not in ('ros1 bz2', 'mcap chunks', 'mcap file', 'sqlite3 file'):
        assert len(records) > (kept - 0.15) * len(expected)
    elif kept > 0.9:
        assert records


@pytest.mark.parametrize('page_size', (512, 4096, 65536))
def test_a_database_that_was_cut_off_is_seen_by_its_pages(copy, page_size):
    """65536 does not fit into the two bytes of the header, which say 1."""
    path = copy('sqlite3')
    file = storage_file(path)
    database = sqlite3.connect(file)
    database.execute(f'PRAGMA page_size={page_size}')
    database.execute('VACUUM')
    database.close()
    expected = by_library(path)
    assert by_bag(path) == (expected, [])
    content = file.read_bytes()
    file.write_bytes(content[:int(0.9 * len(content))])
    records, warnings = by_bag(path)
    assert any('was cut off' in warning for warning in warnings)
    assert 0 < len(records) and records == expected[:len(records)]


@pytest.mark.parametrize('kind', ['mcap', 'mcap chunks', 'sqlite3', 'ros1', 'ros1 lz4'])
def test_damage_in_the_middle_is_survived(copy, kind):
    path = copy(kind)
    expected = by_library(path)
    file = storage_file(path)
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle:middle + 20000] = bytes([255]) * 20000
    file.write_bytes(content)
    records, warnings = by_bag(path)
    assert warnings
    assert set(records[:len(records) // 2]) <= set(expected)


def spoil_page(file, place):
    """Overwrite the page of a sqlite3 file that lies at so much of its length."""
    content = bytearray(file.read_bytes())
    at = int(place * len(content)) // 4096 * 4096
    content[at:at + 4096] = bytes([255]) * 4096
    file.write_bytes(content)


@pytest.mark.parametrize('place', (0.3, 0.5, 0.7, 0.9))
def test_messages_of_one_stamp_are_all_read_where_damage_parts_them(copy, monkeypatch, place):
    """Three have one stamp, and blocks of a hundred end among them."""
    monkeypatch.setattr(sqlite_file, 'BLOCK', 100)
    path = copy('sqlite3')
    file = storage_file(path)
    database = sqlite3.connect(file)
    rows = database.execute('SELECT id, timestamp FROM messages ORDER BY timestamp, id').fetchall()
    database.executemany('UPDATE messages SET timestamp = ? WHERE id = ?', [
        (rows[k - k % 3][1], key) for k, (key, _) in enumerate(rows)])
    database.commit()
    database.execute('VACUUM')             # the index behind all messages
    database.close()
    expected = by_bag(path)[0]
    assert len(set(expected)) == len(expected) == 4400
    spoil_page(file, place)
    records, warnings = by_bag(path)
    assert any('damaged' in warning for warning in warnings)
    assert len(records) == len(set(records))
    assert set(records) == set(expected[:expected.index(records[-1]) + 1])


@pytest.mark.parametrize('place', (0.5, 0.7, 0.9))
def test_what_was_read_before_the_damage_is_not_read_again(copy, monkeypatch, place):
    monkeypatch.setattr(sqlite_file, 'BLOCK', 100)
    path = copy('sqlite3')
    expected = by_library(path)
    file = storage_file(path)
    spoil_page(file, place)
    records, warnings = by_bag(path)
    assert any('damaged' in warning for warning in warnings)
    assert len(records) > 400 and set(records) < set(expected)
    assert len(records) == len(set(records))


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'ros1', 'ros1 lz4'])
def test_zero_bytes_at_the_end(copy, kind):
    """A file system that lost power leaves a file of the right length filled with zeros."""
    path = copy(kind)
    expected = by_library(path)
    file = storage_file(path)
    content = file.read_bytes()
    half = len(content) // 2
    file.write_bytes(content[:half] + bytes(len(content) - half))
    records, warnings = by_bag(path)
    assert warnings
    assert len(records) > 0.3 * len(expected)
    # The last message may straddle the first zero.
    assert records[:-1] == expected[:len(records) - 1]


def test_ros1_not_indexed(copy):
    path = copy('ros1 lz4')
    expected = by_library(path)
    content = bytearray(path.read_bytes())
    at = content.index(b'index_pos=') + len(b'index_pos=')
    content[at:at + 8] = bytes(8)
    path.write_bytes(content)
    records, warnings = by_bag(path)
    assert records == expected
    assert 'not closed' in warnings[0]


def ros1_header(*fields):
    header = b''.join(struct.pack('<I', len(field)) + field for field in fields)
    return struct.pack('<I', len(header)) + header


def ros1_record(data, *fields):
    return ros1_header(*fields) + struct.pack('<I', len(data)) + data


def ros1_file(chunk, indexed):
    """Return a file with one chunk; connections 0 to 3 are described behind it."""
    start = b'#ROSBAG V2.0\n' + ros1_record(
        b'', b'op=\x03', b'index_pos=' + struct.pack('<Q', indexed), b'chunk_count=' + bytes(
            [1, 0, 0, 0]))
    content = start + ros1_record(chunk, b'op=\x05', b'compression=none',
                                  b'size=' + struct.pack('<I', len(chunk)))
    content += b''.join(ros1_record(ros1_header(b'type=a/b')[4:], b'op=\x07',
                                    b'topic=/%d' % key, b'conn=' + struct.pack('<I', key))
                        for key in range(4))
    return content + ros1_record(b'', b'op=\x06', b'chunk_pos=' + struct.pack('<Q', len(start)),
                                 b'start_time=' + bytes(8), b'end_time=' + bytes([255] * 8))


def plain_ros1(data):
    """Return times, connections and messages of a chunk, and whether it is damaged."""
    records = []
    position = 0
    while position + 8 <= len(data):
        start, position = position, position + 4 + struct.unpack_from('<I', data, position)[0]
        if not start + 4 < position <= len(data) - 4:
            position = start
            break
        body = position + 4
        end = body + struct.unpack_from('<I', data, position)[0]
        if end > len(data):
            position = start
            break
        header = data[start + 4:position]
        position = end
        fields = {}
        while len(header) >= 4:
            length, = struct.unpack_from('<I', header)
            name, _, value = header[4:4 + length].partition(b'=')
            fields[name] = value
            header = header[4 + length:]
        if fields.get(b'op') == b'\x02':
            conn, time = fields.get(b'conn', b''), fields.get(b'time', b'')
            seconds, nanoseconds = struct.unpack('<II', time) if len(time) == 8 else (0, 0)
            records.append((seconds * 10 ** 9 + nanoseconds,
                            struct.unpack('<I', conn)[0] if len(conn) == 4 else -1,
                            data[body:end]))
    return records, position != len(data)


CONNECTION = st.builds(lambda key: b'conn=' + struct.pack('<I', key), st.one_of(
    st.integers(0, 5), st.just((1 << 32) - 1)))
TIME = st.builds(lambda *time: b'time=' + struct.pack('<II', *time), *[st.one_of(
    st.integers(0, 9), st.just((1 << 32) - 1))] * 2)
HEADER = st.one_of(
    st.tuples(CONNECTION, st.just(b'op=\x02'), TIME),
    st.tuples(TIME, st.just(b'op=\x02'), CONNECTION),
    st.lists(st.one_of(CONNECTION, TIME, st.sampled_from([
        b'op=\x02', b'op=\x07', b'conn=1', b'time=', b'time', b'=', b'', b'topic=/2']))))


@settings(max_examples=500, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(HEADER, st.binary(max_size=8)), max_size=12),
       st.lists(st.tuples(st.integers(0, 400), st.binary(max_size=9)), max_size=2),
       st.binary(max_size=12), st.booleans())
def test_records_of_a_ros1_chunk_as_one_finds_them_one_by_one(tmp_path, chunk, edits, end,
                                                              indexed):
    data = b''.join(ros1_record(body, *header) for header, body in chunk) + end
    for at, piece in edits:
        data = data[:at] + piece + data[at + len(piece):]
    (tmp_path / 'a.bag').write_bytes(ros1_file(data, indexed))
    records, warnings = by_bag(tmp_path / 'a.bag')
    plain, damaged = plain_ros1(data)
    with Bag(tmp_path / 'a.bag') as bag:
        assert len(warnings) == (damaged if indexed else 1)
        if indexed:
            assert {topic.name for topic in bag.topics} == {'/0', '/1', '/2', '/3'}
        else:
            assert bag.end_ns == (max((time_ns for time_ns, *_ in plain), default=0) or None)
        file, = bag._files
        names = {key: topic.name for key, topic in file.topics.items()}
    expected = [(names[key], time_ns, message) for time_ns, key, message in plain if key in names]
    assert records == sorted(expected, key=lambda record: record[1])


def test_topics_of_a_ros1_recording_without_index(tmp_path):
    messages = [ros1_record(b'%d' % k, b'op=\x02', b'conn=' + struct.pack('<I', 7), b'time=' +
                            struct.pack('<II', 1, k)) for k in range(3)]
    described = ros1_record(ros1_header(b'type=a/b')[4:], b'op=\x07', b'topic=x',
                            b'conn=' + struct.pack('<I', 7))
    for at in range(4):
        chunk = b''.join([*messages[:at], described, *messages[at:]])
        (tmp_path / 'a.bag').write_bytes(ros1_file(chunk, False))
        assert by_bag(tmp_path / 'a.bag')[0] == [
            ('/x', 10 ** 9 + k, b'%d' % k) for k in range(3)]


def test_mcap_without_chunks(tmp_path, recordings):
    content = b'\x89MCAP0\r\n' + mcap_record(1, mcap_string('ros2') + mcap_string('test'))
    content += mcap_record(3, struct.pack('<H', 1) + mcap_string(IMU) + mcap_string('ros2msg')
                           + mcap_string(''))
    content += mcap_record(4, struct.pack('<HH', 7, 1) + mcap_string('/imu') + mcap_string('cdr')
                           + mcap_string(''))
    raws = [data for name, _, data in by_library(recordings['mcap']) if name == '/imu/data_raw']
    for k, raw in enumerate(raws * 4):  # more than one segment
        content += mcap_record(5, struct.pack('<HIQQ', 7, k, k + 1, k + 1) + raw)
    closed = content + mcap_record(15, bytes(4)) + mcap_record(2, bytes(20)) + b'\x89MCAP0\r\n'
    for name, data, warnings in (('open.mcap', content, 1), ('closed.mcap', closed, 0)):
        (tmp_path / name).write_bytes(data)
        records, warned = by_bag(tmp_path / name)
        assert records == [('/imu', k + 1, raw) for k, raw in enumerate(raws * 4)]
        assert len(warned) == warnings


def chunked_mcap(chunks):
    """Return a closed file whose chunks hold these bytes and which describes channels 0 to 3."""
    content = b'\x89MCAP0\r\n'
    for chunk in chunks:
        content += mcap_record(6, struct.pack('<QQQII', 0, (1 << 64) - 1, len(chunk), 0, 0)
                               + struct.pack('<Q', len(chunk)) + chunk)
    return (content + mcap_record(15, bytes(4)) + b''.join(
        mcap_record(4, struct.pack('<HH', key, 0) + mcap_string(f'/{key}') + mcap_string('cdr')
                    + mcap_string('')) for key in range(4)) + mcap_record(2, bytes(20)))


def plain_mcap(data):
    """Return times, channels and messages of a chunk, and whether it is damaged."""
    records = []
    position = 0
    while position + 31 <= len(data):
        op, length, channel, time_ns = struct.unpack_from('<BQH4xQ8x', data, position)
        start, position = position, position + 9 + length
        if op == 0 or position > len(data):
            break
        if op == 5 and length >= 22:
            records.append((time_ns, channel, data[start + 31:position]))
    return records, position > len(data) or position < len(data) and not data[position]


SIZES = st.one_of(st.integers(0, 40), st.sampled_from([1000, (1 << 16) + 1, 1 << 40, 1 << 63]))
TIMES = st.one_of(st.integers(0, 9), st.sampled_from([(1 << 63) - 2, (1 << 63) - 1, 1 << 63,
                                                      (1 << 64) - 1]))
MESSAGE = st.tuples(st.just(5), st.none(), st.integers(0, 5), TIMES, st.binary(max_size=8))
RECORD = st.one_of(MESSAGE, st.tuples(st.integers(0, 15), st.one_of(st.none(), SIZES),
                                      st.integers(0, 5), TIMES, st.binary(max_size=40)))


@settings(max_examples=500, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.lists(RECORD, max_size=12), min_size=1, max_size=3),
       st.lists(st.tuples(st.integers(0, 400), st.binary(max_size=9)), max_size=2),
       st.binary(max_size=40))
def test_records_of_an_mcap_chunk_as_one_finds_them_one_by_one(tmp_path, chunks, edits, end):
    data = [b''.join(
        struct.pack('<BQHIQQ', op, 22 + len(body) if length is None else length, channel, 0,
                    time_ns, 0) + body
        for op, length, channel, time_ns, body in chunk) + end for chunk in chunks]
    for at, piece in edits:
        data[0] = data[0][:at] + piece + data[0][at + len(piece):]
    assume(ZSTD_MAGIC not in b''.join(data))  # of messages that are compressed one by one
    (tmp_path / 'a.mcap').write_bytes(chunked_mcap(data))
    plain = [plain_mcap(chunk) for chunk in data]
    expected = [(f'/{channel}', time_ns, message) for records, _ in plain
                for time_ns, channel, message in records
                if channel < 4 and time_ns < (1 << 63) - 1]
    expected.sort(key=lambda record: record[1])
    records, warnings = by_bag(tmp_path / 'a.mcap')
    assert records == expected
    assert len(warnings) == any(damaged for _, damaged in plain)
    # Without the summary each chunk is looked into for its times: all that are there.
    (tmp_path / 'b.mcap').write_bytes(chunked_mcap(data)[:-29])
    with Bag(tmp_path / 'b.mcap') as bag:
        times = [time_ns for records, _ in plain for time_ns, *_ in records]
        assert bag.end_ns == (max(times, default=0) or None)


def test_images_beside_the_messages_are_not_held(tmp_path):
    """What a block holds is at most twice as large as its messages."""
    for image in (0, 200, 100_000):
        chunk = b''.join(mcap_record(5, struct.pack('<HIQQ', key, 0, k, k) + bytes(size))
                         for k in range(9) for key, size in ((0, 100), (1, image)))
        (tmp_path / 'a.mcap').write_bytes(chunked_mcap([chunk]))
        with Bag(tmp_path / 'a.mcap') as bag:
            imu, = [topic for topic in bag.topics if topic.name == '/0']
            block, = bag.blocks([imu])
            assert [*block.messages] == [bytes(100)] * 9
            assert len(block.messages._buffer) <= 2 * 9 * 100


@settings(max_examples=300, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.one_of(MESSAGE, st.tuples(
    st.sampled_from([3, 5, 8, 9]), st.none(), st.integers(0, 5), TIMES, st.one_of(
        st.binary(max_size=40), st.just(bytes(200))))), max_size=30), st.floats(0.0, 1.0))
def test_records_outside_of_chunks_as_one_finds_them_one_by_one(tmp_path, records, kept):
    described = b''.join(mcap_record(4, struct.pack('<HH', key, 0) + mcap_string(f'/{key}')
                                     + mcap_string('cdr') + mcap_string('')) for key in range(4))
    data = b''.join(mcap_record(op, struct.pack('<HIQQ', channel, 0, time_ns, 0) + body)
                    for op, _, channel, time_ns, body in records)
    assume(ZSTD_MAGIC not in data)  # of messages that are compressed one by one
    front = b'\x89MCAP0\r\n' + described
    closed = front + data + mcap_record(15, bytes(4)) + described + mcap_record(2, bytes(20))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_file, 'PLAIN_PIECE_BYTES', 90)
        patch.setattr(mcap_file, 'PLAIN_SEGMENT_BYTES', 300)
        for content in (closed, front + data[:int(kept * len(data))]):
            (tmp_path / 'a.mcap').write_bytes(content)
            expected = [(f'/{channel}', time_ns, message) for time_ns, channel, message
                        in plain_mcap(content[len(front):])[0]
                        if channel < 4 and time_ns < (1 << 63) - 1]
            expected.sort(key=lambda record: record[1])
            found, warnings = by_bag(tmp_path / 'a.mcap')
            assert found == expected
            assert bool(warnings) == (content is not closed)


def test_messages_of_overlapping_chunks_come_in_order(tmp_path):
    content = b'\x89MCAP0\r\n' + mcap_record(1, mcap_string('ros2') + mcap_string('test'))
    definitions = mcap_record(4, struct.pack('<HH', 0, 0) + mcap_string('/a') + mcap_string('cdr')
                              + mcap_string(''))
    for times in ([1, 5, 3], [2, 9, 4], [6, 7, 8]):
        chunk = definitions + b''.join(
            mcap_record(5, struct.pack('<HIQQ', 0, 0, t, t) + b'%d' % t) for t in times)
        content += mcap_record(6, struct.pack('<QQQII', min(times), max(times), len(chunk), 0, 0)
                               + struct.pack('<Q', len(chunk)) + chunk)
    (tmp_path / 'a.mcap').write_bytes(content)
    assert [r[1] for r in by_bag(tmp_path / 'a.mcap')[0]] == list(range(1, 10))


def test_what_is_held_back_is_joined_once(tmp_path, monkeypatch):
    """All chunks start at 0, as they say: each of them waits for the last one."""
    joined = []
    join = Block.joined

    def counted(parts):
        joined.append(sum(len(part.messages) for part in parts))
        return join(parts)

    monkeypatch.setattr(Block, 'joined', counted)
    times = [*range(1, 51), 0]
    (tmp_path / 'a.mcap').write_bytes(chunked_mcap(
        [mcap_record(5, struct.pack('<HIQQ', 0, 0, time_ns, time_ns)) for time_ns in times]))
    assert [record[1] for record in by_bag(tmp_path / 'a.mcap')[0]] == sorted(times)
    assert joined == [51]


def test_directory_of_several_files(tmp_path, recordings):
    path = tmp_path / 'split'
    path.mkdir()
    for number in (2, 10, 1):
        source = write_recording(tmp_path / f's{number}', 'mcap', 0.1)
        shutil.copy(source / f's{number}.mcap', path / f'split_{number}.mcap')
    (path / 'split_3.mcap').touch()
    records, warnings = by_bag(path)
    assert len(records) == 3 * (10 + 2)
    assert 'split_3.mcap is empty' in warnings
    names = 'split_10.mcap, split_1.mcap, ../../split_2.mcap, gone.mcap'
    (path / 'metadata.yaml').write_text(
        f'rosbag2_bagfile_information: {{relative_file_paths: [{names}]}}')
    records, warnings = by_bag(path)
    assert len(records) == 3 * (10 + 2)
    assert warnings == ['gone.mcap is missing from split']


@pytest.mark.parametrize('kind', ['mcap', 'mcap messages', 'sqlite3', 'ros1 bz2'])
@pytest.mark.parametrize('parts', [
    [(0, 30), (30, 70), (70, 100)], [(70, 100), (30, 70), (0, 30)],
    [(0, 50, 2), (70, 100), (50, 70), (1, 50, 2)], [(0, 100, 3), (1, 100, 3), (2, 100, 3)]])
def test_files_in_any_order_and_at_the_same_time(tmp_path, kind, parts):
    """What is there is read once, in the order of time."""
    store = typestore(kind.startswith('ros1'))
    path = tmp_path / 'split'
    path.mkdir()
    names = []
    stamps = []
    for number, part in enumerate(parts):
        times = [START_NS + k * 10_000_000 for k in range(*part)]
        stamps += times
        messages = [(topic, stamp + late, make_imu(store, stamp, (k, 0, 0), (0, 0, 9.8)))
                    for k, stamp in enumerate(times) for topic, late in (('/a', 0), ('/b', 1))]
        source = write_messages(tmp_path / f's{number}.bag', kind, messages,
                                {'/b': IMU, '/a': IMU} if number else {'/a': IMU, '/b': IMU})
        file = storage_file(source)
        names.append(f'{number}{file.suffix}')
        shutil.copy(file, path / names[-1])
    for listed in (None, names, names[::-1]):
        if listed:
            (path / 'metadata.yaml').write_text(
                f'rosbag2_bagfile_information: {{relative_file_paths: [{", ".join(listed)}]}}')
        records, warnings = by_bag(path)
        assert len(warnings) == (listed is None)
        assert [record[:2] for record in records] == [
            (topic, stamp + late) for stamp in sorted(stamps)
            for topic, late in (('/a', 0), ('/b', 1))]
        later, _ = by_bag(path, start_ns=START_NS + 400_000_000)
        assert later == [record for record in records if record[1] >= START_NS + 400_000_000]


def test_damaged_schema_is_refused_in_one_line(copy):
    path = copy('sqlite3')
    file = storage_file(path)
    content = file.read_bytes()
    for spoilt in (b'((\n\x1b[31m', b'((\xb8\xb8'):
        at = content.index(b'CREATE TABLE messages(')
        file.write_bytes(content[:at + 22] + spoilt + content[at + 22 + len(spoilt):])
        with pytest.raises(BagError) as info:
            Bag(path)
        assert str(info.value).isprintable()


@settings(max_examples=200, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(FORMATS), st.lists(st.tuples(
    st.integers(0, 1 << 16), st.integers(0, 100), st.one_of(
        st.binary(max_size=16), st.sampled_from([b'\xff' * 8, bytes(8), b'\xff\xff\xff\x7f']))),
    min_size=1, max_size=8))
def test_any_damage(short_recordings, tmp_path, kind, edits):
    """Whatever the bytes: messages or one sentence, and nothing else."""
    name, content = short_recordings[kind]
    for place, removed, added in edits:
        at = place % len(content) if content else 0
        content = content[:at] + added + content[at + removed:]
    (tmp_path / name).write_bytes(content)
    try:
        with Bag(tmp_path / name) as bag:
            for topic, _, message in bag.messages(bag.topics):
                assert len(message) <= 1 << 16
                if topic.msgtype == IMU:
                    decode_imu(Messages.of([message]), topic)
            bag.choose_topics(Config())
    except BagError as error:
        assert str(error).isprintable()


@pytest.mark.parametrize('content, message', [
    (b'', 'is empty'), (b'hello', 'no recording'), (bytes(1000), 'no recording'),
    (b'SQLite format 3\x00', 'cut off'), (b'SQLite format 3\x00' + bytes(200), 'a.bag'),
    (b'#ROSBAG V1.2\n', 'version'), (b'\x28\xb5\x2f\xfdxx', 'a.bag')])
def test_no_recording(tmp_path, content, message):
    (tmp_path / 'a.bag').write_bytes(content)
    with pytest.raises(BagError, match=message) as info:
        Bag(tmp_path / 'a.bag')
    assert '\n' not in str(info.value)


@pytest.mark.parametrize('content', [b'\x89MCAP0\r\n', b'#ROSBAG V2.0\n',
                                     b'#ROSBAG V2.0\n' + b'\xff' * 100,
                                     b'\x89MCAP0\r\n' + b'\x05' + b'\xff' * 100,
                                     b'\x89MCAP0\r\n' + b'\x06' + b'\xff' * 100])
def test_nothing_behind_the_magic(tmp_path, content):
    (tmp_path / 'a').write_bytes(content)
    with pytest.raises(BagError) as info:
        with Bag(tmp_path / 'a') as bag:
            assert bag.topics == () and bag.start_ns is None
            bag.choose_topics(Config())
    assert '\n' not in str(info.value)


def test_missing_and_empty_directory(tmp_path):
    with pytest.raises(BagError, match='does not exist'):
        Bag(tmp_path / 'none')
    with pytest.raises(BagError, match='holds no recording'):
        Bag(tmp_path)


def test_other_database(tmp_path):
    database = sqlite3.connect(tmp_path / 'a.db3')
    database.execute('CREATE TABLE t(x)')
    database.execute('CREATE VIEW messages AS SELECT 1')
    database.execute('CREATE VIEW topics AS SELECT 1')
    database.commit()
    database.close()
    with pytest.raises(BagError, match='no recording'):
        Bag(tmp_path / 'a.db3')


@pytest.mark.parametrize('name', ('a b.db3', 'a?mode=rw.db3', 'a#b.db3', '50%25.db3', "a'b.db3"))
def test_a_database_may_have_any_name(recordings, tmp_path, name):
    shutil.copy(storage_file(recordings['sqlite3']), tmp_path / name)
    assert by_bag(tmp_path / name) == (by_library(recordings['sqlite3']), [])
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_database_left_behind_with_its_log(tmp_path, recordings):
    """A recorder that was killed leaves messages in the write-ahead log."""
    path = tmp_path / 'a.db3'
    shutil.copy(storage_file(recordings['sqlite3']), path)
    database = sqlite3.connect(path)
    database.execute('PRAGMA journal_mode=WAL')
    database.execute('INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)',
                     (START_NS + 10 ** 12, b'last'))
    database.commit()
    left = tmp_path / 'left'
    left.mkdir()
    for file in tmp_path.glob('a.db3*'):
        shutil.copy(file, left)
    database.close()
    assert by_bag(left / 'a.db3')[0][-1][2] == b'last'


@pytest.mark.parametrize('block, fetch', [(4096, 256), (100, 30), (7, 7), (1, 1)])
@pytest.mark.parametrize('cut', [False, True])
def test_odd_rows_of_a_database(copy, monkeypatch, block, fetch, cut):
    monkeypatch.setattr(sqlite_file, 'BLOCK', block)
    monkeypatch.setattr(sqlite_file, 'FETCH', fetch)
    path = copy('sqlite3')
    expected = by_library(path)
    database = sqlite3.connect(storage_file(path))
    odd = [(1, START_NS + 5, 'text'), (1, 'soon', b'x'), (1, 0.5, b'x'), (99, START_NS, b'x'),
           *((2, START_NS + k * 10 ** 9, data) for k in range(40) for data in ('text', 0.5))]
    database.executemany('INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)', odd)
    database.commit()
    database.execute('PRAGMA page_size=512')
    database.execute('VACUUM')
    database.close()
    if cut:  # behind the last message, where rows are read in the order in which they are stored
        file = storage_file(path)
        file.write_bytes(file.read_bytes()[:-512])
    records, warnings = by_bag(path)
    assert records == expected
    assert any('was cut off' in warning for warning in warnings) == cut
    assert any('left out' in warning for warning in warnings)


def test_topics_that_a_database_names_by_text(copy):
    """Sqlite finds '1' where 1 is looked for, where the column is one of text."""
    path = copy('sqlite3')
    database = sqlite3.connect(storage_file(path))
    database.execute('ALTER TABLE messages RENAME TO numbered')
    database.execute('CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id TEXT, timestamp, '
                     'data)')
    database.execute('INSERT INTO messages SELECT * FROM numbered')
    database.commit()
    database.close()
    records, warnings = by_bag(path)
    assert records == [] and 'left out' in warnings[0]


@pytest.mark.parametrize('claim', [1 << 31, 1 << 62])
def test_chunk_that_claims_too_much(copy, claim):
    path = copy('mcap chunks')
    file = storage_file(path)
    content = bytearray(file.read_bytes())
    at = content.index(b'\x04\x00\x00\x00zstd')
    content[at - 12:at - 4] = struct.pack('<Q', claim)
    file.write_bytes(content)
    with pytest.raises(BagError, match='claims a chunk'):
        Bag(path)


@pytest.mark.parametrize('kind', ['mcap', 'mcap chunks', 'sqlite3', 'ros1'])
def test_message_that_is_too_long(tmp_path, kind):
    path = tmp_path / ('a.bag' if kind == 'ros1' else 'a')
    store = typestore(kind == 'ros1')
    message = make_twist(store, START_NS, (1.0, 2.0, 3.0), 'x' * (1 << 21))
    write_messages(path, kind, [('/fix_velocity', START_NS, message)], {'/fix_velocity': TWIST})
    with pytest.raises(BagError, match='message of 2097'):
        by_bag(path)


def test_chunks_that_lie_about_their_times(tmp_path, monkeypatch):
    """All start at 0, as they say: what is held back for that stays bounded."""
    monkeypatch.setattr(bag_files, 'MAX_PENDING_BYTES', 1000)
    content = b'\x89MCAP0\r\n' + mcap_record(1, mcap_string('ros2') + mcap_string('test'))
    content += mcap_record(4, struct.pack('<HH', 0, 0) + mcap_string('/a') + mcap_string('cdr')
                           + mcap_string(''))
    for k in range(100):
        chunk = mcap_record(5, struct.pack('<HIQQ', 0, 0, k, k) + bytes(100))
        content += mcap_record(6, struct.pack('<QQQII', 0, 1 << 40, len(chunk), 0, 0)
                               + struct.pack('<Q', len(chunk)) + chunk)
    content += mcap_record(15, bytes(4)) + mcap_record(4, struct.pack('<HH', 0, 0) + mcap_string(
        '/a') + mcap_string('cdr') + mcap_string('')) + mcap_record(2, bytes(20))
    (tmp_path / 'a.mcap').write_bytes(content)
    with Bag(tmp_path / 'a.mcap') as bag:
        sizes = [len(block.messages) for block in bag.blocks(bag.topics)]
    assert sum(sizes) == 100 and max(sizes) == 11


def test_zip_bomb_as_a_message(tmp_path):
    path = tmp_path / 'a'
    store = typestore()
    message = make_twist(store, START_NS, (1.0, 2.0, 3.0), 'x' * (1 << 24))
    write_messages(path, 'mcap messages', [('/fix_velocity', START_NS, message)],
                   {'/fix_velocity': TWIST})
    records, _ = by_bag(path)
    assert len(records[0][2]) <= 1 << 16


def test_zip_bomb_as_a_file(tmp_path):
    try:
        from compression import zstd
    except ImportError:
        from backports import zstd
    packer = zstd.ZstdCompressor()
    with open(tmp_path / 'a.db3.zstd', 'wb') as file:
        for _ in range(1100):
            file.write(packer.compress(bytes(1 << 20)))
        file.write(packer.flush())
    with pytest.raises(BagError, match='unpacks to more than'):
        Bag(tmp_path / 'a.db3.zstd')


@pytest.mark.parametrize('name, pack', [('bz2', 'bz2'), ('lz4', 'lz4.frame'), ('zstd', None)])
def test_decompress_stops_at_the_size(name, pack):
    import importlib
    try:
        module = importlib.import_module(pack or 'compression.zstd')
    except ImportError:
        module = importlib.import_module('backports.zstd')
    packed = module.compress(b'abc' * 1_000_000)
    assert decompress(packed, name, 7) == b'abcabca'
    assert decompress(packed, name, 0) == b''
    assert decompress(packed, name, 3_000_000) == b'abc' * 1_000_000
    assert decompress(b'xx' + packed, name, 100) == b''


def test_compression_that_nobody_knows():
    with pytest.raises(BagError, match='not supported'):
        decompress(b'', 'rar', 3)


@pytest.mark.parametrize('name, expected', [
    ('sensor_msgs/Imu', IMU), (IMU, IMU), ('', ''), ('a/b/c/d', 'a/b/c/d')])
def test_type_names(name, expected):
    assert ros2_type(name) == expected


def topics_of(tmp_path, topics, config=None, kind='mcap', **names):
    path = tmp_path / ('a.bag' if kind == 'ros1' else 'a')
    write_recording(path, kind, 0.3, topics)
    with Bag(path) as bag:
        return bag.choose_topics(config or Config(), **names)


@pytest.mark.parametrize('kind', ['mcap', 'ros1'])
def test_reference_is_never_taken(tmp_path, kind):
    with pytest.raises(BagError, match='no IMU topic'):
        topics_of(tmp_path, {'/reference/imu': IMU, '/fix': FIX}, kind=kind)


def test_reference_is_refused_by_name_too(tmp_path):
    with pytest.raises(BagError, match='must not read it'):
        topics_of(tmp_path, {'/reference/imu': IMU, '/imu': IMU, '/fix': FIX},
                  imu='reference/imu')


def test_several_candidates_are_listed(tmp_path):
    topics = {'/a/imu': IMU, '/b/imu': IMU, '/fix': FIX}
    with pytest.raises(BagError, match='/a/imu, /b/imu.*--imu-topic'):
        topics_of(tmp_path, topics)
    shutil.rmtree(tmp_path / 'a')
    assert topics_of(tmp_path, topics, imu='b/imu').imu.name == '/b/imu'


def test_missing_topics(tmp_path):
    with pytest.raises(BagError, match='no position topic.*NavSatFix.*it has /imu'):
        topics_of(tmp_path, {'/imu': IMU})
    shutil.rmtree(tmp_path / 'a')
    with pytest.raises(BagError, match='no topic /x; it has /fix, /imu'):
        topics_of(tmp_path, {'/imu': IMU, '/fix': FIX}, imu='/x')
    shutil.rmtree(tmp_path / 'a')
    with pytest.raises(BagError, match='is of type sensor_msgs/NavSatFix, but IMU needs'):
        topics_of(tmp_path, {'/imu': IMU, '/fix': FIX}, imu='/fix')


def test_positions_only(tmp_path):
    topics = topics_of(tmp_path, {'/imu': IMU, '/fix': FIX})
    assert topics.velocity is None and topics.velocity_type is None


def test_velocity_not_wanted(tmp_path):
    topics = topics_of(tmp_path, {'/imu': IMU, '/fix': FIX, '/v': TWIST, '/w': TWIST},
                       Config(use_velocity=False))
    assert topics.velocity is None


def velocity_bag(tmp_path, *, frames, name='/odom'):
    store = typestore()
    topics = {'/imu': IMU, '/fix': FIX, name: STAMPED}
    twist = make_twist(store, START_NS, (1.0, 2.0, 3.0)).twist.twist
    message = store.types[STAMPED](make_twist(store, START_NS, (0., 0., 0.), frames).header, twist)
    write_messages(tmp_path / 'a', 'mcap', [(name, START_NS, message)], topics)
    return Bag(tmp_path / 'a')


def test_velocity_of_another_type_is_found(tmp_path):
    with velocity_bag(tmp_path, frames='gps') as bag:
        topics = bag.choose_topics(Config())
    assert topics.velocity.name == '/odom'
    assert topics.velocity_type == 'TwistStamped'


@pytest.mark.parametrize('frames, name', [('base_link', '/odom'), ('', '/cmd_vel')])
@pytest.mark.parametrize('by_name', [False, True])
def test_velocity_that_is_none_of_an_antenna(tmp_path, frames, name, by_name):
    with velocity_bag(tmp_path, frames=frames, name=name) as bag:
        topics = bag.choose_topics(Config(), velocity=name if by_name else None)
        assert (topics.velocity is None) != by_name
        if not frames:
            assert bag.warnings == []
            return
        warning, = bag.warnings
        assert warning.startswith('/odom cannot be used: the velocity is given in the body frame ')
        assert "'base_link'" in warning


def all_types(tmp_path, child='map', names=('/a', '/b', '/c')):
    """Write a velocity of each type."""
    store = typestore()
    types = store.types
    message = make_twist(store, START_NS, (1.0, 2.0, 3.0))
    pose = types['geometry_msgs/msg/PoseWithCovariance'](types['geometry_msgs/msg/Pose'](
        types['geometry_msgs/msg/Point'](0.0, 0.0, 0.0),
        types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)), np.zeros(36))
    messages = [message, types[STAMPED](message.header, message.twist.twist),
                types[ODOMETRY](message.header, child, pose, message.twist)]
    kinds = dict(zip(names, (TWIST, STAMPED, ODOMETRY)))
    write_messages(tmp_path / 'a', 'mcap', [(name, START_NS, message) for name, message
                                            in zip(names, messages)],
                   {'/imu': IMU, '/fix': FIX, **kinds})
    return Bag(tmp_path / 'a')


@pytest.mark.parametrize('child, names, left', [
    ('map', ('/a', '/b', '/c'), '/b (TwistStamped), /c (Odometry)'),
    ('base_link', ('/a', '/b', '/c'), '/b (TwistStamped)'),
    ('map', ('/a', '/cmd_vel', '/c'), '/c (Odometry)'),
    ('base_link', ('/a', '/reference/b', '/c'), '')])
def test_velocities_of_several_types(tmp_path, child, names, left):
    with all_types(tmp_path, child, names) as bag:
        assert bag.choose_topics(Config()).velocity.name == '/a'
        assert bag.warnings == ([f'the velocity is read from /a (TwistWithCovarianceStamped), not '
                                 f'from {left}: --velocity-topic chooses'] if left else [])
    with Bag(tmp_path / 'a') as bag:
        bag.choose_topics(Config(), velocity='/a')
        bag.choose_topics(Config(use_velocity=False))
        assert bag.warnings == []


def test_odometry_in_the_axes_of_the_vehicle(tmp_path):
    with all_types(tmp_path, 'base_link') as bag:
        config = Config(velocity_type='Odometry', use_velocity='auto')
        with pytest.raises(BagError, match='more than one velocity topic'):
            bag.choose_topics(config)
        assert bag.warnings[0].startswith('/c cannot be used: ')
