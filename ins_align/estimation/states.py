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
The error state of a filter, and linearised motion and measurements of epochs.

These are the indices, shapes and names that the modules of the estimation share.
"""

from dataclasses import dataclass

from ins_align.geometry.rotation import apply, Array, cross, skew
import numpy as np

# Places in the error state; the parameters follow from FIRST on: lever arm, delay, errors of the
# gyros (bias, then matrix), errors of the accelerometers.
PHI, XI, RHO, PHI0, FIRST = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12
LEVER_ARM, DELAY, GYRO = slice(0, 3), 3, 4          # in the parameters
# At their end, with a vehicle: mounting and drift, each sideways and upwards.
MOUNT, DRIFT, OF_VEHICLE = slice(-4, -2), slice(-2, None), 4

# One hypothesis is believed against another when it is likelier by this (log likelihood).
MARGIN = 6.0


def triads(m: int) -> tuple[slice, slice]:
    """Return the places of the errors of gyros and accelerometers among m parameters."""
    size = (m - GYRO) // 6 * 3                  # a bias, or a bias and a matrix
    return slice(GYRO, GYRO + size), slice(GYRO + size, GYRO + 2 * size)


def biases(m: int) -> tuple[slice, slice]:
    """Return the places of the biases of gyros and accelerometers among m parameters."""
    gyro, accel = (slice(triad.start, triad.start + 3) for triad in triads(m))
    return gyro, accel


def turned_parameters(d: Array, half: Array, rest: Array) -> Array:
    """
    Return the change of the parameters, (B, m), by errors d, (B, n).

    `half` is half of the turn by phi, (B, 3, 3). Biases of the accelerometers turn with it,

        a_true = a + g - exp(-phi) (g - da + phi x g)

    with g the force at rest, `rest`, (B, 3): the force that a mean then feels is linear in the
    errors.
    """
    x = d[:, FIRST:].copy()
    accel = biases(x.shape[1])[1]
    x[:, accel] = rest - _felt(d[:, PHI], x[:, accel], half.swapaxes(1, 2), rest)
    return x


def _felt(phi: Array, d_accel: Array, back: Array, rest: Array) -> Array:
    """Return the force that the corrected mean feels at rest, (B, 3)."""
    return apply(back @ back, rest - d_accel + cross(phi, rest))


def transport(d: Array, half: Array, rest: Array) -> Array:
    """
    Return G, (B, 15, 15): errors d + e of a mean are about G e where d has corrected it.

    The product of a correction of velocity or position and an error of the attitude, which the
    group has too, is left out: a measurement takes it off again (docs, "Theory").

    d and e, (B, 15), are errors of attitude, velocity, position, attitude at t0, and biases of the
    accelerometers. `half` has half of the turns by phi and phi0, (2, B, 3, 3); `rest` is as in
    `turned_parameters`.
    """
    G = np.zeros((*d.shape, d.shape[1]))
    back, accel = half[0].swapaxes(1, 2), slice(FIRST, FIRST + 3)
    G[:, PHI, PHI], G[:, PHI0, PHI0] = half.swapaxes(2, 3)
    G[:, XI, XI] = G[:, RHO, RHO] = back
    G[:, accel, accel] = back @ back
    G[:, accel, PHI] = (back @ back @ skew(rest)
                        - skew(_felt(d[:, PHI], d[:, accel], back, rest)) @ back)
    return G


@dataclass
class Linearised:
    """Motion and measurements of K epochs, linearised at the parameters of each of M rivals."""

    point: Array  #: (M, m), the parameters x
    duration: list[float]  #: s
    #: (K, M, 3, 3), rotation over the interval before each epoch, corrected for `point`.
    R: Array
    moved: Array  #: (K, M, 6), velocity and position gained in the interval
    J: Array  #: (K, M, 9, m), derivatives of rotation, velocity and position to x
    F: Array  #: (K, M, 9, n), transition of phi, xi, rho
    Q: Array  #: (K, M, 9, 9), process noise of phi, xi, rho from the noise of the IMU
    H: Array  #: (K, 2, M, 3, n), derivatives of velocity and position, in the body, to the errors
    #: (K, 2, M, 3), velocity and position of the IMU minus the measured ones, in the body
    expected: Array
    #: Of the velocity of the vehicle's base: derivatives, (K, M, 3, n); `expected`, (K, M, 3); and
    #: the rotation from the body frame at the time of the measurement to that now, (K, M, 3, 3).
    base: tuple[Array, Array, Array] | None = None


@dataclass
class Measured:
    """The GNSS measurements of K epochs in n0; see `track.InertialTrack`."""

    s: Array  #: (K, 2, 3), s_v and s_p
    covariance: Array  #: (K, 2, 3, 3)
    present: list[tuple[bool, bool]]  #: whether there is a velocity, a position
    vertical: list[bool]  #: whether the vertical velocity or position is measured
    stated: list[tuple[bool, bool]]  #: whether the receiver states its noise
    still: Array  #: (K, 3), s_v of an antenna at rest
