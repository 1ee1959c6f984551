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
"""Reads an mcap file (https://mcap.dev/spec) that rosbags cannot open, as far as it goes."""

from collections.abc import Collection, Iterator
import mmap
from pathlib import Path
import struct
from typing import Any
import zlib

from ins_align.recordings import (
    BagError, MAX_CHUNK_BYTES, MAX_DEFINITION_BYTES, max_message_bytes, max_unpacked_bytes, unpack)
from rosbags.interfaces import (
    Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat)

MCAP_MAGIC = b'\x89MCAP0\r\n'
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 2, 3, 4, 5, 6
_KINDS = {*range(1, 16), *range(128, 256)}  # of records; private from 128 on
_RECORD_HEAD = struct.Struct('<BQ')  # kind and length
_ID = struct.Struct('<H')
_MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence number, recorded and published time
# Start, end, unpacked size, CRC of the unpacked data, length of the name of the compression.
_CHUNK_HEAD = struct.Struct('<QQQII')
_FORMATS = {'ros2msg': MessageDefinitionFormat.MSG, 'ros2idl': MessageDefinitionFormat.IDL}
_NO_SCHEMA = '', MessageDefinition(MessageDefinitionFormat.NONE, '')


class SalvagedMcap:
    """
    An mcap file that is read record by record, without the index at its end.

    It has the attributes and methods of a rosbags reader that `Bag` uses. Opening it reads the
    whole file once, for the topics, the times and whether it is `complete`: it has an end and no
    damage before it.
    """

    def __init__(self, path: Path) -> None:
        self.connections: list[Connection] = []
        self.start_time, self.end_time = (1 << 63) - 1, 0
        self.complete = False
        with open(path, 'rb') as file:
            self._file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        schemas: dict[int, tuple[str, MessageDefinition]] = {}
        channels: dict[int, tuple[int, str, str]] = {}  # schema, topic, encoding
        for data, kind, begin, end in self._records():
            if kind == _MESSAGE and end - begin >= _MESSAGE_HEAD.size:
                _, _, time_ns, _ = _MESSAGE_HEAD.unpack_from(data, begin)
                self.start_time = min(self.start_time, time_ns)
                self.end_time = max(self.end_time, time_ns + 1)
            elif kind in (_SCHEMA, _CHANNEL) and end - begin <= MAX_DEFINITION_BYTES:
                record = data[begin:end]
                key, = _ID.unpack_from(record)
                if kind == _SCHEMA:
                    name, encoding, text = _strings(record, 2, 3)
                    schemas[key] = name, MessageDefinition(
                        _FORMATS.get(encoding, MessageDefinitionFormat.NONE), text)
                else:
                    channels[key] = _ID.unpack_from(record, 2)[0], *_strings(record, 4, 2)
        for channel, (schema, topic, encoding) in channels.items():
            self.connections.append(Connection(
                channel, topic, *schemas.get(schema, _NO_SCHEMA), '', 0,
                ConnectionExtRosbag2(encoding, []), self))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(self, connections: Collection[Connection], start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """Yield messages as a rosbags reader does, but in the order of the file."""
        wanted = {connection.id: connection for connection in connections}
        for data, kind, begin, end in self._records():
            if kind == _MESSAGE and end - begin >= _MESSAGE_HEAD.size:
                channel, _, time_ns, _ = _MESSAGE_HEAD.unpack_from(data, begin)
                if (channel in wanted and (start is None or start <= time_ns)
                        and (stop is None or time_ns < stop)):
                    begin += _MESSAGE_HEAD.size
                    # Of a message that is too long, enough is read for `Bag` to refuse it.
                    connection = wanted[channel]
                    end = min(end, begin + max_message_bytes(connection.msgtype) + 1)
                    yield connection, time_ns, data[begin:end]

    def _records(self) -> Iterator[tuple[Any, int, int, int]]:
        """Yield data, kind, start and end in the data of each record, also of those in chunks."""
        left = max_unpacked_bytes(len(self._file))
        whole = True
        for kind, begin, end in _split(self._file, len(MCAP_MAGIC)):
            if kind != _CHUNK:
                self.complete = kind == _FOOTER and whole
                yield self._file, kind, begin, end
                continue
            _, _, size, crc, length = _CHUNK_HEAD.unpack_from(self._file, begin)
            begin += _CHUNK_HEAD.size
            compression = self._file[begin:begin + length].decode(errors='replace')
            left -= size
            if size > MAX_CHUNK_BYTES or left < 0:
                raise BagError(f'claims a chunk of {size} bytes, which no recording of its size '
                               'has')
            data = unpack(self._file[begin + length + 8:end], compression, size, damaged=b'')
            whole &= len(data) == size and crc in (0, zlib.crc32(data))
            for record in _split(data):
                yield data, *record


def _split(data: Any, position: int = 0) -> Iterator[tuple[int, int, int]]:
    """Yield kind, start and end of each record; the last one may be a chunk that was cut off."""
    while position + _RECORD_HEAD.size <= len(data):
        kind, length = _RECORD_HEAD.unpack_from(data, position)
        begin = position + _RECORD_HEAD.size
        position = begin + length
        if kind not in _KINDS or position > len(data) and (
                kind != _CHUNK or begin + _CHUNK_HEAD.size > len(data)):
            return
        yield kind, begin, min(position, len(data))


def _strings(record: bytes, position: int, count: int) -> list[str]:
    """Return consecutive strings, each with its length (uint32) before it."""
    found = []
    for _ in range(count):
        length, = struct.unpack_from('<I', record, position)
        position += 4 + length
        found.append(record[position - length:position].decode(errors='replace'))
    return found
