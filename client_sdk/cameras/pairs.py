"""Pairs of images of a stereo camera: two devices or videos, one image with both side by side, two folders.

What is wrong with a pair of images is judged in `client_sdk.rigs`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from client_sdk.cameras.folder import image_files, open_folder
from client_sdk.cameras.opencv_video import open_video
from client_sdk.cameras.source import RawFrame, RawPair
from rse_pf.errors import UsageError

__all__ = ["open_pair_folder", "open_pair_videos", "split_pairs"]


def open_pair_folder(folder: Path) -> Iterator[RawPair]:
    """Return the images of ``left/`` with those of the same names in ``right/``.

    Raises:
        UsageError: There is no image, or one of the left has no partner.
    """
    names = [{path.stem for path in image_files(folder / side)} for side in ("left", "right")]
    missing = sorted(names[0] ^ names[1])
    if missing:
        side = "right" if missing[0] in names[0] else "left"
        raise UsageError(
            f"{missing[0]} is missing in {folder / side}", hint="give both images of a pair one name"
        )
    left, right = (open_folder(folder / side, 1000.0)[0] for side in ("left", "right"))
    return _joined(left, right)


def open_pair_videos(left: str, right: str) -> tuple[Iterator[RawPair], Callable[[], None]]:
    """Open two devices or two videos, and return their images in pairs, and how to close them.

    Raises:
        UsageError: One cannot be opened.
    """
    lefts, close_left = open_video(left)
    try:
        rights, close_right = open_video(right)
    except UsageError:
        close_left()
        raise

    def close() -> None:
        close_left()
        close_right()

    return _joined(lefts, rights), close


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


def _joined(lefts: Iterator[RawFrame], rights: Iterator[RawFrame]) -> Iterator[RawPair]:
    for (stamp, left, _), (_, right, _) in zip(lefts, rights, strict=False):
        yield stamp, left, right
