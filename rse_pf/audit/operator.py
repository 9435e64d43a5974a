"""Record the commands of an operator in the audit log of a local platform.

If a command cannot be recorded, it stays done, and a line on standard error reports the missing entry.
"""

from __future__ import annotations

import getpass
import time
from pathlib import Path

from rse_pf.audit.entry import Value
from rse_pf.audit.log import OPERATOR, audit_folder, record_once
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.terminal import show

__all__ = ["record", "record_map_change"]

_DIRECTORY = "dir:"  # start of ``data.store`` for a store in a folder


def record(state: Path, action: str, subject: str, **detail: Value) -> None:
    """Record that the operator did *action* on *subject*, with the name of the user account.

    The entry goes to the log `OPERATOR` of the platform whose files are in the folder *state*.  If it cannot
    be written, a line on standard error reports that.
    """
    try:
        record_once(
            audit_folder(state),
            OPERATOR,
            action,
            subject,
            wall_clock=time.time,
            user=_user(),
            **detail,
        )
    except ConfigurationError as error:
        show(f"the command succeeded, but is missing in the audit log: {error.message}", error=True)


def record_map_change(
    settings: PlatformSettings, action: str, name: str, *, version: str, number: int
) -> None:
    """Record *action* on the map *name*, if its store is in the folder of a platform with an audit log.

    Args:
        settings: Settings, of which ``data.store`` names the store of the map.
        action: What was done.
        name: Tenant and name of the map, as ``TENANT/MAP``.
        version: Id of the version of the map.
        number: Number of that version.
    """
    place = settings.data.store
    state = Path(place.removeprefix(_DIRECTORY)).absolute().parent
    if place.startswith(_DIRECTORY) and audit_folder(state).is_dir():
        record(state, action, name, version=version, number=number)


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # the user id has no account name
        return "unknown"
