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
"""The experiments: small runs whose numbers are known, and the errors a user can make."""

from concurrent.futures.process import BrokenProcessPool
import itertools
import json
import math
import os

from ins_align import experiments
from ins_align.aligner import Aligner, Attitude, State
from ins_align.config import PRESETS
from ins_align.experiments import bound, common, declare, dense, recordings, weak_spots
from ins_align.experiments.spoilt import stream_of
from ins_align.geometry.rotation import exp_so3, matrix_from_rpy
from ins_align.simulation.simulate import simulate, write_bag
import numpy as np
import pytest

pytest.importorskip('pyins')


def square(number):
    """Return a square; another process can import this."""
    return number * number


def test_parallel_keeps_the_order_in_any_number_of_processes():
    tasks = list(range(7))
    for jobs in (1, 2):
        assert common.parallel(square, [tasks, [], tasks[:2]], jobs) == [
            [n * n for n in tasks], [], [0, 1]]


def leave(status):
    """End the process."""
    os._exit(status)


def test_parallel_ends_with_whoever_fails():
    for jobs in (1, 2):
        with pytest.raises(TypeError):
            common.parallel(square, [[1, None, 2]], jobs)
    with pytest.raises(BrokenProcessPool):
        common.parallel(leave, [[1, 1]], 2)


def test_error_is_counted_in_stated_sigmas():
    C = matrix_from_rpy([0.1, -0.2, 2.0])
    phi = np.radians([0.2, -0.6, 3.0])
    sigma = np.radians([0.1, 0.2, 1.0])
    attitude = Attitude(1, exp_so3(-phi) @ C, np.diag(sigma ** 2))
    error = common.error_of(attitude, C)
    assert error['angles_deg'] == pytest.approx(np.degrees(phi))
    assert error['tilt_deg'] == pytest.approx(math.hypot(0.2, 0.6))
    assert error['heading_deg'] == pytest.approx(3.0)
    assert error['tilt_sigmas'] == pytest.approx(3.0)
    assert error['heading_sigmas'] == pytest.approx(3.0)
    assert error['nees'] == pytest.approx(4 + 9 + 9)
    wider = common.error_of(attitude, C, np.array([0.0, 0.0, math.sqrt(8.0)]))
    assert wider['heading_sigmas'] == pytest.approx(1.0)


def test_exact_model_is_that_of_the_simulation():
    simulation = simulate('flight', imu_grade='tactical', duration=5.0)
    assert common.exact_config_for(simulation).imu_noise == pytest.approx(
        PRESETS['tactical']._replace(gyro_scale_std=0.0, rate_random_walk=0.0))


def test_bound_is_reached_on_a_navigation_grade_flight(monkeypatch):
    monkeypatch.setattr(bound, 'TIMES', (10.0, 14.0, 20.0))
    case = bound.CASES[0]
    case = case._replace(simulate={'duration': 20.5})
    limits = common.bound_of(case)
    runs = [bound.run_exact((case, seed)) for seed in range(4)]
    results = bound.results_of(case, limits, runs)
    assert results[0]['heading_bound_deg'] == pytest.approx(0.245, abs=0.01)
    # Four runs, three angles: the mean of twelve squares is within 0.2 and 2.5.
    assert all(0.2 < result['nees'] < 2.5 for result in results)
    assert all(result['heading_ratio'] < 2.0 for result in results)
    assert bound.target_row('velocity', results)['heading met'] == sum(
        result['heading_ratio'] <= 1.1 for result in results)


def test_bound_refuses_what_it_does_not_know():
    with pytest.raises(ValueError, match='constant biases'):
        dense.bound(simulate('car', imu_grade='chip', duration=2.0))


def test_time_at_which_the_bound_crosses(monkeypatch):
    monkeypatch.setattr(declare, 'HORIZON', 10.0)
    flight, straight, unknown = (declare.crossing_time(declare.time_case(*kind)) for kind in (
        ('flight', 'navigation', True), ('straight', 'mems', True),
        ('flight', 'navigation', False)))
    assert flight == pytest.approx(5.4, abs=0.3) and flight < unknown
    assert straight is None


def test_draws_are_repeatable_and_cover_everything():
    combinations = len(declare.FAULTS) * len(declare.CAMPAIGN_SCENARIOS) * len(declare.GRADES)
    drawn = [declare.draw(index) for index in range(combinations)]
    assert drawn[5] == declare.draw(5)
    assert len({case[:2] for case in drawn}) == combinations


def test_every_combination_of_faults_is_drawn_once():
    names = {fault for combination in declare.COMBINATIONS for fault in combination}
    assert names == set(declare.WORSE)
    seeds = range(len(declare.COMBINATIONS) * len(declare.CAMPAIGN_SCENARIOS))
    drawn = [declare.draw_worse(seed) for seed in seeds]
    assert drawn[7] == declare.draw_worse(7)
    assert len({case[:2] for case in drawn}) == len(drawn)


def test_imus_worse_than_configured(tmp_path, monkeypatch):
    monkeypatch.setattr(declare, 'DURATION', 16.0)
    monkeypatch.setattr(declare, 'STAND_STILL', 0.0)
    case = next(case for case in map(declare.draw_worse, range(500))
                if case[:2] == ('none', (('car', 'mems'),)))
    worse = case._replace(simulate=case.simulate | declare.WORSE['noise x 3'])
    clean, again, noisy = (common.run_case((each, 5)) for each in (case, case, worse))
    assert clean == again
    assert clean['levelled'][0]['tilt_sigmas'] < 5
    assert noisy['levelled'] != clean['levelled']
    experiments.run('declare-worse', tmp_path, runs=2, jobs=1)
    assert 'First declared ALIGNED' in (tmp_path / 'declare-worse.md').read_text('utf-8')
    assert len(json.loads((tmp_path / 'declare-worse.json').read_text())['runs']) == 2


def test_settings_are_configured_as_they_are(tmp_path, monkeypatch):
    monkeypatch.setattr(declare, 'DURATION', 16.0)
    cases = [declare.draw_settings(seed) for seed in range(192)]
    assert len({case.name for case in cases}) == 16
    off = [(np.array(case.config['lever_arm']) - case.simulate['lever_arm'])
           / case.config['lever_arm_std'] for case in cases]
    assert 0.9 < np.std(off) < 1.1
    short = next(case for case in cases if 'horizontal' in case.name
                 and not case.spoil.keywords['stated'] and not case.simulate['stand_still'])
    _, stream, aligner = common.prepare(short, 0)
    assert not stream.velocity['covariance'].any() and not stream.fix['covariance_type'].any()
    assert not stream.velocity['velocity'][:, 2].any()
    assert aligner.config.velocity_vertical == 'absent'
    assert aligner.config.lever_arm == short.config['lever_arm']
    monkeypatch.setattr(declare, 'draw_settings', lambda seed: short)
    experiments.run('settings', tmp_path, runs=2, jobs=1)
    found = json.loads((tmp_path / 'settings.json').read_text('utf-8'))['runs']
    assert [run['name'] for run in found] == 2 * [short.name]


def test_shares_beyond_the_limits():
    def result(sigma):
        return {'levelled': [{'t_s': 4.0, 'tilt_sigmas': sigma, 'heading_sigmas': 0.5,
                              'tilt_deg': 0.2, 'heading_deg': 0.7}]}

    def cells(*sigmas):
        runs = [*map(result, sigmas), {'levelled': []}]
        return [*common.event_row('name', runs, 'levelled').values()]

    assert cells(1.0, 4.0) == ['name', 3, 2, '4.0', '1 (50.0 %)', '0 (0.0 %)', '4.0', '0.2',
                               '0 (0.0 %)', '0 (0.0 %)', '0.5', '0.7']
    assert cells(6.0)[4:6] == ['1 (100.0 %)', '1 (100.0 %)']
    assert cells()[2:] == [0] + [None] * 9


def test_a_declared_run_is_judged_against_the_truth(monkeypatch):
    monkeypatch.setattr(declare, 'DURATION', 20.0)
    index = next(index for index, case in enumerate(map(declare.draw, range(500)))
                 if case[:2] == ('none', (('flight', 'navigation'),)))
    result = common.run_case((declare.draw(index), index))
    assert result['state'] == State.ALIGNED.value
    for moment in ('levelled', 'declared', 'final'):
        assert common.worst(result[moment]) < 5
    assert 0.0 < result['final'][0]['heading_sigmas'] <= common.worst(result['final'])


def test_note_with_and_without_lever_arm():
    end = {}
    for case in bound.NOTE_CASES[:3]:
        short = case._replace(simulate={**case.simulate, 'duration': 12.0})
        end[case.name.partition(': ')[2]] = np.array([
            bound.run_exact((short, seed))['rpy_deg'][-1] for seed in range(3)])
    assert bound.rms(end['compensated'][:, 2]) < 1.0
    # With its term the lever arm is as if it were not there, without it is not.
    same = np.linalg.norm(end['compensated'] - end['zero lever arm'])
    assert same < 0.1 * np.linalg.norm(end['not compensated'] - end['zero lever arm'])


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Two recordings, one of them without velocities to speak of."""
    place = tmp_path_factory.mktemp('data')
    for name, scenario in (('driven', 'car'), ('hovering', 'hover')):
        write_bag(simulate(scenario, duration=32.0, lever_arm=(0.0, 0.0, 0.0), seed=1),
                  place / name)
    return place


def test_window_of_a_recording_against_its_reference(folder):
    path = folder / 'driven'
    assert recordings.recordings_in(folder) == [path, folder / 'hovering']
    recording = recordings.load(path)
    assert recording.duration == pytest.approx(32.0, abs=0.1)
    window = recordings.run_window((path, 2.0, 25.0, {}))
    assert window['moves'] and not window['covers_minute']
    [first] = window['first']
    assert first['heading_sigmas'] < 5 and 0.0 < first['t_s'] <= window['declared_s']
    assert window['worst_sigmas'] < 5 and window['beyond'][1] == window['beyond_s'] == 0
    assert window['epochs'] == pytest.approx(5 * 25.0 * window['aligned_part'], abs=5)
    assert window['at'] == {}
    hovering = recordings.run_window((folder / 'hovering', 0.0, 31.0, {}))
    assert not hovering['moves']
    late = hovering['at']['30']
    assert late['t_s'] == pytest.approx(30.0, abs=0.5) and late['tilt_deg'] < 1.0


def test_recordings_and_their_files(folder, tmp_path, capsys):
    (tmp_path / 'data').mkdir()
    (tmp_path / 'data' / 'driven').symlink_to(folder / 'driven')
    experiments.run('recordings', tmp_path, data_dir=tmp_path / 'data', jobs=1)
    text = (tmp_path / 'recordings.md').read_text('utf-8')
    assert 'ins_align experiment recordings --out DIR --data DIR' in text
    assert 'driven, bank' in text
    numbers = json.loads((tmp_path / 'recordings.json').read_text('utf-8'))
    assert [window['start_s'] for window in numbers['driven, bank']] == [0.0, 10.0, 20.0]
    assert 'heading at 30 s' in capsys.readouterr().out


def test_every_weak_spot_is_one_of_its_own():
    s = simulate('car', imu_rate=50.0, duration=100.0, seed=1, velocity_std_vertical=1.0)
    whole = stream_of(s)
    for spot in weak_spots.SPOTS:
        stream = stream_of(s)
        if spot.spoil is not None:
            spot.spoil(stream, np.random.default_rng(1))
            assert stream.config != whole.config or any(
                getattr(stream, name).tobytes() != getattr(whole, name).tobytes()
                for name in ('imu', 'fix', 'velocity')), spot.name
        else:
            assert len(spot.simulate) > 1 or spot.config or 'nothing wrong' in spot.name
    assert len({spot.name for spot in weak_spots.SPOTS}) == len(weak_spots.SPOTS)


def test_weak_spots_are_judged_by_the_clock_of_the_imu():
    s = simulate('flight', imu_grade='mems', duration=40.0, seed=1)
    for by_ns in (0, 3_600_000_000_000):
        stream = stream_of(s)
        for rows in stream.imu, stream.fix, stream.velocity:
            rows['stamp'] += by_ns
        stream.stamp_imu(stream.imu['stamp'])

        def judged(turned=np.eye(3)):
            epochs = list(itertools.chain(*common.follow(
                Aligner(common.config_for(s)), stream)))
            return epochs[-1].state, common.while_aligned(
                epochs, stream.start_ns,
                lambda stamps: turned @ s.attitude_at(stream.true_stamps(stamps)))

        state, result = judged()
        assert state is State.ALIGNED and 0.0 < result['worst_sigmas'] < 5.0
        assert result['beyond_s'] == 0.0 and 0.3 < result['aligned_part'] < 0.9
        _, wrong = judged(exp_so3(np.radians([0.0, 0.0, 20.0])))
        assert common.worst(wrong['first']) > 10.0 and 15.0 < wrong['worst_heading_deg'] < 25.0
        assert wrong['beyond_s'] == pytest.approx(40.0 - wrong['declared_s'], abs=0.5)


def test_weak_spots_and_their_files(tmp_path, monkeypatch):
    chosen = ('nothing wrong', 'GNSS stays away after 60 s', 'gyro x alone reversed, launch',
              'IMU losses of 50 to 600 ms, attitude between epochs')
    monkeypatch.setattr(weak_spots, 'SPOTS', [
        spot._replace(simulate={**spot.simulate, 'duration': {90.0: 40.0}.get(
            spot.simulate['duration'], spot.simulate['duration'])})
        for spot in weak_spots.SPOTS if spot.name in chosen])
    experiments.run('weak-spots', tmp_path, runs=1, jobs=1)
    assert 'weak-spots --out DIR --runs 1' in (tmp_path / 'weak-spots.md').read_text('utf-8')
    found = json.loads((tmp_path / 'weak-spots.json').read_text('utf-8'))['cases']
    assert len(found) == len(chosen) and all(len(runs) == 1 for runs in found.values())
    right, away, between, reversed_ = (runs[0] for runs in found.values())
    assert right['state'] == 'ALIGNED' and right['worst_sigmas'] < 5.0
    assert away['state'] != 'ALIGNED' and 0.1 < away['aligned_part'] < 0.9
    assert between['worst_sigmas'] < 5.0 and reversed_['declared_s'] is None


def test_vehicle_and_the_recorded_car(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(weak_spots, 'VEHICLE_SPOTS', weak_spots.VEHICLE_SPOTS[:1])
    monkeypatch.setattr(weak_spots, 'RECORDING', 'driven')
    monkeypatch.setattr(recordings, 'STEP', 30.0)
    experiments.run('vehicle', tmp_path, folder, runs=1, jobs=1)
    text = (tmp_path / 'vehicle.md').read_text('utf-8')
    assert 'vehicle --out DIR --runs 1 --data DIR' in text and 'started anew every 30 s' in text
    recorded = json.loads((tmp_path / 'vehicle.json').read_text('utf-8'))['recorded']
    assert [len(windows) for windows in recorded.values()] == [1, 1, 1]
    assert recorded['vehicle: car'][0]['state'] == 'ALIGNED'


@pytest.mark.parametrize('arguments, reason', [
    ({'name': 'nonsense'}, 'there are note, bound'),
    ({'name': 'recordings'}, '--data DIR'),
    ({'name': 'bound', 'runs': 0}, 'at least 1'),
    ({'name': 'bound', 'data_dir': '/no/such/place'}, 'no directory'),
])
def test_what_cannot_be_run_is_said(tmp_path, arguments, reason):
    with pytest.raises(experiments.ExperimentError, match=reason):
        experiments.run(out_dir=tmp_path, **arguments)


def test_a_folder_without_recordings_is_said(tmp_path):
    with pytest.raises(experiments.ExperimentError, match='no recording'):
        experiments.run('recordings', tmp_path, data_dir=tmp_path)
