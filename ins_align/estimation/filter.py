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
Error-state Kalman filters whose errors are the body's: many means, one covariance.

A mean is the attitude ``C = C_n0b``, the velocity u and the position w of the IMU in n0, the
attitude C0 at t0 and the parameters x of the body (lever arm, delay, errors of gyros and
accelerometers). n0 is the local level frozen at the last epoch that was processed before; gravity
and the rotation of the Earth are in the GNSS side s_v, s_p (`track.InertialTrack`), so that
propagation is pure integration of preintegrated intervals. u and w are those which a receiver
whose measurements are late by its delay sees. Errors are

    C_true = C exp(phi)    u_true = u + C xi    w_true = w + C rho    C0_true = C0 exp(phi0)

Neither their propagation nor a measurement's derivative holds an attitude, so all means that
differ in their heading share one covariance (docs, "Theory").
"""

from dataclasses import dataclass
from typing import NamedTuple

from ins_align.estimation.linearised import FIRST, GYRO, Linearised, PHI, PHI0, RHO, XI
from ins_align.geometry.rotation import apply, Array, exp_so3, Index, log_so3
import numpy as np

# Normalised innovation squared of three rows above which a measurement is an outlier: one good
# one in 60 000 is (chi-square with three degrees of freedom). To the weights it counts as this
# much, so whatever else rejects a measurement must not leave its value below.
GATE = 25.0
# Log likelihood ratio of a motion that fits a vehicle, to one whose slips are so much larger that
# a normalised innovation squared of twice this, of two rows, is as likely.
FITS = 3.0
_EYE = np.eye(3)


@dataclass
class Track:
    """
    The GNSS side of K epochs in n0; see `track.InertialTrack`.

    Attributes
    ----------
    s : ndarray, shape (K, 2, 3)
        s_v and s_p.
    covariance : ndarray, shape (K, 2, 3, 3)
    present : list of (bool, bool)
        Whether there is a velocity, a position.
    stated : list of (bool, bool)
        Whether the receiver states its noise.
    C_n0n : ndarray, shape (K, 3, 3)
    still : ndarray, shape (K, 3)
        s_v of what rests.

    """

    s: Array
    covariance: Array
    present: list[tuple[bool, bool]]
    stated: list[tuple[bool, bool]]
    C_n0n: Array
    still: Array


class Look(NamedTuple):
    """
    How well B means of M rivals move along x of the vehicle's base; see `vehicle`.

    Attributes
    ----------
    held : ndarray of bool, shape (M,)
        Which of the rivals have to.
    H : ndarray, shape (M, 2, n)
        Derivatives of the innovation, sideways and upwards, to the errors.
    variance : ndarray, shape (M,)
        Of its noise, (m/s)^2.
    innovation : ndarray, shape (B, 2)
        m/s.
    backwards : ndarray, shape (B,)
        Speed the wrong way, m/s.
    tumbled : ndarray of bool, shape (B,)
        Whether z of the base points down.

    """

    held: np.ndarray
    H: Array
    variance: Array
    innovation: Array
    backwards: Array
    tumbled: np.ndarray


@dataclass
class Innovation:
    """
    What was new in a measurement, to the likeliest mean of each rival.

    Attributes
    ----------
    nis : ndarray, shape (M,)
        Normalised and squared, of three rows.
    residual : ndarray, shape (M, 3)
        In n0.
    covariance : ndarray, shape (M, 3, 3)
    taken : ndarray of bool, shape (M,)
        Whether it was taken.

    """

    nis: Array
    residual: Array
    covariance: Array
    taken: np.ndarray


class Filters:
    """
    B means under M rivals: hypotheses of how the sensors are, each with one covariance.

    Parameters
    ----------
    C : ndarray, shape (B, 3, 3)
        Attitudes.
    u : ndarray, shape (3,)
        Velocity of all.
    x : ndarray, shape (m,)
        Parameters of all.
    rival : ndarray of int, shape (B,)
        To which each belongs, increasing.
    P : ndarray, shape (M, n, n)
    walk : ndarray, shape (M, n)
        What a second adds to the diagonal of P.

    Attributes
    ----------
    weight : ndarray, shape (B,)
        Log weight among the means of the same rival.
    evidence : ndarray, shape (M,)
        Log likelihood of all that was measured, under each rival.
    ids : ndarray of int, shape (M,)
        The rivals that are left.
    lead : ndarray of int, shape (M,)
        The likeliest mean of each.
    feigned : ndarray, shape (M, 3, 3)
        Covariance of what the IMU's noise has made of u and no measurement has taken back.

    """

    _OF_MEANS = 'C', 'u', 'w', 'x', 'C0', 'rival', 'weight'
    _OF_RIVALS = 'P', 'walk', 'evidence', 'ids', 'feigned'

    def __init__(self, C: Array, u: Array, x: Array, rival: Index, P: Array,
                 walk: Array) -> None:
        """Start at t0."""
        B, M = len(C), len(P)
        self.C, self.C0 = C, C.copy()
        self.u, self.w, self.x = np.tile(u, (B, 1)), np.zeros((B, 3)), np.tile(x, (B, 1))
        self.rival, self.ids = rival, np.arange(M)
        self.weight = -np.log(np.bincount(rival))[rival]
        self.evidence = np.zeros(M)
        self.P, self.walk = P, walk
        self.feigned = np.zeros((M, 3, 3))
        self._find_places()

    def _find_places(self) -> None:
        self.place = np.searchsorted(self.ids, self.rival)
        self.first = np.searchsorted(self.rival, self.ids)
        self._find_leads()

    def _find_leads(self) -> None:
        if len(self.C) == len(self.ids):
            self.lead = self.first
        else:
            order = np.lexsort((-self.weight, self.rival))
            self.lead = order[self.first]

    def keep(self, means: np.ndarray) -> None:
        """Keep some of the means, and the rivals that have any."""
        for name in self._OF_MEANS:
            setattr(self, name, getattr(self, name)[means])
        left = np.isin(self.ids, self.rival)
        if not left.all():
            for name in self._OF_RIVALS:
                setattr(self, name, getattr(self, name)[left])
        self._find_places()

    def propagate(self, model: Linearised, k: int) -> None:
        """Go over the interval before epoch k of K; the model has those rivals that are left."""
        q, duration = self.place, model.duration[k]
        change = apply(model.J[k][q], self.x - model.point[q])
        moved = model.moved[k][q] + change[:, 3:]
        v, p = moved[:, :3], moved[:, 3:]
        self.w = self.w + duration * self.u + apply(self.C, p - self.x[:, GYRO - 1:GYRO] * v)
        self.u = self.u + apply(self.C, v)
        self.C = self.C @ exp_so3(change[:, PHI]) @ model.R[k][q]
        F, Q, P = model.F[k], model.Q[k], self.P
        rows = F @ P
        P[:, :9, 9:] = rows[:, :, 9:]
        P[:, 9:, :9] = rows[:, :, 9:].swapaxes(1, 2)
        P[:, :9, :9] = rows @ F.swapaxes(1, 2) + Q
        M, n = self.walk.shape
        P.reshape(M, -1)[:, ::n + 1] += duration * self.walk
        T = F[:, PHI, PHI]
        self.feigned = T @ self.feigned @ T.swapaxes(1, 2) + Q[:, XI, XI]

    def update(self, model: Linearised, k: int, kind: int, track: Track,
               noise: Array) -> 'Innovation':
        """
        Take the velocity (kind 0) or the position (1) of epoch k.

        Parameters
        ----------
        model : Linearised
            Of K epochs.
        k : int
            Which of them.
        kind : int
            0 or 1.
        track : Track
            Of the same epochs.
        noise : ndarray, shape (3,)
            Factors on the sigmas that the receiver states, east, north and up.

        """
        q, lead, C = self.place, self.lead, self.C
        H = model.H[k, kind]
        PH = self.P @ H.swapaxes(1, 2)
        # What the receiver states is about axes of n0, which the means see in different ways.
        stated = C.swapaxes(1, 2) @ (track.covariance[k, kind] * noise * noise[:, None]) @ C
        S = (H @ PH)[q] + stated
        inverse = np.linalg.inv(S)
        missing = track.s[k, kind] - (self.w if kind else self.u)
        innovation = (apply(C.swapaxes(1, 2), missing) + model.expected[k, kind][q]
                      - apply(H[q][..., FIRST:], self.x - model.point[q]))
        weighted = apply(inverse, innovation)
        nis = np.sum(innovation * weighted, axis=1)
        good = nis < GATE
        # By the means before the measurement, which an outlier must not choose.
        taken = np.bincount(q, np.exp(self.weight) * good, len(self.ids)) > 0.5
        C_lead, S_lead, inverse = C[lead], S[lead], inverse[lead]
        result = Innovation(nis[lead], apply(C_lead, innovation[lead]),
                            C_lead @ S_lead @ C_lead.swapaxes(1, 2), taken)
        self._weigh(-0.5 * (np.minimum(nis, GATE) + np.log(np.linalg.det(S))))
        gain = (PH @ inverse) * taken[:, None, None]
        self.P = self.P - gain @ PH.swapaxes(1, 2)
        if kind == 0:
            self._forget_feigned(gain, inverse, C_lead[:, 2])
        self._move(apply(PH[q], weighted) * (good & taken[q])[:, None])
        return result

    def hold(self, look: Look) -> None:
        """Hold the rivals that assume it to a motion along x of the vehicle's base."""
        q, held = self.place, look.held
        PH = self.P @ look.H.swapaxes(1, 2)
        S = look.H @ PH + look.variance[:, None, None] * np.eye(2)
        inverse = np.linalg.inv(S)
        weighted = apply(np.asarray(inverse[q], float), look.innovation)
        nis = (np.sum(look.innovation * weighted, axis=1)
               + look.backwards ** 2 / S[q, 0, 0])
        nis = held[q] * np.where(look.tumbled, GATE, np.minimum(nis, GATE))
        self.weight = self.weight - 0.5 * nis
        self._weigh_evenly()
        self._find_leads()
        # How headings were spread before says nothing about the assumption.
        self.evidence = self.evidence + held * (FITS - 0.5 * nis[self.lead])
        good = nis < GATE
        taken = held & (np.bincount(q, np.exp(self.weight) * good, len(self.ids)) > 0.5)
        gain = PH @ inverse * taken[:, None, None]
        self.P = self.P - gain @ PH.swapaxes(1, 2)
        self._move(apply(PH[q], weighted) * (good & taken[q])[:, None])

    def _weigh(self, log_likelihood: Array) -> None:
        """Weigh means within rivals, and rivals."""
        weight = self.weight + log_likelihood
        if len(weight) == len(self.ids):
            self.evidence = self.evidence + weight
            return
        largest = np.maximum.reduceat(weight, self.first)
        total = largest + np.log(np.add.reduceat(np.exp(weight - largest[self.place]), self.first))
        self.evidence = self.evidence + total
        self.weight = weight - total[self.place]
        self._find_leads()

    def _forget_feigned(self, gain: Array, inverse: Array, up: Array) -> None:
        """
        Take off again the information on the heading that the noise of the IMU feigns.

        What the accelerometers' noise adds to u looks like motion, and motion that the GNSS does
        not see in this direction speaks against the heading: in expectation by the trace of
        ``S^-1 V`` over horizontal axes, V the covariance of that noise (errors in variables).
        """
        V = self.feigned
        weighted = inverse @ V
        feigned = (np.trace(weighted, axis1=1, axis2=2) - np.sum(up * apply(weighted, up), axis=1))
        feigned = feigned * (np.abs(gain[:, 3, 0]) > 0)
        to_heading = apply(self.P[:, :, PHI], up)
        variance = np.sum(up * to_heading[:, PHI], axis=1)
        feigned = np.minimum(feigned, 0.5 / variance)
        factor = feigned / (1 - feigned * variance)
        self.P += factor[:, None, None] * to_heading[:, :, None] * to_heading[:, None]
        left = 1 - np.clip(np.trace(gain[:, XI], axis1=1, axis2=2) / 3, 0.0, 1.0)
        self.feigned = (left ** 2)[:, None, None] * V
        if len(self.C) > len(self.ids):
            self.weight *= (1 - np.minimum(feigned, 1.0))[self.place]
            self._weigh_evenly()

    def _weigh_evenly(self) -> None:
        """Make the weights of each rival's means add up to one."""
        total = np.log(np.add.reduceat(np.exp(self.weight), self.first))
        self.weight = self.weight - total[self.place]

    def _move(self, d: Array) -> None:
        """Correct the means, and turn the covariances' frames with the likeliest of them."""
        C, lead = self.C, self.lead
        B, M = len(C), len(lead)
        self.u = self.u + apply(C, d[:, XI])
        self.w = self.w + apply(C, d[:, RHO])
        self.x = self.x + d[:, FIRST:]
        phi, phi0 = d[lead, PHI], d[lead, PHI0]
        start = apply(C[lead].swapaxes(1, 2) @ self.C0[lead], phi0)
        turns = exp_so3(np.concatenate([d[:, PHI], d[:, PHI0], 0.5 * start - phi, -phi,
                                        -0.5 * phi0]))
        self.C, self.C0 = C @ turns[:B], self.C0 @ turns[B:2 * B]
        if max(np.abs(phi).max(), np.abs(phi0).max()) > 1e-4:
            G = np.zeros((M, 12, 12))
            to_phi, to_motion, to_phi0 = turns[2 * B:].reshape(3, M, 3, 3)
            G[:, PHI, PHI], G[:, PHI0, PHI0] = to_phi, to_phi0
            G[:, XI, XI] = G[:, RHO, RHO] = to_motion
            rows = G @ self.P[:, :FIRST]
            self.P[:, :FIRST] = rows
            self.P[:, FIRST:, :FIRST] = rows[:, :, FIRST:].swapaxes(1, 2)
            self.P[:, :FIRST, :FIRST] = rows[:, :, :FIRST] @ G.swapaxes(1, 2)
        self.P = 0.5 * (self.P + self.P.swapaxes(1, 2))     # or rounding grows

    # What does not depend on a measurement

    def turned(self, C_nn0: Array, s_v: Array, s_p: Array) -> None:
        """Go on in another n0; its axes, and what an antenna that rests has there of s."""
        self.C = C_nn0 @ self.C
        self.u, self.w = (self.u - s_v) @ C_nn0.T, (self.w - s_p) @ C_nn0.T

    def clone(self, C_n0n: Array) -> None:
        """Let t0 be now: the attitude at t0 is in the axes of n then, without an error."""
        self.C0 = C_n0n.T @ self.C
        self.P[:, PHI0] = self.P[:, PHI]
        self.P[:, :, PHI0] = self.P[:, :, PHI]

    def open_position(self, position: Array, std: float) -> None:
        """Forget the position."""
        self.w[:] = position
        self.P[:, RHO] = self.P[:, :, RHO] = 0.0
        self.P[:, RHO, RHO] = std ** 2 * _EYE

    def merge(self, alike: float) -> None:
        """Merge the means of each rival that are all within so many sigmas of the likeliest."""
        if len(self.C) == len(self.ids):
            return
        lead = self.lead[self.place]
        C, C0 = self.C[lead].swapaxes(1, 2), self.C0[lead].swapaxes(1, 2)
        away = np.hstack([log_so3(C @ self.C), apply(C, self.u - self.u[lead]),
                          apply(C, self.w - self.w[lead]), log_so3(C0 @ self.C0),
                          self.x - self.x[lead]])
        variance = np.diagonal(self.P, axis1=1, axis2=2)[self.place]
        near = np.all(away[:, PHI] ** 2 < alike ** 2 * variance[:, PHI], axis=1)
        near = np.minimum.reduceat(near, self.first) & (np.bincount(self.place) > 1)
        if not near.any():
            return
        share = np.exp(self.weight)[:, None]
        mean = np.add.reduceat(share * away, self.first)
        spread = away - mean[self.place]
        P = np.add.reduceat(share[..., None] * spread[:, :, None] * spread[:, None], self.first)
        lead = self.lead
        self.P[near] += P[near]
        d = np.where(near[:, None], mean, 0.0)
        C = self.C[lead]
        self.u[lead] += apply(C, d[:, XI])
        self.w[lead] += apply(C, d[:, RHO])
        self.C[lead], self.C0[lead] = C @ exp_so3(d[:, PHI]), self.C0[lead] @ exp_so3(d[:, PHI0])
        self.x[lead] += d[:, FIRST:]
        kept = ~near[self.place]
        kept[lead] = True
        self.weight[lead[near]] = 0.0
        self.keep(kept)
