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
"""
Bytes that nobody has written on purpose: damaged recordings, messages and parameter files.

Whatever they are: a result or a sentence, in bounded memory. ``FUZZ_EXAMPLES=30000`` looks longer.
"""

import os
from pathlib import Path
import struct
import subprocess
import sys

from hypothesis import example, given, HealthCheck, settings, strategies as st
from ins_align.bag_files import BagError, Messages, Topic
from ins_align.bags import Bag
from ins_align.config import Config, config_from_mapping, ConfigError, load_params
from ins_align.decoding import body_start, decode_imu, deserialize
from ins_align.messages import imu_from_msg, MessageError
from ins_align.replay import replay
from ins_align.simulation import simulate, write_bag
import numpy as np
import pytest

EXAMPLES = int(os.environ.get('FUZZ_EXAMPLES', '300'))
FUZZ = settings(max_examples=EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck))
MIB = 1 << 20
MEMORY = 1500 * MIB  # address space of a process that must get along with bounded memory
PARAMETERS = Path(__file__).parents[1] / 'config' / 'ins_align.yaml'
# Where and with what bytes are replaced, and where a file ends.
DAMAGE = st.tuples(
    st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.one_of(
        st.binary(min_size=1, max_size=12),
        st.sampled_from([b'\xff' * 8, b'\0' * 8, struct.pack('<Q', 1 << 32),
                         struct.pack('<I', 0x7fffffff)]))), max_size=5),
    st.one_of(st.just(1.0), st.floats(0.0, 1.0)))


def damaged(data, damage):
    """Return the bytes with some replaced and the end cut off."""
    edits, keep = damage
    data = bytearray(data)
    for place, piece in edits:
        at = int(place * len(data))
        data[at:at + len(piece)] = piece
    return bytes(data[:int(keep * len(data))])


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """Files of three formats by suffix, each of a second of data."""
    folder = tmp_path_factory.mktemp('seeds')
    data = simulate('car', duration=1.5, imu_rate=50.0)
    files = {}
    for storage, suffix in (('mcap', '.mcap'), ('sqlite3', '.db3')):
        write_bag(data, folder / storage, storage)
        file, = (folder / storage).glob(f'*{suffix}')
        files[suffix] = file.read_bytes()
    from rosbags.convert import convert
    ros1 = folder / 'one.bag'
    convert(srcs=[folder / 'mcap'], dst=ros1, dst_storage='sqlite3', dst_version=8,
            compress=None, compress_mode='file', default_typestore=None, typestore=None,
            exclude_topics=[], include_topics=[], exclude_msgtypes=[], include_msgtypes=[])
    files['.bag'] = ros1.read_bytes()
    for path in (folder / 'mcap', folder / 'sqlite3', ros1):
        assert len(replay(path).epochs) > 3
    return files


@FUZZ
@example(suffix='.db3', damage=([(0.3633378835943648, b'\xff\xff\xff\xff^')], 1.0))
@example(suffix='.mcap', damage=([(0.059434364845308625, bytes(7))], 1.0))
@example(suffix='.mcap', damage=([(0.09765625, b'\0'), (0.059434364845308625, bytes(7))], 1.0))
@example(suffix='.db3', damage=([(0.7889469472312373, b'\0C')], 1.0))
@given(suffix=st.sampled_from(['.mcap', '.db3', '.bag']), damage=DAMAGE)
def test_damaged_recordings(recordings, tmp_path_factory, suffix, damage):
    path = tmp_path_factory.getbasetemp() / f'fuzzed{suffix}'
    path.write_bytes(damaged(recordings[suffix], damage))
    try:
        result = replay(path, Config(imu_grade='tactical'))
    except BagError as error:
        assert str(error).isprintable()
        return
    assert all(warning.isprintable() for warning in result.warnings)
    result.to_json()
    result.to_csv()


@FUZZ
@given(damage=DAMAGE, encoding=st.sampled_from(['cdr', 'ros1']),
       frame=st.binary(max_size=20), values=st.binary(min_size=312, max_size=320))
def test_imu_messages_agree_with_the_library_or_are_refused(damage, encoding, frame, values):
    head = struct.pack('<iI', 5, 7) + struct.pack('<I', len(frame)) + frame
    head = (b'\0\1\0\0' if encoding == 'cdr' else struct.pack('<I', 3)) + head
    if encoding == 'cdr':
        head += b'\0' * (-(len(head) - 4) % 8)
    message = damaged(head + values[:296], damage)
    topic = Topic('/imu', 'sensor_msgs/msg/Imu', encoding)
    samples = decode_imu(Messages.of([message]), topic)
    try:
        stamp_ns, gyro, accel = imu_from_msg(deserialize(message, topic))
    except MessageError:
        # A frame_id that is no text is no reason to refuse the numbers behind it.
        assert len(samples.stamps_ns) == (body_start(message, encoding) is not None)
        return
    assert samples.decoded.all()
    assert samples.stamps_ns.tolist() == [stamp_ns]
    np.testing.assert_array_equal(samples.gyro[0], gyro)
    np.testing.assert_array_equal(samples.accel[0], accel)


YAML_VALUES = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8),
              st.sampled_from(['auto', 'true', '.nan', '1e400', '!!python/name:os.system', '*a',
                               '&a [1]', '0x10', '2020-01-01'])),
    lambda inner: st.lists(inner, max_size=4), max_leaves=6)


@FUZZ
@given(data=st.data())
def test_parameter_files(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / 'fuzzed.yaml'
    if data.draw(st.booleans()):
        path.write_bytes(damaged(PARAMETERS.read_bytes(), data.draw(DAMAGE)))
    else:
        names = st.one_of(st.sampled_from(list(vars(Config()))), st.text(max_size=8))
        lines = [f'    {name}: {value}\n' for name, value in data.draw(
            st.dictionaries(names, YAML_VALUES, max_size=6)).items()]
        path.write_text('ins_align:\n  ros__parameters:\n' + ''.join(lines), 'utf-8')
    try:
        config = config_from_mapping(load_params(path))
    except ConfigError as error:
        assert str(error)
        return
    assert np.isfinite(config.lever_arm).all()
    assert np.isfinite(config.imu_noise).all()


LIMITED = """
import resource, sys
from ins_align.cli import main
import ins_align.batch, ins_align.bags
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
sys.exit(main(['replay', sys.argv[2]]))
"""


def refusal(path):
    """Replay in little memory and return the one sentence with which it is refused."""
    done = subprocess.run([sys.executable, '-c', LIMITED, str(MEMORY), str(path)],
                          capture_output=True, text=True, timeout=120,
                          env={**os.environ, 'OPENBLAS_NUM_THREADS': '1'})
    assert done.returncode == 2, done.stderr
    assert 'Traceback' not in done.stderr
    sentence, = done.stderr.splitlines()
    return sentence


def mcap_chunk(compression, packed, claimed):
    """Return an mcap file of one chunk."""
    name = compression.encode()
    body = (struct.pack('<QQQII', 1, 2, claimed, 0, len(name)) + name
            + struct.pack('<Q', len(packed)) + packed)
    header = struct.pack('<BQII', 1, 8, 0, 0)
    return b'\x89MCAP0\r\n' + header + struct.pack('<BQ', 6, len(body)) + body


def packed_zeros(compression, size):
    """Return zeros that take a thousandth of their size, or less."""
    piece = bytes(MIB)
    if compression == 'lz4':
        import lz4.frame
        compressor = lz4.frame.LZ4FrameCompressor()
        parts = [compressor.begin()]
    else:
        try:
            from compression import zstd
        except ImportError:
            from backports import zstd
        compressor, parts = zstd.ZstdCompressor(), []
    parts += [compressor.compress(piece) for _ in range(size // MIB)]
    return b''.join([*parts, compressor.flush()])


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
@pytest.mark.parametrize('honest', [True, False])
def test_zip_bomb_in_a_chunk(compression, honest, tmp_path):
    size = 1 << 32
    path = tmp_path / 'bomb.mcap'
    packed = packed_zeros(compression, size // 4)
    path.write_bytes(mcap_chunk(compression, packed, size if honest else 1 << 20))
    sentence = refusal(path)
    if honest:
        assert f'claims a chunk of {size} bytes' in sentence
    else:
        assert 'has no IMU topic' in sentence


def test_message_that_claims_four_gigabytes(tmp_path):
    path = tmp_path / 'claims.mcap'
    schema = struct.pack('<HI', 1, 19) + b'sensor_msgs/msg/Imu' + struct.pack('<I', 0) * 2
    channel = (struct.pack('<HHI', 1, 1, 4) + b'/imu' + struct.pack('<I', 3) + b'cdr'
               + struct.pack('<I', 0))
    records = b''.join(struct.pack('<BQ', op, len(body)) + body
                       for op, body in ((1, bytes(8)), (3, schema), (4, channel)))
    message = struct.pack('<BQHIQQ', 5, (1 << 32) + 22, 1, 0, 1, 1)
    path.write_bytes(b'\x89MCAP0\r\n' + records + message + bytes(1000))
    assert 'has no position topic' in refusal(path)  # what is left is not read as a message


def test_row_that_holds_a_huge_message(recordings, tmp_path):
    import sqlite3

    path = tmp_path / 'huge.db3'
    path.write_bytes(recordings['.db3'])
    database = sqlite3.connect(path)
    database.execute('UPDATE messages SET data = zeroblob(300000000) WHERE id = 5')
    database.commit()
    database.close()
    assert 'has a message of 300000000 bytes' in refusal(path)


def test_zip_bomb_of_a_whole_file(tmp_path):
    path = tmp_path / 'bomb.db3.zstd'
    path.write_bytes(packed_zeros('zstd', 2 << 30))
    assert 'unpacks to more than 1024 MiB' in refusal(path)


def test_reading_leaves_nothing_behind(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path / 'temporary'))
    (tmp_path / 'temporary').mkdir()
    path = tmp_path / 'whole.mcap.zstd'
    path.write_bytes(packed_zeros('zstd', MIB))
    with pytest.raises(BagError):
        Bag(path)
    assert not list((tmp_path / 'temporary').iterdir())
