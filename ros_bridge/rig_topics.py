"""The rig behind the topics of a bridge: a stereo pair by both ``CameraInfo`` or by a file, and an IMU.

It decodes no image and pairs none; `ros_bridge.incoming` does.
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

_KEPT_SAMPLES = 20_000
"""Ten seconds of an IMU of 2 kHz wait for the next frame."""
_JUMP_NS = 1_000_000_000
_LATE_NS = 200_000_000
"""An IMU that is so far behind the camera is silent: nobody waits for it."""


class RigTopics:
    """What is known of a pair and of an IMU; ``rectification`` is None until both cameras are known."""

    def __init__(self, options: BridgeOptions) -> None:
        """Read the file of the rig, if there is one; ``imu_frame`` is the frame of the samples.

        Raises:
            UsageError: The file cannot be used, or it lacks the right camera or the IMU that has a topic.
        """
        self.rectification: Rectification | None = None
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
        """The ``(4, 4)`` pose of the camera of the frames in the body; None if it is not known."""
        if self.rectification is not None:
            return self.rectification.T_body_camera
        return None if self._rig is None else self._rig.left.T_body_camera

    @property
    def T_camera_imu(self) -> Array | None:
        """The ``(4, 4)`` pose of the IMU in the camera of the frames; None if the rig does not tell it."""
        rig, T = self._rig, self.T_body_camera
        return None if rig is None or rig.imu is None or T is None else inverse(T) @ rig.imu.T_body_imu

    def learn(self, role: str, message: Any) -> None:
        """Take the ``CameraInfo`` of a camera; both together give the pair, once.

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
        """Take a sample; one that is older than the last one is left out, unless the clock jumped back.

        Raises:
            BrokenMessage: It lacks rates or accelerations, or a number is not finite.
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
        """Return whether the sample after a frame is still to come; without it, its motion ends too early."""
        if not self._samples or not self._options.imu or self._rig is None:
            return False
        behind_ns = stamp_ns - self._imu_stamp_ns(self._samples[-1][0])
        return 0 < behind_ns < _LATE_NS

    def imu_until(self, stamp_ns: int) -> ImuSamples | None:
        """Return the samples since the last frame, from one before it to one after *stamp_ns*; or None."""
        rig, T = self._rig, self.T_body_camera
        if rig is None or rig.imu is None or T is None or not self._samples:
            return None
        model: ImuModel = rig.imu.model(T)
        rows = list(self._samples)
        stamps_ns = np.array([self._imu_stamp_ns(stamp) for stamp, _ in rows], dtype=np.int64)
        if self._until_ns < 0:
            self._until_ns = stamp_ns  # as in bags: what was before the first frame is not asked for
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
        """Return the time of a sample on the clock of the camera."""
        return stamp_ns - (0 if self._rig is None else round(1e9 * self._rig.left.time_offset_s))

    def _rectify(self, left: RigCamera, right: RigCamera) -> None:
        self.rectification = Rectification(left, right)
