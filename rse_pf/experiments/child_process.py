"""Child processes that run robots, and the messages that all of them exchange with their parent.

Demo and load generator start a process per robot or group of robots; every process needs tokens, which only
the parent can issue, and reports when it is ready or has failed.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from rse_pf.errors import CommandFailed

__all__ = ["ChildFailed", "ChildReady", "IssuedToken", "TokenRequest", "end_process", "start_process"]


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
        what, _, hint = self.report.partition("\n  hint: ")
        return CommandFailed(f"{name}: {what}", hint=hint)


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
