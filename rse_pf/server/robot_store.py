"""Store objects for robots in a backend server, within the quotas of robot and tenant.

The quota of a robot is its own one in the roster, or else ``data.quota_bytes``, as in the data service.  No
object is removed to make room for another.
"""

from __future__ import annotations

from rse_pf.config import PlatformSettings
from rse_pf.errors import NotFound
from rse_pf.identity import RobotId, object_name
from rse_pf.storage.object_store import ObjectStore, digest_of
from rse_pf.storage.quotas import Accounts

__all__ = ["is_shared", "store_within_quota"]

_PRIVATE_STORE = "memory:"


def is_shared(settings: PlatformSettings) -> bool:
    """Return whether other processes see what one process stores."""
    return settings.data.store != _PRIVATE_STORE


def store_within_quota(
    store: ObjectStore, accounts: Accounts, robot: RobotId, data: bytes, max_bytes: float | None
) -> str:
    """Store *data* durably as an object of the robot, and return its digest.

    An object that is stored already is not counted again.

    Raises:
        QuotaExceeded: It does not fit into the quota of the robot or of its tenant.
        StoreError: The store fails, or is full.
    """
    digest = digest_of(data)
    name = object_name(robot, digest)
    try:
        store.head(name)
    except NotFound:
        with accounts.reservation(robot, len(data), max_bytes):
            store.put(name, data)
    return digest
