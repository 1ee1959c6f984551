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
"""What real drivers do to a node: each fault counted, none of them fatal, the attitude right."""

from copy import deepcopy
from itertools import groupby
import re

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from ins_align.geometry.rotation import matrix_from_quaternion
from ins_align.simulation.simulate import simulate
from nav_msgs.msg import Odometry
from node_harness import (
    attitude_error_deg, FIX, IMU, Listener, play, RELIABLE, running_node, script_of,
    simulated_messages, stamp_ns, values_of, VELOCITY)
import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

RATE = 10.0  # times real time
DURATION = 16.0  # s
# A tactical IMU aligns within 8 s of this flight. GNSS may be late by as much as in real time.
PARAMETERS = ['imu_grade:=tactical', 'lever_arm:=[1, 1, 1]', 'velocity_std:=0.1',
              'velocity_std_vertical:=0.1', 'gnss_lateness:=5.0', *RELIABLE]
TOLERANCE_DEG = 2.0


def flight(**options):
    options = {'imu_grade': 'tactical', 'seed': 1, 'duration': DURATION, **options}
    return simulate('flight', **options)


def check_attitude(attitude, simulation):
    error = attitude_error_deg(attitude.quaternion, simulation.attitude_at(stamp_ns(attitude)))
    assert np.linalg.norm(error) < TOLERANCE_DEG


def wait_until_taken(listener, messages):
    """Wait until the node has counted all positions, then for a status that knows the rest."""
    total = sum(message[1] == FIX for message in messages)
    listener.wait_for(lambda: listener.count('fix') >= total)
    listener.wait_for_next_status()


@pytest.mark.campaign
def test_faulty_drivers(tmp_path):
    simulation = flight(duration=30.0, imu_jitter=0.2, gnss_rate=10.0, gnss_latency=0.9)
    messages, faults = spoilt(simulated_messages(simulation))
    with Listener() as listener, running_node(PARAMETERS):
        play(script_of(messages), tmp_path, RATE)
        wait_until_taken(listener, messages)
    assert {name: listener.count(name) for name in faults} == faults
    assert listener.count('imu_gap') >= 1
    assert listener.heard_state == 'ALIGNED'
    # The 0.2 s that the IMU lost may withdraw it for a moment: then it is published again.
    assert listener.attitudes
    for attitude in listener.attitudes:
        check_attitude(attitude, simulation)


def spoilt(messages):
    """Return messages as bad drivers publish them and the counts that must be seen."""
    imu = [message for message in messages if message[1] == IMU]
    fixes = [message for message in messages if message[1] == FIX]
    velocities = [message for message in messages if message[1] == VELOCITY]
    faults = dict.fromkeys(('imu_duplicate', 'imu_out_of_order', 'imu_nan', 'fix_no_fix',
                            'fix_nan', 'fix_duplicate', 'fix_status_unknown', 'fix_late',
                            'velocity_nan', 'velocity_duplicate'), 0)
    samples = []
    for k, message in enumerate(imu):
        if k % 90 == 10 or 700 <= k < 720:
            continue  # lost
        samples.append(message)
        if k % 70 == 20:
            samples.append(message)
            faults['imu_duplicate'] += 1
        elif k % 70 == 40:
            samples[-2:] = [(samples[-2][0], IMU, message[2]), (message[0], IMU, samples[-2][2])]
            faults['imu_out_of_order'] += 1
        elif k % 170 == 50:
            message[2].angular_velocity.y = float('nan')
            faults['imu_nan'] += 1
    positions = []
    for k, (time_ns, topic, msg) in enumerate(fixes):
        if k % 10 == 3:
            msg.status.status = -1
            faults['fix_no_fix'] += 1
        elif k % 10 == 5:
            msg.latitude = msg.longitude = msg.altitude = float('nan')
            faults['fix_nan'] += 1
        elif k % 10 == 7:
            msg.status.status = -2
            faults['fix_status_unknown'] += 1
        msg.position_covariance = [(0.0, -1.0, float('nan'))[k % 3]] * 9
        msg.position_covariance_type = k % 4
        positions.append((time_ns, topic, msg))
        if k % 10 == 9:
            again = deepcopy(msg)
            again.latitude += 1.0
            positions.append((time_ns + 1, topic, again))
            faults['fix_duplicate'] += 1
    hopeless = deepcopy(fixes[20][2])
    positions.append((fixes[-1][0], FIX, hopeless))
    faults['fix_late'] += 1
    speeds = []
    for k, (time_ns, topic, msg) in enumerate(velocities):
        if k % 10 == 4:
            msg.twist.twist.linear.x = float('nan')
            faults['velocity_nan'] += 1
        msg.twist.covariance = [(0.0, -1.0, float('nan'))[k % 3]] * 36
        speeds.append((time_ns, topic, msg))
        if k % 10 == 8:
            again = deepcopy(msg)
            again.twist.twist.linear.x += 10.0
            speeds.append((time_ns + 1, topic, again))
            faults['velocity_duplicate'] += 1
    return sorted(samples + positions + speeds, key=lambda message: message[0]), faults


def as_twist(msg, kind):
    """Return the same velocity in another message, north-east-down."""
    other = TwistStamped() if kind == 'TwistStamped' else Odometry()
    other.header = msg.header
    velocity = msg.twist.twist.linear
    linear = other.twist.linear if kind == 'TwistStamped' else other.twist.twist.linear
    linear.x, linear.y, linear.z = velocity.y, velocity.x, -velocity.z
    return other


@pytest.mark.parametrize('kind', [
    pytest.param('TwistStamped', marks=pytest.mark.campaign), 'Odometry'])
def test_velocity_of_another_type_north_east_down(kind, tmp_path):
    simulation = flight()
    messages = [(time_ns, topic, as_twist(msg, kind) if topic == VELOCITY else msg)
                for time_ns, topic, msg in simulated_messages(simulation)]
    with Listener() as listener, running_node(
            [f'velocity_type:={kind}', 'velocity_frame:=ned', *PARAMETERS]):
        play(script_of(messages), tmp_path, RATE)
        wait_until_taken(listener, messages)
    attitude, = listener.attitudes
    check_attitude(attitude, simulation)


def test_receiver_without_vertical_velocity_on_best_effort(tmp_path):
    simulation = flight()
    messages = simulated_messages(simulation)
    for _, topic, msg in messages:
        if topic == VELOCITY:
            msg.twist.twist.linear.z = 0.0
    parameters = ['velocity_vertical:=absent', *set(PARAMETERS) - set(RELIABLE)]
    with Listener() as listener, running_node(parameters):
        play(script_of(messages), tmp_path, RATE, 'best_effort')
        listener.wait_for(lambda: listener.attitudes)
    check_attitude(listener.attitudes[0], simulation)


def test_velocity_in_a_body_frame_is_refused(tmp_path):
    messages = simulated_messages(flight(duration=6.0))
    for _, topic, msg in messages:
        if topic == VELOCITY:
            msg.header.frame_id = 'base_link'
    with Listener() as listener, running_node(['use_velocity:=true', *PARAMETERS]):
        play(script_of(messages), tmp_path, RATE)
        wait_until_taken(listener, messages)
    assert listener.count('velocity_body_frame') == sum(topic == VELOCITY
                                                        for _, topic, _ in messages)
    assert listener.count('velocity') == 0
    assert ("no GNSS velocity yet: the velocity is given in the body frame 'base_link'"
            in listener.status['reason'])
    assert not listener.attitudes


@pytest.mark.campaign
def test_frame_of_the_imu_changes(tmp_path):
    simulation = flight(duration=36.0)
    messages = simulated_messages(simulation)
    half = simulation.imu_stamps_ns[len(simulation.imu_stamps_ns) // 2]
    for time_ns, topic, msg in messages:
        if topic == IMU and time_ns >= half:
            msg.header.frame_id = 'imu_of_the_other_make'
    with Listener() as listener, running_node(PARAMETERS) as node:
        listener.wait_for(lambda: listener.statuses)  # the two have found each other
        play(script_of(messages), tmp_path, RATE)
        wait_until_taken(listener, messages)
    assert listener.count('imu_frame_changed') == listener.count('resets') == 1
    assert "'imu_link' to 'imu_of_the_other_make'" in node.output
    first, second = listener.attitudes
    assert stamp_ns(first) < half <= stamp_ns(second)
    check_attitude(first, simulation)
    check_attitude(second, simulation)
    assert listener.statuses[-1].status[0].hardware_id == 'imu_of_the_other_make'


@pytest.mark.campaign
def test_two_imus_on_one_topic(tmp_path):
    simulation = flight(duration=24.0)
    messages = simulated_messages(simulation)
    messages += [(time_ns, topic, replaced_imu(msg)) for time_ns, topic, msg in messages
                 if topic == IMU]
    messages.sort(key=lambda message: message[0])
    with Listener(imu=True) as listener, running_node(PARAMETERS) as node:
        listener.wait_for(lambda: listener.statuses)
        play(script_of(messages), tmp_path, 3.0)
        wait_until_taken(listener, messages)
    # They change places once, then one of them is left out.
    assert listener.count('imu_frame_changed') == listener.count('resets') == 1
    assert listener.count('imu_other_frame') > 2000
    assert node.output.count('two IMUs send on one topic') == 1
    assert listener.attitudes
    used = listener.statuses[-1].status[0].hardware_id
    assert {msg.header.frame_id for msg in listener.imus} == {used}


def replaced_imu(msg):
    """Return the sample of another IMU that is mounted upside down."""
    other = deepcopy(msg)
    other.header.frame_id = 'second_imu'
    for vector in (other.angular_velocity, other.linear_acceleration):
        vector.y, vector.z = -vector.y, -vector.z
    return other


@pytest.mark.campaign
def test_an_imu_that_sends_no_numbers_is_silent(tmp_path):
    messages = simulated_messages(flight(duration=20.0))
    for k, (_, topic, msg) in enumerate(messages):
        if topic == IMU and k > 2 * len(messages) // 3:
            msg.angular_velocity.y = float('nan')
    with Listener() as listener, running_node(PARAMETERS):
        play(script_of(messages), tmp_path, 3.0)
        wait_until_taken(listener, messages)
        listener.wait_for(lambda: 'no IMU sample' in listener.status['reason'])
    assert listener.attitudes
    assert listener.statuses[-1].status[0].level == DiagnosticStatus.WARN
    assert listener.count('imu_nan') > 500


def test_an_imu_that_falls_silent_is_told(tmp_path):
    messages = simulated_messages(flight(duration=27.0))
    split = 2 * len(messages) // 3
    with Listener() as listener, running_node(PARAMETERS):
        play(script_of(messages[:split]), tmp_path, RATE)
        listener.wait_for(lambda: 'no IMU sample for 3 s' in listener.status.get('reason', ''))
        assert listener.status['state'] == 'WAITING_FOR_IMU'
        assert listener.statuses[-1].status[0].level == DiagnosticStatus.WARN
        play(script_of(messages[split:]), tmp_path, 3.0)  # long enough for a status
        wait_until_taken(listener, messages)
        listener.wait_for(lambda: 'no IMU sample for' in listener.status['reason'])
    values = [values_of(status) for status in listener.statuses]
    told = [(each['state'], 'no IMU sample for' in each['reason']) for each in values]
    # Silent, heard, and silent once more; the alignment outlasts it.
    silent, heard = ('WAITING_FOR_IMU', True), ('ALIGNED', False)
    assert [each for each, _ in groupby(told)][-3:] == [silent, heard, silent]
    assert listener.count('imu_gap') == 0  # by the stamps there was none
    assert len(listener.attitudes) == 1


@pytest.mark.campaign
def test_a_bag_that_loops_in_simulated_time(tmp_path):
    simulation = flight()
    once = simulated_messages(simulation)
    start = once[0][0]
    for k in range(round(DURATION * 20)):
        clock = Clock()
        clock.clock.sec, clock.clock.nanosec = divmod(start + k * 50_000_000, 1_000_000_000)
        once.append((start + k * 50_000_000, '/clock', clock))
    once.sort(key=lambda message: message[0])
    pause = round((DURATION + 5.0 * RATE) * 1e9)
    twice = once + [(time_ns + pause, topic, msg) for time_ns, topic, msg in once]
    with Listener() as listener, running_node(['use_sim_time:=true', *PARAMETERS]) as node:
        play(script_of(twice), tmp_path, RATE)
        wait_until_taken(listener, once)
        listener.wait_for(lambda: len(listener.attitudes) == 2)
    assert listener.count('clock_jumps') == 1
    assert 'jumped back' in node.output
    # The same messages, the same attitude: nothing of the first round is left in the second.
    first, second = listener.attitudes
    assert stamp_ns(first) == stamp_ns(second)
    difference = attitude_error_deg(
        second.quaternion, matrix_from_quaternion(np.array([
            first.quaternion.x, first.quaternion.y, first.quaternion.z, first.quaternion.w])))
    assert np.linalg.norm(difference) < 1e-3
    check_attitude(first, simulation)
    # Stamped by /clock, and published while it stood still.
    end = start + round(DURATION * 1e9)
    stamps = [stamp_ns(msg) for msg in listener.statuses]
    assert start <= stamps[-1] < end
    assert len([stamp for stamp in stamps if end - stamp < 100_000_000]) >= 3


@pytest.mark.campaign
def test_reset_in_the_middle(tmp_path):
    simulation = flight(duration=36.0)
    messages = simulated_messages(simulation)
    half = simulation.imu_stamps_ns[len(simulation.imu_stamps_ns) // 2]
    before = [message for message in messages if message[0] < half]
    after = [message for message in messages if message[0] >= half]
    with Listener() as listener, running_node(PARAMETERS) as node:
        play(script_of(before), tmp_path, RATE)
        listener.wait_for(lambda: listener.attitudes)
        assert listener.call(Trigger, '/ins_align/reset', Trigger.Request()).success
        # What does not hold any more is not handed to those who come now.
        with Listener(name='late') as late:
            late.wait_for(lambda: len(late.statuses) >= 2)
            assert not late.attitudes
            assert late.status['state'] != 'ALIGNED'
            play(script_of(after), tmp_path, RATE)
            wait_until_taken(listener, messages)
            late.wait_for(lambda: late.attitudes)
    first, second = listener.attitudes
    assert late.attitudes == [second]
    assert stamp_ns(first) < half <= stamp_ns(second)
    check_attitude(first, simulation)
    check_attitude(second, simulation)
    assert listener.count('resets') == 1
    assert severities(node, 'ALIGNED: (?!.*no IMU sample)') == ['INFO', 'INFO']
    assert severities(node, 'alignment starts over: requested by service') == ['WARN']


@pytest.mark.campaign
def test_accelerations_in_g_are_an_error(tmp_path):
    messages = simulated_messages(flight(duration=12.0))
    for _, topic, msg in messages:
        if topic == IMU:
            force = msg.linear_acceleration
            force.x, force.y, force.z = force.x / 9.8, force.y / 9.8, force.z / 9.8
    with Listener() as listener, running_node(PARAMETERS) as node:
        listener.wait_for(lambda: listener.statuses)
        play(script_of(messages), tmp_path, RATE)
        listener.wait_for(lambda: listener.status['state'] == 'FAULT')
    assert set(severities(node, 'FAULT: ')) == {'ERROR'}


def severities(node, text):
    """Return how the log shows the lines that begin with a text."""
    return re.findall(rf'\[(\w+)\] \[[\d.]+\] \[ins_align\]: {text}', node.output)
