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
"""Many tasks in processes, here or on a Dask cluster, and the threads that each may take."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
import multiprocessing
import os
import signal
import tempfile
import threading
from typing import Any, TypeVar

from ins_align.config import UsageError

T = TypeVar('T')
VARIABLES = ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'OMP_NUM_THREADS')
CONNECT_TIMEOUT = 10.0  # s, to the scheduler of a Dask cluster


def processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, 'sched_getaffinity'):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def keep_to_one() -> None:
    """
    Let linear algebra libraries that are not loaded yet keep to one thread, unless told otherwise.

    Small matrices, now and then: more threads would not share that work, they would wait for more
    of it in a busy loop and take the processor from who has some.
    """
    for variable in VARIABLES:
        os.environ.setdefault(variable, '1')


def _serve_parent(folder: str) -> None:
    """Leave Ctrl-C and a folder for what is unpacked to the parent; end when it is killed."""
    tempfile.tempdir = folder
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def run_all(function: Callable[[Any], T], tasks: Sequence[Any], jobs: int | None,
            ) -> Iterator[T | Exception]:
    """
    Do tasks in so many processes; yield in their order what a function returns of each.

    By default one process a processor; one job is this process. Where the process of a task is
    gone, the exception that says so takes the place of what it should have returned.
    """
    jobs = min(jobs or processors(), len(tasks))
    if jobs <= 1:
        yield from map(function, tasks)
        return
    with tempfile.TemporaryDirectory(prefix='ins_align_') as folder:
        executor = ProcessPoolExecutor(jobs, initializer=_serve_parent, initargs=(folder,))
        try:
            yield from _in_order(executor, function, tasks, BrokenProcessPool)
        except BaseException:
            for child in multiprocessing.active_children():
                child.terminate()
            raise
        finally:
            executor.shutdown()


def run_on_cluster(function: Callable[[Any], T], tasks: Sequence[Any], address: str,
                   ) -> Iterator[T | Exception]:
    """
    Do tasks on a Dask cluster, otherwise as `run_all`; a UsageError says that there is none.

    The workers read and write the files: they need the same folders as this machine. What a worker
    that dies had in hand, another one does again; files are replaced as a whole.
    """
    import asyncio

    from distributed import Client

    try:
        # A client by itself waits for a stranger for ever.
        asyncio.run(asyncio.wait_for(_ask_scheduler(address), CONNECT_TIMEOUT))
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except Exception as error:  # strangers answer all kinds of things
        reason = f'{type(error).__name__}: {error}'.partition('\n')[0].rstrip(': ')
        raise UsageError(f'no Dask scheduler answers at {address} ({reason}); an address is '
                         'like tcp://localhost:8786') from None
    with client, client.get_executor() as executor:
        try:
            yield from _in_order(executor, function, tasks, Exception)
        finally:
            executor.shutdown(wait=False)       # nobody asks for what has not begun


def _in_order(executor: Executor, function: Callable[[Any], T], tasks: Sequence[Any],
              lost: type[Exception]) -> Iterator[T | Exception]:
    """Yield what comes of tasks; `lost` says that whoever worked on one is gone."""
    for future in [executor.submit(function, task) for task in tasks]:
        try:
            yield future.result()
        except lost as error:
            yield error


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
