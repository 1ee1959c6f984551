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
The note: velocity and position integration formulas with lever arm, and attitude from them.

Y. Wu, "Further results on 'Velocity/position integration formula (I): application to in-flight
coarse alignment'", and the free start and the position form (Remark 2.3) that this package
adds (docs, "Theory").
"""

from collections import Counter
from collections.abc import Iterator, Sequence
import math

from ins_align.config import Config
from ins_align.estimation.declaration import Fit
from ins_align.estimation.moments import solve_moments
from ins_align.estimation.track import BodyTrack, InertialTrack
from ins_align.geometry.rotation import Array, orthonormalized
from ins_align.gnss.messages import AntennaEpoch, velocities_of
from ins_align.imu.preintegration import Intervals
from ins_align.results import Attitude, Nuisance
import numpy as np

# Sigma of an angle that is uniformly distributed, radians.
UNIFORM_STD = math.pi / math.sqrt(3.0)


class VelocityIntegral:
    """
    s_p of velocities alone: the integral of `InertialTrack.s_v`.

    Attributes
    ----------
    s_p : ndarray, shape (3,)
        The integral from t0 to the last velocity, m.

    """

    def __init__(self, s_v: Array) -> None:
        """Start at t0 with s_v there, m/s."""
        self.s_p = np.zeros(3)
        self._time, self._s_v = 0.0, s_v
        self._before: tuple[float, Array] | None = None

    def advance(self, time: float, s_v: Array) -> None:
        """Append s_v `time` seconds after t0; a parabola goes through the last three."""
        h, last = time - self._time, self._s_v
        area = h / 2 * (last + s_v)
        if self._before is not None and 0.5 <= h / self._before[0] <= 2.0:
            g, first = self._before
            area = h / 6 * ((3 * g + 2 * h) / (g + h) * s_v + (3 * g + h) / g * last
                            - h * h / (g * (g + h)) * first)
        self._time, self._s_v, self.s_p = time, s_v, self.s_p + area
        self._before = h, last


class NoteMethod:
    """
    The note's velocity (``vif``) or position (``pif``) integration formula with lever arm.

    It does not model errors of the IMU: sigmas come from the centred moments, the noise of the
    receiver and the residuals, and without GNSS from the noise of the gyros. ``pif`` uses
    positions where t0 has no velocity; the start velocity is then always free.

    Parameters
    ----------
    config : Config
    epoch : AntennaEpoch
        The first epoch, t0.
    imu : Intervals
        The interval at t0, whose duration is zero.

    """

    def __init__(self, config: Config, epoch: AntennaEpoch, imu: Intervals) -> None:
        """Start at t0."""
        self.t0_ns = self._last_ns = epoch.stamp_ns
        self.counts: Counter[str] = Counter()
        self.restarted = ''
        self._config = config
        self._lever_b = np.array(config.lever_arm)
        self._free = config.free_start
        self._kind = int(config.method == 'pif')            # 0: velocity form, 1: position form
        self._from_positions = config.method == 'pif' and epoch.v_n is None
        self._track = InertialTrack.start(epoch.latitude, epoch.longitude, epoch.altitude)
        self._body = BodyTrack().along(imu).at(0)
        self._integral = VelocityIntegral(velocities_of([epoch])[0])
        # The start is a constant, and in the position form a slope. What is not free of them is
        # known, (n, 6): the pairs of positions and of velocities at t0.
        kinds = ([] if self._free else [1] if self._from_positions
                 else [1, 0] if self._kind else [0])
        self._known = np.array([self._vectors(epoch, kind) for kind in kinds]).reshape(-1, 6)
        self._nuisance = 1 + self._kind - len(kinds)
        self._moments = np.zeros((6 + self._nuisance, 6 + self._nuisance))
        self._offered, self._measured = 0, True     # pairs; whether the last epoch has one
        self._variance = 0.0                # of the receiver, summed over pairs
        self._start_variance = self._receiver_variance(epoch)
        self._solution: tuple[Array, Array] | None = None
        self._solved_s = 0.0
        self._residual = 0.0
        if self._nuisance:
            self._pair(epoch)

    def advance(self, epochs: Sequence[AntennaEpoch], imu: Intervals) -> Iterator[AntennaEpoch]:
        """Process epochs and the IMU intervals before each; see `Bank.advance`."""
        track, body = self._track.along(epochs, self.t0_ns), self._body.along(imu)
        for k, epoch in enumerate(epochs):
            self._track, self._body, self._last_ns = track.at(k), body.at(k), epoch.stamp_ns
            if epoch.v_n is not None:
                self._integral.advance(float(self._track.time), self._track.s_v(epoch.v_n))
            self._pair(epoch)
            yield epoch

    def _vectors(self, epoch: AntennaEpoch, kind: int) -> Array:
        """Return s and a at an epoch, the last one, shape (6,): of velocity (0) or position."""
        if kind:
            s = self._track.s_p if self._from_positions else self._integral.s_p
            a = self._body.a_p(self._lever_b)
        else:
            s, a = self._track.s_v(velocities_of([epoch])[0]), self._body.a_v(self._lever_b)
        return np.hstack([s, a])

    def _receiver_variance(self, epoch: AntennaEpoch) -> float:
        """Return the receiver's variance of what is used, mean of the three axes."""
        return float(np.trace(epoch.covariances[self._from_positions])) / 3

    def _pair(self, epoch: AntennaEpoch) -> None:
        """Add the pair of vectors of an epoch, without the known start, and solve."""
        self._measured = bool(epoch.measured[self._from_positions])
        if not self._measured:
            return
        time = float(self._track.time)
        known, free = np.split(time ** np.arange(1 + self._kind), [len(self._known)])
        row = np.hstack([self._vectors(epoch, self._kind) - known @ self._known, free])
        self._moments += np.outer(row, row)
        self._variance += self._receiver_variance(epoch)
        self._offered += 1
        self.counts['epochs_used'] += 1
        if self._rows <= 0:
            return
        C, residual, A = solve_moments(self._moments)
        A_n = C @ A @ C.T
        information = np.trace(A_n) * np.eye(3) - A_n
        self._residual = float(residual)
        self._solved_s = time
        white, common = self._noise()
        # Noise that all pairs have in common does not average out.
        self._solution = C, np.linalg.inv(information / (white + self._offered * common)
                                          + np.eye(3) / UNIFORM_STD ** 2)

    def _noise(self) -> tuple[float, float]:
        """Return the white variance of a pair, and the variance that all pairs have in common."""
        variance = self._variance / self._offered
        start = 0.0 if self._free else self._start_variance
        if not self._kind or self._from_positions:
            return variance, start
        # Integrated velocities are a random walk, of which a free start removes all but 1/15; the
        # error of the first velocity grows with time.
        time = float(self._track.time)
        walk = variance * time / self._offered * time
        return 0.0, walk / 15 if self._free else walk / 2 + start * time ** 2 / 3

    def attitudes(self) -> tuple[Attitude, Attitude] | None:
        """Return the attitudes at t0 and at the last epoch; None while there are none."""
        if self._solution is None:
            return None
        C, covariance = self._solution
        C_nn0 = self._track.C_n0n.T
        # Data that fit worse than stated are noisier.
        factor = max(1.0, self.fit().misfit)
        # Without measurements the gyros alone carry the attitude.
        noise, silent_s = self._config.imu_noise, float(self._track.time) - self._solved_s
        drift = noise.angle_random_walk ** 2 * silent_s + (noise.gyro_bias_std * silent_s) ** 2
        return (Attitude(self.t0_ns, C, factor * covariance),
                Attitude(self._last_ns, orthonormalized(C_nn0 @ C @ self._body.C_b0b),
                         factor * (C_nn0 @ covariance @ C_nn0.T + drift * np.eye(3))))

    def fit(self) -> Fit:
        """Return how well the data fit."""
        if self._solution is None:
            return Fit(self._offered, self._measured, delay=self._config.gnss_delay)
        return Fit(self._offered, self._measured, rows=self._rows, delay=self._config.gnss_delay,
                   misfit=self._residual / sum(self._noise()) / self._rows)

    @property
    def _rows(self) -> int:
        """Return how many rows of the pairs are redundant."""
        return 3 * (self._offered - 1 - self._nuisance)

    def move_t0(self) -> None:
        """Leave t0 where it is."""

    def nuisance(self) -> Nuisance:
        """Return what is assumed: no biases, lever arm and delay as configured."""
        zero = np.zeros(3)
        return Nuisance(zero, zero, np.zeros((3, 3)), zero, zero, self._lever_b, zero,
                        self._config.gnss_delay, 0.0)

    def learnt(self) -> None:
        """Return nothing: only the attitude is estimated."""
