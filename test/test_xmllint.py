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

from catkin_pkg.package import parse_package
import pytest

MANIFEST = Path(__file__).parents[1] / 'package.xml'


@pytest.mark.linter
def test_manifest():
    warnings = []
    package = parse_package(MANIFEST, warnings=warnings)
    package.validate(warnings=warnings)
    assert not warnings
    assert package.package_format == 3


@pytest.mark.linter
@pytest.mark.xmllint
def test_xmllint():
    main = pytest.importorskip('ament_xmllint.main').main
    assert main(argv=[str(MANIFEST)]) == 0, 'package.xml does not follow its schema'
