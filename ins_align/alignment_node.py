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
The ROS 2 node: subscribes, hands over to the aligner, publishes what it says.

Everything that decides anything is in aligner.py; the same object runs under `ins_align replay`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
import dataclasses
from operator import attrgetter
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import QuaternionStamped, TwistStamped, TwistWithCovarianceStamped
from ins_align.aligner import Aligner, Attitude, State, Status
from ins_align.config import (
    Config, config_from_mapping, ConfigError, NODE_NAME, Parameter as ParameterInfo, parameters)
from ins_align.imu_bytes import ImuSample, read_imu, with_orientation
from ins_align.messages import Fix, fix_from_msg, MessageError, Velocity, velocity_from_msg
from nav_msgs.msg import Odometry
import numpy as np
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.time import Time
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

VELOCITY_TYPES = {
    'TwistWithCovarianceStamped': TwistWithCovarianceStamped,
    'TwistStamped': TwistStamped,
    'Odometry': Odometry,
}
IMU_DEPTH = 2000  # ten seconds at 200 Hz: the estimator may be busy, no sample may be lost
GNSS_DEPTH = 200
STATUS_PERIOD = 1.0  # s
RCLPY_PARAMETERS = {'use_sim_time', 'start_type_description_service'}  # it declares them itself

LEVELS = {
    State.ALIGNED: DiagnosticStatus.OK,
    State.FAULT: DiagnosticStatus.ERROR,
}


class AlignmentNode(Node):
    """
    Feeds an `Aligner` from topics and publishes the attitude that it declares.

    Raises
    ------
    ConfigError
        If a parameter is wrong.

    """

    def __init__(self) -> None:
        """Declare the parameters, then open the topics."""
        # Overrides are declared untyped first, so that [1, 1, 1] is as good as [1.0, 1.0, 1.0].
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        self._config = self._declare_parameters()
        self._aligner = Aligner(self._config)
        self._declared: Attitude | None = None
        self._imu_frame: str | None = None

        self._attitude_publisher = self._open_attitude_topic()
        self._imu_publisher = self._publish_on(Imu, '~/imu', QoSProfile(depth=100))
        self._status_publishers = [
            self._publish_on(DiagnosticArray, topic, QoSProfile(depth=10))
            for topic in ('~/status', '/diagnostics')]
        self._imu_subscription = self._subscribe_to(
            Imu, 'imu/data_raw', self._on_imu, IMU_DEPTH, raw=True)
        self._fix_subscription = self._subscribe_to(NavSatFix, 'fix', self._on_fix, GNSS_DEPTH)
        self._velocity_subscription = self._subscribe_to(
            VELOCITY_TYPES[self._config.velocity_type], 'fix_velocity', self._on_velocity,
            GNSS_DEPTH)
        self.create_service(Trigger, '~/reset', self._on_reset)
        # Status goes on when simulated time stands still.
        self.create_timer(STATUS_PERIOD, self._on_timer,
                          clock=Clock(clock_type=ClockType.STEADY_TIME))

    # Input

    def _on_imu(self, data: bytes) -> None:
        # The executor takes one message a turn, and a turn costs many times what is done with the
        # message. What has queued up while the estimator was busy therefore comes along, in the
        # order of the stamps: nothing shall be late, or early, only because it waited here.
        queue = queued(self._imu_subscription)
        gnss: list[Fix | Velocity] = []
        if queue:
            gnss += map(fix_from_msg, queued(self._fix_subscription))
            gnss += filter(None, map(self._velocity, queued(self._velocity_subscription)))
            gnss.sort(key=attrgetter('stamp_ns'))
        for message in (data, *queue):
            sample = read_imu(message)
            while gnss and gnss[0].stamp_ns <= sample.stamp_ns:
                self._take_gnss(gnss.pop(0))
            self._take_imu(sample, message)
        for measurement in gnss:
            self._take_gnss(measurement)

    def _take_imu(self, sample: ImuSample, data: bytes) -> None:
        if sample.frame_id != self._imu_frame:
            self._change_imu_frame(sample.frame_id)
        self._aligner.add_imu(sample.stamp_ns, sample.gyro, sample.accel)
        if self._imu_publisher.get_subscription_count():
            self._publish_imu(data, sample.stamp_ns)

    def _on_fix(self, msg: NavSatFix) -> None:
        self._take_gnss(fix_from_msg(msg))

    def _on_velocity(self, msg: Any) -> None:
        velocity = self._velocity(msg)
        if velocity is not None:
            self._take_gnss(velocity)

    def _velocity(self, msg: Any) -> Velocity | None:
        try:
            return velocity_from_msg(msg, self._config)
        except MessageError:
            self._aligner.reject('velocity_body_frame')
            return None

    def _take_gnss(self, measurement: Fix | Velocity) -> None:
        if isinstance(measurement, Fix):
            self._aligner.add_fix(measurement)
        else:
            self._aligner.add_velocity(measurement)
        self._update()

    def _change_imu_frame(self, frame_id: str) -> None:
        """Start over: what was learnt is about axes that are no longer the IMU's."""
        if self._imu_frame is not None:
            self._aligner.reject('imu_frame_changed')
            self._aligner.reset(
                f'frame_id of the IMU changed from {self._imu_frame!r} to {frame_id!r}')
            self._update()
        self._imu_frame = frame_id

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._aligner.reset('requested by service')
        self._update()
        response.success = True
        response.message = 'alignment starts over'
        return response

    def _on_timer(self) -> None:
        self._update()
        self._publish_status()

    # Output

    def _update(self) -> None:
        """Process what can be processed and publish what has changed."""
        self._aligner.update()
        declared = self._aligner.declared
        if declared is not self._declared:
            self._declared = declared
            self._publish_declared()
        events = self._aligner.take_events()
        for event in events:
            self.get_logger().info(event)
        if events:
            self._publish_status()

    def _publish_declared(self) -> None:
        if self._declared is None:
            # Whoever joins from now on must not get an attitude that no longer holds.
            self.destroy_publisher(self._attitude_publisher)
            self._attitude_publisher = self._open_attitude_topic()
            return
        msg = QuaternionStamped()
        msg.header.stamp = Time(nanoseconds=self._declared.stamp_ns).to_msg()
        msg.header.frame_id = self._config.world_frame_id
        turn = msg.quaternion
        turn.x, turn.y, turn.z, turn.w = self._declared.quaternion_xyzw.tolist()
        self._attitude_publisher.publish(msg)

    def _publish_imu(self, data: bytes, stamp_ns: int) -> None:
        attitude = None if self._declared is None else self._aligner.attitude_now()
        # A sample that comes out of order belongs to another instant than the attitude.
        if attitude is None or attitude.stamp_ns != stamp_ns:
            self._imu_publisher.publish(with_orientation(data))
        else:
            self._imu_publisher.publish(
                with_orientation(data, attitude.quaternion_xyzw, attitude.covariance))

    def _publish_status(self) -> None:
        status = self._aligner.status()
        msg = DiagnosticArray()
        msg.header.stamp = self.get_clock().now().to_msg()
        msg.status = [DiagnosticStatus(
            level=LEVELS.get(status.state, DiagnosticStatus.WARN),
            name=f'{self.get_name()}: alignment', message=f'{status.state.value}: {status.reason}',
            hardware_id=self._imu_frame or '',
            values=[KeyValue(key=key, value=value) for key, value in status_values(status)])]
        for publisher in self._status_publishers:
            publisher.publish(msg)

    # Topics and parameters

    def _publish_on(self, msg_type: type, topic: str, qos: QoSProfile) -> Publisher:
        # Every event handler is one more thing to wait for at each IMU message. What is offered
        # here suits every subscriber but those that ask for more, and these warn on their side.
        return self.create_publisher(
            msg_type, topic, qos,
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _open_attitude_topic(self) -> Publisher:
        return self._publish_on(QuaternionStamped, '~/initial_attitude', QoSProfile(
            depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def _subscribe_to(self, msg_type: type, topic: str, callback: Callable[[Any], None],
                      depth: int, *, raw: bool = False) -> Subscription:
        # Best effort matches every publisher.
        return self.create_subscription(
            msg_type, topic, callback,
            QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(), raw=raw)

    def _declare_parameters(self) -> Config:
        """Check the values given at start and declare all parameters with their description."""
        known = parameters()
        names = {own.name for own in known}
        given = {name: parameter.value
                 for name, parameter in self.get_parameters_by_prefix('').items()}
        config = config_from_mapping({name: given[name] for name in names & given.keys()})
        for name in given.keys() - RCLPY_PARAMETERS:
            # A parameter file for many nodes is not wrong, a slip of the pen must not pass unseen.
            if name not in names and not name.startswith('qos_overrides.'):
                self.get_logger().warning(f'parameter {name!r} is not known and has no effect')
            self.undeclare_parameter(name)
        for own in known:
            self.declare_parameter(own.name, getattr(config, own.name), parameter_descriptor(own),
                                   ignore_override=True)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._change_parameters)
        return config

    def _changed_config(self, changes: Iterable[Parameter]) -> Config:
        own = {parameter.name for parameter in parameters()}
        return dataclasses.replace(
            self._config, **{change.name: change.value for change in changes
                             if change.name in own})

    def _check_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self._changed_config(changes)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _change_parameters(self, changes: list[Parameter]) -> None:
        self._config = self._changed_config(changes)
        self._aligner.reconfigure(self._config)


def queued(subscription: Subscription) -> list[Any]:
    """Take the messages that wait in a subscription's queue."""
    messages = []
    with subscription.handle:
        for _ in range(IMU_DEPTH):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            messages.append(taken[0])
    return messages


def parameter_descriptor(parameter: ParameterInfo) -> ParameterDescriptor:
    """Describe one field of `Config` to ROS."""
    unit = f' [{parameter.unit}]' if parameter.unit else ''
    descriptor = ParameterDescriptor(
        description=parameter.description + unit, read_only=parameter.read_only)
    if parameter.choices:
        descriptor.additional_constraints = 'one of: ' + ', '.join(
            str(choice).lower() if isinstance(choice, bool) else choice
            for choice in parameter.choices)
    if parameter.minimum is not None and parameter.maximum is not None:
        descriptor.floating_point_range = [FloatingPointRange(
            from_value=parameter.minimum, to_value=parameter.maximum)]
    return descriptor


def status_values(status: Status) -> Iterator[tuple[str, str]]:
    """List what a status says as names and values, angles in degrees."""
    yield 'state', status.state.value
    yield 'reason', status.reason
    for name, value in (('stamp_ns', status.stamp_ns), ('t0_ns', status.t0_ns)):
        yield name, '' if value is None else str(value)
    yield 'time_to_align_s', _text(status.time_to_align_s)
    for name, attitude in (('initial', status.initial), ('current', status.current)):
        angles = sigma = None
        if attitude is not None:
            angles = attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg
            sigma = attitude.sigma_deg
        yield f'{name}_roll_pitch_yaw_deg', _text(angles)
        yield f'{name}_sigma_east_north_up_deg', _text(sigma)
    for name, estimate, sigma, unit in (
            ('gyro_bias', status.gyro_bias, status.gyro_bias_std, 'rad_s'),
            ('accel_bias', status.accel_bias, status.accel_bias_std, 'm_s2'),
            ('lever_arm', status.lever_arm, status.lever_arm_std, 'm'),
            ('gnss_delay', status.gnss_delay, status.gnss_delay_std, 's')):
        yield f'{name}_{unit}', _text(estimate)
        yield f'{name}_std_{unit}', _text(sigma)
    for name, count in status.counts.items():
        yield name, str(count)


def _text(value: float | Sequence[float] | np.ndarray | None) -> str:
    """Write a number or several; nothing where nothing is known."""
    if value is None:
        return ''
    return ' '.join(f'{number:.6g}' for number in np.atleast_1d(value))
