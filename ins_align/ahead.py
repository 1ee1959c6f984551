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
A generator that runs in another process, ahead of who uses what it yields.

What is on its way waits in a pipe, so that memory stays bounded however slow the other end is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import multiprocessing
from multiprocessing.connection import Connection
import pickle
import signal
import traceback
from typing import Any, TypeVar

T = TypeVar('T')
# Of the pipe, where the system lets one choose: what the one process works on while the other is
# at something that takes longer.
PIPE_BYTES = 1 << 20


class ProcessDied(RuntimeError):
    """The other process ended before the generator did."""


def run_ahead(function: Callable[..., Iterator[T]], *arguments: Any) -> Iterator[T]:
    """
    Yield what a generator yields in another process.

    Parameters
    ----------
    function : callable
        Gives the generator; it, the arguments and what is yielded must be picklable.
    *arguments
        Of the function.

    Raises
    ------
    ProcessDied
        If that process is killed.
    Exception
        Whatever the generator raises; what cannot be pickled as a RuntimeError.

    """
    ours, theirs = multiprocessing.Pipe(duplex=False)
    _widen(theirs)
    process = multiprocessing.Process(target=_produce, args=(ours, theirs, function, arguments),
                                      daemon=True)
    process.start()
    theirs.close()
    try:
        while True:
            try:
                item, error, is_last = pickle.loads(ours.recv_bytes())
            except EOFError:
                process.join()
                raise ProcessDied(f'exit status {process.exitcode}') from None
            if error is not None:
                raise error
            if is_last:
                return
            yield item
    finally:
        ours.close()
        process.terminate()
        process.join()


def _produce(unused: Connection, pipe: Connection, function: Callable[..., Iterator[Any]],
             arguments: tuple[Any, ...]) -> None:
    """Send (item, error, whether it was the last)."""
    # An interruption is for the process that was asked; this one ends when nobody reads any more.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    unused.close()
    try:
        try:
            for item in function(*arguments):
                pipe.send_bytes(pickle.dumps((item, None, False), pickle.HIGHEST_PROTOCOL))
            message = pickle.dumps((None, None, True))
        except BrokenPipeError:
            raise
        except Exception as error:
            try:
                message = pickle.dumps((None, error, True))
                pickle.loads(message)               # not every exception can be made again
            except Exception:
                message = pickle.dumps((None, RuntimeError(traceback.format_exc()), True))
        pipe.send_bytes(message)
    except BrokenPipeError:
        pass


def _widen(pipe: Connection) -> None:
    try:
        from fcntl import F_SETPIPE_SZ, fcntl
        fcntl(pipe.fileno(), F_SETPIPE_SZ, PIPE_BYTES)
    except (ImportError, OSError):
        pass
