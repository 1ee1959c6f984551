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
Error-state Kalman filters with errors in the body frame: many means share one covariance.

A mean is the attitude ``C = C_n0b``, the velocity u and the position w of the IMU in n0, the
attitude C0 at t0 and the parameters x of the body (lever arm, delay, errors of gyros and
accelerometers). n0 is the local level frozen at the last epoch that was processed before; gravity
and the rotation of the Earth are in the GNSS side s_v, s_p (`track.InertialTrack`), so that
propagation is pure integration of preintegrated intervals. u and w are those which a receiver
whose measurements are late by its delay sees. Errors are

    C_true = C exp(phi)    u_true = u + C J xi    w_true = w + C J rho    C0_true = C0 exp(phi0)

with J the left Jacobian of SO(3) at phi: (phi, xi, rho) is the logarithm of an error in SE2(3).
Biases of the accelerometers turn with the attitude (`states.turned_parameters`). Neither the
propagation of errors, exact but for noise, nor a measurement's derivative holds an attitude, so
all means that differ in their heading share one covariance (docs, "Theory").

Arrays are per mean (B), sorted by rival, or per rival (M): X[q], with q = `place`, spreads rivals
to means, X[lead] takes each rival's likeliest mean; q is a slice when B = M.
"""

from typing import NamedTuple

from ins_align.config import STANDARD_GRAVITY
from ins_align.estimation.states import (
    biases, DELAY, FIRST, LEVER_ARM, Linearised, Measured, PHI, PHI0, RHO, transport,
    turned_parameters, XI)
from ins_align.geometry.rotation import (
    apply, Array, exp_so3, Index, log_so3, nearest_rotation, skew)
import numpy as np

# A measurement of three rows is an outlier above this normalised innovation squared: beyond 5
# sigma in some direction, as one good measurement in 60 000 is (chi-square with three degrees of
# freedom). In the weights an outlier counts as this much.
GATE = 25.0
# Log likelihood that motion along x of a vehicle gains over any motion where it fits exactly; with
# a normalised innovation squared of twice this both are as likely.
FITS = 3.0
# Rivals that are less likely than the best by this (log) are left out of a mixture.
NEGLIGIBLE = 12.0
# Corrections of the attitude below this (rad) leave the covariance as it is.
NO_TURN = 1e-3
# An unknown rate turns biases of the accelerometers against the tilt that they look like: their
# variance returns to its first value at this (s) times the variance of the rate.
TURNING = 30.0
# Information on the heading (1/rad^2): the least that an epoch is taken to give, and the most
# spurious information that is carried over to later epochs.
MIN_INFORMATION, MAX_SPURIOUS = 1e-9, 2.0
# The product of the errors of lever arm and attitude lasts so long (s), and that of lever arm and
# rate.
PRODUCT_TIME, RATE_TIME = 0.5, 10.0
_EYE = np.eye(3)


class Innovation(NamedTuple):
    """The innovation of a measurement to the likeliest mean."""

    square: float           # normalised innovation squared, per row
    normalised: Array       # over its sigmas, in n0, shape (3,)
    taken: bool             # whether the rival of this mean accepts the measurement
    fits_none: bool         # whether even the likeliest of all rivals rejects it


class _Test(NamedTuple):
    """The innovations of r rows of B means of M rivals, and their covariances."""

    HP: Array               # (B, r, n)
    S: Array                # (B, r, r), its covariance
    inverse: Array          # of S
    weighted: Array         # (B, r), S^-1 times the innovation
    nis: Array              # (B,), normalised innovation squared


class Filters:
    """
    B means under M rivals, which are hypotheses about the sensors with a covariance each.

    Parameters
    ----------
    C : ndarray, shape (B, 3, 3)
        Attitudes.
    u : ndarray, shape (3,)
        Velocity of all means.
    x : ndarray, shape (m,)
        Parameters of all means.
    rival : ndarray of int, shape (B,)
        The rival that each mean belongs to, increasing.
    P : ndarray, shape (M, n, n)
        Covariances.
    walk : ndarray, shape (M, n)
        Random walk: what P gains on its diagonal in a second.
    prior : ndarray, shape (M,)
        Log probability of each rival before the data.
    mixed : ndarray of bool, shape (M,)
        Whether a rival is part of results, the mixture; the others may speak against it.

    Attributes
    ----------
    weight : ndarray, shape (B,)
        Log weight among the means of the same rival.
    evidence : ndarray, shape (M,)
        Log probability of each rival after the data, but for a constant.
    ids : ndarray of int, shape (M,)
        The rivals that are left.
    spurious : ndarray, shape (M,)
        Information on the heading that noise may have feigned and that is not removed yet,
        1/rad^2.
    accel_expected, accel_variance : ndarray, shapes (3,) and (M, 3)
        Biases of the accelerometers before the data, m/s^2, and their variances, (m/s^2)^2.
    place : ndarray of int, shape (B,), or slice
        The index in `ids` of each mean's rival; a slice of all where each rival has one mean.
    first, lead : ndarray of int, shape (M,)
        The first and the likeliest mean of each rival.

    """

    _OF_MEANS = 'C', 'u', 'w', 'x', 'C0', 'rival', 'weight'
    _OF_RIVALS = 'P', 'walk', 'spurious', 'accel_variance', 'evidence', 'mixed', 'ids'

    def __init__(self, C: Array, u: Array, x: Array, rival: Index, P: Array, walk: Array,
                 prior: Array, mixed: np.ndarray) -> None:
        """Put all means at the same velocity and parameters."""
        B, M = len(C), len(P)
        self.C, self.C0 = C, C.copy()
        self.u, self.w, self.x = np.tile(u, (B, 1)), np.zeros((B, 3)), np.tile(x, (B, 1))
        self.rival, self.ids = rival, np.arange(M)
        self.weight = -np.log(np.bincount(rival))[rival]
        self.evidence, self.mixed = prior, mixed
        self.P, self.walk, self.spurious = P, walk, np.zeros(M)
        accel = biases(x.size)[1]
        self.accel_expected = x[accel]
        self.accel_variance = np.diagonal(P, axis1=1, axis2=2)[:, FIRST:][:, accel].copy()
        self._tilt_and_bias = np.r_[PHI, FIRST + np.r_[accel]]
        self._transported = np.r_[:FIRST, FIRST + np.r_[accel]]
        self._find_places()

    # Means, their rivals and weights

    @property
    def single(self) -> bool:
        """Whether each rival has one mean only."""
        return len(self.C) == len(self.ids)

    @property
    def best(self) -> int:
        """Return the index in `ids` of the likeliest rival of the mixture."""
        return int(np.where(self.mixed, self.evidence, -np.inf).argmax())

    def _find_places(self) -> None:
        self.place: 'Index | slice' = (slice(None) if self.single
                                       else np.searchsorted(self.ids, self.rival))
        self.first = np.searchsorted(self.rival, self.ids)
        self._find_leads()

    def _find_leads(self) -> None:
        self.lead = self.first
        if not self.single:
            self.lead = np.lexsort((-self.weight, self.rival))[self.first]

    def keep(self, means: np.ndarray) -> None:
        """Keep means, by a mask or by indices that may repeat, and the rivals that have any."""
        for name in self._OF_MEANS:
            setattr(self, name, getattr(self, name)[means])
        left = np.isin(self.ids, self.rival)
        for name in self._OF_RIVALS:
            setattr(self, name, getattr(self, name)[left])
        self._find_places()

    def _weigh(self, log_likelihood: Array, real: 'Array | float' = 1.0) -> Array:
        """
        Weigh means by a log likelihood, shape (B,); return that of the rivals, shape (M,).

        The weights of the means of a rival change by the share `real` of it.
        """
        if self.single:
            return self.weight + log_likelihood
        likelihood = self._summed(self.weight + log_likelihood)
        weight = self.weight + real * log_likelihood
        self.weight = weight - self._summed(weight)[self.place]
        self._find_leads()
        return likelihood

    def _summed(self, weight: Array) -> Array:
        """Return the log of the sum of the weights of each rival, shape (M,)."""
        largest = np.maximum.reduceat(weight, self.first)
        total: Array = largest + np.log(
            np.add.reduceat(np.exp(weight - largest[self.place]), self.first))
        return total

    def _by_most(self, good: np.ndarray) -> np.ndarray:
        """Return whether the means that are good have more than half of their rival's weight."""
        if self.single:
            return good
        most: np.ndarray = np.add.reduceat(np.exp(self.weight) * good, self.first) > 0.5
        return most

    # Filtering

    def propagate(self, model: Linearised, k: int) -> None:
        """Propagate over the interval before epoch k of a model of the rivals that are left."""
        q, duration = self.place, model.duration[k]
        change = apply(model.J[k][q], self.x - model.point[q])
        moved = (model.moved[k][q] + change[:, 3:]).reshape(-1, 2, 3) @ self.C.swapaxes(1, 2)
        v, p = moved[:, 0], moved[:, 1]
        self.w = self.w + duration * self.u + p - self.x[:, DELAY, None] * v
        self.u = self.u + v
        self.C = self.C @ exp_so3(change[:, PHI]) @ model.R[k][q]
        F, Q, P = model.F[k], model.Q[k], self.P
        rows = F @ P
        P[:, :9, 9:] = rows[:, :, 9:]
        P[:, 9:, :9] = rows[:, :, 9:].swapaxes(1, 2)
        block = rows @ F.swapaxes(1, 2) + Q
        P[:, :9, :9] = 0.5 * (block + block.swapaxes(1, 2))     # or rounding grows
        M, n = self.walk.shape
        variance = P.reshape(M, -1)[:, ::n + 1]
        places = biases(n - FIRST)
        gyro, accel = (variance[:, FIRST:][:, triad] for triad in places)
        known = np.maximum(self.accel_variance - accel, 0.0)
        turning = TURNING * gyro.sum(axis=1)[:, None] * known
        variance += duration * self.walk
        accel += duration * turning
        self.accel_variance += duration * self.walk[:, FIRST:][:, places[1]]

    def update(self, model: Linearised, k: int, kind: int, measured: Measured,
               noise: Array) -> Innovation:
        """
        Update with the velocity (kind 0) or the position (1) of epoch k of a model.

        `noise`, shape (3,), has factors on the sigmas that the receiver states, east, north, up.
        """
        q, lead, C = self.place, self.lead, self.C
        H = model.H[k, kind]
        # The receiver states a covariance in the axes of n0; innovations are in the body's.
        stated = C.swapaxes(1, 2) @ (measured.covariance[k, kind] * noise * noise[:, None]) @ C
        arm_noise = self._arm_noise(H[..., FIRST:][..., LEVER_ARM], model.duration[k], kind == 0)
        stated = stated + arm_noise[q, None, None] * _EYE
        missing = measured.s[k, kind] - (self.w if kind else self.u)
        innovation = (apply(C.swapaxes(1, 2), missing) + model.expected[k, kind][q]
                      - apply(H[q][..., FIRST:], self.x - model.point[q]))
        test = self._test(H, stated, innovation)
        good = test.nis < GATE
        # Weights are those before the measurement, for an outlier must not choose who accepts it.
        taken = self._by_most(good)
        feigned, back = self._update_covariance(test, stated, taken)
        self.evidence = self.evidence + self._weigh(
            -0.5 * (np.minimum(test.nis, GATE) + np.log(np.linalg.det(test.S))), 1 - feigned[q])
        self._move(test, good & taken[q], lead, back)
        best = self.best
        i = lead[best]
        sigmas = np.sqrt((C[i] @ test.S[i] @ C[i].T).diagonal())
        return Innovation(float(test.nis[i]) / 3, C[i] @ innovation[i] / sigmas,
                          bool(taken[best]), not taken[self.evidence.argmax()])

    def _arm_noise(self, arm: Array, duration: float, swings: bool) -> Array:
        """
        Return the variance, (M,), of errors of the lever arm times those of attitude and rate.

        Products of two errors are in no derivative. They last from epoch to epoch, which are
        `duration` (s) apart. `arm`, (M, 3, 3), has the derivatives of the measurement to the lever
        arm; a velocity (`swings`) has a product with the error of the rate too.
        """
        parameters = self.P[:, FIRST:, FIRST:]
        lever = parameters[:, LEVER_ARM, LEVER_ARM]
        seen = arm @ lever @ arm.swapaxes(1, 2)
        noise = _product(self.P[:, PHI, PHI], seen, PRODUCT_TIME / max(duration, 1e-3))
        if swings:
            gyro, _ = biases(parameters.shape[1])
            noise += _product(parameters[:, gyro, gyro], lever, RATE_TIME / max(duration, 1e-3))
        return noise

    def hold(self, held: np.ndarray, H: Array, variance: Array, innovation: Array,
             backwards: Array, tumbled: np.ndarray) -> None:
        """
        Update some of the rivals with motion along x of a vehicle's base; see `vehicle`.

        `held`, (M,), says which rivals. The innovation, (B, 2), m/s, is sideways and upwards, with
        derivatives H, (M, 2, n), and variance (M,), (m/s)^2. `backwards` and `tumbled`, (B,), are
        the speed in the wrong direction, m/s, and whether z of the base points down.
        """
        q, lead = self.place, self.lead
        test = self._test(H, variance[q][:, None, None] * np.eye(2), innovation)
        nis = test.nis + backwards ** 2 / test.S[:, 0, 0]
        nis = held[q] * np.where(tumbled, GATE, np.minimum(nis, GATE))
        if not self.single:
            self._weigh(-0.5 * nis)
        # The likeliest mean alone counts: that headings were spread before says nothing about
        # the assumption.
        self.evidence = self.evidence + held * (FITS - 0.5 * nis[self.lead])
        good = nis < GATE
        taken = held & self._by_most(good)
        self._reduce(test, taken, lead)
        self._move(test, good & taken[q], lead)

    def _test(self, H: Array, noise: Array, innovation: Array) -> _Test:
        """Compare an innovation, (B, r), with its covariance; H are derivatives, (M, r, n)."""
        HP = H @ self.P
        S = (HP @ H.swapaxes(1, 2))[self.place] + noise
        inverse = np.asarray(np.linalg.inv(S), float)
        weighted = apply(inverse, innovation)
        return _Test(HP[self.place], S, inverse, weighted,
                     np.einsum('ij,ij->i', innovation, weighted))

    def _reduce(self, test: _Test, taken: np.ndarray, lead: Index) -> None:
        """Reduce covariances by a measurement, with the gains of the likeliest means."""
        HP, inverse = test.HP[lead], test.inverse[lead]
        P = self.P - HP.swapaxes(1, 2) @ (inverse * taken[:, None, None]) @ HP
        self.P = 0.5 * (P + P.swapaxes(1, 2))       # or rounding grows

    def _update_covariance(self, test: _Test, noise: Array,
                           taken: np.ndarray) -> tuple[Array, Array]:
        """
        Reduce the covariances, but not by information on the heading that noise may feign.

        Noise of the IMU looks like motion, and motion that the GNSS does not see in this direction
        speaks against the heading (errors in variables). An epoch gives at most ``tr(W - W^2)`` of
        such information in the mean, W being the receiver's share of an innovation (docs,
        "Theory").

        Returns the spurious share of the information on the heading, shape (M,), and what has to
        be taken back of a correction for each radian that it turns the heading, (M, n).
        """
        lead, before = self.lead, self.P
        up = self.C[lead, 2]
        self._reduce(test, taken, lead)
        column, variance = of_heading(self.P, up)
        W = test.inverse[lead] @ noise[lead]
        spurious = self.spurious + np.trace(W - W @ W, axis1=1, axis2=2)
        information = np.maximum(1 / variance - 1 / of_heading(before, up)[1], MIN_INFORMATION)
        removed = taken * np.clip(spurious, 0.0, information)
        self.spurious = np.where(taken, np.minimum(spurious - removed, MAX_SPURIOUS),
                                 self.spurious)
        self.P += (removed / (1 - removed * variance))[:, None, None] * (
            column[:, :, None] * column[:, None])
        feigned = removed / information
        return feigned, (feigned / variance)[:, None] * column

    def _force_at_rest(self) -> Array:
        """
        Return the force at rest in the body, (B, 3), m/s^2, times a share.

        It is the share of the biases' variance in that of the force: so far biases of the
        accelerometers turn with a tilt.
        """
        across = skew(self.C[self.lead, 2])
        felt = np.concatenate([across, np.broadcast_to(_EYE / STANDARD_GRAVITY, across.shape)], 2)
        tilt = across @ felt        # as it looks to the accelerometers
        P = self.P[:, self._tilt_and_bias[:, None], self._tilt_and_bias]
        apparent = np.einsum('mij,mij->m', tilt @ P, tilt)
        bias = self.P[:, self._tilt_and_bias[3:], self._tilt_and_bias[3:]].sum(axis=1)
        share = bias / (bias + STANDARD_GRAVITY ** 2 * apparent)
        return STANDARD_GRAVITY * share[self.place, None] * self.C[:, 2]

    def _move(self, test: _Test, use: np.ndarray, lead: Index,
              back: Array | None = None) -> None:
        """
        Correct the means that `use` a measurement, and move the covariances with the likeliest.

        `back` is as `_update_covariance` returns it.
        """
        d = ((test.weighted * use[:, None])[:, None] @ test.HP)[:, 0]
        if back is not None:
            heading = np.einsum('bi,bi->b', d[:, PHI], self.C[:, 2])
            d = d - heading[:, None] * back[self.place]
        if max(np.abs(d[lead, PHI]).max(), np.abs(d[lead, PHI0]).max()) < NO_TURN:
            self._shift(d)
            return
        rest = self._force_at_rest()
        half = self._shift(d, rest)[:, lead]
        G = transport(d[lead][:, self._transported], half, rest[lead])
        self.P[:, self._transported] = G @ self.P[:, self._transported]
        self.P[:, :, self._transported] = self.P[:, :, self._transported] @ G.swapaxes(1, 2)

    def _shift(self, d: Array, rest: 'Array | None' = None) -> Array:
        """
        Correct the means by errors, shape (B, n); return half of their turns, now and at t0.

        Parameters turn with them where `rest` is given, as `_force_at_rest` returns it.
        """
        half = exp_so3(0.5 * np.stack([d[:, PHI], d[:, PHI0]]))
        turn, turn0 = half @ half
        moved = d[:, 3:9].reshape(-1, 2, 3) @ (self.C @ half[0]).swapaxes(1, 2)     # half[0] ~ J
        self.u, self.w = self.u + moved[:, 0], self.w + moved[:, 1]
        x = d[:, FIRST:] if rest is None else turned_parameters(d, half[0], rest)
        self.x = self.x + x
        self.C, self.C0 = self.C @ turn, self.C0 @ turn0
        return half

    # Without a measurement

    def change_axes(self, C_nn0: Array, s_v: Array, s_p: Array) -> None:
        """Change to another n0, with its axes and the s_v and s_p of an antenna at rest there."""
        self.C = C_nn0 @ self.C
        self.u, self.w = (self.u - s_v) @ C_nn0.T, (self.w - s_p) @ C_nn0.T

    def clone(self, C_n0n: Array) -> None:
        """Let t0 be now: clone the attitude, which `C0` keeps in the axes of n."""
        self.C0 = C_n0n.T @ self.C
        self.P[:, PHI0] = self.P[:, PHI]
        self.P[:, :, PHI0] = self.P[:, :, PHI]

    def reset_vertical(self, s_z: float, v_std: float = 0.0, p_std: float = 0.0) -> None:
        """Set the vertical velocity to `s_z`, and sigmas of it and of the vertical position."""
        up = self.C[self.lead, 2]       # of the likeliest mean of each rival
        along = up[:, :, None] * up[:, None]
        for rows, std in (XI, v_std), (RHO, p_std):
            self.P[:, rows] -= along @ self.P[:, rows]
            self.P[:, :, rows] -= self.P[:, :, rows] @ along
            self.P[:, rows, rows] += std ** 2 * along
        self.u[:, 2] = s_z

    def open_position(self, std: float) -> None:
        """Forget the position."""
        self.w[:] = 0.0
        self.P[:, RHO] = self.P[:, :, RHO] = 0.0
        self.P[:, RHO, RHO] = std ** 2 * _EYE

    def merge(self, alike: float) -> None:
        """Merge the means of each rival that are all within so many sigmas of the likeliest."""
        if self.single:
            return
        leads, place = self.lead, self.place
        lead = leads[place]
        C, C0 = self.C[lead].swapaxes(1, 2), self.C0[lead].swapaxes(1, 2)
        turned = log_so3(C @ self.C)
        variance = np.diagonal(self.P[:, PHI, PHI], axis1=1, axis2=2)[place]
        near = np.all(turned ** 2 < alike ** 2 * variance, axis=1)
        near = np.minimum.reduceat(near, self.first) & (np.bincount(self.rival)[self.ids] > 1)
        if not near.any():
            return
        away = np.hstack([turned, apply(C, self.u - self.u[lead]), apply(C, self.w - self.w[lead]),
                          log_so3(C0 @ self.C0), self.x - self.x[lead]])
        share = np.exp(self.weight)[:, None]
        mean = np.add.reduceat(share * away, self.first)
        spread = away - mean[place]
        P = np.add.reduceat(share[..., None] * spread[:, :, None] * spread[:, None], self.first)
        self.P[near] += P[near]
        merged = leads[near]
        d = np.zeros_like(away)
        d[merged] = mean[near]
        self._shift(d, self._force_at_rest())
        self.weight[merged] = 0.0
        kept = ~near[place]
        kept[merged] = True
        self.keep(kept)

    # Results

    def mixture(self) -> tuple[Array, Array]:
        """
        Return the attitudes at t0 and now, C_n0b, and their covariances in the axes of n0.

        Both are of shape (2, 3, 3), and of all means of the rivals that are mixed.
        """
        level = np.where(self.mixed, self.evidence, -np.inf)
        likely = level > level.max() - NEGLIGIBLE
        use = np.flatnonzero(likely[self.place])
        of = np.arange(len(likely))[self.place][use]
        share = np.exp(level[of] - level.max() + self.weight[use])
        share = share / share.sum()
        C = np.stack([self.C0[use], self.C[use]])
        covariance = C @ np.stack([self.P[of, PHI0, PHI0],
                                   self.P[of, PHI, PHI]]) @ C.swapaxes(-1, -2)
        mean = nearest_rotation((share @ C.reshape(2, -1, 9)).reshape(2, 3, 3))
        away = log_so3(C @ mean[:, None].swapaxes(-1, -2))
        covariance = covariance + away[..., :, None] * away[..., None, :]
        return mean, (share @ covariance.reshape(2, -1, 9)).reshape(2, 3, 3)


def of_heading(P: Array, up: Array) -> tuple[Array, Array]:
    """Return the heading's covariance with all errors, shape (M, n), and its variance, (M,)."""
    column = apply(P[:, :, PHI], up)
    return column, np.einsum('ij,ij->i', up, column[:, PHI])


def _product(A: Array, B: Array, epochs: float) -> Array:
    """
    Return the variance, (M,), of the vector product of vectors of covariances A, B, (M, 3, 3).

    They are independent, and taken as isotropic. A product that lasts for some epochs counts as
    white noise with as many times the variance.
    """
    variance: Array = 2 / 9 * np.trace(A, axis1=1, axis2=2) * np.trace(B, axis1=1, axis2=2)
    return max(1.0, epochs) * variance
