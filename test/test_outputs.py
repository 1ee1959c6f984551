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
"""Outputs are whole or not there; what a recording says ends up in none but those asked for."""

import errno
import json
from pathlib import Path
import signal
import subprocess
import sys
import tempfile

from ins_align.cli import main
import pytest
from recordings import (
    FIX, IMU, make_fix, make_imu, make_twist, START_NS, TWIST, typestore, write_messages,
    write_recording)

pytest.importorskip('rosbags')

# A process that is killed by the very call that makes an output durable, or gives it its name.
KILLED = """
import os, pathlib, signal, sys
where, function = sys.argv[1].rsplit('.', 1)
place = {'os': os, 'Path': pathlib.Path}[where]
setattr(place, function, lambda *arguments: os.kill(os.getpid(), signal.SIGKILL))
from ins_align.cli import main
sys.exit(main(sys.argv[2:]))
"""


def killed(call, *arguments):
    """Run the command line until `call` kills it."""
    done = subprocess.run([sys.executable, '-c', KILLED, call, *map(str, arguments)],
                          cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr


@pytest.fixture(scope='module')
def standing(tmp_path_factory):
    """Record a vehicle that stands still."""
    return write_recording(tmp_path_factory.mktemp('outputs') / 'standing', 'sqlite3', 3.0)


@pytest.mark.parametrize('call, command, option, suffix', [
    ('os.fsync', 'replay', '--json', '.json'), ('os.replace', 'replay', '--csv', '.csv'),
    ('os.replace', 'replay', '--plot', '.png'), ('os.replace', 'info', '--json', '.json')])
def test_killed_on_the_way_leaves_the_old_file(standing, tmp_path, call, command, option, suffix):
    if option == '--plot':
        pytest.importorskip('matplotlib')
    path = tmp_path / f'out{suffix}'
    path.write_text('old')
    killed(call, command, standing, option, path)
    assert path.read_text() == 'old'


def test_killed_experiment_leaves_the_old_files(tmp_path):
    pytest.importorskip('pyins')
    for name in ('faults.md', 'faults.json'):
        (tmp_path / name).write_text('old')
    killed('os.replace', 'experiment', 'faults', '--runs', '1', '--jobs', '1', '--out', tmp_path)
    assert all((tmp_path / name).read_text() == 'old' for name in ('faults.md', 'faults.json'))


@pytest.mark.parametrize('call', ['os.fsync', 'os.replace'])
def test_killed_figure_leaves_the_old_one(tmp_path, call):
    pytest.importorskip('matplotlib')
    (tmp_path / 'x.png').write_text('old')
    draw = """
from ins_align.experiments.common import Report
from ins_align.report import new_figure
Report('x', 'X', pathlib.Path(sys.argv[2])).figure(new_figure(2, 2), 'x')
"""
    program = KILLED.partition('from ins_align')[0] + draw
    done = subprocess.run([sys.executable, '-c', program, call, str(tmp_path)],
                          cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert (tmp_path / 'x.png').read_text() == 'old'


def test_killed_simulation_leaves_no_recording(tmp_path):
    pytest.importorskip('pyins')
    path = tmp_path / 'flight'
    killed('Path.rename', 'simulate', path, '--duration', '2')
    assert not path.exists()


@pytest.mark.parametrize('call, option, name', [
    ('os.fsync', '--csv', 'out.csv'), ('os.fsync', '--plot', 'out.png'),
    ('os.fsync', '--json', 'out.json'),
    ('ins_align.recordings.results_bag.Writer.write', '--bag', 'out')])
def test_a_full_disk_names_the_output(standing, tmp_path, capsys, monkeypatch, call, option, name):
    if option == '--plot':
        pytest.importorskip('matplotlib')

    def full(*arguments):
        raise OSError(errno.ENOSPC, 'No space left on device')
    monkeypatch.setattr(call, full)
    assert main(['replay', str(standing), option, str(tmp_path / name)]) == 2
    assert f'cannot write {tmp_path / name}: No space left on device' in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize('arguments, reason', [
    (['info', '--json', 'a.db3', 'b.db3'], 'a.db3: it is a recording and would be lost'),
    (['replay', '--json', 'a.db3', 'b.db3'], 'a.db3: it is a recording and would be lost'),
    (['replay', '--json', 'link', 'b.db3'], 'link: it is a recording and would be lost'),
    (['replay', '--csv', 'x.json', 'a.db3', 'b.db3', '--json', 'x_a.json'],
     'x_a.json is given for two outputs'),
    (['replay', '--csv', 'y', 'a.db3', '--json', './y'], 'y is given for two outputs'),
    (['replay', '--csv', 'x.json', 'x/a.db3', 'b.db3'],
     'x_a.json: it is a recording and would be lost'),
    (['replay', '--json', 'empty', 'empty'], 'empty: it is to be read'),
    (['replay', '--json', 'p.yaml', 'a.db3', '--params', './p.yaml'], 'p.yaml: it is to be read'),
    (['replay', '--json', 'x/new.mcap', 'x/'], 'x/new.mcap: it would become a part of the'),
    (['replay', '--json', 'x/metadata.yaml', 'x'], 'metadata.yaml: it would become a part of')])
def test_no_output_takes_the_place_of_a_recording(standing, tmp_path, capsys, monkeypatch,
                                                  arguments, reason):
    monkeypatch.chdir(tmp_path)
    content = next(standing.glob('*.db3')).read_bytes()
    Path('x').mkdir()
    for name in ('a.db3', 'b.db3', 'x/a.db3'):
        Path(name).write_bytes(content)
    if 'x_a.json: it' in reason:
        Path('x_a.json').write_bytes(content)
    Path('link').symlink_to('a.db3')
    Path('empty').touch()
    Path('p.yaml').write_text('/**: {ros__parameters: {}}')
    before = {path: path.read_bytes() for path in Path().rglob('*') if path.is_file()}
    monkeypatch.setattr('ins_align.recordings.bag.Bag.__init__', None)  # nothing is read
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert reason in error and error.count('\n') == 1
    assert {path: path.read_bytes() for path in Path().rglob('*') if path.is_file()} == before


@pytest.mark.parametrize('magic', [b'\x89MCAP0\r\n', b'SQLite format 3\x00', b'#ROSBAG V2.0\n',
                                   b'\x28\xb5\x2f\xfd'])
def test_recordings_of_every_format_are_spared(standing, tmp_path, capsys, magic):
    path = tmp_path / 'a.json'
    path.write_bytes(magic + b'and more')
    assert main(['info', '--json', str(path), str(standing)]) == 2
    assert path.read_bytes() == magic + b'and more'


def test_other_files_are_replaced(standing, tmp_path, capsys):
    path = tmp_path / 'a.mcap'
    path.write_text('{}')
    assert main(['info', '--json', str(path), str(standing)]) == 0
    assert json.loads(path.read_text())['topics']


# What a recording says

MARK = 'touch_me'
NASTY = f'../../{MARK}; $(touch {MARK}) `touch {MARK}`; __import__("os").system("touch {MARK}")'
# A process that notes every event of the interpreter that the mark reaches, files and code, and
# every process that is started.
WATCHED = f"""
import json, os, sys
from ins_align.cli import main
import ins_align.offline, ins_align.recordings.info, ins_align.report
import matplotlib.figure, matplotlib.backends.backend_agg
seen = os.open(sys.argv[1], os.O_WRONLY | os.O_APPEND)
STARTED = 'os.system', 'os.exec', 'os.fork', 'os.posix_spawn', 'os.spawn', 'subprocess.Popen'
def watch(event, arguments):
    if event in STARTED or {MARK!r} in repr(arguments):
        line = json.dumps([event, repr(arguments)[:200]])
        os.write(seen, (line + chr(10)).encode())
sys.addaudithook(watch)
statuses = [main(arguments) for arguments in json.loads(sys.argv[2])]
os.write(seen, (json.dumps(statuses) + chr(10)).encode())
"""


def nasty_recording(path, kind):
    """Write a recording with names of topics and frames that want to become commands or paths."""
    store = typestore(kind.startswith('ros1'))
    topics = {f'/{NASTY}/{name}': msgtype for name, msgtype in (
        ('imu', IMU), ('fix', FIX), ('velocity', TWIST))}
    imu, fix, velocity = topics
    messages = []
    for k in range(300):
        stamp = START_NS + k * 10_000_000
        messages.append((imu, stamp, make_imu(store, stamp, [0.001 * (k % 3), 0.0, 0.0],
                                              [0.0, 0.01 * (k % 5), 9.81], NASTY, k)))
        if k % 20 == 0:
            messages.append((fix, stamp + 1, make_fix(store, stamp)))
            messages[-1][2].header.frame_id = NASTY
            messages.append((velocity, stamp + 2, make_twist(store, stamp, [0.0, 0.0, 0.01],
                                                             NASTY)))
    return write_messages(path, kind, messages, topics)


def watched(folder, *commands):
    """Run command lines in a folder; return what the watch has seen, exit statuses, output."""
    with tempfile.NamedTemporaryFile() as file:
        done = subprocess.run([sys.executable, '-c', WATCHED, file.name,
                               json.dumps(commands, default=str)],
                              cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        *seen, statuses = [json.loads(line) for line in file.read().splitlines()]
    return seen, statuses, done.stdout


def test_the_watch_sees_files(standing, tmp_path):
    pytest.importorskip('matplotlib')
    (tmp_path / MARK).symlink_to(standing)
    assert watched(tmp_path, ['replay', MARK])[0]


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'ros1'])
def test_names_in_a_recording_reach_no_shell_file_or_code(tmp_path, kind):
    pytest.importorskip('matplotlib')
    nasty_recording(tmp_path / 'recording', kind)
    folder = tmp_path / 'a' / 'b' / 'c'
    folder.mkdir(parents=True)
    outputs = [f'out.{name}' for name in ('json', 'csv', 'png')]
    replay = ['replay', tmp_path / 'recording', '--json', outputs[0], '--csv', outputs[1],
              '--plot', outputs[2]]
    seen, statuses, out = watched(folder, replay, ['info', tmp_path / 'recording'])
    assert statuses == [1, 0] and seen == [] and MARK in out.partition('recorded from')[2]
    assert json.loads((folder / 'out.json').read_text())['counts']['imu'] == 300
    assert sorted(path.name for path in folder.iterdir()) == sorted(outputs)
    assert sorted(path.name for path in tmp_path.iterdir()) == ['a', 'recording']
    assert not list(tmp_path.rglob(f'*{MARK}*'))


def test_files_that_a_recording_names_elsewhere_are_not_read(standing, tmp_path):
    import yaml
    outside = tmp_path / f'{MARK}.db3'
    outside.write_bytes(next(standing.glob('*.db3')).read_bytes())
    inside = tmp_path / 'recording'
    inside.mkdir()
    metadata = yaml.safe_load((standing / 'metadata.yaml').read_text())
    metadata['rosbag2_bagfile_information']['relative_file_paths'] = [
        f'../{MARK}.db3', str(outside)]
    (inside / 'metadata.yaml').write_text(yaml.safe_dump(metadata))
    folder = tmp_path / 'here'
    folder.mkdir()
    seen, statuses, _ = watched(folder, ['replay', inside])
    assert statuses == [2]
    assert not [event for event in seen if event[0] in ('open', 'sqlite3.connect')]


@pytest.mark.parametrize('value', [
    f"!!python/object/apply:os.system ['touch {MARK}']", f'!!python/name:{MARK}.x', NASTY])
def test_parameters_reach_no_shell_file_or_code(standing, tmp_path, value):
    params = tmp_path / 'params.yaml'
    quoted = value if value.startswith('!!') else json.dumps(value)
    params.write_text(f'ins_align:\n  ros__parameters:\n    world_frame_id: {quoted}\n')
    folder = tmp_path / 'here'
    folder.mkdir()
    seen, statuses, _ = watched(folder, *(['replay', standing, *arguments] for arguments in (
        ['--params', params], ['--set', f'world_frame_id={value}'],
        ['--set', f'lever_arm={value}'])))
    assert len(statuses) == 3 and set(statuses) <= {1, 2} and seen == []
    assert not list(tmp_path.rglob(f'*{MARK}*'))
