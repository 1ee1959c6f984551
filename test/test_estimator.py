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
"""The recursive estimator against the dense reference and the truth."""

from dataclasses import replace
from functools import partial
import math

from alignment import (aligned, config_for, error_of, estimator_of, LEVER, normalised_error,
                       simulated)
from ins_align import scenarios
from ins_align.config import PRESETS
from ins_align.estimator import MapEstimator
from ins_align.experiments.dense import bound, dense_solution
from ins_align.handover import aged, prior_from_now, wander
from ins_align.methods import MapMethod
from ins_align.preintegration import Noise, preintegrate, SensorErrors, Steps
from ins_align.results import State
from ins_align.rotation import log_so3
from ins_align.scenarios import Motion
from ins_align.simulation import simulate
from ins_align.unknowns import (ACCEL_BIAS, ACCEL_ERRORS, BODY_FIXED, DELAY, first_prior,
                                GYRO_BIAS, GYRO_MISALIGNMENT, SIZE, START_POSITION,
                                START_VELOCITY, UNIFORM_ANGLE_STD)
from ins_align.whitening import Measurements
import numpy as np
import pytest
from scipy.stats import chi2


def test_a_full_store_says_so():
    estimator = MapEstimator(first_prior(1e-3, 0.05, LEVER, 0.0, 0.0, 0.0), capacity=3)
    steps = Steps(np.zeros((1, 1)), *np.ones((2, 1, 2, 3)), *np.zeros((2, 1, 2, 3)))
    interval, gnss = preintegrate(steps, SensorErrors.none(), Noise()), Measurements.empty(1)
    for _ in range(3):
        assert len(list(estimator.add(interval, gnss))) == 1
    assert estimator.full
    with pytest.raises(RuntimeError, match='full'):
        next(estimator.add(interval, gnss))


# The whole against the dense reference

CASES = {
    'velocity': ({}, {}),
    'position': ({'use_velocity': False, 'use_position': True}, {}),
    'both': ({'use_position': True}, {}),
    'lever arm': ({'lever_arm_std': 1.0}, {}),
    'delay': ({'gnss_delay_std': 0.1}, {}),
    'everything': ({'use_position': True, 'lever_arm_std': 1.0, 'gnss_delay_std': 0.1}, {}),
}


def settled(aligner):
    """Bring the linearisation point to convergence and return the estimator."""
    estimator = estimator_of(aligner)
    estimator.NONLINEARITY = 1e-7
    estimator.settle()
    return estimator


def stated_covariance(estimator):
    """Covariance before the allowance for what IMU noise feigns, shape (28, 28)."""
    solution = estimator.solution
    information = solution.information + solution.whitener.normal[1:, 1:]
    information[:3, :3] += np.eye(3) / UNIFORM_ANGLE_STD ** 2
    wanted = estimator.columns
    full = np.zeros((SIZE, SIZE))
    full[np.ix_(wanted, wanted)] = np.linalg.inv(information)
    return full


def as_calibrated(grade):
    """Errors of scale factors and axes as large as the grade says."""
    scale_std = PRESETS[grade].gyro_scale_std
    return {'gyro_scale_std': scale_std, 'gyro_misalignment_std': GYRO_MISALIGNMENT * scale_std,
            'accel_scale_std': ACCEL_ERRORS * scale_std,
            'accel_misalignment_std': ACCEL_ERRORS * scale_std}


@pytest.mark.parametrize('case', CASES)
@pytest.mark.parametrize('scenario, grade, walk', [
    ('flight', 'navigation', 0.0), ('flight', 'mems', 0.0), ('car', 'tactical', 0.0),
    ('flight', 'mems', 0.1), ('car', 'tactical', 1.0)])
def test_recursion_is_the_dense_solution(scenario, grade, walk, case, monkeypatch):
    # The reference does not count this.
    monkeypatch.setattr('ins_align.g_sensitivity.G_SENSITIVITY', 0.0)
    changes, _ = CASES[case]
    s = simulated(scenario, imu_grade=grade, duration=20.0, seed=3, position_std=0.5,
                  rate_random_walk=walk * PRESETS[grade].gyro_bias_std, **as_calibrated(grade))
    aligner, _ = aligned(s, **changes)
    estimator = settled(aligner)
    dense = dense_solution(
        s, use_velocity=changes.get('use_velocity', True),
        use_position=changes.get('use_position', False),
        lever_arm_std=changes.get('lever_arm_std', 0.0),
        delay_std=changes.get('gnss_delay_std', 0.0))
    delayed = 'gnss_delay_std' in changes
    # Reference and recursion differ by the rule of integration, and by how they turn a delay
    # into a change of the measurement: hundredths of a sigma.
    tolerance = 0.3 if delayed else 0.03
    late = round(dense.unknowns[DELAY][0] * 1e9)
    first, last = int(s.gnss_stamps_ns[0]), int(s.gnss_stamps_ns[-1])
    x = estimator.estimate()
    step = x.vector() - dense.unknowns
    step[:3] = log_so3(x.C @ (dense.C @ s.attitude_at(first - late).T @ s.attitude_at(first)).T)
    step[START_VELOCITY] = step[START_POSITION] = 0.0     # counted from different origins
    sigma = np.sqrt(np.diag(dense.covariance))
    assert np.all(np.abs(step) <= tolerance * sigma + 1e-12)
    found = np.sqrt(np.diag(stated_covariance(estimator)))
    which = np.concatenate([range(3), BODY_FIXED])
    assert np.allclose(found[which], sigma[which], rtol=0.02 if delayed else 0.01)
    assert estimator.solution.chi2 == pytest.approx(dense.chi2, rel=0.01 if delayed else 1e-3)
    # The allowance only takes information away.
    stated = estimator.variances[:3]
    assert np.all(stated >= found[:3] ** 2 * (1 - 1e-9)) and np.all(
        stated <= 1.1 * found[:3] ** 2)

    C_n0b, covariance = estimator.current()
    truth = dense.C_n0b @ s.attitude_at(last - late).T @ s.attitude_at(last)
    sigma = np.sqrt(np.diag(dense.current_covariance))
    assert np.all(np.abs(log_so3(C_n0b @ truth.T)) <= tolerance * sigma)
    assert np.allclose(np.sqrt(np.diag(covariance)), sigma, rtol=0.02 if delayed else 5e-3)


@pytest.mark.parametrize('grade', ('navigation', 'mems'))
@pytest.mark.parametrize('scenario', ('flight', 'car'))
def test_covariance_without_noise_is_the_cramer_rao_bound_at_every_time(scenario, grade):
    s = simulated(scenario, imu_grade=grade, duration=30.0, ideal=True)
    limit = bound(s)
    _, epochs = aligned(s, hold_time=1e3)             # a declaration may move t0
    # While the heading is open, sigma depends on the point where it is worked out.
    for epoch in epochs[60:]:
        expected = np.sqrt(np.diag(limit.at(epoch.t_s)))
        if np.degrees(expected[2]) < 5.0:
            assert np.allclose(np.sqrt(np.diag(epoch.initial.covariance)), expected, rtol=0.03)


# Handover

@pytest.mark.parametrize('walk', (0.0, 0.3))
@pytest.mark.parametrize('changes', (
    {}, {'use_position': True}, {'use_velocity': False, 'use_position': True},
    {'lever_arm_std': 0.5, 'gnss_delay_std': 0.05}))
def test_handover_gives_the_attitude_of_one_that_never_handed_over(changes, walk, monkeypatch):
    # Not looked at here: what a misfit adds to sigmas, what biases may have wandered since, what
    # is left of second order.
    monkeypatch.setattr('ins_align.fit.Fit.factor', 1.0)
    monkeypatch.setattr('ins_align.fit.Fit.significant_scale', 1.0)
    monkeypatch.setattr('ins_align.handover.WANDER', 0.0)
    monkeypatch.setattr('ins_align.handover.DELAY_WANDER', 0.0)
    monkeypatch.setattr(MapEstimator, 'NONLINEARITY', 0.01)
    s = simulated('flight', imu_grade='tactical', duration=30.0, seed=2, position_std=0.5,
                  rate_random_walk=walk * PRESETS['tactical'].gyro_bias_std)
    one = aligned(s, **changes)[0].status()
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=70))
    other = aligned(s, **changes)[0].status()
    assert other.counts['rebases'] >= 2 and one.counts['rebases'] == 0
    assert np.allclose(other.current.sigma_deg, one.current.sigma_deg, rtol=0.03)
    difference = error_of(other.current, s) - error_of(one.current, s)
    assert np.all(np.abs(difference) < 0.15 * np.radians(one.current.sigma_deg))
    for name in ('gyro_bias', 'accel_bias', 'lever_arm', 'gnss_delay'):
        sigma = np.asarray(getattr(one, name + '_std'))
        assert np.allclose(getattr(other, name + '_std'), sigma, rtol=0.03), name
        assert np.all(np.abs(getattr(other, name) - getattr(one, name)) <= 0.15 * sigma), name


def covariance_of(prior):
    """Covariance of what a prior knows, zero elsewhere, shape (37, 37)."""
    known = np.flatnonzero(np.diag(prior.information))
    full = np.zeros((SIZE, SIZE))
    full[np.ix_(known, known)] = np.linalg.inv(prior.information[np.ix_(known, known)])
    return full


def test_handover_widens_by_the_misfit_and_by_what_biases_may_have_wandered():
    s = simulated('flight', imu_grade='tactical', duration=30.0, seed=2)
    estimator = estimator_of(aligned(s)[0])
    none, changed = np.zeros(3), np.zeros(SIZE)
    still = covariance_of(prior_from_now(estimator, np.eye(3), none, none, 1.0, changed))
    assert np.allclose(np.diag(still)[:3], np.diag(estimator.current()[1]), rtol=1e-5)
    wide = covariance_of(prior_from_now(estimator, np.eye(3), none, none, 4.0, changed))
    # What the data told counts a quarter, what was known before them as much as ever.
    ratio = np.diag(wide)[np.diag(still) > 0] / np.diag(still)[np.diag(still) > 0]
    assert np.all(ratio > 0.999) and np.all(ratio < 4.001)
    before = covariance_of(estimator.prior)
    assert np.all(np.diag(wide)[BODY_FIXED] <= 1.001 * np.diag(before)[BODY_FIXED])
    assert np.all(ratio[-3:] > 3.5)                             # velocity: of the data alone
    changed[GYRO_BIAS], changed[ACCEL_BIAS] = 1e-10, 1e-4
    moved = covariance_of(prior_from_now(estimator, np.eye(3), none, none, 1.0, changed))
    assert np.allclose(np.diag(moved - still), changed, rtol=1e-3, atol=1e-14)


@pytest.mark.parametrize('scenario', ('reverse', 'flight', 'hover'))
def test_handover_feigns_no_information(scenario, monkeypatch):
    """RTK knows the sum of tilt and bias far better than each: a little turn would tell them."""
    s = simulated(scenario, imu_grade='mems', duration=60.0, seed=0, position_std=0.02)
    one = {epoch.stamp_ns: epoch.current for epoch in aligned(s, velocity=False)[1]}
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=50))
    aligner, epochs = aligned(s, velocity=False)
    assert aligner.status().counts['rebases'] >= 4
    ratios = [np.sqrt(np.diag(epoch.current.covariance) / np.diag(one[epoch.stamp_ns].covariance))
              for epoch in epochs if epoch.current is not None
              and one[epoch.stamp_ns].sigma_deg[2] < 10.0]
    assert len(ratios) > 200 and np.min(ratios) > 0.93


def test_handover_while_standing_still_keeps_tilt_and_biases(monkeypatch):
    """Standing long must neither spoil the estimate nor delay it."""
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=60))
    s = simulated('car', imu_grade='mems', duration=75.0, stand_still=40.0, seed=4)
    status = aligned(s)[0].status()
    assert status.counts['rebases'] >= 3
    assert normalised_error(status.current, s) < chi2.ppf(0.9999, 3)
    assert status.current.sigma_deg[2] < 0.5


@pytest.mark.parametrize('understated', (1.2, 1.5))
def test_standing_with_a_receiver_that_understates_forgets_nothing(monkeypatch, understated):
    """What is known of the sensors must not be doubted again at every handover."""
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=60))
    s = simulated('car', imu_grade='mems', duration=100.0, stand_still=70.0, seed=1)
    s = replace(s, velocity_covariance=s.velocity_covariance / understated ** 2)
    aligner, epochs = aligned(s, lever_arm_std=1.0)
    status = aligner.status()
    assert status.counts['rebases'] >= 5 and status.state is State.ALIGNED
    assert next(e.t_s for e in epochs if e.state is State.ALIGNED) < 95.0
    assert normalised_error(status.current, s) < chi2.ppf(0.9999, 3)


@pytest.mark.parametrize('scenario', ('car', 'launch'))
def test_standing_in_vibration_shows_neither_lever_arm_nor_delay(monkeypatch, scenario):
    """The noise of the IMU would swing the antenna, which the GNSS does not see."""
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=100))
    s = simulated(scenario, imu_grade='mems', duration=120.0, stand_still=90.0, seed=1,
                  gnss_delay=0.15)
    r = np.random.default_rng(1)
    s = replace(s, gyro=s.gyro + 0.005 * r.standard_normal(s.gyro.shape),
                accel=s.accel + 0.2 * r.standard_normal(s.accel.shape))
    aligner, epochs = aligned(s, lever_arm_std=1.0, gnss_delay=0.0, gnss_delay_std=0.1)
    status = aligner.status()
    assert status.state is State.ALIGNED
    assert abs(status.gnss_delay - 0.15) < 4.0 * status.gnss_delay_std
    assert np.all(np.abs(status.lever_arm - s.lever_arm) < 4.0 * status.lever_arm_std)
    declared = [normalised_error(e.current, s) for e in epochs if e.state is State.ALIGNED]
    assert max(declared) < chi2.ppf(0.99999, 3)


@pytest.mark.parametrize('scenario', ('car', 'flight'))
def test_clocks_that_drift_apart_are_followed(monkeypatch, scenario):
    """Nothing keeps the clocks of a microcontroller and of a receiver together."""
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=100))
    s = simulated(scenario, imu_grade='mems', duration=300.0, imu_rate=50.0, seed=1)
    drifted_ns = np.rint(1e-4 * (s.gnss_stamps_ns - s.imu_stamps_ns[0])).astype(np.int64)
    late = replace(s, gnss_stamps_ns=s.gnss_stamps_ns + drifted_ns)
    status = aligned(late, lever_arm_std=1.0, gnss_delay_std=0.1)[0].status()
    assert status.counts['rebases'] >= 12 and status.state is State.ALIGNED
    assert abs(status.gnss_delay - 1e-9 * drifted_ns[-1]) < 4.0 * status.gnss_delay_std


@pytest.mark.parametrize('scenario', ('static', 'flight'))
def test_clocks_go_on_whether_anything_shows_the_delay_or_not(scenario):
    s = simulated(scenario, imu_grade='mems', duration=30.0, seed=2)
    config = config_for(s, gnss_delay_std=0.1)
    estimator = estimator_of(aligned(s, gnss_delay_std=0.1)[0])
    none = np.zeros(3)
    for before, later in (
            (estimator.prior, aged(estimator.prior, config, 100.0)),
            (prior_from_now(estimator, np.eye(3), none, none, 1.0, change)
             for change in (np.zeros(SIZE), 100.0 * wander(config)))):
        grown = (covariance_of(later) - covariance_of(before))[DELAY, DELAY]
        assert grown[0, 0] == pytest.approx(0.01 ** 2, rel=1e-3)


def test_silence_after_a_handful_of_epochs_may_fill_the_store(monkeypatch):
    """As in a garage: too few for a first solution, and then none for long."""
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=40))
    s = simulated('car', imu_grade='mems', duration=150.0, stand_still=110.0, imu_rate=50.0,
                  seed=1, outages=((0.55, 110.0),))
    aligner, _ = aligned(s)
    status = aligner.status()
    assert status.counts['rebases'] >= 1 and status.state is State.ALIGNED
    assert normalised_error(status.current, s) < chi2.ppf(0.9999, 3)


def test_store_is_bounded(monkeypatch):
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=40))
    aligner, _ = aligned(simulated('car', imu_grade='mems', duration=30.0, seed=2))
    estimator = estimator_of(aligner)
    assert estimator.count <= 40
    assert len(estimator._gnss.time) == 40


# Consistency

@pytest.fixture(scope='module')
def many_flights():
    """Fly with MEMS IMUs for 50 s: initial and current attitudes with their simulations."""
    runs = []
    for seed in range(24):
        s = simulated('flight', imu_grade='mems', duration=50.0, seed=seed, gnss_rate=2.0,
                      **as_calibrated('mems'))
        runs.append((s, aligned(s)[0]))
    return runs


@pytest.mark.parametrize('which', ('initial', 'current'))
def test_errors_are_as_large_as_stated_and_no_smaller(many_flights, which):
    total = sum(normalised_error(getattr(aligner.status(), which), s)
                for s, aligner in many_flights)
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(many_flights))
    assert low < total < high


def test_biases_are_found_within_their_sigmas(many_flights):
    total = 0.0
    for s, aligner in many_flights:
        status = aligner.status()
        total += np.sum(((status.gyro_bias - s.gyro_bias) / status.gyro_bias_std) ** 2)
        # A tilt takes the place of a horizontal accelerometer bias: they hang together.
        assert np.all(np.abs(status.accel_bias - s.accel_bias) < 5 * status.accel_bias_std)
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(many_flights))
    assert low / 2 < total < 2 * high              # the three axes are not independent


@pytest.mark.parametrize('scenario', ('flight', 'hover'))
def test_biases_that_walk_are_followed(scenario):
    """Over two minutes of a MEMS IMU whose biases walk by their sigma; one and more handovers."""
    walk = PRESETS['mems'].gyro_bias_std / math.sqrt(120.0)
    errors, attitudes, start_errors = [], [], []
    for seed in range(6):
        options = {'imu_grade': 'mems', 'duration': 120.0, 'seed': seed}
        s = simulated(scenario, rate_random_walk=walk, **options)
        walked = (s.gyro - simulated(scenario, **options).gyro)[-1]
        status = aligned(s)[0].status()
        assert status.state is State.ALIGNED
        error = status.gyro_bias - s.gyro_bias - walked
        errors.append(error / status.gyro_bias_std)
        start_errors.append((error + walked) / status.gyro_bias_std)
        attitudes.append(normalised_error(status.current, s) / 3)
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.5
    assert np.sqrt(np.mean(np.square(start_errors))) > 3.0
    assert 0.3 < np.mean(attitudes) < 1.9


def test_residuals_have_their_degrees_of_freedom(many_flights):
    solutions = [estimator_of(aligner).solution for _, aligner in many_flights]
    dof = sum(s.dof for s in solutions)
    # 50 s at 2 Hz, three rows an epoch, minus attitude and start; biases have priors.
    assert solutions[0].dof == 3 * 100 - 6
    low, high = chi2.ppf([0.0005, 0.9995], dof)
    assert low < sum(s.chi2 for s in solutions) < high


def test_unknown_lever_arm_and_delay_are_found_within_their_sigmas():
    s = simulated('flight', imu_grade='mems', duration=50.0, seed=1, gnss_delay=0.12)
    aligner, _ = aligned(s, lever_arm=(0.0, 0.0, 0.0), lever_arm_std=1.0, gnss_delay=0.0,
                         gnss_delay_std=0.1)
    status = aligner.status()
    assert np.all(np.abs(status.lever_arm - s.lever_arm) < 4 * status.lever_arm_std)
    assert np.all(status.lever_arm_std < 1.0)
    assert abs(status.gnss_delay - 0.12) < 4 * status.gnss_delay_std < 0.04
    assert normalised_error(status.initial, s) < chi2.ppf(0.9999, 3)


def walk(duration):
    """Walk: the body heaves with every step and sways with every other one."""
    def wave(t, amplitude, period):
        return amplitude * np.sin(2 * np.pi * t / period)

    def motion(t):
        course = wave(t, 0.8, 40.0)
        ahead, aside = 1.3 + wave(t, 0.15, 0.9), wave(t, 0.1, 1.1)
        velocity = np.stack([ahead * np.cos(course) - aside * np.sin(course),
                             ahead * np.sin(course) + aside * np.cos(course),
                             wave(t, 0.25, 0.55)], axis=-1)
        return Motion(velocity, np.stack([wave(t, 0.05, 1.1), wave(t, 0.05, 0.55),
                                          course + wave(t, 0.08, 1.1)], axis=-1))

    return motion


@pytest.mark.parametrize('delay, seed', [(0.0, 0), (0.06, 1), (0.2, 1)])
def test_unknown_delay_of_a_walker(delay, seed, monkeypatch):
    """
    A third of a step is a long time, and a whole one looks like none.

    A line through the forces was 5 sigma of tilt and more off, the wrong one of several minima 60.
    """
    monkeypatch.setitem(scenarios.SCENARIOS, 'walk', scenarios.Scenario(walk, 120.0, 2.0))
    s = simulate('walk', imu_grade='mems', duration=40.0, seed=seed, gnss_delay=delay,
                 velocity_std=0.05, gnss_rate=20.0, lever_arm=(0.4, 0.6, -0.2),
                 mount_rpy_deg=(-58.0, 77.0, -25.0), heading_deg=-70.0)
    status = aligned(s, gnss_delay=0.0, gnss_delay_std=0.1, lever_arm_std=1.0)[0].status()
    assert status.state is State.ALIGNED
    assert abs(status.gnss_delay - delay) < 4 * status.gnss_delay_std < 0.01
    for attitude in (status.initial, status.current):
        assert normalised_error(attitude, s) < chi2.ppf(0.9999, 3)


# Robustness

def test_outliers_are_rejected_and_counted():
    s = simulated('flight', imu_grade='mems', duration=40.0, seed=5, outlier_rate=0.08)
    clean = simulated('flight', imu_grade='mems', duration=40.0, seed=5)
    spoilt = int(np.count_nonzero(s.outlier))
    assert spoilt > 8
    status = aligned(s)[0].status()
    assert abs(status.counts['epochs_rejected_velocity'] - spoilt) <= 3
    assert normalised_error(status.initial, s) < chi2.ppf(0.9999, 3)
    assert aligned(clean)[0].status().counts['epochs_rejected_velocity'] <= 1


@pytest.mark.parametrize('scenario, rate, understated', [
    ('flight', 5.0, 3.0), ('flight', 5.0, 10.0), ('car', 5.0, 6.0), ('car', 1.0, 6.0)])
def test_noise_that_the_receiver_understates_is_found(scenario, rate, understated):
    s = simulated(scenario, imu_grade='mems', seed=1, duration=60.0, gnss_rate=rate)
    honest = aligned(s)[0].status()
    aligner, _ = aligned(replace(s, velocity_covariance=s.velocity_covariance / understated ** 2))
    status, factor = aligner.status(), math.sqrt(estimator_of(aligner).noise.gnss[0])
    assert status.state is State.ALIGNED
    assert factor == pytest.approx(understated, rel=0.25)
    assert f'velocities are {factor:.1f} times as noisy as stated' in status.reason
    assert np.all(np.abs(np.log(status.current.sigma_deg / honest.current.sigma_deg)) < 0.4)
    assert normalised_error(status.current, s) < chi2.ppf(0.9999, 3)


def test_noise_of_positions_is_found_too():
    s = simulated('flight', imu_grade='mems', seed=1, duration=60.0, position_std=0.02)
    aligner, _ = aligned(replace(s, position_covariance=s.position_covariance / 4.0 ** 2),
                         velocity=False, use_velocity=False)
    velocities, positions = estimator_of(aligner).noise.gnss
    assert velocities == 1.0 and math.sqrt(positions) == pytest.approx(4.0, rel=0.25)
    assert aligner.status().state is State.ALIGNED
    assert normalised_error(aligner.status().current, s) < chi2.ppf(0.9999, 3)


@pytest.mark.parametrize('wrong', [{'flip_axis': 'y'}, {'velocity_frame': 'ned'}])
def test_what_does_not_fit_the_model_is_not_taken_for_noise(wrong):
    s = simulated('flight', imu_grade='mems', seed=1, duration=30.0, **wrong)
    aligner, _ = aligned(s, velocity_frame='enu')
    solution = estimator_of(aligner).solution
    assert solution.chi2 > 10.0 * solution.dof
    assert estimator_of(aligner).noise.gnss == (1.0, 1.0)


def test_receiver_that_comes_back_after_an_outage_goes_on():
    s = simulated('flight', imu_grade='mems', duration=60.0, seed=6, outages=((20.0, 35.0),))
    status = aligned(s)[0].status()
    assert status.counts['epochs_rejected_velocity'] <= 3
    assert status.counts.get('restarts', 0) == 0
    assert normalised_error(status.current, s) < chi2.ppf(0.9999, 3)


def test_attitude_is_carried_on_by_the_gyros_during_an_outage():
    s = simulated('flight', imu_grade='mems', duration=40.0, seed=6, outages=((20.0, 60.0),))
    before = simulated('flight', imu_grade='mems', duration=20.0, seed=6)
    status, earlier = aligned(s)[0].status(), aligned(before)[0].status()
    assert status.stamp_ns - earlier.stamp_ns > 15e9
    assert normalised_error(status.current, s) < chi2.ppf(0.9999, 3)
    assert np.all(status.current.sigma_deg > earlier.current.sigma_deg)
    assert np.allclose(status.initial.sigma_deg, earlier.initial.sigma_deg, rtol=0.02)


@pytest.mark.parametrize('scenario, options', [
    ('launch', {'imu_grade': 'mems', 'seed': 1}),
    ('car', {'imu_grade': 'tactical', 'seed': 3, 'position_std': 0.02}),
    ('car', {'imu_grade': 'navigation', 'seed': 3, 'position_std': 0.02}),
])
@pytest.mark.parametrize('position', (False, True))
def test_sudden_observability_finds_the_right_heading(scenario, options, position):
    """A heading open over the whole circle that a throw or the first metres settle at once."""
    s = simulated(scenario, duration=20.0, **options)
    status = aligned(s, use_velocity=not position, use_position=position)[0].status()
    assert status.initial is not None
    assert normalised_error(status.initial, s) < chi2.ppf(0.99999, 3)


@pytest.mark.parametrize('heading', (0.0, 90.0, 179.0, -120.0))
def test_any_heading_is_found_from_a_stand_still(heading):
    s = simulated('car', imu_grade='mems', duration=25.0, seed=8, heading_deg=heading)
    status = aligned(s)[0].status()
    assert normalised_error(status.initial, s) < chi2.ppf(0.99999, 3)
    assert abs(np.degrees(error_of(status.initial, s)[2])) < 5.0


def test_few_rows_and_many_dry_epochs_break_nothing():
    s = simulated('flight', imu_grade='mems', duration=60.0, seed=6, outages=((0.3, 50.0),))
    status = aligned(s)[0].status()
    assert np.all(np.isfinite(status.gyro_bias))
    assert status.initial is None or np.all(np.isfinite(status.initial.covariance))


def test_static_navigation_grade_finds_north_by_the_turning_earth():
    s = simulated('static', imu_grade='navigation', duration=150.0, seed=1, gnss_rate=1.0,
                  imu_rate=50.0, heading_deg=70.0)
    limit = bound(s)
    status = aligned(s)[0].status()
    error = np.degrees(error_of(status.initial, s)[2])
    sigma = status.initial.sigma_deg[2]
    assert sigma < 4.0
    assert sigma == pytest.approx(np.degrees(np.sqrt(limit.covariance[-1][2, 2])), rel=0.15)
    assert abs(error) < 3.5 * sigma


def test_north_at_rest_is_declared_where_the_axes_are_known_to_be_right():
    s = simulated('static', imu_grade='navigation', duration=150.0, seed=1, gnss_rate=1.0,
                  imu_rate=50.0, heading_deg=70.0)
    wanted = {'heading_std_threshold': 5.0}
    # A reversed axis would fit as well: nothing has turned.
    assert aligned(s, **wanted)[0].status().state is State.LEVELLED
    status = aligned(s, trust_imu_axes=True, **wanted)[0].status()
    assert status.state is State.ALIGNED
    assert abs(np.degrees(error_of(status.initial, s)[2])) < 3 * status.initial.sigma_deg[2]


@pytest.mark.parametrize('scenario', ('static', 'straight'))
def test_mems_without_manoeuvre_never_claims_a_heading(scenario):
    s = simulated(scenario, imu_grade='mems', duration=120.0, seed=2, gnss_rate=2.0, imu_rate=50.0)
    _, epochs = aligned(s)
    # Uniform on the circle is 104 deg.
    assert min(e.initial.sigma_deg[2] for e in epochs if e.initial is not None) > 50.0


def test_configuration_reaches_the_estimator():
    s = simulated('flight', imu_grade='mems', duration=20.0, seed=3)
    assert config_for(s).lever_arm == LEVER
    status = aligned(s, lever_arm_std=0.3)[0].status()
    assert np.all((0 < status.lever_arm_std) & (status.lever_arm_std <= 0.3))
    status = aligned(s)[0].status()
    assert np.all(status.lever_arm_std == 0) and status.gnss_delay_std == 0
