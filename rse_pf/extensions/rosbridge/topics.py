"""The topics of all clients of this process, with their publishers, subscriptions and latched messages.

A topic belongs to a tenant.  A message is stored once for all its subscribers; the module
`rse_pf.extensions.rosbridge.sender` decides when it is sent to each of them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from rse_pf.auth.roster import scopes_allow
from rse_pf.errors import BadRequest, Conflict, Forbidden, QuotaExceeded, UnsupportedProtocol
from rse_pf.extensions.rosbridge.operations import Operation
from rse_pf.extensions.rosbridge.sender import TopicSender
from rse_pf.extensions.rosbridge.subscription import MAX_QUEUE_LENGTH, HeldBytes, Subscription, TopicMessage

__all__ = ["TopicClient", "Topics"]

MAX_TOPICS = 64
"""Largest number of topics that one client advertises."""
MAX_SUBSCRIPTIONS = 64
"""Largest number of subscriptions of one client; further ones are refused.

Each id of a topic counts as one, and so do all subscriptions of a topic that have no id.
"""
MAX_TOPICS_OF_TENANT = 1000
"""Largest number of topics of one tenant."""
MAX_LATCHED_BYTES = 4 << 20
"""Largest number of bytes of all latched messages of one tenant."""
# Longest time between two messages of a subscription (``throttle_rate``), in seconds; longer ones are
# shortened.
_MAX_PAUSE_S = 3600.0
# Pattern of the names of topics.
_NAME = re.compile(r"/?[A-Za-z~][A-Za-z0-9_~.-]{0,127}(?:/[A-Za-z0-9_~.-]{1,128}){0,16}")

Key = tuple[str, str]
"""Tenant, and name of a topic without its leading slash."""


@dataclass(eq=False, slots=True, kw_only=True)
class TopicClient:
    """A client of topics: robot, tenant and scopes of its token, and the sender of its messages."""

    robot: str
    tenant: str
    scopes: tuple[str, ...]
    sender: TopicSender

    def may(self, right: str) -> bool:
        """Return whether the scopes of the client's token allow *right*, such as ``topics:read``."""
        return scopes_allow(self.scopes, right)


@dataclass(eq=False, slots=True)
class _Topic:
    key: Key
    type: str
    publishers: dict[TopicClient, bool] = field(default_factory=dict)
    """For each publisher, whether its messages are latched."""
    subscriptions: dict[TopicClient, Subscription] = field(default_factory=dict)
    latched: dict[TopicClient, TopicMessage] = field(default_factory=dict)


class Topics:
    """All topics of this process, by tenant and name."""

    def __init__(self) -> None:
        self._topics: dict[Key, _Topic] = {}
        self._per_tenant: dict[str, int] = {}
        self._latched_bytes: dict[str, int] = {}
        self._held: dict[str, HeldBytes] = {}
        self._of_client: dict[TopicClient, dict[Key, None]] = {}

    def execute(self, client: TopicClient, operation: Operation) -> None:
        """Execute *operation* of *client*: subscribe, unsubscribe, advertise, unadvertise or publish.

        Raises:
            RsePfError: The token or a limit does not allow the operation, or the topic has another type.
        """
        key = _key(client, operation.topic)
        reads = operation.op in ("subscribe", "unsubscribe")
        right = "topics:read" if reads else "topics:write"
        if not client.may(right):
            raise Forbidden(f"this token does not hold the scope {right}", hint="issue one that does")
        if operation.op == "subscribe":
            self._subscribe(client, key, operation)
        elif operation.op == "unsubscribe":
            self._unsubscribe(client, key, operation)
        elif operation.op == "advertise":
            self._advertise(client, key, operation)
        elif operation.op == "unadvertise":
            self._unadvertise(client, key)
        else:
            self._publish(client, key, operation)

    def leave(self, client: TopicClient) -> None:
        """Remove the publications, latched messages and subscriptions of a client that disconnected."""
        for key in list(self._of_client.get(client, ())):
            topic = self._topics[key]
            topic.publishers.pop(client, None)
            self._unlatch(topic, client)
            self._end(topic, client)
            self._settle(topic, client)

    def readable_by(self, client: TopicClient) -> dict[str, str]:
        """Return the types of the tenant's topics by name; empty if the client may not read topics."""
        if not client.may("topics:read"):
            return {}
        own = (topic for topic in self._topics.values() if topic.key[0] == client.tenant)
        return dict(sorted((topic.key[1], topic.type) for topic in own))

    # --- execution of each operation -----------------------------------------------------------

    def _advertise(self, client: TopicClient, key: Key, operation: Operation) -> _Topic:
        own = self._of_client.get(client, ())
        topic = self._topics.get(key)
        if topic is None or client not in topic.publishers:
            count = sum(1 for own_key in own if client in self._topics[own_key].publishers)
            if count >= MAX_TOPICS:
                raise QuotaExceeded(f"this client advertises {count} topics already", hint="unadvertise one")
        topic = self._use_topic(client, key, operation.type or "")
        topic.publishers[client] = bool(operation.latch) or topic.publishers.get(client, False)
        return topic

    def _unadvertise(self, client: TopicClient, key: Key) -> None:
        topic = self._topics.get(key)
        if topic is not None and topic.publishers.pop(client, None) is not None:
            self._unlatch(topic, client)
            self._settle(topic, client)

    def _publish(self, client: TopicClient, key: Key, operation: Operation) -> None:
        topic = self._topics.get(key)
        if topic is None or client not in topic.publishers:
            topic = self._advertise(client, key, operation)
        message = TopicMessage(bytes(operation.msg))
        if operation.latch or topic.publishers[client]:
            self._latch(topic, client, message)
        for subscriber, subscription in topic.subscriptions.items():
            subscriber.sender.put(subscription, message)

    def _subscribe(self, client: TopicClient, key: Key, operation: Operation) -> None:
        if operation.compression not in (None, "", "none"):
            raise UnsupportedProtocol(
                f"compression {operation.compression[:20]!r} is not supported here",
                hint="subscribe with none",
            )
        count = sum(
            len(self._topics[own_key].subscriptions[client].requests)
            for own_key in self._of_client.get(client, ())
            if client in self._topics[own_key].subscriptions
        )
        if count >= MAX_SUBSCRIPTIONS:
            raise QuotaExceeded(f"this client has {count} subscriptions already", hint="unsubscribe one")
        topic = self._use_topic(client, key, operation.type or "")
        subscription = topic.subscriptions.get(client)
        is_new = subscription is None
        if subscription is None:
            held = self._held.setdefault(key[0], HeldBytes())
            subscription = topic.subscriptions[client] = Subscription(operation.topic, held)
        pause_s = min(_MAX_PAUSE_S, max(0.0, (operation.throttle_rate or 0.0) / 1e3))
        length = min(MAX_QUEUE_LENGTH, max(1, operation.queue_length or 1))
        subscription.requests[operation.id] = pause_s, length
        for message in topic.latched.values() if is_new else ():
            client.sender.put(subscription, message)

    def _unsubscribe(self, client: TopicClient, key: Key, operation: Operation) -> None:
        topic = self._topics.get(key)
        subscription = None if topic is None else topic.subscriptions.get(client)
        if topic is None or subscription is None:
            return
        left = {identity for identity in subscription.requests if identity != operation.id}
        if operation.id is None or not left:
            self._end(topic, client)
            self._settle(topic, client)
        else:
            subscription.requests.pop(operation.id, None)

    # --- creation and removal of topics --------------------------------------------------------

    def _use_topic(self, client: TopicClient, key: Key, type_name: str) -> _Topic:
        """Return the topic *key*, created if necessary, and record that *client* uses it.

        Raises:
            Conflict: The topic has another type than *type_name*; an empty type fits every topic.
            QuotaExceeded: The tenant has too many topics.
        """
        topic = self._topics.get(key)
        present = "" if topic is None else topic.type
        if type_name and present and _ros1_name(type_name) != _ros1_name(present):
            raise Conflict(f"topic {key[1]} has the type {present}, not {type_name}", hint="use its type")
        if topic is None:
            count = self._per_tenant.get(key[0], 0)
            if count >= MAX_TOPICS_OF_TENANT:
                raise QuotaExceeded(f"the tenant has {count} topics already", hint="use fewer topics")
            self._per_tenant[key[0]] = count + 1
            topic = self._topics[key] = _Topic(key, type_name)
        topic.type = topic.type or type_name
        self._of_client.setdefault(client, {})[key] = None
        return topic

    def _settle(self, topic: _Topic, client: TopicClient) -> None:
        """Remove *topic* from the topics of *client* if it is unused there; delete a topic nobody uses."""
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

    def _end(self, topic: _Topic, client: TopicClient) -> None:
        """Remove the subscription of *client* to *topic*, if there is one, with its waiting messages."""
        subscription = topic.subscriptions.pop(client, None)
        if subscription is not None:
            subscription.clear()

    def _latch(self, topic: _Topic, client: TopicClient, message: TopicMessage) -> None:
        tenant = topic.key[0]
        self._unlatch(topic, client)
        held = self._latched_bytes.get(tenant, 0) + len(message.data)
        if held > MAX_LATCHED_BYTES:
            raise QuotaExceeded(
                f"latched messages of {held} bytes are above {MAX_LATCHED_BYTES}", hint="latch less"
            )
        self._latched_bytes[tenant] = held
        topic.latched[client] = message

    def _unlatch(self, topic: _Topic, client: TopicClient) -> None:
        message = topic.latched.pop(client, None)
        if message is not None:
            tenant = topic.key[0]
            self._latched_bytes[tenant] -= len(message.data)
            if not self._latched_bytes[tenant]:
                del self._latched_bytes[tenant]


def _key(client: TopicClient, topic: str) -> Key:
    if not _NAME.fullmatch(topic) or not {".", ".."}.isdisjoint(topic.split("/")):
        raise BadRequest(f"{topic[:80]!r} is no name of a topic", hint="use a ROS name such as /scan")
    return client.tenant, topic.removeprefix("/")


def _ros1_name(type_name: str) -> str:
    """Return the ROS 1 name of a message type: ``std_msgs/msg/String`` is ``std_msgs/String``."""
    package, _, name = type_name.partition("/msg/")
    return f"{package}/{name}" if name else type_name
