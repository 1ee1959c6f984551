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
"""The thread that works for the node: order, exceptions, how it ends."""

import threading

from ins_align.ros.worker import Worker
import pytest

LONG = 20.0                     # s, for what takes no time at all


def end(worker):
    stopper = threading.Thread(target=worker.stop, daemon=True)
    stopper.start()
    stopper.join(LONG)
    assert not stopper.is_alive()


def test_all_is_worked_through_in_its_order():
    done, got, failures = threading.Event(), [], []

    def work(items):
        got.extend(items)
        if len(got) >= 3000:
            done.set()

    worker = Worker(work, failures.append)
    worker.put(0)                                   # before it begins
    worker.start()
    for number in range(1, 3000):
        worker.put(number)
        if number % 100 == 0:
            worker.wake()
    worker.wake()
    assert done.wait(LONG)
    end(worker)
    assert got == list(range(3000)) and failures == []


def test_it_goes_on_without_being_woken():
    """With nothing, too: what is due with time is done in a round."""
    rounds, enough = [], threading.Event()

    def work(items):
        rounds.append(items)
        if len(rounds) == 3:
            enough.set()

    worker = Worker(work, lambda error: None)
    worker.start()
    assert enough.wait(LONG)
    end(worker)
    assert rounds[:3] == [[], [], []]


@pytest.mark.parametrize('error', (ValueError('broken'), KeyboardInterrupt()))
def test_an_exception_is_handed_on_and_ends_it(error):
    failed, called, failures = threading.Event(), [], []

    def work(items):
        called.append(items)
        raise error

    def fail(exception):
        failures.append(exception)
        failed.set()

    worker = Worker(work, fail)
    worker.start()
    assert failed.wait(LONG)
    worker.put(1)
    worker.wake()
    end(worker)
    assert failures == [error] and called == [[]]


def test_it_ends_after_the_round_that_it_is_in():
    started, go_on, rounds = threading.Event(), threading.Event(), []

    def work(items):
        started.set()
        assert go_on.wait(LONG)
        rounds.append(items)

    worker = Worker(work, lambda error: None)
    worker.start()
    assert started.wait(LONG)
    worker.put(1)
    stopper = threading.Thread(target=worker.stop, daemon=True)
    stopper.start()
    while stopper.is_alive() and not worker._stopping:
        stopper.join(0.01)
    go_on.set()
    stopper.join(LONG)
    assert not stopper.is_alive() and rounds == [[]]


def test_one_wake_is_one_round():
    """Or it would turn round and round from then on."""
    awake, enough = [], threading.Event()

    def work(items):
        awake.append(worker._wake.is_set())
        if len(awake) == 4:
            enough.set()

    worker = Worker(work, lambda error: None)
    worker.wake()
    worker.start()
    assert enough.wait(LONG)
    end(worker)
    assert awake[:4] == [True, False, False, False]
