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
Recent motion: what the IMU saw just before a GNSS epoch, as a function of how long ago.

A delayed receiver tells where the antenna was and how fast it went a moment before the stamp.
What the specific force has added to the velocity since, and the rates to the rotation, lead from
the epoch back to that moment. They are kept at a ladder of ages that follows a walker's steps.
"""

from functools import lru_cache
import math
from typing import NamedTuple

from ins_align.geometry.rotation import Array, cross, Index, rotated
import numpy as np

# Seconds between the ages, and how many there are: all of them as long as delays are.
RUNG, RUNGS = 0.025, 40
# Between samples so far apart (s) nobody knows how the vehicle has moved.
SILENCE = 0.3
AGES = RUNG * np.arange(1, RUNGS + 1)
# So many rungs apart force and rate are calm of vibration.
SMOOTH = 2
# Coefficients of the cubics that are 1 at one of the places 0, 1, 2, 3 and 0 at the others.
CUBIC = np.linalg.inv(np.vander(np.arange(4.0), increasing=True))


class Recent(NamedTuple):
    """Integrals from each of `AGES` before an epoch up to it, of K epochs."""

    gained: Array       # (K, RUNGS, 3), of the specific force, m/s, in the body frame at the epoch
    turned: Array       # (K, RUNGS, 3), of the angular rate: rotation vector of the body, rad


def recent_motion(stamps_ns: Index, samples: Array, epochs_ns: Index) -> Recent:
    """
    Integrate samples over the time before each of K epochs.

    A rate that changes its axis makes the rotation vector differ from its integral [Bortz1971]_.
    Where the samples do not reach back far enough, because they begin there or are missing, it
    goes on with their mean. Samples, (N, 6), rad/s and m/s^2, are there before and after each.

    References
    ----------
    .. [Bortz1971] J. E. Bortz, "A new mathematical formulation for strapdown inertial
       navigation", IEEE Transactions on Aerospace and Electronic Systems 7(1), 1971.

    """
    samples = samples.T
    ages = (AGES / 1e-9).astype(np.int64)
    last = np.maximum(np.searchsorted(stamps_ns, epochs_ns), 1)
    rungs = np.searchsorted(stamps_ns, epochs_ns[:, None] - ages, side='right') - 1
    first = np.clip(rungs[:, -1], 0, last - 1)
    most = np.max(last - first)
    # In Fortran order, so that the components of vectors are contiguous in memory.
    step = (first + np.arange(most)[:, None]).T
    inside = step < last[:, None]
    step = np.minimum(step, last[:, None] - 1)
    begin, end = ((stamps_ns[step.T + k] - epochs_ns).T * 1e-9 for k in (0, 1))
    # Nothing is known of a silence and what was before it.
    heard = np.logical_and.accumulate((end - begin < SILENCE)[:, ::-1], axis=1)[:, ::-1]
    dt = np.where(inside & heard, np.minimum(end, 0.0) - begin, 0.0)[..., None]
    middle = (0.5 * (samples[:, :-1] + samples[:, 1:])).take(step.T, axis=1).T
    both = _seen_from_epoch(dt, middle[..., :3], middle[..., 3:])
    sums = np.cumsum(dt * both, axis=1)
    # Up to a rung: the steps before its own, and of that what lies before.
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
    Return forces in the axes of the body at the epoch, and what changes the rotation up to it.

    `dt` are the seconds of the steps before each epoch, shape (K, n, 1), rate and force in the
    body frame of the step, (K, n, 3); both together come back, force first, (K, n, 6).
    """
    turn = dt * rate
    turned = np.cumsum(turn, axis=1)
    # Rotation vector from the middle of a step to the epoch; rates that change their axis make it
    # differ from their integral [Bortz1971]_.
    to_come = turned[:, -1:] - turned + 0.5 * turn
    rate = rate - 0.5 * cross(to_come, rate)
    turn = dt * rate
    turned = np.cumsum(turn, axis=1)
    force = rotated(turned - 0.5 * turn - turned[:, -1:], force)
    return np.concatenate([force, rate], axis=-1)


def exact(integrals: Array, age: float) -> tuple[Array, Array, Array]:
    """
    Follow a force or rate, shape (K, RUNGS, 3) as in `Recent`, back to an age.

    Returns its value, integral and double integral over the ages from 0 on, each (K, 3); before
    age 0 it is extrapolated.
    """
    there, value, _ = _cubic(age, 1)
    rung = min(max(int(age / RUNG), 0), RUNGS - 1)
    rest = age - rung * RUNG
    trapezoids = 0.5 * rest * there
    trapezoids[1:rung] += RUNG
    trapezoids[rung] += 0.5 * (RUNG + rest)
    # Up to the first rung, which is at age 0, the integrals are 0: it is left out.
    value, integral, double_integral = (weights[1:] @ integrals
                                        for weights in (value, there, trapezoids))
    return value, integral, double_integral


def smooth(integrals: Array, age: float) -> tuple[Array, Array]:
    """Return a force or rate at an age, calm of vibration, and its derivative to the age."""
    _, value, change = _cubic(age, SMOOTH)
    return value[1:] @ integrals, change[1:] @ integrals


@lru_cache(maxsize=8)          # the delay stays the same for many epochs
def _cubic(age: float, apart: int) -> tuple[Array, Array, Array]:
    """
    Weights of the rungs, the one at age 0 first, in a cubic and its two derivatives at an age.

    The cubic goes through four rungs next to the age, so many of them apart; before age 0 no
    further out than they are apart.
    """
    apart = min(max(math.ceil(-age / RUNG), apart), RUNGS // 3)
    x = age / (apart * RUNG)
    first = min(max(int(x) - 1, 0), RUNGS // apart - 3)
    x -= first
    weights = np.zeros((3, 1 + RUNGS))
    weights[:, apart * first + apart * np.arange(4)] = np.array(
        [[1, x, x * x, x ** 3], [0, 1, 2 * x, 3 * x * x], [0, 0, 2, 6 * x]]) @ CUBIC
    change, bend = weights[1] / (apart * RUNG), weights[2] / (apart * RUNG) ** 2
    return weights[0], change, bend
