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
"""The alignment methods on noise-free flights, and what they say of themselves."""

from alignment import aligned, error_deg, error_of, normalised_error, simulated
import numpy as np
import pytest
from scipy.stats import chi2

PLACES = {
    'north': {'latitude_deg': 48.0}, 'south': {'latitude_deg': -37.0},
    'arctic': {'latitude_deg': 80.0},
    'antimeridian': {'latitude_deg': -18.0, 'longitude_deg': 179.9999},
}
FORMULAS = {
    'vif': {'method': 'vif'}, 'vif to the letter': {'method': 'vif', 'free_start': False},
    'pif': {'method': 'pif'}, 'pif to the letter': {'method': 'pif', 'free_start': False},
    'pif of positions': {'method': 'pif', 'velocity': False},
    'pif of positions to the letter': {'method': 'pif', 'velocity': False, 'free_start': False},
}
BANKS = {'bank': {'method': 'bank'}, 'bank of positions': {'method': 'bank', 'velocity': False}}
METHODS = {**FORMULAS, **BANKS}
SHARP = {'velocity_std': 0.02, 'position_std': 0.02}


def after_ten_seconds(s, **changes):
    # Positions alone are waited for: 12 s of recording are 10 s of alignment.
    epoch = [epoch for epoch in aligned(s, **changes)[1] if epoch.t_s <= 10.01][-1]
    assert epoch.t_s > 9.0
    return epoch


def check_bank(epoch, s):
    """
    Check that an error that no noise makes adds nothing to speak of to the stated one.

    What is left of the attitudes it starts with and what is of second order in a degree: a
    twentieth of a sigma makes rms errors larger by a thousandth.
    """
    for attitude in (epoch.initial, epoch.current):
        assert normalised_error(attitude, s) < 0.05 ** 2
        assert np.all(attitude.sigma_deg < 1.0)


@pytest.mark.parametrize('method', FORMULAS)
@pytest.mark.parametrize('place', PLACES)
def test_noise_free_flight_is_aligned_to_a_thousandth_of_a_degree(place, method):
    s = simulated('flight', ideal=True, duration=12.2, **PLACES[place])
    epoch = after_ten_seconds(s, **FORMULAS[method])
    assert error_deg(epoch.initial, s) < 1e-3
    assert error_deg(epoch.current, s) < 1e-3


@pytest.mark.parametrize('method', BANKS)
@pytest.mark.parametrize('options', (
    *PLACES.values(),
    {'mount_rpy_deg': (10.0, -70.0, 130.0)}, {'imu_jitter': 0.4}, {'gnss_rate': 1.0},
    {'gnss_phase': 0.01}, {'gnss_latency': 0.4}, {'imu_rate': 200.0, 'gnss_rate': 10.0}))
def test_bank_minds_neither_place_nor_mount_jitter_rates_or_latency(options, method):
    s = simulated('flight', ideal=True, duration=12.2, **{**SHARP, **options})
    check_bank(after_ten_seconds(s, **BANKS[method]), s)


@pytest.mark.parametrize('method', METHODS)
def test_sigma_is_no_smaller_than_the_noise_of_the_receiver_makes_the_error(method):
    """Of an IMU whose errors do not matter: the formulas know none."""
    squares = 0.0
    for seed in range(8):
        s = simulated('flight', imu_grade='navigation', duration=20.0, seed=seed, gnss_rate=2.5,
                      heading_deg=40.0 * seed, gyro_bias_std=1e-9, accel_bias_std=1e-6)
        squares += normalised_error(aligned(s, **METHODS[method])[0].status().initial, s)
    assert squares < chi2.ppf(0.999, 3 * 8)


def test_known_delay_is_taken_into_account():
    s = simulated('flight', ideal=True, duration=12.2, gnss_delay=0.2, **SHARP)
    right, wrong = (after_ten_seconds(s, gnss_delay=delay) for delay in (0.2, 0.0))
    check_bank(right, s)
    assert normalised_error(wrong.initial, s) > 1.0


@pytest.mark.parametrize('method', ('vif', 'pif'))
def test_sigma_of_the_note_is_honest_where_its_model_holds(method):
    """Navigation grade for ten seconds: GNSS noise is all that matters."""
    total = 0.0
    seeds = range(16)
    for seed in seeds:
        s = simulated('flight', imu_grade='navigation', duration=10.0, seed=seed)
        total += normalised_error(aligned(s, method=method)[0].status().initial, s)
    if method == 'vif':
        low, high = chi2.ppf([0.0005, 0.9995], 3 * len(seeds))
        assert low < total < high
    else:
        # Integrated velocity noise is not white, which the note's sum of squares ignores.
        assert np.isfinite(total)


def test_biases_spoil_the_note_and_not_the_bank():
    errors = {'vif': [], 'bank': []}
    for seed in range(4):
        s = simulated('car', imu_grade='mems', duration=50.0, seed=seed, gnss_rate=2.0)
        for method, found in errors.items():
            status = aligned(s, method=method)[0].status()
            found.append(abs(np.degrees(error_of(status.initial, s)[2])))
    assert np.median(errors['bank']) < 0.5 < 1.0 < np.median(errors['vif'])


@pytest.mark.parametrize('method', FORMULAS)
def test_formula_gives_no_attitude_before_its_sigma_means_something(method):
    _, epochs = aligned(simulated('flight', duration=4.0), **FORMULAS[method])
    known = [epoch for epoch in epochs if epoch.initial is not None]
    assert 0 < len(known) < len(epochs)
    assert all(np.isfinite(attitude.covariance).all() for epoch in known
               for attitude in (epoch.initial, epoch.current))


def test_what_the_note_does_not_estimate_it_says_to_be_as_configured():
    s = simulated('flight', ideal=True, duration=12.2)
    status = aligned(s, method='vif')[0].status()
    assert np.array_equal(status.gyro_bias, np.zeros(3))
    assert np.array_equal(status.lever_arm, s.lever_arm)


@pytest.mark.parametrize('method', ('vif', 'bank'))
def test_without_gnss_the_gyros_errors_count(method):
    """They alone carry the attitude on."""
    s = simulated('car', imu_grade='tactical', seed=1, duration=400.0, imu_rate=50.0,
                  outages=((60.0, 400.0),))
    aligner, epochs = aligned(s, method=method)
    status = aligner.status()
    assert epochs[-1].t_s < 61.0 and 'no GNSS for' in status.reason
    before = epochs[-1].current.sigma_deg
    assert np.all(status.current.sigma_deg > before)
    error = np.degrees(np.abs(error_of(status.current, s)))
    assert np.all(error < 4.0 * np.array(status.current.sigma_deg))
