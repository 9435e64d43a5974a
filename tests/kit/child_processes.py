"""What the children of tests do."""

from __future__ import annotations

import os
import resource
import signal
import socket
from pathlib import Path

from rse_pf.processes.fork_server import ForkPlan, read_packet, serve_forks
from rse_pf.processes.ipc import encode_message, receive
from rse_pf.processes.start import ChildPlan, start_child


def tell(parent: socket.socket) -> None:
    """Answer each message with what the child knows of itself; end with the socket."""
    while receive(parent) is not None:
        held = [os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if fd != "3"]
        parent.sendall(encode_message({
            "name": Path("/proc/self/comm").read_text().strip(),
            "policy": os.sched_getscheduler(0),
            "nice": os.nice(0),
            "memory": resource.getrlimit(resource.RLIMIT_DATA)[1],
            "core": resource.getrlimit(resource.RLIMIT_CORE)[1],
            "oom": Path("/proc/self/oom_score_adj").read_text().strip(),
            "sockets": sum(name.startswith("socket") for name in held if name),
            "word": os.environ.get("A_WORD", ""),
        }))  # fmt: skip


def stay(parent: socket.socket) -> None:
    """Do not end with the socket."""
    parent.sendall(encode_message("here"))
    while True:
        signal.pause()


def nest(parent: socket.socket) -> None:
    """Start a child that stays, tell its pid, and wait."""
    started = start_child(ChildPlan(target="tests.kit.child_processes:stay", name="a grandchild"))
    receive(started.connection)
    parent.sendall(encode_message(started.pid))
    receive(parent)


def fork(parent: socket.socket) -> None:
    """Fork processes that stay; the second one is not to begin."""
    read_packet(parent)

    def start(number: int, descriptors: list[int]) -> int:
        pid = os.fork()
        if pid == 0:
            signal.pause()
        return pid

    serve_forks(parent, ForkPlan(fork=start, begin=lambda number, pid: "not today" if number == 2 else ""))
