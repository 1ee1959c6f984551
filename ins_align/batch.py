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
Replay of many recordings: one function a recording, in order.

Here, in other processes of this machine, or on the machines of a Dask cluster.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
import multiprocessing
import os
from pathlib import Path
import signal
import threading
from typing import Any

from ins_align.ahead import ProcessDied
from ins_align.config import Config
from ins_align.recordings import BagError
from ins_align.recordings.replay import replay
from ins_align.report import plot, save_figure, summary, write_whole

CONNECT_TIMEOUT = 10.0  # s, to the scheduler of a Dask cluster


class ClusterError(RuntimeError):
    """A Dask cluster that cannot be used; the text says why in one sentence."""


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


def process(task: Task, progress: Callable[[float], None] | None = None,
            read_ahead: bool = False) -> Outcome:
    """Replay one recording and write its files; whatever the user can put right is an error."""
    try:
        result = replay(task.bag, task.config, imu_topic=task.imu_topic, fix_topic=task.fix_topic,
                        velocity_topic=task.velocity_topic, start=task.start,
                        duration=task.duration, progress=progress, read_ahead=read_ahead)
    except BagError as error:
        return _failed(task, str(error))
    except ProcessDied:
        return _died(task)
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


def _died(task: Task) -> Outcome:
    return _failed(task, f'{task.bag}: a process died on the way, perhaps for want of memory; '
                         '--jobs 1 takes less')


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
        Processes at a time; 1: this one. Where there are two for each recording, one reads
        ahead.
    progress : callable
        Called with the number of recordings done, whole ones and parts.

    """
    if jobs == 1 or len(tasks) == 1:
        for index, task in enumerate(tasks):
            yield process(task, partial(_advance, progress, index), read_ahead=jobs > 1)
            progress(index + 1.0)
        return
    with ProcessPoolExecutor(min(jobs, len(tasks)), initializer=_leave_interrupts) as executor:
        try:
            futures = [executor.submit(process, task, read_ahead=jobs >= 2 * len(tasks))
                       for task in tasks]
            for index, (task, future) in enumerate(zip(tasks, futures)):
                try:
                    outcome = future.result()
                except BrokenProcessPool:
                    outcome = _died(task)
                yield outcome
                progress(index + 1.0)
        except BaseException:
            executor.shutdown(wait=False, cancel_futures=True)
            for child in multiprocessing.active_children():
                child.terminate()
            raise


def process_on_cluster(tasks: Sequence[Task], address: str, progress: Callable[[float], None],
                       ) -> Iterator[Outcome]:
    """
    Process tasks on a Dask cluster and yield their outcomes in the order of the tasks.

    The workers read and write the files: they need the same folders as this machine. What a
    worker that dies had in hand, another one does again; files are replaced as a whole.

    Parameters
    ----------
    tasks : sequence of Task
        One a recording.
    address : str
        Of the scheduler, ``tcp://host:8786``.
    progress : callable
        Called with the number of recordings done.

    Raises
    ------
    ClusterError
        If Dask is not installed or there is no cluster at this address.

    """
    try:
        from distributed import Client
    except ImportError:
        raise ClusterError('--dask needs Dask, which is not installed: '
                           'pip install distributed') from None
    try:
        # A client by itself waits for a stranger for ever.
        asyncio.run(asyncio.wait_for(_ask_scheduler(address), CONNECT_TIMEOUT))
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except Exception as error:  # strangers answer all kinds of things
        reason = str(error).partition('\n')[0] or type(error).__name__
        if isinstance(error, asyncio.TimeoutError):
            reason = f'nothing was heard for {CONNECT_TIMEOUT:g} s'
        elif isinstance(error, MemoryError):  # for what was taken for a size
            reason = 'something else does'
        elif isinstance(error, ValueError):
            reason += '; an address is like tcp://localhost:8786'
        raise ClusterError(f'no Dask scheduler answers at {address}: {reason}') from None
    with client:
        # Not pure: the same recording twice among the arguments is two tasks.
        futures = client.map(_process_there, [_absolute(task) for task in tasks], pure=False)
        try:
            for index, (task, future) in enumerate(zip(tasks, futures)):
                try:
                    outcome = _as_asked(future.result(), task)
                except Exception as error:  # whatever the cluster has run into
                    outcome = _failed(task, f'{task.bag}: the Dask cluster gave up on it: '
                                            f'{type(error).__name__}')
                yield outcome
                progress(index + 1.0)
        finally:
            client.cancel(futures)


async def _ask_scheduler(address: str) -> None:
    """Raise whatever tells that there is no scheduler."""
    from distributed import Security
    from distributed.comm import get_address_host_port
    from distributed.core import rpc

    get_address_host_port(address)  # there is a port
    arguments = Security().get_connection_args('client')
    async with rpc(address, connection_args=arguments) as scheduler:
        if 'workers' not in await scheduler.identity():
            raise OSError('it is no scheduler')


def _process_there(task: Task) -> Outcome:
    """Be the function that Dask calls, which knows of no progress."""
    return process(task)


def _absolute(task: Task) -> Task:
    """Name files as they are named from any folder."""
    return replace(task, bag=os.path.abspath(task.bag),
                   csv=task.csv and os.path.abspath(task.csv),
                   plot=task.plot and os.path.abspath(task.plot))


def _as_asked(outcome: Outcome, task: Task) -> Outcome:
    """Name the recording as the user has named it."""
    path = os.path.abspath(task.bag)
    if outcome.error:
        return _failed(task, outcome.error.replace(path, task.bag))
    return replace(outcome, json={**outcome.json, 'bag': task.bag},
                   summary=outcome.summary.replace(path, task.bag))


def _advance(progress: Callable[[float], None], done: int, part: float) -> None:
    progress(done + part)


def _leave_interrupts() -> None:
    """Let Ctrl-C go to the parent alone, which ends its children; end when it is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
