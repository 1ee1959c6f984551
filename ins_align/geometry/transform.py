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
"""Transforms between frames that are fixed to each other."""

from __future__ import annotations

from typing import NamedTuple

from ins_align.geometry.rotation import Array


class Transform(NamedTuple):
    """Takes vectors of a source frame to a target frame: rotate, then add."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,), m

    def after(self, other: Transform) -> Transform:
        """Return the transform that does the other one first."""
        return Transform(self.rotation @ other.rotation,
                         self.rotation @ other.translation + self.translation)

    def inverse(self) -> Transform:
        """Return the transform from target to source."""
        return Transform(self.rotation.T, -self.rotation.T @ self.translation)
