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
"""What must not matter: frames, clocks, callbacks, order of arrival."""

from alignment import aligned, config_for, error_of, feed, LEVER, simulated
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
from ins_align.aligner import Aligner
from ins_align.geometry.rotation import exp_so3, matrix_from_quaternion
from ins_align.simulation.simulate import give
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

SHORT = {'imu_grade': 'mems', 'duration': 8.0, 'seed': 3, 'gnss_rate': 4.0}


@pytest.fixture(scope='module')
def reference():
    """Align a short flight in order."""
    s = simulated('flight', **SHORT)
    aligner = Aligner(config_for(s))
    return s, numbers(feed(aligner, s)), aligner.status()


def numbers(epochs):
    """Everything that epochs say, to be compared exactly."""
    rows = []
    for e in epochs:
        for attitude in (e.initial, e.current):
            rows.append((e.stamp_ns, e.t_s, e.state) + (
                () if attitude is None else (
                    attitude.stamp_ns, *attitude.quaternion_xyzw.tolist(),
                    *attitude.covariance.ravel().tolist())))
    return rows


def matrix(attitude):
    return matrix_from_quaternion(attitude.quaternion_xyzw)


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_any_callbacks_and_any_order_within_lateness_give_the_same_epochs(reference, data):
    s, expected, status = reference
    random = np.random.default_rng(data.draw(st.integers(0, 2 ** 32 - 1)))
    # GNSS messages arrive up to almost the lateness after newer samples, IMU samples a little out
    # of order; updates happen whenever.
    events = []
    delay = random.uniform(0.0, data.draw(st.sampled_from([0.0, 0.3, 0.95])),
                           (len(s.gnss_stamps_ns), 2))
    for k, stamp in enumerate(s.gnss_stamps_ns.tolist()):
        events.append((stamp + int(delay[k, 0] * 1e9), 'fix', s.fix(k)))
        events.append((stamp + int(delay[k, 1] * 1e9), 'velocity', s.velocity_measurement(k)))
    shuffle = random.uniform(0.0, data.draw(st.sampled_from([0.0, 0.05])), len(s.imu_stamps_ns))
    for k, stamp in enumerate(s.imu_stamps_ns.tolist()):
        events.append((stamp + int(shuffle[k] * 1e9), 'imu', (stamp, s.gyro[k], s.accel[k])))
    events.sort(key=lambda event: event[0])
    aligner = Aligner(config_for(s))
    epochs = []
    share = data.draw(st.sampled_from([0.0, 0.02, 0.5]))
    for _, kind, payload in events:
        give(aligner, kind, payload)
        if random.random() < share:
            epochs += aligner.update()
    epochs += aligner.flush()
    assert numbers(epochs) == expected
    assert aligner.status().reason == status.reason


@pytest.mark.parametrize('lumps', (1, 3, 57))
def test_arrays_give_the_same_epochs_as_samples(reference, lumps):
    s, expected, _ = reference
    aligner = Aligner(config_for(s, gnss_lateness=30.0))
    for part in np.array_split(np.arange(len(s.imu_stamps_ns)), lumps):
        aligner.add_imu(s.imu_stamps_ns[part], s.gyro[part], s.accel[part])
    for k in range(len(s.gnss_stamps_ns)):
        aligner.add_fix(s.fix(k))
        aligner.add_velocity(s.velocity_measurement(k))
    assert numbers(aligner.flush()) == expected


def test_updates_during_an_outage_tell_the_same_epochs_as_one_at_the_end():
    s = simulated('flight', **{**SHORT, 'duration': 16.0}, outages=((5.0, 12.0),))
    often = numbers(feed(Aligner(config_for(s)), s))
    aligner = Aligner(config_for(s, gnss_lateness=30.0))
    for k in range(len(s.gnss_stamps_ns)):
        aligner.add_fix(s.fix(k))
        aligner.add_velocity(s.velocity_measurement(k))
    aligner.add_imu(s.imu_stamps_ns, s.gyro, s.accel)
    assert numbers(aligner.flush()) == often


@pytest.mark.parametrize('shift_ns', (1, 86_400_000_000_000, -1_000_000_000_000_000_000))
def test_time_shift_changes_stamps_only(reference, shift_ns):
    s, expected, _ = reference
    aligner = Aligner(config_for(s))
    epochs = []
    for kind, payload in s.messages():
        give(aligner, kind, (payload[0] + shift_ns, *payload[1:]) if kind == 'imu' else
             payload._replace(stamp_ns=payload.stamp_ns + shift_ns))
        epochs += aligner.update()
    epochs += aligner.flush()
    for row, other in zip(numbers(epochs), expected):
        assert row[0] == other[0] + shift_ns
        assert row[1:3] == other[1:3] and row[4:] == other[4:]
    assert len(epochs) * 2 == len(expected)


RELABELLINGS = {
    'yaw the IMU a quarter': [0.0, 0.0, np.pi / 2], 'upside down': [np.pi, 0.0, 0.0],
    'axes in a ring': 2 * np.pi / 3 / np.sqrt(3) * np.ones(3), 'any': [0.4, -1.1, 2.0]}


@pytest.mark.parametrize('method', ('vif', 'pif', 'bank'))
@pytest.mark.parametrize('name', RELABELLINGS)
def test_relabelling_the_body_axes_relabels_the_answer(reference, name, method):
    if name == 'any' and method == 'bank':
        pytest.skip('scale factors belong to the axes of the sensor')
    s, _, _ = reference
    R = Rotation.from_rotvec(RELABELLINGS[name]).as_matrix()
    plain = aligned(s, method=method)[0].status().initial
    lever = tuple((R @ LEVER).tolist())
    aligner = Aligner(config_for(s, method=method, lever_arm=lever))
    for kind, payload in s.messages():
        if kind == 'imu':
            payload = payload[0], payload[1] @ R.T, payload[2] @ R.T
        give(aligner, kind, payload)
    aligner.flush()
    turned = aligner.status().initial
    # Sums of numbers in another order, amplified by how poorly a short flight tells the heading.
    assert np.allclose(matrix(turned), matrix(plain) @ R.T, atol=1e-6)
    assert np.allclose(turned.sigma_deg, plain.sigma_deg, rtol=1e-5)


@pytest.mark.parametrize('heading', (37.0, 90.0, -135.0, 180.0))
def test_turning_the_world_about_the_vertical_turns_the_heading_and_nothing_else(heading):
    options = {'ideal': True, 'duration': 10.0, 'gnss_rate': 4.0}
    here, there = (aligned(simulated('flight', heading_deg=h, **options))[0].status().initial
                   for h in (0.0, heading))
    turn = exp_so3([0.0, 0.0, np.radians(heading)])
    # The Earth's turning, 0.004 deg/s, lies otherwise: its effect is in the model.
    assert np.allclose(matrix(there), turn @ matrix(here), atol=2e-5)
    rotated = turn @ here.covariance @ turn.T
    scale = np.sqrt(np.outer(np.diag(rotated), np.diag(rotated)))
    assert np.all(np.abs(there.covariance - rotated) < 0.02 * scale)


def test_turning_the_world_turns_the_errors_of_noise_with_it():
    """Same noise, isotropic, another course: the same error in sigmas."""
    here, there = (simulated('flight', heading_deg=h, **{**SHORT, 'duration': 20.0})
                   for h in (0.0, 90.0))
    one, other = (aligned(s)[0].status().initial for s in (here, there))
    # GNSS noise stays in ENU while the course turns: only what the IMU does to it is compared.
    assert np.allclose(other.sigma_deg[2], one.sigma_deg[2], rtol=0.03)
    assert np.all(np.abs(error_of(one, here)) < 5 * np.radians(one.sigma_deg))
    assert np.all(np.abs(error_of(other, there)) < 5 * np.radians(other.sigma_deg))
