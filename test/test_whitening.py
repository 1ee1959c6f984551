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
from ins_align.rotation import exp_so3
from ins_align.unknowns import SIZE, Unknowns
from ins_align.whitening import (Chain, chain_noise, GATE, Measurements, sensitivities, START,
                                 Whitener)
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
    return preintegrate(steps, ZERO, ZERO, Noise(1e-3, 1e-2), gyro_scale=ZERO)


def some_measurements(count=5, seed=0):
    r = np.random.default_rng(seed)
    return Measurements(0.5 * np.arange(1, count + 1), 5.0 * r.standard_normal((count, 6)),
                        np.tile(np.eye(3), (count, 2, 1, 1)), np.ones((count, 2), bool),
                        np.tile([0.0, 0.0, -9.8], (count, 1)), r.standard_normal((count, 3)))


def residuals(x, intervals, gnss):
    """Residuals at x and their derivatives, from scratch: intervals corrected, chained."""
    corrected = intervals.corrected(x.gyro_bias, x.accel_bias, x.gyro_scale)
    return sensitivities(x, Chain.start().extended(corrected), gnss, corrected)


@pytest.mark.parametrize('delay', (0.0, 0.03))
@pytest.mark.parametrize('column', range(SIZE))
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
    assert np.allclose(H, numeric, atol=0.02 * np.max(np.abs(numeric)) + 1e-6)


@pytest.mark.parametrize('row', range(9))
def test_noise_of_an_interval_looks_like_an_error_of_the_start(row):
    """An error of interval 1, as seen at t0, acts on the later epochs as one of the start."""
    x, intervals, gnss = some_unknowns(), some_intervals(), some_measurements()
    x = replace(x, delay=0.0)
    corrected = intervals.corrected(x.gyro_bias, x.accel_bias, x.gyro_scale)
    before = Chain.start().extended(corrected.take(slice(0, 2)))
    chain, later = before.at(-1), slice(2, 5)
    error = np.zeros(9)
    error[row] = 1e-6

    def spoilt(e):
        start = replace(chain, R=chain.R @ exp_so3(e[:3]), v=chain.v + before_R @ e[3:6],
                        p=chain.p + before_R @ e[6:])
        return sensitivities(x, start.extended(corrected.take(later)), gnss.take(later),
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


def test_chain_over_all_is_the_chain_one_by_one():
    intervals = some_intervals()
    whole = Chain.start().extended(intervals)
    chain = Chain.start()
    for k in range(5):
        chain = chain.extended(intervals.take(slice(k, k + 1))).at(-1)
        for name, array in vars(whole).items():
            assert np.allclose(array[k], getattr(chain, name), atol=1e-12), name


@pytest.mark.parametrize('size, kinds', [(6, (0,)), (9, (1,)), (9, (0, 1))])
def test_whitener_is_dense_generalised_least_squares(size, kinds):
    r = np.random.default_rng(5)
    epochs, columns = 7, np.union1d(np.arange(0, SIZE, 2), START[:size])
    whitener = Whitener(columns, size)
    rows, maps, noises, times, steps = [], [], [], [], []
    for epoch in range(epochs):
        root = r.standard_normal((size, size))
        steps.append(root @ root.T)
        whitener.P += steps[-1]
        for kind in kinds:
            Y = r.standard_normal((3, 1 + columns.size))
            root = r.standard_normal((3, 3))
            R = root @ root.T + 0.1 * np.eye(3)
            whitener.update(kind, Y, R, gate=None, gate_scale=1.0)
            rows.append(Y)
            maps.append(Y[:, 1 + np.searchsorted(columns, START[:size])])
            noises.append(R)
            times.append(epoch)
    walk = np.cumsum(steps, axis=0)
    n = len(rows)
    V = np.zeros((3 * n, 3 * n))
    for i in range(n):
        for j in range(n):
            block = maps[i] @ walk[min(times[i], times[j])] @ maps[j].T
            V[3 * i:3 * i + 3, 3 * j:3 * j + 3] = block + (noises[i] if i == j else 0.0)
    D = np.vstack(rows)
    assert np.allclose(whitener.normal, D.T @ np.linalg.solve(V, D), rtol=1e-8)
    # What the filter knows of the errors at the end is the conditional mean and covariance.
    cross = np.hstack([walk[times[i]] @ maps[i].T for i in range(n)])
    assert np.allclose(whitener.X, cross @ np.linalg.solve(V, D), rtol=1e-7, atol=1e-9)
    assert np.allclose(whitener.P, walk[-1] - cross @ np.linalg.solve(V, cross.T), atol=1e-8)
    assert whitener.rows == 3 * n


def test_an_outlier_is_counted_and_leaves_no_trace():
    r = np.random.default_rng(2)
    columns = np.arange(SIZE)
    whitener = Whitener(columns, 6)
    whitener.P += 0.01 * np.eye(6)
    Y = r.standard_normal((3, 1 + SIZE))
    gate = np.zeros(SIZE), 1e-6 * np.eye(SIZE)
    Y[:, 0] = [0.1, -0.1, 0.1]
    good, _ = whitener.update(0, Y, np.eye(3), gate=gate, gate_scale=1.0)
    before = whitener.normal.copy(), whitener.P.copy(), whitener.X.copy(), whitener.rows
    Y[:, 0] = 30.0
    bad, normalised = whitener.update(0, Y, np.eye(3), gate=gate, gate_scale=1.0)
    assert good < GATE < bad and np.allclose(np.sum(normalised ** 2), bad, rtol=0.3)
    assert whitener.rejected == [1, 0] and whitener.rows == before[3]
    assert all(np.array_equal(a, b) for a, b in zip(
        before, (whitener.normal, whitener.P, whitener.X)))
    Y[:, 0] = np.nan
    whitener.update(0, Y, np.eye(3), gate=gate, gate_scale=1.0)
    assert whitener.rejected == [2, 0] and np.all(np.isfinite(whitener.normal))
