"""A demo robot's end of the pipe to its parent: the start and fresh tokens come, everything else goes.

Whoever needs a token asks here: the connection on the event loop, and uploads on threads of their own.
Tokens are all alike, so it does not matter which one of two that ask gets which.  Promises that nobody waits
for a parent that is gone.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from rse_pf.errors import Disconnected

__all__ = ["ParentPipe", "TokenWanted"]

T = TypeVar("T")

_FRESH_S = 60.0
"""Uploads use a token for so long; tokens live ten times longer."""


@dataclass(frozen=True, slots=True)
class TokenWanted:
    """The robot needs a token; the parent answers with a new one."""


class ParentPipe:
    """Send from any thread; what comes is sorted by a thread of its own, begun by `listen`."""

    def __init__(self, pipe: Connection, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._pipe = pipe
        self._clock = clock
        self._sending = threading.Lock()
        self._asking = threading.Lock()
        self._starts: queue.SimpleQueue[float | None] = queue.SimpleQueue()
        self._tokens: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._held: tuple[str, float] | None = None

    def listen(self) -> None:
        """Begin to hear the parent; the thread ends with the process, or when the parent hangs up."""
        threading.Thread(target=self._hear, name="parent", daemon=True).start()

    def send(self, message: Any) -> None:
        """Tell the parent."""
        with self._sending:
            self._pipe.send(message)

    def wait_start(self) -> float:
        """Wait for the start and return its time; raises Disconnected if the parent is gone."""
        return _got(self._starts)

    def fresh_token(self) -> str:
        """Ask for a new token and wait for it; raises Disconnected if the parent is gone."""
        self.send(TokenWanted())
        return _got(self._tokens)

    def token(self) -> str:
        """Return a token that is at most a minute old; raises Disconnected if the parent is gone."""
        with self._asking:
            if self._held is None or self._clock() - self._held[1] > _FRESH_S:
                self._held = (self.fresh_token(), self._clock())
            return self._held[0]

    def _hear(self) -> None:
        try:
            while True:
                message = self._pipe.recv()
                if isinstance(message, str):
                    self._tokens.put(message)
                else:
                    self._starts.put(float(message))
        except (EOFError, OSError):
            self._tokens.put(None)
            self._starts.put(None)


def _got(inbox: queue.SimpleQueue[T | None]) -> T:
    message = inbox.get()
    if message is None:
        inbox.put(None)  # for whoever else waits
        raise Disconnected("the demo has ended without this robot", hint="look at what it said at its end")
    return message
