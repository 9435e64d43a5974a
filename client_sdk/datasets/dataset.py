"""A recording as frames in the order of time; all of them, fewer per second, or the part of one robot of
several."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from client_sdk.auto_close import AutoClose
from client_sdk.datasets.images import readable
from client_sdk.datasets.thinning import Thinning, median_interval_s
from client_sdk.frontend import Frame
from client_sdk.rigs.imu_track import ImuTrack, with_imu
from client_sdk.rigs.stereo_pair_checks import check_stereo_pairs, choose_pairs
from client_sdk.source_facts import DoubtLog
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera

__all__ = ["Dataset"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dataset(AutoClose):
    """A recording: iterate over it for its frames in the order of time.

    Images are read during the iteration; a frame whose image cannot be read is left out, and counted in
    `log`.

    Attributes:
        name: Name of the recording, for messages.
        camera: The pinhole camera of all frames; the rectified left one of a stereo pair.
        timestamps_s: Time stamps of the frames, s.
        truth: Trajectory of the camera with which an estimate can be compared; None if there is none.
        truth_kind: ``ground truth``, ``reference`` if *truth* is an estimate of another program, or ``none``.
        has_camera_truth: False where nothing states that *truth* is that of the camera, as in a bag, whose
            poses may be those of a body.
        rows: For each time stamp, the index of its frame, which is the argument of *read*.
        read: Reads the frame with an index; raises UnreadableImage if an image is damaged.
        notes: Sentences for the user on what was assumed because the recording does not state it.
        has_depth: Whether frames have depth.
        has_stereo: Whether frames have the right image of a stereo pair.
        T_body_camera: ``(4, 4)``, m, pose of the camera of the frames in the body of its rig, which each
            frame gets; None if it is not known.  *truth* is the trajectory of the camera in any case.
        imu: All samples of the IMU, or None; each frame gets those since the frame before it.
        thinned_to_hz: Frames per second on average that `thinned` has left; None for all frames.
        log: Collects the doubts about the recording; recordings that `thinned` and `share` return have the
            same log.
        release: Closes the file of the recording; None if no file is open between two reads.
    """

    name: str
    camera: Camera
    timestamps_s: tuple[float, ...]
    truth: Trajectory | None
    truth_kind: Literal["ground truth", "reference", "none"]
    rows: tuple[int, ...]
    read: Callable[[int], Frame]
    notes: tuple[str, ...] = ()
    has_depth: bool = True
    has_stereo: bool = False
    T_body_camera: Array | None = None
    has_camera_truth: bool = True
    imu: ImuTrack | None = None
    thinned_to_hz: float | None = None
    log: DoubtLog = field(default_factory=DoubtLog)
    release: Callable[[], None] | None = None

    @property
    def rate_hz(self) -> float:
        """Frames per second: `thinned_to_hz`, else by the median time between frames; 1 without one."""
        return self.thinned_to_hz or 1.0 / (median_interval_s(self.timestamps_s) or 1.0)

    @property
    def name_at_rate(self) -> str:
        """Name and rate as text for the user, such as ``kitchen at 5 Hz``."""
        return f"{self.name} at {self.rate_hz:.3g} Hz"

    @property
    def span_s(self) -> tuple[float, float] | None:
        """The first and the last time stamp, s; None without frames."""
        return (self.timestamps_s[0], self.timestamps_s[-1]) if self.timestamps_s else None

    @property
    def has_imu(self) -> bool:
        """Whether frames have IMU samples."""
        return self.imu is not None

    @property
    def sensors(self) -> str:
        """The sensors of the recording in words, such as ``stereo + IMU``."""
        cameras = "stereo" if self.has_stereo else "colour + depth" if self.has_depth else "one lens"
        return f"{cameras} + IMU" if self.has_imu else cameras

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Frame]:
        frames = readable(self.rows, self.read, self.log)
        if self.T_body_camera is not None:
            frames = (replace(frame, T_body_camera=self.T_body_camera) for frame in frames)
        return with_imu(frames, self.imu)

    def close(self) -> None:
        """Close the file of the recording, after which no frame can be read; may be called again."""
        if self.release is not None:
            self.release()

    def check(self) -> None:
        """Compare the images of some stereo pairs, and refuse a faulty rig; do nothing without stereo pairs.

        Raises:
            UsageError: The cameras are swapped, not synchronised, or rectified wrongly.
        """
        if self.has_stereo:
            check_stereo_pairs(self.sample_pairs(), self.name)

    def sample_pairs(self) -> Iterator[tuple[Frame, Frame]]:
        """Yield up to 14 frames, spread over the recording, each with the frame after it.

        Pairs with an image that cannot be read are left out, and not counted in `log`.

        Raises:
            UnreadableImage: Each pair has an image that cannot be read.
        """

        def read(rows: tuple[int, int]) -> tuple[Frame, Frame]:
            return self.read(rows[0]), self.read(rows[1])

        return readable(choose_pairs(self.rows), read, DoubtLog())

    def thinned(self, rate_hz: float) -> Dataset:
        """Return a recording of *rate_hz* of the frames per second on average, or all if there are not more.

        This recording does not change; both share their *log*.  `Thinning` selects the frames so that jitter
        of the time stamps does not change their number.

        Raises:
            UsageError: The rate is not above 0.
        """
        thinning = Thinning(rate_hz, interval_s=median_interval_s(self.timestamps_s))
        indices = [index for index, stamp_s in enumerate(self.timestamps_s) if thinning.selects(stamp_s)]
        return replace(self._select(indices), thinned_to_hz=min(rate_hz, self.rate_hz))

    def share(self, robot: int, robots: int) -> Dataset:
        """Return the part of the recording that one robot of several replays as its own drive.

        The n frames are divided into parts of ``ceil(n / robots)`` consecutive frames, the first for robot 0;
        the last robots get the remaining frames, fewer or none.

        Raises:
            UsageError: *robot* is not within 0..robots - 1.
        """
        if not 0 <= robot < robots:
            raise UsageError(f"robot {robot} is not one of 0..{robots - 1}", hint="count robots from 0")
        size = math.ceil(len(self) / robots)
        return self._select(range(len(self))[robot * size : (robot + 1) * size])

    def _select(self, indices: Sequence[int]) -> Dataset:
        return replace(
            self,
            timestamps_s=tuple(self.timestamps_s[index] for index in indices),
            rows=tuple(self.rows[index] for index in indices),
        )
