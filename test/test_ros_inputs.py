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
"""What the node reads of a serialised IMU message and what it changes in it."""

import sys
from types import SimpleNamespace

from ins_align.config import Config
from ins_align.geometry.rotation import Transform
from ins_align.mounting import turn_to_base
from ins_align.ros.inputs import open_static_tf, read_imu, with_orientation
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

FRAMES = ('', 'i', 'imu', 'imu_link', 'imu_link/é')


def message(frame_id, seconds=1_700_000_000, nanoseconds=999_999_999):
    msg = Imu()
    msg.header.stamp.sec, msg.header.stamp.nanosec = seconds, nanoseconds
    msg.header.frame_id = frame_id
    values = iter(np.arange(1.0, 38.0))
    for vector, names, covariance in (
            (msg.orientation, 'xyzw', msg.orientation_covariance),
            (msg.angular_velocity, 'xyz', msg.angular_velocity_covariance),
            (msg.linear_acceleration, 'xyz', msg.linear_acceleration_covariance)):
        for name in names:
            setattr(vector, name, next(values))
        covariance[:] = [next(values) for _ in range(9)]
    return msg


@pytest.fixture(params=('bytes', 'library'))
def way(request, monkeypatch):
    """Take the layout that is known, and one of a middleware with another serialisation."""
    if request.param == 'library':
        monkeypatch.setattr('ins_align.ros.inputs.body_start', lambda data: None)


@pytest.mark.parametrize('frame_id', FRAMES)
@pytest.mark.parametrize('seconds', (0, 1_700_000_000, 2 ** 31 - 1, -5))
def test_what_is_read_is_the_message(frame_id, seconds, way):
    sample = read_imu(serialize_message(message(frame_id, seconds)))
    assert sample.stamp_ns == seconds * 1_000_000_000 + 999_999_999
    assert sample.gyro == (14.0, 15.0, 16.0) and sample.accel == (26.0, 27.0, 28.0)
    assert sample.frame_id == frame_id


@pytest.mark.parametrize('frame_id', FRAMES)
def test_nothing_but_the_orientation_changes(frame_id, way):
    expected = message(frame_id)
    turn = expected.orientation
    turn.x, turn.y, turn.z, turn.w = quaternion = 0.1, -0.2, 0.3, 0.4
    expected.orientation_covariance = covariance = np.arange(9.0) - 2.0
    data = serialize_message(message(frame_id))
    changed = deserialize_message(with_orientation(data, quaternion, covariance), Imu)
    assert changed == expected
    assert deserialize_message(data, Imu) == message(frame_id)


@pytest.mark.parametrize('mount_deg', [(0, 0, 90), (90, 0, 0), (0, 90, 0), (20, -35, 130)])
def test_the_base_turns_as_scipy_says(mount_deg):
    vehicle = Rotation.from_euler('ZYX', [130.0, -8.0, 5.0], degrees=True)  # base to ENU
    mount = Rotation.from_euler('xyz', mount_deg, degrees=True)  # IMU to base
    msg = message('imu')
    turn = msg.orientation
    turn.x, turn.y, turn.z, turn.w = (vehicle * mount).as_quat()
    msg.linear_acceleration_covariance[0] = -1.0
    turn_to_base(msg, Transform(mount.inv().as_matrix(), np.ones(3)), 'base_link')
    assert (Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
            * vehicle.inv()).magnitude() == pytest.approx(0.0, abs=1e-12)
    expected, M = message('base_link'), mount.as_matrix()
    for vector, values in ((msg.angular_velocity, [14.0, 15.0, 16.0]),
                           (msg.linear_acceleration, [26.0, 27.0, 28.0])):
        assert [vector.x, vector.y, vector.z] == pytest.approx(mount.apply(values))
    assert msg.angular_velocity_covariance.reshape(3, 3) == pytest.approx(
        M @ np.reshape(expected.angular_velocity_covariance, (3, 3)) @ M.T)
    # About east, north, up as before; and what is not stated stays so.
    assert np.array_equal(msg.orientation_covariance, expected.orientation_covariance)
    assert np.array_equal(msg.linear_acceleration_covariance[1:],
                          expected.linear_acceleration_covariance[1:])
    assert msg.linear_acceleration_covariance[0] == -1.0
    assert msg.header == expected.header


def test_tf_is_asked_for_frames_without_a_slash(monkeypatch):
    asked = []
    buffer = SimpleNamespace(can_transform=lambda *frames_and_time: asked.append(frames_and_time))
    monkeypatch.setitem(sys.modules, 'tf2_ros', SimpleNamespace(
        Buffer=lambda: buffer, TransformListener=lambda *_: SimpleNamespace(tf_sub=None)))
    lookup = open_static_tf(SimpleNamespace(destroy_subscription=print), Config())
    assert lookup('/imu', '/gnss') is None
    assert asked[0][:2] == ('imu', 'gnss')
