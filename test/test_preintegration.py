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
"""Preintegration against quadrature of closed-form motion, re-integration and Monte Carlo."""

from dataclasses import replace

from alignment import cut_at, integrate, nanoseconds, SensorErrors
from ins_align.imu.noise import white_noise
from ins_align.imu.preintegration import Noise, Steps
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

RATE = 100.0
NOISE = Noise(1e-3, 1e-2)     # rad/sqrt(s), m/s/sqrt(s)


def omega_of(t):
    """Angular rate of a lively vehicle with coning, rad/s, shape (..., 3)."""
    t = np.asarray(t, float)
    return np.stack([0.5 * np.sin(2.1 * t), 0.4 * np.cos(1.7 * t + 0.3),
                     0.6 + 0.2 * np.sin(0.9 * t)], axis=-1)


def force_of(t):
    """Specific force with sculling, m/s^2, shape (..., 3)."""
    t = np.asarray(t, float)
    return np.stack([2.0 * np.sin(1.3 * t), 1.5 * np.cos(2.1 * t), 9.8 + np.sin(2.9 * t)], axis=-1)


def exact(start, end):
    """Attitude, velocity, position by a high-order integrator from `start` to `end`."""
    def derivative(t, y):
        R = y[:9].reshape(3, 3)
        w = omega_of(t)
        wx = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(R @ wx).ravel(), R @ force_of(t), y[9:12]])

    y0 = np.concatenate([np.eye(3).ravel(), np.zeros(6)])
    y = solve_ivp(derivative, (start, end), y0, method='DOP853', rtol=1e-12, atol=1e-13).y[:, -1]
    return y[:9].reshape(3, 3), y[9:12], y[12:]


def samples(duration, rate=RATE, jitter=0.0, seed=0):
    """Instants around [0, duration] with margin, and what perfect sensors say at them."""
    index = np.arange(-3, int(duration * rate) + 4, dtype=float)
    index += jitter * np.random.default_rng(seed).uniform(-1, 1, index.size)
    stamps = index / rate
    return stamps, omega_of(stamps), force_of(stamps)


def steady_samples(duration):
    """Return samples of a rate and a force that stay."""
    stamps, gyro, accel = samples(duration)
    return stamps, 0 * gyro + [0.3, -0.2, 0.5], 0 * accel + [1.0, 2.0, 9.0]


def integrated(epochs, rate=RATE, jitter=0.0, errors=np.zeros(24)):
    stamps, gyro, accel = samples(epochs[-1], rate, jitter)
    return integrate(cut_at(stamps, *without(errors, gyro, accel), epochs), NOISE)


def without(errors, gyro, accel):
    """Take errors, shape (24,), off what was measured."""
    errors = SensorErrors.from_vector(errors)
    return (gyro - gyro @ errors.gyro_matrix.T - errors.gyro_bias,
            accel - accel @ errors.accel_matrix.T - errors.accel_bias)


def chained(interval):
    """Attitude, velocity, position over all intervals, the plain way."""
    R, v, p = np.eye(3), np.zeros(3), np.zeros(3)
    for k, duration in enumerate(interval.duration):
        p = p + v * duration + R @ interval.p[k]
        v = v + R @ interval.v[k]
        R = R @ interval.R[k]
    return R, v, p


def angle(R_1, R_2):
    return Rotation.from_matrix(R_1 @ R_2.T).magnitude()


@pytest.mark.parametrize('jitter', (0.0, 0.4))
def test_integrals_are_those_of_the_motion(jitter):
    R, v, p = exact(0.0, 10.0)
    interval = integrated([0.0, 10.0], jitter=jitter)
    assert interval.duration[0] == pytest.approx(10.0, abs=1e-12)
    assert angle(interval.R[0], R) < 2e-7
    assert np.allclose(interval.v[0], v, atol=2e-6)
    assert np.allclose(interval.p[0], p, atol=2e-4)
    magnitudes = np.linalg.norm(force_of(np.linspace(0.0, 10.0, 10001)), axis=1)
    assert interval.force[0] == pytest.approx(np.mean(magnitudes), rel=1e-3)


def test_error_falls_faster_than_the_square_of_the_step():
    R, v, _ = exact(0.0, 2.0)
    errors = []
    for rate in (25.0, 50.0, 100.0):
        interval = integrated([0.0, 2.0], rate=rate)
        errors.append([angle(interval.R[0], R), np.linalg.norm(interval.v[0] - v)])
    errors = np.array(errors)
    assert np.all(errors[:-1] / errors[1:] > 5.0)


def test_constant_rate_and_force_in_closed_form():
    w, f, t = 1.3, np.array([2.0, 0.0, 9.8]), 4.0
    stamps = np.arange(-2, 43) * 0.1
    steps = cut_at(stamps, np.tile([0.0, 0.0, w], (45, 1)), np.tile(f, (45, 1)), [0.0, t])
    interval = integrate(steps, NOISE)
    assert np.allclose(interval.R[0], Rotation.from_rotvec([0.0, 0.0, w * t]).as_matrix(),
                       atol=1e-13)
    expected = [2.0 * np.sin(w * t) / w, 2.0 * (1 - np.cos(w * t)) / w, 9.8 * t]
    assert np.allclose(interval.v[0], expected, atol=1e-12)
    expected = [2.0 * (1 - np.cos(w * t)) / w ** 2, 2.0 * (w * t - np.sin(w * t)) / w ** 2,
                9.8 * t * t / 2]
    assert np.allclose(interval.p[0], expected, atol=2e-4)
    assert np.allclose(interval.omega[0], [0.0, 0.0, w])


@pytest.mark.parametrize('jitter', (0.0, 0.4))
@pytest.mark.parametrize('inner', (
    [1.0], [0.0137], [1.003, 1.0049], [0.5, 0.5], [0.2, 0.4, 0.6, 1.9999],
    list(np.linspace(0.01, 1.97, 97))))
def test_split_at_any_epochs_is_the_unsplit(inner, jitter):
    whole = chained(integrated([0.0, 2.0], jitter=jitter))
    parts = chained(integrated([0.0, *inner, 2.0], jitter=jitter))
    assert angle(whole[0], parts[0]) < 1e-8
    assert np.allclose(whole[1], parts[1], atol=1e-7)
    assert np.allclose(whole[2], parts[2], atol=1e-6)


@pytest.mark.parametrize('jitter', (0.0, 0.4))
def test_changes_per_second_of_a_parabola_are_exact(jitter):
    """At samples and at epochs between them, whose slopes come of the cubic."""
    index = np.arange(-3, 60) + jitter * np.random.default_rng(1).uniform(-1, 1, 63)
    stamps = 0.01 * index
    a, b, c = np.array([[0.3, -0.2, 0.5], [1.0, 2.0, -1.0], [4.0, -3.0, 2.0]])

    def value(t):
        return a + b * t[..., None] + c * t[..., None] ** 2

    steps = cut_at(stamps, value(stamps), 10.0 * value(stamps), [0.0533, 0.2171, 0.4987])
    ends = np.cumsum(np.hstack([[[0.0533], [0.2171]], steps.dt]), axis=1)
    slope = b + 2 * c * ends[..., None]
    assert np.allclose(steps.omega, value(ends)) and np.allclose(steps.f, 10 * value(ends))
    assert np.allclose(steps.omega_dot, slope) and np.allclose(steps.f_dot, 10 * slope)


def test_samples_in_bunches_are_one_to_the_slope():
    """Two samples a hair apart differ by their noise, which is no change of the motion."""
    stamps = np.sort(np.concatenate([0.01 * np.arange(40), 0.01 * np.arange(40) + 1e-5]))
    noise = np.tile([1e-3, -1e-3], 40)[:, None]
    gyro = 2.0 * stamps[:, None] + noise * np.ones(3)
    steps = cut_at(stamps, gyro, gyro, np.array([0.1, 0.3]))
    # 2 and what 1 mrad/s makes of 10 ms; 200 rad/s^2 in 10 us.
    assert np.abs(steps.omega_dot - 2.0).max() < 0.5


@pytest.mark.parametrize('epoch', (0.5012, 0.505, 0.5089))
def test_changes_at_an_epoch_are_those_of_the_values(epoch):
    """Of samples that no parabola goes through."""
    stamps = 0.01 * np.arange(100)
    gyro, accel = np.random.default_rng(4).standard_normal((2, 100, 3))
    steps = [cut_at(stamps, gyro, accel, np.array([0.1, epoch + by]))
             for by in (-1e-6, 0.0, 1e-6)]
    for name in ('omega', 'f'):
        before, after = (getattr(steps[k], name)[0, -1] for k in (0, 2))
        assert np.allclose(getattr(steps[1], name + '_dot')[0, -1], (after - before) / 2e-6,
                           rtol=1e-4, atol=1e-2)


def test_interval_without_length_turns_nothing():
    interval = integrated([0.4, 0.4, 1.0])
    assert interval.duration[0] == 0
    assert np.array_equal(interval.R[0], np.eye(3))
    assert np.all(interval.v[0] == 0) and np.all(interval.p[0] == 0) and np.all(
        interval.Q[0] == 0)
    assert np.allclose(interval.omega[0], omega_of(0.4), atol=1e-6)


@pytest.mark.parametrize('column', range(24))
def test_jacobians_are_the_derivatives_of_the_integration(column):
    step = np.zeros(24)
    step[column] = 1e-5
    epochs = [0.0, 1.5]
    at = integrated(epochs)
    of_gyros, of_accelerometers = ((at.J_Rg, at.J_vg, at.J_pg),
                                   (np.zeros((1, 3, 12)), at.J_va, at.J_pa))
    expected = [J[0, :, column % 12] for J in (of_gyros if column < 12 else of_accelerometers)]
    plus, minus = (integrated(epochs, errors=sign * step) for sign in (1, -1))
    turn = Rotation.from_matrix(plus.R[0] @ minus.R[0].T).as_rotvec()
    for change, J, atol in zip((turn, plus.v[0] - minus.v[0], plus.p[0] - minus.p[0]), expected,
                               (1e-4, 2e-3, 2e-3)):
        assert np.allclose(change / 2e-5, J, atol=atol)


def corrected_for(interval, errors):
    """Take sensor errors, shape (24,), off an interval by its derivatives."""
    gyro, accel = errors[:12], errors[12:]
    return replace(interval, R=Rotation.from_rotvec(interval.J_Rg @ gyro).as_matrix() @ interval.R,
                   v=interval.v + interval.J_vg @ gyro + interval.J_va @ accel,
                   p=interval.p + interval.J_pg @ gyro + interval.J_pa @ accel)


@pytest.mark.parametrize('interval, rotation, force', [(0.2, 0.15, 3.0), (1.0, 3.0, 50.0)])
def test_what_a_correction_leaves_of_a_bias_is_what_the_theory_tells(interval, rotation, force):
    """In a turn, of 1 deg/s: an angular rate in deg/h and a force in millionths of gravity."""
    stamps = np.arange(-0.1, 20.2, 0.005)
    rate = np.stack([0.1 * np.sin(0.7 * stamps), 0.1 * np.cos(0.9 * stamps),
                     np.full(stamps.size, 0.6)], axis=1)
    accel = np.stack([np.sin(0.5 * stamps), np.full(stamps.size, 2.0),
                      np.full(stamps.size, 9.8)], axis=1)
    bias = np.radians(1.0) * np.array([0.6, -0.6, 0.5])
    epochs = np.arange(0.0, 20.0, interval)
    exact = integrate(cut_at(stamps, rate, accel, epochs))
    corrected = corrected_for(integrate(cut_at(stamps, rate + bias, accel, epochs)),
                              np.concatenate([bias, np.zeros(21)]))
    turned = Rotation.from_matrix(corrected.R @ exact.R.transpose(0, 2, 1)).as_rotvec()
    for left, limit in ((np.degrees(turned) * 3600.0, rotation),
                        ((corrected.v - exact.v) / 9.8e-6, force)):
        size = np.linalg.norm(np.mean(left, axis=0)) / interval
        assert 0.2 * limit < size < limit


def test_noise_covariance_is_that_of_many_runs():
    # The noise of neighbouring intervals telescopes at their ends; over one second that is 1 %.
    duration, rate, runs = 1.0, 100.0, 2000
    random = np.random.default_rng(11)
    index = np.arange(-3, int(duration * rate) + 4)
    stamps = index / rate
    shape = (runs, stamps.size, 3)
    gyro_std = NOISE.angle_random_walk * np.sqrt(rate)
    accel_std = NOISE.velocity_random_walk * np.sqrt(rate)
    gyro = omega_of(stamps) + gyro_std * random.standard_normal(shape)
    accel = force_of(stamps) + accel_std * random.standard_normal(shape)
    epochs = np.array([0.0, duration])
    clean = integrated(epochs, rate=rate)
    errors = np.empty((runs, 9))
    for run in range(runs):
        noisy = integrate(cut_at(stamps, gyro[run], accel[run], epochs), Noise())
        errors[run, :3] = Rotation.from_matrix(noisy.R[0] @ clean.R[0].T).as_rotvec()
        errors[run, 3:6] = noisy.v[0] - clean.v[0]
        errors[run, 6:] = noisy.p[0] - clean.p[0]
    sample = errors.T @ errors / runs
    sigma = np.sqrt(np.diag(clean.Q[0]))
    assert np.allclose(np.sqrt(np.diag(sample)) / sigma, 1.0, atol=0.05)
    correlation = clean.Q[0] / np.outer(sigma, sigma)
    assert np.allclose(sample / np.outer(sigma, sigma), correlation, atol=0.09)
    # Mean normalised squared error: 9 +- 3 sigma of its mean.
    nees = np.mean(np.sum(errors * np.linalg.solve(clean.Q[0], errors.T).T, axis=1))
    assert nees == pytest.approx(9.0, rel=0.05)


@pytest.mark.parametrize('count', (1, 2, 7))
def test_white_noise_of_a_force_in_closed_form(count):
    """Integrated once q^2 T, twice q^2 T^3 / 3, and q^2 T^2 / 2 between them, in any steps."""
    stamps, duration = 0.2 * np.arange(-3, count + 4), 0.2 * count
    steps = cut_at(stamps, np.zeros((stamps.size, 3)), np.zeros((stamps.size, 3)),
                   [0.0, duration])
    Q = integrate(steps, Noise(0.0, 0.1)).Q[0]
    for rows, columns, expected in ((slice(3, 6), slice(3, 6), duration),
                                    (slice(3, 6), slice(6, 9), duration ** 2 / 2),
                                    (slice(6, 9), slice(6, 9), duration ** 3 / 3)):
        assert np.allclose(Q[rows, columns], 0.01 * expected * np.eye(3), rtol=1e-9)


def test_noise_covariance_chains():
    """Covariance over the whole is that of the parts, propagated."""
    whole = integrated([0.0, 2.0]).Q[0]
    parts = integrated([0.0, 0.3, 0.7, 2.0])
    P, R = np.zeros((9, 9)), np.eye(3)
    for k, h in enumerate(parts.duration):
        u, w = R @ parts.v[k], R @ parts.p[k]
        F = np.eye(9)
        F[3:6, :3] = -np.cross(np.eye(3), u)
        F[6:, :3] = -np.cross(np.eye(3), w)
        F[6:, 3:6] = h * np.eye(3)
        T = np.kron(np.eye(3), R)
        P = F @ P @ F.T + T @ parts.Q[k] @ T.T
        R = R @ parts.R[k]
    assert np.allclose(P, whole, rtol=2e-3, atol=2e-3 * np.sqrt(np.outer(
        np.diag(whole), np.diag(whole))))


def test_noise_may_differ_from_step_to_step():
    epochs = np.array([0.0, 1.0])
    stamps, gyro, accel = samples(1.0)
    steps = cut_at(stamps, gyro, accel, epochs)
    uniform = integrate(steps, Noise(1e-3)).Q[0]
    first_half = np.where(np.cumsum(steps.dt, axis=1) <= 0.5 + 1e-9, 2e-3, 0.0)
    halved = integrate(steps, Noise(first_half)).Q[0]
    assert np.allclose(np.diag(halved)[:3], 2 * np.diag(uniform)[:3], rtol=1e-9)
    # Angle errors of the first half act longer on the velocity.
    assert np.all(np.diag(halved)[3:5] > 3 * np.diag(uniform)[3:5])


def whole(stamps):
    """Return the one window that holds every sample."""
    return np.array([0]), np.array([stamps.size])


@pytest.mark.parametrize('jitter', (0.0, 0.4))
@pytest.mark.parametrize('rate', (100.0, 400.0))
def test_white_noise_is_measured_through_motion(rate, jitter):
    random = np.random.default_rng(5)
    count = 6000
    stamps = (np.arange(count) + jitter * random.uniform(-1, 1, count)) / rate
    density = 2e-4, 5e-3
    sample = np.hstack([
        omega_of(stamps) + density[0] * np.sqrt(rate) * random.standard_normal((count, 3)),
        force_of(stamps) + density[1] * np.sqrt(rate) * random.standard_normal((count, 3))])
    # 3 * 6000 correlated differences: a percent or two.
    found = white_noise(nanoseconds(stamps), sample, *whole(stamps))
    assert np.allclose(found[0], density, rtol=0.05)


def test_white_noise_of_motion_alone_is_nearly_none():
    stamps = np.arange(1000) / RATE
    assert np.all(white_noise(nanoseconds(stamps), np.hstack([omega_of(stamps), force_of(stamps)]),
                              *whole(stamps)) < 1e-6)


def test_white_noise_of_a_handful_of_samples_is_not_told():
    stamps = np.arange(7) / RATE
    found = white_noise(nanoseconds(stamps), np.ones((7, 6)), *whole(stamps))
    assert np.array_equal(found, [[0.0, 0.0]])


def test_white_noise_of_a_window_is_that_of_its_samples_alone():
    random = np.random.default_rng(6)
    stamps, sample = np.arange(400) / RATE, random.standard_normal((400, 6))
    sample[:100] *= 1e6                            # what is before a window leaves no rounding
    first, last = np.array([100, 250, 120, 395]), np.array([200, 400, 380, 400])
    found = white_noise(nanoseconds(stamps), sample, first, last)
    for k, (i, j) in enumerate(zip(first, last)):
        alone = white_noise(nanoseconds(stamps[i:j]), sample[i:j], *whole(stamps[i:j]))[0]
        assert np.allclose(found[k], alone, rtol=1e-12)
    assert np.all(found[:3] > 0) and np.all(found[3] == 0)


def test_noise_in_excess_is_kept_apart():
    stamps, gyro, accel = samples(1.0)
    steps = cut_at(stamps, gyro, accel, np.array([0.0, 1.0]))
    interval = integrate(steps, Noise(1e-3, 1e-2, 2e-3, 3e-2))
    assert np.allclose(interval.Q, integrate(steps, NOISE).Q)
    assert np.allclose(interval.Q_excess,
                       integrate(steps, Noise(2e-3, 3e-2)).Q)
    assert not np.any(integrate(steps, NOISE).Q_excess)


def test_noise_of_an_interval_does_not_hang_on_the_others():
    """Shorter ones are filled up with steps of no length."""
    r = np.random.default_rng(0)
    steps = Steps(np.array([[0.01] * 3 + [0.0] * 2]), *r.standard_normal((2, 1, 6, 3)),
                  *np.zeros((2, 1, 6, 3)))
    density = np.array([[0.3, 0.1, 0.2, 0.0, 0.0]])
    noise = Noise(density, 10 * density, 0.5 * density, 5 * density)
    alone = integrate(Steps(*(values[:, :n] for values, n in zip(steps, (3, 4, 4, 4, 4)))),
                      Noise(*(values[:, :3] for values in noise)))
    filled = integrate(steps, noise)
    assert np.array_equal(filled.Q, alone.Q) and np.array_equal(filled.Q_excess, alone.Q_excess)


def test_mirrored_intervals_are_those_of_mirrored_sensors():
    """To second order in the rotation where rate and force are steady, derivatives to first."""
    epochs = np.array([0.0, 0.2, 0.4])
    signs = np.array([[1, 1, 1, 1], [1, 1, 1, -1], [-1, -1, -1, 1], [-1, -1, -1, -1],
                      [-1, 1, 1, 1], [1, -1, 1, 1], [1, 1, -1, 1]], float)
    for kept in (samples, steady_samples):
        stamps, gyro, accel = kept(0.4)
        plain = integrate(cut_at(stamps, gyro, accel, epochs), NOISE)
        mirrored = plain.mirrored(signs)
        first = 0.5 * max(map(angle, plain.R, [np.eye(3)] * 2))
        second = first if kept is samples else 0.5 * first ** 2
        assert mirrored.v.shape == (2, len(signs), 3)
        for k, (*of_gyros, of_accel) in enumerate(signs):
            expected = vars(integrate(
                cut_at(stamps, of_gyros * gyro, of_accel * accel, epochs), NOISE))
            found = {name: array[:, k] for name, array in vars(mirrored).items()
                     if name not in ('duration', 'force', 'Q', 'Q_excess')}
            for name in ('R', 'v', 'p', 'J_Rg', 'J_vg', 'J_pg', 'J_va', 'J_pa'):
                off = np.abs(found[name] - expected[name]).max() / np.abs(expected[name]).max()
                assert off < (first if name in ('J_vg', 'J_pg') else second), name
            for name in ('gained', 'turned', 'omega'):
                assert np.allclose(found[name], expected[name]), name


@pytest.mark.parametrize('layout', ('C', 'F'))
def test_an_interval_is_the_same_with_others_to_the_bit(layout):
    """Of samples with noise of its own in each step, however they lie in memory."""
    stamps, gyro, accel = samples(2.0, jitter=0.3)
    steps = cut_at(stamps, gyro, accel, np.linspace(0.0, 2.0, 11))
    random = np.random.default_rng(5)
    noise = random.uniform(1e-3, 2e-3, (4,) + steps.dt.shape)

    def integrated_of(index):
        return vars(integrate(
            Steps(*(np.array(values[index], order=layout) for values in steps)),
            Noise(*noise[:, index])))

    together = integrated_of(slice(0, 10))
    for size in (1, 2, 3):
        for first in range(0, 10 - size, size):
            index = slice(first, first + size)
            for name, array in integrated_of(index).items():
                assert np.array_equal(array, together[name][index]), name
