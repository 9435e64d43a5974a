"""Call one installed service as a server would, without a server: the body of `rse-pf service test`.

The same environments, walls and limits; only sockets and robots are missing.  Promises to leave no process.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rse_pf.backend.sandbox.manager import SandboxManager
from rse_pf.backend.scheduling.scheduler import QueuedCommand
from rse_pf.config import PlatformSettings
from rse_pf.object_store import MemoryStore
from rse_pf.services.custom.installed import InstalledService
from rse_pf.wire import Command, Failure, Result

__all__ = ["DryRun", "try_service"]

_ROBOT = "trial"


@dataclass(frozen=True, slots=True, kw_only=True)
class DryRun:
    """What one request came to."""

    answer: Result | Failure
    took_ms: float


def try_service(
    service: InstalledService,
    payloads: Sequence[Any],
    settings: PlatformSettings,
    say: Callable[[str], None],
) -> tuple[tuple[str, ...], list[DryRun]]:
    """Send each payload to *service* in one environment.

    Args:
        service: A folder that was read; it need not be installed.
        payloads: Requests, one after the other.
        settings: Limits.
        say: Told what the service prints, line by line, and how its environment died.

    Returns:
        The walls that this machine lacks, and what came of each payload.

    Raises:
        ConfigurationError: The environment's template did not start.
    """
    return asyncio.run(_try(service, payloads, settings, say))


class _SaidAloud:
    """Events of an environment as lines for a person."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say

    def info(self, event: str, **fields: Any) -> None:
        if event == "service-output":
            self._say(str(fields["text"]))

    def warning(self, event: str, **fields: Any) -> None:
        pass  # the walls that are missing are returned

    def error(self, event: str, **fields: Any) -> None:
        self._say(f"{event}: {fields.get('reason', '')}")


async def _try(
    service: InstalledService,
    payloads: Sequence[Any],
    settings: PlatformSettings,
    say: Callable[[str], None],
) -> tuple[tuple[str, ...], list[DryRun]]:
    loop = asyncio.get_running_loop()
    answers: dict[int, asyncio.Future[Result | Failure]] = {}
    environments = SandboxManager(
        [service],
        settings=settings.replace(services={"accept_weak_isolation": True}),
        most=1,
        server_id="trial",
        store=MemoryStore(),
        monotonic=time.monotonic,
        loop=loop,
        log=_SaidAloud(say),
        answer=lambda job, answer: answers[job.command.id].set_result(answer),
    )
    environments.connected(_ROBOT)
    trials = []
    try:
        for number, payload in enumerate(payloads):
            now = time.monotonic()
            answers[number] = loop.create_future()
            deadline_s = now + settings.session.answer_timeout_s
            command = Command(id=number, service=service.name, payload=payload, keep=True)
            environments.submit(QueuedCommand(None, _ROBOT, command, 0, now, deadline_s))
            answer = await answers[number]
            trials.append(DryRun(answer=answer, took_ms=(time.monotonic() - now) * 1e3))
        return environments.missing, trials
    finally:
        environments.close()
