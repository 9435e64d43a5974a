"""Record an operator's commands in the audit log of a platform.

A command that cannot be recorded is not undone; one line on standard error reports it.
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

_DIRECTORY = "dir:"


def record(state: Path, action: str, subject: str, **detail: Value) -> None:
    """Record *action* on *subject* in the platform whose files lie in *state*."""
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
    """Record a change of a map, if its store lies in the folder of a platform with an audit log."""
    place = settings.data.store
    state = Path(place.removeprefix(_DIRECTORY)).absolute().parent
    if place.startswith(_DIRECTORY) and audit_folder(state).is_dir():
        record(state, action, name, version=version, number=number)


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a user id without a name
        return "unknown"
