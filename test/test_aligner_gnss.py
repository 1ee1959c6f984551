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
"""The aligner with GNSS messages that are wrong, late, missing or of no use."""

from dataclasses import replace
import math

from alignment import (
    aligned, check_same, check_same_attitude, config_for, feed, feed_part, give_all, LEVER,
    normalised_error, simulated, turning_car)
from ins_align.aligner import Aligner, State
from ins_align.config import Config
from ins_align.geometry.rotation import exp_so3
from ins_align.results import Severity
from ins_align.simulation.simulate import give
import numpy as np
import pytest
from scipy.stats import chi2

SECOND = 1_000_000_000


def test_positions_that_are_left_out_are_told_in_the_reason(flight):
    aligner = Aligner(config_for(flight))
    for start in (0, 200, 400):
        used = slice(start, start + 200)
        aligner.add_imu(flight.imu_stamps_ns[used], flight.gyro[used], flight.accel[used])
        aligner.update()
    for k in range(10):
        aligner.add_fix(flight.fix(k))
        aligner.add_fix(flight.fix(28)._replace(status=-1))
    aligner.update()
    assert aligner.status().reason.startswith(
        'no GNSS position yet: 10 without a fix, '
        '10 further behind the IMU than gnss_lateness allows (the last one by 4.2 s); '
        'GNSS messages come up to 6.0 s later than newer IMU samples: set gnss_lateness to 6.5')


@pytest.mark.parametrize('off_s, words', [
    (37.0, '50 far ahead of the IMU (the last one by'),
    (-18.0, '50 further behind the IMU than gnss_lateness allows (the last one by')])
def test_how_far_the_clocks_are_apart_is_said(flight, off_s, words):
    aligner = Aligner(config_for(flight))
    aligner.add_imu(flight.imu_stamps_ns[:1000], flight.gyro[:1000], flight.accel[:1000])
    for k in range(50):
        fix = flight.fix(k)
        aligner.add_fix(fix._replace(stamp_ns=fix.stamp_ns + round(off_s * SECOND)))
    aligner.update()
    reason = aligner.status().reason
    behind_s = (flight.imu_stamps_ns[999] - flight.gnss_stamps_ns[49]) * 1e-9
    assert f'{words} {abs(off_s - behind_s):.1f} s)' in reason


@pytest.mark.parametrize('without', ('numbers', 'axes', 'velocities'))
def test_velocities_of_no_use_are_told_also_where_positions_do(flight, without):
    aligner = Aligner(config_for(flight))
    for part in (slice(600), slice(600, 1200)):
        for k in range(part.stop // 20 - 30, part.stop // 20):
            aligner.add_fix(flight.fix(k))
            if without == 'axes':
                aligner.reject('velocity_body_frame', 'in the wrong axes')
            elif without == 'numbers':
                aligner.add_velocity(flight.velocity_measurement(k)._replace(
                    velocity=np.full(3, np.nan)))
        aligner.add_imu(flight.imu_stamps_ns[part], flight.gyro[part], flight.accel[part])
        aligner.update()
    status = aligner.status()
    assert status.state is State.ALIGNING and status.counts['epochs_used'] > 20
    assert '; no GNSS velocity is used: ' + {
        'axes': 'in the wrong axes', 'numbers': '60 without numbers',
        'velocities': 'none comes'}[without] in status.reason
    for k in range(60, 100):
        aligner.add_fix(flight.fix(k))
        aligner.add_velocity(flight.velocity_measurement(k))
    aligner.add_imu(flight.imu_stamps_ns[1200:], flight.gyro[1200:], flight.accel[1200:])
    aligner.flush()
    assert 'no GNSS velocity' not in aligner.status().reason


def test_why_velocities_were_refused_is_said_while_they_are_waited_for(flight):
    aligner = Aligner(config_for(flight, use_velocity=True))
    for why in ('in the wrong axes', 'in the wrong axes', ''):
        aligner.reject('velocity_body_frame', why)
    for k in range(20):
        aligner.add_fix(flight.fix(k))
    aligner.add_imu(flight.imu_stamps_ns, flight.gyro, flight.accel)
    aligner.flush()
    status = aligner.status()
    assert status.state is State.WAITING_FOR_GNSS
    assert status.reason == 'no GNSS velocity yet: in the wrong axes'
    assert status.counts['velocity_body_frame'] == 3
    assert aligner.take_events().count((Severity.WARNING, 'in the wrong axes')) == 1


def test_why_messages_were_refused_is_forgotten_when_others_come(flight):
    aligner = Aligner(config_for(flight))
    aligner.reject('velocity_body_frame', 'in the wrong axes')
    aligner.add_fix(flight.fix(0))
    aligner.add_imu(flight.imu_stamps_ns[:300], flight.gyro[:300], flight.accel[:300])
    aligner.flush()
    assert 'in the wrong axes' in aligner.status().reason
    aligner.reset()
    aligner.add_fix(flight.fix(20))
    aligner.add_imu(flight.imu_stamps_ns[300:800], flight.gyro[300:800], flight.accel[300:800])
    aligner.flush()
    assert aligner.status().reason == 'no GNSS velocity yet'


def test_velocities_that_are_wanted_alone_are_waited_for(flight):
    aligner, epochs = aligned(flight, velocity=False, use_position=False)
    status = aligner.status()
    assert not epochs and status.state is State.WAITING_FOR_GNSS
    assert status.reason == 'no GNSS velocity yet, and use_position is false'


def test_gnss_from_before_the_last_epoch_is_left_out(flight):
    """After a flush messages may come again that the queue would have refused."""
    aligner, _ = aligned(flight)
    before = aligner.status().current
    aligner.add_velocity(flight.velocity_measurement(-2))
    assert not aligner.flush()
    assert aligner.counts['gnss_out_of_order'] == 1
    assert aligner.status().current == before


def test_without_gnss_what_was_declared_is_withdrawn_when_it_is_lost():
    s = simulated('flight', imu_grade='mems', duration=240.0, seed=1)
    aligner = Aligner(config_for(s, rate_random_walk=0.5))
    states = []
    for first in range(0, len(s.imu_stamps_ns), 200):
        part = slice(first, first + 200)
        for k in np.flatnonzero((s.gnss_stamps_ns >= s.imu_stamps_ns[part][0])
                                & (s.gnss_stamps_ns <= s.imu_stamps_ns[part][-1])):
            if s.gnss_stamps_ns[k] < s.gnss_stamps_ns[0] + 40 * SECOND:
                aligner.add_fix(s.fix(int(k)))
                aligner.add_velocity(s.velocity_measurement(int(k)))
        aligner.add_imu(s.imu_stamps_ns[part], s.gyro[part], s.accel[part])
        aligner.update()
        status = aligner.status()
        states.append(status.state)
        if status.state is State.ALIGNED:
            assert status.current.sigma_deg[2] <= 2.0 and status.current.sigma_deg[0] <= 1.0
            assert normalised_error(status.current, s) < chi2.ppf(0.9999, 3)
    assert State.ALIGNED in states and states[-1] is State.ALIGNING
    assert '; no GNSS for 19' in status.reason and status.counts['withdrawals'] == 1
    events = [(event.severity, event.text.split(':')[0]) for event in aligner.take_events()]
    assert events[-2:] == [(Severity.INFO, 'ALIGNED'), (Severity.WARNING, 'ALIGNING')]


def test_zeros_in_a_tunnel_are_no_velocities():
    """A driver that goes on without a fix is the same as one that is silent."""
    s = simulated('car', imu_grade='mems', duration=60.0, seed=1)

    def zero(k, kind, message):
        if not 150 <= k < 200:
            return message
        return message._replace(**{'status': -1} if kind == 'fix' else {'velocity': np.zeros(3)})

    def none(k, kind, message):
        return None if 150 <= k < 200 else message

    def run(change):
        aligner = Aligner(config_for(s))
        return give_all(aligner, s, change=change), aligner.status()

    (silent, at_end), (zeros, with_zeros) = run(none), run(zero)
    assert with_zeros.counts['velocity_no_fix'] == 50 and with_zeros.state is State.ALIGNED
    assert with_zeros.reason == at_end.reason and len(zeros) == len(silent)
    check_same_attitude(zeros[-1].current, silent[-1].current)


@pytest.mark.parametrize('use_position', ('auto', False))
def test_positions_take_over_where_velocities_stop(use_position):
    s = simulated('car', imu_grade='mems', duration=90.0, seed=1, position_std=1.0)
    epochs = give_all(
        Aligner(config_for(s, use_position=use_position)), s,
        change=lambda k, kind, message: message if kind == 'fix' or k < 150 else None)
    assert len(epochs) == len(s.gnss_stamps_ns)
    error = normalised_error(epochs[-1].current, s)
    assert error < chi2.ppf(0.9999, 3)
    assert (epochs[-1].state is State.ALIGNED) == (use_position == 'auto')
    assert (epochs[-1].current.sigma_deg[2] < 1.0) == (use_position == 'auto')
    assert ('no GNSS for 60 s' in epochs[-1].reason) == (use_position is False)
    assert 'no GNSS velocity is used: none came for 60 s' in epochs[-1].reason


def test_what_is_not_used_declares_nothing():
    """Positions go on and are used 10 s after the last velocity: the hold time waits for them."""
    s = simulated('flight', imu_grade='mems', duration=60.0, seed=1)
    start_ns, states = int(s.gnss_stamps_ns[0]), {}
    for alone in (False, True):
        aligner = Aligner(config_for(s, hold_time=4.0))
        epochs = give_all(aligner, s, change=lambda k, kind, message: None if alone and (
            kind == 'velocity' and message.stamp_ns - start_ns > 18_500_000_000) else message)
        states[alone] = [epoch.state for epoch in epochs
                         if 18.5 < (epoch.stamp_ns - start_ns) * 1e-9 < 28.0]
    assert State.ALIGNED in states[False] and State.ALIGNED not in states[True]


@pytest.mark.parametrize('until_s', (
    5.0, pytest.param(25.0, marks=pytest.mark.campaign)))
def test_velocities_that_come_late_are_used_without_positions(until_s):
    """Positions that wander are better than nothing, and worse than velocities alone."""
    s = simulated('hover', imu_grade='mems', duration=90.0, seed=1, position_std=0.5,
                  position_drift_std=1.5)

    first_ns = int(s.gnss_stamps_ns[0] + until_s * SECOND)

    def run(block):
        aligner, epochs = Aligner(config_for(s)), []
        for count, (kind, payload) in enumerate(s.messages()):
            if kind != 'velocity' or payload.stamp_ns >= first_ns:
                give(aligner, kind, payload)
            if count % block == 0:
                epochs += aligner.update()
        return aligner, epochs + aligner.flush()

    aligner, epochs = run(500)
    assert aligner.status().state is State.ALIGNED
    assert next(e.t_s for e in epochs if e.state is State.ALIGNED) < until_s + 55.0
    declared = [normalised_error(e.current, s) for e in epochs if e.state is State.ALIGNED]
    assert max(declared) < chi2.ppf(0.99999, 3)
    check_same(epochs, run(7)[1])


def test_velocities_that_stop_at_once_are_the_same_in_any_split():
    """They leave too few for a first solution: positions make it, from the same epoch on."""
    s = simulated('flight', imu_grade='mems', duration=60.0, seed=2, position_std=1.0)
    last = []
    for part in (50, len(s.imu_stamps_ns)):
        aligner = Aligner(config_for(s))
        for k in range(len(s.gnss_stamps_ns)):
            aligner.add_fix(s.fix(k))
            if k < 2:
                aligner.add_velocity(s.velocity_measurement(k))
        for first in range(0, len(s.imu_stamps_ns), part):
            now = slice(first, first + part)
            aligner.add_imu(s.imu_stamps_ns[now], s.gyro[now], s.accel[now])
            epochs = aligner.update()
        last.append((epochs + aligner.flush())[-1])
    check_same(last[:1], last[1:])
    assert normalised_error(last[0].current, s) < chi2.ppf(0.9999, 3)


def test_epochs_without_gnss_are_not_counted_as_gnss(flight):
    """The IMU is silent while there is no GNSS: an epoch in between starts over."""
    stamps = flight.imu_stamps_ns
    used = np.flatnonzero((stamps < stamps[0] + 14 * SECOND) | (stamps > stamps[0] + 15 * SECOND))
    given = [k for k, stamp in enumerate(flight.gnss_stamps_ns)
             if not 10 * SECOND < stamp - stamps[0] < 20 * SECOND]
    aligner = Aligner(config_for(flight))
    epochs = give_all(aligner, flight, used,
                      change=lambda k, kind, message: message if k in given else None)
    counts = aligner.status().counts
    assert counts['restarts'] == 1
    used, refused = counts['epochs_used'], counts['epochs_rejected_velocity']
    assert used + refused == len(epochs)
    assert used + refused + counts['epochs_before_start'] == len(given)


@pytest.mark.parametrize('seed', (0, 32, 36))
def test_gnss_every_five_seconds(seed):
    """Epochs without a measurement between them do not stand for measurements."""
    s = simulated('flight', imu_grade='navigation', duration=100.0, seed=seed, gnss_rate=0.2)
    epochs = feed(Aligner(config_for(s)), s)
    assert epochs[-1].state is State.ALIGNED
    assert normalised_error(epochs[-1].current, s) < chi2.ppf(0.9999, 3)


def test_velocity_without_its_vertical(flight, result):
    """Not a number says that it is not measured: the rest of the message is good."""
    aligner = Aligner(config_for(flight))
    epochs = give_all(aligner, flight, change=lambda k, kind, message: (
        message if kind == 'fix' else message._replace(
            velocity=np.array([*message.velocity[:2], np.nan]))))
    counts = aligner.status().counts
    assert counts.get('velocity_nan', 0) == 0
    assert counts['velocity_no_vertical'] == len(flight.gnss_stamps_ns)
    assert epochs[-1].state is State.ALIGNED
    assert normalised_error(epochs[-1].current, flight) < chi2.ppf(0.9999, 3)
    assert epochs[-1].current.sigma_deg[2] >= result[1][-1].current.sigma_deg[2]


@pytest.mark.parametrize('settings, known_from', [
    ({}, 8.0), ({}, math.inf), ({'use_velocity': False}, 8.0), ({'use_position': True}, math.inf),
    ({'use_velocity': False}, math.inf), ({'use_position': True}, 8.0)])
def test_positions_without_their_altitude(flight, settings, known_from):
    aligner = Aligner(config_for(flight, **settings))
    known_ns = flight.gnss_stamps_ns[0] + known_from * SECOND
    epochs = give_all(aligner, flight, change=lambda k, kind, message: (
        message._replace(altitude_m=math.nan) if kind == 'fix' and message.stamp_ns < known_ns
        else message))
    counts = aligner.status().counts
    assert counts.get('fix_nan', 0) == counts.get('fix_jump', 0) == 0
    assert counts.get('fix_no_altitude', 0) > 0
    assert settings.get('use_velocity') is False or epochs[-1].state is State.ALIGNED
    assert normalised_error(epochs[-1].current, flight) < chi2.ppf(0.9999, 3)


def test_gnss_clock_that_is_off_is_named_and_not_declared():
    s = simulated('car', imu_grade='tactical', duration=50.0, seed=4)
    s = replace(s, gnss_stamps_ns=s.gnss_stamps_ns + 670_000_000,
                gnss_arrival_ns=s.gnss_arrival_ns + 670_000_000)
    aligner = Aligner(config_for(s, gnss_delay_std=0.1))
    assert not any(epoch.state is State.ALIGNED for epoch in feed(aligner, s)[-100:])
    assert 'set gnss_delay' in aligner.status().reason


def test_gnss_that_is_sent_again_between_its_epochs_is_that_of_its_epochs():
    """A receiver of 1 Hz, whose driver publishes its last message at 5 Hz with stamps of now."""
    s = simulated('flight', imu_grade='mems', duration=60.0, seed=3)

    def of_epochs(stamped, measured):
        return replace(s, gnss_stamps_ns=s.gnss_stamps_ns[stamped],
                       gnss_arrival_ns=s.gnss_arrival_ns[stamped],
                       lla_deg=s.lla_deg[measured], velocity=s.velocity[measured])

    every = np.arange(len(s.gnss_stamps_ns))
    fifth = every[::5]
    slow, repeated = (aligned(of_epochs(*epochs))[0].status()
                      for epochs in ((fifth, fifth), (every, every // 5 * 5)))
    assert repeated.state is slow.state is State.ALIGNED
    check_same_attitude(repeated.current, slow.current)
    assert repeated.counts['gnss_repeated'] == len(every) - len(fifth)


def test_covariances_of_any_size_break_nothing(flight):
    sizes = (1e-12, 1e-4, 1.0, 1e12)
    aligner = Aligner(config_for(flight, use_position=True))
    give_all(aligner, flight, change=lambda k, kind, message: message._replace(
        covariance=sizes[(k if kind == 'fix' else -k) % 4] * np.eye(3)))
    initial = aligner.status().initial
    assert np.all(np.isfinite(initial.quaternion_xyzw))
    assert np.all(np.linalg.eigvalsh(initial.covariance) > 0)


@pytest.mark.parametrize('sent, used', (
    (np.zeros((3, 3)), None), (-np.eye(3), None), (np.diag([1.0, np.nan, 1.0]), None),
    (np.eye(3) + 2.0 * np.eye(3)[[1, 0, 2]], np.diag([1.0, 1.0, 3.0]))),
    ids=('zero', 'negative', 'nan', 'indefinite'))
def test_of_a_covariance_that_is_none_the_variances_count(flight, sent, used):
    one, other = (give_all(
        Aligner(config_for(flight)), flight, slice(1500),
        change=lambda k, kind, message: message._replace(covariance=covariance))[-1].current
        for covariance in (sent, used))
    assert np.array_equal(one.covariance, other.covariance)
    assert np.array_equal(one.C_nb, other.C_nb)


def test_position_that_jumps_for_good_starts_over(flight):
    aligner = Aligner(config_for(flight))
    feed_part(aligner, flight, 0.0, 10.0)
    for kind, payload in flight.messages():
        stamp = int(payload[0][0]) if kind == 'imu' else payload.stamp_ns
        if stamp < flight.imu_stamps_ns[0] + 10 * SECOND:
            continue
        if kind == 'fix':
            payload = payload._replace(latitude_deg=payload.latitude_deg + 1.0)
        give(aligner, kind, payload)
    aligner.update()
    assert aligner.status().counts['restarts'] == 1
    assert aligner.status().counts['fix_jump'] >= 5


@pytest.mark.parametrize('velocity', (True, False))
def test_a_minute_without_gnss_in_turns_is_bridged(velocity):
    """The place is lost by kilometres, and with it where gravity points, but not the attitude."""
    s = simulated('flight', imu_grade='tactical', seed=1, duration=130.0, position_std=0.02,
                  outages=((50.0, 110.0),))
    status = aligned(s, velocity=velocity)[0].status()
    assert status.state is State.ALIGNED and status.counts.get('restarts', 0) == 0
    for attitude in (status.initial, status.current):
        assert normalised_error(attitude, s) < chi2.ppf(0.9999, 3)


def test_single_wild_fix_is_not_believed(flight):
    aligner = Aligner(config_for(flight))
    give_all(aligner, flight, change=lambda k, kind, message: (
        message._replace(longitude_deg=-60.0) if kind == 'fix' and k % 50 == 25 else message))
    status = aligner.status()
    assert status.counts['fix_jump'] >= 2 and status.counts.get('restarts', 0) == 0
    assert normalised_error(status.initial, flight) < chi2.ppf(0.9999, 3)


@pytest.mark.parametrize('before_s', (0.0, 10.0))
def test_memory_is_bounded_without_gnss_and_when_it_stays_away(flight, before_s):
    aligner = Aligner(config_for(flight))
    feed_part(aligner, flight, 0.0, before_s)
    last, chunk = int(flight.imu_stamps_ns[-1]), 1000
    for k in range(60):
        stamps = last + np.arange(k * chunk + 1, (k + 1) * chunk + 1, dtype=np.int64) * 10_000_000
        aligner.add_imu(stamps, np.zeros((chunk, 3)), np.tile([0.0, 0.0, 9.8], (chunk, 1)))
        aligner.update()
    assert aligner._imu.stamps.size < 3 * chunk
    status = aligner.status()
    assert before_s or status.state is State.WAITING_FOR_GNSS
    assert status.current is None or np.all(np.isfinite(status.current.covariance))


def test_velocity_in_the_other_frame_is_a_fault_with_the_cure():
    s = turning_car(2, velocity_frame='ned')
    aligner, epochs = aligned(s)
    assert State.ALIGNED not in [e.state for e in epochs]
    assert aligner.status().state is State.FAULT
    assert 'velocity_frame' in aligner.status().reason


def test_a_velocity_in_the_other_frame_is_no_fault_once_velocities_have_ended():
    """Positions go on; the fault is there again as soon as velocities are."""
    s = simulated('car', imu_grade='mems', duration=180.0, seed=1, velocity_frame='ned',
                  position_std=0.05)
    seconds = (s.gnss_stamps_ns - s.gnss_stamps_ns[0]) * 1e-9
    silent = (seconds > 50.0) & (seconds < 160.0)
    epochs = give_all(Aligner(config_for(s)), s, change=lambda k, kind, message: (
        None if kind == 'velocity' and silent[k] else message))
    before, epoch, after = (next(epoch for epoch in epochs if epoch.t_s > time)
                            for time in (49.0, 155.0, 160.0))
    assert before.state is after.state is State.FAULT
    assert epoch.state is State.ALIGNED
    assert normalised_error(epoch.current, s) < chi2.ppf(0.9999, 3)


@pytest.mark.parametrize('frame, state', [('ned', State.FAULT), ('enu', State.LEVELLED)])
def test_sharp_positions_show_the_frame_of_a_slow_robot_within_seconds(frame, state):
    s = simulated('robot', imu_grade='mems', duration=20.0, seed=1, position_std=0.02,
                  velocity_frame=frame)
    status = aligned(s)[0].status()
    assert status.state is state
    assert ('north and east exchanged' in status.reason) == (frame == 'ned')


@pytest.mark.parametrize('bad', (0, 2))
@pytest.mark.parametrize('positions', (False, True))
def test_an_outlier_among_the_first_epochs_is_left_out_of_the_start(flight, positions, bad):
    """As if it had not been measured. Believed, it would start all headings wrongly."""
    def run(off):
        def change(k, kind, message):
            if k != bad or kind != ('fix' if positions else 'velocity'):
                return message
            if positions:
                return message._replace(latitude_deg=message.latitude_deg + off)
            return message._replace(velocity=message.velocity + off)

        aligner = Aligner(config_for(flight, use_velocity=False if positions else 'auto'))
        return aligner, give_all(aligner, flight, change=change)

    (_, plain), (without, others), (aligner, epochs) = map(
        run, (0.0, math.nan, 1e-3 if positions else 30.0))
    sigmas = epochs[-1].current.sigma_deg / plain[-1].current.sigma_deg
    assert np.all(sigmas < 1.2)
    name = f'epochs_rejected_{"position" if positions else "velocity"}'
    assert aligner.counts[name] == without.counts.get(name, 0) + 1
    for ours, theirs in zip((epochs[-1].initial, epochs[-1].current),
                            (others[-1].initial, others[-1].current)):
        check_same_attitude(ours, theirs)
    assert normalised_error(epochs[-1].current, flight) < chi2.ppf(0.9999, 3)


@pytest.mark.parametrize('seed', (1, pytest.param(0, marks=pytest.mark.campaign)))
@pytest.mark.parametrize('scenario', ('hover', 'static'))
def test_wild_gnss_from_the_start_is_found_out(scenario, seed):
    s = simulated(scenario, imu_grade='navigation', seed=seed, duration=60.0, outlier_rate=0.09,
                  outlier_velocity=2.0, outlier_position=50.0)
    aligner, epochs = aligned(s, lever_arm_std=1.0, gnss_delay_std=0.1)
    status = aligner.status()
    assert status.state in (State.LEVELLED, State.ALIGNED)
    for attitude in (status.initial, status.current):
        assert normalised_error(attitude, s) < chi2.ppf(0.9999, 3)
    assert abs(status.gnss_delay) < 4 * status.gnss_delay_std
    rejected = status.counts['epochs_rejected_velocity']
    assert 0.9 * np.sum(s.outlier) <= rejected <= np.sum(s.outlier) + 2


def stamp_fixes_apart(aligner, by_ns):
    """Make an aligner take fixes with a stamp of their own."""
    add_fix = aligner.add_fix
    aligner.add_fix = lambda fix: add_fix(fix._replace(stamp_ns=fix.stamp_ns + by_ns))
    return aligner


@pytest.mark.parametrize('apart', (-20_000_000, 20_000_000))
def test_receiver_that_stamps_fix_and_velocity_apart(flight, result, apart):
    """NMEA drivers stamp each sentence: the same answer as with one stamp, but for the place."""
    epochs = feed(stamp_fixes_apart(Aligner(config_for(flight)), apart), flight)
    assert len(epochs) == len(result[1])
    declared, expected = (next(epoch for epoch in run if epoch.state is State.ALIGNED)
                          for run in (epochs, result[1]))
    assert declared.t_s == expected.t_s
    assert np.allclose(declared.initial.C_nb, expected.initial.C_nb, atol=1e-5)


def test_wrong_frame_shows_with_stamps_apart_too():
    s = turning_car(1, velocity_frame='ned')
    aligner = stamp_fixes_apart(Aligner(config_for(s)), -9_000_000)
    feed(aligner, s)
    assert aligner.status().state is State.FAULT
    assert 'velocity_frame' in aligner.status().reason


def test_a_receiver_that_never_measures_the_vertical_is_noticed(flight, result):
    """One that stands still says 0 as well: nothing is noticed before it moves."""
    def run(vertical):
        aligner = Aligner(config_for(flight))
        give_all(aligner, flight, change=lambda k, kind, message: (
            message if kind == 'fix' else message._replace(velocity=vertical(message.velocity))))
        return aligner

    absent = run(lambda v: v * [1.0, 1.0, 0.0])
    told = Aligner(config_for(flight, velocity_vertical='absent'))
    feed(told, flight)
    assert absent.counts['velocity_no_vertical'] == absent.counts['velocity']
    # What was believed before it was noticed is not taken back.
    ratio = absent.status().initial.sigma_deg / told.status().initial.sigma_deg
    assert np.all(0.8 < ratio) and np.all(ratio < 1.05)
    assert normalised_error(absent.status().initial, flight) < chi2.ppf(0.9999, 3)
    assert result[0].counts['velocity_no_vertical'] == 0
    assert run(lambda v: 0.0 * v).counts['velocity_no_vertical'] == 0


@pytest.mark.parametrize('scenario', [
    pytest.param('car', marks=pytest.mark.campaign), 'flight', 'hover'])
def test_a_velocity_that_nothing_measures_says_nothing_about_the_tilt(scenario):
    """It is unknown to metres per second, and turns with errors of the attitude."""
    squares = []
    for seed in range(2):
        s = simulated(scenario, imu_grade='chip', duration=20.0, seed=seed, gnss_rate=20.0,
                      velocity_std=0.02)
        _, epochs = aligned(s, imu_grade='chip', velocity_vertical='absent')
        squares += [normalised_error(epoch.current, s) / 3 for epoch in epochs
                    if epoch.current is not None and epoch.t_s > 3.0]
    # 0.6 to 2.4 where the vertical velocity is measured.
    assert np.mean(squares) < 3.0


def test_a_vertical_velocity_that_is_measured_again_is_used_again():
    s = simulated('flight', imu_grade='tactical', duration=60.0, seed=1)
    again = 75 + int(np.argmax(np.abs(s.velocity[75:225, 2])))
    assert abs(s.velocity[again, 2]) > 1.0

    def change(k, kind, message):
        missing = kind == 'velocity' and 50 <= k < again
        return message._replace(vertical=False) if missing else message

    aligner = Aligner(config_for(s))
    epochs = give_all(aligner, s, change=change)
    assert aligner.counts['epochs_rejected_velocity'] == 0
    assert epochs[-1].state is State.ALIGNED
    assert normalised_error(epochs[-1].current, s) < chi2.ppf(0.9999, 3)


@pytest.mark.parametrize('scenario, wrong', [('flight', 'late'), ('car', 'turned')])
def test_a_receiver_that_is_wrong_at_first_is_not_held_against_it(scenario, wrong):
    """A receiver is wrong for two minutes, 1.6 s late or turned by 60 deg, and right then."""
    s = simulated(scenario, seed=0, duration=180.0, imu_rate=50.0, gnss_rate=2.5)
    velocity = s.velocity.copy()
    first = s.gnss_stamps_ns < s.gnss_stamps_ns[0] + 110 * 10 ** 9
    if wrong == 'late':
        velocity[4:][first[4:]] = s.velocity[:-4][first[4:]]
    else:
        velocity[first] = s.velocity[first] @ exp_so3([0.0, 0.0, np.radians(60.0)]).T
    s = replace(s, velocity=velocity)
    epochs = feed(Aligner(Config(lever_arm=LEVER)), s)
    for epoch in epochs:
        assert (epoch.state is State.ALIGNED) <= (epoch.t_s > 110.0)
    assert next(epoch.t_s for epoch in epochs if epoch.state is State.ALIGNED) < 160.0
    assert normalised_error(epochs[-1].current, s) < chi2.ppf(0.999, 3)
