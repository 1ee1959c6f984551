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
"""The real recordings through the live node at ten times real time, against replay."""

from node_harness import (
    bag_script, Listener, overrides, play, RELIABLE, replayed, running_node, stamp_ns, values_of)
import numpy as np
import pytest
from recordings import real_recording

RATE = 10.0
TOLERANCE_DEG = 0.01
# Ten times real time, the same delay on the way between processes is ten times as long on the
# clock of the data.
LATENESS = 5.0  # s


@pytest.mark.campaign
@pytest.mark.parametrize(('name', 'start', 'duration', 'parameters'), [
    ('uav_thor75', 150.0, 45.0, {}),
    ('car_drive0708', 20.0, 60.0, {'lever_arm': '[0.0, 0.05, 0.0]', 'heading_std_threshold': 1.5}),
    ('quad_dot08.bag', 0.0, 40.0, {})])
def test_recording(name, start, duration, parameters, tmp_path):
    bag = real_recording(name)
    parameters = {**parameters, 'gnss_lateness': LATENESS}
    rows = replayed(bag, parameters, tmp_path / 'rows.csv',
                    f'--start={start}', f'--duration={duration}')
    by_stamp = {int(row['stamp_ns']): row for row in rows}
    script = bag_script(bag, start, duration)
    fixes = sum(topic == '/fix' for _, topic, _, _ in script)
    with Listener() as listener, running_node([*overrides(parameters), *RELIABLE]):
        listener.wait_for(lambda: listener.statuses)  # we have found each other
        play(script, tmp_path, RATE)
        listener.wait_for(lambda: listener.count('fix') == fixes)
        listener.wait_for_next_status()

    # Every attitude that was declared, and nothing that was not.
    declared = [row for before, row in zip(rows, rows[1:])
                if row['state'] == 'ALIGNED' != before['state']
                and int(row['stamp_ns']) <= int(listener.status['stamp_ns'])]
    assert declared
    assert len(listener.attitudes) == len(declared)
    for attitude, row in zip(listener.attitudes, declared):
        q = attitude.quaternion
        cosine = abs(np.dot([q.x, q.y, q.z, q.w],
                            [float(row[each]) for each in ('qx', 'qy', 'qz', 'qw')]))
        assert int(rows[0]['stamp_ns']) <= stamp_ns(attitude) < int(row['stamp_ns'])
        assert 2.0 * np.degrees(np.arccos(min(cosine, 1.0))) < TOLERANCE_DEG
    # State and sigma on the way, wherever a status was published.
    compared = 0
    for values in map(values_of, listener.statuses):
        row = by_stamp.get(int(values['stamp_ns'] or 0))
        if row is not None and row['sigma_u_deg']:
            sigma = float(values['initial_sigma_east_north_up_deg'].split()[2])
            assert sigma == pytest.approx(float(row['sigma_u_deg']), abs=TOLERANCE_DEG)
            if 'no IMU sample for' not in values['reason']:
                assert values['state'] == row['state']
            compared += 1
    assert compared >= 2
