"""The pipe of a demo robot to its parent: it receives the start time and tokens, and sends everything else.

Tokens are requested by the connection on the event loop and by uploads on threads of their own; all tokens of
a robot are equal, so any of them answers any request.  When the parent has ended, every wait ends.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from rse_pf.errors import Disconnected
from rse_pf.experiments.child_process import IssuedToken, TokenRequest

__all__ = ["ParentPipe"]

T = TypeVar("T")

_TOKEN_AGE_S = 60.0
"""Uploads use a token for this long; its ttl is ten times longer."""


class ParentPipe:
    """Sends from any thread; a thread that `listen` starts receives."""

    def __init__(self, pipe: Connection, robot: str, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._pipe = pipe
        self._robot = robot
        self._clock = clock
        self._sending = threading.Lock()
        self._asking = threading.Lock()
        self._starts: queue.SimpleQueue[float | None] = queue.SimpleQueue()
        self._tokens: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._held: tuple[str, float] | None = None

    def listen(self) -> None:
        """Start to receive; the thread ends with the process or with the parent."""
        threading.Thread(target=self._receive, name="parent", daemon=True).start()

    def send(self, message: Any) -> None:
        """Send *message* to the parent."""
        with self._sending:
            self._pipe.send(message)

    def wait_start(self) -> float:
        """Wait for the start and return its time; raises Disconnected if the parent has ended."""
        return _got(self._starts)

    def fresh_token(self) -> str:
        """Ask for a new token and wait for it; raises Disconnected if the parent has ended."""
        self.send(TokenRequest(self._robot))
        return _got(self._tokens)

    def token(self) -> str:
        """Return a token that is at most a minute old; raises Disconnected if the parent has ended."""
        with self._asking:
            if self._held is None or self._clock() - self._held[1] > _TOKEN_AGE_S:
                self._held = (self.fresh_token(), self._clock())
            return self._held[0]

    def _receive(self) -> None:
        try:
            while True:
                message = self._pipe.recv()
                if isinstance(message, IssuedToken):
                    self._tokens.put(message.token)
                else:
                    self._starts.put(float(message))
        except (EOFError, OSError):
            self._tokens.put(None)
            self._starts.put(None)


def _got(inbox: queue.SimpleQueue[T | None]) -> T:
    message = inbox.get()
    if message is None:
        inbox.put(None)  # ends every other wait as well
        raise Disconnected("the demo has ended without this robot", hint="read the last lines of its output")
    return message
