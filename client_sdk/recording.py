"""What a robot needs to record itself: the recorder, made only if one is asked for."""

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
    """Return a recorder that writes to *folder*, None if there is no folder."""
    if folder is None:
        return None
    from rse_pf.recording.robot_recorder import RobotRecorder

    return RobotRecorder(folder, thumbnails=thumbnails, session=settings, version=sdk_version())


def sdk_version() -> str:
    """Return the version of this SDK, "0" where it is not installed."""
    try:
        return metadata.version("rse-pf")
    except metadata.PackageNotFoundError:
        return "0"
