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

from ins_align.antenna import Antenna, StatedNoise
from ins_align.buffers import GnssEpoch
from ins_align.config import Config
from ins_align.messages import Fix, Velocity
import numpy as np
import pytest

CORRELATED = np.array([[0.01, 0.004, 0.0], [0.004, 0.02, -0.003], [0.0, -0.003, 0.03]])


def test_what_is_stated_again_and_again_is_believed():
    noise = StatedNoise(0.3, 0.6)
    for _ in range(20):
        assert noise.believed(CORRELATED) is CORRELATED


def test_a_receiver_that_states_nothing_has_what_is_configured():
    assert np.array_equal(StatedNoise(0.3, 0.6).believed(None), np.diag([0.09, 0.09, 0.36]))


@pytest.mark.parametrize('axis', range(3))
def test_one_that_is_far_better_for_an_epoch_is_not_believed(axis):
    noise = StatedNoise(0.3, 0.6)
    better = np.eye(3)
    better[axis, axis] = 1e-3
    better = better @ CORRELATED @ better
    for k in range(40):
        if k % 3 == 1:
            assert np.allclose(noise.believed(better), CORRELATED)
        else:
            assert noise.believed(CORRELATED) is CORRELATED


def test_the_very_first_epoch_is_compared_with_what_is_configured():
    assert np.array_equal(StatedNoise(0.3, 0.6).believed(1e-8 * np.eye(3)),
                          np.diag([0.09, 0.09, 0.36]))


def test_a_receiver_that_has_become_better_is_believed_after_a_while():
    noise = StatedNoise(2.5, 5.0)
    rtk = 1e-4 * np.eye(3)
    for _ in range(100):
        noise.believed(np.eye(3))
    believed = [noise.believed(rtk) is rtk for _ in range(12)]
    assert believed == sorted(believed) and not believed[0] and believed[6]


def test_a_receiver_that_was_worse_than_expected_is_believed_at_once():
    noise = StatedNoise(0.3, 0.6)
    for _ in range(100):
        noise.believed(1e6 * np.eye(3))
    assert noise.believed(CORRELATED) is CORRELATED


def test_an_antenna_counts_what_it_does_not_believe():
    counts = Counter()
    antenna = Antenna(Config(), counts)
    for k in range(30):
        scale = 1e-8 if k % 10 == 5 else 1.0
        covariance = scale * CORRELATED
        epoch = antenna.epoch(GnssEpoch(
            k, Fix(k, 48.0, 11.0, 300.0, covariance, 0), Velocity(k, np.ones(3), covariance)))
        assert np.allclose(epoch.velocity_covariance, CORRELATED)
        # Ten centimetres are far better than expected, until they are stated again.
        assert (k == 0) != np.allclose(epoch.position_covariance, CORRELATED)
    assert (counts['velocity_covariance'], counts['fix_covariance']) == (3, 4)


@pytest.mark.parametrize('velocity', (True, False))
def test_gravity_is_in_doubt_by_the_way_since_the_last_gnss(velocity):
    """All of it unknown: g (v t / R) t / 2 of velocity, and nothing while there is GNSS."""
    antenna = Antenna(Config(), Counter())
    speed, second = 50.0, 1_000_000_000
    for k in range(11):
        stamp = k * second // 10
        latitude = 48.0 + math.degrees(speed * 0.1 * k / 6378137.0)
        antenna.epoch(GnssEpoch(stamp, Fix(stamp, latitude, 11.0, 0.0, None, 0), Velocity(
            stamp, np.array([0.0, speed, 0.0]), None) if velocity else None))
        assert antenna.gravity_drift(stamp) == 0.0
    t = np.linspace(0.0, 40.0, 4001)
    density = [antenna.gravity_drift(second + round(1e9 * later)) for later in t]
    variance = np.sum(np.square(density)) * (t[1] - t[0])
    assert math.sqrt(variance) == pytest.approx(9.8 * speed * 40.0 ** 2 / 2 / 6378137.0, rel=0.01)
