"""Computes parts without a cluster, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rse_pf.extensions.batch.part_kinds import compute_part
from rse_pf.extensions.batch.parts import Part
from rse_pf.storage.object_store import ObjectStore

__all__ = ["InProcessEngine"]


class InProcessEngine:
    """Takes the place of `rse_pf.extensions.batch.dask_engine.DaskEngine`."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store

    def run(self, parts: Sequence[Part], on_done: Callable[[int], None]) -> None:
        """Compute *parts*."""
        for number, part in enumerate(parts, start=1):
            compute_part(self._store, part)
            on_done(number)
