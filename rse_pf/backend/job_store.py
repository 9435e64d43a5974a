"""The object store as jobs see it, in a worker and in a job's process.

Promises that the two see the same objects wherever the store outlives a process.
"""

from __future__ import annotations

from rse_pf.objects import ObjectStore, open_store
from rse_pf.settings import PlatformSettings

__all__ = ["open_job_store"]


def open_job_store(settings: PlatformSettings) -> ObjectStore:
    """Return the store of ``data.store``; raises UsageError for one that does not exist."""

    def bucket(name: str) -> ObjectStore:
        from rse_pf.aws import open_bucket

        return open_bucket(name, settings.cloud.region)

    return open_store(settings.data.store, {"s3": bucket})
