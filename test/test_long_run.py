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
"""A day of intervals in a chain: neither orthogonality nor precision is lost."""

from ins_align.earth import EARTH_RATE, matrix_earth_turned
from ins_align.prediction import Prediction
from ins_align.preintegration import Noise, preintegrate, SensorErrors, split_at_epochs
from ins_align.rotation import exp_so3, orthonormalized, skew
from ins_align.whitening import Chain
import numpy as np
import pytest

DAY = 86400
SPIN, TILT = np.array([0.0, 0.0, 0.31]), np.array([0.07, -0.05, 0.0])


def attitude(time):
    """Return ``C_nb``, shape (N, 3, 3), of a body that spins about an axis that turns too."""
    # Whole turns are taken off first: what is left of 1e4 radians has lost four digits.
    turns = [rate * np.remainder(time, 2 * np.pi / np.linalg.norm(rate))[:, None]
             for rate in (TILT, SPIN)]
    return exp_so3(turns[0]) @ exp_so3(turns[1])


def test_chained_intervals_of_a_day():
    step = 0.2
    C = np.eye(3)
    worst = 0.0
    for hour in range(24):
        time = np.arange(hour * 18000, (hour + 1) * 18000 + 1) * step
        C_nb = attitude(time)
        for R in C_nb[:-1].transpose(0, 2, 1) @ C_nb[1:]:
            C = orthonormalized(C @ R)
        worst = max(worst, np.abs(C - C_nb[-1]).max())
        assert np.abs(C.T @ C - np.eye(3)).max() < 2e-15
        assert np.linalg.det(C) == pytest.approx(1.0, abs=2e-15)
    # Rounding wanders: 432000 steps of 1e-16 each come to 1e-13, what drifts to 1e-10.
    assert worst < 1e-12


def test_preintegrated_intervals_chained_through_a_day():
    """IMU samples of a rate and a force that stay, against their integrals in closed form."""
    rate, force = np.array([0.3, -0.2, 0.5]), np.array([1.0, 9.0, -3.0])
    hour_ns, epoch_ns, sample_ns = 3600 * 10 ** 9, 10 ** 9, 10 ** 8
    chain = Chain.start()
    for hour in range(24):
        # Samples between the epochs, not on them, and two before and after.
        start_ns = hour * hour_ns
        stamps = start_ns + np.arange(-sample_ns * 3 // 2, hour_ns + 2 * sample_ns, sample_ns)
        epochs = start_ns + np.arange(0, hour_ns + 1, epoch_ns)
        steps = split_at_epochs(stamps, np.tile(rate, (stamps.size, 1)),
                                np.tile(force, (stamps.size, 1)), epochs, unit=1e-9)
        nothing = np.zeros((epochs.size - 1, 1))
        chain = chain.extended(preintegrate(steps, SensorErrors.none(),
                                            Noise(*[nothing] * 4))).at(-1)
    size = np.linalg.norm(rate)
    axis = rate / size
    along, around = np.outer(axis, axis), skew(axis)
    across = np.eye(3) - along
    angle = np.remainder(size * DAY, 2 * np.pi)
    sine, verse = np.sin(angle) / size, (1 - np.cos(angle)) / size
    R = along + np.cos(angle) * across + np.sin(angle) * around
    v = (DAY * along + sine * across + verse * around) @ force
    p = (DAY ** 2 / 2 * along + verse / size * across + (DAY - sine) / size * around) @ force
    assert np.abs(chain.R - R).max() < 1e-9         # the angle is known to 1e-11
    assert np.abs(chain.R.T @ chain.R - np.eye(3)).max() < 1e-11
    assert np.linalg.norm(chain.v - v) < 1e-10 * np.linalg.norm(v)
    assert np.linalg.norm(chain.p - p) < 1e-10 * np.linalg.norm(p)


def test_attitude_carried_through_a_day():
    """Sixteen million samples at a rate that stays, against the angle in closed form."""
    rate, period_ns, lot = np.array([0.3, -0.2, 0.5]), 5_000_000, 1_728_000
    carried = Prediction(0, np.eye(3), np.eye(3), np.zeros(3), np.zeros((3, 3)), 1e-4, 1e-12,
                         rate)
    gyro = np.broadcast_to(rate, (lot, 3))
    stamps = np.arange(1, lot + 1) * period_ns
    for k in range(10):
        carried.carry_many(stamps + k * lot * period_ns, gyro)
    assert carried.stamp_ns == DAY * 1_000_000_000
    size = np.linalg.norm(rate)
    truth = exp_so3(rate / size * np.remainder(size * DAY, 2 * np.pi))
    C_nb, covariance = carried.matrices()
    # The angle itself, 5e4 rad, is known to 1e-11 and no better.
    assert np.abs(C_nb - truth).max() < 1e-9
    assert np.abs(C_nb.T @ C_nb - np.eye(3)).max() < 2e-15
    assert covariance == pytest.approx((1.0 + 1e-8 * DAY + 1e-12 * DAY ** 2) * np.eye(3))


def test_the_earth_after_a_day():
    time = np.arange(0, DAY + 1, 60.0)
    turned = matrix_earth_turned(time)
    product = turned.transpose(0, 2, 1) @ turned
    assert np.abs(product - np.eye(3)).max() < 1e-15
    day = 2 * np.pi / EARTH_RATE  # once around
    assert matrix_earth_turned(day) == pytest.approx(np.eye(3), abs=1e-15)
    assert matrix_earth_turned(day / 4) == pytest.approx(
        matrix_earth_turned(day / 8) @ matrix_earth_turned(day / 8), abs=1e-15)
