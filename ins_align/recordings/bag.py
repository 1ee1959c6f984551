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
"""Opens recordings of every format with rosbags: their topics and serialised messages."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, ExitStack, suppress
from functools import partial
import heapq
import importlib
import itertools
from operator import itemgetter
import os
from pathlib import Path, PurePath
import re
import sqlite3
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from ins_align.recordings import (
    BagError, listed, MAX_CHUNK_BYTES, MAX_HELD_BYTES, max_message_bytes, MAX_METADATA_BYTES,
    MAX_TF_BYTES, MAX_TOPICS, max_unpacked_bytes, one_line, Topic, unpack, ZSTD_MAGIC, ZSTD_MODULE)
from ins_align.recordings.salvage import MCAP_MAGIC, SalvagedMcap
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import storage_mcap

SQLITE_MAGIC, ROSBAG1_MAGIC = b'SQLite format 3\x00', b'#ROSBAG V'
STORAGE_NAME = re.compile(r'\.(mcap|db3|bag)(\.zstd)?$')  # the end of a storage file's name
LISTED_NAME = re.compile(  # a line of metadata.yaml that names a storage file
    rb'(?m)^[ \t]*-[ \t]+["\']?([^\s:][^:\n]*?\.(?:mcap|db3)(?:\.zstd)?)["\']?[ \t]*\r?$')
# A path that rosbags can open: it puts the path into a URI without quoting it.
DATABASE_PATH = re.compile(r'[\w/. ~+=@,-]*\.db3', re.ASCII)
# Commands that may mend a file that rosbags cannot open, by suffix.
COMMANDS = {'.bag': 'rosbag reindex {0}', '.mcap': 'mcap recover {0} -o mended.mcap',
            # Not .recover: the sqlite3 of Debian and Ubuntu is built without what it needs.
            '.db3': "sqlite3 {0} .dump | sed 's/^ROLLBACK.*/COMMIT;/' | sqlite3 mended.db3"}
BLOCK = 4096  # messages in a block
FIRST = 100  # messages of a topic that show what it holds; the very first may be damaged
PIECE_BYTES = 1 << 20  # unpacked from a file at a time
INDEX_ENTRY_BYTES = 12  # for each message in the index of a ROS 1 file
MAX_PASSES = 20  # times a ROS 1 file may be unpacked: chunks that overlap are unpacked repeatedly
SQLITE_LIMIT_LENGTH = 0  # sqlite.org/c3ref/c_limit_attached.html


class Block(NamedTuple):
    """Consecutive messages of some topics."""

    times_ns: np.ndarray  # (N,) int64, when they were recorded
    topics: np.ndarray  # (N,) int64, index into the requested topics
    messages: Sequence[Sequence[bytes]]  # for each requested topic, serialised


class Bag:
    """
    A recording: a rosbag2 directory, one of its files, a ROS 1 bag or a directory of its parts.

    Opening it raises a BagError if nothing can be read. If only a part can be read, `warnings`
    says so.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.warnings: list[str] = []  # sentences on what could not be read or used
        self._topics: dict[int, Topic] = {}  # by id() of a connection
        self._first: dict[Topic, Sequence[bytes]] = {}
        with ExitStack() as stack:
            self._readers = self._open_files(stack)
            with _bag_errors(self.path):
                filled = [reader for reader in self._readers if reader.end_time]
                # When the first and the last message were recorded; 0 if there is no message.
                # int64 refuses what a damaged file may state instead of a time.
                self.start_ns, self.end_ns = (int(np.int64(time_ns)) for time_ns in (
                    min((reader.start_time for reader in filled), default=0),
                    max((reader.end_time - 1 for reader in filled), default=0)))
                self.topics = self._find_topics()  # those whose encoding is supported
            self._stack = stack.pop_all()

    def __enter__(self) -> 'Bag':
        return self

    def __exit__(self, *_: Any) -> None:
        self._stack.close()

    def warn(self, text: str) -> None:
        """Add a warning unless it is there already."""
        if one_line(text) not in self.warnings:
            self.warnings.append(one_line(text))

    def blocks(self, topics: Sequence[Topic], start_ns: int | None = None,
               stop_ns: int | None = None, size: int = BLOCK) -> Iterator[Block]:
        """
        Yield the messages of some topics in recorded order, `size` at a time.

        `start_ns` and `stop_ns` bound the recorded time; the stop is exclusive. Without bounds, a
        warning is added at the end if the files count more messages.
        """
        numbers = {key: topics.index(topic) for key, topic in self._topics.items()
                   if topic in topics}
        with _bag_errors(self.path):
            records = self._records(numbers, start_ns, stop_ns)
            found = 0
            while group := list(itertools.islice(records, size)):
                messages: list[list[bytes]] = [[] for _ in topics]
                for number, _, data in group:
                    messages[number].append(data)
                found += len(group)
                yield Block(np.array([time_ns for _, time_ns, _ in group], np.int64),
                            np.array([number for number, _, _ in group]), messages)
        counted = sum(connection.msgcount for reader in self._readers
                      for connection in reader.connections if id(connection) in numbers)
        if (start_ns, stop_ns) == (None, None) and found < counted:
            self.warn(f'{self.path.name or self.path} is damaged: {found} of {counted} messages '
                      f'on {listed({topic.name for topic in topics})} could be read')

    def first_messages(self, topic: Topic) -> Sequence[bytes]:
        """Return the first messages of a topic, at most `FIRST`."""
        if topic not in self._first:
            block = next(self.blocks([topic], size=FIRST), None)
            self._first[topic] = block.messages[0] if block else ()
        return self._first[topic]

    def _records(self, numbers: Mapping[int, int], start_ns: int | None, stop_ns: int | None,
                 ) -> Iterator[tuple[int, int, bytes]]:
        """Yield topic number, recorded time and message, unpacked, in recorded order."""
        sources = [reader.messages(chosen, start_ns, stop_ns) for reader in self._readers
                   if (chosen := [connection for connection in reader.connections
                                  if id(connection) in numbers])]
        for connection, time_ns, data in heapq.merge(*sources, key=itemgetter(1)):
            limit = max_message_bytes(connection.msgtype)
            if type(data) is not bytes:  # a database may hold text, numbers or NULL instead
                data = b''
            elif len(data) > limit:
                raise BagError(f'has a message of {len(data)} bytes or more on '
                               f'{connection.topic}, where {limit} are allowed')
            elif data.startswith(ZSTD_MAGIC):  # messages may be compressed one by one
                data = unpack(data, 'zstd', limit, damaged=b'')
            yield numbers[id(connection)], time_ns, data

    def _find_topics(self) -> tuple[Topic, ...]:
        """Return the topics of all files, each once, and note whose each connection is."""
        known: dict[tuple[str, str, str], Topic] = {}
        for connection in itertools.chain(*(reader.connections for reader in self._readers)):
            encoding = getattr(connection.ext, 'serialization_format', 'ros1')
            parts = connection.msgtype.split('/')
            msgtype = '/msg/'.join(parts) if len(parts) == 2 else connection.msgtype
            key = '/' + connection.topic.strip('/'), msgtype, encoding
            if encoding in ('cdr', 'ros1'):
                self._topics[id(connection)] = known.setdefault(
                    key, Topic(*key, connection.msgdef.data))
        _check_topics(len(known))
        return tuple(known.values())

    def _open_files(self, stack: ExitStack) -> list[Any]:
        """Open the files; warn of those that fail, raise the first error if all of them do."""
        readers, errors = [], []
        with _bag_errors(self.path):
            files = self._storage_files()
        for path in files:
            try:
                with _bag_errors(path):
                    readers.append(self._open_file(path, stack))
            except BagError as error:
                errors.append(str(error))
        if not readers:
            raise BagError(errors[0])
        self.warnings += errors
        return readers

    def _storage_files(self) -> list[Path]:
        """List the files of the recording."""
        path = self.path
        if not path.exists():
            raise BagError(f'{path} does not exist')
        if path.is_file():
            return [path]
        if not path.is_dir():
            raise BagError(f'{path} is a pipe or a device, from which no recording can be read: '
                           'give a file')
        own = []  # file names that metadata.yaml lists
        with suppress(OSError), open(path / 'metadata.yaml', 'rb') as file:
            # Folders are dropped: metadata must not lead to other files on this machine.
            own = [PurePath(os.fsdecode(name)).name
                   for name in LISTED_NAME.findall(file.read(MAX_METADATA_BYTES))]
        files = sorted(file for file in path.iterdir() if STORAGE_NAME.search(file.name))
        if missing := sorted(set(own).difference(file.name for file in files)):
            self.warn(f'{", ".join(missing)} is missing from {path}')
        files = [file for file in files if file.name in own] or files
        folders = {file.parent.name for file in path.glob('*/*')
                   if STORAGE_NAME.search(file.name) and not own}
        suffixes = {Path(file.name.removesuffix('.zstd')).suffix for file in files}
        if folders or len(suffixes) > 1:
            names = listed([*folders, *(file.name for file in files)])
            raise BagError(f'{path} is a folder of recordings ({names}): name one of them, or '
                           'several')
        if not files:
            raise BagError(f'{path} holds no recording (.mcap, .db3 or .bag)')
        return files

    def _open_file(self, path: Path, stack: ExitStack) -> Any:
        """Open one storage file; its first bytes tell its format."""
        if _first_bytes(path).startswith(ZSTD_MAGIC):
            path = self._unpack_file(path, stack)
        magic = _first_bytes(path)
        if magic.startswith(MCAP_MAGIC):
            return self._open_mcap(path, stack)
        if magic.startswith(SQLITE_MAGIC):
            return self._open_sqlite(path, stack)
        if magic.startswith(ROSBAG1_MAGIC):
            return _opened(_Rosbag1Reader(path), stack)
        raise BagError('is no recording: neither mcap, sqlite3 nor ROS 1 bag' if magic else
                       'is empty')

    def _unpack_file(self, path: Path, stack: ExitStack) -> Path:
        """Unpack a file that is compressed as a whole, into a temporary folder."""
        folder = stack.enter_context(TemporaryDirectory(prefix='ins_align_'))
        target = Path(folder, path.name.removesuffix('.zstd'))
        zstd = importlib.import_module(ZSTD_MODULE)
        left = limit = max_unpacked_bytes(path.stat().st_size)
        with zstd.open(path, 'rb') as packed, open(target, 'wb') as output:
            try:
                while piece := packed.read1(PIECE_BYTES):
                    left -= len(piece)
                    if left < 0:
                        raise BagError(f'unpacks to more than {limit >> 20} MiB, which no '
                                       'recording of its size does')
                    output.write(piece)
            except (EOFError, zstd.ZstdError):
                self.warn(f'{path.name} was cut off or is damaged: it is read as far as it goes')
        return target

    def _open_mcap(self, path: Path, stack: ExitStack) -> Any:
        """Open an mcap file with rosbags, within limits; if that fails, as far as it goes."""
        for name in ('lz4', 'zstd'):
            storage_mcap.DECOMPRESSORS[name] = partial(_unpack_chunk, name)
        try:
            reader = _opened(rosbag2.Reader(path), stack)
            _check_chunks(reader.storage.chunks, max_unpacked_bytes(path.stat().st_size))
            return reader
        except BagError:
            raise
        except Exception:  # damaged bytes cause errors of every kind in rosbags
            salvaged = SalvagedMcap(path)
        stack.callback(salvaged.close)
        if not salvaged.complete:
            self.warn(f'{path.name} was cut off or is damaged: it is read as far as it goes')
        return salvaged

    def _open_sqlite(self, path: Path, stack: ExitStack) -> Any:
        """Open a sqlite3 file with rosbags."""
        log = path.with_name(path.name + '-wal')
        if log.exists() and log.stat().st_size:
            self.warn(f'{log.name} holds messages that are not read: sqlite3 {path.name} '
                      "'PRAGMA wal_checkpoint' puts them into the recording")
        if not DATABASE_PATH.fullmatch(str(path)):
            link = Path(stack.enter_context(TemporaryDirectory()), 'recording.db3')
            link.symlink_to(path.resolve())
            path = link
        with closing(sqlite3.connect(f'file:{path}?immutable=1', uri=True)) as database:
            # Checked before rosbags reads them: it compares each row with all others.
            for table in ('topics', 'message_definitions'):
                with suppress(sqlite3.OperationalError):  # there is no such table
                    _check_topics(*database.execute(f'SELECT count(*) FROM {table}').fetchone())
        reader = _opened(rosbag2.Reader(path), stack)
        with suppress(AttributeError):  # rosbags without apsw; `_records` checks lengths anyway
            reader.storage.dbconn.limit(SQLITE_LIMIT_LENGTH, MAX_TF_BYTES)
        return reader


def _opened(reader: Any, stack: ExitStack) -> Any:
    """Open a reader of rosbags, to be closed with the recording."""
    reader.open()
    stack.callback(reader.close)
    return reader


def _unpack_chunk(compression: str, data: bytes, size: int = MAX_CHUNK_BYTES) -> bytes:
    return unpack(data, compression, min(size, MAX_CHUNK_BYTES))


def _check_chunks(chunks: Sequence[Any], limit: int) -> None:
    """Raise an error if chunks lack an index or unpack to too much; `limit`: of all, bytes."""
    if not chunks or not all(chunk.message_index_offsets for chunk in chunks):
        raise ValueError('rosbags leaves out chunks without an index')
    sizes = [chunk.uncompressed_size for chunk in chunks]
    changes = []  # of the bytes in memory: rosbags holds chunks whose times overlap
    for chunk, size in zip(chunks, sizes):
        end_ns = max(chunk.message_start_time, chunk.message_end_time) + 1
        changes += [(chunk.message_start_time, size), (end_ns, -size)]
    held = max(itertools.accumulate(change for _, change in sorted(changes)))
    if max(sizes) > MAX_CHUNK_BYTES or sum(sizes) > limit or held > MAX_HELD_BYTES:
        raise BagError(f'claims a chunk of {max(sizes)} bytes, {sum(sizes)} in all and {held} of '
                       'the same time, which no recording of its size has')


def _check_topics(count: int) -> None:
    if count > MAX_TOPICS:
        raise BagError(f'describes {count} topics, where {MAX_TOPICS} are allowed')


class _Rosbag1Reader(rosbag1.Reader):
    """A reader of ROS 1 files with bounded memory and time."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._size = path.stat().st_size
        self._left = MAX_PASSES * max_unpacked_bytes(self._size)

    def read_chunk(self) -> Any:
        """Read a chunk whose decompressor is bounded, alone and with all others."""
        chunk = super().read_chunk()
        names = {function: name for name, function in rosbag1.reader.decompressors.items()}
        return chunk._replace(decompressor=partial(self._unpack, names[chunk.decompressor]))

    def _unpack(self, compression: str, data: bytes) -> bytes:
        unpacked = unpack(data, compression, MAX_CHUNK_BYTES)
        self._left -= len(unpacked)
        if self._left < 0:
            raise BagError('has chunks that are unpacked time and again, since they have messages '
                           'of the same time')
        return unpacked

    def read_index_data(self, pos: int, indexes: dict[int, list[Any]]) -> None:
        """Read an index; raise an error if it lists more messages than fit into the file."""
        super().read_index_data(pos, indexes)
        if INDEX_ENTRY_BYTES * sum(map(len, indexes.values())) > self._size:
            raise ValueError('index larger than the file')


def _first_bytes(path: Path) -> bytes:
    with open(path, 'rb') as file:
        return file.read(16)


def begins_like_a_recording(path: Path) -> bool:
    """Tell whether a file begins as a recording does; false if it cannot be read."""
    try:
        return _first_bytes(path).startswith((MCAP_MAGIC, SQLITE_MAGIC, ROSBAG1_MAGIC, ZSTD_MAGIC))
    except OSError:
        return False


@contextmanager
def _bag_errors(path: Path) -> Iterator[None]:
    """Turn any error of rosbags and its libraries into a BagError that names the file."""
    try:
        yield
    except ImportError:
        raise
    except BagError as error:
        named = str(error).startswith(str(path))
        raise BagError(str(error) if named else f'{path.name or path} {error}') from None
    except Exception as error:  # damaged bytes cause errors of every kind
        if isinstance(error, OSError) and error.strerror:
            raise BagError(f'{path} cannot be read: {error.strerror}') from None
        text = str(error).rstrip('.') or type(error).__name__
        packed = path.suffix == '.zstd'
        name = f'unpacked{Path(path.stem).suffix}' if packed else path.name
        command = COMMANDS.get(Path(name).suffix, '').format(name)
        if command and packed:
            command = f'zstd -dc {path.name} > {name}; {command}'
        raise BagError(f'{path.name or path} cannot be read ({text})'
                       + (f'; this may mend it: {command}' if command else '')) from None
