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
"""The command line: exit statuses, outputs, and one sentence for whatever is wrong."""

import contextlib
import fcntl
import importlib
import json
import os
from pathlib import Path
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios

from ins_align.cli import main, SCENARIOS
from ins_align.outputs import names_for
from ins_align.recordings import ZSTD_MODULE
from ins_align.simulation.scenarios import trajectory_of
import pytest
from recordings import FIX, messages_of, real_recording, TWIST, write_recording

COMMAND = [sys.executable, '-m', 'ins_align.cli']


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    """Make a simulated flight with the command itself."""
    path = tmp_path_factory.mktemp('cli') / 'flight'
    assert main(['simulate', str(path), '--scenario', 'flight', '--imu', 'mems', '--seed', '1',
                 '--lever-arm', '1', '1', '1', '--duration', '25', '--gnss-rate', '2.5']) == 0
    return path


@pytest.fixture(scope='module')
def standing(tmp_path_factory):
    """Record a vehicle that stands still: heading is never found."""
    return write_recording(tmp_path_factory.mktemp('cli') / 'standing', 'sqlite3', 5.0)


def one_sentence(capsys):
    """Return what went to standard error after checking that it is one line."""
    captured = capsys.readouterr()
    assert captured.err.count('\n') == 1, captured.err
    assert 'Traceback' not in captured.err
    assert captured.out == ''
    return captured.err


def test_aligned(flight, tmp_path, capsys):
    outputs = {name: tmp_path / f'out.{name}' for name in ('json', 'csv', 'png')}
    assert main(['replay', str(flight), '--set', 'lever_arm=[1,1,1]', '--json',
                 str(outputs['json']), '--csv', str(outputs['csv']),
                 '--plot', str(outputs['png'])]) == 0
    captured = capsys.readouterr()
    assert captured.err == ''
    assert 'ALIGNED after' in captured.out
    result = json.loads(outputs['json'].read_text())
    assert list(result) == [
        'bag', 'aligned', 'state', 'reason', 'changes', 't0', 'time_to_align_s',
        'initial_attitude', 'declared_attitude', 'final_attitude', 'gyro_bias_rad_s',
        'accel_bias_m_s2', 'lever_arm_m', 'gnss_delay_s', 'counts']
    assert result['aligned'] is True and result['state'] == 'ALIGNED'
    assert type(result['t0']) is int and type(result['final_attitude']['stamp']) is int
    assert list(result['initial_attitude']) == [
        'quaternion_xyzw', 'roll_deg', 'pitch_deg', 'yaw_deg', 'sigma_deg']
    lines = outputs['csv'].read_text().splitlines()
    assert lines[0].startswith('stamp_ns,t_s,state,qx,qy,qz,qw,sigma_e_deg,sigma_n_deg,'
                               'sigma_u_deg,current_qx,')
    assert len(lines) == 1 + result['counts']['epochs_used']
    assert outputs['png'].read_bytes().startswith(b'\x89PNG')
    assert sorted(tmp_path.iterdir()) == sorted(outputs.values())


def test_parameter_file_of_the_simulation(flight, capsys):
    assert main(['replay', str(flight), '--params', str(flight / 'ins_align.yaml')]) == 0
    text = (flight / 'ins_align.yaml').read_text()
    assert text.startswith('/**:')              # of a node in any namespace


def test_parameter_file_covers_scale_factors(tmp_path, capsys):
    """With the preset alone, which has none, the residuals contradict the stated noise."""
    path = tmp_path / 'flight'
    assert main(['simulate', str(path), '--imu', 'navigation', '--gyro-scale-std', '0.01',
                 '--duration', '40']) == 0
    assert main(['replay', str(path), '--set', 'imu_grade=navigation']) == 1
    assert main(['replay', str(path), '--params', str(path / 'ins_align.yaml')]) == 0


@pytest.mark.parametrize('latency, delay', [('2', '0'), ('2', '10'), ('1', '0.2'), ('59.5', '0')])
def test_parameter_file_covers_latency(tmp_path, capsys, latency, delay):
    path = tmp_path / 'car'
    assert main(['simulate', str(path), '--scenario', 'car', '--seed', '1', '--duration',
                 str(20.0 + float(latency) + float(delay)), '--gnss-latency', latency,
                 '--gnss-delay', delay]) == 0
    assert main(['replay', str(path), '--params', str(path / 'ins_align.yaml'),
                 '--json', str(tmp_path / 'a.json')]) == 0
    counts = json.loads((tmp_path / 'a.json').read_text())['counts']
    assert not counts.get('fix_late') and not counts.get('velocity_late')


def test_not_aligned(standing, tmp_path, capsys):
    assert main(['replay', str(standing), '--json', str(tmp_path / 'a.json')]) == 1
    result = json.loads((tmp_path / 'a.json').read_text())
    assert result['aligned'] is False
    assert result['state'] != 'ALIGNED' and result['reason']
    assert result['time_to_align_s'] is None
    assert capsys.readouterr().out.rstrip().endswith(f'ins_align info {standing}')


@pytest.mark.parametrize('part, where', [
    (['--start', '1000'], 'after 1000 s'), (['--duration', '0'], 'between 0 s and 0 s'),
    (['--start', '50', '--duration', '10'], 'between 50 s and 60 s')])
def test_part_without_messages(flight, tmp_path, capsys, part, where):
    assert main(['replay', str(flight), *part, '--json', str(tmp_path / 'a.json')]) == 2
    assert one_sentence(capsys) == (f'ins_align replay: {flight} has no IMU or GNSS messages '
                                    f'{where}: it is 25.0 s long\n')
    assert list(tmp_path.iterdir()) == []


def test_too_little_for_an_attitude(flight, tmp_path, capsys):
    assert main(['replay', str(flight), '--start', '24.9', '--set', 'lever_arm=[1,2,3]',
                 '--json', str(tmp_path / 'a.json'), '--csv', str(tmp_path / 'a.csv'),
                 '--plot', str(tmp_path / 'a.png')]) == 1
    result = json.loads((tmp_path / 'a.json').read_text())
    assert all(result[f'{name}_attitude'] is None for name in ('initial', 'declared', 'final'))
    assert result['t0'] is None
    assert result['gyro_bias_rad_s'] == [0.0, 0.0, 0.0] and result['lever_arm_m'] == [1, 2, 3]
    assert len((tmp_path / 'a.csv').read_text().splitlines()) == 1


def test_several_recordings(flight, standing, tmp_path, capsys):
    missing = tmp_path / 'none'
    arguments = ['--set', 'lever_arm=[1,1,1]', '--json', str(tmp_path / 'a.json'), '--csv',
                 str(tmp_path / 'a.csv'), '--plot', str(tmp_path / 'a.svg')]
    assert main(['replay', str(flight), str(standing), *arguments]) == 1
    results = json.loads((tmp_path / 'a.json').read_text())
    assert [result['aligned'] for result in results] == [True, False]
    assert [result['bag'] for result in results] == [str(flight), str(standing)]
    assert {path.name for path in tmp_path.iterdir()} == {
        'a.json', 'a_flight.csv', 'a_standing.csv', 'a_flight.svg', 'a_standing.svg'}
    capsys.readouterr()
    assert main(['replay', str(missing), str(standing), '--json', str(tmp_path / 'a.json')]) == 2
    captured = capsys.readouterr()
    assert captured.err.count('\n') == 1 and 'does not exist' in captured.err
    results = json.loads((tmp_path / 'a.json').read_text())
    assert 'does not exist' in results[0]['error']
    assert results[1]['state']


def test_jobs_do_not_change_the_output(flight, standing, tmp_path, capsys):
    bags = [str(flight), str(standing), str(tmp_path / 'none'), str(flight)]
    outputs = []
    for jobs in ('1', '3'):
        assert main(['replay', *bags, '--jobs', jobs, '--json', str(tmp_path / 'a.json'),
                     '--csv', str(tmp_path / 'a.csv')]) == 2
        captured = capsys.readouterr()
        files = {path.name: path.read_text() for path in tmp_path.iterdir()}
        outputs.append((captured.out, captured.err, files))
    assert outputs[0] == outputs[1]
    assert set(outputs[0][2]) == {'a.json', 'a_flight_1.csv', 'a_flight_4.csv', 'a_standing_2.csv'}


def _killed(*arguments):
    os.kill(os.getpid(), signal.SIGKILL)
    yield


def test_a_process_that_is_killed_on_the_way(flight, monkeypatch, capsys):
    monkeypatch.setattr('ins_align.recordings.reader.read', _killed)
    assert main(['replay', str(flight), str(flight), '--jobs', '2']) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 2 and all('a process died on the way' in error for error in errors)


@pytest.mark.parametrize('bags', [
    ['x/a', 'y/a_1', 'z/a'], ['x/a', 'y/a_3', 'z/a'], ['a', 'a', 'a_2', 'a_1', 'a_2_2'],
    ['a', 'b.mcap', 'c.0.db3'], ['a_1', 'a', 'a_1', 'a']])
def test_no_recording_writes_over_the_files_of_another(bags):
    names = names_for('x/out.csv', bags)
    assert len(set(names)) == len(bags)
    for bag, name in zip(bags, names):
        assert name.startswith(f'x/out_{Path(bag).name.split(".")[0]}') and name.endswith('.csv')


def test_without_a_command_it_shows_the_help(capsys):
    assert main([]) == 2
    captured = capsys.readouterr()
    assert captured.err == '' and 'replay' in captured.out


@pytest.mark.parametrize('command', ['info', 'replay'])
def test_json_to_standard_output_is_nothing_but_json(standing, capsys, command):
    main([command, str(standing), '--json', '-'])
    assert json.loads(capsys.readouterr().out)['bag'] == str(standing)
    main([command, str(standing), str(standing), '--json', '-'])
    assert len(json.loads(capsys.readouterr().out)) == 2


def test_one_spelling_of_the_lever_arm(standing, capsys):
    main(['replay', str(standing), '--lever-arm', '-1', '0', '2.5', '--json', '-'])
    first = json.loads(capsys.readouterr().out)
    main(['replay', str(standing), '--set', 'lever_arm=[-1,0,2.5]', '--json', '-'])
    assert json.loads(capsys.readouterr().out) == first
    assert main(['replay', str(standing), '--lever-arm', 'nan', '0', '0']) == 2
    assert 'finite' in one_sentence(capsys)


@pytest.mark.parametrize('arguments, message', [
    (['--csv', '-'], 'nothing but --json can go to standard output'),
    (['--set', 'lever_arm=[1,2]'], 'lever_arm must be 3 finite numbers in m from -1000'),
    (['--set', 'lever_arm=[1,2,.nan]'], 'finite'),
    (['--set', 'lever_arm=[1,2,.inf]'], 'finite'),
    (['--set', 'lever_am=[1,2,3]'], 'did you mean lever_arm'),
    (['--set', 'method'], 'NAME=VALUE'),
    (['--params', 'no/such/file.yaml'], 'No such file'),
    *(([option, ''], 'cannot') for option in ('--params', '--json', '--csv', '--plot', '--bag')),
    (['--imu-topic', '/no/such'], 'has no topic /no/such; it has /fix'),
    (['--imu-topic', '/fix'], 'IMU needs sensor_msgs/Imu'),
    (['--velocity-topic', '/fix'], 'velocity needs'),
    (['--json', 'no/such/directory/a.json'], 'there is no directory'),
    (['--json', 'a', '--csv', 'a'], 'a is given for two outputs'),
    (['--json', '.'], 'is a directory or a device'),
    (['--plot', 'a.xyz'], 'must end with'),
    (['--plot', 'a'], 'must end with')])
def test_wrong_arguments(standing, capsys, arguments, message):
    assert main(['replay', str(standing), *arguments]) == 2
    assert message in one_sentence(capsys)


@pytest.mark.parametrize('arguments, says', [
    ('replay', 'arguments are required'), ('simulate', 'arguments are required'),
    ('fly', 'invalid choice'), ('experiment x', 'arguments are required'),
    ('replay x --bogus', 'unrecognized arguments: --bogus'),
    ('info x --bogus 3', 'unrecognized arguments: --bogus 3'),
    ('replay x --jobs 0', "--jobs: must be a whole number, 1 or above, got '0'"),
    ('replay x --start a', "--start: must be a number of seconds, 0 or above, got 'a'"),
    ('replay x --start -1', 'must be a number of seconds'),
    ('replay x --start nan', 'must be a number of seconds'),
    ('simulate x --seed a', "invalid int value: 'a'"),
    ('simulate x --lever-arm 1 2', 'expected 3 arguments')])
def test_wrong_usage_names_the_help_of_the_command(capsys, arguments, says):
    command = '' if arguments == 'fly' else f' {arguments.split()[0]}'
    with pytest.raises(SystemExit) as info:
        main(arguments.split())
    assert info.value.code == 2
    sentence = one_sentence(capsys)
    assert sentence.startswith(f'ins_align{command}: ') and says in sentence
    assert sentence.endswith(f'; see "ins_align{command} --help"\n')


def test_version(capsys):
    from importlib.metadata import version
    with pytest.raises(SystemExit) as info:
        main(['--version'])
    assert not info.value.code
    assert capsys.readouterr().out == f'ins_align {version("ins_align")}\n'


def test_help_names_the_experiments(capsys):
    from ins_align.experiments import MEASUREMENTS, NAMES
    with pytest.raises(SystemExit):
        main(['experiment', '--help'])
    words = re.findall(r'\w[\w-]*', capsys.readouterr().out)
    assert {*NAMES, 'all', *MEASUREMENTS} <= set(words)


def test_unusable_file(tmp_path, capsys):
    (tmp_path / 'a.mcap').write_bytes(b'x' * 100)
    assert main(['replay', str(tmp_path / 'a.mcap'), '--json', str(tmp_path / 'a.json')]) == 2
    assert 'no recording' in one_sentence(capsys)
    assert not (tmp_path / 'a.json').exists()


@pytest.mark.parametrize('command', ['replay', 'info'])
def test_files_of_recordings_are_told_apart(tmp_path, capsys, monkeypatch, command):
    """Those of one recorder have the same names."""
    bags = []
    for name in ('monday', 'tuesday'):
        bags.append(str(write_recording(tmp_path / name / 'bag', 'mcap', 2.0)))
        file, = (tmp_path / name / 'bag').glob('*.mcap')
        file.write_bytes(b'' if name == 'monday' else file.read_bytes()[:-100])
    assert main([command, bags[0]]) == 2
    assert one_sentence(capsys) == f'ins_align {command}: {bags[0]}: bag.mcap is empty\n'
    assert main([command, *bags]) == 2
    error = capsys.readouterr().err
    assert f'ins_align {command}: {bags[0]}: bag.mcap is empty\n' in error
    assert f'ins_align {command}: warning: {bags[1]}: bag.mcap was cut off' in error
    monkeypatch.chdir(tmp_path)
    assert main([command, '']) == 2
    assert f'{command}: . holds no recording' in one_sentence(capsys)
    assert main([command, str(tmp_path / 'missing')]) == 2
    assert f'{command}: {tmp_path}/missing does not exist' in one_sentence(capsys)


@pytest.mark.parametrize('command', ['replay', 'info'])
def test_recording_from_a_pipe(standing, command):
    done = subprocess.run([*COMMAND, command, '/dev/stdin'], input=b'\x89MCAP0\r\n',
                          capture_output=True, cwd=Path(__file__).parents[1])
    assert done.returncode == 2
    assert done.stderr.decode() == (f'ins_align {command}: /dev/stdin is a pipe or a device, from '
                                    'which no recording can be read: give a file\n')


@pytest.mark.parametrize('kind', ['mcap', 'sqlite3', 'ros1'])
def test_no_imu(tmp_path, capsys, kind):
    path = write_recording(tmp_path / 'a.bag', kind, 1.0, {'/fix': FIX, '/fix_velocity': TWIST})
    assert main(['replay', str(path)]) == 2
    assert ('no IMU topic (sensor_msgs/Imu); it has /fix (sensor_msgs/NavSatFix), /fix_velocity ('
            in one_sentence(capsys))


@pytest.mark.parametrize('kind, reason', [
    ('mcap', 'cut off'), ('sqlite3', '.dump'), ('ros1', 'rosbag reindex a.bag')])
def test_cut_off_to_nothing(tmp_path, capsys, kind, reason):
    path = write_recording(tmp_path / 'a.bag', kind, 5.0)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != '.yaml')
    file.write_bytes(file.read_bytes()[:64])
    assert main(['replay', str(path)]) == 2
    assert reason in one_sentence(capsys)


def test_cut_off_is_used_as_far_as_it_goes(flight, tmp_path, capsys):
    file = next(flight.glob('*.mcap'))
    (tmp_path / 'cut.mcap').write_bytes(file.read_bytes()[:-100_000])
    status = main(['replay', str(tmp_path / 'cut.mcap'), '--set', 'lever_arm=[1,1,1]'])
    captured = capsys.readouterr()
    assert status == 0
    assert captured.err == (f'ins_align replay: warning: {tmp_path}/cut.mcap was cut off or is '
                            'damaged: it is read as far as it goes\n')


@pytest.mark.parametrize('name', ['uav_thor75', 'car_drive0708', 'quad_dot08.bag'])
@pytest.mark.parametrize('method', [pytest.param('vif', marks=pytest.mark.campaign), 'bank'])
def test_real_recordings(tmp_path, capsys, name, method):
    path = real_recording(name)
    status = main(['replay', str(path), '--set', f'method={method}', '--duration', '60',
                   '--json', str(tmp_path / 'a.json'), '--csv', str(tmp_path / 'a.csv'),
                   '--plot', str(tmp_path / 'a.png')])
    assert status in (0, 1)
    result = json.loads((tmp_path / 'a.json').read_text())
    assert result['aligned'] == (status == 0)
    assert result['counts']['imu'] > 1000


def test_simulate_refuses_in_a_sentence(tmp_path, capsys):
    assert main(['simulate', str(tmp_path / 'a'), '--scenario', 'submarine']) == 2
    assert 'flight' in one_sentence(capsys)
    assert main(['simulate', str(tmp_path), '--duration', '1']) == 2
    assert 'exists already' in one_sentence(capsys)
    assert main(['simulate', str(tmp_path / 'a'), '--imu', 'perfect']) == 2
    assert 'mems' in one_sentence(capsys)


@pytest.mark.parametrize('module, package', [('rosbags.rosbag2', 'rosbags'),
                                             ('pyins.sim', 'python-ins')])
def test_what_to_install(tmp_path, capsys, monkeypatch, module, package):
    trajectory_of.cache_clear()  # a trajectory that is kept needs no pyins
    monkeypatch.setitem(sys.modules, module, None)
    assert main(['simulate', str(tmp_path / 'a'), '--duration', '10']) == 2
    assert f'{module} is not installed: pip install {package}\n' in one_sentence(capsys)


def test_simulate_passes_its_options_on(tmp_path, capsys):
    from ins_align.recordings.bag import Bag
    assert main(['simulate', str(tmp_path / 'a'), '--duration', '10', '--imu-rate', '50',
                 '--gnss-rate', '2', '--outage', '2', '8', '--storage', 'sqlite3']) == 0
    with Bag(tmp_path / 'a') as bag:
        names = [topic.name for topic, _, _ in messages_of(bag)]
    assert names.count('/imu/data_raw') in (500, 501)
    assert names.count('/fix') == 8


def test_help_names_the_scenarios():
    from ins_align.simulation.scenarios import SCENARIOS as simulated
    assert SCENARIOS.split(', ') == list(simulated)


@pytest.mark.parametrize('command', [[], ['info'], ['replay'], ['simulate'], ['experiment']])
def test_help_imports_nothing_heavy(command):
    code = ('import sys; from ins_align.cli import main\n'
            'try: main(sys.argv[1:])\n'
            'except SystemExit as stop: assert stop.code == 0\n'
            'assert not {"numpy", "rosbags", "matplotlib", "yaml"} & set(sys.modules)')
    subprocess.run([sys.executable, '-c', code, *command, '--help'], check=True,
                   stdout=subprocess.DEVNULL, cwd=Path(__file__).parents[1])


@pytest.mark.parametrize('jobs', ['1', '2'])
def test_interrupt(flight, tmp_path, jobs):
    """Ctrl-C leaves without a traceback, with all its processes and what they have unpacked."""
    file, = flight.glob('*.mcap')
    packed = tmp_path / 'flight.mcap.zstd'
    packed.write_bytes(importlib.import_module(ZSTD_MODULE).compress(file.read_bytes()))
    (tmp_path / 'unpacked').mkdir()
    process = subprocess.Popen(
        [*COMMAND, 'replay', *[str(packed)] * 200, '--jobs', jobs], text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=Path(__file__).parents[1],
        env={**os.environ, 'TMPDIR': str(tmp_path / 'unpacked')},
        # A shell makes what it starts in the background deaf to Ctrl-C, tests too.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors == ''
    assert not list((tmp_path / 'unpacked').glob('ins_align_*'))


def test_workers_end_with_a_killed_parent(flight):
    read, write = os.pipe()  # whoever lives holds an end of it
    process = subprocess.Popen(
        [*COMMAND, 'replay', *[str(flight)] * 200, '--jobs', '2'], pass_fds=[write],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=Path(__file__).parents[1])
    os.close(write)
    process.stdout.readline()
    process.kill()
    assert select.select([read], [], [], 30.0)[0] and os.read(read, 1) == b''
    os.close(read)
    process.communicate()


@pytest.mark.skipif(not Path('/dev/full').is_char_device(), reason='no /dev/full')
@pytest.mark.parametrize('command', [['replay'], ['info']])
def test_output_without_room(flight, command):
    with open('/dev/full', 'w') as full:
        done = subprocess.run([*COMMAND, *command, flight], stdout=full, stderr=subprocess.PIPE,
                              text=True, cwd=Path(__file__).parents[1])
    assert done.returncode == 2 and 'No space left' in done.stderr
    assert done.stderr.count('\n') == 1


def test_parameters_of_others_in_a_file_are_told(flight, tmp_path, capsys):
    path = tmp_path / 'many.yaml'
    text = (flight / 'ins_align.yaml').read_text()
    path.write_text(
        text + '/**:\n  ros__parameters:\n    map_frame: map\n    hold_tme: 2.0\n')
    assert main(['replay', str(flight), '--params', str(path)]) == 0
    said = capsys.readouterr().err
    assert "parameter 'map_frame'" in said and 'is not known: did you mean hold_time?' in said


@pytest.mark.parametrize('command, encoding, name, shown', [
    ('replay', 'ascii', 'Übung', r'\xdcbung'), ('info', 'ascii', 'Übung', r'\xdcbung'),
    ('replay', 'latin-1', 'Übung 日', r'Übung \u65e5'),
    ('replay', 'utf-8', 'a\udcff', r'a\udcff')])
def test_streams_of_another_encoding(standing, tmp_path, command, encoding, name, shown):
    (tmp_path / name).symlink_to(standing)
    (tmp_path / f'{name}.json').write_text('x')
    done = subprocess.run(
        [*COMMAND, command, tmp_path / name, tmp_path / f'{name}.json'],
        capture_output=True, cwd=Path(__file__).parents[1],
        env={**os.environ, 'PYTHONIOENCODING': encoding})
    assert done.returncode == 2
    assert f'{shown}\n' in done.stdout.decode(encoding)
    assert 'no recording' in done.stderr.decode(encoding)
    assert 'Traceback' not in done.stderr.decode(encoding)


@pytest.mark.parametrize('command', ['replay', 'info'])
@pytest.mark.parametrize('buffered', [[], ['-u']])
def test_reader_that_leaves(standing, command, buffered):
    """As in ``ins_align replay ... | head -1``: no traceback, the status that shells give."""
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([sys.executable, *buffered, *COMMAND[1:], command, standing],
                          stdout=writing, stderr=subprocess.PIPE, cwd=Path(__file__).parents[1])
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, b'')


def test_progress_bar_on_a_terminal(flight, tmp_path):
    pytest.importorskip('tqdm')
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack('4H', 24, 80, 0, 0))
    process = subprocess.Popen([*COMMAND, 'replay', str(flight)], stdout=subprocess.PIPE,
                               stderr=slave, text=True, cwd=Path(__file__).parents[1])
    os.close(slave)
    shown = b''
    with contextlib.suppress(OSError):  # the terminal goes away with the process
        while piece := os.read(master, 4096):
            shown += piece
    os.close(master)
    out, _ = process.communicate(timeout=60)
    assert b'%' in shown
    assert 'ALIGN' in out and '%' not in out
