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
"""Hours of epochs: neither memory nor precision is lost."""

from collections import deque
from types import FunctionType, ModuleType

from alignment import config_for, normalised_error, simulated
from ins_align.aligner import Aligner, State
import numpy as np
import pytest
from scipy.stats import chi2


def size_of(thing, seen=None):
    """Return the bytes of all arrays, and the number of all other things, that something holds."""
    seen = set() if seen is None else seen
    if id(thing) in seen or isinstance(thing, (type, ModuleType, FunctionType)):
        return 0
    seen.add(id(thing))
    if isinstance(thing, np.ndarray):
        return thing.nbytes
    if isinstance(thing, dict):
        inside = [*thing.keys(), *thing.values()]
    elif isinstance(thing, (list, tuple, set, deque)):
        inside = list(thing)
    else:
        inside = [getattr(thing, name) for name in (
            *getattr(thing, '__dict__', ()), *getattr(type(thing), '__slots__', ()))]
    return 1 + sum(size_of(part, seen) for part in inside)


@pytest.mark.campaign
def test_an_aligner_of_two_hours_holds_no_more_and_knows_no_less():
    """
    Seven thousand epochs in streets.

    What the aligner holds and how large the sigmas of the attitude now are is in the last forty
    minutes as in the first; the errors stay as large as stated. Rounding that grows would show.
    """
    s = simulated('car', imu_grade='tactical', seed=1, duration=2 * 3600.0, imu_rate=20.0,
                  gnss_rate=1.0)
    aligner = Aligner(config_for(s))
    held, errors, sigmas = [], [], []
    for first in range(0, len(s.gnss_stamps_ns), 5):
        for k in range(first, min(first + 5, len(s.gnss_stamps_ns))):
            aligner.add_fix(s.fix(k))
            aligner.add_velocity(s.velocity_measurement(k))
        now = slice(20 * first, 20 * (first + 5))
        aligner.add_imu(s.imu_stamps_ns[now], s.gyro[now], s.accel[now])
        epochs = aligner.update()
        if first % 60 == 55:
            held.append(size_of(aligner))
            errors.append(normalised_error(epochs[-1].current, s))
            sigmas.append(epochs[-1].current.sigma_deg)
    status = aligner.status()
    assert status.state is State.ALIGNED and status.counts['epochs_used'] > 7_150
    part = len(held) // 3
    assert max(held[-part:]) < 1.1 * max(held[:part])
    early, late = np.mean(sigmas[10:part], axis=0), np.mean(sigmas[-part:], axis=0)
    assert np.all(late < 1.1 * early)
    # Errors a minute apart have much in common: three a time on average, none beyond all bounds.
    assert np.mean(errors[-part:]) < 6.0 and max(errors) < chi2.ppf(1 - 1e-6, 3)
