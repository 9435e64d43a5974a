"""A fork server: a child process that imports modules once, and forks, kills and reaps processes on order.

Orders and reports are JSON, one in each packet of its socket, and may carry descriptors.  A fork
server works for one level of trust: each user of this module starts its own, and that of sandboxes has no
environment variables, keys and sockets of a server.
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

_MAX_PACKET_BYTES = 1 << 20  # a configuration has at most 100 kB
_MAX_DESCRIPTORS = 2  # that one packet carries


# --- the parent's side ------------------------------------------------------------------------------------


def start_fork_server(
    plan: ChildPlan, configuration: Any, *, environment: Mapping[str, str] | None = None
) -> Child:
    """Start a fork server, whose function gets *configuration* as its first packet; raises OSError."""
    child = start_child(plan, environment=environment, kind=socket.SOCK_SEQPACKET, output=2)
    with suppress(OSError):  # it has ended, which the next read shows
        child.connection.send(json.dumps(configuration).encode())
    return child


def send_order(server: Child, do: str, number: int, *descriptors: int) -> None:
    """Order to ``create`` or to ``end`` a fork; raises OSError if the server ended, or is behind."""
    socket.send_fds(server.connection, [json.dumps({"do": do, "id": number}).encode()], descriptors)


def read_packet(connection: socket.socket) -> tuple[Any, list[int]]:
    """Return the next packet and its descriptors, None at the end; raises BlockingIOError.

    A parent reads ``ready``, ``created`` with the ``pid`` and a descriptor of the process, and ``gone`` with
    how it ended and the CPU seconds that it took, each as an ``event``.
    """
    try:
        message, descriptors, _, _ = socket.recv_fds(connection, _MAX_PACKET_BYTES, _MAX_DESCRIPTORS)
    except (BlockingIOError, TimeoutError):
        raise
    except OSError:
        return None, []
    return (json.loads(message) if message else None), descriptors


# --- the fork server ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class ForkPlan:
    """What a fork server does for each fork."""

    fork: Callable[[int, list[int]], int]
    """Forks process *number* with the descriptors of its order; returns its pid, 0 if it could not."""
    begin: Callable[[int, int], str] = lambda number, pid: ""
    """Starts the work of process *number* after its *pid* was reported; returns why to kill it, or ""."""
    free: Callable[[int], str] = lambda number: ""
    """Frees the resources of process *number*; returns why it ended, or "" if its exit code shows that."""
    watch: Callable[[list[int]], tuple[dict[int, str], float]] | None = None
    """Checks all forks, by pid; returns why to kill some of them, and the seconds until the next check."""
    keeps_ended: bool = False
    """Whether a process that ended keeps its pid, and is reported, only when its end is ordered."""


def serve_forks(parent: socket.socket, plan: ForkPlan, **ready: Any) -> None:
    """Report that this process is ready, and follow the orders of *parent* until it exits; kill all forks."""
    _Forks(parent, plan).run(ready)


@dataclass(frozen=True, slots=True)
class _Fork:
    number: int
    handle: int
    """Descriptor of its process."""


class _Forks:
    def __init__(self, parent: socket.socket, plan: ForkPlan) -> None:
        self._parent = parent
        self._plan = plan
        self._forks: dict[int, _Fork] = {}
        """By pid."""
        self._reasons: dict[int, str] = {}
        """Why forks were killed that are still ending, by pid."""
        self._look_s = 0.0
        """When `ForkPlan.watch` looks next."""
        self._poll = select.poll()

    def run(self, ready: dict[str, Any]) -> None:
        if not self._plan.keeps_ended:
            prctl(PR_SET_CHILD_SUBREAPER, 1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # descriptors of processes report their end
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
        """Return how long there is nothing to do without an event; None is forever."""
        if self._plan.watch is None or not self._forks:
            return None
        return max(0.0, self._look_s - time.monotonic()) * 1e3

    def _watch(self) -> None:
        watch = self._plan.watch
        if watch is None or not self._forks or time.monotonic() < self._look_s:
            return
        reasons, pause_s = watch(list(self._forks))
        for pid, reason in reasons.items():
            self._kill(pid, reason)
        self._look_s = time.monotonic() + pause_s

    def _kill(self, pid: int, reason: str) -> None:
        self._reasons[pid] = reason
        os.kill(pid, signal.SIGKILL)

    def _follow_order(self) -> bool:
        """Follow one order; return False when the parent has exited."""
        order, descriptors = read_packet(self._parent)
        if order is None:
            return False
        if order["do"] == "create":
            self._create(order["id"], descriptors)
        else:
            for pid in [pid for pid, fork in self._forks.items() if fork.number == order["id"]]:
                os.kill(pid, signal.SIGKILL)  # it is not reaped yet, so no other process has this id
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
        """Reap and report the fork *which*, or each one that has ended; with *wait* all of them."""
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
