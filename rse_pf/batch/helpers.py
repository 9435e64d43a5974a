"""Let idle job servers work for a batch: one worker process for each slot, as long as the batch invites."""

from __future__ import annotations

import importlib.util
import time
from collections import Counter
from collections.abc import Callable

from rse_pf.batch.cluster import start_worker
from rse_pf.batch.invitation import EXPIRES_S, Invited, invitations
from rse_pf.child.start import Child
from rse_pf.object_store import ObjectStore

__all__ = ["BatchHelpers"]

_MOST_ENDS = 2
"""A batch is left alone after all workers here have ended this often."""


class BatchHelpers:
    """The workers of one machine for the batches of others."""

    def __init__(
        self, store: ObjectStore, count: int, *, ports: str = "", clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start nothing yet; *count* workers help one batch at a time, on *ports* such as ``8791:8889``."""
        self._clock = clock
        self._seen: dict[str, tuple[Invited, float]] = {}
        self._ended: Counter[str] = Counter()
        self._ports = ports
        self._store = store
        self._count = count
        self._workers: list[Child] = []
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
        found = self._current() if self._is_able and may_help else {}
        if self._batch not in found:
            self.close()
        if not found:
            return
        had, self._workers = self._workers, [each for each in self._workers if each.exit_code() is None]
        if had and not self._workers:
            self._ended[self._batch] += 1
            if self._ended[self._batch] >= _MOST_ENDS:
                self.close()
                return  # the next step joins another, if there is one
        self._batch = self._batch or min(found)
        invited = found[self._batch]
        while len(self._workers) < self._count:
            self._workers.append(
                start_worker(invited.certificate, invited.key, invited.address, ports=self._ports)
            )

    def _current(self) -> dict[str, Invited]:
        """Return the invitations that are renewed, without those of batches on which no worker lives."""
        found, now = invitations(self._store), self._clock()
        before, self._seen = self._seen, {}
        for name, invited in found.items():
            last, since = before.get(name, (invited, now))
            self._seen[name] = (invited, since if last == invited else now)
            if invited.beat < last.beat:  # its scheduler was started again
                self._ended.pop(name, None)
        for name in self._ended.keys() - found.keys():
            del self._ended[name]
        return {
            name: invited
            for name, (invited, since) in self._seen.items()
            if now - since < EXPIRES_S and self._ended[name] < _MOST_ENDS
        }

    def close(self) -> None:
        """End the workers; their parts go to others."""
        for each in self._workers:
            each.kill()
        self._workers, self._batch = [], ""
