"""Call one installed service as a server would, without a server: used by `rse-pf service test`.

The sandbox, isolation and limits are those of a server; sockets and robots are missing.
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
    """The answer to one request, and how long it took."""

    answer: Result | Failure
    took_ms: float


def dry_run(
    service: InstalledService,
    payloads: Sequence[Any],
    settings: PlatformSettings,
    say: Callable[[str], None],
) -> tuple[tuple[str, ...], list[DryRun]]:
    """Send each payload to *service* in one sandbox.

    Args:
        service: A folder that was read; it need not be installed.
        payloads: Requests, sent one after the other.
        settings: Limits.
        say: Called with each line that the service prints, and with the reason of each crash.

    Returns:
        The means of isolation that this machine lacks, and the answer to each payload.

    Raises:
        ConfigurationError: The zygote did not start.
    """
    return asyncio.run(_dry_run(service, payloads, settings, say))


class _Printer:
    """Log events of a sandbox as lines for a person."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say

    def info(self, event: str, **fields: Any) -> None:
        if event == "service-output":
            self._say(str(fields["text"]))

    def warning(self, event: str, **fields: Any) -> None:
        pass  # missing isolation is returned

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
