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
"""What a calibration leaves: the noise that it becomes, and the sigma that it makes honest."""

from dataclasses import replace
import math

from alignment import normalised_error, simulated
from ins_align.aligner import Aligner
from ins_align.config import Config, PRESETS
from ins_align.g_sensitivity import CALM_TIME, G_SENSITIVITY, GSensitivity, STEADY_TIME
from ins_align.recent import Recent
from ins_align.simulation import feed
from ins_align.unknowns import ACCEL_ERRORS, GYRO_MISALIGNMENT
import numpy as np
import pytest
from scipy.stats import chi2

SCALE = 0.01
DT = 0.02
GRAVITY = np.array([0.0, 0.0, 9.8])


def noise_of(force, scale=SCALE):
    """Noise of a force given at steps of DT, shape (K, 3)."""
    return GSensitivity(scale).noise(np.r_[0.0, np.full(len(force) - 1, DT)],
                                     Recent.steady(force, np.zeros_like(force)))


def still(seconds):
    return np.zeros((round(seconds / DT), 3))


def test_a_push_that_is_soon_over_leaves_the_spread_of_its_error():
    push = np.array([4.0, 3.0, 0.0])            # m/s
    noise = noise_of(GRAVITY + np.concatenate([still(600.0), [push / DT], still(300.0)]))
    a, b = 1 / CALM_TIME, 1 / STEADY_TIME
    # Integral of (a exp(-a t) - b exp(-b t))^2, times 2 / a.
    expected = 2 / a * (a / 2 - 2 * a * b / (a + b) + b / 2)
    assert 0.8 < expected < 1.0
    assert np.sum(noise ** 2) * DT == pytest.approx(expected * (G_SENSITIVITY * SCALE * 5.0) ** 2,
                                                    rel=0.02)


@pytest.mark.parametrize('frequency', (0.0, 2.0, 10.0))
def test_a_steady_force_and_a_swing_leave_next_to_nothing(frequency):
    time = DT * np.arange(3000)[:, None]
    noise = noise_of(GRAVITY + np.cos(2 * np.pi * frequency * time) * [0.3, 0.0, 1.5])
    assert noise.max() < 0.06 * G_SENSITIVITY * SCALE * math.sqrt(2 * CALM_TIME) * 1.5


def test_nothing_is_added_where_scale_factors_are_exact():
    force = GRAVITY + np.random.default_rng(0).standard_normal((50, 3))
    assert np.all(noise_of(force, scale=0.0) == 0.0)


@pytest.mark.parametrize('scenario, grade', [('car', 'mems'), ('launch', 'mems'),
                                             ('launch', 'tactical')])
def test_sigma_is_honest_with_an_imu_as_calibrated_as_stated(scenario, grade):
    scale_std = PRESETS[grade].gyro_scale_std
    errors = []
    for seed in range(6):
        truth = simulated(scenario, imu_grade=grade, seed=seed, duration=60.0)
        r = np.random.default_rng([5, seed])
        gyro, accel, by_force = (share * scale_std * r.standard_normal((3, 3)) for share in (
            GYRO_MISALIGNMENT, ACCEL_ERRORS, G_SENSITIVITY))
        worse = replace(truth, gyro=truth.gyro + truth.gyro @ gyro.T + truth.accel @ by_force.T,
                        accel=truth.accel + truth.accel @ accel.T)
        config = Config(imu_grade=grade, lever_arm=tuple(truth.lever_arm))
        epochs = feed(Aligner(config), worse)
        assert epochs[-1].state.value == 'ALIGNED'
        errors.append(normalised_error(epochs[-1].current, truth))
    # 5 to 44 times as much where such errors are not counted.
    assert sum(errors) < chi2.ppf(0.99, 3 * len(errors))
