"""Blur: how sharp a thumbnail is along four directions, against the thumbnails of the frames before."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from rse_pf.geometry import Array
from rse_pf.recording.explain.causes import Cause, PoseExplanation

__all__ = ["blur", "sharpness"]

_MAX_PIXELS = 640 * 480
_LOST_SHARPNESS, _FEWER_MATCHES = 0.42, 0.65
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))
_ALONG = ("horizontal", "vertical", "falling", "rising")
_UNREADABLE = "thumbnail (it cannot be read)"


def sharpness(thumbnail: bytes) -> Array | None:
    """Return fine over coarse contrast of a JPEG or PNG in four directions, None if it cannot be read.

    The directions are along the rows, along the columns, and both diagonals.  Blur along a direction lowers
    its number; brightness and contrast do not change it.  Pictures above 640x480 are refused undecoded.
    """
    gray = _decode(thumbnail)
    if gray is None:
        return None
    pictures = []
    for down, right in _DIRECTIONS:
        fine, coarse = (_second_difference(gray, down * step, right * step) for step in (1, 4))
        pictures.append(fine / max(coarse, 1e-6))
    return np.array(pictures)


def _decode(thumbnail: bytes) -> Array | None:
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        return None
    kind: Any = Image
    try:
        with kind.open(io.BytesIO(thumbnail), formats=("JPEG", "PNG")) as picture:
            width, height = picture.size
            if width * height > _MAX_PIXELS or min(width, height) < 16:
                return None
            return np.asarray(picture.convert("L"), dtype=np.float64)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, kind.DecompressionBombError):
        return None


def _second_difference(gray: Array, down: int, right: int) -> float:
    """Return the mean square second difference over an offset."""
    height, width = gray.shape
    rows, columns = abs(down), abs(right)

    def part(times: int) -> Array:
        top = rows + times * down
        left = columns + times * right
        inner: Array = gray[top : top + height - 2 * rows, left : left + width - 2 * columns]
        return inner

    second = part(-1) - 2.0 * part(0) + part(1)
    return float(np.mean(second * second))


def blur(
    thumbnail: bytes | None, past: Sequence[bytes], matches: int, usual_matches: float | None
) -> tuple[PoseExplanation | None, tuple[str, ...]]:
    """Return the explanation where the image is less sharp than those before, and what was missing.

    Args:
        thumbnail: Of the frame; None if there is none.
        past: Those of earlier frames.
        matches: Of this command.
        usual_matches: The median of earlier commands; None if there are none.
    """
    if thumbnail is None:
        return None, ("thumbnail (it would show blur)",)
    now = sharpness(thumbnail)
    if now is None:
        return None, (_UNREADABLE,)
    before = [value for value in map(sharpness, past) if value is not None]
    if not before:
        return None, ("thumbnails of earlier frames (they would show what is sharp here)",)
    ratios = now / np.maximum(np.median(np.array(before), axis=0), 1e-9)
    worst = int(ratios.argmin())
    ratio = float(ratios[worst])
    # An image that still gives its usual matches is no cause, however soft it looks.
    if ratio > _LOST_SHARPNESS or (usual_matches and matches > _FEWER_MATCHES * usual_matches):
        return None, ()
    fewer = f", with {matches} matches instead of {usual_matches:.0f}" if usual_matches else ""
    all_round = float(ratios.max()) < 1.3 * ratio
    direction = "in all directions" if all_round else f"along the {_ALONG[worst]} direction"
    return PoseExplanation(
        cause=Cause.BLUR,
        confidence=min(0.97, 0.82 + 0.3 * (_LOST_SHARPNESS - ratio)),
        sentence=(
            f"the image is blurred {direction}: {ratio:.0%} of the fine contrast of the {len(before)} frames "
            f"before{fewer}"
        ),
        evidence={
            "sharpness_ratio": ratio, "sharpest_direction_ratio": float(ratios.max()),
            "matches": float(matches), "usual_matches": float(usual_matches or 0.0),
        },
    ), ()  # fmt: skip
