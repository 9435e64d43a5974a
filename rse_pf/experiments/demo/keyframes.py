"""What a robot of the demo keeps for others: its keyframes, and at the end its map.

A keyframe is handed over as it is made (it goes to the data service in the background, behind live poses) and
kept for the map that the robot commits.  Promises to hold features and poses only, never an image.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import FrontEndOptions, TrackedFrame, extract
from client_sdk.transfer.background_upload import BackgroundUploader
from client_sdk.transfer.data_client import DataClient
from rse_pf.config import DataSettings
from rse_pf.experiments.demo.merge_client import commit
from rse_pf.maps.format import Keyframe, MapVersion, encode_map

__all__ = ["MAP_FILE", "KeyframeKeeper", "KeyframeUploads", "Others"]

MAP_FILE = "map.rsemap"
"""Name of a robot's map in its folder: what `rse_pf.maps.format.encode_map` returns."""


_LEFT_S = 30.0


class Others(Protocol):
    """Where keyframes and the map go."""

    def keyframe(self, data: bytes) -> None:
        """Take an encoded map of one keyframe; must not wait."""

    def finish(self, robot: str, data: bytes) -> int:
        """Take the robot's whole map; return how many keyframes have arrived."""


class KeyframeUploads:
    """The way to the data service: keyframes in the background, the map at the end."""

    def __init__(
        self,
        url: str,
        token: Callable[[], str],
        spool: Path,
        settings: DataSettings,
        is_busy: Callable[[], bool],
    ) -> None:
        """Begin to send; *is_busy* says that a live pose is on its way and keyframes have to wait."""
        self._client = DataClient(url, token)
        self._background = BackgroundUploader(DataClient(url, token), spool, settings, is_busy=is_busy)
        self._background.start()

    def keyframe(self, data: bytes) -> None:
        """Spool a keyframe."""
        self._background.add(data)

    def finish(self, robot: str, data: bytes) -> int:
        """Wait for the keyframes, commit the map under the robot's name, and hang up."""
        try:
            self._background.wait_sent(_LEFT_S)
            commit(self._client, robot, data, "the drive of a demo")
        finally:
            self._background.close()
            self._client.close()
        return self._background.sent


class KeyframeKeeper:
    """Collects the keyframes of one robot's drive."""

    def __init__(self, robot: str, options: FrontEndOptions, others: Others | None = None) -> None:
        """Remember what to do.

        Args:
            robot: Its name, which its keyframes carry.
            options: Those of its tracker: the features are found again in the same way.
            others: Gets each keyframe, encoded as a map of one, and the map.
        """
        self.uploaded = 0
        """Keyframes that have arrived, once the map was shared."""
        self._robot = robot
        self._options = options
        self._others = others
        self._keyframes: list[Keyframe] = []

    def __len__(self) -> int:
        return len(self._keyframes)

    def see(self, tracked: TrackedFrame) -> None:
        """Keep *tracked* if it is a keyframe."""
        if not tracked.keyframe or tracked.T_world_camera is None:
            return
        found = extract(tracked.frame, self._options)
        keyframe = Keyframe(
            id=len(self._keyframes),
            robot=self._robot,
            timestamp_s=tracked.frame.timestamp_s,
            T_world_camera=tracked.T_world_camera,
            camera=tracked.frame.camera,
            pixels=found.pixels.astype(np.float32),
            descriptors=found.descriptors,
            points_camera=found.points_camera.astype(np.float32),
        )
        self._keyframes.append(keyframe)
        if self._others is not None:
            self._others.keyframe(encode_map(MapVersion(keyframes=(keyframe,))))

    def encoded_map(self, points: npt.NDArray[np.float32], colours: npt.NDArray[np.uint8]) -> bytes:
        """Return the robot's map with its cloud, ``(n, 3)`` metres and ``(n, 3)`` uint8."""
        version = MapVersion(
            keyframes=tuple(self._keyframes),
            points=points,
            colours=colours,
            provenance={"made_by": "demo", "robot": self._robot},
        )
        return encode_map(version)

    def share(self, data: bytes) -> None:
        """Hand the whole map over; blocks until the others have it.

        Raises:
            RsePfError: They do not take it.
        """
        if self._others is not None:
            self.uploaded = self._others.finish(self._robot, data)
