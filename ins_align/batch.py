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
from concurrent.futures import Executor
from concurrent.futures.process import BrokenProcessPool
import dataclasses
from dataclasses import dataclass
import multiprocessing
from pathlib import Path
from typing import Any

from ins_align.offline import replay
from ins_align.outputs import PAGE_SUFFIX, write_whole
from ins_align.page import page
from ins_align.processes import pool
from ins_align.recordings import BagError
from ins_align.recordings.reader import Request
from ins_align.recordings.results_bag import write_results
from ins_align.report import plot, save_figure, summary
from ins_align.results import Result

CONNECT_TIMEOUT = 10.0  # s, to the scheduler of a Dask cluster


class ClusterError(RuntimeError):
    """A Dask cluster that cannot be used; the text says why in one sentence."""


@dataclass(frozen=True)
class Task:
    """One recording, how to read it and what to write; paths that hold on every machine."""

    name: str  # of the recording, as it was given
    request: Request
    csv: str | None = None
    plot: str | None = None
    results: str | None = None


@dataclass(frozen=True)
class Outcome:
    """What came of a task: either an error in one sentence or a result."""

    json: dict[str, Any]  # what --json writes of it
    summary: str = ''
    warnings: tuple[str, ...] = ()
    error: str = ''


def process(task: Task, read_ahead: bool = False,
            progress: Callable[[float], None] | None = None) -> Outcome:
    """Replay one recording and write its files; whatever the user can put right is an error."""
    bag = str(task.request.path)
    try:
        result = replay(**vars(task.request), progress=progress, read_ahead=read_ahead)
    except BagError as error:
        return _failed(task, str(error).replace(bag, task.name))
    except BrokenProcessPool as error:
        return _lost(task, error)
    result = dataclasses.replace(result, bag=task.name)
    try:
        if task.csv:
            text = result.to_csv().encode()
            write_whole(task.csv, lambda file: file.write(text))
        if task.results:
            write_results(result, task.results)
        if task.plot:
            _write_picture(result, task.plot)
    except BagError as error:
        return _failed(task, str(error))
    except OSError as error:
        return _failed(task, f'cannot write {error.filename}: {error.strerror}')
    warnings = tuple(text.replace(bag, task.name) for text in result.warnings)
    return Outcome(result.to_json(), summary(result), warnings)


def _write_picture(result: Result, path: str) -> None:
    suffix = Path(path).suffix
    if suffix.lower() == PAGE_SUFFIX:
        html = page(result).encode()
        write_whole(path, lambda file: file.write(html))
    else:
        figure = plot(result)
        write_whole(path, lambda file: save_figure(figure, file, suffix))


def _lost(task: Task, error: Exception) -> Outcome:
    return _failed(task, f'{task.name}: a process died on the way ({type(error).__name__}), '
                         'perhaps for want of memory; --jobs 1 takes less')


def _failed(task: Task, error: str) -> Outcome:
    return Outcome({'bag': task.name, 'aligned': False, 'error': error}, error=error)


def process_all(tasks: Sequence[Task], jobs: int, progress: Callable[[float], None],
                ) -> Iterator[Outcome]:
    """
    Process tasks in so many processes, and yield their outcomes in the order of the tasks.

    One job is this process; where there are two for each recording, one of them reads ahead.
    `progress` is called with the number of recordings done, whole ones and parts.
    """
    if jobs == 1 or len(tasks) == 1:
        for index, task in enumerate(tasks):
            yield process(task, jobs > 1, lambda part: progress(index + part))
            progress(index + 1.0)
        return
    executor = pool(min(jobs, len(tasks)))
    try:
        yield from _outcomes(executor, tasks, progress, BrokenProcessPool,
                             read_ahead=jobs >= 2 * len(tasks))
    except BaseException:
        for child in multiprocessing.active_children():
            child.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def process_on_cluster(tasks: Sequence[Task], address: str, progress: Callable[[float], None],
                       ) -> Iterator[Outcome]:
    """
    Process tasks on a Dask cluster and yield their outcomes in the order of the tasks.

    The workers read and write the files: they need the same folders as this machine. What a
    worker that dies had in hand, another one does again; files are replaced as a whole.
    `progress` is called with the number of recordings done.

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
        reason = f'{type(error).__name__}: {error}'.partition('\n')[0].rstrip(': ')
        raise ClusterError(f'no Dask scheduler answers at {address} ({reason}); an address is '
                           'like tcp://localhost:8786') from None
    with client, client.get_executor() as executor:
        yield from _outcomes(executor, tasks, progress, Exception)


def _outcomes(executor: Executor, tasks: Sequence[Task], progress: Callable[[float], None],
              lost: type[Exception], **options: Any) -> Iterator[Outcome]:
    """Yield outcomes in order; `lost` says that whoever worked on a task is gone."""
    futures = [executor.submit(process, task, **options) for task in tasks]
    try:
        for index, (task, future) in enumerate(zip(tasks, futures)):
            try:
                outcome = future.result()
            except lost as error:
                outcome = _lost(task, error)
            yield outcome
            progress(index + 1.0)
    finally:
        for future in futures:
            future.cancel()


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
