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
The start of a bank: the note's formula over the first epochs, then every heading.

The specific force, integrated, gives one vector in n0 and in the body. It leaves the rotation
about it open, so the bank starts with means all round.
"""

from dataclasses import replace
import math
from typing import NamedTuple

from ins_align.config import Config, STANDARD_GRAVITY
from ins_align.estimation.filter import Filters, of_heading
from ins_align.estimation.moments import solve_moments
from ins_align.estimation.receiver import LEAST_NOISE, LOUD, MOVING, QUIET
from ins_align.estimation.states import FIRST, PHI, PHI0, RHO, triads, XI
from ins_align.estimation.track import BodyTrack, InertialTrack
from ins_align.geometry.rotation import Array, exp_so3, log_so3, skew
from ins_align.gnss.messages import AntennaEpoch, velocities_of
from ins_align.imu.preintegration import Intervals
import numpy as np

# A start takes at least so many epochs, for the formula needs redundancy, and keeps at most so
# many: the information of positions with a noise of metres grows with the square of their time.
FIRST_EPOCHS, MAX_WAITING = 4, 256
# The bank starts when the length of the vector is so many times its noise.
START_RATIO = 40.0
# Epochs whose sigma is so many times the best are left out of a start.
UNCERTAIN = 10.0
# Noise below what is stated or configured is believed only of residuals over so many seconds:
# those of a shorter time do not show errors that last.
LONG_ENOUGH = 1.0
# F statistic of an epoch's residuals over those of the others above which it is an outlier.
OUTLYING = 20.0
# Among so many epochs an outlier is searched for even before they suffice, for with one they may
# never suffice.
FEW = 64
# After so many epochs and seconds without a start something is wrong with them.
STUCK_EPOCHS, STUCK_SECONDS = 20, 20.0
UNFIT = ('{epochs} GNSS epochs in {seconds:.0f} s do not suffice for a start: they are noisy, or '
         'do not fit each other or the motion of the IMU: check the velocity frame and the clocks')
TOO_NOISY = ('{epochs} GNSS epochs in {seconds:.0f} s are too noisy to start with: fewer epochs a '
             'second, which are waited for longer, would do')
# Number of headings, one every five degrees, and their sigma (rad): wide enough for the sum of
# their densities to be flat to a tenth, and narrow, for errors of a heading are linearised.
HEADINGS = 72
STEP_STD = 0.4 * 2 * math.pi / HEADINGS
# Factor on the sigma of the start's tilt, for the filters use its epochs again; and a sigma (rad)
# for what the formula does not model, as the lever arm.
REUSED, TILT_STD = 3.5, math.radians(3.0)
# Headings are drawn again when the sigma of each has grown to this (rad).
BLURRED = 0.2
_EVEN = 2 * math.pi / HEADINGS * np.arange(HEADINGS)[:, None]
# Sigmas of velocity and position at first (m/s, m), and of the velocity where it is measured, if
# only horizontally.
OPEN_VELOCITY, OPEN_POSITION, STEADY_VELOCITY = 1e3, 1e4, 10.0


class RoughAttitude(NamedTuple):
    """The attitude of the note's formula, whose rotation about an axis is not known."""

    C: Array  #: (3, 3), at t0
    axis: Array  #: (3,), in the body at t0
    kind: int  #: 0: from velocities, 1: from positions
    stated: bool  #: whether the receiver states variances
    noise: float  #: factor on the receiver's variances
    std: float  #: sigma of the direction of the axis in n0, rad


class Start:
    """Collects epochs until they suffice for an attitude; the first one is t0."""

    def __init__(self, config: Config) -> None:
        """Start without an epoch."""
        self._lever = np.array(config.lever_arm)
        self.epochs: list[AntennaEpoch] = []
        self._imu: list[Intervals] = []
        self.rejected = [0, 0]      # velocities and positions that were left out as outliers

    def add(self, epoch: AntennaEpoch, imu: Intervals) -> None:
        """Add an epoch and the interval before it."""
        if self.epochs or any(epoch.measured):
            self._imu.append(imu if self.epochs else imu.end())
            self.epochs.append(epoch)
        if len(self.epochs) > MAX_WAITING:
            self._drop_first()

    @property
    def imu(self) -> Intervals:
        """Return the intervals before all epochs; the duration of the first is zero."""
        return Intervals(**{name: np.concatenate([getattr(imu, name) for imu in self._imu])
                            for name in vars(self._imu[0])})

    @property
    def measured(self) -> int:
        """Return the number of epochs with a measurement."""
        return sum(any(epoch.measured) for epoch in self.epochs)

    def _drop_first(self) -> None:
        """Drop the first epochs: t0 is the next one with a measurement."""
        later = [k for k, epoch in enumerate(self.epochs) if k and any(epoch.measured)]
        first = later[0] if later else len(self.epochs)
        del self.epochs[:first], self._imu[:first]
        if later:
            self._imu[0] = self._imu[0].end()

    def solve(self, use_position: bool) -> RoughAttitude | None:
        """Return an attitude; None if the epochs do not suffice or contradict each other."""
        epochs = self.epochs
        if len(epochs) < FIRST_EPOCHS:
            return None
        measured = np.array([epoch.measured for epoch in epochs])
        kind = 0 if np.count_nonzero(measured[:, 0]) >= FIRST_EPOCHS else 1
        use = measured[:, kind]
        states = np.array([epoch.stated[kind] for epoch in epochs])
        stated = bool(2 * np.count_nonzero(states[use]) > np.count_nonzero(use))
        use &= states == stated     # the noise is estimated of the stated or of the others
        variance = self._variance(kind)
        use &= variance <= UNCERTAIN ** 2 * np.min(variance[use], initial=np.inf)
        if np.count_nonzero(use) < FIRST_EPOCHS + kind or (kind and not use_position):
            return None
        time, pairs = self._pairs(kind)
        places = np.flatnonzero(use)
        while True:
            used = pairs[places]
            total = used.T @ used
            C, residual, moments = solve_moments(total)
            usual = float(np.median(variance[places]))      # some may be far less certain
            rows = 3 * (len(places) - 2 - kind)
            noise = float(residual) / (rows * usual)
            values, vectors = np.linalg.eigh(moments)
            chance = math.sqrt(2 / rows)            # relative sigma of `noise`
            quiet = (kind == 0 and stated and noise * (1 + 3 * chance) < QUIET
                     and np.any(np.linalg.norm(velocities_of(epochs)[places], axis=1) > MOVING))
            noise = (max(noise * (1 + chance), LEAST_NOISE) if quiet or not stated
                     else max(noise, 1.0))
            seconds = time[places[-1]] - time[places[0]]
            if noise < 1 and seconds < LONG_ENOUGH and len(epochs) < MAX_WAITING:
                return None
            enough = values[-1] >= START_RATIO ** 2 * usual * noise
            if noise < LOUD or not (enough or len(places) <= FEW):
                break
            if len(places) <= FIRST_EPOCHS + kind:
                if noise > OUTLYING:                # they do not show which is the outlier
                    return None
                break
            left = solve_moments(total - used[:, :, None] * used[:, None])[1]   # without each
            if (residual - left.min()) * (rows - 3) <= 3 * OUTLYING * left.min():
                break
            places = np.delete(places, np.argmin(left))
        if not enough:
            return None
        for k in np.setdiff1d(np.flatnonzero(use), places).tolist():
            self.epochs[k] = replace(epochs[k], **(
                {'position_measured': False} if kind else {'v_n': None}))
            self.rejected[kind] += 1
        if places[0] > 0:
            self._drop_first()
            return self.solve(use_position)
        return RoughAttitude(C, vectors[:, -1], kind, stated,
                             noise if noise > LOUD or noise < 1 or not stated else 1.0,
                             math.sqrt(usual * noise / values[-1]))

    @property
    def lacks(self) -> str:
        """Return in words what the epochs lack for a start, or ''."""
        epochs, measured = self.epochs, self.measured
        if measured < STUCK_EPOCHS:
            return ''
        seconds = (epochs[-1].stamp_ns - epochs[0].stamp_ns) * 1e-9
        words = UNFIT if seconds >= STUCK_SECONDS else TOO_NOISY if measured >= MAX_WAITING else ''
        return words.format(seconds=seconds, epochs=measured)

    def _pairs(self, kind: int) -> tuple[Array, Array]:
        """Return times, and rows of s, a, 1 and for positions time, for all epochs."""
        epochs, first = self.epochs, self.epochs[0]
        track = InertialTrack.start(first.latitude, first.longitude, first.altitude).along(
            epochs, first.stamp_ns)
        body = BodyTrack().along(self.imu)
        s, a = ((track.s_p, body.a_p(self._lever)) if kind else
                (track.s_v(velocities_of(epochs)), body.a_v(self._lever)))
        start = np.vander(track.time, 1 + kind, increasing=True)
        return track.time, np.hstack([s, a, start])

    def _variance(self, kind: int) -> Array:
        """
        Return the variance that the receiver states at each epoch, mean of three axes.

        A vertical velocity that is not measured is taken as steady, an altitude as constant, with
        the variance of the horizontal ones.
        """
        covariance = np.array([epoch.covariances[kind] for epoch in self.epochs])
        horizontal = np.trace(covariance[:, :2, :2], axis1=1, axis2=2)
        return np.minimum(np.trace(covariance, axis1=1, axis2=2) / 3, horizontal)

    def means(self, rough: RoughAttitude, x: Array, known: Array,
              accel_sign: float) -> tuple[Array, Array]:
        """
        Return the attitudes of a rival all round the axis, and the covariance of errors at t0.

        The error of the accelerometers, ``b + M f``, is in the rough attitude as a tilt of
        ``f x (b + M f) / f^2``.

        Parameters
        ----------
        rough : RoughAttitude
            As `solve` returned it.
        x, known : ndarray, shapes (m,) and (m, m)
            Parameters of the body and their covariance.
        accel_sign : float
            Of the accelerometers.

        Returns
        -------
        C, P : ndarray, shapes (HEADINGS, 3, 3) and (n, n)

        """
        C, axis = rough.C, rough.axis
        if accel_sign < 0:
            # With reversed accelerations the attitude is half a turn away, about any axis across.
            across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
            C = C @ exp_so3(math.pi * across / np.linalg.norm(across))
        gained = np.sum([imu.v[0] for imu in self._imu], axis=0)
        upwards = math.copysign(accel_sign, float(axis @ gained))
        force = upwards * STANDARD_GRAVITY * axis
        accel = triads(x.size)[1]
        felt = np.hstack([np.eye(3), np.kron(np.eye(3), force)])[:, :accel.stop - accel.start]
        tilt = skew(force) @ felt / STANDARD_GRAVITY ** 2
        along = np.outer(axis, axis)
        attitude = (tilt @ known[accel, accel] @ tilt.T + STEP_STD ** 2 * along
                    + (REUSED ** 2 * rough.std ** 2 + TILT_STD ** 2) * (np.eye(3) - along))
        P = np.zeros((FIRST + x.size, FIRST + x.size))
        P[FIRST:, FIRST:] = known
        for rows in (PHI, PHI0):
            P[rows, PHI] = P[rows, PHI0] = attitude
            P[rows, FIRST:] = tilt @ known[accel]
            P[FIRST:, rows] = P[rows, FIRST:].T
        steady = any(epoch.measured[0] for epoch in self.epochs)
        P[XI, XI] = (STEADY_VELOCITY if steady else OPEN_VELOCITY) ** 2 * np.eye(3)
        P[RHO, RHO] = OPEN_POSITION ** 2 * np.eye(3)
        return C @ exp_so3(_EVEN * axis) @ exp_so3(tilt @ x[accel]), P


def redraw_headings(filters: Filters) -> None:
    """
    Draw headings again, all round, for the rivals whose headings have become blurred.

    While rates are unknown the heading of each mean becomes uncertain, and its errors are
    linearised. The new headings are sharp and evenly spaced. What was known of the heading is
    given up, which the gyros have not kept, and so is its correlation with the rest.
    """
    if filters.single:
        return
    lead, P = filters.lead, filters.P
    up, up0 = filters.C[lead][:, 2], filters.C0[lead][:, 2]
    column, variance = of_heading(P, up)
    blurred = (np.bincount(filters.rival)[filters.ids] > 1) & (variance > BLURRED ** 2)
    if not blurred.any():
        return
    turn = np.zeros(column.shape)
    turn[:, PHI], turn[:, PHI0] = up, up0
    shared = turn[:, :, None] * column[:, None]
    P += blurred[:, None, None] * (
        (variance + STEP_STD ** 2)[:, None, None] * (turn[:, :, None] * turn[:, None])
        - shared - shared.swapaxes(1, 2))
    # The state of each comes from the old mean that is likeliest to have its heading.
    source = np.split(np.arange(len(filters.C)), filters.first[1:])
    angle = [np.zeros(old.size) for old in source]
    for m in np.flatnonzero(blurred):
        old = source[m]
        away = _EVEN - log_so3(filters.C[old] @ filters.C[lead[m]].T)[:, 2]
        away = np.remainder(away + math.pi, 2 * math.pi) - math.pi
        likeliest = np.argmax(filters.weight[old] - 0.5 * away ** 2 / variance[m], axis=1)
        source[m], angle[m] = old[likeliest], away[np.arange(HEADINGS), likeliest]
    filters.weight = np.where(blurred[filters.place], -math.log(HEADINGS), filters.weight)
    filters.keep(np.concatenate(source))
    turned = exp_so3(np.concatenate(angle)[:, None] * np.array([0.0, 0.0, 1.0]))
    filters.C, filters.C0 = turned @ filters.C, turned @ filters.C0
