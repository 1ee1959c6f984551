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
"""Lever arm and mounting from TF, in recordings, live, and by hand."""

from contextlib import closing
import sqlite3
from types import SimpleNamespace

from ins_align.cli import main
from ins_align.config import Config
from ins_align.geometry.rotation import log_so3, matrix_from_quaternion, matrix_from_rpy
from ins_align.mounting import find_mounting, FixedFrames
from ins_align.offline import replay
from ins_align.recordings import BagError
from ins_align.recordings.results_bag import write_results
from ins_align.results import Severity
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest
from recordings import FIX, IMU, make_fix, make_header, make_imu, START_NS
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

TF = 'tf2_msgs/msg/TFMessage'
LEVER_ARM = (1.5, -0.4, 0.8)
MOUNT_DEG = (2.0, -3.0, 90.0)


def transform(parent, child, translation, quaternion=(0.0, 0.0, 0.0, 1.0)):
    x, y, z = translation
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent), child_frame_id=child, transform=SimpleNamespace(
            translation=SimpleNamespace(x=x, y=y, z=z),
            rotation=SimpleNamespace(**dict(zip('xyzw', quaternion)))))


@pytest.fixture
def frames():
    """IMU on a plate that is turned by 90 deg about z; antenna on a mast."""
    found = FixedFrames()
    half = np.sqrt(0.5)
    for message in (transform('base_link', 'plate', (1.0, 0.0, 0.5), (0.0, 0.0, half, half)),
                    transform('plate', 'imu_link', (0.2, 0.0, 0.0)),
                    transform('/base_link', '/mast', (0.0, 2.0, 1.0)),
                    transform('mast', 'gnss', (0.0, 0.0, 1.0)),
                    transform('a', 'b', (0.0, 0.0, 0.0)), transform('b', 'a', (0.0, 0.0, 0.0))):
        found.add(message)
    return found


def test_transforms_by_hand(frames):
    # The IMU is at (1, 0.2, 0.5) of the base, the antenna at (0, 2, 2); x of the IMU is y there.
    rotation, translation = frames.lookup('imu_link', '/gnss')
    assert translation == pytest.approx([1.8, 1.0, 1.5])
    assert rotation @ [0.0, 1.0, 0.0] == pytest.approx([1.0, 0.0, 0.0])
    back = frames.lookup('gnss', 'imu_link')
    assert back.translation == pytest.approx([1.0, -1.8, -1.5])
    assert frames.lookup('imu_link', 'nowhere') is None
    assert frames.lookup('a', 'imu_link') is None  # a and b go round in circles


@pytest.mark.parametrize('parameters, lever_arm, notes, warnings', [
    ({}, (1.8, 1.0, 1.5), ['lever arm from TF: [1.8, 1, 1.5] m (from imu_link to gnss)'], 0),
    ({'lever_arm_from_tf': False}, (0.0, 0.0, 0.0), [], 0),
    ({'lever_arm': (1.9, 1.0, 1.5), 'lever_arm_std': 0.2}, (1.9, 1.0, 1.5), [], 0),
    ({'lever_arm': (1.8, 1.0, 1.5), 'lever_arm_std': 0.0}, (1.8, 1.0, 1.5), [], 0),
    ({'lever_arm': (1.8, -1.0, 1.5), 'lever_arm_std': 0.2}, (1.8, -1.0, 1.5), [], 1),
    ({'lever_arm': (1.8, -1.0, 1.5), 'lever_arm_from_tf': True, 'lever_arm_std': 0.2},
     (1.8, 1.0, 1.5), [], 1)])
def test_which_lever_arm_is_used(frames, parameters, lever_arm, notes, warnings):
    found = find_mounting(frames.lookup, 'imu_link', 'gnss', Config(**parameters))
    assert found.config.lever_arm == pytest.approx(lever_arm)
    told = {severity: [text for kind, text in found.words if kind is severity]
            for severity in Severity}
    assert told[Severity.INFO] == notes and found.missing == []
    assert len(told[Severity.WARNING]) == warnings
    for warning in told[Severity.WARNING]:
        assert '[1.8, -1.0, 1.5] m, but TF has [1.8, 1, 1.5] m' in warning
        assert 'more than lever_arm_std (0.2 m)' in warning


def test_what_tf_has_may_be_missing_or_senseless(frames):
    found = find_mounting(frames.lookup, 'imu_link', 'map',
                          Config(lever_arm_from_tf=True, base_frame='base'))
    assert found.missing == ["from 'map' (antenna) to 'imu_link' (IMU)",
                             "from 'base' (base) to 'imu_link' (IMU)"]
    assert found.config.lever_arm == (0.0, 0.0, 0.0) and found.base is None
    without_antenna = find_mounting(frames.lookup, 'imu_link', 'map',
                                    Config(base_frame='base_link'))
    assert without_antenna.base is not None and without_antenna.missing == []
    frames.add(transform('base_link', 'far', (5000.0, 0.0, 0.0)))
    frames.add(transform('base_link', 'bad', (np.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)))
    for frame in ('far', 'bad'):
        found = find_mounting(frames.lookup, 'imu_link', frame, Config())
        assert found.config == Config() and 'TF has is none' in found.words[0].text
    no_base = find_mounting(frames.lookup, 'imu_link', 'gnss', Config(base_frame='bad'))
    assert no_base.missing == ["from 'bad' (base) to 'imu_link' (IMU)"]


@pytest.mark.parametrize('imu_frame, antenna_frame', [('gnss', 'gnss'), ('ins', '/ins')])
def test_one_frame_of_both_sensors_says_nothing_about_the_lever_arm(
        frames, imu_frame, antenna_frame):
    config = Config(lever_arm=LEVER_ARM, lever_arm_std=0.05)
    assert find_mounting(frames.lookup, imu_frame, antenna_frame, config)[:3] == (config, None, [])
    missing, = find_mounting(frames.lookup, imu_frame, antenna_frame,
                             Config(lever_arm_from_tf=True)).missing
    assert missing == f'from {antenna_frame!r} (antenna) to {imu_frame!r} (IMU)'


@pytest.fixture(scope='module')
def drive():
    return simulate('car', seed=2, duration=40.0, imu_grade='tactical', lever_arm=LEVER_ARM,
                    mount_rpy_deg=MOUNT_DEG)


@pytest.fixture(scope='module')
def recording(drive, tmp_path_factory):
    path = tmp_path_factory.mktemp('mounting') / 'drive'
    write_bag(drive, path, tf=True)
    return path


def test_recording_with_tf_gives_the_numbers_of_the_parameter(recording, drive, tmp_path):
    from_tf = replay(recording, Config(imu_grade='tactical', base_frame='base_link'))
    given = replay(recording, Config(imu_grade='tactical', lever_arm=LEVER_ARM))
    without = replay(recording, Config(imu_grade='tactical', lever_arm_from_tf=False))
    assert from_tf.aligned and from_tf.warnings == given.warnings == ()
    for epoch, other in zip(from_tf.epochs, given.epochs, strict=True):
        assert (epoch.state, epoch.stamp_ns) == (other.state, other.stamp_ns)
        if epoch.current is not None:
            assert np.degrees(log_so3(
                epoch.current.C_nb @ other.current.C_nb.T)) == pytest.approx(np.zeros(3), abs=1e-6)
    assert without.config.lever_arm == (0.0, 0.0, 0.0)

    found = from_tf.to_json()
    assert found['base_frame'] == 'base_link' and 'base_frame' not in given.to_json()
    final = found['base_final_attitude']
    C_base = drive.attitude_at(from_tf.status.current.stamp_ns) \
        @ matrix_from_rpy(np.radians(MOUNT_DEG)).T
    error = np.degrees(log_so3(C_base @ matrix_from_quaternion(final['quaternion_xyzw']).T))
    assert np.all(np.abs(error) < 5 * np.array(final['sigma_deg']))
    assert abs(final['yaw_deg'] - found['final_attitude']['yaw_deg']) > 45.0

    write_results(from_tf, tmp_path / 'out')
    with AnyReader([tmp_path / 'out']) as reader:
        messages = {connection.topic: reader.deserialize(data, connection.msgtype)
                    for connection, _, data in reader.messages()}  # the last of each
    imu, base = messages['/ins_align/imu'], messages['/ins_align/base_imu']
    assert (imu.header.frame_id, base.header.frame_id) == ('imu', 'base_link')
    assert imu.header.stamp == base.header.stamp
    turns, forces = ([np.array([getattr(vector, name) for name in names])
                      for vector in (getattr(imu, part), getattr(base, part))]
                     for part, names in (('orientation', 'xyzw'), ('linear_acceleration', 'xyz')))
    C_nb, C_base = map(matrix_from_quaternion, turns)
    assert C_nb.T @ C_base == pytest.approx(matrix_from_rpy(np.radians(MOUNT_DEG)).T, abs=1e-12)
    assert C_base @ forces[1] == pytest.approx(C_nb @ forces[0])


def test_recording_with_tf_that_says_otherwise_or_nothing(recording, drive, tmp_path):
    result = replay(recording, Config(lever_arm=(1.5, 0.4, 0.8), lever_arm_std=0.05), duration=5.0)
    warning, = result.warnings
    assert 'lever_arm is [1.5, 0.4, 0.8] m, but TF has [1.5, -0.4, 0.8] m' in warning
    with pytest.raises(BagError, match="no transform from 'roof' .base. to 'imu' .IMU."):
        replay(recording, Config(base_frame='roof'))
    write_bag(drive, tmp_path / 'plain')
    with pytest.raises(BagError, match="no transform from 'gnss' .antenna. to 'imu' .IMU."):
        replay(tmp_path / 'plain', Config(lever_arm_from_tf=True))


@pytest.mark.parametrize('topic, edit', [
    ('/imu/data_raw', lambda data: b'\0\1\0\0'), ('/fix', lambda data: b'\0\1\0\0'),
    ('/imu/data_raw', lambda data: data.replace(b'\4\0\0\0imu\0', b'\1\0\0\0' + bytes(4)))])
def test_the_frame_is_that_of_the_first_message_with_one(drive, tmp_path, topic, edit):
    path = tmp_path / 'drive'
    write_bag(drive, path, 'sqlite3', tf=True)
    with closing(sqlite3.connect(path / 'drive.db3')) as database:
        key, data = database.execute(
            'SELECT messages.id, data FROM messages JOIN topics ON topic_id = topics.id '
            'WHERE name = ? ORDER BY timestamp', (topic,)).fetchone()
        database.execute('UPDATE messages SET data = ? WHERE id = ?', (edit(data), key))
        database.commit()
    result = replay(path, Config(base_frame='base_link'), duration=2.0)
    assert result.config.lever_arm == pytest.approx(LEVER_ARM)
    assert result.topics.base is not None and result.warnings == ()


def test_transforms_of_a_ros1_recording(tmp_path):
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg('geometry_msgs/TransformStamped[] transforms', TF))
    types = store.types
    pose = types['geometry_msgs/msg/Transform'](
        types['geometry_msgs/msg/Vector3'](*LEVER_ARM),
        types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0))
    to_antenna = types['geometry_msgs/msg/TransformStamped'](
        make_header(store, START_NS, 'imu_link'), 'gps', pose)
    with Writer(tmp_path / 'a.bag') as writer:
        for topic, msgtype, message in (
                ('/tf_static', TF, types[TF]([to_antenna])),
                ('/fix', FIX, make_fix(store, START_NS)),
                ('/imu', IMU, make_imu(store, START_NS, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8)))):
            connection = writer.add_connection(topic, msgtype, typestore=store)
            writer.write(connection, START_NS, store.serialize_ros1(message, msgtype))
    assert replay(tmp_path / 'a.bag').config.lever_arm == pytest.approx(LEVER_ARM)


def test_command_line(tmp_path, capsys):
    path = tmp_path / 'drive'
    assert main(['simulate', str(path), '--tf', '--scenario', 'car', '--duration', '5',
                 '--lever-arm', '1', '2', '3']) == 0
    assert replay(path).config.lever_arm == pytest.approx((1.0, 2.0, 3.0))
