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
from ins_align.ros.inputs import open_static_tf, read_imu, with_orientation
import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
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


def test_tf_is_asked_for_frames_without_a_slash(monkeypatch):
    asked = []
    buffer = SimpleNamespace(can_transform=lambda *frames_and_time: asked.append(frames_and_time))
    monkeypatch.setitem(sys.modules, 'tf2_ros', SimpleNamespace(
        Buffer=lambda: buffer, TransformListener=lambda *_: SimpleNamespace(tf_sub=None)))
    lookup = open_static_tf(SimpleNamespace(destroy_subscription=print), Config())
    assert lookup('/imu', '/gnss') is None
    assert asked[0][:2] == ('imu', 'gnss')
