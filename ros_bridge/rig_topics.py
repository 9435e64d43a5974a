"""The sensor rig of a bridge: the calibration of a stereo pair, and an IMU with its samples.

The calibration of the pair is that of both ``CameraInfo`` topics, or of the file of the rig.  Images are
paired and decoded in `ros_bridge.incoming`.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.bags.imu import numbers_of_imu
from client_sdk.bags.stereo import pair_of
from client_sdk.imu.samples import ImuModel, ImuSamples
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig, RigCamera
from client_sdk.rigs.rig_file import read_rig
from ros_bridge.options import BridgeOptions
from rse_pf.geometry import Array, inverse

__all__ = ["RigTopics"]

# Largest number of IMU samples that wait for the next frame: 10 s of an IMU with 2 kHz.
_KEPT_SAMPLES = 20_000
# A time stamp this far before the previous one, in ns, means that the clock was set back or a bag plays
# again.
_JUMP_NS = 1_000_000_000
# If the newest IMU sample is this far behind a frame, in ns, the frame no longer waits: the IMU is silent.
_LATE_NS = 200_000_000


class RigTopics:
    """The calibration of a stereo pair and of an IMU, and the IMU samples that wait for a frame.

    ``rectification`` is None until both cameras are known; ``imu_frame`` is the frame name in the IMU's
    messages.
    """

    def __init__(self, options: BridgeOptions) -> None:
        """Read the file of the rig, if the options name one.

        Raises:
            UsageError: The file cannot be used, or it lacks the right camera or the IMU whose topic is set.
        """
        self.rectification: Rectification | None = None
        self._left: RigCamera | None = None
        self.imu_frame = ""
        self._options = options
        self._rig: Rig | None = None if not options.rig else read_rig(Path(options.rig))
        self._infos: dict[str, Any] = {}
        self._samples: deque[tuple[int, tuple[float, ...]]] = deque(maxlen=_KEPT_SAMPLES)
        self._until_ns = -1
        if self._rig is not None:
            options.check_rig(has_right=self._rig.right is not None, has_imu=self._rig.imu is not None)
            if options.right and self._rig.right is not None:
                self._rectify(self._rig.left, self._rig.right)

    @property
    def T_body_camera(self) -> Array | None:
        """The pose ``(4, 4)`` of the (rectified left) camera in the body frame; None if it is not known."""
        if self.rectification is not None:
            return self.rectification.T_body_camera
        return None if self._rig is None else self._rig.left.T_body_camera

    @property
    def T_left_rectified(self) -> Array:
        """The pose ``(4, 4)`` of the rectified left camera in the left one; the identity without a pair."""
        if self._left is None or self.rectification is None:
            return np.eye(4)
        T: Array = inverse(self._left.T_body_camera) @ self.rectification.T_body_camera
        return T

    @property
    def T_base_left(self) -> Array | None:
        """The pose ``(4, 4)`` of the camera of the images on the body by the file of the rig.

        None without a file, and if the body of the rig is this camera.
        """
        T = None if self._rig is None else self._rig.left.T_body_camera
        return None if T is None or np.allclose(T, np.eye(4)) else T

    @property
    def T_camera_imu(self) -> Array | None:
        """The pose ``(4, 4)`` of the IMU in the (rectified left) camera frame; None if it is not known."""
        rig, T = self._rig, self.T_body_camera
        return None if rig is None or rig.imu is None or T is None else inverse(T) @ rig.imu.T_body_imu

    def learn(self, role: str, message: Any) -> None:
        """Store the ``CameraInfo`` *message* of the camera *role*.

        Once those of both cameras are stored, the rectification of the pair is computed.  Later messages, and
        messages of a bridge without a pair, are ignored.

        Raises:
            UsageError: The pair cannot be used: the cameras are swapped, or their distance is not known.
        """
        if self.rectification is not None or not self._options.right:
            return
        self._infos[role] = message
        if len(self._infos) == 2:
            left, right = (
                (str(getattr(self._options, each)), self._infos[each], "rect" in topic.rsplit("/", 1)[-1])
                for each, topic in (("info", self._options.colour), ("right_info", self._options.right))
            )
            self._rectify(*pair_of(left, right, None))

    def add_imu(self, message: Any, stamp_ns: int) -> None:
        """Add the IMU sample *message*; ignore one that is not newer than the last sample.

        If it is older by at least 1 s, the clock was set back: the stored samples are dropped, and it is
        added.

        Raises:
            BrokenMessage: The message lacks rates or accelerations, or a number is not finite.
        """
        numbers = numbers_of_imu(message)
        self.imu_frame = str(message.header.frame_id).lstrip("/")
        if self._samples and stamp_ns <= self._samples[-1][0]:
            if stamp_ns > self._samples[-1][0] - _JUMP_NS:
                return
            self._samples.clear()
            self._until_ns = -1
        self._samples.append((stamp_ns, numbers))

    def is_imu_due(self, stamp_ns: int) -> bool:
        """Return whether a frame at *stamp_ns* must wait for an IMU sample after it.

        False if there is such a sample or no IMU, or if the IMU is at least 0.2 s behind the frame.
        """
        if not self._samples or not self._options.imu or self._rig is None:
            return False
        behind_ns = stamp_ns - self._imu_stamp_ns(self._samples[-1][0])
        return 0 < behind_ns < _LATE_NS

    def imu_until(self, stamp_ns: int) -> ImuSamples | None:
        """Return the IMU samples from the one before the last frame to the one after *stamp_ns*.

        Samples before them are dropped.  None without an IMU, or if the pose of the camera is not known.
        """
        rig, T = self._rig, self.T_body_camera
        if rig is None or rig.imu is None or T is None or not self._samples:
            return None
        model: ImuModel = rig.imu.model(T)
        rows = list(self._samples)
        stamps_ns = np.array([self._imu_stamp_ns(stamp) for stamp, _ in rows], dtype=np.int64)
        if self._until_ns < 0:
            self._until_ns = stamp_ns  # the first frame gets no samples from before it, as with bags
        first = max(0, int(np.searchsorted(stamps_ns, self._until_ns, side="right")) - 1)
        last = int(np.searchsorted(stamps_ns, stamp_ns, side="left")) + 1
        self._until_ns = stamp_ns
        for _ in range(first):
            self._samples.popleft()
        values = np.array([numbers for _, numbers in rows[first:last]]).reshape(-1, 6)
        if not len(values):
            return None
        stamps_s = stamps_ns[first:last] / 1e9
        return ImuSamples(
            stamps_s, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:]), model
        )

    def _imu_stamp_ns(self, stamp_ns: int) -> int:
        """Return the time stamp of an IMU sample by the clock of the camera, in ns."""
        return stamp_ns - (0 if self._rig is None else round(1e9 * self._rig.left.time_offset_s))

    def _rectify(self, left: RigCamera, right: RigCamera) -> None:
        self.rectification, self._left = Rectification(left, right), left
