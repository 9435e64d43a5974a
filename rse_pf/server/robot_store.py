"""Store objects for robots in a backend server, within the quotas of robot and tenant.

The quota of a robot is the one in its token or the roster, or else ``data.quota_bytes``, as in the data
service.  An object that does not fit is refused; no other object is removed for it.
"""

from __future__ import annotations

from rse_pf.config import PlatformSettings
from rse_pf.errors import NotFound
from rse_pf.identity import RobotId, object_name
from rse_pf.storage.object_store import ObjectStore, digest_of
from rse_pf.storage.quotas import Accounts

__all__ = ["is_shared", "store_within_quota"]

_PRIVATE_STORE = "memory:"  # value of ``data.store`` with which each process has a store in its own memory


def is_shared(settings: PlatformSettings) -> bool:
    """Return whether all processes use the same store: not if ``data.store`` is in a process's own memory."""
    return settings.data.store != _PRIVATE_STORE


def store_within_quota(
    store: ObjectStore, accounts: Accounts, robot: RobotId, data: bytes, max_bytes: float | None
) -> str:
    """Store *data* durably as an object of the robot, and return its digest (sha256 in hexadecimal digits).

    If the robot has this object already, nothing is written or counted.

    Args:
        store: The object store of the platform.
        accounts: The accounts of robots and tenants, which count *data*.
        robot: The robot.
        data: The bytes of the object.
        max_bytes: The quota of the robot in bytes; None means ``data.quota_bytes``.

    Raises:
        QuotaExceeded: *data* does not fit into the quota of the robot or of its tenant.
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
