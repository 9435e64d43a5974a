"""What the children of tests do."""

from __future__ import annotations

import os
import resource
import signal
import socket
from pathlib import Path

from rse_pf.ipc import encode_message, receive


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
            "secret": os.environ.get("SECRET", ""),
        }))  # fmt: skip


def stay(parent: socket.socket) -> None:
    """Do not end with the socket."""
    parent.sendall(encode_message("here"))
    while True:
        signal.pause()
