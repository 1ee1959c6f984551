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
"""What the node's worker makes of messages, in this process and without waiting for topics."""

from contextlib import contextmanager
import time
from types import SimpleNamespace

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped
from ins_align.config import Config
from ins_align.geometry.rotation import Transform
from ins_align.gnss.messages import Fix, Velocity
from ins_align.ros.inputs import ImuSample
from ins_align.ros.node import AlignmentNode, IMU_DEPTH
from node_harness import Listener, overrides, values_of
import numpy as np
import pytest
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

LEVER_ARMS = {'first': (1.0, 0.0, 0.0), 'second': (0.0, 2.0, 0.0)}  # m, by frame of the IMU
STEP_NS = 5_000_000
TOO_FAST = 80.0  # rad/s


class StillNode(AlignmentNode):
    """A node whose worker works when it is told to, by a clock that the test sets."""

    def __init__(self, **options):
        super().__init__(**options)
        self.seconds, self.lines, statuses = 100.0, [], []
        self.statuses = statuses
        self._status_publishers = [SimpleNamespace(publish=statuses.append)]

    def _run(self):
        pass

    def _log(self, severity, text):
        self.lines.append(text)

    def work(self, messages=()):
        """Do a round with messages and what the callbacks have put into the inbox before."""
        requests = [(0, item) for _, item in self._inbox]
        self._inbox.clear()
        self.seconds += 0.2
        self._work([*requests, *((message.stamp_ns, message) for message in messages)])

    def status(self):
        """Return the values of a new status."""
        self._publish_status()
        return values_of(self.statuses[-1])


@pytest.fixture
def still_node(monkeypatch):
    """Return a context manager of a StillNode, with parameters and the transforms of TF."""
    @contextmanager
    def running(transforms=None, arguments=(), **parameters):
        def lookup(target, source):
            if source != 'gnss' or target not in transforms:
                return None
            return Transform(np.eye(3), np.array(transforms[target]))

        monkeypatch.setattr('ins_align.ros.node.open_static_tf',
                            lambda *_: None if transforms is None else lookup)
        given = [word for override in overrides(parameters) for word in ('-p', override)]
        rclpy.init(args=['--ros-args', *given, *arguments],
                   signal_handler_options=SignalHandlerOptions.NO)
        node = None
        try:
            node = StillNode()
            monkeypatch.setattr('ins_align.ros.node.time', SimpleNamespace(
                monotonic=lambda: node.seconds, time_ns=time.time_ns))
            node._search.antenna_frame = 'gnss'
            yield node
        finally:
            if node is not None:
                node.destroy_node()
            rclpy.shutdown()

    return running


def samples_of(frames, start=0, rate=0.0):
    """Return a sample for each frame_id, 200 a second from number `start` on."""
    return [ImuSample(10 ** 9 + number * STEP_NS, (rate, 1e-6 * number, 0.0), (0.0, 0.0, 9.8),
                      frame) for number, frame in enumerate(frames, start)]


AT_ONCE = samples_of(['first', 'second'] * 200)
# The second is in use for a second, falls silent, and the first comes back.
BACK = samples_of(['first'] * 200 + ['second'] * 200) + samples_of(['first'] * 400, 700)


def test_a_program_may_host_nodes_with_options_of_its_own(still_node):
    with still_node(hold_time=2.0) as node:
        other = StillNode(namespace='/robot1',
                          parameter_overrides=[Parameter('hold_time', value=3.0)])
        assert other.get_fully_qualified_name() == '/robot1/ins_align'
        assert node._config.hold_time == 2.0 and other._config.hold_time == 3.0
        other.destroy_node()


@pytest.mark.parametrize('section, is_read', [
    ('ins_align_node', False), ('ins_align', True), ('robot1/ins_align', False), ('/**', True)])
def test_a_section_for_another_node_is_told(still_node, tmp_path, monkeypatch, capfd, section,
                                            is_read):
    file = tmp_path / 'parameters.yaml'
    # With what is the default in any case.
    file.write_text(f'{section}:\n  ros__parameters:\n    hold_time: {Config().hold_time}\n')
    arguments = ['--params-file', str(file)]
    monkeypatch.setattr('sys.argv', ['ins_align_node', '--ros-args', *arguments])
    with still_node(arguments=arguments):
        pass
    told = ('no parameter file sets a parameter of this node: the section for it must be named '
            '"ins_align:" or "/**:"' in capfd.readouterr().err)
    assert told == (not is_read)


@pytest.mark.parametrize('samples, pieces, used, left_out', [
    (AT_ONCE, 40, 'second', True), (AT_ONCE, 41, 'second', True), (BACK, 40, 'first', False)])
@pytest.mark.parametrize('lever_arm_from_tf', ['auto', 'true'])
def test_the_lever_arm_is_that_of_the_imu_in_use(still_node, samples, pieces, used, left_out,
                                                 lever_arm_from_tf):
    with still_node(LEVER_ARMS, lever_arm_from_tf=lever_arm_from_tf) as node:
        node.work(samples[:pieces])
        for start in range(pieces, len(samples), 40):  # that end with either IMU
            node.work(samples[start:start + 40])
        status = node.status()
    assert node.statuses[-1].status[0].hardware_id == used
    assert np.array_equal(np.array(status['lever_arm_m'].split(), float), LEVER_ARMS[used])
    assert (int(status.get('imu_other_frame', 0)) > 0) == left_out
    assert 'no IMU sample for' not in status['reason']


@pytest.mark.parametrize('lever_arm_from_tf', ['auto', 'true'])
@pytest.mark.parametrize('at_once', [False, True])
def test_a_reset_forgets_what_waits_for_a_transform(still_node, lever_arm_from_tf, at_once):
    """Also if the transform comes with it."""
    transforms, samples = {}, samples_of(['first'] * 400)
    with still_node(transforms, lever_arm_from_tf=lever_arm_from_tf) as node:
        node.work([*samples[:100], Fix(samples[50].stamp_ns, 48.0, 11.0, 300.0, None, 0),
                   Velocity(samples[50].stamp_ns, np.ones(3), None)])
        node._on_reset(None, Trigger.Response())
        if at_once:
            transforms.update(LEVER_ARMS)
        node.work()
        transforms.update(LEVER_ARMS)
        node.work(samples[100:])
        status = node.status()
    assert status['lever_arm_m'] == '1 0 0'
    assert any('alignment starts over: requested by service' in line for line in node.lines)
    assert status['state'] == 'WAITING_FOR_GNSS'  # no alignment from before the reset
    assert int(status['imu']) >= 300


def test_an_imu_that_waits_for_a_transform_is_not_silent(still_node):
    with still_node(LEVER_ARMS, lever_arm_from_tf='true') as node:
        node.work(samples_of(['first'] * 100))
        for start in range(100, 900, 40):
            node.work(samples_of(['third'] * 40, start))
        reason = node.status()['reason']
        assert "waits for the transform from 'gnss' (antenna) to 'third' (IMU)" in reason
        assert 'no IMU sample for' not in reason


@pytest.mark.parametrize('frame', ['first', 'second'])
def test_what_came_before_a_new_start_is_not_checked_after_it(still_node, frame):
    with still_node() as node:
        items = [(0, sample) for sample in samples_of(['first'] * 11, 0, TOO_FAST)]
        if frame == 'first':
            items.append((0, lambda: node._start_over('requested by service')))
        node._work(items + [(0, sample) for sample in samples_of([frame] * 100, 11)])
        status = node.status()
    assert status['resets'] == '1' and status['state'] == 'WAITING_FOR_GNSS'
    assert 'deg/s' not in status['reason']


@pytest.mark.parametrize('use_velocity', ['auto', 'false'])
def test_velocities_are_no_fault_where_none_are_used(still_node, use_velocity):
    msg = TwistWithCovarianceStamped()
    msg.header.frame_id = 'base_link'
    with Listener() as listener, still_node(use_velocity=use_velocity) as node:
        listener.node.create_publisher(TwistStamped, '/fix_velocity', 10)
        node._on_gnss('fix_velocity', msg, {'received_timestamp': 1})
        node.work()
        listener.wait_for(lambda: node.count_publishers('fix_velocity'))
        status = node.status()
    assert status['velocity_body_frame'] == '1'
    said = ' '.join([status['reason'], *node.lines])
    for complaint in ('set velocity_type to TwistStamped', 'set velocity_frame to'):
        assert (complaint in said) == (use_velocity == 'auto')


def test_the_depth_of_a_queue_cannot_be_less_than_the_node_needs(still_node):
    name = 'qos_overrides./imu/data_raw.subscription'
    with still_node(**{f'{name}.depth': 10, f'{name}.reliability': 'reliable'}) as node:
        imu, = (each for each in node.subscriptions if each.topic_name == '/imu/data_raw')
        assert imu.qos_profile.depth == IMU_DEPTH
        assert imu.qos_profile.reliability == ReliabilityPolicy.RELIABLE


def test_stamps_may_be_negative(still_node):
    with still_node() as node:
        assert node._header(-1_500_000_000).stamp == Time(sec=-2, nanosec=500_000_000)
