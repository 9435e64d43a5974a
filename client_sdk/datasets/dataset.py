"""A recording as frames in the order of time, thinned out or shared among robots."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from client_sdk.datasets.images import readable
from client_sdk.datasets.thinning import Thinning, median_interval_s
from client_sdk.frontend import Frame
from client_sdk.rigs.imu_track import ImuTrack, with_imu
from client_sdk.rigs.stereo_pair_checks import check_stereo_pairs, choose_pairs
from client_sdk.source_facts import Doubt, DoubtLog
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera

__all__ = ["Dataset"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Dataset:
    """A recording: iterate over it to get its frames in order of time.

    ``truth_kind`` is ``reference`` if the poses came with the source as an estimate.  ``read`` reads one of
    ``rows``; row *i* has the time stamp ``timestamps_s[i]`` of this dataset.  ``notes`` are sentences for the
    user on what was assumed.  ``T_body_camera`` is the pose of the camera in the body whose path was
    measured, None where that is the camera itself, or not known.  With *has_stereo* the camera is the
    rectified left one, and so is that of the truth.  ``imu`` holds all samples of an IMU; each frame that is
    iterated over gets those since the frame before it in this dataset.  ``log`` collects `doubts`.
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
    imu: ImuTrack | None = None
    log: DoubtLog = field(default_factory=DoubtLog)

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """What is unlikely about the recording, and images that were left out while it was iterated over."""
        return self.log.doubts

    @property
    def span_s(self) -> tuple[float, float] | None:
        """The first and the last time stamp; None without a frame."""
        return (self.timestamps_s[0], self.timestamps_s[-1]) if self.timestamps_s else None

    @property
    def has_imu(self) -> bool:
        """Whether frames carry samples of an IMU."""
        return self.imu is not None

    @property
    def sensors(self) -> str:
        """What the frames show, for people: such as ``stereo + IMU``."""
        seen = "stereo" if self.has_stereo else "colour + depth" if self.has_depth else "one lens"
        return f"{seen} + IMU" if self.has_imu else seen

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[Frame]:
        frames = readable(self.rows, self.read, self.log)
        if self.T_body_camera is not None:
            frames = (replace(frame, T_body_camera=self.T_body_camera) for frame in frames)
        return with_imu(frames, self.imu)

    def check(self) -> None:
        """Look at some stereo pairs, and refuse a rig that is wrong; other recordings are not looked at.

        Raises:
            UsageError: The cameras are swapped, not synchronised, or rectified wrongly.
        """
        if self.has_stereo:
            check_stereo_pairs(self.some_pairs(), self.name)

    def some_pairs(self) -> Iterator[tuple[Frame, Frame]]:
        """Yield some frames, each with the one after it; damaged images are passed over."""

        def read(rows: tuple[int, int]) -> tuple[Frame, Frame]:
            return self.read(rows[0]), self.read(rows[1])

        return readable(choose_pairs(self.rows), read, DoubtLog())

    def thinned(self, rate_hz: float) -> Dataset:
        """Return frames at *rate_hz* on average; all of them at the recording's own rate, or a higher one.

        Jitter drops none: `Thinning` says which frame serves which due time.

        Raises:
            UsageError: The rate is not above 0.
        """
        thinning = Thinning(rate_hz, interval_s=median_interval_s(self.timestamps_s))
        rows = [index for index, stamp_s in enumerate(self.timestamps_s) if thinning.plays(stamp_s)]
        return self._only(rows)

    def share(self, robot: int, robots: int) -> Dataset:
        """Return the contiguous share of ``ceil(n / robots)`` frames of *robot* 0, 1, ..."""
        if not 0 <= robot < robots:
            raise UsageError(f"robot {robot} is not one of 0..{robots - 1}", hint="count robots from 0")
        size = math.ceil(len(self) / robots)
        return self._only(range(len(self))[robot * size : (robot + 1) * size])

    def _only(self, indices: Sequence[int]) -> Dataset:
        return replace(
            self,
            timestamps_s=tuple(self.timestamps_s[index] for index in indices),
            rows=tuple(self.rows[index] for index in indices),
        )
