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
"""The vector of unknowns and what is known of it before the data."""

from dataclasses import replace

from alignment import LEVER, some_unknowns
from ins_align.rotation import exp_so3
from ins_align.unknowns import (ACCEL_BIAS, ACCEL_ERRORS, ACCEL_MATRIX, ATTITUDE, DELAY,
                                first_prior, GYRO_BIAS, GYRO_MATRIX, GYRO_MISALIGNMENT,
                                inverse_spd, LEVER_ARM, Prior, prior_of, SIZE, START_POSITION,
                                START_VELOCITY)
import numpy as np
import pytest


def test_moving_and_comparing_points_are_inverse():
    x = some_unknowns()
    step = 0.3 * np.random.default_rng(1).standard_normal(SIZE)
    assert np.allclose(x.moved(step).minus(x), step, atol=1e-12)


def test_first_prior_knows_what_it_was_told():
    prior = first_prior(1e-3, 0.05, LEVER, 0.5, 0.02, 0.1, 0.01)
    x = some_unknowns()
    information, step = prior.at(x)
    known = np.diag(information)
    assert np.allclose(known[GYRO_BIAS], 1e6) and np.allclose(known[ACCEL_BIAS], 400.0)
    matrix = known[GYRO_MATRIX].reshape(3, 3)
    assert np.allclose(np.diag(matrix), 1e4)
    assert np.allclose(matrix[~np.eye(3, dtype=bool)], 1e4 / GYRO_MISALIGNMENT ** 2)
    assert np.allclose(known[ACCEL_MATRIX], 1e4 / ACCEL_ERRORS ** 2)
    assert np.allclose(known[LEVER_ARM], 4.0) and np.allclose(known[DELAY], 100.0)
    for nothing in (ATTITUDE, START_VELOCITY, START_POSITION):
        assert np.all(known[nothing] == 0)
    assert np.allclose(step[LEVER_ARM], np.array(LEVER) - x.lever_b)
    assert np.allclose(step[DELAY], 0.02 - x.delay)
    # Biases are as large as said under a force; without the matrix it makes no difference.
    force = np.array([1.0, -2.0, 9.0])
    told = first_prior(1e-3, 0.05, LEVER, 0.5, 0.02, 0.1, 0.01, force)
    matrix = np.random.default_rng(0).standard_normal((3, 3))
    moved = np.zeros(SIZE)
    moved[ACCEL_BIAS], moved[ACCEL_MATRIX] = -matrix @ force, matrix.ravel()
    assert moved @ told.information @ moved == pytest.approx(
        np.sum(matrix ** 2) * 1e4 / ACCEL_ERRORS ** 2)
    assert np.array_equal(first_prior(1e-3, 0.05, LEVER, 0.0, 0.0, 0.0, 0.0, force).information,
                          first_prior(1e-3, 0.05, LEVER, 0.0, 0.0, 0.0).information)
    fixed = np.diag(first_prior(1e-3, 0.05, LEVER, 0.0, 0.0, 0.0).information)
    assert np.all(fixed[LEVER_ARM] == 0) and np.all(fixed[DELAY] == 0)
    assert np.all(fixed[GYRO_MATRIX] == 0) and np.all(fixed[ACCEL_MATRIX] == 0)


@pytest.mark.parametrize('turn', (0.0, 0.5, 3.0))
def test_prior_of_free_heading_says_the_same_at_any_heading(turn):
    """Tilt known, heading not: turning the point about up changes nothing but axes."""
    mean = replace(some_unknowns(), C=exp_so3([0.05, -0.1, 0.0]))
    information = np.zeros((SIZE, SIZE))
    information[:2, :2] = [[9.0, 1.0], [1.0, 4.0]]
    information[:2, 3:5] = [[0.5, 0.1], [-0.2, 0.3]]
    information[3:5, :2] = information[:2, 3:5].T
    information[3:5, 3:5] = 2.0 * np.eye(2)
    prior = Prior(mean, information, True)
    Rz = exp_so3([0.0, 0.0, turn])
    tilted = exp_so3([0.02, 0.01, 0.0])
    at, step = prior.at(replace(mean, C=Rz @ tilted @ mean.C))
    plain, plain_step = Prior(mean, information, False).at(replace(mean, C=tilted @ mean.C))
    assert step @ at @ step == pytest.approx(plain_step @ plain @ plain_step, rel=1e-3)
    assert np.allclose(Rz.T @ step[:3], plain_step[:3], atol=1e-3)
    assert abs(step[2]) < 1e-3
    assert np.all(at[2] == 0) and np.all(at[:, 2] == 0)


@pytest.mark.parametrize('turn', (0.02, -1.0))
def test_prior_of_a_known_heading_is_about_axes_of_the_body(turn):
    """What it says of a tilt about such an axis and of the biases is the same at any heading."""
    r = np.random.default_rng(4)
    mean = some_unknowns()
    A = r.standard_normal((SIZE, SIZE))
    prior = prior_of(mean, A @ A.T, np.arange(SIZE), False)
    Rz = exp_so3([0.0, 0.0, turn])
    step = r.standard_normal(SIZE)
    turned = step.copy()
    for block in (ATTITUDE, START_VELOCITY, START_POSITION):
        turned[block] = Rz @ step[block]
    here, _ = prior.at(mean)
    there, to_mean = prior.at(replace(mean, C=Rz @ mean.C))
    assert turned @ there @ turned == pytest.approx(step @ here @ step, rel=1e-9)
    assert np.allclose(to_mean[ATTITUDE], [0.0, 0.0, -turn])
    assert np.allclose(to_mean[3:], 0.0)


@pytest.mark.parametrize('block, told_std', (
    (LEVER_ARM, 0.0), (LEVER_ARM, 0.05), (DELAY, 0.0), (DELAY, 0.02)))
def test_a_loosened_prior_forgets_one_block_alone(block, told_std):
    lever_std, delay_std = (told_std, 0.1) if block is LEVER_ARM else (0.5, told_std)
    prior = first_prior(1e-3, 0.05, LEVER, lever_std, 0.02, delay_std, 0.01)
    loose = prior.loosened(block, 2.0)
    before, after = np.diag(prior.information), np.diag(loose.information)
    assert np.allclose(after[block], 1 / (2.0 ** 2 + told_std ** 2))
    others = np.delete(np.arange(SIZE), np.r_[block])
    assert np.allclose(after[others], before[others], rtol=1e-9)
    assert np.array_equal(loose.mean.vector(), prior.mean.vector())


def test_a_prior_without_a_block_knows_as_much_of_the_others():
    """Not more, as it would if the block were known."""
    A = np.random.default_rng(5).standard_normal((SIZE, SIZE))
    covariance, known = A @ A.T, np.delete(np.arange(SIZE), np.r_[LEVER_ARM])
    prior = prior_of(some_unknowns(), covariance[np.ix_(known, known)], known, False)
    rest = np.delete(np.arange(SIZE), np.r_[LEVER_ARM, START_POSITION])
    left = prior.without(START_POSITION)
    assert np.allclose(np.linalg.inv(left.information[np.ix_(rest, rest)]),
                       covariance[np.ix_(rest, rest)], rtol=1e-6, atol=1e-6)
    assert not left.information[START_POSITION].any() and left.mean is prior.mean
    assert left.without(START_POSITION) is left


def test_inverse_of_rows_of_any_scale():
    root = np.random.default_rng(0).standard_normal((6, 6))
    scale = np.diag(10.0 ** np.array([-8, -4, 0, 3, 6, 8]))
    matrix = scale @ (root @ root.T + np.eye(6)) @ scale
    inverse = inverse_spd(matrix)
    assert np.allclose(scale @ inverse @ scale, np.linalg.inv(root @ root.T + np.eye(6)))
    assert np.array_equal(inverse, inverse.T)
