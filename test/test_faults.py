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
"""The fault campaign: a run of every fault, and that it sees what it looks for."""

from functools import cache
import itertools
import json

from ins_align import experiments
from ins_align.aligner import Aligner
from ins_align.experiments import common, faults
import numpy as np
import pytest

pytest.importorskip('pyins')


@pytest.fixture
def short(monkeypatch):
    """Make runs short."""
    monkeypatch.setattr(faults, 'DURATION', 12.0)


@cache
def indices():
    """Return the first run of each kind."""
    return {faults.draw(index)[:2]: index for index in reversed(range(1000))}


def index_of(fault):
    return indices()[fault, (('flight', 'navigation'),)]


def test_draws_are_repeatable_and_cover_everything():
    combinations = len(faults.FAULTS) * len(faults.CAMPAIGN_SCENARIOS) * len(faults.GRADES)
    drawn = [faults.draw(index) for index in range(combinations)]
    again = faults.draw(5)._replace(spoil=drawn[5].spoil)
    assert drawn[5] == again
    assert combinations <= 1000
    assert len({case[:2] for case in drawn}) == combinations


ALIGNED = ('none', 'status unknown', 'covariance 0, -1, nan', 'covariance too small',
           'GNSS up to 1 s late', 'IMU twice', 'IMU out of order',
           'vertical absent, told', 'clock loops', 'updates at random')
NOT_ALIGNED = 'accelerations in g', 'rates in deg/s', 'GNSS clock far off'


@pytest.mark.parametrize('fault', faults.FAULTS)
def test_nothing_breaks_and_what_can_be_aligned_is(short, fault):
    result = faults.run_watched(index_of(fault))
    assert not result['exception']
    assert not result['non_finite'] and not result['warnings']
    assert result['miscounted'] == []
    assert 0 < result['held'] < faults.MAX_HELD
    if fault in ALIGNED:
        assert result['final']
        assert 0.0 < faults.error(result) < 5.0
        assert result['beyond_s'] == 0.0
    if fault in NOT_ALIGNED:
        assert result['declared'] == []


@pytest.mark.parametrize('fault', ['clock back 1 h', 'clock forward 1 h'])
def test_truth_follows_the_clock(monkeypatch, fault):
    monkeypatch.setattr(faults, 'DURATION', 40.0)
    result = faults.run_watched(index_of(fault))
    assert len(result['declared']) == 2 and result['final']
    assert faults.error(result) < 5.0


def spoil(monkeypatch, name, value):
    """Let the aligner of a run have a bug."""
    class Spoilt(Aligner):
        pass
    setattr(Spoilt, name, value)
    monkeypatch.setattr(common, 'Aligner', Spoilt)


def test_an_exception_is_seen(short, monkeypatch):
    def update(aligner):
        raise ZeroDivisionError('seen')
    spoil(monkeypatch, 'update', update)
    result = faults.run_watched(index_of('none'))
    assert 'ZeroDivisionError: seen' in result['exception']
    row = faults.row_of('x', [result])
    assert row['runs'] == row['exceptions'] == 1 and row['declared'] == 0


def test_a_number_that_is_not_finite_is_seen(short, monkeypatch):
    def attitude_now(aligner):
        attitude = Aligner.attitude_now(aligner)
        if attitude is not None:
            attitude.covariance[2, 2] = np.nan
        return attitude
    spoil(monkeypatch, 'attitude_now', attitude_now)
    assert 'now: not finite' in faults.run_watched(index_of('none'))['non_finite']


def test_a_message_that_is_not_counted_is_seen(short, monkeypatch):
    def add_fix(aligner, fix):
        if fix.stamp_ns % 3:
            Aligner.add_fix(aligner, fix)
    spoil(monkeypatch, 'add_fix', add_fix)
    result = faults.run_watched(index_of('none'))
    assert not result['exception']
    assert any('fix is' in text for text in result['miscounted'])


def test_a_wrong_declaration_is_seen(short):
    index = index_of('none')
    simulation, stream, aligner = common.prepare(faults.draw(index), index)
    epochs = list(itertools.chain(*common.follow(aligner, stream)))
    right = common.outcome('none', simulation, stream, aligner, epochs)
    assert faults.error(right) < 5.0
    # The truth of a second later is not that of the stamp.
    stream.clock = (), (-1_000_000_000,)
    result = common.outcome('none', simulation, stream, aligner, epochs)
    assert faults.error(result) > 5.0
    assert result['beyond_s'] > 1.0


def test_tables(short, tmp_path, capsys):
    experiments.run('faults', tmp_path, runs=3, jobs=1)
    text = (tmp_path / 'faults.md').read_text('utf-8')
    assert '`ins_align experiment faults --out DIR --runs 3`' in text
    assert len(json.loads((tmp_path / 'faults.json').read_text('utf-8'))['runs']) == 3
    assert 'What became of it' in capsys.readouterr().out
