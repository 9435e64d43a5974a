"""A fork server: a child process that imports modules once, and forks, kills and reaps further processes.

Its parent sends orders, and receives reports.  Both are JSON, one in each packet of the socket, and may carry
file descriptors.  Each module that needs forks starts a fork server of its own, because forks inherit the
memory and the descriptors of the fork server: that of sandboxes has no environment variables, keys and
sockets of a server.
"""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from rse_pf.processes.linux import PR_SET_CHILD_SUBREAPER, prctl
from rse_pf.processes.start import Child, ChildPlan, how_ended, start_child

__all__ = ["ForkPlan", "read_packet", "send_order", "serve_forks", "start_fork_server"]

_MAX_PACKET_BYTES = 1 << 20  # largest packet: a configuration has at most 100 kB
_MAX_DESCRIPTORS = 2  # most file descriptors that one packet carries


# --- functions for the parent of a fork server ------------------------------------------------------------


def start_fork_server(
    plan: ChildPlan, configuration: Any, *, environment: Mapping[str, str] | None = None
) -> Child:
    """Start the fork server *plan*; raises OSError.

    Its function receives *configuration*, a JSON value, as its first packet.  *environment* are its
    environment variables; None means those of this process.
    """
    child = start_child(plan, environment=environment, kind=socket.SOCK_SEQPACKET, output=2)
    with suppress(OSError):  # the fork server has exited, which the next read shows
        child.connection.send(json.dumps(configuration).encode())
    return child


def send_order(server: Child, do: str, number: int, *descriptors: int) -> None:
    """Order the fork server to ``create`` or to ``end`` (*do*) the fork with this *number*.

    *descriptors* are passed to a new fork.

    Raises:
        OSError: The fork server has exited, or does not read its socket fast enough.
    """
    socket.send_fds(server.connection, [json.dumps({"do": do, "id": number}).encode()], descriptors)


def read_packet(connection: socket.socket) -> tuple[Any, list[int]]:
    """Return the next packet as a JSON value, and its file descriptors; None if the other side has exited.

    A parent receives reports, whose ``event`` is ``ready`` (the fork server), ``created`` with the ``pid``
    and a descriptor of the fork's process, or ``gone`` with how the fork ended (``how``) and its CPU seconds
    (``cpu_s``).

    Raises:
        BlockingIOError: The socket does not block, and there is no packet.
        TimeoutError: No packet came within the time limit of the socket.
    """
    try:
        message, descriptors, _, _ = socket.recv_fds(connection, _MAX_PACKET_BYTES, _MAX_DESCRIPTORS)
    except (BlockingIOError, TimeoutError):
        raise
    except OSError:
        return None, []
    return (json.loads(message) if message else None), descriptors


# --- functions of the fork server itself --------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class ForkPlan:
    """The functions that a fork server calls for its forks."""

    fork: Callable[[int, list[int]], int]
    """Forks the process *number*, with the descriptors of its order; returns its pid, 0 if that failed."""
    begin: Callable[[int, int], str] = lambda number, pid: ""
    """Starts the work of the fork *number* after its pid was reported; returns a reason to kill it, or ""."""
    free: Callable[[int], str] = lambda number: ""
    """Frees the resources of the fork *number*, which has exited; returns how it ended, or "" if its exit
    code says that."""
    watch: Callable[[list[int]], tuple[dict[int, str], float]] | None = None
    """Checks the forks with these pids; returns, by pid, the reasons to kill some of them, and the seconds
    until the next check."""
    keeps_ended: bool = False
    """Whether a fork that exited is reaped and reported only when ``end`` is ordered for it, not at once."""


def serve_forks(parent: socket.socket, plan: ForkPlan, **ready: Any) -> None:
    """Report ``ready`` to the parent, and execute its orders until it exits; then kill all forks and return.

    Args:
        parent: The socket to the parent.
        plan: The functions for the forks.
        ready: Further members of the report ``ready``.
    """
    _Forks(parent, plan).run(ready)


@dataclass(frozen=True, slots=True)
class _Fork:
    number: int
    handle: int
    """Descriptor of the fork's process (pidfd)."""


class _Forks:
    def __init__(self, parent: socket.socket, plan: ForkPlan) -> None:
        self._parent = parent
        self._plan = plan
        self._forks: dict[int, _Fork] = {}
        """The forks that were not reaped yet, by pid."""
        self._reasons: dict[int, str] = {}
        """By pid of a fork that was killed and not reaped yet: the reason."""
        self._next_watch_s = 0.0
        """Monotonic time of the next call of `ForkPlan.watch`."""
        self._poll = select.poll()

    def run(self, ready: dict[str, Any]) -> None:
        if not self._plan.keeps_ended:
            prctl(PR_SET_CHILD_SUBREAPER, 1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # pidfds report the exits of forks instead
        gc.collect()
        gc.freeze()
        self._report(event="ready", **ready)
        self._poll.register(self._parent, select.POLLIN)
        while True:
            found = {fd for fd, _ in self._poll.poll(self._wait_ms())}
            if not self._plan.keeps_ended:
                self._reap()
            self._watch()
            if self._parent.fileno() in found and not self._follow_order():
                break
        for pid in self._forks:
            os.kill(pid, signal.SIGKILL)
        while self._forks:
            self._reap(wait=True)

    def _wait_ms(self) -> float | None:
        """Return the milliseconds until the next call of `ForkPlan.watch`, None if none is planned."""
        if self._plan.watch is None or not self._forks:
            return None
        return max(0.0, self._next_watch_s - time.monotonic()) * 1e3

    def _watch(self) -> None:
        watch = self._plan.watch
        if watch is None or not self._forks or time.monotonic() < self._next_watch_s:
            return
        reasons, pause_s = watch(list(self._forks))
        for pid, reason in reasons.items():
            self._kill(pid, reason)
        self._next_watch_s = time.monotonic() + pause_s

    def _kill(self, pid: int, reason: str) -> None:
        self._reasons[pid] = reason
        os.kill(pid, signal.SIGKILL)

    def _follow_order(self) -> bool:
        """Execute one order of the parent; return False if the parent has exited."""
        order, descriptors = read_packet(self._parent)
        if order is None:
            return False
        if order["do"] == "create":
            self._create(order["id"], descriptors)
        else:
            for pid in [pid for pid, fork in self._forks.items() if fork.number == order["id"]]:
                os.kill(pid, signal.SIGKILL)  # the fork is not reaped yet, so no other process has this pid
                if self._plan.keeps_ended:
                    self._reap(pid, wait=True)
        for fd in descriptors:
            os.close(fd)
        return True

    def _create(self, number: int, descriptors: list[int]) -> None:
        pid = self._plan.fork(number, descriptors)
        if not pid:
            self._report(event="gone", id=number, how="it could not be started", cpu_s=0.0)
            return
        handle = os.pidfd_open(pid)
        self._forks[pid] = _Fork(number, handle)
        if not self._plan.keeps_ended:
            self._poll.register(handle, select.POLLIN)
        self._report(handle, event="created", id=number, pid=pid)
        reason = self._plan.begin(number, pid)
        if reason:
            self._kill(pid, reason)

    def _reap(self, which: int = -1, *, wait: bool = False) -> None:
        """Reap and report the fork with the pid *which* (-1: each fork) if it has exited.

        With *wait*, wait until the fork (-1: all forks) has exited.
        """
        while self._forks:
            try:
                pid, status, used = os.wait4(which, 0 if wait else os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if pid in self._forks:
                fork = self._forks.pop(pid)
                if not self._plan.keeps_ended:
                    self._poll.unregister(fork.handle)
                os.close(fork.handle)
                how = self._reasons.pop(pid, "") or how_ended(os.waitstatus_to_exitcode(status))
                how = self._plan.free(fork.number) or how
                self._report(event="gone", id=fork.number, how=how, cpu_s=used.ru_utime + used.ru_stime)

    def _report(self, handle: int | None = None, **message: Any) -> None:
        data = json.dumps(message).encode()
        with suppress(OSError):  # the parent has exited, which the next poll shows
            socket.send_fds(self._parent, [data], [] if handle is None else [handle])
