"""Let idle job servers work for a batch: one worker process for each slot, as long as the batch invites."""

from __future__ import annotations

import importlib.util
import os
import subprocess

from rse_pf.batch.cluster import start_worker, stop_process
from rse_pf.batch.invitation import invitations
from rse_pf.object_store import ObjectStore

__all__ = ["BatchHelpers"]


class BatchHelpers:
    """The workers of one machine for the batches of others."""

    def __init__(self, store: ObjectStore, count: int, *, ports: str = "") -> None:
        """Start nothing yet; *count* workers help one batch at a time, on *ports* such as ``8791:8889``."""
        self._ports = ports
        self._store = store
        self._count = count
        self._workers: list[subprocess.Popen[bytes]] = []
        self._batch = ""
        self._is_able = importlib.util.find_spec("distributed") is not None

    @property
    def pids(self) -> list[int]:
        """Return the pids of the workers."""
        return [each.pid for each in self._workers]

    def step(self, *, may_help: bool) -> None:
        """Join a batch that invites, leave one that does not any more, or leave because jobs wait.

        Raises:
            StoreError: The store failed.
        """
        found = invitations(self._store) if self._is_able and may_help else {}
        if self._batch not in found:
            self.close()
        if not found:
            return
        self._workers = [each for each in self._workers if each.poll() is None]
        self._batch = self._batch or min(found)
        invited = found[self._batch]
        while len(self._workers) < self._count:
            self._workers.append(
                start_worker(
                    invited.certificate, invited.key, invited.address, ports=self._ports, parent=os.getpid()
                )
            )

    def close(self) -> None:
        """End the workers; their parts go to others."""
        for each in self._workers:
            stop_process(each)
        self._workers, self._batch = [], ""
