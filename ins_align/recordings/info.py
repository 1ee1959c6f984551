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
from ins_align.gnss.messages import enu_from_ned
from ins_align.gnss.motion import (
    differences, EMPTY, find_manoeuvres, heading_in_words, MANOEUVRE_SPEED, MANOEUVRE_TIME,
    Manoeuvres, on_grid, Series, track, velocity_frame, velocity_from_positions,
    without_wild_positions)
from ins_align.imu.buffer import MAX_GAP_NS
from ins_align.recordings import BagError, printable
from ins_align.recordings.bag import Bag
from ins_align.recordings.imu_survey import (
    fit_motion, ImuFacts, MotionFit, Resolution, survey_imu)
from ins_align.recordings.reader import choose_topics
from ins_align.recordings.topic_survey import (
    Gap, MAX_ASTRAY, read_candidates, Recorded, TopicInfo)
from ins_align.report import format_table
import numpy as np

MIN_RATE = 1e9 / MAX_GAP_NS  # Hz
MIN_AHEAD = 0.3  # s: clocks that differ by less may be jitter
MAX_AHEAD, MAX_BEHIND = MAX_AHEAD_NS * 1e-9, 10.0  # s: stamps further apart are of two clocks
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
    """Tell what a recording holds; a BagError says that it cannot be read at all."""
    with Bag(path) as bag:
        return _Survey(bag).info()


class _Survey:
    """Looks at the topics and draws the conclusions."""

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self._notes: list[str] = []
        self._settings: list[str] = []
        self._obstacles: list[str] = []
        self._all = read_candidates(bag)
        self._imus, self._fixes, self._velocities = (
            [data for data in self._all if data.kind == kind]
            for kind in ('imu', 'fix', 'velocity'))

    def info(self) -> Info:
        """Return everything that is known."""
        positions, gravity = self._positions()
        motion, grid = differences(positions), velocity_from_positions(positions)
        for data in self._velocities:
            _look_at_velocity(data, positions)
        if (velocity := _best(self._velocities)) is not None:
            motion = _in_enu(velocity)
            grid = on_grid(motion)
        for data in self._imus:
            _look_at_imu(data, grid, gravity, alone=len(self._imus) == 1)
        imu, fix = (_best(topics) or next(iter(topics), None)
                    for topics in (self._imus, self._fixes))
        gnss = [data for data in (fix, velocity) if data is not None]
        fit = lateness = None
        if imu is not None:
            self._advise_imu(imu)
        self._advise_gnss(fix, velocity)
        if imu is not None:
            lateness = _lateness(imu, gnss)
            self._compare_clocks(imu, gnss)
            if gnss and not self._obstacles:
                if not imu.faults and (source := velocity or _best(self._fixes)) is not None:
                    fit = _fit(imu, source, motion, gravity)
                self._advise_motion(min(imu.age_s - data.age_s for data in gnss), lateness, fit,
                                    velocity)
        for topics in (self._imus, self._fixes, self._velocities):
            good = [data.name for data in topics if not data.faults]
            if len(good) > 1:
                self._notes.append(f'{", ".join(good)}: each could be read, the command takes the '
                                   'one with the most messages; choose for yourself')
        chosen = {'imu': imu, 'fix': fix, 'velocity': velocity}
        command = self._command(chosen)
        # The end of a file that was cut off is known from what could be read of it.
        start_ns = self._bag.start_ns or 0
        end_ns = max([self._bag.end_ns or start_ns, *(
            int(data.recorded_ns.max()) for data in self._all if data.recorded_ns.size)])
        found = find_manoeuvres(grid)
        return Info(
            str(self._bag.path), (end_ns - start_ns) * 1e-9, start_ns,
            (*self._imus, *self._fixes, *self._velocities),
            {kind: None if data is None else data.name for kind, data in chosen.items()},
            lateness, found, fit, heading_in_words(found), tuple(self._notes),
            tuple(self._obstacles), command, tuple(self._bag.warnings))

    def _positions(self) -> tuple[Series, float]:
        """Look at positions; return the track of the best, without spikes, and gravity there."""
        for data in self._fixes:
            if data.stamps_ns.size and not data.usable.any():
                beyond = [beyond_the_poles(*place) for place in data.values[:, :2].tolist()]
                data.faults += ('no message has a fix' if data.no_fix_share == 1.0 else
                                BEYOND_THE_POLES if np.mean(beyond) > 0.5 else
                                'no message has a fix and numbers that can be used',)
        fix = _best(self._fixes)
        if fix is None:
            return EMPTY, 9.81
        for velocity in self._velocities:
            if fault := exchange_fault(fix.series(), velocity.series()):
                fix.faults += (fault,)
                fix.values = fix.values[:, [1, 0, 2]]
                break
        positions_deg = fix.series()
        latitude, _, altitude = np.median(positions_deg.vectors, axis=0).tolist()
        return (without_wild_positions(track(positions_deg)),
                float(normal_gravity(math.radians(latitude), altitude)))

    def _advise(self, when: object, note: str = '', setting: str = '') -> None:
        if when:
            self._notes.extend(filter(None, [note]))
            self._settings.extend(filter(None, [setting]))

    def _advise_imu(self, imu: Recorded) -> None:
        if imu.imu is None:
            return
        gap = imu.timing.longest_gap or Gap(0.0, 0.0)
        self._notes.extend(imu.imu.too_small)
        self._settings.extend(imu.imu.settings)
        self._advise(imu.unmeasured and not imu.faults,
                     f'{imu.name}: {imu.unmeasured}; its numbers are used all the same '
                     '(covariances that are not known are 0)')
        self._advise(gap.duration_s > MAX_GAP_NS * 1e-9,
                     f'the IMU is silent for {gap.duration_s:.1f} s at {gap.start_s:.1f} s: an '
                     'alignment starts over after that')
        self._advise(imu.imu.up[2] < 0.5,
                     'on average the specific force does not point along the z axis of the IMU: '
                     'the attitude will be that of the axes as they are, however the IMU is '
                     'mounted')

    def _advise_gnss(self, fix: Recorded | None, velocity: Recorded | None) -> None:
        no_fix = fix.no_fix_share or 0.0 if fix is not None else 0.0
        self._advise(no_fix > MAX_NO_FIX, f'{no_fix:.0%} of the positions are without a fix')
        if velocity is None or velocity.frame is None:
            self._advise(self._velocities, setting='use_velocity=false')
            self._advise(fix, 'there is no velocity that can be used: it is aligned from '
                         'positions alone, which takes longer unless they are RTK')
            return
        name = velocity.frame.frame
        self._advise(name == 'unknown', 'nothing tells the frame of the velocity (too little '
                     'motion): it is taken as east-north-up')
        self._advise(name == 'ned' or name == 'enu' and velocity.refused,
                     setting=f'velocity_frame={name}')
        self._advise(velocity.frame.upside_down, 'the vertical velocity has the wrong sign')
        self._advise(velocity.vertical_absent, setting='velocity_vertical=absent')

    def _compare_clocks(self, imu: Recorded, gnss: list[Recorded]) -> None:
        for data in gnss:
            late = data.age_s - imu.age_s
            if data.stamps_ns.size and not -MAX_AHEAD < late < MAX_BEHIND:
                self._obstacles.append(
                    f'the stamps of {data.name} are {abs(late):.1f} s '
                    f'{"behind" if late > 0.0 else "ahead of"} those of {imu.name}: they are of '
                    'different clocks')

    def _advise_motion(self, ahead: float, lateness: float | None, fit: MotionFit | None,
                       velocity: Recorded | None) -> None:
        if fit is None or (delay := fit.delay) is None:
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
            horizontal, vertical = (f'{max(std, 1e-3):.2g}' for std in fit.velocity_std)
            self._settings.append(f'velocity_std={horizontal}')
            self._advise(not velocity.vertical_absent, setting=f'velocity_std_vertical={vertical}')
        if lateness is not None and Config.gnss_lateness < lateness < MAX_LATENESS:
            advice, value = lateness_advice(lateness)
            self._advise(True, advice, f'gnss_lateness={value}')

    def _command(self, chosen: dict[str, Recorded | None]) -> str | None:
        """Return the command, tried as far as its choice of topics goes."""
        path = str(self._bag.path)
        arguments = ['ins_align', 'replay', path if not path.startswith('-') else f'./{path}']
        names: dict[str, str] = {}
        for kind, data in chosen.items():
            if data is not None and data.faults:
                self._obstacles.append(f'{data.name} cannot be used: {data.faults[0]}')
            if data is not None and sum(other.kind == kind for other in self._all) > 1:
                names[kind] = data.name
                arguments += [f'--{kind}-topic', data.name]
        for setting in self._settings:
            arguments += ['--set', setting]
        config = config_from_mapping(dict(map(parse_override, self._settings)))
        try:
            choose_topics(self._bag, config, **names)
        except BagError as error:
            self._obstacles.append(str(error))
        return None if self._obstacles else shlex.join(arguments)


def _look_at_velocity(data: Recorded, positions: Series) -> None:
    """Find the frame of a velocity and what makes it useless."""
    if not data.usable.any():
        if data.stamps_ns.size:
            data.faults += ('no message has numbers that can be used',)
        return
    data.frame = velocity_frame(data.series(), positions)
    if data.refused and data.frame.frame not in FRAMES_THAT_FIT:
        data.faults += (data.refused,)
    if data.frame.frame in FRAME_FAULTS:
        data.faults += (FRAME_FAULTS[data.frame.frame].format(data.frame),)
    moved = (data.values[data.usable] != 0.0).any(axis=0)
    data.vertical_absent = bool(moved[:2].any() and not moved[2])


def _look_at_imu(data: Recorded, motion: Series, gravity: float, alone: bool) -> None:
    """Measure an IMU and find what makes it useless."""
    if data.unmeasured and not alone:
        data.faults += (data.unmeasured,)
    data.imu = survey_imu(*data.series(), motion, gravity)
    if data.imu is not None:
        data.faults += data.imu.faults
    elif data.stamps_ns.size:
        data.faults += ('it has too few usable samples',)
    rate = data.timing.rate_hz
    if rate is not None and rate < MIN_RATE:
        data.faults += (f'its rate is {rate:.2g} Hz: an alignment starts over after '
                        f'{MAX_GAP_NS * 1e-9:g} s without a sample',)


def _in_enu(velocity: Recorded) -> Series:
    series = velocity.series()
    if velocity.frame is not None and velocity.frame.frame == 'ned':
        return Series(series.times, enu_from_ned(series.vectors))
    return series


def _fit(imu: Recorded, gnss: Recorded, motion: Series, gravity: float) -> MotionFit:
    """Compare the motion of the IMU with that of the GNSS, on the clocks of their stamps."""
    apart = imu.age_s - gnss.age_s
    samples = imu.series()
    return fit_motion(samples.times, *np.split(samples.vectors, 2, axis=1),
                      Series(motion.times + apart, motion.vectors), gravity,
                      (0.0, apart) if abs(apart) >= MIN_AHEAD else (0.0,))


def _lateness(imu: Recorded, gnss: list[Recorded]) -> float | None:
    """Return how late GNSS messages come after newer IMU samples, 99 percent of them, s."""
    newest = np.maximum.accumulate(imu.stamps_ns[imu.usable])
    late = [np.zeros(0)]
    for data in gnss if newest.size else ():
        before = np.searchsorted(imu.recorded_ns[imu.usable], data.recorded_ns[data.usable]) - 1
        late.append((newest[before] - data.stamps_ns[data.usable])[before >= 0] * 1e-9)
    lateness = np.concatenate(late)
    return float(np.quantile(lateness, 0.99)) if lateness.size else None


def _best(topics: list[Recorded]) -> Recorded | None:
    """Return the topic to read: without faults, its frame known, the most messages."""
    good = [data for data in topics if not data.faults]
    return max(good, default=None, key=lambda data: (
        data.frame is not None and data.frame.frame in FRAMES_THAT_FIT,
        data.timing.count * data.usable_share))


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
