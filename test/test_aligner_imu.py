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
"""The aligner with IMU samples that are wrong, late, missing or of no use."""

from dataclasses import replace
import math

from alignment import (
    aligned, check_same, check_same_attitude, config_for, error_deg, feed, feed_part, give_all,
    normalised_error, simulated, turning_car)
from ins_align.aligner import Aligner, State
from ins_align.config import Config, PRESETS
from ins_align.results import Severity
from ins_align.simulation.scenarios import Motion, Scenario, SCENARIOS
from ins_align.simulation.simulate import give
import numpy as np
import pytest
from scipy.stats import chi2

SECOND = 1_000_000_000


@pytest.mark.parametrize('stamps, rate, words', [
    (np.zeros(200, int), 0.1, '199 with the stamp of another (does the driver set stamps?)'),
    (np.arange(200) * SECOND // 100, math.nan, '200 without numbers or with impossible ones')])
@pytest.mark.parametrize('at_once', (False, True))
def test_why_no_imu_sample_is_of_use_is_said(stamps, rate, words, at_once):
    aligner = Aligner()
    aligner.update()
    assert aligner.status().reason == 'no IMU sample yet'
    gyro, accel = np.full((200, 3), rate), np.full((200, 3), 5.0)
    if at_once:
        aligner.add_imu(stamps, gyro, accel)
        aligner.update()
    else:
        for sample in zip(stamps.tolist(), gyro, accel):
            aligner.add_imu(*sample)
            aligner.update()
    status = aligner.status()
    assert status.state is State.WAITING_FOR_IMU
    assert status.reason == f'no IMU sample of use yet: {words}'


def test_a_loop_inside_one_array_is_the_same_as_one_by_one(flight):
    """The stamps that come again were there before, in the same array."""
    stamps, gyro, accel = (np.concatenate([column[:300]] * 3) for column in (
        flight.imu_stamps_ns, flight.gyro, flight.accel))
    counts = []
    for many in (True, False):
        aligner = Aligner(config_for(flight))
        if many:
            aligner.add_imu(stamps, gyro, accel)
        else:
            for sample in zip(stamps.tolist(), gyro, accel):
                aligner.add_imu(*sample)
        aligner.flush()
        counts.append(aligner.status().counts)
    assert counts[0] == counts[1] and counts[0]['clock_jumps'] == 2


def test_arrays_of_samples_may_be_filled_again(flight):
    aligner = Aligner(config_for(flight))
    columns = flight.imu_stamps_ns, flight.gyro, flight.accel
    arrays = [column[:10].copy() for column in columns]
    for start in range(0, 200, 10):
        for array, column in zip(arrays, columns):
            array[:] = column[start:start + 10]
        aligner.add_imu(*arrays)
    aligner.update()
    imu = aligner._imu
    assert np.array_equal(imu.stamps, flight.imu_stamps_ns[200 - imu.stamps.size:200])
    assert np.array_equal(imu.samples, np.hstack(columns[1:])[200 - imu.stamps.size:200])


def test_epochs_outlive_a_clock_set_back_and_nothing_else(flight):
    """The same messages once more, the same attitude: they are no prior to themselves."""
    aligner = Aligner(config_for(flight))
    epochs = feed(aligner, flight)
    late = np.array([0, 10, 20]) * 1_000_000 + flight.imu_stamps_ns[0]
    aligner.add_imu(late, flight.gyro[:3], flight.accel[:3])
    assert aligner.flush() == [] and aligner.status().counts['clock_jumps'] == 1
    assert aligner.status().counts['epochs_used'] == len(epochs)
    again = feed(aligner, flight)
    assert again[0].t_s == 0.0 and len(again) >= len(epochs) - 1
    for epoch, other in zip(epochs[::-20], again[::-20]):
        assert np.allclose(epoch.current.covariance, other.current.covariance, rtol=1e-6)
    # All at once: what was worked out before the jump is returned though nothing follows.
    assert len(give_all(Aligner(config_for(flight)), replace(
        flight, imu_stamps_ns=np.concatenate([flight.imu_stamps_ns, late]),
        gyro=np.concatenate([flight.gyro, flight.gyro[:3]]),
        accel=np.concatenate([flight.accel, flight.accel[:3]])))) > 100


def test_a_recording_that_is_played_again_gives_the_same_again(flight):
    aligner = Aligner(config_for(flight))
    rounds = [], []
    for epochs in rounds:
        for kind, payload in flight.messages():
            give(aligner, kind, payload)
        epochs += aligner.update()
    first = rounds[0][-1]
    again = [epoch for epoch in rounds[1] if epoch.stamp_ns == first.stamp_ns][-1]
    assert aligner.counts['clock_jumps'] == 1 and aligner.counts['imu_late'] == 0
    assert any('clock' in event.text for event in aligner.take_events())
    assert np.array_equal(again.current.quaternion_xyzw, first.current.quaternion_xyzw)
    assert np.array_equal(again.current.covariance, first.current.covariance)


def test_samples_that_are_late_within_the_allowed_time_change_nothing(flight):
    """Neither do the calls between them: nothing is used that they may still come before."""
    stamps = flight.imu_stamps_ns[:4000]
    late = np.random.default_rng(1).random(stamps.size) < 0.05
    arrival = stamps + np.where(late, SECOND // 10 - 1, 0)
    last = []
    for share in (1.0, 0.1):
        aligner = Aligner(config_for(flight, gnss_lateness=0.1))
        calls = np.random.default_rng(2).random(stamps.size) < share
        for k in range(len(flight.gnss_stamps_ns)):
            aligner.add_fix(flight.fix(k))
            aligner.add_velocity(flight.velocity_measurement(k))
        epochs = []
        for i, called in zip(np.argsort(arrival, kind='stable'), calls):
            aligner.add_imu(int(stamps[i]), flight.gyro[i], flight.accel[i])
            if called:
                epochs += aligner.update()
        last.append(epochs + aligner.flush())
        assert aligner.counts['imu_late'] == 0
    check_same(*last)


def test_an_epoch_before_the_first_sample_of_the_imu_is_no_start(flight):
    aligner = Aligner(config_for(flight))
    epochs = give_all(aligner, flight, slice(500, None))
    first = flight.imu_stamps_ns[500]
    expected = flight.gnss_stamps_ns[flight.gnss_stamps_ns >= first]
    assert [epoch.stamp_ns for epoch in epochs] == expected.tolist()
    counts = aligner.status().counts
    assert counts['epochs_before_start'] == len(flight.gnss_stamps_ns) - len(expected) > 0


@pytest.mark.parametrize('bunch, apart_ns', ((2, 1_000_000), (5, 60_000), (3, 1)))
def test_samples_that_are_stamped_in_bunches(bunch, apart_ns):
    """A driver reads several at a time and stamps them as they come out of its buffer."""
    s = simulated('car', imu_grade='mems', duration=30.0, seed=10)
    k = np.arange(len(s.imu_stamps_ns))
    last = np.minimum(k // bunch * bunch + bunch - 1, len(k) - 1)
    spoilt = replace(s, imu_stamps_ns=s.imu_stamps_ns[last] + (k % bunch) * apart_ns)
    aligner = Aligner(Config(lever_arm=tuple(s.lever_arm)))
    epochs = feed(aligner, spoilt)
    assert epochs[-1].state is State.ALIGNED and aligner.status().counts['imu_gap'] == 0
    assert normalised_error(epochs[-1].current, s) < chi2.ppf(0.9999, 3)


def test_silent_imu_starts_over_and_keeps_the_biases(flight):
    aligner = Aligner(config_for(flight))
    feed_part(aligner, flight, 0.0, 15.0)
    before = aligner.status()
    feed_part(aligner, flight, 18.5)
    status = aligner.status()
    assert status.counts['restarts'] == 1 and status.counts['imu_gap'] >= 1
    assert status.t0_ns > before.t0_ns + 18 * SECOND
    assert normalised_error(status.current, flight) < chi2.ppf(0.9999, 3)
    assert np.all(status.gyro_bias_std <= 1.2 * before.gyro_bias_std)


def test_biases_outlive_a_second_loss_before_the_next_start(flight):
    """The IMU is silent, then the position jumps while velocities are waited for."""
    aligner = Aligner(config_for(flight, use_velocity=True))
    feed_part(aligner, flight, 0.0, 15.0)
    before = aligner.status()
    origin = int(flight.imu_stamps_ns[0])
    for kind, payload in flight.messages():
        stamp = int(payload[0][-1]) if kind == 'imu' else payload.stamp_ns
        seconds = (stamp - origin) * 1e-9
        if seconds < 18.5:
            continue
        if kind == 'fix' and seconds > 20.0:
            payload = payload._replace(latitude_deg=payload.latitude_deg + 1.0)
        if kind != 'velocity' or seconds > 23.0:
            give(aligner, kind, payload)
    aligner.update()
    status = aligner.status()
    assert status.counts['fix_jump'] >= 5 and status.counts['restarts'] == 1
    assert status.t0_ns > origin + 23 * SECOND
    assert np.all(status.gyro_bias_std <= 1.2 * before.gyro_bias_std)


def test_biases_outlive_two_gaps_of_the_imu(flight):
    """The second one comes before enough epochs for a start."""
    aligner = Aligner(config_for(flight))
    feed_part(aligner, flight, 0.0, 15.0)
    before = aligner.status()
    feed_part(aligner, flight, 15.7, 16.3)
    feed_part(aligner, flight, 17.0)
    status = aligner.status()
    assert status.counts['restarts'] == 2
    assert np.all(status.gyro_bias_std <= 1.2 * before.gyro_bias_std)


@pytest.mark.parametrize('share', (0.02, 1.0))
def test_when_somebody_looks_does_not_matter_to_samples_without_numbers(flight, share):
    gyro = flight.gyro.copy()
    seconds = (flight.imu_stamps_ns - flight.imu_stamps_ns[0]) * 1e-9
    gyro[(seconds >= 15.025) & (seconds < 17.5)] = np.nan
    random, results = np.random.default_rng(1), []
    for often in (0.0, share):
        aligner, place = Aligner(config_for(flight)), 0
        for k, stamp in enumerate(flight.gnss_stamps_ns.tolist()):
            until = np.searchsorted(flight.imu_stamps_ns, stamp)
            for block in np.array_split(np.arange(place, until), 4):
                aligner.add_imu(flight.imu_stamps_ns[block], gyro[block], flight.accel[block])
                if random.random() < often:
                    aligner.update()
            place = until
            aligner.add_fix(flight.fix(k))
            aligner.add_velocity(flight.velocity_measurement(k))
        aligner.flush()
        results.append(aligner.status())
    assert results[0].counts == results[1].counts and results[0].counts['restarts'] == 1
    check_same_attitude(results[0].current, results[1].current)


def test_the_end_of_a_range_is_found_at_negative_stamps_too():
    s = simulated('launch', imu_rate=200.0, duration=30.0, seed=1)
    end = 0.65 * np.abs(s.gyro).max()
    clipped = np.clip(s.gyro, -end, end)
    counts = []
    for shift in (0, int(s.imu_stamps_ns[0]) + 300 * SECOND):
        other = replace(s, gyro=clipped, imu_stamps_ns=s.imu_stamps_ns - shift,
                        gnss_stamps_ns=s.gnss_stamps_ns - shift)
        aligner = Aligner(config_for(s))
        give_all(aligner, other)
        counts.append(aligner.status().counts)
    assert counts[0] == counts[1] and counts[0]['imu_saturated'] > 5


@pytest.mark.parametrize('seed', (1, pytest.param(2, marks=pytest.mark.campaign)))
def test_biases_that_were_learnt_before_a_long_silence_are_doubted(seed):
    first = simulated('flight', imu_grade='mems', duration=60.0, seed=seed)
    silence_ns = 3 * 3600 * SECOND
    walked = PRESETS['mems'].rate_random_walk * math.sqrt(silence_ns * 1e-9)
    later = replace(first, imu_stamps_ns=first.imu_stamps_ns + silence_ns,
                    gnss_stamps_ns=first.gnss_stamps_ns + silence_ns,
                    gnss_arrival_ns=first.gnss_arrival_ns + silence_ns,
                    gyro=first.gyro + walked * np.random.default_rng(seed).standard_normal(3))
    aligner = Aligner(config_for(first, rate_random_walk=0.0, imu_grade='mems'))
    feed(aligner, first)
    epochs = feed_part(aligner, later)
    assert aligner.status().counts['restarts'] == 1
    assert epochs[-1].state is State.ALIGNED
    for epoch in epochs:
        if epoch.state is State.ALIGNED:
            attitude = replace(epoch.current, stamp_ns=epoch.stamp_ns - silence_ns)
            assert normalised_error(attitude, first) < chi2.ppf(0.9999, 3)


def test_samples_without_numbers_are_no_samples(flight):
    gyro = flight.gyro.copy()
    gyro[1800:2600, 1] = np.nan
    spoilt = replace(flight, gyro=gyro)
    aligner = Aligner(config_for(flight))
    feed_part(aligner, spoilt, 0.0, 20.5)           # 2.5 s of them
    assert aligner.declared is None and aligner.attitude_now() is None
    assert aligner.status().state is State.WAITING_FOR_IMU
    feed_part(aligner, spoilt, 20.5)
    counts = aligner.status().counts
    assert counts['restarts'] == counts['imu_gap'] == 1 and counts['imu_nan'] == 800
    assert normalised_error(aligner.status().current, flight) < chi2.ppf(0.9999, 3)


def test_no_attitude_is_carried_over_a_gap_of_the_imu(flight):
    aligner = Aligner(config_for(flight))
    feed_part(aligner, flight, 0.0, 20.0)
    assert aligner.attitude_now() is not None
    feed_part(aligner, flight, 20.6, 20.7)
    assert aligner.attitude_now() is None


def test_a_single_imu_stamp_far_ahead_loses_nothing(flight, result):
    stamps = flight.imu_stamps_ns.copy()
    stamps[1500] += 5 * SECOND
    aligner = Aligner(config_for(flight))
    give_all(aligner, replace(flight, imu_stamps_ns=stamps))
    status = aligner.status()
    assert status.counts['imu_ahead'] == 1 and status.counts.get('clock_jumps', 0) == 0
    assert status.t0_ns == result[0].status().t0_ns
    assert np.allclose(status.current.C_nb, result[0].status().current.C_nb, atol=1e-4)


def test_short_gaps_of_the_imu_are_survived_and_doubted(flight):
    keep = np.ones(len(flight.imu_stamps_ns), bool)
    for start in range(300, 2900, 500):
        keep[start:start + 20] = False             # 0.2 s without samples
    whole, gappy = (Aligner(config_for(flight)) for _ in range(2))
    for aligner, used in ((whole, np.ones_like(keep)), (gappy, keep)):
        give_all(aligner, flight, used)
    status = gappy.status()
    assert status.counts['imu_gap'] >= 5 and status.counts.get('restarts', 0) == 0
    assert normalised_error(status.current, flight) < chi2.ppf(0.9999, 3)
    assert np.all(status.current.sigma_deg > whole.status().current.sigma_deg)


def test_stamps_that_jitter_are_doubted_as_much_as_the_motion_makes_of_it():
    """A driver stamps samples when it gets round to it; a throw shows it, a good IMU most."""
    squares = 0.0
    for seed in range(6):
        s = simulated('launch', imu_grade='navigation', seed=seed, duration=30.0)
        step = np.median(np.diff(s.imu_stamps_ns))
        jitter = 0.45 * step * np.random.default_rng(seed).uniform(-1, 1, len(s.imu_stamps_ns))
        jittered = replace(s, imu_stamps_ns=s.imu_stamps_ns + np.rint(jitter).astype(np.int64))
        aligner = Aligner(config_for(s, lever_arm_std=1.0, gnss_delay_std=0.1))
        give_all(aligner, jittered)
        squares += normalised_error(aligner.status().initial, s)
    assert squares < chi2.ppf(0.9999, 3 * 6)


@pytest.mark.parametrize('seed', (1, pytest.param(2, marks=pytest.mark.campaign)))
def test_gyros_that_warm_up_are_doubted(seed):
    cold = simulated('car', imu_grade='mems', seed=seed, duration=100.0)
    seconds = (cold.imu_stamps_ns - cold.imu_stamps_ns[0]) * 1e-9
    drift = np.radians(0.5) * (1.0 - np.exp(-seconds / 60.0))
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], 3)
    warming = replace(cold, gyro=cold.gyro + drift[:, None] * signs)
    for s in (cold, warming):
        aligner, epochs = aligned(s, imu_grade='mems', rate_random_walk=0.15, lever_arm_std=1.0,
                                  gnss_delay_std=0.1)
        late = [epoch.current for epoch in epochs if epoch.t_s > 70.0]
        assert epochs[-1].state is State.ALIGNED
        assert np.mean([normalised_error(attitude, s) for attitude in late]) < chi2.ppf(
            0.9999, 3)
        if s is cold:
            assert 'as fast as stated' not in aligner.status().reason


def test_single_samples_that_no_motion_makes_are_counted_and_do_little(flight, result):
    random = np.random.default_rng(7)
    places = np.arange(150, 2950, 100) + random.integers(0, 50, 28)
    gyro, accel = flight.gyro.copy(), flight.accel.copy()
    gyro[places] += 5.0 * random.choice([-1.0, 1.0], (28, 3))
    accel[places[::2]] += 200.0
    aligner = Aligner(config_for(flight))
    epochs = give_all(aligner, replace(flight, gyro=gyro, accel=accel))
    assert aligner.status().counts['imu_spike'] == len(places)
    clean = result[1]
    assert epochs[-1].state is State.ALIGNED
    assert normalised_error(epochs[-1].current, flight) < chi2.ppf(0.9999, 3)
    assert np.allclose(epochs[-1].current.sigma_deg, clean[-1].current.sigma_deg, rtol=0.2)


def test_attitude_now_steps_over_a_spike(flight):
    spoilt = Aligner(config_for(flight))
    gyro = flight.gyro.copy()
    gyro[-20] += 100.0
    give_all(spoilt, replace(flight, gyro=gyro))
    assert error_deg(spoilt.attitude_now(), flight) < 1.0


def stick(flight, start, end):
    """Let the IMU send the same values from one second to another."""
    gyro, accel = flight.gyro.copy(), flight.accel.copy()
    time = (flight.imu_stamps_ns - flight.imu_stamps_ns[0]) * 1e-9
    same = np.flatnonzero((time >= start) & (time < end))
    gyro[same], accel[same] = gyro[same[0]], accel[same[0]]
    return replace(flight, gyro=gyro, accel=accel)


def test_imu_that_sends_the_same_again_and_again_is_not_believed(flight):
    s = stick(flight, 22.0, 24.0)
    aligner = Aligner(config_for(s))
    epochs = feed_part(aligner, s) + aligner.flush()
    states = {}
    for epoch in epochs:
        states.setdefault(int((epoch.stamp_ns - s.imu_stamps_ns[0]) // (SECOND // 2)),
                          set()).add(epoch.state)
    assert states[43] == {State.ALIGNED}
    assert not {45, 46, 47} & set(states)                       # no result while it is stuck
    assert states[48] == {State.ALIGNING}
    assert normalised_error(epochs[-1].current, flight) < chi2.ppf(0.9999, 3)
    counts = aligner.status().counts
    assert counts['imu_stuck'] == counts['restarts'] == 1


def test_no_attitude_is_carried_over_values_that_repeat(flight):
    """For 0.3 s in a turn; no epoch has been processed since."""
    aligner = Aligner(config_for(flight))
    s = stick(flight, 12.0, 12.3)
    feed_part(aligner, s, 0.0, 11.9)
    assert aligner.attitude_now() is not None
    feed_part(aligner, s, 11.9, 12.6)
    status = aligner.status()
    assert status.current.stamp_ns < flight.imu_stamps_ns[0] + 12 * SECOND
    assert aligner.attitude_now() is None


def test_while_the_imu_is_stuck_that_is_the_reason(flight):
    aligner = Aligner(config_for(flight))
    feed_part(aligner, stick(flight, 12.0, 20.0), 0.0, 18.0)
    status = aligner.status()
    assert status.state is State.WAITING_FOR_IMU and 'same values' in status.reason
    assert aligner.declared is None and aligner.attitude_now() is None


@pytest.mark.parametrize('lateness', (
    0.0, *(pytest.param(lateness, marks=pytest.mark.campaign) for lateness in (0.1, 1.0))))
def test_when_somebody_looks_does_not_matter_to_a_stuck_spiky_or_small_imu(flight, lateness):
    s = stick(flight, 10.0, 10.8)
    s.gyro[2000:2080, 1] = 1.5
    random = np.random.default_rng(2)
    s.gyro[np.r_[100:900:80, 1200:2900:150]] += 3.0
    told = []
    for share in (1.0, 0.3, 0.01):
        aligner, epochs = Aligner(config_for(s, gnss_lateness=lateness)), []
        for k, stamp in enumerate(s.imu_stamps_ns.tolist()):
            aligner.add_imu(stamp, s.gyro[k], s.accel[k])
            if random.random() < share:
                epochs += aligner.update()
            for j in np.flatnonzero((s.gnss_stamps_ns > stamp) & (
                    s.gnss_stamps_ns <= stamp + 10_000_000)):
                aligner.add_fix(s.fix(j))
                aligner.add_velocity(s.velocity_measurement(j))
        epochs += aligner.flush()
        told.append(epochs)
        assert aligner.status().counts['imu_spike'] == 22
        assert aligner.status().counts['imu_stuck'] == 1
        assert aligner.status().counts['imu_saturated'] == 76
        assert aligner.status().counts['imu_blind'] == 1
    assert len(told[0]) > 100
    check_same(told[0], told[1])
    check_same(told[0], told[2])


@pytest.mark.parametrize('scenario, share', [
    ('launch', 0.65), pytest.param('whirl', 0.8, marks=pytest.mark.campaign),
    pytest.param('whirl', 0.4, marks=(
        pytest.mark.campaign, pytest.mark.xfail(strict=True, reason='it is never declared')))])
def test_gyros_with_too_small_a_range_do_not_lead_astray(scenario, share, monkeypatch):
    monkeypatch.setitem(SCENARIOS, 'whirl', Scenario(whirling, 60.0, 2.0))
    aligned = 0
    for seed in range(2):
        s = simulated(scenario, imu_grade='mems', imu_rate=200.0, seed=seed)
        end = share * np.abs(s.gyro).max()
        s = replace(s, gyro=np.clip(s.gyro, -end, end))
        aligner = Aligner(Config(lever_arm=tuple(s.lever_arm)))
        epochs = [epoch for epoch in feed(aligner, s) if epoch.state is State.ALIGNED]
        aligned += len(epochs)
        # 20 to 30 sigma in each where nothing is known of ranges.
        assert max((normalised_error(epoch.current, s) for epoch in epochs),
                   default=0.0) < chi2.ppf(1 - 1e-6, 3)
        assert aligner.status().counts['imu_saturated'] > 50
    assert aligned > 0


def whirling(time, duration):
    """Drive in circles and spin around within 2 s now and then."""
    course = 0.3 * time
    speed = 8.0 + 2.0 * np.sin(0.3 * time)
    spin = sum(7.5 / (1 + np.exp(-(time - start) / 0.3)) for start in (20.0, 40.0))
    velocity = np.stack([speed * np.cos(course), speed * np.sin(course), 0.0 * time], axis=-1)
    swing = 0.1 * np.sin(1.9 * time)
    return Motion(velocity, np.stack([swing, 0.8 * swing, course + spin], axis=-1))


def test_accelerations_in_g_are_a_fault():
    s = turning_car(1)
    aligner = Aligner(config_for(s))
    states = [epoch.state for epoch in give_all(aligner, s, force_scale=1 / 9.80665)]
    assert states[-1] is State.FAULT and State.ALIGNED not in states
    severity, words = aligner.take_events()[-1]
    assert severity is Severity.ERROR and words.startswith('FAULT: ')
    assert 'm/s^2' in aligner.status().reason
    assert aligner.declared is None
