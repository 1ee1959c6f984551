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
Rotations: vectors, matrices, quaternions; every function works over leading axes.

Matrices are ``C_xy`` (components in y to components in x), quaternions are (x, y, z, w) of the
same rotation with w >= 0, angles are radians.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Index = NDArray[np.integer[Any]]

# Below this angle (rad) four terms of the Taylor series of sin(x)/x and friends are exact to
# rounding, below the second one two are.
_SERIES_ANGLE, _SMALL_ANGLE = 0.05, 1e-3
# Numbers from which on arrays are summed one by one.
_MANY = 100


def apply(matrix: Array, vectors: Array) -> Array:
    """
    Products of matrices and vectors.

    Each on its own: those of one matrix with many vectors at a time depend, in the last bit, on
    how many they are.

    Parameters
    ----------
    matrix : ndarray, shape (..., m, n)
        One, or one for each vector.
    vectors : ndarray, shape (..., n)
        Many of them.

    Returns
    -------
    ndarray, shape (..., m)

    """
    return (matrix @ vectors[..., None])[..., 0]


def product(left: Array, right: Array) -> Array:
    """
    Return ``left @ right``, written out: with the stack in Fortran order, for many at a time.

    Parameters
    ----------
    left : ndarray, shape (..., m, n)
        One, or one for each right one.
    right : ndarray, shape (..., n, k)
        Many of them.

    Returns
    -------
    ndarray, shape (..., m, k)
        In Fortran order.

    """
    terms = (np.multiply(left[..., k:k + 1], right[..., k:k + 1, :], order='F')
             for k in range(left.shape[-1]))
    total: Array = next(terms)
    for term in terms:
        total += term
    return total


def by_row(matrix: Array, vectors: Array) -> Array:
    """
    Derive ``matrix @ X @ vector`` by X, row by row.

    Parameters
    ----------
    matrix : ndarray, shape (..., 3, 3)
        The left factor.
    vectors : ndarray, shape (..., 3)
        The right factor.

    Returns
    -------
    ndarray, shape (..., 3, 9)

    """
    return (matrix[..., None] * vectors[..., None, None, :]).reshape(matrix.shape[:-1] + (9,))


def skew(vector: ArrayLike) -> Array:
    """
    Cross-product matrix ``[v x]``.

    Parameters
    ----------
    vector : array_like, shape (..., 3)
        The left factor.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        ``skew(a) @ b == cross(a, b)``.

    """
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
    Cross product over the last axis; leading axes broadcast.

    Several times faster than numpy.cross on the small arrays of one GNSS interval. The result is
    laid out in memory as the larger one is.
    """
    a = np.asarray(a, dtype=float)
    b = np.asarray(b, dtype=float)
    result = np.empty_like(a if a.size > b.size else b, shape=np.broadcast(a, b).shape)
    result[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    result[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    result[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return result


def _trigonometric_factors(angle2: Array) -> tuple[Array, Array]:
    """sin(x)/x and (1 - cos x)/x^2 of x^2."""
    a = 1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42))
    b = 0.5 - angle2 / 24 * (1 - angle2 / 30 * (1 - angle2 / 56))
    small = angle2 < _SERIES_ANGLE ** 2
    if small.all():
        return a, b
    x2 = np.where(small, 1.0, angle2)
    x = np.sqrt(x2)
    return (np.where(small, a, np.sin(x) / x),
            np.where(small, b, 2 * np.sin(x / 2) ** 2 / x2))


def exp_and_left_jacobian(vector: ArrayLike) -> tuple[Array, Array]:
    """
    Return `exp_so3` of rotation vectors, shape (..., 3), and the left Jacobian of SO(3).

    The latter says what a change of a rotation vector does to its rotation:
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
    matrix = (even[..., None] * v)[..., :, None] * v[..., None, :]
    diagonal = 1.0 - even * angle2
    w = odd[..., None] * v
    matrix[..., 0, 0] += diagonal
    matrix[..., 1, 1] += diagonal
    matrix[..., 2, 2] += diagonal
    matrix[..., 0, 1] -= w[..., 2]
    matrix[..., 0, 2] += w[..., 1]
    matrix[..., 1, 0] += w[..., 2]
    matrix[..., 1, 2] -= w[..., 0]
    matrix[..., 2, 0] -= w[..., 1]
    matrix[..., 2, 1] += w[..., 0]
    return matrix


def exp_so3(vector: ArrayLike) -> Array:
    """
    Rotation matrix of a rotation vector (Rodrigues' formula).

    Parameters
    ----------
    vector : array_like, shape (..., 3)
        Radians.

    Returns
    -------
    ndarray, shape (..., 3, 3)

    """
    v = np.asarray(vector, dtype=float)
    if v.ndim > 1:
        squares = _squared_norm(v)
        return _rodrigues(v, squares, *_trigonometric_factors(squares))
    x, y, z = v.tolist()                          # a single one is quicker without arrays
    angle2 = x * x + y * y + z * z
    if angle2 < _SMALL_ANGLE ** 2:
        a, b = 1 - angle2 / 6, 0.5 - angle2 / 24
    else:
        angle = math.sqrt(angle2)
        a, b = math.sin(angle) / angle, 2 * math.sin(angle / 2) ** 2 / angle2
    d = 1 - b * angle2
    return np.array([[d + b * x * x, b * x * y - a * z, b * x * z + a * y],
                     [b * x * y + a * z, d + b * y * y, b * y * z - a * x],
                     [b * x * z - a * y, b * y * z + a * x, d + b * z * z]])


def rotated(rotation: Array, vectors: Array) -> Array:
    """
    Return ``exp_so3(rotation) @ vectors`` without the matrices.

    Parameters
    ----------
    rotation, vectors : ndarray, shape (..., 3)
        Rotation vectors, radians, and what is turned by them.

    Returns
    -------
    ndarray, shape (..., 3)

    """
    a, b = _trigonometric_factors(_squared_norm(rotation))
    sideways = cross(rotation, vectors)
    return vectors + a[..., None] * sideways + b[..., None] * cross(rotation, sideways)


def log_so3(matrix: ArrayLike) -> Array:
    """
    Rotation vector of a rotation matrix, angle in [0, pi].

    Up to a right angle from sine and cosine, beyond it through the quaternion, which keeps full
    precision near pi.

    Parameters
    ----------
    matrix : array_like, shape (..., 3, 3)
        Rotation matrix.

    Returns
    -------
    ndarray, shape (..., 3)
        Radians.

    """
    m = np.asarray(matrix, dtype=float)
    cosine = 0.5 * (m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2] - 1)
    if (cosine > 0).all():
        axis = np.empty(m.shape[:-1])
        axis[..., 0] = m[..., 2, 1] - m[..., 1, 2]
        axis[..., 1] = m[..., 0, 2] - m[..., 2, 0]
        axis[..., 2] = m[..., 1, 0] - m[..., 0, 1]
        axis, part = 0.5 * axis, 1.0                # of the angle, whose sine the axis has
    else:
        q = quaternion_from_matrix(m)
        axis, cosine, part = q[..., :3], q[..., 3], 2.0
    sine = np.sqrt(_squared_norm(axis))
    small = sine < 1e-12
    scale = np.where(small, part, part * _arctan2(sine, cosine) / np.where(small, 1.0, sine))
    return axis * scale[..., None]


def _arctan2(y: Array, x: Array) -> Array:
    """Of packed copies: the last bit of others depends, with numpy 1.26, on where they lie."""
    angle: Array = np.arctan2(np.array(y), np.array(x))
    return angle


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """
    Rotation matrix of a quaternion, which is normalised first.

    Parameters
    ----------
    quaternion : array_like, shape (..., 4)
        (x, y, z, w).

    Returns
    -------
    ndarray, shape (..., 3, 3)

    """
    q = np.asarray(quaternion, dtype=float)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    s = skew(q[..., :3])
    return np.eye(3) + 2 * (q[..., 3, None, None] * s + s @ s)


def quaternion_from_matrix(matrix: ArrayLike) -> Array:
    """
    Quaternion of a rotation matrix, w >= 0.

    Shepperd's method, which divides by the largest of the four components (S. W. Shepperd,
    "Quaternion from rotation matrix", J. Guidance and Control 1(3), 1978).

    Parameters
    ----------
    matrix : array_like, shape (..., 3, 3)
        Rotation matrix.

    Returns
    -------
    ndarray, shape (..., 4)
        (x, y, z, w).

    """
    m = np.asarray(matrix, dtype=float)
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    # Row i of this symmetric matrix is 4 q_i q.
    k = np.empty(m.shape[:-2] + (4, 4))
    for i in range(3):
        k[..., i, i] = 1 + 2 * m[..., i, i] - trace
    k[..., 3, 3] = 1 + trace
    k[..., 0, 1] = k[..., 1, 0] = m[..., 1, 0] + m[..., 0, 1]
    k[..., 0, 2] = k[..., 2, 0] = m[..., 2, 0] + m[..., 0, 2]
    k[..., 1, 2] = k[..., 2, 1] = m[..., 2, 1] + m[..., 1, 2]
    k[..., 0, 3] = k[..., 3, 0] = m[..., 2, 1] - m[..., 1, 2]
    k[..., 1, 3] = k[..., 3, 1] = m[..., 0, 2] - m[..., 2, 0]
    k[..., 2, 3] = k[..., 3, 2] = m[..., 1, 0] - m[..., 0, 1]
    largest = np.argmax(np.diagonal(k, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(k, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0, -q, q)


def matrix_from_rpy(rpy: ArrayLike) -> Array:
    """
    ``C_nb = Rz(yaw) Ry(pitch) Rx(roll)`` (REP-103).

    Parameters
    ----------
    rpy : array_like, shape (..., 3)
        Roll, pitch, yaw in radians; yaw is counter-clockwise from east.

    Returns
    -------
    ndarray, shape (..., 3, 3)

    """
    rpy = np.asarray(rpy, dtype=float)
    x, y, z = np.eye(3)
    return (exp_so3(rpy[..., 2, None] * z) @ exp_so3(rpy[..., 1, None] * y)
            @ exp_so3(rpy[..., 0, None] * x))


def roll_pitch_yaw(matrix: ArrayLike) -> Array:
    """
    Roll, pitch and yaw of ``C_nb``: the inverse of `matrix_from_rpy`.

    Parameters
    ----------
    matrix : array_like, shape (..., 3, 3)
        ``C_nb``.

    Returns
    -------
    ndarray, shape (..., 3)
        Radians; pitch in [-pi/2, pi/2], the others in (-pi, pi].

    """
    m = np.asarray(matrix, dtype=float)
    return np.stack([_arctan2(m[..., 2, 1], m[..., 2, 2]),
                     _arctan2(-m[..., 2, 0], np.hypot(m[..., 0, 0], m[..., 1, 0])),
                     _arctan2(m[..., 1, 0], m[..., 0, 0])], axis=-1)


def orthonormalized(matrix: Array) -> Array:
    """
    Nearest rotation matrix to first order, against drift of long products.

    Parameters
    ----------
    matrix : ndarray, shape (..., 3, 3)
        A rotation matrix up to rounding.

    Returns
    -------
    ndarray, shape (..., 3, 3)

    """
    return 1.5 * matrix - 0.5 * matrix @ (matrix.swapaxes(-1, -2) @ matrix)


def cumulative_rotations(steps: Array) -> Array:
    """
    Prefix products ``steps[0] @ steps[1] @ ... @ steps[k]`` for every k.

    One after the other, over all leading axes at once: what comes out for one run does not depend
    on what else is worked out with it, to the last bit.

    Parameters
    ----------
    steps : ndarray, shape (..., n, 3, 3)
        Rotation matrices.

    Returns
    -------
    ndarray, shape (..., n, 3, 3)

    """
    steps = np.ascontiguousarray(np.moveaxis(steps, -3, 0))
    total = steps.copy()
    for before, step, after in zip(total[:-1], steps[1:], total[1:]):
        np.matmul(before, step, out=after)
    return np.moveaxis(total, 0, -3)


def running_sum(start: Array, steps: Array) -> Array:
    """Return ``start + steps[0] + ... + steps[k]`` for every k, to the bit as one by one."""
    if start.size < _MANY:
        return np.cumsum(np.concatenate([start[None], steps]), axis=0)[1:]
    total = np.empty(steps.shape)
    for step, after in zip(steps, total):         # several times faster than a sum over axis 0
        start = np.add(start, step, out=after)
    return total
