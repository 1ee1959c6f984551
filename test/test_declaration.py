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
"""When something is declared, held back and withdrawn, and the words for it."""

from ins_align.config import Config
from ins_align.estimation.declaration import Declaration, Fit
from ins_align.results import State, Verdict
import numpy as np
import pytest


def fit(**changes):
    return Fit(**{'offered': 102, 'rows': 300, 'misfit': 1.0, **changes})


def covariance(tilt_deg, heading_deg):
    return np.diag(np.radians([tilt_deg, tilt_deg, heading_deg]) ** 2)


GOOD, LEVEL, OPEN = covariance(0.1, 0.5), covariance(0.1, 14.0), covariance(5.0, 90.0)


def judge(declaration, start, seconds, P, the_fit=None, rate=5.0, doubt='', delay=0.0):
    """Judge a stretch of epochs; return the last verdict."""
    verdict = None
    for k in range(int(seconds * rate) + 1):
        verdict = declaration.update(start + k / rate, 0.0, (P, P),
                                     the_fit or fit(delay=delay, doubt=doubt))
    return verdict


def test_good_sigmas_are_declared_after_the_hold_time():
    declaration = Declaration(Config(hold_time=2.0))
    before = judge(declaration, 0.0, 1.8, GOOD)
    assert before.state is State.ALIGNING and 'hold' in before.reason and '2' in before.reason
    assert judge(declaration, 2.0, 0.0, GOOD).state is State.ALIGNED


@pytest.mark.parametrize('hold', (0.0, 0.5, 10.0))
def test_hold_time_is_the_parameter(hold):
    declaration = Declaration(Config(hold_time=hold))
    if hold > 0:
        assert judge(declaration, 0.0, hold - 0.2, GOOD).state is not State.ALIGNED
    assert judge(declaration, hold, 0.2, GOOD).state is State.ALIGNED


def test_level_comes_before_heading_and_the_reason_has_numbers():
    verdict = judge(Declaration(Config()), 0.0, 3.0, LEVEL)
    assert verdict.state is State.LEVELLED
    assert verdict.reason == 'heading sigma 14 deg, needs 1: turn or change speed'
    verdict = judge(Declaration(Config()), 0.0, 3.0, OPEN)
    assert verdict.state is State.ALIGNING and 'tilt sigma 5' in verdict.reason


def test_after_a_minute_near_the_threshold_the_reason_names_the_parameter():
    near, far = covariance(0.1, 2.4), covariance(0.1, 30.0)
    declaration = Declaration(Config())
    early = judge(declaration, 0.0, 10.0, near)
    assert 'heading_std_threshold' not in early.reason
    late = judge(declaration, 100.0, 10.0, near)
    assert late.reason == ('heading sigma 2.4 deg, needs 1: turn or change speed, or raise '
                           'heading_std_threshold if 2.4 deg is good enough')
    assert 'threshold' not in judge(declaration, 200.0, 10.0, far).reason
    tilted = judge(Declaration(Config()), 100.0, 10.0, covariance(1.2, 30.0))
    assert 'raise tilt_std_threshold if 1.2 deg' in tilted.reason


def test_what_is_missing_shows_in_the_numbers():
    verdict = judge(Declaration(Config()), 0.0, 3.0, covariance(0.1, 1.004))
    assert verdict.reason.startswith('heading sigma 1.004 deg, needs 1:')


def test_a_lapse_starts_the_hold_again():
    declaration = Declaration(Config(hold_time=2.0))
    judge(declaration, 0.0, 1.6, GOOD)
    judge(declaration, 1.8, 0.0, LEVEL)
    assert judge(declaration, 2.0, 1.8, GOOD).state is not State.ALIGNED
    assert judge(declaration, 4.0, 0.0, GOOD).state is State.ALIGNED


def test_an_outlier_starts_the_hold_again():
    declaration = Declaration(Config(hold_time=2.0))
    judge(declaration, 0.0, 1.6, GOOD)
    judge(declaration, 1.8, 0.0, GOOD, fit(rejected=1))
    assert judge(declaration, 2.0, 1.8, GOOD, fit(rejected=1)).state is State.ALIGNING
    assert judge(declaration, 4.0, 0.0, GOOD, fit(rejected=1)).state is State.ALIGNED


def test_what_was_withdrawn_has_to_hold_again():
    declaration = Declaration(Config(hold_time=2.0))
    assert judge(declaration, 0.0, 3.0, GOOD).state is State.ALIGNED
    declaration.withdraw()
    assert judge(declaration, 3.2, 1.8, GOOD).state is State.ALIGNING
    assert judge(declaration, 5.2, 0.0, GOOD).state is State.ALIGNED


def test_a_minute_without_gnss_holds_nothing():
    declaration = Declaration(Config(hold_time=2.0))
    judge(declaration, 0.0, 0.0, GOOD)
    for silent in range(2, 62, 2):
        declaration.update(0.0, float(silent), (GOOD, GOOD), fit())
    assert judge(declaration, 62.0, 1.8, GOOD).state is State.ALIGNING
    assert judge(declaration, 64.0, 0.0, GOOD).state is State.ALIGNED


def test_a_misfit_is_not_counted_twice():
    """Sigmas come inflated: a misfit that does not contradict changes nothing more."""
    verdict = judge(Declaration(Config()), 0.0, 5.0, covariance(0.1, 0.8), fit(misfit=9 / 4))
    assert verdict.state is State.ALIGNED and 'heading sigma 0.8' in verdict.reason


@pytest.mark.parametrize('seed', range(5))
def test_tilt_is_that_about_the_worst_horizontal_axis(seed):
    """Whichever way that points: the largest eigenvalue of the two by two."""
    P = covariance(0.1, 0.5)
    root = np.radians(0.3) * np.random.default_rng(seed).standard_normal((2, 2))
    P[:2, :2] = root @ root.T
    sigma = np.degrees(np.sqrt(np.linalg.eigvalsh(P[:2, :2])[1]))
    for factor, state in ((0.99, State.ALIGNING), (1.01, State.ALIGNED)):
        config = Config(hold_time=0.0, tilt_std_threshold=float(factor * sigma))
        verdict = Declaration(config).update(0.0, 0.0, (P, P), fit())
        assert verdict.state is state and f'tilt sigma {sigma:.2g}' in verdict.reason


def test_thresholds_are_the_parameters():
    assert judge(Declaration(Config(heading_std_threshold=20.0)), 0.0, 3.0,
                 LEVEL).state is State.ALIGNED
    assert judge(Declaration(Config(tilt_std_threshold=0.05)), 0.0, 3.0,
                 GOOD).state is State.ALIGNING


def test_the_worse_of_initial_and_current_counts():
    declaration = Declaration(Config(hold_time=2.0))
    for k in range(20):
        verdict = declaration.update(0.2 * k, 0.0, (GOOD, LEVEL), fit())
    assert verdict.state is State.LEVELLED and not declaration.move_t0


def test_a_later_t0_is_wanted_where_only_the_present_heading_is_good():
    declaration = Declaration(Config(hold_time=2.0))
    wanted = []
    for k in range(20):
        verdict = declaration.update(0.2 * k, 0.0, (LEVEL, GOOD), fit())
        wanted.append(declaration.move_t0)
    assert verdict.state is State.LEVELLED
    assert wanted == [False] * 10 + [True] * 10
    # When t0 has moved, what has held before it counts.
    assert declaration.update(4.0, 0.0, (GOOD, GOOD), fit()).state is State.ALIGNED
    assert not declaration.move_t0


def test_no_later_t0_while_the_signs_are_in_doubt():
    declaration = Declaration(Config(hold_time=0.0))
    declaration.update(0.0, 0.0, (LEVEL, GOOD), fit(doubt='turn'))
    assert not declaration.move_t0


@pytest.mark.parametrize('initial, current', [
    (GOOD, covariance(5.0, 0.5)), (covariance(5.0, 14.0), covariance(5.0, 0.5))])
def test_no_later_t0_while_the_present_tilt_is_bad(initial, current):
    declaration = Declaration(Config(hold_time=0.0))
    verdict = declaration.update(0.0, 0.0, (initial, current), fit())
    assert verdict.state is State.ALIGNING and not declaration.move_t0


@pytest.mark.parametrize('doubt', ('', 'turn'))
def test_an_initial_tilt_that_is_bad_declares_nothing(doubt):
    """What is good now is worth a later start, but for a doubt about it."""
    declaration = Declaration(Config(hold_time=0.0))
    verdict = declaration.update(0.0, 0.0, (covariance(0.8, 0.5), GOOD), fit(doubt=doubt))
    assert verdict.state is State.ALIGNING and not declaration.levelled
    assert declaration.move_t0 == (not doubt)


@pytest.mark.parametrize('changes, words', [
    ({'misfit': 4.1}, 'residuals'), ({'rejected': 40}, '40 of 102')])
def test_contradicting_data_are_not_declared_and_withdraw(changes, words):
    bad = fit(**changes)
    verdict = judge(Declaration(Config()), 0.0, 10.0, GOOD, bad)
    assert verdict.state is State.ALIGNING and words in verdict.reason
    declaration = Declaration(Config(hold_time=2.0))
    assert judge(declaration, 0.0, 3.0, GOOD).state is State.ALIGNED
    assert judge(declaration, 3.2, 0.0, GOOD, bad).state is State.ALIGNING
    # And comes back only after holding again.
    assert judge(declaration, 3.4, 1.8, GOOD).state is not State.ALIGNED
    assert judge(declaration, 5.4, 0.2, GOOD).state is State.ALIGNED


def test_contradicting_data_withdraw_the_level_too():
    declaration = Declaration(Config(hold_time=2.0))
    assert judge(declaration, 0.0, 3.0, LEVEL).state is State.LEVELLED
    judge(declaration, 3.2, 0.0, LEVEL, fit(objection='another lever arm'))
    assert judge(declaration, 3.4, 1.8, LEVEL).state is State.ALIGNING
    assert judge(declaration, 5.4, 0.0, LEVEL).state is State.LEVELLED


def test_declared_heading_survives_a_little_more_sigma_and_not_twice_as_much():
    declaration = Declaration(Config(hold_time=2.0))
    judge(declaration, 0.0, 3.0, GOOD)
    assert judge(declaration, 3.2, 1.0, covariance(0.1, 1.5)).state is State.ALIGNED
    assert judge(declaration, 5.0, 0.0, covariance(0.1, 2.5)).state is State.LEVELLED
    assert judge(declaration, 6.0, 0.0, covariance(0.1, 1.5)).state is State.LEVELLED


def test_a_declared_level_survives_a_little_more_sigma_and_not_twice_as_much():
    declaration = Declaration(Config(hold_time=2.0, tilt_std_threshold=0.5))
    assert judge(declaration, 0.0, 3.0, LEVEL).state is State.LEVELLED
    assert judge(declaration, 3.2, 1.0, covariance(0.9, 14.0)).state is State.LEVELLED
    assert judge(declaration, 5.0, 0.0, covariance(1.1, 14.0)).state is State.ALIGNING


def test_declared_heading_goes_with_the_tilt():
    declaration = Declaration(Config(heading_std_threshold=10.0))
    assert judge(declaration, 0.0, 3.0, GOOD).state is State.ALIGNED
    tilted = covariance(5.0, 5.0)
    assert judge(declaration, 3.2, 0.0, tilted).state is State.ALIGNING


def test_without_gnss_nothing_is_declared_and_what_gets_lost_is_withdrawn():
    declaration = Declaration(Config(hold_time=2.0))
    for silent in (2.0, 4.0, 60.0):
        verdict = declaration.update(0.0, silent, (GOOD, GOOD), fit())
        assert verdict.state is State.ALIGNING
        assert verdict.reason.endswith(f'hold for 2 s; no GNSS for {silent:g} s')
    assert judge(declaration, 60.2, 3.0, GOOD).state is State.ALIGNED
    kept = declaration.update(0.0, 2.0, (GOOD, covariance(0.1, 1.9)), fit())
    assert kept.state is State.ALIGNED and 'sigma 1.9' in kept.reason
    assert 'no GNSS for 2 s' in kept.reason
    lost = declaration.update(0.0, 4.0, (GOOD, covariance(0.1, 2.1)), fit())
    assert lost.state is State.LEVELLED and 'no GNSS' in lost.reason
    again = declaration.update(0.0, 6.0, (GOOD, GOOD), fit())
    assert again.state is State.LEVELLED
    fallen = declaration.update(0.0, 8.0, (GOOD, covariance(1.1, 2.1)), fit())
    assert fallen.state is State.ALIGNING


@pytest.mark.parametrize('P, the_fit, doubt', [
    (OPEN, None, ''), (LEVEL, None, ''), (GOOD, fit(rejected=40), ''),
    (GOOD, fit(objection='another lever arm'), ''), (GOOD, None, 'turn'),
    (GOOD, fit(rows=5, offered=4), '')])
def test_without_gnss_what_spoke_against_a_declaration_is_still_said(P, the_fit, doubt):
    declaration = Declaration(Config(hold_time=2.0))
    before = judge(declaration, 0.0, 3.0, P, the_fit, doubt=doubt)
    for silent in (2.0, 4.0, 60.0):
        verdict = declaration.update(0.0, silent, (P, P), the_fit or fit())
        assert verdict == Verdict(before.state, f'{before.reason}; no GNSS for {silent:g} s')


@pytest.mark.parametrize('initial, current, state', [
    (covariance(0.1, 1.2), covariance(0.1, 1.2), State.ALIGNED),
    (covariance(0.1, 2.1), GOOD, State.LEVELLED), (GOOD, covariance(0.1, 2.1), State.LEVELLED)])
def test_without_gnss_the_worse_sigma_counts(initial, current, state):
    declaration = Declaration(Config(hold_time=2.0))
    assert judge(declaration, 0.0, 3.0, GOOD).state is State.ALIGNED
    assert declaration.update(0.0, 2.0, (initial, current), fit()).state is state


def test_an_objection_withdraws_and_is_the_reason():
    declaration = Declaration(Config(hold_time=2.0))
    assert judge(declaration, 0.0, 3.0, GOOD).state is State.ALIGNED
    verdict = judge(declaration, 3.2, 0.0, GOOD, fit(objection='another lever arm'))
    assert verdict.state is State.ALIGNING and verdict.reason == 'another lever arm'


def test_not_before_there_is_redundancy():
    verdict = judge(Declaration(Config()), 0.0, 10.0, GOOD, fit(rows=5, offered=4))
    assert verdict.state is State.ALIGNING and '4' in verdict.reason


@pytest.mark.parametrize('rows', (0, 5))
def test_nothing_is_contradicted_without_redundancy(rows):
    """A handful of rows that do not fit, or none at all: more are needed."""
    few = fit(rows=rows, misfit=1e3, offered=4, delay=9.0, objection='another lever arm')
    verdict = Declaration(Config()).update(0.0, 0.0, (GOOD, GOOD), few)
    assert verdict.state is State.ALIGNING and verdict.reason.startswith('4 GNSS epochs so far')


def test_a_new_start_remembers_what_contradicted_the_one_before():
    declaration = Declaration(Config())
    judge(declaration, 0.0, 3.0, GOOD, fit(objection='another lever arm', offered=650))
    few = fit(rows=5, offered=653)
    words = 'another lever arm; it has started over'
    assert declaration.update(0.0, 0.0, (), few) == Verdict(State.ALIGNING, words)
    assert declaration.update(3.2, 0.0, (GOOD, GOOD), few) == Verdict(State.ALIGNING, words)
    assert declaration.update(0.0, 4.0, (GOOD, GOOD), few).reason == (
        f'{words}; no GNSS for 4 s')
    judge(declaration, 3.4, 0.0, GOOD, fit(offered=660))
    few = fit(rows=5, offered=3)
    assert declaration.update(0.0, 0.0, (), few).reason == (
        '3 GNSS epochs so far: more are needed')
    assert declaration.update(0.0, 4.0, (), few).reason.endswith('needed; no GNSS for 4 s')


def test_an_attitude_that_is_gone_is_withdrawn():
    """The bank may start again by itself: what it finds then has to hold for a while too."""
    declaration = Declaration(Config(hold_time=2.0))
    assert judge(declaration, 0.0, 3.0, GOOD).state is State.ALIGNED
    declaration.update(0.0, 0.0, (), fit(rows=0, offered=4))
    assert declaration.update(3.2, 0.0, (GOOD, GOOD), fit()).state is State.ALIGNING
    assert judge(declaration, 3.4, 3.0, GOOD).state is State.ALIGNED


def test_figures_in_reasons_are_not_rounded_to_what_they_exceed():
    late = Declaration(Config(gnss_delay=0.1, gnss_delay_std=0.001)).update(
        0.0, 0.0, (GOOD, GOOD), fit(delay=0.104))
    assert 'seem to be 0.104 s late, gnss_delay is 0.1 ' in late.reason
    wide = np.diag(np.radians([0.1, 0.1, 1.03]) ** 2)
    reason = judge(Declaration(Config()), 0.0, 70.0, wide).reason
    assert 'heading sigma 1.03 deg, needs 1:' in reason
    assert reason.endswith('if 1.03 deg is good enough')


@pytest.mark.parametrize('P, state', [(GOOD, State.ALIGNED), (LEVEL, State.LEVELLED)])
def test_noise_that_is_another_than_stated_is_the_end_of_the_reason(P, state):
    words = '; the GNSS velocities are 3.0 times as noisy as stated'
    verdict = judge(Declaration(Config()), 0.0, 3.0, P, fit(remarks=words))
    assert verdict.state is state and verdict.reason.endswith(words)


def test_doubt_about_the_signs_holds_the_heading_back_and_not_the_level():
    declaration = Declaration(Config(hold_time=2.0))
    verdict = judge(declaration, 0.0, 10.0, GOOD, doubt='signs of the axes: turn')
    assert verdict.state is State.LEVELLED and verdict.reason == 'signs of the axes: turn'
    assert judge(declaration, 10.2, 0.0, GOOD).state is State.ALIGNED
    # What has been confirmed once is not asked again.
    assert judge(declaration, 10.4, 1.0, GOOD, doubt='signs').state is State.ALIGNED


@pytest.mark.parametrize('told, delay, believed', [
    ({}, 0.29, True), ({}, -0.31, False), ({'gnss_delay': 0.5, 'gnss_delay_std': 0.05}, 0.6, True),
    ({'gnss_delay': 0.5, 'gnss_delay_std': 0.05}, 0.7, False),
    ({'gnss_delay_std': 0.3}, 0.8, True), ({'gnss_delay_std': 0.3}, 1.0, False),
    ({'gnss_delay': 0.5, 'gnss_delay_std': 0.0}, 0.5, True)])
@pytest.mark.parametrize('declared', (False, True))
def test_delay_far_from_what_was_told_is_a_contradiction(declared, told, delay, believed):
    """What is declared is withdrawn at twice the distance: it does not come and go with noise."""
    declaration = Declaration(Config(**told))
    usual = declaration.config.gnss_delay
    if declared:
        assert judge(declaration, 0.0, 2.0, GOOD, delay=usual).state is State.ALIGNED
        verdict = judge(declaration, 2.2, 2.0, GOOD, delay=delay)
        assert verdict.state is State.ALIGNED
        delay = usual + 2 * (delay - usual)
    verdict = judge(declaration, 2.4, 4.4, GOOD, delay=delay)
    assert (verdict.state is State.ALIGNED) == believed
    if not believed:
        assert 'set gnss_delay' in verdict.reason and f'{delay:.2f}' in verdict.reason
