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
Bytes that nobody has written on purpose: damaged recordings and parameter files.

Whatever they are: a result or a sentence, in bounded memory. ``FUZZ_EXAMPLES=30000`` looks longer.
"""

import bz2
from functools import cache
import importlib
import os
from pathlib import Path
import sqlite3
import struct
import subprocess
import sys

from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
from ins_align.config import Config, config_from_mapping, ConfigError, load_params
from ins_align.offline import replay
from ins_align.recordings import BagError, ZSTD_MODULE
from ins_align.recordings.bag import Bag
import lz4.frame
import numpy as np
import pytest
from recordings import indexed_mcap, mcap_chunk, mcap_of, ros1_records, write_recording

EXAMPLES = int(os.environ.get('FUZZ_EXAMPLES', '100'))
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
    paths = {suffix: write_recording(folder / f'a{suffix}', kind, 1.0)
             for suffix, kind in (('.mcap', 'mcap'), ('.db3', 'sqlite3'), ('.bag', 'ros1'))}
    return {suffix: (path if path.is_file() else next(path.glob(f'*{suffix}'))).read_bytes()
            for suffix, path in paths.items()}


@FUZZ
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
import ins_align.offline, ins_align.recordings.reader, ins_align.report
resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[1]),) * 2)
sys.exit(main(['replay', *sys.argv[2:]]))
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


@cache
def packed_zeros(compression, size):
    """Return zeros that take a thousandth of their size, or less."""
    piece = bytes(MIB)
    parts = []
    if compression == 'lz4':
        compressor = lz4.frame.LZ4FrameCompressor()
        parts = [compressor.begin()]
    else:
        compressor = (bz2.BZ2Compressor() if compression == 'bz2'
                      else importlib.import_module(ZSTD_MODULE).ZstdCompressor())
    parts += [compressor.compress(piece) for _ in range(size // MIB)]
    return b''.join([*parts, compressor.flush()])


@pytest.mark.parametrize('compression', ['zstd', 'lz4'])
@pytest.mark.parametrize('honest', [True, False])
@pytest.mark.parametrize('indexed', [True, False])
def test_zip_bomb_in_a_chunk(compression, honest, indexed, tmp_path):
    size = 1 << 32 if honest else 1 << 20
    path = tmp_path / 'bomb.mcap'
    packed = packed_zeros(compression, 1 << 30)
    path.write_bytes(indexed_mcap([(0, 9)], packed, size, compression) if indexed else
                     mcap_of(mcap_chunk(packed, size, compression)))
    assert (f'claims a chunk of {size} ' if honest else 'in a part, to more') in refusal(path)


@pytest.mark.parametrize('compression', ['bz2', 'lz4'])
def test_zip_bomb_in_a_ros1_chunk(compression, recordings, tmp_path):
    content = recordings['.bag']
    records = ros1_records(content)
    chunk_start, chunk_end = next((a, b) for kind, a, b in records if kind == 5)
    rest = content[chunk_end:next(a for kind, a, b in records if kind == 7)]
    info = content.index(b'chunk_pos=', chunk_end) + 10
    content = content[:info] + struct.pack('<Q', len(content)) + content[info + 8:]
    packed = packed_zeros(compression, 257 * MIB)
    fields = b'op=\x05', b'compression=' + compression.encode(), b'size=' + bytes(4)
    head = b''.join(struct.pack('<I', len(field)) + field for field in fields)
    path = tmp_path / 'bomb.bag'
    path.write_bytes(content + struct.pack('<I', len(head)) + head
                     + struct.pack('<I', len(packed)) + packed + rest)
    assert 'unpacks, in a part, to more than the 268435456 bytes' in refusal(path)


def test_row_that_holds_a_huge_message(recordings, tmp_path):
    path = tmp_path / 'huge.db3'
    path.write_bytes(recordings['.db3'])
    database = sqlite3.connect(path)
    database.execute('UPDATE messages SET data = zeroblob(300000000) WHERE id = 5')
    database.commit()
    database.close()
    assert 'too big' in refusal(path)


@pytest.mark.campaign
def test_zip_bomb_of_a_whole_file(tmp_path):
    path = tmp_path / 'bomb.db3.zstd'
    path.write_bytes(packed_zeros('zstd', 1025 * MIB))
    assert 'unpacks to more than 1024 MiB' in refusal(path)


def test_a_whole_file_that_unpacks_to_too_much(tmp_path, monkeypatch):
    monkeypatch.setattr('ins_align.recordings.UNPACKED_BYTES_FREE', 2 * MIB)
    path = tmp_path / 'bomb.db3.zstd'
    path.write_bytes(packed_zeros('zstd', 3 * MIB))
    with pytest.raises(BagError, match='unpacks to more than 2 MiB'):
        Bag(path)


def test_reading_leaves_nothing_behind(recordings, tmp_path, monkeypatch):
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path / 'temporary'))
    (tmp_path / 'temporary').mkdir()
    path = tmp_path / 'whole.mcap.zstd'
    path.write_bytes(packed_zeros('zstd', MIB))
    with pytest.raises(BagError):
        Bag(path)
    assert not list((tmp_path / 'temporary').iterdir())
