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
A thread that works through what others put in, so that these never wait for it.

The estimator takes a tenth of a second when it moves its linearisation point; a callback that
waited for it would hold up every other one of the node.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import threading
from typing import Any

PERIOD = 0.2  # s, between two rounds: many messages at one go cost less than each by itself


class Worker:
    """
    Calls a function over and over in one thread, with what has been put in since.

    Parameters
    ----------
    work : callable
        Takes a list, in the order in which things were put in, which may be empty.
    failed : callable
        Takes the exception that `work` raised; it is not called again after that.

    """

    def __init__(self, work: Callable[[list[Any]], None],
                 failed: Callable[[BaseException], None]) -> None:
        """Wait for `start`."""
        self._work = work
        self._failed = failed
        self._inbox: deque[Any] = deque()
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name='ins_align', daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def put(self, item: Any) -> None:
        """Hand something over; from any thread, at once."""
        self._inbox.append(item)

    def wake(self) -> None:
        """Begin the next round now."""
        self._wake.set()

    def stop(self) -> None:
        """End the thread after the round that it is in."""
        self._stopping = True
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            while not self._stopping:
                # Only as much as is there now: others go on putting in.
                self._work([self._inbox.popleft() for _ in range(len(self._inbox))])
                self._wake.wait(PERIOD)
                self._wake.clear()
        except BaseException as error:
            self._failed(error)
