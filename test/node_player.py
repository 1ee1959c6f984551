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
"""
Plays the part of the sensors' drivers, in a process of its own.

Usage: node_player.py SCRIPT RATE [best_effort], SCRIPT being a pickled list of
(time_ns, topic, type, serialised message), RATE times faster than the times say.
"""

from importlib import import_module
import pickle
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy

TIMEOUT = 30.0  # s
# A busy machine must not cost messages: the player waits when the node is this many IMU messages
# behind, which is less than its queue holds.
IMU_TOPIC = '/imu/data_raw'
LEAD = 1500


def message_class(name):
    package, _, kind = name.split('/')
    return getattr(import_module(f'{package}.msg'), kind)


def main(path, rate, reliability):
    with open(path, 'rb') as file:
        script = pickle.load(file)
    rclpy.init()
    node = rclpy.create_node('player')
    qos = QoSProfile(depth=10000, reliability=reliability)
    publishers = {}
    for _, topic, kind, _ in script:
        if topic not in publishers:
            publishers[topic] = node.create_publisher(message_class(kind), topic, qos)
    seen = [0]  # IMU messages by the node's own count

    def on_status(msg):
        values = {value.key: value.value for value in msg.status[0].values}
        seen[0] = sum(int(values.get(name, 0)) for name in ('imu', 'imu_other_frame'))

    node.create_subscription(DiagnosticArray, '/ins_align/status', on_status, 10)
    deadline = time.monotonic() + TIMEOUT
    while not all(publisher.get_subscription_count() for publisher in publishers.values()):
        if time.monotonic() > deadline:
            sys.exit('nobody subscribes')
        time.sleep(0.02)
    time.sleep(0.5)  # the other side has to find us too
    start, first, sent = time.monotonic(), script[0][0], 0
    for time_ns, topic, _, message in script:
        wait = start + (time_ns - first) * 1e-9 / rate - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        else:
            start -= wait  # a burst to catch up would overflow the transport's queues
        if topic == IMU_TOPIC:
            sent += 1
            deadline = time.monotonic() + TIMEOUT
            while sent > seen[0] + LEAD:
                rclpy.spin_once(node, timeout_sec=1.0)
                if time.monotonic() > deadline:
                    sys.exit(f'{sent} IMU messages sent, the node has got no further '
                             f'than {seen[0]}')
        publishers[topic].publish(message)
    for publisher in publishers.values():
        publisher.wait_for_all_acked()
    time.sleep(0.5)  # best effort is not acknowledged
    node.destroy_node()
    rclpy.shutdown()


if __name__ == '__main__':
    main(sys.argv[1], float(sys.argv[2]),
         ReliabilityPolicy[sys.argv[3].upper()] if sys.argv[3:] else ReliabilityPolicy.RELIABLE)
