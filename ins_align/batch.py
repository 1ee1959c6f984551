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
"""Replay of many recordings: one function a recording, here or in other processes, in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
import multiprocessing
from pathlib import Path
import signal
from typing import Any

from ins_align.bag_files import BagError
from ins_align.config import Config
from ins_align.replay import replay
from ins_align.report import plot, save_figure, summary, write_whole


@dataclass(frozen=True)
class Task:
    """One recording, how to read it and what to write."""

    bag: str
    config: Config
    imu_topic: str | None = None
    fix_topic: str | None = None
    velocity_topic: str | None = None
    start: float | None = None
    duration: float | None = None
    csv: str | None = None
    plot: str | None = None


@dataclass(frozen=True)
class Outcome:
    """What came of a task: either an error in one sentence or a result."""

    json: dict[str, Any]  # what --json writes of it
    summary: str = ''
    warnings: tuple[str, ...] = ()
    error: str = ''


def process(task: Task, progress: Callable[[float], None] | None = None) -> Outcome:
    """Replay one recording and write its files; whatever the user can put right is an error."""
    try:
        result = replay(task.bag, task.config, imu_topic=task.imu_topic, fix_topic=task.fix_topic,
                        velocity_topic=task.velocity_topic, start=task.start,
                        duration=task.duration, progress=progress)
    except BagError as error:
        return _failed(task, str(error))
    try:
        if task.csv:
            text = result.to_csv().encode()
            write_whole(task.csv, lambda file: file.write(text))
        if task.plot:
            figure, suffix = plot(result), Path(task.plot).suffix
            write_whole(task.plot, lambda file: save_figure(figure, file, suffix))
    except OSError as error:
        return _failed(task, f'cannot write {error.filename}: {error.strerror}')
    return Outcome(result.to_json(), summary(result), result.warnings)


def _failed(task: Task, error: str) -> Outcome:
    return Outcome({'bag': task.bag, 'aligned': False, 'error': error}, error=error)


def process_all(tasks: Sequence[Task], jobs: int, progress: Callable[[float], None],
                ) -> Iterator[Outcome]:
    """
    Process tasks, several at a time, and yield their outcomes in the order of the tasks.

    Parameters
    ----------
    tasks : sequence of Task
        One a recording.
    jobs : int
        Processes at a time; 1: this one.
    progress : callable
        Called with the number of recordings done, whole ones and parts.

    """
    if jobs == 1 or len(tasks) == 1:
        for index, task in enumerate(tasks):
            yield process(task, partial(_advance, progress, index))
            progress(index + 1.0)
        return
    with ProcessPoolExecutor(min(jobs, len(tasks)), initializer=_leave_interrupts) as executor:
        try:
            futures = [executor.submit(process, task) for task in tasks]
            for index, (task, future) in enumerate(zip(tasks, futures)):
                try:
                    outcome = future.result()
                except BrokenProcessPool:
                    outcome = _failed(task, f'{task.bag}: a process died on the way, perhaps for '
                                            'want of memory; --jobs 1 takes less')
                yield outcome
                progress(index + 1.0)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                child.terminate()
            raise


def _advance(progress: Callable[[float], None], done: int, part: float) -> None:
    progress(done + part)


def _leave_interrupts() -> None:
    """Let Ctrl-C go to the parent alone, which ends its children."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
