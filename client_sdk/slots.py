"""Parts of the mapper that a user may bring: how features are found, and later what else is pluggable.

A features function takes an image and returns `FoundFeatures`::

    def sift(rgb):
        keypoints, descriptors = SIFT.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        scores = [keypoint.response for keypoint in keypoints]
        pixels = cv2.KeyPoint_convert(keypoints)
        return FoundFeatures(pixels=pixels, scores=scores, descriptors=descriptors)

    mapper = robot.mapper(features=sift)
"""

from __future__ import annotations

import importlib
import math
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, UsageError
from rse_pf.geometry import Array
from rse_pf.maps.descriptors import MAX_DESCRIPTOR_SIZE, ORB, DescriptorKind, Descriptors

__all__ = [
    "CheckedFeatures",
    "FeaturesFunction",
    "FeaturesSlot",
    "FoundFeatures",
    "load_features",
    "load_function",
]

_MAX_FOUND = 100_000
_CLIP = 4.0
"""A vector's numbers are cut at so many times their root mean square, when it becomes int8."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundFeatures:
    """What a features function returns for one image, in any order.

    Attributes:
        pixels: ``(n, 2)``, column and row; the centre of the first pixel is (0, 0).
        scores: ``(n,)``; the highest are kept.
        descriptors: ``(n, d)``: uint8 for binary ones (Hamming distance), int8 or floats for vectors
            (Euclidean distance).  Floats are scaled to one length and sent as int8.
        turns_deg: ``(n,)``, how each feature is turned in the image, clockwise from the x axis; None where
            the detector does not say: then a match may be turned by any angle.
        sizes: ``(n,)``, its scale, 1 for the finest; None where the detector does not say.
    """

    pixels: npt.ArrayLike
    scores: npt.ArrayLike
    descriptors: npt.ArrayLike | None
    turns_deg: npt.ArrayLike | None = None
    sizes: npt.ArrayLike | None = None


FeaturesFunction = Callable[[npt.NDArray[np.uint8]], FoundFeatures]
"""Takes an ``(h, w, 3)`` uint8 image, red first.  Its ``name``, else its ``__name__``, names the features."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CheckedFeatures:
    """Features of one image, best first: as `FoundFeatures`, with int8 for floats."""

    pixels: Array
    scores: Array
    descriptors: Descriptors
    turns: Array
    sizes: Array


class FeaturesSlot:
    """A features function, with its checks; its ``kind`` is ORB until an image had features.

    ``is_oriented`` and ``is_scaled`` say whether it tells how features are turned, and their sizes.
    """

    def __init__(self, function: FeaturesFunction) -> None:
        """Take a function.

        Raises:
            UsageError: It cannot be called, or has no name that features can have.
        """
        if not callable(function):
            raise UsageError(
                f"features= takes a function, not a {type(function).__name__}",
                hint="give a function from an image to FoundFeatures",
            )
        self._function = function
        self.name = str(
            getattr(function, "name", None) or getattr(function, "__name__", type(function).__name__)
        ).lower()
        self.kind: DescriptorKind = ORB
        self.is_oriented, self.is_scaled = False, False
        self._is_known = False
        try:
            DescriptorKind(self.name, "uint8", ORB.size)
        except BadRequest as error:
            raise UsageError(error.message, hint="set the function's name: function.name = 'mine'") from error
        if self.name == ORB.name:
            raise UsageError("features named orb are the built-in ones", hint="give yours another name")

    def __call__(self, rgb: npt.NDArray[np.uint8]) -> CheckedFeatures:
        """Return the features of an ``(h, w, 3)`` image.

        Raises:
            UsageError: The function failed, or what it returned cannot be features.
        """
        try:
            found = self._function(rgb)
        except Exception as error:
            raise UsageError(
                f"the features function {self.name} failed: {type(error).__name__}: {_line(error)}",
                hint="call it with one of your images",
            ) from error
        return self._checked(found, rgb.shape)

    def _checked(self, found: Any, shape: tuple[int, ...]) -> CheckedFeatures:
        if not isinstance(found, FoundFeatures):
            raise self._refusal(f"returned {type(found).__name__}, not FoundFeatures")
        pixels = self._numbers("pixels", found.pixels, (-1, 2))
        n = len(pixels)
        if n > _MAX_FOUND:
            raise self._refusal(f"returned {n} features, above {_MAX_FOUND}")
        if not n:
            none = np.empty(0)
            return CheckedFeatures(
                pixels=np.empty((0, 2)), scores=none, descriptors=self.kind.none(), turns=np.empty((0, 2)),
                sizes=none,
            )  # fmt: skip
        scores = self._numbers("scores", found.scores, (n,))
        descriptors = self._descriptors(found.descriptors, n)
        turned = found.turns_deg is not None, found.sizes is not None
        kind = DescriptorKind(self.name, str(descriptors.dtype), descriptors.shape[1])
        if self._is_known and (kind != self.kind or turned != (self.is_oriented, self.is_scaled)):
            raise self._refusal(f"returned {kind} after {self.kind}, or other fields than before")
        self.kind, self._is_known = kind, True
        self.is_oriented, self.is_scaled = turned
        angles = np.radians(
            np.zeros(n) if found.turns_deg is None else self._numbers("turns_deg", found.turns_deg, (n,))
        )
        sizes = np.ones(n) if found.sizes is None else self._numbers("sizes", found.sizes, (n,))
        if not (sizes > 0.0).all():
            raise self._refusal("returned sizes that are not above 0")
        within = ((pixels >= -0.5) & (pixels <= np.array([shape[1], shape[0]]) - 0.5)).all(axis=1)
        if not within.all():
            raise self._refusal(f"returned {int((~within).sum())} pixels outside the image")
        best = np.argsort(-scores, kind="stable")
        return CheckedFeatures(
            pixels=pixels[best], scores=scores[best], descriptors=descriptors[best],
            turns=np.stack([np.cos(angles), np.sin(angles)], axis=1)[best], sizes=sizes[best],
        )  # fmt: skip

    def _numbers(self, what: str, given: npt.ArrayLike, shape: tuple[int, ...]) -> Array:
        """Return finite numbers of a shape, whose first number may be free."""
        try:
            array = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise self._refusal(f"returned {what} that are no numbers") from error
        if not array.size and shape[0] == -1:
            return np.empty((0, *shape[1:]))
        if array.ndim != len(shape) or any(b not in (-1, a) for a, b in zip(array.shape, shape, strict=True)):
            wanted = tuple("n" if number == -1 else number for number in shape)
            raise self._refusal(f"returned {what} of shape {array.shape}, not {wanted}".replace("'", ""))
        if not np.isfinite(array).all():
            raise self._refusal(f"returned {what} that are not finite")
        return array

    def _descriptors(self, given: npt.ArrayLike | None, n: int) -> Descriptors:
        array = np.asarray(given)
        if array.ndim != 2 or len(array) != n or not 4 <= array.shape[1] <= MAX_DESCRIPTOR_SIZE:
            raise self._refusal(
                f"returned descriptors of shape {array.shape} for {n} features, not ({n}, 4 to "
                f"{MAX_DESCRIPTOR_SIZE})"
            )
        if array.dtype == np.uint8 or array.dtype == np.int8:
            return np.ascontiguousarray(array)
        if not np.issubdtype(array.dtype, np.floating):
            raise self._refusal(f"returned descriptors of {array.dtype}, not uint8, int8 or floats")
        vectors = array.astype(np.float64)
        lengths = np.linalg.norm(vectors, axis=1)
        if not np.isfinite(lengths).all() or not (lengths > 0.0).all():
            raise self._refusal("returned descriptors that are not finite, or zero")
        scale = 127.0 * max(1.0, math.sqrt(array.shape[1]) / _CLIP)
        scaled: Descriptors = np.rint(np.clip(vectors / lengths[:, None] * scale, -127.0, 127.0))
        return scaled.astype(np.int8)

    def _refusal(self, why: str) -> UsageError:
        return UsageError(
            f"the features function {self.name} {why}",
            hint="return FoundFeatures with a pixel, a score and a descriptor for each feature",
        )


def load_features(name: str | None) -> FeaturesFunction | None:
    """Return the features function that ``module:function`` names, None for None.

    Raises:
        UsageError: There is none, or it has no name that features can have.
    """
    if name is None:
        return None
    function: FeaturesFunction = load_function(name)
    FeaturesSlot(function)
    return function


_FUNCTION = re.compile(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)")


def load_function(name: str) -> Any:
    """Return what ``module:function`` names; modules of the working directory are found, too.

    Raises:
        UsageError: There is none.
    """
    parts = _FUNCTION.fullmatch(name)
    if parts is None:
        raise UsageError(f"{name!r} names no function", hint="write module:function, such as sift:sift")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        return getattr(importlib.import_module(parts[1]), parts[2])
    except Exception as error:
        raise UsageError(
            f"{name} cannot be loaded: {type(error).__name__}: {_line(error)}",
            hint=f"is {parts[1].replace('.', '/')}.py in this folder, or installed?",
        ) from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
