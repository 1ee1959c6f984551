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
"""Units, coordinates and clocks that are wrong: node, replay and info say the same."""

from collections import Counter
import dataclasses
import re

from ins_align.checks import BEYOND_THE_POLES, exchange_fault, InputChecks, lateness_advice
from ins_align.config import Config, config_from_mapping
from ins_align.geometry.rotation import matrix_from_rpy
from ins_align.gnss.buffer import GnssBuffer
from ins_align.gnss.messages import Fix, Velocity
from ins_align.gnss.motion import Series
from ins_align.offline import replay
from ins_align.recordings.info import describe, inspect
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest

DEGREES = 'the angular rates look like deg/s'
EXCHANGED = 'with latitude and longitude exchanged'
LATE = 'GNSS messages come up to 1.7 s later than newer IMU samples: set gnss_lateness to 2.5'


@pytest.fixture(scope='module')
def drive():
    return simulate('car', seed=1, duration=40.0, stand_still=5.0, imu_grade='tactical')


def in_degrees(simulation):
    return dataclasses.replace(simulation, gyro=np.degrees(simulation.gyro))


def exchanged(simulation):
    return dataclasses.replace(simulation, lla_deg=simulation.lla_deg[:, [1, 0, 2]])


def far_in_the_east(simulation):
    return dataclasses.replace(
        simulation, lla_deg=simulation.lla_deg[:, [1, 0, 2]] + [100.0, 0.0, 0.0])


def late(simulation):
    return dataclasses.replace(
        simulation, gnss_arrival_ns=simulation.gnss_stamps_ns + 1_720_000_000)


WRONG = ((in_degrees, DEGREES), (exchanged, EXCHANGED), (far_in_the_east, BEYOND_THE_POLES),
         (late, LATE))


@pytest.mark.parametrize('change, sentence', WRONG)
def test_info_and_replay_say_the_same(drive, tmp_path, change, sentence):
    path = tmp_path / 'drive'
    write_bag(change(drive), path)
    info, result = describe(inspect(path)), replay(path)
    assert sentence in info
    assert sentence in result.status.reason
    # Late messages are no fault of what they say.
    assert result.status.state.value == ('ALIGNING' if change is late else 'FAULT')
    # Nothing else is accused.
    for _, other in WRONG:
        assert (other in info) == (other in result.status.reason) == (other == sentence)
    assert 'too little motion' not in info or change is far_in_the_east


@pytest.mark.parametrize('delay', [0.0, -55.0])
@pytest.mark.parametrize('lateness', [1.7, 10.0, 10.1, 59.9])
def test_what_late_messages_ask_for_can_be_set(lateness, delay):
    text, value = lateness_advice(lateness, delay)
    config_from_mapping({'gnss_lateness': float(value)})
    for setting in re.findall(r'gnss_delay=(\S+)', text):
        config_from_mapping({'gnss_delay': float(setting)})


@pytest.mark.parametrize('behind, change, advice', [
    (5.0, late, ('2.5', '-6.7')), (0.0, late, ('2.5', '-1.7')), (5.0, None, ()), (-1.5, None, ())])
def test_late_messages_are_those_that_gnss_delay_does_not_explain(drive, behind, change, advice):
    simulation = change(drive) if change else drive
    simulation = dataclasses.replace(
        simulation, gnss_stamps_ns=simulation.gnss_stamps_ns - round(behind * 1e9))
    said = checked(simulation, config=Config(gnss_delay=-behind)).late_messages()
    assert [re.findall(r'gnss_(?:lateness to|delay=)\s?(-?[\d.]+\d)', text) for text in said] == (
        [list(advice)] if advice else [])


@pytest.mark.parametrize('behind', [-18.0, 18.0])
def test_positions_of_another_clock_are_no_exchanged_ones(behind):
    flight = simulate('flight', seed=1, duration=60.0, imu_rate=50.0)
    offset_ns = round(behind * 1e9)
    positions = dataclasses.replace(flight, gnss_stamps_ns=flight.gnss_stamps_ns - offset_ns)
    checks = checked(flight, kinds=(Velocity,))
    assert checked(positions, checks=checks, kinds=(Fix,)).faults() == []


def test_nothing_is_said_of_what_is_right(drive):
    checks = checked(drive)
    assert checks.faults() == checks.late_messages() == []


@pytest.mark.parametrize('scenario', ['hover', 'flight', 'launch', 'reverse', 'swing'])
@pytest.mark.parametrize('wrong', [{}, {'flip_gyro': 'x'}, {'flip_axis': 'z'}])
def test_rates_in_degrees_are_found_whatever_moves_and_nothing_else_is(scenario, wrong):
    """Also where the course tells nothing, and without accusing wrong signs."""
    simulation = simulate(scenario, seed=2, duration=60.0, imu_grade='chip', **wrong)
    assert checked(simulation).faults() == []
    fault, = checked(in_degrees(simulation)).faults()
    assert DEGREES in fault


def test_a_receiver_that_goes_wild_makes_no_rates_degrees():
    """It spoils what the force should add up to, with rates in either unit."""
    hover = simulate('hover', seed=2, duration=90.0)
    wild = hover.velocity.copy()
    time = hover.gnss_stamps_ns * 1e-9
    wild[:, 2] += np.where(time > 45.0, 40.0 * np.sin(time / 4.0), 0.0)
    assert checked(dataclasses.replace(hover, velocity=wild)).faults() == []


def test_velocities_north_east_down_are_no_exchanged_positions(drive):
    velocity = drive.velocity[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    checks = checked(dataclasses.replace(drive, velocity=velocity))
    assert checks.faults() == []


@pytest.mark.parametrize('angle', [-120.0, -25.0, 40.0, 180.0])
def test_velocities_that_are_turned_are_no_exchanged_positions(angle):
    simulation = simulate('flight', seed=1, duration=60.0, imu_rate=50.0)
    turn = matrix_from_rpy(np.radians([0.0, 0.0, angle]))
    velocity = simulation.velocity @ turn.T
    assert checked(dataclasses.replace(simulation, velocity=velocity)).faults() == []
    fault, = checked(exchanged(simulation)).faults()
    assert EXCHANGED in fault


@pytest.mark.parametrize('change, sentence', WRONG)
def test_it_is_found_in_pieces_of_any_size(drive, change, sentence):
    for samples in (1, 37, 10 ** 6):
        checks = checked(change(drive), samples)
        fault, = checks.faults() + checks.late_messages()
        assert sentence in fault


def test_what_is_no_number_says_nothing():
    nan, huge = np.full((3, 6), np.nan), np.full((3, 6), 1e300)
    checks = InputChecks(Config())
    assert checks.faults() == []
    for values in (nan, huge):
        checks.add_imu(np.arange(3), values)
        buffer = GnssBuffer(0, Counter(), watch=checks.add_gnss)
        buffer.add(Fix(0, np.nan, np.nan, np.nan, None, 0), 1)
        buffer.add(Velocity(0, values[0, :3], None), 1)
    fault, = checks.faults()  # of the huge ones
    assert DEGREES in fault
    nothing = Series(np.zeros(0), np.zeros((0, 3)))
    assert exchange_fault(nothing, nothing) == ''


def checked(simulation, samples=500, config=Config(), checks=None, kinds=(Fix, Velocity)):
    """Give the checks a simulation as it arrives, so many samples at a time."""
    checks = checks or InputChecks(config)
    buffer = GnssBuffer(0, Counter(), watch=checks.add_gnss)
    stamps = simulation.imu_stamps_ns
    values = np.hstack([simulation.gyro, simulation.accel])
    after = np.searchsorted(stamps, simulation.gnss_arrival_ns)
    for start in range(0, len(stamps), samples):
        part = slice(start, start + samples)
        for k in np.flatnonzero((after >= start) & (after < part.stop)).tolist():
            newest = int(stamps[after[k] - 1]) if after[k] else None
            stamp = int(simulation.gnss_stamps_ns[k] - round(config.gnss_delay * 1e9))
            for message in (Fix(stamp, *simulation.lla_deg[k].tolist(), None, 0),
                            Velocity(stamp, simulation.velocity[k], None)):
                if isinstance(message, kinds):
                    buffer.add(message, newest)
        checks.add_imu(stamps[part], values[part])
    return checks
