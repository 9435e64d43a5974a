"""The object store as jobs see it, in a worker and in a job's process.

Promises that the two see the same objects wherever the store outlives a process.
"""

from __future__ import annotations

from rse_pf.config import PlatformSettings
from rse_pf.object_store import ObjectStore, open_store

__all__ = ["is_shared", "open_job_store"]

_OURS_ALONE = "memory:"


def is_shared(settings: PlatformSettings) -> bool:
    """Return whether what one process stores is there for another."""
    return settings.data.store != _OURS_ALONE


def open_job_store(settings: PlatformSettings) -> ObjectStore:
    """Return the store of ``data.store``; raises UsageError for one that does not exist."""

    def bucket(name: str) -> ObjectStore:
        from rse_pf.aws.storage import open_bucket

        return open_bucket(name, settings.cloud.region)

    return open_store(settings.data.store, {"s3": bucket})
