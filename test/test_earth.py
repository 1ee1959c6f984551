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
"""The Earth against python-ins, closed forms and finite differences."""

from functools import partial

from ins_align.geometry import earth
from ins_align.geometry.rotation import apply
from ins_align.gnss.messages import ENU_FROM_NED
import numpy as np
from pyins import earth as reference
from pyins import transform
import pytest
from scipy.spatial.transform import Rotation

PLACES = np.array([
    [0.0, 0.0, 0.0], [48.0, 11.0, 300.0], [-33.9, 151.2, 50.0], [80.0, -179.999, 3000.0],
    [-80.0, 180.0, 0.0], [45.0, -90.0, -100.0], [89.9, 10.0, 9000.0]])
RADIANS = np.column_stack([np.radians(PLACES[:, :2]), PLACES[:, 2]])
GM, J2 = 3.986004418e14, 1.0826298213e-3        # WGS 84


def test_gravity_is_that_of_the_wgs_84_tables():
    # NGA.STND.0036: equator and pole on the ellipsoid.
    assert earth.normal_gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert earth.normal_gravity(np.pi / 2, 0.0) == pytest.approx(9.8321849379, abs=1e-9)
    assert earth.normal_gravity(-np.pi / 2, 0.0) == pytest.approx(9.8321849379, abs=1e-9)


def test_gravity_is_that_of_python_ins_near_the_ground():
    # Its height correction is linear: 0.5 mGal at 1 km, 0.03 percent at 10 km.
    low = PLACES[:, 2] < 1000.0
    assert np.allclose(earth.normal_gravity(RADIANS[:, 0], RADIANS[:, 2])[low],
                       reference.gravity(PLACES[:, 0], PLACES[:, 2])[low], rtol=2e-6)


@pytest.mark.parametrize('altitude', (1e3, 1e4, 2e4))
@pytest.mark.parametrize('pole', (False, True))
def test_gravity_falls_with_height_as_the_potential_has_it(pole, altitude):
    """Of a point mass, the oblateness and the Earth's turning, along the radius."""
    def along_radius(height):
        r = earth.SEMI_MAJOR_AXIS * (1 - earth.FLATTENING * pole) + height
        oblate = 1.5 * J2 * (earth.SEMI_MAJOR_AXIS / r) ** 2 * (-2 if pole else 1)
        return GM / r ** 2 * (1 + oblate) - (0.0 if pole else earth.EARTH_RATE ** 2 * r)

    latitude = np.pi / 2 * pole
    fallen = earth.normal_gravity(latitude, 0.0) - earth.normal_gravity(latitude, altitude)
    assert fallen == pytest.approx(along_radius(0.0) - along_radius(altitude), rel=1e-3)


def test_gravity_vector_points_down():
    g = earth.gravity_n(RADIANS[:, 0], RADIANS[:, 2])
    assert g.shape == (len(PLACES), 3)
    assert np.all(g[:, :2] == 0) and np.all(g[:, 2] < -9.7)


def ecef(latitude, longitude, altitude):
    """Return a position in the Earth-fixed frame."""
    return apply(earth.matrix_en(latitude, longitude), earth.position_n(latitude, altitude))


def test_positions_are_those_of_python_ins():
    assert np.allclose(ecef(*RADIANS.T), transform.lla_to_ecef(PLACES), atol=1e-8)
    assert np.allclose(ecef(*RADIANS[1]), transform.lla_to_ecef(PLACES[1]),
                       atol=1e-8)


def test_local_level_is_that_of_python_ins():
    C_en = earth.matrix_en(RADIANS[:, 0], RADIANS[:, 1])
    expected = transform.mat_en_from_ll(PLACES[:, 0], PLACES[:, 1]) @ ENU_FROM_NED
    assert np.allclose(C_en, expected, atol=1e-14)
    assert np.allclose(np.linalg.det(C_en), 1.0)


def test_local_level_axes_are_the_directions_in_which_positions_change():
    step = 1e-6
    for place, C_en in zip(RADIANS[:-1], earth.matrix_en(RADIANS[:-1, 0], RADIANS[:-1, 1])):
        for axis, change in enumerate(np.array([[0, step, 0], [step, 0, 0], [0, 0, 1.0]])):
            moved = (ecef(*(place + change))
                     - ecef(*(place - change)))
            assert np.allclose(moved / np.linalg.norm(moved), C_en[:, axis], atol=1e-8)


def test_earth_rate_is_that_of_python_ins():
    expected = np.array([reference.rate_n(lat) for lat in PLACES[:, 0]]) @ ENU_FROM_NED
    assert np.allclose(earth.earth_rate_n(RADIANS[:, 0]), expected, atol=1e-18)
    assert np.allclose(earth.matrix_en(*RADIANS[1, :2]) @ earth.earth_rate_n(RADIANS[1, 0]),
                       [0.0, 0.0, earth.EARTH_RATE], atol=1e-18)


def test_earth_turns_eastward():
    quarter = np.pi / 2 / earth.EARTH_RATE
    assert np.allclose(earth.matrix_earth_turned(quarter) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    angles = earth.EARTH_RATE * np.array([0.0, 10.0, 86164.0])
    assert np.allclose(earth.matrix_earth_turned(angles / earth.EARTH_RATE),
                       Rotation.from_euler('Z', angles[:, None]).as_matrix(), atol=1e-14)


def test_frozen_level_starts_as_the_level_and_turns_with_the_earth():
    start = RADIANS[1, :2]
    assert np.allclose(earth.matrix_n0n(start, 0.0, *start), np.eye(3), atol=1e-15)
    turned = Rotation.from_matrix(earth.matrix_n0n(start, 100.0, *start)).as_rotvec()
    assert np.allclose(turned, 100.0 * earth.earth_rate_n(RADIANS[1, 0]), atol=1e-14)


def test_frozen_level_is_smooth_across_the_antimeridian():
    latitude = np.radians(-18.0)
    across = earth.matrix_n0n((latitude, np.radians(179.9999)), 5.0, latitude,
                              np.radians(np.array([180.0, -180.0, -179.9999])))
    assert np.allclose(across[0], across[1], atol=1e-15)
    assert np.linalg.norm(across[2] - across[0]) < 4e-6


def test_inertial_velocity_is_the_derivative_of_inertial_position():
    level = partial(earth.matrix_n0n, RADIANS[1, :2])

    def position(time, latitude, longitude, altitude):
        return level(time, latitude, longitude) @ earth.position_n(latitude, altitude)

    v_n = np.array([120.0, -80.0, 5.0])
    rn, _, rp = reference.principal_radii(PLACES[2, 0], PLACES[2, 2])
    rate = np.array([v_n[1] / rn, v_n[0] / rp, v_n[2]])
    time, h = 400.0, 0.01
    ahead, behind = (position(time + d, *(RADIANS[2] + d * rate)) for d in (h, -h))
    numeric = (ahead - behind) / (2 * h)
    latitude, longitude, altitude = RADIANS[2]
    velocity = level(time, latitude, longitude) @ (
        v_n + earth.ground_velocity_n(latitude, altitude))
    assert np.allclose(velocity, numeric, atol=1e-6)


def test_gravitation_is_that_of_python_ins_and_turned_with_the_earth():
    for place, degrees in zip(RADIANS, PLACES):
        if degrees[2] > 1000.0:
            continue  # its gravity is linear in height
        C_n0e = earth.matrix_en(*RADIANS[1, :2]).T
        expected = C_n0e @ Rotation.from_euler('z', earth.EARTH_RATE * 50.0).apply(
            reference.gravitation_ecef(degrees))
        found = (earth.matrix_n0n(RADIANS[1, :2], 50.0, *place[:2])
                 @ earth.gravitation_n(place[0], place[2]))
        assert np.allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize('place', ((0.8, 0.2, 100.0), (-0.3, np.pi - 1e-6, 0.0), (1.4, -2.0, 9e3)))
def test_the_way_between_places_is_what_carried_goes_and_what_the_ellipsoid_has(place):
    step = np.array([300.0, -200.0, 50.0])
    there = earth.dead_reckon(place, step, 1.0)
    assert np.allclose(earth.enu_offset(place, there), step, rtol=1e-9, atol=1e-6)
    turned = (there[0], there[1] - 2 * np.pi, there[2])
    assert np.allclose(earth.enu_offset(place, turned), step, rtol=1e-9, atol=1e-6)
    moved = earth.matrix_en(*place[:2]).T @ (
        ecef(*there) - ecef(*place))
    assert np.allclose(moved, step, rtol=0.012, atol=0.1)
