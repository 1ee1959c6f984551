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
"""The aligner as a whole: the way through its states, and what it counts and returns."""

import re

from alignment import (
    aligned, config_for, error_deg, feed, feed_part, give_all, normalised_error, simulated)
from ins_align.aligner import Aligner, State
from ins_align.config import Config, ConfigError
from ins_align.geometry.rotation import matrix_from_quaternion, roll_pitch_yaw
from ins_align.results import Severity
import numpy as np
import pytest
from scipy.stats import chi2

SECOND = 1_000_000_000


def test_states_in_their_order(flight):
    aligner = Aligner(config_for(flight))
    status = aligner.status()
    assert status.state is State.WAITING_FOR_IMU and 'IMU' in status.reason
    assert status.initial is None and status.t0_ns is None
    for stamp, gyro, accel in zip(flight.imu_stamps_ns[:20].tolist(), flight.gyro, flight.accel):
        aligner.add_imu(stamp, gyro, accel)
    aligner.update()
    aligner.flush()
    assert aligner.status().state is State.WAITING_FOR_GNSS
    aligner = Aligner(config_for(flight))
    states = [epoch.state for epoch in feed(aligner, flight)]
    order = [state for k, state in enumerate(states) if k == 0 or state is not states[k - 1]]
    assert order[0] is State.ALIGNING and order[-1] is State.ALIGNED
    *_, (severity, words) = aligner.take_events()
    assert severity is Severity.INFO and words.startswith('ALIGNED: heading sigma')
    assert aligner.take_events() == []


def test_before_the_first_epoch_is_known_what_is_told():
    config = Config(lever_arm=(1.0, 2.0, 3.0), lever_arm_std=0.7, gnss_delay=0.2,
                    gnss_delay_std=0.03, imu_grade='tactical')
    status = Aligner(config).status()
    assert status.lever_arm.tolist() == [1.0, 2.0, 3.0] and status.gnss_delay == 0.2
    assert status.lever_arm_std.tolist() == [0.7] * 3 and status.gnss_delay_std == 0.03
    assert not status.gyro_bias.any() and not status.accel_bias.any()
    assert np.allclose(status.gyro_bias_std, config.imu_noise.gyro_bias_std)
    assert np.allclose(status.accel_bias_std, config.imu_noise.accel_bias_std)


def test_only_positions_wait_for_velocities_and_then_go_on(flight):
    aligner, epochs = aligned(flight, velocity=False)
    assert epochs[0].stamp_ns - flight.gnss_stamps_ns[0] >= 2 * SECOND
    assert normalised_error(aligner.status().initial, flight) < chi2.ppf(0.9999, 3)


def test_velocities_that_are_not_wanted_are_counted_and_change_nothing(flight):
    runs = [aligned(flight, velocity=velocity, use_velocity=False) for velocity in (True, False)]
    assert runs[0][0].counts['velocity'] == len(flight.gnss_stamps_ns)
    given, without = (aligner.status() for aligner, _ in runs)
    assert np.array_equal(given.current.C_nb, without.current.C_nb)


def test_only_velocities_wait_for_a_position(flight):
    aligner, epochs = aligned(flight, fix=False)
    assert epochs == [] and aligner.status().state is State.WAITING_FOR_GNSS
    assert 'position' in aligner.status().reason


@pytest.mark.parametrize('changes', ({'use_velocity': True}, {'method': 'vif'}))
def test_wanted_velocities_are_waited_for(flight, changes):
    aligner, epochs = aligned(flight, velocity=False, **changes)
    status = aligner.status()
    assert epochs == [] and status.state is State.WAITING_FOR_GNSS and status.t0_ns is None
    assert 'no GNSS velocity' in status.reason


def test_faults_of_velocities_that_are_not_wanted_are_only_counted():
    aligner = Aligner(Config(use_velocity=False))
    aligner.reject('velocity_body_frame', 'in the wrong axes')
    assert aligner.status().counts['velocity_body_frame'] == 1 and not aligner.take_events()


def test_events_that_nobody_takes_are_bounded():
    aligner = Aligner()
    for k in range(3000):
        aligner.reset(f'number {k}')
    events = aligner.take_events()
    assert len(events) <= 1000 and events[-1].text == 'alignment starts over: number 2999'
    assert aligner.take_events() == []


@pytest.mark.parametrize('changes', (
    {'use_velocity': True}, {'method': 'vif'}, {'use_position': False}))
def test_fixes_and_velocities_of_different_epochs_start_together(flight, changes):
    """Stamps that are 60 ms apart are not one epoch."""
    aligner = Aligner(config_for(flight, **changes))
    give_all(aligner, flight, change=lambda k, kind, message: message if kind == 'fix' else
             message._replace(stamp_ns=message.stamp_ns + 60_000_000))
    assert aligner.status().t0_ns is not None


@pytest.mark.parametrize('imu_from_s, gnss_s', [(2.0, (1.2, 1.9)), (0.0, (0.0, 10.5))])
def test_gnss_that_ends_before_a_start_is_the_reason(flight, imu_from_s, gnss_s):
    """It is older than the IMU, or ends in a gap of the IMU."""
    aligner = Aligner(config_for(flight, gnss_lateness=5.0))
    seconds = (flight.gnss_stamps_ns - flight.imu_stamps_ns[0]) * 1e-9
    t = (flight.imu_stamps_ns - flight.imu_stamps_ns[0]) * 1e-9
    for k in np.flatnonzero((seconds >= gnss_s[0]) & (seconds < gnss_s[1])):
        aligner.add_fix(flight.fix(k))
        aligner.add_velocity(flight.velocity_measurement(k))
    kept = (t >= imu_from_s) & ((t < 9.0) | (t > 11.0))
    for block in np.array_split(np.flatnonzero(kept), 100):
        aligner.add_imu(flight.imu_stamps_ns[block], flight.gyro[block], flight.accel[block])
        aligner.update()
    status = aligner.status()
    assert status.state is State.WAITING_FOR_GNSS
    assert re.fullmatch(r'no GNSS (position yet|for \d+ s)', status.reason)


def test_epochs_tell_time_and_both_attitudes(flight, result):
    aligner, epochs = result
    assert [e.stamp_ns for e in epochs] == flight.gnss_stamps_ns.tolist()
    assert np.allclose([e.t_s for e in epochs],
                       (flight.gnss_stamps_ns - flight.gnss_stamps_ns[0]) * 1e-9)
    last = epochs[-1]
    assert last.initial.stamp_ns == flight.gnss_stamps_ns[0]
    assert last.current.stamp_ns == last.stamp_ns
    for attitude in (last.initial, last.current):
        assert normalised_error(attitude, flight) < chi2.ppf(0.9999, 3)
        assert attitude.quaternion_xyzw[3] >= 0
        rpy = np.degrees(roll_pitch_yaw(matrix_from_quaternion(attitude.quaternion_xyzw)))
        assert np.allclose([attitude.roll_deg, attitude.pitch_deg, attitude.yaw_deg], rpy)
        assert np.allclose(attitude.sigma_deg,
                           np.degrees(np.sqrt(np.diag(attitude.covariance))))


def test_declared_attitude_is_the_initial_one_of_that_moment(flight, result):
    aligner, epochs = result
    first = next(e for e in epochs if e.state is State.ALIGNED)
    assert aligner.declared.stamp_ns == flight.gnss_stamps_ns[0]
    assert np.array_equal(aligner.declared.quaternion_xyzw, first.initial.quaternion_xyzw)
    assert aligner.status().time_to_align_s == pytest.approx(first.t_s)
    assert first.t_s > Config().hold_time


def test_counts_add_up(flight, result):
    counts = result[0].status().counts
    assert counts['imu'] == len(flight.imu_stamps_ns)
    assert counts['fix'] == counts['velocity'] == len(flight.gnss_stamps_ns)
    assert counts['epochs_used'] + counts['epochs_rejected_velocity'] \
        + counts['epochs_rejected_position'] == len(flight.gnss_stamps_ns)


def test_attitude_now_is_carried_to_the_newest_sample(flight):
    aligner = Aligner(config_for(flight))
    assert aligner.attitude_now() is None
    feed_part(aligner, flight)
    now = aligner.attitude_now()
    assert now.stamp_ns == flight.imu_stamps_ns[-1] > aligner.status().stamp_ns + SECOND // 2
    assert error_deg(now, flight) < 3 * np.linalg.norm(now.sigma_deg) + 0.1
    assert np.all(now.sigma_deg >= aligner.status().current.sigma_deg)
    again = aligner.attitude_now()
    assert np.array_equal(now.quaternion_xyzw, again.quaternion_xyzw)


def test_reset_starts_over(flight):
    aligner = Aligner(config_for(flight))
    assert feed_part(aligner, flight, 0.0, 15.0)[-1].t_s > 10.0
    assert aligner.status().initial is not None
    aligner.reset('test')
    status = aligner.status()
    assert status.state is State.WAITING_FOR_IMU and status.initial is None
    assert aligner.declared is None and status.counts['resets'] == 1
    assert status.reason == 'no IMU sample since it started over'
    assert aligner.take_events()[-1] == (Severity.WARNING, 'alignment starts over: test')
    before = status.counts['imu']
    aligner.add_imu(flight.imu_stamps_ns[1600:1700], flight.gyro[:100], flight.accel[:100])
    aligner.reset('test')
    assert aligner.status().counts['imu'] == before + 100
    epochs = feed_part(aligner, flight, 15.0)
    assert aligner.status().t0_ns > flight.imu_stamps_ns[0] + 14 * SECOND
    assert epochs[0].t_s == 0.0
    assert epochs[-1].t_s == pytest.approx((epochs[-1].stamp_ns - epochs[0].stamp_ns) * 1e-9)


def test_thresholds_may_change_while_running_and_nothing_else(flight):
    aligner = Aligner(config_for(flight, heading_std_threshold=1e-3))
    feed_part(aligner, flight, 0.0, 25.0)
    assert aligner.status().state is not State.ALIGNED
    aligner.reconfigure(config_for(flight, heading_std_threshold=2.0))
    feed_part(aligner, flight, 25.0)
    assert aligner.status().state is State.ALIGNED
    with pytest.raises(ConfigError, match='lever_arm'):
        aligner.reconfigure(config_for(flight, lever_arm=(0.0, 0.0, 0.0)))


def test_rejected_messages_of_an_adapter_are_counted():
    aligner = Aligner()
    aligner.reject('velocity_body_frame')
    assert aligner.status().counts['velocity_body_frame'] == 1


def test_counts_hold_every_epoch_over_a_restart(flight):
    """The IMU is silent for a second; one epoch of each kind has a wild measurement."""
    stamps = flight.imu_stamps_ns
    used = np.flatnonzero((stamps < stamps[0] + 15 * SECOND) | (stamps > stamps[0] + 16 * SECOND))
    aligner = Aligner(config_for(flight, use_position=True))

    def spoil(k, kind, message):
        if k != 60:                                 # both: one epoch is spoilt, not two
            return message
        if kind == 'fix':
            return message._replace(altitude_m=message.altitude_m + 200.0)
        return message._replace(velocity=message.velocity + 50.0)

    epochs = give_all(aligner, flight, used, change=spoil)
    counts = aligner.status().counts
    assert counts['restarts'] == 1
    assert (counts['epochs_rejected_velocity'], counts['epochs_rejected_position']) == (1, 1)
    assert counts['epochs_used'] == len(epochs) - 1
    assert counts['epochs_used'] + 1 + counts['epochs_before_start'] == len(flight.gnss_stamps_ns)
    assert np.all(np.diff([epoch.t_s for epoch in epochs]) > 0)
    assert epochs[-1].t_s == pytest.approx((epochs[-1].stamp_ns - epochs[0].stamp_ns) * 1e-9)


def test_a_bank_that_starts_again_by_itself_says_so(flight):
    """Eleven velocities in a row are 50 m/s off; what follows is judged by itself."""
    aligner = Aligner(config_for(flight))

    def spoil(k, kind, message):
        if kind == 'fix' or not 40 <= k < 51:
            return message
        return message._replace(velocity=message.velocity + [30.0, -40.0, 10.0])

    epochs = give_all(aligner, flight, change=spoil)
    counts = aligner.status().counts
    assert counts['restarts'] == 1 and counts.get('withdrawals', 0) == 0
    assert (Severity.WARNING, 'alignment starts over: the last GNSS epochs do not fit the rest'
            ) in aligner.take_events()
    again = next(epoch for epoch in epochs if epoch.started_over)
    after = [epoch for epoch in epochs if epoch.t_s > again.t_s]
    declared = next(epoch for epoch in after if epoch.state is State.ALIGNED)
    assert aligner.status().time_to_align_s == pytest.approx(declared.t_s - again.t_s, abs=1e-6)
    assert counts['epochs_used'] + counts['epochs_rejected_velocity'] == len(epochs)


def test_nothing_is_learnt_of_lever_arm_and_delay_at_rest():
    """What the noise of the IMU looks like is no swing, and no delay."""
    s = simulated('static', duration=60.0, velocity_std=0.03, gnss_delay=0.1, seed=1)
    status = aligned(s, gnss_delay=0.0, gnss_delay_std=0.1, lever_arm_std=1.0)[0].status()
    assert status.state is State.LEVELLED
    assert status.gnss_delay == 0.0 and status.gnss_delay_std == pytest.approx(0.1, rel=0.01)
    assert status.lever_arm_std == pytest.approx(1.0)


def test_broken_messages_on_the_way_change_nothing_but_counts(flight, result):
    aligner = Aligner(config_for(flight))
    for k, (kind, payload) in enumerate(flight.messages()):
        if kind == 'imu':
            aligner.add_imu(*payload)
            stamp = int(payload[0][-1])
            aligner.add_imu(stamp + 1, np.full(3, np.nan), np.zeros(3))
            aligner.add_imu(stamp, np.zeros(3), np.zeros(3))               # twice
        elif kind == 'fix':
            aligner.add_fix(payload._replace(stamp_ns=payload.stamp_ns + 7, latitude_deg=np.nan))
            aligner.add_fix(payload._replace(stamp_ns=payload.stamp_ns + 7, status=-1))
            aligner.add_fix(payload)
            aligner.add_fix(payload)
        else:
            aligner.add_velocity(payload._replace(velocity=np.full(3, np.inf)))
            aligner.add_velocity(payload)
            aligner.add_velocity(payload._replace(stamp_ns=payload.stamp_ns - 60 * SECOND))
    aligner.flush()
    clean, spoilt = result[0].status(), aligner.status()
    assert np.array_equal(spoilt.initial.quaternion_xyzw, clean.initial.quaternion_xyzw)
    assert np.array_equal(spoilt.initial.covariance, clean.initial.covariance)
    for reason in ('imu_nan', 'imu_duplicate', 'fix_nan', 'fix_no_fix', 'fix_duplicate',
                   'velocity_nan', 'velocity_late'):
        assert spoilt.counts[reason] > 100, reason


def test_standing_first_neither_spoils_nor_delays():
    late = simulated('car', imu_grade='mems', duration=75.0, seed=4, stand_still=40.0,
                     gnss_rate=2.5)
    once = simulated('car', imu_grade='mems', duration=35.0, seed=4, gnss_rate=2.5)

    def time_to_align(s):
        _, epochs = aligned(s)
        return next(e.t_s for e in epochs if e.state is State.ALIGNED)

    assert time_to_align(late) - 40.0 < 1.2 * time_to_align(once)
