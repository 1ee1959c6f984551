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
"""What an alignment reads of a recording: its topics, chosen, and their messages, decoded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
import dataclasses
from dataclasses import dataclass
from operator import attrgetter, itemgetter
import os
from typing import NamedTuple

from ins_align.config import Config
from ins_align.geometry.transform import Transform
from ins_align.gnss.drivers import (
    DRIVER_TYPES, imu_from_driver, INERTIAL_UNITS, LIVE_TYPES, NoTimeError, receiver_from_msg,
    RECEIVERS, type_in_words)
from ins_align.gnss.messages import Fix, MessageError, Velocity, velocity_from_msg
from ins_align.mounting import find_mounting, FixedFrames, Mounting
from ins_align.recordings import BagError, Topic
from ins_align.recordings.bag import Bag, Block
from ins_align.recordings.decode import (
    decode_by_kind, decode_imu_topic, decode_orientations, deserialize, GNSS_TYPES, IMU_TYPE,
    ImuSamples, Orientations, Refused)
from ins_align.results import Severity
import numpy as np

FIX_TYPES, VELOCITY_TYPES = ([name for name, fields in GNSS_TYPES.items() if fields.kind == kind]
                             for kind in ('fix', 'velocity'))
VECTOR_TYPE = 'geometry_msgs/msg/Vector3Stamped'  # of a velocity or of anything else
TF_TYPE = 'tf2_msgs/msg/TFMessage'
UNSTAMPED_TYPES = ['geometry_msgs/msg/Twist', 'geometry_msgs/msg/TwistWithCovariance',
                   'geometry_msgs/msg/Vector3']
REFERENCE_NAMESPACE = '/reference/'
REFERENCE_TOPIC = '/reference/imu'  # truth or the best that is known: to compare with, never input
OPTIONS = {'IMU': '--imu-topic', 'position': '--fix-topic', 'velocity': '--velocity-topic'}
LISTED_TOPICS = 20  # in an error


class Topics(NamedTuple):
    """The topics that an alignment reads, and the one that it is compared with."""

    imu: Topic
    fix: Topic
    velocity: Topic | None
    velocity_type: str | None  # as the parameter of that name has it
    reference: Topic | None
    base: Transform | None = None  # from the configured base to the IMU


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
            topics = choose_topics(bag, request.config, request.imu_topic, request.fix_topic,
                                   request.velocity_topic)
        except BagError as error:
            reasons = f' ({bag.warnings[0]})' if bag.warnings else ''
            raise BagError(f'{error}{reasons}') from None
        config = request.config
        if topics.velocity_type is not None:
            config = dataclasses.replace(config, velocity_type=topics.velocity_type)
        mounting = _mounting(bag, topics, config)
        config, topics = mounting.config, topics._replace(base=mounting.base)
        start_ns = (bag.start_ns or 0) + round((request.start or 0.0) * 1e9)
        stop_ns = (None if request.duration is None
                   else start_ns + round(request.duration * 1e9))
        end_ns = bag.end_ns or start_ns
        if stop_ns is not None:
            end_ns = min(end_ns, stop_ns)
        done = 0.0
        empty = request.start is not None or request.duration is not None
        wanted = list(dict.fromkeys(topic for topic in topics if isinstance(topic, Topic)))
        for block in bag.blocks(wanted, None if request.start is None else start_ns, stop_ns):
            if end_ns > start_ns:
                last_ns = int(block.times_ns[-1])
                done = min(max((last_ns - start_ns) / (end_ns - start_ns), 0.0), 1.0)
            yield _decoded(block, wanted, topics, config, done, tuple(bag.warnings))
            empty = False
        if empty:
            raise BagError(f'{request.path} has no IMU or GNSS messages {_part(request, bag)}')
        nothing = Block(np.zeros(0, np.int64), np.zeros(0, np.int64), [()] * len(wanted))
        yield _decoded(nothing, wanted, topics, config, 1.0, tuple(bag.warnings))


def _mounting(bag: Bag, topics: Topics, config: Config) -> Mounting:
    """Look up in /tf_static where antenna and base are."""
    frames = FixedFrames()
    static = [topic for topic in bag.topics
              if topic.msgtype == TF_TYPE and topic.name.endswith('/tf_static')]
    for block in bag.blocks(static):
        for topic, messages in zip(static, block.messages):
            for data in messages:
                with suppress(MessageError):
                    for transform in deserialize(data, topic).transforms:
                        frames.add(transform)
    found = find_mounting(frames.lookup, _frame_id(bag, topics.imu), _frame_id(bag, topics.fix),
                          config)
    if found.missing and (config.lever_arm_from_tf is True or config.base_frame):
        raise BagError(f'{bag.path} has no transform {" and none ".join(found.missing)}: '
                       'lever_arm_from_tf and base_frame need /tf_static with them')
    for severity, text in found.words:
        if severity is Severity.WARNING:
            bag.warn(text)
    return found


def _frame_id(bag: Bag, topic: Topic) -> str:
    """Return the frame_id of the first message of a topic, empty where it has none."""
    data = bag.first_message(topic)
    with suppress(MessageError, AttributeError):
        return str(deserialize(data or b'', topic).header.frame_id)
    return ''


def _part(request: Request, bag: Bag) -> str:
    """Say which part of a recording was asked for, and how long all of it is."""
    start = request.start or 0.0
    part = (f'after {start:g} s' if request.duration is None
            else f'between {start:g} s and {start + request.duration:g} s')
    if bag.start_ns is None or bag.end_ns is None:
        return part
    return f'{part}: it is {(bag.end_ns - bag.start_ns) * 1e-9:.1f} s long'


def _decoded(block: Block, wanted: list[Topic], topics: Topics, config: Config, done: float,
             warnings: tuple[str, ...]) -> Part:
    """Decode a block, the messages of a topic all at once."""
    gnss: list[tuple[int, Fix | Velocity | Refused]] = []
    orientations: Sequence[bytes] = ()
    for number, (topic, messages) in enumerate(zip(wanted, block.messages)):
        places = np.flatnonzero(block.topics == number)
        if topic is topics.imu:
            samples = decode_imu_topic(messages, topic)
            before = np.zeros(block.topics.size, np.int64)
            before[places] = samples.decoded
            before = np.cumsum(before)
        elif topic is topics.reference:
            orientations = messages
        kinds = [kind for kind, source in (('fix', topics.fix), ('velocity', topics.velocity))
                 if topic is source]
        if kinds:
            found = decode_by_kind(messages, topic, config)
            for kind in kinds:
                gnss += zip(places.tolist(), found[kind])
    gnss.sort(key=itemgetter(0))
    return Part(topics, config, samples,
                tuple((int(before[place]), message) for place, message in gnss),
                decode_orientations(orientations, (topics.reference or topics.imu).encoding),
                done, warnings)


def choose_topics(bag: Bag, config: Config, imu: str | None = None, fix: str | None = None,
                  velocity: str | None = None) -> Topics:
    """
    Find the topics by message type, or by name where one is given.

    Velocities that cannot be used, or that are left out for one of another type, are among the
    warnings of `bag` afterwards.

    Raises
    ------
    BagError
        If a topic is missing or there is more than one candidate: the text lists them and names
        the option that chooses one.

    """
    imu_topic = _required(bag, 'IMU', [IMU_TYPE], [*INERTIAL_UNITS], imu)
    fix_topic = _required(bag, 'position', *(
        (FIX_TYPES, [*RECEIVERS]) if config.fix_type == 'NavSatFix' else
        ([LIVE_TYPES[config.fix_type]], [*FIX_TYPES, *RECEIVERS])), fix)
    velocity_topic = None
    if velocity is not None:
        velocity_topic = _named(bag, 'velocity', [*VELOCITY_TYPES, *RECEIVERS], velocity)
        _measures(bag, velocity_topic, config)  # for the warning: it is read as the user wishes
    elif config.use_velocity is not False and fix_topic.msgtype in RECEIVERS:
        velocity_topic = fix_topic
    elif config.use_velocity is not False:
        preferred = [name for name in VELOCITY_TYPES if _short(name) == config.velocity_type]
        others = [name for name in VELOCITY_TYPES if name not in preferred]
        twists = [name for name in others if name != VECTOR_TYPE]
        velocity_topic = _only(bag, 'velocity', preferred, config)
        if velocity_topic is not None:
            _warn_of_others(bag, velocity_topic, others)
        else:
            velocity_topic = (_only(bag, 'velocity', twists, config)
                              or _only(bag, 'velocity', [VECTOR_TYPE], config)
                              or _only(bag, 'velocity', [*RECEIVERS], config))
        if velocity_topic is None:
            _warn_of_unstamped(bag)
    reference = next((topic for topic in bag.topics if topic.name == REFERENCE_TOPIC
                      and topic.msgtype == IMU_TYPE), None)
    return Topics(imu_topic, fix_topic, velocity_topic,
                  _short(velocity_topic.msgtype) if velocity_topic is not None
                  and velocity_topic.msgtype in VELOCITY_TYPES else None, reference)


def _required(bag: Bag, what: str, types: list[str], others: list[str], name: str | None,
              ) -> Topic:
    """Return the one topic of some types, or of others where there is none of these."""
    topic = (_only(bag, what, types) or _only(bag, what, others) if name is None
             else _named(bag, what, [*types, *others], name))
    if topic is None:
        raise BagError(f'{bag.path} has no {what} topic ({_in_words(types)}); {_listing(bag)}')
    return topic


def _candidates(bag: Bag, types: list[str]) -> list[Topic]:
    return [topic for topic in bag.topics if topic.msgtype in types
            and REFERENCE_NAMESPACE not in topic.name]


def _only(bag: Bag, what: str, types: list[str], config: Config = Config()) -> Topic | None:
    """Return the one topic of some types; where there are more the one that measures."""
    candidates = _candidates(bag, types)
    if what == 'velocity' or len(candidates) > 1 or types[0] in DRIVER_TYPES:
        candidates = [topic for topic in candidates if _measures(bag, topic, config)]
    if len(candidates) > 1:
        names = ', '.join(sorted(topic.name for topic in candidates))
        raise BagError(f'{bag.path} has more than one {what} topic ({names}): '
                       f'choose one with {OPTIONS[what]}')
    return candidates[0] if candidates else None


def _named(bag: Bag, what: str, types: list[str], name: str) -> Topic:
    full_name = '/' + name.strip('/')
    if REFERENCE_NAMESPACE in full_name:
        raise BagError(f'{OPTIONS[what]} {full_name} is a reference to compare with: '
                       'an alignment must not read it')
    topic = next((topic for topic in bag.topics if topic.name == full_name), None)
    if topic is None:
        raise BagError(f'{bag.path} has no topic {full_name}; {_listing(bag)}')
    if topic.msgtype not in types:
        raise BagError(f'{OPTIONS[what]} {full_name} is of type {_in_words([topic.msgtype])}, '
                       f'but {what} needs {_in_words(types)}')
    return topic


def _warn_of_others(bag: Bag, velocity: Topic, types: list[str]) -> None:
    """Say which velocities of other types are left out."""
    names = sorted(f'{topic.name} ({_short(topic.msgtype)})' for topic in _candidates(bag, types)
                   if _measures(bag, topic, say=False))
    if names:
        bag.warn(f'the velocity is read from {velocity.name} ({_short(velocity.msgtype)}), not '
                 f'from {", ".join(names)}: --velocity-topic chooses')


def _warn_of_unstamped(bag: Bag) -> None:
    """Say which topics may be velocities, of types that an alignment cannot use."""
    for topic in sorted(_candidates(bag, UNSTAMPED_TYPES), key=attrgetter('name')):
        if not is_command(topic):
            bag.warn(f'{topic.name} cannot be used: {_in_words([topic.msgtype])} has no stamp; a '
                     f'velocity needs {_in_words(VELOCITY_TYPES)}')


def may_be_velocity(topic: Topic) -> bool:
    """Whether the name of a topic is no other vector's: a field, an angular rate, a force."""
    name = topic.name.lower()
    return topic.msgtype != VECTOR_TYPE or ('vel' in name and 'ang' not in name)


def is_command(topic: Topic) -> bool:
    """Whether a topic is a wish, not a measurement: /cmd_vel."""
    return 'cmd' in topic.name.rsplit('/', 1)[-1]


def _measures(bag: Bag, topic: Topic, config: Config = Config(), say: bool = True) -> bool:
    """
    Look into a topic's first message for whether it can be what its type promises.

    With `say` there is a warning of a message that cannot be used.
    """
    if is_command(topic) or not may_be_velocity(topic):
        return False
    data = bag.first_message(topic)
    if data is None:
        return False
    try:
        message = deserialize(data, topic)
        if topic.msgtype in RECEIVERS:
            with suppress(NoTimeError):
                receiver_from_msg(message, topic.msgtype, config)
        elif topic.msgtype in INERTIAL_UNITS:
            imu_from_driver(message, topic.msgtype)
        elif topic.msgtype in VELOCITY_TYPES:
            velocity_from_msg(message, dataclasses.replace(
                config, velocity_type=_short(topic.msgtype)))
    except MessageError as error:
        if say:
            bag.warn(f'{topic.name} cannot be used: {error}')
        return False
    # sensor_msgs/Imu: -1 marks what a sensor does not measure.
    return topic.msgtype != IMU_TYPE or (message.angular_velocity_covariance[0] != -1.0
                                         and message.linear_acceleration_covariance[0] != -1.0)


def _listing(bag: Bag) -> str:
    names = sorted(topic.name for topic in bag.topics)
    more = len(names) - LISTED_TOPICS
    return ('it has no topics' if not names else
            f'it has {", ".join(names[:LISTED_TOPICS])}{f" and {more} more" if more > 0 else ""}')


def _short(msgtype: str) -> str:
    return msgtype.rsplit('/', 1)[-1]


def _in_words(types: list[str]) -> str:
    return ' or '.join(map(type_in_words, types))
