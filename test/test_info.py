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
"""What is told of a recording before a run, against recordings whose faults are known."""

import dataclasses
import json
import math
import shlex

from ins_align.cli import main
from ins_align.config import Config
from ins_align.gnss.motion import (
    find_manoeuvres, Series, track, velocity_frame, without_wild_positions)
from ins_align.offline import replay
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import deserialize
from ins_align.recordings.info import describe, inspect
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest
from recordings import (
    FIX, IMU, make_twist, messages_of, real_recording, TWIST, typestore, write_messages,
    write_recording)

ODOMETRY = 'nav_msgs/msg/Odometry'
TOPICS = {'/imu/data_raw': IMU, '/fix': FIX, '/fix_velocity': TWIST}
DRIVE = {'scenario': 'car', 'seed': 1, 'duration': 60.0, 'stand_still': 15.0,
         'imu_grade': 'tactical', 'imu_rate': 50.0}


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    """Record a car that stands still for 15 s; its messages."""
    path = tmp_path_factory.mktemp('info') / 'drive'
    write_bag(simulate(**DRIVE), path)
    with Bag(path) as bag:
        topics = [topic for topic in bag.topics if topic.name in TOPICS]
        messages = [*messages_of(bag, topics)]
    return path, messages


@pytest.fixture
def changed(drive, tmp_path):
    """
    Return a function that writes the drive with its messages changed by another.

    That one takes topic, time and message and changes the message, or returns a list instead.
    """
    def write(change, kind='mcap', name='changed', topics=None):
        messages = []
        for topic, time, data in drive[1]:
            message = topic.name, time, deserialize(data, topic)
            new = change(*message)
            messages += [message] if new is None else new
        return write_messages(tmp_path / name, kind, messages, topics or TOPICS)
    return write


def by_name(info, name):
    return next(topic for topic in info.topics if topic.name == name)


def heading_of(info):
    return next(line for line in info.lines if 'heading' in line).split(': ', 1)[1]


def velocity_changed(function):
    """Return a change of each velocity."""
    def change(name, time, message):
        if name == '/fix_velocity':
            linear = message.twist.twist.linear
            linear.x, linear.y, linear.z = map(float, function(linear.x, linear.y, linear.z))
    return change


def gnss_ahead(seconds):
    """Return a change of the stamps of GNSS messages."""
    def change(name, time, message):
        if name != '/imu/data_raw':
            message.header.stamp.sec += seconds
    return change


def command_of(info):
    assert info.command is not None, info.faults
    arguments = shlex.split(info.command)
    assert arguments[:3] == ['ins_align', 'replay', info.bag]
    return arguments[3:]


def test_good_recording(drive):
    path, _ = drive
    info = inspect(path)
    assert command_of(info) == ['--set', 'imu_grade=tactical']
    assert info.faults == [] and info.warnings == ()
    assert [topic.name for topic in info.topics] == list(TOPICS)
    imu, fix, velocity = info.topics
    assert imu.figures['messages'] == 3001 and imu.figures['rate_hz'] == pytest.approx(50.0)
    assert fix.figures['rate_hz'] == pytest.approx(5.0)
    assert imu.figures['gaps'] == fix.figures['gaps'] == 0
    assert velocity.figures['frame'] == 'enu'
    assert velocity.figures['speed_ratio'] == pytest.approx(1.0, abs=0.1)
    assert velocity.figures['sigma'] == pytest.approx((0.1, 0.1))
    assert fix.figures['sigma'] == pytest.approx((2.5, 5.0))
    assert velocity.settings == fix.settings == info.settings == {}
    # It sets off after 15 s and then gains 5 m/s in some seconds.
    assert 13.0 < info.figures['first_manoeuvre_s'] < 20.0
    assert heading_of(info).startswith('yes')


def test_noise_and_bias_are_those_of_the_simulation(drive):
    imu = inspect(drive[0]).topics[0].figures
    truth = simulate(**DRIVE)
    noise = truth.imu_noise
    assert imu['angle_random_walk'] == pytest.approx(
        math.degrees(noise.angle_random_walk) * 60.0, rel=0.1)
    assert imu['velocity_random_walk'] == pytest.approx(noise.velocity_random_walk * 60.0, rel=0.1)
    assert 12.0 < imu['rest_s'] < 16.0
    still = truth.truth_gyro[100:600].mean(axis=0) + truth.gyro_bias
    sigma = noise.angle_random_walk / math.sqrt(imu['rest_s'])
    assert np.radians(imu['rest_rate_deg_s']) == pytest.approx(still, abs=3.0 * sigma)
    assert imu['imu_grade'] == 'tactical'


@pytest.mark.parametrize('grade', ['navigation', 'mems'])
def test_grade_at_rest(tmp_path, grade):
    write_bag(simulate('static', seed=2, duration=40.0, imu_grade=grade), tmp_path / 'a')
    info = inspect(tmp_path / 'a')
    assert info.topics[0].figures['imu_grade'] == grade
    assert heading_of(info).startswith('no')
    assert info.figures['first_manoeuvre_s'] is None


def test_noise_in_motion_is_an_upper_bound_only(tmp_path):
    write_bag(simulate('flight', seed=2, duration=30.0, imu_grade='navigation'), tmp_path / 'a')
    info = inspect(tmp_path / 'a')
    assert 'rest_s' not in info.topics[0].figures
    assert command_of(info) == []
    assert 'at most, measured in motion' in describe(info)


@pytest.mark.parametrize('function, settings', [
    (lambda e, n, u: (n, e, -u), ['velocity_frame=ned']),
    (lambda e, n, u: (e, n, 0.0), ['velocity_vertical=absent']),
    (lambda e, n, u: (n, e, 0.0), ['velocity_frame=ned', 'velocity_vertical=absent']),
    (lambda e, n, u: (e, n, math.nan), ['velocity_vertical=absent']),
    (lambda e, n, u: (math.hypot(e, n), 0.01, u), ['use_velocity=false']),
    (lambda e, n, u: (0.8 * e - 0.6 * n, 0.6 * e + 0.8 * n, u), ['use_velocity=false']),
    (lambda e, n, u: (3.6 * e, 3.6 * n, 3.6 * u), ['use_velocity=false'])],
    ids=['ned', 'flat', 'flat ned', 'no vertical', 'body', 'turned', 'km/h'])
def test_frame_of_the_velocity(changed, function, settings):
    info = inspect(changed(velocity_changed(function)))
    useless = settings == ['use_velocity=false']
    if not useless:  # standing still is not seen in positions of 2.5 m
        settings = ['imu_grade=tactical', *settings]
    assert command_of(info) == [word for setting in settings for word in ('--set', setting)]
    assert bool(by_name(info, '/fix_velocity').faults) == useless


@pytest.mark.parametrize('std, frame', [(0.02, 'ned'), (1.0, 'unknown')])
def test_sharp_positions_show_the_frame_of_a_slow_robot(tmp_path, std, frame):
    write_bag(simulate('robot', duration=30.0, position_std=std, velocity_frame='ned'),
              tmp_path / 'robot')
    info = inspect(tmp_path / 'robot')
    assert by_name(info, '/fix_velocity').figures['frame'] == frame


@pytest.mark.parametrize('ratio, said', [(1.0, False), (0.9, True)])
def test_velocities_that_are_too_short_for_the_clock_are_said(changed, ratio, said):
    info = inspect(changed(velocity_changed(lambda *v: [ratio * each for each in v])))
    line = next(line for line in by_name(info, '/fix_velocity').lines if 'frame: enu' in line)
    assert ('times as long' in line) == said and (not said or 'is 0.9' in line)


def test_velocity_that_says_it_is_in_the_body_frame(changed):
    def change(name, time, message):
        if name == '/fix_velocity':
            message.header.frame_id = 'base_link'

    # The motion tells that it is not.
    info = inspect(changed(change))
    assert by_name(info, '/fix_velocity').faults == []
    assert 'velocity_frame=enu' in info.command

    def in_the_axes_of_the_vehicle(*message):
        change(*message)
        velocity_changed(lambda e, n, u: (math.hypot(e, n), 0.0, u))(*message)

    info = inspect(changed(in_the_axes_of_the_vehicle, name='vehicle'))
    assert 'base_link' in by_name(info, '/fix_velocity').faults[0]
    assert 'use_velocity=false' in info.command


@pytest.mark.parametrize('scenario, heading_deg', [('straight', 0.0), ('flight', None)])
def test_a_receiver_is_preferred_to_the_wheels(tmp_path, scenario, heading_deg):
    """Wheel odometry is more frequent; on a course about east it even fits as ENU."""
    heading = {} if heading_deg is None else {'heading_deg': heading_deg}
    write_bag(simulate(scenario, seed=1, duration=60.0, imu_rate=50.0, gnss_rate=10.0, **heading),
              tmp_path / 'gnss')
    with Bag(tmp_path / 'gnss') as bag:
        messages = [(topic.name, time, deserialize(data, topic)) for topic, time, data
                    in messages_of(bag) if topic.name in TOPICS]
    types = typestore().types
    quaternion = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    pose = types['geometry_msgs/msg/PoseWithCovariance'](types['geometry_msgs/msg/Pose'](
        types['geometry_msgs/msg/Point'](0.0, 0.0, 0.0), quaternion), np.zeros(36))
    both = []
    for name, time, message in messages:
        if name == '/imu/data_raw' or message.header.stamp.nanosec // 100_000_000 % 2:
            both.append((name, time, message))
        if name == '/fix_velocity':
            linear = message.twist.twist.linear
            speed = make_twist(typestore(), 0, (math.hypot(linear.x, linear.y), 0.0, 0.0)).twist
            both.append(('/odom', time, types[ODOMETRY](message.header, 'base_link', pose, speed)))
    info = inspect(write_messages(tmp_path / 'both', 'mcap', both, {**TOPICS, '/odom': ODOMETRY}))
    assert info.faults == [] and info.chosen['velocity'] == '/fix_velocity'
    assert command_of(info)[:2] == ['--velocity-topic', '/fix_velocity']
    fits = by_name(info, '/odom').figures['frame'] == 'enu'
    assert fits == (scenario == 'straight')


def test_a_receiver_is_preferred_to_a_filter(tmp_path):
    """Of a combined unit, which sends the output of its filter more often."""
    write_bag(simulate('car', seed=1, duration=30.0, gnss_rate=10.0), tmp_path / 'gnss')
    with Bag(tmp_path / 'gnss') as bag:
        messages = [(topic.name, time, deserialize(data, topic)) for topic, time, data
                    in messages_of(bag) if topic.name in TOPICS]
    filtered = {f'/ekf{name}': kind for name, kind in TOPICS.items() if name != '/imu/data_raw'}
    both = [each for name, time, message in messages for each in (
        [(name, time, message)] if name == '/imu/data_raw' else
        [(f'/ekf{name}', time, message)]
        + [(name, time, message)] * (message.header.stamp.nanosec // 100_000_000 % 2))]
    info = inspect(write_messages(tmp_path / 'both', 'mcap', both, {**TOPICS, **filtered}))
    assert info.chosen == {'imu': '/imu/data_raw', 'fix': '/fix', 'velocity': '/fix_velocity'}
    assert 'output of a filter' not in describe(info)
    alone = [each for each in both if each[0] in filtered or each[0] == '/imu/data_raw']
    info = inspect(write_messages(tmp_path / 'alone', 'mcap', alone, {
        '/imu/data_raw': TOPICS['/imu/data_raw'], **filtered}))
    assert '/ekf/fix is the output of a filter, by its name' in describe(info)


def test_velocities_of_other_types(changed):
    """Vector3Stamped is read if its name says velocity, a Twist without a stamp is named."""
    types = typestore().types
    vector, twist = ('geometry_msgs/msg/Vector3Stamped', 'geometry_msgs/msg/Twist')

    def change(name, time, message):
        if name != '/fix_velocity':
            return [(name, time, message)]
        linear, field = message.twist.twist.linear, types['geometry_msgs/msg/Vector3'](1., 2., 3.)
        return [('/gnss/velocity', time, types[vector](message.header, linear)),
                ('/mag', time, types[vector](message.header, field)),
                ('/vel', time, message.twist.twist)]

    topics = {'/imu/data_raw': IMU, '/fix': FIX, '/gnss/velocity': vector, '/mag': vector,
              '/vel': twist}
    path = changed(change, topics=topics)
    info = inspect(path)
    assert info.chosen['velocity'] == '/gnss/velocity'
    assert [topic.name for topic in info.topics] == ['/imu/data_raw', '/fix', '/gnss/velocity']
    assert command_of(info)[:3] == ['--set', 'imu_grade=tactical', '--set']
    assert replay(path, duration=5.0).topics.velocity.name == '/gnss/velocity'

    path = changed(lambda name, time, message: [
        new for new in change(name, time, message) if 'gnss' not in new[0]],
        name='twist', topics={name: topics[name] for name in topics if 'gnss' not in name})
    assert '/vel cannot be used: geometry_msgs/Twist has no stamp' in inspect(path).warnings[0]
    warning, = replay(path, duration=5.0).warnings
    assert '/vel cannot be used: geometry_msgs/Twist has no stamp' in warning


def test_no_velocity_topic(changed):
    info = inspect(changed(lambda name, *rest: [(name, *rest)] if name != '/fix_velocity' else [],
                           topics={name: TOPICS[name] for name in ('/imu/data_raw', '/fix')}))
    assert command_of(info) == []
    assert 'positions alone' in describe(info)
    assert info.chosen['velocity'] is None
    assert heading_of(info).startswith('yes')


def test_an_imu_that_says_everything_twice(changed, drive):
    """Of one stamp the first counts, as in an alignment."""
    info = inspect(changed(lambda name, time, message: [(name, time, message)] * 2))
    once, twice = (by_name(each, '/imu/data_raw') for each in (inspect(drive[0]), info))
    assert twice.figures == once.figures | {
        name: twice.figures[name] for name in ('messages', 'out_of_order')}


def test_two_imus_quoted_for_a_shell(changed):
    """The one whose gravity is taken out is not proposed, and names stay words of a shell."""
    vector = typestore().types['geometry_msgs/msg/Vector3']
    odd = '/camera/imu; touch x'

    def change(name, time, message):
        if name != '/imu/data_raw':
            return None
        other = dataclasses.replace(message, linear_acceleration=vector(0.1, 0.0, 0.0))
        return [(name, time, message), (odd, time, other)]

    info = inspect(changed(change, name="it's a bag", topics={**TOPICS, odd: IMU}))
    assert command_of(info) == ['--imu-topic', '/imu/data_raw', '--set', 'imu_grade=tactical']
    assert 'gravity is 9.8' in by_name(info, odd).faults[0]


def test_two_good_imus_are_a_choice(changed):
    def change(name, time, message):
        if name == '/imu/data_raw' and time % 40_000_000 == 0:
            return [(name, time, message), ('/imu/slow', time, message)]
        return None

    info = inspect(changed(change, topics={**TOPICS, '/imu/slow': IMU}))
    assert info.chosen['imu'] == '/imu/data_raw'
    assert '--imu-topic /imu/data_raw' in info.command


def test_late_messages(changed):
    info = inspect(changed(lambda name, time, message: [
        (name, time + (2_000_000_000 if name != '/imu/data_raw' else 0), message)]))
    assert info.figures['gnss_lateness'] == pytest.approx(2.0, abs=0.05)
    assert by_name(info, '/fix').figures['stamp_age_s'] == pytest.approx(2.0, abs=0.01)
    assert '--set gnss_lateness=2.5' in info.command


def test_different_clocks(changed):
    info = inspect(changed(gnss_ahead(-1_000_000)))
    assert info.command is None
    assert 'different clocks' in info.faults[0]


def test_stamps_gone_astray(changed):
    """Some stamps of 0 neither stretch the time over decades nor spoil what is measured."""
    def change(name, time, message):
        if time % 7 < 2:
            message.header.stamp.sec = 0

    info = inspect(changed(change))
    imu = by_name(info, '/imu/data_raw')
    assert imu.figures['astray'] > 500
    assert imu.figures['imu_grade'] == 'tactical'
    assert by_name(info, '/fix_velocity').figures['frame'] == 'enu'


def test_half_of_the_stamps_of_another_clock(changed):
    """The median of two clocks is neither."""
    def change(name, time, message):
        if name == '/fix' and message.header.stamp.sec % 2 == 0:
            message.header.stamp.sec -= 1_000_000

    info = inspect(changed(change))
    assert by_name(info, '/fix').figures['astray'] == 150
    json.dumps(info.to_json(), allow_nan=False)


@pytest.mark.parametrize('says_so', (True, False))
def test_gaps_and_no_fix(changed, drive, says_so):
    start = drive[1][0][1]

    def change(name, time, message):
        seconds = (time - start) * 1e-9
        if name == '/imu/data_raw' and 30.0 < seconds < 33.0:
            return []
        if name == '/fix' and seconds > 45.0:
            if says_so:
                message.status.status = -1
            else:
                message.latitude = message.longitude = 0.0
        return None

    info = inspect(changed(change, 'sqlite3 file'))
    figures = by_name(info, '/imu/data_raw').figures
    assert figures['longest_gap_s'] == pytest.approx(3.0, abs=0.03)
    assert figures['longest_gap_start_s'] == pytest.approx(30.0, abs=0.03)
    assert 'silent for 3.0 s at 30.0 s' in describe(info)
    assert by_name(info, '/fix').figures['no_fix_share'] == pytest.approx(0.25, abs=0.01)
    assert 'without a fix: 25' in describe(info)


@pytest.mark.parametrize('silence, word', [(0.4, ''), (1.0, 'silent for 1.0 s')])
def test_silence_after_which_an_alignment_starts_over(changed, drive, silence, word):
    start = drive[1][0][1]
    path = changed(lambda name, time, message: [] if name == '/imu/data_raw' and (
        30.0 < (time - start) * 1e-9 < 30.0 + silence) else None)
    epochs = replay(path, start=20.0, duration=20.0).epochs
    lost = [now for before, now in zip(epochs, epochs[1:]) if before.initial and not now.initial]
    imu = by_name(inspect(path), '/imu/data_raw')
    notes = [line for line in imu.lines if 'starts over' in line]
    assert len(lost) == len(notes) == bool(word)
    assert all(word in note for note in notes)


def test_velocities_without_numbers_are_left_out(changed):
    info = inspect(changed(velocity_changed(lambda *_: [math.nan] * 3)))
    assert by_name(info, '/fix_velocity').faults == ['no message has numbers that can be used']
    assert command_of(info) == ['--set', 'use_velocity=false']
    assert 'positions alone' in describe(info) and heading_of(info).startswith('yes')


def test_an_imu_that_is_too_slow(changed, drive):
    start = drive[1][0][1]
    info = inspect(changed(lambda name, time, message: [] if name == '/imu/data_raw' and (
        (time - start) % 1_000_000_000 >= 10_000_000) else None))
    assert info.command is None and 'its rate is 1 Hz' in info.faults[0]


def test_an_imu_that_is_slow(tmp_path):
    path = tmp_path / 'slow'
    write_bag(simulate('car', duration=20.0, imu_rate=10.0), path)
    info = inspect(path)
    assert 'its rate is 10 Hz: what happens between two samples' in describe(info)
    assert info.command is not None


@pytest.mark.parametrize('ahead', [3, -3])
def test_clocks_some_seconds_apart(changed, ahead):
    """The motion tells clocks that differ from messages that are late."""
    path = changed(gnss_ahead(ahead))
    info = inspect(path)
    name, value = command_of(info)[3].split('=')
    assert name == 'gnss_delay' and float(value) == pytest.approx(ahead, abs=0.05)
    assert len(command_of(info)) == 4 and 'gnss_lateness' not in describe(info)
    assert replay(path, Config(imu_grade='tactical', gnss_delay=float(value)),
                  start=12.0, duration=30.0).aligned


@pytest.mark.parametrize('ahead, setting', [(3, 'gnss_delay=3.0'), (-3, 'gnss_lateness=3.5')])
def test_clocks_some_seconds_apart_at_rest(tmp_path, ahead, setting):
    """Without motion nothing tells; the note names both."""
    truth = simulate('static', seed=1, duration=30.0)
    write_bag(dataclasses.replace(
        truth, gnss_stamps_ns=truth.gnss_stamps_ns + ahead * 1_000_000_000), tmp_path / 'a')
    info = inspect(tmp_path / 'a')
    assert command_of(info)[-2:] == ['--set', setting]
    note = info.lines[-1]
    assert '3.0 s' in note and 'gnss_delay' in note


def test_an_imu_that_says_it_does_not_measure(changed):
    """Where it is the only one it is read all the same, as by `replay`."""
    def change(name, time, message, others=()):
        if name != '/imu/data_raw':
            return None
        covariance = np.array([-1.0] + [0.0] * 8)
        return [(name, time, dataclasses.replace(
            message, angular_velocity_covariance=covariance)), *(
                (other, time, message) for other in others)]

    path = changed(change)
    info = inspect(path)
    assert command_of(info) == ['--set', 'imu_grade=tactical']
    assert 'does not measure angular rate (covariance -1' in describe(info)
    assert replay(path, start=12.0, duration=30.0).aligned
    two = inspect(changed(lambda *message: change(*message, ['/imu']), name='two',
                          topics={**TOPICS, '/imu': IMU}))
    assert two.chosen['imu'] == '/imu'
    assert 'does not measure' in by_name(two, '/imu/data_raw').faults[0]


@pytest.mark.parametrize('latitude, status, fault', [
    (math.nan, 0, 'numbers that can be used'), (48.0, -1, 'no message has a fix')])
def test_positions_that_are_none(changed, latitude, status, fault):
    def change(name, time, message):
        if name == '/fix':
            message.latitude, message.status.status = latitude, status

    info = inspect(changed(change))
    assert info.command is None and fault in info.faults[0]


@pytest.mark.parametrize('topics', [{'/fix': FIX}, {'/imu': IMU}, {'/fix_velocity': TWIST}, {
    '/reference/imu': IMU}])
def test_topics_that_are_missing(tmp_path, topics):
    info = inspect(write_recording(tmp_path / 'a', 'mcap', 6.0, topics))
    assert info.command is None
    assert 'has no ' in info.faults[-1]
    assert 'it cannot be aligned' in describe(info)
    assert ('positions alone' in describe(info)) == (topics == {'/fix': FIX})
    nothing = write_messages(tmp_path / 'nothing', 'mcap', [], TOPICS)
    assert 'positions alone' not in describe(inspect(nothing))
    json.dumps(info.to_json(), allow_nan=False)


def test_values_that_are_no_numbers(changed):
    def change(name, time, message):
        if name == '/imu/data_raw' and time % 3 == 0:
            message.angular_velocity.x = math.nan
        if name == '/fix':
            message.altitude = math.inf
        if name == '/fix_velocity':
            message.twist.twist.linear.z = math.inf

    info = inspect(changed(change))
    assert by_name(info, '/imu/data_raw').figures['imu_grade'] == 'tactical'
    assert by_name(info, '/fix').figures['usable_share'] == 0.0
    assert ('without numbers, or with impossible ones: 33% of the messages'
            in by_name(info, '/imu/data_raw').lines)
    json.dumps(info.to_json(), allow_nan=False)


def test_an_imu_that_hangs(changed):
    def change(name, time, message):
        if name == '/imu/data_raw':
            message.angular_velocity.x = message.angular_velocity.y = 0.01
            message.angular_velocity.z = message.linear_acceleration.x = 0.02
            message.linear_acceleration.y, message.linear_acceleration.z = 0.03, 9.81

    path = changed(change)
    fault, = inspect(path).faults
    assert fault.endswith(replay(path).status.reason)


def test_positions_without_an_altitude(changed):
    def change(name, time, message):
        if name == '/fix':
            message.altitude = math.nan

    info = inspect(changed(change))
    assert by_name(info, '/fix').figures['usable_share'] == 1.0
    assert info.command is not None and not info.faults
    assert by_name(info, '/fix_velocity').figures['frame'] == 'enu'
    alone = changed(lambda name, time, message: (
        [] if name == '/fix_velocity' else change(name, time, message)), name='alone')
    assert inspect(alone).command is not None and 'positions alone' in describe(inspect(alone))
    assert replay(alone).status.current is not None


def test_half_of_a_recording(tmp_path):
    path = write_recording(tmp_path / 'a', 'mcap', 20.0)
    file, = path.glob('a.*')
    file.write_bytes(file.read_bytes()[:file.stat().st_size // 2])
    info = inspect(file)
    assert 'as far as it goes' in info.warnings[0]
    last = max(topic.figures['last_s'] for topic in info.topics)
    assert info.duration_s >= last > 7.0
    assert f'{info.duration_s:.1f} s, recorded from 2023-11-14 22:13:20' in describe(info)


def test_text_of_a_recording_cannot_move_the_cursor(tmp_path):
    info = inspect(write_recording(tmp_path / 'a', 'mcap', 6.0, {'/imu\x1b[2J': IMU, '/fix': FIX}))
    assert '\x1b' not in describe(info)


def test_track_and_manoeuvres_by_hand():
    """A quarter turn at 10 m/s between two straights of 30 s."""
    times = np.arange(0.0, 60.0, 0.5)
    east = np.where(times < 30.0, 10.0, 0.0)
    velocities = Series(times, np.column_stack([east, 10.0 - east, np.zeros_like(times)]))
    assert find_manoeuvres(velocities) == (pytest.approx(10.0 * math.sqrt(2.0)), 29.5)
    degree = math.degrees(1.0 / 6_371_000.0)
    north = np.cumsum(velocities.vectors[:, 1]) * 0.5
    cosine = math.cos(math.radians(60.0))
    positions = track(Series(times, np.column_stack([
        60.0 + north * degree, 179.999 + np.remainder(
            np.cumsum(east) * 0.5 * degree / cosine + 180.0, 360.0) - 180.0,
        np.zeros_like(times)])))
    assert positions.vectors[-1, :2] == pytest.approx([295.0, 300.0], abs=0.2)
    frame = velocity_frame(velocities, positions)
    assert frame.frame == 'enu' and frame.windows > 20
    swapped = Series(times, velocities.vectors[:, [1, 0, 2]])
    assert velocity_frame(swapped, positions).frame == 'ned'


@pytest.mark.parametrize('rate', [0.0, 0.003, 0.005, 0.01, 0.05])
@pytest.mark.parametrize('seed', [1, 2, 3])
def test_wild_fixes_do_not_change_the_frame(rate, seed):
    """Positions 50 m off and velocities 5 m/s off, some of them one after the other."""
    truth = simulate('car', seed=seed, duration=100.0, outlier_rate=rate)
    times = (truth.gnss_stamps_ns - truth.gnss_stamps_ns[0]) * 1e-9
    spoilt = track(Series(times, truth.lla_deg))
    positions = without_wild_positions(spoilt)
    # Of a spike in a random direction a part may point along the way or be short.
    wild = np.isin(times, positions.times, invert=True)
    assert np.count_nonzero(wild & truth.outlier) >= 0.8 * np.count_nonzero(truth.outlier)
    assert np.count_nonzero(wild & ~truth.outlier) <= 1
    C_bn = truth.attitude_at(truth.gnss_stamps_ns).transpose(0, 2, 1)
    east, north, up = truth.velocity.T
    for frame, velocity in (
            ('enu', truth.velocity), ('ned', np.column_stack([north, east, -up])),
            ('body', np.einsum('nij,nj->ni', C_bn, truth.velocity)),
            ('turned', np.column_stack([0.8 * east - 0.6 * north, 0.6 * east + 0.8 * north, up])),
            ('contradiction', 3.6 * truth.velocity)):
        found = velocity_frame(Series(times, velocity), positions)
        assert found.frame == frame
        assert found.speed_ratio == pytest.approx(3.6 if frame == 'contradiction' else 1.0,
                                                  rel=0.1)


def test_wild_fixes_are_no_manoeuvres(tmp_path):
    """From positions alone; steady course, of which the receiver is sometimes 50 m off."""
    write_bag(simulate('straight', seed=1, outlier_rate=0.02), tmp_path / 'a')
    with Bag(tmp_path / 'a') as bag:
        topics = [topic for topic in bag.topics if topic.name in ('/imu/data_raw', '/fix')]
        messages = [(topic.name, time, deserialize(data, topic))
                    for topic, time, data in messages_of(bag, topics)]
    path = write_messages(tmp_path / 'b', 'mcap', messages, {'/imu/data_raw': IMU, '/fix': FIX})
    assert inspect(path).figures['first_manoeuvre_s'] is None


def test_sharp_turns_and_gaps_are_no_spikes():
    """Two fixes a second of a vehicle that turns on the spot, with some of them missing."""
    times = np.delete(np.arange(0.0, 40.0, 0.5), [10, 30, 31, 32, 50])
    east = 20.0 * np.minimum(times, 20.0)
    north = 20.0 * np.maximum(times - 20.0, 0.0)
    positions = Series(times, np.column_stack([east, north, 0.0 * times]))
    assert without_wild_positions(positions).times.tolist() == times.tolist()
    few = Series(times[:4], positions.vectors[:4])
    assert without_wild_positions(few) is few


def test_velocities_and_positions_of_different_times_leave_the_frame_open():
    times = np.arange(0.0, 60.0, 0.5)
    line = np.column_stack([10.0 * times, times, times])
    assert velocity_frame(Series(times, line), Series(times + 100.0, line)).frame == 'unknown'


@pytest.mark.parametrize('noise', (0.0, 0.02))
@pytest.mark.parametrize('unit, expected', [(1.0, 'enu'), (3.6, 'contradiction')])
def test_loops_of_a_walker_are_no_wrong_unit(noise, unit, expected):
    """A way that winds: while it leads 10 m away, 20 m are walked."""
    times = np.arange(0.0, 120.0, 0.25)
    turn = 2 * np.pi * times / 12.0
    place = np.column_stack([0.7 * times + 3.0 * np.cos(turn), 3.0 * np.sin(turn), 0 * times])
    speed = np.gradient(place, times, axis=0)
    noisy = place + noise * np.random.default_rng(0).standard_normal(place.shape)
    frame = velocity_frame(Series(times, unit * speed), Series(times, noisy))
    assert frame.frame == expected
    assert frame.speed_ratio == pytest.approx(unit, rel=0.05)


@pytest.mark.parametrize('name, rate, frame, rest, first, settings', [
    ('uav_thor75', 50.0, 'enu', True, 45.0, {
        'gnss_delay': (0.03, 0.1), 'velocity_std': (0.1, 0.25),
        'velocity_std_vertical': (0.1, 0.35)}),
    # Its clocks drift apart, from 0.13 s to 0: no delay is right for all of it.
    ('car_drive0708', 100.0, 'enu', True, 53.0, {'accel_bias_std': (0.13, 0.15)}),
    ('quad_dot08.bag', 120.5, None, False, 2.7, {})])
def test_real_recordings(name, rate, frame, rest, first, settings):
    info = inspect(real_recording(name))
    imu = by_name(info, '/imu/data_raw')
    assert imu.figures['rate_hz'] == pytest.approx(rate, rel=0.01)
    assert imu.faults == [] and imu.figures['imu_grade'] == 'mems'
    assert ('rest_s' in imu.figures) == rest
    assert (info.chosen['velocity'] is None) == (frame is None)
    if frame:
        assert by_name(info, '/fix_velocity').figures['frame'] == frame
    assert info.figures['first_manoeuvre_s'] == pytest.approx(first, abs=2.0)
    found = dict(setting.split('=') for setting in command_of(info)[1::2])
    assert set(found) == set(settings)
    for parameter, (least, most) in settings.items():
        assert least < float(found[parameter]) < most
    said = describe(info)
    assert 'dead band' not in said and 'round to' not in said
    lines = said.replace(info.command, '').splitlines()  # has the path, however long
    assert max(map(len, lines)) < 130


def test_command_line(drive, tmp_path, capsys):
    path, _ = drive
    out = tmp_path / 'a.json'
    assert main(['info', str(path), '--json', str(out)]) == 0
    captured = capsys.readouterr()
    content = json.loads(out.read_text())
    assert content['command'] in captured.out and captured.err == ''
    assert content['topics'][2]['figures']['frame'] == 'enu'
    assert main(['info', str(tmp_path / 'none')]) == 2
    captured = capsys.readouterr()
    assert captured.out == '' and captured.err.count('\n') == 1
    assert main(['info', str(tmp_path / 'none'), str(path), '--json', str(out)]) == 2
    content = json.loads(out.read_text())
    assert 'does not exist' in content[0]['error'] and content[1]['command']
    assert main(['info', str(path), '--json', str(tmp_path / 'no' / 'a.json')]) == 2


def test_proposed_command_runs(changed, capsys):
    """A recording that does not align by itself does with what is proposed."""
    path = changed(velocity_changed(lambda e, n, u: (n, e, -u)))
    part = '--start', '12', '--duration', '30'
    assert main(['replay', str(path), *part]) == 1
    proposed = shlex.split(inspect(path).command)[1:]
    assert main([*proposed, *part, '--set', 'lever_arm=[1,1,1]']) == 0
