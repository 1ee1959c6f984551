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
"""What a recording holds before any alignment: topics, faults, motion, the command to align it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from datetime import datetime, timezone
import math
import os
import shlex
from typing import Any

from ins_align.checks import (
    BEYOND_THE_POLES, beyond_the_poles, exchange_fault, lateness_advice, MAX_LATENESS)
from ins_align.config import Config, config_from_mapping, parse_override
from ins_align.geometry.earth import normal_gravity
from ins_align.gnss.buffer import MAX_AHEAD_NS
from ins_align.gnss.drivers import type_in_words
from ins_align.gnss.motion import (
    differences, EMPTY, find_manoeuvres, heading_in_words, MANOEUVRE_SPEED, MANOEUVRE_TIME,
    Manoeuvres, on_grid, Series, track, velocity_frame, velocity_from_positions, VelocityFrame,
    without_wild_positions)
from ins_align.imu.buffer import MAX_GAP_NS
from ins_align.recordings import BagError
from ins_align.recordings.bag import Bag
from ins_align.recordings.imu_survey import ImuFacts, Resolution, survey_imu
from ins_align.recordings.motion_fit import fit_motion, MotionFit
from ins_align.recordings.reader import choose_topics, is_command
from ins_align.recordings.topic_survey import (
    Gap, KINDS, MAX_ASTRAY, read_candidates, Recorded, Timing)
from ins_align.report import format_table
import numpy as np

MIN_RATE = 1e9 / MAX_GAP_NS  # Hz
MIN_AHEAD = 0.3  # s: clocks that differ by less may be jitter
MIN_DELAY, DELAY_SIGMAS = 0.05, 2.0  # s and so many sigmas beyond it: a delay to be set
MIN_START = 5.0  # s that an alignment starts before a manoeuvre
MAX_NO_FIX = 0.1  # share of positions without a fix that is worth a word
FRAMES_THAT_FIT = ('enu', 'ned')
FRAME_FAULTS = {
    'body': 'its speed fits the change of position and its direction does not: it is given in the '
            'axes of the vehicle or of a start of its own',
    'turned': 'it is turned by {0.angle_deg:.0f} deg against the change of position: its axes are '
              'not east and north',
    'contradiction': 'it is {0.speed_ratio:.2g} times the change of position: check its unit'}


@dataclass(frozen=True)
class TopicInfo:
    """A topic that an alignment could read."""

    name: str
    msgtype: str
    kind: str  # imu, fix or velocity
    timing: Timing
    faults: tuple[str, ...]  # each makes the topic useless as it is
    usable_share: float  # of the messages: finite and, of fixes, with a fix
    no_fix_share: float | None = None  # of fixes
    covariance_share: float | None = None  # of GNSS messages that state a covariance
    sigma: tuple[float, float] | None = None  # stated, horizontal and vertical, median
    frame: VelocityFrame | None = None  # of velocities
    vertical_absent: bool = False  # of velocities: the vertical one is always 0
    imu: ImuFacts | None = None


@dataclass(frozen=True)
class Info:
    """What is known of a recording before an alignment."""

    bag: str
    duration_s: float
    start_ns: int
    topics: tuple[TopicInfo, ...]
    chosen: dict[str, str | None]  # topic by kind that the command reads
    gnss_lateness_s: float | None  # of GNSS behind newer IMU samples, 99 percent
    manoeuvres: Manoeuvres | None
    motion: MotionFit | None  # motion of the IMU against that of the GNSS
    heading: str  # whether the motion shows it, in words
    notes: tuple[str, ...]
    obstacles: tuple[str, ...]  # why it cannot be aligned
    command: str | None  # to align it, quoted for a shell; None: it cannot be
    warnings: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``--json`` writes."""
        return dataclasses.asdict(self)


def inspect(path: str | os.PathLike[str]) -> Info:
    """
    Tell what a recording holds.

    Raises
    ------
    BagError
        If it cannot be read at all.

    """
    with Bag(path) as bag:
        return _Survey(bag, read_candidates(bag)).info()


class _Survey:
    """Looks at the topics and draws the conclusions."""

    def __init__(self, bag: Bag, candidates: list[Recorded]) -> None:
        self._bag = bag
        self._data = {(data.kind, data.topic.name): data for data in candidates}
        self._notes: list[str] = []
        self._settings: list[str] = []
        self._obstacles: list[str] = []

    def info(self) -> Info:
        """Return everything that is known."""
        fixes = [self._fix(data) for data in self._of('fix')]
        fix = _best(fixes)
        positions, gravity = EMPTY, 9.81
        if fix is not None:
            if fault := self._exchanged(self._data[fix.kind, fix.name]):
                fixes[fixes.index(fix)] = dataclasses.replace(fix, faults=(fault,))
            positions_deg = self._data[fix.kind, fix.name].series()
            positions = without_wild_positions(track(positions_deg))
            latitude, _, altitude = np.median(positions_deg.vectors, axis=0).tolist()
            gravity = float(normal_gravity(math.radians(latitude), altitude))
        velocities = [self._velocity(data, positions) for data in self._of('velocity')]
        velocity = _best(velocities)
        motion, grid = differences(positions), velocity_from_positions(positions)
        if velocity is not None:
            motion = self._enu(velocity)
            grid = on_grid(motion)
        imus = [self._imu(data, grid, gravity) for data in self._of('imu')]
        chosen = {'imu': _best(imus) or next(iter(imus), None),
                  'fix': _best(fixes) or next(iter(fixes), None), 'velocity': velocity}
        gnss = [topic for topic in (chosen['fix'], velocity) if topic is not None]
        found = find_manoeuvres(grid)
        fit = lateness = None
        if (imu := chosen['imu']) is not None:
            self._advise_imu(imu)
        self._advise_gnss(chosen['fix'], velocity, velocities)
        if imu is not None:
            lateness = self._lateness(imu, gnss)
            if not self._has_other_clock(imu, gnss) and gnss:
                ahead = min(_age(imu) - _age(topic) for topic in gnss)
                fit = self._fit(imu, velocity or fix, motion, gravity)
                self._advise_motion(ahead, lateness, fit, velocity)
        for topics in (imus, fixes, velocities):
            good = [topic.name for topic in topics if not topic.faults]
            if len(good) > 1:
                self._notes.append(f'{", ".join(good)}: each could be read, the command takes the '
                                   'one with the most messages; choose for yourself')
        command = self._command(chosen)
        # The end of a file that was cut off is known from what could be read of it.
        start_ns = self._bag.start_ns or 0
        end_ns = max([self._bag.end_ns or start_ns, *(
            int(data.recorded_ns.max()) for data in self._data.values() if data.recorded_ns.size)])
        return Info(
            str(self._bag.path), (end_ns - start_ns) * 1e-9, start_ns,
            (*imus, *fixes, *velocities),
            {kind: None if topic is None else topic.name for kind, topic in chosen.items()},
            lateness, found, fit, heading_in_words(found), tuple(self._notes),
            tuple(self._obstacles), command, tuple(self._bag.warnings))

    def _of(self, kind: str) -> list[Recorded]:
        return [data for data in self._data.values() if data.kind == kind]

    def _topic(self, data: Recorded, faults: list[str], **more: Any) -> TopicInfo:
        count = data.stamps_ns.size
        if not count:
            faults = [*faults, (data.undecodable_why or 'its messages cannot be decoded')
                      if data.undecodable else 'it has no messages']
        stated = data.sigmas[np.isfinite(data.sigmas).all(axis=1)]
        if data.sigmas.size:
            more['covariance_share'] = stated.shape[0] / count
        if stated.size:
            more['sigma'] = tuple(np.median(stated, axis=0).tolist())
        return TopicInfo(
            data.topic.name, type_in_words(data.topic.msgtype), data.kind, data.timing(),
            tuple(faults), float(np.mean(data.usable)) if count else 0.0, **more)

    def _fix(self, data: Recorded) -> TopicInfo:
        faults = []
        count = data.stamps_ns.size
        if count and not data.usable.any():
            beyond = [beyond_the_poles(*place) for place in data.values[:, :2].tolist()]
            faults.append('no message has a fix' if data.no_fix == count else
                          BEYOND_THE_POLES if np.mean(beyond) > 0.5 else
                          'no message has a fix and numbers that can be used')
        return self._topic(data, faults, no_fix_share=data.no_fix / count if count else None)

    def _exchanged(self, data: Recorded) -> str:
        """Say that latitude and longitude are exchanged, and exchange them for the rest."""
        for velocity in self._of('velocity'):
            if fault := exchange_fault(data.series(), velocity.series()):
                data.values = data.values[:, [1, 0, 2]]
                return fault
        return ''

    def _velocity(self, data: Recorded, positions: Series) -> TopicInfo:
        faults = []
        if is_command(data.topic):
            faults.append('its name is that of a command, not of a measurement')
        if not data.usable.any():
            return self._topic(data, faults + ['no message has numbers that can be used']
                               * bool(data.stamps_ns.size))
        frame = velocity_frame(data.series(), positions)
        if data.refused and frame.frame not in FRAMES_THAT_FIT:
            faults.append(data.refused)
        if frame.frame in FRAME_FAULTS:
            faults.append(FRAME_FAULTS[frame.frame].format(frame))
        values = data.values[data.usable] != 0.0
        return self._topic(data, faults, frame=frame, vertical_absent=bool(
            values[:, :2].any() and not values[:, 2].any()))

    def _imu(self, data: Recorded, motion: Series, gravity: float) -> TopicInfo:
        faults = []
        if data.unmeasured and len(self._of('imu')) > 1:
            faults.append(data.unmeasured)
        times, values = data.series()
        facts = survey_imu(times, values, motion, gravity)
        if facts is not None:
            faults += facts.faults
        elif data.stamps_ns.size:
            faults.append('it has too few usable samples')
        rate = data.timing().rate_hz
        if rate is not None and rate < MIN_RATE:
            faults.append(f'its rate is {rate:.2g} Hz: an alignment starts over after '
                          f'{MAX_GAP_NS * 1e-9:g} s without a sample')
        return self._topic(data, faults, imu=facts)

    def _enu(self, velocity: TopicInfo) -> Series:
        series = self._data[velocity.kind, velocity.name].series()
        if velocity.frame is not None and velocity.frame.frame == 'ned':
            return Series(series.times, series.vectors[:, [1, 0, 2]] * (1.0, 1.0, -1.0))
        return series

    def _fit(self, imu: TopicInfo, gnss: TopicInfo | None, motion: Series,
             gravity: float) -> MotionFit | None:
        """Compare the motion of the IMU with that of the GNSS, on the clocks of their stamps."""
        if imu.faults or gnss is None:
            return None
        apart = _age(imu) - _age(gnss)
        samples = self._data[imu.kind, imu.name].series()
        return fit_motion(samples.times, *np.split(samples.vectors, 2, axis=1),
                          Series(motion.times + apart, motion.vectors), gravity,
                          (0.0, apart) if abs(apart) >= MIN_AHEAD else (0.0,))

    def _lateness(self, imu: TopicInfo, gnss: list[TopicInfo]) -> float | None:
        """Return how late GNSS messages come after newer IMU samples, 99 percent of them."""
        samples = self._data[imu.kind, imu.name]
        newest = np.maximum.accumulate(samples.stamps_ns[samples.usable])
        late = [np.zeros(0)]
        for data in (self._data[topic.kind, topic.name] for topic in gnss if newest.size):
            before = np.searchsorted(samples.recorded_ns[samples.usable],
                                     data.recorded_ns[data.usable]) - 1
            late.append((newest[before] - data.stamps_ns[data.usable])[before >= 0] * 1e-9)
        lateness = np.concatenate(late)
        return float(np.quantile(lateness, 0.99)) if lateness.size else None

    def _advise(self, when: object, note: str = '', setting: str = '') -> None:
        if when:
            self._notes.extend(filter(None, [note]))
            self._settings.extend(filter(None, [setting]))

    def _advise_imu(self, imu: TopicInfo) -> None:
        if imu.imu is None:
            return
        gap, data = imu.timing.longest_gap or Gap(0.0, 0.0), self._data[imu.kind, imu.name]
        self._notes.extend(imu.imu.too_small)
        self._settings.extend(imu.imu.settings)
        self._advise(data.unmeasured and not imu.faults,
                     f'{imu.name}: {data.unmeasured}; its numbers are used all the same '
                     '(covariances that are not known are 0)')
        self._advise(gap.duration_s > MAX_GAP_NS * 1e-9,
                     f'the IMU is silent for {gap.duration_s:.1f} s at {gap.start_s:.1f} s: an '
                     'alignment starts over after that')
        self._advise(imu.imu.up[2] < 0.5,
                     'on average the specific force does not point along the z axis of the IMU: '
                     'the attitude will be that of the axes as they are, however the IMU is '
                     'mounted')

    def _advise_gnss(self, fix: TopicInfo | None, velocity: TopicInfo | None,
                     velocities: list[TopicInfo]) -> None:
        no_fix = fix.no_fix_share or 0.0 if fix is not None else 0.0
        self._advise(no_fix > MAX_NO_FIX, f'{no_fix:.0%} of the positions are without a fix')
        if velocity is None or velocity.frame is None:
            self._advise(velocities, setting='use_velocity=false')
            self._advise(fix, 'there is no velocity that can be used: it is aligned from '
                         'positions alone, which takes longer unless they are RTK')
            return
        name, data = velocity.frame.frame, self._data[velocity.kind, velocity.name]
        self._advise(name == 'unknown', 'nothing tells the frame of the velocity (too little '
                     'motion): it is taken as east-north-up')
        self._advise(name == 'ned' or name == 'enu' and data.refused,
                     setting=f'velocity_frame={name}')
        self._advise(velocity.frame.upside_down, 'the vertical velocity has the wrong sign')
        self._advise(velocity.vertical_absent, setting='velocity_vertical=absent')

    def _has_other_clock(self, imu: TopicInfo, gnss: list[TopicInfo]) -> bool:
        for topic in gnss:
            late = _age(topic) - _age(imu)
            if topic.timing.stamp_age_s is not None and not -MAX_AHEAD_NS * 1e-9 < late < 10.0:
                self._obstacles.append(
                    f'the stamps of {topic.name} are {abs(late):.1f} s '
                    f'{"behind" if late > 0.0 else "ahead of"} those of {imu.name}: they are of '
                    'different clocks')
        return bool(self._obstacles)

    def _advise_motion(self, ahead: float, lateness: float | None, fit: MotionFit | None,
                       velocity: TopicInfo | None) -> None:
        delay = None if fit is None else fit.delay
        if delay is None:
            self._advise(
                ahead >= MIN_AHEAD, f'the stamps of GNSS messages are {ahead:.1f} s ahead of '
                'those of the IMU: their clocks differ, which gnss_delay corrects as far as '
                'messages were recorded at once', f'gnss_delay={ahead:.1f}')
        else:
            least = MIN_DELAY + DELAY_SIGMAS * delay.std
            self._advise(
                abs(delay.mean) > least, f'the GNSS measures {abs(delay.mean):.2f} s '
                f'{"before" if delay.mean > 0.0 else "after"} its stamps, as the motion of the '
                'IMU shows: set gnss_delay', f'gnss_delay={delay.mean:.2f}')
            self._advise(
                abs(delay.drift) > least + DELAY_SIGMAS * delay.std, 'the delay of the GNSS '
                f'changes by {delay.drift:+.2f} s from the first half to the second: the clocks '
                'of IMU and GNSS drift apart')
            if lateness is not None and delay.mean < -least:
                lateness += delay.mean  # a delay above 0 adds to gnss_lateness by itself
        # Velocities that mostly come without a covariance.
        if fit is not None and fit.velocity_std is not None and velocity is not None and (
                velocity.covariance_share or 0.0) < 0.5:
            for name, std in zip(('velocity_std', 'velocity_std_vertical'), fit.velocity_std):
                self._advise(not (velocity.vertical_absent and name.endswith('vertical')),
                             setting=f'{name}={max(std, 1e-3):.2g}')
        if lateness is not None and Config.gnss_lateness < lateness < MAX_LATENESS:
            advice, value = lateness_advice(lateness)
            self._advise(True, advice, f'gnss_lateness={value}')

    def _command(self, chosen: dict[str, TopicInfo | None]) -> str | None:
        """Return the command, tried as far as its choice of topics goes."""
        path = str(self._bag.path)
        arguments = ['ins_align', 'replay', path if not path.startswith('-') else f'./{path}']
        names: dict[str, str | None] = dict.fromkeys(KINDS)
        for kind, topic in chosen.items():
            if topic is not None and topic.faults:
                self._obstacles.append(f'{topic.name} cannot be used: {topic.faults[0]}')
            if topic is not None and len(self._of(kind)) > 1:
                names[kind] = topic.name
                arguments += [f'--{kind}-topic', topic.name]
        for setting in self._settings:
            arguments += ['--set', setting]
        config = config_from_mapping(dict(map(parse_override, self._settings)))
        try:
            choose_topics(self._bag, config, names['imu'], names['fix'], names['velocity'])
        except BagError as error:
            self._obstacles.append(str(error))
        return None if self._obstacles else shlex.join(arguments)


def describe(info: Info) -> str:
    """Return what ``ins_align info`` prints of a recording."""
    recorded = datetime.fromtimestamp(info.start_ns * 1e-9, timezone.utc)
    lines = [info.bag,
             f'  {info.duration_s:.1f} s, recorded from {recorded:%Y-%m-%d %H:%M:%S} UTC']
    if info.topics:
        lines += ['', format_table(list(map(_row, info.topics)), [
            'topic', 'type', 'messages', 'Hz', 'from, s', 'to, s', 'stamp age, s', 'spread, s',
            'gaps', 'longest, s'], '  ')]
    for topic in info.topics:
        lines += ['', f'  {topic.name}', *(f'    {line}' for line in _about(topic))]
    lines += ['', f'  heading from the motion: {info.heading}',
              *(f'    {line}' for line in _about_motion(info.manoeuvres, info.motion))]
    if info.notes:
        lines += ['', '  notes', *(f'    - {note}' for note in info.notes)]
    if info.command is None:
        lines += ['', '  it cannot be aligned', *(f'    - {text}' for text in info.obstacles)]
    else:
        lines += ['', '  to align it, with the lever arm added: --lever-arm X Y Z',
                  f'    {info.command}']
    return '\n'.join(printable(line) for text in lines for line in text.split('\n'))


def _row(topic: TopicInfo) -> list[Any]:
    timing, gap = topic.timing, topic.timing.longest_gap
    numbers = [(timing.rate_hz, 1), (timing.first_s, 1), (timing.last_s, 1),
               (timing.stamp_age_s, 3), (timing.stamp_age_spread_s, 3)]
    return [topic.name, topic.msgtype.rsplit('/', 1)[-1], timing.count,
            *('-' if value is None else f'{value:.{digits}f}' for value, digits in numbers),
            timing.gaps, '-' if gap is None else f'{gap.duration_s:.1f} at {gap.start_s:.1f}']


def _about(topic: TopicInfo) -> list[str]:
    """Say in lines what has been found out about a topic."""
    timing, frame, share = topic.timing, topic.frame, topic.covariance_share
    lines = [f'cannot be used: {fault}' for fault in topic.faults]
    lines += [f'{count} {text}' for count, text in (
        (timing.undecodable, 'messages cannot be decoded'),
        (timing.astray, f'stamps are more than {MAX_ASTRAY:g} s off the others'),
        (timing.out_of_order, 'stamps are not later than the one before')) if count]
    if topic.no_fix_share is not None:
        lines.append(f'without a fix: {topic.no_fix_share:.1%}')
    if frame is not None and frame.frame in FRAMES_THAT_FIT:
        lines.append(f'frame: {frame.frame} (fits the change of position over {frame.windows} '
                     'distances)')
    elif frame is not None and frame.frame == 'unknown':
        lines.append('frame: not known, too little motion')
    lines += ['vertical velocity: always 0'] * topic.vertical_absent
    if topic.sigma is not None:
        unit = 'm' if topic.kind == 'fix' else 'm/s'
        lines.append(f'states sigmas of {topic.sigma[0]:.2g} {unit} horizontally, '
                     f'{topic.sigma[1]:.2g} {unit} vertically'
                     + ('' if share == 1.0 else f' in {share:.0%} of the messages'))
    elif share is not None:
        lines.append('states no covariance')
    return lines + ([] if topic.imu is None else _about_imu(topic.imu))


def _about_imu(imu: ImuFacts) -> list[str]:
    x, y, z = imu.up
    walks = [f'{walk:.2g} {unit}' + ' of rounding' * rounds for walk, unit, rounds in zip(
        (imu.angle_random_walk, imu.velocity_random_walk), ('deg/sqrt(h)', 'm/s/sqrt(h)'),
        imu.rounds)]
    lines = [
        f'specific force: {imu.mean_force:.2f} m/s^2 on average, mean direction '
        f'({x:+.2f}, {y:+.2f}, {z:+.2f})',
        f'angular rate: up to {imu.max_rate_deg_s:.0f} deg/s',
        *_about_resolution('gyroscopes', imu.gyro, math.degrees(1.0), 'deg/s'),
        *_about_resolution('accelerometers', imu.accel, 1.0, 'm/s^2'),
        f'noise: {", ".join(walks)}' + ('' if imu.rest_s else ' at most, measured in motion')]
    if imu.rest_rate_deg_s is not None and imu.rest_force_error is not None:
        rounded = f' +- {math.degrees(imu.gyro.half_width):.2g}' * imu.rounds[0]
        lines.append(
            f'at rest for {imu.rest_s:.0f} s: rate '
            f'({", ".join(f"{rate:+.4f}" for rate in imu.rest_rate_deg_s)}){rounded} deg/s, '
            f'specific force {imu.rest_force_error:+.3f}'
            + f' +- {imu.accel.half_width:.2g}' * imu.rounds[1] + ' m/s^2 off gravity')
    if not imu.rest_s:
        return [*lines, f'imu_grade: no worse than {imu.grade}' if imu.grade_covers else
                f'imu_grade: never at rest to measure it; {Config.imu_grade} is the default']
    return [*lines, f'suits imu_grade {imu.grade}' if imu.grade_covers else
            f'worse than imu_grade {imu.grade}: more noise is measured while aligning'
            + ', more bias is among the settings' * ('bias_std' in str(imu.settings))]


def _about_resolution(name: str, found: Resolution, scale: float, unit: str) -> list[str]:
    zeros = f': {found.zeros:.0%} of the samples of an axis are exactly 0' * (found.zeros > 0.01)
    return [f'{name} {text} {value * scale:.2g} {unit}{zeros}' for text, value in (
        ('round to multiples of', found.quantum),
        ('have a dead band: nothing between 0 and', found.dead_band)) if value]


def _about_motion(found: Manoeuvres | None, fit: MotionFit | None) -> list[str]:
    lines = []
    if found is not None:
        lines.append(f'up to {found.max_speed:.1f} m/s; velocity changes by up to '
                     f'{found.largest_change:.1f} m/s within {MANOEUVRE_TIME:g} s')
    if found is not None and (starts := found.starts):
        apart = [start for before, start in zip((-math.inf, *starts), starts)
                 if start - before > MIN_START]
        listing = [f'{start:.0f}' for start in apart[:8]] + ['...'] * (len(apart) > 8)
        lines.append(f'changes by {MANOEUVRE_SPEED:g} m/s: {len(starts)}, at '
                     f'{", ".join(listing)} s' + (
                         f'; --start {starts[0] - MIN_START:.0f} leaves out what came before'
                         if starts[0] > MIN_START else ''))
    if fit is not None and fit.delay is not None:
        lines.append(f'delay of the GNSS against the IMU: {fit.delay.mean:+.2f} s +- '
                     f'{max(fit.delay.std, 0.01):.2f} s')
    if fit is not None and fit.velocity_std is not None:
        lines.append('noise of the GNSS velocity: {:.2g} m/s horizontally, {:.2g} m/s vertically'
                     .format(*fit.velocity_std))
    return lines


def _age(topic: TopicInfo) -> float:
    return topic.timing.stamp_age_s or 0.0


def _best(topics: list[TopicInfo]) -> TopicInfo | None:
    """Return the topic to read: without faults, its frame known, the most messages."""
    good = [topic for topic in topics if not topic.faults]
    return max(good, default=None, key=lambda topic: (
        topic.frame is not None and topic.frame.frame in FRAMES_THAT_FIT,
        topic.timing.count * topic.usable_share))


def printable(line: str) -> str:
    """Make a line that quotes a recording fit for a terminal."""
    return ''.join(letter if letter.isprintable() else '?' for letter in line)
