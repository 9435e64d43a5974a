"""Read the access control store again and again, and tell every worker what is new.

What cannot be read leaves everything as it was known, and is logged once.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

from rse_pf.auth.trust_store import TrustStore
from rse_pf.backend.log import JsonLog
from rse_pf.backend.supervisor.session_registry import WorkerHandle

__all__ = ["TrustPoller", "first_order"]


class TrustPoller:
    """Looks into the control room again and again, and has every worker know what is new."""

    def __init__(
        self,
        trust: TrustStore,
        *,
        workers: Callable[[], Iterable[WorkerHandle]],
        log: JsonLog,
        pause_s: float,
    ) -> None:
        self._trust = trust
        self._workers = workers
        self._log = log
        self._pause_s = pause_s
        self._problem = ""

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            await asyncio.sleep(self._pause_s)
            self.tell(await asyncio.to_thread(self._trust.look))

    def tell(self, is_new: bool) -> None:
        """Say once what went wrong, and hand on what *is_new*."""
        if self._trust.problem != self._problem:
            self._problem = self._trust.problem
            if self._problem:
                self._log.warning("control-room-unread", reason=self._problem)
        if is_new:
            for worker in self._workers():
                worker.order(do="trust", text=self._trust.text)
            self._log.info("trust", bytes=len(self._trust.text))


def first_order(trust: TrustStore | None) -> dict[str, str]:
    """Return what a worker is told before it takes sockets; without a control room its keys stay."""
    return {"do": "trust", "text": "" if trust is None else trust.text}
