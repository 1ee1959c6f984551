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

import struct

from ins_align.bag_files import (
    bytes_at, ChunkedFile, MAX_DEFINITION_BYTES, Messages, Records, ros2_type, Segment, Topic)
import numpy as np

MAGIC = b'\x89MCAP0\r\n'
PLAIN_SEGMENT_BYTES = 1 << 22  # of records outside of chunks, read at a time
PLAIN_PIECE_BYTES = 1 << 16  # of the same, looked into at a time: few where images lie between


class McapFile(ChunkedFile):
    """An mcap file with ROS messages."""

    _RECORD = struct.Struct('<BQ')
    # Of a message: neither its length nor sequence number nor time of publication.
    _HEAD = np.dtype({'names': ['op', 'channel', 'log_time'], 'formats': ['u1', '<u2', '<u8'],
                      'offsets': [0, 9, 15], 'itemsize': 31})
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
            head = self._file.read(self._HEAD.itemsize)
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
            if op == self._MESSAGE_OP and len(head) == self._HEAD.itemsize:
                messages = self._plain_messages(start, position)
                position = messages.offset + messages.size
                plain = self._extend(plain, messages)
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

    def _plain_messages(self, start: int, end: int) -> Segment:
        """Return the message that lies here, and those right behind it, outside of chunks."""
        self._file.seek(start)
        data = self._file.read(PLAIN_PIECE_BYTES)
        unpack, head_size = self._RECORD.unpack_from, self._RECORD.size
        size = len(data)
        last = size - self._HEAD.itemsize
        places = [0]
        position = end - start
        while position <= last:
            op, length = unpack(data, position)
            behind = position + head_size + length
            if op != self._MESSAGE_OP or behind > size:
                break
            places.append(position)
            position = behind
        return Segment(start, position, '', position, 0, 0, -1).with_times(
            self._heads(data, np.array(places))['log_time'])

    def _extend(self, plain: Segment | None, messages: Segment) -> Segment:
        """Gather messages outside of chunks."""
        if plain is None:
            return messages
        size = messages.offset + messages.size - plain.offset
        if size <= PLAIN_SEGMENT_BYTES:
            return plain._replace(size=size, raw_size=size,
                                  start_ns=min(plain.start_ns, messages.start_ns),
                                  end_ns=max(plain.end_ns, messages.end_ns))
        self._add_segment(plain)
        return messages

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
            self._segments[index] = segment.with_times(self._records(data).times_ns)

    def _define(self, data: bytes) -> None:
        """Take the schemas and channels out of a run of records."""
        unpack, head_size = self._RECORD.unpack_from, self._RECORD.size
        definitions = (self._SCHEMA, self._CHANNEL)
        position, size = 0, len(data)
        while position + head_size <= size:
            op, length = unpack(data, position)
            body = position + head_size
            position = body + length
            if op not in definitions or position > size:
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

    def _records(self, data: bytes) -> Records:
        """Return the messages, found from record to record by their lengths."""
        unpack, head_size = self._RECORD.unpack_from, self._RECORD.size
        position, size = 0, len(data)
        last = size - self._HEAD.itemsize
        edges: list[int] = []  # where each record starts and the last one ends
        add = edges.append
        while position <= last:
            op, length = unpack(data, position)
            add(position)
            position += head_size + length
            if not op:
                break
        if position <= size:
            add(position)  # otherwise the last record is cut off, and ends the one before it
        if position > size or position < size and not data[position]:
            self._warn_of_damage()
        places = np.fromiter(edges, np.int64, len(edges))
        lengths = np.diff(places) - self._HEAD.itemsize
        heads = self._heads(data, places[:-1])
        chosen = np.flatnonzero((heads['op'] == self._MESSAGE_OP) & (lengths >= 0))
        return Records(heads['log_time'][chosen], heads['channel'][chosen], Messages(
            data, places[chosen] + self._HEAD.itemsize, lengths[chosen]))

    def _heads(self, data: bytes, places: np.ndarray) -> np.ndarray:
        """Return the heads of the records that lie at some places, all as those of messages."""
        return bytes_at(data, places, self._HEAD.itemsize).view(self._HEAD)[:, 0]
