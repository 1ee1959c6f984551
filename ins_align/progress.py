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
"""How far replay has come: a bar on a terminal, and text that does not tear it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import sys
from typing import Any, IO


class Progress:
    """
    One bar over all recordings, on a terminal and with tqdm; otherwise nothing.

    Parameters
    ----------
    bar : tqdm or None
        Counts recordings.

    """

    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def say(self, text: str) -> None:
        """Write to standard output without tearing the bar."""
        self._write(text, sys.stdout)

    def note(self, text: str) -> None:
        """Write to standard error without tearing the bar."""
        self._write(text, sys.stderr)

    def advance(self, position: float) -> None:
        """Say how many recordings have been read, whole ones and parts."""
        if self._bar is not None and position > self._bar.n:
            self._bar.update(position - self._bar.n)

    def _write(self, text: str, file: IO[str]) -> None:
        if self._bar is None:
            print(text, file=file)
        else:
            self._bar.write(text, file=file)


@contextmanager
def progress_bar(total: int) -> Iterator[Progress]:
    """Show a bar over so many recordings, where there is a terminal and tqdm."""
    bar = None
    if sys.stderr.isatty():
        try:
            from tqdm import tqdm
            bar = tqdm(total=total, file=sys.stderr, leave=False,
                       bar_format='{percentage:3.0f}% |{bar}| {elapsed}, {remaining} left')
        except ImportError:
            pass
    try:
        yield Progress(bar)
    finally:
        if bar is not None:
            bar.close()
