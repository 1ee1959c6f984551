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
The aligner: messages in, attitudes and states out.

An intake and an alignment behind one face; replay uses the two themselves. Messages are buffered;
an epoch is processed when IMU samples `gnss_lateness` newer than it have come, so that late
messages find their place and the results depend on the messages alone.
"""

from collections import Counter
from copy import copy

from ins_align.alignment import Alignment
from ins_align.config import Config, ConfigError, parameters
from ins_align.geometry.earth import EARTH_RATE
from ins_align.geometry.rotation import Array
from ins_align.gnss.messages import Fix, Velocity
from ins_align.imu.buffer import MAX_GAP_NS
from ins_align.imu.plausibility import IMU_BEFORE, without_spikes
from ins_align.imu.prediction import Prediction
from ins_align.intake import Intake
from ins_align.results import Attitude, Epoch, Event, Severity, State, Status
import numpy as np

__all__ = ['Aligner', 'Attitude', 'Epoch', 'State', 'Status']

MAX_TOLD = 100  # sentences on messages that were rejected


class Aligner:
    """
    In-motion alignment from messages as they come.

    Parameters
    ----------
    config : Config, optional

    """

    def __init__(self, config: Config | None = None) -> None:
        """Wait for the first messages."""
        self.config = Config() if config is None else config
        self._intake = Intake(self.config)
        self._alignment = Alignment(self.config)
        self._events: list[Event] = []
        self._told: set[str] = set()                # of messages that were rejected
        self._done: list[Epoch] = []
        self._now: Prediction | None = None

    @property
    def declared(self) -> Attitude | None:
        """Return the initial attitude as it was declared, None while none is."""
        return self._alignment.declared

    @property
    def counts(self) -> Counter[str]:
        """Return what became of messages and epochs, by name."""
        return Counter(self.status().counts)

    @property
    def newest_imu_ns(self) -> int | None:
        """Return the stamp of the newest IMU sample of use, None where there is none."""
        stamps = self._intake.imu.stamps
        return int(stamps[-1]) if stamps.size else None

    # Input

    def add_imu(self, stamp_ns: 'int | np.ndarray', gyro: Array, accel: Array) -> None:
        """
        Take an IMU sample, or many.

        Parameters
        ----------
        stamp_ns : int or ndarray, shape (N,)
            Time of measurement.
        gyro, accel : array_like, shape (3,) or (N, 3)
            Angular rate, rad/s; specific force, m/s^2.

        """
        if isinstance(stamp_ns, np.ndarray):
            # Copies: they are looked at later.
            self._intake.add_imu_array(np.array(stamp_ns, np.int64), np.array(gyro, float),
                                       np.array(accel, float))
        else:
            self._intake.add_imu(stamp_ns, gyro, accel)
        if self._intake.steps:                      # the clock has jumped
            self._go()

    def add_fix(self, fix: Fix) -> None:
        """Take a GNSS position."""
        self._intake.add_fix(fix)

    def add_velocity(self, velocity: Velocity) -> None:
        """Take a GNSS velocity."""
        self._intake.add_velocity(velocity)

    def reject(self, reason: str, why: str = '') -> None:
        """Count a message that an adapter could not use; `why`, in words, is told once."""
        self._intake.reject(reason, why)
        if why and why not in self._told and len(self._told) < MAX_TOLD:
            self._told.add(why)
            self._events.append(Event(Severity.WARNING, why))

    def reset(self, reason: str = 'on request') -> None:
        """Start over."""
        self._intake.reset(reason)
        self._go()

    def reconfigure(self, config: Config) -> None:
        """
        Change what may change while running: thresholds and hold time.

        Raises
        ------
        ConfigError
            If anything else differs.

        """
        for parameter in parameters():
            if parameter.read_only and (getattr(config, parameter.name)
                                        != getattr(self.config, parameter.name)):
                raise ConfigError(f'{parameter.name} cannot change while running: set it at '
                                  'start')
        self.config = config
        self._alignment.reconfigure(config)

    # Processing

    def update(self) -> list[Epoch]:
        """Process what nothing late can precede any more; return the GNSS epochs in it."""
        return self._process(last=False)

    def flush(self) -> list[Epoch]:
        """Process the rest, at the end of a recording; return the GNSS epochs in it."""
        return self._process(last=True)

    def _process(self, last: bool) -> list[Epoch]:
        """Process what can be; return the GNSS epochs that were not returned yet."""
        self._intake.prepare(last)
        self._go()
        done, self._done = self._done, []
        return done

    def _go(self) -> None:
        """Go the steps that are prepared."""
        for step in self._intake.take_steps():
            self._done += [epoch for epoch in self._alignment.go(step) if not epoch.dry]
            self._now = None

    # Output

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call."""
        events, self._events = self._events + self._alignment.take_events(), []
        return events

    def attitude_now(self) -> Attitude | None:
        """
        Return the current attitude carried on with the gyros to the newest IMU sample.

        None before there is one, and after a gap of the IMU.
        """
        prediction = self.prediction()
        return None if prediction is None else Attitude(prediction.stamp_ns,
                                                        *prediction.matrices())

    def prediction(self) -> Prediction | None:
        """Return the attitude at the newest IMU sample to be carried on by whoever asks."""
        current, imu = self._alignment.current, self._intake.imu
        if current is None:
            return None
        imu.consolidate()
        start_ns = current.stamp_ns if self._now is None else self._now.stamp_ns
        stamps = imu.stamps
        first = int(np.searchsorted(stamps, start_ns, side='right'))
        if np.any(np.diff(stamps[first:], prepend=start_ns) > MAX_GAP_NS):
            return None                             # nobody knows how it has turned since
        looked_at = max(first - IMU_BEFORE, 0)
        samples, _ = without_spikes(stamps[looked_at:], imu.samples[looked_at:])
        rates = samples[:, :3]
        if self._now is None:
            sensors = self._alignment.sensor_errors()
            bias_std = float(np.max(self._alignment.nuisance().gyro_bias_std))
            self._now = Prediction(
                start_ns, current.C_nb, current.covariance, sensors.gyro_bias,
                sensors.gyro_matrix,
                self.config.imu_noise.angle_random_walk, bias_std ** 2 + EARTH_RATE ** 2,
                [float(np.interp(0.0, stamps[looked_at:] - start_ns, rate)) for rate in rates.T])
        self._now.carry_many(stamps[first:], rates[first - looked_at:])
        return copy(self._now)

    def status(self) -> Status:
        """Return the state, the reason for it, the estimates and the counts."""
        return self._alignment.status(self._intake.counts)
