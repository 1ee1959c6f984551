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

An attitude is declared when its sigma, inflated where the data fit badly, has been below its
threshold and the residuals have been within limits for the hold time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math

from ins_align.config import Config
from ins_align.geometry.rotation import Array
from ins_align.results import State, Verdict
import numpy as np

# Mean square of normalised residuals above which the model is contradicted.
MAX_MISFIT = 4.0
# Share of epochs that may be rejected as outliers.
REJECTED_SHARE = 0.25
# What was declared is withdrawn when its sigma is so many times the threshold, or the delay so
# many times as far from the configured one as a delay may be for a declaration.
WITHDRAWN_AT = 2.0
# Redundant rows before anything is declared.
MIN_ROWS = 12
# A delay is to be expected within so many of its sigmas.
DELAY_SIGMAS = 3.0
# The hold time begins again after a longer time without GNSS (s).
MAX_SILENCE = 30.0
# After so many seconds a reason says that a sigma within so many times its threshold may do.
PATIENCE, ACCEPTABLE = 60.0, 4.0


@dataclass(frozen=True)
class Fit:
    """How well the data fit the model of a method."""

    offered: int  #: epochs with a measurement since the start, rejected ones included
    measured: bool = True  #: whether a measurement of the present epoch is used, or rejected
    waiting: int = 0  #: epochs that wait for a start, not offered yet
    rows: int = 0  #: redundant rows; 0 before there is a solution
    misfit: float = math.nan  #: mean square of normalised residuals
    #: (3,), of the velocity (of the position where only that is used) over its sigma.
    innovation: Array = field(default_factory=lambda: np.full(3, math.nan))
    rejected: int = 0  #: epochs with a measurement that was rejected as an outlier
    delay: float = 0.0  #: of the GNSS, s; the configured one where none is estimated
    delay_std: float = 0.0  #: sigma, s, that the likeliest hypothesis gives it at least
    objection: str = ''  #: what the data say against the configuration, in words
    doubt: str = ''  #: what speaks against declaring a heading, in words
    remarks: str = ''  #: how the sensors differ from the configuration, as the end of a sentence


class Declaration:
    """Decides at each epoch, by the two thresholds and the hold time of the configuration."""

    def __init__(self, config: Config) -> None:
        """Start with nothing declared."""
        self.config = config
        self._level_since_s: float | None = None
        self._heading_since_s: float | None = None
        self.levelled = False               # what is declared
        self.aligned = False
        self.move_t0 = False                # whether t0 should move to now
        self._against = ''                  # what spoke against a declaration at the last epoch
        self._contradiction = ''            # at the last epoch with redundancy
        self._rejected = 0
        self._time_s = 0.0                  # of the last epoch with a measurement

    def update(self, time_s: float, silent_s: float, covariances: Sequence[Array],
               fit: Fit) -> Verdict:
        """
        Judge an epoch, `time_s` seconds after the first one of the alignment.

        `silent_s` are the seconds since the last measurement: at an epoch without one nothing is
        declared, but it may be withdrawn. `covariances`, (3, 3), are those of the attitude at t0
        and of that now, in ENU; there are none where there is no attitude, or none any more. Both
        must be good enough; where only that now is, `move_t0` is set.
        """
        self.move_t0 = False
        silence = f'; no GNSS for {silent_s:.0f} s' if silent_s else ''
        if not covariances:
            self.withdraw()
            return Verdict(State.ALIGNING, (fit.doubt or self._too_few(fit)) + silence)
        (tilt, heading), now = map(_sigmas_deg, covariances)
        tilt, heading = max(tilt, now[0]), max(heading, now[1])
        if not silent_s:
            self._time_s = time_s
            self._declare(tilt, heading, *now, fit)
        elif silent_s > MAX_SILENCE:
            self._level_since_s = self._heading_since_s = None
        self._withdraw_lost(tilt, heading)
        verdict = self._verdict(tilt, heading, fit)
        return Verdict(verdict.state, (self._against or verdict.reason) + silence)

    def _declare(self, tilt: float, heading: float, tilt_now: float, heading_now: float,
                 fit: Fit) -> None:
        """Declare what has been good enough for the hold time, unless something is against it."""
        self._against = self._contradicted_by(fit)
        if fit.rows >= MIN_ROWS:
            self._contradiction = self._against
        just_rejected, self._rejected = fit.rejected > self._rejected, fit.rejected
        good = not self._against and not just_rejected and fit.rows >= MIN_ROWS
        max_tilt, max_heading = self.config.tilt_std_threshold, self.config.heading_std_threshold
        self._level_since_s = self._since(self._level_since_s, good and tilt <= max_tilt)
        self._heading_since_s = self._since(self._heading_since_s, good and tilt_now <= max_tilt
                                            and heading_now <= max_heading)
        if self._against:
            self.withdraw()
        self.levelled = self.levelled or self._held(self._level_since_s)
        if not self.aligned and self._held(self._heading_since_s):
            self._against = fit.doubt
            self.aligned = not fit.doubt and tilt <= max_tilt and heading <= max_heading
            self.move_t0 = not fit.doubt and not self.aligned

    def withdraw(self) -> None:
        """Withdraw all that is declared; the hold time begins again."""
        self.levelled = self.aligned = False
        self._level_since_s = self._heading_since_s = None

    def _withdraw_lost(self, tilt: float, heading: float) -> None:
        """Withdraw what is declared when its sigma has grown to a multiple of the threshold."""
        max_tilt = WITHDRAWN_AT * self.config.tilt_std_threshold
        self.levelled = self.levelled and tilt <= max_tilt
        self.aligned = (self.aligned and tilt <= max_tilt
                        and heading <= WITHDRAWN_AT * self.config.heading_std_threshold)

    def _verdict(self, tilt: float, heading: float, fit: Fit) -> Verdict:
        config = self.config
        if self.aligned:
            return Verdict(State.ALIGNED, f'heading sigma {_deg(heading)}, '
                                          f'tilt sigma {_deg(tilt)}{fit.remarks}')
        if fit.rows < MIN_ROWS:
            return Verdict(State.ALIGNING, self._too_few(fit))
        if tilt > config.tilt_std_threshold and not self.levelled:
            return Verdict(State.ALIGNING, self._too_large(
                'tilt', tilt, 'wait, or turn or change speed') + fit.remarks)
        state = State.LEVELLED if self.levelled else State.ALIGNING
        if heading > config.heading_std_threshold:
            return Verdict(state, self._too_large(
                'heading', heading, 'turn or change speed') + fit.remarks)
        return Verdict(state, f'heading sigma {_deg(heading)} is good enough: it has to hold '
                              f'for {config.hold_time:g} s')

    def _too_large(self, name: str, sigma_deg: float, advice: str) -> str:
        """Return advice; after a while also that the sigma may be good enough as it is."""
        parameter = f'{name}_std_threshold'
        threshold_deg = getattr(self.config, parameter)
        sigma = _above(sigma_deg, threshold_deg)
        words = f'{name} sigma {sigma}, needs {threshold_deg:g}: {advice}'
        if self._time_s >= PATIENCE and sigma_deg <= ACCEPTABLE * threshold_deg:
            words += f', or raise {parameter} if {sigma} is good enough'
        return words

    def _too_few(self, fit: Fit) -> str:
        """Return how many epochs there are where there is no redundancy yet."""
        if self._contradiction:
            return f'{self._contradiction}; it has started over'
        return f'{fit.offered + fit.waiting} GNSS epochs so far: more are needed'

    def _since(self, since_s: float | None, good: bool) -> float | None:
        """Return the time since which something has been good, or None."""
        if not good:
            return None
        return self._time_s if since_s is None else since_s

    def _held(self, since_s: float | None) -> bool:
        return since_s is not None and self._time_s - since_s >= self.config.hold_time - 1e-6

    def _contradicted_by(self, fit: Fit) -> str:
        """Return what in the data contradicts the model; empty when nothing does."""
        if fit.rows < MIN_ROWS:
            return ''
        config = self.config
        unexplained = abs(fit.delay - config.gnss_delay)
        most = DELAY_SIGMAS * max(config.gnss_delay_std, fit.delay_std)
        if unexplained > most * (WITHDRAWN_AT if self.levelled or self.aligned else 1.0) > 0:
            digits = 2 if unexplained >= 0.02 else 3
            return (f'the GNSS stamps seem to be {fit.delay:.{digits}f} s late, gnss_delay is '
                    f'{config.gnss_delay:g} and gnss_delay_std {config.gnss_delay_std:g}: check '
                    'the clocks, or set gnss_delay')
        if fit.objection:
            return fit.objection
        if fit.rejected > REJECTED_SHARE * fit.offered:
            return (f'{fit.rejected} of {fit.offered} GNSS epochs do not fit the rest: check the '
                    'velocity frame, the IMU axes and signs, the lever arm, the GNSS delay')
        if fit.misfit > MAX_MISFIT:
            return (f'the residuals are {math.sqrt(fit.misfit):.1f} times what the stated noise '
                    'allows: check the lever arm, the GNSS delay, the velocity frame, the IMU '
                    'axes and signs, the covariances that the receiver states')
        return ''


def _above(sigma_deg: float, threshold_deg: float) -> str:
    """Return a sigma with enough digits to be above its threshold."""
    text = _deg(sigma_deg)
    return text if float(text.split()[0]) > threshold_deg else f'{sigma_deg:.4g} deg'


def _deg(sigma_deg: float) -> str:
    """Return a sigma with two digits, or as a whole number."""
    return f'{sigma_deg:.2g} deg' if sigma_deg < 99.5 else f'{sigma_deg:.0f} deg'


def _sigmas_deg(P: Array) -> tuple[float, float]:
    """Sigma of tilt, about the horizontal axis where it is largest, and of heading."""
    (ee, en, _), (_, nn, _), (_, _, uu) = P.tolist()
    tilt = math.sqrt(0.5 * (ee + nn) + math.hypot(0.5 * (ee - nn), en))
    return math.degrees(tilt), math.degrees(math.sqrt(uu))
