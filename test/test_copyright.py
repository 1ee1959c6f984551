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

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ('docs', 'ins_align', 'launch', 'test')
HEADER = Path(__file__).read_text(encoding='utf-8').splitlines()[:13]


def sources():
    return [ROOT / 'setup.py',
            *(path for folder in FOLDERS for path in sorted((ROOT / folder).rglob('*.py')))]


@pytest.mark.linter
@pytest.mark.parametrize('path', sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_header(path):
    assert path.read_text(encoding='utf-8').splitlines()[:13] == HEADER


@pytest.mark.copyright
@pytest.mark.linter
def test_copyright():
    main = pytest.importorskip('ament_copyright.main').main
    assert main(argv=[str(path) for path in sources()]) == 0, 'licence headers are missing'
