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
"""The package as it is installed: complete, consistent, and light where the robot needs it."""

import ast
import configparser
import dataclasses
from importlib import import_module
import math
from pathlib import Path
import re
import subprocess
import sys

from catkin_pkg.package import parse_package
from ins_align.config import Config
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
CORE = ('aligner', 'config', 'results', 'geometry.earth', 'imu.prediction', 'gnss.antenna',
        'estimation.bank', 'estimation.formula', 'estimation.declaration')
OPTIONAL = ('rosbags', 'matplotlib', 'pyins', 'pandas', 'numba', 'scipy', 'tqdm')


def read(name):
    return (ROOT / name).read_text(encoding='utf-8')


@pytest.fixture(scope='module')
def installed(tmp_path_factory):
    """Install the modules and the data into an empty directory."""
    place = tmp_path_factory.mktemp('installed')
    subprocess.run(
        [sys.executable, 'setup.py', '-q', 'build', '--build-base', str(place / 'build'),
         'install_lib', '--install-dir', str(place / 'lib'), '--no-compile',
         'install_data', '--install-dir', str(place)],
        cwd=ROOT, check=True, capture_output=True)
    return place


def test_every_module_is_installed(installed):
    wanted = {path.relative_to(ROOT) for path in (ROOT / 'ins_align').rglob('*.py')}
    got = {path.relative_to(installed / 'lib') for path in (installed / 'lib').rglob('*.py')}
    assert got == wanted


def test_share_holds_what_ros_looks_for(installed):
    share = installed / 'share'
    assert (share / 'ament_index/resource_index/packages/ins_align').is_file()
    assert (share / 'ins_align/package.xml').read_text() == read('package.xml')
    for folder, pattern in (('config', '*.yaml'), ('launch', '*.launch.*')):
        wanted = {path.name for path in (ROOT / folder).glob(pattern)}
        assert wanted
        assert {path.name for path in (share / 'ins_align' / folder).iterdir()} == wanted


def test_one_version():
    version = parse_package(ROOT / 'package.xml').version
    assert f"version='{version}'" in read('setup.py')
    assert re.search(rf'^{re.escape(version)} \(', read('CHANGELOG.rst'), re.MULTILINE)


def test_what_the_launch_files_run_is_a_dependency():
    needed = {dependency.name for dependency in parse_package(ROOT / 'package.xml').exec_depends}
    verbs = set()
    for path in (ROOT / 'launch').iterdir():
        # cmd="ros2 bag play ..." in XML, cmd=['ros2', 'bag', ...] in Python.
        verbs |= set(re.findall(r'cmd=\W*ros2\W+(\w+)', path.read_text()))
    assert verbs == {'bag'}
    assert {f'ros2{verb}' for verb in verbs} <= needed
    assert 'rosbag2_storage_mcap' in needed  # what ins_align simulate writes


def test_commands_are_where_ros2_run_looks():
    config = configparser.ConfigParser(delimiters='=')
    config.read_string(read('setup.cfg'))
    assert config['install']['install_scripts'] == '$base/lib/ins_align'
    assert config['develop']['script_dir'] == '$base/lib/ins_align'


@pytest.mark.parametrize('command', ['ins_align', 'ins_align_node'])
def test_entry_point_exists(command):
    module, function = re.search(rf"'{command} = ([\w.]+):(\w+)'", read('setup.py')).groups()
    tree = ast.parse(read(module.replace('.', '/') + '.py'))
    assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def imported_by(modules):
    """Top-level packages in a process that has imported these modules of ours."""
    imports = '; '.join(f'import ins_align.{name}' for name in modules)
    code = f'import sys; {imports}; print(*sys.modules)'
    run = subprocess.run([sys.executable, '-c', code], cwd=ROOT, check=True,
                         capture_output=True, text=True)
    return {name.split('.')[0] for name in run.stdout.split()}


def test_core_needs_numpy_only():
    """A laptop without ROS."""
    assert not imported_by(CORE) & {*OPTIONAL, 'rclpy', 'sensor_msgs'}


def test_node_needs_nothing_optional():
    """A robot without rosbags, matplotlib and python-ins."""
    pytest.importorskip('rclpy')
    assert not imported_by(['ros.main']) & set(OPTIONAL)


def test_command_line_starts_without_anything_optional():
    """Help has to work before the extras are installed."""
    assert not imported_by(['cli']) & {*OPTIONAL, 'rclpy'}


def test_page_lists_every_parameter_with_its_default():
    page = read('docs/parameters.md')
    rows = dict(re.findall(r'^\| `(\w+)` \| `([^`]+)` \|', page, re.MULTILINE))
    defaults = {}
    for field in dataclasses.fields(Config):
        value = list(field.default) if isinstance(field.default, tuple) else field.default
        defaults[field.name] = (
            str(value).lower() if isinstance(value, bool) else str(value) or "''")
    assert rows == defaults


@pytest.mark.parametrize('page', ['README.md', *(
    f'docs/{path.name}' for path in sorted((ROOT / 'docs').glob('*.md')))])
def test_page_names_no_file_that_is_not_there(page):
    links = re.findall(r'\]\((?!https?:|#)([^)#]+)', read(page))
    assert [link for link in links if not ((ROOT / page).parent / link).exists()] == []


def test_readme_is_short():
    assert len(read('README.md').splitlines()) <= 130


def test_topics_are_listened_to_before_there_is_a_node():
    """Of a topic that nobody publishes yet ``ros2 topic echo`` does not know the type."""
    text = read('README.md').replace('\\\n', ' ')
    commands = re.findall(r'^ros2 topic echo .*', text, re.MULTILINE)
    assert len(commands) == 2
    for command in commands:
        assert re.search(r' /ins_align/\w+ \w+/msg/\w+$', command), command


def test_api_page_has_every_module():
    """A module that was renamed makes the documentation fail, one that is new is not in it."""
    listed = re.findall(r'automodule:: ins_align\.([\w.]+)', read('docs/api.rst'))
    package = ROOT / 'ins_align'
    modules = ['.'.join(path.relative_to(package).with_suffix('').parts)
               for path in package.rglob('*.py')]
    assert sorted(listed) == sorted(
        {module.removesuffix('.__init__') for module in modules
         if module == 'experiments.__init__' or not module.startswith('experiments.')}
        - {'__init__'})


def test_constants_are_those_of_their_page():
    """All numbers of the estimation; places in arrays, sentences and tables are none."""
    others = set('LEVER_ARM DELAY GYRO MOUNT DRIFT OF_VEHICLE NO_INNOVATION NOT_USED TOO_NOISY '
                 'UNFIT UNCONFIRMED AMBIGUOUS LEVELS SIGNS GRADE CERTAIN REJECTED'.split())
    written, found = {}, {}
    for row in re.findall(r'^\| (`.*?`) \| (`.*?`) \|', read('docs/constants.md'), re.MULTILINE):
        names, values = (re.findall('`(.*?)`', cell) for cell in row)
        values = [eval(value, {**vars(math)}) for value in values]
        written.update(zip(names, values if len(values) == len(names) else values[0]))
    for path in (ROOT / 'ins_align/estimation').glob('*.py'):
        module = import_module(f'ins_align.estimation.{path.stem}')
        for names in re.findall('^([A-Z][A-Z_, ]*) = ', path.read_text('utf-8'), re.MULTILINE):
            found.update((name, getattr(module, name)) for name in names.split(', '))
    assert set(written) == set(found) - others
    for name, value in written.items():
        assert found[name] == pytest.approx(value if isinstance(value, dict)
                                            else np.array(value, float)), name


def test_files_functions_and_chains_of_imports_stay_short():
    """What docs/design.md promises to whoever reads the package."""
    trees = {path.relative_to(ROOT).with_suffix('').as_posix().removesuffix('/__init__'):
             ast.parse(path.read_text('utf-8')) for path in (ROOT / 'ins_align').rglob('*.py')}
    imported = {name: set(trees) & {
        f'{node.module.replace(".", "/")}{end}' for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module
        for end in ('', *(f'/{alias.name}' for alias in node.names))}
        for name, tree in trees.items()}

    def floor(name):
        return 1 + max((floor(below) for below in imported[name]), default=0)

    for name, tree in trees.items():
        assert floor(name) <= 8, name
        assert max((node.end_lineno for node in tree.body), default=0) <= 500, name
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                first = node.body[1 if ast.get_docstring(node) and len(node.body) > 1 else 0]
                assert node.end_lineno - first.lineno < 60, f'{name}: {node.name}'
