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
"""Processes that work for this one, and the threads that each may take."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
import multiprocessing
import os
import signal
import threading
from typing import Any, TypeVar

T = TypeVar('T')
VARIABLES = ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'OMP_NUM_THREADS')
# What `run_ahead` produces before it is asked for; more would only take memory.
AHEAD = 3


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


def pool(workers: int) -> ProcessPoolExecutor:
    """Return an executor whose processes leave Ctrl-C to this one and end when it is killed."""
    return ProcessPoolExecutor(workers, initializer=_serve_parent)


def _serve_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def run_ahead(function: Callable[..., Generator[T, None, None]], *arguments: Any) -> Iterator[T]:
    """
    Yield what a generator yields in another process, which is some items ahead.

    Parameters
    ----------
    function : callable
        Gives the generator; it, the arguments and what is yielded must be picklable.
    *arguments
        Of the function.

    Raises
    ------
    BrokenProcessPool
        If that process is killed.
    Exception
        Whatever the generator raises.

    """
    with pool(1) as executor:
        executor.submit(_begin, function, arguments).result()
        waiting = deque(executor.submit(_next) for _ in range(AHEAD))
        try:
            while item := waiting.popleft().result():
                waiting.append(executor.submit(_next))
                yield item[0]
        finally:
            for future in waiting:
                future.cancel()
            with suppress(BrokenProcessPool):
                executor.submit(_end).result()


# In the other process: the generator.
_items: Generator[Any, None, None] = None  # type: ignore[assignment]


def _begin(function: Callable[..., Generator[Any, None, None]],
           arguments: tuple[Any, ...]) -> None:
    global _items
    _items = function(*arguments)


def _next() -> tuple[Any, ...]:
    """Return the next item; nothing at the end."""
    for item in _items:
        return (item,)
    return ()


def _end() -> None:
    _items.close()
