"""The process that forks sandboxes: `python -m rse_pf.backend.sandbox.zygote FD`, started by a worker.

It imports once what services need, so that a fork starts without imports.  It starts no thread and no event
loop, runs no service itself, and ends with its worker, together with every sandbox.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
from pathlib import Path
from typing import Any

from rse_pf.backend.sandbox import isolation
from rse_pf.backend.sandbox.child import SandboxPlan, readable_paths, run_sandbox
from rse_pf.errors import MissingExtra
from rse_pf.linux import PR_SET_CHILD_SUBREAPER, die_with_parent, prctl
from rse_pf.services.custom.installed import InstalledService

__all__ = ["main"]

_MAX_MESSAGE = 1 << 20
_GO = b"g"
_SLOTS = 500
"""User ids of one zygote; the next zygote's begin after them."""
_FIRST_UID = 1_000_000
"""Sandboxes of a server that runs as root get user ids from here."""


def main(arguments: list[str]) -> None:
    """Fork sandboxes until the worker is gone."""
    worker = socket.socket(fileno=int(arguments[0]))
    config = json.loads(worker.recv(_MAX_MESSAGE) or b"null")
    if config is not None and die_with_parent(config["worker"]):
        _Zygote(worker, config).run()


class _Zygote:
    def __init__(self, worker: socket.socket, config: dict[str, Any]) -> None:
        self._worker = worker
        services = {
            each["name"]: InstalledService(**{**each, "folder": Path(each["folder"])})
            for each in config["services"]
        }
        _warm_up({service.language for service in services.values()})
        self._first_uid = _FIRST_UID + os.getpid() * _SLOTS if os.getuid() == 0 else None
        self._plan = SandboxPlan(
            services=services,
            memory_bytes=config["memory_bytes"],
            scratch_bytes=config["scratch_bytes"],
            max_bytes=config["max_bytes"],
            missing=self._missing_isolation(list(services.values()), config["scratch_bytes"]),
        )
        self._children: dict[int, tuple[int, int]] = {}
        """Number of the sandbox and slot of its user id, by pid."""

    def run(self) -> None:
        prctl(PR_SET_CHILD_SUBREAPER, 1)
        child_ended, wakeup = os.pipe()
        for fd in (child_ended, wakeup):
            os.set_blocking(fd, False)
        signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        gc.collect()
        gc.freeze()
        self._report(event="ready", missing=list(self._plan.missing))
        poll = select.poll()
        poll.register(self._worker, select.POLLIN)
        poll.register(child_ended, select.POLLIN)
        while True:
            ready = {fd for fd, _ in poll.poll()}
            if child_ended in ready:
                os.read(child_ended, 4096)
            self._reap()
            if self._worker.fileno() in ready and not self._follow_order():
                break
        for pid in self._children:
            os.kill(pid, signal.SIGKILL)
        os._exit(0)

    def _follow_order(self) -> bool:
        try:
            message, fds, _, _ = socket.recv_fds(self._worker, _MAX_MESSAGE, 2)
        except OSError:
            return False
        if not message:
            return False
        order = json.loads(message)
        if order["do"] == "create":
            self._create(order["id"], *fds)
        else:
            for pid, (number, _) in self._children.items():
                if number == order["id"]:
                    os.kill(pid, signal.SIGKILL)
        for fd in fds:
            os.close(fd)
        return True

    def _create(self, number: int, channel: int, output: int) -> None:
        """Fork twice: the first child enters the namespaces, the second is the first process inside them."""
        used = {slot for _, slot in self._children.values()}
        slot = next(n for n in range(_SLOTS) if n not in used)
        uid = None if self._first_uid is None else self._first_uid + slot
        pid_read, pid_write = os.pipe()
        go_read, go_write = os.pipe()
        first = os.fork()
        if first == 0:
            os.close(go_write)
            self._fork_inside(channel, output, uid, pid_write, go_read)
        os.close(pid_write)
        os.close(go_read)
        os.waitpid(first, 0)
        pid = int(os.read(pid_read, 32) or b"0")
        os.close(pid_read)
        if pid:
            self._children[pid] = number, slot
            os.write(go_write, _GO)
        else:
            self._report(event="gone", id=number, how="it could not enter its namespaces")
        os.close(go_write)

    def _fork_inside(self, channel: int, output: int, uid: int | None, pid_write: int, go_read: int) -> None:
        """Enter the namespaces, fork the sandbox, tell its pid and exit."""
        try:
            if "namespaces" not in self._plan.missing:
                isolation.enter_namespaces()
            pid = os.fork()
            if pid == 0 and os.read(go_read, 1) == _GO:  # the zygote knows the pid
                run_sandbox(self._plan, channel, output, uid)
            elif pid:
                os.write(pid_write, str(pid).encode())
        finally:
            os._exit(0)

    def _reap(self) -> None:
        while self._children:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if pid in self._children:
                number, _ = self._children.pop(pid)
                code = os.waitstatus_to_exitcode(status)
                how = f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"
                self._report(event="gone", id=number, how=how)

    def _missing_isolation(self, services: list[InstalledService], scratch_bytes: int) -> list[str]:
        uid = self._first_uid

        def make_root() -> None:
            isolation.enter_namespaces()
            isolation.make_root(readable_paths(services), scratch_bytes, os.getuid() if uid is None else uid)

        return isolation.missing_isolation(
            [
                isolation.enter_namespaces,
                make_root,
                lambda: isolation.give_up_privileges(uid),
                isolation.forbid_system_calls,
            ]
        )

    def _report(self, **message: Any) -> None:
        with contextlib.suppress(OSError):  # the worker is gone, which the next poll shows
            self._worker.send(json.dumps(message).encode())


def _warm_up(languages: set[str]) -> None:
    """Import what every sandbox would import otherwise."""
    importlib.import_module("numpy.linalg")

    if "cpp" in languages:
        importlib.import_module("rse_pf.services.custom.native")
    if "lua" in languages:
        from rse_pf.services.custom.lua import warm_up

        with contextlib.suppress(MissingExtra):  # reported when a robot calls the service
            warm_up()


if __name__ == "__main__":
    main(sys.argv[1:])
