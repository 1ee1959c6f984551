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
"""`~/imu` as navsat_transform listens to it, which takes the first quaternion that it gets."""

from ins_align.rotation import matrix_from_quaternion, roll_pitch_yaw
from ins_align.simulation import simulate
from node_harness import (
    Listener, playing, RELIABLE, running_node, script_of, simulated_messages, stamp_ns)
import numpy as np
import pytest
from sensor_msgs.msg import Imu

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


@pytest.mark.parametrize('gnss_rate', [1.0, 5.0, 10.0])
def test_who_listens_gets_the_heading_whenever_it_joins(gnss_rate, tmp_path):
    simulation = simulate('flight', imu_grade='tactical', seed=3, duration=DURATION,
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
