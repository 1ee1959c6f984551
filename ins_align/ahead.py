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

from collections.abc import Callable, Generator, Iterator
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
# For what a generator that is told to end has to clean up, s.
GRACE = 5.0


class ProcessDied(RuntimeError):
    """The other process ended before the generator did."""


def run_ahead(function: Callable[..., Generator[T, None, None]], *arguments: Any) -> Iterator[T]:
    """
    Yield what a generator yields in another process; in this one where there can be no other.

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
    if multiprocessing.current_process().daemon:  # of a pool, which may not start any
        yield from function(*arguments)
        return
    ours, theirs = multiprocessing.Pipe(duplex=False)
    _widen(theirs)
    process = multiprocessing.Process(target=_produce, args=(ours, theirs, function, arguments),
                                      daemon=True)
    try:
        process.start()
    except OSError:  # no process or no memory to be had
        ours.close()
        theirs.close()
        yield from function(*arguments)
        return
    theirs.close()
    try:
        while True:
            try:
                message = ours.recv_bytes()
            except (EOFError, OSError):  # the latter in the middle of a message
                process.join()
                raise ProcessDied(f'exit status {process.exitcode}') from None
            what, content = pickle.loads(message)
            if what == 'end':
                return
            if what == 'error':
                error, where = content
                raise error from RuntimeError(where)
            yield content
    finally:
        ours.close()
        process.terminate()
        process.join(GRACE)
        if process.is_alive():
            process.kill()
            process.join()


class _Left(SystemExit):
    """Nobody reads any more."""


def _produce(unused: Connection, pipe: Connection,
             function: Callable[..., Generator[Any, None, None]],
             arguments: tuple[Any, ...]) -> None:
    """Send ('item', item), ..., then ('end', None) or ('error', (error, where it came from))."""
    # An interruption is for the process that was asked, and nobody's event loop is to hear of
    # what is sent to this one. It ends when nobody reads any more.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGTERM, _leave)
    unused.close()
    items = function(*arguments)
    try:
        for item in items:
            _send(pipe, pickle.dumps(('item', item), pickle.HIGHEST_PROTOCOL))
        message = pickle.dumps(('end', None))
    except Exception as error:
        where = traceback.format_exc()
        try:
            message = pickle.dumps(('error', (error, where)))
            pickle.loads(message)  # not every exception can be made again
        except Exception:
            message = pickle.dumps(('error', (RuntimeError(where), where)))
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # what is to be cleaned up is
        items.close()
    _send(pipe, message)


def _leave(*_: Any) -> None:
    raise _Left


def _send(pipe: Connection, message: bytes) -> None:
    try:
        pipe.send_bytes(message)
    except BrokenPipeError:
        raise _Left from None


def _widen(pipe: Connection) -> None:
    try:
        from fcntl import F_SETPIPE_SZ, fcntl
        fcntl(pipe.fileno(), F_SETPIPE_SZ, PIPE_BYTES)
    except (ImportError, OSError):
        pass
