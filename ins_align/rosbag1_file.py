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
"""Reads ROS 1 recordings (https://wiki.ros.org/Bags/Format/2.0), indexed or not."""

from __future__ import annotations

from collections.abc import Collection, Iterator
import struct

from ins_align.bag_files import (
    BagError, ChunkedFile, MAX_DEFINITION_BYTES, MAX_MESSAGE_BYTES, Records, ros2_type, Segment,
    Topic)

MAGIC = b'#ROSBAG V'


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
                 ) -> Records:
        records = []
        for fields, body, end in self._split(data):
            if fields.get(b'op') == self._MESSAGE:
                connection = self._uint(fields.get(b'conn', b''))
                time_ns = self._time(fields, b'time')
                if connection is not None and connection in ids and start_ns <= time_ns < stop_ns:
                    if end - body > MAX_MESSAGE_BYTES:
                        self._refuse_message(end - body, connection)
                    records.append((time_ns, connection, data[body:end]))
        return records

    def _split(self, data: bytes) -> Iterator[tuple[dict[bytes, bytes], int, int]]:
        """Yield each whole record's header and where its data start and end."""
        unpack = struct.Struct('<I').unpack_from
        position = 0
        while position + 8 <= len(data):
            head_end = position + 4 + unpack(data, position)[0]
            if not position + 4 < head_end <= len(data) - 4:
                break
            body = head_end + 4
            end = body + unpack(data, head_end)[0]
            if end > len(data):
                break
            yield self._fields(data[position + 4:head_end]), body, end
            position = end
        if position != len(data):
            self._warn_of_damage()

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
