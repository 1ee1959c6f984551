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
"""Alignment of recorded data: `replay` for recordings, `align` for arrays."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import repeat
import os
from typing import Any

from ins_align.aligner import Aligner
from ins_align.config import Config, config_from_mapping, ConfigError, STANDARD_GRAVITY
from ins_align.geometry.rotation import Array, Index, Transform
from ins_align.gnss.messages import (
    Fix, fix_from_numbers, numbers_of, usable, Velocity, velocity_from_numbers)
from ins_align.gnss.motion import differences, series_of, series_of_rows, track
from ins_align.imu.buffer import MAX_GAP_NS
from ins_align.recordings.motion_fit import fit_motion, MAX_DELAY_STD
from ins_align.results import Epoch, in_order_of_time, Reference, Result, State
import numpy as np
from numpy.typing import ArrayLike

# `Aligner.update` is called after so many messages: an epoch costs less among many.
MESSAGES = 2500
# Stamps given as seconds are below this (ns), unless they are nanoseconds by mistake.
MAX_STAMP_NS = 9e18
# GNSS stamps that are closer on average were not given as nanoseconds.
MIN_INTERVAL_NS = 1_000_000


class _Run:
    """Passes recorded messages to an aligner and collects the epochs."""

    def __init__(self, config: Config, base: Transform | None = None) -> None:
        self._config = config
        self._aligner = Aligner(config, base)
        self._epochs: list[Epoch] = []
        self._waiting = 0

    def add(self, stamps_ns: Index, gyro: Array, accel: Array,
            gnss: Sequence[tuple[int, Fix | Velocity | tuple[str, str]]],
            undecodable: int = 0) -> None:
        """
        Take consecutive messages.

        IMU samples have the shapes (N,), ns, and (N, 3), rad/s and m/s^2; `undecodable` counts IMU
        messages without a sample. Each GNSS message comes with the number of these samples before
        it; one that cannot be used is replaced by the arguments of `Aligner.reject`.
        """
        aligner, position = self._aligner, 0
        for _ in range(undecodable):
            aligner.reject('imu_undecodable')
        for before, message in (*gnss, (len(stamps_ns), None)):
            self._waiting += before - position + 1
            if before > position:
                between = slice(position, before)
                aligner.add_imu(stamps_ns[between], gyro[between], accel[between])
                position = before
            if self._waiting >= MESSAGES:
                self._epochs += aligner.update(dry=True)
                self._waiting = 0
            if isinstance(message, Fix):
                aligner.add_fix(message)
            elif isinstance(message, Velocity):
                aligner.add_velocity(message)
            elif message is not None:
                aligner.reject(*message)

    def result(self, **of_recording: Any) -> Result:
        """Process the rest and return the result."""
        self._epochs += self._aligner.flush(dry=True)
        return Result(config=self._config, status=self._aligner.status(),
                      epochs=in_order_of_time(self._epochs), **of_recording)


def replay(path: str | os.PathLike[str], config: Config | None = None, *,
           imu_topic: str | None = None, fix_topic: str | None = None,
           velocity_topic: str | None = None,
           start: float | None = None, duration: float | None = None,
           progress: Callable[[float], None] | None = None) -> Result:
    """
    Align a recording.

    Parameters
    ----------
    path : path
        rosbag2 directory or file, ROS 1 bag.
    config : Config, optional
        By default `Config()`.
    imu_topic, fix_topic, velocity_topic : str, optional
        Where there is more than one candidate.
    start, duration : float, optional
        Part of the recording, seconds from its start, by recorded time.
    progress : callable, optional
        Called with the share that has been read, 0 to 1.

    Returns
    -------
    Result

    Raises
    ------
    BagError
        If the recording cannot be read, lacks a topic, or has no messages in the part asked for.

    """
    from ins_align.recordings.reader import read  # needs rosbags, `align` does not

    run: _Run | None = None
    fixes: list[tuple[int, float, float]] = []
    references: list[tuple[np.ndarray, np.ndarray]] = []
    for part in read(path, config or Config(), imu_topic, fix_topic, velocity_topic, start,
                     duration):
        run = run or _Run(part.config, part.topics.base)
        run.add(part.imu.stamps_ns, part.imu.gyro, part.imu.accel, part.gnss,
                int(np.count_nonzero(~part.imu.decoded)))
        fixes += [(message.stamp_ns, message.latitude_deg, message.longitude_deg)
                  for _, message in part.gnss
                  if isinstance(message, Fix) and not usable(message)[1]]
        references.append(part.reference.orientations()[:2])
        if progress is not None:
            progress(part.done)
    assert run is not None
    return run.result(
        bag=str(path), warnings=part.warnings, topics=part.topics,
        reference=Reference(*references) if any(
            stamps_ns.size for stamps_ns, _ in references) else None,
        track=np.array(fixes, float).reshape(-1, 3))


def align(stamps: ArrayLike, gyro: ArrayLike, accel: ArrayLike,
          fixes: ArrayLike | Sequence[Fix],
          velocities: ArrayLike | Sequence[Velocity] | None = None, **config: Any) -> Result:
    """
    Align arrays.

    Parameters
    ----------
    stamps : array_like, shape (N,)
        Stamps of the IMU samples: seconds, or nanoseconds if they are integers.
    gyro, accel : array_like, shape (N, 3)
        Angular rate, rad/s, and specific force, m/s^2, forward-left-up.
    fixes : array_like, shape (K, 4), (K, 7) or (K, 13); or sequence of Fix
        Columns: stamp, in the unit and on the clock of `stamps`; latitude, longitude, degrees;
        altitude, m; if known three standard deviations, m, or nine covariances, m^2,
        east-north-up.
    velocities : array_like, shape (L, 4), (L, 7) or (L, 13); or sequence of Velocity; or None
        Columns: stamp; east, north, up, m/s; if known three standard deviations, m/s, or nine
        covariances, m^2/s^2.
    **config
        Parameters by name: ``lever_arm=(1.0, 0.0, 0.5)``.

    Returns
    -------
    Result
        ``initial`` and ``current``, the attitudes at t0 and at the last epoch, with covariances;
        ``aligned``, ``status`` with the reason in words, ``epochs``. Rows with nan or masked
        numbers are left out and counted in ``status.counts``.

    Raises
    ------
    ConfigError
        If a parameter is not known, its value is wrong, or it needs a recording.
    ValueError
        If an array has the wrong shape, or its stamps are not finite, in another unit, out of
        order by more than ``gnss_lateness``, or on another clock than those of the IMU.

    """
    settings = config_from_mapping(config)
    if settings.base_frame or settings.lever_arm_from_tf is True:
        raise ConfigError('base_frame and lever_arm_from_tf need the transforms of a recording, '
                          'which arrays do not have: leave them out, and set lever_arm')
    unit_ns = 1.0 if np.asarray(stamps).dtype.kind in 'iu' else 1e9
    stamps_ns = _nanoseconds('the IMU', np.ma.asarray(stamps), unit_ns)
    rates, forces = _numbers('gyro', gyro), _numbers('accel', accel)
    for name, array in (('gyro', rates), ('accel', forces)):
        if stamps_ns.ndim != 1 or array.shape != (stamps_ns.size, 3):
            raise ValueError(f'{name} has the shape {array.shape} and stamps {stamps_ns.shape}: '
                             'they must be (N, 3) and (N,)')
    _check_order(stamps_ns, settings.gnss_lateness)
    gnss: list[Any] = []
    for name, given, kind in (('fixes', fixes, Fix), ('velocities', velocities, Velocity)):
        if given is not None:
            found = _messages(name, given, kind, unit_ns, settings)
            delay_ns = round(settings.gnss_delay * 1e9)
            _check_clock(name, [message.stamp_ns - delay_ns for message in found], stamps_ns)
            gnss += found
    gnss.sort(key=lambda message: message.stamp_ns)
    # Each message follows the IMU samples up to its stamp.
    before = np.searchsorted(np.maximum.accumulate(stamps_ns),
                             [message.stamp_ns for message in gnss], side='right')
    run = _Run(settings)
    run.add(stamps_ns, rates, forces, list(zip(before.tolist(), gnss)))
    result = run.result()
    if result.status.state in (State.ALIGNING, State.LEVELLED) and (
            delay := _other_delay(stamps_ns, np.hstack([rates, forces]), gnss, settings)):
        result = replace(result, status=replace(
            result.status, reason=f'{delay}; {result.status.reason}'))
    return result


def _other_delay(stamps_ns: Index, samples: Array, gnss: Sequence[Fix | Velocity],
                 config: Config) -> str:
    """Return in words that the motion shows another GNSS delay, or ''; samples are (N, 6)."""
    good, start_ns = np.isfinite(samples).all(axis=1), stamps_ns.min()
    velocities, positions = (series_of_rows(
        [((message.stamp_ns - start_ns) * 1e-9, *numbers_of(message))
         for message, fault in map(usable, gnss) if isinstance(message, kind) and not fault])
        for kind in (Velocity, Fix))
    motion = velocities if velocities.times.size else differences(track(positions))
    found = fit_motion(series_of((stamps_ns[good] - start_ns) * 1e-9, samples[good]), motion,
                       STANDARD_GRAVITY)
    if 'gnss_delay' not in found:
        return ''
    delay = found['gnss_delay']
    if abs(delay - config.gnss_delay) < 3.0 * max(config.gnss_delay_std, MAX_DELAY_STD):
        return ''
    return (f'the motion fits GNSS stamps that are {delay:.2f} s late: check the clocks, or '
            f'set gnss_delay={delay:.2f}')


def _numbers(name: str, given: Any) -> Array:
    """Return an array of floats, with nan for what is masked."""
    try:
        return np.asarray(np.ma.filled(np.ma.asarray(given, float), np.nan))
    except (TypeError, ValueError) as error:
        raise ValueError(f'{name} must be numbers in rows of the same length ({error}); times are '
                         'seconds, or integer nanoseconds') from None


def _nanoseconds(name: str, stamps: np.ndarray, unit_ns: float) -> Index:
    if stamps.dtype.kind not in 'iu' or np.ma.is_masked(stamps):
        stamps = np.round(_numbers(f'the stamps of {name}', stamps) * unit_ns)
        if not np.all(np.abs(stamps) < MAX_STAMP_NS):
            raise ValueError(f'the stamps of {name} must be seconds, or nanoseconds if those of '
                             'the IMU are integers, without nan and none of them masked')
    return np.asarray(stamps).astype(np.int64)


def _check_order(stamps_ns: Index, lateness: float) -> None:
    """Raise ValueError if stamps of the IMU are too far apart or too far out of order."""
    intervals_ns = np.diff(np.unique(stamps_ns))
    if intervals_ns.size and np.median(intervals_ns) > MAX_GAP_NS:
        raise ValueError(f'the samples of the IMU are {np.median(intervals_ns) * 1e-9:.6g} s '
                         f'apart, where {MAX_GAP_NS * 1e-9:g} s are allowed: its stamps must be '
                         'seconds, or nanoseconds if they are integers')
    behind = np.maximum.accumulate(stamps_ns) - stamps_ns
    if np.any(behind > lateness * 1e9):
        row = int(np.argmax(behind > lateness * 1e9))
        raise ValueError(f'the stamps of the IMU go back by {behind[row] * 1e-9:.6g} s at row '
                         f'{row}: sort all its rows by stamp, or align the parts one by one '
                         'if the clock was set back')


def _check_clock(name: str, gnss_ns: list[int], imu_ns: Index) -> None:
    """Raise ValueError if the times of a GNSS array and of the IMU do not overlap."""
    if not gnss_ns or not imu_ns.size:
        return
    first, last, imu_first, imu_last = (
        bound * 1e-9 for bound in (min(gnss_ns), max(gnss_ns), imu_ns.min(), imu_ns.max()))
    if first > imu_last or last < imu_first:
        raise ValueError(f'the stamps of {name} ({first:.3f} to {last:.3f} s) and of the IMU '
                         f'({imu_first:.3f} to {imu_last:.3f} s) have no time in common: give '
                         'both by one clock, with the offset between the clocks taken off')


def _messages(name: str, given: Any, kind: type, unit_ns: float, config: Config) -> list[Any]:
    """Return fixes or velocities, from messages or from a table."""
    if len(given) == 0:
        return []
    if all(isinstance(message, kind) for message in given):
        return list(given)
    table = _numbers(name, given)
    if table.ndim != 2 or table.shape[1] not in (4, 7, 13):
        columns = 'latitude, longitude, altitude' if kind is Fix else 'east, north, up'
        raise ValueError(f'{name} have the shape {table.shape}: it must be (K, 4), (K, 7) or '
                         f'(K, 13), with stamp, {columns}, and three standard deviations or nine '
                         'covariances if they are known')
    stamps_ns = _nanoseconds(name, table[:, 0], unit_ns)
    if unit_ns == 1.0 and 0 < np.ptp(stamps_ns) < len(table) * MIN_INTERVAL_NS:
        raise ValueError(f'the stamps of {name} must be nanoseconds, as those of the IMU, which '
                         'are integers: they look like another unit')
    covariances: Iterable[Any] = repeat(None)
    if table.shape[1] == 7:
        # The square keeps the sign: a negative one means that it is not known.
        covariances = [np.diag(std * np.abs(std)) for std in table[:, 4:]]
    elif table.shape[1] == 13:
        covariances = table[:, 4:]
    make = fix_from_numbers if kind is Fix else partial(velocity_from_numbers, config)
    return [make(*row) for row in zip(stamps_ns, table[:, 1:4], covariances)]
