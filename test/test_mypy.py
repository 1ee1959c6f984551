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

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CORE = ('aligner', 'config', 'results', 'geometry/*', 'imu/*', 'gnss/*', 'estimation/*',
        'recordings/__init__', 'recordings/bag', 'recordings/decode', 'recordings/reader',
        'recordings/salvage')


@pytest.mark.linter
@pytest.mark.mypy
def test_mypy():
    # Types are checked against the pinned stubs of numpy and scipy, not those of a distribution.
    api = pytest.importorskip('mypy.api')
    modules = [str(path) for name in CORE for path in (ROOT / 'ins_align').glob(f'{name}.py')]
    report, errors, status = api.run(
        ['--config-file', str(ROOT / 'setup.cfg'), '--cache-dir', str(ROOT / '.mypy_cache'),
         *modules])
    assert status == 0, os.linesep + report + errors
