"""Replay in a process with limits: a recording may come from a stranger.

    with LimitedReplay(settings) as replay:
        report = replay.command(path, "0123456789abcdef:42")

What reads, decodes, solves and draws runs there; the caller gets typed values.  A file that crashes
that process, or takes all its memory or time, costs one error.
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

_MEMORY_BYTES = 1 << 30
_MAX_REPLY_BYTES = 64 << 20
_RECORDING_S = 6 * 3600.0
"""CPU seconds, and seconds, for a whole recording."""
_TARGET = "rse_pf.extensions.recording.replay.limited:replayer"

T = TypeVar("T")


class _Order(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the process is to do."""

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
    """Answers questions about recordings; nothing is started before the first one."""

    def __init__(self, settings: PlatformSettings | None = None) -> None:
        """Keep the limits of messages; *settings* are those of this machine."""
        self._processes = LimitedProcesses(
            _TARGET,
            ProcessLimits(
                memory_bytes=_MEMORY_BYTES, cpu_s=_RECORDING_S, max_reply_bytes=_MAX_REPLY_BYTES
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
        """Return what `run.overview` returns; raises RsePfError."""
        order = _Order(
            do="overview", path=str(path), solve=solve, overrides=overrides or Overrides(), worst=worst,
        )  # fmt: skip
        return self._ask(order, run.Overview)

    def command(
        self, path: Path, identity: str, overrides: Overrides | None = None, *, with_picture: bool = True
    ) -> CommandReport:
        """Return what `run.report` returns; raises RsePfError."""
        order = _Order(
            do="report", path=str(path), identity=identity, overrides=overrides or Overrides(),
            with_picture=with_picture,
        )  # fmt: skip
        return self._ask(order, CommandReport)

    def find(
        self,
        path: Path,
        *,
        trace: str,
        id: int,
        near_s: float | None = None,
        command_bytes: int | None = None,
    ) -> str | None:
        """Return ``CONNECTION:ID`` of a command as `run.find` does, None if there is none."""
        order = _Order(
            do="find", path=str(path), trace=trace, number=id, near_s=near_s, command_bytes=command_bytes
        )
        return self._ask(order, str) or None

    def close(self) -> None:
        """End the process."""
        self._processes.close()

    def _ask(self, order: _Order, kind: type[T]) -> T:
        path = Path(order.path)
        recording_files(path)  # what is plainly wrong is told before a process is started
        try:
            data = self._processes.call(msgspec.msgpack.encode(order), _RECORDING_S)
            return msgspec.msgpack.decode(data, type=kind)
        except Overran:
            raise BadRequest(f"{path} takes too long to read", hint="replay one --command of it") from None
        except Crashed as crash:
            raise BadRequest(
                f"{path} cannot be read within limits: {crash.message}", hint="do not trust this file"
            ) from None
        except msgspec.DecodeError as error:
            raise InternalError("the process with limits replied with something else") from error


def replayer(configuration: str) -> Handler:
    """Return what answers orders in the process with limits; *configuration* is the settings in JSON."""
    settings = PlatformSettings.from_dict(json.loads(configuration))

    def answer(data: bytes) -> bytes:
        order = msgspec.msgpack.decode(data, type=_Order)
        path = Path(order.path)
        reply: Any
        if order.do == "overview":
            reply = run.overview(
                path, settings, solve=order.solve, overrides=order.overrides, worst=order.worst,
            )  # fmt: skip
        elif order.do == "report":
            reply = run.report(
                path, settings, order.identity, order.overrides, with_picture=order.with_picture
            )
        elif order.do == "find":
            reply = run.find(
                path, settings, trace=order.trace, number=order.number, near_s=order.near_s,
                command_bytes=order.command_bytes,
            )  # fmt: skip
        else:
            raise BadMessage(f"no order {order.do!r}")
        return msgspec.msgpack.encode(reply)

    return answer
