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
"""The bench: that its pieces run and compare what they say they compare."""

from ins_align.experiments import bench
import pytest

pytest.importorskip('pyins')


def test_medians_of_processes():
    short, long = bench.medians(['-c', 'pass'], ['-c', 'import time; time.sleep(0.5)'])
    assert long > short + 0.3
    with pytest.raises(RuntimeError, match='no such thing'):
        bench.elapsed(['-c', 'import sys; sys.stderr.write("no such thing"); sys.exit(2)'])


def test_rows_have_ratios():
    assert bench.row('x', 1.5, 3.0, 's', '1') == {
        'name': 'x', 'ours': '1.5 s', 'other': '3 s', 'ratio': '0.50', 'target': '1'}


def test_every_epoch_is_timed(monkeypatch):
    monkeypatch.setattr(bench, 'EPOCH_SECONDS', 6.0)
    epochs, memory = bench.epoch_rows()
    assert '30: longest; median' in epochs['name']
    longest, median = (float(epochs[cell].split()[0]) for cell in ('ours', 'other'))
    assert 0.0 < median <= longest
    assert float(memory['ours'].split()[0]) >= float(memory['other'].split()[0]) > 0.0


def test_bare_pass_counts_the_recording(tmp_path, monkeypatch):
    monkeypatch.setattr(bench, 'REPEATS', 1)
    row = bench.replay_against_bare_pass(tmp_path, 'mcap', 0.25)
    assert row['name'] == 'replay of 0.25 min, mcap; bare pass'
    assert all(float(row[cell].split()[0]) > 0.0 for cell in ('ours', 'other', 'ratio'))
