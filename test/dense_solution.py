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
"""All velocities of a simulation solved at once, with the pieces of the dense reference."""

from ins_align.experiments import dense
from ins_align.experiments.dense import (
    ACCEL_BIAS, ATTITUDE, cumulative, DELAY, GYRO_BIAS, LEVER_ARM, SIZE, START_VELOCITY)
import numpy as np
from scipy.spatial.transform import Rotation


def dense_solution(simulation, lever_arm_std=0.0, delay_std=0.0, iterations=6):
    """
    Gauss-Newton from the truth on.

    Returns C_nb(t0), shape (3, 3), and the covariance of what is estimated; the first three rows
    are the attitude's.
    """
    noise = simulation.imu_noise
    columns, prior = dense.prior_of(noise, False, lever_arm_std, delay_std)
    mean = np.zeros(SIZE)
    mean[LEVER_ARM] = simulation.lever_arm
    x = mean.copy()
    x[GYRO_BIAS], x[ACCEL_BIAS] = simulation.gyro_bias, simulation.accel_bias
    C = simulation.attitude_at(int(simulation.gnss_stamps_ns[0]))
    known = prior.copy()
    known[:3, :3] = 0.0
    for _ in range(iterations):
        path = measured_path(simulation, C, x)
        V = dense.noise_covariance(path, noise, simulation.velocity_covariance)
        H = dense.design_of(path, x[LEVER_ARM])[:, columns]
        y = (measured_velocities(simulation, path) - path.U
             - dense.lever_velocity(path, x[LEVER_ARM]) - x[START_VELOCITY])
        both = dense.whiten(V, np.column_stack([y.ravel(), H]))
        whitened_y, whitened_H = both[:, 0], both[:, 1:]
        P = dense.inverse_of(whitened_H.T @ whitened_H + prior)
        dx = np.zeros(SIZE)
        dx[columns] = P @ (whitened_H.T @ whitened_y + known @ (mean - x)[columns])
        C = Rotation.from_rotvec(dx[ATTITUDE]).as_matrix() @ C
        x = x + dx
        x[ATTITUDE] = 0.0
    return C, P


def measured_path(simulation, C, x):
    """Integrate the IMU from C on without the errors in x, to the instants of measurement."""
    epochs_ns = simulation.gnss_stamps_ns - round(x[DELAY][0] * 1e9)
    grid, at = dense.grid_of(simulation.imu_stamps_ns, epochs_ns)
    time = (grid - grid[0]) * 1e-9
    omega = dense.interpolated(simulation.imu_stamps_ns, simulation.gyro, grid) - x[GYRO_BIAS]
    f = dense.interpolated(simulation.imu_stamps_ns, simulation.accel, grid) - x[ACCEL_BIAS]
    # Angle of each step with the coning term of a rate that is linear in time.
    h = np.diff(time)[:, None]
    steps = Rotation.from_rotvec(h / 2 * (omega[1:] + omega[:-1])
                                 + h * h / 12 * np.cross(omega[:-1], omega[1:])).as_matrix()
    attitude = np.empty((len(time), 3, 3))
    attitude[0] = C
    for k, step in enumerate(steps):
        attitude[k + 1] = attitude[k] @ step
    lla = simulation.lla_deg
    return dense.path_along(time, attitude, omega, f, at,
                            dense.matrices_n0n(lla, lla[0], time[at]), dense.gravity_n(lla),
                            simulation.velocity)


def measured_velocities(simulation, path):
    """Antenna velocity in n0 without what gravitation did, shape (K, 3)."""
    from pyins.earth import gravitation_ecef, RATE
    from pyins.transform import lla_to_ecef

    lla = simulation.lla_deg
    C_en = dense.matrices_en(lla)
    to_n0 = C_en[0].T @ dense.matrices_earth(path.time)
    v_e = (np.einsum('nij,nj->ni', C_en, simulation.velocity)
           + np.cross([0.0, 0.0, RATE], lla_to_ecef(lla)))
    gravitation = np.einsum('nij,nj->ni', to_n0, gravitation_ecef(lla))
    return np.einsum('nij,nj->ni', to_n0, v_e) - cumulative(path.time, gravitation)
