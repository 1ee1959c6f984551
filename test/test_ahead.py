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
"""A generator in another process: everything arrives, once, in order; nothing stays behind."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time

from ins_align.ahead import PIPE_BYTES, ProcessDied, run_ahead
from ins_align.recordings import BagError
import numpy as np
import pytest


def arrays(count, size):
    for k in range(count):
        yield k, np.full(size, float(k))


def broken(after, error):
    yield from range(after)
    raise error


def killed(after):
    yield from range(after)
    os.kill(os.getpid(), signal.SIGKILL)


def told(path):
    """Write down what was yielded: one line before each."""
    for k in range(1000):
        with open(path, 'a') as file:
            file.write(f'{os.getpid()}\n')
        yield np.zeros(PIPE_BYTES // 16)


class Unpicklable(Exception):

    def __reduce__(self):
        raise TypeError('not this one')


class NotMadeAgain(Exception):

    def __init__(self, what, why):
        super().__init__(f'{what}: {why}')


@pytest.mark.parametrize('size', [0, 1, PIPE_BYTES])
def test_all_arrive_in_order(size):
    got = list(run_ahead(arrays, 20, size))
    assert [k for k, _ in got] == list(range(20))
    assert all(np.array_equal(array, np.full(size, float(k))) for k, array in got)
    assert not multiprocessing.active_children()


def test_it_is_another_process():
    import threading
    assert next(run_ahead(_process_and_thread)) != (os.getpid(), threading.get_ident())


def _process_and_thread():
    import threading
    yield os.getpid(), threading.get_ident()


@pytest.mark.parametrize('error', [
    BagError('it is broken'), KeyError('x'), OSError(5, 'why'), BrokenPipeError(32, 'another')])
def test_errors_come_after_what_was_before_them(error):
    items = run_ahead(broken, 3, error)
    assert [next(items) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(type(error)) as caught:
        next(items)
    assert caught.value.args == error.args
    assert 'in broken\n' in str(caught.value.__cause__)  # where it was raised
    assert not multiprocessing.active_children()


@pytest.mark.parametrize('error', [Unpicklable, NotMadeAgain])
def test_an_error_that_cannot_be_sent_is_told(error):
    # Made over there: it could not be sent there either. As itself all the same, where a library
    # that is imported (tblib, by Dask) has taught pickle more exceptions.
    items = run_ahead(_raises, error)
    with pytest.raises((RuntimeError, error)) as caught:
        next(items)
    assert error.__name__ in repr(caught.value)


def _raises(error):
    raise error('x', 'y')
    yield


def test_a_killed_process_is_an_error_and_no_end():
    items = run_ahead(killed, 2)
    assert [next(items), next(items)] == [0, 1]
    with pytest.raises(ProcessDied):
        next(items)


def test_a_process_killed_in_the_middle_of_a_message_is_an_error(tmp_path):
    path = tmp_path / 'told'
    items = run_ahead(told, path)
    next(items)
    pid = int(path.read_text().split()[0])
    time.sleep(0.2)  # the pipe is full
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(ProcessDied):
        for _ in items:
            pass


def cleaned_up(path):
    try:
        yield from told(path)
    finally:
        path.unlink()


def test_who_leaves_early_lets_it_clean_up(tmp_path):
    path = tmp_path / 'told'
    items = run_ahead(cleaned_up, path)
    next(items)
    assert path.exists()
    items.close()
    assert not path.exists()


def test_handlers_of_the_parent_are_its_own(tmp_path):
    # Two, because the second holds an end of the pipe of the first.
    program = ('import asyncio, pathlib, signal, sys; sys.path.insert(0, sys.argv[1])\n'
               'from test_ahead import told\n'
               'from ins_align.ahead import run_ahead\n'
               'async def main():\n'
               '    loop = asyncio.get_running_loop()\n'
               '    loop.add_signal_handler(signal.SIGTERM, print, "heard")\n'
               '    both = [run_ahead(told, pathlib.Path(sys.argv[2], name)) for name in "ab"]\n'
               '    for items in both: next(items)\n'
               '    for items in both: items.close()\n'
               '    await asyncio.sleep(0.2)\n'
               'asyncio.run(main())\n')
    done = subprocess.run([sys.executable, '-c', program, os.path.dirname(__file__), tmp_path],
                          capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, ''), done.stderr


def _all(count):
    return list(run_ahead(range_of, count))


def range_of(count):
    yield from range(count)


def test_where_there_can_be_no_other_process_it_runs_in_this_one(monkeypatch):
    with multiprocessing.Pool(1) as pool:  # daemons may not have children
        assert pool.apply(_all, (3,)) == [0, 1, 2]
    monkeypatch.setattr(multiprocessing.Process, 'start', _no_process)
    assert _all(3) == [0, 1, 2]


def _no_process(process):
    raise BlockingIOError(11, 'Resource temporarily unavailable')


def test_who_leaves_early_leaves_nothing_behind(tmp_path):
    path = tmp_path / 'told'
    items = run_ahead(told, path)
    next(items)
    items.close()
    assert not multiprocessing.active_children()
    # What nobody takes is not produced: the pipe holds two, and one waits.
    assert len(path.read_text().splitlines()) <= 5


def test_it_does_not_outlive_a_killed_parent(tmp_path):
    path = tmp_path / 'told'
    program = ('import sys; sys.path.insert(0, sys.argv[1])\n'
               'from test_ahead import told\n'
               'from ins_align.ahead import run_ahead\n'
               'for _ in run_ahead(told, sys.argv[2]): print(flush=True)\n')
    parent = subprocess.Popen([sys.executable, '-c', program, os.path.dirname(__file__), path],
                              stdout=subprocess.PIPE)
    parent.stdout.readline()
    parent.kill()
    parent.wait()
    child = int(path.read_text().split()[0])
    assert child != parent.pid
    deadline = time.monotonic() + 20.0
    while _runs(child):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def _runs(pid):
    try:
        with open(f'/proc/{pid}/stat') as file:
            return file.read().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False
