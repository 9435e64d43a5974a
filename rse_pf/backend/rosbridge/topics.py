"""The topics of the rosbridge clients of one worker: who publishes, who subscribes, and what is sent when.

A topic belongs to a tenant.  A message is kept once for all of its subscribers; one that reads slowly gets
the newest ones and delays nobody.  Other workers' clients are reached through `TopicPeers`.
"""

from __future__ import annotations

import re
from asyncio import AbstractEventLoop, TimerHandle
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Protocol

import msgspec

from rse_pf.auth.roster import scopes_allow
from rse_pf.backend.ports import Subscriber
from rse_pf.backend.rosbridge.codec import RosbridgeOp
from rse_pf.backend.rosbridge.session import RosbridgeSession
from rse_pf.backend.rosbridge.subscription import MAX_QUEUE_LENGTH, HeldBytes, Subscription, TopicMessage
from rse_pf.errors import (
    BadRequest,
    Conflict,
    Forbidden,
    QuotaExceeded,
    RsePfError,
    UnknownService,
    UnsupportedProtocol,
)

__all__ = ["RosbridgeTopics", "TopicPeers"]

MAX_TOPICS = 64
"""Topics that one client advertises."""
MAX_SUBSCRIPTIONS = 64
"""Subscriptions of one client, counted by their ids."""
MAX_TOPICS_OF_TENANT = 1000
"""Topics of one tenant in one worker."""
MAX_LATCHED_BYTES = 4 << 20
"""Latched messages of one tenant in one worker, all together."""
_MAX_UNSENT_BYTES = 16_384
"""Above this a client gets no messages until it has read; the answers to its calls come in any case."""
_RETRY_S = 0.02
_MAX_SENT_AT_ONCE = 100
"""Messages in one round of the event loop; robots' commands wait meanwhile."""
_MAX_PAUSE_S = 3600.0
_NAME = re.compile(r"/?[A-Za-z~][A-Za-z0-9_~.-]{0,127}(?:/[A-Za-z0-9_~.-]{1,128}){0,16}")

Key = tuple[str, str]
"""Tenant and topic, without the slash before its name."""


class TopicPeers(Protocol):
    """What is needed of the way to other workers; `rse_pf.backend.rosbridge.peers.WorkerPeers` is one."""

    def tell(self, key: Key, kind: str, *, exists: bool, is_wanted: bool) -> None:
        """Report to the others whether a topic exists here, and whether somebody subscribes to it."""

    def publish(self, key: Key, data: bytes) -> None:
        """Send a message to the others that want the topic."""

    def topics(self, tenant: str) -> dict[str, str]:
        """Return the types of the others' topics of *tenant*, by their names."""


@dataclass(eq=False, slots=True)
class _Topic:
    key: Key
    kind: str
    publishers: dict[Subscriber, bool] = field(default_factory=dict)
    """Whether a publisher latches."""
    subscriptions: dict[Subscriber, Subscription] = field(default_factory=dict)
    latched: dict[Subscriber, TopicMessage] = field(default_factory=dict)


class RosbridgeTopics:
    """All topics of one worker."""

    def __init__(
        self,
        *,
        loop: AbstractEventLoop,
        clock: Callable[[], float],
        services: Iterable[str],
        peers: TopicPeers,
    ) -> None:
        """Know no topic yet.

        Args:
            loop: Event loop of the worker.
            clock: The monotonic clock, s.
            services: Names of the services of this server.
            peers: The way to other workers.
        """
        self.sent = self.replaced = 0
        """Messages that were sent, and those that newer ones replaced before."""
        self._loop = loop
        self._clock = clock
        self._services = tuple(services)
        self._peers = peers
        self._topics: dict[Key, _Topic] = {}
        self._per_tenant: dict[str, int] = {}
        self._latched_bytes: dict[str, int] = {}
        self._held: dict[str, HeldBytes] = {}
        self._of_client: dict[Subscriber, dict[Key, None]] = {}
        self._due: dict[Subscription, None] = {}
        self._slow: dict[Subscription, None] = {}
        self._resting: dict[Subscription, TimerHandle] = {}
        self._is_sending = self._is_retrying = False

    def offer(self, services: Iterable[str]) -> None:
        """Replace the names of the services of this server."""
        self._services = tuple(services)

    def report(self) -> dict[str, float]:
        """Return the gauges of this worker."""
        subscriptions = sum(len(topic.subscriptions) for topic in self._topics.values())
        return {
            "rosbridge_topics": float(len(self._topics)),
            "rosbridge_subscriptions": float(subscriptions),
            "rosbridge_sent": float(self.sent),
            "rosbridge_replaced": float(self.replaced),
        }

    def execute(self, client: Subscriber, session: RosbridgeSession, op: RosbridgeOp) -> None:
        """Execute one operation of a client, or tell it why not."""
        try:
            if op.op == "call_service":
                self._answer(client, session, op)
            else:
                self._execute(client, op)
        except RsePfError as error:
            for send in session.refuse(op, error):
                client.write(send.data)

    def leave(self, client: Subscriber) -> None:
        """Forget a client whose connection ended."""
        for key in list(self._of_client.get(client, ())):
            topic = self._topics[key]
            topic.publishers.pop(client, None)
            self._unlatch(topic, client)
            self._end(topic, client)
            self._settle(topic, client)

    def deliver(self, key: Key, data: bytes) -> None:
        """Deliver a message that a client of another worker published."""
        topic = self._topics.get(key)
        if topic is not None:
            self._queue_message(topic, TopicMessage(data))

    def send_latched(self, key: Key) -> None:
        """Send the latched messages of a topic to another worker, which has its first subscriber."""
        topic = self._topics.get(key)
        for message in () if topic is None else topic.latched.values():
            self._peers.publish(key, message.data)

    # --- operations ----------------------------------------------------------------------------

    def _execute(self, client: Subscriber, op: RosbridgeOp) -> None:
        key = self._key(client, op.topic)
        reads = op.op in ("subscribe", "unsubscribe")
        right = "topics:read" if reads else "topics:write"
        if client.claims is not None and not scopes_allow(client.claims.scopes, right):
            raise Forbidden(f"this token does not hold the scope {right}", hint="issue one that does")
        if op.op == "subscribe":
            self._subscribe(client, key, op)
        elif op.op == "unsubscribe":
            self._unsubscribe(client, key, op)
        elif op.op == "advertise":
            self._advertise(client, key, op)
        elif op.op == "unadvertise":
            self._unadvertise(client, key)
        else:
            self._publish(client, key, op)

    def _key(self, client: Subscriber, topic: str) -> Key:
        if not _NAME.fullmatch(topic) or not {".", ".."}.isdisjoint(topic.split("/")):
            raise BadRequest(f"{topic[:80]!r} is no name of a topic", hint="use a ROS name such as /scan")
        return client.robot.tenant, topic.removeprefix("/")

    def _advertise(self, client: Subscriber, key: Key, op: RosbridgeOp) -> _Topic:
        own = self._of_client.get(client, ())
        topic = self._topics.get(key)
        if topic is None or client not in topic.publishers:
            count = sum(1 for own_key in own if client in self._topics[own_key].publishers)
            if count >= MAX_TOPICS:
                raise QuotaExceeded(f"this client advertises {count} topics already", hint="unadvertise one")
        topic = self._use_topic(client, key, op.type or "")
        topic.publishers[client] = bool(op.latch) or topic.publishers.get(client, False)
        return topic

    def _unadvertise(self, client: Subscriber, key: Key) -> None:
        topic = self._topics.get(key)
        if topic is not None and topic.publishers.pop(client, None) is not None:
            self._unlatch(topic, client)
            self._settle(topic, client)

    def _publish(self, client: Subscriber, key: Key, op: RosbridgeOp) -> None:
        topic = self._topics.get(key)
        if topic is None or client not in topic.publishers:
            topic = self._advertise(client, key, op)
        data = bytes(op.msg)
        message = TopicMessage(data)
        if op.latch or topic.publishers[client]:
            self._latch(topic, client, message)
        self._queue_message(topic, message)
        self._peers.publish(key, data)

    def _subscribe(self, client: Subscriber, key: Key, op: RosbridgeOp) -> None:
        if op.compression not in (None, "", "none"):
            raise UnsupportedProtocol(
                f"compression {op.compression[:20]!r} is not supported here", hint="subscribe with none"
            )
        count = sum(
            len(self._topics[own_key].subscriptions[client].requests)
            for own_key in self._of_client.get(client, ())
            if client in self._topics[own_key].subscriptions
        )
        if count >= MAX_SUBSCRIPTIONS:
            raise QuotaExceeded(f"this client has {count} subscriptions already", hint="unsubscribe one")
        topic = self._use_topic(client, key, op.type or "")
        subscription = topic.subscriptions.get(client)
        is_first = not topic.subscriptions
        is_new = subscription is None
        if subscription is None:
            held = self._held.setdefault(key[0], HeldBytes())
            subscription = topic.subscriptions[client] = Subscription(client, op.topic, held)
            client.bound_unsent(_MAX_UNSENT_BYTES)
        pause_s = min(_MAX_PAUSE_S, max(0.0, (op.throttle_rate or 0.0) / 1e3))
        subscription.requests[op.id] = pause_s, min(MAX_QUEUE_LENGTH, max(1, op.queue_length or 1))
        if is_first:
            self._tell(topic)
        if is_new:
            for message in topic.latched.values():
                subscription.put(message)
            if subscription:
                self._send_soon(subscription)

    def _unsubscribe(self, client: Subscriber, key: Key, op: RosbridgeOp) -> None:
        topic = self._topics.get(key)
        subscription = None if topic is None else topic.subscriptions.get(client)
        if topic is None or subscription is None:
            return
        subscription.requests.pop(op.id, None)
        if op.id is None or not subscription.requests:
            self._end(topic, client)
            self._settle(topic, client)

    # --- topics --------------------------------------------------------------------------------

    def _use_topic(self, client: Subscriber, key: Key, kind: str) -> _Topic:
        """Return the topic *key*, which *client* uses from now on as one of messages of type *kind*."""
        topic = self._topics.get(key)
        present = self._peers.topics(key[0]).get(key[1], "") if topic is None else topic.kind
        if kind and present and kind != present:
            raise Conflict(f"topic {key[1]} has the type {present}, not {kind}", hint="use its type")
        if topic is None:
            count = self._per_tenant.get(key[0], 0)
            if count >= MAX_TOPICS_OF_TENANT:
                raise QuotaExceeded(f"the tenant has {count} topics already", hint="use fewer topics")
            self._per_tenant[key[0]] = count + 1
            topic = self._topics[key] = _Topic(key, kind or present)
            self._tell(topic)
        elif kind and not topic.kind:
            topic.kind = kind
            self._tell(topic)
        self._of_client.setdefault(client, {})[key] = None
        return topic

    def _settle(self, topic: _Topic, client: Subscriber) -> None:
        """Drop *topic* from those of *client* if it uses it no longer, and altogether if nobody does."""
        if client in topic.publishers or client in topic.subscriptions:
            return
        own = self._of_client.get(client, {})
        own.pop(topic.key, None)
        if not own:
            self._of_client.pop(client, None)
        if topic.publishers or topic.subscriptions or self._topics.pop(topic.key, None) is None:
            return
        tenant = topic.key[0]
        self._per_tenant[tenant] -= 1
        if not self._per_tenant[tenant]:
            del self._per_tenant[tenant]
            self._held.pop(tenant, None)
        self._peers.tell(topic.key, topic.kind, exists=False, is_wanted=False)

    def _tell(self, topic: _Topic) -> None:
        self._peers.tell(topic.key, topic.kind, exists=True, is_wanted=bool(topic.subscriptions))

    def _end(self, topic: _Topic, client: Subscriber) -> None:
        """End a subscription."""
        subscription = topic.subscriptions.pop(client, None)
        if subscription is None:
            return
        self.replaced += subscription.replaced
        self._due.pop(subscription, None)
        self._slow.pop(subscription, None)
        resting = self._resting.pop(subscription, None)
        if resting is not None:
            resting.cancel()  # it would keep the messages that wait, for an hour
        subscription.clear()
        if not topic.subscriptions:
            self._tell(topic)

    def _latch(self, topic: _Topic, client: Subscriber, message: TopicMessage) -> None:
        tenant = topic.key[0]
        self._unlatch(topic, client)
        held = self._latched_bytes.get(tenant, 0) + len(message.data)
        if held > MAX_LATCHED_BYTES:
            raise QuotaExceeded(
                f"latched messages of {held} bytes are above {MAX_LATCHED_BYTES}", hint="latch less"
            )
        self._latched_bytes[tenant] = held
        topic.latched[client] = message

    def _unlatch(self, topic: _Topic, client: Subscriber) -> None:
        message = topic.latched.pop(client, None)
        if message is not None:
            tenant = topic.key[0]
            self._latched_bytes[tenant] -= len(message.data)
            if not self._latched_bytes[tenant]:
                del self._latched_bytes[tenant]

    # --- sending -------------------------------------------------------------------------------

    def _queue_message(self, topic: _Topic, message: TopicMessage) -> None:
        for subscription in topic.subscriptions.values():
            subscription.put(message)
            if subscription in self._slow or subscription in self._resting:
                subscription.drop_surplus()
            else:
                self._send_soon(subscription)

    def _send_soon(self, subscription: Subscription) -> None:
        self._due[subscription] = None
        if not self._is_sending:
            self._is_sending = True
            self._loop.call_soon(self._send)

    def _send(self) -> None:
        """Send the messages that are due, up to a bound; the event loop then serves commands first."""
        now = self._clock()
        budget = _MAX_SENT_AT_ONCE
        while self._due and budget > 0:
            subscription = next(iter(self._due))
            del self._due[subscription]
            budget -= self._send_to(subscription, now, budget)
        self._is_sending = bool(self._due)
        if self._is_sending:
            self._loop.call_soon(self._send)

    def _send_to(self, subscription: Subscription, now: float, most: int) -> int:
        """Send up to *most* messages to one subscriber; return how many were sent."""
        client, count = subscription.owner, 0
        claims = client.claims
        if not client.is_connected or (claims and not scopes_allow(claims.scopes, "topics:read")):
            return 1
        while subscription:
            wait_s = subscription.wait_s(now)
            if wait_s > 0:
                subscription.drop_surplus()
                self._resting[subscription] = self._loop.call_later(
                    wait_s, self._send_after_rest, subscription
                )
                break
            if client.unsent_bytes > _MAX_UNSENT_BYTES:
                subscription.drop_surplus()
                self._retry_later(subscription)
                break
            if count >= most:
                self._due[subscription] = None
                break
            client.write(subscription.take(now))
            self.sent += 1
            count += 1
        self.replaced += subscription.replaced
        subscription.replaced = 0
        return max(1, count)

    def _send_after_rest(self, subscription: Subscription) -> None:
        del self._resting[subscription]
        self._send_soon(subscription)

    def _retry_later(self, subscription: Subscription) -> None:
        self._slow[subscription] = None
        if not self._is_retrying:
            self._is_retrying = True
            self._loop.call_later(_RETRY_S, self._retry)

    def _retry(self) -> None:
        slow, self._slow = self._slow, {}
        self._is_retrying = False
        for subscription in slow:
            self._send_soon(subscription)

    # --- rosapi --------------------------------------------------------------------------------

    def _answer(self, client: Subscriber, session: RosbridgeSession, op: RosbridgeOp) -> None:
        """Answer one of the calls of ``rosapi`` that clients need to find services and topics."""
        call = op.service.removeprefix("/").removeprefix("rosapi/")
        if call == "services":
            values: dict[str, Any] = {"services": [f"/{name}" for name in self._allowed_services(client)]}
        elif call == "topics":
            kinds = self._readable_topics(client)
            values = {"topics": [f"/{name}" for name in kinds], "types": list(kinds.values())}
        elif call == "service_type":
            name = _argument(op, "service").removeprefix("/")
            values = {"type": f"rse_pf/{name}" if name in self._allowed_services(client) else ""}
        elif call == "topic_type":
            values = {"type": self._readable_topics(client).get(_argument(op, "topic").removeprefix("/"), "")}
        else:
            raise UnknownService(
                f"rosapi offers no {call[:40]!r} here",
                hint="choose /rosapi/services, /rosapi/topics, /rosapi/service_type or /rosapi/topic_type",
            )
        client.write(session.respond(op, values))

    def _allowed_services(self, client: Subscriber) -> list[str]:
        scopes = () if client.claims is None else client.claims.scopes
        return sorted(name for name in self._services if scopes_allow(scopes, f"services:{name}"))

    def _readable_topics(self, client: Subscriber) -> dict[str, str]:
        """Return the types of the tenant's topics, by their names, if the client may read topics."""
        if client.claims is not None and not scopes_allow(client.claims.scopes, "topics:read"):
            return {}
        tenant = client.robot.tenant
        kinds = self._peers.topics(tenant)
        kinds |= {key[1]: topic.kind for key, topic in self._topics.items() if key[0] == tenant}
        return dict(sorted(kinds.items()))


def _argument(op: RosbridgeOp, name: str) -> str:
    """Return the argument *name* of a call of ``rosapi``; raises BadRequest."""
    try:
        value = msgspec.json.decode(op.args, type=dict[str, str]).get(name, "")
    except msgspec.DecodeError as error:
        raise BadRequest(f"rosapi: {str(error)[:150]}", hint=f"send {name}") from error
    return value
