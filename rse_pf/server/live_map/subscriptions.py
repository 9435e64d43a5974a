"""Send the robots of one worker the newest update of each key of the live maps to which they subscribe.

The newest updates of a map are stored once for all its subscribers.  For a slow subscriber, only the keys are
stored whose newest update it has not received, so memory is bounded: the subscriber later receives the newest
update of each of these keys, and none of those between.  Who may subscribe is decided by the caller.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.errors import BadMessage, RsePfError
from rse_pf.server.worker_context import Log, Subscriber
from rse_pf.wire import Update
from rse_pf.wire.live_map import live_topic
from rse_pf.wire.preencoded import encode_payload
from rse_pf.wire.server_session import ServerSession

__all__ = ["Subscriptions"]

_MIN_ROUND_INTERVAL_S = 0.01
"""Shortest time in seconds between two rounds of sending; updates that arrive in between replace older ones
of their key.  After a round that could not send all due updates, the next one follows without a pause."""
_SLOW_RETRY_S = 0.05
"""Seconds after which a subscriber whose socket was full is tried again."""
_MAX_UNSENT_BYTES = 16_384
"""Bytes that may wait in the socket of a subscriber.  Above this limit no updates are written until the
subscriber has read some bytes; answers to commands are written in any case."""
_MAX_SENT_PER_ROUND = 200
"""Largest number of updates that are sent in one round.  An update takes about 20 us, and commands of robots
wait until the round has ended."""
_MAX_KEYS = 1024
"""Largest number of keys of one map whose newest update is stored; beyond it, the oldest update is dropped,
and is not sent to subscribers that have not received it."""
_MAX_UPDATE_BYTES = 65_536
"""Largest encoded payload of an update in bytes; a larger one is logged and not sent."""
_UPDATE_WITHOUT_MAP_SERVER = {"kind": "map", "keyframes": 0, "version": 0, "owner": "", "state": "moving"}
"""Update of the key ``map`` that subscribers of a live map get until its map server has sent one."""


@dataclass(eq=False, slots=True)
class _MapUpdate:
    """The payload of an update, with its encodings for the binary codec (True) and for JSON (False).

    An encoding is made when a subscriber needs it first; it is None if the update cannot be sent.
    """

    payload: dict[str, Any]
    encoded: dict[bool, msgspec.Raw | None] = field(default_factory=dict)


@dataclass(eq=False, slots=True)
class _WatchedMap:
    """A live map to which at least one robot of this worker subscribes."""

    tenant: str
    name: str
    updates: dict[str, _MapUpdate] = field(default_factory=dict)  # newest update by key, the oldest first
    subscriptions: dict[_Subscription, None] = field(default_factory=dict)
    starters: set[_Subscription] = field(default_factory=set)  # those for which a map server may be started
    may_start: bool | None = None  # whether `watch` was last called with True or False; None: not called yet


@dataclass(eq=False, slots=True)
class _Subscription:
    """A subscription of one connection to one map; ``id`` is the robot's id of the subscription."""

    subscriber: Subscriber
    id: int
    map: _WatchedMap
    find_error: Callable[[], RsePfError | None]
    # Sequence number of the last update that was sent.  Replaced updates count too: a gap in the numbers
    # shows a subscriber how many updates it did not get.
    seq: int = 0
    unsent: dict[str, int] = field(default_factory=dict)
    """For each key with an unsent update, the number of updates of this key since the last one that was sent.
    The key that has waited longest comes first."""


class Subscriptions:
    """All subscriptions of one worker to live maps; all methods are called in the event loop."""

    def __init__(
        self,
        *,
        loop: AbstractEventLoop,
        log: Log,
        watch: Callable[[str, str, bool], None],
        unwatch: Callable[[str, str], None],
    ) -> None:
        """Begin without subscriptions.

        Args:
            loop: Event loop of the worker.
            log: Log of the worker.
            watch: Called with tenant, map name, and whether a map server may be started, when a map gets its
                first subscription, and when the third value changes.
            unwatch: Called with tenant and map name when a map has lost its last subscription.
        """
        self.sent = 0
        """Number of updates that were sent, once for each subscriber."""
        self.replaced = 0
        """Number of updates that were not sent to a subscriber, because a newer one replaced them, once for
        each subscriber."""
        self._loop = loop
        self._log = log
        self._watch = watch
        self._unwatch = unwatch
        self._maps: dict[tuple[str, str], _WatchedMap] = {}  # keyed by tenant and map name
        self._by_subscriber: dict[Subscriber, dict[int, _Subscription]] = {}
        self._due: dict[_Subscription, None] = {}  # subscriptions that the next round serves
        self._slow: dict[_Subscription, None] = {}  # subscriptions whose socket was full
        self._has_round = False  # whether the next round of sending is scheduled
        self._has_slow_retry = False  # whether a retry for subscriptions with a full socket is scheduled
        self._last_round_s = float("-inf")

    def __len__(self) -> int:
        """Return the number of subscriptions of this worker to live maps."""
        return sum(len(subscriptions) for subscriptions in self._by_subscriber.values())

    def begin(
        self,
        subscriber: Subscriber,
        identity: int,
        tenant: str,
        map_name: str,
        *,
        find_error: Callable[[], RsePfError | None],
        may_start: bool = True,
    ) -> None:
        """Send a subscriber the newest update of each key of a map soon, and newer ones when they arrive.

        A map without updates of its map server has one update of the key ``map`` with the state "moving".

        Args:
            subscriber: Connection of the robot.
            identity: The robot's id of the subscription.
            tenant: Tenant of the robot.
            map_name: Name of a live map of the tenant.
            find_error: Returns an error if the robot may no longer read the map; called before each sending.
            may_start: Whether a map server is started for this subscription if the map has none.
        """
        watched_map = self._maps.get((tenant, map_name))
        if watched_map is None:
            watched_map = self._maps[tenant, map_name] = _WatchedMap(tenant, map_name)
            watched_map.updates["map"] = _MapUpdate(_UPDATE_WITHOUT_MAP_SERVER)
        subscription = _Subscription(subscriber, identity, watched_map, find_error)
        watched_map.subscriptions[subscription] = None
        self._by_subscriber.setdefault(subscriber, {})[identity] = subscription
        subscription.unsent = dict.fromkeys(watched_map.updates, 1)
        subscriber.bound_unsent(_MAX_UNSENT_BYTES)
        self._schedule(subscription)
        if may_start:
            watched_map.starters.add(subscription)
        self._update_watch(watched_map)

    def stop_starting(self, subscriber: Subscriber, identity: int) -> None:
        """Start no map server for a subscription from now on, because the robot may only watch the map.

        Nothing happens if the subscription has ended.
        """
        subscription = self._by_subscriber.get(subscriber, {}).get(identity)
        if subscription is not None:
            subscription.map.starters.discard(subscription)
            self._update_watch(subscription.map)

    def _update_watch(self, watched_map: _WatchedMap) -> None:
        """Call ``watch`` for a map that is new, or if it has changed whether a map server may be started."""
        may_start = bool(watched_map.starters)
        if may_start != watched_map.may_start:
            watched_map.may_start = may_start
            self._watch(watched_map.tenant, watched_map.name, may_start)

    def end(self, subscriber: Subscriber, identity: int) -> None:
        """End the subscription *identity* of a subscriber; does nothing if it has ended already."""
        subscriptions = self._by_subscriber.get(subscriber, {})
        subscription = subscriptions.pop(identity, None)
        if subscription is None:
            return
        if not subscriptions:
            del self._by_subscriber[subscriber]
        self._due.pop(subscription, None)
        self._slow.pop(subscription, None)
        watched_map = subscription.map
        del watched_map.subscriptions[subscription]
        watched_map.starters.discard(subscription)
        if watched_map.subscriptions:
            self._update_watch(watched_map)
        else:
            del self._maps[watched_map.tenant, watched_map.name]
            self._unwatch(watched_map.tenant, watched_map.name)

    def end_all(self, subscriber: Subscriber) -> None:
        """End all subscriptions of a robot whose connection was closed."""
        for identity in list(self._by_subscriber.get(subscriber, ())):
            self.end(subscriber, identity)

    def update(self, tenant: str, map_name: str, key: str, payload: dict[str, Any]) -> None:
        """Replace the newest update of *key* and schedule it for all subscribers of the map.

        The update of a map without subscribers is dropped.
        """
        watched_map = self._maps.get((tenant, map_name))
        if watched_map is None:
            return
        watched_map.updates.pop(key, None)
        watched_map.updates[key] = _MapUpdate(payload)
        if len(watched_map.updates) > _MAX_KEYS:
            oldest = next(iter(watched_map.updates))
            del watched_map.updates[oldest]
            for subscription in watched_map.subscriptions:
                subscription.unsent.pop(oldest, None)
        for subscription in watched_map.subscriptions:
            subscription.unsent[key] = subscription.unsent.get(key, 0) + 1
            if subscription not in self._slow:
                self._schedule(subscription)

    def _schedule(self, subscription: _Subscription) -> None:
        """Let the next round of sending serve *subscription*, at least 10 ms after the last round began."""
        self._due[subscription] = None
        if not self._has_round:
            self._has_round = True
            delay_s = self._last_round_s + _MIN_ROUND_INTERVAL_S - self._loop.time()
            self._loop.call_later(max(0.0, delay_s), self._send_round)

    def _send_round(self) -> None:
        """Send up to 200 due updates; the others follow after the event loop has done its other work."""
        self._last_round_s = self._loop.time()
        remaining = _MAX_SENT_PER_ROUND
        while self._due and remaining > 0:
            subscription = next(iter(self._due))
            del self._due[subscription]
            remaining = self._send_to(subscription, remaining)
        self._has_round = bool(self._due)
        if self._has_round:
            self._loop.call_soon(self._send_round)

    def _send_to(self, subscription: _Subscription, remaining: int) -> int:
        """Send up to *remaining* updates to one subscriber; return how many more the round may send.

        A subscription whose robot may no longer read the map ends here.  If the socket is full, the rest is
        tried again after 0.05 s; if the round may send no more, the next round sends the rest.
        """
        subscriber, session = subscription.subscriber, subscription.subscriber.session
        if session is None or not subscriber.is_connected:
            return remaining
        error = subscription.find_error()
        if error is not None:
            self.end(subscriber, subscription.id)
            subscriber.refuse_updates(subscription.id, error)
            return remaining
        watched_map, unsent = subscription.map, subscription.unsent
        while unsent:
            if subscriber.unsent_bytes > _MAX_UNSENT_BYTES:
                self._retry_later(subscription)
                return remaining
            if remaining <= 0:
                self._due[subscription] = None
                return remaining
            key = next(iter(unsent))
            count = unsent.pop(key)
            encoded = self._encode(watched_map, key, session)
            if encoded is None:
                continue
            subscription.seq += count
            update = Update(
                id=subscription.id,
                topic=live_topic(watched_map.name),
                seq=subscription.seq,
                key=key,
                payload=encoded,
            )
            subscriber.write(session.codec.encode(update))
            self.sent += 1
            self.replaced += count - 1
            remaining -= 1
        return remaining

    def _encode(self, watched_map: _WatchedMap, key: str, session: ServerSession) -> msgspec.Raw | None:
        """Return the newest payload of *key* in the codec of the session, or None if it cannot be sent.

        The first failure of an update is logged.
        """
        update = watched_map.updates[key]
        is_binary = session.codec.name == "bin"
        if is_binary in update.encoded:
            return update.encoded[is_binary]
        reason, encoded = "", None
        try:
            data = encode_payload(session.codec, update.payload)
        except BadMessage as error:
            reason = error.message
        else:
            encoded = msgspec.Raw(data) if len(data) <= _MAX_UPDATE_BYTES else None
            reason = f"{len(data)} bytes are above {_MAX_UPDATE_BYTES}"
        if encoded is None:
            self._log.error("update-not-sent", map=watched_map.name, key=key, reason=reason)
        update.encoded[is_binary] = encoded
        return encoded

    def _retry_later(self, subscription: _Subscription) -> None:
        """Try *subscription*, whose socket is full, again after at most 0.05 s."""
        self._slow[subscription] = None
        if not self._has_slow_retry:
            self._has_slow_retry = True
            self._loop.call_later(_SLOW_RETRY_S, self._retry_slow)

    def _retry_slow(self) -> None:
        slow, self._slow = self._slow, {}
        self._has_slow_retry = False
        for subscription in slow:
            self._schedule(subscription)
