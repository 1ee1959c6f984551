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
"""Reads mcap files (https://mcap.dev/spec), with or without chunks and summary."""

from __future__ import annotations

from collections.abc import Collection
import struct

from ins_align.bag_files import (
    ChunkedFile, INT64_MAX, MAX_DEFINITION_BYTES, MAX_MESSAGE_BYTES, Records, ros2_type, Segment,
    Topic)

MAGIC = b'\x89MCAP0\r\n'
PLAIN_SEGMENT_BYTES = 1 << 22  # of records outside of chunks, read at a time


class McapFile(ChunkedFile):
    """An mcap file with ROS messages."""

    _RECORD = struct.Struct('<BQ')
    _MESSAGE = struct.Struct('<BQH4xQ8x')  # neither sequence number nor time of publication
    _CHUNK = struct.Struct('<QQQII')
    _HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _DATA_END = 1, 2, 3, 4, 5, 6, 15
    _LAST_OP = 15

    def _walk(self) -> None:
        self._schemas: dict[int, str] = {}
        summary_channels = False
        data_ended = False
        position = len(MAGIC)
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
                plain = self._extend(plain, start, position, self._MESSAGE.unpack(head)[3])
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
                 ) -> Records:
        records = []
        unpack, head_size = self._MESSAGE.unpack_from, self._MESSAGE.size
        position, size = 0, len(data)
        while position + head_size <= size:
            op, length, channel, log_time = unpack(data, position)
            start, position = position, position + 9 + length
            if op == 0 or position > size:
                break
            if op != 5 or length < 22:
                continue
            if ids is None:
                records.append((log_time, channel, b''))
            elif channel in ids and start_ns <= log_time < stop_ns:
                if length > MAX_MESSAGE_BYTES:
                    self._refuse_message(length, channel)
                records.append((log_time, channel, data[start + head_size:position]))
        if position > size or position < size and not data[position]:
            self._warn_of_damage()
        return records
