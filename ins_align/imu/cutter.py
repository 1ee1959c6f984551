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
from typing import NamedTuple

from ins_align.config import ImuNoise
from ins_align.geometry.rotation import Array
from ins_align.imu.buffer import ImuBuffer, MAX_GAP_NS
from ins_align.imu.intervals import Intervals
from ins_align.imu.noise import (
    gap_and_jitter, GAP_ANGULAR_ACCELERATION, GAP_JERK, IMU_BEFORE, RangeCheck, stuck, white_noise,
    without_spikes)
from ins_align.imu.preintegration import Noise, preintegrate, split_at_epochs, Steps
from ins_align.imu.recent import AGES, Recent, recent_motion
import numpy as np

# Noise is measured over the interval and this long before it (ns); it counts when it is this
# many times the stated one.
NOISE_WINDOW_NS = 500_000_000
NOISE_EXCESS = 1.25
# Samples are kept for that, and for as long as a receiver may be late.
KEPT_NS = max(NOISE_WINDOW_NS, round(1e9 * AGES[-1]))
# How many IMU samples are cut at one go; those that an epoch looks back at count for a sixth.
MAX_CUT_SAMPLES, LOOKED_AT = 6144, 6
NO_SAMPLE = f'no IMU sample for more than {MAX_GAP_NS * 1e-9:g} s'


class Silence(NamedTuple):
    """A time in which the IMU says too little: stamps, the count's name, why in words."""

    start_ns: int
    end_ns: int
    counter: str
    why: str


class ImuSteps(NamedTuple):
    """IMU steps before each of K epochs, the white noise in them and the motion at their ends."""

    steps: Steps
    noise: Noise
    recent: Recent
    # Sum and number of the magnitudes of the specific force before each epoch, and seconds.
    forces: list[tuple[float, int, float]]

    def integrated(self) -> Intervals:
        """Return the intervals that they make."""
        return preintegrate(self.steps, self.noise, self.recent)


class ImuCutter:
    """
    Cuts what is buffered of the IMU at epochs, one run of them after the other.

    What is not needed any more is forgotten in the buffer; ``imu_spike``, ``imu_gap`` and
    ``imu_saturated`` are counted.
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
        # An epoch is taken when the IMU is ahead by the lateness: what is known by then counts.
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
        stamps = self._buffer.stamps
        place, first = np.searchsorted(stamps, [epochs_ns, np.subtract(epochs_ns, KEPT_NS)])
        size = place - place[0] + np.cumsum(place - first) // LOOKED_AT
        starts = np.flatnonzero(np.diff(size // MAX_CUT_SAMPLES, prepend=-1)).tolist()
        return [slice(*ends) for ends in zip(starts, [*starts[1:], len(epochs_ns)])]

    def start(self, stamp_ns: int) -> ImuSteps:
        """Return the steps of no length at the first epoch of an alignment."""
        self._upto_ns = stamp_ns
        return self.cut([stamp_ns], [0.0])

    def cut(self, epochs_ns: list[int], gravity_drift: list[float]) -> ImuSteps:
        """
        Return the steps up to each epoch since the one before.

        Parameters
        ----------
        epochs_ns : list of int
            Increasing.
        gravity_drift : list of float
            Noise of gravity for want of a place, m/s/sqrt(s), before each.

        """
        stamps = self._buffer.stamps
        ends_ns = np.array([self._upto_ns, *epochs_ns])
        ends = np.searchsorted(stamps, ends_ns, side='left') + 2
        first = np.searchsorted(stamps, ends_ns[:-1] - NOISE_WINDOW_NS)
        stamps = stamps[:ends[-1] + 1]
        samples, spikes = without_spikes(stamps, self._buffer.samples[:stamps.size])
        self._counts['imu_spike'] += int(np.count_nonzero(spikes[ends[0] - 2:ends[-1] - 2]))
        stamps, samples = stamps[:ends[-1]], samples[:ends[-1]]
        steps = split_at_epochs(stamps, samples, ends_ns)
        measured = white_noise(stamps, samples, first, ends[1:])
        excess = np.where(measured > NOISE_EXCESS * self._stated, np.sqrt(np.maximum(
            measured ** 2 - self._stated ** 2, 0.0)), 0.0)
        gap, jitter = gap_and_jitter(stamps, first, ends[1:], steps.dt)
        self._counts['imu_gap'] += int(np.count_nonzero(gap))
        beyond = self._range.beyond(stamps, ends_ns, steps.dt)
        noise = Noise(
            _together(self._stated[0], GAP_ANGULAR_ACCELERATION * gap,
                      jitter * _rms(steps.omega_dot), beyond[0]),
            _together(self._stated[1], GAP_JERK * gap, jitter * _rms(steps.f_dot), beyond[1],
                      np.array(gravity_drift)[:, None]),
            excess[:, :1], excess[:, 1:])
        magnitudes = np.sqrt(np.sum(np.square(samples[:, 3:]), axis=1))
        sums = np.diff(np.concatenate([[0.0], np.cumsum(magnitudes)])[ends - 2])
        seconds = np.diff(ends_ns) * 1e-9
        cut = ImuSteps(steps, noise, recent_motion(stamps, samples, ends_ns[1:]),
                       list(zip(sums.tolist(), np.diff(ends).tolist(), seconds.tolist())))
        self._upto_ns = self._buffer.used_ns = epochs_ns[-1]
        self.forget_before(self._upto_ns)
        return cut


def _together(*densities: 'Array | float') -> Array:
    """Return the density of noises that are independent of each other."""
    return np.asarray(np.sqrt(sum(map(np.square, densities))))


def _rms(slope: Array) -> Array:
    """Return the root mean square of the three axes at the end of each step, shape (K, n)."""
    return np.sqrt(np.mean(np.square(slope[:, 1:]), axis=2))
