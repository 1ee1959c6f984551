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
"""Writes results as a recording (mcap) with the topics of the node, to play with the input."""

from collections import deque
from collections.abc import Iterator
import dataclasses
import math
import os
from pathlib import Path
import tempfile
from types import SimpleNamespace
from typing import Any

from ins_align.imu.buffer import MAX_GAP_NS, MAX_RATE
from ins_align.imu.prediction import Prediction
from ins_align.mounting import turn_to_base
from ins_align.recordings import BagError
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import decode_imu, deserialize, IMU_TYPE, VECTOR_TYPE
from ins_align.recordings.reader import frame_id_of
from ins_align.results import (
    BIASES, Epoch, FOR_PLOTS, level_of, Result, State, Status, status_values)
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

NAMESPACE = '/ins_align'
TOPICS = {'imu': IMU_TYPE, 'initial_attitude': 'geometry_msgs/msg/QuaternionStamped',
          'status': 'diagnostic_msgs/msg/DiagnosticArray',
          **dict.fromkeys((*FOR_PLOTS, *BIASES), VECTOR_TYPE)}
STATUS_PERIOD_NS = 1_000_000_000  # a change of the state is written at once
# Without GNSS there is an epoch every 2 s; the gyros carry no older attitude forward.
MAX_AGE_NS = 2_500_000_000
RECENT = 100  # IMU samples that show how much the rate varies

Record = tuple[str, int, Any]  # topic without its namespace, recorded time, message


def write_results(result: Result, path: str | os.PathLike[str]) -> None:
    """
    Write the results of a recording as a rosbag2 (mcap) with the topics of the node.

    It makes a complete directory or none, and reads the IMU messages of the recording again.
    Stamps are those of the input; the recorded time is that of the next IMU message. Raises a
    BagError if the path exists or the recording can no longer be read.
    """
    path = Path(path)
    if path.exists():
        raise BagError(f'{path} exists already: choose another name for the results or remove it')
    topics = dict(TOPICS)
    if result.topics is not None and result.topics.base is not None:
        topics['base_imu'] = IMU_TYPE
    store = get_typestore(Stores.ROS2_JAZZY)
    ros = SimpleNamespace(**{name.split('/')[-1]: kind for name, kind in store.types.items()})
    with tempfile.TemporaryDirectory(prefix=f'.{path.name}.', dir=path.parent) as directory:
        unfinished = Path(directory) / path.name
        with Writer(unfinished, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections = {name: writer.add_connection(f'{NAMESPACE}/{name}', msgtype,
                                                       typestore=store)
                           for name, msgtype in topics.items()}
            for name, time_ns, message in _Results(result, ros).records():
                writer.write(connections[name], time_ns,
                             store.serialize_cdr(message, topics[name]))
        unfinished.rename(path)


class _Results:
    """Makes the ROS messages of a result; `ros` has their types by name."""

    def __init__(self, result: Result, ros: SimpleNamespace) -> None:
        assert result.topics is not None
        self._result, self._ros = result, ros
        self._topic, self._base = result.topics.imu, result.topics.base
        self._imu_frame = ''
        self._state: State | None = None  # of the epoch before
        self._status_ns = -STATUS_PERIOD_NS
        nan = np.full(3, math.nan)
        # An Epoch does not hold these values of a Status.
        self._unknown = dataclasses.replace(
            result.status, accel_bias_std=nan, lever_arm=nan, lever_arm_std=nan,
            gnss_delay=math.nan, gnss_delay_std=math.nan, counts={}, time_to_align_s=None)

    def records(self) -> Iterator[Record]:
        """Yield IMU messages with the attitude, and between them the messages of the epochs."""
        epochs = deque(self._result.epochs)
        prediction: Prediction | None = None
        last_ns, recent = 0, deque([np.zeros(3)], maxlen=RECENT)
        time_ns = epoch_ns = 0
        for time_ns, data, stamp_ns, gyro, accel, good in self._samples():
            # Not all epochs up to the stamp: it may be far ahead, or the clock is set back later.
            while epochs and 0 <= stamp_ns - epochs[0].stamp_ns <= MAX_GAP_NS:
                epoch = epochs.popleft()
                yield from self._of_epoch(epoch, time_ns)
                share = ((epoch.stamp_ns - last_ns) / (stamp_ns - last_ns)
                         if last_ns < stamp_ns else 1.0)
                rate = recent[-1] + (max(share, 0.0) * (gyro - recent[-1]) if good else 0.0)
                prediction = self._prediction(epoch, np.array([*recent, rate]),
                                              1e-9 * (stamp_ns - last_ns))
                epoch_ns = epoch.stamp_ns
            if good:
                last_ns = stamp_ns
                recent.append(gyro)
            if prediction is None:
                if not epochs:
                    break
            elif stamp_ns <= epoch_ns + MAX_AGE_NS and (
                    prediction.propagate(stamp_ns, gyro.tolist())
                    or (good and stamp_ns == epoch_ns)):
                yield 'imu', time_ns, self._imu(prediction, data, gyro, accel)
                if self._base is not None:
                    message = self._imu(prediction, data, gyro, accel)
                    turn_to_base(message, self._base, self._result.config.base_frame)
                    yield 'base_imu', time_ns, message
        for epoch in epochs:
            yield from self._of_epoch(epoch, time_ns)
        yield 'status', time_ns, self._status(self._result.status)

    def _samples(self) -> Iterator[tuple[int, Any, int, Any, Any, bool]]:
        """Yield recorded time, message, stamp, rate, specific force, and if the rate is valid."""
        with Bag(self._result.bag) as bag:
            self._imu_frame = frame_id_of(bag, self._topic)
            for block in bag.blocks([self._topic]):
                samples = decode_imu(block.messages[0], self._topic)
                good = (np.abs(samples.gyro) < MAX_RATE).all(axis=1)
                for place, *numbers in zip(
                        np.flatnonzero(samples.decoded).tolist(), samples.stamps_ns.tolist(),
                        samples.gyro, samples.accel, good.tolist()):
                    yield int(block.times_ns[place]), block.messages[0][place], *numbers

    def _prediction(self, epoch: Epoch, rates: Any, interval: float) -> Prediction | None:
        """Return a prediction from an epoch with these rates; None unless it is declared."""
        if epoch.state is not State.ALIGNED or epoch.current is None:
            return None
        return Prediction(epoch, self._result.config.imu_noise, rates, interval)

    def _of_epoch(self, epoch: Epoch, time_ns: int) -> Iterator[Record]:
        """Yield the messages of an epoch: initial attitude, angles, sigmas and biases, status."""
        first, now = epoch.initial, epoch.current
        declared = epoch.state is State.ALIGNED and self._state is not State.ALIGNED
        if declared and first is not None:
            yield 'initial_attitude', time_ns, self._ros.QuaternionStamped(
                self._header(first.stamp_ns), self._quaternion(first.quaternion_xyzw))
        if now is not None:
            for name in FOR_PLOTS:
                yield name, time_ns, self._ros.Vector3Stamped(
                    self._header(now.stamp_ns), self._ros.Vector3(*getattr(now, name)))
            for name in BIASES:
                header = dataclasses.replace(self._header(now.stamp_ns), frame_id=self._imu_frame)
                yield name, time_ns, self._ros.Vector3Stamped(
                    header, self._ros.Vector3(*getattr(epoch, name).tolist()))
        since_ns = abs(epoch.stamp_ns - self._status_ns)  # the clock may have been set back
        if epoch.state is not self._state or since_ns >= STATUS_PERIOD_NS:
            self._status_ns = epoch.stamp_ns
            yield 'status', time_ns, self._status(dataclasses.replace(
                self._unknown, state=epoch.state, reason=epoch.reason, stamp_ns=epoch.stamp_ns,
                t0_ns=first and first.stamp_ns, initial=first, current=now,
                gyro_bias=epoch.gyro_bias, gyro_bias_std=epoch.gyro_bias_std,
                accel_bias=epoch.accel_bias))
        self._state = epoch.state

    def _imu(self, prediction: Prediction, data: bytes, gyro: Any, accel: Any) -> Any:
        """Return the input message with its orientation set."""
        orientation = self._quaternion(prediction.quaternion_xyzw)
        covariance = np.array(prediction.covariance)
        if self._topic.msgtype == IMU_TYPE:
            return dataclasses.replace(deserialize(data, self._topic), orientation=orientation,
                                       orientation_covariance=covariance)
        # A driver's own type has neither a header nor an orientation.
        return self._ros.Imu(
            self._header(prediction.stamp_ns), orientation, covariance,
            self._ros.Vector3(*gyro.tolist()), np.zeros(9),
            self._ros.Vector3(*accel.tolist()), np.zeros(9))

    def _status(self, status: Status) -> Any:
        values = status_values(status, self._result.config.base_frame, self._base)
        return self._ros.DiagnosticArray(self._header(status.stamp_ns or 0), [
            self._ros.DiagnosticStatus(
                level_of(status.state), 'ins_align: alignment',
                f'{status.state.value}: {status.reason}'.removesuffix(': '), self._imu_frame,
                [self._ros.KeyValue(*each) for each in values.items()])])

    def _header(self, stamp_ns: int) -> Any:
        return self._ros.Header(self._ros.Time(*divmod(stamp_ns, 1_000_000_000)),
                                self._result.config.world_frame_id)

    def _quaternion(self, xyzw: Any) -> Any:
        return self._ros.Quaternion(*map(float, xyzw))
