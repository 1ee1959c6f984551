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
"""What a recording holds, told before any alignment: topics, faults, motion, the command."""

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
from ins_align.imu.buffer import MAX_GAP_NS
from ins_align.recordings import BagError
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import ImuSamples
from ins_align.recordings.imu_survey import ImuFacts, survey_imu
from ins_align.recordings.motion_survey import (
    find_manoeuvres, MANOEUVRE_SPEED, MANOEUVRE_TIME, Manoeuvres, on_grid, Series, track,
    velocity_frame, velocity_from_positions, VelocityFrame, WEAK_SPEED, without_wild_positions)
from ins_align.recordings.reader import choose_topics
from ins_align.recordings.topic_survey import KINDS, MAX_ASTRAY, read_candidates, Recorded, Timing
from ins_align.report import format_table
import numpy as np

MIN_RATE = 1e9 / MAX_GAP_NS  # Hz
MIN_AHEAD = 0.3  # s: GNSS stamps this far ahead of the IMU's are no jitter
MIN_START = 5.0  # s that an alignment starts before a manoeuvre
MAX_NO_FIX = 0.1  # share of positions without a fix that is worth a word
FRAMES_THAT_FIT = ('enu', 'ned')


@dataclass(frozen=True)
class TopicInfo:
    """A topic that an alignment could read."""

    name: str
    msgtype: str
    kind: str  # imu, fix or velocity
    timing: Timing
    undecodable: int
    faults: tuple[str, ...]  # each makes the topic useless as it is
    usable_share: float  # of the messages: finite and, of fixes, with a fix
    no_fix_share: float | None = None  # of fixes
    covariance_share: float | None = None  # of GNSS messages that state a covariance
    sigma: tuple[float, float] | None = None  # stated, horizontal and vertical, median
    frame: VelocityFrame | None = None  # of velocities
    vertical_absent: bool | None = None  # of velocities: the vertical one is always 0
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
    heading: str  # whether the motion shows it, in words
    notes: tuple[str, ...]
    obstacles: tuple[str, ...]  # why it cannot be aligned
    command: str | None  # to align it, quoted for a shell; None: it cannot be
    warnings: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``--json`` writes; numbers that are not finite are None."""
        content: dict[str, Any] = _plain(dataclasses.asdict(self))
        return content


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
        self._start_ns = bag.start_ns or 0
        self._candidates = candidates
        self._data = {(data.kind, data.topic.name): data for data in candidates}
        self._notes: list[str] = []
        self._settings: list[str] = []
        self._obstacles: list[str] = []

    def info(self) -> Info:
        """Return everything that is known."""
        fixes = [self._fix(data) for data in self._of('fix')]
        fix = _best(fixes)
        if fix is not None and (fault := self._exchanged(fix)):
            fixes = [dataclasses.replace(topic, faults=(fault,)) if topic is fix else topic
                     for topic in fixes]
        positions = self._positions(fix)
        velocities = [self._velocity(data, positions) for data in self._of('velocity')]
        velocity = _best(velocities)
        motion = velocity_from_positions(positions)
        if velocity is not None:
            motion = on_grid(self._velocity_series(velocity))
        latitude, altitude = self._place(fix)
        gravity = float(normal_gravity(math.radians(latitude), altitude))
        imus = [self._imu(data, motion, gravity) for data in self._of('imu')]
        imu = _best(imus)
        chosen = {'imu': imu or _first(imus), 'fix': _best(fixes) or _first(fixes),
                  'velocity': velocity}
        lateness = self._lateness(chosen)
        found = find_manoeuvres(motion)
        self._advise_imu(chosen['imu'])
        self._advise_gnss(chosen['fix'], velocity, velocities)
        self._advise_clocks(chosen, lateness)
        for topics in (imus, fixes, velocities):
            self._advise_choice(topics)
        command = self._command(chosen)
        # The end of a file that was cut off is known from what could be read of it.
        end_ns = max([self._bag.end_ns or self._start_ns, *(
            int(data.recorded_ns.max()) for data in self._candidates if data.recorded_ns.size)])
        return Info(
            str(self._bag.path), (end_ns - self._start_ns) * 1e-9,
            self._start_ns, (*imus, *fixes, *velocities),
            {kind: None if topic is None else topic.name for kind, topic in chosen.items()},
            lateness, found, _heading_in_words(found), tuple(self._notes),
            tuple(self._obstacles), command, tuple(self._bag.warnings))

    def _of(self, kind: str) -> list[Recorded]:
        return [data for data in self._candidates if data.kind == kind]

    def _topic(self, data: Recorded, faults: list[str], **more: Any) -> TopicInfo:
        count = data.stamps_ns.size
        if not count:
            faults = [*faults, 'it has no messages' if not data.undecodable
                      else data.undecodable_why or 'its messages cannot be decoded']
        return TopicInfo(
            data.topic.name, data.topic.msgtype.replace('/msg/', '/'), data.kind,
            data.timing(self._start_ns), data.undecodable, tuple(faults),
            float(np.mean(data.usable)) if count else 0.0, **more)

    def _fix(self, data: Recorded) -> TopicInfo:
        faults = []
        count = data.stamps_ns.size
        if count and not data.usable.any():
            beyond = [beyond_the_poles(*place) for place in data.values[:, :2].tolist()]
            faults.append('no message has a fix' if data.no_fix == count else
                          BEYOND_THE_POLES if np.mean(beyond) > 0.5 else
                          'no message has a fix and numbers that can be used')
        return self._topic(data, faults, **_stated(data),
                           no_fix_share=data.no_fix / count if count else None)

    def _exchanged(self, fix: TopicInfo) -> str:
        """Say that latitude and longitude are exchanged, and exchange them for the rest."""
        data = self._data[fix.kind, fix.name]
        fault = next(filter(None, (
            exchange_fault(self._series(data), self._series(velocity))
            for velocity in self._of('velocity') if velocity.usable.any())), '')
        if fault:
            data.values = data.values[:, [1, 0, 2]]
        return fault

    def _velocity(self, data: Recorded, positions: Series) -> TopicInfo:
        faults = []
        if 'cmd' in data.topic.name.rsplit('/', 1)[-1]:
            faults.append('its name is that of a command, not of a measurement')
        frame = absent = None
        if data.usable.any():
            frame = velocity_frame(self._series(data), positions)
            if _is_refused(data) and frame.frame not in FRAMES_THAT_FIT:
                faults.append(data.refusals.most_common(1)[0][0])
            faults += _frame_faults(frame)
            values = data.values[data.usable]
            absent = bool((values[:, 2] == 0.0).all() and (values[:, :2] != 0.0).any())
        elif data.stamps_ns.size:
            faults.append('no message has numbers that can be used')
        return self._topic(data, faults, **_stated(data), frame=frame, vertical_absent=absent)

    def _imu(self, data: Recorded, motion: Series, gravity: float) -> TopicInfo:
        faults = []
        if data.unmeasured and len(self._of('imu')) > 1:
            faults.append(_says_unmeasured(data))
        times = data.times(self._start_ns)[data.usable]
        # Of one stamp the first counts, as in an alignment.
        times, first = np.unique(times, return_index=True)
        samples = ImuSamples(data.stamps_ns[data.usable][first],
                             data.values[data.usable, :3][first],
                             data.values[data.usable, 3:][first], data.usable)
        facts = survey_imu(samples, times, motion, gravity)
        if facts is not None:
            faults += facts.faults
        elif data.stamps_ns.size:
            faults.append('it has too few usable samples')
        timing = data.timing(self._start_ns)
        if timing.rate_hz is not None and timing.rate_hz < MIN_RATE:
            faults.append(f'its rate is {timing.rate_hz:.2g} Hz: an alignment starts over after '
                          f'{MAX_GAP_NS * 1e-9:g} s without a sample')
        return self._topic(data, faults, imu=facts)

    def _series(self, data: Recorded) -> Series:
        """Return a GNSS topic's values over increasing time."""
        times, vectors = data.times(self._start_ns)[data.usable], data.values[data.usable]
        times, first = np.unique(times, return_index=True)
        return Series(times, vectors[first])

    def _velocity_series(self, velocity: TopicInfo) -> Series:
        series = self._series(self._data[velocity.kind, velocity.name])
        if velocity.frame is not None and velocity.frame.frame == 'ned':
            return Series(series.times, series.vectors[:, [1, 0, 2]] * (1.0, 1.0, -1.0))
        return series

    def _positions(self, fix: TopicInfo | None) -> Series:
        if fix is None:
            return Series(np.zeros(0), np.zeros((0, 3)))
        series = self._series(self._data[fix.kind, fix.name])
        return without_wild_positions(track(series.times, *series.vectors.T))

    def _place(self, fix: TopicInfo | None) -> tuple[float, float]:
        """Return latitude, degrees, and altitude; somewhere on Earth if they are not known."""
        if fix is None:
            return 45.0, 0.0
        data = self._data[fix.kind, fix.name]
        latitude, _, altitude = np.median(data.values[data.usable], axis=0).tolist()
        return latitude, altitude if math.isfinite(altitude) else 0.0

    def _lateness(self, chosen: dict[str, TopicInfo | None]) -> float | None:
        """Return how late GNSS messages come after newer IMU samples, 99 percent of them."""
        imu = chosen['imu']
        if imu is None or not self._data[imu.kind, imu.name].usable.any():
            return None
        imu_data = self._data[imu.kind, imu.name]
        newest = np.maximum.accumulate(imu_data.stamps_ns[imu_data.usable])
        late = []
        for topic in (chosen['fix'], chosen['velocity']):
            if topic is None:
                continue
            data = self._data[topic.kind, topic.name]
            before = np.searchsorted(imu_data.recorded_ns[imu_data.usable],
                                     data.recorded_ns[data.usable]) - 1
            late.append((newest[before] - data.stamps_ns[data.usable])[before >= 0] * 1e-9)
        lateness = np.concatenate(late) if late else np.zeros(0)
        return float(np.quantile(lateness, 0.99)) if lateness.size else None

    def _advise_choice(self, topics: list[TopicInfo]) -> None:
        good = [topic.name for topic in topics if not topic.faults]
        if len(good) > 1:
            self._notes.append(f'{", ".join(good)}: each could be read, the command takes the one '
                               'with the most messages; choose for yourself')

    def _advise_imu(self, imu: TopicInfo | None) -> None:
        if imu is None or imu.imu is None:
            return
        facts, timing = imu.imu, imu.timing
        self._notes.extend(facts.too_small)
        data = self._data[imu.kind, imu.name]
        if data.unmeasured and not imu.faults:
            self._notes.append(f'{imu.name}: {_says_unmeasured(data)}; its numbers are used all '
                               'the same (covariances that are not known are 0)')
        if timing.longest_gap is not None and timing.longest_gap.duration_s > MAX_GAP_NS * 1e-9:
            self._notes.append(
                f'the IMU is silent for {timing.longest_gap.duration_s:.1f} s at '
                f'{timing.longest_gap.start_s:.1f} s: an alignment starts over after that')
        if facts.grade_is_sure and facts.grade != Config.imu_grade:
            self._settings.append(f'imu_grade={facts.grade}')
        if facts.up[2] < 0.5:
            self._notes.append('on average the specific force does not point along the z axis of '
                               'the IMU: the attitude will be that of the axes as they are, '
                               'however the IMU is mounted')

    def _advise_gnss(self, fix: TopicInfo | None, velocity: TopicInfo | None,
                     velocities: list[TopicInfo]) -> None:
        if fix is not None and (fix.no_fix_share or 0.0) > MAX_NO_FIX:
            self._notes.append(f'{fix.no_fix_share:.0%} of the positions are without a fix')
        if velocity is None:
            if velocities:
                self._settings.append('use_velocity=false')
            self._notes.append('there is no velocity that can be used: it is aligned from '
                               'positions alone, which takes longer unless they are RTK')
            return
        frame = velocity.frame
        if frame is None or frame.frame == 'unknown':
            self._notes.append('nothing tells the frame of the velocity (too little motion): '
                               'it is taken as east-north-up')
        elif frame.frame == 'ned' or _is_refused(self._data[velocity.kind, velocity.name]):
            self._settings.append(f'velocity_frame={frame.frame}')
        if frame is not None and frame.upside_down:
            self._notes.append('the vertical velocity has the wrong sign')
        if velocity.vertical_absent:
            self._settings.append('velocity_vertical=absent')

    def _advise_clocks(self, chosen: dict[str, TopicInfo | None],
                       lateness: float | None) -> None:
        imu = chosen['imu']
        if imu is None:
            return
        for topic in (chosen['fix'], chosen['velocity']):
            if topic is None:
                continue
            age, imu_age = topic.timing.stamp_age_s, imu.timing.stamp_age_s
            if age is None or imu_age is None or -MAX_AHEAD_NS * 1e-9 < age - imu_age < 10.0:
                continue
            self._obstacles.append(f'the stamps of {topic.name} are {abs(age - imu_age):.1f} s '
                                   f'{"behind" if age > imu_age else "ahead of"} those of '
                                   f'{imu.name}: they are of different clocks')
            return
        self._advise_delay(chosen, imu.timing.stamp_age_s)
        if lateness is not None and Config.gnss_lateness < lateness < MAX_LATENESS:
            advice, value = lateness_advice(lateness)
            self._settings.append(f'gnss_lateness={value}')
            self._notes.append(advice)

    def _advise_delay(self, chosen: dict[str, TopicInfo | None], imu_age: float | None) -> None:
        """See whether GNSS messages are recorded before they could have been measured."""
        ages = [topic.timing.stamp_age_s for topic in (chosen['fix'], chosen['velocity'])
                if topic is not None and topic.timing.stamp_age_s is not None]
        if not ages or imu_age is None or imu_age - max(ages) < MIN_AHEAD:
            return
        ahead = imu_age - max(ages)
        self._settings.append(f'gnss_delay={ahead:.1f}')
        self._notes.append(f'the stamps of GNSS messages are {ahead:.1f} s ahead of those of the '
                           'IMU: their clocks differ, which gnss_delay puts right as far as '
                           'messages were recorded at once')

    def _command(self, chosen: dict[str, TopicInfo | None]) -> str | None:
        """Return the command, tried as far as its choice of topics goes."""
        path = str(self._bag.path)
        arguments = ['ins_align', 'replay', path if not path.startswith('-') else f'./{path}']
        names: dict[str, str | None] = {}
        for kind in KINDS:
            topic = chosen[kind]
            names[kind] = topic.name if topic is not None and len(self._of(kind)) > 1 else None
            if topic is not None and topic.faults:
                self._obstacles.append(f'{topic.name} cannot be used: {topic.faults[0]}')
            if names[kind] is not None:
                arguments += [f'--{kind}-topic', names[kind] or '']
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
    lines += ['', f'  heading from the motion: {info.heading}', *_motion_lines(info.manoeuvres)]
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
    return [topic.name, topic.msgtype.rsplit('/', 1)[-1], timing.count,
            _number(timing.rate_hz, 1), _number(timing.first_s, 1), _number(timing.last_s, 1),
            _number(timing.stamp_age_s, 3), _number(timing.stamp_age_spread_s, 3), timing.gaps,
            '-' if gap is None else f'{gap.duration_s:.1f} at {gap.start_s:.1f}']


def _about(topic: TopicInfo) -> list[str]:
    """Say in lines what has been found out about a topic."""
    lines = [f'cannot be used: {fault}' for fault in topic.faults]
    if topic.undecodable:
        lines.append(f'{topic.undecodable} messages cannot be decoded')
    if topic.timing.astray:
        lines.append(f'{topic.timing.astray} stamps are more than {MAX_ASTRAY:g} s off the others')
    if topic.timing.out_of_order:
        lines.append(f'{topic.timing.out_of_order} stamps are not later than the one before')
    if topic.no_fix_share is not None:
        lines.append(f'without a fix: {topic.no_fix_share:.1%}')
    if topic.frame is not None and topic.frame.frame in FRAMES_THAT_FIT:
        lines.append(f'frame: {topic.frame.frame} (fits the change of position over '
                     f'{topic.frame.windows} distances)')
    elif topic.frame is not None and topic.frame.frame == 'unknown':
        lines.append('frame: not known, too little motion')
    if topic.vertical_absent:
        lines.append('vertical velocity: always 0')
    if topic.sigma is not None:
        unit = 'm' if topic.kind == 'fix' else 'm/s'
        lines.append(f'states sigmas of {topic.sigma[0]:.2g} {unit} horizontally, '
                     f'{topic.sigma[1]:.2g} {unit} vertically'
                     + ('' if topic.covariance_share == 1.0
                        else f' in {topic.covariance_share:.0%} of the messages'))
    elif topic.covariance_share is not None:
        lines.append('states no covariance')
    return lines + ([] if topic.imu is None else _about_imu(topic.imu))


def _about_imu(imu: ImuFacts) -> list[str]:
    x, y, z = imu.up
    bound = '' if imu.rest_s else ' at most, measured in motion'
    lines = [
        f'specific force: {imu.mean_force:.2f} m/s^2 on average, mean direction '
        f'({x:+.2f}, {y:+.2f}, {z:+.2f})',
        f'angular rate: up to {imu.max_rate_deg_s:.0f} deg/s',
        f'noise: {imu.angle_random_walk:.2g} deg/sqrt(h), {imu.velocity_random_walk:.2g} '
        f'm/s/sqrt(h){bound}']
    if imu.rest_rate_deg_s is not None and imu.rest_force_error is not None:
        lines.append(
            f'at rest for {imu.rest_s:.0f} s: rate '
            f'({", ".join(f"{rate:+.4f}" for rate in imu.rest_rate_deg_s)}) deg/s, '
            f'specific force {imu.rest_force_error:+.3f} m/s^2 off gravity')
    return [*lines, _about_grade(imu)]


def _about_grade(imu: ImuFacts) -> str:
    if imu.grade_is_sure and imu.grade_covers:
        return f'suits imu_grade {imu.grade}'
    if imu.grade_is_sure:
        return (f'no imu_grade covers this, {imu.grade} comes closest: more noise is measured '
                'while aligning, more bias is not')
    if imu.grade != Config.imu_grade:
        return f'imu_grade: no worse than {imu.grade}'
    return f'imu_grade: never at rest to measure it; {imu.grade} is the default'


def _motion_lines(found: Manoeuvres | None) -> list[str]:
    if found is None:
        return []
    lines = [f'    up to {found.max_speed:.1f} m/s; velocity changes by up to '
             f'{found.largest_change:.1f} m/s within {MANOEUVRE_TIME:g} s']
    if found.starts:
        apart = [found.starts[0]]
        for start in found.starts:
            if start - apart[-1] > MANOEUVRE_TIME:
                apart.append(start)
        lines.append(f'    changes by {MANOEUVRE_SPEED:g} m/s: {len(found.starts)}, at '
                     f'{_listing(apart)} s')
        if apart[0] > MIN_START:
            lines[-1] += f'; --start {apart[0] - MIN_START:.0f} leaves out what came before'
    return lines


def _listing(times: list[float]) -> str:
    return ', '.join([f'{time:.0f}' for time in times[:8]] + ['...'] * (len(times) > 8))


def _number(value: float | None, digits: int) -> str:
    return '-' if value is None else f'{value:.{digits}f}'


def _stated(data: Recorded) -> dict[str, Any]:
    """Return what GNSS messages state of their own quality."""
    stated = np.isfinite(data.sigmas).all(axis=1)
    if not stated.any():
        return {'covariance_share': 0.0 if stated.size else None}
    horizontal, vertical = np.median(data.sigmas[stated], axis=0).tolist()
    return {'covariance_share': float(np.mean(stated)), 'sigma': (horizontal, vertical)}


def _is_refused(data: Recorded) -> bool:
    """Whether an alignment refuses most velocities of a topic for their frame_id."""
    return data.refusals.total() > 0.5 * data.stamps_ns.size


def _says_unmeasured(data: Recorded) -> str:
    return (f'its messages say that it does not measure {" and ".join(data.unmeasured)} '
            '(covariance -1)')


def _frame_faults(frame: VelocityFrame) -> list[str]:
    if frame.frame == 'body':
        return ['its speed fits the change of position and its direction does not: it is given '
                'in the axes of the vehicle or of a start of its own']
    if frame.frame == 'turned':
        return [f'it is turned by {frame.angle_deg:.0f} deg against the change of position: its '
                'axes are not east and north']
    if frame.frame == 'contradiction':
        return [f'it is {frame.speed_ratio:.2g} times the change of position: check its unit']
    return []


def _best(topics: list[TopicInfo]) -> TopicInfo | None:
    """Return the topic to read: without faults, its frame known, the most messages."""
    good = [topic for topic in topics if not topic.faults]
    return max(good, default=None, key=lambda topic: (
        topic.frame is not None and topic.frame.frame in FRAMES_THAT_FIT,
        topic.timing.count * topic.usable_share))


def _first(topics: list[TopicInfo]) -> TopicInfo | None:
    return topics[0] if topics else None


def _heading_in_words(found: Manoeuvres | None) -> str:
    if found is None:
        return 'unknown: there is no GNSS to tell the motion from'
    if found.starts:
        return 'yes: the velocity changes enough'
    if found.largest_change >= WEAK_SPEED:
        return 'weakly: the changes of velocity are small, it takes longer and a good receiver'
    return ('no: turn or change speed (standing, only navigation grade finds north, by the '
            "Earth's rotation)")


def printable(line: str) -> str:
    """Make a line that quotes a recording fit for a terminal."""
    return ''.join(letter if letter.isprintable() else '?' for letter in line)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(content) for key, content in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(content) for content in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
