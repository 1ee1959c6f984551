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
"""Recordings: opened whatever their format, topics found by type, messages in recorded order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
import heapq
import itertools
from operator import itemgetter
import os
from pathlib import Path, PurePath
import re
import shutil
import tempfile
from typing import Any, NamedTuple

from ins_align import mcap_file, rosbag1_file, sqlite_file
from ins_align.bag_files import (
    BagError, Block, ChunkedFile, decompress, decompressor, INT64_MAX, MAX_MESSAGE_BYTES, Messages,
    one_line, PIECE_BYTES, Topic, ZSTD_MAGIC)
from ins_align.config import Config
from ins_align.decoding import deserialize
from ins_align.messages import MessageError, velocity_from_msg

IMU_TYPE = 'sensor_msgs/msg/Imu'
FIX_TYPE = 'sensor_msgs/msg/NavSatFix'
VELOCITY_TYPES = {
    'TwistWithCovarianceStamped': 'geometry_msgs/msg/TwistWithCovarianceStamped',
    'TwistStamped': 'geometry_msgs/msg/TwistStamped',
    'Odometry': 'nav_msgs/msg/Odometry',
}
REFERENCE_NAMESPACE = '/reference/'
REFERENCE_TOPIC = '/reference/imu'  # truth or the best that is known: to compare with, never input

STORAGE_NAME = re.compile(r'\.(mcap|db3|bag)(\.zstd)?$')  # of the files of a recording
LOOK_NS = 60_000_000_000  # of a recording in which topics that are left out are looked for
MERGED_BLOCK = 1024  # messages
MAX_METADATA_BYTES = 1 << 24
_MAGICS = (mcap_file.MAGIC, rosbag1_file.MAGIC, sqlite_file.MAGIC, ZSTD_MAGIC)
# A compressed file may unpack to this much, or to more at no more than this ratio.
UNPACKED_BYTES_FREE = 1 << 30
MAX_UNPACK_RATIO = 200


class Topics(NamedTuple):
    """The topics that an alignment reads, and the one that it is compared with."""

    imu: Topic
    fix: Topic
    velocity: Topic | None
    velocity_type: str | None  # as the parameter of that name has it
    reference: Topic | None


class Bag:
    """
    A recording: a rosbag2 directory, one of its files, or a ROS 1 bag.

    Raises
    ------
    BagError
        If it cannot be read at all. What can be read in part is, with `warnings`.

    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._warnings: list[str] = []
        with ExitStack() as stack:
            try:
                self._files = self._open_files(stack)
            except OSError as error:
                raise BagError(f'{self.path} cannot be read: {error.strerror}') from None
            self._stack = stack.pop_all()
        topics = {topic: None for file in self._files for topic in file.topics.values()
                  if topic.encoding in ('cdr', 'ros1')}
        self.topics: tuple[Topic, ...] = tuple(topics)

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def close(self) -> None:
        """Close the files and delete what was unpacked."""
        self._stack.close()

    @property
    def warnings(self) -> list[str]:
        """Sentences on what could not be read."""
        return [one_line(text) for text in
                self._warnings + [text for file in self._files for text in file.warnings]]

    @property
    def start_ns(self) -> int | None:
        """Time at which the first message of any topic was recorded; None: there is none."""
        return min((f.start_ns for f in self._files if f.start_ns is not None), default=None)

    @property
    def end_ns(self) -> int | None:
        """Time at which the last message was recorded, where that is known."""
        return max((f.end_ns for f in self._files if f.end_ns is not None), default=None)

    def blocks(self, topics: Sequence[Topic], start_ns: int | None = None,
               stop_ns: int | None = None) -> Iterator[Block]:
        """
        Yield the messages of some topics in recorded order, many at a time.

        Parameters
        ----------
        topics : sequence of Topic
            What to read.
        start_ns, stop_ns : int, optional
            First recorded time and the one to stop before.

        """
        start_ns = 0 if start_ns is None else min(start_ns, INT64_MAX)
        stop_ns = INT64_MAX if stop_ns is None else min(stop_ns, INT64_MAX)
        for group in self._overlapping():
            streams = [self._blocks_of(file, topics, start_ns, stop_ns) for file in group]
            if len(streams) == 1:
                yield from streams[0]
                continue
            merged = heapq.merge(*(_one_by_one(stream) for stream in streams), key=itemgetter(0))
            while records := list(itertools.islice(merged, MERGED_BLOCK)):
                yield Block.of(*zip(*records))

    def _overlapping(self) -> Iterator[list[ChunkedFile | sqlite_file.SqliteFile]]:
        """Put together the files that hold messages of the same time."""
        group: list[ChunkedFile | sqlite_file.SqliteFile] = []
        end_ns = 0
        for file in self._files:
            if group and (file.start_ns or 0) >= end_ns:
                yield group
                group = []
            group.append(file)
            end_ns = max(end_ns, file.end_ns or 0)
        yield group

    @staticmethod
    def _blocks_of(file: ChunkedFile | sqlite_file.SqliteFile, topics: Sequence[Topic],
                   start_ns: int, stop_ns: int) -> Iterator[Block]:
        wanted = {key: topics.index(topic) for key, topic in file.topics.items()
                  if topic in topics}
        if not wanted:
            return
        packed = None
        for block in file.blocks(wanted, start_ns, stop_ns):
            if not len(block.messages):
                continue
            if packed is None:  # rosbag2 compresses every message or none
                packed = (topics[block.topics[0]].encoding == 'cdr'
                          and block.messages[0].startswith(ZSTD_MAGIC))
            if packed:
                block = block._replace(messages=Messages.of(
                    [decompress(message, 'zstd', MAX_MESSAGE_BYTES)
                     for message in block.messages]))
            yield block

    def messages(self, topics: Sequence[Topic], start_ns: int | None = None,
                 stop_ns: int | None = None) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield topic, recorded time and message one by one, otherwise like `blocks`."""
        for time_ns, index, message in _one_by_one(self.blocks(topics, start_ns, stop_ns)):
            yield topics[index], time_ns, message

    def _open_files(self, stack: ExitStack) -> list[ChunkedFile | sqlite_file.SqliteFile]:
        """Open those files that can be; an error only if there is none."""
        files = []
        errors = []
        for path in self._storage_files():
            try:
                files.append(_open_file(_unpacked(path, stack, self._warnings)))
                stack.callback(files[-1].close)
            except BagError as error:
                errors.append(error)
        if not files:
            raise errors[0]
        self._warnings += [str(error) for error in errors]
        return sorted(files, key=lambda file: file.start_ns or 0)

    def _storage_files(self) -> list[Path]:
        """List the files of the recording."""
        if not self.path.exists():
            raise BagError(f'{self.path} does not exist')
        if self.path.is_file():
            return [self.path]
        if not self.path.is_dir():
            raise BagError(f'{self.path} is a pipe or a device, from which no recording can be '
                           'read: give a file')
        files = sorted(file for file in self.path.iterdir() if STORAGE_NAME.search(file.name))
        names = self._listed_names()
        if names is None:
            self._warnings.append(f'{self.path.name} has no readable metadata.yaml: '
                                  'all files in it are read')
        else:
            missing = [name for name in names if not (self.path / name).is_file()]
            files = [self.path / name for name in names if name not in missing]
            self._warnings += [f'{name} is missing from {self.path.name}' for name in missing]
        if not files:
            raise BagError(f'{self.path} holds no recording (.mcap, .db3 or .bag)')
        return files

    def _listed_names(self) -> list[str] | None:
        """Return the names of the files that metadata.yaml lists."""
        import yaml
        try:
            with open(self.path / 'metadata.yaml', 'rb') as file:
                text = file.read(MAX_METADATA_BYTES)
            loader = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
            listed = yaml.load(text, loader)['rosbag2_bagfile_information']['relative_file_paths']
            # The last part only: a recording names its own files, not others on this machine.
            names = [PurePath(name).name for name in listed]
        except (OSError, yaml.YAMLError, LookupError, TypeError, ValueError, RecursionError):
            return None
        return names or None

    def choose_topics(self, config: Config, imu: str | None = None, fix: str | None = None,
                      velocity: str | None = None) -> Topics:
        """
        Find the topics by message type, or by name where one is given.

        Velocities that cannot be used, or that are left out for one of another type, are among
        the `warnings` afterwards.

        Raises
        ------
        BagError
            If a topic is missing or there is more than one candidate: the text lists them and
            names the option that chooses one.

        """
        velocity_topic = velocity_type = None
        imu_topic = self._required('IMU', '--imu-topic', IMU_TYPE, imu)
        fix_topic = self._required('position', '--fix-topic', FIX_TYPE, fix)
        if velocity is not None or config.use_velocity is not False:
            preferred = VELOCITY_TYPES[config.velocity_type]
            others = [kind for kind in VELOCITY_TYPES.values() if kind != preferred]
            if velocity is None:
                velocity_topic = self._choose('velocity', '--velocity-topic', [preferred], None)
                if velocity_topic is not None:
                    self._warn_of_others(velocity_topic, others)
            if velocity_topic is None:
                kinds = others if velocity is None else [preferred, *others]
                velocity_topic = self._choose('velocity', '--velocity-topic', kinds, velocity)
            if velocity_topic is not None:
                velocity_type = velocity_topic.msgtype.rsplit('/', 1)[-1]
        reference = next((topic for topic in self.topics if topic.name == REFERENCE_TOPIC
                          and topic.msgtype == IMU_TYPE), None)
        return Topics(imu_topic, fix_topic, velocity_topic, velocity_type, reference)

    def _required(self, what: str, option: str, kind: str, name: str | None) -> Topic:
        topic = self._choose(what, option, [kind], name)
        if topic is None:
            raise BagError(f'{self.path} has no {what} topic ({kind.replace("/msg/", "/")}); '
                           f'{self._listing()}')
        return topic

    def _choose(self, what: str, option: str, kinds: list[str], name: str | None) -> Topic | None:
        if name is not None:
            topic = self._named(what, option, kinds, name)
            if what == 'velocity':
                self._measures(topic)  # for the warning: it is read as the user wishes
            return topic
        candidates = [topic for topic in self.topics if topic.msgtype in kinds
                      and REFERENCE_NAMESPACE not in topic.name]
        if what == 'velocity' or len(candidates) > 1:
            candidates = [topic for topic in candidates if self._measures(topic)]
        if len(candidates) > 1:
            names = ', '.join(sorted(topic.name for topic in candidates))
            raise BagError(f'{self.path} has more than one {what} topic ({names}): '
                           f'choose one with {option}')
        return candidates[0] if candidates else None

    def _named(self, what: str, option: str, kinds: list[str], name: str) -> Topic:
        full_name = '/' + name.strip('/')
        if REFERENCE_NAMESPACE in full_name:
            raise BagError(f'{option} {full_name} is a reference to compare with: '
                           'an alignment must not read it')
        topic = next((topic for topic in self.topics if topic.name == full_name), None)
        if topic is None:
            raise BagError(f'{self.path} has no topic {full_name}; {self._listing()}')
        if topic.msgtype not in kinds:
            wanted = ' or '.join(kind.replace('/msg/', '/') for kind in kinds)
            raise BagError(f'{option} {full_name} is of type '
                           f'{topic.msgtype.replace("/msg/", "/")}, but {what} needs {wanted}')
        return topic

    def _warn_of_others(self, velocity: Topic, kinds: list[str]) -> None:
        """Say which velocities of other types are left out."""
        # A topic without messages is found out by reading all of the recording: not for a warning.
        stop_ns = (self.start_ns or 0) + LOOK_NS
        names = sorted(_with_type(topic) for topic in self.topics if topic.msgtype in kinds
                       and REFERENCE_NAMESPACE not in topic.name
                       and self._measures(topic, stop_ns, say=False))
        if names:
            self._warn(f'the velocity is read from {_with_type(velocity)}, not from '
                       f'{", ".join(names)}: --velocity-topic chooses')

    def _measures(self, topic: Topic, stop_ns: int | None = None, say: bool = True) -> bool:
        """
        Look into a topic's first message for whether it can be what its type promises.

        With `say` there is a warning of a message that cannot be used.
        """
        if 'cmd' in topic.name.rsplit('/', 1)[-1]:
            return False  # /cmd_vel: a wish, not a measurement
        first = next(self.messages([topic], stop_ns=stop_ns), None)
        if first is None:
            return False
        try:
            message = deserialize(first[2], topic)
            if topic.msgtype == IMU_TYPE:
                # sensor_msgs/Imu: -1 marks what a sensor does not measure.
                return (message.angular_velocity_covariance[0] != -1.0
                        and message.linear_acceleration_covariance[0] != -1.0)
            if topic.msgtype in VELOCITY_TYPES.values():
                velocity_from_msg(message,
                                  Config(velocity_type=topic.msgtype.rsplit('/', 1)[-1]))
        except MessageError as error:
            if say:
                self._warn(f'{topic.name} cannot be used: {error}')
            return False
        return True

    def _warn(self, text: str) -> None:
        if text not in self._warnings:
            self._warnings.append(text)

    def _listing(self) -> str:
        names = sorted(topic.name for topic in self.topics)
        more = f' and {len(names) - 20} more' if len(names) > 20 else ''
        return f'it has {", ".join(names[:20])}{more}' if names else 'it has no topics'


def _one_by_one(blocks: Iterable[Block]) -> Iterator[tuple[int, int, bytes]]:
    for block in blocks:
        yield from zip(block.times_ns.tolist(), block.topics.tolist(), block.messages)


def _with_type(topic: Topic) -> str:
    return f'{topic.name} ({topic.msgtype.rsplit("/", 1)[-1]})'


def _unpacked(path: Path, stack: ExitStack, warnings: list[str]) -> Path:
    """Return the file itself or, where it is compressed as a whole, its unpacked copy."""
    with open(path, 'rb') as file:
        if file.read(4) != ZSTD_MAGIC:
            return path
        file.seek(0)
        size = path.stat().st_size
        limit = max(UNPACKED_BYTES_FREE, MAX_UNPACK_RATIO * size)
        folder = Path(tempfile.mkdtemp(prefix='ins_align_'))
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        name = path.stem if path.suffix in ('.zstd', '.zst') else path.name
        target = folder / name
        unpack = decompressor('zstd')
        total = 0
        with open(target, 'wb') as output:
            while not unpack.eof:
                feed = file.read(PIECE_BYTES) if unpack.needs_input else b''
                if unpack.needs_input and not feed:
                    warnings.append(f'{path.name} was cut off: it is read as far as it goes')
                    break
                try:
                    piece = unpack.decompress(feed, PIECE_BYTES * 16)
                except Exception:  # the library's own kind of error
                    warnings.append(f'{path.name} is damaged: it is read as far as it goes')
                    break
                total += len(piece)
                if total > limit:
                    raise BagError(f'{path.name} unpacks to more than {limit >> 20} MiB, '
                                   'which no recording of its size does')
                output.write(piece)
    return target


def begins_like_a_recording(path: Path) -> bool:
    """Whether there is a file that a recording may lie in, whole or damaged."""
    try:
        with open(path, 'rb') as file:
            return file.read(16).startswith(_MAGICS)
    except OSError:
        return False


def _open_file(path: Path) -> ChunkedFile | sqlite_file.SqliteFile:
    """Open one storage file, its format told by its first bytes."""
    with open(path, 'rb') as file:
        magic = file.read(16)
    if not magic:
        raise BagError(f'{path.name} is empty')
    if magic.startswith(mcap_file.MAGIC):
        return mcap_file.McapFile(path)
    if magic.startswith(rosbag1_file.MAGIC):
        return rosbag1_file.Rosbag1File(path)
    if magic == sqlite_file.MAGIC:
        return sqlite_file.SqliteFile(path)
    raise BagError(f'{path.name} is no recording: neither mcap, sqlite3 nor ROS 1 bag')
