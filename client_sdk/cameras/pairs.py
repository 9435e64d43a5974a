"""Pairs of images of a stereo camera: two devices or videos, or one image with both side by side.

What is wrong with a pair of images is judged in `client_sdk.rigs`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from client_sdk.cameras.opencv_video import Video, open_video
from client_sdk.cameras.source import RawFrame, RawPair
from client_sdk.source_facts import DoubtLog, SourceFacts, VideoFacts
from rse_pf.errors import UsageError

__all__ = ["PairVideos", "open_pair_videos", "split_pairs"]

_MAX_APART = 0.4  # of a pair of two files, in frames: images that are farther apart show two moments


@dataclass(frozen=True, slots=True, kw_only=True)
class PairVideos:
    """Two devices or two videos."""

    name: str
    left: Video
    right: Video

    def facts(self, names: tuple[str, str]) -> SourceFacts:
        """Return what both videos state, and what was assumed."""
        stated = {
            name: VideoFacts(frames=video.frames, period_s=video.period_s)
            for name, video in zip(names, (self.left, self.right), strict=True)
            if video.frames
        }
        return SourceFacts(name=self.name, videos=stated, assumed=(*self.left.notes, *self.right.notes))

    def pairs(self, log: DoubtLog) -> Iterator[RawPair]:
        """Yield images of devices as they come, and images of files that have one time.

        *log* counts images of files without a partner.
        """
        within_s = _MAX_APART * min(self.left.period_s, self.right.period_s)
        left, right = next(self.left.images, None), next(self.right.images, None)
        while left is not None and right is not None:
            apart_s = right[0] - left[0]
            if within_s and apart_s > within_s:
                log.leave_out(f"the left image at {left[0]:.3f} s")
                left = next(self.left.images, None)
            elif within_s and apart_s < -within_s:
                log.leave_out(f"the right image at {right[0]:.3f} s")
                right = next(self.right.images, None)
            else:
                yield left[0], left[1], right[1]
                left, right = next(self.left.images, None), next(self.right.images, None)

    def close(self) -> None:
        """Release both."""
        self.left.close()
        self.right.close()


def open_pair_videos(left: str, right: str) -> PairVideos:
    """Open two devices or two videos.

    Raises:
        UsageError: One cannot be opened.
    """
    of_left = open_video(left)
    try:
        return PairVideos(name=f"{left},{right}", left=of_left, right=open_video(right))
    except UsageError:
        of_left.close()
        raise


def split_pairs(raw: Iterator[RawFrame], name: str) -> Iterator[RawPair]:
    """Yield the left and the right half of each image.

    Raises:
        UsageError: The width is odd.
    """
    for stamp, rgb, _ in raw:
        half = rgb.shape[1] // 2
        if rgb.shape[1] % 2:
            raise UsageError(
                f"{name} gives images of {rgb.shape[1]} px, which have no two halves",
                hint="use a camera that gives both images side by side, or two devices: 0,2",
            )
        yield stamp, np.ascontiguousarray(rgb[:, :half]), np.ascontiguousarray(rgb[:, half:])
