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
"""What `info` tells of sensors and advises, on simulations whose errors are known."""

import dataclasses
import math
import re
import shlex

from ins_align.cli import main
from ins_align.config import Config
from ins_align.estimation.rivals import level_in_words, Rival
from ins_align.estimation.states import biases, GYRO
from ins_align.recordings.info import describe, inspect
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest

QUANTUM = math.radians(0.57)
NO_COVARIANCE = np.zeros((3, 3))


def drive(seed=1, duration=100.0, **arguments):
    return simulate('car', seed=seed, duration=duration, stand_still=20.0, **arguments)


def inspected(simulation, path, **changes):
    """Write a simulation with some of its arrays changed, and inspect it."""
    write_bag(dataclasses.replace(simulation, **changes), path)
    return inspect(path)


def settings_of(info):
    """Return the parameters that the command sets."""
    assert info.command is not None, info.faults
    words = shlex.split(info.command)
    return dict(words[k + 1].split('=') for k, word in enumerate(words) if word == '--set')


def imu_of(info):
    return next(topic.figures for topic in info.topics if topic.kind == 'imu')


def test_coarse_gyros_are_named_as_such(tmp_path):
    truth = drive()
    gyro = np.round(truth.gyro / QUANTUM) * QUANTUM
    info = inspected(truth, tmp_path / 'a', gyro=gyro)
    said = describe(info)
    zeros = np.mean(gyro == 0.0, axis=0).max()
    assert f'gyroscopes round to multiples of 0.57 deg/s: {zeros:.0%} of the samples' in said
    assert 'dead band' not in said
    assert 'accelerometers round' not in said
    # Nothing is measured of a bias that is rounded away.
    assert re.search(r'rate \(.*\) \+- 0.28 deg/s', said) and 'of rounding' in said
    settings = settings_of(info)
    # Uniform within half a quantum.
    assert float(settings['gyro_bias_std']) >= 0.57 / math.sqrt(12.0) * 0.95
    assert float(settings['angle_random_walk']) > 0.9
    assert imu_of(info)['imu_grade'] == 'mems' and 'worse than imu_grade mems\n' in said


@pytest.mark.parametrize('quantum, said', [
    (1e-4, 'round to multiples of 0.0057 deg/s'), (0.0, '')])
def test_a_quantum_below_the_noise_does_no_harm(tmp_path, quantum, said):
    truth = drive(duration=40.0)
    gyro = np.round(truth.gyro / quantum) * quantum if quantum else truth.gyro
    info = inspected(truth, tmp_path / 'a', gyro=gyro)
    assert said in describe(info) and ('gyroscopes round' in describe(info)) == bool(said)
    assert 'of rounding' not in describe(info) and settings_of(info) == {}
    assert imu_of(info)['angle_random_walk'] == pytest.approx(0.3, rel=0.15)


@pytest.mark.parametrize('quantum', [0.0, math.radians(0.1)])
def test_dead_band(tmp_path, quantum):
    truth = drive()
    band = math.radians(1.0)
    gyro = np.where(np.abs(truth.gyro) < band, 0.0, truth.gyro)
    if quantum:
        gyro = np.round(gyro / quantum) * quantum
    info = inspected(truth, tmp_path / 'a', gyro=gyro)
    assert imu_of(info)['gyroscopes_dead_band'] == pytest.approx(band, abs=quantum + 1e-3)
    assert imu_of(info)['gyroscopes_quantum'] == pytest.approx(quantum, rel=0.01)
    assert 'gyroscopes have a dead band: nothing between 0 and 1 deg/s' in describe(info)
    uniform = 1.0 / math.sqrt(3.0)
    assert float(settings_of(info)['gyro_bias_std']) == pytest.approx(uniform, rel=0.1)


@pytest.mark.parametrize('error', [-0.4, 0.15, 0.53])
def test_accelerometers_that_are_off_gravity_at_rest(tmp_path, error):
    truth = drive(accel_bias_std=0.0, duration=40.0)
    info = inspected(truth, tmp_path / 'a', accel=truth.accel + [0.0, 0.0, error])
    assert imu_of(info)['rest_force_error'] == pytest.approx(error, abs=0.01)
    off = imu_of(info)['rest_force_error']
    assert f'specific force {off:+.3f} m/s^2 off gravity' in describe(info)
    settings = settings_of(info)
    assert float(settings.pop('accel_bias_std')) == pytest.approx(abs(error), rel=0.05)
    assert settings == {}


def test_accelerometers_in_another_unit(tmp_path):
    """In feet; means up to 60 m/s^2 are possible in loops, but not at rest."""
    truth = drive(accel_bias_std=0.0, duration=40.0)
    info = inspected(truth, tmp_path / 'a', accel=truth.accel / 0.3048)
    assert info.command is None
    assert 'the specific force at rest is 32.2 m/s^2, gravity is 9.81: check the unit' in (
        describe(info))


@pytest.mark.parametrize('scale', [0.79, 0.97])
def test_accelerometers_that_read_too_little(tmp_path, scale):
    """No motion does that, and it is no noise of the GNSS."""
    truth = simulate('flight', seed=1, duration=80.0)
    mean = np.linalg.norm(truth.accel, axis=1).mean()
    info = inspected(truth, tmp_path / 'a', accel=truth.accel * scale * 9.81 / mean,
                     velocity_covariance=NO_COVARIANCE)
    said = f'the accelerometers read {1.0 - scale:.0%} too little' in describe(info)
    assert said == (scale < 0.9)
    assert ('velocity_std' in settings_of(info)) != said


def test_a_setting_beyond_its_limits_is_a_fault(tmp_path):
    truth = drive(duration=240.0)
    info = inspected(truth, tmp_path / 'a', gnss_stamps_ns=truth.gnss_stamps_ns + 60_100_000_000,
                     gnss_arrival_ns=truth.gnss_arrival_ns + 300_000_000)
    assert info.command is None and 'gnss_delay must be' in describe(info)


def test_what_is_carried_at_rest_for_the_receiver_is_not_at_rest(tmp_path):
    truth = drive(duration=40.0)
    time = (truth.imu_stamps_ns - truth.imu_stamps_ns[0]) * 1e-9
    turned = truth.gyro + 0.5 * ((12.0 < time) & (time < 14.0))[:, None]
    info = inspected(truth, tmp_path / 'a', gyro=turned)
    assert imu_of(info)['rest_s'] == pytest.approx(10.0, abs=1.0)
    assert settings_of(info) == {}


@pytest.mark.parametrize('seed', (0, *(
    pytest.param(seed, marks=pytest.mark.campaign) for seed in (1, 2))))
def test_an_imu_as_good_as_its_grade_needs_no_setting(tmp_path, seed):
    info = inspected(drive(seed=seed), tmp_path / 'a')
    assert settings_of(info) == {}


@pytest.mark.parametrize('scenario, arguments', [
    ('launch', {'lever_arm': (0.0, 0.0, 3.0)}), ('car', {'duration': 100.0, 'outlier_rate': 0.02}),
    ('flight', {'duration': 120.0}), pytest.param(
        'car', {'duration': 200.0, 'gnss_rate': 1.0}, marks=pytest.mark.campaign)])
@pytest.mark.parametrize('delay', [
    -0.1, pytest.param(0.3, marks=pytest.mark.campaign), 0.8, -18.0])
def test_delay_of_the_receiver(tmp_path, scenario, arguments, delay):
    """Whatever the lever arm is, which nobody has stated."""
    truth = simulate(scenario, seed=4, gnss_delay=max(delay, 0.0),
                     **{'lever_arm': (1.0, -0.5, 1.5), **arguments})
    early = round(min(delay, 0.0) * 1e9)
    info = inspected(truth, tmp_path / 'a', gnss_stamps_ns=truth.gnss_stamps_ns + early)
    assert info.figures['gnss_delay'] == pytest.approx(delay, abs=0.05)
    settings = settings_of(info)
    assert float(settings.pop('gnss_delay')) == pytest.approx(delay, abs=0.05)
    assert settings == {}


@pytest.mark.parametrize('scenario', ['car', 'launch'])
def test_clocks_that_drift_apart_have_no_delay_of_their_own(tmp_path, scenario):
    truth = simulate(scenario, seed=4, duration=150.0)
    drift = np.linspace(120e6, 0.0, truth.gnss_stamps_ns.size).astype(np.int64)
    info = inspected(truth, tmp_path / 'a', gnss_stamps_ns=truth.gnss_stamps_ns + drift)
    assert info.figures['gnss_delay'] == pytest.approx(0.06, abs=0.02)
    assert 0.03 < info.figures['gnss_delay_std'] < 0.06     # 0.12 / sqrt(12) = 0.035
    assert 'gnss_delay' not in settings_of(info)


@pytest.mark.parametrize('offset, drift', [(0.0, 0.3), (-4.8, 0.7)])
def test_no_delay_is_told_where_it_is_not_known_to_a_twentieth_of_a_second(
        tmp_path, offset, drift):
    """Nor one of a clock that is right, if the motion is seconds off; the noise is that there."""
    truth = simulate('car', seed=4, duration=150.0)
    offsets = 1e9 * (offset + np.linspace(0.5 * drift, -0.5 * drift, truth.gnss_stamps_ns.size))
    late_ns = offsets.astype(np.int64)
    info = inspected(truth, tmp_path / 'a', gnss_stamps_ns=truth.gnss_stamps_ns + late_ns,
                     gnss_arrival_ns=truth.gnss_arrival_ns + late_ns)
    assert 'delay of the GNSS' not in describe(info)
    assert not {'gnss_delay', 'gnss_delay_std'} & set(info.figures)
    assert info.figures['velocity_noise'] == pytest.approx(0.1, abs=0.03)


@pytest.mark.parametrize('scenario', ['straight', 'static', 'swing', 'car'])
def test_no_delay_is_told_where_there_is_none_or_no_motion(tmp_path, scenario):
    """The antenna of a boat that yaws on its course moves, and its heading is open."""
    info = inspected(simulate(
        scenario, seed=3, gnss_delay=0.0 if scenario == 'car' else 0.5, imu_grade='tactical',
        lever_arm=(2.0, -1.0, 1.0)), tmp_path / 'a')
    assert 'gnss_delay' not in settings_of(info)
    assert ('gnss_delay' in info.figures) == (scenario == 'car')


@pytest.mark.parametrize('scenario', [
    'car', *(pytest.param(name, marks=pytest.mark.campaign) for name in ('flight', 'static'))])
@pytest.mark.parametrize('std, vertical', [(0.05, 0.1), (0.3, 0.3), (1.0, 2.0)])
def test_noise_of_a_velocity_without_covariance(tmp_path, scenario, std, vertical):
    truth = simulate(scenario, seed=5, velocity_std=std, velocity_std_vertical=vertical,
                     outlier_rate=0.01)
    info = inspected(truth, tmp_path / 'a', velocity_covariance=NO_COVARIANCE)
    settings = settings_of(info)
    assert 1 / 1.5 < float(settings['velocity_std']) / std < 1.5
    assert 1 / 1.5 < float(settings['velocity_std_vertical']) / vertical < 1.5
    assert 'noise of the GNSS velocity' in describe(info)
    stated = inspected(truth, tmp_path / 'b')
    assert not [name for name in settings_of(stated) if name.startswith('velocity_std')]


def test_everything_at_once_and_its_command_aligns(tmp_path):
    """A coarse IMU far off its grade beside a receiver that is late and states no covariance."""
    truth = drive(seed=6, gnss_delay=0.6, duration=120.0, accel_bias_std=0.0)
    info = inspected(
        truth, tmp_path / 'a', gyro=np.round(truth.gyro / QUANTUM) * QUANTUM,
        accel=truth.accel + [0.1, -0.1, 0.4], velocity_covariance=NO_COVARIANCE)
    settings = settings_of(info)
    assert float(settings['gnss_delay']) == pytest.approx(0.6, abs=0.05)
    assert float(settings['accel_bias_std']) == pytest.approx(0.4, abs=0.05)
    assert {'gyro_bias_std', 'angle_random_walk', 'velocity_std'} < set(settings)
    assert main([*shlex.split(info.command)[1:], '--set', 'lever_arm=[1,1,1]']) == 0


@pytest.mark.parametrize('seed', [1, pytest.param(2, marks=pytest.mark.campaign)])
def test_a_chip_aligns_with_thresholds_that_it_reaches(tmp_path, seed):
    truth = drive(seed=seed, imu_grade='chip', duration=120.0)
    info = inspected(truth, tmp_path / 'a')
    assert set(settings_of(info)) == {'imu_grade', 'tilt_std_threshold', 'heading_std_threshold'}
    assert main([*shlex.split(info.command)[1:], '--set', 'lever_arm=[1,1,1]']) == 0


@pytest.mark.parametrize('factor', [1.0, 8.0])
def test_a_receiver_that_overstates_its_noise(tmp_path, factor):
    truth = drive(velocity_std=0.05, velocity_std_vertical=0.05)
    info = inspected(truth, tmp_path / 'a',
                     velocity_covariance=factor ** 2 * truth.velocity_covariance)
    assert ('much less than stated' in describe(info)) == (factor > 1.0)
    assert settings_of(info) == {}


def test_of_rates_in_degrees_nothing_is_told_in_degrees(tmp_path):
    truth = drive(duration=60.0)
    info = inspected(truth, tmp_path / 'a', gyro=np.degrees(truth.gyro))
    assert info.command is None and 'look like deg/s: they must be rad/s' in info.faults[0]
    assert not {'max_rate_deg_s', 'rest_rate_deg_s', 'angle_random_walk'} & set(imu_of(info))


@pytest.mark.parametrize('gyro_bias', [0.0, 0.05, 0.8])  # deg/s, where mems has 0.1
@pytest.mark.parametrize('accel_bias', [0.0, 0.04, 0.3])  # m/s^2, where mems has 0.05
def test_a_level_names_the_setting_that_a_bias_asks_for(gyro_bias, accel_bias):
    """What looks worse for other reasons gets no better with larger biases configured."""
    x = np.zeros(GYRO + 6)
    gyro, accel = biases(x.size)
    x[gyro], x[accel] = [0.0, -np.radians(gyro_bias), 0.0], [accel_bias, 0.0, 0.0]
    P = np.radians(0.01) ** 2 * np.eye(x.size)
    said = level_in_words(Rival(gyro=3.0), Config(), x, P)
    assert ('gyro_bias_std=0.8' in said) == (gyro_bias == 0.8)
    assert ('accel_bias_std=0.3' in said) == (accel_bias == 0.3)
    assert ('gyros look worse' in said) != ('_std=' in said)
    assert level_in_words(Rival(), Config(), x, P) == ''
    assert '_std=' not in level_in_words(Rival(gyro=3.0), Config(), 100.0 * x, P)
    hardly_known = np.diag(0.25 * x ** 2)
    assert '_std=' not in level_in_words(Rival(gyro=3.0), Config(), x, hardly_known)


def test_both_biases_beyond_the_default_are_another_grade(tmp_path):
    truth = drive(gyro_bias_std=0.0, accel_bias_std=0.0, duration=60.0)
    info = inspected(truth, tmp_path / 'a', accel=truth.accel + [0.0, 0.0, 0.5],
                     gyro=truth.gyro + np.radians([0.8, -0.8, 0.8]))
    assert settings_of(info)['imu_grade'] == 'chip' and 'gyro_bias_std' not in settings_of(info)
    assert 'suits imu_grade chip' in describe(info)


@pytest.mark.parametrize('error, is_set', [(0.0, False), (0.4, True)])
def test_a_bias_is_among_the_settings_only_where_it_is_said(tmp_path, error, is_set):
    truth = drive(accel_bias_std=0.0, duration=40.0)
    noise = np.radians(0.5) * np.random.default_rng(1).standard_normal(truth.gyro.shape)
    info = inspected(truth, tmp_path / 'a', gyro=truth.gyro + noise,
                     accel=truth.accel + [0.0, 0.0, error])
    assert 'worse than imu_grade mems: more noise' in describe(info)
    assert ('accel_bias_std' in settings_of(info)) == is_set
