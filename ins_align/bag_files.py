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
Storage files of recordings: mcap, sqlite3 and ROS 1, whole or broken.

Each reader goes through its file from the front with the format's own records and needs no index,
so that a recording that was cut off is read as far as it goes. Sizes that a file claims are
checked before memory is spent on them.

Formats: https://mcap.dev/spec, https://wiki.ros.org/Bags/Format/2.0, rosbag2_storage_sqlite3.
"""

from __future__ import annotations

import bisect
from collections.abc import Collection, Iterator
import itertools
from operator import itemgetter
import os
from pathlib import Path
import sqlite3
import struct
from typing import Any, NamedTuple
from urllib.parse import quote
import zlib

MAX_CHUNK_BYTES = 1 << 30  # of a chunk, unpacked
MAX_MESSAGE_BYTES = 1 << 20  # of an IMU or GNSS message: the frame_id is all that can grow
MAX_DEFINITION_BYTES = 1 << 24  # of a record that describes a topic
MAX_PENDING = 1_000_000  # messages held back to bring overlapping chunks into order
PLAIN_SEGMENT_BYTES = 1 << 22  # of mcap records outside of chunks, read at a time
PIECE_BYTES = 1 << 18

INT64_MAX = (1 << 63) - 1
MCAP_MAGIC = b'\x89MCAP0\r\n'
ROSBAG1_MAGIC = b'#ROSBAG V'
SQLITE_MAGIC = b'SQLite format 3\x00'
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


class BagError(ValueError):
    """A recording that cannot be used; the text says why in one sentence."""


class Topic(NamedTuple):
    """A topic of a recording."""

    name: str
    msgtype: str  # in ROS 2 notation: sensor_msgs/msg/Imu
    encoding: str  # of its messages: cdr or ros1


class Segment(NamedTuple):
    """A stretch of a file that holds messages."""

    offset: int
    size: int  # on disk
    compression: str
    raw_size: int  # unpacked
    crc: int  # of the unpacked bytes, 0: none
    start_ns: int
    end_ns: int


def decompressor(compression: str) -> Any:
    """
    Return a new streaming decompressor.

    Raises
    ------
    BagError
        If the compression is none that recordings use.
    """
    if compression == 'zstd':
        try:
            from compression import zstd  # Python 3.14
        except ImportError:
            from backports import zstd
        return zstd.ZstdDecompressor()
    if compression == 'lz4':
        import lz4.frame
        return lz4.frame.LZ4FrameDecompressor()
    if compression == 'bz2':
        import bz2
        return bz2.BZ2Decompressor()
    raise BagError(f'chunks are compressed with {compression[:40]!r}, which is not supported')


def decompress(data: bytes, compression: str, size: int) -> bytes:
    """Unpack up to `size` bytes; fewer where the data are cut off or damaged."""
    if compression in ('', 'none'):
        return data[:size]
    unpack = decompressor(compression)
    pieces: list[bytes] = []
    left = size
    position = 0
    while left > 0 and not unpack.eof:
        feed = b''
        if unpack.needs_input:
            feed = data[position:position + PIECE_BYTES]
            position += len(feed)
            if not feed:
                break
        try:
            piece = unpack.decompress(feed, left)
        except Exception:  # each library has its own kind of error for damaged data
            break
        left -= len(piece)
        pieces.append(piece)
    return b''.join(pieces)


def ros2_type(name: str) -> str:
    """Return a message type's name in ROS 2 notation."""
    parts = name.split('/')
    return f'{parts[0]}/msg/{parts[1]}' if len(parts) == 2 else name


class ChunkedFile:
    """What mcap and ROS 1 files have in common: records in chunks, any of them compressed."""

    def __init__(self, path: Path) -> None:
        self.warnings: list[str] = []
        self.topics: dict[int, Topic] = {}
        self._path = path
        self._segments: list[Segment] = []
        self._complete = False
        self._file = open(path, 'rb')
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._walk()
            if not self._complete:
                self._warn('was cut off or not closed: it is read as far as it goes')
            self._segments = [segment for segment in self._segments
                              if segment.end_ns >= segment.start_ns]
        except BaseException:
            self._file.close()
            raise

    @property
    def start_ns(self) -> int | None:
        """Recorded time of the first message."""
        # An mcap chunk without messages says that it starts and ends at 0.
        return min((segment.start_ns for segment in self._segments if segment.end_ns > 0),
                   default=None)

    @property
    def end_ns(self) -> int | None:
        """Recorded time of the last message."""
        return max((segment.end_ns for segment in self._segments if segment.end_ns > 0),
                   default=None)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, ids: Collection[int], start_ns: int, stop_ns: int,
                 ) -> Iterator[tuple[int, int, bytes]]:
        """Yield recorded time, topic's id, message in the order of recorded time."""
        by_time = itemgetter(0)
        segments = [segment for segment in self._segments
                    if segment.end_ns >= start_ns and segment.start_ns < stop_ns]
        starts = [segment.start_ns for segment in segments[1:]] + [INT64_MAX]
        horizons = list(itertools.accumulate(reversed(starts), min))[::-1]
        pending: list[tuple[int, int, bytes]] = []
        for segment, horizon in zip(segments, horizons):
            pending += self._records(self._load(segment), ids, start_ns, stop_ns)
            pending.sort(key=by_time)
            ready = bisect.bisect_left(pending, horizon, key=by_time)
            if len(pending) - ready > MAX_PENDING or horizon == INT64_MAX:
                ready = len(pending)
            yield from pending[:ready]
            del pending[:ready]

    def _walk(self) -> None:
        """Find segments and topics."""
        raise NotImplementedError

    def _records(self, data: bytes, ids: Collection[int], start_ns: int, stop_ns: int,
                 ) -> list[tuple[int, int, bytes]]:
        """Return recorded time, topic's id and message of the wanted records."""
        raise NotImplementedError

    def _warn(self, text: str) -> None:
        warning = f'{self._path.name} {text}'
        if warning not in self.warnings:
            self.warnings.append(warning)

    def _add_segment(self, segment: Segment) -> None:
        if segment.raw_size > MAX_CHUNK_BYTES:
            raise BagError(f'{self._path.name} claims a chunk of {segment.raw_size} bytes, more '
                           f'than the {MAX_CHUNK_BYTES >> 30} GiB that are allowed')
        self._segments.append(segment)

    def _load(self, segment: Segment) -> bytes:
        self._file.seek(segment.offset)
        data = decompress(self._file.read(segment.size), segment.compression, segment.raw_size)
        if self._complete and (len(data) < segment.raw_size
                               or segment.crc and zlib.crc32(data) != segment.crc):
            self._warn('has a damaged chunk: what could be read of it is used')
        return data

    def _check_size(self, size: int, topic: int) -> None:
        if size > MAX_MESSAGE_BYTES:
            raise BagError(f'{self._path.name} has a message of {size} bytes on '
                           f'{self.topics[topic].name}, where {MAX_MESSAGE_BYTES} are allowed')


class McapFile(ChunkedFile):
    """An mcap file with ROS messages."""

    _RECORD = struct.Struct('<BQ')
    _MESSAGE = struct.Struct('<BQHIQQ')
    _CHUNK = struct.Struct('<QQQII')
    _HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _DATA_END = 1, 2, 3, 4, 5, 6, 15
    _LAST_OP = 15

    def _walk(self) -> None:
        self._schemas: dict[int, str] = {}
        summary_channels = False
        data_ended = False
        position = len(MCAP_MAGIC)
        plain: Segment | None = None
        while True:
            self._file.seek(position)
            head = self._file.read(self._MESSAGE.size)
            if len(head) < self._RECORD.size:
                break
            op, length = self._RECORD.unpack_from(head)
            start, position = position, position + self._RECORD.size + length
            if not 0 < op <= self._LAST_OP and op < 0x80 or position > self._size:
                if op == self._CHUNK_OP:
                    self._read_chunk_header(start, self._size)
                break
            if op == self._FOOTER:
                self._complete = True
                break
            if op == self._MESSAGE_OP and len(head) == self._MESSAGE.size:
                plain = self._extend(plain, start, position, self._MESSAGE.unpack(head)[4])
            elif op in (self._SCHEMA, self._CHANNEL):
                if length <= MAX_DEFINITION_BYTES:
                    self._file.seek(start)
                    self._define(self._file.read(position - start))
                summary_channels |= data_ended and op == self._CHANNEL
            elif op == self._CHUNK_OP:
                self._read_chunk_header(start, position)
            elif op == self._DATA_END:
                data_ended = True
        if plain is not None:
            self._add_segment(plain)
        if not (self._complete and summary_channels):
            self._scan_chunks()

    def _extend(self, plain: Segment | None, start: int, end: int, log_time: int) -> Segment:
        """Gather messages outside of chunks."""
        if plain is not None:
            size = end - plain.offset
            if size <= PLAIN_SEGMENT_BYTES:
                return plain._replace(size=size, raw_size=size,
                                      start_ns=min(plain.start_ns, log_time),
                                      end_ns=max(plain.end_ns, log_time))
            self._add_segment(plain)
        return Segment(start, end - start, '', end - start, 0, log_time, log_time)

    def _read_chunk_header(self, start: int, end: int) -> None:
        self._file.seek(start + self._RECORD.size)
        head = self._file.read(self._CHUNK.size + 64)
        try:
            start_ns, end_ns, raw_size, crc, name_length = self._CHUNK.unpack_from(head)
            name_end = self._CHUNK.size + name_length
            compression = head[self._CHUNK.size:name_end].decode(errors='replace')
            size, = struct.unpack_from('<Q', head, name_end)
        except struct.error:
            return
        offset = start + self._RECORD.size + name_end + 8
        self._add_segment(Segment(offset, max(0, min(size, end - offset)), compression, raw_size,
                                  crc, start_ns, end_ns))

    def _scan_chunks(self) -> None:
        """Find the topics and the true times of chunks that no summary describes."""
        for index, segment in enumerate(self._segments):
            data = self._load(segment)
            self._define(data)
            times = [record[0] for record in self._records(data, None, 0, INT64_MAX)]
            self._segments[index] = segment._replace(
                start_ns=min(times, default=0), end_ns=max(times, default=-1))

    def _define(self, data: bytes) -> None:
        """Take the schemas and channels out of a run of records."""
        position = 0
        while position + self._RECORD.size <= len(data):
            op, length = self._RECORD.unpack_from(data, position)
            body = position + self._RECORD.size
            position = body + length
            if op not in (self._SCHEMA, self._CHANNEL) or position > len(data):
                continue
            record = data[body:position]
            try:
                if op == self._SCHEMA:
                    name, _ = self._string(record, 2)
                    self._schemas[struct.unpack_from('<H', record)[0]] = name
                else:
                    channel, schema = struct.unpack_from('<HH', record)
                    topic, after = self._string(record, 4)
                    encoding, _ = self._string(record, after)
                    self.topics[channel] = Topic(
                        topic, ros2_type(self._schemas.get(schema, '')), encoding)
            except (struct.error, UnicodeDecodeError):
                self._warn('has a damaged description of a topic')

    @staticmethod
    def _string(record: bytes, position: int) -> tuple[str, int]:
        length, = struct.unpack_from('<I', record, position)
        end = position + 4 + length
        return record[position + 4:end].decode(), end

    def _records(self, data: bytes, ids: Collection[int] | None, start_ns: int, stop_ns: int,
                 ) -> list[tuple[int, int, bytes]]:
        records = []
        unpack, head_size = self._MESSAGE.unpack_from, self._MESSAGE.size
        position, last = 0, len(data) - head_size
        while position <= last:
            op, length, channel, _, log_time, _ = unpack(data, position)
            start, position = position, position + 9 + length
            if op != 5 or length < 22:
                continue
            if position > len(data):
                break
            if ids is None:
                records.append((log_time, channel, b''))
            elif channel in ids and start_ns <= log_time < stop_ns:
                self._check_size(length, channel)
                records.append((log_time, channel, data[start + head_size:position]))
        return records


class Rosbag1File(ChunkedFile):
    """A ROS 1 recording, version 2.0."""

    _MESSAGE, _HEADER, _CHUNK = b'\x02', b'\x03', b'\x05'
    _CHUNK_INFO, _CONNECTION = b'\x06', b'\x07'

    def _walk(self) -> None:
        if self._file.readline(32).strip() != b'#ROSBAG V2.0':
            raise BagError(f'{self._path.name} is a ROS 1 recording of another version than 2.0')
        infos: dict[int, tuple[int, int]] = {}
        chunk_starts: list[int] = []
        expected = -1
        position = self._file.tell()
        while True:
            start = position
            self._file.seek(position)
            length = self._uint(self._file.read(4))
            if length is None or length > MAX_DEFINITION_BYTES:
                break
            fields = self._fields(self._file.read(length))
            size = self._uint(self._file.read(4))
            if size is None:
                break
            body, op = self._file.tell(), fields.get(b'op')
            position = body + size
            if op == self._CHUNK:
                chunk_starts.append(start)
                self._add_segment(Segment(
                    body, min(size, self._size - body),
                    fields.get(b'compression', b'').decode(errors='replace'),
                    self._uint(fields.get(b'size', b'')) or 0, 0, 0, -1))
            if position > self._size:
                break
            if op == self._HEADER:
                if fields.get(b'encryptor'):
                    raise BagError(f'{self._path.name} is encrypted')
                if any(fields.get(b'index_pos', b'')):
                    expected = self._uint(fields.get(b'chunk_count', b'')) or 0
            elif op == self._CONNECTION and size <= MAX_DEFINITION_BYTES:
                self._connect(fields, self._file.read(size))
            elif op == self._CHUNK_INFO and len(fields.get(b'chunk_pos', b'')) == 8:
                times = self._time(fields, b'start_time'), self._time(fields, b'end_time')
                infos[struct.unpack('<Q', fields[b'chunk_pos'])[0]] = times
        self._complete = len(chunk_starts) == expected and all(s in infos for s in chunk_starts)
        if self._complete:
            self._segments = [
                segment._replace(start_ns=infos[start][0], end_ns=infos[start][1])
                for start, segment in zip(chunk_starts, self._segments)]
        else:
            self._scan_chunks()

    def _scan_chunks(self) -> None:
        """Find the topics and times of chunks that no index describes."""
        for index, segment in enumerate(self._segments):
            times = []
            for fields, body, end in self._split(data := self._load(segment)):
                if fields.get(b'op') == self._CONNECTION:
                    self._connect(fields, data[body:end])
                elif fields.get(b'op') == self._MESSAGE:
                    times.append(self._time(fields, b'time'))
            self._segments[index] = segment._replace(
                start_ns=min(times, default=0), end_ns=max(times, default=-1))

    def _connect(self, fields: dict[bytes, bytes], data: bytes) -> None:
        connection = self._uint(fields.get(b'conn', b''))
        if connection is not None:
            name = fields.get(b'topic', b'').decode(errors='replace')
            msgtype = self._fields(data).get(b'type', b'').decode(errors='replace')
            self.topics[connection] = Topic('/' + name.strip('/'), ros2_type(msgtype), 'ros1')

    def _records(self, data: bytes, ids: Collection[int], start_ns: int, stop_ns: int,
                 ) -> list[tuple[int, int, bytes]]:
        records = []
        for fields, body, end in self._split(data):
            if fields.get(b'op') == self._MESSAGE:
                connection = self._uint(fields.get(b'conn', b''))
                time_ns = self._time(fields, b'time')
                if connection in ids and start_ns <= time_ns < stop_ns:
                    self._check_size(end - body, connection)
                    records.append((time_ns, connection, data[body:end]))
        return records

    @classmethod
    def _split(cls, data: bytes) -> Iterator[tuple[dict[bytes, bytes], int, int]]:
        """Yield each whole record's header and where its data start and end."""
        unpack = struct.Struct('<I').unpack_from
        position = 0
        while position + 8 <= len(data):
            head_end = position + 4 + unpack(data, position)[0]
            if head_end + 4 > len(data):
                return
            body = head_end + 4
            end = body + unpack(data, head_end)[0]
            if end > len(data):
                return
            yield cls._fields(data[position + 4:head_end]), body, end
            position = end

    @staticmethod
    def _fields(header: bytes) -> dict[bytes, bytes]:
        fields = {}
        position = 0
        while position + 4 <= len(header):
            end = position + 4 + int.from_bytes(header[position:position + 4], 'little')
            name, _, value = header[position + 4:end].partition(b'=')
            fields[name] = value
            position = end
        return fields

    @staticmethod
    def _uint(data: bytes) -> int | None:
        return int.from_bytes(data, 'little') if len(data) == 4 else None

    @staticmethod
    def _time(fields: dict[bytes, bytes], name: bytes) -> int:
        value = fields.get(name, b'')
        if len(value) != 8:
            return 0
        seconds, nanoseconds = struct.unpack('<II', value)
        return seconds * 1_000_000_000 + nanoseconds


class SqliteFile:
    """A sqlite3 file of rosbag2."""

    def __init__(self, path: Path) -> None:
        self.warnings: list[str] = []
        self._path = path
        self._truncated = self._is_truncated()
        # Immutable: neither locks nor journals are written beside somebody's recording. Only one
        # that its recorder left behind has a write-ahead log that is worth reading.
        log = path.with_name(path.name + '-wal')
        options = 'mode=ro' if log.exists() and log.stat().st_size else 'mode=ro&immutable=1'
        try:
            self._database = sqlite3.connect(f'file:{quote(str(path.resolve()))}?{options}',
                                             uri=True, check_same_thread=False)
            self._open()
        except sqlite3.Error as error:
            raise BagError(f'{path.name} cannot be read: {error}') from None

    def _is_truncated(self) -> bool:
        with open(self._path, 'rb') as file:
            head = file.read(100)
        if len(head) < 100:
            raise BagError(f'{self._path.name} was cut off within its first 100 bytes')
        page_size = int.from_bytes(head[16:18], 'big')
        page_size = 65536 if page_size == 1 else page_size  # sqlite.org/fileformat.html, 1.3.2
        return self._path.stat().st_size < page_size * int.from_bytes(head[28:32], 'big')

    def _open(self) -> None:
        execute = self._database.execute
        execute('PRAGMA trusted_schema=OFF')
        if self._truncated:
            self._warn('was cut off: it is read as far as it goes')
            # The one way to make sqlite open a file that is shorter than its header says.
            execute('PRAGMA writable_schema=ON')
        tables = {name for name, in execute("SELECT name FROM sqlite_master WHERE type='table'")}
        if not {'topics', 'messages'} <= tables:
            raise BagError(f'{self._path.name} is a sqlite3 file but no recording: it has no '
                           'tables of topics and messages')
        self.topics: dict[int, Topic] = {
            key: Topic(str(name), ros2_type(str(msgtype)), str(encoding))
            for key, name, msgtype, encoding in execute(
                'SELECT id, name, type, serialization_format FROM topics')}
        order = 'rowid' if self._truncated else 'timestamp'
        self.start_ns: int | None = self._one_time(f'{order} ASC')
        self.end_ns: int | None = None if self._truncated else self._one_time(f'{order} DESC')

    def _one_time(self, order: str) -> int | None:
        row = self._database.execute(
            "SELECT timestamp FROM messages WHERE typeof(timestamp)='integer' "
            f'ORDER BY {order} LIMIT 1').fetchone()
        return row[0] if row else None

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def messages(self, ids: Collection[int], start_ns: int, stop_ns: int,
                 ) -> Iterator[tuple[int, int, bytes]]:
        """Yield recorded time, topic's id, message in the order of recorded time."""
        # The order of time needs the index, which a file that was cut off has lost in part.
        order = 'rowid' if self._truncated else 'timestamp, rowid'
        query = ('SELECT timestamp, topic_id, '
                 f'CASE WHEN length(data) <= {MAX_MESSAGE_BYTES} THEN data ELSE length(data) END '
                 f'FROM messages WHERE topic_id IN ({",".join("?" * len(ids))}) '
                 f'AND timestamp >= ? AND timestamp < ? ORDER BY {order}')
        try:
            for row in self._database.execute(query, (*ids, start_ns, stop_ns)):
                if type(row[2]) is bytes and type(row[0]) is int:
                    yield row
                elif type(row[2]) is int:
                    raise BagError(
                        f'{self._path.name} has a message of {row[2]} bytes on '
                        f'{self.topics[row[1]].name}, where {MAX_MESSAGE_BYTES} are allowed')
                else:
                    self._warn('has damaged messages, which are left out')
        except sqlite3.Error as error:
            if not self._truncated:
                self._warn(f'is damaged ({error}): it is read as far as it goes')

    def _warn(self, text: str) -> None:
        warning = f'{self._path.name} {text}'
        if warning not in self.warnings:
            self.warnings.append(warning)


def open_bag_file(path: Path) -> ChunkedFile | SqliteFile:
    """
    Open one storage file, its format told by its first bytes.

    Raises
    ------
    BagError
        If it is empty or of no known format.
    """
    with open(path, 'rb') as file:
        magic = file.read(16)
    if not magic:
        raise BagError(f'{path.name} is empty')
    if magic.startswith(MCAP_MAGIC):
        return McapFile(path)
    if magic.startswith(ROSBAG1_MAGIC):
        return Rosbag1File(path)
    if magic == SQLITE_MAGIC:
        return SqliteFile(path)
    raise BagError(f'{path.name} is no recording: neither mcap, sqlite3 nor ROS 1 bag')
