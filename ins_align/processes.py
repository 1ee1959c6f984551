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
"""Tasks in several processes, here or on a Dask cluster, and the threads that each may use."""

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
    Limit linear algebra libraries that are not loaded yet to one thread, if nothing else is set.

    The matrices here are small: more threads would only wait in busy loops.
    """
    for variable in VARIABLES:
        os.environ.setdefault(variable, '1')


def _serve_parent(folder: str) -> None:
    """Set up a worker: the parent handles Ctrl-C and removes the folder; end when it ends."""
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
    Call a function with each task in `jobs` processes; yield the results in order.

    The default is one process per processor; one job runs in this process. If the process of a
    task dies, the exception that says so takes the place of its result.
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
    Run tasks on a Dask cluster, otherwise as `run_all`; UsageError if no scheduler answers.

    The workers read and write the files, so they need the same folders as this machine. If a
    worker dies, another one repeats its tasks, which does no harm: files are written whole.
    """
    import asyncio

    from distributed import Client

    try:
        # A client waits for ever if something else than a scheduler answers.
        asyncio.run(asyncio.wait_for(_ask_scheduler(address), CONNECT_TIMEOUT))
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except Exception as error:  # another server may answer anything
        reason = f'{type(error).__name__}: {error}'.partition('\n')[0].rstrip(': ')
        raise UsageError(f'no Dask scheduler answers at {address} ({reason}); an address is '
                         'like tcp://localhost:8786') from None
    with client, client.get_executor() as executor:
        try:
            yield from _in_order(executor, function, tasks, Exception)
        finally:
            executor.shutdown(wait=False)       # cancels the remaining tasks


def _in_order(executor: Executor, function: Callable[[Any], T], tasks: Sequence[Any],
              lost: type[Exception]) -> Iterator[T | Exception]:
    """Yield the results of tasks, or the error where `lost` says that the worker is gone."""
    for future in [executor.submit(function, task) for task in tasks]:
        try:
            yield future.result()
        except lost as error:
            yield error


async def _ask_scheduler(address: str) -> None:
    """Raise an error of any kind unless a scheduler answers."""
    from distributed import Security
    from distributed.comm import get_address_host_port
    from distributed.core import rpc

    get_address_host_port(address)  # raises if there is no port
    arguments = Security().get_connection_args('client')
    async with rpc(address, connection_args=arguments) as scheduler:
        if 'workers' not in await scheduler.identity():
            raise OSError('it is no scheduler')
