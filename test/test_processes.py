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

from concurrent.futures.process import BrokenProcessPool
import multiprocessing
import os
import select
import signal
import subprocess
import sys

from ins_align.processes import AHEAD, pool, run_ahead
from ins_align.recordings import BagError
import numpy as np
import pytest

SIZE = 1 << 17


def arrays(count, size):
    for k in range(count):
        yield k, np.full(size, float(k))


def broken(after, error):
    yield from range(after)
    raise error


def killed(after):
    yield from range(after)
    os.kill(os.getpid(), signal.SIGKILL)


def cleaned_up(path):
    """Write down what was yielded: a line before each; remove it all at the end."""
    try:
        for _ in range(1000):
            with open(path, 'a') as file:
                file.write(f'{os.getpid()}\n')
            yield np.zeros(SIZE)
    finally:
        with open(path) as file, open(f'{path}.end', 'w') as end:
            end.write(str(len(file.readlines())))
        os.unlink(path)


@pytest.mark.parametrize('size', [0, 1, SIZE])
def test_all_arrive_in_order(size):
    got = list(run_ahead(arrays, 20, size))
    assert [k for k, _ in got] == list(range(20))
    assert all(np.array_equal(array, np.full(size, float(k))) for k, array in got)
    assert not multiprocessing.active_children()


def _process():
    yield os.getpid()


def test_it_is_another_process():
    assert list(run_ahead(_process)) != [os.getpid()]


@pytest.mark.parametrize('error', [
    BagError('it is broken'), KeyError('x'), OSError(5, 'why'), BrokenPipeError(32, 'another')])
def test_errors_come_after_what_was_before_them(error):
    items = run_ahead(broken, 3, error)
    assert [next(items) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(type(error)) as caught:
        next(items)
    assert caught.value.args == error.args
    assert not multiprocessing.active_children()


def test_a_killed_process_is_an_error_and_no_end():
    items = run_ahead(killed, 2)
    with pytest.raises(BrokenProcessPool):
        list(items)


def test_who_leaves_early_lets_it_clean_up(tmp_path):
    """And what nobody takes is not produced, but for what waits and what may be on its way."""
    path = tmp_path / 'told'
    items = run_ahead(cleaned_up, path)
    next(items)
    assert path.exists()
    items.close()
    assert not path.exists() and not multiprocessing.active_children()
    assert int((tmp_path / 'told.end').read_text()) <= 2 + AHEAD


def test_it_is_used_in_a_process_of_a_pool():
    """As of the option --jobs, which has two processes for each recording."""
    with pool(1) as executor:
        assert executor.submit(_all, 3).result() == [0, 1, 2]


def _all(count):
    return [k for k, _ in run_ahead(arrays, count, 1)]


def test_it_does_not_outlive_a_killed_parent(tmp_path):
    read, write = os.pipe()  # whoever lives holds an end of it
    program = ('import sys; sys.path.insert(0, sys.argv[1])\n'
               'from test_processes import cleaned_up\n'
               'from ins_align.processes import run_ahead\n'
               'if __name__ == "__main__":\n'
               '    for _ in run_ahead(cleaned_up, sys.argv[2]): print(flush=True)\n')
    parent = subprocess.Popen(
        [sys.executable, '-c', program, os.path.dirname(__file__), tmp_path / 'told'],
        stdout=subprocess.PIPE, pass_fds=[write])
    os.close(write)
    parent.stdout.readline()
    parent.kill()
    assert select.select([read], [], [], 30.0)[0] and os.read(read, 1) == b''
    os.close(read)
    parent.communicate()


def test_ctrl_c_is_for_the_parent():
    """A terminal sends it to all processes in front."""
    items = run_ahead(arrays, 20, 1)
    next(items)
    for child in multiprocessing.active_children():
        os.kill(child.pid, signal.SIGINT)
    assert [k for k, _ in items] == list(range(1, 20))
