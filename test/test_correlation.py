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
"""Errors of the GNSS that last from epoch to epoch, and the sigma that knows of them."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

from alignment import aligned, error_of, estimator_of, simulated
from ins_align.correlation import Correlation, LAGS
from ins_align.methods import MapMethod
import numpy as np
import pytest

STD = 0.1                               # of the velocities, m/s


def autoregressive(count, rho, seed):
    """Errors of unit variance each of which is rho times the last one and something new."""
    new = np.random.default_rng(seed).standard_normal((count, 3))
    errors = new.copy()
    for k in range(1, count):
        errors[k] = rho * errors[k - 1] + np.sqrt(1.0 - rho ** 2) * new[k]
    return errors


def watched(innovations):
    """Return what becomes of variances, epoch by epoch."""
    correlation = Correlation()
    factors = []
    for innovation in innovations:
        correlation.add(innovation)
        factors.append(correlation.gnss)
    return np.array(factors)


def test_white_innovations_change_nothing():
    for seed in range(30):
        assert np.all(watched(autoregressive(1000, 0.0, seed)) == 1.0)


@pytest.mark.parametrize('rho', [0.6, 0.8, 0.9])
def test_lasting_errors_count_less(rho):
    lags = np.arange(1, LAGS + 1)
    exact = 1.0 + 2.0 * np.sum((1.0 - lags / (LAGS + 1)) * rho ** lags)
    found = np.mean([watched(autoregressive(1500, rho, seed))[-1] for seed in range(10)])
    assert 0.6 * exact < found < exact < (1.0 + rho) / (1.0 - rho)


def test_errors_that_do_not_last_any_more_are_forgotten():
    factors = watched(np.concatenate([autoregressive(600, 0.9, 3), autoregressive(3000, 0.0, 4)]))
    assert factors[599] > 3.0 and factors[-1] == 1.0


def test_one_group_of_outliers_is_no_lasting_error():
    innovations = autoregressive(300, 0.0, 1)
    innovations[150:155] = 50.0
    assert np.all(watched(innovations) == 1.0)


def test_epochs_without_a_measurement_say_nothing():
    errors = autoregressive(300, 0.9, 2)
    none = np.full((300, 3), np.nan)
    with_gaps = np.stack([errors, none], axis=1).reshape(-1, 3)
    assert np.array_equal(watched(with_gaps)[::2], watched(errors))
    assert np.all(watched(none) == 1.0) and np.all(watched(np.zeros((300, 3))) == 1.0)


@pytest.mark.parametrize('scenario, grade', [
    ('car', 'navigation'), ('hover', 'tactical'), ('hover', 'mems'), ('flight', 'mems')])
def test_share_of_the_gnss_is_what_its_noise_adds(scenario, grade):
    s = simulated(scenario, imu_grade=grade, seed=3, duration=40.0)
    one, twice = (aligned(replace(s, velocity_covariance=factor * s.velocity_covariance))[0]
                  for factor in (1.0, 2.0))
    variances = np.array([np.concatenate([status.initial.sigma_deg, status.current.sigma_deg])
                          for status in (one.status(), twice.status())]) ** 2
    share = estimator_of(one).gnss_share(0.0)
    assert share == pytest.approx(np.max(variances[1] / variances[0]) - 1.0, abs=0.1)
    # Where all that the prior knows comes from the GNSS, there is more.
    assert share <= estimator_of(one).gnss_share(1.0) <= 1.0


def test_a_share_of_the_prior_counts_where_the_prior_does(monkeypatch):
    """What was handed over comes from the GNSS of before, which is as loud."""
    monkeypatch.setattr('ins_align.alignment.MapMethod', partial(MapMethod, capacity=60))
    s = simulated('flight', imu_grade='tactical', seed=3, duration=27.0)
    estimator = estimator_of(aligned(s)[0])
    assert estimator.prior.information[0, 0] > 0.0
    assert estimator.gnss_share(1.0) > estimator.gnss_share(0.0) + 0.1


def test_the_next_estimator_is_told_what_its_prior_has_of_the_gnss():
    """Whoever goes on knows that of the one before, which was asked at its own first time."""
    correlation, told = Correlation(), []
    for innovation in autoregressive(300, 0.9, 5):
        correlation.add(innovation)
    for share in (0.6, 0.7):
        def gnss_share(of_prior, share=share):
            told.append(of_prior)
            return share

        estimator = SimpleNamespace(converged=True, measured=100, count=100, FIRST_FIT=4,
                                    gnss_share=gnss_share)
        for _ in range(3):                              # asked once at so many epochs
            correlation.ask(estimator)
        assert correlation.attitude == pytest.approx(1.0 + share * (correlation.gnss - 1.0))
        correlation.restart()
    assert told == [0.0, 0.6]


@pytest.mark.parametrize('scenario, grade', [('hover', 'tactical'), ('car', 'tactical'),
                                             ('hover', 'mems')])
def test_sigma_knows_of_velocities_whose_errors_last(scenario, grade):
    normalised, factors = [], []
    for seed in range(6):
        options = {'imu_grade': grade, 'seed': seed, 'duration': 80.0}
        true = simulated(scenario, ideal=True, **options).velocity
        s = simulated(scenario, **options)
        # Of the stated size, and hanging together over two seconds.
        errors = STD * autoregressive(len(true), np.exp(-0.2 / 2.0), 100 + seed)
        aligner, _ = aligned(replace(s, velocity=true + errors))
        white, _ = aligned(s)
        found = aligner.status()
        normalised.append(error_of(found.current, s) / np.radians(found.current.sigma_deg))
        factors.append(found.current.sigma_deg[2] / white.status().current.sigma_deg[2])
    # Without it about 3.
    assert np.sqrt(np.mean(np.square(normalised))) < 2.0
    assert np.median(factors) > 1.3
