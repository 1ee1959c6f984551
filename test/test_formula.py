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
"""The note's formulas against noise-free motion, quadrature and brute force."""

from functools import lru_cache
from typing import NamedTuple

from alignment import cut_at, integrate
from ins_align.estimation import formula
from ins_align.estimation.moments import solve_moments
from ins_align.estimation.track import BodyTrack, InertialTrack
from ins_align.experiments.dense import bound, cumulative
from ins_align.geometry.earth import EARTH_RATE, earth_rate_n
from ins_align.geometry.rotation import skew
from ins_align.simulation.simulate import simulate
import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

LEVER = np.array([1.0, 1.0, 1.0])
ZERO = np.zeros(3)
PLACES = {
    'north': {'latitude_deg': 48.0}, 'south': {'latitude_deg': -37.0},
    'arctic': {'latitude_deg': 80.0}, 'equator': {'latitude_deg': 0.0},
    'antimeridian': {'latitude_deg': -18.0, 'longitude_deg': 179.9999},
}


def angle_deg(C_1, C_2):
    return np.degrees(Rotation.from_matrix(C_1 @ C_2.T).magnitude())


@lru_cache(maxsize=None)
def flight(place, duration=10.5):
    return simulate('flight', ideal=True, duration=duration, gnss_rate=5.0, **PLACES[place])


class Sides(NamedTuple):
    """Both sides of the formulas at an epoch: of a free start, and to the letter."""

    t: float
    track: InertialTrack
    body: BodyTrack
    s_v: np.ndarray
    s_p: np.ndarray
    a_v: np.ndarray
    a_p: np.ndarray
    beta_v: np.ndarray
    beta_p: np.ndarray
    alpha_v: np.ndarray
    alpha_p: np.ndarray


def run(simulation, lever=LEVER):
    """Both sides of the formulas at every epoch."""
    stamps = (simulation.imu_stamps_ns - simulation.gnss_stamps_ns[0]) * 1e-9
    epochs = (simulation.gnss_stamps_ns - simulation.gnss_stamps_ns[0]) * 1e-9
    lla = np.column_stack([np.radians(simulation.lla_deg[:, :2]), simulation.lla_deg[:, 2]])
    intervals, first = (
        integrate(cut_at(stamps, simulation.gyro, simulation.accel, ends))
        for ends in (epochs, epochs[[0, 0]]))
    velocity = simulation.velocity
    body, integral = BodyTrack().along(first).at(0), formula.VelocityIntegral(velocity[0])
    track = InertialTrack.start(*lla[0])
    swing = body.a_v(lever)
    for k in range(1, len(epochs)):
        body = body.along(intervals.take(slice(k - 1, k))).at(0)
        track = track.extended(*np.array([epochs[k], *lla[k]])[:, None]).at(0)
        t, s_v = epochs[k], track.s_v(velocity[k])
        integral.advance(t, s_v)
        a_v, a_p = body.a_v(lever), body.a_p(lever)
        yield Sides(t, track, body, s_v, integral.s_p, a_v, a_p, s_v - velocity[0],
                    integral.s_p - t * velocity[0], a_v - swing, a_p - lever - t * swing)


FORMS = {
    'vif to the letter': lambda at: (at.beta_v, at.alpha_v),
    'vif': lambda at: (at.s_v, at.a_v, 1.0),
    'pif to the letter': lambda at: (at.beta_p, at.alpha_p),
    'pif': lambda at: (at.s_p, at.a_p, 1.0, at.t),
    'pif of positions': lambda at: (at.track.s_p, at.a_p, 1.0, at.t),
}


def aligned(simulation, form, lever=LEVER):
    rows = np.array([np.hstack(FORMS[form](sides)) for sides in run(simulation, lever)])
    return solve_moments(rows.T @ rows)


@pytest.mark.parametrize('form', FORMS)
@pytest.mark.parametrize('place', PLACES)
def test_noise_free_attitude_after_ten_seconds(place, form):
    simulation = flight(place)
    C, residual, _ = aligned(simulation, form)
    truth = simulation.attitude_at(int(simulation.gnss_stamps_ns[0]))
    assert angle_deg(C, truth) < 1e-3
    assert residual < 1e-4


def test_flight_across_the_antimeridian_goes_across():
    longitude = flight('antimeridian').lla_deg[:, 1]
    assert longitude.min() < -179.9 and longitude.max() > 179.9


@pytest.mark.parametrize('form', ('vif', 'vif to the letter', 'pif', 'pif of positions'))
def test_without_lever_arm_the_attitude_is_off(form):
    simulation = flight('north')
    truth = simulation.attitude_at(int(simulation.gnss_stamps_ns[0]))
    assert angle_deg(aligned(simulation, form, ZERO)[0], truth) > 0.05


def test_body_and_navigation_side_agree_through_the_true_attitude():
    """Beta = C alpha at every epoch: what the note claims, on python-ins' sensors."""
    simulation = flight('north')
    C = simulation.attitude_at(int(simulation.gnss_stamps_ns[0]))
    for at in run(simulation):
        assert np.allclose(at.beta_v, C @ at.alpha_v, atol=2e-4)
        assert np.allclose(at.beta_p, C @ at.alpha_p, atol=2e-3)


def test_chain_rule_gives_the_current_attitude():
    simulation = flight('south')
    C = simulation.attitude_at(int(simulation.gnss_stamps_ns[0]))
    *_, last = run(simulation)
    truth = simulation.attitude_at(int(simulation.gnss_stamps_ns[-1]))
    assert angle_deg(last.track.C_n0n.T @ C @ last.body.C_b0b, truth) < 1e-4


# Short form of (9) against the exact one

def turning_flight(duration=1000.0, rate=50.0):
    """Attitude in b0, rates: a flight of turns, from python-ins."""
    simulation = simulate('flight', ideal=True, duration=duration, imu_rate=rate)
    time = (simulation.truth_stamps_ns - simulation.truth_stamps_ns[0]) * 1e-9
    C_nb = simulation.truth_C_nb
    lla = np.radians(simulation.truth_lla)
    omega_ie_b = np.einsum('nji,nj->ni', C_nb, earth_rate_n(lla[:, 0]))
    from pyins.transform import mat_en_from_ll
    C_en = mat_en_from_ll(*simulation.truth_lla[:, :2].T) @ np.array(
        [[0., 1., 0.], [1., 0., 0.], [0., 0., -1.]])
    earth = Rotation.from_rotvec(EARTH_RATE * time[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    C_ib = earth @ C_en @ C_nb
    return time, C_ib[0].T @ C_ib, simulation.truth_gyro, omega_ie_b


def exact_lever_remainder(time, C_b0b, omega_eb_b, omega_ie_b0, lever_b):
    """Difference of the exact form of (9) from the short one, shape (N, 3), m/s."""
    rate = skew(omega_eb_b)
    omega_ie_b = C_b0b.transpose(0, 2, 1) @ omega_ie_b0
    exact = C_b0b @ rate - rate[0] + skew(omega_ie_b0) @ cumulative(time, C_b0b @ rate)
    omega_ib_b = omega_eb_b + omega_ie_b
    short = C_b0b @ skew(omega_ib_b) - skew(omega_ib_b[0])
    return (exact - short) @ lever_b


def test_short_form_stays_within_its_bound_for_a_thousand_seconds():
    time, C_b0b, omega_ib_b, omega_ie_b = turning_flight()
    remainder = exact_lever_remainder(time, C_b0b, omega_ib_b - omega_ie_b, omega_ie_b[0],
                                      LEVER)
    size = np.linalg.norm(remainder, axis=1)
    limit = 2 * EARTH_RATE ** 2 * time * np.linalg.norm(LEVER)
    # Rounding and the trapezoidal rule of the oracle's integral weigh 1e-8 m/s.
    assert np.all(size <= limit + 2e-8)
    assert size[-1] > 0.02 * limit[-1]         # and it is not nothing: the bound is a bound


def test_exact_form_is_the_difference_of_antenna_and_imu_velocity():
    """In inertial space v_antenna - v_imu = C_ib [omega_ib x] l: both forms lead to it."""
    time, C_b0b, omega_ib_b, omega_ie_b = turning_flight(duration=200.0, rate=100.0)
    omega_eb_b = omega_ib_b - omega_ie_b
    # Left side of (9) for antenna minus IMU: relative velocity over ground and its Earth term.
    relative = np.einsum('nij,nj->ni', C_b0b, np.cross(omega_eb_b, LEVER))
    h = np.diff(time)[:, None]
    omega_ie_b0 = omega_ie_b[0]
    swept = np.cross(omega_ie_b0, relative)
    integral = np.vstack([ZERO, np.cumsum(h / 2 * (swept[1:] + swept[:-1]), axis=0)])
    exact = relative - relative[0] + integral
    rate = np.einsum('nij,nj->ni', C_b0b, np.cross(omega_ib_b, LEVER))
    short = rate - rate[0]
    remainder = exact_lever_remainder(time, C_b0b, omega_eb_b, omega_ie_b0, LEVER)
    assert np.allclose(exact - short, remainder, atol=1e-12)


# Positions alone against integrated velocity

class ClosedForm:
    """A turning, climbing course on the ellipsoid whose velocity is known in closed form."""

    def lla(self, t):
        return np.stack([0.8 + 2e-5 * np.sin(0.05 * t), 0.2 + 3e-5 * np.cos(0.04 * t) - 1e-6 * t,
                         500.0 + 30.0 * np.sin(0.1 * t)], axis=-1)

    def v_n(self, t):
        from pyins.earth import principal_radii
        latitude, _, altitude = np.moveaxis(self.lla(t), -1, 0)
        rn, _, rp = principal_radii(np.degrees(latitude), altitude)
        return np.stack([rp * (-1.2e-6 * np.sin(0.04 * t) - 1e-6), rn * 1e-6 * np.cos(0.05 * t),
                         3.0 * np.cos(0.1 * t)], axis=-1)


def test_positions_alone_are_the_integrated_velocity_form():
    from ins_align.geometry.earth import gravity_n, matrix_n0n
    course, end = ClosedForm(), 100.0
    start = course.lla(0.0)

    def turned(t, vector):
        return matrix_n0n(start[:2], t, *course.lla(t)[:2]) @ vector

    def integrand(t):
        lla, v_n = course.lla(t), course.v_n(t)
        coriolis = turned(t, np.cross(earth_rate_n(lla[0]), v_n))
        gravity = turned(t, gravity_n(lla[0], lla[2]))
        weight = end - t              # a double integral is one with the time still to go
        return np.concatenate([coriolis, gravity, turned(t, v_n), weight * coriolis,
                               weight * gravity])

    parts = quad_vec(integrand, 0.0, end, epsabs=1e-11, epsrel=1e-13)[0].reshape(5, 3)
    beta_v = turned(end, course.v_n(end)) - course.v_n(0.0) + parts[0] - parts[1]
    beta_p = parts[2] - end * course.v_n(0.0) + parts[3] - parts[4]
    track = InertialTrack.start(*start)
    before = track.s_v(course.v_n(0.0))
    assert np.allclose(before, course.v_n(0.0), atol=1e-12)
    time = np.arange(0.01, end + 0.005, 0.01)      # gravitation changes over hundreds of seconds
    places = np.array([course.lla(t) for t in time]).T
    half = time.size // 2
    track = track.extended(time[:half], *places[:, :half]).at(-1)
    track = track.extended(time[half:], *places[:, half:]).at(-1)
    # Rounding of positions is 1e-9 m.
    assert np.allclose(track.s_v(course.v_n(end)) - course.v_n(0.0), beta_v, atol=1e-8)
    assert np.allclose(track.s_p - end * course.v_n(0.0), beta_p, atol=1e-7)
    # Of velocities, five a second, the integral is known to a parabola.
    time, track = np.arange(0.2, end + 0.1, 0.2), InertialTrack.start(*start)
    track = track.extended(time, *np.array([course.lla(t) for t in time]).T)
    integral = formula.VelocityIntegral(course.v_n(0.0))
    for t, s_v in zip(time, track.s_v(np.array([course.v_n(t) for t in time]))):
        integral.advance(t, s_v)
    assert np.allclose(s_v - course.v_n(0.0), beta_v, atol=1e-6)
    assert np.allclose(integral.s_p - end * course.v_n(0.0), beta_p, atol=1e-3)


# q-method

@pytest.mark.parametrize('seed', range(5))
def test_q_method_is_the_least_squares_attitude(seed):
    random = np.random.default_rng(seed)
    truth = Rotation.random(random_state=seed)
    a = random.standard_normal((30, 3)) * [10.0, 5.0, 1.0]
    s = truth.apply(a) + 0.3 * random.standard_normal((30, 3))
    rows = np.hstack([s, a])
    C, residual, _ = solve_moments(rows.T @ rows)
    expected, rssd = Rotation.align_vectors(s, a)
    assert angle_deg(C, expected.as_matrix()) < 1e-6
    assert residual == pytest.approx(rssd ** 2, rel=1e-9)
    assert np.linalg.det(C) == pytest.approx(1.0)


def test_q_method_on_vectors_of_half_a_turn():
    truth = np.diag([1.0, -1.0, -1.0])
    rows = np.hstack([truth, np.eye(3)])
    C, residual, _ = solve_moments(rows.T @ rows)
    assert np.allclose(C, truth, atol=1e-12) and residual < 1e-12


@pytest.mark.parametrize('nuisance', (0, 1, 2))
def test_free_start_is_minimised_over(nuisance):
    """Moments in constant memory against a plain minimisation over attitude and start."""
    random = np.random.default_rng(7)
    time = np.linspace(0.0, 5.0, 20)
    truth = Rotation.from_rotvec([0.3, -0.2, 2.0])
    a = np.cumsum(random.standard_normal((20, 3)), axis=0)
    basis = np.vander(time, nuisance, increasing=True)
    s = (truth.apply(a) + basis @ random.standard_normal((nuisance, 3)) * 20.0
         + 0.1 * random.standard_normal((20, 3)))
    rows = np.hstack([s, a, basis])

    def cost(vector):
        left = s - Rotation.from_rotvec(vector).apply(a)
        if nuisance:
            left = left - basis @ np.linalg.lstsq(basis, left, rcond=None)[0]
        return np.sum(left ** 2)

    best = minimize(cost, truth.as_rotvec(), method='Nelder-Mead',
                    options={'xatol': 1e-9, 'fatol': 1e-12, 'maxiter': 4000})
    C, residual, A = solve_moments(rows.T @ rows)
    assert angle_deg(C, Rotation.from_rotvec(best.x).as_matrix()) < 1e-4
    assert residual == pytest.approx(best.fun, rel=1e-6)
    centred = a - basis @ np.linalg.lstsq(basis, a, rcond=None)[0] if nuisance else a
    assert np.allclose(A, centred.T @ centred)


def test_many_sums_at_once_each_without_one_pair():
    """Against scipy on the pairs that are left, with the free start projected out."""
    random = np.random.default_rng(4)
    basis = np.vander(np.arange(12.0), 2, increasing=True)
    a = random.standard_normal((12, 3)) * [3.0, 2.0, 1.0]
    s = Rotation.from_rotvec([0.3, -0.2, 2.0]).apply(a) + 0.3 * random.standard_normal((12, 3))
    rows = np.hstack([s, a, basis])
    C, residual, _ = solve_moments(rows.T @ rows - rows[:, :, None] * rows[:, None])
    for k in range(12):
        left = np.linalg.qr(np.delete(basis, k, 0), 'complete').Q[:, 2:].T
        expected, rssd = Rotation.align_vectors(left @ np.delete(s, k, 0),
                                                left @ np.delete(a, k, 0))
        assert angle_deg(C[k], expected.as_matrix()) < 1e-6
        assert residual[k] == pytest.approx(rssd ** 2, rel=1e-9)


def test_moments_of_hundreds_of_kilometres_keep_a_centimetre():
    """Position form after long: sums of squares of large numbers must not lose the small ones."""
    random = np.random.default_rng(3)
    time = np.arange(0.0, 1000.0, 0.2)
    truth = Rotation.from_rotvec([0.1, 0.2, -1.0])
    a = np.column_stack([50.0 * np.sin(0.1 * time), 50.0 * np.cos(0.07 * time), 4.9 * time ** 2])
    s = truth.apply(a) + 30.0 * time[:, None] + 0.02 * random.standard_normal(a.shape)
    moments = np.zeros((8, 8))
    for row in np.column_stack([s, a, np.ones(time.size), time]):
        moments += np.outer(row, row)
    C, _, _ = solve_moments(moments)
    assert angle_deg(C, truth.as_matrix()) < 1e-3


def test_free_start_reaches_the_bound_of_a_navigation_grade_imu():
    """Heading rms of the centred form against the Cramer-Rao bound; the letter's is worse."""
    errors = {'vif': [], 'vif to the letter': []}
    for seed in range(20):
        simulation = simulate('flight', imu_grade='navigation', duration=20.0, seed=seed)
        truth = simulation.attitude_at(int(simulation.gnss_stamps_ns[0]))
        for form, found in errors.items():
            C = aligned(simulation, form)[0]
            found.append(Rotation.from_matrix(C @ truth.T).as_rotvec()[2])
    sigma = np.sqrt(bound(simulation).covariance[-1][2, 2])
    rms = {form: np.sqrt(np.mean(np.square(found))) for form, found in errors.items()}
    assert 0.6 < rms['vif'] / sigma < 1.5      # 95 % of a chi-square of 20 are 0.69 to 1.31
    assert rms['vif to the letter'] > 1.2 * rms['vif']
