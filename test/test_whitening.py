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
"""Chain, sensitivities and whitening filter against finite differences and dense algebra."""

from dataclasses import replace

from alignment import some_unknowns
from ins_align.preintegration import (
    Noise, preintegrate, SensorErrors, split_at_epochs, Steps)
from ins_align.recent import AGES, Recent, recent_motion
from ins_align.rotation import exp_so3, skew
from ins_align.unknowns import DELAY, GYRO, SIZE, START_VELOCITY
from ins_align.whitening import (BLOCK, Chain, chain_noise, GATE, Gate, HEADING_RESOLVED_STD,
                                 Measurements, POSITION, Rows, sensitivities, START, VELOCITY,
                                 Whitener)
import numpy as np
import pytest
from scipy.integrate import solve_ivp


def some_intervals(count=5, seed=0):
    """Intervals of half a second of a lively motion."""
    r = np.random.default_rng(seed)
    n = 10
    shape = (count, n + 1, 3)
    steps = Steps(np.full((count, n), 0.05), r.standard_normal(shape),
                  r.standard_normal(shape) + [0.0, 0.0, 9.8], np.zeros(shape), np.zeros(shape))
    # What was just before changes linearly with the age, which is interpolated without error.
    before = (AGES[:, None] * values[:, -1:]
              + AGES[:, None] ** 2 * r.standard_normal((count, 1, 3))
              for values in (steps.f, steps.omega))
    return preintegrate(steps, SensorErrors.none(), Noise(1e-3, 1e-2), Recent(*before))


def some_measurements(count=5, seed=0):
    r = np.random.default_rng(seed)
    return Measurements(0.5 * np.arange(1, count + 1), 5.0 * r.standard_normal((count, 6)),
                        np.tile(np.eye(3), (count, 2, 1, 1)), np.ones((count, 2), bool),
                        np.tile([0.0, 0.0, -9.8], (count, 1)), r.standard_normal((count, 3)))


def six_rows(*arguments):
    """Velocity's and position's rows one behind the other."""
    Y = sensitivities(*arguments)
    return Y.reshape(len(Y), 6, -1)


def residuals(x, intervals, gnss):
    """Residuals at x and their derivatives, from scratch: intervals corrected, chained."""
    corrected = intervals.corrected(x.sensors.vector())
    return six_rows(x, Chain.start().extended(corrected), gnss, corrected)


def test_velocities_alone_have_the_rows_that_they_have_beside_positions():
    x, intervals, gnss = some_unknowns(), some_intervals(), some_measurements()
    chain = Chain.start().extended(intervals)
    both, alone = (sensitivities(x, chain, gnss, intervals, kinds) for kinds in (2, 1))
    assert alone.shape == (5, 1, 3, 1 + SIZE) and np.array_equal(alone, both[:, :1])


@pytest.mark.parametrize('column, delay', [
    (column, delay) for column in range(SIZE) for delay in (0.0, 0.03, 0.2)
    # Over a long delay the gyros' errors, and the delay's own, are told to the first order.
    if delay < 0.1 or column not in np.r_[GYRO, DELAY]])
def test_sensitivities_are_the_derivatives_of_the_residual(column, delay):
    x, intervals, gnss = some_unknowns(), some_intervals(), some_measurements()
    x = replace(x, delay=delay)
    step = np.zeros(SIZE)
    step[column] = 1e-6
    plus, minus = (residuals(x.moved(sign * step), intervals, gnss)[:, :, 0]
                   for sign in (1, -1))
    numeric = -(plus - minus) / 2e-6
    H = residuals(x, intervals, gnss)[:, :, 1 + column]
    # The intervals' derivatives are those at the bias they were integrated with; how the change
    # of the force within an interval hangs together with the rest is of second order.
    for rows in (VELOCITY, POSITION):
        largest = np.max(np.abs(numeric[:, rows]), axis=1, keepdims=True)
        assert np.all(np.abs(H[:, rows] - numeric[:, rows]) < 0.02 * largest + 1e-6)


@pytest.mark.parametrize('delay', (-0.05, 0.0, 0.12, 0.25))
def test_residuals_of_the_truth_are_nothing(delay):
    """Against a numerical solution of the motion, seen with a lever arm a delay before."""
    gravity, lever = np.array([0.0, 0.0, -9.8]), np.array([1.0, -0.7, 0.4])
    x = replace(some_unknowns(), lever_b=lever, delay=delay)
    gyro_bias, accel_bias = 2e-3 * np.array([1.0, -2.0, 1.5]), 0.05 * np.array([-1.0, 1.0, 2.0])
    x = replace(x, sensors=SensorErrors.none()._replace(gyro_bias=gyro_bias,
                                                        accel_bias=accel_bias))

    def rate(t):
        return np.array([0.6 * np.sin(3.0 * t), 0.5 * np.cos(2.3 * t), 0.8 + 0.4 * np.sin(2 * t)])

    def force(t):
        return np.array([3.0 * np.sin(4.0 * t), 2.0 * np.sin(3 * t), 9.8 + 2.0 * np.sin(2 * t)])

    def slope(t, y):
        C = y[:9].reshape(3, 3)
        return np.concatenate([(C @ skew(rate(t))).ravel(), C @ force(t) + gravity, y[9:12]])

    start = np.concatenate([x.C.ravel(), x.start_velocity, x.start_position])
    motion = solve_ivp(slope, (0.0, 2.2), start, rtol=1e-11, atol=1e-11, dense_output=True).sol
    stamps, epochs = np.arange(0.0, 2.15, 1e-3), np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    gyro = np.array([rate(t) for t in stamps]) + gyro_bias
    accel = np.array([force(t) for t in stamps]) + accel_bias
    interval = preintegrate(split_at_epochs(stamps, gyro, accel, epochs), x.sensors, Noise(),
                            recent_motion(stamps, gyro, accel, epochs[1:]))
    time = epochs[1:]
    seen = motion(time - delay).T
    C = seen[:, :9].reshape(-1, 3, 3)
    swing = np.array([np.cross(rate(t), lever) for t in time - delay])
    velocity = seen[:, 9:12] + (C @ swing[..., None])[..., 0]
    position = seen[:, 12:] + C @ lever
    t = time[:, None]
    gnss = replace(some_measurements(4), time=time, gravity=np.tile(gravity, (4, 1)),
                   offset=t * gravity,
                   s=np.concatenate([velocity - t * gravity, position - t * t / 2 * gravity], 1))
    residual = six_rows(x, Chain.start().extended(interval), gnss, interval)[:, :, 0]
    # The motion since what was seen is told to the second order of the angle, a bias in it to
    # the first.
    assert np.max(np.abs(residual[:, :3])) < 7e-3 and np.max(np.abs(residual[:, 3:])) < 7e-4


@pytest.mark.parametrize('delay, limit', [(0.5, 0.3), (-0.4, -0.1)])
def test_with_an_absurd_delay_the_model_goes_straight_on(delay, limit):
    x, intervals, gnss = some_unknowns(), some_intervals(), some_measurements()
    at_limit, absurd = (residuals(replace(x, delay=d), intervals, gnss) for d in (limit, delay))
    assert np.allclose(absurd[:, :, 1:], at_limit[:, :, 1:])
    assert np.allclose(absurd[:, :, 0] - at_limit[:, :, 0],
                       -(delay - limit) * at_limit[:, :, 1 + DELAY.start])


@pytest.mark.parametrize('row', range(9))
def test_noise_of_an_interval_looks_like_an_error_of_the_start(row):
    """An error of interval 1, as seen at t0, acts on the later epochs as one of the start."""
    x, intervals, gnss = some_unknowns(), some_intervals(), some_measurements()
    x = replace(x, delay=0.0)
    corrected = intervals.corrected(x.sensors.vector())
    before = Chain.start().extended(corrected.take(slice(0, 2)))
    chain, later = before.at(-1), slice(2, 5)
    error = np.zeros(9)
    error[row] = 1e-6

    def spoilt(e):
        start = replace(chain, R=chain.R @ exp_so3(e[:3]), v=chain.v + before_R @ e[3:6],
                        p=chain.p + before_R @ e[6:])
        return six_rows(x, start.extended(corrected.take(later)), gnss.take(later),
                        corrected.take(later))[:, :, 0]

    # Noise of an interval is told in the axes at its start, the rotation too.
    before_R = before.at(0).R
    turn = corrected.R[1]
    plus, minus = (spoilt(sign * np.concatenate([turn.T @ error[:3], error[3:]]))
                   for sign in (1, -1))
    Q = np.zeros((5, 9, 9))
    Q[1, row, row] = 1.0
    noise = chain_noise(x.C, gnss.time, Chain.start().extended(corrected),
                        replace(corrected, Q=Q), 9)[1]
    values, vectors = np.linalg.eigh(noise)
    as_start = vectors[:, -1] * np.sqrt(values[-1])
    assert np.allclose(noise, np.outer(as_start, as_start), atol=1e-9)     # of rank one
    D = residuals(x, intervals, gnss)[later][:, :, 1 + START]
    numeric = -(plus - minus) / 2e-6
    sign = np.sign(np.sum(numeric * (D @ as_start)))
    assert np.allclose(D @ as_start * sign, numeric, atol=2e-6)


def test_noise_in_excess_counts_as_far_as_it_is_believed():
    x, intervals, gnss = some_unknowns(), some_intervals(), some_measurements()
    chain = Chain.start().extended(intervals)
    both = replace(intervals, Q_excess=3.0 * intervals.Q)
    plain = chain_noise(x.C, gnss.time, chain, intervals, 9)
    assert not np.any(intervals.Q_excess) and np.any(plain)
    assert np.allclose(chain_noise(x.C, gnss.time, chain, both, 9, excess=0.2), 1.6 * plain)


def test_chain_over_all_is_the_chain_one_by_one():
    intervals = some_intervals()
    whole = Chain.start().extended(intervals)
    chain = Chain.start()
    for k in range(5):
        chain = chain.extended(intervals.take(slice(k, k + 1))).at(-1)
        for name, array in vars(whole).items():
            assert np.allclose(array[k], getattr(chain, name), atol=1e-12), name


def rows_of(Y, covariance, noise):
    """Rows with the whitening's inputs alone."""
    return Rows(None, np.array(noise), np.array(Y), np.array(covariance), np.arange(len(Y)))


@pytest.mark.parametrize('size, kinds', [(6, (0,)), (9, (1,)), (9, (0, 1))])
def test_whitener_is_dense_generalised_least_squares(size, kinds):
    r = np.random.default_rng(5)
    epochs, columns = 7, np.union1d(np.arange(0, SIZE, 2), START[:size])
    D, R, steps = [], [], []
    for _ in range(epochs):
        root = r.standard_normal((size, size))
        steps.append(root @ root.T)
        D.append(r.standard_normal((2, 3, 1 + columns.size)))
        root = r.standard_normal((2, 3, 3))
        R.append(root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3))
    wanted = np.isin(np.arange(2), kinds) & np.ones((epochs, 1), bool)
    whitener = Whitener(columns, size)
    # In two goes: the second one starts where the first one ended.
    for part in (slice(0, 3), slice(3, epochs)):
        whitened = whitener.whitened(rows_of(D[part], R[part], steps[part]), wanted[part])
        whitener.move_to(whitened, -1)
    times = np.repeat(np.arange(epochs), len(kinds))
    noises = [R[epoch][kind] for epoch in range(epochs) for kind in kinds]
    D = [D[epoch][kind] for epoch in range(epochs) for kind in kinds]
    maps = [Y[:, 1 + np.searchsorted(columns, START[:size])] for Y in D]
    walk = np.cumsum(steps, axis=0)
    n = len(D)
    V = np.zeros((3 * n, 3 * n))
    for i in range(n):
        for j in range(n):
            block = maps[i] @ walk[min(times[i], times[j])] @ maps[j].T
            V[3 * i:3 * i + 3, 3 * j:3 * j + 3] = block + (noises[i] if i == j else 0.0)
    D = np.vstack(D)
    assert np.allclose(whitener.normal, D.T @ np.linalg.solve(V, D), rtol=1e-8)
    # What the filter knows of the errors at the end is the conditional mean and covariance.
    cross = np.hstack([walk[times[i]] @ maps[i].T for i in range(n)])
    assert np.allclose(whitener.X, cross @ np.linalg.solve(V, D), rtol=1e-7, atol=1e-9)
    assert np.allclose(whitener.P, walk[-1] - cross @ np.linalg.solve(V, cross.T), atol=1e-8)
    assert whitener.rows == 3 * n
    assert whitener.log_det == pytest.approx(np.linalg.slogdet(V)[1])


def some_rows(seed, epochs, size, kinds, width):
    """Rows of random numbers, whose covariances are positive definite."""
    r = np.random.default_rng(seed)
    roots = r.standard_normal((epochs, size, size)), r.standard_normal((epochs, kinds, 3, 3))
    noise, covariance = (root @ root.swapaxes(-1, -2) for root in roots)
    return rows_of(r.standard_normal((epochs, kinds, 3, 1 + width)),
                   covariance + 0.1 * np.eye(3), noise)


@pytest.mark.parametrize('size, kinds, walks', [(6, 1, False), (6, 1, True), (9, 2, True)])
@pytest.mark.parametrize('epochs', [1, BLOCK, 3 * BLOCK + 2])
def test_blocks_at_once_are_what_the_filter_is_epoch_by_epoch(size, kinds, walks, epochs):
    whitener = Whitener(np.arange(SIZE), size, walks)
    before = some_rows(1, 3, size + 3 * walks, kinds, SIZE)
    whitener.move_to(whitener.whitened(before, np.ones((3, kinds), bool)), -1)
    rows = some_rows(2, epochs, size + 3 * walks, kinds, SIZE)
    wanted = np.random.default_rng(3).random((epochs, kinds)) < 0.8
    rows.Y[~wanted] = np.nan                        # what is not wanted is not looked at
    expected, found = whitener.whitened(rows, wanted), whitener.whitened_at_once(rows, wanted)
    for name in ('P', 'X', 'normal', 'rows', 'spurious', 'log_det'):
        assert np.allclose(getattr(found, name), getattr(expected, name)[-1:], rtol=1e-9), name
    for name in ('used', 'innovation', 'S'):
        assert np.allclose(getattr(found, name), getattr(expected, name), rtol=1e-8), name


def test_what_cannot_be_factored_is_filtered_epoch_by_epoch():
    """Here because rounding has left a covariance with a variance below zero."""
    rows = some_rows(4, BLOCK, 6, 1, SIZE)
    rows.noise[2] -= 50.0 * np.eye(6)
    whitener, wanted = Whitener(np.arange(SIZE), 6), np.ones((BLOCK, 1), bool)
    with np.errstate(invalid='ignore'):             # the logarithm of a negative determinant
        expected = whitener.whitened(rows, wanted)
        found = whitener.whitened_at_once(rows, wanted)
    assert np.isfinite(expected.normal).all()
    assert np.array_equal(found.normal, expected.normal)


def test_information_on_the_heading_that_noise_feigns():
    """A horizontal error of variance p, seen with r beside it: p / (p + r) on each of two axes."""
    q, r, count = 0.04, 0.09, 6
    whitener = Whitener(np.arange(SIZE), 6)
    columns = np.zeros((count, 1, 3, 1 + SIZE))
    columns[:, 0, :, 1:][:, :, START_VELOCITY] = np.eye(3)
    noise = np.zeros((count, 6, 6))
    noise[:, 3:, 3:] = q * np.eye(3)
    covariance, wanted = np.tile(r * np.eye(3), (count, 1, 1, 1)), np.ones((count, 1), bool)
    for part in (slice(0, 2), slice(2, count)):
        rows = rows_of(columns[part], covariance[part], noise[part])
        whitener.move_to(whitener.whitened(rows, wanted[part]), -1)
    p = feigned = 0.0
    for _ in range(count):
        p += q
        feigned += 2 * p / (p + r)
        p = p * r / (p + r)
    assert whitener.spurious == pytest.approx(feigned)


def test_an_outlier_is_counted_and_leaves_no_trace():
    r = np.random.default_rng(2)
    columns = np.arange(SIZE)
    Y = r.standard_normal((1, 3, 1 + SIZE))
    bad, broken = Y.copy(), Y.copy()
    Y[..., 0], bad[..., 0], broken[..., 0] = [0.1, -0.1, 0.1], 30.0, np.nan
    R, noise = np.eye(3)[None], 0.01 * np.eye(6)
    gate = Gate(np.zeros(SIZE), 1e-6 * np.eye(SIZE))
    whitener = Whitener(columns, 6)
    whitened = whitener.whitened(rows_of([Y, bad, broken], [R] * 3, [noise, 0 * noise, 0 * noise]),
                                 np.ones((3, 1), bool), gate)
    assert whitened.used[:, 0].tolist() == [True, False, False]
    for array in (whitened.P, whitened.X, whitened.normal, whitened.rows, whitened.log_det):
        assert np.array_equal(array[0], array[1]) and np.array_equal(array[0], array[2])
    for new, fine in ((Y, True), (bad, False)):
        nis, normalised = gate.test(new, R)
        assert (nis[0] < GATE) == fine
        assert np.allclose(np.sum(normalised ** 2), nis, rtol=0.3)


@pytest.mark.parametrize('scale, used', [(1.0, False), (47.0 / GATE, False), (49.0 / GATE, True)])
def test_a_wider_gate_lets_through_what_a_usual_one_does_not(scale, used):
    innovation = np.zeros((1, 1, 3, 1 + SIZE))
    innovation[..., 0] = 4.0                               # 48 in its squares
    rows = rows_of(innovation, np.eye(3)[None, None], np.zeros((1, 6, 6)))
    gate, wanted = Gate(np.zeros(SIZE), 1e-9 * np.eye(SIZE)), np.ones((1, 1), bool)
    whitened = Whitener(np.arange(SIZE), 6).whitened(rows, wanted, gate, scale)
    assert whitened.used[0, 0] == used


@pytest.mark.parametrize('share', (0.99, 1.01))
def test_a_gate_is_round_while_the_heading_is_open(share):
    """An error of the heading shows across the motion only to first order."""
    P = 1e-6 * np.eye(SIZE)
    P[2, 2] = (share * HEADING_RESOLVED_STD) ** 2
    innovation, S = np.zeros((3, 1 + SIZE)), np.diag([0.01, 0.02, 0.03])
    innovation[:, 0] = 3.0, 0.5, -0.4
    innovation[:, 3] = 0.0, 20.0, 0.0
    spread = np.diag([0.0, 400.0 * P[2, 2], 0.0])
    if share > 1.0:
        spread[0, 0] = spread[1, 1]
    nis, normalised = Gate(np.zeros(SIZE), P).test(innovation, S)
    residual = innovation[:, 0]
    assert nis == pytest.approx(residual @ np.linalg.solve(spread + S, residual))
    assert np.allclose(normalised, residual / np.sqrt(np.diag(spread + S)))
    assert (nis < GATE) == (share > 1.0)
