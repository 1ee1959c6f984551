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
"""What others make of the topics: navsat_transform, plots, two robots, types that do not match."""

from dataclasses import replace
import re
import sys
from types import SimpleNamespace

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped, Vector3Stamped
from ins_align.config import Config, ConfigError
from ins_align.geometry.rotation import matrix_from_quaternion, roll_pitch_yaw
from ins_align.gnss.drivers import gnss_from_msg
from ins_align.ros.inputs import gnss_topics, message_class
from ins_align.ros.node import ReasonLog
from ins_align.simulation.simulate import simulate
from node_harness import (
    Listener, playing, RELIABLE, running_node, script_of, simulated_messages, stamp_ns, values_of)
import numpy as np
import pytest
from sensor_msgs.msg import Imu
from std_msgs.msg import Header, UInt8

PARAMETERS = ['imu_grade:=tactical', 'lever_arm:=[1, 1, 1]', 'velocity_std:=0.1',
              'velocity_std_vertical:=0.1', 'gnss_lateness:=5.0', *RELIABLE]
# It is aligned after so many seconds; they are played ten times as fast as the rest.
ALIGNED_NS, FASTER = 20_000_000_000, 10
DURATION = 26.0  # s
TOLERANCE_DEG = 2.0


class NavsatTransform:
    """What navsat_transform does with IMU messages: the first one gives the heading, for good."""

    def __init__(self, node):
        self.first = None
        self._node = node
        self._subscription = node.create_subscription(Imu, '/ins_align/imu', self._on_imu, 10)

    def _on_imu(self, msg):
        # The covariance is not looked at.
        self.first = self.first or msg

    def leave(self):
        self._node.destroy_subscription(self._subscription)

    def heading_error_deg(self, simulation):
        q = self.first.orientation
        assert [q.x, q.y, q.z, q.w] != [0.0] * 4
        error = (roll_pitch_yaw(matrix_from_quaternion(np.array([q.x, q.y, q.z, q.w])))
                 - roll_pitch_yaw(simulation.attitude_at(stamp_ns(self.first))))[2]
        return abs(np.degrees(np.remainder(error + np.pi, 2.0 * np.pi) - np.pi))


@pytest.mark.parametrize('gnss_rate', [5.0, *(
    pytest.param(rate, marks=pytest.mark.campaign) for rate in (1.0, 10.0))])
def test_who_listens_gets_the_heading_whenever_it_joins(gnss_rate, tmp_path):
    simulation = simulate('flight', imu_grade='tactical', seed=1, duration=DURATION,
                          gnss_rate=gnss_rate)
    messages = simulated_messages(simulation)
    start_ns = messages[0][0]
    messages = [(min(time_ns - start_ns, ALIGNED_NS) // FASTER
                 + max(time_ns - start_ns - ALIGNED_NS, 0), topic, msg)
                for time_ns, topic, msg in messages]
    with Listener() as listener, running_node(PARAMETERS):
        early = NavsatTransform(listener.node)
        with playing(script_of(messages), tmp_path) as player:
            listener.wait_for(lambda: early.first)
            early.leave()
            joined = []
            while player.poll() is None:
                seen = len(listener.statuses)
                # The node knows that nobody listens any more: the next one is new to it.
                listener.wait_for(lambda: len(listener.statuses) > seen)
                late = NavsatTransform(listener.node)
                listener.wait_for(lambda: late.first or player.poll() is not None)
                late.leave()
                joined += [late] if late.first else []
    print(len(joined), 'joined')
    assert listener.attitudes and len(joined) >= 3
    errors = [consumer.heading_error_deg(simulation) for consumer in (early, *joined)]
    assert max(errors) < TOLERANCE_DEG, errors


def test_numbers_of_each_epoch(tmp_path):
    simulation = simulate('flight', imu_grade='tactical', seed=1, duration=16.0)
    angles, sigmas, gyro, accel, states = [], [], [], [], []
    with Listener() as listener, running_node(PARAMETERS):
        for msg_type, topic, store in ((Vector3Stamped, 'roll_pitch_yaw_deg', angles),
                                       (Vector3Stamped, 'sigma_deg', sigmas),
                                       (Vector3Stamped, 'gyro_bias', gyro),
                                       (Vector3Stamped, 'accel_bias', accel),
                                       (UInt8, 'state', states)):
            listener.node.create_subscription(msg_type, f'/ins_align/{topic}', store.append, 100)
        listener.wait_for(lambda: states)               # the two have found each other
        with playing(script_of(simulated_messages(simulation)), tmp_path, 10.0):
            listener.wait_for(lambda: listener.status.get('state') == 'ALIGNED')
        listener.wait_for_next_status()
    assert [stamp_ns(msg) for msg in angles] == [stamp_ns(msg) for msg in sigmas]
    assert len(angles) > 20
    for name, biases in (('gyro_bias_rad_s', gyro), ('accel_bias_m_s2', accel)):
        assert [stamp_ns(msg) for msg in biases] == [stamp_ns(msg) for msg in angles]
        assert biases[-1].header.frame_id == 'imu_link'
        last = biases[-1].vector
        assert [last.x, last.y, last.z] == pytest.approx(
            [float(number) for number in listener.status[name].split()], rel=1e-5)
    now = angles[-1].vector
    truth = np.degrees(roll_pitch_yaw(simulation.attitude_at(stamp_ns(angles[-1]))))
    difference = np.array([now.x, now.y, now.z]) - truth
    assert np.abs(np.remainder(difference + 180.0, 360.0) - 180.0).max() < TOLERANCE_DEG
    assert 0.0 < sigmas[-1].vector.z < 1.0 < sigmas[0].vector.z
    # In the order in which the README lists the states, which begins with WAITING_FOR_IMU.
    assert states[0].data == 0 and max(msg.data for msg in states) == 4


def test_what_is_missing_is_said_in_the_log_with_the_names_of_its_namespace():
    with Listener(namespace='/robot1') as listener, running_node(
            ['lever_arm:=[1, 2, 3]', 'imu_grade:=tactical'], ['-r', '__ns:=/robot1']) as node:
        velocity = listener.node.create_publisher(TwistStamped, '/robot1/fix_velocity', 10)
        listener.wait_for(lambda: 'velocity_type' in listener.status.get('reason', ''))
        listener.node.destroy_publisher(velocity)
        listener.wait_for(lambda: 'velocity_type' not in listener.status['reason'])
    reasons = [values['reason'] for values in map(values_of, listener.statuses)]
    assert any('nobody publishes /robot1/imu/data_raw' in reason for reason in reasons)
    wrong = ('/robot1/fix_velocity is published as geometry_msgs/TwistStamped, not '
             'geometry_msgs/TwistWithCovarianceStamped: set velocity_type to TwistStamped')
    assert any(wrong in reason for reason in reasons)
    assert {msg.status[0].name for msg in listener.diagnostics} == {'robot1/ins_align: alignment'}
    # The log has each of them once, and at its start what is read and with which parameters.
    assert node.output.count(wrong) == 1
    assert ('reads /robot1/imu/data_raw (sensor_msgs/Imu), /robot1/fix (sensor_msgs/NavSatFix), '
            '/robot1/fix_velocity (geometry_msgs/TwistWithCovarianceStamped); '
            'lever_arm (1.0, 2.0, 3.0), imu_grade tactical' in node.output)


def test_a_topic_with_two_publishers_is_named():
    with Listener() as listener, running_node([]):
        one, other = (listener.node.create_publisher(Imu, '/imu/data_raw', 10) for _ in range(2))
        listener.wait_for(lambda: '/imu/data_raw has 2 publishers: it must have one'
                          in listener.status.get('reason', ''))
        listener.node.destroy_publisher(other)
        listener.wait_for(lambda: 'publishers' not in listener.status['reason'])
        listener.node.destroy_publisher(one)


def test_wrong_units_and_late_messages_are_said_as_replay_says_them(tmp_path):
    simulation = simulate('car', seed=1, duration=40.0, stand_still=5.0, imu_grade='tactical')
    simulation = replace(simulation, gyro=np.degrees(simulation.gyro),
                         gnss_arrival_ns=simulation.gnss_stamps_ns + 1_720_000_000)
    with Listener() as listener, running_node(RELIABLE) as node:
        with playing(script_of(simulated_messages(simulation)), tmp_path, 10.0):
            listener.wait_for(lambda: 'look like deg/s' in listener.status.get('reason', ''))
            listener.wait_for(lambda: 'set gnss_lateness to' in listener.status['reason'])
            listener.wait_for(lambda: listener.status['state'] == 'FAULT')
    assert 'the angular rates look like deg/s: they must be rad/s' in node.output
    # The way between processes comes on top, ten times as long on the clock of the data.
    late = re.findall(r'GNSS messages come up to ([\d.]+) s later', node.output)
    assert late and 1.7 <= min(map(float, late)) <= max(map(float, late)) < 5.0


def test_a_reason_is_logged_when_its_kind_changes_and_when_it_stays():
    log = ReasonLog()

    def logged(text, seconds, again=True):
        return [now for now in seconds if log.due(text, now, again)]

    assert logged('ALIGNING: heading sigma 3.1 deg', range(8)) == [0]
    assert logged('ALIGNING: heading sigma 1e+02 deg', range(8, 25)) == [10, 20]
    assert logged('ALIGNED: heading sigma 0.9 deg', range(25, 60), False) == [25]
    assert logged('ALIGNED: heading sigma 0.8 deg; no GNSS for 3 s', [60], False) == [60]
    # What comes and goes is not logged each time.
    for now in range(65, 100):
        assert log.due(f'ALIGNING: {"ab"[now % 2]}', now, True) == (now % 10 in (5, 6))
    # A warning that no longer holds is not the last word.
    assert logged('ALIGNED: heading sigma 0.7 deg', range(100, 106), False) == [100]
    assert logged('ALIGNED: heading sigma 0.7 deg; no GNSS for 3 s', range(106, 109)) == [106]
    assert logged('ALIGNED: heading sigma 0.6 deg', range(109, 200), False) == [110]
    # An event is logged in any case: the status does not repeat it.
    for now in (200, 205):
        assert log.due('LEVELLED: heading sigma 2 deg', now + 1, True, logged=True)
        assert log.due('ALIGNED: heading sigma 0.9 deg', now + 2, True, logged=True)
    assert logged('ALIGNED: heading sigma 0.8 deg', range(208, 300), False) == []


def test_receiver_messages_need_their_package_and_bring_the_velocity(monkeypatch):
    config = Config(fix_type='GPSFix')
    monkeypatch.setitem(sys.modules, 'gps_msgs.msg', None)
    monkeypatch.setitem(sys.modules, 'gps_msgs', None)
    assert gnss_topics(config) == {'fix': 'gps_msgs/msg/GPSFix'}
    with pytest.raises(ConfigError, match='gps_msgs is not installed: sudo apt install ros-'):
        message_class('gps_msgs/msg/GPSFix')

    class GPSFix(SimpleNamespace):
        pass

    monkeypatch.setitem(sys.modules, 'gps_msgs.msg', SimpleNamespace(GPSFix=GPSFix))
    assert message_class('gps_msgs/msg/GPSFix') is GPSFix
    message = GPSFix(
        header=Header(stamp=Time(sec=12)), status=SimpleNamespace(status=0), latitude=48.0,
        longitude=11.0, altitude=300.0, position_covariance=np.zeros(9),
        position_covariance_type=0, speed=5.0, track=90.0, climb=1.0, err_speed=0.2, err_climb=0.4)
    fix, velocity = gnss_from_msg(message, 'gps_msgs/msg/GPSFix', config)
    assert fix[:4] == (12_000_000_000, 48.0, 11.0, 300.0) and fix.covariance is None
    assert velocity.velocity == pytest.approx([5.0, 0.0, 1.0])
    assert velocity.covariance == pytest.approx(np.diag([0.01, 0.01, 0.04]))
