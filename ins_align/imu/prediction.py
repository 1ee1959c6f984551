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
"""
The attitude between epochs, carried on with the gyroscopes sample by sample.

It computes with plain numbers, because the node does this for each IMU message and numpy takes
several times as long for vectors of three.
"""

from collections import deque
from collections.abc import Sequence
import math

from ins_align.config import ImuNoise
from ins_align.geometry.earth import EARTH_RATE
from ins_align.geometry.rotation import Array, matrix_from_quaternion
from ins_align.imu.buffer import MAX_GAP_NS, MAX_RATE
from ins_align.imu.noise import GAP_ANGULAR_ACCELERATION, GAP_STEPS, variance_in_gap
from ins_align.results import Attitude, Epoch
import numpy as np

# Number of samples kept, over which a prediction that comes late is carried.
HISTORY = 2000
_SMALL_ANGLE = 1e-6  # rad: sin(x / 2) / x is 1 / 2 to rounding


class Prediction:
    """
    An attitude that gyroscopes carry on from an epoch that has one.

    The rate is ``measured - gyro_matrix @ measured - gyro_bias``, rad/s, with a constant error of
    which the largest sigma of the biases counts; the Earth rate counts as an error, too. `rates`,
    (N, 3), are measured in a time before the epoch, and the last one at it; `interval` is between
    samples, s.
    """

    def __init__(self, epoch: Epoch, noise: ImuNoise, rates: Array, interval: float) -> None:
        attitude = epoch.current
        assert attitude is not None
        self.stamp_ns = self._epoch_ns = attitude.stamp_ns
        x, y, z, w = attitude.quaternion_xyzw.tolist()
        self._quaternion = x, y, z, w
        self._covariance = tuple(attitude.covariance.ravel().tolist())
        self._bias = tuple(epoch.gyro_bias.tolist())
        self._matrix = (np.eye(3) - epoch.gyro_matrix).tolist()
        self._rate = tuple(rates[-1].tolist())  # last measured
        self._varies = float(np.mean(np.var(rates, axis=0)))
        self._white_variance = noise.angle_random_walk ** 2
        self._rate_variance = float(np.max(epoch.gyro_bias_std)) ** 2 + EARTH_RATE ** 2
        self._longest_step, self._gaps_variance = GAP_STEPS * interval, 0.0

    def propagate(self, stamp_ns: int, gyro: Sequence[float]) -> bool:
        """
        Carry on to a sample (rad/s), with the mean of its rate and that of the last one.

        Return whether the attitude is now that at the sample. It is not if the sample is old or
        invalid, and never again after a gap longer than `MAX_GAP_NS`, in which the rotation is
        unknown. A shorter gap adds to the covariance, as in the filters.
        """
        x, y, z = gyro
        if not (0 < stamp_ns - self.stamp_ns <= MAX_GAP_NS
                and abs(x) < MAX_RATE and abs(y) < MAX_RATE and abs(z) < MAX_RATE):
            return False
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        if dt > self._longest_step:
            differs = sum((now - last) ** 2 for now, last in zip(gyro, self._rate)) / 3
            self._gaps_variance += dt ** 2 * variance_in_gap(
                dt, self._varies, differs, GAP_ANGULAR_ACCELERATION)
        last_x, last_y, last_z = self._rate
        self._rate = x, y, z
        x, y, z = 0.5 * (last_x + x), 0.5 * (last_y + y), 0.5 * (last_z + z)
        (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = self._matrix
        bias_x, bias_y, bias_z = self._bias
        x, y, z = ((xx * x + xy * y + xz * z - bias_x) * dt,
                   (yx * x + yy * y + yz * z - bias_y) * dt,
                   (zx * x + zy * y + zz * z - bias_z) * dt)
        angle = math.sqrt(x * x + y * y + z * z)
        half_sinc = math.sin(0.5 * angle) / angle if angle > _SMALL_ANGLE else 0.5
        x, y, z, w = x * half_sinc, y * half_sinc, z * half_sinc, math.cos(0.5 * angle)
        a, b, c, d = self._quaternion
        x, y, z, w = (d * x + a * w + b * z - c * y, d * y - a * z + b * w + c * x,
                      d * z + a * y - b * x + c * w, d * w - a * x - b * y - c * z)
        size = math.sqrt(x * x + y * y + z * z + w * w)
        self._quaternion = x / size, y / size, z / size, w / size
        self.stamp_ns = stamp_ns
        return True

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        """Quaternion of the rotation from body to ENU, w >= 0."""
        x, y, z, w = self._quaternion
        return (x, y, z, w) if w >= 0.0 else (-x, -y, -z, -w)

    @property
    def covariance(self) -> tuple[float, ...]:
        """Covariance of the small rotation about the axes of ENU, rad^2, row by row."""
        age = (self.stamp_ns - self._epoch_ns) * 1e-9
        drift = (self._white_variance + self._rate_variance * age) * age + self._gaps_variance
        ee, en, eu, ne, nn, nu, ue, un, uu = self._covariance
        return ee + drift, en, eu, ne, nn + drift, nu, ue, un, uu + drift

    def attitude(self) -> Attitude:
        """Return the attitude at the last sample that it was carried to."""
        return Attitude(self.stamp_ns, matrix_from_quaternion(np.array(self._quaternion)),
                        np.array(self.covariance).reshape(3, 3))


class Follower:
    """Carries the latest prediction, which comes late, to each sample as it arrives."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Sequence[float]]] = deque(maxlen=HISTORY)
        self._prediction: Prediction | None = None

    def adopt(self, prediction: Prediction | None) -> None:
        """Take over a prediction and carry it to the newest sample; None: there is no attitude."""
        self._prediction = None
        if prediction is None:
            return
        # From the newest sample back: the stamp may have come before the clock was set back, too.
        since = []
        for sample in reversed(self._samples):
            if sample[0] == prediction.stamp_ns:
                break
            since.append(sample)
        else:
            return  # its sample has not arrived here or is no longer kept: wait for the next one
        self._prediction = prediction
        for stamp_ns, gyro in reversed(since):
            prediction.propagate(stamp_ns, gyro)

    def follow(self, stamp_ns: int, gyro: Sequence[float]) -> Prediction | None:
        """Add a sample and return the prediction at its stamp; None while there is none."""
        self._samples.append((stamp_ns, gyro))
        now = self._prediction
        return now if now is not None and now.propagate(stamp_ns, gyro) else None
