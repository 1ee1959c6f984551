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
"""The node by itself: parameters, signals, topics, services, without any sensor."""

from dataclasses import fields
from itertools import cycle
import json
import os
import signal
import subprocess
import sys
import time

from ins_align.config import Config
from node_harness import Listener, NodeProcess, running_node
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from std_srvs.srv import Trigger


def set_parameter(listener, name, value):
    request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
    return listener.call(SetParameters, '/ins_align/set_parameters', request).results[0]


def double(value):
    return ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)


WRONG = (
    (['-p', 'lever_arm:=[1, 2]'], 'lever_arm must be 3 finite numbers'),
    (['-p', 'lever_arm:=[]'], 'an empty list: write its numbers, as lever_arm:=[0.0, 0.0, 0.0]'),
    (['-p', 'lever_arm:=[1.0, .nan, 0.0]'], 'lever_arm must be 3 finite numbers'),
    (['-p', 'hold_time:=-1'], 'hold_time must be a finite number in s from 0 to 3600'),
    (['-p', 'imu_grade:=golden'],
     'imu_grade must be one of navigation, tactical, mems, chip, custom'),
    (['-p', 'imu_grade:=custom'], 'missing: angle_random_walk'),
    (['-p', 'velocity_frame:=body'], 'velocity_frame must be one of auto, enu, ned'),
    (['-p', 'qos_overrides./fix.subscription.reliability:=perhaps'], 'reliability'),
    (['--params-file', 'no_such_file.yaml'], 'no_such_file.yaml'),
    (['--no-such-option'], '--no-such-option'),
    (['--', '--params-file', 'p.yaml'], 'unrecognized arguments: --params-file p.yaml'),
)


# Imports once and starts the node many times, with the outputs in files; prints exit statuses.
STARTS = """
import json, os, sys
from ins_align.ros import main, node
for number, arguments in enumerate(json.loads(sys.argv[1])):
    if not os.fork():
        for stream in (1, 2):
            os.dup2(os.open(str(number), os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
        sys.exit(main.main(['--ros-args', *arguments]))
    print(os.waitstatus_to_exitcode(os.wait()[1]), flush=True)
"""


def test_what_is_wrong_at_start_is_refused_with_a_sentence(tmp_path):
    done = subprocess.run(
        [sys.executable, '-c', STARTS, json.dumps([arguments for arguments, _ in WRONG])],
        cwd=tmp_path, check=True, stdout=subprocess.PIPE, text=True, timeout=60)
    assert done.stdout.split() == ['2'] * len(WRONG)
    for number, (_, says) in enumerate(WRONG):
        output = (tmp_path / str(number)).read_text()
        assert says in output and 'Traceback' not in output


def test_without_ros_it_says_what_to_do():
    hide = "import sys; sys.modules.update(dict.fromkeys(['rclpy', 'diagnostic_msgs']))"
    done = subprocess.run(
        [sys.executable, '-c', f'{hide}; from ins_align.ros.main import main; sys.exit(main([]))'],
        capture_output=True, text=True)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
    assert 'source /opt/ros/jazzy/setup.bash' in done.stderr


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_cleanly(number):
    with Listener() as listener:
        node = NodeProcess()
        listener.wait_for(lambda: listener.statuses)
        assert node.stop(number) == 0
    assert 'Traceback' not in node.output
    assert 'rror' not in node.output


def test_more_signals_while_it_ends_change_nothing():
    with Listener() as listener:
        node = NodeProcess()
        listener.wait_for(lambda: listener.statuses)
        for number in cycle([signal.SIGINT, signal.SIGTERM]):
            if node.status is not None:
                break
            os.kill(node.pid, number)
            time.sleep(0.01)
    assert node.wait() == 0
    assert 'Traceback' not in node.output


def test_parameters_and_status_of_an_idle_node():
    given = ['lever_arm:=[1, 2, 3]', 'use_velocity:=true', 'lever_am:=[1.0, 2.0, 3.0]']
    with Listener() as listener, running_node(given) as node:
        names = [field.name for field in fields(Config)]
        described = listener.call(DescribeParameters, '/ins_align/describe_parameters',
                                  DescribeParameters.Request(names=names)).descriptors
        values = listener.call(GetParameters, '/ins_align/get_parameters',
                               GetParameters.Request(names=['lever_arm'])).values
        # A threshold can change, with a reason if it must not, the rest cannot.
        assert set_parameter(listener, 'heading_std_threshold', double(0.5)).successful
        too_small = set_parameter(listener, 'heading_std_threshold', double(-0.5))
        word = set_parameter(listener, 'hold_time', ParameterValue(
            type=ParameterType.PARAMETER_STRING, string_value='long'))
        not_finite = set_parameter(listener, 'hold_time', double(float('nan')))
        read_only = set_parameter(listener, 'gnss_delay', double(0.1))
        changed = listener.call(
            GetParameters, '/ins_align/get_parameters',
            GetParameters.Request(names=['heading_std_threshold', 'hold_time', 'gnss_delay']))
        reset = listener.call(Trigger, '/ins_align/reset', Trigger.Request())
        listener.wait_for(lambda: listener.count('resets') == 1)
        listener.wait_for(lambda: listener.diagnostics)

    by_name = {descriptor.name: descriptor for descriptor in described}
    assert list(by_name) == names
    assert all(descriptor.description for descriptor in described)
    assert by_name['lever_arm'].description.endswith('[m]')
    assert by_name['lever_arm'].type == ParameterType.PARAMETER_DOUBLE_ARRAY
    assert by_name['velocity_frame'].additional_constraints == 'one of: auto, enu, ned'
    assert by_name['hold_time'].floating_point_range[0].to_value == 3600.0
    assert {name for name in names if not by_name[name].read_only} == {
        'heading_std_threshold', 'tilt_std_threshold', 'hold_time'}
    assert list(values[0].double_array_value) == [1.0, 2.0, 3.0]
    assert "parameter 'lever_am' is not known: did you mean lever_arm" in node.output

    for refused, says in ((too_small, 'range'), (word, 'type'), (not_finite, 'nan'),
                          (read_only, 'read-only')):
        assert not refused.successful
        assert says in refused.reason
    assert [value.double_value for value in changed.values] == [
        0.5, Config().hold_time, 0.0]
    assert reset.success

    status, = listener.statuses[-1].status
    assert status.level == status.WARN
    assert status.message.startswith('WAITING_FOR_IMU: ')
    assert listener.status['state'] == 'WAITING_FOR_IMU'
    assert listener.diagnostics[-1].status[0].name == 'ins_align: alignment'
    assert not listener.attitudes
