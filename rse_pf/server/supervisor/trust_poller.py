"""Read keys, roster and deny list periodically, and send changes to every worker.

After a failed read, workers continue with what was read last, and the problem is logged once.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

from rse_pf.auth.trust_store import REFRESH_S, TrustStore
from rse_pf.server.supervisor.orders import TrustOrder
from rse_pf.server.supervisor.worker_handle import WorkerProcess
from rse_pf.server.worker_context import Log

__all__ = ["poll_trust", "update_workers"]


async def poll_trust(trust: TrustStore, workers: Sequence[WorkerProcess], log: Log) -> None:
    """Call `update_workers` every `REFRESH_S` seconds until this task is cancelled."""
    while True:
        await asyncio.sleep(REFRESH_S)
        await update_workers(trust, workers, log)


async def update_workers(trust: TrustStore, workers: Sequence[WorkerProcess], log: Log) -> None:
    """Read *trust* again in a thread; log a new problem, or send what has changed to all *workers*."""
    known = trust.problem
    is_new = await asyncio.to_thread(trust.refresh)
    if trust.problem not in ("", known):
        log.warning("access-control-unread", reason=trust.problem)
    if is_new:
        for worker in workers:
            worker.order(TrustOrder(trust.snapshot))
        log.info("access-control-read", bytes=len(trust.snapshot))
