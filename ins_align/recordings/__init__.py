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
chooses the topics that an alignment reads, `decode` makes arrays of them, `limits` bounds it all.
"""

from typing import NamedTuple


def printable(line: str) -> str:
    """Make a line that may quote a recording fit for a terminal."""
    return ''.join(letter if letter.isprintable() else '?' for letter in line)


def one_line(text: str) -> str:
    """Make a text that may quote a recording a line that is not too long."""
    return printable(text[:1000])


class BagError(ValueError):
    """A recording that cannot be used; the text says why in one sentence."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class Topic(NamedTuple):
    """A topic of a recording."""

    name: str
    msgtype: str  # in ROS 2 notation: sensor_msgs/msg/Imu
    encoding: str  # of its messages: cdr or ros1
    message_count: int = 0  # as the recording says
    definition: str = ''  # of the type, where the recording has it
