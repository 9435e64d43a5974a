"""Versions of maps count for the robot that committed them, although they belong to its tenant.

``charges/TENANT/ROBOT/MAP/VERSION.SIZE`` is an empty object that says so; SIZE is what the version added to
the store, in bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from rse_pf.identity import RobotId
from rse_pf.object_store import ObjectStore, Usage, charge_of

__all__ = ["charge_name", "charged_to", "remove_charges"]


def charge_name(robot: RobotId, map_name: str, version: str, size: int) -> str:
    """Return the name of the object that charges *robot* with *size* bytes for a version of a map."""
    return f"charges/{robot.folder}/{map_name}/{version}.{size}"


def charged_to(store: ObjectStore, robot: RobotId, check: Callable[[], None] = lambda: None) -> Usage:
    """Return what the versions that *robot* committed count for.

    Args:
        store: Where maps and charges lie.
        robot: Who committed them.
        check: Called between two reads; ends the work by the error that it raises.
    """
    objects = charged = 0
    for info in store.list(f"charges/{robot.folder}/"):
        check()
        objects += 1
        charged += charge_of(int(info.name.rpartition(".")[2]))
    return Usage(objects, charged)


def remove_charges(store: ObjectStore, tenant: str, map_name: str, versions: Collection[str]) -> None:
    """Charge no robot any longer with *versions* of a map, by their ids; *tenant* is the folder."""
    for robot in store.folders(f"charges/{tenant}/"):
        prefix = f"charges/{tenant}/{robot}/{map_name}/"
        for info in store.list(prefix):
            if info.name.removeprefix(prefix).partition(".")[0] in versions:
                store.delete(info.name)
