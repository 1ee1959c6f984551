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
"""What a command makes of a recording: its result, and output files, named and checked."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
import dataclasses
from dataclasses import dataclass
import errno
from functools import partial
from importlib import import_module
import os
from pathlib import Path
from typing import Any, IO

from ins_align.config import UsageError

# Everything else is imported where it is used: --help must not wait for numpy.

STANDARD_OUTPUT = '-'
PLOT_SUFFIXES = ('.png', '.pdf', '.svg', '.jpg', '.jpeg', '.webp', '.eps', '.tif', '.tiff')


@dataclass(frozen=True)
class Task:
    """One recording, how to replay it and what to write; paths other than `name` are absolute."""

    name: str  # of the recording, as it was given
    arguments: dict[str, Any]  # for `replay`
    csv: str | None = None  # this and the following: files to write
    plot: str | None = None
    results: str | None = None


@dataclass(frozen=True)
class Outcome:
    """What a command tells of a recording."""

    json: dict[str, Any]  # for --json; if it has an "error", the other fields are empty
    text: str = ''  # for standard output
    warnings: tuple[str, ...] = ()


def not_aligned(bag: str, error: str) -> Outcome:
    """Return the outcome of a recording that could not be aligned because of an error."""
    return Outcome({'bag': bag, 'aligned': False, 'error': about(bag, error)})


def process(task: Task, progress: Callable[[float], None] | None = None) -> Outcome:
    """Replay one recording and write its files; problems that a user can solve are an error."""
    from ins_align.offline import replay
    from ins_align.recordings import BagError
    from ins_align.report import plot, summary

    def named(text: object) -> str:
        return about(task.name, str(text).replace(str(task.arguments['path']), task.name or '.'))

    try:
        result = replay(**task.arguments, progress=progress)
        if task.results:
            from ins_align.recordings.results_bag import write_results
            with _naming(task.results):
                write_results(result, task.results)
        result = dataclasses.replace(result, bag=task.name)
        if task.csv:
            write_whole(task.csv, lambda file: file.write(result.to_csv().encode()))
        if task.plot:
            write_whole(task.plot, partial(
                plot(result).savefig, format=Path(task.plot).suffix[1:].lower(), dpi=120))
    except BagError as error:
        return not_aligned(task.name, named(error))
    except OSError as error:
        return not_aligned(task.name, f'cannot write {error.filename}: {error.strerror}')
    return Outcome(result.to_json(), summary(result), tuple(map(named, result.warnings)))


def survey(bag: str) -> Outcome:
    """Inspect a recording."""
    from ins_align.recordings import BagError
    from ins_align.recordings.info import describe, inspect

    try:
        info = inspect(bag)
    except BagError as error:
        return Outcome({'bag': bag, 'error': about(bag, str(error))})
    return Outcome(info.to_json(), describe(info),
                   tuple(about(bag, warning) for warning in info.warnings))


@contextmanager
def _naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Name the file that was being written in errors that name none, as of a full disk."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def write_whole(path: str | os.PathLike[str], write: Callable[[IO[bytes]], Any]) -> None:
    """Write a file, or the target of a link, whole or not at all; `write` gets the open file."""
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():
        raise FileExistsError(errno.EEXIST, 'it is no file', str(path))
    unfinished = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        with _naming(path), open(unfinished, 'xb') as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def names_for(path: str, bags: Sequence[str]) -> list[str]:
    """Return an output path for each recording; with several, their names precede the suffix."""
    if len(bags) == 1:
        return [path]
    labels = [Path(bag).resolve().name.split('.')[0] or 'bag' for bag in bags]
    if len(set(labels)) < len(labels):
        labels = [f'{label}_{number}' for number, label in enumerate(labels, 1)]
    root, suffix = os.path.splitext(path)
    return [f'{root}_{label}{suffix}' for label in labels]


def about(bag: str, text: str) -> str:
    """Return a sentence on a recording that begins with its path as given."""
    from ins_align.recordings import one_line

    path = Path(bag)
    name, last = one_line(str(path)), one_line(path.name)
    for begin in (name, last):
        if begin and text.startswith((f'{begin} ', f'{begin}:')):
            return name + text[len(begin):]
    return f'{name}: {text}'


def in_the_way(target: Path, inputs: Sequence[str]) -> str:
    """Return why nothing should be written there, or ''; links are resolved in all paths."""
    from ins_align.recordings.bag import begins_like_a_recording, STORAGE_NAME

    folder = target.parent
    if target.exists() and not target.is_file():
        return 'it is a directory or a device, no file'
    if str(target) in inputs:
        return 'it is to be read, choose another name'
    if begins_like_a_recording(target):
        return 'it is a recording and would be lost, choose another name'
    if str(folder) in inputs and (STORAGE_NAME.search(target.name)
                                  or target.name == 'metadata.yaml'):
        return 'it would become a part of the recording around it, choose another name'
    if not folder.is_dir():
        return f'there is no directory {folder}'
    return '' if os.access(folder, os.W_OK) else f'no permission to write to {folder}'


def check_plot(path: str) -> None:
    """Raise an error, before the work, if a figure cannot be drawn in the format of the name."""
    if Path(path).suffix.lower() not in PLOT_SUFFIXES:
        raise UsageError(f'cannot draw {path}: its name must end with one of '
                         f'{", ".join(PLOT_SUFFIXES)}')
    import_module('matplotlib')
