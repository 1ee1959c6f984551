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
"""Arrays: `align` against the truth, against replay, with tables of every form; public names."""

from dataclasses import replace
import json
from pathlib import Path
import re
import subprocess
import sys

from alignment import error_of, normalised_error, simulated
import ins_align
from ins_align.config import ConfigError, PRESETS
from ins_align.offline import replay
from ins_align.results import State
from ins_align.simulation.simulate import write_bag
import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

LEVER = {'lever_arm': (1.0, 1.0, 1.0)}


@pytest.fixture(scope='module')
def flight():
    return simulated('flight', duration=30.0, seed=1)


def tables(s, spread=''):
    """Return fixes and velocities of a simulation as tables, stamps in ns."""
    noises = s.position_covariance, s.velocity_covariance
    result = []
    for values, noise in zip((s.lla_deg, s.velocity), noises):
        columns = [s.gnss_stamps_ns[:, None], values]
        if spread == 'std':
            columns.append(np.tile(np.sqrt(np.diag(noise)), (len(values), 1)))
        elif spread == 'covariance':
            columns.append(np.tile(noise.ravel(), (len(values), 1)))
        result.append(np.hstack(columns))
    return result


def imu(s):
    return s.imu_stamps_ns, s.gyro, s.accel


@pytest.fixture(scope='module')
def result(flight):
    fixes = [flight.fix(k) for k in range(len(flight.gnss_stamps_ns))]
    velocities = [flight.velocity_measurement(k) for k in range(len(flight.gnss_stamps_ns))]
    return ins_align.align(*imu(flight), fixes, velocities, **LEVER)


def test_attitudes_are_right_and_their_covariances_too(flight, result):
    assert result.aligned and result.status.state is State.ALIGNED
    for attitude in (result.initial, result.current, result.declared):
        assert normalised_error(attitude, flight) < chi2.ppf(0.9999, 3)
    assert result.initial.stamp_ns == result.status.t0_ns
    assert result.current.stamp_ns == result.epochs[-1].stamp_ns
    assert len(result.epochs) == len(flight.gnss_stamps_ns)
    declared = result.to_json()['declared_attitude']
    assert declared['stamp'] == result.declared.stamp_ns
    assert declared['quaternion_xyzw'] == result.declared.quaternion_xyzw.tolist()


def test_it_is_what_replay_says(flight, result, tmp_path):
    write_bag(flight, tmp_path / 'flight')
    replayed = replay(tmp_path / 'flight', result.config)
    assert replayed.to_csv() == result.to_csv()
    assert {**replayed.to_json(), 'bag': None} == {**result.to_json(), 'bag': None}


@pytest.mark.parametrize('spread', ['std', 'covariance'])
def test_tables_are_what_fixes_and_velocities_are(flight, result, spread):
    """In nanoseconds a float has room for 256 of them, which at 30 m/s are 8 um."""
    other = ins_align.align(*imu(flight), *tables(flight, spread), **LEVER)
    assert np.allclose(other.current.C_nb, result.current.C_nb, atol=1e-6)
    assert np.allclose(other.current.covariance, result.current.covariance, rtol=1e-6, atol=1e-12)


def test_stamps_in_seconds(flight, result):
    stamps, gyro, accel = imu(flight)
    origin = int(stamps[0])
    fixes, velocities = tables(flight, 'std')
    for table in (fixes, velocities):
        table[:, 0] = (flight.gnss_stamps_ns - origin) * 1e-9
    other = ins_align.align((stamps - origin) * 1e-9, gyro, accel, fixes, velocities, **LEVER)
    assert other.current.stamp_ns == result.current.stamp_ns - origin
    assert np.allclose(other.current.C_nb, result.current.C_nb, atol=1e-6)


def test_covariances_that_are_not_known(flight):
    """Four columns are what messages are whose covariance is not known, and no less honest."""
    numbers = range(len(flight.gnss_stamps_ns))
    unknown = ins_align.align(
        *imu(flight), [flight.fix(k)._replace(covariance=None) for k in numbers],
        [flight.velocity_measurement(k)._replace(covariance=None) for k in numbers], **LEVER)
    plain = ins_align.align(*imu(flight), *tables(flight), **LEVER)
    assert np.allclose(plain.current.C_nb, unknown.current.C_nb, atol=1e-6)
    assert np.allclose(plain.current.covariance, unknown.current.covariance, rtol=1e-5)
    assert normalised_error(plain.current, flight) < chi2.ppf(0.9999, 3)


def test_velocities_north_east_down(flight, result):
    fixes, velocities = tables(flight, 'std')
    ned = velocities[:, [0, 2, 1, 3, 5, 4, 6]] * [1, 1, 1, -1, 1, 1, 1]
    other = ins_align.align(*imu(flight), fixes, ned, velocity_frame='ned', **LEVER)
    assert np.allclose(other.current.C_nb, result.current.C_nb, atol=1e-6)


def test_positions_alone():
    s = simulated('car', duration=60.0, seed=1, position_std=0.02)
    alone = ins_align.align(*imu(s), tables(s, 'std')[0], None, **LEVER)
    assert alone.aligned and 'velocity' not in alone.status.counts
    assert np.all(np.abs(error_of(alone.current, s))
                  < 4 * np.sqrt(np.diag(alone.current.covariance)))


def test_rows_with_nan_are_left_out_and_counted(flight):
    stamps, gyro, accel = imu(flight)
    gyro = np.where(np.arange(len(gyro))[:, None] % 100 == 50, np.nan, gyro)
    fixes, velocities = tables(flight, 'std')
    fixes[::10, 1], velocities[::15, 2] = np.nan, np.nan
    spoilt = ins_align.align(stamps, gyro, accel, fixes, velocities, **LEVER)
    counts = spoilt.status.counts
    assert counts['imu_nan'] == np.isnan(gyro[:, 0]).sum()
    assert counts['fix_nan'] == len(fixes[::10])
    assert counts['velocity_nan'] == len(velocities[::15])
    assert normalised_error(spoilt.current, flight) < chi2.ppf(0.9999, 3)


def test_clocks_may_be_as_far_apart_as_gnss_delay_says(flight):
    fixes, velocities = tables(flight, 'std')
    fixes[:, 0], velocities[:, 0] = fixes[:, 0] + 50e9, velocities[:, 0] + 50e9
    assert ins_align.align(*imu(flight), fixes, velocities, gnss_delay=50.0, **LEVER).aligned


def test_what_is_no_number_gets_a_sentence(flight):
    times, fixes = pd.to_datetime(flight.imu_stamps_ns), pd.DataFrame(tables(flight, 'std')[0])
    of_times = fixes.assign(stamp=pd.to_datetime(fixes[0]))
    for stamps, given in ((list(times), fixes), (flight.imu_stamps_ns, of_times)):
        with pytest.raises(ValueError, match='must be numbers .* times are seconds, or integer'):
            ins_align.align(stamps, *imu(flight)[1:], given, None, **LEVER)


def test_a_frame_without_rows_has_no_messages(flight):
    empty = pd.DataFrame({'stamp': [], 'latitude': [], 'longitude': [], 'altitude': []})
    result = ins_align.align(*imu(flight), empty, None, **LEVER)
    assert 'no GNSS position yet' in result.status.reason


def test_a_masked_stamp_of_the_imu_is_refused(flight):
    stamps, gyro, accel = imu(flight)
    masked = np.ma.masked_array(stamps, np.arange(len(stamps)) == 7)
    with pytest.raises(ValueError, match='none of them masked'):
        ins_align.align(masked, gyro, accel, *tables(flight, 'std'), **LEVER)


def test_what_is_masked_is_left_out_as_nan_is(flight):
    stamps, gyro, accel = imu(flight)
    arrays = [gyro, accel, *tables(flight, 'std')]
    with_nan, masked = ([array.copy() for array in arrays] for _ in range(2))
    for k, (nan, mask) in enumerate(zip(with_nan, masked)):
        nan[20 + k::50, 1], mask[20 + k::50, 1] = np.nan, 40.0
        masked[k] = np.ma.masked_array(mask, mask == 40.0)
    results = [ins_align.align(stamps, *each, **LEVER) for each in (with_nan, masked)]
    assert results[0].to_json() == results[1].to_json()
    assert results[1].status.counts['velocity_nan'] == 3


@pytest.mark.parametrize('seed', [0, 1])
def test_a_robot_on_a_flat_floor(seed):
    """Roll and pitch never change, so nothing shows the signs of two gyros: that does no harm."""
    rate, random = 100, np.random.default_rng(seed)
    t = np.arange(40 * rate) / rate
    turn = np.radians(30.0) * np.sin(2 * np.pi * t / 17) * (t > 5)
    speed = 4.0 * (0.6 + 0.4 * np.sin(2 * np.pi * t / 23)) * np.clip((t - 3) / 2, 0, 1)
    yaw = np.cumsum(turn) / rate + random.uniform(-3.0, 3.0)
    zero = np.zeros(t.size)
    gyro = np.stack([zero, zero, turn], axis=1)
    accel = np.stack([np.gradient(speed, 1 / rate), speed * turn, zero + 9.81], axis=1)
    mems = PRESETS['mems']
    for sensor, bias, walk in ((gyro, mems.gyro_bias_std, mems.angle_random_walk),
                               (accel, mems.accel_bias_std, mems.velocity_random_walk)):
        sensor += bias * random.standard_normal(3)
        sensor += walk * np.sqrt(rate) * random.standard_normal(sensor.shape)
    v_n = np.stack([speed * np.cos(yaw), speed * np.sin(yaw), zero], axis=1)
    degrees = np.degrees(np.cumsum(v_n[:, :2], axis=0) / rate / 6.38e6)
    epochs = slice(None, None, 20)
    fixes = np.column_stack([t, 48 + degrees[:, 1], 11 + degrees[:, 0] / 0.669, zero])[epochs]
    velocities = np.column_stack([t, v_n + 0.05 * random.standard_normal(v_n.shape),
                                  np.full((t.size, 3), 0.05)])[epochs]
    result = ins_align.align(t, gyro, accel, fixes, velocities, lever_arm_std=0.05)
    assert result.aligned, result
    heading = np.degrees(yaw[round(result.current.stamp_ns * 1e-9 * rate)])
    error = (result.current.yaw_deg - heading + 180.0) % 360.0 - 180.0
    assert abs(error) < 4.0 * result.current.sigma_deg[2]


def test_an_outage_is_in_the_epochs():
    s = simulated('car', duration=40.0, seed=2, outages=((20.0, 30.0),))
    epochs = ins_align.align(*imu(s), *tables(s, 'std'), **LEVER).epochs
    dry = [epoch for epoch in epochs if epoch.dry]
    assert 3 <= len(dry) <= 5 and all(19.0 < epoch.t_s < 31.0 for epoch in dry)
    times = [epoch.stamp_ns for epoch in epochs]
    assert times == sorted(times)


def test_samples_that_overtook_others_are_put_in_order(flight, result):
    stamps, gyro, accel = (array.copy() for array in imu(flight))
    for array in (stamps, gyro, accel):
        array[1000:1050] = array[1000:1050][::-1].copy()
    other = ins_align.align(stamps, gyro, accel, *tables(flight, 'std'), **LEVER)
    assert other.status.counts['imu_out_of_order'] == 49
    assert np.allclose(other.current.C_nb, result.current.C_nb, atol=1e-6)


def test_result_is_told_in_some_words(flight, result):
    text = repr(result)
    assert text == str(result) and len(text) < 300 and '\n' not in text
    now = result.current
    assert text.startswith('Result(ALIGNED after ')
    assert f'heading {now.heading_deg:.2f} +- {now.sigma_deg[2]:.2f} deg' in text
    assert f'roll {now.roll_deg:.2f}' in text and '150 epochs' in text
    assert f'stamp {now.stamp_ns}' in text
    nothing = ins_align.align([], np.zeros((0, 3)), np.zeros((0, 3)), [])
    assert repr(nothing) == 'Result(WAITING_FOR_IMU, no attitude, 0 epochs)'


def test_units_that_are_wrong_are_named():
    car = simulated('car', duration=30.0, seed=2)
    stamps, gyro, accel = imu(car)
    wrong = ins_align.align(stamps, np.degrees(gyro), accel, *tables(car, 'std'), **LEVER)
    assert not wrong.aligned and 'deg/s' in wrong.status.reason
    change = wrong.to_json()['changes'][-1]
    assert change['state'] == 'FAULT' and 'deg/s' in change['reason']


@pytest.mark.parametrize('off', [-18.0, 3.0])
def test_a_clock_that_is_off_is_told_from_the_motion(off):
    """Arrays have no order of arrival that would show it: GPS time, UTC, a wrong second."""
    s = simulated('car', duration=120.0, seed=2)
    fixes, velocities = tables(s)
    for table in fixes, velocities:
        table[:, 0] += off * 1e9
    result = ins_align.align(*imu(s), fixes, velocities, **LEVER)
    assert not result.aligned
    delay = re.match(r'the motion fits GNSS stamps that are (.+) s late: check the clocks, '
                     r'or set gnss_delay=\1; ', result.status.reason)[1]
    assert float(delay) == pytest.approx(off, abs=0.05)
    again = ins_align.align(*imu(s), fixes, velocities, **LEVER, gnss_delay=float(delay))
    assert again.aligned and normalised_error(again.current, s) < chi2.ppf(0.9999, 3)


def test_no_delay_is_told_where_the_clock_is_right(flight):
    fixes, velocities = tables(flight)
    reason = ins_align.align(*imu(flight), fixes, velocities, **LEVER,
                             heading_std_threshold=0.01).status.reason
    assert 'heading sigma' in reason and 'gnss_delay' not in reason


def test_no_data():
    nothing = np.zeros((0, 3))
    result = ins_align.align(np.zeros(0), nothing, nothing, [])
    assert result.status.state is State.WAITING_FOR_IMU and result.epochs == ()
    assert result.initial is None and result.current is None and not result.aligned


@pytest.mark.parametrize('change, message', [
    ({'gyro': np.zeros((5, 3))}, r'gyro has the shape \(5, 3\)'),
    ({'accel': np.zeros(3001)}, r'accel has the shape \(3001,\)'),
    ({'fixes': np.zeros((5, 3))}, r'fixes have the shape \(5, 3\).*latitude'),
    ({'velocities': np.zeros((5, 8))}, r'velocities have the shape \(5, 8\).*north'),
    ({'fixes': np.full((5, 4), np.nan)}, 'stamps of fixes must be seconds'),
    ({'stamps': np.arange(3001.0) + 1.7e18}, 'stamps of the IMU must be seconds'),
    ({'velocities': np.outer(np.arange(30.0), [0.2, 0.1, 0.1, 0.0])},
     'stamps of velocities must be nanoseconds'),
    ({'fixes': np.outer(np.arange(30.0), [1e6, 1e-6, 0.0, 0.0])},
     'stamps of fixes must be nanoseconds'),
    ({'stamps': np.arange(3001) * 10.0}, 'are 10 s apart, .*: its stamps must be seconds'),
    ({'stamps': np.roll(np.arange(3001) * 10_000_000, 1200)},
     'IMU go back by 30 s at row 1200: sort all its rows by stamp'),
    ({'stamps': np.arange(3001) * 10_000_000},
     r'fixes \(175\d+\.\d+ to .*\(0\.000 to 30\.000 s\) have no time in common: .* one clock'),
    ({'fixes': [], 'stamps': 10 ** 18 + np.arange(3001) * 10_000_000},
     'stamps of velocities .* have no time in common'),
])
def test_wrong_arrays_end_in_a_sentence(flight, change, message):
    stamps, gyro, accel = imu(flight)
    fixes, velocities = tables(flight)
    arguments = {'stamps': stamps, 'gyro': gyro, 'accel': accel, 'fixes': fixes,
                 'velocities': velocities, **change}
    with pytest.raises(ValueError, match=message):
        ins_align.align(**arguments)


def test_wrong_parameters_end_in_a_sentence(flight):
    with pytest.raises(ConfigError, match='did you mean lever_arm'):
        ins_align.align(*imu(flight), *tables(flight), lever_arms=(1.0, 1.0, 1.0))
    for needs_tf in ({'base_frame': 'base_link'}, {'lever_arm_from_tf': True}):
        with pytest.raises(ConfigError, match='which arrays do not have'):
            ins_align.align(*imu(flight), *tables(flight), **needs_tf)


def test_every_public_name_is_there():
    for name in ins_align.__all__:
        assert getattr(ins_align, name).__name__ == name
        assert name in dir(ins_align)
    assert not hasattr(ins_align, 'nothing')


def test_the_package_imports_what_is_used():
    code = ('import sys, ins_align; print(*sys.modules); ins_align.align; print(*sys.modules)')
    alone, aligning = subprocess.run([sys.executable, '-c', code], check=True, text=True,
                                     capture_output=True).stdout.splitlines()
    assert 'numpy' not in alone.split()
    assert not {'rosbags', 'scipy', 'matplotlib', 'rclpy'} & set(aligning.split())


def test_the_example_of_the_readme_runs(flight, tmp_path, monkeypatch, capsys):
    text = (Path(__file__).parents[1] / 'README.md').read_text(encoding='utf-8')
    code, = re.findall(r'```python\n(.*?)```', text, re.DOTALL)
    fixes, velocities = tables(flight)
    seconds = (flight.imu_stamps_ns - flight.imu_stamps_ns[0]) * 1e-9
    for table in (fixes, velocities):
        table[:, 0] = (flight.gnss_stamps_ns - flight.imu_stamps_ns[0]) * 1e-9
    for name, table in (('imu', np.column_stack([seconds, flight.gyro, flight.accel])),
                        ('fix', fixes), ('velocity', velocities)):
        np.savetxt(tmp_path / f'{name}.csv', table, delimiter=',')
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code, 'README.md', 'exec'), names)
    told, reason = capsys.readouterr().out.splitlines()
    assert told.startswith('Result(ALIGNED after') and reason.startswith('heading sigma')
    assert names['result'].aligned


def test_the_notebook_runs(tmp_path, monkeypatch, capsys):
    """Its numbers are those of the simulation: a nose that points 8 deg left of the course."""
    pytest.importorskip('matplotlib').use('Agg')
    path = Path(__file__).parents[1] / 'docs' / 'notebooks' / 'align.ipynb'
    cells = json.loads(path.read_text(encoding='utf-8'))['cells']
    monkeypatch.chdir(tmp_path)
    names = {}
    for number, cell in enumerate(cells):
        if cell['cell_type'] == 'code':
            exec(compile(''.join(cell['source']), f'cell {number}', 'exec'), names)
    names['plt'].close('all')
    assert names['result'].aligned
    assert normalised_error(
        replace(names['result'].current,
                stamp_ns=names['result'].current.stamp_ns + int(names['start_ns'])),
        names['flight']) < chi2.ppf(0.9999, 3)
    said = re.search(r'points (\S+) deg left', capsys.readouterr().out)[1]
    assert float(said) == pytest.approx(8.0, abs=1.5)
