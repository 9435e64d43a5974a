"""Read the pairs of images of a stereo camera: from two devices or videos, or from images with both halves.

Whether the images of a pair fit each other is checked in `client_sdk.rigs.stereo_pair_checks`.
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

_MAX_TIME_DIFFERENCE = 0.4
"""Difference between the times of two images of a pair, in image intervals of the faster video: images that
are farther apart belong to two moments."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairVideos:
    """Two open devices, or two open videos, of a stereo pair; ``name`` is for messages."""

    name: str
    left: Video
    right: Video

    def facts(self, names: tuple[str, str]) -> SourceFacts:
        """Return the facts about both: of videos also the number of images and the time between them.

        *names* are the names of both, left first; devices, and videos that state no number, give no such
        facts.
        """
        stated = {
            name: VideoFacts(frames=video.frame_count, period_s=video.period_s)
            for name, video in zip(names, (self.left, self.right), strict=True)
            if video.frame_count
        }
        return SourceFacts(name=self.name, videos=stated, assumed=(*self.left.notes, *self.right.notes))

    def pairs(self, log: DoubtLog) -> Iterator[RawPair]:
        """Yield pairs, with the time stamps of the left images, until one side has no more images.

        Of devices, images are paired as they come; of videos, images whose times differ by at most 0.4 image
        intervals of the faster video.  *log* counts images of videos without a partner, but not those that
        the longer video has left at the end.
        """
        # 0 for devices, whose images are taken as they come.
        max_difference_s = _MAX_TIME_DIFFERENCE * min(self.left.period_s, self.right.period_s)
        left, right = next(self.left.images, None), next(self.right.images, None)
        while left is not None and right is not None:
            difference_s = right[0] - left[0]
            if max_difference_s and difference_s > max_difference_s:
                log.leave_out(f"the left image at {left[0]:.3f} s")
                left = next(self.left.images, None)
            elif max_difference_s and difference_s < -max_difference_s:
                log.leave_out(f"the right image at {right[0]:.3f} s")
                right = next(self.right.images, None)
            else:
                yield left[0], left[1], right[1]
                left, right = next(self.left.images, None), next(self.right.images, None)

    def close(self) -> None:
        """Release both devices or files."""
        self.left.close()
        self.right.close()


def open_pair_videos(left: str, right: str) -> PairVideos:
    """Open two devices or two videos, named as for `open_video`.

    Raises:
        UsageError: One of them cannot be opened; the other one is closed then.
        MissingExtra: OpenCV is not installed.
    """
    left_video = open_video(left)
    try:
        return PairVideos(name=f"{left},{right}", left=left_video, right=open_video(right))
    except UsageError:
        left_video.close()
        raise


def split_pairs(raw: Iterator[RawFrame], name: str) -> Iterator[RawPair]:
    """Yield the left and the right half of each image of *raw*, a camera that shows both images side by side.

    Raises:
        UsageError: The width of an image is odd; *name* is the source, for the message.
    """
    for stamp, rgb, _ in raw:
        half = rgb.shape[1] // 2
        if rgb.shape[1] % 2:
            raise UsageError(
                f"{name} gives images of {rgb.shape[1]} px, which have no two halves",
                hint="use a camera that gives both images side by side, or two devices: 0,2",
            )
        yield stamp, np.ascontiguousarray(rgb[:, :half]), np.ascontiguousarray(rgb[:, half:])
