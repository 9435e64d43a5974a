"""The subscriptions of one worker's robots to live maps: the newest value of each key, to each reader.

A map's present values are kept once for all of its readers, so that a slow reader costs the names of the keys
that it has not got yet, and no value.  Who may subscribe is decided elsewhere.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.errors import BadMessage, RsePfError
from rse_pf.server.ports import Log, Subscriber
from rse_pf.wire import Update
from rse_pf.wire.live_map import live_topic
from rse_pf.wire.preencoded import encode_payload
from rse_pf.wire.server_session import ServerSession

__all__ = ["Subscriptions"]

_GATHER_S = 0.01
"""Values leave this long after the last ones, or at once; until then they replace each other."""
_RETRY_S = 0.05
"""A reader whose socket is full is looked at again after this time."""
_MAX_UNSENT_BYTES = 16_384
"""Above this a reader gets no updates until it has read; the answers to its commands come in any case."""
_MAX_SENT_AT_ONCE = 200
"""Updates in one round of the event loop; each takes about 20 us, and robots' commands wait meanwhile."""
_MAX_KEYS = 1024
"""Values of one map; the one that changed longest ago is forgotten first."""
_MAX_VALUE_BYTES = 65_536
_NO_OWNER = {"kind": "map", "keyframes": 0, "version": 0, "owner": "", "state": "moving"}
"""The value of the key ``map`` as long as the map's owner has sent none."""


@dataclass(eq=False, slots=True)
class _Value:
    """A payload, and its bytes in each encoding that a reader uses."""

    payload: dict[str, Any]
    encoded: dict[bool, msgspec.Raw | None] = field(default_factory=dict)


@dataclass(eq=False, slots=True)
class _Topic:
    """A map with at least one reader."""

    tenant: str
    map_name: str
    values: dict[str, _Value] = field(default_factory=dict)
    readers: dict[_Subscription, None] = field(default_factory=dict)
    starters: set[_Subscription] = field(default_factory=set)
    """Those for whom an owner is started."""


@dataclass(eq=False, slots=True)
class _Subscription:
    reader: Subscriber
    id: int
    topic: _Topic
    may_go_on: Callable[[], RsePfError | None]
    seq: int = 0
    waiting: dict[str, int] = field(default_factory=dict)
    """How many values each key has had since the reader got one; the key that waited longest comes first."""


class Subscriptions:
    """All subscriptions of one worker."""

    def __init__(
        self,
        *,
        loop: AbstractEventLoop,
        log: Log,
        watch: Callable[[str, str, bool], None],
        unwatch: Callable[[str, str], None],
    ) -> None:
        """Serve no reader yet.

        Args:
            loop: Event loop of the worker.
            log: Of the worker.
            watch: Called with tenant and map when its first reader comes, and whether an owner may be
                started for its readers; again when that changes.
            unwatch: Called when its last reader has left.
        """
        self.sent = self.replaced = 0
        """Values that were sent, and those that newer ones replaced before."""
        self._loop = loop
        self._log = log
        self._watch = watch
        self._unwatch = unwatch
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._of_reader: dict[Subscriber, dict[int, _Subscription]] = {}
        self._due: dict[_Subscription, None] = {}
        self._slow: dict[_Subscription, None] = {}
        self._is_sending = self._is_retrying = False
        self._sent_s = float("-inf")

    def __len__(self) -> int:
        """Return how many subscriptions there are."""
        return sum(len(own) for own in self._of_reader.values())

    def begin(
        self,
        reader: Subscriber,
        identity: int,
        tenant: str,
        map_name: str,
        *,
        may_go_on: Callable[[], RsePfError | None],
        may_start: bool = True,
    ) -> None:
        """Send the present values of a map to *reader*, and then each newer one.

        Args:
            reader: The robot's connection.
            identity: The robot's id of the subscription.
            tenant: Of the robot.
            map_name: A map of the tenant.
            may_go_on: Returns why the robot may read the map no longer; called before anything is sent.
            may_start: Whether an owner is started for this reader if the map has none.
        """
        key = (tenant, map_name)
        topic = self._topics.get(key)
        is_new = topic is None
        if topic is None:
            topic = self._topics[key] = _Topic(tenant, map_name)
            topic.values["map"] = _Value(_NO_OWNER)
        subscription = _Subscription(reader, identity, topic, may_go_on)
        topic.readers[subscription] = None
        self._of_reader.setdefault(reader, {})[identity] = subscription
        subscription.waiting = dict.fromkeys(topic.values, 1)
        reader.bound_unsent(_MAX_UNSENT_BYTES)
        self._send_soon(subscription)
        if is_new:
            self._watch(tenant, map_name, may_start)
        if may_start:
            self._set_starter(subscription, is_starter=True, is_told=is_new)

    def stop_starting(self, reader: Subscriber, identity: int) -> None:
        """Start no owner for this subscription any more: the reader may only watch from now on."""
        subscription = self._of_reader.get(reader, {}).get(identity)
        if subscription is not None:
            self._set_starter(subscription, is_starter=False)

    def _set_starter(self, subscription: _Subscription, *, is_starter: bool, is_told: bool = False) -> None:
        topic = subscription.topic
        before = bool(topic.starters)
        (topic.starters.add if is_starter else topic.starters.discard)(subscription)
        if topic.readers and bool(topic.starters) != before and not is_told:
            self._watch(topic.tenant, topic.map_name, is_starter)

    def end(self, reader: Subscriber, identity: int) -> None:
        """Send no more to a subscription; does nothing if it has ended."""
        own = self._of_reader.get(reader, {})
        subscription = own.pop(identity, None)
        if subscription is None:
            return
        if not own:
            del self._of_reader[reader]
        self._due.pop(subscription, None)
        self._slow.pop(subscription, None)
        topic = subscription.topic
        del topic.readers[subscription]
        self._set_starter(subscription, is_starter=False)
        if not topic.readers:
            del self._topics[topic.tenant, topic.map_name]
            self._unwatch(topic.tenant, topic.map_name)

    def left(self, reader: Subscriber) -> None:
        """End all subscriptions of a connection that ended."""
        for identity in list(self._of_reader.get(reader, ())):
            self.end(reader, identity)

    def update(self, tenant: str, map_name: str, key: str, payload: dict[str, Any]) -> None:
        """Take the newest value of one key of a map; it is forgotten if nobody reads the map."""
        topic = self._topics.get((tenant, map_name))
        if topic is None:
            return
        topic.values.pop(key, None)
        topic.values[key] = _Value(payload)
        if len(topic.values) > _MAX_KEYS:
            oldest = next(iter(topic.values))
            del topic.values[oldest]
            for subscription in topic.readers:
                subscription.waiting.pop(oldest, None)
        for subscription in topic.readers:
            subscription.waiting[key] = subscription.waiting.get(key, 0) + 1
            if subscription not in self._slow:
                self._send_soon(subscription)

    def _send_soon(self, subscription: _Subscription) -> None:
        self._due[subscription] = None
        if not self._is_sending:
            self._is_sending = True
            self._loop.call_later(max(0.0, self._sent_s + _GATHER_S - self._loop.time()), self._send)

    def _send(self) -> None:
        """Send what is due, up to a bound; then the event loop serves the robots' commands first."""
        self._sent_s = self._loop.time()
        left = _MAX_SENT_AT_ONCE
        while self._due and left > 0:
            subscription = next(iter(self._due))
            del self._due[subscription]
            left = self._send_to(subscription, left)
        self._is_sending = bool(self._due)
        if self._is_sending:
            self._loop.call_soon(self._send)

    def _send_to(self, subscription: _Subscription, left: int) -> int:
        """Send up to *left* values to one reader; return how many more may be sent."""
        reader, session = subscription.reader, subscription.reader.session
        if session is None or not reader.is_connected:
            return left
        forbidden = subscription.may_go_on()
        if forbidden is not None:
            self.end(reader, subscription.id)
            reader.refuse_updates(subscription.id, forbidden)
            return left
        topic, waiting = subscription.topic, subscription.waiting
        while waiting:
            if reader.unsent_bytes > _MAX_UNSENT_BYTES:
                self._retry_later(subscription)
                return left
            if left <= 0:
                self._due[subscription] = None
                return left
            key = next(iter(waiting))
            count = waiting.pop(key)
            encoded = self._encoded(topic, key, topic.values[key], session)
            if encoded is None:
                continue
            subscription.seq += count
            update = Update(
                id=subscription.id, topic=live_topic(topic.map_name), seq=subscription.seq, key=key,
                payload=encoded,
            )  # fmt: skip
            reader.write(session.codec.encode(update))
            self.sent += 1
            self.replaced += count - 1
            left -= 1
        return left

    def _encoded(self, topic: _Topic, key: str, value: _Value, session: ServerSession) -> msgspec.Raw | None:
        """Return the payload as the reader's codec has it; None if it cannot be sent."""
        is_binary = session.codec.name == "bin"
        if is_binary in value.encoded:
            return value.encoded[is_binary]
        why, encoded = "", None
        try:
            data = encode_payload(session.codec, value.payload)
        except BadMessage as error:
            why = error.message
        else:
            encoded = msgspec.Raw(data) if len(data) <= _MAX_VALUE_BYTES else None
            why = f"{len(data)} bytes are above {_MAX_VALUE_BYTES}"
        if encoded is None:
            self._log.error("update-not-sent", map=topic.map_name, key=key, reason=why)
        value.encoded[is_binary] = encoded
        return encoded

    def _retry_later(self, subscription: _Subscription) -> None:
        self._slow[subscription] = None
        if not self._is_retrying:
            self._is_retrying = True
            self._loop.call_later(_RETRY_S, self._retry)

    def _retry(self) -> None:
        slow, self._slow = self._slow, {}
        self._is_retrying = False
        for subscription in slow:
            self._send_soon(subscription)
