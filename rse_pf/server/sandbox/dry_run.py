"""Call one service in a sandbox without a server, for ``rse-pf service test``.

The sandbox and its limits are those of a server.  There is no network connection and no robot.  The service
also runs if this machine lacks a means of isolation, and its snapshots are kept in memory.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.identity import DEFAULT_TENANT, RobotId
from rse_pf.server.sandbox.manager import SandboxHost, SandboxManager
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.services.custom.installed import InstalledService
from rse_pf.storage.object_store import MemoryStore
from rse_pf.wire import Command, Failure, Result

__all__ = ["DryRun", "dry_run"]

_SERVER = "dry-run"
_ROBOT = RobotId(DEFAULT_TENANT, _SERVER)


@dataclass(frozen=True, slots=True, kw_only=True)
class DryRun:
    """The answer to one request, and the milliseconds from the submission of the request to the answer."""

    answer: Result | Failure
    took_ms: float


def dry_run(
    service: InstalledService,
    payloads: Sequence[Any],
    settings: PlatformSettings,
    say: Callable[[str], None],
) -> tuple[tuple[str, ...], list[DryRun]]:
    """Send *payloads* as commands to *service* in a sandbox, each after the answer to the one before.

    Args:
        service: The service; its folder need not be in the services folder of a server.
        payloads: Payloads of the commands.
        settings: Limits of sandboxes; the deadline of a command is ``session.answer_timeout_s``.
        say: Called with each line that the service prints, and with each error event of the sandbox and its
            reason.

    Returns:
        Names of `ISOLATION` that this machine lacks, and one `DryRun` for each payload, in order.

    Raises:
        ConfigurationError: The zygote, the parent process of the sandbox, did not start.
    """
    return asyncio.run(_dry_run(service, payloads, settings, say))


class _Printer:
    """A log that passes printed output and error events of a sandbox to *say*, and drops everything else."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say

    def info(self, event: str, **fields: Any) -> None:
        if event == "service-output":
            self._say(str(fields["text"]))

    def warning(self, event: str, **fields: Any) -> None:
        pass  # `dry_run` returns the missing isolation; an overrun is in the answer

    def error(self, event: str, **fields: Any) -> None:
        self._say(f"{event}: {fields.get('reason', '')}")


async def _dry_run(
    service: InstalledService,
    payloads: Sequence[Any],
    settings: PlatformSettings,
    say: Callable[[str], None],
) -> tuple[tuple[str, ...], list[DryRun]]:
    loop = asyncio.get_running_loop()
    answers: dict[int, asyncio.Future[Result | Failure]] = {}
    host = SandboxHost(
        server_id=_SERVER,
        loop=loop,
        monotonic=time.monotonic,
        log=_Printer(say),
        answer=lambda queued, answer: answers[queued.command.id].set_result(answer),
    )
    sandboxes = SandboxManager(
        [service],
        settings=settings.replace(services={"accept_weak_isolation": True}),
        max_sandboxes=1,
        store=MemoryStore(),
        host=host,
    ).start()
    sandboxes.add_connection(_ROBOT)
    runs = []
    try:
        for number, payload in enumerate(payloads):
            now = time.monotonic()
            answers[number] = loop.create_future()
            deadline_s = now + settings.session.answer_timeout_s
            command = Command(id=number, service=service.name, payload=payload, keep=True)
            sandboxes.submit(QueuedCommand(None, _ROBOT, command, 0, now, deadline_s))
            answer = await answers[number]
            runs.append(DryRun(answer=answer, took_ms=(time.monotonic() - now) * 1e3))
        return sandboxes.missing, runs
    finally:
        sandboxes.close()
