"""Count versions of maps against the quota of the robot that committed them.

A robot has a quota of its own within that of its tenant.  A version that a robot commits counts for both: the
empty object ``charges/TENANT/ROBOT/MAP/VERSION.SIZE`` (a charge) counts it for the robot.  SIZE is the number
of bytes that the version added to the store.  Versions of live maps have no charge, since no robot commits
them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from rse_pf.identity import RobotId
from rse_pf.storage.object_store import ObjectStore, Usage, charge_of

__all__ = ["charge_name", "remove_charges", "sum_charges"]


def charge_name(robot: RobotId, map_name: str, version: str, size: int) -> str:
    """Return the name of the object that counts a version of a map for *robot*.

    Args:
        robot: The robot that committed the version.
        map_name: Name of the map.
        version: Id of the version.
        size: Bytes that the version added to the store.
    """
    return f"charges/{robot.folder}/{map_name}/{version}.{size}"


def sum_charges(store: ObjectStore, robot: RobotId, check: Callable[[], None] = lambda: None) -> Usage:
    """Return the number and the charged bytes of all versions of maps that count for *robot*.

    Args:
        store: The store of the maps.
        robot: The robot.
        check: Called before each object; an error that it raises stops the work.
    """
    objects = charged_bytes = 0
    for info in store.list(f"charges/{robot.folder}/"):
        check()
        objects += 1
        charged_bytes += charge_of(int(info.name.rpartition(".")[2]))
    return Usage(objects, charged_bytes)


def remove_charges(store: ObjectStore, tenant: str, map_name: str, versions: Collection[str]) -> None:
    """Delete the objects that count versions of a map for robots, so that no robot is charged any more.

    Args:
        store: The store of the maps.
        tenant: Folder of the tenant.
        map_name: Name of the map.
        versions: Ids of the versions.
    """
    for robot in store.folders(f"charges/{tenant}/"):
        prefix = f"charges/{tenant}/{robot}/{map_name}/"
        for info in store.list(prefix):
            if info.name.removeprefix(prefix).partition(".")[0] in versions:
                store.delete(info.name)
