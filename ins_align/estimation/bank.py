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
The bank: filters for every heading and every rival hypothesis, side by side on the same data.

It starts from the note's pair of vectors, weighs means and rivals by their likelihood, and reports
the attitude as a Gaussian mixture (docs, "Theory").
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
import math
from typing import NamedTuple

from ins_align.config import Config, STANDARD_GRAVITY
from ins_align.estimation.declaration import Fit
from ins_align.estimation.filter import Filters
from ins_align.estimation.linearised import EARLIEST, LATEST, linearised
from ins_align.estimation.receiver import MOVING, ReceiverNoise
from ins_align.estimation.rivals import level_in_words, Rivals, SHARE
from ins_align.estimation.start import (
    HEADINGS, OPEN_POSITION, redraw_headings, RoughAttitude, Start, STEADY_VELOCITY)
from ins_align.estimation.states import (
    biases, DELAY, FIRST, GYRO, LEVER_ARM, Linearised, Measured, OF_VEHICLE, triads)
from ins_align.estimation.track import InertialTrack
from ins_align.estimation.vehicle import NOT_USED, Vehicle
from ins_align.geometry.rotation import Array, Transform
from ins_align.gnss.messages import AntennaEpoch
from ins_align.imu.preintegration import Intervals
from ins_align.results import Attitude, Nuisance
import numpy as np

# The model is linearised again when parameters of a likeliest mean have moved this far: lever arm
# (m), delay (s), bias and matrix of the gyros (rad/s, 1) and of the accelerometers (m/s^2, 1).
REACH = np.array([0.2] * 3 + [0.01] + [3e-3] * 3 + [0.02] * 9 + [0.1] * 3 + [0.02] * 9)
MAX_SPAN = 64       # epochs with one n0
# Positions add little to velocities, and do harm when their errors wander or their stamps are a
# few ms off. With use_position auto the bank uses them if t0 has no velocity or after the first
# time without one (ns), until velocities have come for the second (ns).
VELOCITY_STOPPED_NS, VELOCITY_BACK_NS = 10_000_000_000, 2_000_000_000
# After so many epochs in a row that no rival accepts the bank starts again.
ASTRAY = 10
# A heading with a smaller sigma (rad) is resolved.
RESOLVED_STD = 0.35
NO_INNOVATION = np.full(3, math.nan)
# Counts of epochs with an outlier, in the order of kinds of measurement.
REJECTED = 'epochs_rejected_velocity', 'epochs_rejected_position'


class Learnt(NamedTuple):
    """What an earlier alignment found of the body: a prior for the next one."""

    x: Array  #: (m,), parameters
    P: Array  #: (m, m), their covariance
    stamp_ns: int  #: of its last epoch


class Bank:
    """
    The estimator of the method `bank`.

    Parameters
    ----------
    config : Config
    epoch : AntennaEpoch
        The first epoch, t0.
    imu : Intervals
        The interval at t0, whose duration is zero.
    prior : Learnt, optional
        What an earlier alignment found.
    base : Transform, optional
        From the vehicle's base to the IMU; needed where `vehicle` is configured.

    """

    _inertial: InertialTrack        # from the epoch at which n0 was frozen to the last epoch

    def __init__(self, config: Config, epoch: AntennaEpoch, imu: Intervals,
                 prior: Learnt | None = None, base: Transform | None = None) -> None:
        """Take the first epoch."""
        self._base = base or Transform(np.eye(3), np.zeros(3))
        self._not_used = ''
        self._config = config
        self._use_position = epoch.v_n is None or config.use_position is True
        self._velocity_ns = epoch.stamp_ns          # stamp of the last velocity
        self._velocities_since_ns: int | None = None
        self.counts: Counter[str] = Counter()       # epochs by outcome, and moves of t0
        self.restarted = ''         # why the bank has started again by itself, until it is read
        self._begin(epoch, imu, prior)
        self._wait(epoch, imu)

    def _begin(self, epoch: AntennaEpoch, imu: Intervals, prior: Learnt | None = None) -> None:
        """Start again at an epoch, with nothing known but the prior."""
        self.t0_ns = epoch.stamp_ns
        self._prior = prior
        force = imu.gained[0, -1]
        force = STANDARD_GRAVITY * force / max(float(np.linalg.norm(force)), 1e-3)
        self._rivals = rivals = Rivals(self._config, force)
        self._vehicle: Vehicle | None = None
        if self._config.vehicle != 'none':
            std = np.sqrt(rivals.P[0].diagonal()[-OF_VEHICLE:])
            self._vehicle = Vehicle(self._config, self._base, rivals.along, std)
        if prior is not None:
            rivals.use_prior(prior.x, prior.P, (self.t0_ns - prior.stamp_ns) * 1e-9)
        gyro, accel = triads(rivals.x.size)
        errors = gyro.stop - gyro.start
        # Measurements are linear in the parameters of a vehicle.
        self._reach = np.full(rivals.x.size, np.inf)
        self._reach[:accel.stop] = np.concatenate([REACH[:gyro.stop], REACH[16:16 + errors]])
        self._filters: Filters | None = None
        self._mixture: tuple[Array, Array] | None = None
        self._doubt, self._contradicted = '', False
        self._start = Start(self._config)
        self._last = epoch                          # the last epoch that was processed
        self._offered = self._rejected = 0          # epochs with a measurement; with an outlier
        self._measured = False                      # whether the last epoch has one that is used
        self._C_nn0 = np.eye(3)
        self._innovation = NO_INNOVATION
        self._receiver = ReceiverNoise()
        self._seconds = 0.0                         # since the first epoch that was processed
        self._in_a_row = 0                          # epochs that no rival accepted
        self._vertical_measured = True              # at the last epoch
        # n0 and the point of linearisation are kept for `_span` epochs, of which `_left` are left.
        self._point: Array | None = None
        self._span = self._left = 1

    # Input

    def advance(self, epochs: Sequence[AntennaEpoch], imu: Intervals) -> Iterator[AntennaEpoch]:
        """
        Process epochs and the IMU intervals before each.

        Yields each epoch once it is processed, when results are those at this epoch.
        """
        done = 0
        while done < len(epochs):
            part = slice(done, done + (1 if self._filters is None else self._left))
            for epoch in self._take(epochs[part], imu.take(part)):
                self._conclude()
                done += 1
                yield epoch

    def _take(self, epochs: Sequence[AntennaEpoch], imu: Intervals) -> Iterator[AntennaEpoch]:
        """
        Process epochs until the model has to be linearised again.

        n0 and the point of linearisation are kept between calls, so results do not depend on how
        many epochs come at a time.
        """
        filters = self._filters
        if filters is None:
            self._choose(epochs[0])
            self._wait(epochs[0], imu)
            yield epochs[0]
            return
        inertial = self._inertial.along(epochs, self._n0_ns)
        measured = inertial.measured(epochs, self._use_position)
        if self._point is None:
            self._point = self._point_of(filters)
        model = self._model(filters, self._point, imu)
        for k, epoch in enumerate(epochs):
            self._step(filters, model, k, measured)
            self._C_nn0 = inertial.C_n0n[k].T
            self._last = epoch
            self._left -= 1
            why = ('the last GNSS epochs do not fit the rest' if self._in_a_row >= ASTRAY
                   else self._drop_vehicle(filters))
            if why:
                self.restarted = why
                self._begin(epoch, imu.take(slice(k, k + 1)).end())
                yield epoch
                return
            changed = self._choose(epoch)
            if (changed or self._left == 0 or filters.ids.size != len(model.point) or np.any(
                    np.abs(filters.x[filters.lead] - model.point) > self._reach)):
                self._span = 1 if self._left else min(2 * self._span, MAX_SPAN)
                self._anchor(filters, inertial.at(k))
                if changed and self._use_position:
                    filters.open_position(OPEN_POSITION)
                yield epoch
                return
            if k + 1 == len(epochs):
                self._inertial = inertial.at(k)
            yield epoch

    def _choose(self, epoch: AntennaEpoch) -> bool:
        """Decide whether positions are used, see `VELOCITY_STOPPED_NS`; return if it changes."""
        before = self._use_position
        stopped = epoch.stamp_ns - self._velocity_ns > VELOCITY_STOPPED_NS
        if epoch.v_n is not None:
            if self._velocities_since_ns is None or stopped:
                self._velocities_since_ns = epoch.stamp_ns
            self._velocity_ns = epoch.stamp_ns
            if (self._config.use_position == 'auto'
                    and epoch.stamp_ns - self._velocities_since_ns >= VELOCITY_BACK_NS):
                self._use_position = False
        elif self._config.use_position == 'auto' and epoch.position_measured and stopped:
            self._use_position = True
        return self._use_position != before

    def _freeze(self, epoch: AntennaEpoch) -> None:
        """Let n0 be the local level at an epoch; the next epoch is linearised again."""
        self._n0_ns, self._C_nn0 = epoch.stamp_ns, np.eye(3)
        self._inertial = InertialTrack.start(epoch.latitude, epoch.longitude, epoch.altitude)
        self._point = None
        self._left = self._span

    def _point_of(self, filters: Filters) -> Array:
        """Return the point of linearisation: the likeliest mean of each rival, one delay."""
        point = filters.x[filters.lead]
        point[:, DELAY] = np.clip(point[filters.best, DELAY], EARLIEST, LATEST)
        return point

    def _model(self, filters: Filters, point: Array, imu: Intervals) -> Linearised:
        """Linearise the epochs that follow the intervals."""
        return linearised(point, imu.mirrored(self._rivals.signs[filters.ids]),
                          (imu.Q + SHARE * imu.Q_excess)[:, None], self._use_position,
                          None if self._vehicle is None else self._vehicle.position)

    def _anchor(self, filters: Filters, track: InertialTrack) -> None:
        """Freeze n0 at the last epoch that was processed, where the track ends."""
        filters.change_axes(track.C_n0n.T, track.still_v, track.s_p)
        self._freeze(self._last)

    def _step(self, filters: Filters, model: Linearised, k: int, measured: Measured) -> None:
        """Propagate all means over the interval before epoch k, and update them."""
        vehicle = self._vehicle
        filters.propagate(model, k)
        self._seconds += model.duration[k]
        self._innovation = NO_INNOVATION
        kinds = [kind for kind, present in enumerate(measured.present[k]) if present]
        self._measured = bool(kinds)
        due = vehicle is not None and vehicle.is_due(model.duration[k], bool(kinds))
        if not kinds:
            return
        # A vehicle that moves along its own axis tells something of the vertical velocity.
        vertical = vehicle is not None or measured.vertical[k]
        if vertical and not self._vertical_measured:
            filters.reset_vertical(measured.still[k, 2], STEADY_VELOCITY, OPEN_POSITION)
        news, receiver = [], self._receiver
        moving = bool(np.linalg.norm(measured.s[k, 0] - measured.still[k]) > MOVING)
        for kind in kinds:
            stated = measured.stated[k][kind]
            new = filters.update(model, k, kind, measured, receiver.factors(kind, stated))
            receiver.follow(kind, stated, moving, new.square, new.normalised, self._seconds)
            self.counts[REJECTED[kind]] += not new.taken
            news.append(new)
        self._offered += 1
        good = all(new.taken for new in news)
        self._rejected += not good
        self.counts['epochs_used'] += good
        self._in_a_row = self._in_a_row + 1 if any(new.fits_none for new in news) else 0
        self._innovation = news[0].normalised
        if not vertical:
            filters.reset_vertical(measured.still[k, 2])
        self._vertical_measured = vertical
        if vehicle is not None and due:
            vehicle.update(filters, model, k, measured)
        self._rivals.select(filters)
        redraw_headings(filters)

    def _drop_vehicle(self, filters: Filters) -> str:
        """Give up the assumption on the vehicle if the motion contradicts it; return why."""
        vehicle = self._config.vehicle
        if self._vehicle is None or not self._vehicle.contradicted(filters):
            return ''
        self._not_used = NOT_USED.format(vehicle=vehicle)
        self._config = replace(self._config, vehicle='none')
        return f'the motion contradicts vehicle: {vehicle}'

    def _conclude(self) -> None:
        """Mix the attitudes at an epoch, and ask the rivals."""
        filters = self._filters
        if filters is None:
            return
        self._mixture = filters.mixture()
        self._doubt, self._contradicted = (
            '' if self._vehicle is None else self._vehicle.doubt(filters)), False
        if not self._doubt:
            self._doubt, self._contradicted = self._rivals.doubt(filters, *self._mixture)

    # Start

    def _wait(self, epoch: AntennaEpoch, imu: Intervals) -> None:
        """Add an epoch to those from which the filters start, and start them if they suffice."""
        start = self._start
        self._measured = any(epoch.measured)
        start.add(epoch, imu)
        rough = start.solve(self._use_position)
        for name, count in zip(REJECTED, start.rejected):
            self.counts[name] += count
            self._rejected += count
            self._offered += count
        start.rejected = [0, 0]
        if start.epochs:
            self._last = start.epochs[0]
            self.t0_ns = self._last.stamp_ns
        if rough is not None:
            self._receiver.start(rough.kind, rough.stated, rough.noise)
            self._begin_with(rough)

    def _begin_with(self, rough: RoughAttitude) -> None:
        """Start filters for all headings and rivals at t0, and process the epochs since."""
        epochs, imu, rivals = self._start.epochs, self._start.imu, self._rivals
        C, P = zip(*(self._start.means(rough, rivals.x, known, sign) for known, sign in zip(
            rivals.P, rivals.signs[:, 3].tolist())))
        rival = np.repeat(np.arange(len(rivals.table)), HEADINGS)
        v_n = next((epoch.v_n for epoch in epochs if epoch.v_n is not None), np.zeros(3))
        self._freeze(epochs[0])
        inertial = self._inertial.along(epochs, self._n0_ns)
        self._filters = filters = Filters(np.concatenate(C), v_n, rivals.x, rival, np.array(P),
                                          rivals.walk, rivals.prior, rivals.mixed)
        for k in range(len(epochs)):
            one = slice(k, k + 1)
            model = self._model(filters, self._point_of(filters), imu.take(one))
            self._step(filters, model, 0,
                       inertial.at(one).measured(epochs[one], self._use_position))
        self._start = Start(self._config)
        self._last = epochs[-1]
        self._anchor(filters, inertial.at(len(epochs) - 1))

    # Results

    def attitudes(self) -> tuple[Attitude, Attitude] | None:
        """Return the attitudes at t0 and at the last epoch; None while there are none."""
        if self._mixture is None:
            return None
        (C0, C), (P0, P) = self._mixture
        C_nn0, inflation = self._C_nn0, self._receiver.inflation
        return (Attitude(self.t0_ns, C0, inflation * P0),
                Attitude(self._last.stamp_ns, C_nn0 @ C, inflation * C_nn0 @ P @ C_nn0.T))

    def fit(self) -> Fit:
        """Return how well the data fit, and what speaks against a declaration."""
        filters, receiver = self._filters, self._receiver
        if filters is None:
            return Fit(self._offered, self._measured, waiting=self._start.measured,
                       delay=self._config.gnss_delay, doubt=self._start.lacks)
        x, P = self._body()
        likeliest = self._rivals.table[filters.ids[filters.best]]
        remarks = receiver.in_words() + self._not_used + level_in_words(
            likeliest, self._config, x, P)
        if self._vehicle is not None:
            remarks += self._vehicle.in_words(filters)
        return Fit(self._offered, self._measured, rows=3 * (self._offered - self._rejected),
                   misfit=receiver.misfit, innovation=self._innovation, rejected=self._rejected,
                   delay=self._config.gnss_delay + float(x[DELAY]),
                   delay_std=likeliest.gnss_delay_std,
                   objection=self._doubt if self._contradicted else '', doubt=self._doubt,
                   remarks=remarks)

    def move_t0(self) -> None:
        """Move t0 to the last epoch."""
        assert self._filters is not None
        self._filters.clone(self._C_nn0.T)
        self._mixture = self._filters.mixture()
        self.counts['rebases'] += 1
        self.t0_ns = self._last.stamp_ns

    def _body(self) -> tuple[Array, Array]:
        """Return the likeliest parameters of the body and their covariance."""
        filters, known, known_P = self._filters, self._rivals.x, self._rivals.P[0]
        if filters is None or self._mixture is None:
            return known, known_P
        best = filters.best
        x, P = filters.x[filters.lead[best]].copy(), filters.P[best, FIRST:, FIRST:].copy()
        if self._mixture[1][1, 2, 2] > RESOLVED_STD ** 2:
            # Without a change of velocity lever arm and delay are estimated from nothing but the
            # noise of the IMU, which looks like a swing that the GNSS does not see.
            antenna = slice(0, GYRO)
            P[antenna] = P[:, antenna] = 0.0
            x[antenna], P[antenna, antenna] = known[antenna], known_P[antenna, antenna]
        return x, P

    def nuisance(self) -> Nuisance:
        """Return errors of the sensors, lever arm and delay at the last epoch."""
        x, P = self._body()
        std = np.sqrt(np.diag(P))
        gyro, accel = biases(x.size)
        matrix = x[triads(x.size)[0]][3:].reshape(-1, 3)
        return Nuisance(x[gyro], std[gyro], matrix if matrix.size else np.zeros((3, 3)),
                        x[accel], std[accel], x[LEVER_ARM], std[LEVER_ARM],
                        float(self._config.gnss_delay + x[DELAY]), float(std[DELAY]))

    def learnt(self) -> Learnt | None:
        """Return the prior for another start; None while epochs do not fit."""
        if self._mixture is None:
            return self._prior
        return None if self._in_a_row else Learnt(*self._body(), self._last.stamp_ns)
