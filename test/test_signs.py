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
from ins_align.signs import SignCheck
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
