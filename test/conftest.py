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
"""Keeps ROS graphs of the tests apart from everything else and names the versions in use."""

from importlib.metadata import version
import os
import platform
import random

import pytest

# Before numpy is there: OpenBLAS 0.3.23, which numpy 1.26 brings along, has kernels for the newest
# processors whose sums depend, in the last bit, on where in memory a matrix lies. Those for older
# processors have not.
if version('numpy').startswith('1.') and platform.machine() == 'x86_64':
    os.environ.setdefault('OPENBLAS_CORETYPE', 'Haswell')
# There is a worker for each core already.
os.environ.setdefault('OMP_NUM_THREADS', '1')

# Before any test starts a node: its own domain, this machine only, so that neither a robot on
# the network nor a second run of the tests is heard. Workers of pytest-xdist, which inherit the
# first one's choice, take those that follow.
worker = os.environ.get('PYTEST_XDIST_WORKER', '').removeprefix('gw')
domain = (int(os.environ['ROS_DOMAIN_ID']) + 1 + int(worker) if worker
          else random.SystemRandom().randint(0, 100))
os.environ['ROS_DOMAIN_ID'] = str(domain % 101 + 1)
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'


def pytest_report_header():
    return ', '.join(f'{name} {version(name)}' for name in ('numpy', 'scipy'))


@pytest.fixture(scope='session')
def flight():
    """Simulate a MEMS flight of 30 s."""
    from alignment import simulated

    return simulated('flight', imu_grade='mems', duration=30.0, seed=2)


@pytest.fixture(scope='session')
def result(flight):
    """Align it; return the aligner, which is not to be changed, and its epochs."""
    from alignment import aligned

    return aligned(flight)
