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
Simulated recordings: sensors of a moving vehicle with truth.

Perfect readings come from `scenarios`. This module adds the errors of the IMU, the noise, latency,
outages and outliers of the GNSS receiver, and writes the recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import heapq
import json
import math
from operator import itemgetter
import os
from pathlib import Path
import tempfile
from types import SimpleNamespace
from typing import Any

from ins_align.config import Config, ImuNoise, PRESETS
from ins_align.geometry.rotation import Array, matrix_from_rpy, quaternion_from_matrix
from ins_align.gnss.messages import ENU_FROM_NED, Fix, Velocity
from ins_align.simulation import scenarios
from ins_align.simulation.arguments import (
    Arguments, AXIS_SIGNS, LATENESS_MARGIN, SimulationError)
from ins_align.simulation.scenarios import displaced, START_NS, Trajectory, trajectory_of, wrapped
import numpy as np

# Scenarios that the experiments draw from: one more would change all their runs.
CAMPAIGN_SCENARIOS = tuple(scenarios.SCENARIOS)[:8]
STORAGES = ('mcap', 'sqlite3')
TOPICS = {'/imu/data_raw': 'sensor_msgs/msg/Imu', '/reference/imu': 'sensor_msgs/msg/Imu',
          '/fix': 'sensor_msgs/msg/NavSatFix',
          '/fix_velocity': 'geometry_msgs/msg/TwistWithCovarianceStamped',
          '/tf_static': 'tf2_msgs/msg/TFMessage'}

_TRUTH_STD = 1e-6  # rad, stated on the reference topic, where zero would mean unknown


@dataclass(frozen=True, eq=False)
class Simulation:
    """
    A simulated recording with truth; N IMU samples, K GNSS epochs.

    Velocities are ENU (unless the receiver was told to send NED), attitudes take the IMU frame
    to ENU, positions are degrees, degrees, metres above the ellipsoid.
    """

    imu_stamps_ns: np.ndarray       # (N,) int64
    gyro: Array                     # (N, 3), rad/s
    accel: Array                    # (N, 3), specific force, m/s^2
    gnss_stamps_ns: np.ndarray      # (K,) int64
    gnss_arrival_ns: np.ndarray     # (K,) int64
    lla_deg: Array                  # (K, 3), antenna
    velocity: Array                 # (K, 3), antenna, m/s
    velocity_covariance: Array      # (3, 3), in the frame of `velocity`
    position_covariance: Array      # (3, 3), ENU, m^2
    outlier: np.ndarray             # (K,) bool: this epoch was spoilt on purpose
    truth_stamps_ns: np.ndarray     # (N,) int64
    truth_C_nb: Array               # (N, 3, 3)
    truth_velocity: Array           # (N, 3), IMU, ENU, m/s
    truth_lla: Array                # (N, 3), IMU, degrees and metres
    truth_gyro: Array               # (N, 3), rad/s
    truth_accel: Array              # (N, 3), m/s^2
    gyro_bias: Array                # (3,), rad/s, at the first sample
    accel_bias: Array               # (3,), m/s^2
    lever_arm: Array                # (3,), IMU to antenna in the IMU frame, m
    imu_noise: ImuNoise             # noise, and the sigmas of the constant errors
    gyro_std: float                 # rad/s per sample
    accel_std: float                # m/s^2 per sample
    meta: dict[str, Any]            # the arguments of `simulate`
    _trajectory: Trajectory
    _C_vb: Array

    def attitude_at(self, stamps_ns: int | np.ndarray) -> Array:
        """Return the true ``C_nb`` at stamps (...), exact between samples, shape (..., 3, 3)."""
        stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
        time = (stamps_ns.ravel() - START_NS) * 1e-9
        C_nb = matrix_from_rpy(self._trajectory.motion(time).rpy) @ self._C_vb
        return C_nb.reshape(stamps_ns.shape + (3, 3))

    def messages(self) -> Iterator[tuple[str, Any]]:
        """
        Yield messages as a subscriber gets them, in the order of arrival.

        Each is 'imu' with the samples since the last GNSS epoch (stamps (n,), gyro (n, 3), accel
        (n, 3)), 'fix' with a `Fix`, or 'velocity' with a `Velocity`.
        """
        upto = np.searchsorted(self.imu_stamps_ns, self.gnss_arrival_ns, side='right')
        start = 0
        for k, end in enumerate([*upto, len(self.imu_stamps_ns)]):
            if end > start:
                yield 'imu', (self.imu_stamps_ns[start:end], self.gyro[start:end],
                              self.accel[start:end])
                start = end
            if k < len(upto):
                yield 'fix', self.fix(k)
                yield 'velocity', self.velocity_measurement(k)

    def fix(self, k: int) -> Fix:
        """Return the position of GNSS epoch k as a message."""
        latitude, longitude, altitude = self.lla_deg[k].tolist()
        return Fix(int(self.gnss_stamps_ns[k]), latitude, longitude, altitude,
                   self.position_covariance, 0)

    def velocity_measurement(self, k: int) -> Velocity:
        """Return the velocity of GNSS epoch k as a message, taken for ENU even if it is NED."""
        return Velocity(int(self.gnss_stamps_ns[k]), self.velocity[k], self.velocity_covariance)


def give(aligner: Any, kind: str, payload: Any) -> None:
    """Pass one of `Simulation.messages` to an aligner."""
    if kind == 'imu':
        aligner.add_imu(*payload)
    else:
        getattr(aligner, f'add_{kind}')(payload)


def simulate(scenario: str, **options: Any) -> Simulation:
    """
    Simulate the sensors of a vehicle that moves as one of `scenarios.SCENARIOS`.

    The options are the fields of `Arguments`, in SI units except where the name says degrees. A
    SimulationError says which one makes no sense.
    """
    args = Arguments(scenario, **options)
    trajectory = trajectory_of(scenario, *(float(getattr(args, name)) for name in (
        'duration', 'imu_rate', 'imu_jitter', 'latitude_deg', 'longitude_deg', 'altitude',
        'heading_deg', 'crab_deg', 'stand_still')))
    streams = np.random.default_rng(int(args.seed)).spawn(6)
    C_vb = matrix_from_rpy(np.radians(args.mount_rpy_deg))
    lever_b = np.array(args.lever_arm, dtype=float)
    return Simulation(
        truth_stamps_ns=trajectory.stamps_ns, truth_C_nb=trajectory.C_nv @ C_vb,
        truth_velocity=trajectory.velocity, truth_lla=trajectory.lla, lever_arm=lever_b,
        meta=dict(vars(args)), _trajectory=trajectory, _C_vb=C_vb,
        **_imu(args, trajectory, C_vb, streams),
        **_gnss(args, trajectory, C_vb, lever_b, streams))


def _imu(args: Arguments, trajectory: Trajectory, C_vb: Array,
         streams: list[np.random.Generator]) -> dict[str, Any]:
    """Return the fields of `Simulation` that hold the IMU's readings and its errors."""
    noise, scale = args.imu_noise, 0.0 if args.ideal else 1.0
    truth_gyro, truth_accel = trajectory.gyro @ C_vb, trajectory.accel @ C_vb
    gyro_bias = scale * noise.gyro_bias_std * streams[0].standard_normal(3)
    accel_bias = scale * noise.accel_bias_std * streams[0].standard_normal(3)
    if args.accel_bias is not None:
        accel_bias = scale * np.array(args.accel_bias, dtype=float)
        noise = noise._replace(accel_bias_std=max(
            noise.accel_bias_std, float(np.sqrt(np.mean(np.square(args.accel_bias))))))
    gyro_matrix, accel_matrix = (
        np.eye(3) + scale * scale_std * np.diag(streams[0].standard_normal(3))
        + scale * misalignment_std * (1 - np.eye(3)) * streams[0].standard_normal((3, 3))
        for scale_std, misalignment_std in (
            (args.gyro_scale_std, args.gyro_misalignment_std),
            (args.accel_scale_std, args.accel_misalignment_std)))
    time, shape = trajectory.stamps_ns * 1e-9, truth_gyro.shape
    steps = np.sqrt(np.diff(time, prepend=time[0]))[:, None]
    walk = np.cumsum(scale * noise.rate_random_walk * steps * streams[0].standard_normal(shape),
                     axis=0)
    gyro_std = scale * noise.angle_random_walk * math.sqrt(args.imu_rate)
    accel_std = scale * noise.velocity_random_walk * math.sqrt(args.imu_rate)
    sign = np.array(AXIS_SIGNS[args.flip_axis])
    gyro = sign * AXIS_SIGNS[args.flip_gyro] * (
        truth_gyro @ gyro_matrix.T + gyro_bias + walk
        + gyro_std * streams[1].standard_normal(shape))
    accel = args.accel_sign * sign * (truth_accel @ accel_matrix.T + accel_bias
                                      + accel_std * streams[2].standard_normal(shape))
    if not args.ideal:
        for reading, dead_band, quantum in zip((gyro, accel), args.dead_band, args.quantum):
            reading[np.abs(reading) < dead_band] = 0.0
            if quantum > 0:
                np.rint(reading / quantum, out=reading)
                reading *= quantum
    return {'imu_stamps_ns': trajectory.stamps_ns, 'gyro': gyro, 'accel': accel,
            'truth_gyro': truth_gyro, 'truth_accel': truth_accel, 'gyro_bias': gyro_bias,
            'accel_bias': accel_bias, 'imu_noise': noise, 'gyro_std': gyro_std,
            'accel_std': accel_std}


def _gnss(args: Arguments, trajectory: Trajectory, C_vb: Array, lever_b: Array,
          streams: list[np.random.Generator]) -> dict[str, Any]:
    """Return the fields of `Simulation` that hold what the receiver sends."""
    scale = 0.0 if args.ideal else 1.0
    count = max(math.floor((args.duration - args.gnss_phase) * args.gnss_rate + 1e-6) + 1, 0)
    stamps = np.rint((args.gnss_phase + np.arange(count) / args.gnss_rate) * 1e9).astype(np.int64)
    seconds = stamps * 1e-9
    received = seconds >= args.gnss_delay
    for start, end in args.outages:
        received &= (seconds < start) | (seconds >= end)
    stamps, time = stamps[received], seconds[received] - args.gnss_delay
    lla, velocity = trajectory.antenna(time, C_vb, lever_b)
    vertical = args.velocity_std_vertical
    velocity_sigma = np.array([args.velocity_std, args.velocity_std,
                               args.velocity_std if vertical is None else vertical])
    position_sigma = args.position_std * np.array([1.0, 1.0, 2.0])
    outlier = streams[4].random(len(time)) < args.outlier_rate
    direction = streams[4].standard_normal((len(time), 3))
    direction *= (outlier / np.linalg.norm(direction, axis=1))[:, None]
    velocity = (velocity + scale * velocity_sigma * streams[3].standard_normal(velocity.shape)
                + args.outlier_velocity * direction)
    offset = (scale * position_sigma * streams[3].standard_normal(lla.shape)
              + args.outlier_position * direction)
    if not args.ideal:
        # Drawn last from their streams, so that they change no other error.
        for error, std, stream in ((offset, args.position_drift_std, streams[3]),
                                   (velocity, args.velocity_drift_std, streams[5])):
            error += gauss_markov(stamps * 1e-9, std, args.gnss_correlation, stream)
    lla = wrapped(displaced(lla, offset))
    velocity_covariance = np.diag(velocity_sigma ** 2)
    if args.velocity_frame == 'ned':
        velocity = velocity @ ENU_FROM_NED
        velocity_covariance = ENU_FROM_NED @ velocity_covariance @ ENU_FROM_NED
    gnss_stamps_ns = START_NS + stamps
    return {'gnss_stamps_ns': gnss_stamps_ns,
            'gnss_arrival_ns': gnss_stamps_ns + round(args.gnss_latency * 1e9),
            'lla_deg': lla, 'velocity': velocity, 'velocity_covariance': velocity_covariance,
            'position_covariance': np.diag(position_sigma ** 2), 'outlier': outlier}


def gauss_markov(time: Array, std: float, correlation_time: float,
                 random: np.random.Generator) -> Array:
    """Return a first-order Gauss-Markov process (n, 3) of constant variance."""
    decay = np.exp(-np.diff(time, prepend=-np.inf) / correlation_time)
    drive = std * np.sqrt(1 - decay ** 2)[:, None] * random.standard_normal((len(time), 3))
    for k in range(1, len(drive)):
        drive[k] += decay[k] * drive[k - 1]
    return drive


def write_bag(simulation: Simulation, path: str | os.PathLike, storage: str = 'mcap',
              tf: bool = False) -> None:
    """
    Write a rosbag2 of what a vehicle would have recorded, with truth on `/reference/imu`.

    Messages are in the order of arrival, which is their receive time. The directory also gets
    ``ins_align.yaml`` with the parameters that suit the recording; the arguments of the simulation
    and the biases are in the bag's custom data.

    The path becomes a directory, written whole or not at all; a SimulationError says that it
    exists already, or that storage is none of `STORAGES`. `tf` writes the mounting of IMU and
    antenna to `/tf_static`, too: frames base_link, imu and gnss.
    """
    path = Path(path)
    if storage not in STORAGES:
        raise SimulationError(f'storage must be one of {", ".join(STORAGES)}, got {storage!r}')
    if path.exists():
        raise SimulationError(f'{path} exists already: choose another name or remove it')
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f'.{path.name}.', dir=path.parent) as directory:
        unfinished = Path(directory) / path.name
        _write_messages(simulation, unfinished, storage, tf)
        (unfinished / 'ins_align.yaml').write_text(_parameter_file(simulation), 'utf-8')
        unfinished.rename(path)


def _write_messages(simulation: Simulation, path: Path, storage: str, tf: bool) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import get_typestore, Stores

    typestore = get_typestore(Stores.ROS2_JAZZY)
    ros = SimpleNamespace(**{name.split('/')[-1]: kind for name, kind in typestore.types.items()})
    streams = [_imu_messages(simulation, ros), _gnss_messages(simulation, ros)]
    if tf:
        streams.insert(0, _static_transforms(simulation, ros))
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        writer.set_custom_data('ins_align', json.dumps(
            {**simulation.meta, 'gyro_bias': simulation.gyro_bias,
             'accel_bias': simulation.accel_bias}, default=lambda value: value.tolist()))
        connections = {}
        for arrival, topic, message in heapq.merge(*streams, key=itemgetter(0)):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, TOPICS[topic],
                                                           typestore=typestore)
            writer.write(connections[topic], arrival,
                         typestore.serialize_cdr(message, TOPICS[topic]))


def _header(ros: SimpleNamespace, stamp_ns: int, frame: str) -> Any:
    return ros.Header(ros.Time(*divmod(stamp_ns, 1_000_000_000)), frame)


# Time of arrival, ns, topic and message.
_Messages = Iterator[tuple[int, str, Any]]


def _static_transforms(simulation: Simulation, ros: SimpleNamespace) -> _Messages:
    """Yield the mounting of IMU and antenna."""
    start, C_vb = int(simulation.imu_stamps_ns[0]), simulation._C_vb
    yield start, '/tf_static', ros.TFMessage([
        ros.TransformStamped(_header(ros, start, 'base_link'), child, ros.Transform(
            ros.Vector3(*translation.tolist()),
            ros.Quaternion(*quaternion_from_matrix(C).tolist())))
        for child, translation, C in (('imu', np.zeros(3), C_vb),
                                      ('gnss', C_vb @ simulation.lever_arm, np.eye(3)))])


def _imu_messages(simulation: Simulation, ros: SimpleNamespace) -> _Messages:
    """Yield the IMU's readings, and the truth on the reference topic."""
    unknown, exact = np.array([-1.0] + 8 * [0.0]), np.zeros(9)
    truth, gyro_covariance, accel_covariance = (
        (std ** 2 * np.eye(3)).ravel()
        for std in (_TRUTH_STD, simulation.gyro_std, simulation.accel_std))
    level = ros.Quaternion(0.0, 0.0, 0.0, 1.0)
    for stamp, attitude, gyro, accel, true_gyro, true_accel in zip(*(
            values.tolist() for values in (
                simulation.imu_stamps_ns, quaternion_from_matrix(simulation.truth_C_nb),
                simulation.gyro, simulation.accel, simulation.truth_gyro,
                simulation.truth_accel)), strict=True):
        header = _header(ros, stamp, 'imu')
        yield stamp, '/imu/data_raw', ros.Imu(
            header, level, unknown, ros.Vector3(*gyro), gyro_covariance, ros.Vector3(*accel),
            accel_covariance)
        yield stamp, '/reference/imu', ros.Imu(
            header, ros.Quaternion(*attitude), truth, ros.Vector3(*true_gyro), exact,
            ros.Vector3(*true_accel), exact)


def _gnss_messages(simulation: Simulation, ros: SimpleNamespace) -> _Messages:
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = simulation.velocity_covariance
    position_covariance = simulation.position_covariance.ravel()
    for stamp, arrival, lla, velocity in zip(*(values.tolist() for values in (
            simulation.gnss_stamps_ns, simulation.gnss_arrival_ns, simulation.lla_deg,
            simulation.velocity)), strict=True):
        yield arrival, '/fix', ros.NavSatFix(
            _header(ros, stamp, 'gnss'), ros.NavSatStatus(0, 1), *lla, position_covariance,
            ros.NavSatFix.COVARIANCE_TYPE_KNOWN)
        yield arrival, '/fix_velocity', ros.TwistWithCovarianceStamped(
            _header(ros, stamp, simulation.meta['velocity_frame']), ros.TwistWithCovariance(
                ros.Twist(ros.Vector3(*velocity), ros.Vector3(0.0, 0.0, 0.0)),
                covariance.ravel()))


def noise_parameters(noise: ImuNoise) -> dict[str, float]:
    """Return the noise of an IMU as parameters of `Config`."""
    arw, vrw, gyro_bias, accel_bias, gyro_scale, rate_walk = map(float, noise)
    return dict(zip(ImuNoise._fields, (
        60 * math.degrees(arw), 60 * vrw, math.degrees(gyro_bias), accel_bias, gyro_scale,
        60 * math.degrees(rate_walk))))


def _parameter_file(simulation: Simulation) -> str:
    """Return a parameter file of the node that suits the recording."""
    meta = simulation.meta
    values = {'lever_arm': simulation.lever_arm.tolist(), 'gnss_delay': float(meta['gnss_delay']),
              'velocity_frame': meta['velocity_frame']}
    lateness = float(meta['gnss_latency']) + LATENESS_MARGIN
    if lateness > Config.gnss_lateness:
        values['gnss_lateness'] = lateness
    grade = meta['imu_grade']
    values['imu_grade'] = grade if grade in PRESETS else 'custom'
    # Only what exceeds the preset is stated.
    covered = noise_parameters(PRESETS.get(grade, ImuNoise(0.0, 0.0, 0.0, 0.0)))
    values |= {name: value for name, value in noise_parameters(simulation.imu_noise).items()
               if value > covered[name]}
    return ''.join(['/**:\n  ros__parameters:\n',
                    *(f'    {name}: {value}\n' for name, value in values.items())])
