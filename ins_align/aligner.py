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

The same object works under the node and under replay. Messages are buffered; an epoch is
processed when IMU samples `gnss_lateness` newer than it have come, so that late messages find
their place and the results depend on the messages alone.
"""

from collections import Counter
from copy import copy
import math
from typing import NamedTuple

from ins_align.antenna import Antenna
from ins_align.buffers import GnssBuffer, GnssEpoch, ImuBuffer, PAIR_NS
from ins_align.config import Config, ConfigError, parameters
from ins_align.declaration import Declaration, State, Verdict
from ins_align.earth import EARTH_RATE
from ins_align.imu_steps import ImuCutter
from ins_align.messages import Fix, Velocity
from ins_align.methods import AntennaEpoch, MapMethod, Method, NoteMethod, Nuisance
from ins_align.plausibility import ForceCheck, IMU_BEFORE, stuck, without_spikes
from ins_align.prediction import Prediction
from ins_align.results import Attitude, Epoch, Status
from ins_align.rotation import Array
from ins_align.unknowns import Prior
import numpy as np

# The IMU may be silent for this long; then the attitude is lost and alignment starts over (ns).
MAX_GAP_NS = 500_000_000
# Without GNSS an epoch without measurement is made this often, which bounds the buffer (ns).
DRY_INTERVAL_NS = 2_000_000_000
# Positions alone are taken when no velocity came for this long (ns).
NO_VELOCITY_NS = 2_000_000_000
# The IMU samples of a run of epochs that are handled at one go, and what an epoch costs beside.
MAX_RUN_SAMPLES, EPOCH_SAMPLES = 4096, 16
_NOTHING_YET = Verdict(State.WAITING_FOR_IMU, 'no IMU sample yet')


class _Silence(NamedTuple):
    """A time during which the IMU says nothing that could be used; stamps, what to count, why."""

    start_ns: int
    end_ns: int
    counter: str
    why: str


class _Located(NamedTuple):
    """An epoch, what was known of the GNSS then, and whether it is without GNSS."""

    epoch: AntennaEpoch
    fault: str                  # of the velocities
    gravity_drift: float        # noise of gravity for want of a place, m/s/sqrt(s)
    dry: bool


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
        self.counts: Counter[str] = Counter()
        self._events: list[str] = []
        self._delay_ns = round(self.config.gnss_delay * 1e9)
        self._lateness_ns = (round(self.config.gnss_lateness * 1e9) + max(self._delay_ns, 0))
        self._done: list[Epoch] = []
        self._silences: list[_Silence] = []
        self._start_over(None)

    def _start_over(self, prior: Prior | None) -> None:
        """Forget everything but the counts and the prior."""
        self._imu = ImuBuffer(self._lateness_ns, self.counts)
        self._cutter = ImuCutter(self.config.imu_noise, self._imu, self.counts)
        self._gnss = GnssBuffer(self._lateness_ns, self.counts,
                                0 if self.config.use_velocity is False else PAIR_NS)
        self._forget_alignment(prior)

    def _forget_alignment(self, prior: Prior | None) -> None:
        """Start the alignment again on what is buffered."""
        self._prior = prior
        self._method: Method | None = None
        self._declaration = Declaration(self.config)
        self._force_check = ForceCheck()
        self._antenna = Antenna(self.config, self.counts)
        self._verdict = _NOTHING_YET
        self._first_t0_ns: int | None = None
        self._first_fix_ns: int | None = None
        self._last_ns: int | None = None            # the last epoch put into the run
        self._run: list[_Located] = []
        self._initial: Attitude | None = None
        self._current: Attitude | None = None
        self._time_to_align_s: float | None = None
        self.declared: Attitude | None = None
        self._now: Prediction | None = None

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
            self._add_imu_array(stamp_ns, np.asarray(gyro, float), np.asarray(accel, float))
            return
        self._imu.add(stamp_ns, gyro, accel)
        if self._imu.jumped_to_ns is not None:
            self._clock_jumped()
            self._imu.add(stamp_ns, gyro, accel)

    def _add_imu_array(self, stamps_ns: np.ndarray, gyro: Array, accel: Array) -> None:
        self._imu.add_many(stamps_ns, gyro, accel)
        jumped_to = self._imu.jumped_to_ns
        if jumped_to is not None:
            first = int(np.flatnonzero(stamps_ns == jumped_to)[0])
            self._clock_jumped()
            self._add_imu_array(stamps_ns[first:], gyro[first:], accel[first:])

    def _clock_jumped(self) -> None:
        self._done = self.update()                  # what could have been asked for before
        self.counts['clock_jumps'] += 1
        self._events.append('the clock of the IMU jumped back: alignment starts over')
        self._start_over(None)

    def add_fix(self, fix: Fix) -> None:
        """Take a GNSS position."""
        self._gnss.add_fix(fix._replace(stamp_ns=fix.stamp_ns - self._delay_ns),
                           self._imu.newest_ns)

    def add_velocity(self, velocity: Velocity) -> None:
        """Take a GNSS velocity."""
        self._gnss.add_velocity(velocity._replace(stamp_ns=velocity.stamp_ns - self._delay_ns),
                                self._imu.newest_ns)

    def reject(self, reason: str) -> None:
        """Count a message that an adapter could not convert."""
        self.counts[reason] += 1

    def reset(self, reason: str = 'on request') -> None:
        """Start over."""
        self.counts['resets'] += 1
        self._events.append(f'alignment starts over: {reason}')
        self._start_over(None)

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
        self.config = self._declaration.config = config

    # Processing

    def update(self) -> list[Epoch]:
        """Process every epoch that nothing late can precede any more."""
        newest = self._imu.newest_ns
        return [] if newest is None else self._process(newest - self._lateness_ns)

    def flush(self) -> list[Epoch]:
        """Process the rest, at the end of a recording."""
        newest = self._imu.newest_ns
        return [] if newest is None else self._process(newest, last=True)

    def _process(self, upto_ns: int, last: bool = False) -> list[Epoch]:
        self._imu.consolidate()
        stamps = self._imu.stamps
        if stamps.size < 4:
            return []
        # Interpolation at an epoch wants two samples after it, and whether they are spikes shows
        # in the next one.
        upto_ns = min(upto_ns, int(stamps[-3]))
        self._silences = self._find_silences(self._cutter.check_range(upto_ns))
        for message in self._gnss.release(upto_ns, last):
            self._dry_epochs(message.stamp_ns)
            self._line_up(message)
        waiting_ns = self._gnss.oldest_ns
        self._dry_epochs(upto_ns if waiting_ns is None else min(upto_ns, waiting_ns))
        self._advance()
        if self._method is None:
            self._cutter.forget_before(upto_ns)
            if self._verdict is _NOTHING_YET:
                self._set_verdict(Verdict(State.WAITING_FOR_GNSS, 'no GNSS position yet'))
        done, self._done = self._done, []
        return done

    def _dry_epochs(self, upto_ns: int) -> None:
        """Go on without GNSS up to a stamp in steps of bounded length."""
        while (self._method is not None and self._last_ns is not None
               and upto_ns - self._last_ns > DRY_INTERVAL_NS):
            self._line_up(GnssEpoch(self._last_ns + DRY_INTERVAL_NS), dry=True)

    def _line_up(self, message: GnssEpoch, dry: bool = False) -> None:
        """Put an epoch into the run of those that the method takes at one go."""
        if self._last_ns is not None and message.stamp_ns <= self._last_ns:
            self.counts['gnss_out_of_order'] += 1
            return
        epoch = self._antenna.epoch(message)
        if self._antenna.jumped:
            self._lose('the position jumped')
            epoch = self._antenna.epoch(message)
        if epoch is None:
            return
        if self._method is None:
            self._start(epoch)
            return
        assert self._last_ns is not None
        if silence := self._silence(self._last_ns, epoch.stamp_ns):
            self.counts[silence.counter] += 1
            self._lose(silence.why)
        else:
            self._run.append(_Located(epoch, self._antenna.fault,
                                      self._antenna.gravity_drift(epoch.stamp_ns), dry))
            self._last_ns = epoch.stamp_ns

    def _find_silences(self, blind: list[int]) -> list[_Silence]:
        """When the IMU says nothing, in what is buffered; `blind`: too much was missed (ns)."""
        stamps = self._imu.stamps
        last = np.flatnonzero(np.diff(stamps) > MAX_GAP_NS)
        why = f'no IMU sample for more than {MAX_GAP_NS * 1e-9:g} s'
        silences = [_Silence(start, end, 'imu_gap', why) for start, end in
                    zip(stamps[last].tolist(), stamps[last + 1].tolist())]
        # An epoch is taken when the IMU is ahead by the lateness: what is known by then, not what
        # is known when somebody looks.
        silences += [_Silence(max(start, known - self._lateness_ns), end, 'imu_stuck',
                              'the IMU sends the same values again and again')
                     for start, end, known in stuck(stamps, self._imu.samples)]
        silences += [_Silence(stamp - 1, stamp, 'imu_blind', 'the gyros are at the end of their '
                              'range: let the driver set a larger one')
                     for stamp in blind]
        return silences

    def _silence(self, start_ns: int, end_ns: int) -> '_Silence | None':
        """Return why the IMU says too little between two stamps, or at one."""
        for silence in self._silences:
            if silence.start_ns < end_ns and silence.end_ns > start_ns:
                return silence
        return None

    def _advance(self) -> None:
        """Let the method take the run of epochs, so many at a time that memory stays bounded."""
        run, self._run = self._run, []
        if not run:
            return
        method = self._method
        assert method is not None
        place = np.searchsorted(self._imu.stamps, [located.epoch.stamp_ns for located in run])
        size = place - place[0] + EPOCH_SAMPLES * np.arange(len(run))
        cuts = np.flatnonzero(np.diff(size // MAX_RUN_SAMPLES)) + 1
        for part in np.split(np.arange(len(run)), cuts):
            epochs = [run[k].epoch for k in part]
            imu, forces = self._cutter.cut([epoch.stamp_ns for epoch in epochs],
                                           [run[k].gravity_drift for k in part])
            for k, epoch in enumerate(method.advance(epochs, imu)):
                self._force_check.add(*forces[k])
                done = self._judge(epoch, run[part[k]].fault)
                if not run[part[k]].dry:
                    self._done.append(done)

    def _start(self, epoch: AntennaEpoch) -> None:
        """Make an epoch t0 if it can be one."""
        if not epoch.position_measured:
            return
        if self._first_fix_ns is None:
            self._first_fix_ns = epoch.stamp_ns
        wanted = self.config.use_velocity is not False
        alone = (not wanted or (self.config.use_velocity == 'auto' and self.config.method != 'vif'
                                and epoch.stamp_ns - self._first_fix_ns >= NO_VELOCITY_NS))
        if epoch.v_n is None and not alone:
            self._set_verdict(Verdict(State.WAITING_FOR_GNSS, 'no GNSS velocity yet'))
            return
        use_position = self.config.use_position
        if use_position == 'auto':
            # Beside velocities positions gain little and hurt when their errors wander or their
            # stamps are a few milliseconds off.
            use_position = epoch.v_n is None
        if epoch.v_n is None and not use_position:
            self._set_verdict(Verdict(State.WAITING_FOR_GNSS, 'no GNSS velocity yet, and '
                                      'use_position is false'))
            return
        if self._imu.stamps[0] > epoch.stamp_ns:
            return
        if silence := self._silence(epoch.stamp_ns, epoch.stamp_ns):
            self._set_verdict(Verdict(State.WAITING_FOR_IMU, silence.why))
            return
        self._last_ns = self._first_t0_ns = epoch.stamp_ns
        imu = self._cutter.start(epoch.stamp_ns)
        if self.config.method == 'map':
            self._method = MapMethod(self.config, epoch, imu, bool(use_position), self._prior)
        else:
            self._method = NoteMethod(self.config, epoch, imu, epoch.v_n is None)
        self._done.append(self._judge(epoch, self._antenna.fault))

    def _lose(self, why: str) -> None:
        """Start the alignment over; biases are kept."""
        self._advance()
        prior = None if self._method is None else self._method.prior_without_attitude()
        if self._method is not None:
            self.counts['restarts'] += 1
            self._events.append(f'alignment starts over: {why}')
        self._forget_alignment(prior)

    def _judge(self, epoch: AntennaEpoch, fault: str) -> Epoch:
        """Results and state after an epoch; `fault` is what is known to be wrong with the GNSS."""
        method, stamp_ns = self._method, epoch.stamp_ns
        assert method is not None and self._first_t0_ns is not None
        time_s = (stamp_ns - self._first_t0_ns) * 1e-9
        fit = method.fit()
        if not fit.converged:
            method.settle()
            fit = method.fit()
        initial, current = method.initial(), method.current()
        self._now = None
        measured = epoch.v_n is not None or epoch.position_measured
        verdict = self._verdict
        if initial is None or current is None:
            self._initial = self._current = None
            verdict = Verdict(State.ALIGNING, f'{fit.offered} GNSS epochs so far: more are '
                                              'needed')
        else:
            if measured:
                verdict = self._declaration.update(time_s, initial[1], current[1], fit,
                                                   method.unconfirmed)
                if self._declaration.later_start:
                    method.renew()
            scale = fit.factor ** 2 if math.isfinite(fit.factor) else 1.0
            self._initial = Attitude(method.t0_ns, initial[0], initial[1] * scale)
            self._current = Attitude(stamp_ns, current[0], current[1] * scale)
        fault = self._force_check.fault or fault
        if fault:
            self._declaration.levelled = self._declaration.aligned = False
            verdict = Verdict(State.FAULT, fault)
        method.judged(self._declaration.contradicted or bool(fault),
                      verdict.state in (State.LEVELLED, State.ALIGNED))
        if verdict.state is State.ALIGNED and self.declared is None:
            self.declared = self._initial
            self._time_to_align_s = time_s
        elif verdict.state is not State.ALIGNED and self.declared is not None:
            self.declared = self._time_to_align_s = None
            self.counts['withdrawals'] += 1
        self._set_verdict(verdict)
        sensors = method.sensor_errors()
        return Epoch(stamp_ns, time_s, verdict.state, self._initial, self._current,
                     fit.innovation.normalised, sensors.gyro_bias, sensors.accel_bias)

    def _set_verdict(self, verdict: Verdict) -> None:
        if verdict.state is not self._verdict.state:
            self._events.append(f'{verdict.state.value}: {verdict.reason}')
        self._verdict = verdict

    # Output

    def take_events(self) -> list[str]:
        """Return and forget the sentences worth a log line since the last call."""
        events, self._events = self._events, []
        return events

    def attitude_now(self) -> Attitude | None:
        """Return the current attitude carried on with the gyros to the newest IMU sample."""
        prediction = self.prediction()
        return None if prediction is None else Attitude(prediction.stamp_ns,
                                                        *prediction.matrices())

    def prediction(self) -> Prediction | None:
        """Return the attitude at the newest IMU sample to be carried on by whoever asks."""
        method, current = self._method, self._current
        if method is None or current is None or self._last_ns is None:
            return None
        self._imu.consolidate()
        if self._now is None:
            sensors = method.sensor_errors()
            bias_std = float(np.max(method.nuisance().gyro_bias_std))
            self._now = Prediction(
                self._last_ns, current.C_nb, current.covariance, sensors.gyro_bias,
                sensors.gyro_matrix,
                self.config.imu_noise.angle_random_walk, bias_std ** 2 + EARTH_RATE ** 2)
        stamps = self._imu.stamps
        first = int(np.searchsorted(stamps, self._now.stamp_ns, side='right'))
        looked_at = max(first - IMU_BEFORE, 0)
        samples, _ = without_spikes(stamps[looked_at:], self._imu.samples[looked_at:])
        self._now.carry_many(stamps[first:], samples[first - looked_at:, :3])
        return copy(self._now)

    def status(self) -> Status:
        """Return the state, the reason for it, the estimates and the counts."""
        if self._method is None:
            zero = np.zeros(3)
            nuisance = Nuisance(zero, zero, zero, zero, np.array(self.config.lever_arm), zero,
                                self.config.gnss_delay, 0.0)
        else:
            nuisance = self._method.nuisance()
        return Status(self._verdict.state, self._verdict.reason, self._last_ns,
                      None if self._method is None else self._method.t0_ns,
                      self._time_to_align_s, self._initial, self._current,
                      **vars(nuisance), counts=self._all_counts())

    def _all_counts(self) -> dict[str, int]:
        counts = dict(self.counts)
        if self._method is not None:
            fit = self._method.fit()
            counts['epochs_rejected_velocity'] = fit.rejected_velocity
            counts['epochs_rejected_position'] = fit.rejected_position
            counts['epochs_used'] = (fit.offered - fit.rejected_velocity - fit.rejected_position)
            counts['rebases'] = self._method.moved
        return counts
