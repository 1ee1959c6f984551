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
"""Simulated recordings against python-ins' own mechanisation, statistics, and what was asked."""

from dataclasses import replace
import math

from ins_align.config import config_from_mapping, ImuNoise, load_params, PRESETS
from ins_align.geometry.rotation import log_so3, matrix_from_quaternion, matrix_from_rpy
from ins_align.gnss.messages import ENU_FROM_NED
from ins_align.simulation import scenarios
from ins_align.simulation.scenarios import FLU_FROM_FRD, START_NS
from ins_align.simulation.simulate import simulate, SimulationError, write_bag
import numpy as np
import pytest

EARTH_RATE = 7.292115e-5


def seconds(stamps_ns):
    return (stamps_ns - START_NS) * 1e-9


def assert_same(ours, theirs):
    """Of the same random numbers; the last bit may change from call to call."""
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def ecef(lla):
    from pyins.transform import lla_to_ecef
    return lla_to_ecef(lla)


def matrix_en(lla):
    from pyins.transform import mat_en_from_ll
    return mat_en_from_ll(lla[:, 0], lla[:, 1]) @ ENU_FROM_NED


def angle_deg(C_1, C_2):
    return np.degrees(np.linalg.norm(log_so3(C_1 @ np.swapaxes(C_2, -1, -2)), axis=-1))


@pytest.mark.parametrize('scenario, options', [
    *((name, {}) for name in scenarios.SCENARIOS),
    ('flight', {'latitude_deg': -40.0}),
    ('flight', {'latitude_deg': 80.0, 'heading_deg': 130.0}),
    ('flight', {'imu_jitter': 0.3}),
    ('car', {'stand_still': 5.0, 'crab_deg': 8.0}),
])
@pytest.mark.filterwarnings('ignore:The copy keyword')  # of pandas, in python-ins
def test_strapdown_integration_ends_at_the_truth(scenario, options):
    import pandas as pd
    from pyins import strapdown, transform, util
    s = simulate(scenario, ideal=True, duration=30.0, imu_rate=400.0, **options)
    imu = pd.DataFrame(np.hstack([s.gyro @ FLU_FROM_FRD, s.accel @ FLU_FROM_FRD]),
                       index=seconds(s.imu_stamps_ns),
                       columns=util.GYRO_COLS + util.ACCEL_COLS)
    rph = transform.mat_to_rph(ENU_FROM_NED @ s.truth_C_nb[0] @ FLU_FROM_FRD)
    start = pd.Series(np.concatenate([s.truth_lla[0], s.truth_velocity[0] @ ENU_FROM_NED, rph]),
                      index=util.TRAJECTORY_COLS)
    increments = strapdown.compute_increments_from_imu(imu, 'rate')
    end = strapdown.Integrator(start).integrate(increments).iloc[-1]
    C_nb = (ENU_FROM_NED @ transform.mat_from_rph(end[util.RPH_COLS].to_numpy())
            @ FLU_FROM_FRD)
    assert angle_deg(C_nb, s.truth_C_nb[-1]) < 5e-5
    velocity = end[util.VEL_COLS].to_numpy() @ ENU_FROM_NED
    np.testing.assert_allclose(velocity, s.truth_velocity[-1], atol=3e-4)
    np.testing.assert_allclose(ecef(end[util.LLA_COLS].to_numpy()), ecef(s.truth_lla[-1]),
                               atol=5e-3)


def test_static_sensors_feel_the_earth():
    s = simulate('static', ideal=True, latitude_deg=45.0, altitude=0.0, heading_deg=90.0,
                 duration=2.0)
    # The vehicle points north: x north, y west, z up.
    root = math.sqrt(0.5)
    np.testing.assert_allclose(s.gyro, np.tile([EARTH_RATE * root, 0, EARTH_RATE * root],
                                               (201, 1)), atol=1e-11)
    # WGS 84 normal gravity at 45 degrees on the ellipsoid. Single samples carry the rounding of
    # positions of 6e6 m, differentiated twice.
    np.testing.assert_allclose(s.accel.mean(axis=0), [0, 0, 9.806197769], atol=1e-6)
    np.testing.assert_allclose(s.accel, np.tile([0, 0, 9.806197769], (201, 1)), atol=2e-4)
    np.testing.assert_array_equal(s.velocity, 0.0)


@pytest.mark.parametrize('scenario, options', [
    ('flight', {}), ('flight', {'latitude_deg': 80.0, 'lever_arm': (5.0, -3.0, 2.0)}),
    ('hover', {'mount_rpy_deg': (170.0, 85.0, -60.0)}), ('swing', {'latitude_deg': -33.0}),
    ('car', {'crab_deg': 15.0}),
])
def test_antenna_velocity_is_the_derivative_of_its_position(scenario, options):
    s = simulate(scenario, ideal=True, duration=30.0, gnss_rate=50.0, **options)
    r = ecef(s.lla_deg)
    slope = (8 * (r[3:-1] - r[1:-3]) - (r[4:] - r[:-4])) * 50.0 / 12
    velocity = np.einsum('nji,nj->ni', matrix_en(s.lla_deg[2:-2]), slope)
    np.testing.assert_allclose(s.velocity[2:-2], velocity, atol=4e-5)


def test_antenna_is_at_the_end_of_the_lever_arm():
    s = simulate('flight', ideal=True, duration=20.0, gnss_phase=0.0, gnss_rate=5.0,
                 lever_arm=(5.0, -3.0, 2.0), latitude_deg=80.0, mount_rpy_deg=(10.0, 20.0, 30.0))
    at = np.searchsorted(s.imu_stamps_ns, s.gnss_stamps_ns)
    np.testing.assert_array_equal(s.imu_stamps_ns[at], s.gnss_stamps_ns)
    lever_e = ecef(s.lla_deg) - ecef(s.truth_lla[at])
    lever_b = np.einsum('nkj,nkl,nl->nj', s.truth_C_nb[at],
                        np.swapaxes(matrix_en(s.truth_lla[at]), 1, 2), lever_e)
    np.testing.assert_allclose(lever_b, np.tile([5.0, -3.0, 2.0], (len(at), 1)), atol=1e-3)


def test_attitude_is_known_between_samples():
    s = simulate('flight', duration=10.0, mount_rpy_deg=(10.0, 20.0, 30.0))
    np.testing.assert_allclose(s.attitude_at(s.truth_stamps_ns), s.truth_C_nb, atol=1e-9)
    middle = s.attitude_at(int(s.truth_stamps_ns[100]) + 5_000_000)
    turned = log_so3(s.truth_C_nb[100].T @ middle) / 0.005
    rate = (s.truth_gyro[100] + s.truth_gyro[101]) / 2
    np.testing.assert_allclose(turned, rate, atol=2e-3)
    assert middle.shape == (3, 3)


def test_imu_noise_has_the_stated_density_and_is_white():
    s = simulate('static', imu_grade='tactical', duration=600.0, imu_rate=50.0, seed=3)
    for measured, truth, bias, density in (
            (s.gyro, s.truth_gyro, s.gyro_bias, PRESETS['tactical'].angle_random_walk),
            (s.accel, s.truth_accel, s.accel_bias, PRESETS['tactical'].velocity_random_walk)):
        noise = measured - truth - bias
        sigma = density * math.sqrt(50.0)
        assert np.abs(noise.std(axis=0) / sigma - 1).max() < 0.02
        assert np.abs(noise.mean(axis=0)).max() < 4 * sigma / math.sqrt(len(noise))
        lag = np.mean(noise[1:] * noise[:-1], axis=0) / sigma ** 2
        assert np.abs(lag).max() < 4 / math.sqrt(len(noise))


def test_biases_spread_as_the_grade_says():
    runs = [simulate('static', duration=1.0, seed=seed) for seed in range(400)]
    grade = PRESETS['mems']
    gyro = np.array([run.gyro_bias for run in runs]) / grade.gyro_bias_std
    accel = np.array([run.accel_bias for run in runs]) / grade.accel_bias_std
    both = np.hstack([gyro, accel])
    assert np.abs(both.std(axis=0) - 1).max() < 0.15
    assert np.abs(both.mean(axis=0)).max() < 0.2
    assert np.abs(np.corrcoef(both.T) - np.eye(6)).max() < 0.2


def test_bias_override_custom_noise_and_ideal():
    own = ImuNoise(1e-4, 2e-3, 1e-3, 1e-2)
    s = simulate('static', imu_grade=own, gyro_bias_std=0.0, duration=1.0)
    np.testing.assert_array_equal(s.gyro_bias, 0.0)
    assert np.abs(s.accel_bias).max() > 0
    assert s.gyro_std == pytest.approx(1e-3)
    s = simulate('flight', ideal=True, gyro_scale_std=0.01, duration=1.0)
    np.testing.assert_array_equal(s.gyro, s.truth_gyro)
    np.testing.assert_array_equal(s.accel, s.truth_accel)
    assert s.velocity_covariance[0, 0] == pytest.approx(0.01)


@pytest.mark.parametrize('sensor', ('gyro', 'accel'))
@pytest.mark.parametrize('error, there', [('scale', np.eye(3, dtype=bool)),
                                          ('misalignment', ~np.eye(3, dtype=bool))])
def test_scale_factors_and_misalignment(sensor, error, there):
    plain, s = (simulate('flight', seed=2, duration=100.0, **{f'{sensor}_{error}_std': std})
                for std in (0.0, 0.003))
    spoilt = getattr(s, sensor) - getattr(plain, sensor)
    fitted = np.linalg.lstsq(getattr(s, f'truth_{sensor}'), spoilt, rcond=None)[0].T
    np.testing.assert_allclose(fitted[~there], 0.0, atol=1e-12)
    assert 1e-3 < np.abs(fitted[there]).max() < 0.01 and np.abs(fitted[there]).min() > 1e-5
    for other in {'gyro', 'accel', 'velocity'} - {sensor}:
        assert_same(getattr(s, other), getattr(plain, other))


def test_biases_of_the_gyros_walk():
    plain, s = (simulate('hover', seed=3, duration=400.0, imu_rate=10.0, rate_random_walk=walk)
                for walk in (0.0, 1e-4))
    walk = s.gyro - plain.gyro
    assert np.all(walk[0] == 0.0)
    np.testing.assert_allclose(np.diff(walk, axis=0).std(axis=0), 1e-4 * math.sqrt(0.1), rtol=0.05)
    # Steps that hang together would grow faster.
    apart = walk[200:] - walk[:-200]
    assert 0.3 < apart.std() / (1e-4 * math.sqrt(20.0)) < 1.7
    assert_same(s.accel, plain.accel)
    assert_same(s.velocity, plain.velocity)


def test_gnss_noise():
    s = simulate('static', duration=2000.0, imu_rate=1.0, velocity_std=0.2,
                 velocity_std_vertical=0.3, position_std=2.0)
    velocity = s.velocity.std(axis=0)
    np.testing.assert_allclose(velocity, [0.2, 0.2, 0.3], rtol=0.04)
    np.testing.assert_allclose(np.sqrt(np.diag(s.velocity_covariance)), [0.2, 0.2, 0.3])
    r = np.einsum('ji,nj->ni', matrix_en(s.lla_deg[:1])[0], ecef(s.lla_deg))
    np.testing.assert_allclose(r.std(axis=0), [2.0, 2.0, 4.0], rtol=0.04)
    np.testing.assert_allclose(np.diag(s.position_covariance), [4.0, 4.0, 16.0])


@pytest.mark.parametrize('quantity', ['position', 'velocity'])
def test_errors_that_last_are_first_order_gauss_markov(quantity):
    s = simulate('static', duration=20000.0, imu_rate=1.0, gnss_rate=1.0, gnss_correlation=20.0,
                 **{f'{quantity}_std': 0.0, f'{quantity}_drift_std': 3.0})
    drift = (s.lla_deg if quantity == 'position' else s.velocity)[:, 2]
    drift = drift - drift.mean()
    assert drift.std() == pytest.approx(3.0, rel=0.1)
    for lag in (20, 40):
        assert np.mean(drift[lag:] * drift[:-lag]) / drift.var() == pytest.approx(
            math.exp(-lag / 20), abs=0.08)


def test_correlated_velocity_errors_change_nothing_else():
    s, clean = (simulate('car', duration=20.0, velocity_drift_std=std) for std in (0.3, 0.0))
    assert not np.allclose(s.velocity, clean.velocity, atol=0.1)
    for name in ('gyro', 'accel', 'lla_deg', 'velocity_covariance'):
        np.testing.assert_array_equal(getattr(s, name), getattr(clean, name))


def test_quantum_and_dead_band():
    fine = simulate('car', duration=30.0)
    quantum, band = (0.01, 0.05), (0.02, 0.3)
    coarse = simulate('car', duration=30.0, quantum=quantum)
    silent = simulate('car', duration=30.0, dead_band=band)
    for name, step, limit in zip(('gyro', 'accel'), quantum, band):
        exact = getattr(fine, name)
        counts = getattr(coarse, name) / step
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        assert np.abs(getattr(coarse, name) - exact).max() <= step / 2 * (1 + 1e-9)
        small = np.abs(exact) < limit
        assert 0.01 < small.mean() < 0.99
        np.testing.assert_array_equal(getattr(silent, name), np.where(small, 0.0, exact))


def test_accelerometer_bias_that_is_given():
    bias = [0.5, -0.3, 0.2]
    s, drawn = simulate('car', duration=5.0, accel_bias=bias), simulate('car', duration=5.0)
    np.testing.assert_array_equal(s.accel_bias, bias)
    np.testing.assert_allclose(s.accel - drawn.accel, np.tile(bias - drawn.accel_bias, (501, 1)),
                               atol=1e-12)
    np.testing.assert_array_equal(s.gyro, drawn.gyro)


def test_a_chip_has_the_errors_that_its_preset_states():
    sim = [simulate('static', imu_grade='chip', seed=seed, duration=1.0, latitude_deg=0.0)
           for seed in range(200)]
    gravity = np.array([s.truth_accel[0] for s in sim])
    # Of the force along z: scale in z, misalignment in x and y; the biases are known.
    error = np.array([s.accel.mean(axis=0) - s.accel_bias for s in sim]) - gravity
    noise = PRESETS['chip'].velocity_random_walk
    expected = np.hypot(0.3 * PRESETS['chip'].gyro_scale_std * 9.78, noise)
    np.testing.assert_allclose(error.std(axis=0), expected, rtol=0.2)
    for name, std in (('accel_bias', PRESETS['chip'].accel_bias_std),
                      ('gyro_bias', PRESETS['chip'].gyro_bias_std)):
        assert np.std([getattr(s, name) for s in sim]) == pytest.approx(std, rel=0.15)


def test_delay_latency_and_phase():
    plain = simulate('flight', ideal=True, duration=5.0, gnss_phase=0.05)
    late = simulate('flight', ideal=True, duration=5.0, gnss_phase=0.05, gnss_delay=0.2,
                    gnss_latency=0.3)
    np.testing.assert_allclose(seconds(plain.gnss_stamps_ns), 0.05 + np.arange(25) / 5,
                               atol=1e-8)
    # One epoch of delay: what was measured at a stamp carries the next stamp.
    np.testing.assert_array_equal(late.gnss_stamps_ns, plain.gnss_stamps_ns[1:])
    np.testing.assert_allclose(late.velocity, plain.velocity[:-1], atol=1e-6)
    np.testing.assert_allclose(late.lla_deg, plain.lla_deg[:-1], atol=1e-11)
    np.testing.assert_array_equal(late.gnss_arrival_ns - late.gnss_stamps_ns, 300_000_000)


def test_outages_and_outliers():
    plain = simulate('car', duration=60.0, seed=4)
    s = simulate('car', duration=60.0, seed=4, outlier_rate=0.2, outlier_velocity=7.0,
                 outlier_position=40.0)
    error = np.linalg.norm(s.velocity - plain.velocity, axis=1)
    np.testing.assert_allclose(error, np.where(s.outlier, 7.0, 0.0), atol=1e-9)
    error = np.linalg.norm(ecef(s.lla_deg) - ecef(plain.lla_deg), axis=1)
    np.testing.assert_allclose(error, np.where(s.outlier, 40.0, 0.0), atol=1e-3)
    assert 0.1 < s.outlier.mean() < 0.3
    assert_same(s.gyro, plain.gyro)
    s = simulate('car', duration=60.0, outages=[(10.0, 20.0), (30.0, math.inf)])
    time = seconds(s.gnss_stamps_ns)
    assert not np.any((time >= 10) & (time < 20)) and time.max() < 30
    assert len(time) == 100


def test_seed_repeats_and_sensors_have_streams_of_their_own():
    one, same, other = (simulate('car', duration=5.0, seed=seed) for seed in (1, 1, 2))
    assert_same(one.gyro, same.gyro)
    assert_same(one.velocity, same.velocity)
    assert not np.any(one.gyro == other.gyro) and not np.any(one.velocity == other.velocity)
    faster = simulate('car', duration=5.0, seed=1, gnss_rate=10.0)
    assert_same(one.gyro, faster.gyro)


def test_heading_crab_and_mount():
    plain = simulate('car', ideal=True, duration=20.0)
    turned = simulate('car', ideal=True, duration=20.0, heading_deg=70.0)
    C = matrix_from_rpy([0.0, 0.0, math.radians(70.0)])
    np.testing.assert_allclose(turned.truth_velocity, plain.truth_velocity @ C.T, atol=1e-9)
    np.testing.assert_allclose(turned.truth_C_nb, C @ plain.truth_C_nb, atol=1e-9)
    crabbed = simulate('straight', ideal=True, duration=5.0, crab_deg=10.0)
    sideways = crabbed.truth_C_nb[0].T @ crabbed.truth_velocity[0]
    np.testing.assert_allclose(sideways, 30.0 * np.array(
        [math.cos(math.radians(10)), -math.sin(math.radians(10)), 0.0]), atol=1e-9)
    mount = matrix_from_rpy(np.radians([90.0, 80.0, 30.0]))
    mounted = simulate('car', ideal=True, duration=20.0, mount_rpy_deg=(90.0, 80.0, 30.0),
                       lever_arm=mount.T @ [1.0, 1.0, 1.0])
    np.testing.assert_allclose(mounted.gyro, plain.gyro @ mount, atol=1e-12)
    np.testing.assert_allclose(mounted.truth_C_nb, plain.truth_C_nb @ mount, atol=1e-12)
    np.testing.assert_allclose(mounted.velocity, plain.velocity, atol=1e-9)


@pytest.mark.parametrize('scenario', ['flight', 'car', 'hover'])
def test_stand_still_then_the_same_path(scenario):
    s = simulate(scenario, ideal=True, stand_still=20.0, duration=100.0)
    standing = seconds(s.imu_stamps_ns) <= 20.0
    np.testing.assert_array_equal(s.truth_velocity[standing], 0.0)
    np.testing.assert_allclose(s.truth_C_nb[standing], np.tile(s.truth_C_nb[0], (
        standing.sum(), 1, 1)), atol=1e-15)
    assert np.linalg.norm(s.truth_velocity[~standing], axis=1).max() > 0.5
    plain = simulate(scenario, ideal=True, duration=100.0)
    # Setting off takes a time in which half the path is covered.
    lost = 20.0 + {'flight': 20.0, 'car': 0.5, 'hover': 1.0}[scenario]
    at = int(lost * 100)
    np.testing.assert_allclose(ecef(s.truth_lla[at + 4000:]), ecef(plain.truth_lla[4000:-at]),
                               atol=1e-3)


def test_vehicles_move_as_they_should():
    def body_velocity(name):
        s = simulate(name, ideal=True)
        return np.einsum('nji,nj->ni', s.truth_C_nb, s.truth_velocity), s

    backing, _ = body_velocity('reverse')
    assert backing[:1000, 0].min() < -1.4 and backing[1500:, 0].max() > 10
    driving, s = body_velocity('car')
    assert np.abs(driving[:, 1]).max() < 0.05 and driving[:, 0].min() > -1e-9
    assert np.linalg.norm(s.truth_velocity[300]) > 1.0
    thrown, s = body_velocity('launch')
    assert np.abs(thrown[:200]).max() < 1e-9 and thrown[270, 0] > 14.0
    assert s.accel[:, 0].max() > 30.0
    hovering, _ = body_velocity('hover')
    assert np.linalg.norm(hovering, axis=1).max() < 2.0
    swinging, s = body_velocity('swing')
    np.testing.assert_allclose(s.truth_velocity, np.tile([5.0, 0, 0], (len(s.gyro), 1)))
    assert swinging[:, 1].max() > 5 * math.sin(math.radians(19))
    s = simulate('straight', ideal=True)
    np.testing.assert_allclose(s.truth_C_nb, np.tile(np.eye(3), (len(s.gyro), 1, 1)), atol=1e-12)


def test_antimeridian_is_crossed_with_longitudes_in_range():
    s = simulate('flight', ideal=True, longitude_deg=179.99)
    for longitude in (s.truth_lla[:, 1], s.lla_deg[:, 1]):
        assert longitude.min() >= -180.0 and longitude.max() < 180.0
        assert longitude[0] > 179.9 and longitude[-1] < -179.8
    np.testing.assert_allclose(s.truth_lla[0], [48.0, 179.99, 300.0], rtol=0, atol=1e-3)


def test_jitter_displaces_samples_and_stamps_alike():
    s = simulate('flight', ideal=True, imu_jitter=0.3, duration=10.0)
    steps = np.diff(s.imu_stamps_ns) * 1e-9
    assert 0.004 - 1e-8 <= steps.min() < 0.006 and 0.014 < steps.max() <= 0.016 + 1e-8
    np.testing.assert_allclose(s.attitude_at(s.truth_stamps_ns), s.truth_C_nb, atol=1e-9)


def test_faults():
    plain = simulate('car', duration=5.0)
    assert_same(simulate('car', duration=5.0, velocity_frame='ned').velocity,
                plain.velocity @ ENU_FROM_NED)
    flipped = simulate('car', duration=5.0, flip_axis='y')
    assert_same(flipped.gyro, plain.gyro * [1, -1, 1])
    assert_same(flipped.accel, plain.accel * [1, -1, 1])
    flipped = simulate('car', duration=5.0, flip_gyro='x')
    assert_same(flipped.gyro, plain.gyro * [-1, 1, 1])
    assert_same(flipped.accel, plain.accel)
    assert_same(simulate('car', duration=5.0, accel_sign=-1).accel, -plain.accel)


def test_messages_come_once_in_the_order_of_arrival():
    s = simulate('car', duration=5.0, gnss_latency=0.25)
    of_kind = {'imu': [], 'fix': [], 'velocity': []}
    newest = 0
    for kind, payload in s.messages():
        of_kind[kind].append(payload)
        if kind == 'imu':
            assert payload[0][0] > newest
            newest = payload[0][-1]
        else:
            # An epoch that would arrive after the last sample comes last.
            assert newest <= payload.stamp_ns + 250_000_000
            assert newest > payload.stamp_ns + 239_000_000 or newest == s.imu_stamps_ns[-1]
    for given, sent in zip(zip(*of_kind['imu']), (s.imu_stamps_ns, s.gyro, s.accel), strict=True):
        np.testing.assert_array_equal(np.concatenate(given), sent)
    np.testing.assert_array_equal([fix[1:4] for fix in of_kind['fix']], s.lla_deg)
    np.testing.assert_array_equal([v.velocity for v in of_kind['velocity']], s.velocity)
    for kind in 'fix', 'velocity':
        assert [each.stamp_ns for each in of_kind[kind]] == s.gnss_stamps_ns.tolist()


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_bag_holds_the_recording(tmp_path, storage):
    from pathlib import Path

    from rosbags.highlevel import AnyReader
    from rosbags.typesys import get_typestore, Stores
    s = simulate('car', duration=10.0, seed=5, gnss_latency=0.12, gyro_bias_std=0.01)
    path = tmp_path / 'deep' / 'bag'
    write_bag(s, path, storage)
    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        received = {}
        order = []
        for connection, stamp, raw in reader.messages():
            order.append(stamp)
            received.setdefault(connection.topic, []).append(
                (stamp, reader.deserialize(raw, connection.msgtype)))
    assert order == sorted(order)
    assert set(received) == {'/imu/data_raw', '/fix', '/fix_velocity', '/reference/imu'}

    def stamps(topic):
        return [m.header.stamp.sec * 10 ** 9 + m.header.stamp.nanosec for _, m in received[topic]]

    assert stamps('/imu/data_raw') == stamps('/reference/imu') == s.imu_stamps_ns.tolist()
    assert stamps('/fix') == stamps('/fix_velocity') == s.gnss_stamps_ns.tolist()
    assert [stamp for stamp, _ in received['/fix']] == s.gnss_arrival_ns.tolist()
    imu = [m for _, m in received['/imu/data_raw']]
    vector = [[m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z] for m in imu]
    np.testing.assert_array_equal(vector, s.gyro)
    vector = [[m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z]
              for m in imu]
    np.testing.assert_array_equal(vector, s.accel)
    assert imu[0].orientation_covariance[0] == -1
    np.testing.assert_allclose(imu[0].angular_velocity_covariance,
                               (s.gyro_std ** 2 * np.eye(3)).ravel())
    fixes = [m for _, m in received['/fix']]
    np.testing.assert_array_equal([[m.latitude, m.longitude, m.altitude] for m in fixes],
                                  s.lla_deg)
    assert fixes[0].position_covariance_type == 3 and fixes[0].status.status == 0
    np.testing.assert_allclose(fixes[0].position_covariance, s.position_covariance.ravel())
    twists = [m.twist for _, m in received['/fix_velocity']]
    np.testing.assert_array_equal(
        [[m.twist.linear.x, m.twist.linear.y, m.twist.linear.z] for m in twists], s.velocity)
    np.testing.assert_allclose(twists[0].covariance.reshape(6, 6)[:3, :3], s.velocity_covariance)
    truth = [m.orientation for _, m in received['/reference/imu']]
    np.testing.assert_allclose(matrix_from_quaternion([[q.x, q.y, q.z, q.w] for q in truth]),
                               s.truth_C_nb, atol=1e-12)
    config = config_from_mapping(load_params(path / 'ins_align.yaml'))
    assert config.lever_arm == (1.0, 1.0, 1.0) and config.imu_grade == 'mems'
    assert config.imu_noise.gyro_bias_std == pytest.approx(0.01)


def test_parameters_of_a_custom_imu(tmp_path):
    own = ImuNoise(1e-4, 2e-3, 1e-3, 1e-2)
    write_bag(simulate('static', duration=1.0, imu_grade=own), tmp_path / 'bag')
    config = config_from_mapping(load_params(tmp_path / 'bag' / 'ins_align.yaml'))
    np.testing.assert_allclose(config.imu_noise, own)


def test_parameters_hold_what_the_preset_does_not_cover(tmp_path):
    write_bag(simulate('static', duration=1.0, imu_grade='tactical', gyro_scale_std=0.01,
                       rate_random_walk=1e-4), tmp_path / 'worse')
    noise = config_from_mapping(load_params(tmp_path / 'worse' / 'ins_align.yaml')).imu_noise
    assert noise.gyro_scale_std == 0.01
    assert noise.rate_random_walk == pytest.approx(1e-4)  # rad/s/sqrt(s) both ways
    write_bag(simulate('static', duration=1.0, gyro_scale_std=0.001, rate_random_walk=1e-9),
              tmp_path / 'covered')
    config = config_from_mapping(load_params(tmp_path / 'covered' / 'ins_align.yaml'))
    assert config.imu_noise == PRESETS['mems']


def test_bag_is_written_whole_or_not_at_all(tmp_path):
    s = simulate('static', duration=1.0)
    with pytest.raises(SimulationError, match='storage must be one of mcap, sqlite3'):
        write_bag(s, tmp_path / 'bag', 'hdf5')
    write_bag(s, tmp_path / 'bag')
    with pytest.raises(SimulationError, match='exists already'):
        write_bag(s, tmp_path / 'bag')
    with pytest.raises(ValueError):     # fails after fifty samples
        write_bag(replace(s, truth_gyro=s.truth_gyro[:50]), tmp_path / 'half')
    assert [entry.name for entry in tmp_path.iterdir()] == ['bag']


@pytest.mark.parametrize('options, sentence', [
    ({'scenario': 'submarine'}, 'scenario must be one of flight, car'),
    ({'imu_grade': 'best'}, 'imu_grade must be one of navigation, tactical, mems'),
    ({'imu_grade': ['mems']}, 'imu_grade must be'),
    ({'imu_rate': -1.0}, 'imu_rate must be a finite number in Hz from 0.001 to 1000'),
    ({'gnss_rate': 0.0}, 'gnss_rate must be'),
    ({'gnss_rate': math.nan}, 'gnss_rate must be'),
    ({'duration': 0.0}, 'duration must be a number of seconds above 0'),
    ({'duration': 1e9}, 'too many samples'),
    ({'stand_still': 1e7}, '1.00001e.07 s at 100 Hz are too many samples'),
    ({'imu_rate': 1.0, 'duration': 1e4, 'gnss_rate': 1e4}, 'at 10000 Hz are too many samples'),
    ({'seed': -1}, 'seed must be an integer'),
    ({'seed': 0.5}, 'seed must be an integer'),
    ({'lever_arm': (1.0, 2.0)}, 'lever_arm must be 3 finite numbers in m'),
    ({'lever_arm': (1.0, 2.0, math.inf)}, 'lever_arm must be 3 finite numbers in m'),
    ({'lever_arm': None}, 'lever_arm must be 3 finite numbers in m'),
    ({'lever_arm': (1.0, 2.0, 2e3)}, 'lever_arm must be 3 finite numbers in m from -1000 to 1000'),
    ({'gnss_delay': 100.0}, 'gnss_delay must be a finite number in s from 0 to 60, got 100'),
    ({'gnss_delay': -0.1}, 'gnss_delay must be'),
    ({'gnss_latency': 100.0}, 'gnss_latency must be a finite number in s from 0 to 59.5, got 100'),
    ({'gyro_scale_std': 1.0}, 'gyro_scale_std must be a finite number from 0 to 0.5'),
    ({'altitude': 1e7}, 'altitude must be a finite number in m from -1000 to 100000'),
    ({'velocity_std': -0.1}, 'velocity_std must be a finite number in m/s, 0 or above'),
    ({'imu_jitter': 0.5}, 'imu_jitter must be'),
    ({'outlier_rate': 2.0}, 'outlier_rate must be'),
    ({'outages': [(5.0, 4.0)]}, 'outages must be pairs'),
    ({'outages': (5.0, 6.0)}, 'outages must be pairs'),
    ({'latitude_deg': 90.0}, 'latitude_deg must be'),
    ({'velocity_frame': 'body'}, 'velocity_frame must be one of enu, ned'),
    ({'flip_axis': 'w'}, 'flip_axis must be'),
    ({'flip_gyro': 'xy'}, 'flip_gyro must be'),
    ({'accel_sign': 0}, 'accel_sign must be'),
    ({'quantum': 0.01}, 'quantum must be 2 finite numbers in rad/s and m/s.2, 0 or above'),
    ({'dead_band': (0.01, -1.0)}, 'dead_band must be 2 finite numbers'),
    ({'accel_bias': 0.5}, 'accel_bias must be 3 finite numbers in m/s.2'),
    ({'gnss_correlation': 0.0}, 'gnss_correlation must be a finite number in s, 0.001 or above'),
])
def test_bad_arguments_get_a_sentence(options, sentence):
    with pytest.raises(SimulationError, match=sentence) as caught:
        simulate(**{'scenario': 'car', **options})
    assert '\n' not in str(caught.value)


def test_a_recording_without_gnss_is_possible():
    s = simulate('car', duration=2.0, outages=[(0.0, 10.0)])
    assert s.lla_deg.shape == s.velocity.shape == (0, 3)
    assert [kind for kind, _ in s.messages()] == ['imu']
