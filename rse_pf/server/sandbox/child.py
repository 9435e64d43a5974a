"""The process of one sandbox: isolate itself, then answer requests of its worker until it is killed.

A sandbox is one process with one thread and one socket to its worker.  No code of a service runs before the
isolation is complete.  An exception of a service does not end the process: it is answered as an error.
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

_UNBUFFERED = 2  # mode of setvbuf(3) without a buffer: ``_IONBF`` of the GNU C library and of musl
_MAX_PROBLEM = 150  # longest reason in characters why a reply cannot be encoded; a longer one is cut
_REPLY_HINT = "reply with numbers, text, bytes, lists, maps and arrays of numbers"
_FRAMES_SHOWN = -3  # a printed traceback has the last three frames only, which are those of the service
_LOADER_CACHE = Path("/etc/ld.so.cache")  # the dynamic loader's list of shared libraries
_SYSTEM_PATHS = (
    str(_LOADER_CACHE), "/etc/localtime", "/usr/lib/locale", "/usr/share/zoneinfo",
)  # fmt: skip
"""Files and folders of the system that every sandbox may read: libraries' paths, time zones and locales."""
_LINKS = (Path("/lib"), Path("/lib64"))
"""Symbolic links to folders in /usr on most systems; programs name the loader and libraries by them."""
_SHARED_PREFIXES = ("/usr", "/usr/local")
"""Installation prefixes of Python whose ``lib`` folder also has files of other programs; a sandbox reads only
Python's part of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SandboxPlan:
    """The services, limits and isolation that all sandboxes of one zygote have in common.

    Attributes:
        services: The installed services by name.
        readable: Paths that a sandbox may read, from `readable_paths`.
        memory_bytes: Memory of one sandbox in bytes, including its scratch folder.
        scratch_bytes: Size in bytes of the scratch folder, the only folder that a sandbox can write.
        max_bytes: Largest message in bytes with which a sandbox replies.
        missing: Names of `ISOLATION` that this machine lacks; a sandbox runs without them.
        copies: For each folder of an installed service and of its packages, the folder of the verified copy
            (`VerifiedCopy`) that a sandbox sees at its path.
        refused: For the name of each service that sandboxes do not load, because its files were changed, the
            error.
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
    """Return the files and folders that a sandbox may read.

    They are Python's modules, ``rse_pf``, shared libraries, time zones and locales, and the folders of
    *services* and of their packages.  Programs, configuration files and home folders are not included.
    """
    package = Path(__file__).resolve().parents[2]
    modules = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    if sys.base_prefix not in _SHARED_PREFIXES:
        modules.append(f"{sys.base_prefix}/lib")  # shared libraries that Python's modules need, as in conda
    names = [*_SYSTEM_PATHS, *_library_folders(), *modules, *site.getsitepackages()]
    packages = [service.dependencies for service in services if service.dependencies is not None]
    return [*map(Path, names), package, *(service.folder for service in services), *packages]


def run_sandbox(plan: SandboxPlan, channel: int, output: int, uid: int | None) -> None:
    """Isolate this process, send ``["ready"]``, and answer requests until the worker closes the socket.

    Never returns: the process exits, with code 1 if the isolation failed.

    Args:
        plan: Services, limits and isolation.
        channel: Descriptor of the socket to the worker.
        output: Descriptor to which standard output and error are written.
        uid: User id that the process takes, if it is root; None keeps the user.
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
    except BaseException:  # noqa: BLE001  the process exits here; the worker logs its output
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _library_folders() -> list[str]:
    """Return the folders of shared libraries, from the dynamic loader's cache.

    Without a cache these are ``/lib`` and ``/usr/lib``.  The symbolic links `_LINKS` are included.
    """
    try:
        listed = re.findall(rb"(/[^\0]+)/[^\0/]+\0", _LOADER_CACHE.read_bytes())
    except OSError:
        listed = []
    folders = {os.fsdecode(folder) for folder in listed} or {"/lib", "/usr/lib"}
    links = [str(link) for link in _LINKS if link.is_symlink()]
    return [*links, *sorted({os.path.realpath(folder) for folder in folders})]


def _reset_process(output: int) -> None:
    """Reset signal handlers and the environment; read from ``/dev/null``, and print to the pipe *output*."""
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
    """A writer that flushes after each write; unlike a raw file, it writes all bytes even to a full pipe."""

    def write(self, data: Any, /) -> int:
        count = super().write(data)
        self.flush()
        return count


def _unbuffer_output() -> None:
    """Make Python, C, C++ and Lua write printed text at once, because a killed process flushes nothing."""
    for name, fd in (("stdout", 1), ("stderr", 2)):
        writer = _WrittenAtOnce(io.FileIO(fd, "w", closefd=False))
        stream = io.TextIOWrapper(writer, "utf-8", "backslashreplace", "\n", write_through=True)
        setattr(sys, name, stream)
    libc = ctypes.CDLL(None)
    libc.setvbuf(ctypes.c_void_p.in_dll(libc, "stdout"), None, _UNBUFFERED, ctypes.c_size_t(0))


def _isolate(plan: SandboxPlan, uid: int | None) -> None:
    """Apply every means of `ISOLATION` that this machine has; the zygote has entered the namespaces."""
    owner = os.getuid() if uid is None else uid
    if "root" not in plan.missing:
        isolation.make_root(plan.readable, plan.scratch_bytes, owner, plan.copies)
    alone = uid is not None or "namespaces" not in plan.missing
    isolation.limit_resources(plan.memory_bytes, plan.scratch_bytes, alone=alone)
    if "privileges" not in plan.missing:
        isolation.give_up_privileges(uid)
    die_with_parent()  # after give_up_privileges: a change of the user id clears this setting
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
        except BaseException as error:  # noqa: BLE001  a service may raise anything, SystemExit included
            traceback.print_exc(limit=_FRAMES_SHOWN)
            text = f"{type(error).__name__} in service {name!r}"
            answer = [False, InternalError.code, text, "read the traceback in the server's log"]
        answer.append((time.perf_counter() - began) * 1e3)
        connection.sendall(_encode_within(answer, plan.max_bytes))


def _answer(plan: SandboxPlan, runtimes: dict[str, Runtime], kind: str, name: str, value: Any) -> list[Any]:
    """Execute a request to service *name*, which is loaded first if needed; return the answer.

    *kind* ``call`` passes the request *value* to the service and returns ``[True, reply, snapshot]``: the
    snapshot is the state after the call, None if the service has no snapshots.  *kind* ``restore`` sets the
    state to the snapshot *value* and returns ``[True, has_snapshots, None]``.

    Raises:
        InternalError: The service cannot be loaded; the reason is printed.
        BaseException: The service raised it.
    """
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
                f"service {name!r} cannot be loaded", hint="read the reason in the server's log"
            ) from error
    if kind == "restore":
        if runtime.has_snapshots:
            runtime.restore(value)
        return [True, runtime.has_snapshots, None]
    reply = runtime.call(value)
    return [True, reply, runtime.snapshot() if runtime.has_snapshots else None]


def _encode_within(answer: list[Any], max_bytes: int) -> bytes:
    """Return the encoded *answer*; if it is too large or cannot be encoded, an encoded failure instead.

    The failure is LimitExceeded for an answer of more than *max_bytes*, or with too many values or levels;
    InternalError for an answer that contains a value of a type that has no encoding.
    """
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
