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
"""
Rotation vectors, matrices and quaternions, over leading axes; transforms between fixed frames.

Matrices are ``C_xy`` (components in y to components in x), quaternions are (x, y, z, w) of the
same rotation with w >= 0, angles are radians.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Index = NDArray[np.integer[Any]]

# Below this angle (rad) four terms of the Taylor series of (x - sin x)/x^3 are exact to rounding.
_SERIES_ANGLE = 0.05
_TINY = 1e-300          # added to an angle, so that it can be a divisor


def apply(matrix: Array, vectors: Array) -> Array:
    """
    Return ``matrix @ vector``, shapes (..., m, n) and (..., n), with leading axes that broadcast.

    Each product is computed separately: in one of a matrix with many vectors, the last bit depends
    on their number.
    """
    return (matrix @ vectors[..., None])[..., 0]


def product(left: Array, right: Array) -> Array:
    """
    Return ``left @ right``, shapes (..., m, n) and (..., n, k), in Fortran order.

    Written out term by term, which is faster for many small matrices in Fortran order.
    """
    terms = (np.multiply(left[..., k:k + 1], right[..., k:k + 1, :], order='F')
             for k in range(left.shape[-1]))
    total: Array = next(terms)
    for term in terms:
        total += term
    return total


def by_row(matrix: Array, vectors: Array) -> Array:
    """Return the derivative of ``matrix @ X @ vector`` to X, row by row, shape (..., 3, 9)."""
    return (matrix[..., None] * vectors[..., None, None, :]).reshape(matrix.shape[:-1] + (9,))


def skew(vector: ArrayLike) -> Array:
    """Return the matrix ``[v x]``, shape (..., 3, 3), of v, shape (..., 3)."""
    v = np.asarray(vector, dtype=float)
    matrix = np.zeros(v.shape + (3,))
    matrix[..., 0, 1] = -v[..., 2]
    matrix[..., 0, 2] = v[..., 1]
    matrix[..., 1, 0] = v[..., 2]
    matrix[..., 1, 2] = -v[..., 0]
    matrix[..., 2, 0] = -v[..., 1]
    matrix[..., 2, 1] = v[..., 0]
    return matrix


def cross(a: ArrayLike, b: ArrayLike) -> Array:
    """
    Return the cross product over the last axis, in the memory order of the larger argument.

    On small arrays this is several times faster than numpy.cross.
    """
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    result = np.empty_like(a if a.size > b.size else b, shape=np.broadcast(a, b).shape)
    result[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    result[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    result[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return result


_EYE = np.eye(3)
_SKEWS = skew(_EYE).reshape(3, 9)       # row i: the skew matrix of unit vector i


def _trigonometric_factors(angle2: Array) -> tuple[Array, Array]:
    """Return sin(x)/x and (1 - cos x)/x^2 for x^2, exact to rounding by half-angle formulas."""
    half = 0.5 * np.sqrt(angle2) + _TINY
    ratio = np.sin(half) / half
    return ratio * np.cos(half), 0.5 * ratio * ratio


def exp_and_left_jacobian(vector: ArrayLike) -> tuple[Array, Array]:
    """
    Return `exp_so3` of rotation vectors, shape (..., 3), and the left Jacobian of SO(3).

    The latter is the effect of a change of a rotation vector on its rotation:
    ``exp_so3(v + d) ~ exp_so3(left_jacobian d) exp_so3(v)``.
    """
    v = np.asarray(vector, dtype=float)
    angle2 = _squared_norm(v)
    a, b = _trigonometric_factors(angle2)
    small = angle2 < _SERIES_ANGLE ** 2
    c = np.where(small, 1 / 6 - angle2 / 120 * (1 - angle2 / 42 * (1 - angle2 / 72)),
                 (1 - a) / np.where(small, 1.0, angle2))        # (x - sin x)/x^3
    return _rodrigues(v, angle2, a, b), _rodrigues(v, angle2, b, c)


def _squared_norm(v: Array) -> Array:
    squares = v * v
    return np.asarray(squares[..., 0] + squares[..., 1] + squares[..., 2])


def _rodrigues(v: Array, angle2: Array, odd: Array, even: Array) -> Array:
    """Return ``I + odd [v x] + even [v x]^2``, shape (..., 3, 3)."""
    # Few numpy calls, because most arrays are small. The product with _SKEWS is exact: all terms
    # of each of its entries are zero but one.
    matrix: Array = (even[..., None] * v)[..., :, None] * v[..., None, :]
    matrix += ((odd[..., None] * v) @ _SKEWS).reshape(matrix.shape)
    matrix += (1.0 - even * angle2)[..., None, None] * _EYE
    return matrix


def exp_so3(vector: ArrayLike) -> Array:
    """Return rotation matrices, shape (..., 3, 3), of rotation vectors (Rodrigues' formula)."""
    v = np.asarray(vector, dtype=float)
    angle2 = np.einsum('...i,...i', v, v)
    return _rodrigues(v, angle2, *_trigonometric_factors(angle2))


def rotated(rotation: Array, vectors: Array) -> Array:
    """Return ``exp_so3(rotation) @ vectors``, all of shape (..., 3), without the matrices."""
    a, b = _trigonometric_factors(_squared_norm(rotation))
    sideways = cross(rotation, vectors)
    return vectors + a[..., None] * sideways + b[..., None] * cross(rotation, sideways)


def log_so3(matrix: ArrayLike) -> Array:
    """
    Return rotation vectors, shape (..., 3), of rotation matrices, angle in [0, pi].

    If all angles are below a right angle they are computed from sine and cosine, otherwise from
    quaternions, which keep full precision near pi.
    """
    m = np.asarray(matrix, dtype=float)
    cosine = 0.5 * (np.einsum('...ii', m) - 1.0)
    if (cosine > 0).all():
        # Half of m_32 - m_23, m_13 - m_31, m_21 - m_12: the axis times the sine of the angle.
        axis, times = 0.5 * (m.reshape(m.shape[:-2] + (9,)) @ _SKEWS.T), 1.0
    else:
        # The axis times the sine of half the angle.
        q = quaternion_from_matrix(m)
        axis, cosine, times = q[..., :3], q[..., 3], 2.0
    sine = np.sqrt(np.einsum('...i,...i', axis, axis)) + _TINY
    angle_over_sine: Array = times * _arctan2(sine, cosine) / sine
    return axis * angle_over_sine[..., None]


def _arctan2(y: Array, x: Array) -> Array:
    """Return arctan2 of contiguous copies: with numpy 1.26 the last bit depends on strides."""
    return np.asarray(np.arctan2(np.array(y), np.array(x)))


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Return rotation matrices of quaternions (x, y, z, w) of any length, shape (..., 4)."""
    q = np.asarray(quaternion, dtype=float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    s = skew(q[..., :3])
    return _EYE + 2 * (q[..., 3, None, None] * s + s @ s)


def quaternion_from_matrix(matrix: ArrayLike) -> Array:
    """
    Return quaternions (x, y, z, w), shape (..., 4), w >= 0, of rotation matrices.

    Shepperd's method divides by the largest of the four components (S. W. Shepperd, "Quaternion
    from rotation matrix", J. Guidance and Control 1(3), 1978).
    """
    m = np.asarray(matrix, dtype=float)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    # Row i of this symmetric matrix is 4 q_i q.
    k = np.empty(m.shape[:-2] + (4, 4))
    k[..., :3, :3] = m + m.swapaxes(-1, -2)
    for i, row, column in (0, 2, 1), (1, 0, 2), (2, 1, 0):
        k[..., i, i] = 1 + k[..., i, i] - trace
        k[..., i, 3] = k[..., 3, i] = m[..., row, column] - m[..., column, row]
    k[..., 3, 3] = 1 + trace
    largest = np.argmax(np.diagonal(k, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(k, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def matrix_from_rpy(rpy: ArrayLike) -> Array:
    """
    Return ``C_nb = Rz(yaw) Ry(pitch) Rx(roll)`` (REP-103) of roll, pitch, yaw, shape (..., 3).

    Yaw is counter-clockwise from east.
    """
    rpy = np.asarray(rpy, dtype=float)
    x, y, z = _EYE
    return (exp_so3(rpy[..., 2, None] * z) @ exp_so3(rpy[..., 1, None] * y)
            @ exp_so3(rpy[..., 0, None] * x))


def roll_pitch_yaw(matrix: ArrayLike) -> Array:
    """
    Return roll, pitch and yaw of ``C_nb``, shape (..., 3): the inverse of `matrix_from_rpy`.

    Pitch is in [-pi/2, pi/2], the others are in (-pi, pi].
    """
    m = np.asarray(matrix, dtype=float)
    return np.stack([_arctan2(m[..., 2, 1], m[..., 2, 2]),
                     _arctan2(-m[..., 2, 0], np.hypot(m[..., 0, 0], m[..., 1, 0])),
                     _arctan2(m[..., 1, 0], m[..., 0, 0])], axis=-1)


def nearest_rotation(matrix: Array) -> Array:
    """Return the rotations nearest to matrices, shape (..., 3, 3), by least squares."""
    U, _, V = np.linalg.svd(matrix)
    U[..., 2] *= np.sign(np.linalg.det(U @ V))[..., None]      # no reflection
    nearest: Array = U @ V
    return nearest


def orthonormalized(matrix: Array) -> Array:
    """Return the nearest rotation, to first order, of a product that rounding has distorted."""
    return 1.5 * matrix - 0.5 * matrix @ (matrix.swapaxes(-1, -2) @ matrix)


def cumulative_rotations(steps: Array) -> Array:
    """
    Return ``steps[0] @ ... @ steps[k]`` for every k, shape (..., n, 3, 3).

    No bit of the products depends on the other leading axes.
    """
    steps = np.ascontiguousarray(np.moveaxis(steps, -3, 0))
    total = steps.copy()
    for before, step, after in zip(total[:-1], steps[1:], total[1:]):
        np.matmul(before, step, out=after)
    return np.moveaxis(total, 0, -3)


def running_sum(start: Array, steps: Array) -> Array:
    """Return ``start + steps[0] + ... + steps[k]`` for every k, added one after the other."""
    return np.cumsum(np.concatenate([start[None], steps]), axis=0)[1:]


class Transform(NamedTuple):
    """Takes vectors from a source frame to a target frame: rotate, then add the translation."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,), m

    def after(self, other: Transform) -> Transform:
        """Return the transform that applies the other one first."""
        return Transform(self.rotation @ other.rotation,
                         self.rotation @ other.translation + self.translation)

    def inverse(self) -> Transform:
        """Return the transform from target to source."""
        return Transform(self.rotation.T, -self.rotation.T @ self.translation)
