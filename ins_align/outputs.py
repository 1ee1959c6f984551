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
"""What comes of a recording: the files that a command writes, named, checked, written whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
from dataclasses import dataclass
import errno
from functools import partial
from importlib import import_module
import os
from pathlib import Path
from typing import Any, IO

# Everything else is imported where it is used: --help must not wait for numpy.

STANDARD_OUTPUT = '-'
PLOT_SUFFIXES = ('.png', '.pdf', '.svg', '.jpg', '.jpeg', '.webp', '.eps', '.tif', '.tiff')


class UsageError(Exception):
    """A wrong command line; the text says what is wrong in one sentence."""


@dataclass(frozen=True)
class Task:
    """One recording, how to replay it and what to write; paths that hold on every machine."""

    name: str  # of the recording, as it was given
    arguments: dict[str, Any]  # of `replay`
    csv: str | None = None
    plot: str | None = None
    results: str | None = None


@dataclass(frozen=True)
class Outcome:
    """What came of a recording: either an error in one sentence or a text to print."""

    json: dict[str, Any]  # what --json writes of it
    text: str = ''
    warnings: tuple[str, ...] = ()
    error: str = ''

    @classmethod
    def failed(cls, bag: str, error: str) -> Outcome:
        """Return the outcome of a recording that could not be aligned for want of something."""
        sentence = about(bag, error)
        return cls({'bag': bag, 'aligned': False, 'error': sentence}, error=sentence)

    @classmethod
    def lost(cls, bag: str, error: Exception) -> Outcome:
        """Return the outcome of a recording whose process is gone."""
        return cls.failed(bag, f'a process died on the way ({type(error).__name__}), perhaps for '
                               'want of memory; --jobs 1 takes less')


def process(task: Task, progress: Callable[[float], None] | None = None) -> Outcome:
    """Replay one recording and write its files; whatever the user can put right is an error."""
    from ins_align.offline import replay
    from ins_align.recordings import BagError
    from ins_align.report import summary

    def named(error: object) -> str:
        return str(error).replace(str(task.arguments['path']), task.name)

    try:
        result = replay(**task.arguments, progress=progress)
        if task.results:
            from ins_align.recordings.results_bag import write_results
            write_results(result, task.results)
        result = dataclasses.replace(result, bag=task.name)
        if task.csv:
            write_whole(task.csv, lambda file: file.write(result.to_csv().encode()))
        if task.plot:
            from ins_align.panels import plot
            write_whole(task.plot, partial(
                plot(result).savefig, format=Path(task.plot).suffix[1:].lower(), dpi=120))
    except BagError as error:
        return Outcome.failed(task.name, named(error))
    except OSError as error:
        return Outcome.failed(task.name, f'cannot write {error.filename}: {error.strerror}')
    warnings = tuple(about(task.name, named(text)) for text in result.warnings)
    return Outcome(result.to_json(), summary(result), warnings)


def survey(bag: str) -> Outcome:
    """Tell what a recording holds."""
    from ins_align.recordings import BagError
    from ins_align.recordings.info import describe, inspect

    try:
        info = inspect(bag)
    except BagError as error:
        return Outcome({'bag': bag, 'error': about(bag, str(error))}, error=about(bag, str(error)))
    return Outcome(info.to_json(), describe(info),
                   tuple(about(bag, warning) for warning in info.warnings))


def write_whole(path: str | os.PathLike[str], write: Callable[[IO[bytes]], Any]) -> None:
    """
    Write a file whole or not at all, with a function that gets it open.

    A link stays one, to a file that is replaced. What is there and is no file is not replaced.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        raise FileExistsError(errno.EEXIST, 'it is no file', str(path))
    unfinished = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        with open(unfinished, 'xb') as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def labels(bags: Sequence[str]) -> list[str]:
    """Name the recordings, all differently, for the names of output files."""
    names = [Path(bag).resolve().name.split('.')[0] or 'bag' for bag in bags]
    if len(set(names)) == len(names):
        return names
    return [f'{name}_{number}' for number, name in enumerate(names, 1)]


def with_label(path: str, label: str) -> str:
    """Put the name of a recording into that of a file."""
    return str(Path(path).with_stem(f'{Path(path).stem}_{label}')) \
        if label and Path(path).name else path


def about(bag: str, text: str) -> str:
    """Let a sentence on a recording begin with the path as it was given."""
    from ins_align.recordings import one_line

    path = Path(bag)
    name, last = one_line(str(path)), one_line(path.name)
    for begin in (name, last):
        if begin and text.startswith((f'{begin} ', f'{begin}:')):
            return name + text[len(begin):]
    return f'{name}: {text}'


def check_writable(path: str, inputs: Sequence[str]) -> None:
    """Find out before the work whether its result can be written, and spoils no input."""
    if path == STANDARD_OUTPUT:
        return
    target = Path(os.path.realpath(path))
    folder = target.parent
    if Path(path).exists() and not Path(path).is_file():
        raise UsageError(f'cannot write {path}: it is a directory or a device, no file')
    if spoilt := _spoilt(target, list(map(os.path.realpath, inputs))):
        raise UsageError(f'cannot write {path}: {spoilt}, choose another name')
    if not folder.is_dir():
        raise UsageError(f'cannot write {path}: there is no directory {folder}')
    if not os.access(folder, os.W_OK):
        raise UsageError(f'cannot write {path}: no permission to write to {folder}')


def _spoilt(target: Path, inputs: Sequence[str]) -> str:
    """Say what would be lost if something were written there; both without links."""
    from ins_align.recordings.bag import begins_like_a_recording, STORAGE_NAME

    if str(target) in inputs:
        return 'it is to be read'
    if begins_like_a_recording(target):
        return 'it is a recording and would be lost'
    if str(target.parent) in inputs and (STORAGE_NAME.search(target.name)
                                         or target.name == 'metadata.yaml'):
        return 'it would become a part of the recording around it'
    return ''


def check_plot(path: str) -> None:
    """Find out before the work whether a figure can be drawn in the format that is asked for."""
    if Path(path).suffix.lower() not in PLOT_SUFFIXES:
        raise UsageError(f'cannot draw {path}: its name must end with one of '
                         f'{", ".join(PLOT_SUFFIXES)}')
    import_module('matplotlib')
