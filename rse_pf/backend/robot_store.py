"""The object store as a backend server uses it: written within a robot's quota.

The quota is that of the data service: ``data_bytes`` of the robot's token, or else ``data.quota_bytes``.
Nothing is removed to make an object fit.
"""

from __future__ import annotations

from rse_pf.auth.tokens import Claims
from rse_pf.config import PlatformSettings
from rse_pf.errors import NotFound, QuotaExceeded
from rse_pf.identity import RobotId, object_name
from rse_pf.maps.charges import charged_to
from rse_pf.object_store import MIN_CHARGE_BYTES, ObjectStore, charge_of, digest_of, usage_of

__all__ = ["check_quota", "is_shared", "quota_bytes", "store_within_quota"]

_PRIVATE_STORE = "memory:"


def is_shared(settings: PlatformSettings) -> bool:
    """Return whether other processes see what one process stores."""
    return settings.data.store != _PRIVATE_STORE


def quota_bytes(claims: Claims | None, default: float) -> float:
    """Return how much a robot may store: what its token says, or *default*."""
    return (claims.quota("data_bytes") if claims is not None else None) or default


def check_quota(store: ObjectStore, robot: RobotId, size: int, max_bytes: float) -> None:
    """Raise QuotaExceeded unless an object of *size* bytes fits; StoreError if the store fails.

    Stored objects and committed versions of maps are counted, each with `MIN_CHARGE_BYTES` at least; the data
    service counts uploads that have begun, too, and limits the number of objects.
    """
    used = (usage_of(store, object_name(robot, "")) + charged_to(store, robot)).charged_bytes
    if used + charge_of(size) > max_bytes:
        raise QuotaExceeded(
            f"{used} + {charge_of(size)} bytes are more than the quota of {max_bytes:.0f}; a short object "
            f"counts as {MIN_CHARGE_BYTES}",
            hint="delete objects, or raise data.quota_bytes",
        )


def store_within_quota(store: ObjectStore, robot: RobotId, data: bytes, max_bytes: float) -> str:
    """Store *data* durably as an object of the robot, and return its digest.

    An object that is stored already is not counted again.

    Raises:
        QuotaExceeded: It does not fit.
        StoreError: The store fails.
    """
    digest = digest_of(data)
    name = object_name(robot, digest)
    try:
        store.head(name)
    except NotFound:
        check_quota(store, robot, len(data), max_bytes)
        store.put(name, data)
    return digest
