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

from ins_align.gnss.antenna import VelocityCheck
from ins_align.imu.noise import (
    BEYOND_END, BLIND_ANGLE, END_TIMES, FORCE_TIME, ForceCheck, RangeCheck, stuck, without_spikes)
import numpy as np
import pytest

RADIUS = 6.37e6


@pytest.mark.parametrize('mean, wrong', [(9.81, False), (1.0, True), (9810.0, True),
                                         (20.0, False), (35.0, False), (0.0, True)])
def test_force_in_another_unit_is_found(mean, wrong):
    check = ForceCheck()
    check.add(mean, FORCE_TIME)
    assert bool(check.fault) == wrong
    if wrong:
        assert 'm/s^2' in check.fault and any(c.isdigit() for c in check.fault)


def test_force_check_waits_forgives_and_forgets_what_was_right_before():
    check = ForceCheck()
    for mean, seconds, wrong in ((1.0, 0.9 * FORCE_TIME, False), (1.0, 0.2 * FORCE_TIME, True),
                                 (9.8, FORCE_TIME, False), (1.0, FORCE_TIME, True)):
        check.add(mean, seconds)
        assert bool(check.fault) == wrong
    assert 'averages 1 m/s^2' in check.fault


def drive(check, sent, *, speed=10.0, turn=0.1, seconds=60.0, rate=5.0, noise=0.5, wild=0.0):
    """
    Drive circles; `sent` makes what the receiver says of the true velocity.

    A share `wild` of the fixes is off by 30 to 100 m.
    """
    random = np.random.default_rng(1)
    latitude, longitude = 0.8, 0.2
    for k in range(int(seconds * rate)):
        t = k / rate
        v = speed * np.array([np.cos(turn * t), np.sin(turn * t), 0.0])
        error = noise * random.standard_normal(2)
        if wild and random.random() < wild:
            way = random.uniform(0, 2 * np.pi)
            error += random.uniform(30.0, 100.0) * np.array([np.cos(way), np.sin(way)])
        place = (latitude + error[1] / RADIUS,
                 longitude + error[0] / (RADIUS * np.cos(latitude)), 100.0)
        check.add(t, place, sent(v), noise)
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
    # Not a full circle: near its end a velocity that always points to the east is right.
    fault = drive(VelocityCheck(), sent, seconds=50.0).fault
    assert fault and 'world frame' in fault


def test_fixes_that_stay_where_they_are_contradict_a_velocity():
    check = VelocityCheck()
    for k in range(200):
        check.add(0.2 * k, (0.8, 0.2, 0.0), np.array([10.0, 5.0, 0.0]), 0.5)
    assert 'contradicts' in check.fault


def test_straight_drive_to_the_north_east_tells_nothing():
    check = VelocityCheck()
    for k in range(200):
        check.add(0.2 * k, (0.8 + 1.4 * k / RADIUS, 0.2 + 1.4 * k / (RADIUS * np.cos(0.8)), 0.0),
                  np.array([7.0, 7.0, 0.0]), 0.5)
    assert not check.fault


def test_the_wrong_frame_stays_found_on_the_way_to_the_north_east():
    """There both frames say the same: no evidence for either."""
    check = drive(VelocityCheck(), lambda v: v[[1, 0, 2]] * [1.0, 1.0, -1.0], seconds=60.0)
    assert 'exchanged' in check.fault
    place = np.array([0.9, 0.3])
    for k in range(300):
        check.add(100.0 + 0.2 * k, (*place, 0.0), np.array([7.0, 7.0, 0.0]), 0.5)
        place += 1.4 / RADIUS * np.array([1.0, 1.0 / np.cos(place[0])])
    assert 'exchanged' in check.fault


def test_gaps_are_not_bridged():
    check = VelocityCheck()
    for k in range(100):
        # One epoch in three seconds: what happened between is not known.
        check.add(3.0 * k, (0.8 + 1e-5 * k, 0.2, 0.0), np.array([10.0, 0.0, 0.0]), 0.5)
    assert not check.fault


def test_standing_still_is_nothing_to_compare():
    random = np.random.default_rng(4)
    check = VelocityCheck()
    for k in range(1000):
        latitude, longitude = [0.8, 0.2] + 2.5 / RADIUS * random.standard_normal(2)
        check.add(0.2 * k, (latitude, longitude, 0.0), 0.1 * random.standard_normal(3), 2.5)
    assert not check.fault


@pytest.mark.parametrize('speed', (0.0, 10.0))
@pytest.mark.parametrize('share', (0.1, 0.3))
def test_wild_fixes_do_not_convict_the_velocity(speed, share):
    """Nor do they hide that it is wrong."""
    for sent, wrong in ((lambda v: v, False), (lambda v: v[[1, 0, 2]], speed > 0)):
        assert bool(drive(VelocityCheck(), sent, speed=speed, wild=share,
                          seconds=600.0).fault) == wrong


def test_across_the_antimeridian():
    check = VelocityCheck()
    latitude = np.radians(-18.0)
    for k in range(300):
        longitude = np.pi - 1e-4 + 10.0 * 0.2 * k / (6378137.0 * np.cos(latitude))
        longitude = (longitude + np.pi) % (2 * np.pi) - np.pi
        check.add(0.2 * k, (latitude, longitude, 0.0), np.array([10.0, 0.0, 0.0]), 0.1)
    assert not check.fault


# Samples of the IMU

MS = 1_000_000


def shaken(count=400, seed=0):
    """Turn and shake; return stamps at 100 Hz, samples, and the random numbers."""
    random = np.random.default_rng(seed)
    t = 0.01 * np.arange(count)
    motion = np.stack([np.sin(3 * t), np.cos(2 * t), 0.5 * t, 2 * np.sin(5 * t), t, 9.8 + 0 * t],
                      axis=1)
    noise = np.repeat([0.05, 0.5], 3) * random.standard_normal((count, 6))
    return 10 * MS * np.arange(count), motion + noise, random


@pytest.mark.parametrize('sensor, size', [(0, 3.0), (0, 150.0), (1, 30.0), (1, 1500.0)])
def test_single_samples_that_no_motion_makes_are_replaced(sensor, size):
    stamps, true, random = shaken()
    places = np.array([30, 34, 100, 111, 250, 390])
    spoilt = true.copy()
    axes = slice(3 * sensor, 3 * sensor + 3)
    direction = random.standard_normal((places.size, 3))
    spoilt[places, axes] += size * direction / np.linalg.norm(direction, axis=1)[:, None]
    sent = spoilt.copy()
    samples, spikes = without_spikes(stamps, spoilt)
    assert np.flatnonzero(spikes).tolist() == places.tolist()
    assert np.array_equal(spoilt, sent)
    assert np.array_equal(samples[~spikes], true[~spikes])
    assert np.max(np.abs(samples - true)) < 3.0
    assert np.array_equal(np.delete(samples, np.r_[axes], axis=1),
                          np.delete(true, np.r_[axes], axis=1))


def test_a_spike_is_replaced_by_what_lies_at_its_stamp():
    stamps, samples, _ = shaken()
    samples[:] = 1e-6 * (stamps / MS)[:, None]
    stamps[200] += 4 * MS
    samples[200, 0] = 50.0
    cleaned, _ = without_spikes(stamps, samples)
    assert cleaned[200, 0] == pytest.approx(1e-6 * 2004)


def test_shaking_steps_and_shocks_that_ring_are_left_alone():
    stamps, samples, random = shaken()
    samples *= 20.0
    assert without_spikes(stamps, samples)[0] is samples
    stamps, samples, random = shaken()
    samples[200:, 2] += 3.0                                     # a turn begins at once
    ringing = 80.0 * np.cos(2.5 * np.arange(40)) * np.exp(-0.1 * np.arange(40))
    samples[300:340, 5] += ringing
    samples[300:340, 0] += 0.1 * ringing
    assert not np.any(without_spikes(stamps, samples)[1])


def test_what_cannot_be_judged_is_left_alone():
    for count in (0, 1, 2, 14):
        stamps, samples, _ = shaken(count)
        samples[-1:] += 100.0
        cleaned, spikes = without_spikes(stamps, samples)
        assert cleaned is samples and spikes.shape == (count,) and not spikes.any()


@pytest.mark.parametrize('first', [100, 113, 126, 137])
def test_a_spike_is_judged_the_same_wherever_the_array_begins(first):
    stamps, samples, _ = shaken()
    samples[[143, 150, 152, 160], 1] += [2.0, -40.0, 60.0, 0.7]
    whole, part = (without_spikes(stamps[k:], samples[k:])[1] for k in (0, first))
    judged = max(first + 13, 0)
    assert np.array_equal(whole[judged:], part[judged - first:]) and whole.any()


def test_an_imu_that_sends_the_same_again_and_again_is_stuck():
    stamps, samples, _ = shaken()
    samples[100:180] = samples[100]
    samples[390:] = samples[390]                                # not for long yet
    (first, last, known), = stuck(stamps, samples)
    assert (first, last, known) == (1000 * MS, 1790 * MS, 1250 * MS)
    assert stuck(stamps[:126], samples[:126]) == [(1000 * MS, 1250 * MS, 1250 * MS)]
    assert stuck(stamps[:125], samples[:125]) == []


def test_a_slow_imu_is_stuck_after_so_many_samples():
    _, samples, _ = shaken(60)
    samples[20:40] = samples[20]
    (first, last, known), = stuck(100 * MS * np.arange(60), samples)
    assert (first, last, known) == (2000 * MS, 3900 * MS, 2800 * MS)


def test_an_imu_at_rest_that_repeats_some_values_is_not_stuck():
    random = np.random.default_rng(3)
    noise = 0.4 * random.standard_normal((20_000, 6))           # of the least step
    samples = np.rint(noise) * np.repeat([1e-3, 0.02], 3)
    same = np.all(samples[1:] == samples[:-1], axis=1)
    assert np.mean(same) > 0.05
    assert stuck(10 * MS * np.arange(20_000), samples) == []
    _, samples, _ = shaken()
    assert stuck(2 * MS * np.arange(1600), np.repeat(samples, 4, axis=0)) == []


STEP_NS = 5_000_000


def swinging(count=2000, noise=0.01):
    """Rates up to 4 rad/s about z and forces up to 30 m/s^2 along x, with noise."""
    stamps = STEP_NS * np.arange(1, count + 1)
    samples = noise * np.random.default_rng(3).standard_normal((count, 6))
    samples[:, 2] += 4.0 * np.sin(2e-9 * np.pi * stamps)
    samples[:, 3] += 30.0 * np.sin(3e-9 * np.pi * stamps)
    samples[:, 5] += 9.8
    return stamps, samples


def checked(stamps, samples, block=None):
    check = RangeCheck()
    for k in range(0, stamps.size, block or stamps.size):
        part = slice(k, k + (block or stamps.size))
        check.add(stamps[part], samples[part])
    return check


@pytest.mark.parametrize('axis, end', [(2, 3.0), (3, 20.0)])
@pytest.mark.parametrize('block', (1, 7, None))
def test_end_of_a_range_is_found(axis, end, block):
    stamps, samples = swinging()
    clipped = samples.copy()
    clipped[:, axis] = np.clip(samples[:, axis], -end, 0.9 * end)
    there = np.flatnonzero(clipped[:, axis] != samples[:, axis])
    check = checked(stamps, clipped, block)
    # The first ones of either end might be chance.
    assert np.isin(check.stamps, stamps[there]).all()
    assert check.stamps.size == there.size - 2 * (END_TIMES - 1)
    sensor = axis // 3
    assert np.all(check.densities[:, sensor] > 0) and np.all(check.densities[:, 1 - sensor] == 0)
    # One run from its first sample on: the error that grows with its time.
    last = np.flatnonzero(np.diff(check.stamps) > STEP_NS)
    run = slice(last[-2] + 1, last[-1] + 1)
    seconds = STEP_NS * 1e-9 * (run.stop - run.start)
    size = np.abs(clipped[stamps == check.stamps[run.start], axis])[0]
    assert np.sum(check.densities[run, sensor] ** 2) * STEP_NS * 1e-9 == pytest.approx(
        (BEYOND_END * size * seconds) ** 2, rel=0.1)
    assert bool(check.blind) == (sensor == 0)
    if sensor == 0:
        per_run = BEYOND_END * size * seconds // BLIND_ANGLE
        assert per_run == np.count_nonzero((np.array(check.blind) >= check.stamps[run][0])
                                           & (np.array(check.blind) <= check.stamps[run][-1]))


@pytest.mark.parametrize('block', (1, 7, None))
@pytest.mark.parametrize('rate', (25, 100))
def test_each_excursion_beyond_the_range_may_hide_an_angle(rate, block):
    """Single samples at 25 Hz, that miss an angle each, as several in a row do at 100 Hz."""
    length = rate // 25
    stamps = np.arange(16 * rate) * (1_000_000_000 // rate)
    samples = 0.3 * np.random.default_rng(0).standard_normal((stamps.size, 6))
    samples[:, 5] += 9.8
    at_end = np.arange(stamps.size) % rate >= rate - length
    samples[at_end, 0] = 35.0
    check = checked(stamps, samples, block)
    excursions = np.unique(check.stamps * rate // 1_000_000_000 // rate)
    assert excursions.size >= 12
    assert np.isin(excursions, np.array(check.blind) * rate // 1_000_000_000 // rate).all()


@pytest.mark.parametrize('block', (1, 7, None))
def test_what_is_not_the_end_of_a_range(block):
    stamps, samples = swinging()
    resting = np.round(samples / 0.01) * 0.01
    resting[:, 2:4] = 0.0
    steady = swinging(noise=1e-4)[1]
    steady[:, 2:4] = 2.0, 0.0
    for values in (samples, resting,
                   np.round(samples / 1e-3) * 1e-3,               # steps of a converter
                   np.repeat(samples[::4], 4, axis=0),            # sent more often than measured
                   np.repeat(samples[::8], 8, axis=0),
                   np.round(steady / 0.1) * 0.1,                  # coarse, and calm
                   np.round(samples / [[0.01] * 3 + [0.05] * 3]) * [[0.01] * 3 + [0.05] * 3]):
        assert checked(stamps, values, block).stamps.size == 0


def test_range_check_forgets():
    stamps, samples = swinging()
    samples[:, 2] = np.clip(2.0 * samples[:, 2], -3.0, 3.0)
    check = checked(stamps, samples)
    middle = int(stamps[1000])
    check.forget_before(middle)
    assert check.stamps.size == len(check.densities) > 0 and check.blind
    assert check.stamps.min() >= middle and min(check.blind) >= middle
