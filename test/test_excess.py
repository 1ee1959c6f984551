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
"""How much of the IMU's noise in excess is believed once a heading is declared."""

from dataclasses import replace

from alignment import aligned, config_for, error_of, estimator_of, give, simulated
from ins_align.aligner import Aligner
from ins_align.excess import ExcessJudge, SHARES
from ins_align.results import State
import numpy as np
import pytest

QUIET, VIBRATING = 0.0 * np.eye(9), 100.0 * np.eye(9)
# Log likelihoods of the shares: as good as each other; clearly against all but one.
OPEN = np.array([0.0, -0.1, -0.5, -1.0])
SMALL, LARGE = np.array([0.0, -5.0, -20.0, -40.0]), np.array([-40.0, -20.0, -5.0, 0.0])


def judge_of(*excess, declared=True):
    """Return one that heard of so many intervals."""
    judge = ExcessJudge()
    judge.declared = declared
    for each in excess:
        judge.hear(np.eye(9), each)
    return judge


def test_nothing_is_judged_before_a_declaration_or_without_vibration():
    assert not judge_of(*20 * [VIBRATING], declared=False).due
    assert not judge_of(*20 * [QUIET]).competent and not judge_of(*20 * [5.0 * np.eye(9)]).due
    judge = judge_of(*20 * [VIBRATING], declared=False)
    judge.declared = True
    judge.hear(np.eye(9), QUIET)
    assert not judge.due                            # the throw before a declaration is over
    judge.hear(np.eye(9), VIBRATING)
    assert judge.due


def test_it_is_judged_again_when_there_is_twice_as_much():
    judge = judge_of(*100 * [QUIET])
    judged_at = []
    for k in range(1, 41):
        judge.hear(np.eye(9), VIBRATING)
        if judge.due:
            judge.share(OPEN)
            judged_at.append(k)
    assert judged_at == [1, 3, 7, 15, 31]
    # Of one that is thirty times as loud this is so at once.
    assert not judge.due
    judge.hear(np.eye(9), 30.0 * VIBRATING)
    assert judge.due


def test_the_largest_share_that_may_be_right_is_believed():
    judge = judge_of(VIBRATING)
    assert judge.share(OPEN) == SHARES[-1] == 1.0
    assert judge.share(SMALL) == SHARES[0] and judge.share(LARGE) == SHARES[-1]
    assert judge.share(np.array([-6.0, 0.0, -2.5, -8.0])) == SHARES[2]


def test_what_was_known_is_handed_on_and_can_be_overruled():
    judge = judge_of(VIBRATING)
    judge.share(100.0 * SMALL)
    judge.restart()
    assert not judge.due and judge.declared
    judge.hear(np.eye(9), VIBRATING)
    assert judge.due and judge.share(OPEN) == SHARES[0]
    assert judge.share(LARGE) == SHARES[-1]


# In an alignment

def shaken(s, start_s, kind, seed):
    """Add vibration of 1 m/s^2 and 3 deg/s, 1 sigma, from a time on: white, or of two tones."""
    time = (s.imu_stamps_ns - s.imu_stamps_ns[0]) * 1e-9
    random = np.random.default_rng(seed)
    shape = s.gyro.shape
    gyro, accel = (
        random.standard_normal(shape) if kind == 'white'
        else sum(np.sin(2 * np.pi * (f * time[:, None] + random.random(3))) for f in (23.0, 37.0))
        for _ in range(2))
    on = (time >= start_s)[:, None]
    return replace(s, gyro=s.gyro + np.radians(3.0) * on * gyro, accel=s.accel + on * accel)


@pytest.mark.parametrize('scenario, seed', [('car', 0), ('car', 2), ('flight', 3), ('flight', 7)])
def test_white_vibration_that_sets_in_after_the_declaration_is_believed_at_once(scenario, seed):
    """Errors were 5 to 7 sigma while a small share was believed until the store had grown."""
    s = shaken(simulated(scenario, seed=seed, duration=60.0), 25.0, 'white', 100 + seed)
    aligner, epochs = aligned(s)
    declared = [epoch.current for epoch in epochs if epoch.state is State.ALIGNED]
    # It may be withdrawn: after ten seconds such noise leaves two degrees of heading.
    assert sum(epoch.state is State.ALIGNED for epoch in epochs if epoch.t_s > 25.0) > 40
    sigmas = np.array([np.max(np.abs(np.degrees(error_of(attitude, s))) / attitude.sigma_deg)
                       for attitude in declared])
    assert np.max(sigmas) < 4.0 and np.mean(sigmas > 3.0) < 0.03
    assert estimator_of(aligner).noise.excess >= 1 / 3


@pytest.mark.parametrize('scenario', ('car', 'flight'))
def test_vibration_that_averages_out_is_not_believed_for_long(scenario):
    s = shaken(simulated(scenario, seed=3, duration=40.0), 25.0, 'tones', 103)
    aligner = Aligner(config_for(s))
    shares = {}
    for kind, payload in s.messages():
        give(aligner, kind, payload)
        for epoch in aligner.update():
            shares[epoch.t_s] = estimator_of(aligner).noise.excess
    assert max(share for t_s, share in shares.items() if t_s < 25.0) <= 1 / 3
    assert max(share for t_s, share in shares.items() if 25.0 < t_s < 27.0) == 1.0
    assert max(share for t_s, share in shares.items() if t_s > 30.0) <= 1 / 9


def test_vibration_is_judged_in_any_split_alike():
    s = shaken(simulated('car', seed=0, duration=40.0), 25.0, 'white', 100)
    aligner, epochs = aligned(s)
    other = Aligner(config_for(s))
    for k in range(len(s.gnss_stamps_ns)):
        other.add_fix(s.fix(k))
        other.add_velocity(s.velocity_measurement(k))
    other.add_imu(s.imu_stamps_ns, s.gyro, s.accel)
    at_once = other.flush()
    assert estimator_of(other).noise == estimator_of(aligner).noise
    assert ([(epoch.stamp_ns, epoch.state, epoch.t_s) for epoch in at_once]
            == [(epoch.stamp_ns, epoch.state, epoch.t_s) for epoch in epochs])
    assert all(np.array_equal(a.current.covariance, b.current.covariance)
               for a, b in zip(at_once, epochs) if a.current is not None)
