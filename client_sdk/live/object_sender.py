"""Send what a robot stores beside its keyframes, when nothing more urgent waits.

Poses and keyframes come first; objects take a bounded share of the link, newest kept: what does not fit into
the memory for waiting ones is dropped, oldest first, and only the cloud of the map is thinner for that.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable

from client_sdk.concurrency.user_callbacks import Callbacks
from rse_pf.errors import (
    BadRequest,
    Forbidden,
    InternalError,
    LimitExceeded,
    QuotaExceeded,
    RsePfError,
    Unauthorized,
    UsageError,
)
from rse_pf.token_bucket import TokenBucket

__all__ = ["ObjectSender", "StoreObject"]

StoreObject = Callable[[bytes], Awaitable[str]]
"""Stores bytes as an object of the robot and returns their digest; raises RsePfError."""

_OVERHEAD_BYTES = 1_000
"""Of a request and its answer: the token is the largest part."""
_MAX_WAITING_BYTES = 16 << 20
_MAX_QUIET_WAIT_S = 1.0
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0
_REFUSED = (LimitExceeded, BadRequest, UsageError)
"""The object is refused: it is dropped."""
_ALL_REFUSED = (Forbidden, Unauthorized, QuotaExceeded)
"""Each object would be refused: all that wait are dropped."""


class ObjectSender:
    """Sends what was added, oldest first, until `run` is cancelled."""

    def __init__(
        self,
        store: StoreObject,
        *,
        bytes_per_s: float,
        clock: Callable[[], float],
        wait_quiet: Callable[[], Awaitable[None]],
    ) -> None:
        """Describe the sender.

        Args:
            store: Stores one object.
            bytes_per_s: Share of the link.
            clock: Seconds, monotonic.
            wait_quiet: Returns when neither a pose is asked for nor a keyframe waits.
        """
        self.sent = 0
        self.sent_bytes = 0
        """With the heads of the requests, roughly."""
        self.dropped = 0
        self.trouble = ""
        """Why the last object is not stored; empty if all is well."""
        self._store, self._clock, self._wait_quiet = store, clock, wait_quiet
        self._bucket = TokenBucket(bytes_per_s, burst=0.0)
        self._callbacks = Callbacks()
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._added, self._empty = asyncio.Event(), asyncio.Event()
        self._empty.set()

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, data: bytes) -> None:
        """Send *data* when its turn comes."""
        self._waiting.append(data)
        self._waiting_bytes += len(data)
        while self._waiting_bytes > _MAX_WAITING_BYTES:
            self._waiting_bytes -= len(self._waiting.popleft())
            self.dropped += 1
        self._empty.clear()
        self._added.set()

    def report(self) -> dict[str, int | str]:
        """Return how many objects were sent, wait, and were dropped, and how many bytes took the link."""
        return {
            "sent": self.sent, "bytes": self.sent_bytes, "waiting": len(self._waiting),
            "dropped": self.dropped, "trouble": self.trouble,
        }  # fmt: skip

    async def wait_empty(self) -> None:
        """Wait until nothing waits."""
        await self._empty.wait()

    async def run(self) -> None:
        """Send until cancelled."""
        pause_s = _FIRST_PAUSE_S
        while True:
            while not self._waiting:
                self._empty.set()
                self._added.clear()
                await self._added.wait()
            data = self._waiting[0]
            await asyncio.sleep(self._bucket.spend(len(data) + _OVERHEAD_BYTES, self._clock()))
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._wait_quiet(), _MAX_QUIET_WAIT_S)
            try:
                await self._store(data)
            except Exception as error:  # noqa: BLE001  code of the program
                if not isinstance(error, RsePfError):
                    self._callbacks.report("store", error)
                    error = InternalError(f"store raised {type(error).__name__}", hint="see the log")
                self.trouble = f"{error.code}: {error.message}"
                if isinstance(error, _REFUSED):
                    self.dropped += self._remove(data)
                elif isinstance(error, _ALL_REFUSED):
                    self.dropped += len(self._waiting)
                    self._waiting.clear()
                    self._waiting_bytes = 0
                    self._empty.set()
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
            else:
                self.sent += self._remove(data)
                self.sent_bytes += len(data) + _OVERHEAD_BYTES
                self.trouble, pause_s = "", _FIRST_PAUSE_S

    def _remove(self, data: bytes) -> bool:
        """Take the first object off, unless it was dropped meanwhile; return whether it was there."""
        is_first = bool(self._waiting) and self._waiting[0] is data
        if is_first:
            self._waiting.popleft()
            self._waiting_bytes -= len(data)
        return is_first
