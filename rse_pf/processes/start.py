"""Start a child process, and end it:

    child = start_child(ChildPlan(target="rse_pf.server.jobs.process:run", name="rse-pf job", nice=10))
    child.say({"service": "map-optimise"})
    child.kill()

A child exits after a message that asks for it, or when its parent closes the socket; it ignores the signals
of a terminal.  A child that does not exit is killed, and each child is reaped.
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
    """What a child process runs, and what it may use.

    A plan must hold no secret: it is part of the command line, which other users can read.
    """

    target: str
    """``module:function``; the function takes the socket to the parent.  The child exits when it returns."""
    name: str
    """Name of the process that tools like top show, of at most 15 letters."""
    policy: Literal["usual", "batch"] = "usual"
    """Linux scheduling policy: "batch" makes the child wait for a processor rather than take one from a
    running process."""
    nice: int = 0
    """Niceness of the child above that of its parent."""
    import_nice: int = 0
    """Niceness above ``nice`` while the child imports the module of ``target``."""
    memory_bytes: int | None = None
    """Most bytes of memory that the child may allocate; None is no limit."""
    is_killed_first: bool = False
    """Whether Linux kills the child before other processes when the memory of the machine is short."""
    outlives_parent: bool = False
    """Whether the child continues after the thread that started it has ended; otherwise Linux kills it."""


class Child:
    """A started child process and the socket to it."""

    def __init__(self, process: subprocess.Popen[bytes], connection: socket.socket) -> None:
        self._process = process
        self.connection = connection
        self.pid = process.pid

    def say(self, message: Any) -> None:
        """Send *message* to the child; it is lost if the child has exited, which the next read shows."""
        with suppress(OSError):
            self.connection.sendall(encode_message(message))

    def exit_code(self) -> int | None:
        """Return the exit code, minus the number of the signal that ended the child, None while it runs."""
        return self._process.poll()

    def wait(self) -> int:
        """Wait until the child exits, and return `exit_code`."""
        return self._process.wait()

    def end(self, within_s: float) -> int:
        """Close the socket, kill the child if it still runs *within_s* seconds later; return `exit_code`."""
        self.connection.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(within_s)
        return self.kill()

    def kill(self) -> int:
        """Kill the child unless it has exited, close the socket, reap the child and return `exit_code`."""
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
    """Start a child process.

    Args:
        plan: What the child runs, and what it may use.
        environment: Its environment variables; None means those of this process and `ONE_THREAD`.
        kind: Type of the socket between parent and child.
        descriptors: File descriptors that the child inherits in addition to its socket.
        output: Descriptor to which the child's standard output and standard error go; None means those of
            this process.

    Raises:
        OSError: The system cannot start a process, for example because memory or descriptors are used up.
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
        with suppress(OSError):  # the child has exited already
            os.setpriority(os.PRIO_PROCESS, process.pid, nice)
    return Child(process, ours)


def how_ended(code: int) -> str:
    """Return text for an exit code as in `Child.exit_code`: ``exit code 1`` or ``signal SIGKILL``."""
    if code >= 0:
        return f"exit code {code}"
    return f"signal {signal.Signals(-code).name if -code in set(signal.Signals) else -code}"
