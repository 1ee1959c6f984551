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
"""What arrives late, twice, out of order or broken is put in order or counted."""

from collections import Counter
import math

from hypothesis import given, settings
from hypothesis import strategies as st
from ins_align.gnss.buffer import GnssBuffer
from ins_align.gnss.messages import Fix, Velocity
from ins_align.imu.buffer import ImuBuffer, KEPT_BEFORE, KEPT_NS
import numpy as np
import pytest

MS = 1_000_000
LATENESS = 1000 * MS


def imu_buffer():
    counts = Counter()
    return ImuBuffer(LATENESS, counts), counts


def gnss_buffer():
    counts = Counter()
    return GnssBuffer(LATENESS, counts), counts


def sample_of(stamp):
    """Values that tell their stamp."""
    return np.full(3, stamp * 1e-12), np.full(3, -stamp * 1e-12)


def fill(buffer, stamps, last=True):
    """Take samples one by one; return whether the clock goes on."""
    goes_on = all(buffer.add(stamp, *sample_of(stamp)) for stamp in stamps)
    buffer.consolidate(last)
    return goes_on


def held(buffer):
    """Stamps that are held, each with its own values."""
    assert np.allclose(buffer.samples[:, 0], buffer.stamps * 1e-12)
    assert np.allclose(buffer.samples[:, 3], -buffer.stamps * 1e-12)
    return buffer.stamps.tolist()


def test_samples_in_order_stay_as_they_are():
    buffer, counts = imu_buffer()
    fill(buffer, range(0, 100 * MS, 10 * MS))
    assert held(buffer) == list(range(0, 100 * MS, 10 * MS))
    assert counts['imu'] == 10 and buffer.newest_ns == 90 * MS


def test_samples_out_of_order_are_sorted_and_duplicates_dropped():
    buffer, counts = imu_buffer()
    fill(buffer, [0, 20 * MS, 10 * MS, 10 * MS, 30 * MS, 20 * MS])
    assert held(buffer) == [0, 10 * MS, 20 * MS, 30 * MS]
    assert counts['imu_duplicate'] == 2
    assert counts['imu_out_of_order'] >= 2
    fill(buffer, [25 * MS, 40 * MS, 30 * MS])
    assert held(buffer) == [0, 10 * MS, 20 * MS, 25 * MS, 30 * MS, 40 * MS]


def test_of_imu_samples_with_one_stamp_the_first_to_come_is_kept():
    buffer, counts = imu_buffer()
    for value in (1.0, 2.0, 3.0):
        for stamp in (0, 10 * MS):
            buffer.add(stamp, np.full(3, value), np.zeros(3))
    buffer.consolidate()
    assert buffer.samples[:, 0].tolist() == [1.0, 1.0] and counts['imu_duplicate'] == 4


@pytest.mark.parametrize('value', (np.nan, np.inf, -np.inf, 1e30))
@pytest.mark.parametrize('column', range(6))
def test_broken_values_are_dropped_and_counted(value, column):
    buffer, counts = imu_buffer()
    sample = np.zeros(6)
    sample[column] = value
    buffer.add(0, np.zeros(3), np.zeros(3))
    buffer.add(10 * MS, sample[:3], sample[3:])
    buffer.add(20 * MS, np.zeros(3), np.zeros(3))
    buffer.consolidate()
    assert buffer.stamps.tolist() == [0, 20 * MS]
    assert counts['imu_nan'] == 1 and counts['imu'] == 3


def test_sample_later_than_allowed_is_counted_and_dropped():
    buffer, counts = imu_buffer()
    assert fill(buffer, [0, 1000 * MS, 2000 * MS, 10 * MS, 2010 * MS])
    assert held(buffer) == [0, 1000 * MS, 2000 * MS, 2010 * MS]
    assert counts['imu_late'] == 1


@pytest.mark.parametrize('wild', (1500 * MS, 10 ** 18))
def test_single_sample_far_ahead_is_of_another_clock(wild):
    buffer, counts = imu_buffer()
    assert fill(buffer, [0, 10 * MS, wild, 20 * MS, 30 * MS, wild])
    assert buffer.newest_ns == 30 * MS
    assert held(buffer) == [0, 10 * MS, 20 * MS, 30 * MS]
    assert counts['imu_ahead'] == 2 and counts['imu'] == 4


def test_time_goes_on_where_a_second_sample_says_so():
    buffer, counts = imu_buffer()
    fill(buffer, [0, 3000 * MS], last=False)
    assert buffer.newest_ns == 0
    fill(buffer, [2990 * MS])                   # out of order, within the lateness
    assert held(buffer) == [0, 2990 * MS, 3000 * MS]
    assert buffer.newest_ns == 3000 * MS and counts['imu_ahead'] == 0


def test_sample_before_what_is_used_up_is_late():
    buffer, counts = imu_buffer()
    fill(buffer, [0, 100 * MS, 200 * MS])
    buffer.used_ns = 150 * MS
    fill(buffer, [120 * MS, 300 * MS])
    assert held(buffer) == [0, 100 * MS, 200 * MS, 300 * MS]
    assert counts['imu_late'] == 1


@pytest.mark.parametrize('step', [100, 300, 900, 893])   # the last leads to equal stamps
def test_clock_set_back_by_less_than_lateness_is_told(step):
    buffer, counts = imu_buffer()
    fill(buffer, np.arange(0, 2000, 10) * MS)
    since = np.arange(1993 - step, 2500, 10) * MS
    for count, stamp in enumerate(since, 1):
        if not buffer.add(stamp, *sample_of(stamp + step * MS)):
            break
    assert 1 < count < 10 and [stamp for stamp, _ in buffer.held] == since[:count].tolist()
    buffer.consolidate()
    assert counts['imu'] == 200 and not counts['imu_out_of_order']


@pytest.mark.parametrize('hole', [(1500, 1990), (1000, 1200)])
def test_late_block_that_fills_a_hole_is_no_clock_set_back(hole):
    stamps = np.arange(0, 2000, 10)
    late = (stamps >= hole[0]) & (stamps < hole[1])
    buffer, counts = imu_buffer()
    assert fill(buffer, np.concatenate([stamps[~late], stamps[late], stamps[late]]) * MS)
    np.testing.assert_array_equal(buffer.stamps, stamps * MS)
    assert counts['imu_duplicate'] == np.count_nonzero(late)


def test_clock_set_back_is_told_from_a_single_late_sample():
    buffer, counts = imu_buffer()
    assert fill(buffer, [5000 * MS, 10 * MS], last=False)
    assert not fill(buffer, [20 * MS], last=False)
    assert [stamp for stamp, _ in buffer.held] == [10 * MS, 20 * MS] and not counts['imu_late']


def test_two_strays_far_apart_are_not_a_clock():
    buffer, _ = imu_buffer()
    assert fill(buffer, [5000 * MS, 10 * MS, 2000 * MS])


def test_late_samples_with_good_ones_between_them_are_no_clock():
    buffer, counts = imu_buffer()
    for k in range(5):
        assert fill(buffer, np.array([5000, 1000]) * MS + k * 10 * MS, last=False)
    # Nor are two of them where the second is the older one.
    assert fill(buffer, [900 * MS])
    assert counts['imu_late'] == 6


def test_forgetting_keeps_what_interpolation_needs():
    buffer, _ = imu_buffer()
    fill(buffer, range(0, 1000 * MS, 10 * MS))
    buffer.forget_before(505 * MS + KEPT_NS)
    kept = held(buffer)
    assert kept == list(range((510 - 10 * KEPT_BEFORE) * MS, 1000 * MS, 10 * MS))
    assert 490 * MS in kept and 500 * MS in kept
    buffer.forget_before(0)
    assert held(buffer) == kept


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 60), min_size=1, max_size=40), st.data())
def test_arrays_are_the_same_as_one_by_one(numbers, data):
    stamps = np.array(numbers, np.int64) * 50 * MS          # up to 3 s: late ones among them
    one, counts_one = imu_buffer()
    goes_on = fill(one, stamps.tolist())
    many, counts_many = imu_buffer()
    cuts = sorted(data.draw(st.lists(st.integers(0, len(numbers)), max_size=4)))
    for part in np.split(stamps, cuts):
        values = np.repeat(part[:, None] * 1e-12, 3, axis=1)
        if not many.add_in_order(part, values, -values) and not all(
                many.add(stamp, *sample_of(stamp)) for stamp in part.tolist()):
            break
        many.consolidate()
    many.consolidate(last=True)
    if goes_on:
        assert held(one) == held(many)
        assert one.newest_ns == many.newest_ns
        assert +counts_one == +counts_many


# GNSS

def fix(stamp=0, **changes):
    return Fix(stamp, 48.0, 11.0, 300.0, None, 0)._replace(**changes)


def velocity(stamp=0, v=(1.0, 2.0, 3.0)):
    return Velocity(stamp, np.array(v), None)


def test_fix_and_velocity_of_one_stamp_are_one_epoch():
    buffer, counts = gnss_buffer()
    buffer.add(velocity(20), None)
    buffer.add(fix(20), None)
    buffer.add(fix(10), None)
    first, second = buffer.release(20)
    assert (first.stamp_ns, first.velocity) == (10, None) and first.fix is not None
    assert second.fix is not None and second.velocity is not None
    assert buffer.release(100) == [] and counts['fix'] == 2 and counts['velocity'] == 1


def test_epochs_are_released_in_order_up_to_a_stamp():
    buffer, _ = gnss_buffer()
    for stamp in (50, 10, 40, 20, 30):
        buffer.add(fix(stamp), None)
    assert [e.stamp_ns for e in buffer.release(30)] == [10, 20, 30]
    assert [e.stamp_ns for e in buffer.release(99, last=True)] == [40, 50]


@pytest.mark.parametrize('changes, reason', [
    ({'latitude_deg': np.nan}, 'fix_nan'), ({'longitude_deg': np.inf}, 'fix_nan'),
    ({'altitude_m': np.inf}, 'fix_nan'), ({'latitude_deg': 91.0}, 'fix_nan'),
    ({'longitude_deg': 1e6}, 'fix_nan'), ({'altitude_m': -1e9}, 'fix_nan'),
    ({'status': -1}, 'fix_no_fix'), ({'latitude_deg': 0.0, 'longitude_deg': 0.0}, 'fix_no_fix')])
def test_fixes_that_are_none_are_counted_by_reason(changes, reason):
    buffer, counts = gnss_buffer()
    buffer.add(fix(5, **changes), None)
    assert buffer.release(10) == [] and counts[reason] == 1


def test_broken_velocities_are_counted():
    buffer, counts = gnss_buffer()
    for v in ((np.nan, 0, 0), (0, np.inf, 0), (0, 0, 1e9)):
        buffer.add(velocity(5, v), None)
    assert buffer.release(10) == [] and counts['velocity_nan'] == 3


def test_position_without_its_altitude_is_kept():
    buffer, counts = gnss_buffer()
    buffer.add(fix(5, altitude_m=math.nan), None)
    buffer.add(fix(6, altitude_m=math.inf), None)
    buffer.add(fix(7, altitude_m=math.nan, latitude_deg=math.nan), None)
    kept, = buffer.release(10, last=True)
    assert kept.fix.latitude_deg == 48.0 and kept.fix.altitude_m == 0.0 and not kept.fix.vertical
    assert counts['fix'] == 3 and counts['fix_nan'] == 2 and counts['fix_no_altitude'] == 1


def test_velocity_without_its_vertical_is_kept():
    buffer, counts = gnss_buffer()
    buffer.add(velocity(5, (1.0, 2.0, np.nan)), None)
    kept = buffer.release(10, last=True)[0].velocity
    assert kept.velocity.tolist() == [1.0, 2.0, 0.0] and not kept.vertical
    assert counts['velocity'] == 1 and counts['velocity_nan'] == 0


def test_duplicates_are_counted_and_the_first_is_kept():
    buffer, counts = gnss_buffer()
    buffer.add(fix(5, altitude_m=1.0), None)
    buffer.add(fix(5, altitude_m=2.0), None)
    buffer.add(velocity(5, (1.0, 0, 0)), None)
    buffer.add(velocity(5, (2.0, 0, 0)), None)
    epoch, = buffer.release(10)
    assert epoch.fix.altitude_m == 1.0 and epoch.velocity.velocity[0] == 1.0
    assert counts['fix_duplicate'] == 1 and counts['velocity_duplicate'] == 1


@pytest.mark.parametrize('late', (0, 30 * MS))
def test_epochs_that_move_and_repeat_the_one_before_are_left_out(late):
    """A driver that sends what the receiver said last at a rate of its own."""
    buffer, counts = gnss_buffer()
    said = [(48.0, 3.0), (48.0, 3.0), (48.1, 3.0), (48.1, 3.0), (48.1, 3.0), (48.1, 3.1)]
    for k, (latitude, north) in enumerate(said):
        buffer.add(fix(k * 200 * MS, latitude_deg=latitude), None)
        buffer.add(velocity(k * 200 * MS + late, (0.0, north, 0.0)), None)
        if k == 3:
            epochs = buffer.release(700 * MS)
    epochs += buffer.release(2000 * MS)
    assert [epoch.stamp_ns - late for epoch in epochs] == [0, 400 * MS, 1000 * MS]
    assert counts['gnss_repeated'] == 3


def test_a_receiver_that_stands_or_says_half_repeats_nothing():
    """At rest some receivers hold position and velocity; positions alone may do so too."""
    buffer, counts = gnss_buffer()
    for k in range(3):
        buffer.add(fix(k * 100 * MS), None)
        buffer.add(velocity(k * 100 * MS, (0.0, 0.0, 0.0)), None)
        buffer.add(fix((1000 + 100 * k) * MS), None)
        buffer.add(velocity((2000 + 100 * k) * MS, (1.0, 2.0, 0.0)), None)
    assert len(buffer.release(3000 * MS)) == 9 and counts['gnss_repeated'] == 0


@pytest.mark.parametrize('late', (0, 30 * MS))
def test_velocities_of_a_receiver_without_a_fix_are_left_out(late):
    """It sends zeros, or what it knew last, and some messages have no room to say so."""
    buffer, counts = gnss_buffer()
    epochs = []
    for k in range(12):                                     # twice as many velocities as fixes
        if k % 2 == 0:
            buffer.add(fix(k * 100 * MS, status=-1 if 4 <= k < 8 else 0), None)
        buffer.add(velocity(k * 100 * MS + late), None)
        epochs += buffer.release((k - 2) * 100 * MS)
    epochs += buffer.release(2000 * MS)
    assert [epoch.stamp_ns - late for epoch in epochs] == [
        k * 100 * MS for k in range(12) if not 4 <= k < 8]
    assert counts['velocity_no_fix'] == 4 and counts['fix_no_fix'] == 2
    # Who says nothing of a fix any more may have one again.
    buffer.add(fix(3000 * MS, status=-1), 3000 * MS)
    for stamp in (3000 * MS, 5000 * MS, 5100 * MS):
        buffer.add(velocity(stamp), None)
    assert [epoch.stamp_ns for epoch in buffer.release(6000 * MS)] == [5100 * MS]
    # Too late to tell anything, as a fix would be.
    buffer.add(fix(7000 * MS, status=-1), 9000 * MS)
    buffer.add(velocity(7500 * MS), 8000 * MS)
    assert len(buffer.release(9000 * MS)) == 1


def test_what_is_behind_the_end_is_left_out_and_counted():
    buffer, counts = gnss_buffer()
    for k in range(4):
        buffer.add(fix(k * 1000 * MS), None)
    assert len(buffer.release(1000 * MS)) == 1 and counts['gnss_after_imu'] == 0
    assert len(buffer.release(2000 * MS, last=True)) == 2 and buffer.oldest_ns is None
    assert counts['gnss_after_imu'] == 1


def test_messages_too_late_or_of_another_clock_are_counted():
    buffer, counts = gnss_buffer()
    newest = 100_000 * MS
    buffer.add(fix(newest - LATENESS - 1), newest)
    buffer.add(velocity(newest - LATENESS - 1), newest)
    buffer.add(fix(newest + 3_600_000 * MS), newest)
    assert counts['fix_late'] == 1 and counts['velocity_late'] == 1 and counts['fix_ahead'] == 1
    buffer.add(fix(newest - LATENESS), newest)
    assert len(buffer.release(newest)) == 1


def test_gnss_without_imu_is_bounded():
    buffer, counts = gnss_buffer()
    for k in range(12_000):
        buffer.add(velocity(k), None)
    assert counts['gnss_overflow'] == 2_000
    released = buffer.release(12_000, last=True)
    assert len(released) == 10_000
    assert (released[0].stamp_ns, released[-1].stamp_ns) == (2_000, 11_999)


@pytest.mark.parametrize('late', (-30 * MS, 30 * MS))
def test_fix_and_velocity_with_stamps_of_their_own_are_one_epoch(late):
    """At the velocity's stamp, the fix carried to it: 30 ms at 100 m/s are 3 m."""
    buffer, _ = gnss_buffer()
    for stamp, longitude in ((1000 * MS, 11.0), (1200 * MS, 11.1)):
        buffer.add(fix(stamp, longitude_deg=longitude), None)
        buffer.add(velocity(stamp + late, (0.0, 100.0, 10.0)), None)
    epochs = buffer.release(2000 * MS)
    assert [epoch.stamp_ns for epoch in epochs] == [1000 * MS + late, 1200 * MS + late]
    for epoch in epochs:
        moved = epoch.fix.latitude_deg - fix(0).latitude_deg
        assert moved * 111_195 == pytest.approx(late * 1e-9 * 100.0, abs=0.02)
        assert epoch.fix.altitude_m - fix(0).altitude_m == pytest.approx(late * 1e-9 * 10.0)
        assert epoch.fix.stamp_ns == epoch.velocity.stamp_ns == epoch.stamp_ns


def test_half_an_epoch_waits_for_the_other_half_and_not_for_ever():
    buffer, _ = gnss_buffer()
    buffer.add(fix(1000 * MS), None)
    assert buffer.release(1040 * MS) == [] and buffer.oldest_ns == 1000 * MS
    buffer.add(velocity(1045 * MS), None)
    assert buffer.release(1040 * MS) == []             # the epoch is the velocity's
    joint, = buffer.release(1045 * MS)
    assert joint.fix is not None and joint.velocity is not None and buffer.oldest_ns is None
    buffer.add(velocity(1200 * MS), None)
    buffer.add(fix(1300 * MS), None)
    assert [epoch.stamp_ns for epoch in buffer.release(1310 * MS)] == [1200 * MS]
    assert [epoch.stamp_ns for epoch in buffer.release(1310 * MS, last=True)] == [1300 * MS]


def test_two_of_a_kind_are_no_pair():
    buffer, _ = gnss_buffer()
    for stamp in (1000 * MS, 1040 * MS):
        buffer.add(velocity(stamp), None)
    assert len(buffer.release(2000 * MS)) == 2


def test_an_epoch_is_whole_whatever_comes_right_behind_it():
    buffer, _ = gnss_buffer()
    buffer.add(fix(0), None)
    for stamp in (0, 30 * MS):
        buffer.add(velocity(stamp), None)
    whole, alone = buffer.release(1000 * MS)
    assert whole.fix is not None and whole.velocity.stamp_ns == whole.stamp_ns == 0
    assert alone.fix is None and alone.velocity.stamp_ns == alone.stamp_ns == 30 * MS
