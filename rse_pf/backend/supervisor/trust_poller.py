"""Read the access control store periodically, and send every worker what is new.

What cannot be read stays as it was last known, and is logged once.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

from rse_pf.auth.trust_store import TrustStore
from rse_pf.backend.log import JsonLog
from rse_pf.backend.supervisor.orders import TrustOrder
from rse_pf.backend.supervisor.session_registry import WorkerHandle

__all__ = ["TrustPoller"]


class TrustPoller:
    """Reads the access control store periodically; what is new goes to every worker."""

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
        """Read until cancelled."""
        while True:
            await asyncio.sleep(self._pause_s)
            self.tell(await asyncio.to_thread(self._trust.refresh))

    def tell(self, is_new: bool) -> None:
        """Log a problem once, and send the workers what *is_new*."""
        if self._trust.problem != self._problem:
            self._problem = self._trust.problem
            if self._problem:
                self._log.warning("access-control-unread", reason=self._problem)
        if is_new:
            for worker in self._workers():
                worker.order(TrustOrder(self._trust.snapshot))
            self._log.info("trust", bytes=len(self._trust.snapshot))
