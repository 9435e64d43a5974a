"""Replay in a process with limits of memory and time, since recordings are untrusted input.

    with LimitedReplay(settings) as replay:
        report = replay.command(path, "0123456789abcdef:42")

Files are read, decoded, solved and drawn in that process, which returns typed values.  A file that crashes
the process, or exceeds its memory or time, causes an error for the caller and nothing else.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadMessage, BadRequest, Crashed, InternalError
from rse_pf.extensions.recording.reader import recording_files
from rse_pf.extensions.recording.replay import run
from rse_pf.extensions.recording.replay.report import CommandReport
from rse_pf.extensions.recording.replay.solving import Overrides
from rse_pf.processes.limited import Handler, LimitedProcesses, Overran, ProcessLimits

__all__ = ["LimitedReplay", "replayer"]

_MAX_MEMORY_BYTES = 1 << 30  # largest memory of the process in which recordings are read
_MAX_REPLY_BYTES = 64 << 20  # largest encoded result of one task that the caller accepts
_MAX_RECORDING_S = 6 * 3600.0
"""Largest CPU time and largest wall time of one task, seconds: enough for a whole recording."""
_TARGET = "rse_pf.extensions.recording.replay.limited:replayer"  # the function that the process runs

T = TypeVar("T")


class _Task(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A call of one function of the module `run` in a process with limits of memory, time and reply.

    ``do`` names the function: ``overview``, ``report`` or ``find``.  The other fields are arguments, of which
    each function uses those that it has.
    """

    do: str
    path: str
    identity: str = ""
    overrides: Overrides = Overrides()
    solve: bool = False
    worst: int = 0
    with_picture: bool = True
    trace: str = ""
    number: int = 0
    near_s: float | None = None
    command_bytes: int | None = None


class LimitedReplay:
    """Call the functions of the module `run` in a process with limits, which the first call starts."""

    def __init__(self, settings: PlatformSettings | None = None) -> None:
        """Prepare the process; *settings* hold the limits of messages, None for the defaults."""
        self._processes = LimitedProcesses(
            _TARGET,
            ProcessLimits(
                memory_bytes=_MAX_MEMORY_BYTES, cpu_s=_MAX_RECORDING_S, max_reply_bytes=_MAX_REPLY_BYTES
            ),
            configuration=json.dumps((settings or PlatformSettings()).to_dict()), niceness=0,
        )  # fmt: skip

    def __enter__(self) -> LimitedReplay:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def overview(
        self,
        path: Path,
        *,
        solve: bool,
        overrides: Overrides | None = None,
        worst: int = 20,
    ) -> run.Overview:
        """Summarise a recording, see `run.overview`.

        Raises RsePfError; BadRequest also if the file exceeds the limits of the process.
        """
        task = _Task(
            do="overview", path=str(path), solve=solve, overrides=overrides or Overrides(), worst=worst,
        )  # fmt: skip
        return self._ask(task, run.Overview)

    def command(
        self, path: Path, identity: str, overrides: Overrides | None = None, *, with_picture: bool = True
    ) -> CommandReport:
        """Report one command, see `run.report`.

        Raises RsePfError; BadRequest also if the file exceeds the limits of the process.
        """
        task = _Task(
            do="report", path=str(path), identity=identity, overrides=overrides or Overrides(),
            with_picture=with_picture,
        )  # fmt: skip
        return self._ask(task, CommandReport)

    def find(
        self,
        path: Path,
        *,
        trace: str,
        id: int,
        near_s: float | None = None,
        command_bytes: int | None = None,
    ) -> str | None:
        """Return ``CONNECTION:ID`` of the command that `run.find` finds, None if there is none.

        Raises RsePfError; BadRequest also if the file exceeds the limits of the process.
        """
        task = _Task(
            do="find", path=str(path), trace=trace, number=id, near_s=near_s, command_bytes=command_bytes
        )
        return self._ask(task, str) or None

    def close(self) -> None:
        """Stop the process with limits."""
        self._processes.close()

    def _ask(self, task: _Task, kind: type[T]) -> T:
        path = Path(task.path)
        recording_files(path)  # a missing file is reported before a process is started
        try:
            data = self._processes.call(msgspec.msgpack.encode(task), _MAX_RECORDING_S)
            return msgspec.msgpack.decode(data, type=kind)
        except Overran:
            raise BadRequest(f"{path} takes too long to read", hint="replay one --command of it") from None
        except Crashed as crash:
            raise BadRequest(
                f"{path} cannot be read within limits: {crash.message}", hint="do not trust this file"
            ) from None
        except msgspec.DecodeError as error:
            raise InternalError("the process with limits returned a result of another type") from error


def replayer(configuration: str) -> Handler:
    """Return the function that runs tasks in the limited process; *configuration* is settings in JSON."""
    settings = PlatformSettings.from_dict(json.loads(configuration))

    def answer(data: bytes) -> bytes:
        task = msgspec.msgpack.decode(data, type=_Task)
        path = Path(task.path)
        reply: Any
        if task.do == "overview":
            reply = run.overview(
                path, settings, solve=task.solve, overrides=task.overrides, worst=task.worst,
            )  # fmt: skip
        elif task.do == "report":
            reply = run.report(path, settings, task.identity, task.overrides, with_picture=task.with_picture)
        elif task.do == "find":
            reply = run.find(
                path, settings, trace=task.trace, number=task.number, near_s=task.near_s,
                command_bytes=task.command_bytes,
            )  # fmt: skip
        else:
            raise BadMessage(f"no task {task.do!r}")
        return msgspec.msgpack.encode(reply)

    return answer
