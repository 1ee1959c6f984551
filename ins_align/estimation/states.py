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
The error state of a filter, and what filters take of epochs: motion and measurements.

A leaf of the imports: places, shapes and names that the modules of the estimation share.
"""

from dataclasses import dataclass

from ins_align.geometry.rotation import Array

# Places in the error state; the parameters follow from FIRST on: lever arm, delay, errors of the
# gyros (bias, then matrix), errors of the accelerometers.
PHI, XI, RHO, PHI0, FIRST = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12
LEVER_ARM, DELAY, GYRO = slice(0, 3), 3, 4          # in the parameters
# At their end, where a vehicle is known: mounting and drift, each sideways and upwards.
MOUNT, DRIFT, OF_VEHICLE = slice(-4, -2), slice(-2, None), 4

# One hypothesis has to be likelier than another by this (log likelihood), to be believed.
MARGIN = 6.0


def triads(m: int) -> tuple[slice, slice]:
    """Return the places of the errors of gyros and accelerometers among m parameters."""
    size = (m - GYRO) // 6 * 3                  # a bias, or a bias and a matrix
    return slice(GYRO, GYRO + size), slice(GYRO + size, GYRO + 2 * size)


def biases(m: int) -> tuple[slice, slice]:
    """Return the places of the biases of gyros and accelerometers among m parameters."""
    gyro, accel = (slice(triad.start, triad.start + 3) for triad in triads(m))
    return gyro, accel


@dataclass
class Linearised:
    """
    Motion and measurements of K epochs, linearised at the parameters of each of M rivals.

    Attributes
    ----------
    point : ndarray, shape (M, m)
        The parameters x.
    duration : list of float
        Seconds.
    R : ndarray, shape (K, M, 3, 3)
        Rotation over the interval before each epoch, corrected for the point's sensor errors.
    moved : ndarray, shape (K, M, 6)
        Velocity and position gained in it.
    J : ndarray, shape (K, M, 9, m)
        Derivatives of rotation, velocity and position to x.
    F : ndarray, shape (K, M, 9, n)
        Transition of phi, xi, rho.
    Q : ndarray, shape (K, M, 9, 9)
        What the noise of the IMU adds to their covariance.
    H : ndarray, shape (K, 2, M, 3, n)
        Derivatives of velocity and position, in the body frame, to the errors.
    expected : ndarray, shape (K, 2, M, 3)
        What C u and C w lack, in the body frame, of the measurements.
    base : tuple of ndarray or None
        Of the velocity of the vehicle's base: derivatives, shape (K, M, 3, n); what C u lacks of
        it, (K, M, 3); rotation to the body frame from that at the moment of the measurement,
        (K, M, 3, 3).

    """

    point: Array
    duration: list[float]
    R: Array
    moved: Array
    J: Array
    F: Array
    Q: Array
    H: Array
    expected: Array
    base: tuple[Array, Array, Array] | None = None


@dataclass
class Measured:
    """
    What the GNSS measures of K epochs, in n0; see `track.InertialTrack`.

    Attributes
    ----------
    s : ndarray, shape (K, 2, 3)
        s_v and s_p.
    covariance : ndarray, shape (K, 2, 3, 3)
    present : list of (bool, bool)
        Whether there is a velocity, a position.
    stated : list of (bool, bool)
        Whether the receiver states its noise.
    still : ndarray, shape (K, 3)
        s_v of what rests.

    """

    s: Array
    covariance: Array
    present: list[tuple[bool, bool]]
    stated: list[tuple[bool, bool]]
    still: Array
