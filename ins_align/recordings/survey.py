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
"""Surveys what an alignment could read: the topics with their timing, the samples of an IMU."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any, NamedTuple

from ins_align.checks import ANY_GYRO_RATE, degrees_fault
from ins_align.config import CHIP_THRESHOLDS, Config, ImuNoise, PRESETS
from ins_align.geometry.earth import EARTH_RATE
from ins_align.geometry.rotation import Array
from ins_align.gnss.drivers import type_in_words
from ins_align.gnss.messages import numbers_of, usable
from ins_align.gnss.motion import GRID, Series, series_of
from ins_align.imu.buffer import MAX_ACCELERATION, MAX_RATE, SAME_VALUES
from ins_align.imu.noise import force_fault, white_noise
from ins_align.recordings import Topic
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import decode, Gnss, ImuSamples, KINDS, Refused
from ins_align.recordings.reader import candidates, doubt
import numpy as np

MAX_ASTRAY = 60.0  # s that the age of a usable stamp may differ from the median age
MAX_USELESS = 0.01  # share of messages without usable numbers that is not worth a line
GAP_INTERVALS = 3.5  # usual intervals without a message that make a gap
# Of the samples of an IMU:
WINDOW = 2.0  # s, the length of a window in which noise is measured
QUIET_QUANTILE = 0.1  # of the windows' noise, taken in motion, where motion adds least
AVERAGING = 0.1  # s: noise of filtered sensors is white only over several samples
NOISE_MARGIN = 1.5  # times a preset's noise that the preset still covers
BIAS_SIGMAS = 2.5  # times a preset's sigma of a bias that the preset still covers
REST_SPEED = 0.3  # m/s by GNSS, below which a vehicle may be at rest
REST_RATE, REST_FORCE = math.radians(1.0), 0.3  # rad/s, m/s^2: scatter of GRID means at rest
MIN_REST = 5.0  # s
# The mean of |f| over a time is at least gravity less the change of velocity over that time: s,
# m/s^2.
WEAK_TIME, WEAK_FORCE = 60.0, 0.5
MAX_FORCE_ERROR = 3.0  # m/s^2: no accelerometer at rest is so far off gravity
ON_LATTICE = 0.1  # quanta that a step between values may be off a multiple of the quantum
MIN_REPEATS = 3  # samples per value: with fewer, the quantum may be that of digits in a text
MIN_ZEROS, MIN_ZERO_SHARE = 20, 0.01  # least number and share of exact zeros with a dead band


def rounded(value: float) -> float:
    """Round a value to two significant digits, for a parameter."""
    return float(f'{value:.2g}')


def set_arguments(settings: Mapping[str, Any]) -> list[str]:
    """Return the arguments of ``--set`` for some parameters."""
    return [f'{name}={str(value).lower()}' for name, value in settings.items()]


@dataclass(kw_only=True)
class Surveyed:
    """Findings about a recording or a topic."""

    lines: list[str] = field(default_factory=list)  # sentences that ``ins_align info`` prints
    # Numbers by name, in SI units unless the name ends with another unit.
    figures: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)  # parameters that an alignment needs
    faults: list[str] = field(default_factory=list)  # sentences on why it cannot be used

    def add(self, text: str, settings: Mapping[str, Any] | None = None, *, fault: bool = False,
            **figures: Any) -> None:
        """Add a finding: a sentence ('' adds none), the parameters that it sets, and figures."""
        if fault:
            self.faults.append(text)
        elif text:
            sets = ', '.join(set_arguments(settings or {}))
            self.lines.append(text + (sets and f' (sets {sets})'))
        self.settings |= settings or {}
        self.figures |= figures


class Columns(NamedTuple):
    """The contents of N messages of a topic."""

    recorded_ns: np.ndarray  # (N,) int64
    stamps_ns: np.ndarray  # (N,) int64
    # Imu: (N, 6), angular rate, rad/s, and specific force, m/s^2. Fix: (N, 3), latitude and
    # longitude, degrees, and altitude, m. Velocity: (N, 3), read as ENU, m/s.
    values: Array
    usable: np.ndarray  # (N,) bool: finite, within bounds, and with a fix
    no_fix: np.ndarray  # (N,) bool
    sigmas: Array  # (N, 2), m or m/s, horizontal and vertical; nan if no covariance is stated
    vertical: np.ndarray  # (N,) bool: whether altitude or vertical velocity is not nan


NOTHING = Columns(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)),
                  np.zeros(0, bool), np.zeros(0, bool), np.zeros((0, 2)), np.zeros(0, bool))


def columns_of(times_ns: np.ndarray, decoded: ImuSamples | Sequence[Gnss]) -> Columns:
    """Return the columns of messages recorded at some times, without undecodable ones."""
    if isinstance(decoded, ImuSamples):
        values = np.hstack([decoded.gyro, decoded.accel])
        good = (np.abs(values) < np.repeat([MAX_RATE, MAX_ACCELERATION], 3)).all(axis=1)
        return Columns(times_ns[decoded.decoded], decoded.stamps_ns, values, good,
                       np.zeros_like(good), np.full((good.size, 2), np.nan), good)
    rows = []
    for time_ns, message in zip(times_ns.tolist(), decoded):
        if not isinstance(message, Refused):
            found, fault = usable(message)
            values = numbers_of(found)
            covariance = message.covariance
            east, north, up = (math.nan,) * 3 if covariance is None else covariance.diagonal()
            rows.append((time_ns, message.stamp_ns, values, not fault, fault == 'no_fix',
                         (math.sqrt((east + north) / 2.0), math.sqrt(up)), found.vertical))
    return Columns(*map(np.array, zip(*rows))) if rows else NOTHING


@dataclass(init=False)
class Recorded(Surveyed):
    """Survey of a topic that an alignment could read, with its messages in recorded order."""

    name: str
    msgtype: str
    kind: str  # imu, fix or velocity

    def __init__(self, bag: Bag, topic: Topic, kind: str, messages: int,
                 parts: Sequence[Columns]) -> None:
        """Survey a topic by the number of its messages and their decoded parts."""
        super().__init__()
        self.name, self.msgtype, self.kind = topic.name, type_in_words(topic.msgtype), kind
        # Why the messages may not be what their type promises; '' if there is no doubt.
        self.doubt = doubt(bag, topic)
        data = Columns(*map(np.concatenate, zip(*parts))) if parts else NOTHING
        self.recorded_ns, self.stamps_ns, self.values = data[:3]
        self.usable = data.usable  # without stamps that are astray, see below
        self._start_ns, self._age_ns = bag.start_ns, 0
        count = self.stamps_ns.size
        self.add('', messages=messages)
        if not count:
            self.add(self.doubt or 'its messages cannot be decoded', fault=True)
            return
        ages_ns = self.recorded_ns - self.stamps_ns
        # The upper median is one of the ages, never the mean of the ages by two clocks.
        self._age_ns = int(np.sort(ages_ns)[count // 2])
        astray = np.abs(ages_ns - self._age_ns) > MAX_ASTRAY * 1e9
        self.usable = data.usable & ~astray
        stamps_ns = self.stamps_ns[~astray]
        self._add_timing(np.unique(stamps_ns), ages_ns[~astray] * 1e-9)
        for name, number, text in (
                ('undecodable', messages - count, 'messages cannot be decoded'),
                ('astray', int(np.count_nonzero(astray)),
                 f'stamps are more than {MAX_ASTRAY:g} s off the others'),
                ('out_of_order', int(np.count_nonzero(np.diff(stamps_ns) <= 0)),
                 'stamps are not later than the one before')):
            self.add(f'{number} {text}' if number else '', **{name: number})
        useless = float(np.mean(~(data.usable | data.no_fix)))
        self.add(f'without numbers, or with impossible ones: {useless:.0%} of the messages'
                 if useless > MAX_USELESS else '', usable_share=float(np.mean(self.usable)))
        if kind == 'fix':
            share = float(np.mean(data.no_fix))
            self.add(f'without a fix: {share:.1%}', no_fix_share=share)
        if kind != 'imu':
            self.add('', vertical_share=float(np.mean(data.vertical)))
            self._add_sigmas(data.sigmas)

    def _add_sigmas(self, sigmas: Array) -> None:
        """Add the median of the stated sigmas, and in how many messages there are any."""
        stated = sigmas[np.isfinite(sigmas[:, 0])]
        share = len(stated) / len(sigmas)
        if not share:
            self.add('states no covariance', covariance_share=share)
            return
        sigma = np.median(stated, axis=0).tolist()
        horizontal, vertical = (f'{std:.2g} {"m" if self.kind == "fix" else "m/s"}'
                                for std in sigma)
        self.add(f'states sigmas of {horizontal} horizontally, {vertical} vertically'
                 + ('' if share == 1.0 else f' in {share:.0%} of the messages'),
                 covariance_share=share, sigma=sigma)

    def _add_timing(self, stamps_ns: np.ndarray, ages: Array) -> None:
        """Add rate, gaps and ages of messages with these increasing stamps, ns, and ages, s."""
        intervals = np.diff(stamps_ns) * 1e-9
        usual = float(np.median(intervals)) if intervals.size else math.inf
        gaps = int(np.count_nonzero(intervals > GAP_INTERVALS * usual))
        first, last = ((self.recorded_ns[[0, -1]] - self._start_ns) * 1e-9).tolist()
        self.add('', rate_hz=1.0 / usual or None, first_s=first, last_s=last,
                 stamp_age_s=self.age_s, gaps=gaps,
                 stamp_age_spread_s=float(np.ptp(np.quantile(ages, (0.01, 0.99)))))
        if gaps:
            place = int(np.argmax(intervals))
            start_ns = int(stamps_ns[place]) - self._start_ns + self._age_ns
            self.add('', longest_gap_s=float(intervals[place]),
                     longest_gap_start_s=start_ns * 1e-9)

    @property
    def age_s(self) -> float:
        """Median of recorded time minus stamp, s; 0 if there is no message."""
        return self._age_ns * 1e-9

    def series(self) -> Series:
        """
        Return the usable values over increasing times, s from the start of the recording.

        The times are the stamps plus the median age of the messages, which makes different clocks
        comparable. Of equal stamps the first counts.
        """
        times_ns = self.stamps_ns[self.usable] - self._start_ns + self._age_ns
        return series_of(times_ns.astype(float) * 1e-9, self.values[self.usable])


def read_candidates(bag: Bag) -> list[Recorded]:
    """Read and survey every topic that an alignment could read, sorted by name."""
    topics = sorted(candidates(bag, KINDS))
    counts: Counter[Topic] = Counter()
    parts: dict[tuple[Topic, str], list[Columns]] = defaultdict(list)
    for block in bag.blocks(topics):
        for number, (topic, messages) in enumerate(zip(topics, block.messages)):
            counts[topic] += len(messages)
            times_ns = block.times_ns[block.topics == number]
            # The frame_id of a velocity is ignored: the motion will show its frame.
            decoded = decode(messages, topic, Config(velocity_frame='enu'))
            for kind, data in decoded.items():
                parts[topic, kind].append(columns_of(times_ns, data))
    return [Recorded(bag, topic, kind, counts[topic], parts[topic, kind])
            for topic in topics for kind in KINDS[topic.msgtype]]


class Sensor(NamedTuple):
    """How to print the figures of gyroscopes or accelerometers."""

    name: str
    unit: str
    size: float  # of the unit, in SI units
    walk_unit: str  # unit of the random walk; in SI units 1 / 60 of `size`


SENSORS = (Sensor('gyroscopes', 'deg/s', math.radians(1.0), 'deg/sqrt(h)'),
           Sensor('accelerometers', 'm/s^2', 1.0, 'm/s/sqrt(h)'))


def survey_imu(imu: Surveyed, samples: Series, velocities: Series, gravity: float) -> None:
    """
    Add what the samples of an IMU show to its findings.

    Samples are finite angular rates, rad/s, and specific forces, m/s^2, shape (N, 6); velocities
    are those of GNSS, m/s, as from `on_grid`, at times by the same clock, and may be empty.
    Gravity is in m/s^2.
    """
    times, values = samples
    if times.size < 20:
        imu.add('it has too few usable samples', fault=True)
        return
    sizes = np.linalg.norm(values.reshape(-1, 2, 3), axis=2)
    force, max_rate = float(np.mean(sizes[:, 1])), float(np.quantile(sizes[:, 0], 0.999))
    up = values[:, 3:].mean(axis=0)
    up /= np.linalg.norm(up) or 1.0
    grid, cells = _cells(times, values)
    rates = (SAME_VALUES if not np.ptp(values, axis=0).any() else
             'all angular rates are 0' if max_rate == 0.0 else
             degrees_fault(max_rate > ANY_GYRO_RATE, grid, *np.split(cells, 2, axis=1),
                           velocities))
    for fault in filter(None, (force_fault(force), rates)):
        imu.add(fault, fault=True)
    x, y, z = up.tolist()
    imu.add(f'specific force: {force:.2f} m/s^2 on average, mean direction '
            f'({x:+.2f}, {y:+.2f}, {z:+.2f})', mean_force=force, up=[x, y, z])
    if imu.faults:
        return  # the other findings would have wrong units
    if np.ptp(times) > WEAK_TIME and force < gravity - WEAK_FORCE:
        imu.add(f'gravity is {gravity:.2f} m/s^2, and no motion takes so much off the average: '
                f'the accelerometers read {1.0 - force / gravity:.0%} too little: check scale '
                'and unit',
                force_lacks=gravity - force)
    if z < 0.5:
        imu.add('on average the specific force does not point along the z axis of the IMU: the '
                'attitude will be that of the axes as they are, however the IMU is mounted')
    imu.add(f'angular rate: up to {math.degrees(max_rate):.0f} deg/s',
            max_rate_deg_s=math.degrees(max_rate))
    _add_noise(imu, samples, _longest_rest(grid, cells, velocities), gravity)


def _add_noise(imu: Surveyed, samples: Series, rest: tuple[float, float] | None, gravity: float,
               ) -> None:
    """Add resolution, noise, biases and grade; `rest`: begin and end of a time at rest, s."""
    times, values = samples
    part = slice(None) if rest is None else slice(*np.searchsorted(times, rest))
    rate, force = values[part].mean(axis=0).reshape(2, 3)
    off_gravity = float(np.linalg.norm(force) - gravity)
    if rest and abs(off_gravity) > MAX_FORCE_ERROR:
        imu.add(f'the specific force at rest is {gravity + off_gravity:.3g} m/s^2, gravity is '
                f'{gravity:.2f}: check the unit and that gravity is not taken out', fault=True)
        return
    widths = np.array([_add_resolution(imu, sensor, triad)
                       for sensor, triad in zip(SENSORS, np.split(values, 2, axis=1))])
    walks = _walks(times[part], values[part], 0.5 if rest else QUIET_QUANTILE)
    root = math.sqrt(np.median(np.diff(times)))
    # With noise of half a quantum or more, rounding errors average out; with less they last.
    hidden = walks < widths * root
    lost = np.where(hidden, widths / math.sqrt(3.0), 0.0)  # 1 sigma of a uniform error
    walks = np.maximum(walks, lost * root)
    # The part of the rate that the Earth's rate does not explain is bias.
    bias = abs(float(np.linalg.norm(rate)) - EARTH_RATE) / math.sqrt(3.0)
    measured = ImuNoise(*walks, *map(math.hypot, lost, (bias, off_gravity) if rest else (0, 0)))
    grade, covers = _grade(measured)
    preset = PRESETS[grade if rest else Config.imu_grade]
    settings, biases = {}, {}
    # The alignment itself measures noise, except noise that is rounded away.
    if hidden[0] and measured.angle_random_walk > preset.angle_random_walk:
        settings['angle_random_walk'] = rounded(math.degrees(60.0 * measured.angle_random_walk))
    if measured.gyro_bias_std > preset.gyro_bias_std * (1.0 if hidden[0] else BIAS_SIGMAS):
        biases['gyro_bias_std'] = rounded(math.degrees(measured.gyro_bias_std))
    if measured.accel_bias_std > preset.accel_bias_std * BIAS_SIGMAS:
        biases['accel_bias_std'] = rounded(measured.accel_bias_std)
    shown = [f'{60.0 * walk / sensor.size:.2g} {sensor.walk_unit}'
             + (' of rounding' if rounding else '')
             for walk, rounding, sensor in zip(walks, hidden, SENSORS)]
    imu.add(f'noise: {", ".join(shown)}' + ('' if rest else ' at most, measured in motion'),
            settings if rest else settings | biases,
            angle_random_walk=math.degrees(60.0 * walks[0]),
            velocity_random_walk=float(60.0 * walks[1]))
    if rest is None:
        noise = f'; its noise is no worse than that of {grade}' if covers else ''
        imu.add(f'imu_grade: {Config.imu_grade} is the default; not seen at rest, which would '
                f'show biases{noise}', imu_grade=grade)
        return
    degrees_s = np.degrees(rate).tolist()
    within = [f' +- {width / sensor.size:.2g}' if rounding else ''
              for width, rounding, sensor in zip(widths, hidden, SENSORS)]
    imu.add(f'at rest for {rest[1] - rest[0]:.0f} s: rate '
            f'({", ".join(f"{each:+.4f}" for each in degrees_s)}){within[0]} deg/s, specific '
            f'force {off_gravity:+.3f}{within[1]} m/s^2 off gravity', biases,
            rest_s=rest[1] - rest[0], rest_rate_deg_s=degrees_s, rest_force_error=off_gravity)
    verdict = f'suits imu_grade {grade}'
    if not covers:
        verdict = f'worse than imu_grade {grade}'
        if np.any(~hidden & (walks > NOISE_MARGIN * np.array(preset[:2]))):
            verdict += ': more noise is measured while aligning'
    imu.add(verdict, {} if grade == Config.imu_grade else
            {'imu_grade': grade, **(CHIP_THRESHOLDS if grade == 'chip' else {})},
            imu_grade=grade)


def _grade(measured: ImuNoise) -> tuple[str, bool]:
    """
    Return the preset that suits what was measured, and whether it covers all of it.

    A preset worse than the default is returned only if both biases exceed the default, as those of
    another kind of sensor do. A single bias is set as a parameter, and the alignment itself
    measures more noise.
    """
    margins = NOISE_MARGIN, NOISE_MARGIN, BIAS_SIGMAS, BIAS_SIGMAS
    for name, preset in PRESETS.items():
        covered = [value <= margin * limit for value, margin, limit
                   in zip(measured, margins, preset)]
        if all(covered) or (name == Config.imu_grade and any(covered[2:])):
            break
    return name, all(covered)


def _add_resolution(imu: Surveyed, sensor: Sensor, values: Array) -> float:
    """
    Add the resolution of the coarsest axis of a sensor with values of shape (N, 3).

    Returns the largest error of rounding to a multiple of the quantum or, in a dead band, to 0.
    """
    quantum = dead_band = zeros = 0.0
    for axis in values.T:
        levels = np.unique(axis)
        steps = np.diff(levels)
        # Steps to and from 0 may cross a dead band and are no multiples of the quantum.
        inner = steps[(levels[1:] != 0.0) & (levels[:-1] != 0.0)]
        if inner.size and axis.size > MIN_REPEATS * levels.size:
            q = float(np.median(inner[inner < 1.5 * inner.min()]))
            if np.mean(np.abs(inner / q - np.round(inner / q)) < ON_LATTICE) > 0.99:
                quantum = max(quantum, q)
        sizes = np.abs(axis[axis != 0.0])
        zero_count = axis.size - sizes.size
        zeros = max(zeros, zero_count / axis.size)
        if sizes.size and zero_count > max(MIN_ZEROS, MIN_ZERO_SHARE * axis.size):
            smallest = float(sizes.min())
            # Many values lie just beyond a dead band; otherwise the zeros mean something else.
            if np.count_nonzero(sizes < 2.0 * smallest) > MIN_ZEROS and smallest > dead_band:
                dead_band = smallest
    if dead_band <= 1.5 * quantum:
        dead_band = 0.0
    exactly = f': {zeros:.0%} of the samples of an axis are exactly 0' if zeros > 0.01 else ''
    for figure, text, value in (
            ('quantum', 'round to multiples of', quantum),
            ('dead_band', 'have a dead band: nothing between 0 and', dead_band)):
        line = f'{sensor.name} {text} {value / sensor.size:.2g} {sensor.unit}{exactly}'
        imu.add(line if value else '', **{f'{sensor.name}_{figure}': value})
    return max(0.5 * quantum, dead_band)


def _walks(times: Array, values: Array, quiet: float) -> Array:
    """Return the random walks of gyros and accelerometers, SI units, (2,), of quiet windows."""
    walks, interval = np.zeros(2), float(np.median(np.diff(times)))
    for average in {1, max(round(AVERAGING / interval), 1)}:
        count = times.size // average
        stamps, means = (column[:count * average].reshape(count, average, -1).mean(axis=1)
                         for column in (times * 1e9, values))
        edges = np.arange(0, count, max(round(WINDOW / (interval * average)), 8))
        if edges.size > 1:
            walks = np.maximum(walks, np.quantile(white_noise(
                stamps[:, 0].astype(np.int64), means, edges[:-1], edges[1:]), quiet, axis=0))
    return walks


def _cells(times: Array, samples: Array) -> tuple[Array, Array]:
    """Average over cells of GRID s; return their middles, s, (M,), and means, (M, 6)."""
    index = ((times - times[0]) / GRID).astype(np.int64)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(index) > 0]))
    counts = np.diff(np.append(starts, times.size))[:, None]
    return times[0] + (index[starts] + 0.5) * GRID, np.add.reduceat(samples, starts) / counts


def _longest_rest(grid: Array, cells: Array, velocities: Series) -> tuple[float, float] | None:
    """Return begin and end of the longest time at rest, s; None if there is none."""
    if velocities.times.size < 2:
        return None
    speed = np.interp(grid, velocities.times, np.hypot(*velocities.vectors[:, :2].T))
    after = np.clip(np.searchsorted(velocities.times, grid), 1, velocities.times.size - 1)
    near = np.abs(grid - velocities.times[after - 1]) < 2.0 * GRID
    # GNSS does not show that a vehicle is handled at rest: jumps of the means interrupt the rest.
    limits = np.repeat([REST_RATE, REST_FORCE], 3)
    calm = np.all(np.abs(np.diff(cells, axis=0)) < 2.0 * limits, axis=1)
    calm = np.append(calm, True) & np.insert(calm, 0, True)
    still = np.concatenate([[False], near & calm & (speed < REST_SPEED), [False]])
    runs = np.flatnonzero(np.diff(still.astype(np.int8))).reshape(-1, 2).tolist()
    for start, end in sorted(runs, key=lambda run: run[0] - run[1]):
        # The first and the last second may belong to stopping and starting.
        rest = slice(start + 2, end - 2)
        if (end - start) * GRID >= MIN_REST and np.all(cells[rest].std(axis=0) < limits):
            first, last = grid[rest][[0, -1]].tolist()
            return first - 0.5 * GRID, last + 0.5 * GRID
    return None
