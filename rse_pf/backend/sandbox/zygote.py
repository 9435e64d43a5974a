"""The warm template of environments: `python -m rse_pf.backend.sandbox.zygote FD`, started by a worker.

It imports what services need, then forks an environment for each robot that asks.  Promises to start no
thread and no event loop, to run no service itself, and to die with its worker and take every environment
along.
"""

from __future__ import annotations

import contextlib
import ctypes
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

from rse_pf.backend.sandbox import isolation as walls
from rse_pf.backend.sandbox.child import SandboxPlan, readable_paths, run_environment
from rse_pf.errors import MissingExtra
from rse_pf.linux import die_with_parent
from rse_pf.services.custom.installed import InstalledService

__all__ = ["main"]

_PR_SET_CHILD_SUBREAPER = 36
_MAX_MESSAGE = 1 << 20
_SLOTS = 500
"""User ids of one zygote; the next zygote's begin after them."""


def main(arguments: list[str]) -> None:
    """Fork environments until the worker is gone."""
    worker = socket.socket(fileno=int(arguments[0]))
    config = json.loads(worker.recv(_MAX_MESSAGE) or b"null")
    if config is not None and die_with_parent(config["worker"]):
        _Zygote(worker, config).run()


class _Zygote:
    def __init__(self, worker: socket.socket, config: dict[str, Any]) -> None:
        self._worker = worker
        services = {
            told["name"]: InstalledService(**{**told, "folder": Path(told["folder"])})
            for told in config["services"]
        }
        _warm_up({service.language for service in services.values()})
        self._first_uid = config["first_uid"] + os.getpid() * _SLOTS if os.getuid() == 0 else None
        self._plan = SandboxPlan(
            services=services,
            memory_bytes=config["memory_bytes"],
            scratch_bytes=config["scratch_bytes"],
            max_bytes=config["max_bytes"],
            missing=self._missing(list(services.values()), config["scratch_bytes"]),
        )
        self._children: dict[int, int] = {}
        self._slots: dict[int, int] = {}

    def run(self) -> None:
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        awake, wake = os.pipe()
        for fd in (awake, wake):
            os.set_blocking(fd, False)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        gc.collect()
        gc.freeze()
        self._say(event="ready", missing=list(self._plan.missing))
        poll = select.poll()
        poll.register(self._worker, select.POLLIN)
        poll.register(awake, select.POLLIN)
        while True:
            ready = {fd for fd, _ in poll.poll()}
            if awake in ready:
                os.read(awake, 4096)
            self._reap()
            if self._worker.fileno() in ready and not self._obey():
                break
        for pid in self._children:
            os.kill(pid, signal.SIGKILL)
        os._exit(0)

    def _obey(self) -> bool:
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
            for pid in [pid for pid, which in self._children.items() if which == order["id"]]:
                os.kill(pid, signal.SIGKILL)
        for fd in fds:
            os.close(fd)
        return True

    def _create(self, which: int, conversation: int, output: int) -> None:
        """Fork twice: the first child enters the namespaces, the second is the first process inside them."""
        slot = next(n for n in range(_SLOTS) if n not in self._slots.values())
        uid = None if self._first_uid is None else self._first_uid + slot
        told, tell = os.pipe()
        go, let_go = os.pipe()
        keeper = os.fork()
        if keeper == 0:
            self._keep(conversation, output, uid, tell, go, let_go)
        os.close(tell)
        os.close(go)
        os.waitpid(keeper, 0)
        pid = int(os.read(told, 32) or b"0")
        os.close(told)
        if pid:
            self._children[pid] = which
            self._slots[pid] = slot
            os.write(let_go, b"g")
            self._say(event="created", id=which, pid=pid)
        else:
            self._say(event="gone", id=which, how="could not enter its namespaces")
        os.close(let_go)

    def _keep(self, conversation: int, output: int, uid: int | None, tell: int, go: int, let_go: int) -> None:
        try:
            if "namespaces" not in self._plan.missing:
                walls.enter_namespaces()
            pid = os.fork()
            if pid == 0:
                os.close(let_go)
                run_environment(
                    self._plan, conversation, output, uid, lambda: _wait_for(go)
                )  # does not return
            os.write(tell, str(pid).encode())
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
            which = self._children.pop(pid, None)
            self._slots.pop(pid, None)
            if which is not None:
                code = os.waitstatus_to_exitcode(status)
                how = f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"
                self._say(event="gone", id=which, how=how)

    def _missing(self, services: list[InstalledService], scratch_bytes: int) -> list[str]:
        uid = self._first_uid

        def root() -> None:
            walls.enter_namespaces()
            walls.make_root(readable_paths(services), scratch_bytes, os.getuid() if uid is None else uid)

        tries = (
            walls.enter_namespaces, root, lambda: walls.give_up_privileges(uid), walls.forbid_system_calls
        )  # fmt: skip
        return walls.missing_walls(tries)

    def _say(self, **message: Any) -> None:
        with contextlib.suppress(OSError):  # the worker is gone: the next poll tells
            self._worker.send(json.dumps(message).encode())


def _wait_for(go: int) -> None:
    if os.read(go, 1) != b"g":
        os._exit(1)
    os.close(go)


def _warm_up(languages: set[str]) -> None:
    """Import once what every environment would import again."""
    importlib.import_module("numpy.linalg")

    if "cpp" in languages:
        importlib.import_module("rse_pf.services.custom.native")
    if "lua" in languages:
        from rse_pf.services.custom.lua import warm_up

        with contextlib.suppress(MissingExtra):  # said when a robot calls the service
            warm_up()


if __name__ == "__main__":
    main(sys.argv[1:])
