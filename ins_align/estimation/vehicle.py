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
from ins_align.estimation.filter import Filters
from ins_align.estimation.states import (
    DRIFT, FIRST, Linearised, log_sum, MARGIN, Measured, MOUNT, OF_VEHICLE, PHI)
from ins_align.geometry.rotation import apply, Array, Index, skew, Transform
import numpy as np

# How far the motion is off x without lasting (rad: bends, yawing in waves, gusts).
SLIPS = {'car': math.radians(1.0), 'boat': math.radians(10.0), 'aeroplane': math.radians(5.0)}
# Looks are so far apart (s) that what does not last is another; its least sigma (m/s).
INTERVAL, NOISE = 1.0, 0.05
# Backwards a vehicle goes as fast as this (m/s, 1 sigma).
BACKWARDS_SPEED = 2.0
# A speed of so many of its sigmas has a direction; that of a vehicle at rest would be noise, which
# feigns a heading.
MOVES = 5.0
# Mounting and drift that are so many of their sigmas are none.
MOST = 4.0
# What is assumed of a vehicle must be likelier by this than nothing: some seconds of motion.
CONFIRMED = 9.0
NOT_USED = ('; the motion contradicts vehicle: {vehicle}, which is not used (a drift, a tow, a '
            'ferry, or x of base_frame does not point forward: raise mount_yaw_std or '
            'vehicle_velocity_std?)')
UNCONFIRMED = 'the motion does not confirm yet that the vehicle moves along x of its base: wait'
AMBIGUOUS = '; forwards and backwards are both possible: change speed'


class Vehicle:
    """
    Looks at the motion of a vehicle, once a second.

    `base` leads from the base to the IMU, where the base is at `position`, (3,), m. `along`, (R,),
    says where each rival sets out: 1 forwards, -1 backwards, 0 anywhere; `std`, (4,), are sigmas
    of mounting and drift.
    """

    def __init__(self, config: Config, base: Transform, along: Index, std: Array) -> None:
        """Have seen nothing yet."""
        self._axes, self.position = base.rotation, base.translation
        self._std, self._slip = std, SLIPS[config.vehicle]
        self._waited, self._along = INTERVAL, along
        # By how much the log likelihood of each is less, for the speed at which it went backwards.
        self._against = np.zeros(len(along))

    def is_due(self, duration: float) -> bool:
        """Return whether to look again, when so many seconds have gone by."""
        self._waited += duration
        if self._waited < INTERVAL:
            return False
        self._waited = 0.0
        return True

    def look(self, filters: Filters, model: Linearised, k: int, measured: Measured) -> None:
        """Hold filters to the motion along x of the base at epoch k."""
        assert model.base is not None
        q, lead, ids = filters.place, filters.lead, filters.ids
        along = self._along[ids]
        H_v, expected, back = (values[k] for values in model.base)
        v_b = (apply(filters.C.swapaxes(1, 2), filters.u - measured.still[k]) - expected[q]
               + apply(H_v[q][..., FIRST:], filters.x - model.point[q]))
        to_base = self._axes.T @ back.swapaxes(1, 2)
        v = apply(to_base[q], v_b)
        # A rival whose heading is open sets out in its direction; later it may turn back. The
        # derivatives are those at motion along x.
        open_ = np.bincount(filters.rival)[ids] > 1
        fast = np.linalg.norm(v_b[lead], axis=1)
        moves = fast > MOVES * np.sqrt(np.einsum('mij,mjk,mik->m', H_v, filters.P, H_v) / 3)
        speed = np.where(open_, along * fast, v[lead, 0] * (along != 0))
        against = np.maximum(self._against[ids],
                             0.5 * (np.minimum(speed, 0.0) / BACKWARDS_SPEED) ** 2)
        filters.evidence = filters.evidence - (against - self._against[ids])
        self._against[ids] = against
        H = to_base[:, 1:] @ H_v
        H[..., PHI] += to_base[:, 1:] @ skew(speed[:, None] * to_base[:, 0])
        x = H[..., FIRST:]
        x[..., MOUNT], x[..., DRIFT] = -speed[:, None, None] * np.eye(2), -np.eye(2)
        sideways = v[:, 1:] - v[:, :1] * filters.x[:, MOUNT] - filters.x[:, DRIFT]
        filters.hold(moves & (along != 0), H, NOISE ** 2 + (self._slip * speed) ** 2, -sideways,
                     np.maximum(-np.sign(speed)[q] * v[:, 0], 0.0),
                     apply(filters.C, self._axes[:, 2])[:, 2] < 0)

    def contradicted(self, filters: Filters) -> bool:
        """Return whether the motion contradicts what is assumed of the vehicle."""
        x = filters.x[filters.lead[filters.best], -OF_VEHICLE:]
        free = self._along[filters.ids] == 0
        return bool(np.any(np.abs(x) > MOST * self._std) or log_sum(filters.evidence[free])
                    >= log_sum(filters.evidence[~free]) + MARGIN)

    def doubt(self, filters: Filters) -> str:
        """Return that the motion does not confirm yet what is assumed of the vehicle, or ''."""
        free = self._along[filters.ids] == 0
        ahead = filters.evidence[filters.best] - np.max(filters.evidence[free])
        return UNCONFIRMED if ahead < CONFIRMED else ''

    def in_words(self, filters: Filters) -> str:
        """Return what is not known of the vehicle's motion, as the end of a sentence, or ''."""
        level = filters.evidence
        likely = filters.lead[filters.counts & (level > level[filters.best] - MARGIN)]
        x_n0 = apply(filters.C[likely], self._axes[:, 0])
        return AMBIGUOUS if np.any(x_n0 @ x_n0.T < 0) else ''
