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
"""Lever arm and base from TF in the live node, with a stand-in for tf2_ros and its Buffer."""

import os

from ins_align.config import Config, ConfigError
from ins_align.geometry.rotation import matrix_from_quaternion, Transform
from ins_align.gnss.messages import Fix
from ins_align.mounting import MountingSearch
from ins_align.ros.inputs import ImuSample
from ins_align.simulation.simulate import simulate, write_bag
from node_harness import (
    bag_script, Listener, playing, RELIABLE, replayed, running_node, script_of, simulated_messages,
    stamp_ns)
import numpy as np
import pytest
from sensor_msgs.msg import Imu
from test_node import double, set_parameter
from test_node_topics import PARAMETERS

SAMPLE = (1, ImuSample(10, (0.0, 0.0, 0.0), (0.0, 0.0, 9.8), 'imu'))
FIX = (2, Fix(10, 48.0, 11.0, 300.0, None, 0))
LEVER_ARM = np.array([1.0, 2.0, 3.0])
# tf2_ros as the node uses it: the transforms of the simulation, there after some questions only.
STAND_IN = """
from geometry_msgs.msg import TransformStamped
from std_msgs.msg import Empty


class Buffer:
    def __init__(self):
        self.asked = 0

    def can_transform(self, target, source, time):
        self.asked += 1
        return target.startswith('imu') and source in ('gnss', 'base_link') and self.asked > 3

    def lookup_transform(self, target, source, time):
        found = TransformStamped()
        if source == 'gnss':
            found.transform.translation.x, found.transform.translation.y = 1.5, -0.4
            found.transform.translation.z = 0.8
        else:  # the IMU is turned to the left by 90 deg
            found.transform.rotation.z = -0.5 ** 0.5
            found.transform.rotation.w = 0.5 ** 0.5
        return found


class TransformListener:
    def __init__(self, buffer, node):
        self.tf_sub = node.create_subscription(Empty, '/tf', print, 1)
"""


@pytest.fixture
def stand_in(tmp_path_factory, monkeypatch):
    """Let nodes find the stand-in as tf2_ros."""
    package = tmp_path_factory.mktemp('path') / 'tf2_ros'
    package.mkdir()
    (package / '__init__.py').write_text(STAND_IN)
    monkeypatch.setenv('PYTHONPATH', os.pathsep.join(
        [str(package.parent), os.environ.get('PYTHONPATH', '')]))


def search(translations, **parameters):
    """Look in transforms that may appear one after the other; None: there is no TF."""
    def lookup(target, source):
        return Transform(np.eye(3), translations[source]) if source in translations else None

    found = MountingSearch(Config(**parameters), None if translations is None else lookup)
    found.antenna_frame = 'gnss'
    return found


def test_without_tf_nothing_waits():
    assert search(None).take([SAMPLE], 0.0)[0] == [SAMPLE]
    assert search({}, lever_arm_from_tf=False).take([SAMPLE], 0.0)[0] == [SAMPLE]
    with pytest.raises(ConfigError, match='tf2_ros is not installed: sudo apt install'):
        search(None, lever_arm_from_tf=True)


def test_messages_from_before_the_transform_are_aligned_with_it():
    translations = {}
    auto = search(translations)
    assert auto.take([SAMPLE], 0.0) == ([SAMPLE], None)
    translations['gnss'] = LEVER_ARM
    items, mounting = auto.take([FIX], 0.5)
    assert items == [SAMPLE, FIX] and mounting.config.lever_arm == (1.0, 2.0, 3.0)
    assert auto.take([SAMPLE], 1.0) == ([SAMPLE], None)
    auto.restart()  # another IMU, which the model does not have
    del translations['gnss']
    assert auto.take([SAMPLE], 10.0) == ([SAMPLE], None)
    items, mounting = auto.take([FIX], 13.0)
    assert items == [SAMPLE, FIX] and mounting.config.lever_arm == (0.0, 0.0, 0.0)


def test_a_transform_that_comes_late_is_used():
    translations = {}
    auto = search(translations)
    assert auto.take([SAMPLE, FIX], 0.0) == ([SAMPLE, FIX], None)
    items, mounting = auto.take([SAMPLE], 2.5)
    said, = mounting.words
    assert "no transform from the antenna ('gnss') to the IMU ('imu') yet" in said.text
    for now in (3.0, 5.0, 60.0):
        assert auto.take([SAMPLE], now) == ([SAMPLE], None)
    translations['gnss'] = LEVER_ARM
    items, mounting = auto.take([FIX], 63.0)
    assert items == [FIX] and mounting.config.lever_arm == (1.0, 2.0, 3.0)
    said, = mounting.words
    assert 'lever arm from TF: [1, 2, 3] m' in said.text
    assert auto.take([SAMPLE], 90.0) == ([SAMPLE], None)


def test_what_is_wanted_is_waited_for_and_named():
    translations = {'gnss': LEVER_ARM}
    wanted = search(translations, lever_arm_from_tf=True, base_frame='base_link')
    request = (3, print)
    assert wanted.waits_for == 'a message of the IMU and a position'
    assert wanted.take([SAMPLE, request, FIX], 0.0) == ([request], None)
    assert wanted.waits_for == "the transform from 'base_link' (base) to 'imu' (IMU)"
    assert wanted.take([], 100.0) == ([], None)
    translations['base_link'] = np.zeros(3)
    items, mounting = wanted.take([], 101.0)
    assert items == [SAMPLE, FIX] and wanted.waits_for == ''
    assert np.array_equal(mounting.base.rotation, np.eye(3))


@pytest.mark.parametrize('lever_arm_from_tf, antenna_frame', [
    ('auto', 'gnss'), ('auto', ''), (False, '')])  # NavPVT has no frame
def test_a_base_alone_does_not_wait_for_the_antenna(lever_arm_from_tf, antenna_frame):
    found = search({'base_link': np.zeros(3)}, base_frame='base_link', lever_arm=(1.0, 2.0, 3.0),
                   lever_arm_from_tf=lever_arm_from_tf)
    found.antenna_frame = antenna_frame
    items, mounting = found.take([SAMPLE, FIX], 0.0)
    if lever_arm_from_tf == 'auto':
        assert (items, mounting) == ([], None)  # its transform may still come
        items, mounting = found.take([], 3.0)
    assert items == [SAMPLE, FIX] and mounting.base is not None
    assert mounting.config.lever_arm == (1.0, 2.0, 3.0)


def test_base_imu_is_imu_in_the_axes_of_the_base(tmp_path, stand_in):
    flight = simulate('flight', imu_grade='tactical', seed=1, duration=16.0)
    bases, imus = [], []
    with Listener() as listener, running_node(
            [*PARAMETERS, 'lever_arm_from_tf:=false', 'base_frame:=base_link']):
        def subscribe(topic, store):
            listener.node.create_subscription(Imu, f'/ins_align/{topic}', store.append, 5000)

        subscribe('base_imu', bases)
        listener.wait_for(lambda: listener.statuses)
        with playing(script_of(simulated_messages(flight)), tmp_path, 8.0):
            listener.wait_for(lambda: bases)  # also if nobody listens to the other
            subscribe('imu', imus)
    base_of = {stamp_ns(msg): msg for msg in bases}
    pairs = [(msg, base_of[stamp_ns(msg)]) for msg in imus]
    assert len(pairs) > 100
    for imu, base in pairs[::20]:
        assert base.header.frame_id == 'base_link'
        # The IMU is turned to the left by 90 deg.
        C_nb, C_base = (matrix_from_quaternion(np.array([turn.x, turn.y, turn.z, turn.w]))
                        for turn in (imu.orientation, base.orientation))
        assert C_base[:, 1] == pytest.approx(C_nb[:, 0])
        assert base.angular_velocity.y == pytest.approx(imu.angular_velocity.x)
        assert np.array_equal(base.orientation_covariance, imu.orientation_covariance)


@pytest.mark.campaign
@pytest.mark.parametrize('base_frame, vehicle', [
    ('', 'none'), ('base_link', 'none'), ('base_link', 'car')])
def test_node_with_tf_gives_the_numbers_of_the_parameter(tmp_path, stand_in, base_frame, vehicle):
    drive = simulate('car', seed=2, duration=40.0, imu_grade='tactical',
                     lever_arm=(1.5, -0.4, 0.8), mount_rpy_deg=(0.0, 0.0, 90.0))
    write_bag(drive, tmp_path / 'drive')
    write_bag(drive, tmp_path / 'with_tf', tf=True)
    parameters = {'imu_grade': 'tactical', 'gnss_lateness': 4.0}
    if vehicle != 'none':
        parameters.update(vehicle=vehicle, base_frame=base_frame)
    rows = replayed(tmp_path / ('drive' if vehicle == 'none' else 'with_tf'),
                    {**parameters, 'lever_arm': '[1.5, -0.4, 0.8]'}, tmp_path / 'rows.csv')
    declared = next(row for row in rows if row['state'] == 'ALIGNED')
    given = [f'{name}:={value}' for name, value in parameters.items()]
    if base_frame and vehicle == 'none':
        given.append(f'base_frame:={base_frame}')
    with Listener() as listener, running_node([*given, *RELIABLE]) as node:
        listener.wait_for(lambda: listener.statuses)
        with playing(bag_script(tmp_path / 'drive'), tmp_path, 4.0):
            # Whenever it comes, a change of a threshold keeps the lever arm of TF.
            while listener.status['lever_arm_m'] == '0 0 0':
                assert set_parameter(listener, 'hold_time', double(1.0)).successful
        listener.wait_for(lambda: listener.count('imu') == len(drive.imu_stamps_ns))
        listener.wait_for(lambda: listener.attitudes)
        listener.wait_for_next_status()
    assert 'lever arm from TF: [1.5, -0.4, 0.8] m (from imu to gnss)' in node.output
    q = listener.attitudes[0].quaternion
    assert [q.x, q.y, q.z, q.w] == pytest.approx(
        [float(declared[name]) for name in ('qx', 'qy', 'qz', 'qw')], abs=1e-9)
    if base_frame:
        assert listener.status['base_frame'] == 'base_link'
        imu, base = (np.array(listener.status[f'{name}_roll_pitch_yaw_deg'].split(), float)
                     for name in ('current', 'base_current'))
        assert (imu[2] - base[2] - 90.0 + 180.0) % 360.0 == pytest.approx(180.0, abs=0.2)
    else:
        assert 'base_frame' not in listener.status
