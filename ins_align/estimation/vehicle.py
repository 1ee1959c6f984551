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
The motion constraint of a vehicle: its base moves along its x axis.

In the axes B of the base, the velocity of its origin is, with the speed s along x,

    v = (s, s m_y + d_y, s m_z + d_z) + noise

where the angles m are the mounting of the base, and the velocities d are slip, leeway and wind,
which last. Both are parameters of the filters, and this equation is one more measurement (docs,
"Theory"). Some rivals assume that the vehicle goes forwards, some backwards, and some assume
nothing and are there to contradict the others.
"""

import math

from ins_align.config import Config
from ins_align.estimation.filter import Filters
from ins_align.estimation.states import (
    DRIFT, FIRST, Linearised, MARGIN, Measured, MOUNT, OF_VEHICLE, PHI)
from ins_align.geometry.rotation import apply, Array, Index, skew, Transform
import numpy as np

# Sigma of the angle between motion and x that does not last (rad: bends, yawing in waves, gusts).
SLIPS = {'car': math.radians(1.0), 'boat': math.radians(10.0), 'aeroplane': math.radians(5.0)}
# Updates are so far apart (s) that what does not last is independent; least sigma (m/s).
INTERVAL, NOISE = 1.0, 0.05
# Sigma of the speed at which a vehicle reverses (m/s).
BACKWARDS_SPEED = 2.0
# Headings of a rival differ when the cosine of the angle between two of them is below this.
ONE_WAY = 0.5
# The speed of a vehicle that moves is so many of its sigmas: the direction of noise would feign a
# heading.
MOVES = 5.0
# Mounting or drift beyond so many of their sigmas contradict the assumption.
MOST = 4.0
# Log likelihood by which the assumption must exceed none: some seconds of motion.
CONFIRMED = 9.0
NOT_USED = ('; the motion contradicts vehicle: {vehicle}, which is not used (a drift, a tow, a '
            'ferry, GNSS errors that last, a base_frame that is not at the rear axle: raise '
            'vehicle_velocity_std? or its x does not point forward: raise mount_yaw_std?)')
UNCONFIRMED = 'the motion does not confirm yet that the vehicle moves along x of its base: wait'
AMBIGUOUS = '; forwards and backwards are both possible: change speed'


class Vehicle:
    """
    Applies the constraint once a second.

    Parameters
    ----------
    config : Config
    base : Transform
        From the base to the IMU.
    along : ndarray of int, shape (R,)
        Direction in which each rival sets out: 1 forwards, -1 backwards, 0 any.
    std : ndarray, shape (4,)
        Sigmas of mounting (rad) and drift (m/s).

    Attributes
    ----------
    position : ndarray, shape (3,)
        Of the base in the frame of the IMU, m.

    """

    def __init__(self, config: Config, base: Transform, along: Index, std: Array) -> None:
        """Start without an update."""
        self._axes, self.position = base.rotation, base.translation
        self._std, self._slip = std, SLIPS[config.vehicle]
        self._waited, self._along = INTERVAL, along
        # By how much each is less likely for the highest speed at which it has reversed (log).
        self._against = np.zeros(len(along))

    def is_due(self, duration: float, measured: bool) -> bool:
        """Count seconds; return whether an update is due, for which a measurement is needed."""
        self._waited += duration
        if self._waited < INTERVAL or not measured:
            return False
        self._waited = 0.0
        return True

    def update(self, filters: Filters, model: Linearised, k: int, measured: Measured) -> None:
        """Update filters with motion along x of the base at epoch k."""
        assert model.base is not None
        q, lead, ids = filters.place, filters.lead, filters.ids
        along = self._along[ids]
        H_v, expected, back = (values[k] for values in model.base)
        v_b = (apply(filters.C.swapaxes(1, 2), filters.u - measured.still[k]) - expected[q]
               + apply(H_v[q][..., FIRST:], filters.x - model.point[q]))
        to_base = self._axes.T @ back.swapaxes(1, 2)
        v = apply(to_base[q], v_b)
        # While its headings differ, a rival goes in the direction in which it sets out; later it
        # may turn back. The derivatives are those at motion along x.
        x_n0 = apply(filters.C, self._axes[:, 0])
        open_ = np.minimum.reduceat(np.sum(x_n0 * x_n0[lead][q], axis=1), filters.first) < ONE_WAY
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
        any_way, along = (np.logaddexp.reduce(filters.evidence[use]) for use in (free, ~free))
        return bool(np.any(np.abs(x) > MOST * self._std) or any_way >= along + MARGIN)

    def doubt(self, filters: Filters) -> str:
        """Return in words that the motion does not confirm the assumption yet, or ''."""
        free = self._along[filters.ids] == 0
        ahead = filters.evidence[filters.best] - np.max(filters.evidence[free])
        return UNCONFIRMED if ahead < CONFIRMED else ''

    def in_words(self, filters: Filters) -> str:
        """Return that the direction is not known, as the end of a sentence, or ''."""
        level = filters.evidence
        likely = filters.lead[filters.mixed & (level > level[filters.best] - MARGIN)]
        x_n0 = apply(filters.C[likely], self._axes[:, 0])
        return AMBIGUOUS if np.any(x_n0 @ x_n0.T < 0) else ''
