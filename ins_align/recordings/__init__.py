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

`bag` opens recordings with rosbags, `salvage` reads an mcap file that rosbags cannot open,
`reader` chooses the topics that an alignment reads, `decode` turns messages into arrays. The
limits here keep a damaged or hostile recording from taking much memory.
"""

from collections.abc import Iterable
import importlib
import sys
from typing import Any, NamedTuple

MAX_CHUNK_BYTES = 1 << 28  # of one chunk, unpacked
MAX_HELD_BYTES = 1 << 30  # of all chunks, unpacked, whose times overlap
MAX_MESSAGE_BYTES = 1 << 16  # of an IMU or GNSS message, which has some hundred bytes
MAX_TF_BYTES = 1 << 20  # of a message of TF, which has some hundred bytes for each frame
MAX_DEFINITION_BYTES = 1 << 24  # of a schema or channel record of an mcap file
MAX_TOPICS = 10_000
MAX_LISTED = 20  # names in a sentence
MAX_METADATA_BYTES = 1 << 24  # of metadata.yaml
# A file may unpack to the larger of this size and this multiple of its own size.
UNPACKED_BYTES_FREE = 1 << 30
MAX_UNPACK_RATIO = 200

ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
ZSTD_MODULE = 'compression.zstd' if sys.version_info >= (3, 14) else 'backports.zstd'
DECOMPRESSORS = {'bz2': ('bz2', 'BZ2Decompressor'), 'lz4': ('lz4.frame', 'LZ4FrameDecompressor'),
                 'zstd': (ZSTD_MODULE, 'ZstdDecompressor')}


def printable(line: str) -> str:
    """Replace characters that a terminal should not get; the line may quote a recording."""
    return ''.join(letter if letter.isprintable() else '?' for letter in line)


def one_line(text: str) -> str:
    """Turn a text that may quote a recording into one printable line of bounded length."""
    return printable(text[:1000])


def listed(names: Iterable[str]) -> str:
    """List names in alphabetical order; of many, only the first ones and how many follow."""
    found = sorted(names)
    more = len(found) - MAX_LISTED
    return ', '.join(found[:MAX_LISTED]) + (f' and {more} more' if more > 0 else '')


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
    """Return how many bytes a file of `size` bytes may unpack to."""
    return max(UNPACKED_BYTES_FREE, MAX_UNPACK_RATIO * size)


def max_message_bytes(msgtype: str) -> int:
    """Return how many bytes a message of a type may have."""
    return MAX_TF_BYTES if msgtype.endswith('/TFMessage') else MAX_MESSAGE_BYTES


def unpack(data: bytes, compression: str, limit: int, damaged: bytes | None = None) -> bytes:
    """
    Unpack data, as far as they go; return `damaged` for damaged data.

    Raises a BagError if they unpack to more than `limit` bytes or the compression is not
    supported, and where `damaged` is None the error of the library, of whatever type.
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
