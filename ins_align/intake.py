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
Messages → what an alignment works on: epochs of the antenna, and IMU intervals between them.

Messages are buffered, put in order and checked. What comes out does not depend on what is
estimated with it, so that a recording can be prepared in one process and aligned in another.
"""

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple, Union

from ins_align.config import Config
from ins_align.geometry.rotation import Array
from ins_align.gnss.antenna import Antenna, AntennaEpoch
from ins_align.gnss.buffer import GnssBuffer, GnssEpoch, PAIR_NS
from ins_align.gnss.messages import Fix, Velocity
from ins_align.imu.buffer import ImuBuffer, MAX_GAP_NS
from ins_align.imu.cutter import ImuCutter
from ins_align.imu.plausibility import stuck
from ins_align.imu.preintegration import Intervals
from ins_align.results import State, Verdict
import numpy as np

# Without GNSS an epoch without measurement is made this often, which bounds the buffer (ns).
DRY_INTERVAL_NS = 2_000_000_000
# Positions alone are taken when no velocity came for this long (ns).
NO_VELOCITY_NS = 2_000_000_000
# The IMU samples of a run of epochs that are handled at one go, and what an epoch costs beside.
MAX_RUN_SAMPLES, EPOCH_SAMPLES = 6144, 16
# IMU samples and GNSS messages that are left out, as they are counted, and why.
_IMU_LEFT_OUT = {'imu_undecodable': 'that cannot be decoded',
                 'imu_nan': 'without numbers or with impossible ones',
                 'imu_duplicate': 'with the stamp of another (does the driver set stamps?)',
                 'imu_late': 'too late'}
_GNSS_LEFT_OUT = {'no_fix': 'without a fix', 'undecodable': 'that cannot be decoded',
                  'nan': 'without numbers',
                  'late': 'further behind the IMU than gnss_lateness allows',
                  'ahead': 'far ahead of the IMU'}
_FIX_LEFT_OUT, _VELOCITY_LEFT_OUT = (
    {f'{kind}_{name}': why for name, why in _GNSS_LEFT_OUT.items()}
    for kind in ('fix', 'velocity'))
_NO_SAMPLE = f'no IMU sample for more than {MAX_GAP_NS * 1e-9:g} s'


class Located(NamedTuple):
    """An epoch, what was known of the GNSS then, and whether it is without GNSS."""

    epoch: AntennaEpoch
    fault: str                  # of the velocities
    gravity_drift: float        # noise of gravity for want of a place, m/s/sqrt(s)
    dry: bool


@dataclass(frozen=True)
class Start:
    """
    An epoch that becomes t0.

    Attributes
    ----------
    first : Located
    imu : Intervals
        Of no length, at the epoch.
    use_position : bool
        Whether positions are measurements to align with.
    without_velocity : str
        Why velocities that came are of no use.

    """

    first: Located
    imu: Intervals
    use_position: bool
    without_velocity: str = ''


@dataclass(frozen=True)
class Run:
    """
    K epochs that follow.

    Attributes
    ----------
    located : list of Located
    imu : Intervals
        Before each.
    forces : list of (float, int, float)
        Sum and number of the magnitudes of the specific force before each epoch, and seconds.

    """

    located: list[Located]
    imu: Intervals
    forces: list[tuple[float, int, float]]


@dataclass(frozen=True)
class Wait:
    """Nothing can start yet; why."""

    verdict: Verdict


@dataclass(frozen=True)
class Loss:
    """The attitude is lost, and why; sensors, lever arm and delay are what they were."""

    why: str


@dataclass(frozen=True)
class Afresh:
    """All that was learnt is void; `event` says so."""

    event: str


Step = Union[Start, Run, Wait, Loss, Afresh]


class _Silence(NamedTuple):
    """A time during which the IMU says nothing that could be used; stamps, what to count, why."""

    start_ns: int
    end_ns: int
    counter: str
    why: str


class Intake:
    """
    Takes messages as they come and gives the steps that an alignment is to go.

    Parameters
    ----------
    config : Config

    Attributes
    ----------
    counts : Counter
        Of messages, by what became of them.
    imu : ImuBuffer
        What is not used up yet.
    steps : list of Step
        What is prepared and not taken yet.

    """

    def __init__(self, config: Config) -> None:
        """Wait for the first messages."""
        self._config = config
        self.counts: Counter[str] = Counter()
        self._delay_ns = round(config.gnss_delay * 1e9)
        self._lateness_ns = round(config.gnss_lateness * 1e9) + max(self._delay_ns, 0)
        self.steps: list[Step] = []
        self._silences: list[_Silence] = []
        self._forget_all()

    def _forget_all(self) -> None:
        """Forget everything but the counts."""
        self.imu = ImuBuffer(self._lateness_ns, self.counts)
        self._cutter = ImuCutter(self._config.imu_noise, self.imu, self.counts)
        self._refusal = ''                          # why velocities cannot be used
        self._gnss = GnssBuffer(self._lateness_ns, self.counts,
                                0 if self._config.use_velocity is False else PAIR_NS)
        self._forget_epochs()

    def _forget_epochs(self) -> None:
        """Wait for another t0 among what is buffered."""
        self._antenna = Antenna(self._config, self.counts)
        self._last_ns: int | None = None            # the last epoch since t0; None before it
        self._waiting: Verdict | None = None        # why there is none yet, as it was said
        self._counts_before = Counter(self.counts)
        self._first_fix_ns: int | None = None
        self._run: list[Located] = []

    # Input

    def add_imu(self, stamp_ns: int, gyro: Array, accel: Array) -> None:
        """Take an IMU sample: its stamp, rad/s and m/s^2."""
        self.imu.add(stamp_ns, gyro, accel)
        if self.imu.jumped_to_ns is not None:
            self._clock_jumped()
            self.imu.add(stamp_ns, gyro, accel)

    def add_imu_array(self, stamps_ns: np.ndarray, gyro: Array, accel: Array) -> None:
        """Take many, shapes (N,), (N, 3), (N, 3)."""
        taken = self.imu.add_many(stamps_ns, gyro, accel)
        while taken < stamps_ns.size:
            self._clock_jumped()
            stamps_ns, gyro, accel = stamps_ns[taken:], gyro[taken:], accel[taken:]
            taken = self.imu.add_many(stamps_ns, gyro, accel)

    def _clock_jumped(self) -> None:
        self.prepare()                              # what could have been asked for before
        self.counts['clock_jumps'] += 1
        # A recording that is played again tells nothing new: what it told before is no prior.
        self._start_afresh('the clock of the IMU jumped back: alignment starts over')

    def add_fix(self, fix: Fix) -> None:
        """Take a GNSS position."""
        self._gnss.add_fix(fix._replace(stamp_ns=fix.stamp_ns - self._delay_ns),
                           self.imu.newest_ns)

    def add_velocity(self, velocity: Velocity) -> None:
        """Take a GNSS velocity."""
        self._refusal = ''
        self._gnss.add_velocity(velocity._replace(stamp_ns=velocity.stamp_ns - self._delay_ns),
                                self.imu.newest_ns)

    def reject(self, reason: str, why: str = '') -> None:
        """Count a message that could not be used, and keep why, in words."""
        self.counts[reason] += 1
        self._refusal = why or self._refusal

    def reset(self, reason: str) -> None:
        """Start over, for a reason in words."""
        self.counts['resets'] += 1
        self._start_afresh(f'alignment starts over: {reason}')

    def _start_afresh(self, event: str) -> None:
        self.steps.append(Afresh(event))
        self._forget_all()

    # Output

    def take_steps(self) -> list[Step]:
        """Return and forget the steps that are prepared."""
        steps, self.steps = self.steps, []
        return steps

    def prepare(self, last: bool = False) -> None:
        """
        Prepare the steps up to where nothing late can come any more.

        `last`: at the end of a recording nothing comes any more at all.
        """
        self.imu.consolidate(last)
        if self.imu.newest_ns is None or self.imu.stamps.size < 4:
            if left_out := self._left_out(_IMU_LEFT_OUT):
                self._wait(State.WAITING_FOR_IMU, f'no IMU sample of use yet: {left_out}')
            return
        stamps = self.imu.stamps
        # Interpolation at an epoch wants two samples after it, and whether they are spikes shows
        # in the next one.
        settled_ns = self.imu.newest_ns - (0 if last else self._lateness_ns)
        settled = int(np.searchsorted(stamps, settled_ns, side='right'))
        upto_ns = int(stamps[max(settled, 3) - 3])
        self._silences = self._find_silences(self._cutter.check_range(upto_ns))
        for message in self._gnss.release(upto_ns, last):
            self._dry_epochs(message.stamp_ns)
            self._line_up(message)
        waiting_ns = self._gnss.oldest_ns
        self._dry_epochs(upto_ns if waiting_ns is None else min(upto_ns, waiting_ns))
        self._cut_run()
        # Samples come, but none that could be used.
        silent = self.imu.newest_ns - self._lateness_ns - int(stamps[-1]) > MAX_GAP_NS
        if self._last_ns is not None and silent:
            self.counts['imu_gap'] += 1
            self._lose(_NO_SAMPLE)
        if self._last_ns is None:
            self._cutter.forget_before(upto_ns)
            if silent:
                self._wait(State.WAITING_FOR_IMU, _NO_SAMPLE)
            elif self._first_fix_ns is None:
                self._wait(State.WAITING_FOR_GNSS, self._no_position())

    def _wait(self, state: State, reason: str) -> None:
        verdict = Verdict(state, reason)
        if verdict != self._waiting:
            self.steps.append(Wait(verdict))
        self._waiting = verdict

    def _no_position(self) -> str:
        """Say that there is no position, and what has become of those that came."""
        left_out = self._left_out(_FIX_LEFT_OUT)
        return 'no GNSS position yet' + (left_out and f': {left_out}')

    def _left_out(self, reasons: dict[str, str]) -> str:
        """List what was left out for these reasons since it started to wait."""
        return ', '.join(f'{count} {why}{self._off(name)}' for name, why in reasons.items()
                         if (count := self.counts[name] - self._counts_before[name]))

    def _off(self, name: str) -> str:
        """Return how far a message was from the IMU, where that is why it was left out."""
        off_ns = self._gnss.off_ns.get(name)
        return '' if off_ns is None else f' (the last one by {off_ns * 1e-9:.1f} s)'

    def _dry_epochs(self, upto_ns: int) -> None:
        """Go on without GNSS up to a stamp in steps of bounded length."""
        while self._last_ns is not None and upto_ns - self._last_ns > DRY_INTERVAL_NS:
            self._line_up(GnssEpoch(self._last_ns + DRY_INTERVAL_NS), dry=True)

    def _line_up(self, message: GnssEpoch, dry: bool = False) -> None:
        """Put an epoch into the run of those that are cut at one go."""
        if self._last_ns is not None and message.stamp_ns <= self._last_ns:
            self.counts['gnss_out_of_order'] += 1
            return
        epoch = self._antenna.epoch(message)
        if self._antenna.jumped:
            self._lose('the position jumped')
            epoch = self._antenna.epoch(message)
        if self._last_ns is None:
            if epoch is not None:
                self._start(self._located(epoch))
            self.counts['epochs_before_start'] += self._last_ns is None
            return
        if epoch is None:
            return
        if silence := self._silence(self._last_ns, epoch.stamp_ns):
            self.counts[silence.counter] += 1
            self.counts['epochs_before_start'] += not dry
            self._lose(silence.why)
        else:
            self._run.append(self._located(epoch, dry))
            self._last_ns = epoch.stamp_ns

    def _located(self, epoch: AntennaEpoch, dry: bool = False) -> Located:
        return Located(epoch, self._antenna.fault, self._antenna.gravity_drift(epoch.stamp_ns),
                       dry)

    def _find_silences(self, blind: list[int]) -> list[_Silence]:
        """When the IMU says nothing, in what is buffered; `blind`: too much was missed (ns)."""
        stamps = self.imu.stamps
        last = np.flatnonzero(np.diff(stamps) > MAX_GAP_NS)
        silences = [_Silence(start, end, 'imu_gap', _NO_SAMPLE) for start, end in
                    zip(stamps[last].tolist(), stamps[last + 1].tolist())]
        # An epoch is taken when the IMU is ahead by the lateness: what is known by then, not what
        # is known when somebody looks.
        silences += [_Silence(max(start, known - self._lateness_ns), end, 'imu_stuck',
                              'the IMU sends the same values again and again')
                     for start, end, known in stuck(stamps, self.imu.samples)]
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

    def _cut_run(self) -> None:
        """Cut the IMU at a run of epochs, so many at a time that memory stays bounded."""
        run, self._run = self._run, []
        if not run:
            return
        place = np.searchsorted(self.imu.stamps, [located.epoch.stamp_ns for located in run])
        size = place - place[0] + EPOCH_SAMPLES * np.arange(len(run))
        cuts = np.flatnonzero(np.diff(size // MAX_RUN_SAMPLES)) + 1
        for part in np.split(np.arange(len(run)), cuts):
            located = run[part[0]:part[-1] + 1]
            imu, forces = self._cutter.cut([each.epoch.stamp_ns for each in located],
                                           [each.gravity_drift for each in located])
            self.steps.append(Run(located, imu.integrated(), forces))

    def _start(self, located: Located) -> None:
        """Make an epoch t0 if it can be one."""
        epoch = located.epoch
        if not epoch.position_measured:
            return
        if self._first_fix_ns is None:
            self._first_fix_ns = epoch.stamp_ns
        config = self._config
        wanted = config.use_velocity is not False
        alone = (not wanted or (config.use_velocity == 'auto' and config.method != 'vif'
                                and epoch.stamp_ns - self._first_fix_ns >= NO_VELOCITY_NS))
        no_velocity = self._refusal or self._left_out(_VELOCITY_LEFT_OUT)
        if epoch.v_n is None and not alone:
            self._wait(State.WAITING_FOR_GNSS,
                       'no GNSS velocity yet' + (no_velocity and f': {no_velocity}'))
            return
        use_position = config.use_position
        if use_position == 'auto':
            # Beside velocities positions gain little and hurt when their errors wander or their
            # stamps are a few milliseconds off.
            use_position = epoch.v_n is None
        if epoch.v_n is None and not use_position:
            self._wait(State.WAITING_FOR_GNSS, 'no GNSS velocity yet, and use_position is false')
            return
        if self.imu.stamps[0] > epoch.stamp_ns:
            return
        if silence := self._silence(epoch.stamp_ns, epoch.stamp_ns):
            self._wait(State.WAITING_FOR_IMU, silence.why)
            return
        self._last_ns = epoch.stamp_ns
        imu = self._cutter.start(epoch.stamp_ns).integrated()
        self.steps.append(Start(located, imu, bool(use_position),
                                no_velocity if wanted and epoch.v_n is None else ''))

    def _lose(self, why: str) -> None:
        """Let the alignment start over; biases are kept."""
        self._cut_run()
        self.steps.append(Loss(why))
        self._forget_epochs()
