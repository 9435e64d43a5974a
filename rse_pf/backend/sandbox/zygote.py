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
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rse_pf.backend.sandbox import isolation
from rse_pf.backend.sandbox.cgroup import Cgroups, own_hierarchies
from rse_pf.backend.sandbox.child import SandboxPlan, readable_paths, run_sandbox
from rse_pf.backend.sandbox.watcher import MemoryWatcher
from rse_pf.errors import ConfigurationError, MissingExtra
from rse_pf.linux import PR_SET_CHILD_SUBREAPER, die_with_parent, prctl
from rse_pf.services.custom.installed import InstalledService
from rse_pf.services.custom.verified_copy import PrivateFolder, VerifiedCopy

__all__ = ["main"]

_MAX_MESSAGE = 1 << 20
_GO = b"g"
_SLOTS = 500
"""User ids of one zygote; the next zygote's begin after them."""
_FIRST_UID = 1_000_000
"""Sandboxes of a server that runs as root get user ids from here."""
_MAX_THREADS = 64


def main(arguments: list[str]) -> None:
    """Fork sandboxes until the worker is gone."""
    worker = socket.socket(fileno=int(arguments[0]))
    config = json.loads(worker.recv(_MAX_MESSAGE) or b"null")
    if config is not None and die_with_parent(config["worker"]):
        _Zygote(worker, config).run()


@dataclass(frozen=True, slots=True)
class _Child:
    """A sandbox: its number, the slot of its user id, and a descriptor of its process."""

    number: int
    slot: int
    handle: int


class _Zygote:
    def __init__(self, worker: socket.socket, config: dict[str, Any]) -> None:
        self._worker = worker
        services = {
            fields["name"]: InstalledService(
                **{
                    **fields,
                    **{name: fields[name] and Path(fields[name]) for name in ("folder", "dependencies")},
                }
            )
            for fields in config["services"]
        }
        _warm_up({service.language for service in services.values()})
        self._first_uid = _FIRST_UID + os.getpid() * _SLOTS if os.getuid() == 0 else None
        self._private = PrivateFolder(Path(config["temporary"]))
        self._copies: dict[str, VerifiedCopy] = {}
        self._refused: dict[str, ConfigurationError] = {}
        self._copy([service for service in services.values() if service.identity])
        readable = readable_paths([service for service in services.values() if not service.identity])
        copies = self._places()
        missing = self._missing_isolation(readable, copies, config["scratch_bytes"])
        if "root" in missing and self._private.path is not None:  # a sandbox sees the copies where they are
            self._private.path.chmod(0o755)
            services |= {name: copy.service for name, copy in self._copies.items()}
        self._plan = SandboxPlan(
            services=services,
            readable=readable,
            copies=copies,
            memory_bytes=config["memory_bytes"],
            scratch_bytes=config["scratch_bytes"],
            max_bytes=config["max_bytes"],
            missing=missing,
        )
        total_bytes = config["total_bytes"]
        self._cgroups = Cgroups(
            own_hierarchies(), owner=os.getpid(), memory_bytes=total_bytes, max_threads=_MAX_THREADS
        )
        self._cgroups.prepare()
        has_cgroup = "memory" in self._cgroups.controllers
        self._watcher = None if has_cgroup else MemoryWatcher(total_bytes)
        self._look_s = 0.0
        """When the watcher looks next."""
        self._children: dict[int, _Child] = {}
        """By pid."""
        self._reasons: dict[int, str] = {}
        """Why sandboxes were killed that are still ending, by pid."""
        self._poll = select.poll()

    def run(self) -> None:
        prctl(PR_SET_CHILD_SUBREAPER, 1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # descriptors of processes report their end
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        gc.collect()
        gc.freeze()
        self._report(event="ready", missing=list(self._plan.missing), cgroup=list(self._cgroups.controllers))
        self._poll.register(self._worker, select.POLLIN)
        while True:
            ready = {fd for fd, _ in self._poll.poll(self._wait_ms())}
            self._reap()
            self._watch()
            if self._worker.fileno() in ready and not self._follow_order():
                break
        for pid in self._children:
            os.kill(pid, signal.SIGKILL)
        while self._children:
            self._reap(wait=True)
        self._cgroups.close()
        self._private.remove()
        os._exit(0)

    def _copy(self, installed: list[InstalledService]) -> None:
        """Copy and compare *installed*; what was changed since the worker looked is refused."""
        for service in installed:
            copy = VerifiedCopy(service, self._private.path or self._private.make())
            try:
                copy.make()
                self._copies[service.name] = copy
            except ConfigurationError as error:
                self._refused[service.name] = error

    def _places(self) -> dict[Path, Path]:
        """Return the folders of installed services and of their packages, and the copies of both."""
        places = {}
        for copy in self._copies.values():
            places[copy.original.folder] = copy.service.folder
            if copy.original.dependencies is not None and copy.service.dependencies is not None:
                places[copy.original.dependencies] = copy.service.dependencies
        return places

    def _plan_of_now(self) -> SandboxPlan:
        """Return the plan of a sandbox that starts now: a service that somebody edited is refused."""
        problems = {name: copy.problem() for name, copy in self._copies.items()}
        edited = {name: error for name, error in problems.items() if error is not None}
        return replace(self._plan, refused={**self._refused, **edited})

    def _wait_ms(self) -> float | None:
        """Return how long there is nothing to do without an event; None is forever."""
        if self._watcher is None or not self._children:
            return None
        return max(0.0, self._look_s - time.monotonic()) * 1e3

    def _watch(self) -> None:
        """End the sandboxes that use too much memory in all."""
        if self._watcher is None or not self._children or time.monotonic() < self._look_s:
            return
        for pid, reason in self._watcher.find_excess(list(self._children)).items():
            self._reasons[pid] = reason
            os.kill(pid, signal.SIGKILL)
        self._look_s = time.monotonic() + self._watcher.interval_s

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
            for pid, child in self._children.items():
                if child.number == order["id"]:
                    os.kill(pid, signal.SIGKILL)
        for fd in fds:
            os.close(fd)
        return True

    def _create(self, number: int, channel: int, output: int) -> None:
        """Fork twice: the first child enters the namespaces, the second is the first process inside them.

        Its cgroup comes last: moving a process takes about 10 ms, in which it isolates itself.
        """
        used = {child.slot for child in self._children.values()}
        slot = next(n for n in range(_SLOTS) if n not in used)
        uid = None if self._first_uid is None else self._first_uid + slot
        pid_read, pid_write = os.pipe()
        go_read, go_write = os.pipe()
        plan = self._plan_of_now()
        first = os.fork()
        if first == 0:
            os.close(go_write)
            self._fork_inside(plan, channel, output, uid, pid_write, go_read)
        os.close(pid_write)
        os.close(go_read)
        os.waitpid(first, 0)
        pid = int(os.read(pid_read, 32) or b"0")
        os.close(pid_read)
        if pid:
            handle = os.pidfd_open(pid)
            self._children[pid] = _Child(number, slot, handle)
            self._poll.register(handle, select.POLLIN)
            self._report(handle, event="created", id=number)
            os.write(go_write, _GO)
            if not self._cgroups.add(number, pid):
                self._reasons[pid] = "it could not enter its cgroup"
                os.kill(pid, signal.SIGKILL)
        else:
            self._report(event="gone", id=number, how="it could not enter its namespaces")
        os.close(go_write)

    def _fork_inside(
        self, plan: SandboxPlan, channel: int, output: int, uid: int | None, pid_write: int, go_read: int
    ) -> None:
        """Enter the namespaces, fork the sandbox, tell its pid and exit.

        A session of its own: Linux shares the processor between sessions (`sched_autogroup_enabled`), so that
        the threads of a sandbox weigh no more than one.  And a stopped process in the server's process group
        would have Linux end that group with SIGHUP when the parent of the group ends.
        """
        try:
            os.setsid()
            if "namespaces" not in plan.missing:
                isolation.enter_namespaces()
            pid = os.fork()
            if pid == 0 and os.read(go_read, 1) == _GO:  # the zygote knows the pid
                run_sandbox(plan, channel, output, uid)
            elif pid:
                os.write(pid_write, str(pid).encode())
        finally:
            os._exit(0)

    def _reap(self, *, wait: bool = False) -> None:
        while self._children:
            try:
                pid, status = os.waitpid(-1, 0 if wait else os.WNOHANG)
            except ChildProcessError:
                return
            if pid == 0:
                return
            if pid in self._children:
                child = self._children.pop(pid)
                self._poll.unregister(child.handle)
                os.close(child.handle)
                code = os.waitstatus_to_exitcode(status)
                how = f"exit code {code}" if code >= 0 else f"signal {signal.Signals(-code).name}"
                how = self._reasons.pop(pid, how)
                how = self._cgroups.remove(child.number) or how
                self._report(event="gone", id=child.number, how=how)

    def _missing_isolation(
        self, readable: list[Path], copies: Mapping[Path, Path], scratch_bytes: int
    ) -> list[str]:
        uid = self._first_uid

        def make_root() -> None:
            isolation.enter_namespaces()
            isolation.make_root(readable, scratch_bytes, os.getuid() if uid is None else uid, copies)

        return isolation.missing_isolation(
            [
                isolation.enter_namespaces,
                make_root,
                lambda: isolation.give_up_privileges(uid),
                isolation.forbid_system_calls,
            ]
        )

    def _report(self, handle: int | None = None, **message: Any) -> None:
        data = json.dumps(message).encode()
        with contextlib.suppress(OSError):  # the worker is gone, which the next poll shows
            socket.send_fds(self._worker, [data], [] if handle is None else [handle])


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
