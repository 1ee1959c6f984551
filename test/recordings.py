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
"""Writes small recordings of every format and finds the real ones."""

from functools import cache
import os
from pathlib import Path
import struct

import numpy as np
import pytest

IMU, FIX = 'sensor_msgs/msg/Imu', 'sensor_msgs/msg/NavSatFix'
TWIST = 'geometry_msgs/msg/TwistWithCovarianceStamped'
START_NS = 1_700_000_000_000_000_000
MCAP = b'\x89MCAP0\r\n'

FORMATS = ('mcap', 'mcap chunks', 'mcap messages', 'mcap file', 'sqlite3', 'sqlite3 messages',
           'sqlite3 file', 'ros1', 'ros1 lz4', 'ros1 bz2')


def real_recording(name):
    """Return the path of one of the three real recordings or skip the test."""
    folder = Path(os.environ.get('INS_ALIGN_DATA')
                  or Path(__file__).resolve().parents[2] / 'shared' / 'data')
    if not (folder / name).exists():
        pytest.skip(f'the recording {name} is not here (INS_ALIGN_DATA names its folder)')
    return folder / name


@cache
def typestore(ros1=False):
    """Return the types; what one has compiled to write a type it keeps."""
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)


def make_header(store, stamp_ns, frame_id, seq=0):
    time = store.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10 ** 9))
    header = store.types['std_msgs/msg/Header']
    arguments = {'stamp': time, 'frame_id': frame_id}
    if 'seq' in header.__dataclass_fields__:
        arguments['seq'] = seq
    return header(**arguments)


def make_imu(store, stamp_ns, gyro, accel, frame_id='imu_link', seq=0, measured=True):
    vector = store.types['geometry_msgs/msg/Vector3']
    quaternion = store.types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
    unknown = np.array([-1.0] + [0.0] * 8)
    return store.types[IMU](
        make_header(store, stamp_ns, frame_id, seq), quaternion, unknown, vector(*gyro),
        np.zeros(9) if measured else unknown, vector(*accel),
        np.zeros(9) if measured else unknown)


def make_fix(store, stamp_ns, latitude=48.0, longitude=11.0, altitude=300.0):
    status = store.types['sensor_msgs/msg/NavSatStatus'](status=0, service=1)
    return store.types[FIX](make_header(store, stamp_ns, 'gps'), status, latitude, longitude,
                            altitude, np.zeros(9), 0)


def make_twist(store, stamp_ns, velocity, frame_id='gps'):
    vector = store.types['geometry_msgs/msg/Vector3']
    twist = store.types['geometry_msgs/msg/Twist'](vector(*velocity), vector(0.0, 0.0, 0.0))
    with_covariance = store.types['geometry_msgs/msg/TwistWithCovariance'](twist, np.zeros(36))
    return store.types[TWIST](make_header(store, stamp_ns, frame_id), with_covariance)


def write_messages(path, kind, messages, topics):
    """Write (topic's name, recorded time, message), of topics with a type, as one of FORMATS."""
    from rosbags import rosbag1, rosbag2
    ros1 = kind.startswith('ros1')
    store = typestore(ros1)
    compression = kind.partition(' ')[2]
    if ros1:
        writer = rosbag1.Writer(path)
        if compression:
            writer.set_compression(rosbag1.Writer.CompressionFormat[compression.upper()])
        serialize = store.serialize_ros1
    else:
        plugin = rosbag2.StoragePlugin[kind.split()[0].upper()]
        writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        if compression:
            mode = {'chunks': 'STORAGE', 'messages': 'MESSAGE', 'file': 'FILE'}[compression]
            writer.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
        serialize = store.serialize_cdr
    with writer:
        connections = {name: writer.add_connection(name, msgtype, typestore=store)
                       for name, msgtype in topics.items()}
        for name, time_ns, message in messages:
            writer.write(connections[name], time_ns, serialize(message, topics[name]))
    return path


def write_recording(path, kind, duration=4.0, topics=None, seed=0):
    """Write a vehicle that stands still: 100 Hz IMU, 5 Hz position and velocity."""
    rng = np.random.default_rng(seed)
    store = typestore(kind.startswith('ros1'))
    topics = topics or {'/imu/data_raw': IMU, '/fix': FIX, '/fix_velocity': TWIST}
    messages = []
    for k in range(int(duration * 100)):
        stamp = START_NS + k * 10_000_000
        sample = rng.normal(0.0, 0.01, 6)
        for name, msgtype in topics.items():
            if msgtype == IMU:
                messages.append((name, stamp + 1_000_000, make_imu(
                    store, stamp, sample[:3], sample[3:] + [0.0, 0.0, 9.81], seq=k)))
            elif k % 20 == 0 and msgtype == FIX:
                messages.append((name, stamp + 50_000_000, make_fix(store, stamp)))
            elif k % 20 == 0 and msgtype == TWIST:
                messages.append((name, stamp + 50_000_001, make_twist(store, stamp, sample[:3])))
    messages.sort(key=lambda message: message[1])
    return write_messages(path, kind, messages, topics)


def messages_of(bag, topics=None):
    """Yield topic, recorded time and message of a recording that is open."""
    topics = bag.topics if topics is None else topics
    for block in bag.blocks(topics):
        streams = [iter(messages) for messages in block.messages]
        for time_ns, number in zip(block.times_ns.tolist(), block.topics.tolist()):
            yield topics[number], time_ns, next(streams[number])


def mcap_record(op, content):
    """Return one record of an mcap file."""
    return struct.pack('<BQ', op, len(content)) + content


def mcap_string(text):
    return struct.pack('<I', len(text)) + text.encode()


def mcap_of(*records, closed=True):
    """Return an mcap file without an index that describes topics /0 and /1."""
    described = mcap_record(3, struct.pack('<H', 1) + mcap_string(IMU) + mcap_string('ros2msg')
                            + mcap_string('definition'))
    described += b''.join(mcap_record(4, struct.pack('<HH', key, 1) + mcap_string(
        f'/{key}') + mcap_string('cdr') + mcap_string('')) for key in (0, 1))
    end = mcap_record(15, bytes(4)) + mcap_record(2, bytes(20)) + MCAP
    return MCAP + described + b''.join(records) + (end if closed else b'')


def mcap_message(channel, time_ns, data):
    return mcap_record(5, struct.pack('<HIQQ', channel, 0, time_ns, time_ns) + data)


def mcap_chunk(data, size=None, compression=''):
    """Return a chunk that claims a size."""
    return mcap_record(6, struct.pack('<QQQI', 0, 1 << 40, len(data) if size is None else size, 0)
                       + mcap_string(compression) + struct.pack('<Q', len(data)) + data)


def indexed_mcap(times, data, size, compression=''):
    """Return a whole mcap file with the same chunk at each of some times (start, end)."""
    content = MCAP + mcap_record(1, mcap_string('ros2') + mcap_string(''))
    index = mcap_of(closed=False)[len(MCAP):]
    for start, end in times:
        chunk = mcap_chunk(data, size, compression)
        index += mcap_record(8, struct.pack('<QQQQI', start, end, len(content), len(chunk), 10)
                             + struct.pack('<HQQ', 0, len(content) + len(chunk), 31)
                             + mcap_string(compression) + struct.pack('<QQ', len(data), size))
        content += chunk + mcap_record(7, bytes(22))
    index += mcap_record(11, struct.pack('<QHIIIIQQI', 1, 1, 2, 0, 0, 1, 0, 1 << 40, 0))
    footer = mcap_record(2, struct.pack('<QQI', len(content), 0, 0))
    return content + index + footer + MCAP


def ros1_records(content):
    """Return kind, start and end of each record of a ROS 1 file."""
    position, records = 13, []
    while position < len(content):
        start = position
        position += 4 + struct.unpack_from('<I', content, position)[0]
        kind = content[content.index(b'op=', start, position) + 3]
        position += 4 + struct.unpack_from('<I', content, position)[0]
        records.append((kind, start, position))
    return records
