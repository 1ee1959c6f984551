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
"""Messages that are taken from their subscription when somebody wants them, many at a time."""

from __future__ import annotations

from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.subscription import Subscription


class OnDemand(CallbackGroup):
    """
    Keeps a subscription from its executor until it is opened.

    A turn of the executor takes longer than all that is done with a message. Where nothing has
    to be done at once, messages wait in the subscription's queue and are taken many at a time.
    """

    is_open = False

    def can_execute(self, entity: Any) -> bool:
        """Whether the executor may take messages."""
        return self.is_open

    def beginning_execution(self, entity: Any) -> bool:
        """Allow it."""
        return True

    def ending_execution(self, entity: Any) -> None:
        """Do nothing."""


def queued(subscription: Subscription, most: int) -> list[tuple[Any, int]]:
    """Take up to so many waiting messages, each with the time at which it was received, ns."""
    messages = []
    with subscription.handle:
        for _ in range(most):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                break
            messages.append((taken[0], taken[1]['received_timestamp']))
    return messages
