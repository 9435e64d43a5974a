"""Child processes that run robots, and the messages that all of them exchange with their parent.

Demo and load generator start a process per robot or group of robots; every process needs tokens, which only
the parent can issue, and reports when it is ready or has failed.
"""

from __future__ import annotations

import multiprocessing
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from rse_pf.errors import CommandFailed, Disconnected

__all__ = [
    "ChildFailed",
    "ChildReady",
    "IssuedToken",
    "ParentPipe",
    "TokenRequest",
    "end_process",
    "start_process",
]

T = TypeVar("T")

_TOKEN_AGE_S = 60.0
"""Uploads use a token for this long; its ttl is ten times longer."""


@dataclass(frozen=True, slots=True)
class TokenRequest:
    """From the child: a robot connects and needs a token."""

    robot: str


@dataclass(frozen=True, slots=True)
class IssuedToken:
    """From the parent: the answer to a `TokenRequest`."""

    robot: str
    token: str


@dataclass(frozen=True, slots=True)
class ChildReady:
    """From the child: it can start; ``frames`` is how many it will send, 0 if that is open."""

    frames: int = 0


@dataclass(frozen=True, slots=True)
class ChildFailed:
    """From the child: it has ended with an error, which ``report`` describes in two lines."""

    report: str

    def error(self, name: str) -> CommandFailed:
        """Return the error for the parent to raise."""
        problem, _, hint = self.report.partition("\n  hint: ")
        return CommandFailed(f"{name}: {problem}", hint=hint)


class ParentPipe:
    """The pipe of a robot to its parent: any thread sends, and a thread that `listen` starts receives.

    Tokens are requested by the connection on the event loop and by uploads on threads of their own; all
    tokens of a robot are equal, so any of them answers any request.  When the parent has ended, every wait
    ends.
    """

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


def start_process(
    target: Callable[[Any, Connection], None], spec: Any, name: str
) -> tuple[BaseProcess, Connection]:
    """Start ``target(spec, pipe)`` in a new process; return the process and the parent's end of the pipe."""
    context = multiprocessing.get_context("spawn")
    pipe, child_pipe = context.Pipe()
    process = context.Process(target=target, args=(spec, child_pipe), name=name, daemon=True)
    process.start()
    child_pipe.close()
    return process, pipe


def end_process(process: BaseProcess, pipe: Connection, timeout_s: float) -> None:
    """Close *pipe*, wait up to *timeout_s* for the end of *process*, then kill it."""
    pipe.close()
    process.join(timeout_s)
    if process.is_alive():
        process.kill()
        process.join()
