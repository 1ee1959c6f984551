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
"""What a receiver says of itself, and what of that is believed."""

from collections import Counter
import math

from ins_align.config import Config
from ins_align.gnss.antenna import Antenna, StatedNoise
from ins_align.gnss.buffer import GnssEpoch
from ins_align.gnss.messages import Fix, usable, Velocity
import numpy as np
import pytest

CORRELATED = np.array([[0.01, 0.004, 0.0], [0.004, 0.02, -0.003], [0.0, -0.003, 0.03]])
SECOND = 1_000_000_000
RADIUS = 6378137.0


def told(stamp_ns, north=None, velocity=None):
    """Return what the receiver says; metres north of 48 degrees."""
    fix = None if north is None else Fix(stamp_ns, 48.0 + math.degrees(north / RADIUS), 11.0, 0.0,
                                         None, 0)
    return GnssEpoch(stamp_ns, fix, None if velocity is None else Velocity(
        stamp_ns, np.array(velocity), CORRELATED))


def stated_noise(std, std_vertical):
    return StatedNoise(std, std_vertical, 1e3, Counter(), 'covariance')


def north_of(epoch):
    return RADIUS * (epoch.latitude - math.radians(48.0))


def test_what_is_stated_again_and_again_is_believed():
    noise = stated_noise(0.3, 0.6)
    for _ in range(20):
        assert noise.covariance(CORRELATED) is CORRELATED


def test_a_receiver_that_states_nothing_has_what_is_configured():
    assert np.array_equal(stated_noise(0.3, 0.6).covariance(None), np.diag([0.09, 0.09, 0.36]))


@pytest.mark.parametrize('axis', range(3))
def test_one_that_is_far_better_for_an_epoch_is_not_believed(axis):
    noise = stated_noise(0.3, 0.6)
    better = np.eye(3)
    better[axis, axis] = 1e-3
    better = better @ CORRELATED @ better
    for k in range(40):
        if k % 3 == 1:
            assert np.allclose(noise.covariance(better), CORRELATED)
        else:
            assert noise.covariance(CORRELATED) is CORRELATED


def test_the_very_first_epoch_is_believed_if_a_good_receiver_can_mean_it():
    noise, rtk = stated_noise(2.5, 5.0), np.diag([1e-4, 1e-4, 4e-4])
    assert all(noise.covariance(rtk) is rtk for _ in range(20))
    assert np.array_equal(stated_noise(0.3, 0.6).covariance(1e-8 * np.eye(3)),
                          np.diag([0.09, 0.09, 0.36]))


def test_a_receiver_that_has_become_better_is_believed_after_a_while():
    noise = stated_noise(2.5, 5.0)
    rtk = 1e-4 * np.eye(3)
    for _ in range(100):
        noise.covariance(np.eye(3))
    believed = [noise.covariance(rtk) is rtk for _ in range(12)]
    assert believed == sorted(believed) and not believed[0] and believed[6]


def test_a_receiver_that_was_worse_than_expected_is_believed_at_once():
    noise = stated_noise(0.3, 0.6)
    for _ in range(100):
        noise.covariance(1e6 * np.eye(3))
    assert noise.covariance(CORRELATED) is CORRELATED


def test_an_antenna_counts_what_it_does_not_believe():
    counts = Counter()
    antenna = Antenna(Config(), counts)
    for k in range(30):
        scale = 1e-8 if k % 10 == 5 else 1.0
        covariance = scale * CORRELATED
        epoch = antenna.epoch(GnssEpoch(
            k, Fix(k, 48.0, 11.0, 300.0, covariance, 0), Velocity(k, np.ones(3), covariance)))
        assert np.allclose(epoch.covariances[0], CORRELATED)
        assert np.allclose(epoch.covariances[1], CORRELATED)
    assert (counts['velocity_covariance'], counts['fix_covariance']) == (3, 3)


@pytest.mark.parametrize('velocity', (None, (0.0, 0.0, 0.0)))
def test_altitude_that_comes_and_goes(velocity):
    """What is not known is no jump, and what was known is kept."""
    counts = Counter()
    antenna = Antenna(Config(), counts)
    altitudes = [math.nan] * 3 + [2500.0] * 3 + [math.nan] * 3 + [2501.0, 4000.0]
    epochs = []
    for k, altitude in enumerate(altitudes):
        message = told(k * SECOND, 0.0, velocity)
        message = message._replace(fix=usable(message.fix._replace(altitude_m=altitude))[0])
        epochs.append(antenna.epoch(message))
    assert [epoch.altitude for epoch in epochs] == [0.0] * 3 + [2500.0] * 6 + [2501.0] * 2
    assert counts['fix_jump'] == 1 and not epochs[-1].position_measured
    for epoch, altitude in zip(epochs, altitudes):
        up = epoch.covariances[1][2, 2]
        assert up == (1e8 if math.isnan(altitude) else Config().position_std_vertical ** 2)
        assert epoch.covariances[1][0, 0] == Config().position_std ** 2


@pytest.mark.parametrize('vertical', (0.0, 1.0))
def test_a_vertical_velocity_that_is_told_to_be_absent_counts_for_nothing(vertical):
    antenna = Antenna(Config(velocity_vertical='absent'), Counter())
    for k in range(3):
        epoch = antenna.epoch(told(k * SECOND, 0.0, (1.0, 2.0, vertical)))
        assert np.array_equal(epoch.covariances[0][:2, :2], CORRELATED[:2, :2])
        assert np.array_equal(epoch.covariances[0][2], [0.0, 0.0, 1e6])
        assert np.array_equal(epoch.covariances[0][:, 2], [0.0, 0.0, 1e6])


def test_the_course_of_a_slow_receiver_is_held_where_the_speed_alone_changes():
    """Not at rest, not where the velocity repeats, and not in a turn of 0.1 deg or at 2 m/s."""
    default = np.diag([Config.velocity_std ** 2] * 2 + [Config.velocity_std_vertical ** 2])
    speeds = [0.0, 0.2, 0.1, 0.1, 0.8, 0.8, 2.0, 2.5, 1.0]
    turns = [0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 180.0]
    variances = [0.0, 0.0, 0.09, 0.0, 0.64, 0.0, 0.0, 0.0, 0.0]
    for stated in (CORRELATED, None):
        counts = Counter()
        antenna = Antenna(Config(), counts)
        for k, (speed, course, variance) in enumerate(zip(speeds, 70.0 + np.cumsum(turns),
                                                          variances)):
            course = math.radians(course)
            v_n = np.array([speed * math.sin(course), speed * math.cos(course), 0.3])
            epoch = antenna.epoch(told(k * SECOND, 0.0)._replace(
                velocity=Velocity(k * SECOND, v_n, stated)))
            usual = default if stated is None else stated
            assert epoch.stated[0] == (stated is not None or variance > 0.0)
            assert np.allclose(epoch.covariances[0],
                               usual + np.diag([variance, variance, 0.0]))
        assert counts['velocity_course_held'] == 2


def test_a_receiver_that_has_measured_the_vertical_may_say_zero():
    antenna = Antenna(Config(), Counter())
    for k, up in enumerate((0.5, 0.0, -0.5, 0.0)):
        epoch = antenna.epoch(told(k * SECOND, 0.0, (3.0, 1.0, up)))
        assert np.array_equal(epoch.covariances[0], CORRELATED)


@pytest.mark.parametrize('silent, off, believed', [
    (1, 550.0, True), (1, 650.0, False), (9, 2950.0, True), (9, 3050.0, False)])
def test_a_fix_may_be_further_off_after_a_silence(silent, off, believed):
    antenna = Antenna(Config(), Counter())
    antenna.epoch(told(0, 0.0, (0.0, 0.0, 0.0)))
    epoch = antenna.epoch(told(silent * SECOND, off))
    assert epoch.position_measured == believed
    assert north_of(epoch) == pytest.approx(off if believed else 0.0, abs=1e-3)


def test_jumps_are_only_believed_one_after_the_other():
    antenna = Antenna(Config(), Counter())
    for k in range(61):
        antenna.epoch(told(k * SECOND // 5, 0.0 if k % 5 == 0 else 1e5))
        assert not antenna.jumped
    for k in range(61, 66):
        assert not antenna.jumped
        antenna.epoch(told(k * SECOND // 5, 1e5))
    assert antenna.jumped


def test_without_fixes_the_place_goes_on_with_the_velocity_for_a_minute():
    antenna = Antenna(Config(), Counter())
    antenna.epoch(told(0, 0.0, (0.0, 20.0, 0.0)))
    # Straight on where nothing is said; by what is said then; but not over two minutes.
    for second, velocity, north in ((5, None, 100.0), (15, (0.0, 30.0, 0.0), 400.0),
                                    (135, (0.0, 30.0, 0.0), 400.0)):
        epoch = antenna.epoch(told(second * SECOND, velocity=velocity))
        assert north_of(epoch) == pytest.approx(north, abs=1e-3)
        assert not epoch.position_measured


@pytest.mark.parametrize('std, fault', [(30.0, False), (0.1, True)])
def test_how_good_fixes_are_decides_what_they_say_about_velocities(std, fault):
    """Ten metres within a few seconds the other way are nothing where fixes are that bad."""
    antenna = Antenna(Config(), Counter())
    for k in range(400):
        message = told(k * SECOND // 5, -0.4 * k, (0.0, 2.0, 0.1))
        epoch = antenna.epoch(message._replace(
            fix=message.fix._replace(covariance=std ** 2 * np.eye(3))))
    assert bool(epoch.fault) == fault


@pytest.mark.parametrize('velocity', (True, False))
def test_gravity_is_in_doubt_by_the_way_since_the_last_gnss(velocity):
    """All of it unknown: g (v t / R) t / 2 of velocity, and nothing while there is GNSS."""
    antenna = Antenna(Config(), Counter())
    speed = 50.0
    for k in range(11):
        stamp = k * SECOND // 10
        antenna.epoch(told(stamp, speed * 0.1 * k, (0.0, speed, 0.0) if velocity else None))
        assert antenna.gravity_drift(stamp) == 0.0
    t = np.linspace(0.0, 40.0, 4001)
    density = [antenna.gravity_drift(SECOND + round(1e9 * later)) for later in t]
    variance = np.sum(np.square(density)) * (t[1] - t[0])
    assert math.sqrt(variance) == pytest.approx(9.8 * speed * 40.0 ** 2 / 2 / RADIUS, rel=0.01)


def test_a_velocity_that_stopped_coming_says_nothing_of_a_later_speed():
    """As if there had been none: 100 s at rest with velocities, then fixes alone at 30 m/s."""
    density = []
    for velocities in (100, 0):
        antenna = Antenna(Config(), Counter())
        for k in range(300):
            north = max(30.0 * (k - 100), 0.0)
            antenna.epoch(told(k * SECOND, north, (0.0, 0.0, 0.0) if k < velocities else None))
        density.append(antenna.gravity_drift(319 * SECOND))
    assert density[0] == density[1] == pytest.approx(9.78 * 30.0 / RADIUS * 20.0 ** 1.5, rel=0.01)


def test_an_epoch_that_says_nothing_leaves_gravity_in_doubt():
    antenna = Antenna(Config(), Counter())
    antenna.epoch(told(0, 0.0, (0.0, 50.0, 0.0)))
    antenna.epoch(told(4 * SECOND))
    expected = 9.78 * 50.0 / RADIUS * 4.0 ** 1.5
    assert antenna.gravity_drift(4 * SECOND) == pytest.approx(expected, rel=0.01)
