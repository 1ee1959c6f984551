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
"""Checks on units and frames that need no alignment."""

from ins_align.earth import ecef_from_lla, matrix_en
from ins_align.plausibility import ForceCheck, VelocityCheck
import numpy as np
import pytest

RADIUS = 6.37e6


def forces(scale, count=600):
    random = np.random.default_rng(0)
    return scale * ([0.0, 0.0, 9.81] + random.standard_normal((count, 3)))


@pytest.mark.parametrize('scale, wrong', [(1.0, False), (1 / 9.81, True), (1000.0, True),
                                          (-1.0, False), (2.0, False), (0.0, True)])
def test_force_in_another_unit_is_found(scale, wrong):
    check = ForceCheck()
    check.add(forces(scale))
    assert bool(check.fault) == wrong
    if wrong:
        assert 'm/s^2' in check.fault and any(c.isdigit() for c in check.fault)


def test_force_check_waits_for_enough_samples_and_forgives():
    check = ForceCheck()
    check.add(forces(0.1, 100))
    assert not check.fault
    check.add(forces(0.1, 900))
    assert check.fault
    check.add(forces(1.0, 600))
    assert not check.fault


def drive(check, sent, *, speed=10.0, turn=0.1, seconds=60.0, rate=5.0, noise=0.5):
    """Drive circles; `sent` makes what the receiver says of the true velocity."""
    random = np.random.default_rng(1)
    latitude, longitude = 0.8, 0.2
    for k in range(int(seconds * rate)):
        t = k / rate
        v = speed * np.array([np.cos(turn * t), np.sin(turn * t), 0.0])
        error = noise * random.standard_normal(2)
        check.add(t, latitude + error[1] / RADIUS,
                  longitude + error[0] / (RADIUS * np.cos(latitude)), 100.0, sent(v), noise)
        latitude += v[1] / rate / RADIUS
        longitude += v[0] / rate / (RADIUS * np.cos(latitude))
    return check


def test_right_velocity_passes():
    assert not drive(VelocityCheck(), lambda v: v).fault
    assert not drive(VelocityCheck(), lambda v: v, noise=2.5).fault
    random = np.random.default_rng(2)
    assert not drive(VelocityCheck(), lambda v: v + random.standard_normal(3)).fault


def test_north_and_east_exchanged_is_found_and_named():
    fault = drive(VelocityCheck(), lambda v: np.array([v[1], v[0], -v[2]])).fault
    assert 'velocity_frame' in fault and 'exchanged' in fault


@pytest.mark.parametrize('sent', (
    lambda v: np.array([np.hypot(v[0], v[1]), 0.0, 0.0]), lambda v: 3.6 * v, lambda v: -v,
    lambda v: 0.0 * v))
def test_other_wrong_velocities_are_found(sent):
    fault = drive(VelocityCheck(), sent).fault
    assert fault and 'world frame' in fault


def test_straight_drive_to_the_north_east_tells_nothing():
    check = VelocityCheck()
    for k in range(200):
        check.add(0.2 * k, 0.8 + 1.4 * k / RADIUS, 0.2 + 1.4 * k / (RADIUS * np.cos(0.8)), 0.0,
                  np.array([7.0, 7.0, 0.0]), 0.5)
    assert not check.fault


def test_gaps_are_not_bridged():
    check = VelocityCheck()
    for k in range(100):
        # One epoch in three seconds: what happened between is not known.
        check.add(3.0 * k, 0.8 + 1e-5 * k, 0.2, 0.0, np.array([10.0, 0.0, 0.0]), 0.5)
    assert not check.fault


def test_standing_still_is_nothing_to_compare():
    random = np.random.default_rng(4)
    check = VelocityCheck()
    for k in range(1000):
        check.add(0.2 * k, 0.8 + 2.5 / RADIUS * random.standard_normal(),
                  0.2 + 2.5 / RADIUS * random.standard_normal(), 0.0,
                  0.1 * random.standard_normal(3), 2.5)
    assert not check.fault


def test_across_the_antimeridian():
    check = VelocityCheck()
    latitude = np.radians(-18.0)
    place = ecef_from_lla(latitude, np.pi, 0.0)
    assert np.all(np.isfinite(place)) and matrix_en(latitude, np.pi).shape == (3, 3)
    for k in range(300):
        longitude = np.pi - 1e-4 + 10.0 * 0.2 * k / (6378137.0 * np.cos(latitude))
        longitude = (longitude + np.pi) % (2 * np.pi) - np.pi
        check.add(0.2 * k, latitude, longitude, 0.0, np.array([10.0, 0.0, 0.0]), 0.1)
    assert not check.fault
