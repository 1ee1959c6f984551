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
IMU samples that have arrived → steps between GNSS epochs, with the white noise that they have.

Noise is what is stated, what is measured, and what makes the samples miss the motion: gaps, stamps
that jitter, the end of the sensors' range, forces that shift the gyros' biases, gravity at a place
that is not known.
"""

from collections import Counter
from dataclasses import dataclass
import math
from typing import NamedTuple

from ins_align.config import ImuNoise
from ins_align.geometry.rotation import Array, Index
from ins_align.imu.buffer import ImuBuffer, MAX_GAP_NS
from ins_align.imu.intervals import Intervals, SensorErrors
from ins_align.imu.plausibility import IMU_BEFORE, RangeCheck, stuck, without_spikes
from ins_align.imu.preintegration import Noise, preintegrate, split_at_epochs, Steps, white_noise
from ins_align.imu.recent import AGES, Recent, recent_motion
import numpy as np

# A step this many times the usual one holds lost samples; what the motion can do meanwhile
# (angular acceleration, rad/s^2, and jerk, m/s^3) is added to its noise.
GAP_STEPS = 2.5
# Samples come in bunches, stamped on arrival, where the usual step is so much shorter than the
# longest but for one in twenty: then those are the usual pauses.
BUNCHED, PAUSES = 0.2, 0.95
GAP_ANGULAR_ACCELERATION, GAP_JERK = 2.0, 20.0
# Standard deviation of stamps over the median of what the steps between them deviate.
JITTER_OF_MEDIAN = 1.4826 / math.sqrt(2)
# Noise is measured over the interval and this long before it (ns); it counts when it is this
# many times the stated one.
NOISE_WINDOW_NS = 500_000_000
# Samples are kept for that, and for as long as a receiver may be late.
KEPT_NS = max(NOISE_WINDOW_NS, round(1e9 * AGES[-1]))
NOISE_EXCESS = 1.25
# The IMU samples of epochs that are cut at one go, and what an epoch costs beside.
MAX_CUT_SAMPLES, EPOCH_SAMPLES = 6144, 16
NO_SAMPLE = f'no IMU sample for more than {MAX_GAP_NS * 1e-9:g} s'


class Silence(NamedTuple):
    """A time in which the IMU says too little: stamps, the count's name, why in words."""

    start_ns: int
    end_ns: int
    counter: str
    why: str


@dataclass(frozen=True)
class ImuSteps:
    """IMU steps before each of K epochs, the white noise in them and the motion at their ends."""

    steps: Steps
    noise: Noise
    recent: Recent

    def integrated(self) -> Intervals:
        """Return the intervals that they make, integrated as if the sensors had no errors."""
        return preintegrate(self.steps, SensorErrors.none(), self.noise, self.recent)


class ImuCutter:
    """
    Cuts what is buffered of the IMU at epochs, one run of them after the other.

    Parameters
    ----------
    stated : ImuNoise
    buffer : ImuBuffer
        What is not needed any more is forgotten there.
    counts : Counter
        Where ``imu_spike``, ``imu_gap`` and ``imu_saturated`` are counted.

    """

    def __init__(self, stated: ImuNoise, buffer: ImuBuffer, counts: Counter[str]) -> None:
        """Wait for `start`."""
        self._stated = np.array(stated[:2])
        self._buffer = buffer
        self._counts = counts
        self._range = RangeCheck()
        self._upto_ns = 0                   # up to where the IMU is cut
        self._checked_ns = 0                # and its range checked
        self._silences: list[Silence] = []

    def forget_before(self, stamp_ns: int) -> None:
        """Keep what an epoch at or after a stamp wants to look back at."""
        self._buffer.forget_before(stamp_ns - KEPT_NS)
        self._range.forget_before(stamp_ns)

    def check(self, upto_ns: int) -> None:
        """
        Look for times in which the IMU says too little, in what is buffered.

        Samples up to a stamp that are at the end of the sensors' range are counted.
        """
        stamps = self._buffer.stamps
        first, last = np.searchsorted(stamps, [self._checked_ns, upto_ns], side='right').tolist()
        context = max(first - IMU_BEFORE, 0)
        around = slice(context, last + 1)
        samples, _ = without_spikes(stamps[around], self._buffer.samples[around])
        before = self._range.stamps.size
        self._range.add(stamps[first:last], samples[first - context:last - context])
        self._counts['imu_saturated'] += self._range.stamps.size - before
        self._checked_ns = max(self._checked_ns, upto_ns)
        gaps = np.flatnonzero(np.diff(stamps) > MAX_GAP_NS)
        self._silences = [Silence(start, end, 'imu_gap', NO_SAMPLE) for start, end in
                          zip(stamps[gaps].tolist(), stamps[gaps + 1].tolist())]
        # An epoch is taken when the IMU is ahead by the lateness: what is known by then, not what
        # is known when somebody looks.
        self._silences += [Silence(max(start, known - self._buffer.lateness_ns), end, 'imu_stuck',
                                   'the IMU sends the same values again and again')
                           for start, end, known in stuck(stamps, self._buffer.samples)]
        self._silences += [Silence(stamp - 1, stamp, 'imu_blind', 'the gyros are at the end of '
                                   'their range: let the driver set a larger one')
                           for stamp in self._range.blind]

    def silence(self, start_ns: int, end_ns: int) -> Silence | None:
        """Return why the IMU says too little between two stamps, or at one."""
        return next((silence for silence in self._silences
                     if silence.start_ns < end_ns and silence.end_ns > start_ns), None)

    def parts(self, epochs_ns: list[int]) -> list[slice]:
        """Divide epochs into parts to be cut one after the other, so that memory is bounded."""
        place = np.searchsorted(self._buffer.stamps, epochs_ns)
        size = place - place[0] + EPOCH_SAMPLES * np.arange(len(epochs_ns))
        starts = np.flatnonzero(np.diff(size // MAX_CUT_SAMPLES, prepend=-1)).tolist()
        return [slice(*ends) for ends in zip(starts, [*starts[1:], len(epochs_ns)])]

    def start(self, stamp_ns: int) -> ImuSteps:
        """Return the steps of no length at the first epoch of an alignment."""
        self._upto_ns = stamp_ns
        return self.cut([stamp_ns], [0.0])[0]

    def cut(self, epochs_ns: list[int],
            gravity_drift: list[float]) -> tuple[ImuSteps, list[tuple[float, int, float]]]:
        """
        Return the steps up to each epoch since the one before.

        Parameters
        ----------
        epochs_ns : list of int
            Increasing.
        gravity_drift : list of float
            Noise of gravity for want of a place, m/s/sqrt(s), before each.

        Returns
        -------
        ImuSteps
        list of (float, int, float)
            Sum and number of the magnitudes of the specific force before each epoch, and seconds.

        """
        stamps = self._buffer.stamps
        ends_ns = np.array([self._upto_ns, *epochs_ns])
        ends = np.searchsorted(stamps, ends_ns, side='left') + 2
        first = np.searchsorted(stamps, ends_ns[:-1] - NOISE_WINDOW_NS)
        stamps = stamps[:ends[-1] + 1]
        samples, spikes = without_spikes(stamps, self._buffer.samples[:stamps.size])
        self._counts['imu_spike'] += int(np.count_nonzero(spikes[ends[0] - 2:ends[-1] - 2]))
        stamps, samples = stamps[:ends[-1]], samples[:ends[-1]]
        gyro, accel = samples[:, :3], samples[:, 3:]
        steps = split_at_epochs(stamps, gyro, accel, ends_ns, unit=1e-9)
        recent = recent_motion(stamps, gyro, accel, ends_ns[1:], unit=1e-9)
        excess = self._excess(stamps, samples, first, ends[1:])
        gap, jitter = self._of_stamps(stamps, first, ends[1:], steps.dt)
        beyond = self._beyond_range(stamps, ends_ns, steps.dt)
        seconds = np.diff(ends_ns) * 1e-9
        noise = Noise(
            _together(self._stated[0], GAP_ANGULAR_ACCELERATION * gap,
                      jitter * _rms(steps.omega_dot), beyond[0]),
            _together(self._stated[1], GAP_JERK * gap, jitter * _rms(steps.f_dot), beyond[1],
                      np.array(gravity_drift)[:, None]),
            excess[:, :1], excess[:, 1:])
        magnitudes = np.sqrt(np.sum(np.square(accel), axis=1))
        sums = np.diff(np.concatenate([[0.0], np.cumsum(magnitudes)])[ends - 2])
        forces = list(zip(sums.tolist(), np.diff(ends).tolist(), seconds.tolist()))
        self._upto_ns = self._buffer.used_ns = epochs_ns[-1]
        self.forget_before(self._upto_ns)
        return ImuSteps(steps, noise, recent), forces

    def _excess(self, stamps: Index, samples: Array, first: Index, last: Index) -> Array:
        """Densities measured beyond the stated ones in K windows, shape (K, 2)."""
        measured = white_noise(stamps, samples, first, last, unit=1e-9)
        beyond = np.sqrt(np.maximum(measured ** 2 - self._stated ** 2, 0.0))
        return np.where(measured > NOISE_EXCESS * self._stated, beyond, 0.0)

    def _of_stamps(self, stamps: Index, first: Index, last: Index,
                   dt: Array) -> tuple[Array, Array]:
        """
        Return what becomes of steps, shape (K, n), with lost samples and with jittering stamps.

        The first is to be multiplied with what the motion can do in a gap, the second with what
        it does to a sample whose stamp jitters: its change per second. Densities then.
        """
        between = np.diff(stamps) * 1e-9
        usual, jitter = _usual_steps(between, first, last - 1)
        gap = np.where(dt > GAP_STEPS * usual, dt, 0.0)
        self._counts['imu_gap'] += int(np.count_nonzero(gap))
        # An error of acceleration * dt^2 over the step, as a density: squared, over dt.
        return gap ** 1.5, JITTER_OF_MEDIAN * jitter * np.sqrt(dt)

    def _beyond_range(self, stamps: Index, ends_ns: Index, dt: Array) -> Array:
        """Return densities for what gyros and accelerometers missed, shape (2, K, n)."""
        beyond = np.zeros((2,) + dt.shape)
        inside = slice(*np.searchsorted(self._range.stamps, ends_ns[[0, -1]]))
        saturated = self._range.stamps[inside]
        if saturated.size:
            interval = np.searchsorted(ends_ns, saturated, side='right') - 1
            # An interval's first step begins at its start, at a sample or between two.
            first = np.searchsorted(stamps, ends_ns[:-1], side='right') - 1
            step = np.searchsorted(stamps, saturated) - first[interval]
            beyond[:, interval, step] = self._range.densities[inside].T
        return beyond


def _together(*densities: 'Array | float') -> Array:
    """Density of noises that are independent of each other."""
    return np.asarray(np.sqrt(sum(map(np.square, densities))))


def _rms(slope: Array) -> Array:
    """Of the three axes at the end of each step, shape (K, n)."""
    return np.sqrt(np.mean(np.square(slope[:, 1:]), axis=2))


def _usual_steps(steps: Array, first: Index, last: Index) -> tuple[Array, Array]:
    """
    Return the usual step, of bunches their pause, and the median of what steps deviate.

    Both in K windows of the steps, shape (K, 1); `first`, `last`: as in `white_noise`.
    """
    count = (last - first)[:, None]
    place = np.arange(np.max(count))
    windows = np.where(place < count, steps[first[:, None] + np.minimum(place, count - 1)], np.inf)

    def ranked(values: Array, rank: Index) -> Array:
        return np.take_along_axis(np.sort(values, axis=1), rank, axis=1)

    half = count // 2
    usual, pause = ranked(windows, np.hstack([half, (PAUSES * count).astype(int)])).T[..., None]
    bunched = usual < BUNCHED * pause
    # Those of bunches as much as evenly spread over it.
    return (np.where(bunched, pause, usual),
            np.where(bunched, 0.3 * pause, ranked(np.abs(windows - usual), half)))
