"""Choose the views of a moving camera that structure from motion needs: sharp, and with enough motion between
them.

The motion of each image since the one before it is measured with sparse optical flow (Lucas and Kanade 1981).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import load_opencv

__all__ = ["MAX_VIEWS", "select_views"]

_Image = npt.NDArray[np.uint8]

MAX_VIEWS = 60  # most views of a calibration: more take minutes, and determine the lens hardly better
_MIN_SPACING = 0.03
"""Smallest motion between two views, as a fraction of the image width: with less, there is no parallax."""
_MAX_SPACING = 0.12
"""Largest motion between two views that is asked for, as a fraction of the image width: with more, a view and
that after the next one overlap too little."""
_SEARCHED_SPACINGS = 1.5
"""A sharper image is looked for until the motion since the last view is this many times the smallest one."""
_MOTION_PERCENTILE = 75
"""Percentile of the lengths of the flow that counts as motion: far points and the points ahead of a car move
less than the others."""
_FLOW_WIDTH_PX = 480  # the flow is measured in images of this width, which is enough for a motion of 6 %
_FLOW_CORNERS = 200  # number of corners whose flow is measured
_MIN_FLOW_CORNERS = 20  # with fewer corners found again, the image counts as one that shows another place


def select_views(images: Iterable[_Image]) -> tuple[list[_Image], int]:
    """Return at most 60 grey views ``(h, w)``, and the number of images that were read.

    The sharpest image with 3 to 4.5 % of the image width of motion since the last view becomes the next view.
    When there are more than 60 views, every second one is left out, and twice the motion is asked for.
    Reading ends with the 60th view that is 12 % from the one before it: of a long recording only the
    beginning is used.
    """
    views: list[_Image] = []
    candidates: list[tuple[float, float, _Image]] = []
    spacing = motion = _MIN_SPACING
    count = 0
    last: _Image | None = None
    for gray in images:
        count += 1
        small = _shrink(gray)
        motion += 0.0 if last is None else _motion(last, small)
        last = small
        if candidates and motion >= _SEARCHED_SPACINGS * spacing:
            motion -= _append_sharpest(views, candidates)
            if len(views) == MAX_VIEWS and spacing >= _MAX_SPACING:
                return views, count
            if len(views) > MAX_VIEWS:
                views = views[::2]
                spacing *= 2
        if motion >= spacing:
            candidates.append((_sharpness(small), motion, gray))
    if candidates:
        _append_sharpest(views, candidates)
    return views[:MAX_VIEWS], count


def _append_sharpest(views: list[_Image], candidates: list[tuple[float, float, _Image]]) -> float:
    """Move the sharpest candidate to *views*, remove the others, and return its motion."""
    _, motion, gray = max(candidates, key=lambda candidate: candidate[0])
    views.append(gray)
    candidates.clear()
    return motion


def _shrink(gray: _Image) -> _Image:
    cv2 = load_opencv()
    scale = _FLOW_WIDTH_PX / gray.shape[1]
    small: _Image = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return small


def _motion(before: _Image, after: _Image) -> float:
    """Return the motion between two images, as a fraction of their width; 1 if no flow can be measured."""
    cv2 = load_opencv()
    corners = cv2.goodFeaturesToTrack(before, _FLOW_CORNERS, 0.01, 8)
    if corners is None:
        return 1.0
    moved, is_found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, maxLevel=4)
    flow = (moved - corners)[is_found.ravel() == 1].reshape(-1, 2)
    if len(flow) < _MIN_FLOW_CORNERS:
        return 1.0
    lengths_px = np.linalg.norm(flow, axis=1)
    motion: float = np.percentile(lengths_px, _MOTION_PERCENTILE) / before.shape[1]
    return motion


def _sharpness(gray: _Image) -> float:
    """Return the variance of the Laplacian, which is small for blurred images."""
    cv2 = load_opencv()
    sharpness: float = cv2.Laplacian(gray, cv2.CV_64F).var()
    return sharpness
