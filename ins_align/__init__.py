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
In-motion alignment: roll, pitch and true heading from an IMU and a GNSS receiver.

Frames
------
``e``
    Earth-centred Earth-fixed.
``n``
    Local level at the antenna, east-north-up (ENU).
``n0``
    ``n`` frozen at t0, in a bank at a later epoch; does not rotate.
``b``
    IMU body frame, forward-left-up (FLU).
``b0``
    ``b`` frozen at t0; does not rotate.

Names
-----
``C_xy`` takes components in y to components in x: ``C_nb`` is the attitude, ``C_n0n`` and
``C_b0b`` are how far the two frames have turned since they were frozen. A vector carries its frame
as a suffix: ``v_n``, ``f_b``, ``omega_ib_b``, ``lever_b``. Quaternions are (x, y, z, w) with
w >= 0. Stamps are integer nanoseconds. Attitude errors are small rotations about the axes of ENU
(left errors): ``C_nb = exp_so3(phi) C_nb_estimated``.

Chain rule, with n0 frozen at t0: ``C_nb(t) = C_n0n(t)^T C_nb(0) C_b0b(t)``; the
unknown is the initial attitude ``C_nb(0)``.
"""

from importlib import import_module
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from ins_align.aligner import Aligner
    from ins_align.config import Config, ConfigError
    from ins_align.gnss.messages import Fix, Velocity
    from ins_align.offline import align, replay
    from ins_align.recordings.info import inspect
    from ins_align.results import Attitude, Epoch, State, Status
    from ins_align.simulation.simulate import simulate

# The public names and their modules, which are imported when a name is used (PEP 562): a robot
# needs no rosbags, and the help of a command does not load numpy.
_MODULES = {
    'align': 'offline', 'Aligner': 'aligner', 'Attitude': 'results', 'Config': 'config',
    'ConfigError': 'config', 'Epoch': 'results', 'Fix': 'gnss.messages',
    'inspect': 'recordings.info', 'replay': 'offline',
    'simulate': 'simulation.simulate', 'State': 'results', 'Status': 'results',
    'Velocity': 'gnss.messages'}
__all__ = ['Aligner', 'Attitude', 'Config', 'ConfigError', 'Epoch', 'Fix', 'State', 'Status',
           'Velocity', 'align', 'inspect', 'replay', 'simulate']


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_MODULES[name]}'), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
