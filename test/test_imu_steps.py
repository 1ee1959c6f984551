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
"""What the steps between epochs and their noise are made of."""

from collections import Counter

from ins_align.config import ImuNoise
from ins_align.imu.buffer import ImuBuffer
from ins_align.imu.noise import GAP_ANGULAR_ACCELERATION, GAP_JERK
import numpy as np
import pytest

SECOND = 1_000_000_000
STATED = 1e-3, 1e-2                     # rad/sqrt(s), m/s/sqrt(s)
STEP = 0.01
EPOCHS = [2 * SECOND, 3 * SECOND + 4_000_000, 4 * SECOND]


def cut(stamps_ns, samples, epochs=EPOCHS, drift=0.0):
    """Cut samples at the epochs behind the first one; return steps, noise, and the counts."""
    counts = Counter()
    buffer = ImuBuffer(0, counts, ImuNoise(*STATED, gyro_bias_std=0.0, accel_bias_std=0.0))
    buffer.add_in_order(stamps_ns, samples[:, :3], samples[:, 3:])
    buffer.settled_ns(last=True)
    buffer.start(epochs[0])
    steps, noise, _ = buffer.cut(epochs[1:], [drift] * (len(epochs) - 1))
    return steps, noise, counts


def steady(step=STEP, seconds=5.0):
    stamps = np.rint(np.arange(0.0, seconds, step) * SECOND).astype(np.int64)
    return stamps, np.tile([0.1, 0.2, -0.1, 1.0, 2.0, 9.5], (stamps.size, 1))


def test_noise_is_the_stated_one_where_nothing_is_wrong():
    _, noise, counts = cut(*steady())
    assert np.allclose(noise.angle_random_walk, STATED[0])
    assert np.allclose(noise.velocity_random_walk, STATED[1])
    assert not np.any(noise.gyro_excess) and not np.any(noise.accel_excess)
    assert not counts['imu_gap'] and not counts['imu_spike'] and not counts['imu_saturated']


@pytest.mark.parametrize('varies, differs', [(0.0, 0.0), (0.3, 0.0), (0.0, 0.6), (0.3, 0.6)])
def test_a_gap_has_the_noise_of_what_the_motion_may_do_in_it(varies, differs):
    """Its noise density squared is the variance of the mean rate in it, times its length."""
    stamps, samples = steady()
    seconds = stamps / SECOND
    samples += (varies * np.sin(20 * np.pi * seconds) + differs * (seconds >= 2.6))[:, None]
    kept = (stamps <= 2.5 * SECOND) | (stamps >= 2.6 * SECOND)
    around = np.var(samples[kept & (seconds >= EPOCHS[0] / SECOND - 0.5)
                            & (seconds <= EPOCHS[1] / SECOND)], axis=0)[0]
    steps, noise, counts = cut(stamps[kept], samples[kept])
    gap = np.isclose(steps.dt, 0.1)
    assert np.count_nonzero(gap) == counts['imu_gap'] == 1
    for density, stated, most in (
            (noise.angle_random_walk, STATED[0], GAP_ANGULAR_ACCELERATION),
            (noise.velocity_random_walk, STATED[1], GAP_JERK)):
        density = np.broadcast_to(density, gap.shape)
        assert np.allclose(density[~gap], stated)
        variance = (most * 0.1) ** 2 + around + 0.25 * differs ** 2
        assert density[gap] == pytest.approx(np.sqrt(stated ** 2 + 0.1 * variance), rel=0.02)


def test_stamps_that_jitter_have_the_noise_of_what_changes_meanwhile():
    """A stamp off by a sigma of t makes a sample err by its slope times t: white noise."""
    stamps, samples = steady(seconds=12.0)
    samples[:, 2] = 0.8 * stamps * 1e-9                      # rad/s, 0.8 rad/s^2
    sigma = 2e-4
    late = np.rint(sigma * SECOND * np.random.default_rng(1).standard_normal(stamps.size))
    _, noise, _ = cut(stamps + late.astype(np.int64), samples, [2 * SECOND, 11 * SECOND])
    inner = noise.angle_random_walk[0, 5:-5]
    expected = 0.8 / np.sqrt(3) * sigma * np.sqrt(STEP)      # mean over the axes
    assert np.median(np.sqrt(inner ** 2 - STATED[0] ** 2)) == pytest.approx(expected, rel=0.2)


@pytest.mark.parametrize('times, found', [(1.1, False), (3.0, True)])
@pytest.mark.parametrize('sensor', (0, 1))
def test_noise_beyond_the_stated_one_is_measured(sensor, times, found):
    stamps, samples = steady(seconds=42.0)
    columns = slice(3 * sensor, 3 * sensor + 3)
    samples[:, columns] += times * STATED[sensor] / np.sqrt(STEP) * np.random.default_rng(
        2).standard_normal((stamps.size, 3))
    _, noise, _ = cut(stamps, samples, [2 * SECOND, 41 * SECOND])
    excess = (noise.accel_excess if sensor else noise.gyro_excess).item()
    expected = STATED[sensor] * np.sqrt(times ** 2 - 1) if found else 0.0
    assert excess == pytest.approx(expected, rel=0.05)
    assert not np.any(noise.gyro_excess if sensor else noise.accel_excess)


def test_noise_is_measured_over_short_intervals_too():
    """Five samples between epochs do not tell it, the half second before does."""
    stamps, samples = steady(seconds=42.0)
    samples[:, :3] += 3.0 * STATED[0] / np.sqrt(STEP) * np.random.default_rng(2).standard_normal(
        (stamps.size, 3))
    _, noise, _ = cut(stamps, samples, list(range(2 * SECOND, 41 * SECOND, SECOND // 20)))
    assert np.all(noise.gyro_excess > STATED[0])
    assert np.mean(noise.gyro_excess ** 2) == pytest.approx(8.0 * STATED[0] ** 2, rel=0.1)


def test_gravity_at_an_unknown_place_is_noise_of_the_force():
    _, noise, _ = cut(*steady(), drift=0.03)
    assert np.allclose(noise.velocity_random_walk, np.hypot(STATED[1], 0.03))
    assert np.allclose(noise.angle_random_walk, STATED[0])


def test_spikes_are_counted_once_and_replaced():
    stamps, samples = steady()
    spoilt = samples.copy()
    for place in (230, 310, 380, 401):                       # the last one is still to come
        spoilt[place, :3] += 5.0
    steps, _, counts = cut(stamps, spoilt)
    assert counts['imu_spike'] == 3
    assert np.allclose(steps.omega, samples[0, :3])
    assert np.allclose(steps.f, samples[0, 3:])


def test_the_end_of_the_range_is_noise_of_the_steps_before():
    """Where the gyro about z stops at 2 rad/s nobody knows how far it went: half as much again."""
    stamps, samples = steady(seconds=8.0)
    random = np.random.default_rng(3)
    samples += 1e-4 * random.standard_normal(samples.shape)
    samples[:, 2] = np.minimum(4.0 * np.sin(2 * np.pi * stamps * 1e-9), 2.0)
    steps, noise, counts = cut(stamps, samples, [3 * SECOND + 3_000_000, 4 * SECOND])
    at_end = np.flatnonzero((samples[:, 2] == 2.0) & (stamps > EPOCHS[0] + SECOND)
                            & (stamps < 4 * SECOND))
    assert counts['imu_saturated'] > at_end.size
    density = np.broadcast_to(noise.angle_random_walk, steps.dt.shape)[0]
    begin = np.concatenate([[0.0], np.cumsum(steps.dt[0])[:-1]]) + 3.003
    noisy = begin[density > 10 * STATED[0]]
    assert np.allclose(noisy, stamps[at_end] * 1e-9)
    seconds = at_end.size * STEP
    assert np.sum(density[density > 10 * STATED[0]] ** 2) * STEP == pytest.approx(
        (0.5 * 2.0 * seconds) ** 2, rel=0.1)
