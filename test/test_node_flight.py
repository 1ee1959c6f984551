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
"""A flight through the live node: what it publishes against replay and against the truth."""

import json

from ins_align.simulation.simulate import simulate, write_bag
from node_harness import (
    attitude_error_deg, bag_script, Listener, overrides, play, RELIABLE, replayed, running_node,
    stamp_ns, values_of)
import numpy as np
import pytest

RATE = 3.0  # times real time: with coverage measured, a node keeps up on a busy machine
# Faster than real time, the same delay on the way between processes is longer on the data's clock.
LATENESS = 4.0  # s
SPAN_NS = 25_000_000_000  # that is looked at after the declaration


@pytest.fixture(scope='module')
def flight():
    return simulate('flight', imu_grade='mems', seed=0, duration=50.0)


def test_flight(flight, tmp_path):
    bag = tmp_path / 'flight'
    write_bag(flight, bag)
    parameters = {'lever_arm': '[1, 1, 1]', 'gnss_lateness': LATENESS}
    rows = replayed(bag, parameters, tmp_path / 'flight.csv', f'--json={tmp_path / "flight.json"}')
    declared = next(row for row in rows if row['state'] == 'ALIGNED')

    with running_node([*overrides(parameters), *RELIABLE]) as node:
        with Listener(imu=True) as listener:
            listener.wait_for(lambda: listener.statuses)  # the two have found each other
            play(bag_script(bag), tmp_path, RATE)
            listener.wait_for(lambda: listener.count('imu') == len(flight.imu_stamps_ns))
            listener.wait_for_next_status()
        with Listener(name='late') as late:
            late.wait_for(lambda: late.attitudes)

    # The same attitude for whoever listened and for whoever comes late, and that of replay.
    attitude, = listener.attitudes
    assert late.attitudes == [attitude]
    q = attitude.quaternion
    assert [q.x, q.y, q.z, q.w] == pytest.approx(
        [float(declared[name]) for name in ('qx', 'qy', 'qz', 'qw')], abs=1e-9)
    assert q.w >= 0.0
    assert attitude.header.frame_id == 'map'
    # t0 moves until it is declared, and no more; there it is the true attitude.
    t0_ns = json.loads((tmp_path / 'flight.json').read_text())['t0']
    assert stamp_ns(attitude) == t0_ns < int(declared['stamp_ns'])
    error = attitude_error_deg(q, flight.attitude_at(t0_ns))
    sigma = np.array([float(declared[f'sigma_{axis}_deg']) for axis in 'enu'])
    assert np.abs(error / sigma).max() < 3.5

    # Nothing was lost or left out on the way, and the last word is that of replay as well.
    status = listener.status
    row = next(row for row in rows if row['stamp_ns'] == status['stamp_ns'])
    assert int(status['stamp_ns']) > int(declared['stamp_ns']) + SPAN_NS
    assert listener.heard_state == row['state'] == 'ALIGNED'
    assert float(status['time_to_align_s']) == pytest.approx(float(declared['t_s']))
    assert int(status['fix']) == int(status['velocity']) == len(flight.gnss_stamps_ns)
    for name in ('fix_late', 'fix_ahead', 'imu_gap', 'imu_nan', 'imu_late', 'resets'):
        assert listener.count(name) == 0
    levels = {msg.status[0].level for msg in listener.statuses
              if values_of(msg)['state'] == 'ALIGNED'}
    assert levels == {b'\0'}
    assert 'ALIGNED' in node.output

    check_imu(listener, flight, float(declared['t_s']))


def check_imu(listener, flight, time_to_align_s):
    """Compare ~/imu with the input and with the truth."""
    stamps = np.array([stamp_ns(msg) for msg in listener.imus])
    # Every sample from the first one with an attitude on, and none before the alignment.
    before = len(flight.imu_stamps_ns) - len(stamps)
    assert np.array_equal(stamps, flight.imu_stamps_ns[before:])
    assert time_to_align_s <= (stamps[0] - flight.imu_stamps_ns[0]) * 1e-9
    rates = np.array([(msg.angular_velocity.x, msg.angular_velocity.y, msg.angular_velocity.z)
                      for msg in listener.imus])
    assert np.array_equal(rates, flight.gyro[before:])
    assert {msg.header.frame_id for msg in listener.imus} == {'imu'}

    span = slice(0, np.searchsorted(stamps, stamps[0] + SPAN_NS))
    truth = flight.attitude_at(stamps[span])
    errors, sigmas = [], []
    for msg, C_nb in zip(listener.imus[span], truth):
        errors.append(attitude_error_deg(msg.orientation, C_nb))
        covariance = np.reshape(msg.orientation_covariance, (3, 3))
        assert np.linalg.eigvalsh(covariance)[0] > 0.0
        sigmas.append(np.degrees(np.sqrt(np.diag(covariance))))
    errors, sigmas = np.array(errors), np.array(sigmas)
    assert len(errors) > 2000
    assert np.abs(errors / sigmas).max() < 3.0
    # Honest must not mean vague: from the threshold, at which it was declared, sigma falls.
    assert sigmas[-1].max() < 0.7 * sigmas[0].max()
