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
"""Motion just before an epoch against the integral of the motion itself."""

from alignment import nanoseconds
from ins_align.imu.recent import AGE_COUNT, AGES, interpolated, recent_motion, smoothed
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

MS = 1_000_000
PERIOD = 0.55           # s, of a walker's steps


def force(t):
    """In the body frame, m/s^2, as a walker's."""
    w = 2 * np.pi / PERIOD
    return np.stack([2.0 + np.sin(3 * t), 3.0 * np.cos(w * t), 9.8 + 3.0 * np.sin(w * t)], axis=-1)


def rate(t):
    w = 2 * np.pi / PERIOD
    return np.stack([0.5 * np.sin(w * t), 0.4 * np.cos(8 * t), 0.6 + 0.3 * np.sin(5 * t)], axis=-1)


def before(epoch, age):
    """Integral and double integral of the force over the ages, and the body's frame then."""
    def change(s, x):
        C = x[6:].reshape(3, 3)
        skewed = np.cross(rate(np.array(epoch - s)), np.eye(3)).T
        return np.concatenate([C @ force(np.array(epoch - s)), x[:3], (-C @ skewed).ravel()])

    start = np.concatenate([np.zeros(6), np.eye(3).ravel()])
    x = solve_ivp(change, (0.0, age), start, rtol=1e-10, atol=1e-12).y[:, -1]
    return x[:3], x[3:6], x[6:].reshape(3, 3)


def motion(first_ms, epochs_ms, step_ms=5):
    stamps = np.arange(first_ms, 801, step_ms)
    return recent_motion(stamps * MS, measured(stamps), np.array(epochs_ms) * MS)


def measured(stamps_ms):
    return np.hstack([rate(stamps_ms * 1e-3), force(stamps_ms * 1e-3)])


@pytest.mark.parametrize('age', (0.01, 0.06, 0.1, 0.2, 0.29))
def test_it_leads_back_to_the_motion_of_a_moment_ago(age):
    epochs_ms = [300, 423, 700]
    recent = motion(-200, epochs_ms)
    _, gained, moved = interpolated(recent.gained, age)
    turning, turn, _ = interpolated(recent.turned, age)
    calm = smoothed(recent.gained, age)[0]
    for k, epoch in enumerate(np.array(epochs_ms) * 1e-3):
        velocity, distance, C = before(epoch, age)
        assert np.allclose(gained[k], velocity, atol=2e-3)
        assert np.allclose(moved[k], distance, atol=5e-4)
        assert np.allclose(Rotation.from_rotvec(-turn[k]).as_matrix(), C, atol=1e-3)
        # The change of a rotation vector is the rate but for its turn (Bortz).
        found = turning[k] + 0.5 * np.cross(turn[k], turning[k])
        assert np.allclose(found, rate(np.array(epoch - age)), atol=0.03)
        assert np.allclose(calm[k], C @ force(np.array(epoch - age)), atol=0.25)


def test_at_the_epoch_itself_nothing_has_been_gained():
    recent = motion(-200, [300])
    for integrals in (recent.gained, recent.turned):
        value, gained, moved = interpolated(integrals, 0.0)
        assert not np.any(gained) and not np.any(moved)
    assert np.allclose(value, rate(np.array([0.3])), atol=0.03)


def test_it_goes_on_a_little_beyond_the_epoch():
    recent = motion(-200, [300])
    for age in (-0.01, -0.02):
        velocity, _, _ = before(0.3, age)
        assert np.allclose(interpolated(recent.gained, age)[1][0], velocity, atol=0.1 * abs(age))


def test_forces_and_rates_that_last():
    stamps = np.arange(-201, 2) * 10 * MS
    recent, turning = (
        recent_motion(stamps, np.tile(sample, (stamps.size, 1)), np.array([0]))
        for sample in ([0.0, 0.0, 0.0, 1.0, 2.0, 9.8], [0.1, 0.0, -0.2, 0.0, 0.0, 0.0]))
    for age in (-0.1, 0.0, 0.07, 0.3):
        value, gained, moved = interpolated(recent.gained, age)
        assert np.allclose(value, [[1.0, 2.0, 9.8]])
        assert np.allclose(gained, [[age, 2 * age, 9.8 * age]])
        assert np.allclose(moved, [[age ** 2 / 2, age ** 2, 4.9 * age ** 2]])
        assert np.allclose(interpolated(turning.turned, age)[1], [[0.1 * age, 0.0, -0.2 * age]])
        calm, change = smoothed(recent.gained, age)
        assert np.allclose(calm, value) and np.allclose(change, 0.0, atol=1e-9)


@pytest.mark.parametrize('age', (-0.05, 0.0, 0.013, 0.06, 0.14, 0.22, 0.3))
def test_a_cubic_is_followed_exactly(age):
    """Of an integral a t + b t^2 + c t^3: value a + 2 b t + 3 c t^2, change 2 b + 6 c t."""
    a, b, c = np.array([[1.0, 2.0, 9.8], [3.0, -1.0, 0.5], [-7.0, 4.0, 5.0]])
    integrals = (a * AGES[:, None] + b * AGES[:, None] ** 2 + c * AGES[:, None] ** 3)[None]
    value, change = a + 2 * b * age + 3 * c * age ** 2, 2 * b + 6 * c * age
    for found, expected in zip(smoothed(integrals, age), (value, change)):
        assert np.allclose(found, expected, atol=1e-9)
    found, integral, _ = interpolated(integrals, age)
    assert np.allclose(found, value, atol=1e-9)
    assert np.allclose(integral, a * age + b * age ** 2 + c * age ** 3, atol=1e-12)


@pytest.mark.parametrize('age', np.linspace(-0.1, 0.3, 33))
def test_noise_of_the_integrals_does_not_grow_where_they_are_followed(age):
    """A cubic goes on by one of its own steps at most: 4 (at age 0, which is 0), -6, 4, -1."""
    squares = 0.0
    for rung in range(AGE_COUNT):
        one = np.zeros((1, AGE_COUNT, 1))
        one[0, rung] = 1.0
        squares += interpolated(one, age)[1].item() ** 2
    assert squares <= 6 ** 2 + 4 ** 2 + 1 + 1e-9


def test_where_samples_begin_or_were_silent_their_mean_goes_on():
    whole, begun = motion(-200, [300]), motion(155, [300])
    known = AGES < 0.146
    assert np.allclose(begun.gained[0, known], whole.gained[0, known])
    mean = begun.gained[0, known][-1] / AGES[known][-1]
    assert np.allclose(np.diff(begun.gained[0, ~known], axis=0), 0.025 * mean, rtol=0.1, atol=0.02)
    stamps = np.concatenate([np.arange(-900, -600, 5), np.arange(155, 801, 5)])
    gap = recent_motion(stamps * MS, measured(stamps), np.array([300]) * MS)
    assert np.allclose(gap.gained, begun.gained) and np.allclose(gap.turned, begun.turned)
    at_first = motion(300, [300])
    assert np.allclose(at_first.gained[0], AGES[:, None] * force(np.array(0.3)), rtol=0.02,
                       atol=0.03)


def test_vibration_hardly_reaches_the_smooth_force():
    r = np.random.default_rng(3)
    stamps = np.arange(-2, 63) * 0.005
    shaken = 0.0
    for _ in range(50):
        phase = r.uniform(0, 2 * np.pi, 3)
        accel = [0.0, 0.0, 9.8] + 5.0 * np.cos(2 * np.pi * 67.0 * stamps[:, None] + phase)
        recent = recent_motion(nanoseconds(stamps), np.hstack([np.zeros((stamps.size, 3)), accel]),
                               nanoseconds([0.305]))
        shaken = max(shaken, np.abs(smoothed(recent.gained, 0.1)[0] - [0.0, 0.0, 9.8]).max())
    # Of what a single sample shows, each 50 ms keep 2 / (2 pi 67 Hz 0.05 s) at most, and two
    # parts of them count half each.
    assert shaken < 5.0 * 2 / (2 * np.pi * 67.0 * 0.05)


def test_one_epoch_is_the_same_with_others_to_the_bit():
    together = motion(-200, [300, 423, 700])
    alone = motion(-200, [423])
    assert np.array_equal(together.gained[1], alone.gained[0])
    assert np.array_equal(together.turned[1], alone.turned[0])
    for age in (0.0, 0.07, 0.2):
        for ours, its in zip(interpolated(together.gained[1:], age),
                             interpolated(alone.gained, age)):
            assert np.array_equal(ours[0], its[0])
