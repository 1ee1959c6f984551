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
"""Bulk decoding of IMU and GNSS messages against the rosbags library."""

from hypothesis import given, settings, strategies as st
from ins_align import decoding
from ins_align.bag_files import Messages, Topic
from ins_align.bags import VELOCITY_TYPES
from ins_align.config import Config
from ins_align.decoding import (
    body_start, decode_fixes, decode_imu, decode_orientations, decode_velocities, deserialize,
    Refused)
from ins_align.messages import MessageError
import numpy as np
import pytest
from recordings import FIX, IMU, make_header, make_imu, START_NS, typestore

TOPICS = {'cdr': Topic('/imu', IMU, 'cdr'), 'ros1': Topic('/imu', IMU, 'ros1')}


def serialized(encoding, count=5, frame_id='imu_link', little_endian=True, seed=0):
    rng = np.random.default_rng(seed)
    store = typestore(encoding == 'ros1')
    raws = []
    for k in range(count):
        values = rng.normal(size=6)
        message = make_imu(store, START_NS + k * 10_000_001, values[:3], values[3:], frame_id, k)
        raws.append(bytes(store.serialize_ros1(message, IMU) if encoding == 'ros1' else
                          store.serialize_cdr(message, IMU, little_endian=little_endian)))
    return raws


def by_library(raws, topic):
    messages = [deserialize(raw, topic) for raw in raws]
    stamps = [m.header.stamp.sec * 10 ** 9 + m.header.stamp.nanosec for m in messages]
    gyro = [[getattr(m.angular_velocity, axis) for axis in 'xyz'] for m in messages]
    accel = [[getattr(m.linear_acceleration, axis) for axis in 'xyz'] for m in messages]
    return np.array(stamps), np.array(gyro), np.array(accel)


def assert_same(samples, expected):
    for mine, theirs in zip(samples, expected):
        np.testing.assert_array_equal(mine, theirs)


@pytest.mark.parametrize('encoding', ['cdr', 'ros1'])
@pytest.mark.parametrize('frame_id', ['', 'a', 'imu', 'imu_link', 'a/long/name/of/a/frame', 'ü'])
def test_as_the_library(encoding, frame_id, monkeypatch):
    raws = serialized(encoding, frame_id=frame_id)
    expected = by_library(raws, TOPICS[encoding])
    monkeypatch.setattr(decoding, 'deserialize', None)  # the bulk path needs no library
    assert_same(decode_imu(Messages.of(raws), TOPICS[encoding]), expected)


@pytest.mark.parametrize('encoding', ['cdr', 'ros1'])
def test_mixed_layouts_keep_their_order(encoding, monkeypatch):
    raws = [raw for pair in zip(serialized(encoding, seed=1),
                                serialized(encoding, frame_id='another_frame', seed=2),
                                serialized(encoding, frame_id='imu_lin2', seed=3))
            for raw in pair]
    expected = by_library(raws, TOPICS[encoding])
    monkeypatch.setattr(decoding, 'deserialize', None)  # each layout is known
    assert_same(decode_imu(Messages.of(raws), TOPICS[encoding]), expected)


def test_big_endian_and_padding_go_to_the_library():
    raws = serialized('cdr', little_endian=False)
    assert body_start(raws[0], 'cdr') is None
    assert_same(decode_imu(Messages.of(raws), TOPICS['cdr']), by_library(raws, TOPICS['cdr']))


@pytest.mark.parametrize('encoding', ['cdr', 'ros1'])
def test_what_cannot_be_decoded_is_left_out(encoding):
    raws = serialized(encoding)
    spoilt = [b'', raws[0], b'\x00', raws[1][:100], raws[2], b'\xff' * 324, raws[3][:-1]]
    samples = decode_imu(Messages.of(spoilt), TOPICS[encoding])
    assert_same(samples, by_library([raws[0], raws[2]], TOPICS[encoding]))
    assert np.flatnonzero(samples.decoded).tolist() == [1, 4]


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(['cdr', 'ros1']), st.lists(st.tuples(
    st.sampled_from([0, 12, 15, 16, 20, 323, 324, 328]), st.binary(max_size=2),
    st.sampled_from([0, 1, 4, 8, 9, 12, 1 << 31, (1 << 32) - 1])), max_size=6))
def test_where_the_numbers_start(encoding, kinds):
    """Of many messages the same as of each."""
    raws = [(front + bytes(12))[:12] + frame.to_bytes(4, 'little') + bytes(400)
            for _, front, frame in kinds]
    raws = [raw[:length] for raw, (length, *_) in zip(raws, kinds)]
    starts = decoding._body_starts(Messages.of(raws), encoding).tolist()
    assert starts == [-1 if start is None else start
                      for start in (body_start(raw, encoding) for raw in raws)]


@pytest.mark.parametrize('encoding', ['cdr', 'ros1'])
def test_orientations(encoding):
    raws = serialized(encoding) + [b''] + serialized(encoding, 1, frame_id='x')
    orientations = decode_orientations(Messages.of(raws), TOPICS[encoding])
    np.testing.assert_array_equal(orientations.quaternions, [[0.0, 0.0, 0.0, 1.0]] * 6)
    np.testing.assert_array_equal(orientations.covariances, [[-1.0] + [0.0] * 8] * 6)
    np.testing.assert_array_equal(orientations.stamps_ns,
                                  decode_imu(Messages.of(raws), TOPICS[encoding]).stamps_ns)
    if encoding == 'cdr':
        big = serialized(encoding, little_endian=False)
        assert_same(decode_orientations(Messages.of(big), TOPICS[encoding]),
                    decode_orientations(Messages.of(raws[:5]), TOPICS[encoding]))


def test_nothing():
    samples = decode_imu(Messages.of([]), TOPICS['cdr'])
    assert [array.shape for array in samples] == [(0,), (0, 3), (0, 3), (0,)]


@pytest.mark.parametrize('seconds', [-2 ** 31, -1, 2 ** 31 - 1])
def test_stamps_at_the_ends_of_time(seconds):
    raw = bytearray(serialized('cdr', 1)[0])
    raw[4:8] = seconds.to_bytes(4, 'little', signed=True)
    raw[8:12] = b'\xff' * 4
    stamp = decode_imu(Messages.of([bytes(raw)]), TOPICS['cdr']).stamps_ns[0]
    assert stamp == seconds * 10 ** 9 + 2 ** 32 - 1


def test_deserialize_refuses_in_a_sentence():
    with pytest.raises(MessageError, match='5 bytes on /imu'):
        deserialize(b'\x00\x01\x00\x00\x00', TOPICS['cdr'])


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(['cdr', 'ros1']), st.lists(st.tuples(
    st.integers(0, 4), st.integers(0, 330), st.binary(max_size=24)), max_size=6))
def test_any_bytes(encoding, edits):
    """Whatever the bytes: the same as the library makes of them, message by message."""
    raws = serialized(encoding)
    for index, at, replacement in edits:
        raws[index] = raws[index][:at] + replacement + raws[index][at + len(replacement):]
    decoded = decode_imu(Messages.of(raws), TOPICS[encoding])
    expected = []
    for raw in raws:
        try:
            expected.append(by_library([raw], TOPICS[encoding]))
        except MessageError:
            # A frame_id that is no text: the numbers behind it are good all the same.
            if body_start(raw, encoding) is not None:
                expected.append(decode_imu(Messages.of([raw]), TOPICS[encoding]))
    assert len(decoded.stamps_ns) == len(expected)
    if expected:
        assert_same(decoded, [np.concatenate(parts) for parts in zip(*expected)])


# GNSS

GNSS = [FIX, *VELOCITY_TYPES]


def serialized_gnss(encoding, kind, count=5, frame_id='gps', seed=0, little_endian=True):
    """Serialise messages in which every number is another one."""
    rng = np.random.default_rng(seed)
    store = typestore(encoding == 'ros1')
    msgtype = VELOCITY_TYPES.get(kind, kind)

    def made(name, *values):
        return store.types[f'geometry_msgs/msg/{name}'](*values)

    def covariance(size):
        factor = rng.normal(size=(size, size))
        return (factor @ factor.T).ravel()

    raws = []
    for k in range(count):
        header = make_header(store, START_NS + k * 200_000_001,
                             'map' if kind == 'Odometry' else frame_id, k)
        twist = made('Twist', *(made('Vector3', *rng.normal(size=3)) for _ in range(2)))
        uncertain = made('TwistWithCovariance', twist, covariance(6))
        if kind == FIX:
            status = store.types['sensor_msgs/msg/NavSatStatus'](k - 1, 0xfff0 + k)
            rest = status, *rng.uniform(-90, 90, 3), covariance(3), k % 4
        elif kind == 'Odometry':
            pose = made('Pose', made('Point', *rng.normal(size=3)),
                        made('Quaternion', *rng.normal(size=4)))
            rest = frame_id, made('PoseWithCovariance', pose, covariance(6)), uncertain
        else:
            rest = (twist if kind == 'TwistStamped' else uncertain),
        message = store.types[msgtype](header, *rest)
        raws.append(bytes(store.serialize_ros1(message, msgtype) if encoding == 'ros1' else
                          store.serialize_cdr(message, msgtype, little_endian=little_endian)))
    return raws


def decode_gnss(raws, encoding, kind):
    topic = Topic('/gnss', VELOCITY_TYPES.get(kind, kind), encoding)
    messages = Messages.of(raws)
    if kind == FIX:
        return decode_fixes(messages, topic)
    return decode_velocities(messages, topic, Config(velocity_type=kind, velocity_frame='ned'))


def gnss_by_library(raws, encoding, kind):
    """Decode one by one with nothing taken from bytes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decoding, '_same_layout', lambda *arguments: None)
        return [decode_gnss([raw], encoding, kind)[0] for raw in raws]


def assert_same_gnss(messages, expected):
    assert len(messages) == len(expected)
    for mine, theirs in zip(messages, expected):
        assert type(mine) is type(theirs)
        if isinstance(mine, Refused):
            assert mine == theirs
            continue
        for one, other in zip(mine, theirs):
            assert type(one) is type(other)
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize('encoding', ['cdr', 'ros1'])
@pytest.mark.parametrize('kind', GNSS)
@pytest.mark.parametrize('frame_id', ['', 'a', 'ab', 'gps', 'gnss', 'a/long/name/of/a/frame', 'ü'])
def test_gnss_as_the_library(encoding, kind, frame_id, monkeypatch):
    raws = serialized_gnss(encoding, kind, frame_id=frame_id)
    expected = gnss_by_library(raws, encoding, kind)
    assert not any(isinstance(message, Refused) for message in expected)
    monkeypatch.setattr(decoding, 'deserialize', None)  # the bulk path needs no library
    assert_same_gnss(decode_gnss(raws, encoding, kind), expected)


@pytest.mark.parametrize('encoding', ['cdr', 'ros1'])
@pytest.mark.parametrize('kind', GNSS)
def test_gnss_of_several_layouts_keeps_its_order(encoding, kind):
    raws = [b''] + [raw for group in zip(serialized_gnss(encoding, kind, seed=1),
                                         serialized_gnss(encoding, kind, frame_id='imu', seed=2),
                                         serialized_gnss(encoding, kind, frame_id='long', seed=3))
                    for raw in group] + [b'\xff' * 200]
    messages = decode_gnss(raws, encoding, kind)
    assert_same_gnss(messages, gnss_by_library(raws, encoding, kind))
    name = 'fix' if kind == FIX else 'velocity'
    assert messages[0] == messages[-1] == Refused(f'{name}_undecodable')
    if kind != FIX:
        refused = messages[2::3]
        assert {message.counter for message in refused} == {'velocity_body_frame'}
        assert all("body frame 'imu'" in message.why for message in refused)
        assert decode_gnss(raws[2::3], encoding, kind) == refused


@pytest.mark.parametrize('kind', GNSS)
def test_gnss_with_its_last_four_bytes_filled_up(kind):
    raws = serialized_gnss('cdr', kind)
    expected = decode_gnss(raws, 'cdr', kind)
    for fill, good in ((1, True), (3, True), (4, False)):
        messages = decode_gnss([raw + bytes(fill) for raw in raws], 'cdr', kind)
        assert_same_gnss(messages, expected if good else gnss_by_library(
            [raw + bytes(fill) for raw in raws], 'cdr', kind))
        assert isinstance(messages[0], Refused) is not good


@pytest.mark.parametrize('kind', GNSS)
def test_gnss_big_endian_goes_to_the_library(kind):
    assert_same_gnss(decode_gnss(serialized_gnss('cdr', kind, little_endian=False), 'cdr', kind),
                     decode_gnss(serialized_gnss('cdr', kind), 'cdr', kind))


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(['cdr', 'ros1']), st.sampled_from(GNSS), st.lists(st.tuples(
    st.integers(0, 120), st.binary(max_size=8)), max_size=4), st.booleans())
def test_any_gnss_bytes(encoding, kind, edits, everywhere):
    """Whatever the bytes: the same as the library makes of them, message by message."""
    raws = serialized_gnss(encoding, kind, 3)
    for at, replacement in edits:
        raws[:3 if everywhere else 1] = [raw[:at] + replacement + raw[at + len(replacement):]
                                         for raw in raws[:3 if everywhere else 1]]
    assert_same_gnss(decode_gnss(raws, encoding, kind), gnss_by_library(raws, encoding, kind))
