"""The inside of one robot's isolated environment: raise the walls, then answer requests until the end.

One process, one thread, one conversation with its worker: each message is a length and MessagePack.  Promises
that no code of a service runs before the last wall stands, and that whatever a service raises becomes a
typed failure.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import struct
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from rse_pf.backend.sandbox import isolation as walls
from rse_pf.errors import ConfigurationError, InternalError, LimitExceeded, RsePfError
from rse_pf.services.custom.installed import InstalledService
from rse_pf.services.custom.runtime import Runtime, open_runtime
from rse_pf.wire.arrays import binary_encode_hook, extension_hook

__all__ = ["HEADER", "SandboxPlan", "decoded", "encoded", "readable_paths", "run_environment"]

HEADER = struct.Struct("<I")
"""Length of the MessagePack body that follows."""

_PR_SET_PDEATHSIG = 1
_FRAMES_SHOWN = -3
"""The last ones: those of the service."""
_SYSTEM_PATHS = ("/usr", "/lib", "/lib64", "/bin", "/etc/ld.so.cache", "/etc/localtime")


@dataclass(frozen=True, slots=True, kw_only=True)
class SandboxPlan:
    """What every environment of a server has in common."""

    services: Mapping[str, InstalledService]
    memory_bytes: int
    scratch_bytes: int
    max_bytes: int
    """Of a reply, and of a snapshot."""
    missing: Sequence[str]
    """Walls that this kernel lacks; the operator accepted that."""


def encoded(message: Any) -> bytes:
    """Return *message* with its length before it."""
    body = msgspec.msgpack.encode(message, enc_hook=binary_encode_hook)
    return HEADER.pack(len(body)) + body


def decoded(body: bytes) -> Any:
    """Return the message of *body*; raises msgspec.DecodeError."""
    return msgspec.msgpack.decode(body, ext_hook=extension_hook)


def readable_paths(services: Sequence[InstalledService]) -> list[Path]:
    """Return what an environment may read: the system's libraries, Python, this package, the services."""
    package = Path(__file__).resolve().parents[2]
    own = [Path(sys.prefix), Path(sys.base_prefix), package, *(service.folder for service in services)]
    return [*(Path(path) for path in _SYSTEM_PATHS), *own]


def run_environment(
    plan: SandboxPlan, conversation: int, output: int, uid: int | None, allowed: Callable[[], None]
) -> None:
    """Become an environment and serve; never returns.

    Args:
        plan: What to run and how much it may use.
        conversation: Socket to the worker.
        output: Where the service's standard output and error go.
        uid: User to become, if this process is root.
        allowed: Returns when the process that forked this one is gone and this one may begin.
    """
    code = 1
    try:
        allowed()
        _wire_up(output)
        walls.close_other_descriptors([conversation])
        _raise_walls(plan, uid)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        with socket.socket(fileno=conversation) as connection:
            connection.sendall(encoded(["ready"]))
            _serve(plan, connection)
        code = 0
    except BaseException:  # noqa: BLE001  the process ends here, and its output is the log
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _wire_up(output: int) -> None:
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGCHLD, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    null = os.open("/dev/null", os.O_RDWR)
    for fd, source in ((0, null), (1, output), (2, output)):
        os.dup2(source, fd)
    os.environ.clear()
    os.environ.update(HOME="/scratch", TMPDIR="/scratch", PATH="/usr/bin", LANG="C.UTF-8")


def _raise_walls(plan: SandboxPlan, uid: int | None) -> None:
    owner = os.getuid() if uid is None else uid
    if "root" not in plan.missing:
        walls.make_root(readable_paths(list(plan.services.values())), plan.scratch_bytes, owner)
    alone = uid is not None or "namespaces" not in plan.missing
    walls.limit_resources(plan.memory_bytes, plan.scratch_bytes, alone=alone)
    if "privileges" not in plan.missing:
        walls.give_up_privileges(uid)
    if "seccomp" not in plan.missing:
        walls.forbid_system_calls()


def _serve(plan: SandboxPlan, connection: socket.socket) -> None:
    runtimes: dict[str, Runtime] = {}
    with connection.makefile("rb") as requests:
        while header := requests.read(HEADER.size):
            what, name, value = decoded(requests.read(*HEADER.unpack(header)))
            began = time.perf_counter()
            try:
                answer = _answer(plan, runtimes, what, name, value)
            except RsePfError as error:
                answer = [False, error.code, error.message, error.hint]
            except BaseException as error:  # noqa: BLE001  foreign code: anything may come out, exit too
                traceback.print_exc(limit=_FRAMES_SHOWN)
                what = f"{type(error).__name__} in service {name!r}"
                answer = [False, InternalError.code, what, "the server's log has it"]
            answer.append((time.perf_counter() - began) * 1e3)
            connection.sendall(_bounded(answer, plan.max_bytes))


def _answer(plan: SandboxPlan, runtimes: dict[str, Runtime], what: str, name: str, value: Any) -> list[Any]:
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
    if what == "restore":
        if runtime.has_snapshots:
            runtime.restore(value)
        return [True, runtime.has_snapshots, None]
    reply = runtime.call(value)
    return [True, reply, runtime.snapshot() if runtime.has_snapshots else None]


def _bounded(answer: list[Any], most: int) -> bytes:
    try:
        data = encoded(answer)
        problem = f"a reply of {len(data)} bytes is above {most}" if len(data) > most else ""
    except (TypeError, ValueError, OverflowError, RsePfError) as error:
        problem = f"the reply does not travel: {str(error)[:150]}"
    if problem:
        return encoded([False, LimitExceeded.code, problem, "reply with less", answer[-1]])
    return data
