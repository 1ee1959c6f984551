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
"""The configuration: every default, every refusal, parameter files and overrides."""

import dataclasses
import math
from pathlib import Path

from ins_align.config import (
    Config, config_from_mapping, ConfigError, load_params, parse_override, PRESETS,
    without_unknown)
import numpy as np
import pytest

FIELDS = dataclasses.fields(Config)
YAML_FILE = Path(__file__).parents[1] / 'config' / 'ins_align.yaml'


def write(path, text):
    path.write_text(text)
    return path


def test_every_parameter_is_described():
    for field in FIELDS:
        line = field.metadata
        assert len(line['description']) > 10, field.name
        if isinstance(field.default, (float, tuple)):
            assert line['unit'], field.name
            assert line['minimum'] < line['maximum'], field.name
        elif field.name not in ('world_frame_id', 'base_frame'):
            assert field.default in line['choices']


def test_run_time_parameters():
    assert {field.name for field in FIELDS if not field.metadata['read_only']} == {
        'heading_std_threshold', 'tilt_std_threshold', 'hold_time'}


def test_yaml_file_lists_every_default():
    values = load_params(YAML_FILE)
    assert list(values) == [field.name for field in FIELDS]
    assert config_from_mapping(values) == Config()


def test_yaml_file_describes_as_the_code_does():
    text = ' '.join(line.strip(' #') for line in YAML_FILE.read_text().splitlines())
    for field in FIELDS:
        line = field.metadata
        assert line['description'] in text, field.name
        if line['unit']:
            assert f'[{line["unit"]}, {line["minimum"]:g} to {line["maximum"]:g}' in text


def test_page_describes_as_the_code_does():
    page = (Path(__file__).parents[1] / 'docs' / 'parameters.md').read_text().split('The presets')
    for field, row in zip(FIELDS, page[0].split('\n| `')[1:], strict=True):
        name, *_, meaning = row.rstrip(' |\n').split(' | ')
        assert name == f'{field.name}`'
        assert meaning.replace('`', '').startswith(field.metadata['description'])


@pytest.mark.parametrize('value', [[1, 2, 3], (1.0, 2.0, 3.0), np.array([1, 2, 3])])
def test_lever_arm_takes_any_three_numbers(value):
    assert Config(lever_arm=value).lever_arm == (1.0, 2.0, 3.0)


@pytest.mark.parametrize('value', [
    [1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [1.0, math.nan, 0.0], [math.inf, 0.0, 0.0], 'abc', 1.0,
    None, ['1', '2', '3'], [True, False, True], {1: 1, 2: 2, 3: 3}, [10 ** 400, 0, 0],
    [2000.0, 0.0, 0.0]])
def test_lever_arm_refused(value):
    with pytest.raises(ConfigError, match='lever_arm'):
        Config(lever_arm=value)


@pytest.mark.parametrize('name, value', [
    ('hold_time', math.nan), ('hold_time', -1.0), ('hold_time', '2'), ('hold_time', True),
    ('hold_time', None), ('heading_std_threshold', 0.0), ('gnss_delay', 61.0),
    ('gnss_delay', 10 ** 400), ('method', 'kalman'), ('method', 1), ('free_start', 1),
    ('free_start', 'maybe'), ('use_velocity', 1), ('use_position', 'yes'),
    ('world_frame_id', ''), ('world_frame_id', '/map'), ('world_frame_id', 'a b'),
    ('world_frame_id', 3)])
def test_value_refused_in_one_line(name, value):
    with pytest.raises(ConfigError, match=name) as info:
        Config(**{name: value})
    assert '\n' not in str(info.value)
    assert len(str(info.value)) < 300


@pytest.mark.parametrize('name, value, sentence', [
    ('gyro_scale_std', 0.7, 'gyro_scale_std must be a finite number from 0 to 0.5, got 0.7'),
    ('gyro_scale_std', 'x', "gyro_scale_std must be a finite number from 0 to 0.5, got 'x'"),
    ('hold_time', -1, 'hold_time must be a finite number in s from 0 to 3600, got -1')])
def test_sentence_names_the_unit_where_there_is_one(name, value, sentence):
    with pytest.raises(ConfigError) as info:
        Config(**{name: value})
    assert str(info.value) == sentence


def test_values_take_their_own_type():
    config = Config(hold_time=3, use_velocity='true', use_position='False', free_start='false')
    assert isinstance(config.hold_time, float)
    assert config.use_velocity is True
    assert config.use_position is False
    assert config.free_start is False


@pytest.mark.parametrize('values', [
    {'use_velocity': False, 'use_position': False}, {'use_velocity': False, 'method': 'vif'}])
def test_contradictions_refused(values):
    with pytest.raises(ConfigError, match='use_velocity'):
        Config(**values)


@pytest.mark.parametrize('method, use_velocity, refused', [
    ('vif', 'auto', True), ('pif', 'auto', True), ('pif', True, True), ('pif', False, False),
    ('bank', 'auto', False)])
def test_positions_that_a_method_would_not_use_are_refused(method, use_velocity, refused):
    values = {'method': method, 'use_velocity': use_velocity, 'use_position': True}
    if refused:
        with pytest.raises(ConfigError, match=f'{method} .*use_position is true'):
            Config(**values)
    else:
        assert Config(**values).use_position is True


def test_unknown_parameter_names_the_close_ones():
    with pytest.raises(ConfigError, match="'lever_am'.*did you mean lever_arm"):
        config_from_mapping({'lever_am': [0, 0, 0]})
    with pytest.raises(ConfigError, match="parameter 'xyz' is not known$"):
        config_from_mapping({'xyz': 1})


def test_preset_figures_and_overrides():
    mems = Config().imu_noise
    assert mems == PRESETS['mems']
    assert math.isclose(mems.angle_random_walk, math.radians(0.3) / 60.0)
    assert math.isclose(mems.gyro_bias_std, math.radians(0.1))
    navigation = Config(imu_grade='navigation', accel_bias_std=0.01).imu_noise
    assert navigation.accel_bias_std == 0.01
    assert math.isclose(navigation.velocity_random_walk * 60.0, 0.003)
    # 5 ug/sqrt(Hz) is the same figure by another name.
    assert math.isclose(navigation.velocity_random_walk, 5e-6 * 9.80665, rel_tol=0.03)


def test_custom_needs_all_four():
    figures = {'angle_random_walk': 0.1, 'velocity_random_walk': 0.1, 'gyro_bias_std': 0.1}
    with pytest.raises(ConfigError, match='missing: accel_bias_std'):
        Config(imu_grade='custom', **figures)
    noise = Config(imu_grade='custom', accel_bias_std=0.2, **figures).imu_noise
    assert noise.accel_bias_std == 0.2


def test_config_is_frozen_and_replaceable():
    config = Config()
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.hold_time = 1.0
    assert dataclasses.replace(config, hold_time=1).hold_time == 1.0


@pytest.mark.parametrize('head', [
    'ins_align:\n  ros__parameters:', '/ins_align:\n  ros__parameters:',
    '/**:\n  ros__parameters:', '/robot/ins_align:\n  ros__parameters:',
    'robot:\n ins_align:\n  ros__parameters:'])
def test_parameter_file_names_the_node(tmp_path, head):
    path = write(tmp_path / 'p.yaml', f'{head}\n    hold_time: 1e-1\n    lever_arm: [1, 2, 3]\n')
    assert load_params(path) == {'hold_time': 0.1, 'lever_arm': [1, 2, 3]}


def test_parameter_file_of_several_nodes(tmp_path):
    path = write(tmp_path / 'p.yaml',
                 'other:\n  ros__parameters:\n    x: 1\n'
                 'ins_align:\n  ros__parameters:\n    use_sim_time: true\n    hold_time: 3.0\n'
                 '    qos_overrides:\n      /imu/data_raw:\n        subscription: {depth: 5}\n')
    assert without_unknown(load_params(path)) == ({'hold_time': 3.0}, [])


@pytest.mark.parametrize('text, message', [
    ('', 'no parameters'), ('hold_time: 1', 'no parameters'),
    ('other:\n  ros__parameters:\n    x: 1', 'no parameters'),
    ('ins_align:\n  ros__parameters: [1]', 'mapping'),
    ('a:\n ins_align:\n  ros__parameters: {}\nb:\n ins_align:\n  ros__parameters: {}',
     'for /a/ins_align and /b/ins_align: leave only those of one'), ('a: [', 'YAML, line 1'),
    ('a: !!python/object/apply:os.system [ls]', 'YAML'), ('\x00', 'YAML'),
    ('[' * 100000, 'YAML'), ('x' * (1 << 21), 'MiB')])
def test_parameter_file_refused(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as info:
        load_params(write(tmp_path / 'p.yaml', text))
    assert '\n' not in str(info.value)


def test_parameter_file_that_unfolds_is_refused(tmp_path):
    lines = ['a0: &a0 [x, x, x, x, x, x, x, x, x, x]']
    lines += [f'a{i + 1}: &a{i + 1} [{", ".join([f"*a{i}"] * 10)}]' for i in range(9)]
    lines += ['ins_align:', '  ros__parameters:', '    lever_arm: *a9', '    hold_time: *a9']
    with pytest.raises(ConfigError, match='aliases are not allowed'):
        load_params(write(tmp_path / 'p.yaml', '\n'.join(lines)))


def test_hostile_value_is_refused_briefly():
    value = ['x' * 100000] * 100000
    with pytest.raises(ConfigError) as info:
        config_from_mapping({'hold_time': value, 'y' * 100000: 1})
    assert len(str(info.value)) < 600
    with pytest.raises(ConfigError) as info:
        config_from_mapping({'method': value})
    assert len(str(info.value)) < 600


def test_parameter_file_missing(tmp_path):
    with pytest.raises(ConfigError, match='No such file'):
        load_params(tmp_path / 'none.yaml')
    with pytest.raises(ConfigError, match='cannot read'):
        load_params(tmp_path)


@pytest.mark.parametrize('text, expected', [
    ('lever_arm=[1,1,1]', ('lever_arm', [1, 1, 1])), ('hold_time=1e1', ('hold_time', 10.0)),
    ('method=vif', ('method', 'vif')), ('free_start=false', ('free_start', False)),
    ('use_velocity=auto', ('use_velocity', 'auto')), ('method=', ('method', None)),
    ('hold_time=.5', ('hold_time', 0.5)), ('gnss_delay=-1e-1', ('gnss_delay', -0.1))])
def test_override(text, expected):
    assert parse_override(text) == expected


@pytest.mark.parametrize('text', ['', 'hold_time', '=3', 'lever_arm=[1,', 'a={', 'x=2020-99-99'])
def test_override_refused(text):
    with pytest.raises(ConfigError) as info:
        parse_override(text)
    assert '\n' not in str(info.value)
