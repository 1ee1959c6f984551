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
"""What a vehicle knows of its motion: a heading on a straight road, and none that is wrong."""

from alignment import feed
from ins_align.aligner import Aligner
from ins_align.config import Config, ConfigError
from ins_align.geometry.rotation import matrix_from_rpy, Transform
from ins_align.offline import replay
from ins_align.results import State
from ins_align.simulation.scenarios import Motion, Scenario, SCENARIOS
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest

CAMPAIGN = pytest.mark.campaign
CAR = {'vehicle': 'car', 'trust_imu_axes': True, 'heading_std_threshold': 2.0}


def aligned(simulation, base=None, **config):
    """Return the aligner, its epochs and the headings' errors over their sigmas."""
    aligner = Aligner(Config(**{**CAR, 'lever_arm': tuple(simulation.lever_arm.tolist()),
                                **config}), base)
    epochs = [epoch for epoch in feed(aligner, simulation) if epoch.current is not None]
    true = simulation.attitude_at([epoch.stamp_ns for epoch in epochs])
    errors = [epoch.current.heading_deg - heading_deg(C) for epoch, C in zip(epochs, true)]
    sigmas = [epoch.current.sigma_deg[2] for epoch in epochs]
    return aligner, epochs, (np.remainder(np.add(errors, 180.0), 360.0) - 180.0) / sigmas


def heading_deg(C_nb):
    return float(np.degrees(np.arctan2(C_nb[0, 0], C_nb[1, 0])))


@pytest.mark.parametrize('mount_std, drift_std', [(1.0, 0.1), (0.5, 0.3), (3.0, 0.1)])
def test_straight_road_gives_a_heading_as_good_as_mounting_and_drift(mount_std, drift_std):
    """At a constant 10 m/s nothing else is known of it but, to 0.1 deg in a minute, its change."""
    simulation = simulate('highway', seed=1, duration=20.0)
    aligner, epochs, _ = aligned(simulation, mount_yaw_std=mount_std,
                                 vehicle_velocity_std=drift_std, heading_std_threshold=5.0)
    known = np.hypot(mount_std, np.degrees(drift_std / 10.0))
    first = next(epoch for epoch in epochs if epoch.state is State.ALIGNED)
    assert (first.stamp_ns - epochs[0].stamp_ns) * 1e-9 < 5.0
    assert known < aligner.status().current.sigma_deg[2] < 1.25 * known


@pytest.mark.parametrize('grade', ['tactical', pytest.param('navigation', marks=CAMPAIGN)])
def test_a_car_that_backs_out_and_drives_on_contradicts_nothing(grade):
    simulation = simulate('reverse', seed=1, imu_grade=grade, duration=45.0)
    aligner, epochs, sigmas = aligned(simulation, imu_grade=grade)
    assert not any('contradicts' in epoch.reason for epoch in epochs)
    assert aligner.status().state is State.ALIGNED and abs(sigmas[-1]) < 4


def test_epochs_without_a_measurement_take_no_turn_of_the_constraint():
    """GNSS every 2.5 s, so that an epoch without it, 2 s after each, is due first."""
    status = aligned(simulate('highway', seed=5, duration=60.0, gnss_rate=0.4))[0].status()
    assert status.state is State.ALIGNED and status.current.sigma_deg[2] < 2.0


def test_straight_road_gives_no_heading_without_a_vehicle():
    without = aligned(simulate('highway', seed=1, duration=20.0), vehicle='none')[0].status()
    assert without.state is State.LEVELLED and without.current.sigma_deg[2] > 10.0


@pytest.mark.parametrize('scenario, vehicle', [
    ('highway', 'car'), ('flight', 'aeroplane'),
    *(pytest.param(scenario, 'car', marks=CAMPAIGN) for scenario in ('car', 'reverse'))])
def test_heading_is_right_with_a_base_that_is_turned_and_elsewhere(scenario, vehicle):
    """The base of the vehicle is 2 m behind and below an IMU that looks to the left."""
    mount = np.array([3.0, -2.0, 90.0])
    simulation = simulate(scenario, seed=3, duration=40.0, mount_rpy_deg=mount.tolist())
    C_base_imu = matrix_from_rpy(np.radians(mount))
    base = Transform(C_base_imu.T, C_base_imu.T @ [-2.0, 0.0, -2.0])
    if scenario != 'highway':               # which moves the IMU, and the base with it
        base = base._replace(translation=np.zeros(3))
    aligner, epochs, sigmas = aligned(simulation, base, vehicle=vehicle)
    assert aligner.status().state is State.ALIGNED
    assert max(abs(sigma) for sigma, epoch in zip(sigmas, epochs)
               if epoch.state is State.ALIGNED) < 3.5
    assert 'contradicts' not in aligner.status().reason


def test_base_comes_from_tf(tmp_path):
    simulation = simulate('highway', seed=4, duration=12.0, mount_rpy_deg=(2.0, -3.0, 90.0))
    write_bag(simulation, tmp_path / 'drive', tf=True)
    result = replay(tmp_path / 'drive', Config(**CAR, base_frame='base_link'))
    C_true = simulation.attitude_at(result.status.current.stamp_ns)
    error = result.status.current.heading_deg - heading_deg(C_true)
    assert result.aligned and abs(np.remainder(error + 180.0, 360.0) - 180.0) < 4.0


@pytest.mark.parametrize('scenario, options', [
    ('car', {'mount_rpy_deg': (0.0, 0.0, 8.0)}),        # x does not point forward
    ('swing', {'crab_deg': 70.0}),                      # on a ferry, in waves
    pytest.param('swing', {}, marks=CAMPAIGN),          # a drift to and fro
    pytest.param('car', {'crab_deg': 70.0}, marks=CAMPAIGN),        # towed
    pytest.param('car', {'crab_deg': 180.0}, marks=CAMPAIGN)])      # 12 m/s in reverse gear
def test_motion_that_contradicts_the_vehicle_is_found(scenario, options):
    simulation = simulate(scenario, seed=5, duration=40.0, **options)
    aligner, epochs, sigmas = aligned(simulation)
    assert 'the motion contradicts vehicle: car, which is not used' in aligner.status().reason
    late = [abs(sigma) for sigma, epoch in zip(sigmas, epochs)
            if epoch.state is State.ALIGNED and epoch.stamp_ns - epochs[0].stamp_ns > 20e9]
    assert max(late, default=0.0) < 3.5


def test_direction_of_a_slow_car_is_said_to_be_ambiguous_until_its_speed_changes(monkeypatch):
    """At a constant 2 m/s nothing tells whether it goes backwards; it does, then it stops."""
    def motion(time, duration):
        speed = -2.0 + 2.0 * np.clip((time - 20.0) / 3.0, 0.0, 1.0)
        zero = np.zeros_like(time)
        return Motion(np.stack([speed, zero, zero], axis=-1), np.zeros((len(time), 3)))

    monkeypatch.setitem(SCENARIOS, 'slow', Scenario(motion, 40.0, 1.0))
    _, epochs, _ = aligned(simulate('slow', seed=6, duration=40.0))
    ambiguous = ['forwards and backwards are both possible' in epoch.reason for epoch in epochs]
    times = np.array([epoch.stamp_ns - epochs[0].stamp_ns for epoch in epochs]) * 1e-9
    assert all(unclear for unclear, t in zip(ambiguous, times) if 8.0 < t < 19.0)
    assert not any(unclear for unclear, t in zip(ambiguous, times) if t > 25.0)
    assert all(epoch.state is not State.ALIGNED for epoch, t in zip(epochs, times) if t < 19.0)
    error = epochs[-1].current.heading_deg - 90.0
    assert abs(np.remainder(error + 180.0, 360.0) - 180.0) < 3 * epochs[-1].current.sigma_deg[2]


def test_vehicle_at_rest_has_no_direction():
    """The noise of its speed says nothing of the heading."""
    simulation = simulate('static', seed=1, duration=10.0)
    known, unknown = (aligned(simulation, vehicle=vehicle)[0].status().current.sigma_deg[2]
                      for vehicle in ('car', 'none'))
    assert known == pytest.approx(unknown, rel=0.01)


@pytest.mark.parametrize('method', ['vif', 'pif'])
def test_published_methods_know_no_vehicle(method):
    with pytest.raises(ConfigError, match='vehicle is car: set it to none'):
        Config(vehicle='car', method=method, use_velocity='auto' if method == 'vif' else False)
