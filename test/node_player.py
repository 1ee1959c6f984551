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

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy

DISCOVERY_TIMEOUT = 30.0  # s


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
    deadline = time.monotonic() + DISCOVERY_TIMEOUT
    while not all(publisher.get_subscription_count() for publisher in publishers.values()):
        if time.monotonic() > deadline:
            sys.exit('nobody subscribes')
        time.sleep(0.02)
    time.sleep(0.5)  # the other side has to find us too
    start, first = time.monotonic(), script[0][0]
    for time_ns, topic, _, message in script:
        wait = start + (time_ns - first) * 1e-9 / rate - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        publishers[topic].publish(message)
    time.sleep(0.5)  # what is on its way must arrive before the publisher is gone
    node.destroy_node()
    rclpy.shutdown()


if __name__ == '__main__':
    main(sys.argv[1], float(sys.argv[2]),
         ReliabilityPolicy[sys.argv[3].upper()] if sys.argv[3:] else ReliabilityPolicy.RELIABLE)
