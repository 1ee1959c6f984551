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
from ins_align.estimation.moments import AttitudeMoments
from ins_align.estimation.track import InertialTrack
from ins_align.geometry.rotation import Array, cross, orthonormalized
from ins_align.gnss.messages import AntennaEpoch
from ins_align.imu.preintegration import Intervals, SensorErrors
from ins_align.results import Nuisance
import numpy as np

# Sigma of an angle that is uniformly distributed, radians.
UNIFORM_STD = math.pi / math.sqrt(3.0)


class BodyIntegrals:
    """
    The body side of the formulas, accumulated interval by interval from t0.

    Attributes
    ----------
    time : float
        Seconds since t0.
    C_b0b : ndarray, shape (3, 3)
    omega_ib_b : ndarray, shape (3,)
        Angular rate now; `omega_ib_b0` at t0.
    int_f, int_int_f : ndarray, shape (3,)
        Single and double integral of ``C_b0b f_b``.

    """

    def __init__(self, lever_b: Array, omega_ib_b0: Array) -> None:
        """Start at t0."""
        self.lever_b = np.asarray(lever_b, dtype=float)
        self.omega_ib_b0 = self.omega_ib_b = np.asarray(omega_ib_b0, dtype=float)
        self.time = 0.0
        self.C_b0b = np.eye(3)
        self.int_f = np.zeros(3)
        self.int_int_f = np.zeros(3)

    def advance(self, interval: Intervals, k: int) -> None:
        """Append interval `k` of `interval`."""
        duration = interval.duration[k]
        self.int_int_f = (self.int_int_f + duration * self.int_f
                          + self.C_b0b @ interval.p[k])
        self.int_f = self.int_f + self.C_b0b @ interval.v[k]
        self.C_b0b = orthonormalized(self.C_b0b @ interval.R[k])
        self.omega_ib_b = interval.omega[k]
        self.time += duration

    @property
    def a_v(self) -> Array:
        """``int C_b0b f + C_b0b (omega_ib x lever)``: the free-start body velocity."""
        return self.int_f + self.C_b0b @ cross(self.omega_ib_b, self.lever_b)

    @property
    def a_p(self) -> Array:
        """``int int C_b0b f + C_b0b lever``: the free-start body position."""
        return self.int_int_f + self.C_b0b @ self.lever_b

    @property
    def alpha_v(self) -> Array:
        """Right side of the note's (9), short form."""
        return self.a_v - cross(self.omega_ib_b0, self.lever_b)

    @property
    def alpha_p(self) -> Array:
        """Right side of the position form, Remark 2.3."""
        return (self.a_p - self.lever_b
                - self.time * cross(self.omega_ib_b0, self.lever_b))


class NavigationSide:
    """
    The navigation side of the formulas, from velocities: s_v, and s_p as its integral.

    Attributes
    ----------
    time : float
        Seconds since t0.
    v_n0 : ndarray, shape (3,)
        Antenna velocity at t0, ENU, m/s.
    s_v : ndarray, shape (3,)
        Free-start velocity, ``C_n0n v_n + int C_n0n (omega_ie x v_n) - int C_n0n g_n``, which is
        `InertialTrack.s_v`.
    s_p : ndarray, shape (3,)
        Free-start position, one more integral.

    """

    def __init__(self, v_n0: Array) -> None:
        """Start at t0."""
        self.time = 0.0
        self.v_n0 = self.s_v = v_n0
        self.s_p = np.zeros(3)
        self._before: tuple[float, Array] | None = None

    def advance(self, time: float, s_v: Array) -> None:
        """Append an epoch; s_p follows the parabola through the last three of them."""
        h, last = time - self.time, self.s_v
        area = h / 2 * (last + s_v)
        if self._before is not None and 0.5 <= h / self._before[0] <= 2.0:
            g, first = self._before
            area = h / 6 * ((3 * g + 2 * h) / (g + h) * s_v + (3 * g + h) / g * last
                            - h * h / (g * (g + h)) * first)
        self.time, self.s_v, self.s_p = time, s_v, self.s_p + area
        self._before = h, last

    @property
    def beta_v(self) -> Array:
        """Left side of the note's (9)."""
        return self.s_v - self.v_n0

    @property
    def beta_p(self) -> Array:
        """Left side of the position form, Remark 2.3."""
        return self.s_p - self.time * self.v_n0


def _mean_variance(covariance: Array) -> float:
    """Mean of the three axes' variances."""
    return float(np.trace(covariance)) / 3


class NoteMethod:
    """
    The note's velocity (``vif``) or position (``pif``) integration formula with lever arm.

    It does not model errors of the IMU: sigmas come from the centred moments, the noise of the
    receiver and the residuals, and without GNSS from the noise of the gyros. ``pif`` uses
    positions where there are no velocities; the start velocity is then always free.

    Parameters
    ----------
    config : Config
    epoch : AntennaEpoch
        The first epoch, t0.
    imu : Intervals
        The interval at t0, whose duration is zero.
    use_position : bool
        For ``pif``: integrate positions, not velocities.

    """

    def __init__(self, config: Config, epoch: AntennaEpoch, imu: Intervals,
                 use_position: bool) -> None:
        """Start at t0."""
        self.t0_ns = epoch.stamp_ns
        self.counts: Counter[str] = Counter()
        self.restarted = ''
        self._config = config
        self._lever_b = np.array(config.lever_arm)
        self._free = config.free_start
        self._position_form = config.method == 'pif'
        self._from_positions = self._position_form and use_position
        self._body = BodyIntegrals(self._lever_b, imu.omega[0])
        self._track = InertialTrack.start(epoch.latitude, epoch.longitude, epoch.altitude)
        self._navigation = None if epoch.v_n is None else NavigationSide(epoch.v_n)
        nuisance = 0
        if self._position_form:
            nuisance = 2 if self._free else int(self._from_positions)
        elif self._free:
            nuisance = 1
        self._moments = AttitudeMoments(nuisance)
        self._nuisance = nuisance
        self._offered = 0
        self._variance = 0.0                # of the receiver, summed over pairs
        self._start_variance = _mean_variance(epoch.position_covariance if self._from_positions
                                              else epoch.velocity_covariance)
        self._solution: tuple[Array, Array] | None = None
        self._solved_s = 0.0
        self._residual = 0.0
        if self._free or self._from_positions:
            self._pair(epoch)

    def advance(self, epochs: Sequence[AntennaEpoch], imu: Intervals) -> Iterator[AntennaEpoch]:
        """Process epochs and the IMU intervals before each; see `Bank.advance`."""
        for k, epoch in enumerate(epochs):
            self._body.advance(imu, k)
            self._track = self._track.along([epoch], self.t0_ns).at(0)
            if epoch.v_n is not None and self._navigation is not None:
                self._navigation.advance(float(self._track.time), self._track.s_v(epoch.v_n))
            self._pair(epoch)
            yield epoch

    def _pair(self, epoch: AntennaEpoch) -> None:
        """Add the pair of vectors of an epoch and solve."""
        body, time = self._body, float(self._track.time)
        if self._from_positions:
            if not epoch.position_measured:
                return
            regressors = (1.0, time) if self._free else (time,)
            first = 0.0 if self._free else 1.0
            self._moments.add(self._track.s_p, body.a_p - first * self._lever_b, regressors)
            self._variance += _mean_variance(epoch.position_covariance)
        elif epoch.v_n is not None and self._navigation is not None:
            navigation = self._navigation
            if self._position_form:
                if self._free:
                    self._moments.add(navigation.s_p, body.a_p, (1.0, time))
                else:
                    self._moments.add(navigation.beta_p, body.alpha_p)
            elif self._free:
                self._moments.add(navigation.s_v, body.a_v, (1.0,))
            else:
                self._moments.add(navigation.beta_v, body.alpha_v)
            self._variance += _mean_variance(epoch.velocity_covariance)
        else:
            return
        self._offered += 1
        self.counts['epochs_used'] += 1
        if self._rows <= 0:
            return
        C, residual, A = self._moments.solve()
        A_n = C @ A @ C.T
        information = np.trace(A_n) * np.eye(3) - A_n
        self._residual = float(residual)
        self._solved_s = time
        white, common = self._noise()
        # Noise that all pairs have in common does not average out.
        self._solution = C, np.linalg.inv(information / (white + self._moments.count * common)
                                          + np.eye(3) / UNIFORM_STD ** 2)

    def _noise(self) -> tuple[float, float]:
        """Return the white variance of a pair, and the variance that all pairs have in common."""
        variance = self._variance / self._offered
        start = 0.0 if self._free else self._start_variance
        if not self._position_form or self._from_positions:
            return variance, start
        # Integrated velocities are a random walk, of which a free start removes all but 1/15; the
        # error of the first velocity grows with time.
        time = float(self._track.time)
        walk = variance * time / self._offered * time
        return 0.0, walk / 15 if self._free else walk / 2 + start * time ** 2 / 3

    def initial(self) -> tuple[Array, Array] | None:
        """Return ``C_nb(t0)`` and the covariance of its error in ENU."""
        if self._solution is None:
            return None
        return self._solution[0], self._factor() * self._solution[1]

    def current(self) -> tuple[Array, Array] | None:
        """Return ``C_nb`` at the last epoch and the covariance of its error in ENU."""
        if self._solution is None:
            return None
        C, covariance = self._solution
        C_nn0 = self._track.C_n0n.T
        # Without measurements the gyros alone carry the attitude.
        noise, silent_s = self._config.imu_noise, float(self._track.time) - self._solved_s
        drift = noise.angle_random_walk ** 2 * silent_s + (noise.gyro_bias_std * silent_s) ** 2
        return (orthonormalized(C_nn0 @ C @ self._body.C_b0b),
                self._factor() * (C_nn0 @ covariance @ C_nn0.T + drift * np.eye(3)))

    def fit(self) -> Fit:
        """Return how well the data fit."""
        if self._solution is None:
            return Fit(self._offered, delay=self._config.gnss_delay)
        return Fit(self._offered, rows=self._rows, delay=self._config.gnss_delay,
                   misfit=self._residual / sum(self._noise()) / self._rows)

    @property
    def _rows(self) -> int:
        """Return how many rows of the pairs are redundant."""
        return 3 * (self._moments.count - 1 - self._nuisance)

    def _factor(self) -> float:
        """Return the factor on variances for data that fit worse than stated."""
        return max(1.0, self.fit().misfit)

    def move_t0(self) -> None:
        """Leave t0 where it is."""

    def nuisance(self) -> Nuisance:
        """Return what is assumed: no biases, lever arm and delay as configured."""
        zero = np.zeros(3)
        return Nuisance(zero, zero, zero, zero, self._lever_b, zero, self._config.gnss_delay, 0.0)

    def sensor_errors(self) -> SensorErrors:
        """Return zeros."""
        return SensorErrors.from_vector(np.zeros(24))

    def learnt(self) -> None:
        """Return nothing: only the attitude is estimated."""
