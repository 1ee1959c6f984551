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
What the readers of recordings share: chunks, sizes, decompression, the order of time.

Each reader goes through its file from the front with the format's own records and needs no index,
so that a recording that was cut off is read as far as it goes. Sizes that a file claims are
checked before memory is spent on them.
"""

from __future__ import annotations

import bisect
from collections.abc import Collection, Iterator
import itertools
from operator import itemgetter
import os
from pathlib import Path
from typing import Any, NamedTuple, NoReturn
import zlib

MAX_CHUNK_BYTES = 1 << 28  # of a chunk, unpacked
MAX_MESSAGE_BYTES = 1 << 16  # of an IMU or GNSS message, which has some hundred bytes
MAX_DEFINITION_BYTES = 1 << 24  # of a record that describes a topic
MAX_PENDING_BYTES = 1 << 28  # of messages held back to bring overlapping chunks into order
PIECE_BYTES = 1 << 14  # fed to a decompressor: what comes after damage in a piece is lost

INT64_MAX = (1 << 63) - 1
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'


def one_line(text: str) -> str:
    """Make text that may quote a recording fit for a line on a terminal."""
    return ''.join(letter if letter.isprintable() else '?' for letter in text[:1000])


class BagError(ValueError):
    """A recording that cannot be used; the text says why in one sentence."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class Topic(NamedTuple):
    """A topic of a recording."""

    name: str
    msgtype: str  # in ROS 2 notation: sensor_msgs/msg/Imu
    encoding: str  # of its messages: cdr or ros1


Records = list[tuple[int, int, bytes]]  # recorded time, topic's id, message


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
        """Time at which the first message was recorded."""
        # An mcap chunk without messages says that it starts and ends at 0.
        return min((segment.start_ns for segment in self._segments if segment.end_ns > 0),
                   default=None)

    @property
    def end_ns(self) -> int | None:
        """Time at which the last message was recorded."""
        return max((segment.end_ns for segment in self._segments if segment.end_ns > 0),
                   default=None)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def blocks(self, ids: Collection[int], start_ns: int, stop_ns: int) -> Iterator[Records]:
        """Yield records many at a time, in the order of recorded time."""
        by_time = itemgetter(0)
        segments = [segment for segment in self._segments
                    if segment.end_ns >= start_ns and segment.start_ns < stop_ns]
        starts = [segment.start_ns for segment in segments[1:]] + [INT64_MAX]
        horizons = list(itertools.accumulate(reversed(starts), min))[::-1]
        pending: Records = []
        for segment, horizon in zip(segments, horizons):
            pending += self._records(self._load(segment), ids, start_ns, stop_ns)
            pending.sort(key=by_time)
            ready = bisect.bisect_left(pending, horizon, key=by_time)
            held_back = sum(len(record[2]) for record in pending[ready:])
            if held_back > MAX_PENDING_BYTES or horizon == INT64_MAX:
                ready = len(pending)
            if ready:
                yield pending[:ready]
            del pending[:ready]

    def _walk(self) -> None:
        """Find segments and topics."""
        raise NotImplementedError

    def _records(self, data: bytes, ids: Collection[int], start_ns: int, stop_ns: int) -> Records:
        """Return the wanted records of a segment."""
        raise NotImplementedError

    def _warn(self, text: str) -> None:
        warning = f'{self._path.name} {text}'
        if warning not in self.warnings:
            self.warnings.append(warning)

    def _add_segment(self, segment: Segment) -> None:
        if segment.raw_size > MAX_CHUNK_BYTES:
            raise BagError(f'{self._path.name} claims a chunk of {segment.raw_size} bytes, '
                           f'where {MAX_CHUNK_BYTES >> 20} MiB are allowed')
        self._segments.append(segment)

    def _load(self, segment: Segment) -> bytes:
        self._file.seek(segment.offset)
        data = decompress(self._file.read(segment.size), segment.compression, segment.raw_size)
        if self._complete and (len(data) < segment.raw_size
                               or segment.crc and zlib.crc32(data) != segment.crc):
            self._warn_of_damage()
        return data

    def _warn_of_damage(self) -> None:
        if self._complete:  # otherwise it has been said that the recording ends early
            self._warn('has a damaged chunk: what could be read of it is used')

    def _refuse_message(self, size: int, topic: int) -> NoReturn:
        raise BagError(f'{self._path.name} has a message of {size} bytes on '
                       f'{self.topics[topic].name}, where {MAX_MESSAGE_BYTES} are allowed')
