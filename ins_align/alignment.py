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
An alignment: prepared steps in, attitudes and states out.

A method estimates, a declaration judges; this lets the one go from epoch to epoch and hears the
other, and tells what has become of it.
"""

from collections import Counter

from ins_align.config import Config
from ins_align.estimation.bank import Bank, Learnt
from ins_align.estimation.declaration import Declaration
from ins_align.estimation.formula import NoteMethod
from ins_align.imu.plausibility import ForceCheck
from ins_align.imu.preintegration import SensorErrors
from ins_align.intake import Afresh, Located, Loss, Run, Start, Step, Wait
from ins_align.results import Attitude, Epoch, Event, Nuisance, Severity, State, Status, Verdict
import numpy as np

_DECLARED = {State.LEVELLED: 1, State.ALIGNED: 2}
_NOTHING_YET = Verdict(State.WAITING_FOR_IMU, 'no IMU sample yet')


class Alignment:
    """
    Goes the steps that an intake has prepared.

    Parameters
    ----------
    config : Config

    Attributes
    ----------
    counts : Counter
        ``restarts``, ``withdrawals``.
    declared : Attitude or None
        The initial attitude as it was declared.
    current : Attitude or None
        At the last epoch.

    """

    def __init__(self, config: Config) -> None:
        """Wait for the first step."""
        self.config = config
        self.counts: Counter[str] = Counter()
        self._events: list[Event] = []
        self._epochs: Counter[str] = Counter()      # of alignments that are over
        self._method: Bank | NoteMethod | None = None
        self._first_t0_ns: int | None = None
        self._forget(None)

    def _forget(self, learnt: Learnt | None) -> None:
        """Forget everything but the counts and what was learnt of sensors, lever arm and delay."""
        if self._method is not None:
            self._epochs.update(_epoch_counts(self._method))
        self._learnt = learnt
        self._method = None
        self._declaration = Declaration(self.config)
        self._force_check = ForceCheck()
        self._verdict = _NOTHING_YET
        self._start_ns = 0                          # the first t0 since it started over
        self._measured_ns = 0                       # the last epoch with a measurement
        self._without_velocity = ''                 # why none that came was of use
        self._initial: Attitude | None = None
        self._stamp_ns: int | None = None
        self._time_to_align_s: float | None = None
        self.declared: Attitude | None = None
        self.current: Attitude | None = None

    def reconfigure(self, config: Config) -> None:
        """Take other thresholds and another hold time."""
        self.config = self._declaration.config = config

    def go(self, step: Step) -> list[Epoch]:
        """Go a step; return the epochs that were in it."""
        if isinstance(step, Run):
            return self._advance(step)
        if isinstance(step, Start):
            return [self._start(step)]
        if isinstance(step, Wait):
            self._set_verdict(step.verdict)
        elif isinstance(step, Loss):
            self._lose(step.why)
        elif isinstance(step, Afresh):
            self._events.append(Event(Severity.WARNING, step.event))
            self._first_t0_ns = None
            self._forget(None)
        return []

    def _start(self, step: Start) -> Epoch:
        epoch = step.first.epoch
        self._start_ns = epoch.stamp_ns
        self._without_velocity = step.without_velocity
        if self._first_t0_ns is None:
            self._first_t0_ns = epoch.stamp_ns
        if self.config.method == 'bank':
            self._method = Bank(self.config, epoch, step.imu, step.use_position, self._learnt)
        else:
            self._method = NoteMethod(self.config, epoch, step.imu, epoch.v_n is None)
        return self._judge(self._method, step.first)

    def _advance(self, run: Run) -> list[Epoch]:
        method = self._method
        assert method is not None
        done = []
        taken = method.advance([located.epoch for located in run.located], run.imu)
        for _, located, forces in zip(taken, run.located, run.forces):
            self._force_check.add(*forces)
            done.append(self._judge(method, located))
        return done

    def _lose(self, why: str) -> None:
        """Start over; what was learnt of the sensors is kept."""
        learnt = self._learnt
        if self._method is not None and self._stamp_ns is not None:
            self.counts['restarts'] += 1
            self._events.append(Event(Severity.WARNING, f'alignment starts over: {why}'))
            learnt = self._method.learnt()
        self._forget(learnt)

    def _judge(self, method: Bank | NoteMethod, located: Located) -> Epoch:
        """Results and state after an epoch."""
        assert self._first_t0_ns is not None
        epoch = located.epoch
        self._stamp_ns = stamp_ns = epoch.stamp_ns
        time_s = (stamp_ns - self._start_ns) * 1e-9
        fit = method.fit()
        initial, current = method.initial(), method.current()
        measured = epoch.v_n is not None or epoch.position_measured
        if measured:
            self._measured_ns = stamp_ns
        silent_s = (stamp_ns - self._measured_ns) * 1e-9
        if initial is None or current is None:
            self._initial = self.current = None
            verdict = self._declaration.update_without_attitude(silent_s, fit)
        else:
            if measured:
                verdict = self._declaration.update(time_s, initial[1], current[1], fit,
                                                   method.unconfirmed)
                if self._declaration.move_t0:
                    method.move_t0()
                    initial = method.initial() or initial
            else:
                verdict = self._declaration.update_without_gnss(silent_s, initial[1], current[1],
                                                                fit)
            self._initial = Attitude(method.t0_ns, *initial)
            self.current = Attitude(stamp_ns, *current)
        fault = self._force_check.fault or located.fault
        if fault:
            self._declaration.withdraw()
            verdict = Verdict(State.FAULT, fault)
        if epoch.v_n is not None:
            self._without_velocity = ''
        if self._without_velocity:
            verdict = Verdict(verdict.state, f'{verdict.reason}; no GNSS velocity is used: '
                                             f'{self._without_velocity}')
        if verdict.state is State.ALIGNED and self.declared is None:
            self.declared = self._initial
            self._time_to_align_s = time_s
        elif verdict.state is not State.ALIGNED and self.declared is not None:
            self.declared = self._time_to_align_s = None
            self.counts['withdrawals'] += 1
        self._set_verdict(verdict)
        sensors = method.sensor_errors()
        return Epoch(stamp_ns, (stamp_ns - self._first_t0_ns) * 1e-9, verdict.state,
                     self._initial, self.current, fit.innovation,
                     sensors.gyro_bias, sensors.accel_bias, located.dry)

    def _set_verdict(self, verdict: Verdict) -> None:
        before, state = self._verdict.state, verdict.state
        if state is not before:
            severity = Severity.INFO
            if state is State.FAULT:
                severity = Severity.ERROR
            elif _DECLARED.get(state, 0) < _DECLARED.get(before, 0):
                severity = Severity.WARNING
            self._events.append(Event(severity, f'{state.value}: {verdict.reason}'))
        self._verdict = verdict

    # Output

    def take_events(self) -> list[Event]:
        """Return and forget the events since the last call."""
        events, self._events = self._events, []
        return events

    def sensor_errors(self) -> SensorErrors:
        """Return the errors of gyros and accelerometers at the last epoch; none before one."""
        return SensorErrors.none() if self._method is None else self._method.sensor_errors()

    def nuisance(self) -> Nuisance:
        """Return biases, lever arm and delay; what is told of them before the first epoch."""
        if self._method is not None:
            return self._method.nuisance()
        config, zero = self.config, np.zeros(3)
        gyro_std, accel_std, lever_std = (np.full(3, std) for std in (
            config.imu_noise.gyro_bias_std, config.imu_noise.accel_bias_std,
            config.lever_arm_std))
        return Nuisance(zero, gyro_std, zero, accel_std, np.array(config.lever_arm), lever_std,
                        config.gnss_delay, config.gnss_delay_std)

    def status(self, of_messages: Counter[str]) -> Status:
        """Return the state, the reason for it, the estimates and all counts."""
        counts = Counter(of_messages)
        for more in (self.counts, self._epochs, _epoch_counts(self._method)):
            counts.update(more)
        return Status(self._verdict.state, self._verdict.reason, self._stamp_ns,
                      None if self._method is None else self._method.t0_ns,
                      self._time_to_align_s, self._initial, self.current,
                      **vars(self.nuisance()), counts=dict(counts))


def _epoch_counts(method: Bank | NoteMethod | None) -> Counter[str]:
    """Return what became of the epochs of an alignment."""
    if method is None:
        return Counter(epochs_used=0, epochs_rejected_velocity=0, epochs_rejected_position=0,
                       rebases=0)
    fit = method.fit()
    return Counter(epochs_used=fit.offered - fit.rejected,
                   epochs_rejected_velocity=fit.rejected_velocity,
                   epochs_rejected_position=fit.rejected_position, rebases=method.moved)
