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
"""Attitudes carried on with gyros, against SciPy's rotations."""

from copy import copy

from ins_align.config import ImuNoise
from ins_align.geometry.earth import EARTH_RATE
from ins_align.imu.noise import GAP_ANGULAR_ACCELERATION
from ins_align.imu.prediction import Follower, MAX_GAP_NS, Prediction
from ins_align.results import Attitude, Epoch, State
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

STEP_NS = 5_000_000
BIAS = np.array([0.02, -0.03, 0.01])
MATRIX = np.array([[0.01, 2e-3, 0.0], [3e-3, -0.01, 1e-3], [-4e-3, 0.0, 5e-3]])
RANDOM = np.random.default_rng(7)
GYRO = RANDOM.normal(scale=2.0, size=(400, 3))
STAMPS = np.cumsum(RANDOM.integers(1, 2 * STEP_NS, 400))
RATE = (0.5, -1.0, 2.0)
START = Rotation.from_rotvec([0.3, -0.2, 2.5])
COVARIANCE = np.array([[4.0, 0.5, 0.2], [0.5, 3.0, -0.1], [0.2, -0.1, 9.0]]) * 1e-6


def predicted(stamp_ns, C_nb, bias, matrix, bias_std, noise, rates):
    attitude, zero = Attitude(stamp_ns, C_nb, COVARIANCE), np.zeros(3)
    epoch = Epoch(stamp_ns, 0.0, State.ALIGNED, attitude, attitude, zero, bias, zero,
                  np.full(3, bias_std), matrix)
    return Prediction(epoch, ImuNoise(noise, 0.0, 0.0, 0.0),
                      np.atleast_2d(rates), 1e-9 * STEP_NS)


def prediction():
    return predicted(0, START.as_matrix(), BIAS, MATRIX, 1e-3, 2e-3, np.array(RATE))


def still(stamp_ns, rate):
    """Return the attitude with its axes in ENU, for gyros without errors."""
    return predicted(stamp_ns, np.eye(3), np.zeros(3), np.zeros((3, 3)), 0.0, 0.0, rate)


def truth(count):
    """Return the attitude after so many samples."""
    mean = 0.5 * (np.vstack([RATE, GYRO[:-1]]) + GYRO)
    turns = (mean - mean @ MATRIX.T - BIAS) * (np.diff(STAMPS, prepend=0) * 1e-9)[:, None]
    attitude = START
    for turn in turns[:count]:
        attitude = attitude * Rotation.from_rotvec(turn)
    return attitude.as_matrix()


def propagate_all(carried, stamps, gyro):
    """Propagate over many samples."""
    assert all(carried.propagate(*sample) for sample in zip(stamps.tolist(), gyro.tolist()))


@pytest.mark.parametrize('count', [0, 1, 2, 3, 37, 400])
def test_rotations_are_those_of_scipy(count):
    carried = prediction()
    propagate_all(carried, STAMPS[:count], GYRO)
    assert carried.stamp_ns == (STAMPS[count - 1] if count else 0)
    assert carried.attitude().C_nb == pytest.approx(truth(count), abs=1e-12)
    assert carried.quaternion_xyzw[3] >= 0.0
    assert np.linalg.norm(carried.quaternion_xyzw) == pytest.approx(1.0, abs=1e-15)


def test_a_rate_that_swings_is_followed():
    """To and fro about one axis, for which the angle is known, up to where the rate is largest."""
    swing, frequency, period = 3.0, 2 * np.pi * 2.0, 0.01
    stamps = np.arange(1, 1013) * 10_000_000
    gyro = np.outer(swing * np.sin(frequency * stamps * 1e-9), [0.0, 0.6, 0.8])
    carried = still(0, np.zeros(3))
    propagate_all(carried, stamps, gyro)
    angle = swing / frequency * (1 - np.cos(frequency * stamps[-1] * 1e-9))
    turned = Rotation.from_quat(carried.quaternion_xyzw).as_rotvec() @ [0.0, 0.6, 0.8]
    # The rate at the end of each step alone would be off by half a step of the largest rate.
    assert abs(turned - angle) < 0.05 * 0.5 * period * swing


def test_covariance_grows_with_the_noise_of_the_gyros():
    carried = prediction()
    assert carried.attitude().covariance == pytest.approx(COVARIANCE)
    propagate_all(carried, STAMPS, GYRO)
    seconds = STAMPS[-1] * 1e-9
    drift = 4e-6 * seconds + (1e-6 + EARTH_RATE ** 2) * seconds ** 2
    assert carried.attitude().covariance == pytest.approx(COVARIANCE + drift * np.eye(3))


def test_what_it_may_have_turned_in_a_gap_is_not_known():
    """Rates of 0.4 and 0.6 rad/s before it, of 0.5 and 1.1 at its ends."""
    carried = predicted(0, np.eye(3), np.zeros(3), np.zeros((3, 3)), 0.0, 1e-4,
                        [[0.0, 0.0, 0.4], [0.0, 0.0, 0.6]] * 50)
    sigmas = []
    for step, rate in ((1, 0.5), (2, 0.5), (3, 0.5), (63, 1.1), (64, 1.1)):
        assert carried.propagate(STEP_NS * step, (0.0, 0.0, rate))
        sigmas.append(np.sqrt(np.diag(carried.attitude().covariance)))
    rate = np.sqrt((0.1 ** 2 + 0.3 ** 2) / 3)
    may_have_turned = 0.3 * np.hypot(rate, 0.3 * GAP_ANGULAR_ACCELERATION)      # rad, 3.3 deg
    assert np.max(sigmas[2]) < 0.06 * may_have_turned
    assert np.array(sigmas[3:]) == pytest.approx(may_have_turned, rel=0.01)


def test_what_is_old_or_broken_changes_nothing():
    carried = prediction()
    carried.propagate(STEP_NS, (0.1, 0.2, 0.3))
    before = carried.quaternion_xyzw
    for stamp_ns, x in ((STEP_NS, 1.0), (0, 1.0), (2 * STEP_NS, float('nan')),
                        (2 * STEP_NS, float('inf')), (2 * STEP_NS, -1e300)):
        assert not carried.propagate(stamp_ns, (0.0, x, 0.0))
    assert (carried.stamp_ns, carried.quaternion_xyzw) == (STEP_NS, before)


def test_follower_catches_up_with_predictions_that_come_late():
    follower = Follower()
    slow = prediction()
    for k, (stamp_ns, gyro) in enumerate(zip(STAMPS.tolist(), GYRO.tolist())):
        now = follower.follow(stamp_ns, gyro)
        assert (now is None) == (k <= 60)
        if now is not None:
            assert now.stamp_ns == stamp_ns
        if k % 20 == 0 and k >= 40:  # a prediction up to forty samples ago
            propagate_all(slow, STAMPS[max(k - 60, 0):k - 40], GYRO[max(k - 60, 0):k - 40])
            follower.adopt(copy(slow))
    assert now.attitude().C_nb == pytest.approx(truth(400), abs=1e-12)


def test_follower_knows_which_round_of_a_loop_it_is_in():
    follower = Follower()
    for _ in range(2):
        for stamp_ns in range(STEP_NS, 100 * STEP_NS, STEP_NS):
            assert follower.follow(stamp_ns, (0.0, 0.0, 1.0)) is None
    follower.adopt(still(90 * STEP_NS, np.array([0.0, 0.0, 1.0])))
    now = follower.follow(100 * STEP_NS, (0.0, 0.0, 1.0))
    assert Rotation.from_quat(now.quaternion_xyzw).as_rotvec() == pytest.approx([0, 0, 0.05])


def test_follower_has_nothing_where_nothing_is_known():
    follower = Follower()
    follower.adopt(prediction())  # it stands at a sample that has not been seen
    assert follower.follow(STEP_NS, (0.0, 0.0, 0.0)) is None
    beginning = prediction()
    beginning.propagate(STEP_NS, (0.0, 0.0, 0.0))
    follower.adopt(beginning)
    assert follower.follow(2 * STEP_NS, (0.0, 0.0, 0.0)) is not None
    assert follower.follow(2 * STEP_NS, (0.0, 0.0, 0.0)) is None  # there twice
    assert follower.follow(3 * STEP_NS, (0.0, 0.0, 0.0)) is not None
    # What it did while samples were missing nobody knows.
    late = 4 * STEP_NS + MAX_GAP_NS
    assert follower.follow(late, (0.0, 0.0, 0.0)) is None
    assert follower.follow(late + STEP_NS, (0.0, 0.0, 0.0)) is None
    follower.adopt(None)
    assert follower.follow(late + 2 * STEP_NS, (0.0, 0.0, 0.0)) is None
