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
The aligner: messages in, attitudes and states out, in eight steps (docs, "Design").

In step 1 the caller has turned messages into numbers. An epoch is processed when the IMU is
`gnss_lateness` ahead of it, so that results do not depend on when `update` is called.
"""

from collections import Counter, deque
import dataclasses

from ins_align.checks import InputChecks
from ins_align.config import Config, ConfigError
from ins_align.estimation.bank import Bank, Learnt, REJECTED
from ins_align.estimation.declaration import Declaration
from ins_align.estimation.formula import NoteMethod
from ins_align.geometry.rotation import Array, Transform
from ins_align.gnss.antenna import Antenna
from ins_align.gnss.buffer import GnssBuffer, GnssEpoch
from ins_align.gnss.messages import AntennaEpoch, Fix, Velocity
from ins_align.imu.buffer import ImuBuffer, NO_SAMPLE
from ins_align.imu.noise import ForceCheck
from ins_align.imu.prediction import Prediction
from ins_align.imu.preintegration import preintegrate
from ins_align.results import Attitude, Epoch, Event, Nuisance, Severity, State, Status, Verdict
import numpy as np

__all__ = ['Aligner', 'Attitude', 'Epoch', 'State', 'Status']

# Interval of epochs without measurement in a GNSS outage, which bounds the queues (ns).
DRY_INTERVAL_NS = 2_000_000_000
# An alignment starts with positions alone if no velocity came for this long after the first (ns);
# later the reason says so.
NO_VELOCITY_NS = 2_000_000_000
MAX_WARNINGS = 100      # different texts about messages that could not be used
MAX_EVENTS = 1000       # the latest, kept for `Aligner.take_events`
# Why messages were left out, by the ending of the name of their count.
_LEFT_OUT = {'no_fix': 'without a fix', 'undecodable': 'that cannot be decoded',
             'nan': 'without numbers or with impossible ones',
             'duplicate': 'with the stamp of another (does the driver set stamps?)',
             'late': 'further behind the IMU than gnss_lateness allows',
             'ahead': 'far ahead of the IMU'}
_RANK = {State.LEVELLED: 1, State.ALIGNED: 2}    # of what is declared; 0 in other states


class Aligner:
    """
    In-motion alignment from messages in the order of their arrival; by default with `Config()`.

    `base` transforms from the vehicle's base frame to the IMU frame; it is used with ``vehicle``
    and by default is the identity. The attribute `declared` is the initial attitude as it was
    declared, or None while none is declared.
    """

    def __init__(self, config: Config | None = None, base: Transform | None = None) -> None:
        self.config = Config() if config is None else config
        self._base = base
        # Messages and epochs, by outcome; the epochs of the present alignment are in its method.
        self._counts = Counter(dict.fromkeys((*REJECTED, 'epochs_used', 'rebases'), 0))
        self._events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self._warned: set[str] = set()
        self._done: list[Epoch] = []                # not yet returned by `update`
        self._started_over = ''                     # the reason; '' from the next epoch on
        self._method: Bank | NoteMethod | None = None
        self._forget_all()

    def _forget_all(self) -> None:
        """Drop the queues and all that was learnt; counts, events and finished epochs stay."""
        delay_ns = round(self.config.gnss_delay * 1e9)
        lateness_ns = round(self.config.gnss_lateness * 1e9) + max(delay_ns, 0)
        self._checks = InputChecks(self.config)
        self._imu = ImuBuffer(lateness_ns, self._counts, self.config.imu_noise,
                              self._checks.add_imu)
        self._gnss = GnssBuffer(lateness_ns, self._counts, delay_ns, self._checks.add_gnss)
        self._refusal = ''                          # why the last velocity could not be used
        self._first_t0_ns: int | None = None
        self._forget(None)

    def _forget(self, learnt: Learnt | None) -> None:
        """Drop the alignment and wait for a new t0; keep the queues and `learnt` for its start."""
        if self._method is not None:
            self._counts.update(self._method.counts)
        self._learnt = learnt
        self._method = None
        self._antenna = Antenna(self.config, self._counts)
        self._declaration = Declaration(self.config)
        self._force_check = ForceCheck()
        self._counts_before = Counter(self._counts)
        self._first_fix_ns: int | None = None
        self._before_ns = 0                         # stamp of the last GNSS message before t0
        self._queued: list[AntennaEpoch] = []       # epochs that wait for steps 4 to 8
        self._last_ns: int | None = None            # stamp of the last epoch; None before t0
        self._start_ns = self._measured_ns = 0      # first epoch; last one with a measurement
        self._velocity_ns: int | None = None        # stamp of the last epoch with a velocity
        since = 'since it started over' if self._started_over else 'yet'
        self._verdict = Verdict(State.WAITING_FOR_IMU, f'no IMU sample {since}')
        self._time_to_align_s: float | None = None
        self._epoch: Epoch | None = None            # the last one; None before t0
        self.declared: Attitude | None = None

    # Input: step 2

    def add_imu(self, stamp_ns: 'int | np.ndarray', gyro: Array, accel: Array) -> None:
        """
        Take an IMU sample, or N of them if stamps are an array, shape (N,).

        Angular rates, rad/s, and specific forces, m/s^2, have the shape (3,) or (N, 3).
        """
        if not isinstance(stamp_ns, np.ndarray):
            self._add_sample(stamp_ns, gyro, accel)
            return
        # Copies, because the samples are used later.
        stamps_ns = np.array(stamp_ns, np.int64)
        gyro, accel = np.array(gyro, float), np.array(accel, float)
        if not self._imu.add_in_order(stamps_ns, gyro, accel):
            for sample in zip(stamps_ns.tolist(), gyro, accel):
                self._add_sample(*sample)

    def _add_sample(self, stamp_ns: int, gyro: Array, accel: Array) -> None:
        if self._imu.add(stamp_ns, gyro, accel):
            return
        since = self._imu.held
        # Sensor errors that were learnt are dropped: if a recording is played again, they come
        # from the same data and are no independent prior.
        self._start_over('clock_jumps', 'the clock of the IMU jumped back')
        for held_ns, values in since:
            self._imu.add(held_ns, values[:3], values[3:])

    def add_fix(self, fix: Fix) -> None:
        """Take a GNSS position."""
        self._gnss.add(fix, self._imu.newest_ns)

    def add_velocity(self, velocity: Velocity) -> None:
        """Take a GNSS velocity."""
        self._refusal = ''
        if self.config.use_velocity is False:
            self._counts['velocity'] += 1
            return
        self._gnss.add(velocity, self._imu.newest_ns)

    def reject(self, reason: str, why: str = '') -> None:
        """Count a message that the caller could not use; `why`, in words, is an event once."""
        self._counts[reason] += 1
        if not why or (self.config.use_velocity is False and reason.startswith('velocity')):
            return
        self._refusal = why
        if why not in self._warned and len(self._warned) < MAX_WARNINGS:
            self._warned.add(why)
            self._events.append(Event(Severity.WARNING, why))

    def reset(self, reason: str = 'on request') -> None:
        """Start over from nothing, for a reason in words."""
        self._start_over('resets', reason)

    def _start_over(self, counter: str, why: str) -> None:
        self._process()     # whatever came before, so that results do not depend on `update`
        self._announce_restart(counter, why)
        self._forget_all()

    def _announce_restart(self, counter: str, why: str) -> None:
        self._counts[counter] += 1
        self._started_over = f'alignment starts over: {why}'
        self._events.append(Event(Severity.WARNING, self._started_over))

    def reconfigure(self, config: Config) -> None:
        """Change thresholds and hold time; a ConfigError says if another parameter differs."""
        for field in dataclasses.fields(Config):
            name = field.name
            if field.metadata['read_only'] and getattr(config, name) != getattr(self.config, name):
                raise ConfigError(f'{name} cannot change while running: set it at start')
        self.config = self._declaration.config = config

    # Processing: steps 3 to 8

    def update(self, dry: bool = False, last: bool = False) -> list[Epoch]:
        """
        Process the queued messages that no late one can precede; return the new epochs.

        With `dry`, epochs without measurement that divide an outage are returned as well. `last`
        says that no more messages come, so that all that are queued are processed.
        """
        self._process(last)
        done, self._done = self._done, []
        return [epoch for epoch in done if dry or not epoch.dry]

    def flush(self, dry: bool = False) -> list[Epoch]:
        """Process all queued messages, at the end of a recording; otherwise as `update`."""
        return self.update(dry, last=True)

    def _process(self, last: bool = False) -> None:
        """Process the queued messages that no late one can precede, or with `last` all."""
        upto_ns = self._imu.settled_ns(last)
        if upto_ns is None:
            if left_out := self._left_out('imu'):
                self._wait(State.WAITING_FOR_IMU, 'no IMU sample of use yet', left_out)
            return
        for message in self._gnss.release(upto_ns, last, self._imu.due_ns):
            self._bridge_outage(message.stamp_ns)
            self._queue(message)
        waiting_ns = self._gnss.oldest_ns
        self._bridge_outage(upto_ns if waiting_ns is None else min(upto_ns, waiting_ns))
        self._align()
        if self._last_ns is not None and self._imu.silent:
            self._counts['imu_gap'] += 1
            self._restart(NO_SAMPLE)
        if self._last_ns is None:
            self._imu.forget_before(upto_ns)
            if self._imu.silent:
                self._wait(State.WAITING_FOR_IMU, NO_SAMPLE)
            elif self._first_fix_ns is None:
                self._wait(State.WAITING_FOR_GNSS, 'no GNSS position yet', self._left_out('fix'))
            elif (self._verdict.state is State.WAITING_FOR_IMU
                  and upto_ns - self._before_ns > NO_VELOCITY_NS):
                self._wait(State.WAITING_FOR_GNSS,
                           f'no GNSS for {(upto_ns - self._before_ns) * 1e-9:.0f} s')

    def _queue(self, message: GnssEpoch) -> None:
        """Make an epoch of GNSS messages: t0, or one that waits for steps 4 to 8."""
        if self._last_ns is not None and message.stamp_ns <= self._last_ns:
            self._counts['gnss_out_of_order'] += 1
            return
        # 3. GNSS messages become an epoch of the antenna.
        epoch = self._antenna.epoch(message)
        if self._antenna.jumped:
            self._restart('the position jumped')
            epoch = self._antenna.epoch(message)
        if self._last_ns is None:
            self._before_ns = message.stamp_ns
            if epoch is not None:
                self._start(epoch)
            self._counts['epochs_before_start'] += self._last_ns is None
        elif epoch is not None:
            if silence := self._imu.silence(self._last_ns, epoch.stamp_ns):
                self._counts[silence.counter] += 1
                self._counts['epochs_before_start'] += not epoch.dry
                self._restart(silence.why)
            else:
                self._queued.append(epoch)
                self._last_ns = epoch.stamp_ns

    def _align(self) -> None:
        """Take the queued epochs through steps 4 to 8, many at a time."""
        epochs, self._queued = self._queued, []
        method = self._method
        if method is None or not epochs:
            return
        for part in self._imu.parts([epoch.stamp_ns for epoch in epochs]):
            # 4. The IMU samples before each epoch are preintegrated.
            imu = preintegrate(*self._imu.cut([epoch.stamp_ns for epoch in epochs[part]],
                                              [epoch.gravity_drift for epoch in epochs[part]]))
            # 5. The method propagates and updates; it yields an epoch when its estimates hold.
            taken = method.advance(epochs[part], imu)
            for epoch, force, seconds in zip(taken, imu.force.tolist(), imu.duration.tolist()):
                self._force_check.add(force, seconds)
                self._finish(epoch, method)

    def _finish(self, epoch: AntennaEpoch, method: Bank | NoteMethod) -> None:
        """Decide on the state after an epoch, and append the `Epoch` to the output."""
        # 6. The fit holds what the rival hypotheses object.
        fit = method.fit()
        if method.restarted:
            self._announce_restart('restarts', method.restarted)
            self.declared = self._time_to_align_s = None
            self._start_ns, method.restarted = epoch.stamp_ns, ''
        # 7. The declaration decides on the state and words the reason.
        attitudes = method.attitudes()
        if fit.measured:
            self._measured_ns = epoch.stamp_ns
        if epoch.v_n is not None:
            self._velocity_ns = epoch.stamp_ns
        verdict = self._declaration.update(
            (epoch.stamp_ns - self._start_ns) * 1e-9, (epoch.stamp_ns - self._measured_ns) * 1e-9,
            [attitude.covariance for attitude in attitudes or ()], fit)
        if self._declaration.move_t0:
            method.move_t0()
            attitudes = method.attitudes()
        initial, current = attitudes or (None, None)
        if fault := self._force_check.fault or epoch.fault:
            self._declaration.withdraw()
            verdict = Verdict(State.FAULT, fault)
        if why := self._no_velocity(epoch):
            verdict = Verdict(verdict.state,
                              f'{verdict.reason}; no GNSS velocity is used: {why}')
        if verdict.state is State.ALIGNED and self.declared is None:
            self.declared = initial
            self._time_to_align_s = (epoch.stamp_ns - self._start_ns) * 1e-9
        elif verdict.state is not State.ALIGNED and self.declared is not None:
            self.declared = self._time_to_align_s = None
            self._counts['withdrawals'] += 1
        self._set_verdict(verdict)
        # 8. The epoch is ready for `update` to return.
        body = method.nuisance()
        self._epoch = Epoch(
            epoch.stamp_ns, (epoch.stamp_ns - (self._first_t0_ns or 0)) * 1e-9, verdict.state,
            initial, current, fit.innovation, body.gyro_bias, body.accel_bias,
            body.gyro_bias_std, body.gyro_matrix, epoch.dry, verdict.reason, self._started_over)
        self._done.append(self._epoch)
        self._started_over = ''

    # Start, outages, loss

    def _start(self, epoch: AntennaEpoch) -> None:
        """Make an epoch t0 if possible; otherwise say what is missing."""
        if self._first_fix_ns is None:      # the antenna has no epoch before there is a fix
            self._first_fix_ns = epoch.stamp_ns
        if not any(epoch.measured):
            return
        config = self.config
        alone = epoch.v_n is None
        if alone and config.use_velocity is not False and (
                config.use_velocity is True or config.method == 'vif'
                or epoch.stamp_ns - self._first_fix_ns < NO_VELOCITY_NS):
            self._wait(State.WAITING_FOR_GNSS, 'no GNSS velocity yet', self._unused_velocities())
            return
        if alone and config.use_position is False:
            self._wait(State.WAITING_FOR_GNSS, 'no GNSS velocity yet, and use_position is false')
            return
        if self._imu.stamps[0] > epoch.stamp_ns:
            return
        if silence := self._imu.silence(epoch.stamp_ns, epoch.stamp_ns):
            self._wait(State.WAITING_FOR_IMU, silence.why)
            return
        self._last_ns = self._start_ns = epoch.stamp_ns
        if self._first_t0_ns is None:
            self._first_t0_ns = epoch.stamp_ns
        imu = preintegrate(*self._imu.start(epoch.stamp_ns))
        # A method starts with positions where the first epoch has no velocity.
        self._method = (Bank(config, epoch, imu, self._learnt, self._base)
                        if config.method == 'bank' else NoteMethod(config, epoch, imu))
        self._finish(epoch, self._method)

    def _bridge_outage(self, upto_ns: int) -> None:
        """Insert epochs without measurement, up to a stamp."""
        while self._last_ns is not None and upto_ns - self._last_ns > DRY_INTERVAL_NS:
            self._queue(GnssEpoch(self._last_ns + DRY_INTERVAL_NS))

    def _restart(self, why: str) -> None:
        """Restart the alignment, keeping what it has learnt of the sensors."""
        self._align()
        learnt = self._learnt
        if self._method is not None:
            self._announce_restart('restarts', why)
            learnt = self._method.learnt()
        self._forget(learnt)

    def _no_velocity(self, epoch: AntennaEpoch) -> str:
        """Return in words why no velocity is used while positions go on, or ''."""
        if not epoch.position_measured or self.config.use_velocity is False:
            return ''
        if self._velocity_ns is None:
            return self._unused_velocities() or 'none comes'
        silent_ns = epoch.stamp_ns - self._velocity_ns
        if silent_ns <= NO_VELOCITY_NS:
            return ''
        return self._unused_velocities() or f'none came for {silent_ns * 1e-9:.0f} s'

    def _unused_velocities(self) -> str:
        """Return in words why velocity messages could not be used, or ''."""
        return self._refusal or self._left_out('velocity')

    def _left_out(self, kind: str) -> str:
        """List in words the messages of a kind that were left out since the last start."""
        parts = []
        for ending, why in _LEFT_OUT.items():
            name = f'{kind}_{ending}'
            if count := self._counts[name] - self._counts_before[name]:
                off_ns = self._gnss.off_ns.get(name)
                off = '' if off_ns is None else f' (the last one by {off_ns * 1e-9:.1f} s)'
                parts.append(f'{count} {why}{off}')
        return ', '.join(parts)

    def _wait(self, state: State, what: str, why: str = '') -> None:
        self._set_verdict(Verdict(state, what + (why and f': {why}')))

    def _set_verdict(self, verdict: Verdict) -> None:
        """Set the verdict; a change of state is an event."""
        before, state = self._verdict.state, verdict.state
        if state is not before:
            severity = Severity.INFO
            if state is State.FAULT:
                severity = Severity.ERROR
            elif _RANK.get(state, 0) < _RANK.get(before, 0):
                severity = Severity.WARNING
            self._events.append(Event(severity, f'{state.value}: {verdict.reason}'))
        self._verdict = verdict

    # Output

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call, at most `MAX_EVENTS`."""
        events = list(self._events)
        self._events.clear()
        return events

    @property
    def newest_imu_ns(self) -> int | None:
        """Return the stamp of the newest valid IMU sample, None where there is none."""
        return int(self._imu.stamps[-1]) if self._imu.stamps.size else None

    def attitude_now(self) -> Attitude | None:
        """
        Return the current attitude, propagated with the gyros to the newest IMU sample.

        None before there is an attitude, and after a time in which the IMU measured too little.
        """
        prediction = self.prediction()
        return None if prediction is None else prediction.attitude()

    def prediction(self) -> Prediction | None:
        """Return a prediction that stands at the newest IMU sample; None as `attitude_now`."""
        epoch = self._epoch
        if epoch is None or epoch.current is None:
            return None
        stamps, rates, before, usual = self._imu.rates_since(epoch.stamp_ns)
        if stamps.size and self._imu.silence(epoch.stamp_ns, int(stamps[-1])):
            return None
        prediction = Prediction(epoch, self.config.imu_noise, before, usual)
        carried = all(prediction.propagate(*sample)
                      for sample in zip(stamps.tolist(), rates.tolist()))
        return prediction if carried else None

    @property
    def counts(self) -> Counter[str]:
        """Return how many messages and epochs had which outcome, by name."""
        counts = Counter(self._counts)
        if self._method is not None:
            counts.update(self._method.counts)
        return counts

    def status(self) -> Status:
        """
        Return the state, the reason for it, the estimates and the counts.

        While nothing is ALIGNED, it is a FAULT if units or coordinates are found to be wrong. This
        looks through the messages of minutes: call it about once a second, not at each epoch.
        """
        method, epoch = self._method, self._epoch
        nuisance = Nuisance.configured(self.config) if method is None else method.nuisance()
        verdict = self._verdict
        if verdict.state is not State.ALIGNED:
            verdict = self._checks.judge(verdict)
        return Status(**vars(nuisance), **vars(verdict), stamp_ns=self._last_ns,
                      t0_ns=None if method is None else method.t0_ns,
                      initial=None if epoch is None else epoch.initial,
                      current=None if epoch is None else epoch.current,
                      time_to_align_s=self._time_to_align_s, counts=dict(self.counts))
