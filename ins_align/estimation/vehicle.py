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
What a vehicle knows of its motion: its base moves along its x axis.

In the axes B of the base, the velocity of its origin is, with the speed s along x,

    v = (s, s m_y + d_y, s m_z + d_z) + noise

where the angles m are how the base is mounted and the velocities d slip, leeway and wind, which
last. Both are parameters of the filters, and this is one more measurement of them (docs,
"Theory"). Some rivals assume that the vehicle goes forwards, some backwards, and some, which are
there to contradict the others, nothing.
"""

import math

from ins_align.config import Config
from ins_align.estimation.filter import Filters, Look, Track
from ins_align.estimation.linearised import (
    DRIFT, FIRST, Linearised, MOUNT, OF_VEHICLE, PHI, XI)
from ins_align.geometry.rotation import apply, Array, Index, skew, Transform
import numpy as np

# Velocity sideways and upwards that lasts (m/s: tyres' slip, leeway and current, wind), and how
# far the motion is off it without lasting (rad: bends, yawing in waves, gusts).
KINDS = {'car': (0.1, math.radians(1.0)), 'boat': (1.0, math.radians(10.0)),
         'aeroplane': (10.0, math.radians(5.0))}
# Looks are so far apart (s) that what does not last is another; its least sigma (m/s).
INTERVAL, NOISE = 1.0, 0.05
# What lasts changes by its sigma in this time (s), as the wind does where an aeroplane turns.
LASTING = 30.0
# Backwards a vehicle goes as fast as this (m/s, 1 sigma).
BACKWARDS_SPEED = 2.0
# A speed of so many of its sigmas has a direction; that of a vehicle at rest would be noise, which
# feigns a heading.
MOVES = 5.0
# Mounting and drift that are so many of their sigmas are none.
MOST = 4.0
NOT_USED = ('; the motion contradicts vehicle: {vehicle}, which is not used (a drift, a tow, a '
            'ferry, or x of base_frame does not point forward: raise mount_yaw_std or '
            'vehicle_velocity_std?)')
UNCONFIRMED = 'the motion does not confirm yet that the vehicle moves along x of its base: wait'
AMBIGUOUS = '; forwards and backwards are both possible: change speed'


class Vehicle:
    """
    Looks at the motion of a vehicle, once a second.

    Parameters
    ----------
    config : Config
    base : Transform
        From the base to the IMU.
    along : ndarray of int, shape (R,)
        Where each rival sets out: 1 forwards, -1 backwards, 0 anywhere.

    Attributes
    ----------
    position : ndarray, shape (3,)
        Of the base, in the frame of the IMU, m.
    against : ndarray, shape (R,)
        By how much the log likelihood of each is less, for the speed at which it went backwards.

    """

    def __init__(self, config: Config, base: Transform, along: Index) -> None:
        """Have seen nothing yet."""
        self._axes, self.position = base.rotation, base.translation
        self._std, self._slip = known_of_vehicle(config)[0], KINDS[config.vehicle][1]
        self._waited, self._along = INTERVAL, along
        self.against = np.zeros(len(along))

    def is_due(self, duration: float) -> bool:
        """Return whether to look again, when so many seconds have gone by."""
        self._waited += duration
        if self._waited < INTERVAL:
            return False
        self._waited = 0.0
        return True

    def look(self, filters: Filters, model: Linearised, k: int, track: Track) -> Look:
        """Look at epoch k."""
        assert model.base is not None
        q, lead, along = filters.place, filters.lead, self._along[filters.ids]
        H_v, expected, back = (values[k] for values in model.base)
        v_n0 = filters.u - track.still[k]
        v_b = (apply(filters.C.swapaxes(1, 2), v_n0) - expected[q]
               + apply(H_v[q][..., FIRST:], filters.x - model.point[q]))
        to_base = self._axes.T @ back.swapaxes(1, 2)
        v = apply(to_base[q], v_b)
        # A rival whose heading is open sets out in its direction; later it may turn back. The
        # derivatives are those at motion along x.
        open_ = np.bincount(q) > 1
        fast = np.linalg.norm(v_n0[lead], axis=1)
        moves = fast > MOVES * np.sqrt(np.trace(filters.P[:, XI, XI], axis1=1, axis2=2) / 3)
        speed = np.where(open_, along * fast, v[lead, 0] * (along != 0))
        self.against[filters.ids] = np.maximum(
            self.against[filters.ids], 0.5 * (np.minimum(speed, 0.0) / BACKWARDS_SPEED) ** 2)
        H = to_base[:, 1:] @ H_v
        H[..., PHI] += to_base[:, 1:] @ skew(speed[:, None] * to_base[:, 0])
        x = H[..., FIRST:]
        x[..., MOUNT], x[..., DRIFT] = -speed[:, None, None] * np.eye(2), -np.eye(2)
        sideways = v[:, 1:] - v[:, :1] * filters.x[:, MOUNT] - filters.x[:, DRIFT]
        return Look(moves & (along != 0), H, NOISE ** 2 + (self._slip * speed) ** 2, -sideways,
                    np.maximum(-np.sign(speed)[q] * v[:, 0], 0.0),
                    apply(filters.C, self._axes[:, 2])[:, 2] < 0)

    def forward(self, C: Array) -> Array:
        """Return x of the base for attitudes C of the IMU, shape (N, 3, 3)."""
        return apply(C, self._axes[:, 0])

    def contradicts(self, x: Array) -> bool:
        """Return whether the parameters x, shape (m,), can be those of the vehicle no more."""
        return bool(np.any(np.abs(x[-OF_VEHICLE:]) > MOST * self._std))


def known_of_vehicle(config: Config) -> tuple[Array, Array]:
    """Return the sigmas of mounting and drift, and what a second adds to their variances."""
    drift = config.vehicle_velocity_std or KINDS[config.vehicle][0]
    std = np.array([math.radians(config.mount_yaw_std)] * 2 + [drift] * 2)
    return std, np.array([0.0] * 2 + [drift ** 2 / LASTING] * 2)
