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
"""What an alignment wants of a recording: its messages, decoded many at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
from dataclasses import dataclass
from operator import itemgetter
import os
from typing import NamedTuple

from ins_align.bag_files import BagError, Block, Messages, Topic
from ins_align.bags import Bag, Topics
from ins_align.config import Config
from ins_align.decoding import (
    decode_fixes, decode_imu, decode_orientations, decode_velocities, ImuSamples, Orientations,
    Refused)
from ins_align.messages import Fix, Velocity
import numpy as np


@dataclass(frozen=True)
class Request:
    """
    What to read of which recording.

    Attributes
    ----------
    path : path
        rosbag2 directory or file, ROS 1 bag.
    config : Config
        ``velocity_type`` is used where the recording leaves a choice, as are the standard
        deviations of GNSS messages without any.
    imu_topic, fix_topic, velocity_topic : str, optional
        Where there is more than one candidate.
    start, duration : float, optional
        Part of the recording, seconds from its start, by recorded time.

    """

    path: str | os.PathLike[str]
    config: Config = Config()
    imu_topic: str | None = None
    fix_topic: str | None = None
    velocity_topic: str | None = None
    start: float | None = None
    duration: float | None = None


class Part(NamedTuple):
    """Consecutive messages of a recording, decoded."""

    topics: Topics
    config: Config  # as requested, for the type of velocity that was found
    imu: ImuSamples
    # Each GNSS message, and how many of the IMU samples come before it.
    gnss: tuple[tuple[int, Fix | Velocity | Refused], ...]
    orientations: Orientations
    done: float  # how much of the recording this ends at, 0 to 1
    warnings: tuple[str, ...]  # so far


def read(request: Request) -> Iterator[Part]:
    """
    Read a recording; the last part has no messages and all warnings.

    Raises
    ------
    BagError
        If the recording cannot be read or lacks a topic, or if a part was asked for that holds no
        message of these topics.

    """
    with Bag(request.path) as bag:
        try:
            topics = bag.choose_topics(request.config, request.imu_topic, request.fix_topic,
                                       request.velocity_topic)
        except BagError as error:
            reasons = f' ({bag.warnings[0]})' if bag.warnings else ''
            raise BagError(f'{error}{reasons}') from None
        config = request.config
        if topics.velocity_type is not None:
            config = dataclasses.replace(config, velocity_type=topics.velocity_type)
        wanted = tuple(topic for topic in (topics.imu, topics.fix, topics.velocity,
                                           topics.reference) if topic is not None)
        start_ns = (bag.start_ns or 0) + round((request.start or 0.0) * 1e9)
        stop_ns = (None if request.duration is None
                   else start_ns + round(request.duration * 1e9))
        end_ns = bag.end_ns or start_ns
        if stop_ns is not None:
            end_ns = min(end_ns, stop_ns)
        done = 0.0
        empty = request.start is not None or request.duration is not None
        try:
            for block in bag.blocks(wanted, start_ns, stop_ns):
                if end_ns > start_ns:
                    last_ns = int(block.times_ns[-1])
                    done = min(max((last_ns - start_ns) / (end_ns - start_ns), 0.0), 1.0)
                yield _decoded(block, wanted, topics, config, done, tuple(bag.warnings))
                empty = False
        except OSError as error:
            raise BagError(f'{request.path} cannot be read: {error.strerror}') from None
        if empty:
            raise BagError(f'{request.path} has no IMU or GNSS messages {_part(request, bag)}')
        yield _decoded(Block.of((), (), ()), wanted, topics, config, 1.0, tuple(bag.warnings))


def _part(request: Request, bag: Bag) -> str:
    """Say which part of a recording was asked for, and how long all of it is."""
    start = request.start or 0.0
    part = (f'after {start:g} s' if request.duration is None
            else f'between {start:g} s and {start + request.duration:g} s')
    if bag.start_ns is None or bag.end_ns is None:
        return part
    return f'{part}: it is {(bag.end_ns - bag.start_ns) * 1e-9:.1f} s long'


def _decoded(block: Block, wanted: Sequence[Topic], topics: Topics, config: Config, done: float,
             warnings: tuple[str, ...]) -> Part:
    """Decode a block, the messages of a topic all at once."""
    def places_and_messages(topic: Topic) -> tuple[np.ndarray, Messages]:
        places = np.flatnonzero(block.topics == wanted.index(topic))
        return places, block.messages.take(places)

    imu_places, messages = places_and_messages(topics.imu)
    samples = decode_imu(messages, topics.imu)
    before = np.zeros(len(block.messages), np.int64)
    before[imu_places] = samples.decoded
    before = np.cumsum(before)
    gnss: list[tuple[int, Fix | Velocity | Refused]] = []
    places, messages = places_and_messages(topics.fix)
    gnss += zip(places.tolist(), decode_fixes(messages, topics.fix))
    if topics.velocity is not None:
        places, messages = places_and_messages(topics.velocity)
        gnss += zip(places.tolist(), decode_velocities(messages, topics.velocity, config))
    gnss.sort(key=itemgetter(0))
    orientations = Messages.of(())
    if topics.reference is not None:
        _, orientations = places_and_messages(topics.reference)
    return Part(topics, config, samples,
                tuple((int(before[place]), message) for place, message in gnss),
                decode_orientations(orientations, topics.reference or topics.imu), done, warnings)
