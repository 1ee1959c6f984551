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
from ins_align.estimation.linearised import DRIFT, FIRST, Linearised, MOUNT, PHI
from ins_align.geometry.rotation import apply, Array, skew
from ins_align.geometry.transform import Transform
import numpy as np

# Velocity sideways and upwards that lasts, m/s: tyres' slip, leeway and current, wind.
VELOCITY_STD = {'car': 0.1, 'boat': 1.0, 'aeroplane': 10.0}
# What does not last from one second to the next: m/s, and rad of the direction of motion.
NOISE, SLIP = 0.05, math.radians(1.0)
INTERVAL = 1.0
# What lasts changes by its sigma in this time (s), as the wind does where an aeroplane turns.
LASTING = 30.0
# Backwards a vehicle goes as fast as this (m/s, 1 sigma).
BACKWARDS_SPEED = 2.0
# Mounting is worth a word when it is so many of its sigmas.
MENTIONED = 3.0
NOT_USED = ('; the motion contradicts vehicle: {vehicle}, which is not used (a drift, a tow, a '
            'ferry, or x of base_frame does not point forward?)')


class Vehicle:
    """
    Looks at the motion of a vehicle, once a second.

    Parameters
    ----------
    config : Config
    base : Transform
        From the base to the IMU.

    Attributes
    ----------
    position : ndarray, shape (3,)
        Of the base, in the frame of the IMU, m.

    """

    def __init__(self, config: Config, base: Transform) -> None:
        """Have seen nothing yet."""
        self._config, self._axes, self.position = config, base.rotation, base.translation
        self._waited, self._fastest = INTERVAL, 0.0

    def is_due(self, duration: float) -> bool:
        """Return whether to look again, when so many seconds have gone by."""
        self._waited += duration
        if self._waited < INTERVAL:
            return False
        self._waited = 0.0
        return True

    def look(self, filters: Filters, model: Linearised, k: int, track: Track,
             along: Array) -> Look:
        """Look at epoch k, with the direction of each rival: 1, -1, or 0 for none."""
        assert model.base is not None
        q, lead = filters.place, filters.lead
        H_v, expected, back = (values[k] for values in model.base)
        v_n0 = filters.u - track.still[k]
        v_b = (apply(filters.C.swapaxes(1, 2), v_n0) - expected[q]
               + apply(H_v[q][..., FIRST:], filters.x - model.point[q]))
        to_base = self._axes.T @ back.swapaxes(1, 2)
        v = apply(to_base[q], v_b)
        # Derivatives are those at motion along x, as fast as the likeliest mean goes.
        fast = np.linalg.norm(v_n0[lead], axis=1)
        self._fastest = max(self._fastest, float(fast[0]))
        speed = along * fast
        H = to_base[:, 1:] @ H_v
        H[..., PHI] += to_base[:, 1:] @ skew(speed[:, None] * to_base[:, 0])
        x = H[..., FIRST:]
        x[..., MOUNT], x[..., DRIFT] = -speed[:, None, None] * np.eye(2), -np.eye(2)
        sideways = v[:, 1:] - v[:, :1] * filters.x[:, MOUNT] - filters.x[:, DRIFT]
        return Look(along != 0, H, NOISE ** 2 + (SLIP * speed) ** 2, -sideways,
                    np.maximum(-along[q] * v[:, 0], 0.0),
                    apply(filters.C, self._axes[:, 2])[:, 2] < 0)

    @property
    def against_backwards(self) -> float:
        """Return by how much the log likelihood of going backwards is less, for the speed."""
        return 0.5 * (self._fastest / BACKWARDS_SPEED) ** 2

    def in_words(self, x: Array, directions: set[int]) -> str:
        """Return what there is to say, of parameters and directions, as the end of a sentence."""
        if directions == {1, -1}:
            return '; forwards and backwards are both possible: change speed'
        yaw, pitch = np.degrees(x[MOUNT]).tolist()
        if max(abs(yaw), abs(pitch)) <= MENTIONED * self._config.mount_yaw_std:
            return ''
        return (f'; the vehicle moves {yaw:.1f} deg to the left of and {pitch:.1f} deg above x of '
                'its base: check the mounting, or raise mount_yaw_std')


def known_of_vehicle(config: Config) -> tuple[Array, Array]:
    """Return the sigmas of mounting and drift, and what a second adds to their variances."""
    drift = config.vehicle_velocity_std or VELOCITY_STD[config.vehicle]
    std = np.array([math.radians(config.mount_yaw_std)] * 2 + [drift] * 2)
    return std, np.array([0.0] * 2 + [drift ** 2 / LASTING] * 2)
