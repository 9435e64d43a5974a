"""The action debug: run a service outside of the sandbox, in this interpreter, under a debugger.

Nothing isolates the service here: it is the author's own code, on the author's own machine.
"""

from __future__ import annotations

import bdb
import importlib
import os
import pdb
import shlex
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from rse_pf.cli.services.building import built_service
from rse_pf.cli.services.replaying import plain, requests_of
from rse_pf.errors import InternalError, RsePfError, UsageError
from rse_pf.services.custom.installed import InstalledService
from rse_pf.services.custom.runtime import Runtime, open_runtime
from rse_pf.terminal import error_lines, show, show_json
from rse_pf.wire.arrays import binary_encode_hook, extension_hook

__all__ = ["DebugOptions", "debug_service"]

_LOOPBACK = "127.0.0.1"
_CALLS = ("rse_pf_service_call_arrays", "rse_pf_service_call")


@dataclass(frozen=True, slots=True, kw_only=True)
class DebugOptions:
    """How to debug: ``request`` is the file, ``number`` the request in it, from 1."""

    request: Path
    number: int = 1
    debugger: bool = True
    gdb: bool = False
    client_port: int | None = None


def debug_service(source: Path, options: DebugOptions) -> int:
    """Call the service in *source* with one recorded request; return 0 if it replied.

    Of a service with state, the requests before it are sent first, without stopping.

    Raises:
        UsageError: A file or option is refused, or a debugger is not installed.
    """
    service, _ = built_service(source)
    calls = requests_of(options.request, service.name)
    if not 1 <= options.number <= len(calls):
        raise UsageError(
            f"{options.request} holds {len(calls)} requests, there is no number {options.number}",
            hint=f"choose --number 1 to {len(calls)}",
        )
    if options.client_port is not None and service.language != "python":
        raise UsageError(
            f"--wait-for-client is for services in Python, {service.name} is in {service.language}",
            hint="leave it out",
        )
    if options.gdb and service.language != "cpp":
        raise UsageError(
            f"--gdb is for services in C and C++, {service.name} is in {service.language}",
            hint="leave it out",
        )
    if service.language == "cpp" and options.debugger:
        return _debug_library(service, options)
    payloads = [each["request"] for _, each in calls[: options.number]]
    if options.client_port is not None:
        _wait_for_client(options.client_port)
    uses_pdb = service.language == "python" and options.debugger and options.client_port is None
    if service.language == "lua" and options.debugger:
        show("Lua has no debugger here: the script runs without a sandbox, and print shows what it holds")
    return _run(service, payloads, uses_pdb=uses_pdb)


def _run(service: InstalledService, payloads: Sequence[Any], *, uses_pdb: bool) -> int:
    *before, last = payloads
    with _scratch() as scratch:
        try:
            runtime = open_runtime(service, scratch)
            for payload in before if service.kind == "per_robot_state" else ():
                runtime.call(payload)
            reply = _on_the_wire(_call_in_pdb(runtime, last) if uses_pdb else runtime.call(last))
            state = runtime.snapshot() if runtime.has_snapshots else None
        except bdb.BdbQuit:
            show("the debugger was left before the service replied")
            return 1
        except RsePfError as error:
            show(*error_lines(error))
            return 1
        except Exception as error:  # noqa: BLE001  foreign code may raise anything
            show(*_last_frames(error, service))
            defect = InternalError(
                f"{type(error).__name__} in service {service.name!r}", hint="see the lines above"
            )
            show(*error_lines(defect))
            return 1
    show_json(plain(reply))
    if state is not None:
        show(f"snapshot: {len(state)} bytes")
    return 0


class _AuthorsPdb(pdb.Pdb):
    """Tells by BdbQuit that it was left, where `pdb.Pdb` returns None like a service that replies nothing."""

    _was_left = False

    def set_quit(self) -> None:
        self._was_left = True
        super().set_quit()

    def runcall(self, *args: Any, **keywords: Any) -> Any:
        reply = super().runcall(*args, **keywords)
        if self._was_left:
            raise bdb.BdbQuit
        return reply


def _call_in_pdb(runtime: Runtime, payload: Any) -> Any:
    """Stop at the first line of the service, and again where it raises something unexpected."""
    run_by: Callable[[Callable[..., Any]], None] = runtime.run_by  # type: ignore[attr-defined]
    run_by(_AuthorsPdb().runcall)
    try:
        return runtime.call(payload)
    except (RsePfError, bdb.BdbQuit):
        raise
    except Exception as error:
        show(f"{type(error).__name__}: {error}; the debugger stands where it was raised, q leaves it")
        pdb.post_mortem(error.__traceback__)
        raise


def _on_the_wire(reply: Any) -> Any:
    """Return *reply* as a message holds it."""
    data = msgspec.msgpack.encode(reply, enc_hook=binary_encode_hook)
    return msgspec.msgpack.decode(data, ext_hook=extension_hook)


def _wait_for_client(port: int) -> None:
    try:
        debugpy: Any = importlib.import_module("debugpy")
    except ImportError as error:
        raise UsageError(
            "debugpy is not installed", hint=f"{shlex.quote(sys.executable)} -m pip install debugpy"
        ) from error
    debugpy.listen((_LOOPBACK, port))
    show(f"waiting for a debugger at {_LOOPBACK}:{port}; in VS Code: attach, debugpy, this address")
    debugpy.wait_for_client()


def _debug_library(service: InstalledService, options: DebugOptions) -> int:
    """Show the command line of gdb for a library, and run it if that is wanted."""
    stops = [word for name in _CALLS for word in ("-ex", f"break {name}")]
    ours = [
        "-m", "rse_pf.cli.main", "service", "debug", str(service.folder), "--request",
        str(options.request.absolute()), "--number", str(options.number), "--no-debugger",
    ]  # fmt: skip
    command = [
        "gdb",
        "-q",
        "-ex",
        "set breakpoint pending on",
        *stops,
        "-ex",
        "run",
        "--args",
        sys.executable,
        *ours,
    ]
    show(shlex.join(command))
    if not options.gdb:
        return 0
    if shutil.which("gdb") is None:
        raise UsageError("gdb is not installed", hint="apt install gdb")
    return subprocess.run(command, check=False).returncode


def _last_frames(error: BaseException, service: InstalledService) -> list[str]:
    """Return the lines of the traceback from the first one inside the folder of the service on."""
    frames = traceback.extract_tb(error.__traceback__)
    inside = [n for n, frame in enumerate(frames) if frame.filename.startswith(str(service.folder))]
    chosen = frames[inside[0] :] if inside else frames
    text = "".join([*traceback.format_list(chosen), *traceback.format_exception_only(type(error), error)])
    return text.rstrip("\n").split("\n")


@contextmanager
def _scratch() -> Iterator[Path]:
    """Work in an empty folder, as in a sandbox, and return to the present one."""
    here = Path.cwd()
    with tempfile.TemporaryDirectory(prefix="rse-pf-scratch-") as scratch:
        os.chdir(scratch)
        try:
            yield Path(scratch)
        finally:
            os.chdir(here)
