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
Example: the alignment gives robot_localization its attitude and true heading.

Needs robot_localization and a transform from base_link to the IMU's frame_id (a URDF, or tf2_ros
static_transform_publisher). The result is the pose of base_link in an ENU frame with its origin
where the vehicle was aligned, on /odometry/filtered and as the transform odom -> base_link.

    ros2 launch ins_align robot_localization.launch.py params_file:=my_robot.yaml

All of it may start at once: before the alignment there is no message on ~/imu, and both nodes of
robot_localization wait for the first one. navsat_transform_node takes its heading, for good.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

# Names without a leading slash are those of the namespace that everything is started in.
ALIGNED_IMU = 'ins_align/imu'

NAVSAT_TRANSFORM = {
    'frequency': 30.0,
    # No seconds to wait for a compass to settle: the first heading that arrives is good.
    'delay': 0.0,
    # The heading of ~/imu is true: it comes from GNSS and from the Earth's axis, not from a
    # magnetometer. There is no declination to add.
    'magnetic_declination_radians': 0.0,
    # Its yaw is 0 facing east and grows to the left (REP-103), as this node wants it; pi/2, the
    # value in many examples, is for compasses that read 0 facing north.
    'yaw_offset': 0.0,
    # Heading from the IMU message, not from the odometry, which needs this node's output first.
    'use_odometry_yaw': False,
    'wait_for_datum': False,
    'zero_altitude': False,
    'broadcast_cartesian_transform': False,
    'publish_filtered_gps': False,
}

# Which of: x y z, roll pitch yaw, their rates (linear, angular), linear acceleration.
POSITION_ONLY = [True, True, True] + [False] * 12
ATTITUDE_AND_RATE = [False] * 3 + [True] * 3 + [False] * 3 + [True] * 3 + [False] * 3

EKF = {
    'frequency': 30.0,
    'two_d_mode': False,
    'publish_tf': True,
    'odom_frame': 'odom',
    'base_link_frame': 'base_link',
    # One filter, all of it absolute: it broadcasts odom -> base_link itself. With wheel odometry
    # take robot_localization's example of two filters; this one is then the map's.
    'world_frame': 'odom',
    'odom0': 'odometry/gps',
    'odom0_config': POSITION_ONLY,
    # As measured, neither as differences nor relative to the first: both inputs are absolute.
    'odom0_differential': False,
    'odom0_relative': False,
    'imu0': ALIGNED_IMU,
    'imu0_config': ATTITUDE_AND_RATE,
    'imu0_differential': False,
    'imu0_relative': False,
    'imu0_queue_size': 50,
}


def generate_launch_description() -> LaunchDescription:
    """Start the alignment and robot_localization."""
    arguments = {
        'params_file': PathJoinSubstitution(
            [FindPackageShare('ins_align'), 'config', 'ins_align.yaml']),
        'namespace': '',
        'imu_topic': 'imu/data_raw',
        'fix_topic': 'fix',
        'velocity_topic': 'fix_velocity',
        'use_sim_time': 'false',
    }
    given = {name: LaunchConfiguration(name) for name in arguments}
    alignment = IncludeLaunchDescription(
        PathJoinSubstitution([FindPackageShare('ins_align'), 'launch', 'ins_align.launch.xml']),
        launch_arguments=given.items())
    sim_time = {'use_sim_time': given['use_sim_time']}
    navsat_transform = Node(
        package='robot_localization', executable='navsat_transform_node',
        name='navsat_transform', namespace=given['namespace'], output='screen',
        parameters=[NAVSAT_TRANSFORM, sim_time],
        remappings=[('imu', ALIGNED_IMU), ('gps/fix', given['fix_topic'])])
    ekf = Node(
        package='robot_localization', executable='ekf_node', name='ekf_filter_node',
        namespace=given['namespace'], output='screen', parameters=[EKF, sim_time])
    # Where robot_localization is not installed, launch ends here and would leave others running.
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value) for name, value in arguments.items()),
        navsat_transform, ekf, alignment])
