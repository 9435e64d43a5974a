"""Store what a service made for a robot, within what the robot may store at all.

The quota is the data service's: ``data_bytes`` of the robot's token, or ``data.quota_bytes``.  Promises that
nothing is stored beyond it, and to remove nothing to make room.
"""

from __future__ import annotations

from rse_pf.auth.tokens import Claims
from rse_pf.errors import NotFound, QuotaExceeded
from rse_pf.object_store import ObjectStore, digest_of, object_name

__all__ = ["check_room", "quota_bytes", "store_within"]


def quota_bytes(claims: Claims | None, otherwise: float) -> float:
    """Return how much a robot may store: what its token says, or *otherwise*."""
    return (claims.quota("data_bytes") if claims is not None else None) or otherwise


def check_room(store: ObjectStore, tenant: str, robot: str, size: int, max_bytes: float) -> None:
    """Raise QuotaExceeded unless *size* more bytes fit; StoreError if nobody can tell.

    Counts the robot's objects in the store; uploads that have begun are the data service's to count.
    """
    used = sum(info.size for info in store.list(object_name(tenant, robot, "")))
    if used + size > max_bytes:
        raise QuotaExceeded(
            f"{used} + {size} bytes are more than the quota of {max_bytes:.0f}",
            hint="delete objects, or raise data.quota_bytes",
        )


def store_within(store: ObjectStore, tenant: str, robot: str, data: bytes, max_bytes: float) -> str:
    """Store *data* durably as an object of the robot, and return its digest.

    What is there already needs no room.

    Raises:
        QuotaExceeded: It does not fit.
        StoreError: The store fails.
    """
    digest = digest_of(data)
    name = object_name(tenant, robot, digest)
    try:
        store.head(name)
    except NotFound:
        check_room(store, tenant, robot, len(data), max_bytes)
        store.put(name, data)
    return digest
