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
"""Reads the sqlite3 files of rosbag2."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
import contextlib
from pathlib import Path
import sqlite3
from typing import Any
from urllib.parse import quote

from ins_align.bag_files import (
    BagError, Block, MAX_MESSAGE_BYTES, Messages, ros2_type, Topic)
import numpy as np

MAGIC = b'SQLite format 3\x00'
BLOCK = 4096  # rows yielded at a time
FETCH = 256  # rows read at a time, so few that they stay in the processor's cache
# Python decodes sqlite's messages, which quote what is damaged, as UTF-8.
# What it has no memory for is a size that a damaged row claims.
_ERRORS = (sqlite3.Error, UnicodeDecodeError, MemoryError)

Row = tuple[Any, Any, Any]  # recorded time, topic's id, message


class SqliteFile:
    """A sqlite3 file of rosbag2."""

    _SELECT = ('SELECT timestamp, topic_id, CASE WHEN length(data) <= '
               f'{MAX_MESSAGE_BYTES} THEN data ELSE length(data) END ')

    def __init__(self, path: Path) -> None:
        self.warnings: list[str] = []
        self._path = path
        self._truncated = self._is_truncated()
        # Immutable: neither locks nor journals are written beside somebody's recording. Only one
        # that its recorder left behind has a write-ahead log that is worth reading.
        log = path.with_name(path.name + '-wal')
        options = 'mode=ro' if log.exists() and log.stat().st_size else 'mode=ro&immutable=1'
        try:
            self._database = sqlite3.connect(f'file:{quote(str(path.resolve()))}?{options}',
                                             uri=True, check_same_thread=False)
            self._open()
        except _ERRORS as error:
            raise BagError(f'{path.name} cannot be read: {error}') from None

    def _is_truncated(self) -> bool:
        with open(self._path, 'rb') as file:
            head = file.read(100)
        if len(head) < 100:
            raise BagError(f'{self._path.name} was cut off within its first 100 bytes')
        page_size = int.from_bytes(head[16:18], 'big')
        page_size = 65536 if page_size == 1 else page_size  # sqlite.org/fileformat.html, 1.3.2
        return self._path.stat().st_size < page_size * int.from_bytes(head[28:32], 'big')

    def _open(self) -> None:
        execute = self._database.execute
        execute('PRAGMA trusted_schema=OFF')
        if self._truncated:
            self._warn('was cut off: it is read as far as it goes')
            # The one way to make sqlite open a file that is shorter than its header says.
            execute('PRAGMA writable_schema=ON')
        tables = {name for name, in execute("SELECT name FROM sqlite_master WHERE type='table'")}
        if not {'topics', 'messages'} <= tables:
            raise BagError(f'{self._path.name} is a sqlite3 file but no recording: it has no '
                           'tables of topics and messages')
        self.topics: dict[int, Topic] = {
            key: Topic(str(name), ros2_type(str(msgtype)), str(encoding))
            for key, name, msgtype, encoding in execute(
                'SELECT id, name, type, serialization_format FROM topics')}
        self.start_ns: int | None = None
        self.end_ns: int | None = None
        if not self._truncated:
            try:
                self.start_ns = self._one_time('messages ORDER BY timestamp')
                self.end_ns = self._one_time('messages ORDER BY timestamp DESC')
                return
            except _ERRORS as error:
                self._warn_of_damage(error)
        self.start_ns = self._one_time('messages NOT INDEXED ORDER BY rowid')

    def _one_time(self, source: str) -> int | None:
        row = self._database.execute(
            f'SELECT timestamp FROM {source} LIMIT 1').fetchone()
        return row[0] if row and type(row[0]) is int else None

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def blocks(self, wanted: Mapping[int, int], start_ns: int, stop_ns: int) -> Iterator[Block]:
        """Yield messages many at a time, in the order of recorded time."""
        taken: list[tuple[int, int, bytes]] = []  # of the last stamp
        if self.end_ns is not None:
            places = ','.join('?' * len(wanted))
            query = (self._SELECT + f'FROM messages WHERE topic_id IN ({places})'
                     ' AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, rowid')
            try:
                cursor = self._database.execute(query, (*wanted, start_ns, stop_ns))
                while parts := self._fetched(cursor, wanted):
                    block = Block.joined([
                        part if isinstance(part, Block) else self._sound(part, wanted)
                        for part in parts])
                    if len(block.messages):
                        yield block
                        start_ns = int(block.times_ns[-1])
                        last = block.take(block.times_ns == start_ns)
                        taken = [record for record in taken if record[0] == start_ns]
                        taken += zip(last.times_ns.tolist(), last.topics.tolist(), last.messages)
                return
            except _ERRORS as error:
                self._warn_of_damage(error)
        rows: list[Row] = []
        for time_ns, topic, data, _ in self._rows_as_stored():
            if (topic in wanted and type(time_ns) is int and start_ns <= time_ns < stop_ns
                    and (time_ns, wanted[topic], data) not in taken):
                rows.append((time_ns, topic, data))
            if len(rows) == BLOCK:
                yield self._sound(rows, wanted)
                rows = []
        if rows:
            yield self._sound(rows, wanted)

    @staticmethod
    def _fetched(cursor: sqlite3.Cursor, wanted: Mapping[int, int]) -> list[Block | list[Row]]:
        """Read so many rows as a block has; as they are where some of them are no messages."""
        parts: list[Block | list[Row]] = []
        left = BLOCK
        while left > 0 and (rows := cursor.fetchmany(min(FETCH, left))):
            left -= len(rows)
            try:
                parts.append(_columns(rows, wanted))
            except (TypeError, KeyError):
                parts.append(rows)
        return parts

    def _rows_as_stored(self) -> Iterator[tuple[Any, Any, Any, int]]:
        """
        Yield rows in the order of recording, to the end or to the first page that is lost.

        The order of time would need the index. A page that is lost in part has rows numbered 0.
        """
        last = 0
        with contextlib.suppress(*_ERRORS):
            for row in self._database.execute(
                    self._SELECT + ', rowid FROM messages NOT INDEXED ORDER BY rowid'):
                if row[3] <= last:
                    return
                last = row[3]
                yield row

    def _sound(self, rows: list[Row], wanted: Mapping[int, int]) -> Block:
        """Leave out rows that are no messages; one that is too long is an error."""
        sound = []
        for time_ns, topic, data in rows:
            if type(data) is int and topic in wanted:
                raise BagError(f'{self._path.name} has a message of {data} bytes on '
                               f'{self.topics[topic].name}, where {MAX_MESSAGE_BYTES} are allowed')
            if type(data) is bytes and type(time_ns) is int and topic in wanted:
                sound.append((time_ns, topic, data))
            else:
                self._warn('has damaged messages, which are left out')
        return _columns(sound, wanted)

    def _warn_of_damage(self, error: Exception) -> None:
        self._warn(f'is damaged ({error}): it is read as far as it goes')

    def _warn(self, text: str) -> None:
        warning = f'{self._path.name} {text}'
        if warning not in self.warnings:
            self.warnings.append(warning)


def _columns(rows: list[Row], wanted: Mapping[int, int]) -> Block:
    """
    Put rows into columns.

    Raises
    ------
    TypeError
        If a time is no integer or a message no blob.
    KeyError
        If a topic is none that is wanted: a column of text finds '1' where 1 is looked for.

    """
    times_ns, topics, messages = zip(*rows) if rows else ((), (), ())
    return Block(np.frombuffer(array('q', times_ns), np.int64),
                 np.fromiter(map(wanted.__getitem__, topics), np.int64, len(rows)),
                 Messages.of(messages))
