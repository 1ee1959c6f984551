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

Needs robot_localization and, in /tf_static, the transforms from base_link to the frame_id of the
IMU and to that of the fix (a URDF, or a static_transform_publisher of tf2_ros for each). The
result is the pose of base_link in an ENU frame with its origin where the vehicle was aligned, on
/odometry/filtered and as the transform odom -> base_link.

    ros2 launch ins_align robot_localization.launch.py params_file:=my_robot.yaml

All nodes may start at once: before the alignment there is no message on ~/base_imu, and both nodes
of robot_localization wait for the first one. navsat_transform_node keeps the heading of the last
message before it computes its transform.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

# Without a leading slash: relative to the namespace in which everything is started.
ALIGNED_IMU = 'ins_align/base_imu'
BASE_FRAME = 'base_link'

NAVSAT_TRANSFORM = {
    'frequency': 30.0,
    # s. There is no compass that has to settle: the first heading that arrives is good.
    'delay': 0.0,
    # The heading of ~/base_imu is true: it comes from GNSS and from the Earth's axis, not from a
    # magnetometer. There is no declination to add.
    'magnetic_declination_radians': 0.0,
    # The yaw of ~/base_imu is 0 facing east and grows to the left (REP-103), as this node wants
    # it. pi/2, the value in many examples, is for compasses that read 0 facing north.
    'yaw_offset': 0.0,
    # Take the heading from the IMU, which has it before the odometry has.
    'use_odometry_yaw': False,
    'wait_for_datum': False,
    'zero_altitude': False,
    'broadcast_cartesian_transform': False,
    'publish_filtered_gps': False,
}

# Order: position, roll pitch yaw, velocity, angular rate, acceleration; three values each.
POSITION_ONLY = [True, True, True] + [False] * 12
ATTITUDE_AND_RATE = [False] * 3 + [True] * 3 + [False] * 3 + [True] * 3 + [False] * 3

EKF = {
    'frequency': 30.0,
    'two_d_mode': False,
    'publish_tf': True,
    'odom_frame': 'odom',
    'base_link_frame': BASE_FRAME,
    # A single filter of absolute measurements broadcasts odom -> base_link itself. With wheel
    # odometry take robot_localization's example of two filters; this one then has the map frame.
    'world_frame': 'odom',
    'odom0': 'odometry/gps',
    'odom0_config': POSITION_ONLY,
    # Both inputs are absolute: neither differences nor values relative to the first.
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
    sim_time = {'use_sim_time': given['use_sim_time']}
    # As in ins_align.launch.xml, with a base_frame instead of that in the file.
    alignment = Node(
        package='ins_align', executable='ins_align_node', name='ins_align',
        namespace=given['namespace'], output='screen',
        ros_arguments=['--params-file', given['params_file']],
        parameters=[sim_time, {'base_frame': BASE_FRAME}],
        remappings=[('imu/data_raw', given['imu_topic']), ('fix', given['fix_topic']),
                    ('fix_velocity', given['velocity_topic'])])
    navsat_transform = Node(
        package='robot_localization', executable='navsat_transform_node',
        name='navsat_transform', namespace=given['namespace'], output='screen',
        parameters=[NAVSAT_TRANSFORM, sim_time],
        remappings=[('imu', ALIGNED_IMU), ('gps/fix', given['fix_topic'])])
    ekf = Node(
        package='robot_localization', executable='ekf_node', name='ekf_filter_node',
        namespace=given['namespace'], output='screen', parameters=[EKF, sim_time])
    # Its nodes come first: where robot_localization is not installed, launch ends there, and
    # what it has started before would go on running.
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=value) for name, value in arguments.items()),
        navsat_transform, ekf, alignment])
