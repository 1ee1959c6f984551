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
"""What a recording holds, found without an alignment, and the command that aligns it."""

import dataclasses
from dataclasses import dataclass
from datetime import datetime, timezone
import math
import os
import re
import shlex
from typing import Any

from ins_align.checks import (
    BEYOND_THE_POLES, beyond_the_poles, exchange_fault, lateness_advice, MAX_DELAY, MAX_LATENESS)
from ins_align.config import Config, config_from_mapping, ConfigError
from ins_align.estimation.receiver import QUIET
from ins_align.geometry.earth import normal_gravity
from ins_align.gnss.messages import enu_from_ned
from ins_align.gnss.motion import (
    differences, EMPTY, find_manoeuvres, MANOEUVRE_SPEED, MANOEUVRE_TIME, on_grid, Series,
    SHARP_STD, track, velocity_frame, velocity_from_positions, without_wild_positions)
from ins_align.imu.buffer import MAX_GAP_NS
from ins_align.recordings import BagError, printable
from ins_align.recordings.bag import Bag
from ins_align.recordings.decode import short_name
from ins_align.recordings.motion_fit import fit_motion
from ins_align.recordings.reader import choose_topics
from ins_align.recordings.survey import (
    read_candidates, Recorded, rounded, set_arguments, survey_imu, Surveyed)
from ins_align.report import format_table
import numpy as np

WEAK_CHANGE = 1.0  # m/s: smaller changes of velocity show no heading with a usual receiver
MIN_RATE, LOW_RATE = 1e9 / MAX_GAP_NS, 20.0  # Hz
# Names of topics with the output of a filter, whose errors last and which is not at the antenna.
FUSED = re.compile(r'(^|[/_])(ekf|ukf|filter|filtered|fused)([/_]|$)', re.IGNORECASE)
MIN_AHEAD = 0.3  # s: a smaller difference of clocks may be jitter
MIN_DELAY, DELAY_SIGMAS = 0.05, 2.0  # s, sigmas: a delay beyond the sum of both is set
MAX_STRETCH = 0.06  # of velocities against the change of position, which is worth a word
FRAMES_THAT_FIT = ('enu', 'ned')
FRAME_FAULTS = {
    'body': 'its speed fits the change of position and its direction does not: it is given in the '
            'axes of the vehicle or of a start of its own, or the receiver is wrong',
    'turned': 'it is turned by {0.angle_deg:.0f} deg against the change of position: its axes are '
              'not east and north',
    'contradiction': 'it is {0.speed_ratio:.2g} times the change of position: check its unit'}
# Columns of the table of topics: title and format by figure.
COLUMNS = {
    'messages': ('messages', ''), 'rate_hz': ('Hz', '.1f'), 'first_s': ('from, s', '.1f'),
    'last_s': ('to, s', '.1f'), 'stamp_age_s': ('stamp age, s', '.3f'),
    'stamp_age_spread_s': ('spread, s', '.3f'), 'gaps': ('gaps', ''),
    'longest_gap_s': ('longest, s', '.1f'), 'longest_gap_start_s': ('at, s', '.1f')}
NOT_LOOKED_FOR = (
    'not looked for: scale factors and axes of the IMU (gyro_scale_std), biases across gravity, '
    'slow errors of the GNSS')


@dataclass
class Info(Surveyed):
    """Findings about a recording; the faults say why it cannot be aligned."""

    bag: str
    duration_s: float
    start_ns: int
    topics: tuple[Recorded, ...]
    chosen: dict[str, str | None]  # the topics that the command reads, by kind
    command: str | None = None  # that aligns it, quoted for a shell; None if it cannot be aligned
    warnings: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the object that ``--json`` writes."""
        return dataclasses.asdict(self)


def inspect(path: str | os.PathLike[str]) -> Info:
    """Survey a recording; raises a BagError if it cannot be read at all."""
    with Bag(path) as bag:
        candidates = read_candidates(bag)
        imus, fixes, velocities = (
            [data for data in candidates if data.kind == kind]
            for kind in ('imu', 'fix', 'velocity'))
        positions, gravity, sharp = _survey_fixes(fixes, velocities)
        for data in velocities:
            if data.stamps_ns.size:
                _survey_velocity(data, positions, sharp)
        motion, grid = differences(positions), velocity_from_positions(positions)
        if (velocity := _best(velocities)) is not None:
            motion = velocity.series()
            if velocity.figures.get('frame') == 'ned':
                motion = Series(motion.times, enu_from_ned(motion.vectors))
            grid = on_grid(motion)
        for data in imus:
            if data.stamps_ns.size:
                _survey_imu(data, grid, gravity, alone=len(imus) == 1)
        imu, fix = (_best(of_kind) or next(iter(of_kind), None) for of_kind in (imus, fixes))
        chosen = {'imu': imu, 'fix': fix, 'velocity': velocity}
        # Messages may be later than the end that a damaged file states.
        end_ns = max([bag.end_ns, *(
            int(data.recorded_ns.max()) for data in candidates if data.recorded_ns.size)])
        info = Info(str(bag.path), (end_ns - bag.start_ns) * 1e-9, bag.start_ns,
                    (*imus, *fixes, *velocities),
                    {kind: data and data.name for kind, data in chosen.items()})
        _add_manoeuvres(info, grid)
        for data in filter(None, chosen.values()):
            if data.kind != 'imu' and FUSED.search(data.name):
                info.add(f'{data.name} is the output of a filter, by its name: an alignment needs '
                         'the measurements of a receiver, at its antenna')
            if data.faults:
                info.add(f'{data.name} cannot be used: {data.faults[0]}', fault=True)
        if velocity is None and fix is not None and not fix.faults:
            info.add('there is no velocity that can be used: it is aligned from positions alone, '
                     'which takes longer unless they are RTK',
                     {'use_velocity': False} if velocities else {})
        gnss = [data for data in (fix, velocity) if data is not None]
        if imu is not None and gnss:
            _add_clocks(info, imu, gnss)
            if not info.faults:
                _add_timing(info, imu, gnss, motion, gravity)
        _propose(info, bag, chosen)
    return info


def _survey_fixes(fixes: list[Recorded], velocities: list[Recorded],
                  ) -> tuple[Series, float, bool]:
    """
    Check positions; return the best track, without outliers, and gravity there, m/s^2.

    The third value says whether the positions are sharp, see `velocity_frame`.
    """
    for data in fixes:
        if data.stamps_ns.size and not data.usable.any():
            beyond = [beyond_the_poles(*place) for place in data.values[:, :2].tolist()]
            fault = 'no message has a fix and numbers that can be used'
            if data.figures['no_fix_share'] == 1.0:
                fault = 'no message has a fix'
            elif np.mean(beyond) > 0.5:
                fault = BEYOND_THE_POLES
            data.add(fault, fault=True)
    fix = _best(fixes)
    if fix is None:
        return EMPTY, 9.81, False
    for velocity in velocities:
        if not velocity.doubt and (
                fault := exchange_fault(fix.series(), velocity.series())):
            fix.add(fault, fault=True)
            fix.values = fix.values[:, [1, 0, 2]]
            break
    positions_deg = fix.series()
    latitude, _, altitude = np.median(positions_deg.vectors, axis=0).tolist()
    return (without_wild_positions(track(positions_deg)),
            float(normal_gravity(math.radians(latitude), altitude)),
            fix.figures.get('sigma', [math.inf])[0] <= SHARP_STD)


def _survey_velocity(data: Recorded, positions: Series, sharp: bool) -> None:
    """Find the frame of a velocity, and why it cannot be used."""
    if not data.usable.any():
        data.add('no message has numbers that can be used', fault=True)
        return
    frame = velocity_frame(data.series(), positions, sharp)
    name = frame.frame
    data.add('', frame=name, speed_ratio=frame.speed_ratio)
    if name in FRAMES_THAT_FIT:
        ratio = frame.speed_ratio or 1.0
        stretched = '' if abs(ratio - 1.0) < MAX_STRETCH else (
            f', but is {ratio:.2f} times as long: check the unit and the rate of the clock')
        data.add(f'frame: {name} (fits the change of position over {frame.windows} distances'
                 f'{stretched})', {'velocity_frame': name} if name == 'ned' or data.doubt else {})
    elif data.doubt:
        data.add(data.doubt, fault=True)
    if name in FRAME_FAULTS:
        data.add(FRAME_FAULTS[name].format(frame), fault=True)
    elif name not in FRAMES_THAT_FIT:
        data.add('frame: not known, too little motion: it is taken as east-north-up')
    moved = (data.values[data.usable] != 0.0).any(axis=0)
    if moved[:2].any() and not moved[2]:
        always = 'always 0' if data.figures['vertical_share'] else 'none'
        data.add(f'vertical velocity: {always}', {'velocity_vertical': 'absent'})


def _survey_imu(data: Recorded, motion: Series, gravity: float, alone: bool) -> None:
    """Survey an IMU, and find why it cannot be used; `motion`: GNSS velocities on a grid."""
    if data.doubt:
        data.add(data.doubt + ('; its numbers are used all the same' if alone else ''),
                 fault=not alone)
    rate, gap = (data.figures.get(name) for name in ('rate_hz', 'longest_gap_s'))
    if rate is not None and rate < MIN_RATE:
        data.add(f'its rate is {rate:.2g} Hz: an alignment starts over after '
                 f'{MAX_GAP_NS * 1e-9:g} s without a sample', fault=True)
    elif gap is not None and gap > MAX_GAP_NS * 1e-9:
        data.add(f'silent for {gap:.1f} s at {data.figures["longest_gap_start_s"]:.1f} s: an '
                 'alignment starts over after that')
    if rate is not None and MIN_RATE <= rate < LOW_RATE:
        data.add(f'its rate is {rate:.2g} Hz: what happens between two samples is lost; 50 Hz and '
                 'more follow vehicles that turn or shake')
    survey_imu(data, data.series(), motion, gravity)


def _best(topics: list[Recorded]) -> Recorded | None:
    """Return the topic without faults to read: a receiver's, with the most usable messages."""
    good = [data for data in topics if not data.faults]
    return max(good, default=None, key=lambda data: (
        data.figures.get('frame') in FRAMES_THAT_FIT, not data.doubt,
        not FUSED.search(data.name), np.count_nonzero(data.usable)))


def _add_manoeuvres(info: Info, velocities: Series) -> None:
    """Add how the vehicle moves and whether its motion shows the heading."""
    if velocities.times.size < 2:
        info.add('heading from the motion: unknown: there is no GNSS, or too little, to '
                 'tell the motion from')
        return
    largest, first = find_manoeuvres(velocities)
    shown = ('no: turn or change speed (standing, only navigation grade finds north, by the '
             "Earth's rotation)")
    if first is not None:
        shown = 'yes: the velocity changes enough'
    elif largest >= WEAK_CHANGE:
        shown = 'weakly: the changes of velocity are small, it takes longer and a good receiver'
    info.add(f'heading from the motion: {shown}')
    speed = float(np.hypot(*velocities.vectors[:, :2].T).max())
    info.add(f'up to {speed:.1f} m/s; velocity changes by up to {largest:.1f} m/s within '
             f'{MANOEUVRE_TIME:g} s', max_speed=speed, largest_change=largest)
    info.add('' if first is None else
             f'the first change by {MANOEUVRE_SPEED:g} m/s is at {first:.0f} s',
             first_manoeuvre_s=first)


def _add_clocks(info: Info, imu: Recorded, gnss: list[Recorded]) -> None:
    """Add a fault for each GNSS topic whose clock is not that of the IMU."""
    for data in gnss:
        age = data.age_s - imu.age_s
        if data.stamps_ns.size and abs(age) >= MAX_DELAY:
            info.add(f'the stamps of {data.name} are {abs(age):.1f} s '
                     f'{"behind" if age > 0.0 else "ahead of"} those of {imu.name}: they are of '
                     'different clocks', fault=True)


def _add_timing(info: Info, imu: Recorded, gnss: list[Recorded], motion: Series, gravity: float,
                ) -> None:
    """Add delay and lateness of GNSS messages against the IMU, and the noise of velocities."""
    source = gnss[-1]
    apart = imu.age_s - source.age_s
    lateness, behind = _lateness(imu, gnss), 0.0
    found = fit_motion(imu.series(), Series(motion.times + apart, motion.vectors), gravity,
                       (0.0, apart) if abs(apart) >= MIN_AHEAD else (0.0,))
    info.add('', gnss_lateness=lateness, **found)
    ahead = min(imu.age_s - data.age_s for data in gnss)
    if 'gnss_delay' in found:
        delay, std = found['gnss_delay'], found['gnss_delay_std']
        least = MIN_DELAY + DELAY_SIGMAS * std
        info.add(f'delay of the GNSS against the IMU: {delay:+.2f} s +- {max(std, 0.01):.2f} s, '
                 'as the motion of the IMU shows',
                 {'gnss_delay': round(delay, 2)} if abs(delay) > least else {})
        if delay < -least:  # the alignment itself adds a delay above 0 to gnss_lateness
            behind = delay
    elif ahead >= MIN_AHEAD:
        info.add(f'the stamps of GNSS messages are {ahead:.1f} s ahead of those of the IMU: their '
                 'clocks differ, which gnss_delay corrects as far as messages were recorded at '
                 'once', {'gnss_delay': round(ahead, 1)})
    # A fit with wrong forces shows their error as noise of the velocity.
    if (source.kind == 'velocity' and 'velocity_noise' in found
            and 'force_lacks' not in imu.figures):
        _add_velocity_noise(info, source)
    if Config.gnss_lateness < lateness + behind < MAX_LATENESS:
        text, value = lateness_advice(lateness + behind, behind)
        info.add(text, {'gnss_lateness': float(value)})


def _add_velocity_noise(info: Info, velocity: Recorded) -> None:
    """Add the noise of velocities; set it if most of them state no covariance."""
    noise = [info.figures['velocity_noise'], info.figures['velocity_noise_vertical']]
    names = ['velocity_std', 'velocity_std_vertical']
    if 'velocity_vertical' in velocity.settings:
        names.pop()
    settings = {name: rounded(max(std, 1e-3)) for name, std in zip(names, noise)}
    stated = velocity.figures['covariance_share'] >= 0.5
    quiet = stated and noise[0] < math.sqrt(QUIET) * velocity.figures['sigma'][0]
    info.add(f'noise of the GNSS velocity: {noise[0]:.2g} m/s horizontally, {noise[1]:.2g} m/s '
             'vertically' + (', much less than stated: this counts in motion' if quiet else ''),
             {} if stated else settings)


def _lateness(imu: Recorded, gnss: list[Recorded]) -> float:
    """Return by how much GNSS stamps lag the newest IMU stamp on arrival, 99th percentile, s."""
    newest = np.maximum.accumulate(imu.stamps_ns[imu.usable])
    late = [np.zeros(1)]
    for data in gnss:
        before = np.searchsorted(imu.recorded_ns[imu.usable], data.recorded_ns[data.usable]) - 1
        late.append((newest[before] - data.stamps_ns[data.usable])[before >= 0] * 1e-9)
    return float(np.quantile(np.concatenate(late), 0.99))


def _propose(info: Info, bag: Bag, chosen: dict[str, Recorded | None]) -> None:
    """Set the command and try its choice of topics; add a fault if there can be none."""
    arguments = ['ins_align', 'replay', info.bag if info.bag[0] != '-' else f'./{info.bag}']
    names: dict[str, str] = {}
    settings: dict[str, Any] = {}
    for kind, data in chosen.items():
        if data is None:
            continue
        settings |= data.settings
        if sum(other.kind == kind for other in info.topics) > 1:
            names[kind] = data.name
            arguments += [f'--{kind}-topic', data.name]
    settings |= info.settings
    for setting in set_arguments(settings):
        arguments += ['--set', setting]
    try:
        choose_topics(bag, config_from_mapping(settings), **names)
    except (BagError, ConfigError) as error:    # no such topic; a setting beyond its limits
        info.add(str(error), fault=True)
    info.warnings = tuple(bag.warnings)
    info.command = None if info.faults else shlex.join(arguments)


def describe(info: Info) -> str:
    """Return what ``ins_align info`` prints of a recording."""
    recorded = datetime.fromtimestamp(info.start_ns * 1e-9, timezone.utc)
    lines = [info.bag,
             f'  {info.duration_s:.1f} s, recorded from {recorded:%Y-%m-%d %H:%M:%S} UTC']
    if info.topics:
        lines += ['', format_table(list(map(_row, info.topics)), [
            'topic', 'type', *(title for title, _ in COLUMNS.values())], '  ')]
    for topic in info.topics:
        lines += ['', f'  {topic.name}',
                  *(f'    cannot be used: {fault}' for fault in topic.faults),
                  *(f'    {line}' for line in topic.lines)]
    lines += ['', '  together', *(f'    {line}' for line in info.lines)]
    if info.command is None:
        lines += ['', '  it cannot be aligned', *(f'    - {fault}' for fault in info.faults)]
    else:
        lines += [f'    {NOT_LOOKED_FOR}', '',
                  '  to align it, with the lever arm added unless /tf_static has it: '
                  '--lever-arm X Y Z',
                  f'    {info.command}']
    return '\n'.join(printable(line) for text in lines for line in text.split('\n'))


def _row(topic: Recorded) -> list[str]:
    figures = topic.figures
    return [topic.name, short_name(topic.msgtype), *(
        '-' if (value := figures.get(name)) is None else format(value, digits)
        for name, (_, digits) in COLUMNS.items())]
