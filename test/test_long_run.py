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
"""Hours of epochs, a day of samples: neither memory, orthogonality nor precision is lost."""

from collections import deque
from types import FunctionType, ModuleType

from alignment import config_for, normalised_error, simulated
from ins_align.aligner import Aligner, State
from ins_align.geometry.earth import EARTH_RATE, matrix_earth_turned
from ins_align.geometry.rotation import exp_so3, orthonormalized
from ins_align.imu.prediction import Prediction
from ins_align.results import Attitude
import numpy as np
import pytest
from scipy.stats import chi2

DAY = 86400
SPIN, TILT = np.array([0.0, 0.0, 0.31]), np.array([0.07, -0.05, 0.0])


def attitude(time):
    """Return ``C_nb``, shape (N, 3, 3), of a body that spins about an axis that turns too."""
    # Whole turns are taken off first: what is left of 1e4 radians has lost four digits.
    turns = [rate * np.remainder(time, 2 * np.pi / np.linalg.norm(rate))[:, None]
             for rate in (TILT, SPIN)]
    return exp_so3(turns[0]) @ exp_so3(turns[1])


@pytest.mark.campaign
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


def size_of(thing, seen=None):
    """Return the bytes of all arrays, and the number of all other things, that something holds."""
    seen = set() if seen is None else seen
    if id(thing) in seen or isinstance(thing, (type, ModuleType, FunctionType)):
        return 0
    seen.add(id(thing))
    if isinstance(thing, np.ndarray):
        return thing.nbytes
    if isinstance(thing, dict):
        inside = [*thing.keys(), *thing.values()]
    elif isinstance(thing, (list, tuple, set, deque)):
        inside = list(thing)
    else:
        inside = [getattr(thing, name) for name in (
            *getattr(thing, '__dict__', ()), *getattr(type(thing), '__slots__', ()))]
    return 1 + sum(size_of(part, seen) for part in inside)


@pytest.mark.campaign
def test_an_aligner_of_two_hours_holds_no_more_and_knows_no_less():
    """
    Seven thousand epochs in streets.

    What the aligner holds and how large the sigmas of the attitude now are is in the last forty
    minutes as in the first; the errors stay as large as stated. Rounding that grows would show.
    """
    s = simulated('car', imu_grade='tactical', seed=1, duration=2 * 3600.0, imu_rate=20.0,
                  gnss_rate=1.0)
    aligner = Aligner(config_for(s))
    held, errors, sigmas = [], [], []
    for first in range(0, len(s.gnss_stamps_ns), 5):
        for k in range(first, min(first + 5, len(s.gnss_stamps_ns))):
            aligner.add_fix(s.fix(k))
            aligner.add_velocity(s.velocity_measurement(k))
        now = slice(20 * first, 20 * (first + 5))
        aligner.add_imu(s.imu_stamps_ns[now], s.gyro[now], s.accel[now])
        epochs = aligner.update()
        if first % 60 == 55:
            held.append(size_of(aligner))
            errors.append(normalised_error(epochs[-1].current, s))
            sigmas.append(epochs[-1].current.sigma_deg)
    status = aligner.status()
    assert status.state is State.ALIGNED and status.counts['epochs_used'] > 7_150
    part = len(held) // 3
    assert max(held[-part:]) < 1.1 * max(held[:part])
    early, late = np.mean(sigmas[10:part], axis=0), np.mean(sigmas[-part:], axis=0)
    assert np.all(late < 1.1 * early)
    # Errors a minute apart have much in common: three a time on average, none beyond all bounds.
    assert np.mean(errors[-part:]) < 6.0 and max(errors) < chi2.ppf(1 - 1e-6, 3)


@pytest.mark.campaign
def test_attitude_carried_through_a_day():
    """Two million samples at a rate that stays, against the angle in closed form."""
    rate, period_ns = np.array([0.3, -0.2, 0.5]), 50_000_000
    carried = Prediction(Attitude(0, np.eye(3), np.eye(3)), np.zeros(3),
                         np.zeros((3, 3)), 1e-6, 1e-4, rate)
    for stamp_ns in range(period_ns, DAY * 1_000_000_000 + 1, period_ns):
        carried.carry(stamp_ns, rate)
    assert carried.stamp_ns == DAY * 1_000_000_000
    size = np.linalg.norm(rate)
    truth = exp_so3(rate / size * np.remainder(size * DAY, 2 * np.pi))
    attitude = carried.attitude()
    # The angle itself, 5e4 rad, is known to 1e-11 and no better.
    assert np.abs(attitude.C_nb - truth).max() < 1e-9
    assert np.abs(attitude.C_nb.T @ attitude.C_nb - np.eye(3)).max() < 2e-15
    assert attitude.covariance == pytest.approx((
        1.0 + 1e-8 * DAY + (1e-12 + EARTH_RATE ** 2) * DAY ** 2) * np.eye(3))


def test_the_earth_after_a_day():
    time = np.arange(0, DAY + 1, 60.0)
    turned = matrix_earth_turned(time)
    product = turned.transpose(0, 2, 1) @ turned
    assert np.abs(product - np.eye(3)).max() < 1e-15
    day = 2 * np.pi / EARTH_RATE  # once around
    assert matrix_earth_turned(day) == pytest.approx(np.eye(3), abs=1e-15)
    assert matrix_earth_turned(day / 4) == pytest.approx(
        matrix_earth_turned(day / 8) @ matrix_earth_turned(day / 8), abs=1e-15)
