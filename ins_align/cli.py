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
"""The command ``ins_align``: inspect and replay recordings, simulate, repeat experiments."""

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from functools import partial
import gc
import io
from itertools import chain
import json
import os
from pathlib import Path
import sys
from typing import Any, NoReturn

from ins_align.config import (
    Config, config_from_mapping, load_params, parse_override, UsageError, without_unknown)
from ins_align.outputs import (
    check_plot, in_the_way, names_for, not_aligned, Outcome, process, STANDARD_OUTPUT, survey,
    Task, write_whole)
from ins_align.processes import keep_to_one, run_all, run_on_cluster

# Everything else is imported where it is used: --help must not wait for numpy.

ALIGNED, NOT_ALIGNED, UNUSABLE, INTERRUPTED, NO_READER = 0, 1, 2, 130, 141

# Packages to install whose names differ from that of the module.
PACKAGES = {'backports': 'backports.zstd', 'pyins': 'python-ins', 'yaml': 'pyyaml'}

SCENARIOS = 'flight, car, straight, static, hover, launch, reverse, swing, highway, robot'

BAG_HELP = 'rosbag2 directory or file (.mcap, .db3), or ROS 1 .bag'

DESCRIPTION = """\
Finds roll, pitch and true heading of a moving IMU with a GNSS receiver.
"ins_align COMMAND --help" explains a command.
"""

INFO_EPILOG = """\
It ends with the "ins_align replay" command and the options that the recording needs.

exit status:
  0  told, whether it can be aligned or not
  2  bad usage or a recording that cannot be read

With several recordings --json writes an array with an object for each.

example:
  ins_align info drive.bag
"""

REPLAY_EPILOG = """\
exit status:
  0  aligned (of several recordings: all)
  1  read to the end and not aligned; table and JSON say why
  2  bad usage or a recording that cannot be read

With several recordings --json writes an array with an object for each, and --csv, --plot and --bag
put the recording's name before the suffix: out.csv becomes out_first.csv, out_second.csv.

examples:
  ins_align replay flight_1 --lever-arm 1.2 0.0 0.4 --json flight_1.json
  ins_align replay drive.bag --params config/ins_align.yaml --start 30 --plot drive.png
"""

SIMULATE_EPILOG = """\
The recording holds /imu/data_raw, /fix, /fix_velocity and the true attitude on /reference/imu.
In its folder is ins_align.yaml with the parameters that suit it.

example:
  ins_align simulate flight --scenario flight --imu mems --seed 1 --lever-arm 1 1 1
  ins_align replay flight --params flight/ins_align.yaml
"""


class Parser(argparse.ArgumentParser):
    """A parser that reports an error in one sentence."""

    def error(self, message: str) -> NoReturn:
        """Exit with the status of bad usage."""
        self.exit(UNUSABLE, f'{self.prog}: {message}; see "{self.prog} --help"\n')


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line, by default that of the process; return the exit status."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # its encoding may lack characters
            stream.reconfigure(errors='backslashreplace')
    arguments, unknown = parser().parse_known_args(argv)
    if unknown:
        arguments.parser.error(f'unrecognized arguments: {" ".join(unknown)}')
    try:
        if arguments.command is None:
            arguments.parser.print_help()
            return UNUSABLE
        status = int(arguments.run(arguments))
        print(end='', flush=True)
        return status
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:  # the reader of the output has ended, as "head" does
        return NO_READER
    except ModuleNotFoundError as error:
        sentence = _not_installed(error)
    except UsageError as error:
        sentence = str(error)
    except OSError as error:
        sentence = f'{error.filename or "output"}: {error.strerror}'
        if error.filename is None:  # disk full: closing would fail again
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    print(f'ins_align {arguments.command}: {sentence}', file=sys.stderr)
    return UNUSABLE


def parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    top = Parser(prog='ins_align', description=DESCRIPTION)
    top.add_argument('--version', action='version', version=f'%(prog)s {_version()}')
    top.set_defaults(parser=top)
    commands = top.add_subparsers(dest='command', metavar='COMMAND', title='commands')
    _add_info(commands)
    _add_replay(commands)
    _add_simulate(commands)
    _add_experiment(commands)
    return top


def _add_command(commands: Any, name: str, run: Callable[[argparse.Namespace], int],
                 description: str, epilog: str) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = commands.add_parser(
        name, help=description, description=description, epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    command.set_defaults(run=run, parser=command)
    return command


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version('ins_align')
    except PackageNotFoundError:
        return 'is not installed: its version is in package.xml'


def _number(kind: type, least: float, text: str) -> Any:
    try:
        value = kind(text)
    except ValueError:
        value = least - 1
    if not least <= value < 1e9:
        what = 'whole number' if kind is int else 'number of seconds'
        raise argparse.ArgumentTypeError(f'must be a {what}, {least:g} or above, got {text!r}')
    return value


_seconds, _count = partial(_number, float, 0.0), partial(_number, int, 1)


def _add_info(commands: Any) -> None:
    command = _add_command(commands, 'info', run_info,
                           'Tell what recordings hold and how to align them, before any run.',
                           INFO_EPILOG)
    command.add_argument('bags', nargs='+', metavar='BAG', help=BAG_HELP)
    command.add_argument('--json', metavar='FILE', help='write what is known, for programs; '
                         '-: to standard output, instead of the text')


def _add_replay(commands: Any) -> None:
    command = _add_command(commands, 'replay', run_replay, 'Align recordings, without ROS.',
                           REPLAY_EPILOG)
    command.add_argument('bags', nargs='+', metavar='BAG', help=BAG_HELP)
    group = command.add_argument_group('parameters')
    group.add_argument('--params', metavar='FILE', help='parameter file of the node (YAML)')
    group.add_argument('--set', action='append', default=[], metavar='NAME=VALUE',
                       dest='overrides', help='set a parameter; repeatable, after --params')
    group.add_argument('--lever-arm', type=float, nargs=3, metavar=('X', 'Y', 'Z'),
                       help='IMU to antenna in the IMU frame, m: sets the parameter lever_arm')
    group = command.add_argument_group('input')
    for name, what in (('imu', 'IMU'), ('fix', 'position'), ('velocity', 'velocity')):
        group.add_argument(f'--{name}-topic', metavar='TOPIC',
                           help=f'the {what} topic, where there is more than one')
    group.add_argument('--start', type=_seconds, metavar='S',
                       help='skip this many seconds of the recording')
    group.add_argument('--duration', type=_seconds, metavar='S', help='read this many seconds')
    group.add_argument('--jobs', type=_count, metavar='N',
                       help='recordings at a time (default: one a processor)')
    group.add_argument('--dask', metavar='ADDRESS',
                       help='process the recordings on the Dask cluster with this scheduler')
    group = command.add_argument_group('output')
    group.add_argument('--json', metavar='FILE', help='write the result; '
                       '-: to standard output, instead of the table')
    group.add_argument('--csv', metavar='FILE', help='write a row for every GNSS epoch')
    group.add_argument('--plot', metavar='FILE',
                       help='draw attitude, sigma, innovations, biases, error and track '
                            '(.png, .pdf, .svg)')
    group.add_argument('--bag', metavar='OUT', dest='results',
                       help='write a recording (mcap) with the topics of the node, to play and to '
                            'plot beside the original; a directory to make')


def _add_simulate(commands: Any) -> None:
    command = _add_command(commands, 'simulate', run_simulate,
                           'Write a recording of a simulated vehicle, with truth.',
                           SIMULATE_EPILOG)
    from ins_align.simulation.arguments import Arguments

    command.add_argument('out', metavar='OUT_BAG', help='directory to make')
    command.add_argument('--scenario', default='flight', metavar='NAME',
                         help=f'one of {SCENARIOS} (default: flight)')
    command.add_argument('--imu', default='mems', metavar='GRADE', dest='imu_grade',
                         help='navigation, tactical, mems or chip (default: mems)')
    command.add_argument('--storage', default='mcap', choices=('mcap', 'sqlite3'))
    command.add_argument('--seed', type=int, default=0, help='of everything random (default: 0)')
    command.add_argument('--duration', type=_seconds, metavar='S',
                         help='default: what suits the scenario')
    command.add_argument('--ideal', action='store_true', help='no noise and no biases')
    command.add_argument('--outage', type=float, nargs=2, action='append', default=[],
                         metavar=('FROM', 'TO'), dest='outages',
                         help='no GNSS between these seconds; repeatable')
    groups: dict[str, Any] = {}
    for field in fields(Arguments):
        metadata = field.metadata
        if not metadata:
            continue
        group, choices = metadata['group'], metadata['choices']
        if group not in groups:
            groups[group] = command.add_argument_group(group)
        unit = metadata['unit'] if metadata['unit'] != '1' else ''
        default = field.default
        if isinstance(default, tuple):
            default = ' '.join(map(str, default))
        groups[group].add_argument(
            '--' + field.name.replace('_', '-'), default=argparse.SUPPRESS,
            type=type(field.default) if choices else float,
            nargs=len(metadata['names']) or None,
            metavar=metadata['names'] or unit.upper() or ('NAME' if choices else 'X'),
            help=metadata['text'] + (unit and f', {unit}')
            + (f' (default: {default})' if default else ''))
    command.add_argument('--tf', action='store_true',
                         help='write how IMU and antenna are mounted to /tf_static')


def _add_experiment(commands: Any) -> None:
    from ins_align.experiments import MEASUREMENTS, NAMES

    command = _add_command(
        commands, 'experiment', run_experiment,
        'Repeat a published or documented experiment: its figure and its numbers.', '')
    command.add_argument('name', metavar='NAME',
                         help=f'{", ".join(NAMES)}; all: these one after the other; '
                              f'{", ".join(MEASUREMENTS)}: measure the machine too, with ROS')
    command.add_argument('--out', required=True, metavar='DIR', help='where to write')
    command.add_argument('--data', metavar='DIR', help='folder of the real recordings')
    command.add_argument('--runs', type=_count, metavar='N', help='of a Monte Carlo experiment')
    command.add_argument('--jobs', type=_count, metavar='N', help='processes at a time')


def run_info(arguments: argparse.Namespace) -> int:
    """Run ``ins_align info``."""
    _check_outputs(arguments, {})
    return _print_outcomes(arguments, map(survey, arguments.bags))


def run_replay(arguments: argparse.Namespace) -> int:
    """Run ``ins_align replay``."""
    keep_to_one()
    gc.set_threshold(100_000)  # thousands of objects are made, and hardly any is garbage
    files = {option: names_for(path, arguments.bags) for option in ('csv', 'plot', 'results')
             if (path := getattr(arguments, option)) is not None}
    _check_outputs(arguments, files)
    settings = {'config': _config(arguments), **{
        name: getattr(arguments, name) for name in (
            'imu_topic', 'fix_topic', 'velocity_topic', 'start', 'duration')}}
    if arguments.plot:
        check_plot(arguments.plot)
    tasks = [Task(bag, {'path': os.path.abspath(bag), **settings}, **{
        option: os.path.abspath(paths[place]) for option, paths in files.items()})
        for place, bag in enumerate(arguments.bags)]
    found: Iterable[Outcome | Exception]
    if arguments.dask is not None:
        found = run_on_cluster(process, tasks, arguments.dask)
    elif len(tasks) > 1:
        found = run_all(process, tasks, arguments.jobs)
    else:
        found = [_with_a_bar(tasks[0])]
    return _print_outcomes(arguments, (
        not_aligned(task.name, f'a process died on the way ({type(outcome).__name__}), perhaps '
                    'for want of memory; --jobs 1 takes less')
        if isinstance(outcome, Exception) else outcome
        for task, outcome in zip(tasks, found)))


def _with_a_bar(task: Task) -> Outcome:
    """Process one recording, with a progress bar if there is a terminal."""
    from tqdm import tqdm

    with tqdm(total=1, leave=False, disable=None if sys.stderr else True,  # None: no terminal
              bar_format='{percentage:3.0f}% |{bar}| {elapsed}, {remaining} left') as bar:
        return process(task, lambda part: bar.update(part - bar.n))


def _check_outputs(arguments: argparse.Namespace, files: dict[str, list[str]]) -> None:
    """Raise UsageError, before the work, unless all `files`, lists by option, can be written."""
    if STANDARD_OUTPUT in [getattr(arguments, option) for option in files]:
        raise UsageError('nothing but --json can go to standard output: give the name of a file')
    for path in files.get('results', ()):
        if os.path.exists(path):
            raise UsageError(f'cannot write {path}: it exists already, choose another name')
    outputs = list(chain(*files.values()))
    if arguments.json not in (None, STANDARD_OUTPUT):
        outputs.append(arguments.json)
    inputs = [*arguments.bags, *filter(None, [getattr(arguments, 'params', None)])]
    inputs, targets = (list(map(os.path.realpath, paths)) for paths in (inputs, outputs))
    for path, target in zip(outputs, targets):
        if what := in_the_way(Path(target), inputs):
            raise UsageError(f'cannot write {path}: {what}')
        if targets.count(target) > 1:
            raise UsageError(f'{path} is given for two outputs')


def _print_outcomes(arguments: argparse.Namespace, outcomes: Iterable[Outcome]) -> int:
    """Print the outcome of each recording and write ``--json``; return the exit status."""
    several = len(arguments.bags) > 1
    objects, statuses = [], []
    # All outcomes are read: a pool of processes that is dropped early is torn down in a race.
    for outcome in outcomes:
        objects.append(outcome.json)
        if error := outcome.json.get('error'):
            if not several:
                raise UsageError(error)
            print(f'ins_align {arguments.command}: {error}', file=sys.stderr)
            statuses.append(UNUSABLE)
            continue
        for warning in outcome.warnings:
            print(f'ins_align {arguments.command}: warning: {warning}', file=sys.stderr)
        if arguments.json != STANDARD_OUTPUT:
            print(outcome.text + '\n', flush=True)
        statuses.append(ALIGNED if outcome.json.get('aligned', True) else NOT_ALIGNED)
    text = json.dumps(objects if several else objects[0], indent=2, allow_nan=False) + '\n'
    if arguments.json == STANDARD_OUTPUT:
        print(text, end='')
    elif arguments.json:
        try:
            write_whole(arguments.json, lambda file: file.write(text.encode()))
        except OSError as error:
            raise UsageError(f'cannot write {arguments.json}: {error.strerror}') from None
    return max(statuses)


def _config(arguments: argparse.Namespace) -> Config:
    given = {} if arguments.params is None else load_params(arguments.params)
    values, warnings = without_unknown(given)
    for warning in warnings:
        print(f'ins_align {arguments.command}: warning: {arguments.params}: {warning}',
              file=sys.stderr)
    values.update(parse_override(text) for text in arguments.overrides)
    if arguments.lever_arm is not None:
        values['lever_arm'] = arguments.lever_arm
    return config_from_mapping(values)


def _not_installed(error: ModuleNotFoundError) -> str:
    """Return a sentence that says what to install; raise the error if the module is our own."""
    if (error.name or 'ins_align').startswith('ins_align'):
        raise error
    name = (error.name or '').split('.')[0]
    return f'{error.name} is not installed: pip install {PACKAGES.get(name, name)}'


def run_simulate(arguments: argparse.Namespace) -> int:
    """Run ``ins_align simulate``."""
    from ins_align.simulation.simulate import simulate, write_bag

    options = {name: value for name, value in vars(arguments).items()
               if name not in ('command', 'run', 'parser', 'out', 'storage', 'scenario', 'tf')}
    try:
        write_bag(simulate(arguments.scenario, **options), arguments.out, arguments.storage,
                  arguments.tf)
    except OSError as error:
        raise UsageError(f'cannot write {arguments.out}: {error.strerror}') from None
    print(f'{arguments.out}: {arguments.scenario}, {arguments.imu_grade} IMU, '
          f'seed {arguments.seed}; parameters that suit it: {arguments.out}/ins_align.yaml')
    return 0


def run_experiment(arguments: argparse.Namespace) -> int:
    """Run ``ins_align experiment``."""
    from ins_align import experiments

    experiments.run(arguments.name, arguments.out, arguments.data, arguments.runs, arguments.jobs)
    return 0


if __name__ == '__main__':
    sys.exit(main())
