"""The process of one sandbox: isolate itself, then answer the worker's requests until the end.

One process, one thread, one socket to its worker.  No code of a service runs before the isolation is
complete, and whatever a service raises becomes a typed failure.
"""

from __future__ import annotations

import io
import os
import signal
import socket
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.backend.sandbox import isolation
from rse_pf.backend.sandbox.ipc import encode_message, receive
from rse_pf.errors import ConfigurationError, InternalError, LimitExceeded, RsePfError
from rse_pf.linux import die_with_parent
from rse_pf.services.custom.installed import InstalledService
from rse_pf.services.custom.runtime import Runtime, open_runtime

__all__ = ["SandboxPlan", "readable_paths", "run_sandbox"]

_FRAMES_SHOWN = -3
"""The last ones: those of the service."""
_SYSTEM_PATHS = ("/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache", "/etc/localtime")


@dataclass(frozen=True, slots=True, kw_only=True)
class SandboxPlan:
    """What every sandbox of a server has in common.

    ``max_bytes`` limits a reply, and ``missing`` names the means of isolation that this kernel lacks.
    """

    services: Mapping[str, InstalledService]
    memory_bytes: int
    scratch_bytes: int
    max_bytes: int
    missing: Sequence[str]


def readable_paths(services: Sequence[InstalledService]) -> list[Path]:
    """Return what a sandbox may read: the system's libraries, Python, this package, the services."""
    package = Path(__file__).resolve().parents[2]
    own = [Path(sys.prefix), Path(sys.base_prefix), package, *(service.folder for service in services)]
    return [*(Path(path) for path in _SYSTEM_PATHS), *own]


def run_sandbox(plan: SandboxPlan, channel: int, output: int, uid: int | None) -> None:
    """Become a sandbox and serve; never returns.

    Args:
        plan: What to run and how much it may use.
        channel: Socket to the worker.
        output: Where the service's standard output and error go.
        uid: User to become, if this process is root.
    """
    code = 1
    try:
        _reset_process(output)
        isolation.close_other_descriptors(channel)
        _isolate(plan, uid)
        die_with_parent()
        with socket.socket(fileno=channel) as connection:
            connection.sendall(encode_message(["ready"]))
            _serve(plan, connection)
        code = 0
    except BaseException:  # noqa: BLE001  the process ends here, and its output is the log
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _reset_process(output: int) -> None:
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGCHLD, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    null = os.open("/dev/null", os.O_RDWR)
    for fd, source in ((0, null), (1, output), (2, output)):
        os.dup2(source, fd)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # a process that is killed flushes nothing
    os.environ.clear()
    os.environ.update(HOME="/scratch", TMPDIR="/scratch", PATH="/usr/bin", LANG="C.UTF-8")


def _isolate(plan: SandboxPlan, uid: int | None) -> None:
    owner = os.getuid() if uid is None else uid
    if "root" not in plan.missing:
        isolation.make_root(readable_paths(list(plan.services.values())), plan.scratch_bytes, owner)
    alone = uid is not None or "namespaces" not in plan.missing
    isolation.limit_resources(plan.memory_bytes, plan.scratch_bytes, alone=alone)
    if "privileges" not in plan.missing:
        isolation.give_up_privileges(uid)
    if "seccomp" not in plan.missing:
        isolation.forbid_system_calls()


def _serve(plan: SandboxPlan, connection: socket.socket) -> None:
    runtimes: dict[str, Runtime] = {}
    while request := receive(connection):
        kind, name, value = request
        began = time.perf_counter()
        try:
            answer = _answer(plan, runtimes, kind, name, value)
        except RsePfError as error:
            answer = [False, error.code, error.message, error.hint]
        except BaseException as error:  # noqa: BLE001  foreign code may raise anything, SystemExit too
            traceback.print_exc(limit=_FRAMES_SHOWN)
            text = f"{type(error).__name__} in service {name!r}"
            answer = [False, InternalError.code, text, "the server's log has it"]
        answer.append((time.perf_counter() - began) * 1e3)
        connection.sendall(_encode_within(answer, plan.max_bytes))


def _answer(plan: SandboxPlan, runtimes: dict[str, Runtime], kind: str, name: str, value: Any) -> list[Any]:
    runtime = runtimes.get(name)
    if runtime is None:
        try:
            runtime = runtimes[name] = open_runtime(plan.services[name], Path.cwd())
        except ConfigurationError as error:
            sys.stderr.write(error.report() + "\n")
            sys.stderr.flush()
            raise InternalError(
                f"service {name!r} cannot be loaded", hint="the server's log says why"
            ) from error
    if kind == "restore":
        if runtime.has_snapshots:
            runtime.restore(value)
        return [True, runtime.has_snapshots, None]
    reply = runtime.call(value)
    return [True, reply, runtime.snapshot() if runtime.has_snapshots else None]


def _encode_within(answer: list[Any], max_bytes: int) -> bytes:
    try:
        data = encode_message(answer)
        problem = f"a reply of {len(data)} bytes is above {max_bytes}" if len(data) > max_bytes else ""
    except (TypeError, ValueError, OverflowError, RsePfError) as error:
        problem = f"the reply cannot be encoded: {str(error)[:150]}"
    if problem:
        return encode_message([False, LimitExceeded.code, problem, "reply with less", answer[-1]])
    return data
