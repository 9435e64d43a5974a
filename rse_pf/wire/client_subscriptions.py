"""The subscriptions of a robot: they outlive its connections, and begin again on each new one.

Messages and the time go in, messages to send and events come out.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from rse_pf.wire.messages import Failure, Message, Subscribe, Unsubscribe, Update

__all__ = ["ClientSubscriptions", "SubscriptionEnded", "Updated"]

_UNHEARD_S = 5.0
"""A server sends the present state at once; after this time without an update the robot asks again."""
_MAX_TRIES = 3


@dataclass(frozen=True, slots=True)
class Updated:
    """The newest value of one key of a subscription's topic."""

    id: int
    key: str
    payload: Any


@dataclass(frozen=True, slots=True)
class SubscriptionEnded:
    """The server refused or ended a subscription."""

    id: int
    failure: Failure


@dataclass(slots=True, kw_only=True)
class _Subscription:
    topic: str
    tries: int = 0
    again_s: float | None = None
    """When to ask the current connection again; None once it answered."""


class ClientSubscriptions:
    """All subscriptions of one robot, and the connection that they are on."""

    def __init__(self) -> None:
        """Begin without a subscription and without a connection."""
        self.replaced = 0
        """How many values servers left out, because newer ones of the same key replaced them."""
        self._live: dict[int, _Subscription] = {}
        self._connection: Hashable | None = None
        self._last_seq: dict[int, int] = {}

    def __contains__(self, identity: int | None) -> bool:
        """Return whether a live subscription has this id."""
        return identity in self._live

    def add(self, identity: int, topic: str, now: float) -> list[Message]:
        """Begin a subscription; return what to send on the current connection."""
        self._live[identity] = _Subscription(topic=topic)
        return [self._ask(identity, now)] if self._connection is not None else []

    def remove(self, identity: int) -> list[Message]:
        """End a subscription; return what to send on the current connection."""
        known = self._live.pop(identity, None)
        return [] if known is None or self._connection is None else [Unsubscribe(id=identity)]

    def adopt(self, connection: Hashable, now: float) -> list[Message]:
        """Begin every subscription on a new *connection*; return what to send on it."""
        self._connection = connection
        for subscription in self._live.values():
            subscription.tries = 0
        return [self._ask(identity, now) for identity in self._live]

    def lose(self, connection: Hashable) -> None:
        """Suspend the subscriptions, because *connection* ended; they wait for the next one."""
        if self._connection is connection:
            self._connection = None

    def update(self, connection: Hashable, update: Update) -> list[Updated]:
        """Return the event of an update; none if it is of a subscription or a connection that ended."""
        subscription = self._live.get(update.id)
        if subscription is None or connection is not self._connection or update.topic != subscription.topic:
            return []
        subscription.again_s = None
        self.replaced += max(0, update.seq - self._last_seq.get(update.id, 0) - 1)
        self._last_seq[update.id] = update.seq
        return [Updated(update.id, update.key, update.payload)]

    def refuse(self, connection: Hashable, failure: Failure) -> list[SubscriptionEnded]:
        """Return the end of the subscription that *failure* names; none if it names none."""
        if failure.id not in self._live or connection is not self._connection:
            return []
        del self._live[failure.id]
        return [SubscriptionEnded(failure.id, failure)]

    def due(self, now: float) -> tuple[list[Message], list[SubscriptionEnded]]:
        """Return the messages to send again, and the ends of subscriptions that no server answered."""
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
        """End every subscription, because no further connection will be opened."""
        ended = [
            SubscriptionEnded(identity, Failure(id=identity, code=code, message=message, hint=hint))
            for identity in self._live
        ]
        self._live.clear()
        return ended

    def _ask(self, identity: int, now: float) -> Subscribe:
        subscription = self._live[identity]
        subscription.tries += 1
        subscription.again_s = now + _UNHEARD_S
        self._last_seq.pop(identity, None)
        return Subscribe(id=identity, topic=subscription.topic)
