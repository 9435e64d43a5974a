"""The action record: have the servers of a live platform record requests to one service, and write a file.

Servers record only for an operator who shows the token of their control port, and only as long as this
command runs: it ends the recording, and a server ends it by itself at its limits.
"""

from __future__ import annotations

import asyncio
import base64
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from rse_pf.cli.services.blocks import Server
from rse_pf.errors import CommandFailed, RsePfError, UsageError
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.services.custom.recording import RecordedCall, recorded_calls
from rse_pf.services.custom.request_files import write_requests
from rse_pf.terminal import counted, show, show_progress

__all__ = ["MAX_CALLS", "MAX_MIB", "MAX_SECONDS", "RecordLimits", "record_service"]

MAX_CALLS, MAX_SECONDS, MAX_MIB = 10_000, 3600.0, 64
_TIMEOUT_S = 10.0
_POLL_S = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordLimits:
    """When a recording ends: at the first of these; ``max_mib`` counts for each worker process."""

    calls: int = 100
    seconds: float = 60.0
    max_mib: int = 16

    def __post_init__(self) -> None:
        """Raise UsageError for a limit out of its range."""
        for option, value, least, most in (
            ("--count", self.calls, 1, MAX_CALLS),
            ("--seconds", self.seconds, 0.1, MAX_SECONDS),
            ("--max-mib", self.max_mib, 1, MAX_MIB),
        ):
            if not least <= value <= most:
                raise UsageError(
                    f"{option} {value:g} is not within {least:g}..{most:g}",
                    hint=f"choose {least:g} to {most:g}",
                )


def record_service(name: str, servers: Sequence[Server], limits: RecordLimits, out: Path) -> int:
    """Record requests to the service *name* on *servers*, and write them to *out*; return how many there are.

    Ctrl-C ends the recording early, and what was recorded is kept.

    Raises:
        UsageError: The file cannot be written, a token is missing, or no server offers the service.
        CommandFailed: No server answers.
    """
    if not out.absolute().parent.is_dir():
        raise UsageError(
            f"there is no folder {out.absolute().parent}", hint="name a file in an existing folder"
        )
    calls = asyncio.run(_record(name, servers, limits))
    write_requests(out, name, calls)
    secrets = sum(call.secrets for call in calls)
    show(f"{counted(len(calls), 'request')} to {name} in {out}")
    if secrets:
        show(f"{counted(secrets, 'value')} that looked like secrets were left out")
    if not calls:
        show("no robot called the service meanwhile; record longer with --seconds")
    return len(calls)


async def _record(name: str, servers: Sequence[Server], limits: RecordLimits) -> list[RecordedCall]:
    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        with suppress(ValueError, RuntimeError):  # not in the main thread
            loop.add_signal_handler(number, stopped.set)
    ports = {server: ControlPort(port, token) for server, port, token in servers}
    streams: defaultdict[tuple[str, int], bytearray] = defaultdict(bytearray)
    began: dict[str, int] = {}
    try:
        for server, port in ports.items():
            began[server] = await _begin(server, port, name, limits)
        until = time.monotonic() + limits.seconds
        calls: list[RecordedCall] = []
        is_over = False
        while not is_over:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(stopped.wait(), _POLL_S)
            is_over = stopped.is_set() or time.monotonic() >= until
            over = [await _take(ports[server], server, began, streams) for server in list(began)]
            calls = [call for stream in streams.values() for call in recorded_calls(bytes(stream))]
            show_progress(f"{len(calls)} of {limits.calls} requests to {name}", is_over=False)
            is_over = is_over or all(over) or len(calls) >= limits.calls
        return calls[: limits.calls]
    finally:
        show_progress("", is_over=False)
        for server in began:
            with suppress(RsePfError):
                await _ask(server, ports[server], "/record", recording=began[server], count=0)
        for port in ports.values():
            port.close()


async def _begin(server: str, port: ControlPort, name: str, limits: RecordLimits) -> int:
    """Begin a recording on one server and return its number."""
    reply = await _ask(
        server, port, "/record", service=name, count=limits.calls, seconds=limits.seconds, mib=limits.max_mib
    )
    if not any(row.get("offers") for row in reply["workers"]):
        raise UsageError(
            f"{server} runs no installed service named {name!r}",
            hint="rse-pf service list shows the installed ones",
        )
    return int(reply["recording"])


async def _take(
    port: ControlPort,
    server: str,
    began: dict[str, int],
    streams: defaultdict[tuple[str, int], bytearray],
) -> bool:
    """Read all that one server has recorded; return whether it will record no more.

    One that answers no more, such as a server that is replaced, is left out of *began* from then on.
    """
    while True:
        try:
            reply = await _ask(server, port, "/record/take", recording=began[server])
        except CommandFailed as error:
            show(f"{error.message}; what it had recorded until then is kept", error=True)
            del began[server]
            return True
        for row in reply["workers"]:
            streams[server, int(row["worker"])] += base64.b64decode(row["data"])
        if not any(row["waiting"] for row in reply["workers"]):
            return all(row["is_over"] for row in reply["workers"])


async def _ask(server: str, port: ControlPort, path: str, **query: Any) -> dict[str, Any]:
    try:
        reply = await port.ask(f"{path}?{urlencode(query)}", timeout_s=_TIMEOUT_S, method="POST")
        document = reply.document()
    except ConnectionError as error:
        raise CommandFailed(
            f"no answer from {server}", hint="see rse-pf local status and the logs of the servers"
        ) from error
    refusal = _REFUSALS.get(reply.status)
    if refusal is not None:
        raise refusal(server, document)
    if reply.status != 200 or not isinstance(document.get("workers"), list):
        raise CommandFailed(
            f"{server} answers {reply.status}", hint=str(document.get("hint", "see the server's log"))
        )
    return document


_REFUSALS: dict[int, Callable[[str, dict[str, Any]], RsePfError]] = {
    401: lambda server, told: UsageError(
        f"{server} requires another token", hint="name the file of it with --control-token"
    ),
    403: lambda server, told: UsageError(f"{server} does not record", hint=str(told.get("hint", ""))),
    404: lambda server, told: CommandFailed(
        f"{server} is of an earlier version", hint="roll the servers to this version"
    ),
}
