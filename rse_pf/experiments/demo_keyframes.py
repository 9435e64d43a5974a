"""What a robot of the demo keeps for others: its keyframes, and at the end its map.

A keyframe is handed over as it is made (the data client sends it in the background) and kept for the map
that the robot commits.  Promises to hold features and poses only, never an image.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import FrontEndOptions, TrackedFrame, extract
from rse_pf.maps import Keyframe, MapVersion, encode_map

__all__ = ["MAP_FILE", "KeyframeKeeper"]

MAP_FILE = "map.rsemap"
"""Name of a robot's map in its folder: what `rse_pf.maps.encode_map` returns."""


class KeyframeKeeper:
    """Collects the keyframes of one robot's drive."""

    def __init__(
        self, robot: str, options: FrontEndOptions, hand_over: Callable[[bytes], object] | None = None
    ) -> None:
        """Remember what to do.

        Args:
            robot: Its name, which its keyframes carry.
            options: Those of its tracker: the features are found again in the same way.
            hand_over: Gets each keyframe, encoded as a map of one.
        """
        self._robot = robot
        self._options = options
        self._hand_over = hand_over
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
        if self._hand_over is not None:
            self._hand_over(encode_map(MapVersion(keyframes=(keyframe,))))

    def encoded_map(self, points: npt.NDArray[np.float32], colours: npt.NDArray[np.uint8]) -> bytes:
        """Return the robot's map with its cloud, ``(n, 3)`` metres and ``(n, 3)`` uint8."""
        version = MapVersion(
            keyframes=tuple(self._keyframes),
            points=points,
            colours=colours,
            provenance={"made_by": "demo", "robot": self._robot},
        )
        return encode_map(version)
