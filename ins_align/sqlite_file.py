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

from collections.abc import Collection, Iterator
import contextlib
from pathlib import Path
import sqlite3
from typing import Any
from urllib.parse import quote

from ins_align.bag_files import BagError, MAX_MESSAGE_BYTES, Records, ros2_type, Topic

MAGIC = b'SQLite format 3\x00'
BLOCK = 4096  # rows read at a time
# Python decodes sqlite's messages, which quote what is damaged, as UTF-8.
# What it has no memory for is a size that a damaged row claims.
_ERRORS = (sqlite3.Error, UnicodeDecodeError, MemoryError)


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

    def blocks(self, ids: Collection[int], start_ns: int, stop_ns: int) -> Iterator[Records]:
        """Yield records many at a time, in the order of recorded time."""
        taken: Records = []  # of the last stamp
        if self.end_ns is not None:
            query = (self._SELECT + f'FROM messages WHERE topic_id IN ({",".join("?" * len(ids))})'
                     ' AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, rowid')
            try:
                cursor = self._database.execute(query, (*ids, start_ns, stop_ns))
                while rows := cursor.fetchmany(BLOCK):
                    if records := self._sound(rows):
                        yield records
                        start_ns = records[-1][0]
                        taken = [record for record in (*taken, *records) if record[0] == start_ns]
                return
            except _ERRORS as error:
                self._warn_of_damage(error)
        records = []
        for row in self._rows_as_stored():
            record = row[:3]
            if (row[1] in ids and type(row[0]) is int and start_ns <= row[0] < stop_ns
                    and record not in taken):
                records.append(record)
            if len(records) == BLOCK:
                yield self._sound(records)
                records = []
        if records:
            yield self._sound(records)

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

    def _sound(self, rows: list[tuple[Any, Any, Any]]) -> Records:
        """Leave out rows that are no messages; one that is too long is an error."""
        times_ns, _, messages = zip(*rows)
        if set(map(type, times_ns)) == {int} and set(map(type, messages)) == {bytes}:
            return rows
        records = []
        for time_ns, topic, data in rows:
            if type(data) is int:
                raise BagError(f'{self._path.name} has a message of {data} bytes on '
                               f'{self.topics[topic].name}, where {MAX_MESSAGE_BYTES} are allowed')
            if type(data) is bytes and type(time_ns) is int:
                records.append((time_ns, topic, data))
            else:
                self._warn('has damaged messages, which are left out')
        return records

    def _warn_of_damage(self, error: Exception) -> None:
        self._warn(f'is damaged ({error}): it is read as far as it goes')

    def _warn(self, text: str) -> None:
        warning = f'{self._path.name} {text}'
        if warning not in self.warnings:
            self.warnings.append(warning)
