"""What a robot needs of the recorder of its messages, frames and maps; without one, nothing is kept."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from client_sdk.network.message_tap import MessageTap, NullMessageTap
from rse_pf.config import SessionSettings

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

__all__ = ["NullRobotRecorder", "RobotRecorder", "make_robot_recorder"]


class RobotRecorder(MessageTap, Protocol):
    """Record one robot between `start` and `stop`; the methods between them return at once."""

    def start(self) -> None:
        """Begin to record.

        Raises:
            MissingExtra: A package for recordings is not installed.
            UsageError: Files cannot be written into the folder.
        """

    async def stop(self) -> None:
        """Write what is queued and finish the file."""

    def record_frame(
        self,
        timestamp_s: float,
        rgb: npt.NDArray[np.uint8] | None = None,
        T_odom_camera: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """Record a frame.

        Args:
            timestamp_s: Time of the frame by the robot's clock.
            rgb: ``(h, w, 3)``, of which a thumbnail is recorded if thumbnails are on; None without an image.
            T_odom_camera: ``(4, 4)``, from the camera frame to the odometry frame, metres; None if unknown.
        """

    def record_map(self, points: npt.NDArray[np.float32]) -> None:
        """Record the points of a map, ``(n, 3)``, metres."""


class NullRobotRecorder(NullMessageTap):
    """Record nothing."""

    def start(self) -> None:
        """Do nothing."""

    async def stop(self) -> None:
        """Do nothing."""

    def record_frame(
        self,
        timestamp_s: float,
        rgb: npt.NDArray[np.uint8] | None = None,
        T_odom_camera: npt.NDArray[np.float64] | None = None,
    ) -> None:
        """Ignore a frame."""

    def record_map(self, points: npt.NDArray[np.float32]) -> None:
        """Ignore the points of a map."""


def make_robot_recorder(
    folder: str | Path | None, *, thumbnails: bool, session: SessionSettings, version: str
) -> RobotRecorder:
    """Return a recorder that writes into *folder*, or one that records nothing if *folder* is None.

    Args:
        folder: For the files; made if it is missing.
        thumbnails: Whether pictures of frames are recorded.
        session: Limits of messages.
        version: Version of the SDK, which is written into the recording.
    """
    if folder is None:
        return NullRobotRecorder()
    # The only import of an extension in the SDK, so that `record=` needs nothing but a folder from its user.
    from rse_pf.extensions.recording.robot_recorder import RobotRecorder as FileRecorder

    return FileRecorder(folder, thumbnails=thumbnails, session=session, version=version)
