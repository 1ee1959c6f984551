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
"""What the tests of the node share: the node as a process, messages to play, a listener."""

from contextlib import contextmanager
import csv
from pathlib import Path
import pickle
import signal
import subprocess
import sys
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped, TwistWithCovarianceStamped
from ins_align.config import Config
from ins_align.geometry.rotation import log_so3, matrix_from_quaternion
from ins_align.recordings.bag import Bag
from ins_align.recordings.reader import choose_topics
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from recordings import messages_of
from sensor_msgs.msg import Imu, NavSatFix

PLAYER = Path(__file__).with_name('node_player.py')
IMU, FIX, VELOCITY = '/imu/data_raw', '/fix', '/fix_velocity'
TOPICS = {'imu': IMU, 'fix': FIX, 'velocity': VELOCITY}
# Reliable, for comparisons with replay that stand and fall with every single message.
RELIABLE = [f'qos_overrides.{topic}.subscription.reliability:=reliable'
            for topic in TOPICS.values()]


class NodeProcess:
    """`ins_align_node` in a process of its own."""

    def __init__(self, parameters=(), arguments=()):
        command = [sys.executable, '-m', 'ins_align.ros.main', '--ros-args']
        for parameter in parameters:
            command += ['-p', parameter]
        self._process = subprocess.Popen(
            [*command, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self.pid = self._process.pid
        self.output = ''

    @property
    def status(self):
        """Return the exit status, None while it runs."""
        return self._process.poll()

    def stop(self, number=signal.SIGINT):
        """Send a signal and return the exit status."""
        if self.status is None:
            self._process.send_signal(number)
        return self.wait()

    def wait(self, timeout=60.0):
        """Return the exit status; `output` then holds all that was printed."""
        try:
            self.output += self._process.communicate(timeout=timeout)[0] or ''
        except subprocess.TimeoutExpired:
            self._process.kill()
            self.output += self._process.communicate()[0] or ''
            raise
        return self.status


@contextmanager
def running_node(parameters=(), arguments=()):
    """Run the node; it must still be alive at the end and stop cleanly."""
    node = NodeProcess(parameters, arguments)
    try:
        yield node
    except BaseException:
        node.stop(signal.SIGKILL)
        print(node.output)
        raise
    alive = node.status is None
    status = node.stop()
    assert alive, node.output
    assert status == 0, node.output
    assert 'Traceback' not in node.output, node.output


class Listener:
    """Hears what the node publishes, in a thread of the test."""

    def __init__(self, *, imu=False, name='listener', namespace=''):
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node(name, context=self._context)
        self.attitudes, self.statuses, self.diagnostics, self.imus = [], [], [], []
        # A queue of one would keep the last of two attitudes when a busy machine holds us up.
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for msg_type, topic, store, qos in (
                (QuaternionStamped, f'{namespace}/ins_align/initial_attitude', self.attitudes,
                 latched),
                (DiagnosticArray, f'{namespace}/ins_align/status', self.statuses, 100),
                (DiagnosticArray, '/diagnostics', self.diagnostics, 100)):
            self.node.create_subscription(msg_type, topic, store.append, qos)
        if imu:
            self.node.create_subscription(
                Imu, f'{namespace}/ins_align/imu', self.imus.append, 10000)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self):
        try:
            self._executor.spin()
        except ExternalShutdownException:
            pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    @property
    def status(self):
        """Return the newest status as a dict, empty before the first."""
        return values_of(self.statuses[-1]) if self.statuses else {}

    @property
    def heard_state(self):
        """Return the newest state that is not due to an IMU that has fallen silent."""
        return next(values['state'] for values in map(values_of, reversed(self.statuses))
                    if 'no IMU sample for' not in values['reason'])

    def count(self, name):
        return int(self.status.get(name, 0))

    def wait_for(self, condition, timeout=20.0):
        """Wait until a condition holds; an AssertionError shows the last status."""
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, self.status
            time.sleep(0.02)

    def wait_for_next_status(self):
        """Wait for a status that was made after this call."""
        seen = len(self.statuses)
        self.wait_for(lambda: len(self.statuses) > seen + 1)

    def call(self, service_type, name, request):
        client = self.node.create_client(service_type, name)
        assert client.wait_for_service(20.0)
        future = client.call_async(request)
        self.wait_for(future.done)
        return future.result()


def values_of(msg):
    """Return the values of a DiagnosticArray of the node."""
    return {value.key: value.value for value in msg.status[0].values}


def stamp_ns(msg):
    return msg.header.stamp.sec * 1_000_000_000 + msg.header.stamp.nanosec


def attitude_error_deg(quaternion, C_nb):
    """Return the error of a geometry_msgs/Quaternion, degrees about east, north, up."""
    q = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    return np.degrees(log_so3(matrix_from_quaternion(q) @ np.swapaxes(C_nb, -1, -2)))


def bag_script(path, start_s=0.0, duration_s=float('inf')):
    """Return what the drivers published when a bag was recorded."""
    from rosbags.typesys import get_typestore, Stores
    store = get_typestore(Stores.ROS2_JAZZY)
    script = []
    with Bag(path) as bag:
        topics = choose_topics(bag, Config())
        wanted = {topic: TOPICS[role] for role, topic in topics._asdict().items()
                  if role in TOPICS and topic is not None}
        for topic, time_ns, data in messages_of(bag, list(wanted)):
            if not 0.0 <= (time_ns - bag.start_ns) * 1e-9 - start_s < duration_s:
                continue
            if topic.encoding == 'ros1':
                data = bytes(store.ros1_to_cdr(data, topic.msgtype))
            script.append((time_ns, wanted[topic], topic.msgtype, data))
    return script


def overrides(parameters):
    """Write parameters as they stand behind -p."""
    return [f'{name}:={value}' for name, value in parameters.items()]


def replayed(bag, parameters, table, *options):
    """Return the rows of `ins_align replay --csv TABLE`."""
    settings = [f'--set={name}={value}' for name, value in parameters.items()]
    done = subprocess.run([sys.executable, '-m', 'ins_align.cli', 'replay', bag, '--csv', table,
                           *settings, *options], capture_output=True, text=True)
    assert table.exists(), done.stderr
    with open(table, newline='') as file:
        return list(csv.DictReader(file))


def simulated_messages(simulation):
    """Return (arrival_ns, topic, ROS message) of a simulation in the order of arrival."""
    messages = []
    for stamp, gyro, accel in zip(simulation.imu_stamps_ns.tolist(), simulation.gyro,
                                  simulation.accel):
        msg = Imu()
        set_stamp(msg, stamp)
        msg.header.frame_id = 'imu_link'
        for vector, xyz in ((msg.angular_velocity, gyro), (msg.linear_acceleration, accel)):
            vector.x, vector.y, vector.z = xyz.tolist()
        messages.append((stamp, IMU, msg))
    for k, arrival in enumerate(simulation.gnss_arrival_ns.tolist()):
        fix, velocity = NavSatFix(), TwistWithCovarianceStamped()
        for msg in (fix, velocity):
            set_stamp(msg, int(simulation.gnss_stamps_ns[k]))
            msg.header.frame_id = 'gnss'
        fix.status.status = 0
        fix.latitude, fix.longitude, fix.altitude = simulation.lla_deg[k].tolist()
        linear = velocity.twist.twist.linear
        linear.x, linear.y, linear.z = simulation.velocity[k].tolist()
        messages += [(arrival, FIX, fix), (arrival, VELOCITY, velocity)]
    return sorted(messages, key=lambda message: message[0])


def set_stamp(msg, stamp):
    msg.header.stamp.sec, msg.header.stamp.nanosec = divmod(stamp, 1_000_000_000)


def script_of(messages):
    """Serialise messages for the player."""
    return [(time_ns, topic, '/'.join([type(msg).__module__.split('.')[0], 'msg',
                                       type(msg).__name__]), serialize_message(msg))
            for time_ns, topic, msg in messages]


@contextmanager
def playing(script, tmp_path, rate=1.0, reliability='reliable'):
    """Publish a script from another process, beside what the block does."""
    path = tmp_path / f'script{len(list(tmp_path.iterdir()))}.pickle'
    path.write_bytes(pickle.dumps(script))
    player = subprocess.Popen([sys.executable, PLAYER, path, str(rate), reliability])
    try:
        yield player
        assert player.wait() == 0, 'the player failed'
    finally:
        if player.poll() is None:
            player.kill()
            player.wait()


def play(script, tmp_path, rate=1.0, reliability='reliable'):
    """Publish a script from another process and wait for its end."""
    with playing(script, tmp_path, rate, reliability):
        pass
