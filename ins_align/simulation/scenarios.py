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
True motion of a simulated vehicle, and what perfect sensors on it would measure.

A scenario is a function of time that gives velocity and attitude in closed form, so that the truth
is known at any instant; angular acceleration and jerk are continuous. Positions come from
integrating the velocity. Body axes are forward-left-up, velocities ENU, angles radians, yaw is
counter-clockwise from east.

The IMU's readings come from python-ins (PyPI), which derives them from the trajectory with its own
Earth model. The antenna's motion is computed at the instants of the GNSS measurements, which need
not be those of IMU samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
import math
from typing import Any, NamedTuple

from ins_align.geometry.earth import matrix_en
from ins_align.geometry.rotation import Array, cross, log_so3, matrix_from_rpy
from ins_align.gnss.messages import ENU_FROM_NED
import numpy as np

_GRAVITY = 9.81     # m/s^2, for banking only
_MARGIN = 1000.0    # s for which a profile is defined before its start and after its end

# Rows of duration in s, acceleration in m/s^2 and turn rate in rad/s, from rest to rest.
_Rows = Sequence[tuple[float, float, float]]
_CITY = ((1.0, 0.0, 0.0), (6.0, 2.0, 0.0), (5.0, 0.0, 0.0), (3.0, -2.0, 0.0),
         (5.2, 0.0, 0.3), (4.0, 2.0, 0.0), (6.0, 0.0, 0.05), (4.0, -2.0, 0.0),
         (4.5, 0.0, -0.35), (4.0, 1.5, 0.0), (5.0, 0.0, -0.06), (6.0, -2.0, 0.0),
         (4.0, 0.0, 0.0))
# A robot also turns on the spot.
_YARD = ((1.0, 0.0, 0.0), (1.5, 0.5, 0.0), (12.0, 0.0, 0.0), (1.5, -0.5, 0.0), (3.2, 0.0, 1.0),
         (1.5, 0.4, 0.0), (8.0, 0.0, 0.15), (6.0, 0.0, -0.2), (1.5, -0.4, 0.0), (3.0, 0.0, -0.7),
         (2.0, 0.0, 0.0), (2.0, -0.2, 0.0), (3.0, 0.0, 0.2), (2.0, 0.2, 0.0))
_BACK_OUT = ((2.0, 0.0, 0.0), (2.0, -0.75, 0.0), (5.0, 0.0, 0.25), (2.0, 0.75, 0.0),
             (1.0, 0.0, 0.0))
_THROW = ((2.0, 0.5, 3.5), (0.0, 30.0, 0.0))  # durations in s, accelerations in m/s^2
_CIRCUIT = ((7.0, 0.0, 0.35), (3.0, 0.0, 0.0), (7.0, 0.0, -0.35), (4.0, 0.0, 0.1))


class Motion(NamedTuple):
    """Velocity of the IMU and attitude of the vehicle at n instants."""

    velocity: Array  # (n, 3), ENU, m/s
    rpy: Array       # (n, 3), roll, pitch, yaw, rad


class Scenario(NamedTuple):
    """One kind of motion."""

    motion: Callable[[Array, float], Motion]  # of times (n,) and the duration, s
    duration: float  # s, by default
    set_off: float   # s from standstill to full motion


def motion_of(time: Array, scenario: Scenario, duration: float, heading: float, crab: float,
              stand_still: float) -> Motion:
    """
    Return the motion of a scenario at times (n,), s.

    Heading turns the whole trajectory about the vertical, crab the attitude only, rad. The vehicle
    sets off after `stand_still` seconds at rest.
    """
    pace = np.ones_like(time)
    if stand_still > 0:
        # The vehicle follows the same path, slowly at first.
        pace = _step(time, stand_still, scenario.set_off)
        time = _step_integral(time, stand_still, scenario.set_off)
    velocity, rpy = scenario.motion(time, duration)
    turn = matrix_from_rpy([0.0, 0.0, heading])
    return Motion(velocity * pace[:, None] @ turn.T, rpy + [0.0, 0.0, heading + crab])


def _step(time: Array, start: float, width: float) -> Array:
    """Return a step from 0 to 1 within `width`, with two continuous derivatives."""
    x = np.clip((time - start) / width, 0.0, 1.0)
    return x ** 3 * (10 - 15 * x + 6 * x ** 2)


def _step_integral(time: Array, start: float, width: float) -> Array:
    """Return the integral of `_step`."""
    x = np.clip((time - start) / width, 0.0, 1.0)
    return width * x ** 4 * (2.5 - 3 * x + x ** 2) + np.maximum(time - start - width, 0.0)


def _profile(durations: Sequence[float], values: Sequence[float], width: float) -> Any:
    """Return a PPoly that holds each value for its duration, with smooth steps between them."""
    from scipy.interpolate import PPoly

    ends = np.cumsum(durations)
    starts = np.concatenate([[0.0], ends[:-1]])
    steps = np.diff(values, prepend=0.0)
    # A constant piece from before t = 0, then a step and a constant piece for each value.
    breaks = np.concatenate([[-_MARGIN], np.column_stack([starts, starts + width]).ravel(),
                             [ends[-1] + _MARGIN]])
    coefficients = np.zeros((6, len(breaks) - 1))
    smooth = slice(1, None, 2)
    coefficients[0, smooth] = 6 * steps / width ** 5
    coefficients[1, smooth] = -15 * steps / width ** 4
    coefficients[2, smooth] = 10 * steps / width ** 3
    coefficients[5, smooth] = np.subtract(values, steps)
    coefficients[5, 2::2] = values
    return PPoly(coefficients, breaks)


@lru_cache(maxsize=8)
def _course(first: _Rows, block: _Rows, duration: float, width: float) -> tuple[Any, Any]:
    """Return acceleration and turn rate, as PPoly, of `first` and then repetitions of `block`."""
    rows = list(first)
    length = sum(row[0] for row in first)
    while length < duration:
        rows.extend(block)
        length += sum(row[0] for row in block)
    durations, accelerations, rates = zip(*rows)
    return _profile(durations, accelerations, width), _profile(durations, rates, width)


def _along(speed: Array, yaw: Array, climb: Array) -> Array:
    """Return the ENU velocity, (n, 3), of a speed along a course and a climb angle, (n,)."""
    level = speed * np.cos(climb)
    return np.stack([level * np.cos(yaw), level * np.sin(yaw), speed * np.sin(climb)], axis=-1)


def _wave(time: Array, amplitude: float, period: float, phase: float = 0.0) -> Array:
    return amplitude * np.sin(2 * np.pi * time / period + phase)


def _flight(time: Array, duration: float) -> Motion:
    """Fly S-turns at 100 m/s, banked, with oscillations of a few degrees about all axes."""
    turn, period = np.radians(25.0), 40.0
    speed = 100.0 + _wave(time, 3.0, 61.0)
    course = turn * (1 - np.cos(2 * np.pi * time / period))
    rate = _wave(time, turn * 2 * np.pi / period, period)
    climb = _wave(time, 0.03, 27.0)
    roll = -np.arctan(speed * rate / _GRAVITY) + _wave(time, 0.05, 4.3)
    pitch = -climb - 0.03 + _wave(time, 0.05, 5.7, 1.0)
    yaw = course + _wave(time, 0.035, 7.1, 2.0)
    return Motion(_along(speed, course, climb), np.stack([roll, pitch, yaw], axis=-1))


def _road(time: Array, duration: float, first: _Rows = (), block: _Rows = _CITY,
          bumps: float = 1.0) -> Motion:
    """
    Drive the rows of `first`, then repeat `block`, by default city streets with corners.

    Slopes and bumps are `bumps` times closer together than those of streets.
    """
    acceleration, rate = _course(first, block, duration, 0.8)
    speed_along = acceleration.antiderivative()
    speed, d = speed_along(time), bumps * speed_along.antiderivative()(time)
    yaw, turn = rate.antiderivative()(time), rate(time)
    # Slopes and bumps belong to places: a car at rest does not move on them.
    slope = _wave(d, 0.03, 310.0) + _wave(d, 0.004, 9.7)
    roll = 0.006 * speed * turn + _wave(d, 0.02, 170.0) + _wave(d, 0.005, 8.3)
    pitch = -slope - 0.006 * acceleration(time) + _wave(d, 0.003, 11.9)
    return Motion(_along(speed, yaw, slope), np.stack([roll, pitch, yaw], axis=-1))


def _launch(time: Array, duration: float) -> Motion:
    """Rest in a hand, be thrown with 3 g for half a second, climb and turn."""
    speed = _profile(*_THROW, 0.1).antiderivative()(time)
    _, rate = _course(((6.0, 0.0, 0.0),), _CIRCUIT, duration, 1.5)
    yaw = rate.antiderivative()(time)
    free = _step(time, 2.6, 3.0)
    climb = 0.2 - 0.15 * _step(time, 6.0, 6.0)
    roll = -np.arctan(speed * rate(time) / _GRAVITY) + free * _wave(time, 0.05, 2.9)
    pitch = -climb - free * (0.05 + _wave(time, 0.04, 3.7))
    yaw_body = yaw + free * _wave(time, 0.03, 4.9)
    return Motion(_along(speed, yaw, climb), np.stack([roll, pitch, yaw_body], axis=-1))


def _hover(time: Array, duration: float) -> Motion:
    """Wander about a point as a quadrotor does: it leans where it accelerates, yaws slowly."""
    # Axis, amplitude in m/s, period in s, phase.
    waves = ((0, 0.7, 7.3, 0.3), (0, 0.5, 12.1, 1.1), (1, 0.8, 9.1, 2.0), (1, 0.4, 5.9, 0.0),
             (2, 0.2, 8.3, 0.7))
    velocity = np.zeros((len(time), 3))
    lift = np.tile([0.0, 0.0, _GRAVITY], (len(time), 1))
    for axis, amplitude, period, phase in waves:
        velocity[:, axis] += _wave(time, amplitude, period, phase)
        lift[:, axis] += _wave(time, amplitude * 2 * np.pi / period, period, phase + np.pi / 2)
    yaw = _wave(time, 0.35, 53.0)
    ahead = np.cos(yaw) * lift[:, 0] + np.sin(yaw) * lift[:, 1]
    left = np.cos(yaw) * lift[:, 1] - np.sin(yaw) * lift[:, 0]
    pitch = np.arctan2(ahead, lift[:, 2])
    roll = -np.arctan2(left, np.hypot(ahead, lift[:, 2]))
    return Motion(velocity, np.stack([roll, pitch, yaw], axis=-1))


def _steady(time: Array, duration: float, speed: float,
            waves: Sequence[tuple[int, float, float, float]] = ()) -> Motion:
    """Hold speed and course; waves (axis, amplitude, period, phase) turn only the attitude."""
    rpy = np.zeros((len(time), 3))
    for axis, *wave in waves:
        rpy[:, axis] += _wave(time, *wave)
    return Motion(np.tile([speed, 0.0, 0.0], (len(time), 1)), rpy)


# Gusts push the nose of a car on a highway off its course, by a degree.
_GUSTS = ((0, 0.005, 2.3, 0.0), (0, 0.01, 17.0, 0.0), (1, 0.005, 1.7, 0.0), (2, 0.017, 3.1, 0.0),
          (2, 0.017, 7.3, 1.0))
# A boat in waves.
_SEA = ((0, 0.05, 4.7, 0.0), (1, 0.03, 6.1, 0.0), (2, np.radians(20.0), 11.0, 0.0))
SCENARIOS = {
    'flight': Scenario(_flight, 100.0, 40.0),
    'car': Scenario(_road, 100.0, 1.0),
    'straight': Scenario(partial(_steady, speed=30.0), 100.0, 15.0),
    'static': Scenario(partial(_steady, speed=0.0), 60.0, 1.0),
    'hover': Scenario(_hover, 60.0, 2.0),
    'launch': Scenario(_launch, 60.0, 2.0),
    'reverse': Scenario(partial(_road, first=_BACK_OUT), 100.0, 1.0),
    'swing': Scenario(partial(_steady, speed=5.0, waves=_SEA), 100.0, 5.0),
    'highway': Scenario(partial(_steady, speed=10.0, waves=_GUSTS), 60.0, 5.0),
    'robot': Scenario(partial(_road, block=_YARD, bumps=10.0), 100.0, 1.0),
}


# Sensors

FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])
START_NS = 1_750_000_000_000_000_000  # stamp of t = 0

# Splines are inexact at their ends, with an error that falls by a factor of 0.27 per sample: so
# many more samples are computed on both sides and left out.
_PADDING = 32
_JITTER_SEED = 1
_RATE_STEP = 1e-3  # s, of the numerical derivative of the attitude


def displaced(lla: Array, offset: Array) -> Array:
    """Return positions (n, 3), degrees and m, moved by small offsets (n, 3), ENU, m."""
    from pyins.transform import perturb_lla

    return perturb_lla(lla, offset @ ENU_FROM_NED)


def wrapped(lla: Array) -> Array:
    """Return positions (n, 3), degrees and m, with longitudes in [-180, 180)."""
    result = lla.copy()
    result[:, 1] = (result[:, 1] + 180.0) % 360.0 - 180.0
    return result


class Trajectory(NamedTuple):
    """
    Motion of a vehicle and perfect IMU samples, independent of mounting, noise and antenna.

    N samples at the IMU's instants, in the vehicle's frame v, forward-left-up; velocities are ENU,
    m/s, positions degrees, degrees, metres.
    """

    motion: Callable[[Array], Motion]
    stamps_ns: np.ndarray    # (N,)
    C_nv: Array              # (N, 3, 3)
    velocity: Array          # (N, 3)
    lla: Array               # (N, 3), longitude in [-180, 180)
    gyro: Array              # (N, 3), rad/s
    accel: Array             # (N, 3), specific force, m/s^2
    lla_spline: Callable[[Array], Array]  # of times (n,), (n, 3), longitude continuous

    def antenna(self, time: Array, C_vb: Array, lever_arm: Array) -> tuple[Array, Array]:
        """Return the antenna's position, degrees and m, and ENU velocity at times (n,)."""
        from pyins.earth import principal_radii

        velocity, rpy = self.motion(time)
        lla = self.lla_spline(time)
        C_nb = matrix_from_rpy(rpy) @ C_vb
        # Five-point difference of the attitude about each instant.
        near, far = (log_so3(
            np.swapaxes(self._attitude(time - step), 1, 2) @ self._attitude(time + step))
            / (2 * step) for step in (_RATE_STEP, 2 * _RATE_STEP))
        omega_nb_b = (4 * near - far) / 3 @ C_vb
        north, east, _ = principal_radii(lla[:, 0], lla[:, 2])
        turn = velocity[:, 0] / east
        omega_en_n = np.stack([-velocity[:, 1] / north, turn,
                               turn * np.tan(np.radians(lla[:, 0]))], axis=-1)
        omega_eb_b = omega_nb_b + np.einsum('nji,nj->ni', C_nb, omega_en_n)
        lever_n = C_nb @ lever_arm
        velocity = velocity + np.einsum('nij,nj->ni', C_nb, cross(omega_eb_b, lever_arm))
        antenna = displaced(lla, lever_n)
        # East, north and up at the antenna are not those at the IMU.
        C_imu, C_antenna = (matrix_en(*np.radians(p[:, :2]).T) for p in (lla, antenna))
        velocity = np.einsum('nji,njk,nk->ni', C_antenna, C_imu, velocity)
        return antenna, velocity

    def _attitude(self, time: Array) -> Array:
        return matrix_from_rpy(self.motion(time).rpy)


@lru_cache(maxsize=4)
def trajectory_of(
        scenario: str, duration: float, imu_rate: float, imu_jitter: float, latitude_deg: float,
        longitude_deg: float, altitude: float, heading_deg: float, crab_deg: float,
        stand_still: float) -> Trajectory:
    """Return the trajectory for arguments of `simulate`; the last few are kept, read-only."""
    from pyins.earth import principal_radii
    from pyins.sim import generate_imu
    from pyins.transform import mat_from_rph
    from scipy.interpolate import CubicHermiteSpline

    motion = partial(motion_of, scenario=SCENARIOS[scenario], duration=duration,
                     heading=math.radians(heading_deg), crab=math.radians(crab_deg),
                     stand_still=stand_still)
    index = np.arange(-_PADDING, int(duration * imu_rate + 1e-6) + 1 + _PADDING, dtype=float)
    if imu_jitter > 0:
        jitter = np.random.default_rng(_JITTER_SEED)
        index += jitter.uniform(-imu_jitter, imu_jitter, len(index))
    stamps = np.rint(index / imu_rate * 1e9).astype(np.int64)
    time = stamps * 1e-9
    velocity, rpy = motion(time)
    roll, pitch, yaw = np.degrees(rpy).T
    # The trajectory begins before t = 0, with the padding, and is at the given place at t = 0.
    before = velocity[:_PADDING + 1].mean(axis=0, keepdims=True) * time[0]
    start = displaced(np.array([[latitude_deg, longitude_deg, altitude]]), before)
    truth, imu = generate_imu(time, start[0], np.stack([roll, -pitch, 90 - yaw], axis=-1),
                              velocity @ ENU_FROM_NED, 'rate')
    lla = truth[['lat', 'lon', 'alt']].to_numpy()
    north, _, parallel = principal_radii(lla[:, 0], lla[:, 2])
    slope = np.stack([np.degrees(velocity[:, 1] / north), np.degrees(velocity[:, 0] / parallel),
                      velocity[:, 2]], axis=-1)
    keep = slice(_PADDING, -_PADDING)
    C_nv = ENU_FROM_NED @ mat_from_rph(truth[['roll', 'pitch', 'heading']].to_numpy()[keep]) \
        @ FLU_FROM_FRD
    arrays = (START_NS + stamps[keep], C_nv,
              truth[['VN', 'VE', 'VD']].to_numpy()[keep] @ ENU_FROM_NED, wrapped(lla[keep]),
              imu[['gyro_x', 'gyro_y', 'gyro_z']].to_numpy()[keep] @ FLU_FROM_FRD,
              imu[['accel_x', 'accel_y', 'accel_z']].to_numpy()[keep] @ FLU_FROM_FRD)
    for array in arrays:
        array.setflags(write=False)  # shared by every simulation that has this trajectory
    return Trajectory(motion, *arrays, CubicHermiteSpline(time, lla, slope))
