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
"""Chooses the topics of a recording that an alignment reads, and reads their messages."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
import itertools
from operator import itemgetter
import os
from typing import Any, NamedTuple

from ins_align.config import Config
from ins_align.geometry.rotation import Transform
from ins_align.gnss.drivers import (
    DRIVER_TYPES, gnss_from_msg, imu_from_driver, INERTIAL_UNITS, LIVE_TYPES, NoTimeError,
    RECEIVERS, type_in_words, VELOCITY_TYPES)
from ins_align.gnss.messages import MessageError
from ins_align.mounting import find_mounting, FixedFrames, Mounting
from ins_align.recordings import BagError, listed, Topic
from ins_align.recordings.bag import Bag, Block
from ins_align.recordings.decode import (
    decode, decode_imu, deserialize, FIX_TYPE, Gnss, IMU_TYPE, ImuSamples, short_name, TF_TYPE,
    VECTOR_TYPE)
from ins_align.results import Severity
import numpy as np

UNSTAMPED_TYPES = ['geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistWithCovariance',
                   'geometry_msgs/msg/Vector3']
REFERENCE_NAMESPACE = '/reference/'
REFERENCE_TOPIC = '/reference/imu'  # the best known attitude: to compare with, never input
OPTIONS = {'IMU': '--imu-topic', 'position': '--fix-topic', 'velocity': '--velocity-topic'}


class Topics(NamedTuple):
    """The topics that an alignment reads, and the one that its result is compared with."""

    imu: Topic
    fix: Topic
    velocity: Topic | None
    reference: Topic | None
    base: Transform | None = None  # from the configured base to the IMU


class Part(NamedTuple):
    """Consecutive decoded messages of a recording."""

    topics: Topics
    config: Config  # as requested, with the lever arm of this recording
    imu: ImuSamples
    gnss: tuple[tuple[int, Gnss], ...]  # each with the number of IMU samples in `imu` before it
    reference: ImuSamples  # whose orientations are the reference
    done: float  # share of the recording that has been read at its end, 0 to 1
    warnings: tuple[str, ...]  # all until now


def read(path: str | os.PathLike[str], config: Config = Config(), imu_topic: str | None = None,
         fix_topic: str | None = None, velocity_topic: str | None = None,
         start: float | None = None, duration: float | None = None) -> Iterator[Part]:
    """
    Read a recording from `start` on for `duration`, s; `replay` describes the parameters.

    The last part has no messages but all warnings. Raises a BagError if the recording cannot be
    read, lacks a topic or has no message of these topics in the time that was asked for.
    """
    with Bag(path) as bag:
        try:
            topics = choose_topics(bag, config, imu_topic, fix_topic, velocity_topic)
        except BagError as error:
            reasons = f' ({bag.warnings[0]})' if bag.warnings else ''
            raise BagError(f'{error}{reasons}') from None
        mounting = _mounting(bag, topics, config)
        config, topics = mounting.config, topics._replace(base=mounting.base)
        wanted = list(dict.fromkeys(topic for topic in topics if isinstance(topic, Topic)))
        begin_ns = bag.start_ns + round((start or 0.0) * 1e9)
        stop_ns = None if duration is None else begin_ns + round(duration * 1e9)
        length_ns = (bag.end_ns if stop_ns is None else min(bag.end_ns, stop_ns)) - begin_ns
        empty = True
        for block in bag.blocks(wanted, None if start is None else begin_ns, stop_ns):
            done = float(np.clip((block.times_ns[-1] - begin_ns) / max(length_ns, 1), 0.0, 1.0))
            yield _decoded(block, wanted, topics, config, done, tuple(bag.warnings))
            empty = False
        if empty and (start, duration) != (None, None):
            from_s = start or 0.0
            window = (f'after {from_s:g} s' if duration is None
                      else f'between {from_s:g} s and {from_s + duration:g} s')
            raise BagError(f'{path} has no IMU or GNSS messages {window}: it is '
                           f'{(bag.end_ns - bag.start_ns) * 1e-9:.1f} s long')
        nothing = Block(np.zeros(0, np.int64), np.zeros(0, np.int64), [()] * len(wanted))
        yield _decoded(nothing, wanted, topics, config, 1.0, tuple(bag.warnings))


def _mounting(bag: Bag, topics: Topics, config: Config) -> Mounting:
    """Look up where antenna and base are in /tf_static."""
    frames = FixedFrames()
    static = [topic for topic in bag.topics
              if topic.msgtype == TF_TYPE and topic.name.endswith('/tf_static')]
    for block in bag.blocks(static):
        for topic, messages in zip(static, block.messages):
            for data in messages:
                with suppress(MessageError):
                    for transform in deserialize(data, topic).transforms:
                        frames.add(transform)
    found = find_mounting(frames.lookup, frame_id_of(bag, topics.imu),
                          frame_id_of(bag, topics.fix), config)
    if found.missing:
        raise BagError(f'{bag.path} has no transform {" and none ".join(found.missing)}: '
                       'lever_arm_from_tf and base_frame need /tf_static with them')
    for severity, text in found.words:
        if severity is Severity.WARNING:
            bag.warn(text)
    return found


def frame_id_of(bag: Bag, topic: Topic) -> str:
    """Return the first frame_id in the first messages of a topic; empty if there is none."""
    frame_ids = (str(message.header.frame_id) for message in _first_readable(bag, topic)
                 if hasattr(message, 'header'))
    return next(filter(None, frame_ids), '')


def _first_readable(bag: Bag, topic: Topic) -> Iterator[Any]:
    """Yield those of the first messages of a topic that can be deserialised."""
    for data in bag.first_messages(topic):
        with suppress(MessageError):
            yield deserialize(data, topic)


def _decoded(block: Block, wanted: list[Topic], topics: Topics, config: Config, done: float,
             warnings: tuple[str, ...]) -> Part:
    """Decode the messages of a block, those of each topic at once."""
    decoded = {topic: decode(messages, topic, config)
               for topic, messages in zip(wanted, block.messages)}
    samples = decoded[topics.imu]['imu']
    before = np.zeros(block.topics.size, np.int64)
    before[block.topics == wanted.index(topics.imu)] = samples.decoded
    before = np.cumsum(before)
    gnss: list[tuple[int, Gnss]] = []
    for kind, topic in (('fix', topics.fix), ('velocity', topics.velocity)):
        if topic is not None:
            places = np.flatnonzero(block.topics == wanted.index(topic))
            gnss += zip(places.tolist(), decoded[topic][kind])
    gnss.sort(key=itemgetter(0))
    reference = (decoded[topics.reference]['imu'] if topics.reference
                 else decode_imu((), topics.imu))
    return Part(topics, config, samples,
                tuple((int(before[place]), message) for place, message in gnss), reference, done,
                warnings)


def choose_topics(bag: Bag, config: Config, imu: str | None = None, fix: str | None = None,
                  velocity: str | None = None) -> Topics:
    """
    Choose the topics by message type, or by name if one is given.

    Warnings of velocities that cannot be used or are not chosen are added to `bag`. If a topic is
    missing or there is more than one candidate, a BagError lists the topics and names the option
    that chooses one.
    """
    imu_topic = _required(bag, 'IMU', ([IMU_TYPE], [*INERTIAL_UNITS]), imu)
    fix_topic = _required(bag, 'position', (
        ([FIX_TYPE], [*RECEIVERS]) if config.fix_type == 'NavSatFix' else
        ([LIVE_TYPES[config.fix_type]], [FIX_TYPE, *RECEIVERS])), fix)
    reference = next((topic for topic in bag.topics if topic.name == REFERENCE_TOPIC
                      and topic.msgtype == IMU_TYPE), None)
    return Topics(imu_topic, fix_topic, _velocity(bag, config, fix_topic, velocity), reference)


def _velocity(bag: Bag, config: Config, fix: Topic, name: str | None) -> Topic | None:
    """Choose the topic of the velocity, if there is one; warn of those that are left out."""
    if name is None and config.use_velocity is False:
        return None
    if name is None and fix.msgtype in RECEIVERS:
        return fix
    preferred = [each for each in VELOCITY_TYPES if short_name(each) == config.velocity_type]
    others = [each for each in VELOCITY_TYPES if each not in preferred]
    twists = [each for each in others if each != VECTOR_TYPE]
    topic = _choose(bag, 'velocity', (preferred, twists, [VECTOR_TYPE], [*RECEIVERS]), name,
                    config)
    if topic is None:
        for other in sorted(candidates(bag, UNSTAMPED_TYPES)):
            bag.warn(f'{other.name} cannot be used: {type_in_words(other.msgtype)} has no '
                     f'stamp; a velocity needs {_in_words(VELOCITY_TYPES)}')
    elif name is not None:
        _can_be_used(bag, topic, config)  # only to warn: it is read because the user wants it
    elif topic.msgtype in preferred:
        if names := sorted(f'{other.name} ({short_name(other.msgtype)})'
                           for other in candidates(bag, others)
                           if not doubt(bag, other)):
            bag.warn(f'the velocity is read from {topic.name} ({short_name(topic.msgtype)}), '
                     f'not from {", ".join(names)}: --velocity-topic chooses')
    return topic


def _required(bag: Bag, what: str, groups: Sequence[list[str]], name: str | None) -> Topic:
    """Choose a topic as `_choose` does; raise a BagError if there is none."""
    if topic := _choose(bag, what, groups, name):
        return topic
    raise BagError(f'{bag.path} has no {what} topic ({_in_words(groups[0])}); {_listing(bag)}')


def _choose(bag: Bag, what: str, groups: Sequence[list[str]], name: str | None,
            config: Config = Config()) -> Topic | None:
    """Return the topic with a name, or the only usable one of the first types that have any."""
    if name is not None:
        return _named(bag, what, list(dict.fromkeys(itertools.chain(*groups))), name)
    for types in groups:
        found = candidates(bag, types)
        # A single topic of a standard type is read even if its first messages raise doubts.
        if what == 'velocity' or len(found) > 1 or types[0] in DRIVER_TYPES:
            found = [topic for topic in found if _can_be_used(bag, topic, config)]
        if len(found) > 1:
            names = ', '.join(sorted(topic.name for topic in found))
            raise BagError(f'{bag.path} has more than one {what} topic ({names}): '
                           f'choose one with {OPTIONS[what]}')
        if found:
            return found[0]
    return None


def _named(bag: Bag, what: str, types: list[str], name: str) -> Topic:
    """Return the topic that the user named; raise a BagError if it cannot be read."""
    full_name = '/' + name.strip('/')
    if REFERENCE_NAMESPACE in full_name:
        raise BagError(f'{OPTIONS[what]} {full_name} is a reference to compare with: '
                       'an alignment must not read it')
    topic = next((topic for topic in bag.topics if topic.name == full_name), None)
    if topic is None:
        raise BagError(f'{bag.path} has no topic {full_name}; {_listing(bag)}')
    if topic.msgtype not in types:
        raise BagError(f'{OPTIONS[what]} {full_name} is of type {type_in_words(topic.msgtype)}, '
                       f'but {what} needs {_in_words(types)}')
    return topic


def candidates(bag: Bag, types: Collection[str]) -> list[Topic]:
    """Return the topics of some types, except those that are no measurement by their name."""
    found = []
    for topic in bag.topics:
        name = topic.name.lower()
        reference = REFERENCE_NAMESPACE in topic.name
        command = 'cmd' in topic.name.rsplit('/', 1)[-1]  # /cmd_vel: not a measurement
        # A vector may also be a magnetic field, an angular rate or a force.
        other = topic.msgtype == VECTOR_TYPE and ('vel' not in name or 'ang' in name)
        if topic.msgtype in types and not (reference or command or other):
            found.append(topic)
    return found


def doubt(bag: Bag, topic: Topic, config: Config = Config()) -> str:
    """Return why a topic is not what its type promises, judged by one of its messages, or ''."""
    first = bag.first_messages(topic)
    if not first:
        return 'it has no messages'
    try:
        message = next(_first_readable(bag, topic), None) or deserialize(first[0], topic)
        if topic.msgtype in INERTIAL_UNITS:
            imu_from_driver(message, topic.msgtype)
        elif topic.msgtype != IMU_TYPE:
            with suppress(NoTimeError):
                gnss_from_msg(message, topic.msgtype, config)
    except MessageError as error:
        return str(error)
    if topic.msgtype != IMU_TYPE:
        return ''
    unmeasured = ' and '.join(what for what, covariance in (
        ('angular rate', message.angular_velocity_covariance),
        ('specific force', message.linear_acceleration_covariance)) if covariance[0] == -1.0)
    return unmeasured and (f'its messages say that it does not measure {unmeasured} (covariance '
                           '-1; 0 says that it is not known)')


def _can_be_used(bag: Bag, topic: Topic, config: Config) -> bool:
    """Tell whether a topic is what its type promises by its first messages; warn if not."""
    if why := doubt(bag, topic, config):
        bag.warn(f'{topic.name} cannot be used: {why}')
    return not why


def _listing(bag: Bag) -> str:
    return 'it has ' + (listed(f'{topic.name} ({type_in_words(topic.msgtype)})'
                               for topic in bag.topics) or 'no topics')


def _in_words(types: Sequence[str]) -> str:
    return ' or '.join(map(type_in_words, types))
