"""Make the recorder of a robot if one is requested, so that other robots do not import it."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from rse_pf.config import SessionSettings

if TYPE_CHECKING:
    from rse_pf.recording.robot_recorder import RobotRecorder

__all__ = ["make_recorder", "sdk_version"]


def make_recorder(
    folder: str | Path | None, thumbnails: bool, settings: SessionSettings
) -> RobotRecorder | None:
    """Return a recorder of messages and frames that writes to *folder*, None if *folder* is None.

    Args:
        folder: For the recordings; made if it is missing.
        thumbnails: Whether small pictures of frames are recorded.
        settings: Limits of messages.
    """
    if folder is None:
        return None
    from rse_pf.recording.robot_recorder import RobotRecorder

    return RobotRecorder(folder, thumbnails=thumbnails, session=settings, version=sdk_version())


def sdk_version() -> str:
    """Return the version of this SDK, "0" where it runs from its sources without an installation."""
    try:
        return metadata.version("rse-pf")
    except metadata.PackageNotFoundError:
        return "0"
