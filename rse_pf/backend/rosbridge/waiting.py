"""Rosbridge clients that showed no token in their handshake: a bounded number, for a bounded time.

They are no robots yet: they have no place among the connections, and only their token is heard.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop, TimerHandle
from typing import Generic, Protocol, TypeVar

__all__ = ["AUTH_TIMEOUT_S", "AwaitedTokens", "Unnamed", "WaitingLine"]

AUTH_TIMEOUT_S = 3.0
"""Time from the handshake to the token."""


class Unnamed(Protocol):
    """What is needed of a connection without a token."""

    @property
    def is_closing(self) -> bool:
        """Whether it ends already."""

    def close(self, code: int, reason: str) -> None:
        """Close the socket."""


Connection = TypeVar("Connection", bound=Unnamed)


class WaitingLine(Protocol[Connection]):
    """Who has to leave when too many wait; `PendingHandshakes` is one."""

    def enter(self, key: Connection, source: str) -> Connection | None:
        """Add one from the address *source*; return the one that leaves for it."""

    def leave(self, key: Connection) -> None:
        """Forget one."""


class AwaitedTokens(Generic[Connection]):
    """The connections of one worker that have not shown a token."""

    def __init__(
        self,
        line: WaitingLine[Connection],
        *,
        loop: AbstractEventLoop,
        close_code: int,
        seconds: float = AUTH_TIMEOUT_S,
    ) -> None:
        """Wait for nobody yet.

        Args:
            line: Bounds their number, for each address and in all.
            loop: Event loop of the worker.
            close_code: How one is closed whose time is over, or that is surplus.
            seconds: How long each of them may wait.
        """
        self._line = line
        self._loop = loop
        self._close_code = close_code
        self._seconds = seconds
        self._timers: dict[Connection, TimerHandle] = {}
        self._sources: dict[Connection, str] = {}

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._timers)

    def enter(self, connection: Connection, source: str) -> None:
        """Wait for the token of *connection*, which came from the address *source*."""
        self._timers[connection] = self._loop.call_later(self._seconds, self._cut, connection)
        self._sources[connection] = source
        surplus = self._line.enter(connection, source)
        if surplus is not None:
            self._cut(surplus)

    def leave(self, connection: Connection) -> str | None:
        """Forget one that showed a token or is gone; return its address, None if it did not wait."""
        timer = self._timers.pop(connection, None)
        if timer is None:
            return None
        timer.cancel()
        self._line.leave(connection)
        return self._sources.pop(connection)

    def close_all(self) -> None:
        """Close all of them: the server leaves."""
        for connection in list(self._timers):
            self._cut(connection)

    def _cut(self, connection: Connection) -> None:
        self.leave(connection)
        if not connection.is_closing:
            connection.close(self._close_code, "unauthenticated")
