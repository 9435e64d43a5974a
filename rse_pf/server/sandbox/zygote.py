"""The zygote: the fork server from which a worker starts its sandboxes.

The zygote imports the modules that services need, so that a forked sandbox starts without imports.  It has
one thread and no event loop, and runs no code of services.  It exits when its worker has exited, after it has
killed every sandbox.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import socket
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rse_pf.errors import ConfigurationError, MissingExtra
from rse_pf.processes.fork_server import ForkPlan, read_packet, serve_forks
from rse_pf.server.sandbox import isolation
from rse_pf.server.sandbox.cgroup import Cgroups, own_hierarchies
from rse_pf.server.sandbox.child import SandboxPlan, readable_paths, run_sandbox
from rse_pf.server.sandbox.watcher import MemoryWatcher
from rse_pf.services.custom.installed import InstalledService
from rse_pf.services.custom.verified_copy import PrivateFolder, VerifiedCopy

__all__ = ["run"]

_GO = b"g"  # byte that a forked sandbox waits for before it isolates itself
_SLOTS = 500  # number of user ids of one zygote, so that the user ids of two zygotes never overlap
_FIRST_UID = 1_000_000  # lowest user id of sandboxes of a server that runs as root; accounts have lower ones
_MAX_THREADS = 64  # most threads of one sandbox, so that a service cannot exhaust the machine's process ids


def run(worker: socket.socket) -> None:
    """Read the configuration from the socket to the *worker*, and fork sandboxes until the worker has exited.

    Then the process exits.  It returns at once if the worker exits before it sends a configuration.
    """
    config, _ = read_packet(worker)
    if config is not None:
        _Zygote(config).run(worker)


class _Zygote:
    def __init__(self, config: dict[str, Any]) -> None:
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
        if "root" in missing and self._private.path is not None:  # sandboxes read the copies in place
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
        self._watch = None if has_cgroup else MemoryWatcher(total_bytes).look
        self._slots: dict[int, int] = {}
        """Slot of each sandbox, by number of the sandbox: its user id minus that of slot 0."""
        self._starts: dict[int, int] = {}
        """Pipe to each sandbox that waits for `_GO`, by number of the sandbox."""

    def run(self, worker: socket.socket) -> None:
        """Serve the orders of *worker* until it has exited; remove cgroups and copies, and exit."""
        plan = ForkPlan(fork=self._fork, begin=self._begin, free=self._free, watch=self._watch)
        serve_forks(worker, plan, missing=list(self._plan.missing), cgroup=list(self._cgroups.controllers))
        self._cgroups.close()
        self._private.remove()
        os._exit(0)

    def _copy(self, installed: list[InstalledService]) -> None:
        """Make a verified copy of each service in *installed*, for all sandboxes.

        A service whose files were changed since the server verified them is refused: each call of it fails.
        """
        for service in installed:
            copy = VerifiedCopy(service, self._private.path or self._private.make())
            try:
                copy.make()
                self._copies[service.name] = copy
            except ConfigurationError as error:
                self._refused[service.name] = error

    def _places(self) -> dict[Path, Path]:
        """Return the folder of the copy for each folder of an installed service, and of its packages."""
        places = {}
        for copy in self._copies.values():
            places[copy.original.folder] = copy.service.folder
            if copy.original.dependencies is not None and copy.service.dependencies is not None:
                places[copy.original.dependencies] = copy.service.dependencies
        return places

    def _plan_of_now(self) -> SandboxPlan:
        """Return the plan of a sandbox that starts now, which refuses services whose files were edited."""
        problems = {name: copy.problem() for name, copy in self._copies.items()}
        edited = {name: error for name, error in problems.items() if error is not None}
        return replace(self._plan, refused={**self._refused, **edited})

    def _fork(self, number: int, descriptors: list[int]) -> int:
        """Fork sandbox *number* and return its process id, 0 if that failed; the sandbox waits for `_begin`.

        A first child enters the namespaces and forks the sandbox, because only a child of the process that
        made a namespace of processes is in it.

        Args:
            number: Number of the sandbox.
            descriptors: Socket to the worker, and pipe for printed output.
        """
        channel, output = descriptors
        used = set(self._slots.values())
        self._slots[number] = next(n for n in range(_SLOTS) if n not in used)
        uid = None if self._first_uid is None else self._first_uid + self._slots[number]
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
            self._starts[number] = go_write
        else:
            os.close(go_write)
            del self._slots[number]
        return pid

    def _begin(self, number: int, pid: int) -> str:
        """Let sandbox *number* isolate itself, and move its process into a cgroup meanwhile (about 10 ms).

        Returns:
            "", or the reason to kill the sandbox: it could not enter its cgroup.
        """
        go = self._starts.pop(number)
        os.write(go, _GO)
        os.close(go)
        return "" if self._cgroups.add(number, pid) else "it could not enter its cgroup"

    def _free(self, number: int) -> str:
        """Free user id and cgroup of the exited sandbox *number*; return the limit that ended it, or ""."""
        del self._slots[number]
        return self._cgroups.remove(number) or ""

    def _fork_inside(
        self, plan: SandboxPlan, channel: int, output: int, uid: int | None, pid_write: int, go_read: int
    ) -> None:
        """Enter the namespaces, fork the sandbox, write its process id to *pid_write* and exit.

        The sandbox is in a session of its own for two reasons.  Linux divides CPU time between sessions
        (``sched_autogroup_enabled``), so that a sandbox with many threads gets no more than one with a single
        thread.  And Linux sends SIGHUP to a process group that has a stopped process and loses its parent: a
        paused sandbox in the server's group would end the server.
        """
        try:
            os.setsid()
            if "namespaces" not in plan.missing:
                isolation.enter_namespaces()
            pid = os.fork()
            if pid == 0 and os.read(go_read, 1) == _GO:  # `_begin` wrote it; the zygote knows the process id
                run_sandbox(plan, channel, output, uid)
            elif pid:
                os.write(pid_write, str(pid).encode())
        finally:
            os._exit(0)

    def _missing_isolation(
        self, readable: list[Path], copies: Mapping[Path, Path], scratch_bytes: int
    ) -> list[str]:
        """Return the names of `isolation.ISOLATION` that this machine lacks, by a try of each means."""
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


def _warm_up(languages: set[str]) -> None:
    """Import the modules that services in *languages* need, so that sandboxes do not import them again."""
    importlib.import_module("numpy.linalg")

    if "cpp" in languages:
        importlib.import_module("rse_pf.services.custom.cpp")
    if "lua" in languages:
        from rse_pf.services.custom.lua import warm_up

        with contextlib.suppress(MissingExtra):  # Lua is not installed: the call of a Lua service reports it
            warm_up()
