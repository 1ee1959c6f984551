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
"""Rotations against scipy.spatial.transform and algebra."""

from hypothesis import given, settings
from hypothesis import strategies as st
from ins_align.geometry import rotation
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

SMALL = (0.0, 1e-300, 1e-12, 1e-8, 9.9e-4, 1.01e-3, 0.1)
LARGE = (1.0, 3.0, np.pi - 1e-3, np.pi - 1e-8, np.pi)


@pytest.fixture(scope='module')
def random_rotations():
    return Rotation.random(200, random_state=1)


def directions():
    random = np.random.default_rng(2).standard_normal((20, 3))
    axes = np.vstack([np.eye(3), -np.eye(3), random])
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def test_skew_and_cross_are_the_cross_product():
    a, b = np.random.default_rng(0).standard_normal((2, 4, 5, 3))
    expected = np.cross(a, b)
    assert np.allclose((rotation.skew(a) @ b[..., None])[..., 0], expected, atol=1e-15)
    assert np.allclose(rotation.cross(a, b), expected, atol=1e-15)
    assert np.allclose(rotation.cross(a, b[0, 0]), np.cross(a, b[0, 0]), atol=1e-15)


def test_products_written_out_are_products():
    random = np.random.default_rng(0)
    left, right = random.standard_normal((5, 4, 3, 3)), random.standard_normal((5, 4, 3, 2))
    for order in 'CF':
        left, right = (np.array(each, order=order) for each in (left, right))
        for one in (left, left[0, 0]):
            product = rotation.product(one, right)
            assert np.allclose(product, one @ right, atol=1e-14) and product.flags.f_contiguous
        assert np.array_equal(rotation.product(left[1:2], right[1:2]),
                              rotation.product(left, right)[1:2])


@pytest.mark.parametrize('angle', SMALL + LARGE + (5.0, 20.0))
def test_vectors_are_rotated_as_by_the_matrix(angle):
    rotations = angle * directions()
    vectors = np.random.default_rng(1).standard_normal(rotations.shape)
    expected = rotation.apply(rotation.exp_so3(rotations), vectors)
    assert np.allclose(rotation.rotated(rotations, vectors), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize('angle', SMALL + LARGE + (5.0, 20.0))
def test_exp_is_the_matrix_exponential(angle):
    vectors = angle * directions()
    matrices = rotation.exp_so3(vectors)
    assert np.allclose(matrices, Rotation.from_rotvec(vectors).as_matrix(), atol=4e-15)
    assert np.allclose(matrices[7], expm(rotation.skew(vectors[7])), atol=1e-13)


@pytest.mark.parametrize('angle', SMALL + LARGE)
def test_log_inverts_exp_at_every_angle(angle):
    vectors = angle * directions()
    back = rotation.log_so3(rotation.exp_so3(vectors))
    if angle > np.pi - 1e-6:
        # Half a turn about an axis is half a turn about its opposite.
        back *= np.sign(np.sum(back * vectors, axis=1, keepdims=True))
    assert np.allclose(back, vectors, rtol=1e-9, atol=1e-15)


def test_log_keeps_small_angles_to_relative_precision():
    vectors = 1e-10 * directions()
    assert np.allclose(rotation.log_so3(rotation.exp_so3(vectors)), vectors, rtol=1e-9, atol=0)


@pytest.mark.parametrize('angle', (1e-9, 1e-4, 0.01, 1.0, 3.0))
def test_left_jacobian_is_the_derivative_of_exp(angle):
    for vector in angle * directions()[:9]:
        numeric = np.empty((3, 3))
        for axis in range(3):
            step = 1e-5 * np.eye(3)[axis]
            before, after = (Rotation.from_rotvec(v) for v in (vector - step, vector + step))
            numeric[:, axis] = (after * before.inv()).as_rotvec() / 2e-5
        assert np.allclose(rotation.exp_and_left_jacobian(vector)[1], numeric, atol=1e-9)


def test_quaternions_are_those_of_scipy_with_positive_w(random_rotations):
    matrices = random_rotations.as_matrix()
    q = rotation.quaternion_from_matrix(matrices)
    assert np.all(q[:, 3] >= 0)
    assert np.allclose(q, random_rotations.as_quat(canonical=True), atol=1e-14)
    assert np.allclose(rotation.matrix_from_quaternion(q), matrices, atol=1e-14)
    assert np.allclose(rotation.matrix_from_quaternion(-3 * q), matrices, atol=1e-14)


def test_quaternions_of_half_turns_are_exact():
    for axis in np.vstack([np.eye(3), directions()]):
        matrix = 2 * np.outer(axis, axis) - np.eye(3)
        q = rotation.quaternion_from_matrix(matrix)
        assert np.allclose(rotation.matrix_from_quaternion(q), matrix, atol=1e-14)


def test_roll_pitch_yaw_as_rep_103_has_them():
    rpy = np.random.default_rng(4).uniform([-3.1, -1.5, -3.1], [3.1, 1.5, 3.1], (200, 3))
    expected = Rotation.from_euler('ZYX', rpy[:, ::-1]).as_matrix()
    assert np.allclose(rotation.matrix_from_rpy(rpy), expected, atol=1e-14)
    assert np.allclose(rotation.roll_pitch_yaw(expected), rpy, atol=1e-12)


def test_yaw_is_counter_clockwise_from_east_and_pitch_is_nose_down():
    north = rotation.matrix_from_rpy([0.0, 0.0, np.pi / 2])
    assert np.allclose(north @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    nose_down = rotation.matrix_from_rpy([0.0, 0.3, 0.0])
    assert (nose_down @ [1.0, 0.0, 0.0])[2] < 0


@pytest.mark.parametrize('pitch', (np.pi / 2, -np.pi / 2))
def test_vertical_nose_still_gives_angles_of_the_same_rotation(pitch):
    matrix = rotation.matrix_from_rpy([0.4, pitch, 0.9])
    rpy = rotation.roll_pitch_yaw(matrix)
    assert np.all(np.isfinite(rpy))
    assert rpy[1] == pytest.approx(pitch, abs=1e-7)


def test_the_memory_that_a_call_gets_does_not_change_the_last_bit():
    matrices = Rotation.random(500, random_state=3).as_matrix()
    random = np.random.default_rng(4)
    first, held = rotation.log_so3(matrices), []
    for _ in range(4000):
        held = [*held[-20:], np.empty(random.integers(1, 9000))]
        assert np.array_equal(rotation.log_so3(matrices), first)


@pytest.mark.parametrize('count', (1, 2, 3, 7, 8, 33))
def test_cumulative_rotations_are_the_products_one_by_one(count):
    steps = Rotation.random(3 * count, random_state=count).as_matrix().reshape(3, count, 3, 3)
    original = steps.copy()
    total = rotation.cumulative_rotations(steps)
    for batch in range(3):
        product = np.eye(3)
        for k in range(count):
            product = product @ steps[batch, k]
            assert np.allclose(total[batch, k], product, atol=1e-13)
    assert np.array_equal(steps, original)


def test_the_nearest_rotation_solves_wahbas_problem():
    """Of matrices of any kind, also where a reflection is nearer."""
    matrices = np.random.default_rng(4).normal(size=(20, 3, 3))
    assert {True, False} == set((np.linalg.det(matrices) < 0).tolist())
    for matrix, nearest in zip(matrices, rotation.nearest_rotation(matrices)):
        expected = Rotation.align_vectors(matrix.T, np.eye(3))[0].as_matrix()
        assert np.allclose(nearest, expected, atol=1e-12)


def test_orthonormalized_takes_out_what_is_no_rotation(random_rotations):
    matrix = random_rotations[0].as_matrix()
    spoilt = matrix + 1e-6 * np.random.default_rng(5).standard_normal((3, 3))
    good = rotation.orthonormalized(spoilt)
    assert np.allclose(good @ good.T, np.eye(3), atol=1e-11)
    u, _, vt = np.linalg.svd(spoilt)
    assert np.allclose(good, u @ vt, atol=1e-11)  # the nearest rotation of all


def test_a_day_of_products_stays_a_rotation():
    step = rotation.exp_so3([1e-2, -2e-2, 3e-2])
    matrix = np.eye(3)
    for _ in range(100_000):
        matrix = rotation.orthonormalized(matrix @ step)
    assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-15)
    exact = Rotation.from_rotvec(np.array([1e-2, -2e-2, 3e-2]) * 100_000).as_matrix()
    assert np.allclose(matrix, exact, atol=1e-9)


@pytest.mark.parametrize('shape', [(), (3,), (9, 11), (10, 10), (38, 38)])
@pytest.mark.parametrize('count', [0, 1, 2, 40])
def test_running_sum_is_the_same_to_the_bit_however_it_is_split(shape, count):
    random = np.random.default_rng(count)
    start, steps = np.asarray(random.normal(size=shape)), random.normal(size=(count,) + shape)
    expected, so_far = [], start
    for step in steps:
        so_far = so_far + step
        expected.append(so_far)
    sums = rotation.running_sum(start, steps)
    assert sums.shape == steps.shape
    assert np.array_equal(sums, np.reshape(expected, steps.shape))
    if count > 1:
        rest = rotation.running_sum(sums[count // 2 - 1], steps[count // 2:])
        assert np.array_equal(rest, sums[count // 2:])


finite = st.floats(-50.0, 50.0)


@settings(max_examples=60, deadline=None)
@given(st.tuples(finite, finite, finite), st.tuples(finite, finite, finite))
def test_exp_is_a_rotation_and_composes_about_one_axis(a, b):
    matrix = rotation.exp_so3(a)
    assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(matrix) == pytest.approx(1.0, abs=1e-12)
    assert np.allclose(rotation.exp_so3(np.multiply(0.5, a)) @ rotation.exp_so3(
        np.multiply(0.5, a)), matrix, atol=1e-12)
    assert np.allclose(matrix @ rotation.exp_so3(b) @ matrix.T,
                       rotation.exp_so3(matrix @ np.array(b)), atol=1e-11)
