"""Let a recorder see the messages, frames and maps of a robot: the one for files, or one of the program."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

from client_sdk.concurrency.user_callbacks import UserCallbacks
from client_sdk.network.message_tap import MessageTap
from rse_pf.config import SessionSettings
from rse_pf.errors import UsageError
from rse_pf.wire import Codec

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

__all__ = ["RobotRecorder", "make_robot_recorder"]

STOP_TIMEOUT_S = 5.0
"""Longest time, seconds, for which the end of a robot waits for `RobotRecorder.stop` of the program."""


@runtime_checkable
class RobotRecorder(MessageTap, Protocol):
    """Record one robot between `start` and `stop`; the methods between them return at once.

    A program extends this class, overrides the methods that it needs, and gives an object of it to
    ``connect(record=...)``.  An exception is logged, and counted in `Stats.callback_errors`.
    """

    def start(self) -> None:
        """Begin to record.

        Raises:
            MissingExtra: A package for recordings is not installed.
            UsageError: Files cannot be written into the folder.
        """
        return

    async def stop(self) -> None:
        """Write what is queued and finish the file."""
        return

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
        return

    def record_map(self, points: npt.NDArray[np.float32]) -> None:
        """Record the points of a map, ``(n, 3)``, metres."""
        return


class _GuardedRecorder(RobotRecorder):
    """Call a recorder of the program, so that the robot goes on whatever the recorder does."""

    def __init__(self, recorder: RobotRecorder, callbacks: UserCallbacks) -> None:
        self._recorder = recorder
        self._callbacks = callbacks

    def start(self) -> None:
        self._callbacks.call("record.start", self._recorder.start)

    async def stop(self) -> None:
        try:
            await asyncio.wait_for(self._recorder.stop(), STOP_TIMEOUT_S)
        except Exception as error:  # noqa: BLE001  a function of the program may raise anything
            self._callbacks.report("record.stop", error)

    def open_connection(self, codec: Codec, token: str | None) -> int:
        name, method = "record.open_connection", self._recorder.open_connection
        number: int = self._callbacks.call(name, method, codec, token, default=0)
        return number

    def observe_message(self, connection: int, direction: Literal["up", "down"], data: bytes) -> None:
        method = self._recorder.observe_message
        self._callbacks.call("record.observe_message", method, connection, direction, data)

    def close_connection(self, connection: int) -> None:
        self._callbacks.call("record.close_connection", self._recorder.close_connection, connection)

    def record_frame(
        self,
        timestamp_s: float,
        rgb: npt.NDArray[np.uint8] | None = None,
        T_odom_camera: npt.NDArray[np.float64] | None = None,
    ) -> None:
        method = self._recorder.record_frame
        self._callbacks.call("record.record_frame", method, timestamp_s, rgb, T_odom_camera)

    def record_map(self, points: npt.NDArray[np.float32]) -> None:
        self._callbacks.call("record.record_map", self._recorder.record_map, points)


def make_robot_recorder(
    record: str | Path | RobotRecorder | None,
    *,
    thumbnails: bool,
    session: SessionSettings,
    version: str,
    callbacks: UserCallbacks,
) -> RobotRecorder | None:
    """Return the recorder of a robot, None if it records nothing.

    Args:
        record: Folder for the files, made if it is missing; or a recorder of the program.
        thumbnails: Whether pictures of frames are recorded in the folder.
        session: Limits of messages.
        version: Version of the SDK, which is written into the recording.
        callbacks: Calls a recorder of the program, and survives its exceptions.

    Raises:
        UsageError: *record* is something else.
    """
    if record is None:
        return None
    if not isinstance(record, str | Path):
        if not isinstance(record, RobotRecorder):
            raise UsageError(
                f"record= is a {type(record).__name__}, neither a folder nor a recorder",
                hint="give a folder, or an object of a class that extends client_sdk.RobotRecorder",
            )
        return _GuardedRecorder(record, callbacks)
    # The only import of an extension in the SDK, so that `record=` needs nothing but a folder from its user.
    try:
        from rse_pf.extensions.recording.robot_recorder import RobotRecorder as FileRecorder
    except ModuleNotFoundError as error:
        raise UsageError(
            f"recordings were removed from this installation: {error}",
            hint="leave out record=, or give a recorder of your own",
        ) from error

    return FileRecorder(record, thumbnails=thumbnails, session=session, version=version)
