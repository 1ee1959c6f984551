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
"""What the tests of the core share: recordings through the aligner, their errors, IMU steps."""

from functools import lru_cache
from typing import NamedTuple

from ins_align.aligner import Aligner
from ins_align.experiments.common import exact_config_for
from ins_align.geometry.rotation import log_so3, matrix_from_quaternion
from ins_align.imu.preintegration import Noise, preintegrate, split_at_epochs
from ins_align.imu.recent import AGES, Recent
from ins_align.simulation.simulate import give, simulate
import numpy as np

LEVER = (1.0, 1.0, 1.0)
FEED_BLOCK = 200    # messages between two updates of a fed aligner: many at a time are quicker


@lru_cache(maxsize=64)
def simulated(scenario, **options):
    """Return a simulation; the same arguments give the same object, so change only copies."""
    return simulate(scenario, **options)


def config_for(simulation, **changes):
    """Return a configuration that states the truth about a simulation, lever arm and all."""
    settings = {'gnss_delay': float(simulation.meta['gnss_delay']), 'gnss_lateness': 1.0}
    return exact_config_for(simulation, **{**settings, **changes})


def feed(aligner, simulation, *, fix=True, velocity=True):
    """Give a recording to an aligner in the order of arrival; return the epochs of all updates."""
    epochs = []
    for count, (kind, payload) in enumerate(simulation.messages()):
        if kind == 'imu' or (fix if kind == 'fix' else velocity):
            give(aligner, kind, payload)
        if count % FEED_BLOCK == 0:
            epochs += aligner.update()
    return epochs + aligner.flush()


def aligned(simulation, *, fix=True, velocity=True, **changes):
    """Feed a simulation to an aligner; return it and its epochs."""
    aligner = Aligner(config_for(simulation, **changes))
    return aligner, feed(aligner, simulation, fix=fix, velocity=velocity)


def nanoseconds(times):
    """Return times in seconds as stamps."""
    return np.rint(np.multiply(times, 1e9)).astype(np.int64)


def cut_at(times, gyro, accel, epochs):
    """Return IMU steps between epochs; samples and epochs in seconds."""
    return split_at_epochs(nanoseconds(times), np.hstack([gyro, accel]), nanoseconds(epochs))


class SensorErrors(NamedTuple):
    """Constant errors of gyros and accelerometers: true = measured - matrix @ measured - bias."""

    gyro_bias: np.ndarray
    gyro_matrix: np.ndarray
    accel_bias: np.ndarray
    accel_matrix: np.ndarray

    @staticmethod
    def from_vector(vector):
        """Return the errors in a vector, shape (24,), with the matrices row by row."""
        return SensorErrors(vector[:3], vector[3:12].reshape(3, 3), vector[12:15],
                            vector[15:].reshape(3, 3))


def integrate(steps, noise=Noise(), recent=None):
    """Integrate IMU steps; force and rate at the end have lasted, unless told otherwise."""
    lasting = Recent(*(AGES[:, None] * values[:, -1:] for values in (steps.f, steps.omega)))
    return preintegrate(steps, noise, recent or lasting)


def error_of(attitude, simulation):
    """Error of an attitude as a rotation about east, north, up, radians, shape (3,)."""
    truth = simulation.attitude_at(attitude.stamp_ns)
    return log_so3(matrix_from_quaternion(attitude.quaternion_xyzw) @ truth.T)


def error_deg(attitude, simulation):
    """Angle between an attitude and the truth, degrees."""
    return float(np.degrees(np.linalg.norm(error_of(attitude, simulation))))


def normalised_error(attitude, simulation):
    """Squared error of an attitude over its covariance; 3 on average where that is honest."""
    error = error_of(attitude, simulation)
    return float(error @ np.linalg.solve(attitude.covariance, error))


def check_same(epochs, others):
    """Compare epochs, states and attitudes, but for rounding: a thousandth of a sigma."""
    assert [(e.stamp_ns, e.state) for e in epochs] == [(e.stamp_ns, e.state) for e in others]
    for epoch, other in zip(epochs, others):
        assert (epoch.current is None) == (other.current is None)
        if epoch.current is not None:
            check_same_attitude(epoch.current, other.current)
            check_same_attitude(epoch.initial, other.initial)


def check_same_attitude(one, other):
    away = np.degrees(log_so3(one.C_nb @ other.C_nb.T))
    assert np.all(np.abs(away) < 1e-3 * one.sigma_deg)
    assert np.allclose(one.sigma_deg, other.sigma_deg, rtol=1e-3)


def feed_part(aligner, s, start=0.0, end=1e9):
    """Feed what arrives between two times, in seconds of the recording."""
    origin = int(s.imu_stamps_ns[0])
    epochs = []
    for count, (kind, payload) in enumerate(s.messages()):
        stamp = int(payload[0][-1]) if kind == 'imu' else payload.stamp_ns
        if start <= (stamp - origin) * 1e-9 < end:
            give(aligner, kind, payload)
        if count % 40 == 0:
            epochs += aligner.update()
    return epochs + aligner.update()


def give_all(aligner, s, used=slice(None), force_scale=1.0,
             change=lambda k, kind, message: message):
    """
    Feed a whole recording at once, GNSS first so that nothing of it is late.

    `change` makes another message of the k-th fix or velocity; None leaves it out.
    """
    for k in range(len(s.gnss_stamps_ns)):
        for kind, message in (('fix', s.fix(k)), ('velocity', s.velocity_measurement(k))):
            if (message := change(k, kind, message)) is not None:
                give(aligner, kind, message)
    aligner.add_imu(s.imu_stamps_ns[used], s.gyro[used], force_scale * s.accel[used])
    return aligner.flush()


def turning_car(seed, **options):
    """Simulate a car that turns soon."""
    return simulated('car', imu_grade='mems', duration=40.0, seed=seed, **options)
