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
Recordings: rosbag2 (mcap, sqlite3, compressed) and ROS 1, from file to arrays.

`bag` opens and lists them with rosbags, `salvage` reads an mcap that rosbags cannot open, `reader`
chooses the topics that an alignment reads, `decode` makes arrays of them. The limits here bound it
all, so that a damaged or hostile recording takes little memory.
"""

from collections.abc import Iterable
import importlib
import sys
from typing import Any, NamedTuple

MAX_CHUNK_BYTES = 1 << 28  # of a chunk, unpacked
MAX_HELD_BYTES = 1 << 30  # of chunks, unpacked, that have messages of the same time
MAX_MESSAGE_BYTES = 1 << 16  # of an IMU or GNSS message, which has some hundred bytes
MAX_DEFINITION_BYTES = 1 << 24  # of the description of a topic
MAX_TOPICS = 10_000
LISTED = 20  # names in a sentence
MAX_METADATA_BYTES = 1 << 24  # of metadata.yaml
# A file may unpack to this much, or to more at no more than this ratio.
UNPACKED_BYTES_FREE = 1 << 30
MAX_UNPACK_RATIO = 200

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
ZSTD_MODULE = 'compression.zstd' if sys.version_info >= (3, 14) else 'backports.zstd'
DECOMPRESSORS = {'bz2': ('bz2', 'BZ2Decompressor'), 'lz4': ('lz4.frame', 'LZ4FrameDecompressor'),
                 'zstd': (ZSTD_MODULE, 'ZstdDecompressor')}


def printable(line: str) -> str:
    """Make a line that may quote a recording fit for a terminal."""
    return ''.join(letter if letter.isprintable() else '?' for letter in line)


def one_line(text: str) -> str:
    """Make a text that may quote a recording a line that is not too long."""
    return printable(text[:1000])


def listed(names: Iterable[str]) -> str:
    """List names in the order of the alphabet, of many the first."""
    found = sorted(names)
    more = len(found) - LISTED
    return ', '.join(found[:LISTED]) + (f' and {more} more' if more > 0 else '')


class BagError(ValueError):
    """A recording that cannot be used; the text says why in one sentence."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class Topic(NamedTuple):
    """A topic of a recording."""

    name: str
    msgtype: str  # in ROS 2 notation: sensor_msgs/msg/Imu
    encoding: str  # of its messages: cdr or ros1
    definition: str = ''  # of the type, where the recording has it


def max_unpacked_bytes(size: int) -> int:
    """Return to how much a file of a size, bytes, may unpack."""
    return max(UNPACKED_BYTES_FREE, MAX_UNPACK_RATIO * size)


def unpack(data: bytes, compression: str, limit: int, damaged: bytes | None = None) -> bytes:
    """
    Unpack data; of those that were cut off the front, of those that are damaged what is given.

    A BagError says that there are more than `limit` bytes or the compression is not known. Damaged
    data raise errors of many kinds, if nothing is given for them.
    """
    if compression in ('', 'none'):
        return data
    if compression not in DECOMPRESSORS:
        raise BagError(f'is compressed with {compression[:40]!r}, which is not supported')
    module, name = DECOMPRESSORS[compression]
    decompressor: Any = getattr(importlib.import_module(module), name)()
    try:
        unpacked: bytes = decompressor.decompress(data, limit + 1)
    except Exception:  # each library has its own kind of error for damaged data
        if damaged is None:
            raise
        return damaged
    if len(unpacked) > limit:
        raise BagError(f'unpacks, in a part, to more than the {limit} bytes that are allowed or '
                       'claimed')
    return unpacked
