"""What one rosbridge client still has to get of one topic: the newest messages, not faster than it asked for.

Times and messages go in, the messages that are due come out: there is no clock, no loop and no socket here.
"""

from __future__ import annotations

from collections import deque

from rse_pf.extensions.rosbridge.messages import publication

__all__ = ["MAX_HELD_BYTES", "MAX_QUEUE_LENGTH", "HeldBytes", "Subscription", "TopicMessage"]

MAX_QUEUE_LENGTH = 100
MAX_HELD_BYTES = 32 << 20
"""Messages that wait for all subscriptions of a tenant; above it each keeps the newest only."""
_MAX_QUEUE_BYTES = 1 << 20
"""Messages that wait for one subscription, all together; the newest is kept in any case."""


class HeldBytes:
    """How many bytes wait for the slow subscribers of one tenant."""

    __slots__ = ("of_tenant",)

    def __init__(self) -> None:
        self.of_tenant = 0


class TopicMessage:
    """The JSON that a client published, and what its subscribers get, made once for each spelling."""

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
    """One client's subscription to one topic, however many times it subscribed.

    Attributes:
        spelling: The topic as the client wrote it first.
        requests: The shortest pause in s and the queue length of each request, by its id.
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
        """Return how many messages wait."""
        return len(self._waiting)

    def clear(self) -> None:
        """Forget the waiting messages, because the subscription has ended."""
        self._waiting.clear()
        self._count(-self._bytes)

    def put(self, message: TopicMessage) -> None:
        """Add *message*; the oldest ones are dropped above the longest queue that there is."""
        self._waiting.append(message)
        self._count(len(message.data))
        self._drop_beyond(MAX_QUEUE_LENGTH if self._held.of_tenant <= MAX_HELD_BYTES else 1)

    def drop_surplus(self) -> None:
        """Drop the oldest messages above the queue that was asked for: the client has to wait now."""
        if self.requests:
            self._drop_beyond(max(length for _, length in self.requests.values()))

    def wait_s(self, now: float) -> float:
        """Return 0 if a message may be sent at *now* (s), else the seconds until then."""
        return max(0.0, self._next_s - now)

    def take(self, now: float) -> bytes:
        """Return the WebSocket message that is sent at *now* (s)."""
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
