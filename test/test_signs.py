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
"""What the data say about the signs of the IMU's axes."""

from dataclasses import replace

from alignment import aligned, estimator_of, simulated
from ins_align.aligner import Aligner, State
from ins_align.experiments.common import config_for
from ins_align.signs import GAIN, HARMLESS, one_gyro_evidence, SignCheck
from ins_align.simulation import feed
import numpy as np
import pytest

WRONG = {(1, -1): 'accelerations reversed', (-1, 1): 'angular rates reversed',
         (-1, -1): 'one IMU axis reversed'}


def doubt_about(simulation):
    """Return what is said of a recording when all of it is there."""
    aligner, _ = aligned(simulation, hold_time=1e3)
    return SignCheck().doubt(estimator_of(aligner))


@pytest.mark.parametrize('grade', ('tactical', 'mems'))
@pytest.mark.parametrize('signs', WRONG)
def test_signs_that_are_wrong_are_named(signs, grade):
    s = simulated('flight', imu_grade=grade, duration=20.0, seed=3)
    gyro, accel = signs
    assert WRONG[signs] in doubt_about(replace(s, gyro=gyro * s.gyro, accel=accel * s.accel))


def test_one_axis_that_is_wrong_is_named():
    s = simulated('flight', imu_grade='tactical', duration=20.0, seed=3, flip_axis='y')
    assert 'one IMU axis reversed' in doubt_about(s)


@pytest.mark.parametrize('scenario, doubt', [
    ('flight', ''),
    ('static', 'the signs of the IMU axes are not confirmed by the motion yet: turn')])
def test_right_signs_are_confirmed_once_the_vehicle_has_turned(scenario, doubt):
    s = simulated(scenario, imu_grade='tactical', duration=20.0, seed=3)
    assert doubt_about(s) == doubt


def one_gyro_reversed(simulation, axis):
    """Return a recording with the angular rate about one axis the other way round."""
    return replace(simulation, gyro=simulation.gyro * np.where(np.arange(3) == axis, -1.0, 1.0))


@pytest.mark.parametrize('grade', ('tactical', 'mems'))
@pytest.mark.parametrize('scenario, duration, axes', [('car', 17.0, 'yz'), ('launch', 8.0, 'xyz')])
def test_one_gyro_that_is_reversed_is_named(scenario, duration, axes, grade):
    s = simulated(scenario, imu_grade=grade, duration=duration, seed=3)
    assert doubt_about(s) == ''
    for axis in axes:
        wrong = one_gyro_reversed(s, 'xyz'.index(axis))
        assert f'rate about {axis} reversed' in doubt_about(wrong)


def test_a_gyro_about_which_the_vehicle_has_not_turned_does_no_harm():
    """In 14 s the car goes over bumps, but not round a corner."""
    s = simulated('car', imu_grade='mems', duration=14.0, seed=3)
    aligner, _ = aligned(s, hold_time=1e3)
    evidence, harm = one_gyro_evidence(estimator_of(aligner))
    assert np.all(evidence[:2] > GAIN) and abs(evidence[2]) < GAIN
    assert np.all(harm[:2] > HARMLESS) and harm[2] < HARMLESS
    assert doubt_about(one_gyro_reversed(s, 2)) == ''


@pytest.mark.parametrize('seed', (50, 51))
@pytest.mark.parametrize('axis', (0, 2))
def test_a_launch_with_one_gyro_reversed_is_never_aligned(axis, seed):
    """Its residuals show it only seconds after heading and tilt have become good enough."""
    s = one_gyro_reversed(simulated('launch', duration=30.0, seed=seed), axis)
    epochs = feed(Aligner(config_for(s)), s)
    assert len(epochs) > 140
    assert State.ALIGNED not in {epoch.state for epoch in epochs}


def test_a_car_that_backs_out_with_one_gyro_reversed_is_never_aligned():
    """A fit that goes astray after 85 s speaks for the right sign, for four epochs."""
    s = simulated('reverse', imu_grade='mems', duration=88.0, seed=427, flip_gyro='z',
                  heading_deg=40.514933, latitude_deg=-13.211179,
                  lever_arm=(1.117373, -0.364103, -0.715554),
                  mount_rpy_deg=(8.827634, -4.522443, 9.2002397))
    states = {epoch.state for epoch in feed(Aligner(config_for(s)), s)}
    assert State.LEVELLED in states and State.ALIGNED not in states


def test_what_speaks_for_a_reversed_gyro_counts_until_t0_moves():
    """Then the fit may have refused as outliers what spoke for it."""
    s = simulated('car', imu_grade='mems', duration=17.0, seed=3)
    wrong, right = (estimator_of(aligned(data, hold_time=1e3)[0])
                    for data in (one_gyro_reversed(s, 2), s))
    check = SignCheck()
    assert 'rate about z reversed' in check.doubt(wrong)
    assert 'rate about z reversed' in check.doubt(right)
    check.restart()
    assert check.doubt(right) == ''
