"""The queue of messages of one topic for one rosbridge client, with the client's rate and queue length.

The class is given all times and messages; it uses no clock, no event loop and no socket.
"""

from __future__ import annotations

from collections import deque

from rse_pf.extensions.rosbridge.operations import publication

__all__ = ["MAX_HELD_BYTES", "MAX_QUEUE_LENGTH", "HeldBytes", "Subscription", "TopicMessage"]

MAX_QUEUE_LENGTH = 100
"""Largest number of messages that wait for one subscription."""
MAX_HELD_BYTES = 32 << 20
"""Bytes of messages that wait for all subscriptions of a tenant.

Above it, a subscription stores only its newest
message."""
# Largest number of bytes of messages that wait for one subscription; its newest message is stored in any
# case.
_MAX_QUEUE_BYTES = 1 << 20


class HeldBytes:
    """The number of bytes of messages that wait for all subscriptions of one tenant."""

    __slots__ = ("of_tenant",)

    def __init__(self) -> None:
        self.of_tenant = 0


class TopicMessage:
    """The JSON that a client published, and the WebSocket messages for subscribers.

    A WebSocket message is encoded once for each spelling of the topic (with or without a leading slash).
    """

    __slots__ = ("_encoded", "data")

    def __init__(self, data: bytes) -> None:
        self.data = data
        self._encoded: dict[str, bytes] = {}

    def encode_for(self, topic: str) -> bytes:
        """Return the WebSocket message for a subscriber that spells the topic as *topic*."""
        message = self._encoded.get(topic)
        if message is None:
            message = self._encoded[topic] = publication(topic, self.data)
        return message


class Subscription:
    """One client's subscription to one topic, for all of the client's requests to subscribe to it.

    Attributes:
        spelling: The topic's name as the client wrote it first.
        requests: Shortest time between two messages (s) and queue length of each request, by the request's
            id.
    """

    __slots__ = ("_bytes", "_held", "_next_s", "_waiting", "requests", "spelling")

    def __init__(self, spelling: str, held: HeldBytes) -> None:
        self.spelling = spelling
        self.requests: dict[str | int | None, tuple[float, int]] = {}
        self._waiting: deque[TopicMessage] = deque()
        self._bytes = 0
        self._held = held
        self._next_s = float("-inf")

    def __len__(self) -> int:
        """Return the number of waiting messages."""
        return len(self._waiting)

    def clear(self) -> None:
        """Drop the waiting messages; called when the subscription ends."""
        self._waiting.clear()
        self._count(-self._bytes)

    def put(self, message: TopicMessage) -> None:
        """Add *message* to the queue; drop the oldest messages above 100 messages or 1 MiB.

        While more than 32 MiB wait for the subscriptions of the tenant, only the newest message is stored.
        """
        self._waiting.append(message)
        self._count(len(message.data))
        self._drop_beyond(MAX_QUEUE_LENGTH if self._held.of_tenant <= MAX_HELD_BYTES else 1)

    def drop_surplus(self) -> None:
        """Drop the oldest messages above the longest queue length that the client requested.

        This is called while no message may be sent to the client.
        """
        if self.requests:
            self._drop_beyond(max(length for _, length in self.requests.values()))

    def wait_s(self, now: float) -> float:
        """Return the seconds until the next message may be sent; 0 if it may be sent at *now* (s)."""
        return max(0.0, self._next_s - now)

    def take(self, now: float) -> bytes:
        """Remove the oldest message and return its WebSocket message, which the caller sends at *now* (s)."""
        message = self._waiting.popleft()
        self._count(-len(message.data))
        self._next_s = now + min(pause_s for pause_s, _ in self.requests.values())
        return message.encode_for(self.spelling)

    def _drop_beyond(self, length: int) -> None:
        waiting = self._waiting
        while len(waiting) > length or (len(waiting) > 1 and self._bytes > _MAX_QUEUE_BYTES):
            self._count(-len(waiting.popleft().data))

    def _count(self, size: int) -> None:
        self._bytes += size
        self._held.of_tenant += size
