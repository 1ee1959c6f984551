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
"""The GNSS topics that a node reads: their message types, and the messages as numbers."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped, Vector3Stamped
from ins_align.config import Config, ConfigError
from ins_align.gnss.drivers import LIVE_TYPES, receiver_from_msg
from ins_align.gnss.messages import Fix, fix_from_msg, Velocity, velocity_from_msg
from nav_msgs.msg import Odometry
from sensor_msgs.msg import NavSatFix

FIX_TOPIC, VELOCITY_TOPIC = 'fix', 'fix_velocity'
# As what is counted a message that cannot be used.
REJECTED_AS = {FIX_TOPIC: 'fix_undecodable', VELOCITY_TOPIC: 'velocity_body_frame'}
# What the parameter velocity_type can name.
VELOCITY_TYPES = {
    'TwistWithCovarianceStamped': TwistWithCovarianceStamped,
    'TwistStamped': TwistStamped,
    'Odometry': Odometry,
    'Vector3Stamped': Vector3Stamped,
}


def gnss_topics(config: Config) -> dict[str, type]:
    """
    Return the message types of the topics to read, by topic.

    Raises
    ------
    ConfigError
        If the package of the configured type is not installed.

    """
    if config.fix_type == 'NavSatFix':
        return {FIX_TOPIC: NavSatFix, VELOCITY_TOPIC: VELOCITY_TYPES[config.velocity_type]}
    package = LIVE_TYPES[config.fix_type].partition('/')[0]
    try:
        return {FIX_TOPIC: getattr(import_module(f'{package}.msg'), config.fix_type)}
    except ModuleNotFoundError:
        raise ConfigError(
            f'fix_type is {config.fix_type}, but {package} is not installed: sudo apt install '
            f'ros-$ROS_DISTRO-{package.replace("_", "-")}, or set fix_type to NavSatFix') from None


def gnss_from_msg(topic: str, msg: Any, config: Config) -> Sequence[Fix | Velocity]:
    """
    Return what a message of a topic carries.

    Raises
    ------
    MessageError
        If it cannot be used.

    """
    if topic == VELOCITY_TOPIC:
        return [velocity_from_msg(msg, config)]
    if config.fix_type == 'NavSatFix':
        return [fix_from_msg(msg)]
    return receiver_from_msg(msg, LIVE_TYPES[config.fix_type], config)
