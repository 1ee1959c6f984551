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

from ins_align.preintegration import Noise, preintegrate, Steps
from ins_align.rotation import exp_so3, log_so3
from ins_align.unknowns import DELAY, SIZE, Unknowns
from ins_align.whitening import Chain, GATE, Measurements, sensitivities, Whitener
import numpy as np
import pytest

ZERO = np.zeros(3)


def some_unknowns(seed=0):
    r = np.random.default_rng(seed)
    return Unknowns(C=exp_so3(r.standard_normal(3)), gyro_bias=1e-3 * r.standard_normal(3),
                    gyro_scale=0.01 * r.standard_normal(3),
                    accel_bias=0.01 * r.standard_normal(3),
                    start_velocity=r.standard_normal(3), start_position=r.standard_normal(3),
                    lever_b=r.standard_normal(3), delay=0.03)


def some_intervals(count=5, seed=0):
    """Intervals of half a second of a lively motion."""
    r = np.random.default_rng(seed)
    n = 10
    shape = (count, n + 1, 3)
    steps = Steps(np.full((count, n), 0.05), r.standard_normal(shape),
                  r.standard_normal(shape) + [0.0, 0.0, 9.8], np.zeros(shape), np.zeros(shape))
    return preintegrate(steps, ZERO, ZERO, Noise(1e-3, 1e-2))


def some_measurements(count=5, seed=0):
    r = np.random.default_rng(seed)
    return Measurements(0.5 * np.arange(1, count + 1), 5.0 * r.standard_normal((count, 6)),
                        np.tile(np.eye(3), (count, 2, 1, 1)), np.ones((count, 2), bool),
                        np.tile([0.0, 0.0, -9.8], (count, 1)), r.standard_normal((count, 3)))


def residuals(x, intervals, gnss, chain_error=np.zeros(9)):
    """Residuals at x from scratch: intervals corrected, chained, spoilt, compared."""
    corrected = intervals.corrected(x.gyro_bias, x.accel_bias, x.gyro_scale)
    chain, _, _ = Chain.start().extended(corrected)
    chain = replace(chain, R=exp_so3(chain_error[:3]) @ chain.R, v=chain.v + chain_error[3:6],
                    p=chain.p + chain_error[6:])
    return sensitivities(x, chain, gnss, corrected)


@pytest.mark.parametrize('column', range(SIZE))
def test_sensitivities_are_the_derivatives_of_the_residual(column):
    x, intervals, gnss = some_unknowns(), some_intervals(), some_measurements()
    if column != DELAY.start:
        x = replace(x, delay=0.0)                  # how a delay hangs together with the rest is
    step = np.zeros(SIZE)                          # of second order
    step[column] = 1e-6
    plus, minus = (residuals(x.moved(sign * step), intervals, gnss)[0][:, :, 0]
                   for sign in (1, -1))
    numeric = -(plus - minus) / 2e-6
    H = residuals(x, intervals, gnss)[0][:, :, 1 + column]
    # The intervals' derivatives are those at the bias they were integrated with.
    assert np.allclose(H, numeric, atol=0.02 * np.max(np.abs(numeric)) + 1e-6)


@pytest.mark.parametrize('row', range(9))
def test_sensitivity_to_the_errors_of_the_chain(row):
    x, intervals, gnss = some_unknowns(), some_intervals(), some_measurements()
    x = replace(x, delay=0.0)
    error = np.zeros(9)
    error[row] = 1e-6
    plus, minus = (residuals(x, intervals, gnss, sign * error)[0][:, :, 0] for sign in (1, -1))
    numeric = -(plus - minus) / 2e-6
    L = residuals(x, intervals, gnss)[1]
    assert np.allclose(L[:, :, row], numeric, atol=1e-6)


def test_chain_over_all_is_the_chain_one_by_one():
    intervals = some_intervals()
    whole, F, W = Chain.start().extended(intervals)
    chain = Chain.start()
    for k in range(5):
        steps, F_k, W_k = chain.extended(intervals.take(slice(k, k + 1)))
        chain = steps.at(-1)
        for name, array in vars(whole).items():
            assert np.allclose(array[k], getattr(chain, name), atol=1e-12), name
        assert np.allclose(F[k], F_k[0]) and np.allclose(W[k], W_k[0])


def test_transition_carries_errors_of_the_chain():
    intervals = some_intervals(1)
    start = Chain.start()
    _, F, _ = start.extended(intervals)
    for column in range(9):
        error = np.zeros(9)
        error[column] = 1e-6
        ends = []
        for e in (error, -error):
            spoilt = replace(start, R=exp_so3(e[:3]) @ start.R, v=start.v + e[3:6],
                             p=start.p + e[6:])
            ends.append(spoilt.extended(intervals)[0].at(0))
        plus, minus = ends
        numeric = np.concatenate([log_so3(plus.R @ minus.R.T), plus.v - minus.v,
                                  plus.p - minus.p]) / 2e-6
        assert np.allclose(F[0][:, column], numeric, atol=1e-7)


@pytest.mark.parametrize('size, kinds', [(6, (0,)), (9, (1,)), (9, (0, 1))])
def test_whitener_is_dense_generalised_least_squares(size, kinds):
    r = np.random.default_rng(5)
    epochs, columns = 7, np.arange(0, SIZE, 2)
    whitener = Whitener(columns, size)
    covariance = np.zeros((size, size))
    rows, maps, noises = [], [], []
    transitions = [np.eye(9)]                      # from the noise of each interval to now
    sources = []
    for _ in range(epochs):
        F = np.eye(9) + 0.3 * np.tril(r.standard_normal((9, 9)), -3)
        root = r.standard_normal((9, 9))
        W = root @ root.T
        whitener.predict(F, W)
        covariance = F[:size, :size] @ covariance @ F[:size, :size].T + W[:size, :size]
        sources = [(F @ T, Q) for T, Q in sources] + [(np.eye(9), W)]
        for kind in kinds:
            Y, L = r.standard_normal((3, 1 + SIZE)), r.standard_normal((3, 9))
            L[:, size:] = 0.0
            root = r.standard_normal((3, 3))
            R = root @ root.T + 0.1 * np.eye(3)
            whitener.update(kind, Y, L, R, gate=None, gate_scale=1.0)
            rows.append(Y)
            maps.append([L @ T for T, _ in sources])
            noises.append(R)
    del transitions
    Q = [W for _, W in sources]
    n = len(rows)
    V = np.zeros((3 * n, 3 * n))
    for i in range(n):
        for j in range(n):
            block = sum((a @ W @ b.T for a, b, W in zip(maps[i], maps[j], Q)),
                        start=np.zeros((3, 3)))
            V[3 * i:3 * i + 3, 3 * j:3 * j + 3] = block + (noises[i] if i == j else 0.0)
    D = np.vstack(rows)[:, np.concatenate([[0], 1 + columns])]
    assert np.allclose(whitener.normal, D.T @ np.linalg.solve(V, D), rtol=1e-8)
    # What the filter knows of the errors at the end is the conditional mean and covariance.
    cross = np.hstack([sum((T @ W @ m.T for (T, W), m in zip(sources, maps[i])),
                           start=np.zeros((9, 3))) for i in range(n)])[:size]
    P = sum((T @ W @ T.T for T, W in sources), start=np.zeros((9, 9)))[:size, :size]
    assert np.allclose(whitener.X, cross @ np.linalg.solve(V, D), rtol=1e-7, atol=1e-9)
    assert np.allclose(whitener.P, P - cross @ np.linalg.solve(V, cross.T), atol=1e-8)
    assert whitener.rows == 3 * n


def test_an_outlier_is_counted_and_leaves_no_trace():
    r = np.random.default_rng(2)
    columns = np.arange(SIZE)
    whitener = Whitener(columns, 6)
    whitener.predict(np.eye(9), 0.01 * np.eye(9))
    Y, L = r.standard_normal((3, 1 + SIZE)), r.standard_normal((3, 9))
    gate = np.zeros(SIZE), 1e-6 * np.eye(SIZE)
    Y[:, 0] = [0.1, -0.1, 0.1]
    good = whitener.update(0, Y, L, np.eye(3), gate=gate, gate_scale=1.0)
    before = whitener.normal.copy(), whitener.P.copy(), whitener.X.copy(), whitener.rows
    Y[:, 0] = 30.0
    bad = whitener.update(0, Y, L, np.eye(3), gate=gate, gate_scale=1.0)
    assert good < GATE < bad
    assert whitener.rejected == [1, 0] and whitener.rows == before[3]
    assert all(np.array_equal(a, b) for a, b in zip(
        before, (whitener.normal, whitener.P, whitener.X)))
    Y[:, 0] = np.nan
    whitener.update(0, Y, L, np.eye(3), gate=gate, gate_scale=1.0)
    assert whitener.rejected == [2, 0] and np.all(np.isfinite(whitener.normal))
