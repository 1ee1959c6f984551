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
"""The process of the node: what `ros2 run ins_align ins_align_node` starts."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import os
import re
import signal
import sys
from types import FrameType

from ins_align.processes import keep_to_one

_SOURCE_LINES = re.compile(r', at \S+:\d+')  # rcl's errors name lines of its sources


def main(args: Sequence[str] | None = None) -> int:
    """
    Run the node until it is interrupted; `args` are by default those of the process.

    Returns the exit status: 0, or 2 for a wrong argument or parameter, or without ROS.
    """
    keep_to_one()  # more threads would cost several times as much

    # rclpy's handlers end spin(). Python's own would also raise KeyboardInterrupt, at any line,
    # even in the clean-up: a Ctrl-C arrives twice, from the terminal and from ros2 launch.
    ros_handles_signals = False

    def on_signal(number: int, frame: FrameType | None) -> None:
        if not ros_handles_signals:
            os._exit(0)  # there is nothing to clean up, and an import would swallow SystemExit

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)

    # Only now: importing starts the threads of linear algebra, and a signal may come meanwhile.
    try:
        from ins_align.ros.node import AlignmentNode
    except ModuleNotFoundError as error:
        return _refused(f'the Python package {error.name} is not installed here: source the ROS '
                        'installation first (source /opt/ros/jazzy/setup.bash), or, without one, '
                        "pip install 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-common-interfaces")
    from ins_align.config import ConfigError
    import rclpy
    from rclpy.exceptions import ParameterException
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.qos_overriding_options import InvalidQosOverridesError
    from rclpy.utilities import remove_ros_args

    args = sys.argv if args is None else [sys.argv[0], *args]
    try:
        _refuse_other_arguments(remove_ros_args(args)[1:])
        rclpy.init(args=args)
    except RuntimeError as error:  # every error of rcl is one
        hint = ' (write 0.0, not 0, in a list)' if 'same type' in str(error) else ''
        return _refused(f'the ROS arguments are wrong: {error}{hint}')
    ros_handles_signals = True
    # The worker's thread must not keep a callback waiting for the interpreter.
    sys.setswitchinterval(0.001)  # s
    node = None
    try:
        executor = SingleThreadedExecutor()  # a signal while it is made ends in a traceback
        node = AlignmentNode()
        rclpy.spin(node, executor)
    except ExternalShutdownException:
        pass
    except (ConfigError, ParameterException, InvalidQosOverridesError, RuntimeError) as error:
        # If the context is gone, the process was interrupted, and the error only follows from it.
        if rclpy.ok():
            if node is not None:
                raise
            return _refused(str(error))
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        # The interpreter gives signals that are not ignored their default action before it ends.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    if node is not None and node.failure is not None:
        raise node.failure
    return 0


def _refuse_other_arguments(arguments: list[str]) -> None:
    """Exit with a usage message if there are arguments that ROS does not know."""
    argparse.ArgumentParser(
        prog='ins_align_node', usage='%(prog)s [-h] [--ros-args ...]',
        description='Aligns an IMU with GNSS while moving and publishes its attitude.',
        epilog='Parameters: --ros-args --params-file FILE or -p NAME:=VALUE; topics: '
               '-r imu/data_raw:=TOPIC.').parse_args(arguments)


def _refused(error: str) -> int:
    """Print why the node does not start, and return the exit status."""
    print(f'ins_align: {_SOURCE_LINES.sub("", " ".join(error.split()))}', file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
