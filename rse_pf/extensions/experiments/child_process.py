"""Child processes that run robots, and the messages between such a process and its parent.

The demo starts one process per robot, the load generator one per group of robots.  A child requests the
tokens of its robots from the parent, which alone has the signing key, and reports when it is ready or has
failed.
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

# `ParentPipe.token` returns the same token for this long, in seconds; by default a token is valid for 900 s.
_TOKEN_AGE_S = 60.0


@dataclass(frozen=True, slots=True)
class TokenRequest:
    """Message of a child to its parent: the robot named ``robot`` is about to connect and needs a token."""

    robot: str


@dataclass(frozen=True, slots=True)
class IssuedToken:
    """Answer of the parent to a `TokenRequest`: the signed token of the robot named ``robot``."""

    robot: str
    token: str


@dataclass(frozen=True, slots=True)
class ChildReady:
    """Message of a child to its parent: its robots are ready to start.

    ``frames`` is the number of frames that the child will send; 0 means that the number is not known.
    """

    frames: int = 0


@dataclass(frozen=True, slots=True)
class ChildFailed:
    """Last message of a child that exits with an error: ``report`` is the error's message and its hint."""

    report: str

    def error(self, name: str) -> CommandFailed:
        """Return the error that the parent raises for the child process *name*, with the child's hint."""
        problem, _, hint = self.report.partition("\n  hint: ")
        return CommandFailed(f"{name}: {problem}", hint=hint)


class ParentPipe:
    """The pipe between a robot's process and its parent.

    Every thread may send; one thread, which `listen` starts, receives.  The robot's connection requests
    tokens on the event loop, and uploads request them on threads of their own; a received token may be handed
    to any of the waiting threads, since all tokens of a robot allow the same.  When the parent closes the
    pipe or exits, every call that waits raises Disconnected.
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
        """Start the daemon thread that receives messages until the parent closes the pipe or exits."""
        threading.Thread(target=self._receive, name="parent", daemon=True).start()

    def send(self, message: Any) -> None:
        """Pickle *message* and write it to the pipe.

        Threads that call this at the same time wait for each other.
        """
        with self._sending:
            self._pipe.send(message)

    def wait_start(self) -> float:
        """Wait until the parent sends the start time and return that time (s, `time.monotonic`).

        Raises:
            Disconnected: The parent has closed the pipe or exited.
        """
        return _got(self._starts)

    def fresh_token(self) -> str:
        """Request a new token from the parent and wait for it.

        Raises:
            Disconnected: The parent has closed the pipe or exited.
        """
        self.send(TokenRequest(self._robot))
        return _got(self._tokens)

    def token(self) -> str:
        """Return a token that was received at most 60 s ago, or request a new one.

        Raises:
            Disconnected: The parent has closed the pipe or exited.
        """
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
        inbox.put(None)  # so that every other thread that waits for this queue raises Disconnected as well
        raise Disconnected(
            "the parent of this robot's process has exited", hint="read the last lines of its output"
        )
    return message


def start_process(
    target: Callable[[Any, Connection], None], spec: Any, name: str
) -> tuple[BaseProcess, Connection]:
    """Start ``target(spec, pipe)`` in a new spawned daemon process.

    Return the process and the parent's end of the pipe.
    """
    context = multiprocessing.get_context("spawn")
    pipe, child_pipe = context.Pipe()
    process = context.Process(target=target, args=(spec, child_pipe), name=name, daemon=True)
    process.start()
    child_pipe.close()
    return process, pipe


def end_process(process: BaseProcess, pipe: Connection, timeout_s: float) -> None:
    """Close *pipe* and wait up to *timeout_s* seconds until *process* exits.

    A process that is still running after that time is killed.
    """
    pipe.close()
    process.join(timeout_s)
    if process.is_alive():
        process.kill()
        process.join()
