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
"""Messages to arrays: units, frames, what counts as an unknown covariance."""

from types import SimpleNamespace as Msg

from ins_align.config import Config
from ins_align.gnss.messages import (
    fix_from_msg, imu_from_msg, MessageError, sound_covariance, stamp_from_msg, velocity_from_msg)
import numpy as np
import pytest


def header(frame_id='gnss_link', sec=12, nanosec=34):
    return Msg(stamp=Msg(sec=sec, nanosec=nanosec), frame_id=frame_id)


def xyz(x, y, z):
    return Msg(x=x, y=y, z=z)


def fix(covariance=None, covariance_type=2, status=0):
    covariance = np.diag([1.0, 2.0, 3.0]).ravel() if covariance is None else covariance
    return Msg(header=header(), status=Msg(status=status), latitude=48.0, longitude=11.0,
               altitude=500.0, position_covariance=covariance,
               position_covariance_type=covariance_type)


def covariance36(block):
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = block
    covariance[3, 3] = -1.0  # receivers' drivers: no angular rate
    return covariance.ravel()


def twist_with_covariance(velocity, block, frame_id='gnss_link'):
    return Msg(header=header(frame_id), twist=Msg(twist=Msg(linear=xyz(*velocity)),
                                                  covariance=covariance36(block)))


@pytest.mark.parametrize('sec, nanosec, expected', [
    (12, 34, 12_000_000_034), (-1, 0, -1_000_000_000), (-2 ** 31, 2 ** 32 - 1, None),
    (2 ** 31 - 1, 2 ** 32 - 1, None), (np.int32(1_700_000_000), np.uint32(5),
                                       1_700_000_000_000_000_005)])
def test_stamp(sec, nanosec, expected):
    stamp = stamp_from_msg(Msg(header=header(sec=sec, nanosec=nanosec)))
    assert type(stamp) is int
    assert -2 ** 63 <= stamp < 2 ** 63
    assert expected is None or stamp == expected


def test_imu():
    msg = Msg(header=header('imu_link'), angular_velocity=xyz(0.1, 0.2, 0.3),
              linear_acceleration=xyz(1.0, float('nan'), 9.8))
    stamp_ns, gyro, accel = imu_from_msg(msg)
    assert stamp_ns == 12_000_000_034
    np.testing.assert_array_equal(gyro, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(accel, [1.0, np.nan, 9.8])


def test_fix():
    result = fix_from_msg(fix(status=-1))
    assert result[:4] == (12_000_000_034, 48.0, 11.0, 500.0)
    assert result.status == -1
    np.testing.assert_allclose(result.covariance, np.diag([1.0, 2.0, 3.0]))


@pytest.mark.parametrize('message', [
    fix(covariance_type=0), fix(np.zeros(9)), fix(np.full(9, np.nan)),
    fix(np.diag([1.0, 1.0, 0.0]).ravel()), fix(np.diag([-1.0, 0.0, 0.0]).ravel()),
    fix(np.diag([1.0, np.inf, 1.0]).ravel())])
def test_fix_covariance_unknown(message):
    assert fix_from_msg(message).covariance is None


@pytest.mark.parametrize('kind', (1, 2, 3))
def test_fix_covariance_of_every_known_type_is_taken(kind):
    """Approximated, 1, is what most drivers say."""
    np.testing.assert_array_equal(fix_from_msg(fix(covariance_type=kind)).covariance,
                                  np.diag([1.0, 2.0, 3.0]))


def test_velocity_enu():
    block = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.25]])
    result = velocity_from_msg(twist_with_covariance((1.0, 2.0, 3.0), block), Config())
    np.testing.assert_array_equal(result.velocity, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(result.covariance, block)


def test_velocity_ned_turns_with_its_covariance():
    block = np.array([[0.04, 0.01, 0.02], [0.01, 0.09, 0.03], [0.02, 0.03, 0.25]])
    result = velocity_from_msg(twist_with_covariance((1.0, 2.0, 3.0), block),
                               Config(velocity_frame='ned'))
    np.testing.assert_array_equal(result.velocity, [2.0, 1.0, -3.0])
    np.testing.assert_allclose(
        result.covariance, [[0.09, 0.01, -0.03], [0.01, 0.04, -0.02], [-0.03, -0.02, 0.25]])


@pytest.mark.filterwarnings('error')
def test_what_is_not_finite_in_ned_spoils_nothing_else():
    block = np.diag([0.04, 0.09, np.inf])
    config = Config(velocity_frame='ned')
    result = velocity_from_msg(twist_with_covariance((1.0, np.inf, np.nan), block), config)
    np.testing.assert_array_equal(result.velocity, [np.inf, 1.0, np.nan])
    np.testing.assert_allclose(result.covariance,
                               np.diag([0.09, 0.04, config.velocity_std_vertical ** 2]))


@pytest.mark.parametrize('block', [
    np.zeros((3, 3)), np.diag([-1.0, 0.0, 0.0]), np.full((3, 3), np.nan), -np.eye(3)])
def test_velocity_covariance_unknown(block):
    msg = twist_with_covariance((1.0, 2.0, 3.0), block)
    assert velocity_from_msg(msg, Config()).covariance is None


@pytest.mark.parametrize('frame', ['enu', 'ned'])
def test_vertical_variance_unknown_takes_the_configured_one(frame):
    msg = twist_with_covariance((1.0, 2.0, 0.0), np.diag([0.01, 0.01, 0.0]))
    config = Config(velocity_std_vertical=0.5, velocity_frame=frame)
    np.testing.assert_allclose(velocity_from_msg(msg, config).covariance,
                               np.diag([0.01, 0.01, 0.25]))


@pytest.mark.parametrize('correlation', (-500.0, -1.5, -1.0, 1.0, 1.01, 500.0, np.nan, np.inf,
                                         -np.inf))
def test_impossible_correlation_is_dropped(correlation):
    block = np.diag([1.0, 4.0, 9.0])
    block[0, 1] = block[1, 0] = 2.0 * correlation
    msg = twist_with_covariance((1.0, 2.0, 3.0), block)
    np.testing.assert_array_equal(velocity_from_msg(msg, Config()).covariance,
                                  np.diag([1.0, 4.0, 9.0]))


def test_possible_correlation_is_kept_and_made_symmetric():
    block = np.diag([1.0, 4.0, 9.0])
    block[0, 1], block[1, 0] = 1.7, 1.9
    msg = twist_with_covariance((1.0, 2.0, 3.0), block)
    np.testing.assert_allclose(velocity_from_msg(msg, Config()).covariance,
                               [[1.0, 1.8, 0.0], [1.8, 4.0, 0.0], [0.0, 0.0, 9.0]])


def test_other_velocity_types():
    stamped = Msg(header=header('world'), twist=Msg(linear=xyz(1.0, 2.0, 3.0)))
    result = velocity_from_msg(stamped, Config())
    np.testing.assert_array_equal(result.velocity, [1.0, 2.0, 3.0])
    assert result.covariance is None
    vector = Msg(header=header('world'), vector=xyz(1.0, 2.0, 3.0))
    result = velocity_from_msg(vector, Config())
    np.testing.assert_array_equal(result.velocity, [1.0, 2.0, 3.0])
    odometry = twist_with_covariance((1.0, 2.0, 3.0), np.eye(3), 'base_link')
    odometry.child_frame_id = 'gps'
    result = velocity_from_msg(odometry, Config())
    np.testing.assert_array_equal(result.covariance, np.eye(3))


@pytest.mark.parametrize('frame', [
    'base_link', 'robot1/base_link', '/base_footprint', 'imu', 'imu_link', 'imu0', 'body',
    'body_frame', 'os_imu', 'vehicle', 'BASE_LINK', 'chassis'])
def test_body_frame_velocity_is_refused(frame):
    msg = twist_with_covariance((1.0, 2.0, 3.0), np.eye(3), frame)
    with pytest.raises(MessageError, match='body frame'):
        velocity_from_msg(msg, Config())
    msg.header.frame_id, msg.child_frame_id = 'map', frame
    with pytest.raises(MessageError, match='body frame'):
        velocity_from_msg(msg, Config())
    # Who says in which world frame it is knows better than the frame_id.
    velocity = velocity_from_msg(msg, Config(velocity_frame='ned'))
    np.testing.assert_array_equal(velocity.velocity, [2.0, 1.0, -3.0])


@pytest.mark.parametrize('frame', ['', 'gps', 'gnss_link', 'antenna', 'map', 'enu', 'ned',
                                   'earth', 'baseline', 'insgps', 'world'])
def test_other_frames_are_taken(frame):
    msg = twist_with_covariance((1.0, 2.0, 3.0), np.eye(3), frame)
    assert velocity_from_msg(msg, Config()).stamp_ns == 12_000_000_034


@pytest.mark.parametrize('variance', [1e-320, 1e-13])
def test_variances_of_no_sensor_are_unknown(variance):
    assert sound_covariance(np.eye(3) * variance) is None
    np.testing.assert_allclose(
        sound_covariance(np.diag([0.04, variance, 0.04]), (0.2, 0.3, 0.4)),
        np.diag([0.04, 0.09, 0.04]))


@pytest.mark.parametrize('correlation', (0.0, 1e300))
def test_variances_beyond_all_bounds_stay_finite_in_products(correlation):
    usable = sound_covariance(np.full((3, 3), correlation) + np.diag([1e300, 1.0, 2e300]))
    assert np.isfinite(np.linalg.det(usable)) and np.linalg.det(usable) > 0.0
