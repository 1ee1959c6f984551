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

from collections.abc import Iterator, Mapping, Sequence
import itertools
import os
from pathlib import Path
from typing import Any, NamedTuple
import zlib

import numpy as np

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


class Messages:
    """
    Serialised messages that lie in one buffer, so that many are decoded at once.

    Parameters
    ----------
    buffer : bytes
        What they lie in.
    starts, lengths : ndarray, shape (N,)
        Where each one lies.

    """

    def __init__(self, buffer: bytes, starts: np.ndarray, lengths: np.ndarray) -> None:
        self._buffer = buffer
        self._starts = starts
        self.lengths = lengths

    @classmethod
    def of(cls, messages: Sequence[bytes]) -> Messages:
        """Put messages one behind the other."""
        lengths = np.fromiter(map(len, messages), np.int64, len(messages))
        return cls(b''.join(messages), np.cumsum(lengths) - lengths, lengths)

    @classmethod
    def joined(cls, parts: Sequence[Messages]) -> Messages:
        """Make one of several."""
        ends = itertools.accumulate((len(part._buffer) for part in parts), initial=0)
        return cls(b''.join(part._buffer for part in parts),
                   np.concatenate([part._starts + end for part, end in zip(parts, ends)]),
                   np.concatenate([part.lengths for part in parts]))

    def __len__(self) -> int:
        return self.lengths.size

    def __getitem__(self, index: int) -> bytes:
        start = int(self._starts[index])
        return self._buffer[start:start + int(self.lengths[index])]

    def __iter__(self) -> Iterator[bytes]:
        for start, length in zip(self._starts.tolist(), self.lengths.tolist()):
            yield self._buffer[start:start + length]

    def take(self, places: np.ndarray | slice) -> Messages:
        """Return some of them."""
        return Messages(self._buffer, self._starts[places], self.lengths[places])

    def alone(self) -> Messages:
        """Return them in a buffer that holds little else, which images may have filled."""
        return self if 2 * self.lengths.sum() > len(self._buffer) else Messages.of([*self])

    def rows(self, start: int, size: int) -> np.ndarray:
        """Return so many bytes from this place of each message on, which they all must have."""
        return bytes_at(self._buffer, self._starts + start, size)


def bytes_at(buffer: bytes, places: np.ndarray, size: int) -> np.ndarray:
    """Return the bytes that lie at some places of a buffer, shape (N, size)."""
    if not places.size:
        return np.zeros((0, size), np.uint8)
    # An item at every byte: taking some is a plain copy of each.
    items = np.ndarray((len(buffer) - size + 1,), f'V{size}', buffer, 0, (1,))
    return items[places].view(np.uint8).reshape(-1, size)


class Block(NamedTuple):
    """Consecutive messages, in columns."""

    times_ns: np.ndarray  # (N,) int64, recorded time
    topics: np.ndarray  # (N,) int64, index into the topics that were asked for
    messages: Messages

    @classmethod
    def of(cls, times_ns: Sequence[int], topics: Sequence[int],
           messages: Sequence[bytes]) -> Block:
        """Make columns of sequences."""
        return cls(np.array(times_ns, np.int64), np.array(topics, np.int64),
                   Messages.of(messages))

    @classmethod
    def joined(cls, parts: Sequence[Block]) -> Block:
        """Make one of several."""
        times_ns, topics, messages = zip(*parts)
        return cls(np.concatenate(times_ns), np.concatenate(topics), Messages.joined(messages))

    def take(self, places: np.ndarray | slice) -> Block:
        """Return some of the messages."""
        return Block(self.times_ns[places], self.topics[places], self.messages.take(places))


class Records(NamedTuple):
    """The messages of a stretch of a file, in columns, in the order in which they lie there."""

    times_ns: np.ndarray  # (N,) uint64, recorded time
    topics: np.ndarray  # (N,) the file's keys of their topics
    messages: Messages


class Segment(NamedTuple):
    """A stretch of a file that holds messages."""

    offset: int
    size: int  # on disk
    compression: str
    raw_size: int  # unpacked
    crc: int  # of the unpacked bytes, 0: none
    start_ns: int
    end_ns: int

    def with_times(self, times_ns: np.ndarray) -> Segment:
        """Return it with the times of its messages, shape (N,); one without any ends before 0."""
        if not times_ns.size:
            return self._replace(start_ns=0, end_ns=-1)
        return self._replace(start_ns=int(times_ns.min()), end_ns=int(times_ns.max()))


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

    def blocks(self, wanted: Mapping[int, int], start_ns: int, stop_ns: int) -> Iterator[Block]:
        """Yield messages many at a time, in the order of recorded time."""
        segments = [segment for segment in self._segments
                    if segment.end_ns >= start_ns and segment.start_ns < stop_ns]
        starts = [segment.start_ns for segment in segments[1:]] + [INT64_MAX]
        horizons = list(itertools.accumulate(reversed(starts), min))[::-1]
        pending: list[Block] = []
        held_bytes, earliest_ns = 0, INT64_MAX
        for segment, horizon in zip(segments, horizons):
            block = self._block(self._records(self._load(segment)), wanted, start_ns, stop_ns)
            if len(block.messages):
                pending.append(block)
                held_bytes += int(block.messages.lengths.sum())
                earliest_ns = min(earliest_ns, int(block.times_ns.min()))
            if earliest_ns >= horizon and held_bytes <= MAX_PENDING_BYTES:
                continue  # all of them wait, and are not joined time and again meanwhile
            block = Block.joined(pending)
            if (np.diff(block.times_ns) < 0).any():
                block = block.take(np.argsort(block.times_ns, kind='stable'))
            ready = int(np.searchsorted(block.times_ns, horizon))
            if block.messages.lengths[ready:].sum() > MAX_PENDING_BYTES:
                ready = len(block.messages)
            if ready:
                yield block.take(slice(ready))
            pending, held_bytes, earliest_ns = [], 0, INT64_MAX
            if ready < len(block.messages):
                later = block.take(slice(ready, None))
                pending = [later._replace(messages=later.messages.alone())]
                held_bytes = int(later.messages.lengths.sum())
                earliest_ns = int(later.times_ns[0])

    def _block(self, records: Records, wanted: Mapping[int, int], start_ns: int, stop_ns: int,
               ) -> Block:
        """Choose messages; one that is too long is an error."""
        keys = np.array(sorted(wanted))
        nearest = np.minimum(np.searchsorted(keys, records.topics), keys.size - 1)
        first, end = (np.uint64(max(time_ns, 0)) for time_ns in (start_ns, stop_ns))
        chosen = np.flatnonzero((keys[nearest] == records.topics)
                                & (first <= records.times_ns) & (records.times_ns < end))
        messages = records.messages.take(chosen)
        too_long = messages.lengths > MAX_MESSAGE_BYTES
        if too_long.any():
            index = int(np.argmax(too_long))
            raise BagError(f'{self._path.name} has a message of {messages.lengths[index]} bytes '
                           f'on {self.topics[int(records.topics[chosen[index]])].name}, where '
                           f'{MAX_MESSAGE_BYTES} are allowed')
        messages = messages.alone()
        indices = np.array([wanted[key] for key in keys.tolist()])
        return Block(records.times_ns[chosen].astype(np.int64), indices[nearest[chosen]], messages)

    def _walk(self) -> None:
        """Find segments and topics."""
        raise NotImplementedError

    def _records(self, data: bytes) -> Records:
        """Return the messages of a segment."""
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
