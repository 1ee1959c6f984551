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
Recent motion: integrals of the IMU samples from a moment before a GNSS epoch up to it.

A delayed receiver measures where the antenna was some time before the stamp, the age. Integrals
over the age lead back there, at ages ("rungs") close enough to follow a walker's steps.
"""

from functools import lru_cache
import math
from typing import NamedTuple

from ins_align.geometry.rotation import Array, cross, Index, rotated
import numpy as np

# Seconds between the ages, and their number: the last one is the largest delay.
AGE_STEP, AGE_COUNT = 0.025, 40
AGES = AGE_STEP * np.arange(1, AGE_COUNT + 1)
# Between samples this far apart (s) the motion is unknown.
UNKNOWN_STEP = 0.3
# A cubic through ages this many apart takes vibration out of force and rate.
SMOOTH = 2
# Coefficients of the cubics that are 1 at one of the places 0, 1, 2, 3 and 0 at the others.
CUBIC = np.linalg.inv(np.vander(np.arange(4.0), increasing=True))


class Recent(NamedTuple):
    """Integrals from each of `AGES` before an epoch up to it, for K epochs."""

    # (K, AGE_COUNT, 3), of the specific force, m/s, in the body frame at the epoch
    gained: Array
    turned: Array       # (K, AGE_COUNT, 3), rotation vector of the body, rad


def recent_motion(stamps_ns: Index, samples: Array, epochs_ns: Index) -> Recent:
    """
    Integrate samples, (N, 6), rad/s and m/s^2, over the time before each of K epochs.

    A rate that changes its axis makes the rotation vector differ from its integral (J. E. Bortz,
    "A new mathematical formulation for strapdown inertial navigation", IEEE Transactions on
    Aerospace and Electronic Systems 7(1), 1971). Before the first sample and the last gap, the
    mean since then is used. There has to be a sample before and after each epoch.
    """
    samples = samples.T
    ages = (AGES / 1e-9).astype(np.int64)
    last = np.maximum(np.searchsorted(stamps_ns, epochs_ns), 1)
    rungs = np.searchsorted(stamps_ns, epochs_ns[:, None] - ages, side='right') - 1
    first = np.clip(rungs[:, -1], 0, last - 1)
    most = np.max(last - first)
    step = (first + np.arange(most)[:, None]).T     # in Fortran order: components are contiguous
    inside = step < last[:, None]
    step = np.minimum(step, last[:, None] - 1)
    begin, end = ((stamps_ns[step.T + k] - epochs_ns).T * 1e-9 for k in (0, 1))
    # Gaps do not count, nor does what was before the last one.
    known = np.logical_and.accumulate((end - begin < UNKNOWN_STEP)[:, ::-1], axis=1)[:, ::-1]
    dt = np.where(inside & known, np.minimum(end, 0.0) - begin, 0.0)[..., None]
    middle = (0.5 * (samples[:, :-1] + samples[:, 1:])).take(step.T, axis=1).T
    both = _seen_from_epoch(dt, middle[..., :3], middle[..., 3:])
    sums = np.cumsum(dt * both, axis=1)
    # The integral up to a step: over the steps before, and over part of the one that it is in.
    own = np.clip(rungs - first[:, None], 0, step.shape[1] - 1)
    rows = np.arange(epochs_ns.size)[:, None]
    before = (sums[rows, own]
              + (-AGES - np.minimum(end, 0.0)[rows, own])[..., None] * both[rows, own])
    span = np.cumsum(dt, axis=1)[:, -1]
    at_end = samples[[3, 4, 5, 0, 1, 2]][:, last].T
    mean = np.where(span > 0, sums[:, -1] / np.maximum(span, 1e-9), at_end)[:, None]
    missing = (AGES - span)[..., None]
    integrals = sums[:, -1:] + np.where(missing > 1e-6, missing * mean, -before)
    return Recent(integrals[..., :3], integrals[..., 3:])


def _seen_from_epoch(dt: Array, rate: Array, force: Array) -> Array:
    """
    Return forces in the body frame at the epoch, and rates of the rotation vector, (K, n, 6).

    `dt` are the steps before each epoch, (K, n, 1), s; rate and force, in the body frame of the
    step, are (K, n, 3).
    """
    turn = dt * rate
    turned = np.cumsum(turn, axis=1)
    # Rotation vector from the middle of a step to the epoch, to first order.
    to_come = turned[:, -1:] - turned + 0.5 * turn
    rate = rate - 0.5 * cross(to_come, rate)
    turn = dt * rate
    turned = np.cumsum(turn, axis=1)
    force = rotated(turned - 0.5 * turn - turned[:, -1:], force)
    return np.concatenate([force, rate], axis=-1)


def interpolated(integrals: Array, age: float) -> tuple[Array, Array, Array]:
    """
    Return a force or rate at an age, and its integral and double integral from age 0, each (K, 3).

    Interpolates the integrals of `Recent`, (K, AGE_COUNT, 3); extrapolates to negative ages.
    """
    there, value, _ = _cubic(age, 1)
    step = min(max(int(age / AGE_STEP), 0), AGE_COUNT - 1)
    rest = age - step * AGE_STEP
    trapezoids = 0.5 * rest * there
    trapezoids[1:step] += AGE_STEP
    trapezoids[step] += 0.5 * (AGE_STEP + rest)
    # The weights begin with the step at age 0, where the integrals are 0.
    value, integral, double_integral = (weights[1:] @ integrals
                                        for weights in (value, there, trapezoids))
    return value, integral, double_integral


def smoothed(integrals: Array, age: float) -> tuple[Array, Array]:
    """Return a force or rate at an age, without vibration, and its derivative to the age."""
    _, value, change = _cubic(age, SMOOTH)
    return value[1:] @ integrals, change[1:] @ integrals


@lru_cache(maxsize=8)          # the delay stays the same for many epochs
def _cubic(age: float, apart: int) -> tuple[Array, Array, Array]:
    """
    Return weights of the rungs, from age 0 on, in a cubic and its two derivatives at an age.

    It goes through four rungs near the age, `apart` rungs from each other: more for a negative
    age, so that it is extrapolated by no more than their distance.
    """
    apart = min(max(math.ceil(-age / AGE_STEP), apart), AGE_COUNT // 3)
    x = age / (apart * AGE_STEP)
    first = min(max(int(x) - 1, 0), AGE_COUNT // apart - 3)
    x -= first
    weights = np.zeros((3, 1 + AGE_COUNT))
    weights[:, apart * first + apart * np.arange(4)] = np.array(
        [[1, x, x * x, x ** 3], [0, 1, 2 * x, 3 * x * x], [0, 0, 2, 6 * x]]) @ CUBIC
    return weights[0], weights[1] / (apart * AGE_STEP), weights[2] / (apart * AGE_STEP) ** 2
