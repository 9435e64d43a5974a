"""The subscriptions of a robot, which continue on each new connection after the one before was lost.

The methods take received messages and the time (``now``: monotonic seconds), and return messages to send and
events; they neither send nor read a clock.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from rse_pf.wire.messages import Failure, Message, Subscribe, Unsubscribe, Update

__all__ = ["ClientSubscriptions", "SubscriptionEnded", "Updated"]

_ANSWER_TIMEOUT_S = 5.0
"""Seconds after a Subscribe without an update after which it is sent again: a server that knows subscriptions
sends the present state at once."""
_MAX_TRIES = 3
"""Times that a Subscribe is sent on one connection before its subscription ends with an error."""


@dataclass(frozen=True, slots=True)
class Updated:
    """The newest value of one key of a subscription's topic."""

    id: int
    key: str
    payload: Any


@dataclass(frozen=True, slots=True)
class SubscriptionEnded:
    """A subscription ended: the server refused it or did not answer, or the robot will not connect again."""

    id: int
    failure: Failure


@dataclass(slots=True, kw_only=True)
class _Subscription:
    topic: str
    tries: int = 0
    again_s: float | None = None
    """Time at which the Subscribe is sent again on the current connection; None after its first update."""


class ClientSubscriptions:
    """All subscriptions of one robot, and the connection on which the robot has subscribed."""

    def __init__(self) -> None:
        """Begin without a subscription and without a connection."""
        self.replaced = 0
        """Number of values that servers did not send, because newer values of the same key replaced them."""
        self._live: dict[int, _Subscription] = {}
        self._connection: Hashable | None = None
        self._last_seq: dict[int, int] = {}

    def __contains__(self, identity: int | None) -> bool:
        """Return whether a subscription that has not ended has the id *identity*."""
        return identity in self._live

    def add(self, identity: int, topic: str, now: float) -> list[Message]:
        """Add a subscription to *topic* with the id *identity*; return what to send now.

        Without a connection the list is empty: `adopt` sends the Subscribe then.
        """
        self._live[identity] = _Subscription(topic=topic)
        return [self._ask(identity, now)] if self._connection is not None else []

    def remove(self, identity: int) -> list[Message]:
        """Remove the subscription *identity*; return the Unsubscribe to send on the current connection.

        The list is empty if there is no such subscription or no connection.
        """
        known = self._live.pop(identity, None)
        return [] if known is None or self._connection is None else [Unsubscribe(id=identity)]

    def adopt(self, connection: Hashable, now: float) -> list[Message]:
        """Make *connection* the current one; return a Subscribe for each subscription, to send on it."""
        self._connection = connection
        for subscription in self._live.values():
            subscription.tries = 0
        return [self._ask(identity, now) for identity in self._live]

    def lose(self, connection: Hashable) -> None:
        """Note that *connection* was lost; if it is the current one, all subscriptions wait for `adopt`."""
        if self._connection is connection:
            self._connection = None

    def update(self, connection: Hashable, update: Update) -> list[Updated]:
        """Return the event of an *update* that was received on *connection*.

        The list is empty if the subscription has ended, *connection* is not the current one, or the topic is
        another.
        """
        subscription = self._live.get(update.id)
        if subscription is None or connection is not self._connection or update.topic != subscription.topic:
            return []
        subscription.again_s = None
        self.replaced += max(0, update.seq - self._last_seq.get(update.id, 0) - 1)
        self._last_seq[update.id] = update.seq
        return [Updated(update.id, update.key, update.payload)]

    def refuse(self, connection: Hashable, failure: Failure) -> list[SubscriptionEnded]:
        """End the subscription whose id *failure* has, and return the event.

        The list is empty if there is no such subscription, or *connection* is not the current one.
        """
        if failure.id not in self._live or connection is not self._connection:
            return []
        del self._live[failure.id]
        return [SubscriptionEnded(failure.id, failure)]

    def due(self, now: float) -> tuple[list[Message], list[SubscriptionEnded]]:
        """Return the Subscribe messages to send again, and an event for each subscription that ended.

        A subscription without an update `_ANSWER_TIMEOUT_S` after its `_MAX_TRIES`-th Subscribe ends.
        """
        again: list[Message] = []
        ended: list[SubscriptionEnded] = []
        for identity, subscription in list(self._live.items()):
            if self._connection is None or subscription.again_s is None or now < subscription.again_s:
                continue
            if subscription.tries < _MAX_TRIES:
                again.append(self._ask(identity, now))
                continue
            del self._live[identity]
            failure = Failure(
                id=identity, code="unsupported", message="the server does not answer subscriptions",
                hint="update the server",
            )  # fmt: skip
            ended.append(SubscriptionEnded(identity, failure))
        return again, ended

    def abandon(self, code: str, message: str, hint: str) -> list[SubscriptionEnded]:
        """End every subscription with a Failure, because no further connection will be opened."""
        ended = [
            SubscriptionEnded(identity, Failure(id=identity, code=code, message=message, hint=hint))
            for identity in self._live
        ]
        self._live.clear()
        return ended

    def _ask(self, identity: int, now: float) -> Subscribe:
        subscription = self._live[identity]
        subscription.tries += 1
        subscription.again_s = now + _ANSWER_TIMEOUT_S
        self._last_seq.pop(identity, None)
        return Subscribe(id=identity, topic=subscription.topic)
