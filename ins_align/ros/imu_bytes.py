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
"""
One serialised sensor_msgs/Imu: read it, and fill in its orientation.

Turning every sample into a Python message and back costs several times what the alignment itself
does with it, so the node takes the bytes as they arrive and changes them in place.
"""

from collections.abc import Sequence
import struct
from typing import NamedTuple

from ins_align.gnss.messages import imu_from_msg
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu

_CDR_LITTLE_ENDIAN = b'\x00\x01'  # OMG DDSI-RTPS 2.3, 10.2: encapsulation of plain CDR
_STAMP = struct.Struct('<iI')  # behind the encapsulation
_STAMP_OFFSET = 4
_FRAME_OFFSET = 16
# The body: orientation 4 and its covariance 9, rate 3 and 9, specific force 3 and 9, all float64.
_ORIENTATION = struct.Struct('<13d')
_VECTOR = struct.Struct('<3d')
_RATE_OFFSET = 8 * 13
_FORCE_OFFSET = 8 * 25
_BODY_BYTES = 8 * 37


class ImuSample(NamedTuple):
    """What the alignment needs of one message."""

    stamp_ns: int
    gyro: tuple[float, float, float]  # rad/s
    accel: tuple[float, float, float]  # m/s^2
    frame_id: str


def body_start(data: bytes) -> int | None:
    """
    Return where the numbers of a sensor_msgs/Imu start, behind its header.

    None: this is not the known layout, by its encapsulation or because header and numbers do not
    add up to its length.
    """
    frame_length = int.from_bytes(data[_FRAME_OFFSET - 4:_FRAME_OFFSET], 'little')
    start = _FRAME_OFFSET + frame_length
    start += -(start - 4) % 8  # numbers of eight bytes are aligned behind the encapsulation
    known = data[:2] == _CDR_LITTLE_ENDIAN and len(data) == start + _BODY_BYTES
    return start if known else None


def read_imu(data: bytes) -> ImuSample:
    """Read one serialised sensor_msgs/Imu; its orientation is not looked at."""
    start = body_start(data)
    if start is None:  # a middleware with another serialisation
        msg = deserialize_message(data, Imu)
        stamp_ns, gyro, accel = imu_from_msg(msg)
        return ImuSample(stamp_ns, tuple(gyro), tuple(accel), msg.header.frame_id)
    seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_OFFSET)
    frame = data[_FRAME_OFFSET:start].split(b'\0', 1)[0]
    return ImuSample(seconds * 1_000_000_000 + nanoseconds,
                     _VECTOR.unpack_from(data, start + _RATE_OFFSET),
                     _VECTOR.unpack_from(data, start + _FORCE_OFFSET),
                     frame.decode(errors='replace'))


def with_orientation(data: bytes, quaternion_xyzw: Sequence[float],
                     covariance: Sequence[float]) -> bytes:
    """
    Return a serialised sensor_msgs/Imu with another orientation.

    Parameters
    ----------
    data : bytes
        The message.
    quaternion_xyzw : four floats
        IMU frame to ENU.
    covariance : nine floats
        rad^2, row by row.

    """
    orientation = (*quaternion_xyzw, *covariance)
    start = body_start(data)
    if start is None:
        msg = deserialize_message(data, Imu)
        turn = msg.orientation
        turn.x, turn.y, turn.z, turn.w = orientation[:4]
        msg.orientation_covariance = orientation[4:]
        return serialize_message(msg)
    changed = bytearray(data)
    _ORIENTATION.pack_into(changed, start, *orientation)
    return bytes(changed)
