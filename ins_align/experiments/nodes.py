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
Processes that experiments with the node run beside it: ``python -m ins_align.experiments.nodes``.

``bare`` subscribes to what the node subscribes to and does nothing, ``republish`` publishes each
IMU message unchanged, ``listen`` takes what is published, ``play FILE`` plays the drivers.
"""

from __future__ import annotations

from pathlib import Path
import pickle
import sys
import time
from typing import Any

from geometry_msgs.msg import TwistWithCovarianceStamped
from ins_align.simulation.simulate import Simulation
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, NavSatFix

TYPES = {'imu/data_raw': Imu, 'fix': NavSatFix, 'fix_velocity': TwistWithCovarianceStamped}
DEPTHS = {'imu/data_raw': 2000, 'fix': 200, 'fix_velocity': 200}
Script = list[tuple[int, str, bytes]]


def script_of(simulation: Simulation) -> Script:
    """Return arrival time, topic and serialised message in the order of arrival."""
    script = []
    for stamp, gyro, accel in zip(simulation.imu_stamps_ns.tolist(), simulation.gyro,
                                  simulation.accel):
        imu = Imu()
        imu.header.frame_id = 'imu_link'
        rate, force = imu.angular_velocity, imu.linear_acceleration
        rate.x, rate.y, rate.z = gyro.tolist()
        force.x, force.y, force.z = accel.tolist()
        script.append((stamp, 'imu/data_raw', _stamped(imu, stamp)))
    for k, (arrival, stamp) in enumerate(zip(simulation.gnss_arrival_ns.tolist(),
                                             simulation.gnss_stamps_ns.tolist())):
        fix, velocity = NavSatFix(), TwistWithCovarianceStamped()
        fix.latitude, fix.longitude, fix.altitude = simulation.lla_deg[k].tolist()
        linear = velocity.twist.twist.linear
        linear.x, linear.y, linear.z = simulation.velocity[k].tolist()
        script += [(arrival, 'fix', _stamped(fix, stamp)),
                   (arrival, 'fix_velocity', _stamped(velocity, stamp))]
    return sorted(script, key=lambda message: message[0])


def _stamped(msg: Any, stamp_ns: int) -> bytes:
    msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    return bytes(serialize_message(msg))


def _nothing(msg: Any) -> None:
    pass


def _spin(name: str) -> None:
    node = rclpy.create_node(name)
    if name == 'listen':
        for topic in ('/republish/imu', '/ins_align/imu'):
            node.create_subscription(Imu, topic, _nothing, 100, raw=True)
    else:
        publish = (node.create_publisher(Imu, '~/imu', 100).publish if name == 'republish'
                   else _nothing)
        for topic, kind in TYPES.items():
            node.create_subscription(
                kind, topic, publish if kind is Imu else _nothing,
                QoSProfile(depth=DEPTHS[topic], reliability=ReliabilityPolicy.BEST_EFFORT))
    # A signal between two waits of the executor would not be seen.
    node.create_timer(1.0, lambda: None)
    rclpy.spin(node)


def _play(path: str) -> None:
    script: Script = pickle.loads(Path(path).read_bytes())
    node = rclpy.create_node('play')
    publishers = {topic: node.create_publisher(kind, topic, 1000)
                  for topic, kind in TYPES.items()}
    time.sleep(2.0)  # they have to find each other
    start, first = time.monotonic(), script[0][0]
    for time_ns, topic, message in script:
        wait = start + (time_ns - first) * 1e-9 - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        publishers[topic].publish(message)


def main(name: str, *arguments: str) -> int:
    """Run one of the processes until it is interrupted."""
    rclpy.init()
    try:
        if name == 'play':
            _play(*arguments)
        else:
            _spin(name)
    except ExternalShutdownException:
        pass
    return 0


if __name__ == '__main__':
    sys.exit(main(*sys.argv[1:]))
