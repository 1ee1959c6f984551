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
"""Results as a recording: against the result, the truth, and as other readers see them."""

import math

from alignment import feed
from ins_align.aligner import Aligner
from ins_align.cli import main
from ins_align.config import Config
from ins_align.geometry.rotation import log_so3, matrix_from_quaternion
from ins_align.gnss.messages import stamp_from_msg
from ins_align.offline import replay
from ins_align.recordings import BagError
from ins_align.recordings.results_bag import write_results
from ins_align.results import State
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest
from recordings import real_recording, write_messages
from rosbags.highlevel import AnyReader

IMU_TOPIC, PERIOD_NS = '/imu/data_raw', 10_000_000
CONFIG = Config(lever_arm=(1.0, 1.0, 1.0), imu_grade='tactical', gnss_lateness=2.0)


def read(path):
    """Return (recorded time, message) by topic, in the order of the recording."""
    found = {}
    with AnyReader([path]) as reader:
        times = []
        for connection, time_ns, data in reader.messages():
            times.append(time_ns)
            found.setdefault(connection.topic, []).append(
                (time_ns, reader.deserialize(data, connection.msgtype)))
    assert times == sorted(times)
    return found


@pytest.fixture(scope='module')
def drive(tmp_path_factory):
    """Make a drive with an outage in which the alignment lasts; the folder holds drive and out."""
    folder = tmp_path_factory.mktemp('results')
    simulation = simulate('car', seed=4, duration=50.0, imu_grade='tactical', gnss_latency=0.3,
                          outages=[(40.0, 44.0)])
    write_bag(simulation, folder / 'drive')
    result = replay(folder / 'drive', CONFIG)
    write_results(result, folder / 'out')
    return folder, simulation, result


def test_same_topics_stamps_and_values_as_the_result(drive):
    folder, simulation, result = drive
    found, original = read(folder / 'out'), read(folder / 'drive')
    assert {topic.removeprefix('/ins_align/') for topic in found} == {
        'imu', 'initial_attitude', 'status', 'roll_pitch_yaw_deg', 'sigma_deg', 'gyro_bias',
        'accel_bias'}

    declared = next(epoch for epoch in result.epochs if epoch.state is State.ALIGNED)
    (time_ns, attitude), = found['/ins_align/initial_attitude']
    q = attitude.quaternion
    assert [q.x, q.y, q.z, q.w] == declared.initial.quaternion_xyzw.tolist()
    assert stamp_from_msg(attitude) == declared.initial.stamp_ns
    assert attitude.header.frame_id == 'map'
    assert declared.stamp_ns <= time_ns < declared.stamp_ns + PERIOD_NS

    epochs = [epoch for epoch in result.epochs if epoch.current is not None]
    yaw, sigma = (found[f'/ins_align/{name}'] for name in ('roll_pitch_yaw_deg', 'sigma_deg'))
    assert [message.vector.z for _, message in yaw] == [e.current.yaw_deg for e in epochs]
    assert [message.vector.x for _, message in sigma] == [e.current.sigma_deg[0] for e in epochs]
    for name in ('gyro_bias', 'accel_bias'):
        biases = [message for _, message in found[f'/ins_align/{name}']]
        assert [message.vector.z for message in biases] == [getattr(e, name)[2] for e in epochs]
        assert {message.header.frame_id for message in biases} == {'imu'}
    assert [stamp_from_msg(message) for _, message in yaw] == [e.current.stamp_ns for e in epochs]

    # Each input sample from the declaration on, recorded when the input was.
    imus = found['/ins_align/imu']
    inputs = {stamp_from_msg(message): (time, message) for time, message in original[IMU_TOPIC]}
    assert len(imus) == np.count_nonzero(simulation.imu_stamps_ns >= declared.stamp_ns)
    for time_ns, message in imus[::50]:
        time, sent = inputs[stamp_from_msg(message)]
        assert time_ns == time and message.header.frame_id == sent.header.frame_id
        for vector, other in ((message.angular_velocity, sent.angular_velocity),
                              (message.linear_acceleration, sent.linear_acceleration)):
            assert (vector.x, vector.y, vector.z) == (other.x, other.y, other.z)


def test_orientation_against_truth(drive):
    folder, simulation, result = drive
    messages = [message for _, message in read(folder / 'out')['/ins_align/imu']]
    stamps = np.array(list(map(stamp_from_msg, messages)))
    truth = simulation.attitude_at(stamps)
    turns = [(turn.x, turn.y, turn.z, turn.w) for turn in (
        message.orientation for message in messages)]
    errors = np.degrees(log_so3(
        matrix_from_quaternion(np.array(turns)) @ np.swapaxes(truth, -1, -2)))
    sigmas = np.degrees(np.sqrt([message.orientation_covariance[[0, 4, 8]]
                                 for message in messages]))
    assert len(errors) > 2000 and np.abs(errors / sigmas).max() < 4.0
    # Between epochs it follows the motion.
    epochs = np.searchsorted([epoch.stamp_ns for epoch in result.epochs], stamps)
    steps = np.abs(np.diff(errors, axis=0))[np.diff(epochs) == 0]
    assert steps.max() < 0.01 < np.degrees(np.abs(simulation.gyro[:, 2]).max()) * PERIOD_NS * 1e-9


def test_the_last_orientation_is_that_of_the_node(tmp_path):
    """Gyros that are a chip's turn by degrees too much; both take that off."""
    flight = simulate('flight', seed=3, duration=60.0, imu_rate=50.0, gnss_rate=1.0,
                      gyro_scale_std=0.03)
    config = Config(lever_arm=(1.0, 1.0, 1.0), imu_grade='chip', heading_std_threshold=8.0,
                    tilt_std_threshold=4.0)
    write_bag(flight, tmp_path / 'flight')
    write_results(replay(tmp_path / 'flight', config), tmp_path / 'out')
    _, last = read(tmp_path / 'out')['/ins_align/imu'][-1]
    aligner = Aligner(config)
    feed(aligner, flight)
    now = aligner.attitude_now()
    turn = last.orientation
    assert stamp_from_msg(last) == now.stamp_ns > aligner.status().stamp_ns
    assert np.array([turn.x, turn.y, turn.z, turn.w]) == pytest.approx(
        now.quaternion_xyzw, abs=1e-6)
    assert last.orientation_covariance == pytest.approx(now.covariance.ravel(), rel=1e-6)


def test_status_is_that_of_the_result(drive):
    folder, _, result = drive
    statuses = [(message.status[0], {each.key: each.value for each in message.status[0].values})
                for _, message in read(folder / 'out')['/ins_align/status']]
    status, values = statuses[-1]
    assert status.message == f'ALIGNED: {result.status.reason}' and int(status.level) == 0
    assert status.hardware_id == 'imu'
    assert values['fix'] == str(result.status.counts['fix'])
    states = [values['state'] for _, values in statuses]
    for state in {epoch.state.value for epoch in result.epochs}:
        assert state in states
    told = [f'{span.first.state.value}: {span.reason}' for span in result.spans]
    assert len(told) >= 2 and set(told) <= {status.message for status, _ in statuses}
    assert len(statuses) >= 45  # one a second


def ahead(k, seconds, message):
    """Let the clock of one sample be an hour ahead."""
    if k == 3000:
        message.header.stamp.sec += 3600


def set_back(k, seconds, message):
    if seconds >= 20.0:
        message.header.stamp.sec -= 1000


def no_numbers(k, seconds, message):
    if k % 49 == 0 and hasattr(message, 'angular_velocity'):
        message.angular_velocity.y = math.nan


@pytest.mark.parametrize('change, start', [
    (ahead, None), (set_back, None), (set_back, 22.0), (no_numbers, None)])
def test_samples_gone_astray_cost_no_others(drive, tmp_path, change, start):
    messages = []
    for topic, found in read(drive[0] / 'drive').items():
        for k, (time_ns, message) in enumerate(found):
            if topic == IMU_TOPIC or change is set_back and topic in ('/fix', '/fix_velocity'):
                change(k, 1e-9 * (time_ns - found[0][0]), message)
            messages.append((topic, time_ns, message))
    messages.sort(key=lambda message: message[1])
    path = write_messages(tmp_path / 'a', 'mcap', messages, {
        topic: message.__msgtype__ for topic, _, message in messages})
    result = replay(path, CONFIG, start=start)
    write_results(result, tmp_path / 'out')
    found = read(tmp_path / 'out')

    # Each sample from the declaration by its clock on, with an orientation.
    declared = [after.stamp_ns for before, after in zip(result.epochs, result.epochs[1:])
                if after.state is State.ALIGNED is not before.state]
    samples = [stamp_from_msg(message) for topic, _, message in messages
               if topic == IMU_TOPIC and not math.isnan(message.angular_velocity.y)]
    imus = [message for _, message in found['/ins_align/imu']]
    assert len(declared) == (2 if change is set_back and start is None else 1)
    assert len(imus) == sum(stamp <= sample < stamp + 100e9
                            for stamp in declared for sample in samples)
    for message in imus:
        turn = message.orientation
        assert np.isfinite([turn.x, turn.y, turn.z, turn.w,
                            *message.orientation_covariance]).all()
    # Epochs are recorded in time, also by a clock that was set back, with a status each second.
    late = [(time_ns - stamp_from_msg(message)) * 1e-9 % 1000.0
            for time_ns, message in found['/ins_align/sigma_deg']]
    assert max(late) <= 2e-9 * PERIOD_NS
    assert len(found['/ins_align/status']) >= 45 - (start or 0.0)


def test_official_reader(drive):
    reader = pytest.importorskip('mcap.reader')
    folder, _, _ = drive
    with open(next((folder / 'out').glob('*.mcap')), 'rb') as file:
        summary = reader.make_reader(file).get_summary()
        counts = {channel.topic: summary.statistics.channel_message_counts[number]
                  for number, channel in summary.channels.items()}
        schemas = {schema.name for schema in summary.schemas.values()}
        times = [message.log_time for _, _, message in reader.make_reader(file).iter_messages()]
    found = read(folder / 'out')
    assert counts == {topic: len(messages) for topic, messages in found.items()}
    assert times == sorted(times) and len(times) == sum(counts.values())
    assert schemas == {'sensor_msgs/msg/Imu', 'geometry_msgs/msg/QuaternionStamped',
                       'geometry_msgs/msg/Vector3Stamped', 'diagnostic_msgs/msg/DiagnosticArray'}


def test_command_line_and_what_is_there_already(drive, capsys):
    folder, _, _ = drive
    arguments = ['replay', str(folder / 'drive'), '--lever-arm', '1', '1', '1', '--duration', '10',
                 '--bag', str(folder / 'short')]
    assert main(arguments) == 1
    assert read(folder / 'short')['/ins_align/status'][-1][0] < read(
        folder / 'out')['/ins_align/status'][-1][0]
    assert main(arguments) == 2
    assert f'cannot write {folder / "short"}: it exists already' in capsys.readouterr().err
    with pytest.raises(BagError, match='exists already'):
        write_results(replay(folder / 'drive', duration=2.0), folder / 'short')


@pytest.mark.parametrize('name', [
    pytest.param('uav_thor75', marks=pytest.mark.campaign), 'quad_dot08.bag',
    pytest.param('car_drive0708', marks=pytest.mark.campaign)])
def test_real_recordings(name, tmp_path):
    result = replay(real_recording(name))
    write_results(result, tmp_path / 'out')
    found = read(tmp_path / 'out')
    assert len(found['/ins_align/sigma_deg']) == sum(
        epoch.current is not None for epoch in result.epochs)
