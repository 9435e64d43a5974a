"""The process of one sandbox: isolate itself, then answer the requests of the worker until it is ended.

One process, one thread, one socket to its worker.  No code of a service runs before the isolation is
complete, and whatever a service raises becomes a typed failure.
"""

from __future__ import annotations

import ctypes
import io
import os
import re
import signal
import site
import socket
import sys
import sysconfig
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rse_pf.errors import ConfigurationError, InternalError, LimitExceeded, RsePfError, message_of
from rse_pf.processes.ipc import encode_message, encode_reply, receive
from rse_pf.processes.linux import close_other_descriptors, die_with_parent
from rse_pf.server.sandbox import isolation
from rse_pf.services.custom.installed import InstalledService
from rse_pf.services.custom.runtime import Runtime, open_runtime

__all__ = ["SandboxPlan", "readable_paths", "run_sandbox"]

_UNBUFFERED = 2  # ``_IONBF`` of the GNU C library and of musl
_MAX_PROBLEM = 150  # characters of the reason why a reply cannot be encoded
_REPLY_HINT = "reply with numbers, text, bytes, lists, maps and arrays of numbers"
_FRAMES_SHOWN = -3  # the last frames of a traceback, which are those of the service
_LOADER_CACHE = Path("/etc/ld.so.cache")
_SYSTEM_PATHS = (
    str(_LOADER_CACHE), "/etc/localtime", "/usr/lib/locale", "/usr/share/zoneinfo",
)  # fmt: skip
_LINKS = (Path("/lib"), Path("/lib64"))
"""Links of a system with a merged /usr, by which the loader and libraries name files."""
_SHARED_PREFIXES = ("/usr", "/usr/local")
"""Prefixes of a Python that shares its ``lib`` folder with the system."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SandboxPlan:
    """The values that all sandboxes of a server share.

    Attributes:
        services: The installed services by name.
        readable: The paths of `readable_paths`.
        memory_bytes: Memory of one sandbox.
        scratch_bytes: Size of its scratch folder.
        max_bytes: Largest reply.
        missing: The means of isolation that this kernel lacks.
        copies: The `VerifiedCopy` that a sandbox sees in place of each folder.
        refused: The error of each service that is not loaded, by name.
    """

    services: Mapping[str, InstalledService]
    readable: Sequence[Path]
    memory_bytes: int
    scratch_bytes: int
    max_bytes: int
    missing: Sequence[str]
    copies: Mapping[Path, Path] = field(default_factory=dict)
    refused: Mapping[str, ConfigurationError] = field(default_factory=dict)


def readable_paths(services: Sequence[InstalledService]) -> list[Path]:
    """Return the paths that a sandbox may read: Python, this package, system libraries, the services.

    Programs, documentation, settings and homes are not among it.
    """
    package = Path(__file__).resolve().parents[2]
    modules = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    if sys.base_prefix not in _SHARED_PREFIXES:
        modules.append(f"{sys.base_prefix}/lib")  # libraries that its modules link to, as in conda
    names = [*_SYSTEM_PATHS, *_library_folders(), *modules, *site.getsitepackages()]
    packages = [service.dependencies for service in services if service.dependencies is not None]
    return [*map(Path, names), package, *(service.folder for service in services), *packages]


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
        close_other_descriptors(channel)
        with socket.socket(fileno=channel) as connection:
            _isolate(plan, uid)
            connection.sendall(encode_message(["ready"]))
            _serve(plan, connection)
        code = 0
    except BaseException:  # noqa: BLE001  the process ends here, and its output is the log
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _library_folders() -> list[str]:
    """Return the folders in which the loader's cache lists libraries, without a cache all of /lib."""
    try:
        listed = re.findall(rb"(/[^\0]+)/[^\0/]+\0", _LOADER_CACHE.read_bytes())
    except OSError:
        listed = []
    folders = {os.fsdecode(folder) for folder in listed} or {"/lib", "/usr/lib"}
    links = [str(link) for link in _LINKS if link.is_symlink()]
    return [*links, *sorted({os.path.realpath(folder) for folder in folders})]


def _reset_process(output: int) -> None:
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGCHLD, signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    null = os.open("/dev/null", os.O_RDWR)
    for fd, source in ((0, null), (1, output), (2, output)):
        os.dup2(source, fd)
    _unbuffer_output()
    os.environ.clear()
    os.environ.update(HOME="/scratch", TMPDIR="/scratch", PATH="/usr/bin", LANG="C.UTF-8")


class _WrittenAtOnce(io.BufferedWriter):
    """Keeps nothing back; unlike a raw file it writes all of what a full pipe takes in parts."""

    def write(self, data: Any, /) -> int:
        count = super().write(data)
        self.flush()
        return count


def _unbuffer_output() -> None:
    """Write what Python, C, C++ and Lua print at once: a process that is killed flushes nothing."""
    for name, fd in (("stdout", 1), ("stderr", 2)):
        writer = _WrittenAtOnce(io.FileIO(fd, "w", closefd=False))
        stream = io.TextIOWrapper(writer, "utf-8", "backslashreplace", "\n", write_through=True)
        setattr(sys, name, stream)
    libc = ctypes.CDLL(None)
    libc.setvbuf(ctypes.c_void_p.in_dll(libc, "stdout"), None, _UNBUFFERED, ctypes.c_size_t(0))


def _isolate(plan: SandboxPlan, uid: int | None) -> None:
    owner = os.getuid() if uid is None else uid
    if "root" not in plan.missing:
        isolation.make_root(plan.readable, plan.scratch_bytes, owner, plan.copies)
    alone = uid is not None or "namespaces" not in plan.missing
    isolation.limit_resources(plan.memory_bytes, plan.scratch_bytes, alone=alone)
    if "privileges" not in plan.missing:
        isolation.give_up_privileges(uid)
    die_with_parent()  # after the change of the user, which would undo it
    if "seccomp" not in plan.missing:
        languages = {service.language for service in plan.services.values()}
        isolation.forbid_system_calls(
            {"python" if language == "package" else language for language in languages}
        )


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
            if name in plan.refused:
                raise plan.refused[name]
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
    """Return the message of *answer*, or of a failure: it is too large, or holds what no message can."""
    try:
        data = encode_reply(answer)
    except LimitExceeded as error:
        problem = f"the reply cannot be encoded: {message_of(error)[:_MAX_PROBLEM]}"
        return encode_message([False, error.code, problem, "reply with less", answer[-1]])
    except (TypeError, ValueError, OverflowError, RecursionError, RsePfError) as error:
        problem = f"the reply cannot be encoded: {message_of(error)[:_MAX_PROBLEM]}"
        return encode_message([False, InternalError.code, problem, _REPLY_HINT, answer[-1]])
    if len(data) > max_bytes:
        problem = f"a reply of {len(data)} bytes is above {max_bytes}"
        return encode_message([False, LimitExceeded.code, problem, "reply with less", answer[-1]])
    return data
