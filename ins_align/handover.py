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
"""Moving t0: what an estimator knows at its last epoch becomes the prior of the next one."""

from dataclasses import replace
import math

from ins_align.config import Config
from ins_align.earth import EARTH_RATE
from ins_align.estimator import MapEstimator
from ins_align.rotation import Array, exp_so3, Index, skew
from ins_align.unknowns import (ACCEL, ACCEL_BIAS, ANTENNA, ATTITUDE, BODY_FIXED, DELAY, GYRO,
                                GYRO_BIAS, inverse_spd, Prior, prior_of, SIZE, START_POSITION,
                                START_VELOCITY, Unknowns)
from ins_align.whitening import HEADING_RESOLVED_STD, START
import numpy as np

# Biases wander by this share of their prior sigma in this time (s), and so does the delay: clocks
# of IMU and GNSS that nothing keeps together drift apart by up to 0.1 ms in a second.
WANDER, DELAY_WANDER, WANDER_TIME = 0.3, 0.1, 100.0


def wander(config: Config) -> Array:
    """
    Return the variance by which the unknowns change in a second, shape (37,).

    Beside a rate random walk of the gyroscopes, which the estimator counts all the time.
    """
    noise = config.imu_noise
    variance = np.zeros(SIZE)
    variance[DELAY] = (DELAY_WANDER * config.gnss_delay_std) ** 2 / WANDER_TIME
    if noise.rate_random_walk == 0.0:
        variance[GYRO_BIAS] = (WANDER * noise.gyro_bias_std) ** 2 / WANDER_TIME
    variance[ACCEL_BIAS] = (WANDER * noise.accel_bias_std) ** 2 / WANDER_TIME
    return variance


def aged(prior: Prior, config: Config, seconds: float) -> Prior:
    """Return what is left of what was known, after a time in which nothing was measured."""
    variance = wander(config)
    variance[GYRO_BIAS] += config.imu_noise.rate_random_walk ** 2
    return _loosened(prior, seconds * variance, (GYRO_BIAS, ACCEL_BIAS, DELAY))


def _loosened(prior: Prior, variance: Array, blocks: tuple[slice, ...]) -> Prior:
    """Return what is known where blocks of unknowns have changed; variances, shape (37,)."""
    for block in blocks:
        if variance[block.start] > 0.0:
            prior = prior.loosened(block, math.sqrt(variance[block.start]))
    return prior


def prior_from_now(estimator: MapEstimator, C_n0n: Array, shift_v: Array, shift_p: Array,
                   scale: float, wander: Array) -> Prior:
    """
    Return what is known now as the prior of an estimator whose t0 is the last epoch.

    While the heading is not resolved, the linear picture of how it hangs together with the
    rest is not good for long: then tilt and biases are kept, the heading and the start are not.
    Of lever arm and delay that is kept which was known before: without a change of speed nothing
    shows them but the noise of the IMU, which feigns a swing that the GNSS does not see.

    Parameters
    ----------
    estimator : MapEstimator
        With a solution.
    C_n0n : ndarray, shape (3, 3)
        How far the local level has turned since t0.
    shift_v, shift_p : ndarray, shape (3,)
        s_v and s_p of an antenna track that starts at the last epoch, minus those of this one,
        in n0 axes.
    scale : float
        Factor on the covariance, for data that fit worse than stated.
    wander : ndarray, shape (37,)
        Variance by which the unknowns may have changed since t0.

    Raises
    ------
    RuntimeError
        Before the first solution.

    """
    columns = estimator.columns
    heading_free = not estimator.heading_std < HEADING_RESOLVED_STD
    now, joint = _now(estimator, heading_free, scale)
    T = np.eye(joint.shape[0])
    for block in range(3):
        T[3 * block:3 * block + 3, 3 * block:3 * block + 3] = C_n0n.T
    joint = T @ joint @ T.T
    joint[9:, 9:] += np.diag(wander[columns])
    if heading_free:
        # The gyros cannot tell their biases from the Earth's rate seen under a heading that
        # may be anything; the linear picture knows the tangent of that circle only.
        gyro_bias = slice(9 + GYRO_BIAS.start, 9 + GYRO_BIAS.stop)
        least = np.linalg.eigvalsh(joint[gyro_bias, gyro_bias])[0]
        joint[gyro_bias, gyro_bias] += max(EARTH_RATE ** 2 - least, 0.0) * np.eye(3)
        # So it is with the tilt of a vehicle that gathers speed: what may be anything is the turn
        # about the specific force, which leads the vertical round a circle.
        joint[:2, :2] += estimator.free_axis_tilt ** 2 * np.eye(2)
    # Places of what is kept in the joint covariance, and in the vector of unknowns.
    kept = _carried(estimator, heading_free)
    start = np.arange(2 if heading_free else estimator.size)
    places = np.concatenate([start, 9 + kept])
    unknowns = np.concatenate([START[start], columns[kept]])
    mean = replace(now, C=C_n0n.T @ now.C, start_velocity=C_n0n.T @ (now.start_velocity + shift_v),
                   start_position=C_n0n.T @ (now.start_position + shift_p))
    prior = prior_of(mean, joint[np.ix_(places, places)], unknowns, heading_free)
    if heading_free:
        prior = prior.with_antenna_of(_loosened(estimator.prior, wander, (DELAY,)))
    return prior


def prior_without_attitude(estimator: MapEstimator) -> Prior:
    """Return what is known now of sensors, lever arm and delay as the prior of a fresh start."""
    if estimator.solution is None:
        return estimator.prior
    now, joint = _now(estimator, True)
    heading_free = not estimator.heading_std < HEADING_RESOLVED_STD
    kept = _carried(estimator, heading_free)
    mean = replace(now, C=np.eye(3), start_velocity=np.zeros(3), start_position=np.zeros(3))
    prior = prior_of(mean, joint[np.ix_(9 + kept, 9 + kept)], estimator.columns[kept], False)
    return prior.with_antenna_of(estimator.prior) if heading_free else prior


def _carried(estimator: MapEstimator, heading_free: bool) -> Index:
    """Places in the vector of unknowns of what the data tell of the body, shape (k,)."""
    told = np.setdiff1d(BODY_FIXED, ANTENNA) if heading_free else BODY_FIXED
    return np.flatnonzero(np.isin(estimator.columns, told))


def _now(estimator: MapEstimator, heading_free: bool,
         scale: float = 1.0) -> tuple[Unknowns, Array]:
    """
    Return the unknowns as if the last epoch were t0, in the axes and origin of the present n0.

    Their attitude, start velocity and start position are those of the IMU now. The second result
    is the joint covariance of (attitude, velocity, position, unknowns), shape (9 + n, 9 + n). It
    belongs to the heading of the linearisation point; with `heading_free` the attitude is told
    with that heading too, since any is as good.
    """
    s = estimator.solution
    if s is None:
        raise RuntimeError('no solution yet')
    x, step, time, chain = s.estimate, s.step(), estimator.time, s.chain
    C = exp_so3([0.0, 0.0, -step[2]]) @ x.C if heading_free else x.C
    # The stored chain has the sensor errors of the point: their step is still to be applied.
    gyro, accel = step[GYRO], step[ACCEL]
    v = C @ (chain.v + chain.v_g @ gyro + chain.v_a @ accel)
    p = C @ (chain.p + chain.p_g @ gyro + chain.p_a @ accel)
    # Derivatives of what is now to the unknowns; to attitude and start they are those to the
    # errors of the chain too.
    J = np.zeros((9, SIZE))
    J[:3, ATTITUDE] = J[3:6, START_VELOCITY] = J[6:, START_POSITION] = np.eye(3)
    J[3:6, ATTITUDE], J[6:, ATTITUDE] = -skew(v), -skew(p)
    J[6:, START_VELOCITY] = time * np.eye(3)
    E = J[:, START]
    J[:3, GYRO], J[3:6, GYRO], J[6:, GYRO] = C @ chain.R_g, C @ chain.v_g, C @ chain.p_g
    J[3:6, ACCEL], J[6:, ACCEL] = C @ chain.v_a, C @ chain.p_a
    # Derivatives of all that is now to the errors of the chain.
    errors = s.chain_errors()
    size, n = estimator.size, estimator.columns.size
    D = np.zeros((9 + n, errors.size))
    D[:9, :size] = E[:, :size]
    if errors.size > size:                                      # the gyros' biases walk
        D[:9, size:] = J[:, GYRO_BIAS]
        D[9 + np.flatnonzero(np.isin(estimator.columns, np.r_[GYRO_BIAS])), size:] = np.eye(3)
    moved = D[:9] @ errors
    now = replace(
        x, C=exp_so3(moved[:3]) @ C @ exp_so3(chain.R_g @ gyro) @ chain.R,
        sensors=x.sensors._replace(gyro_bias=s.gyro_bias),
        start_velocity=x.start_velocity + v + moved[3:6],
        start_position=x.start_position + time * x.start_velocity + p + moved[6:])
    total = np.vstack([J[:, estimator.columns], np.eye(n)]) - D @ s.whitener.X[:, 1:]
    # What the data told counts less by the scale; what was known before them does not.
    P = s.P if scale == 1.0 else inverse_spd(
        inverse_spd(s.P) / scale + (1.0 - 1.0 / scale) * s.information)
    return now, total @ P @ total.T + scale * D @ s.whitener.P @ D.T
