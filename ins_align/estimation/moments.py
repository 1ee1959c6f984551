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
"""The q-method for pairs of vectors, with an unknown start: an attitude from their moments."""

from ins_align.geometry.rotation import Array, matrix_from_quaternion
import numpy as np


def solve_moments(moments: Array) -> tuple[Array, Array, Array]:
    """
    Davenport's q-method for ``sum |s - (unknown start) - C a|^2``, vectors not normalised.

    The start is regressed out of the moments first.

    Parameters
    ----------
    moments : ndarray, shape (..., 6 + n, 6 + n)
        Sums of the products of each pair: s, a and the n values that multiply the unknown start.
        With a free start that is 1 for velocities, 1 and time for positions.

    Returns
    -------
    C : ndarray, shape (..., 3, 3)
        The attitude.
    residual : ndarray, shape (...)
        Residual sum of squares, the smallest eigenvalue of ``K = total I - 2 D`` (not negative).
    A : ndarray, shape (..., 3, 3)
        Moments of a about the regression.

    """
    zm = moments[..., 6:, :6]
    m = moments[..., :6, :6] - zm.swapaxes(-1, -2) @ np.linalg.pinv(
        moments[..., 6:, 6:], hermitian=True) @ zm
    B, total = m[..., :3, 3:], np.trace(m, axis1=-2, axis2=-1)
    trace = np.trace(B, axis1=-2, axis2=-1)
    twist = B.swapaxes(-1, -2) - B
    D = np.empty((*trace.shape, 4, 4))
    D[..., :3, :3] = B + B.swapaxes(-1, -2) - trace[..., None, None] * np.eye(3)
    D[..., :3, 3] = D[..., 3, :3] = twist[..., [1, 2, 0], [2, 0, 1]]
    D[..., 3, 3] = trace
    values, vectors = np.linalg.eigh(np.multiply.outer(total, np.eye(4)) - 2 * D)
    return (matrix_from_quaternion(vectors[..., 0]), np.maximum(values[..., 0], 0.0),
            m[..., 3:, 3:])
