"""Read the image pairs of a stereo camera: from two devices or videos, or from images that show both side by
side.

`client_sdk.rigs.stereo_pair_checks` checks whether the images of a pair fit each other.
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
"""Largest difference between the times of the two images of a pair of two videos, in image intervals of the
video with the higher rate: images that are farther apart were not taken together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairVideos:
    """Two open devices, or two open videos, of a stereo pair; ``name`` names both in messages."""

    name: str
    left: Video
    right: Video

    def facts(self, names: tuple[str, str]) -> SourceFacts:
        """Return the facts about both: notes, and of videos the number of images and their interval.

        *names* are the names of both, left first.  Devices, and videos that state no number of images, have
        only the former.
        """
        stated = {
            name: VideoFacts(frames=video.frame_count, period_s=video.period_s)
            for name, video in zip(names, (self.left, self.right), strict=True)
            if video.frame_count
        }
        return SourceFacts(name=self.name, videos=stated, assumed=(*self.left.notes, *self.right.notes))

    def pairs(self, log: DoubtLog) -> Iterator[RawPair]:
        """Yield pairs, with the time stamps of the left images, until one side has no more images.

        The next image of the left device is paired with the next image of the right one, whatever their
        times, so that an image that one device loses shifts all later pairs.  Images of videos are paired if
        their times differ by at most 0.4 image intervals of the video with the higher rate.  *log* counts
        images of videos without a partner, but not those that remain in the longer video at the end.
        """
        # The limit is 0 for devices, whose images are paired without comparing times.
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
    """Yield the left and right half of each image of *raw*, a camera that gives both images side by side.

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
