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

import struct

from ins_align.bag_files import (
    BagError, bytes_at, ChunkedFile, MAX_DEFINITION_BYTES, Messages, Records, ros2_type, Segment,
    Topic)
import numpy as np

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
            records = self._records(self._load(segment), connect=True)
            self._segments[index] = segment.with_times(records.times_ns)

    def _connect(self, fields: dict[bytes, bytes], data: bytes) -> None:
        connection = self._uint(fields.get(b'conn', b''))
        if connection is not None:
            name = fields.get(b'topic', b'').decode(errors='replace')
            msgtype = self._fields(data).get(b'type', b'').decode(errors='replace')
            self.topics[connection] = Topic('/' + name.strip('/'), ros2_type(msgtype), 'ros1')

    def _records(self, data: bytes, connect: bool = False) -> Records:
        """Return the messages; with `connect` learn the topics that are described among them."""
        edges, bodies = self._split(data)
        starts, ends = edges[:-1] + 4, edges[1:]
        times_ns = np.zeros(starts.size, np.uint64)
        connections = np.full(starts.size, -1)
        is_message = np.zeros(starts.size, bool)
        left = np.arange(starts.size)
        alike_known = False
        while left.size:
            index = int(left[0])
            header = data[starts[index]:bodies[index] - 4]
            places = self._places(header)
            fields = {name: header[place] for name, place in places.items()}
            if fields.get(b'op') != self._MESSAGE:
                if connect and fields.get(b'op') == self._CONNECTION:
                    self._connect(fields, data[bodies[index]:ends[index]])
                left = left[1:]
                continue
            connection = self._uint(fields.get(b'conn', b''))
            if not alike_known and connection is not None and len(fields.get(b'time', b'')) == 8:
                # The writer of a file has one way to write them: all others are taken from it.
                alike_known = True
                left, alike, rows = self._alike(data, starts, bodies, left, places)
                seconds, nanoseconds = np.ascontiguousarray(
                    rows[:, places[b'time']]).view('<u4').astype(np.uint64).T
                times_ns[alike] = seconds * np.uint64(1_000_000_000) + nanoseconds
                connections[alike] = np.ascontiguousarray(
                    rows[:, places[b'conn']]).view('<u4')[:, 0]
                is_message[alike] = True
                continue
            times_ns[index] = self._time(fields, b'time')
            connections[index] = -1 if connection is None else connection
            is_message[index] = True
            left = left[1:]
        chosen = np.flatnonzero(is_message)
        return Records(times_ns[chosen], connections[chosen],
                       Messages(data, bodies[chosen], (ends - bodies)[chosen]))

    @staticmethod
    def _alike(data: bytes, starts: np.ndarray, bodies: np.ndarray, left: np.ndarray,
               places: dict[bytes, slice]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Part the records that differ from the first one in no more than connection and time."""
        lengths = (bodies - 4 - starts)[left]
        long = lengths == lengths[0]
        rows = bytes_at(data, starts[left[long]], int(lengths[0]))
        same = rows == rows[0]
        for name in (b'conn', b'time'):
            same[:, places[name]] = True
        alike = same.all(axis=1)
        found = left[long][alike]
        return np.setdiff1d(left, found, assume_unique=True), found, rows[alike]

    def _split(self, data: bytes) -> tuple[np.ndarray, np.ndarray]:
        """Return where each whole record starts and the last one ends, and where data start."""
        unpack = struct.Struct('<I').unpack_from
        position, size = 0, len(data)
        edges: list[int] = []
        bodies: list[int] = []
        while position + 8 <= size:
            body = position + 8 + unpack(data, position)[0]
            if not position + 8 < body <= size:
                break
            end = body + unpack(data, body - 4)[0]
            if end > size:
                break
            edges.append(position)
            bodies.append(body)
            position = end
        if position != size:
            self._warn_of_damage()
        return np.array([*edges, position]), np.array(bodies, np.int64)

    @classmethod
    def _fields(cls, header: bytes) -> dict[bytes, bytes]:
        return {name: header[place] for name, place in cls._places(header).items()}

    @staticmethod
    def _places(header: bytes) -> dict[bytes, slice]:
        """Return where the value of each field lies."""
        places = {}
        position = 0
        while position + 4 <= len(header):
            end = position + 4 + int.from_bytes(header[position:position + 4], 'little')
            field = header[position + 4:end]
            name = field.partition(b'=')[0]
            places[name] = slice(position + 4 + len(name) + 1, position + 4 + len(field))
            position = end
        return places

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
