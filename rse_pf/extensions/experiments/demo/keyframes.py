"""The keyframes of a robot in the demo, and the map that the robot commits at the end.

Each keyframe is uploaded to the data service in a thread, and stored in memory for the map.  A keyframe holds
features and a pose, never an image.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import FrontEndOptions, TrackedFrame, extract
from client_sdk.plugins import FeaturesFunction, FeaturesPlugin
from client_sdk.transfer.data_client import DataClient
from rse_pf.extensions.experiments.demo.merge import commit
from rse_pf.maps.format import Keyframe, MapVersion, encode_map

__all__ = ["KeyframeCollector", "KeyframeUploads"]

_UPLOAD_TIMEOUT_S = 30.0  # longest wait for uploads of keyframes after the last frame, in seconds


class KeyframeUploads:
    """Uploads a robot's keyframes to the data service in a thread, and the robot's map at the end."""

    def __init__(self, url: str, token: Callable[[], str]) -> None:
        """Describe the uploads to the data service at *url*; *token* returns a valid token of the robot."""
        self._client = DataClient(url, token)
        self._thread = ThreadPoolExecutor(1, "keyframe-uploads")
        self._uploads: list[Future[str]] = []

    def keyframe(self, data: bytes) -> None:
        """Queue the upload of an encoded keyframe, and return at once."""
        self._uploads.append(self._thread.submit(self._client.upload, data))

    def finish(self, robot: str, data: bytes) -> int:
        """Wait up to 30 s for the uploads, commit *data* as the map named *robot*, and close the connection.

        Return the number of keyframes that were uploaded.
        """
        try:
            uploads, _ = wait(self._uploads, _UPLOAD_TIMEOUT_S)
            commit(self._client, robot, data, "a drive of the demo")
        finally:
            self._thread.shutdown(wait=False, cancel_futures=True)
            self._client.close()
        return sum(upload.exception() is None for upload in uploads)


class KeyframeCollector:
    """Collects the keyframes of one robot, uploads them, and makes a map of them."""

    def __init__(
        self,
        robot: str,
        options: FrontEndOptions,
        uploads: KeyframeUploads,
        features: FeaturesFunction | None = None,
    ) -> None:
        """Describe the robot; there is no keyframe yet.

        Args:
            robot: Name of the robot, which is stored in its keyframes.
            options: Options of the robot's tracker, with which the features of a keyframe are extracted
                again.
            uploads: Uploads each keyframe, encoded as a map with one keyframe, and the complete map.
            features: The robot's own function for features; None for ORB.
        """
        self._plugin = None if features is None else FeaturesPlugin(features)
        self._robot = robot
        self._options = options
        self._uploads = uploads
        self._keyframes: list[Keyframe] = []

    def __len__(self) -> int:
        return len(self._keyframes)

    def add(self, tracked: TrackedFrame) -> None:
        """Add and upload the frame *tracked* if the tracker made it a keyframe and it has a pose."""
        if not tracked.keyframe or tracked.T_world_camera is None:
            return
        features = extract(tracked.frame, self._options, self._plugin)
        keyframe = Keyframe(
            id=len(self._keyframes),
            robot=self._robot,
            timestamp_s=tracked.frame.timestamp_s,
            T_world_camera=tracked.T_world_camera,
            camera=tracked.frame.camera,
            pixels=features.pixels.astype(np.float32),
            descriptors=features.descriptors,
            kind=features.kind,
            points_camera=features.points_camera.astype(np.float32),
        )
        self._keyframes.append(keyframe)
        self._uploads.keyframe(encode_map(MapVersion(keyframes=(keyframe,))))

    def encoded_map(self, points: npt.NDArray[np.float32], colours: npt.NDArray[np.uint8]) -> bytes:
        """Return the encoded map: all keyframes, and a cloud of points ``(n, 3)`` (m) with RGB ``(n, 3)``."""
        version = MapVersion(
            keyframes=tuple(self._keyframes),
            points=points,
            colours=colours,
            provenance={"made_by": "demo", "robot": self._robot},
        )
        return encode_map(version)

    def upload_map(self, data: bytes) -> int:
        """Upload *data*, the encoded map; return the number of uploaded keyframes; raises RsePfError."""
        return self._uploads.finish(self._robot, data)
