"""Start a child process, and end it.

    child = start_child(ChildPlan(target="rse_pf.server.jobs.process:run", name="rse-pf job", nice=10))
    child.say({"service": "map-optimise"})
    child.kill()

A child is asked to end by an order, or by the end of its socket; it ignores the signals of a terminal.  What
does not end is killed, and what was killed is reaped.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rse_pf.processes.ipc import encode_message
from rse_pf.processes.linux import run_as_batch
from rse_pf.processes.one_thread import ONE_THREAD

__all__ = ["Child", "ChildPlan", "how_ended", "start_child"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChildPlan:
    """What a child runs, and what it may use.  It holds no secret: other users may read it."""

    target: str
    """``module:function``; the function takes the socket to the parent, and the child ends with it."""
    name: str
    """The name that top shows, of at most 15 letters."""
    policy: Literal["usual", "batch"] = "usual"
    """It gets a processor as its parent does, or takes none from who runs."""
    nice: int = 0
    """Above that of its parent."""
    import_nice: int = 0
    """While it imports *target*, above ``nice``."""
    memory_bytes: int | None = None
    """What it may allocate."""
    is_killed_first: bool = False
    """Whether Linux kills it before others when memory is short."""
    outlives_parent: bool = False
    """Whether it goes on when the thread that started it has ended; else Linux kills it."""


class Child:
    """A started process and the socket to it."""

    def __init__(self, process: subprocess.Popen[bytes], connection: socket.socket) -> None:
        self._process = process
        self.connection = connection
        self.pid = process.pid

    def say(self, message: Any) -> None:
        """Send *message*; it is lost if the process has ended, which the next read shows."""
        with suppress(OSError):
            self.connection.sendall(encode_message(message))

    def exit_code(self) -> int | None:
        """Return how it ended (negative: by which signal), None while it runs."""
        return self._process.poll()

    def wait(self) -> int:
        """Wait for its end and return the exit code."""
        return self._process.wait()

    def end(self, within_s: float) -> int:
        """Close the socket, kill it if it has not ended after *within_s*, and return the exit code."""
        self.connection.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(within_s)
        return self.kill()

    def kill(self) -> int:
        """Kill it unless it has ended, reap it and return the exit code; negative for a signal."""
        self._process.kill()
        self.connection.close()
        return self._process.wait()


def start_child(
    plan: ChildPlan,
    *,
    environment: Mapping[str, str] | None = None,
    kind: socket.SocketKind = socket.SOCK_STREAM,
    descriptors: Sequence[int] = (),
    output: int | None = None,
) -> Child:
    """Start a child; its numbers are those of one thread of linear algebra.

    Args:
        plan: What it runs.
        environment: Its variables; None for those of this process.
        kind: Of the socket to it.
        descriptors: Open files that it inherits in addition to its socket and the standard ones.
        output: Where standard output and error go; None for those of this process.

    Raises:
        OSError: The machine has no process, memory or descriptor left.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, kind)
    parent = 0 if plan.outlives_parent else os.getpid()
    try:
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-m", "rse_pf.processes", str(theirs.fileno()),
                 json.dumps({**asdict(plan), "parent": parent})],
                pass_fds=(theirs.fileno(), *descriptors), stdin=subprocess.DEVNULL, stdout=output,
                stderr=output, env={**os.environ, **ONE_THREAD} if environment is None else environment,
            )  # fmt: skip
    except OSError:
        ours.close()
        raise
    nice = os.getpriority(os.PRIO_PROCESS, 0) + plan.nice
    if plan.policy == "batch":
        run_as_batch(process.pid, nice)
    elif plan.nice:
        with suppress(OSError):  # it has ended
            os.setpriority(os.PRIO_PROCESS, process.pid, nice)
    return Child(process, ours)


def how_ended(code: int) -> str:
    """Describe an exit code as part of a sentence."""
    if code >= 0:
        return f"exit code {code}"
    return f"signal {signal.Signals(-code).name if -code in set(signal.Signals) else -code}"
