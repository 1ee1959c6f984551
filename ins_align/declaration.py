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
When an alignment is declared, held back or withdrawn, and why, in words with numbers.

A declared attitude must be right: the stated sigma, inflated by how badly the data fit, must be
under its threshold; the residuals must pass; both must have held for a while.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
import math

from ins_align.config import Config
from ins_align.methods import Fit
from ins_align.rotation import Array


class State(str, Enum):
    """State of an alignment."""

    WAITING_FOR_IMU = 'WAITING_FOR_IMU'
    WAITING_FOR_GNSS = 'WAITING_FOR_GNSS'
    ALIGNING = 'ALIGNING'
    LEVELLED = 'LEVELLED'
    ALIGNED = 'ALIGNED'
    FAULT = 'FAULT'


# Mean square of normalised residuals above which the model is contradicted.
MAX_MISFIT = 4.0
# Share of epochs that may be rejected as outliers.
MAX_REJECTED = 0.25
# Redundant rows before anything is declared.
MIN_DOF = 12
# A delay is to be expected within so many of its sigmas; and further off (s) it is more than a
# correction to the model, whatever the sigma.
DELAY_SIGMAS, MAX_DELAY = 3.0, 0.3
# Epochs over which the latest innovations are averaged.
RECENT = 25


@dataclass(frozen=True)
class Verdict:
    """State and the reason for it."""

    state: State
    reason: str


class Declaration:
    """
    Decides from epoch to epoch.

    Parameters
    ----------
    config : Config
        ``heading_std_threshold``, ``tilt_std_threshold`` and ``hold_time``.

    Attributes
    ----------
    levelled, aligned : bool
        What is declared.
    later_start : bool
        Whether t0 had better move.
    contradicted : bool
        Whether the data contradict the model.

    """

    def __init__(self, config: Config) -> None:
        """Start with nothing declared."""
        self.config = config
        self._level_since_s: float | None = None
        self._heading_since_s: float | None = None
        self.levelled = False
        self.aligned = False
        self.later_start = False
        self.contradicted = False
        self._recent_nis = 1.0
        self._rejected = 0

    def update(self, time_s: float, initial: Array, current: Array, fit: Fit,
               unconfirmed: Callable[[], str]) -> Verdict:
        """
        Judge an epoch.

        Parameters
        ----------
        time_s : float
            Seconds since the first t0.
        initial, current : ndarray, shape (3, 3)
            Covariances of the attitude at t0 and of the one now, in ENU. Both must be good enough;
            where only the present one is, `later_start` says that t0 had better move.
        fit : Fit
            How well the data fit the model.
        unconfirmed : callable
            Asked before a heading is declared: a reason against it in words, or ''.

        Returns
        -------
        Verdict

        """
        nis = fit.innovation.nis
        if math.isfinite(nis):
            self._recent_nis += (min(nis, 10.0) - self._recent_nis) / RECENT
        contradiction = self._contradiction(fit)
        self.contradicted = bool(contradiction)
        factor = fit.factor
        tilt, tilt_now = (math.degrees(_largest_std(P)) * factor for P in (initial, current))
        heading, heading_now = (math.degrees(math.sqrt(P[2, 2])) * factor
                                for P in (initial, current))
        tilt, heading = max(tilt, tilt_now), max(heading, heading_now)
        rejected = fit.rejected_velocity + fit.rejected_position
        just_rejected, self._rejected = rejected > self._rejected, rejected
        good = (not contradiction and not just_rejected and fit.converged
                and fit.dof >= MIN_DOF)
        max_tilt, max_heading = self.config.tilt_std_threshold, self.config.heading_std_threshold
        self._level_since_s = _since(self._level_since_s, time_s, good and tilt <= max_tilt)
        self._heading_since_s = _since(self._heading_since_s, time_s, good
                                       and tilt_now <= max_tilt and heading_now <= max_heading)
        self.later_start = False
        if contradiction:
            self.levelled = self.aligned = False
            return Verdict(State.ALIGNING, contradiction)
        self.levelled = self.levelled or self._held(self._level_since_s, time_s)
        doubt = ''
        if not self.aligned and self._held(self._heading_since_s, time_s):
            doubt = unconfirmed()
            self.aligned = not doubt and tilt <= max_tilt and heading <= max_heading
            self.later_start = not doubt and not self.aligned
        if self.aligned:
            # What was declared stays declared until the data contradict it or its sigma has
            # clearly grown.
            self.aligned = heading <= 2 * max_heading
        if self.levelled:
            self.levelled = tilt <= 2 * max_tilt
        if doubt:
            return Verdict(State.LEVELLED if self.levelled else State.ALIGNING, doubt)
        return self._verdict(tilt, heading, fit)

    def _verdict(self, tilt: float, heading: float, fit: Fit) -> Verdict:
        config = self.config
        if self.aligned:
            return Verdict(State.ALIGNED, f'heading sigma {heading:.2g} deg, '
                                          f'tilt sigma {tilt:.2g} deg{_understated(fit)}')
        if fit.dof < MIN_DOF:
            return Verdict(State.ALIGNING, f'{fit.offered} GNSS epochs so far: more are needed')
        if tilt > config.tilt_std_threshold and not self.levelled:
            return Verdict(State.ALIGNING, f'tilt sigma {tilt:.2g} deg, needs '
                                           f'{config.tilt_std_threshold:g}: wait')
        state = State.LEVELLED if self.levelled else State.ALIGNING
        if heading > config.heading_std_threshold:
            return Verdict(state, f'heading sigma {heading:.2g} deg, needs '
                                  f'{config.heading_std_threshold:g}: turn or change speed')
        if not fit.converged:
            return Verdict(state, f'heading sigma {heading:.2g} deg is good enough: the estimate '
                                  'is still settling')
        return Verdict(state, f'heading sigma {heading:.2g} deg is good enough: it has to hold '
                              f'for {config.hold_time:g} s')

    def _held(self, since_s: float | None, time_s: float) -> bool:
        return since_s is not None and time_s - since_s >= self.config.hold_time - 1e-6

    def _contradiction(self, fit: Fit) -> str:
        """Return what in the data contradicts the model; empty when nothing does."""
        if fit.dof < MIN_DOF:
            return ''
        rejected = fit.rejected_velocity + fit.rejected_position
        if rejected > MAX_REJECTED * fit.offered:
            return (f'{rejected} of {fit.offered} GNSS epochs do not fit the rest: check the '
                    'velocity frame, the IMU axes and signs, the lever arm, the GNSS delay')
        config = self.config
        unexplained = abs(fit.delay - config.gnss_delay)
        if unexplained > min(DELAY_SIGMAS * config.gnss_delay_std, MAX_DELAY) > 0:
            return (f'the GNSS stamps seem to be {fit.delay:.2f} s late, gnss_delay is '
                    f'{config.gnss_delay:g} and gnss_delay_std {config.gnss_delay_std:g}: check '
                    'the clocks, or set gnss_delay')
        misfit = max(fit.chi2 / fit.dof, self._recent_nis)
        if misfit > MAX_MISFIT:
            return (f'the residuals are {math.sqrt(misfit):.1f} times what the stated noise '
                    'allows: check the lever arm, the GNSS delay, the velocity frame, the IMU '
                    'axes and signs, the covariances that the receiver states')
        return ''


def _understated(fit: Fit) -> str:
    """Return what a receiver states too little of, as the end of a sentence."""
    return ''.join(f'; the GNSS {name} are {math.sqrt(factor):.1f} times as noisy as stated'
                   for name, factor in zip(('velocities', 'positions'), fit.gnss_noise)
                   if factor > 1.0)


def _largest_std(P: Array) -> float:
    """Largest sigma about a horizontal axis: from the larger eigenvalue of the leading 2 x 2."""
    (a, b), (_, c) = P[:2, :2].tolist()
    return math.sqrt(0.5 * (a + c) + math.hypot(0.5 * (a - c), b))


def _since(since_s: float | None, time_s: float, good: bool) -> float | None:
    """Return since when something has been good."""
    if not good:
        return None
    return time_s if since_s is None else since_s
