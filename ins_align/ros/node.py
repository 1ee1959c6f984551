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
"""The ROS 2 node: feeds the aligner, which decides everything, and publishes its results."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
import dataclasses
from functools import partial
from operator import itemgetter
import re
import sys
import threading
import time
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Quaternion, QuaternionStamped, Vector3, Vector3Stamped
from ins_align.aligner import Aligner, Attitude, Epoch, State, Status
from ins_align.config import (
    Config, config_from_mapping, ConfigError, NODE_NAME, RCLPY_PARAMETERS, without_unknown)
from ins_align.geometry.rotation import Transform
from ins_align.gnss.drivers import gnss_from_msg
from ins_align.gnss.messages import Fix, MessageError, Velocity
from ins_align.imu.prediction import Follower, Prediction
from ins_align.mounting import Mounting, MountingSearch, turn_to_base
from ins_align.results import BIASES, FOR_PLOTS, level_of, Severity, status_values, WARN
from ins_align.ros.inputs import (
    FIX_TOPIC, Gate, gnss_topics, ImuSample, inputs_in_words, message_class, open_static_tf,
    parameter_descriptor, queued, read_imu, REJECTED_AS, topic_faults, VELOCITY_TOPIC,
    with_orientation)
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import Imu
from std_msgs.msg import Header, UInt8
from std_srvs.srv import Trigger

IMU_TOPIC = 'imu/data_raw'
IMU_DEPTH = 2000  # 10 s at 200 Hz, so that no sample is lost while the machine is busy
GNSS_DEPTH = 200
PERIOD = 0.2  # s, between rounds of the worker: many messages at a time cost less
STATUS_PERIOD = 1.0  # s
# After so long without a sample (s), by the clock of this machine, the status says so, and another
# IMU may take its place.
IMU_SILENT = 1.0
LOG_AGAIN = 10.0  # s after which a reason that has not changed may be logged again
_NUMBER = re.compile(r'[-+]?\d[\d.]*(?:e[-+]?\d+)?')
ACKNOWLEDGED_WITHIN = Duration(seconds=0.5)


class ReasonLog:
    """Decides when a state with its reason is worth a line in the log."""

    def __init__(self) -> None:
        self._logged: dict[str, float] = {}  # text without numbers to when it was logged last, s
        self._last = ''  # the one that was logged last

    def due(self, text: str, now: float, again: bool, logged: bool = False) -> bool:
        """
        Return whether to log a text at time `now`, s; if so, it counts as logged.

        A text is due if it differs in more than numbers from the one logged last, or if `again`
        says to repeat it, but not within `LOG_AGAIN`. With `logged` it has been logged already.
        """
        kind = _NUMBER.sub('#', text)
        self._logged = {other: when for other, when in self._logged.items()
                        if now - when < LOG_AGAIN}
        if not logged and (kind in self._logged or (kind == self._last and not again)):
            return False
        self._logged[kind], self._last = now, kind
        return True


class AlignmentNode(Node):
    """
    Feeds an `Aligner` from topics and publishes the attitude that it declares.

    The executor's thread puts messages into an inbox. While somebody listens to `~/imu` or
    `~/base_imu`, it takes each IMU message at once and publishes it with the worker's latest
    attitude, carried on with the gyros; otherwise it takes them several times a second, which
    costs half. The worker, a thread that no callback waits for, aligns. A parameter that is wrong
    is a ConfigError. `options` are those of `rclpy.node.Node`, as ``namespace`` or
    ``parameter_overrides``.
    """

    def __init__(self, **options: Any) -> None:
        # Overrides are declared untyped first, so that [1, 1, 1] is as good as [1.0, 1.0, 1.0].
        try:
            super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True,
                             **options)
        except ValueError as error:
            if 'PARAMETER_NOT_SET' not in str(error):  # rcl loses the type of an empty list
                raise
            raise ConfigError('the value of a parameter is an empty list: write its numbers, as '
                              'lever_arm:=[0.0, 0.0, 0.0], or leave it out') from None
        self.failure: BaseException | None = None  # what ended the worker, and the context with it
        self._config = self._declare_parameters()
        self._search = MountingSearch(self._config, open_static_tf(self, self._config))
        # From the executor to the worker: time of reception, ns, and a message or a request.
        self._inbox: deque[tuple[int, Any]] = deque()
        # From the worker to the executor, replaced as a whole: the attitude that ~/imu carries on,
        # if there is one, the frame_id of its IMU, and the base if somebody listens to ~/base_imu.
        self._prediction: tuple[Prediction | None, str | None, Transform | None] = (
            None, None, None)
        # The executor's:
        self._follower = Follower()
        self._followed = self._prediction
        # The worker's:
        self._aligner = Aligner(self._config)
        self._declared: Attitude | None = None
        self._imu_frame: str | None = None
        self._imu_received_ns = 0  # when the last sample of that IMU was received
        self._other_frames: set[str] = set()  # of earlier IMUs
        self._newest_imu_ns: int | None = None
        self._imu_heard: float | None = None  # when the aligner got a new sample, s
        self._next_status = 0.0
        self._reasons = ReasonLog()
        self._wake, self._stopping = threading.Event(), False
        self._worker = threading.Thread(target=self._run, name='ins_align', daemon=True)
        self._open_topics()
        self.get_logger().info(inputs_in_words(self, self._inputs, self._config))
        self.create_service(Trigger, '~/reset', self._on_reset)
        # A signal between two waits does not wake the executor: with the timer it looks.
        self.create_timer(PERIOD, self._open_gate, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._worker.start()

    def destroy_node(self) -> None:
        """Stop the worker after its round, then destroy the node."""
        self._stopping = True
        self._wake.set()
        self._worker.join()
        super().destroy_node()

    # Callbacks: in the executor's thread, which never waits for the aligner

    def _open_gate(self) -> None:
        self._gate.is_open = True

    def _on_imu(self, data: bytes, info: dict[str, int]) -> None:
        self._take_imu([(data, info['received_timestamp']), *queued(self._imu_subscription)])
        self._gate.is_open = self._is_listened_to()

    def _is_listened_to(self) -> bool:
        return (self._imu_publisher.get_subscription_count() > 0
                or self._base_imu_publisher.get_subscription_count() > 0)

    def _take_imu(self, messages: list[tuple[bytes, int]]) -> None:
        if self._followed is not self._prediction:
            self._followed = self._prediction
            self._follower.adopt(self._followed[0])
        _, imu_frame, base = self._followed
        for data, received_ns in messages:
            sample = read_imu(data)
            self._inbox.append((received_ns, sample))
            # The attitude is that of another IMU if the frame_id differs.
            if imu_frame not in (None, sample.frame_id):
                continue
            now = self._follower.follow(sample.stamp_ns, sample.gyro)
            # Without an attitude nothing is published: navsat_transform keeps the heading of a
            # message for good, whatever its covariance.
            if now is not None:
                data = with_orientation(data, now.quaternion_xyzw, now.covariance)
                self._imu_publisher.publish(data)
                if base is not None:
                    msg = deserialize_message(data, Imu)
                    turn_to_base(msg, base, self._config.base_frame)
                    self._base_imu_publisher.publish(msg)

    def _on_gnss(self, topic: str, msg: Any, info: dict[str, int]) -> None:
        self._take_imu(queued(self._imu_subscription))  # those that came before this message
        if topic == FIX_TOPIC:
            header = getattr(msg, 'header', None)  # NavPVT has none
            self._search.antenna_frame = header.frame_id if header else ''
        items: Iterable[Any]
        try:
            items = gnss_from_msg(msg, self._inputs[topic], self._config)
        except MessageError as error:
            why = str(error)
            items = [lambda: self._aligner.reject(REJECTED_AS[topic], why)]
        self._inbox.extend((info['received_timestamp'], item) for item in items)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._inbox.append((time.time_ns(), lambda: self._start_over('requested by service')))
        self._wake.set()
        response.success = True
        response.message = 'alignment starts over'
        return response

    # Alignment and its results: in the worker's thread, the only one that uses the aligner

    def _run(self) -> None:
        try:
            while not self._stopping:
                # Only the items that are there now, because the executor adds more.
                self._work([self._inbox.popleft() for _ in range(len(self._inbox))])
                self._wake.wait(PERIOD)
                self._wake.clear()
        except BaseException as error:
            # Without a context the process was interrupted, which is no failure.
            if self.context.ok():
                self.failure = error
                self.context.try_shutdown()

    def _work(self, items: list[tuple[int, Any]]) -> None:
        """Give the aligner what has come, and publish the results."""
        # Topics wait in separate queues: restore the order of reception.
        items.sort(key=itemgetter(0))
        items, mounting = self._search.take(items, time.monotonic(), self._other_frames)
        if mounting is not None:
            self._use_mounting(mounting)
        self._feed(items)
        self._align()
        newest_ns = self._aligner.newest_imu_ns
        if newest_ns is not None and newest_ns != self._newest_imu_ns:
            self._imu_heard = time.monotonic()
        self._newest_imu_ns = newest_ns
        self._update_prediction()
        events = self._aligner.take_events()
        for event in events:
            self._log(event.severity, event.text)
            self._reasons.due(event.text, time.monotonic(), True, logged=True)
        # By a clock that does not stop with simulated time.
        if events or time.monotonic() >= self._next_status:
            self._publish_status()

    def _use_mounting(self, mounting: Mounting) -> None:
        """Log what TF says, and start again with its lever arm and base."""
        for severity, text in mounting.words:
            self._log(severity, text)
        if (mounting.config.lever_arm != self._config.lever_arm
                or (mounting.base is not None and self._config.vehicle != 'none')):
            self._config = dataclasses.replace(self._config, lever_arm=mounting.config.lever_arm)
            self._aligner = Aligner(self._config, mounting.base)

    def _log(self, severity: Severity, text: str) -> None:
        # rclpy allows one severity for each line of code.
        if severity is Severity.ERROR:
            self.get_logger().error(text)
        elif severity is Severity.WARNING:
            self.get_logger().warning(text)
        else:
            self.get_logger().info(text)

    def _feed(self, items: list[tuple[int, Any]]) -> None:
        """Give messages to the aligner, and do the requests in between."""
        for received_ns, item in items:
            if isinstance(item, ImuSample):
                if self._accepts_frame(item.frame_id, received_ns):
                    self._aligner.add_imu(item.stamp_ns, item.gyro, item.accel)
            elif isinstance(item, Fix):
                self._aligner.add_fix(item)
            elif isinstance(item, Velocity):
                self._aligner.add_velocity(item)
            else:
                item()

    def _align(self) -> None:
        """Process the epochs that are ready, and publish their results."""
        for epoch in self._aligner.update():
            self._publish_declared(epoch.initial if epoch.state is State.ALIGNED else None)
            self._publish_numbers(epoch)
        if self._aligner.declared is None:
            self._publish_declared(None)

    def _start_over(self, why: str) -> None:
        self._align()  # messages before the request count, whenever the worker took them
        self._aligner.reset(why)
        self._search.forget()

    def _accepts_frame(self, frame_id: str, received_ns: int) -> bool:
        """
        Return whether a sample is of the IMU that is aligned.

        An IMU with a new frame_id takes its place, or an earlier one while it is silent.
        """
        if frame_id != self._imu_frame:
            silent = received_ns - self._imu_received_ns > IMU_SILENT * 1e9
            if frame_id in self._other_frames and not silent:
                self._aligner.reject('imu_other_frame')
                self.get_logger().warning(
                    f'two IMUs send on one topic, with frame_id {frame_id!r} and '
                    f'{self._imu_frame!r}: the latter is used', once=True)
                return False
            if self._imu_frame is not None:
                # The estimates are about the axes of the former IMU.
                self._aligner.reject('imu_frame_changed')
                self._search.restart()
                self._start_over(
                    f'frame_id of the IMU changed from {self._imu_frame!r} to {frame_id!r}')
                self._other_frames.add(self._imu_frame)
                self._other_frames.discard(frame_id)
            self._imu_frame = frame_id
        self._imu_received_ns = received_ns
        return True

    def _update_prediction(self) -> None:
        """Hand over the attitude for ~/imu; None if nobody listens or nothing is declared."""
        prediction = (self._aligner.prediction() if self._declared and self._is_listened_to()
                      else None)
        if prediction is not None or self._prediction[0] is not None:
            mounting = self._search.mounting
            listened = self._base_imu_publisher.get_subscription_count() > 0
            base = mounting.base if mounting and listened else None
            self._prediction = prediction, self._imu_frame, base

    def _publish_declared(self, attitude: Attitude | None) -> None:
        """Publish the initial attitude once, or withdraw it."""
        if (attitude is None) == (self._declared is None):
            return
        self._declared = attitude
        if attitude is None:
            # Who subscribes later must not get an attitude that no longer holds: a new publisher
            # has none. Who has subscribed before must have got it.
            self._attitude_publisher.wait_for_all_acked(ACKNOWLEDGED_WITHIN)
            self.destroy_publisher(self._attitude_publisher)
            self._attitude_publisher = self._open_attitude_topic()
            return
        turn = dict(zip('xyzw', attitude.quaternion_xyzw.tolist()))
        self._attitude_publisher.publish(QuaternionStamped(
            header=self._header(attitude.stamp_ns), quaternion=Quaternion(**turn)))

    def _header(self, stamp_ns: int) -> Header:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)  # rclpy.time has no negative times
        return Header(stamp=Time(sec=sec, nanosec=nanosec), frame_id=self._config.world_frame_id)

    def _publish_numbers(self, epoch: Epoch) -> None:
        """Publish angles, sigmas and biases of an epoch."""
        now = epoch.current
        if now is None:
            return
        for name, publisher in self._numbers_publishers.items():
            if publisher.get_subscription_count() > 0:
                header = self._header(now.stamp_ns)
                if name in BIASES:
                    header.frame_id = self._imu_frame or ''
                of = epoch if name in BIASES else now
                vector = dict(zip('xyz', map(float, getattr(of, name))))
                publisher.publish(Vector3Stamped(header=header, vector=Vector3(**vector)))

    def _publish_status(self) -> None:
        now = time.monotonic()
        first = self._next_status == 0.0  # no publisher has been discovered yet
        self._next_status = now + STATUS_PERIOD
        status = self._aligner.status()
        level = level_of(status.state)
        # While a transform is waited for, samples are kept from the aligner.
        silent = (0.0 if self._imu_heard is None or self._search.waits_for
                  else now - self._imu_heard)
        faults = [] if first else self._input_faults(status, silent > IMU_SILENT)
        if silent > IMU_SILENT:
            # The aligner goes by stamps: it notices a gap only when the next sample comes. Until
            # then it keeps everything, because there is no gap if samples are only late.
            faults.append(f'no IMU sample for {silent:.0f} s')
            if status.state is not State.FAULT:
                status = dataclasses.replace(status, state=State.WAITING_FOR_IMU)
        if self._search.waits_for:
            faults.append(f'waits for {self._search.waits_for}')
        if faults:
            level = max(level, WARN)
            status = dataclasses.replace(status, reason='; '.join([status.reason, *faults]))
        text = f'{status.state.value}: {status.reason}'
        mounting = self._search.mounting
        values = status_values(status, self._config.base_frame, mounting and mounting.base)
        msg = DiagnosticArray(
            header=Header(stamp=self.get_clock().now().to_msg()), status=[DiagnosticStatus(
                level=bytes([level]), message=text, hardware_id=self._imu_frame or '',
                name=f'{self.get_fully_qualified_name().lstrip("/")}: alignment',
                values=[KeyValue(key=key, value=value) for key, value in values.items()])])
        for publisher in self._status_publishers:
            publisher.publish(msg)
        self._state_publisher.publish(UInt8(data=list(State).index(status.state)))
        again = status.state is not State.ALIGNED or bool(faults)
        if not first and self._reasons.due(text, now, again):
            severity = Severity.WARNING if faults else Severity.INFO
            self._log(Severity.ERROR if status.state is State.FAULT else severity, text)

    def _input_faults(self, status: Status, silent: bool) -> list[str]:
        """Return what is wrong with the input topics, in words."""
        expected = [topic for topic, wanted in (
            (IMU_TOPIC, silent or status.state is State.WAITING_FOR_IMU),
            (FIX_TOPIC, status.state is State.WAITING_FOR_GNSS),
            (VELOCITY_TOPIC, self._config.use_velocity is True
             and not status.counts.get('velocity'))) if wanted]
        inputs = {topic: kind for topic, kind in self._inputs.items()
                  if topic != VELOCITY_TOPIC or self._config.use_velocity is not False}
        return list(topic_faults(self, inputs, expected))

    # Topics and parameters

    def _open_topics(self) -> None:
        self._attitude_publisher = self._open_attitude_topic()
        self._imu_publisher = self._publish_on(Imu, '~/imu', 100)
        self._base_imu_publisher = self._publish_on(Imu, '~/base_imu', 100)
        self._status_publishers = [self._publish_on(DiagnosticArray, topic, 10)
                                   for topic in ('~/status', '/diagnostics')]
        self._numbers_publishers = {name: self._publish_on(Vector3Stamped, f'~/{name}', 100)
                                    for name in (*FOR_PLOTS, *BIASES)}
        self._state_publisher = self._publish_on(UInt8, '~/state', 10)
        gnss = gnss_topics(self._config)
        self._inputs = {IMU_TOPIC: 'sensor_msgs/msg/Imu', **gnss}
        self._gate = Gate()
        self._imu_subscription = self._subscribe_to(
            Imu, IMU_TOPIC, self._on_imu, IMU_DEPTH, self._gate)
        for topic, msgtype in gnss.items():
            self._subscribe_to(message_class(msgtype), topic, partial(self._on_gnss, topic),
                               GNSS_DEPTH)

    def _publish_on(self, msg_type: type, topic: str, qos: QoSProfile | int) -> Publisher:
        # The executor would wait for every event handler at each IMU message, and none is needed:
        # a subscriber whose QoS asks for more warns on its own side.
        return self.create_publisher(
            msg_type, topic, qos,
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def _open_attitude_topic(self) -> Publisher:
        return self._publish_on(QuaternionStamped, '~/initial_attitude', QoSProfile(
            depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def _subscribe_to(self, msg_type: type, topic: str, callback: Callable[..., None],
                      depth: int, group: Gate | None = None) -> Subscription:
        # Best effort matches every publisher: an event of incompatible QoS cannot occur.
        return self.create_subscription(
            msg_type, topic, callback,
            QoSProfile(depth=depth, reliability=ReliabilityPolicy.BEST_EFFORT),
            callback_group=group,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            # A shorter queue would lose samples while the gate is closed.
            qos_overriding_options=QoSOverridingOptions((QoSPolicyKind.RELIABILITY,)),
            raw=msg_type is Imu)

    def _declare_parameters(self) -> Config:
        """Check the values given at start and declare all parameters with their description."""
        declared = {name: parameter.value
                    for name, parameter in self.get_parameters_by_prefix('').items()}
        given, warnings = without_unknown(declared)
        config = config_from_mapping(given)
        if not given and not warnings and '--params-file' in sys.argv:
            # ROS passes over sections for other nodes without a word.
            name = self.get_fully_qualified_name().lstrip('/')
            warnings.append(f'no parameter file sets a parameter of this node: the section for it '
                            f'must be named "{name}:" or "/**:", with "ros__parameters:" below')
        for warning in warnings:
            self.get_logger().warning(warning)
        for name in declared:
            if name not in RCLPY_PARAMETERS:
                self.undeclare_parameter(name)
        for own in dataclasses.fields(Config):
            self.declare_parameter(own.name, getattr(config, own.name), parameter_descriptor(own),
                                   ignore_override=True)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._change_parameters)
        return config

    def _changed_config(self, changes: Iterable[Parameter]) -> Config:
        own, _ = without_unknown({change.name: change.value for change in changes})
        return dataclasses.replace(self._config, **own)

    def _check_parameters(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            self._changed_config(changes)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _change_parameters(self, changes: list[Parameter]) -> None:
        self._inbox.append((time.time_ns(), lambda: self._reconfigure(changes)))

    def _reconfigure(self, changes: list[Parameter]) -> None:
        # In the worker's thread, because it may put the lever arm of TF into the configuration.
        self._config = self._changed_config(changes)
        self._aligner.reconfigure(self._config)
