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
"""The aligner with a configuration or stated noise that is not that of the sensors."""

from dataclasses import replace
import math
import re

from alignment import (
    aligned, config_for, error_of, feed, give_all, normalised_error, simulated)
from ins_align.aligner import Aligner, State
from ins_align.config import Config, ImuNoise
from ins_align.gnss.messages import Fix, Velocity
from ins_align.offline import align
from ins_align.simulation.scenarios import displaced
from ins_align.simulation.simulate import gauss_markov, give
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2


WRONG = {
    'y axis reversed': ({'flip_axis': 'y'}, {}),
    'NED for ENU': ({'velocity_frame': 'ned'}, {}),
    'lever arm left out': ({'lever_arm': (1.5, -1.0, 1.0)}, {'lever_arm': (0.0, 0.0, 0.0)}),
    'delay left out': ({'gnss_delay': 0.2}, {'gnss_delay': 0.0}),
}


@pytest.mark.parametrize('scenario', ('flight', 'car'))
@pytest.mark.parametrize('wrong', WRONG)
@pytest.mark.parametrize('seed', (1, pytest.param(0, marks=pytest.mark.campaign)))
def test_wrong_set_up_is_never_declared_wrong(seed, wrong, scenario):
    """The default configuration: what is declared is right, or nothing is."""
    options, changes = WRONG[wrong]
    s = simulated(scenario, imu_grade='mems', duration=30.0, seed=seed, gnss_rate=4.0, **options)
    defaults = {'lever_arm_std': Config().lever_arm_std,
                'gnss_delay_std': Config().gnss_delay_std}
    _, epochs = aligned(s, **{**defaults, **changes})
    for epoch in epochs:
        if epoch.state is State.ALIGNED:
            error = np.degrees(error_of(epoch.initial, s))
            assert np.all(np.abs(error) < 5 * epoch.initial.sigma_deg), epoch.t_s


@pytest.mark.parametrize('scenario', ('car', 'flight', 'hover'))
def test_a_told_lever_arm_with_the_wrong_signs_is_aligned_rightly_and_named(scenario):
    told = (0.9, -0.6, 1.2)
    s = simulated(scenario, imu_grade='tactical', seed=3, duration=40.0, gnss_rate=2.5,
                  lever_arm=told)
    assert aligned(s, lever_arm_std=0.02)[1][-1].state is State.ALIGNED
    wrong = tuple(-metres for metres in told)
    aligner, epochs = aligned(s, lever_arm=wrong, lever_arm_std=0.02)
    for epoch in epochs:
        if epoch.state is State.ALIGNED:
            assert normalised_error(epoch.current, s) < chi2.ppf(0.999, 3)
    assert epochs[-1].state is State.ALIGNED
    reason = aligner.status().reason
    assert 'lever arm of [' in reason and 'raise lever_arm_std' in reason
    found = np.array(reason.split('[')[1].split(']')[0].split(','), float)
    assert np.allclose(found, told, atol=0.3)


@pytest.mark.parametrize('scenario, true, told', [
    ('car', 'mems', 'tactical'), ('flight', 'mems', 'tactical'),
    pytest.param('car', 'tactical', 'navigation', marks=(pytest.mark.campaign, pytest.mark.xfail(
        strict=True, reason='a tactical IMU passes for one of navigation grade')))])
def test_an_imu_worse_than_its_grade_is_aligned_rightly_and_named(scenario, true, told):
    of_the_grade = dict.fromkeys(ImuNoise._fields, 0.0)
    s = simulated(scenario, imu_grade=true, seed=0, duration=60.0)
    _, epochs = aligned(s, imu_grade=true, **of_the_grade)
    assert {e.state for e in epochs if e.t_s > 40.0} == {State.ALIGNED}
    aligner, epochs = aligned(s, imu_grade=told, **of_the_grade)
    for epoch in epochs:
        if epoch.t_s > 40.0:
            assert epoch.state is State.ALIGNED
            assert normalised_error(epoch.current, s) < chi2.ppf(0.999, 3)
    assert f'imu_grade={true}' in aligner.status().reason


@pytest.mark.parametrize('seed, grade', [(0, 'tactical'), (2, 'navigation')])
def test_a_receiver_that_understates_its_noise_says_nothing_about_the_grade(seed, grade):
    s = simulated('launch', imu_grade=grade, seed=seed, duration=40.0, velocity_std=0.2)
    s = replace(s, velocity_covariance=s.velocity_covariance / 4.0)
    _, epochs = aligned(s, imu_grade=grade, lever_arm_std=1.0, gnss_delay_std=0.1,
                        **dict.fromkeys(ImuNoise._fields, 0.0))
    assert {e.state for e in epochs if e.t_s > 20.0} == {State.ALIGNED}
    assert normalised_error(epochs[-1].current, s) < chi2.ppf(0.999, 3)


@pytest.mark.parametrize('scenario, grade, late, told', [
    ('flight', 'mems', 0.2, 0.0), ('car', 'tactical', 0.1, 0.0), ('hover', 'mems', 0.3, 0.1)])
def test_a_delay_that_is_told_wrongly_is_named_and_what_is_declared_right(scenario, grade, late,
                                                                          told):
    s = simulated(scenario, imu_grade=grade, seed=2, duration=60.0, gnss_delay=late)
    assert aligned(s)[1][-1].state is State.ALIGNED
    aligner, epochs = aligned(s, gnss_delay=told)
    for epoch in epochs:
        if epoch.state is State.ALIGNED:
            assert np.all(np.abs(np.degrees(error_of(epoch.initial, s)))
                          < 5 * epoch.initial.sigma_deg)
    status = aligner.status()
    assert status.state is State.ALIGNED
    assert 'raise gnss_delay_std' in status.reason
    found = float(status.reason.split('stamps that are ')[1].split(' s late')[0])
    assert abs(found - late) < 0.03


def test_a_delay_that_is_told_wrongly_and_does_no_harm_is_let_pass():
    """A car in streets whose receiver is 20 ms late: heading and sigma are as with the truth."""
    s = simulated('car', imu_grade='mems', seed=1, duration=60.0, gnss_delay=0.02)
    aligner, epochs = aligned(s, gnss_delay=0.0)
    assert epochs[-1].state is State.ALIGNED and aligner.counts['withdrawals'] == 0
    assert normalised_error(epochs[-1].current, s) < chi2.ppf(0.999, 3)


@pytest.mark.parametrize('grade', (
    'navigation', pytest.param('tactical', marks=pytest.mark.campaign), 'mems'))
@pytest.mark.parametrize('scenario', ('flight', 'car', 'hover', 'launch', 'reverse'))
def test_whatever_is_declared_is_right(scenario, grade):
    s = simulated(scenario, imu_grade=grade, duration=30.0, seed=11, outlier_rate=0.02,
                  gnss_latency=0.2, gnss_rate=2.5)
    aligner, epochs = aligned(s)
    for epoch in epochs:
        if epoch.state is State.ALIGNED:
            error = np.degrees(error_of(epoch.initial, s))
            assert np.all(np.abs(error) < 5 * epoch.initial.sigma_deg)
    if scenario in ('flight', 'launch'):
        assert epochs[-1].state is State.ALIGNED


@pytest.mark.parametrize('seed, delay', [
    (0, 0.1), (0, 0.0), (1, 0.1), (2, 0.0), (3, 0.1)])
def test_sharp_positions_of_a_car_that_pulls_away_at_once(seed, delay):
    """While it gathers speed, any turn about the specific force fits, not about the vertical."""
    s = simulated('car', imu_grade='mems', seed=seed, duration=40.0, position_std=0.02,
                  gnss_delay=delay)
    aligner = Aligner(Config(lever_arm=tuple(s.lever_arm)))
    epochs = feed(aligner, s, velocity=False)
    declared = next(epoch for epoch in epochs if epoch.state is State.ALIGNED)
    assert declared.t_s < 20.0
    for attitude in (declared.initial, declared.current, aligner.status().initial):
        assert np.all(np.abs(error_of(attitude, s)) <= 4 * np.sqrt(np.diag(attitude.covariance)))


@pytest.mark.parametrize('kind, seed', [
    ('velocity', 0), ('velocity', 1), ('velocity', 2), ('position', 0), ('position', 1)])
def test_sharp_gnss_that_is_late_sees_the_lever_arm_swing(seed, kind):
    sharp = {'velocity_std': 0.05} if kind == 'velocity' else {'position_std': 0.02}
    s = simulated('launch', imu_grade='tactical', seed=seed, duration=60.0, gnss_rate=5.0,
                  gnss_delay=0.17, lever_arm=(0.9, 1.3, -1.3), **sharp)
    aligner = Aligner(Config(imu_grade='tactical', lever_arm=tuple(s.lever_arm)))
    feed(aligner, s, velocity=kind == 'velocity')
    status = aligner.status()
    assert status.state is State.ALIGNED
    assert abs(status.gnss_delay - 0.17) < 0.01
    for attitude in (status.initial, status.current):
        assert np.all(np.abs(error_of(attitude, s)) <= 4 * np.sqrt(np.diag(attitude.covariance)))


@pytest.mark.parametrize('delay', [0.3, 0.6])
def test_delay_is_followed_as_far_as_its_sigma_allows(delay):
    s = simulated('flight', duration=40.0, gnss_delay=delay, seed=5)
    aligner, _ = aligned(s, gnss_delay=0.0, gnss_delay_std=0.5, gnss_lateness=2.0)
    status = aligner.status()
    assert status.state is State.ALIGNED
    assert abs(status.gnss_delay - delay) < 0.05
    assert normalised_error(status.current, s) < 16
    short = aligned(s, gnss_delay=0.0, gnss_delay_std=0.05, gnss_lateness=2.0)[0].status()
    assert short.state is not State.ALIGNED
    named = float(re.search(r'stamps (?:seem to be|that are) ([\d.]+) s late', short.reason)[1])
    assert abs(named - delay) < 0.05


def with_stated(s, covariance_of):
    """Return the epochs of a recording whose velocities state another covariance."""
    aligner, done = Aligner(config_for(s, imu_grade='mems')), []
    for k, (kind, payload) in enumerate(s.messages()):
        if kind == 'velocity':
            payload = payload._replace(covariance=covariance_of(payload))
        give(aligner, kind, payload)
        if k % 1000 == 0:
            done += aligner.update()
    return done + aligner.flush()


def first_aligned(epochs):
    return next(epoch.t_s for epoch in epochs if epoch.state is State.ALIGNED)


@pytest.mark.parametrize('true_std, duration', [(0.05, 45.0), (0.6, 90.0)])
def test_noise_that_the_receiver_does_not_state_is_found(true_std, duration):
    s = simulated('car', imu_grade='mems', duration=duration, seed=7, velocity_std=true_std,
                  velocity_std_vertical=true_std)
    stated = with_stated(s, lambda velocity: velocity.covariance)
    unstated = with_stated(s, lambda velocity: None)
    assert first_aligned(unstated) < 1.3 * first_aligned(stated)
    sigmas = [epochs[-1].current.sigma_deg for epochs in (stated, unstated)]
    assert np.all(np.abs(np.log(sigmas[1] / sigmas[0])) < 0.3)
    assert normalised_error(unstated[-1].current, s) < 16
    assert ('times as noisy as configured' in unstated[-1].reason) == (true_std == 0.6)


@pytest.mark.parametrize('scenario, longer', [('flight', 1.2), ('hover', 2.0), ('car', 4.0)])
def test_noise_that_the_receiver_overstates_is_found(scenario, longer):
    """Ten times, as common receivers do; a car at rest shows it once it moves."""
    s = simulated(scenario, imu_grade='mems', duration=60.0, seed=7, velocity_std=0.03,
                  velocity_std_vertical=0.05)
    right = with_stated(s, lambda velocity: velocity.covariance)
    overstated = with_stated(s, lambda velocity: 100 * velocity.covariance)
    assert first_aligned(overstated) < longer * first_aligned(right)
    sigmas = [epochs[-1].current.sigma_deg for epochs in (right, overstated)]
    assert np.all(sigmas[1] < 1.4 * sigmas[0])
    assert normalised_error(overstated[-1].current, s) < 16


@pytest.mark.parametrize('stated', [True, False])
def test_one_uncertain_velocity_among_the_first_does_not_make_the_others_look_quiet(stated):
    """Neither does it tell of a receiver that states nothing otherwise."""
    s = simulated('flight', imu_grade='mems', duration=30.0, seed=1)

    def sent(uncertain):
        def change(k, kind, message):
            if kind != 'velocity':
                return message
            if k == 1 and uncertain:
                return message._replace(covariance=90.0 * message.covariance)
            return message if stated else message._replace(covariance=None)

        return give_all(Aligner(config_for(s, velocity_std=0.1, velocity_std_vertical=0.1)), s,
                        change=change)

    plain, one = sent(False), sent(True)
    assert abs(first_aligned(one) - first_aligned(plain)) < 2.0
    assert one[-1].current.sigma_deg == pytest.approx(plain[-1].current.sigma_deg, rel=0.1)


@pytest.mark.parametrize('stated', [True, False])
@pytest.mark.parametrize('scenario, std, seed, within', [
    ('hover', 0.05, 3, 10.0), ('hover', 0.05, 5, 10.0), ('robot', 0.1, 5, math.inf)])
def test_a_receiver_that_holds_its_course_when_it_is_slow(scenario, std, seed, within, stated):
    """Below 1 m/s: otherwise a hover is not declared in time and a robot 150 deg wrong."""
    s = simulated(scenario, imu_grade='mems', duration=60.0, seed=seed, velocity_std=std,
                  velocity_std_vertical=std)
    held = s.velocity.copy()
    for before, now in zip(held, held[1:]):
        speed = np.hypot(*now[:2])
        if speed < 1.0:
            now[:2] = before[:2] * speed / np.hypot(*before[:2])
    sent = dict(zip(s.gnss_stamps_ns.tolist(), held))
    aligner = Aligner(config_for(
        s, imu_grade='mems', tilt_std_threshold=2.0, heading_std_threshold=4.0))
    for kind, payload in s.messages():
        if kind == 'velocity':
            payload = payload._replace(velocity=sent[payload.stamp_ns],
                                       covariance=payload.covariance if stated else None)
        give(aligner, kind, payload)
    done = [epoch for epoch in aligner.flush() if epoch.state is State.ALIGNED]
    assert aligner.status().counts['velocity_course_held'] > 150
    assert within == math.inf or first_aligned(done) < within
    errors = [normalised_error(epoch.current, s) for epoch in done]
    assert not errors or (np.quantile(errors, 0.9) < 16 and max(errors) < 40)


def test_errors_that_last_are_not_taken_for_a_quiet_receiver():
    """Of a receiver that filters, at 10 Hz: in the first 0.3 s they do not show."""
    s = simulated('car', imu_grade='mems', gnss_rate=10.0, velocity_std=0.01, duration=30.0,
                  seed=4, gyro_bias_std=0.1)
    lasting = gauss_markov(s.gnss_stamps_ns * 1e-9, 0.1, 0.5, np.random.default_rng(104))
    result = align(s.imu_stamps_ns, s.gyro, s.accel,
                   [Fix(stamp_ns, *lla, None, 0) for stamp_ns, lla
                    in zip(s.gnss_stamps_ns.tolist(), s.lla_deg.tolist())],
                   [Velocity(stamp_ns, v, None) for stamp_ns, v
                    in zip(s.gnss_stamps_ns.tolist(), s.velocity + lasting)], velocity_std=0.1)
    errors = [normalised_error(epoch.current, s) for epoch in result.epochs if epoch.t_s > 8.0]
    assert len(errors) > 200 and max(errors) < 25.0


@pytest.mark.parametrize('scenario', [
    'hover', pytest.param('robot', marks=pytest.mark.campaign)])
def test_positions_that_come_more_often_say_no_more(scenario):
    """A receiver filters over 2 s errors that last 20 s, at 20 Hz, and states none of it."""
    s = simulated(scenario, imu_grade='mems', duration=100.0, gnss_rate=20.0, seed=2,
                  position_std=0.01, lever_arm=(0.3, 0.2, 0.5))
    wander = gauss_markov(s.gnss_stamps_ns * 1e-9, 1.0, 20.0, np.random.default_rng(2))
    decay = math.exp(-1 / (2.0 * 20.0))
    filtered = lfilter([1 - decay], [1, -decay], wander, axis=0)
    result = align(s.imu_stamps_ns, s.gyro, s.accel,
                   [Fix(stamp_ns, *lla, None, 0) for stamp_ns, lla in zip(
                       s.gnss_stamps_ns.tolist(), displaced(s.lla_deg, filtered).tolist())],
                   lever_arm=(0.3, 0.2, 0.5), heading_std_threshold=5.0, tilt_std_threshold=1.5)
    assert result.aligned
    sigmas = [np.max(np.abs(error_of(epoch.current, s)) / np.radians(epoch.current.sigma_deg))
              for epoch in result.epochs if epoch.current is not None]
    assert len(sigmas) > 1900 and max(sigmas) < 4.0


@pytest.mark.parametrize('scenario', ['car', 'flight', 'static'])
def test_accelerometers_ten_times_worse_than_configured_are_noticed(scenario):
    # Along gravity, so that those who stand see it too.
    s = simulated(scenario, imu_grade='mems', duration=40.0, seed=2, gnss_rate=2.5)
    f_b = np.mean(s.truth_accel[:100], axis=0)
    bias = 0.5 * (f_b / np.linalg.norm(f_b) + [0.6, -0.6, 0.0])
    aligner, epochs = aligned(replace(s, accel=s.accel + bias), imu_grade='mems')
    for epoch in epochs:
        if epoch.state in (State.LEVELLED, State.ALIGNED):
            tilt = error_of(epoch.current, s)[:2] / np.sqrt(np.diag(epoch.current.covariance)[:2])
            assert np.max(np.abs(tilt)) < 5
    reason = aligner.status().reason
    assert 'set accel_bias_std=0.' in reason
