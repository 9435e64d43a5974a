"""Parts of the mapper that a user may bring: features, a motion model, places and an optimiser.

A features function takes an image and returns `FoundFeatures`::

    def sift(rgb):
        keypoints, descriptors = SIFT.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        scores = [keypoint.response for keypoint in keypoints]
        pixels = cv2.KeyPoint_convert(keypoints)
        return FoundFeatures(pixels=pixels, scores=scores, descriptors=descriptors)

    mapper = robot.mapper(features=sift)
"""

from __future__ import annotations

import asyncio
import importlib
import math
import re
import sys
import traceback
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.imu.estimator import ImuEstimator
from client_sdk.monocular.bundle import Bundle
from rse_pf.errors import BadRequest, UsageError
from rse_pf.geometry import Array, Camera, rigid
from rse_pf.maps.descriptors import MAX_DESCRIPTOR_SIZE, ORB, DescriptorKind, Descriptors
from rse_pf.slam.place_recognition import PlaceVector

__all__ = [
    "CheckedFeatures",
    "FeaturesFunction",
    "FeaturesSlot",
    "FoundFeatures",
    "LoopsFunction",
    "LoopsSlot",
    "MotionFunction",
    "MotionSlot",
    "OptimiserFunction",
    "OptimiserSlot",
    "Slots",
    "load_features",
    "load_function",
]

_MAX_FOUND = 100_000
_RECENT = 10
_MIN_PLACE, _MAX_PLACE = 8, 4096
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


MotionFunction = Callable[[Array, Array, float], npt.ArrayLike]
"""Takes ``(k,)`` stamps in seconds and ``(k, 4, 4)`` poses ``T_world_camera`` of the newest tracked frames,
ten at most, oldest first, and the next stamp; returns its expected ``(4, 4)`` ``T_world_camera``."""
LoopsFunction = Callable[[npt.NDArray[np.uint8]], npt.ArrayLike]
"""Takes an ``(h, w, 3)`` uint8 image, red first, and returns a vector of 8 to 4,096 numbers: the smaller the
angle between two vectors, the likelier the images show the same place."""
OptimiserFunction = Callable[[Bundle, Camera, int], tuple[npt.ArrayLike, npt.ArrayLike]]
"""Takes a bundle of a camera without depth, its intrinsics and the iterations that the built-in one would do;
returns the adjusted ``(c, 4, 4)`` poses ``T_camera_world`` and ``(p, 3)`` points."""


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
        return self._checked(_called(f"features function {self.name}", self._function, rgb), rgb.shape)

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
                pixels=np.empty((0, 2)), scores=none, descriptors=self.kind.empty(), turns=np.empty((0, 2)),
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
            raise self._refusal(
                f"returned {what} that are no numbers"
                + ": cv2.KeyPoint_convert makes them of keypoints" * (what == "pixels")
            ) from error
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


class MotionSlot:
    """A motion function with its checks, and the newest poses that it is given."""

    def __init__(self, function: MotionFunction) -> None:
        """Take a function; raises UsageError."""
        self._function = _callable("motion", function)
        self._recent: deque[tuple[float, Array]] = deque(maxlen=_RECENT)

    def add(self, timestamp_s: float, T_world_camera: Array) -> None:
        """Take the pose of a tracked frame."""
        self._recent.append((timestamp_s, T_world_camera))

    def clear(self) -> None:
        """Forget the poses: the camera was lost, or its frame was moved."""
        self._recent.clear()

    def expected(self, timestamp_s: float) -> Array | None:
        """Return ``T_world_camera`` as the function expects it at a time; None before any pose.

        Raises:
            UsageError: The function failed, or returned no pose.
        """
        if not self._recent:
            return None
        stamps_s = np.array([stamp_s for stamp_s, _ in self._recent])
        poses = np.array([pose for _, pose in self._recent])
        returned = _called("motion function", self._function, stamps_s, poses, timestamp_s)
        T = rigid(_numbers_of("motion", returned, (4, 4)))
        if T is None:
            raise UsageError(
                "the motion function returned a matrix that is no pose",
                hint="return T_world_camera: a rotation, a translation in metres, and 0 0 0 1",
            )
        return T


class LoopsSlot:
    """A loops function with its checks; its vectors have one length."""

    def __init__(self, function: LoopsFunction) -> None:
        """Take a function; raises UsageError."""
        self._function = _callable("loops", function)
        self._size = 0

    def __call__(self, rgb: npt.NDArray[np.uint8]) -> PlaceVector:
        """Return the unit vector of an image.

        Raises:
            UsageError: The function failed, or returned no such vector.
        """
        vector = _numbers_of("loops", _called("loops function", self._function, rgb), (-1,))
        length = float(np.linalg.norm(vector))
        self._size = self._size or len(vector)
        if len(vector) != self._size or not _MIN_PLACE <= len(vector) <= _MAX_PLACE or not length > 0.0:
            raise UsageError(
                f"the loops function returned {len(vector)} numbers of length {length:g}",
                hint=f"return a vector of {_MIN_PLACE} to {_MAX_PLACE} numbers, always as many, not all 0",
            )
        return (vector / length).astype(np.float32)


class OptimiserSlot:
    """An optimiser with its checks; it is called as `client_sdk.monocular.bundle.adjust` is."""

    def __init__(self, function: OptimiserFunction) -> None:
        """Take a function; raises UsageError."""
        self._function = _callable("optimiser", function)

    def __call__(self, bundle: Bundle, camera: Camera, *, iterations: int = 8) -> tuple[Array, Array]:
        """Return the adjusted poses ``T_camera_world`` and points.

        Raises:
            UsageError: The function failed, or returned no poses and points of these numbers.
        """
        returned = _called("optimiser function", self._function, bundle, camera, iterations)
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise UsageError(
                f"the optimiser function returned {type(returned).__name__}, not poses and points",
                hint="return T_camera_world and points_world of the bundle, adjusted",
            )
        poses = _numbers_of("optimiser", returned[0], bundle.T_camera_world.shape)
        points = _numbers_of("optimiser", returned[1], bundle.points_world.shape)
        made = [rigid(pose) for pose in poses]
        if any(pose is None for pose in made):
            raise UsageError(
                "the optimiser function returned a matrix that is no pose", hint="keep rotations orthonormal"
            )
        return np.array(made).reshape(-1, 4, 4), points


def _callable(slot: str, function: Any) -> Any:
    if not callable(function):
        raise UsageError(
            f"{slot}= takes a function, not a {type(function).__name__}", hint="see docs/own_parts.md"
        )
    return function


def _called(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return function(*arguments)
    except (Exception, asyncio.CancelledError, SystemExit) as error:  # also what would end a thread or a task
        raise UsageError(
            f"the {name} failed: {type(error).__name__}: {_line(error)}",
            hint="call it with values of your own, or see docs/own_parts.md",
        ) from error


def _numbers_of(slot: str, given: Any, shape: tuple[int, ...]) -> Array:
    """Return finite numbers of a shape, of which -1 is free; raises UsageError."""
    try:
        array = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"the {slot} function returned no numbers", hint="return an array") from error
    fits = array.ndim == len(shape) and all(b in (-1, a) for a, b in zip(array.shape, shape, strict=True))
    if not fits or not np.isfinite(array).all():
        raise UsageError(
            f"the {slot} function returned an array of shape {array.shape}, or numbers that are not finite",
            hint=f"return finite numbers of shape {shape}".replace("-1", "n"),
        )
    return array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Slots:
    """The parts of a tracker that its user brought, None for the built-in ones; and what its IMU tells."""

    features: FeaturesSlot | None = None
    motion: MotionSlot | None = None
    loops: LoopsSlot | None = None
    optimiser: OptimiserSlot | None = None
    inertial: ImuEstimator | None = None

    @classmethod
    def of(
        cls,
        *,
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
        optimiser: OptimiserFunction | None = None,
    ) -> Slots:
        """Return the slots of these functions.

        Raises:
            UsageError: One is no function, or the features have no name.
        """
        return cls(
            features=None if features is None else FeaturesSlot(features),
            motion=None if motion is None else MotionSlot(motion),
            loops=None if loops is None else LoopsSlot(loops),
            optimiser=None if optimiser is None else OptimiserSlot(optimiser),
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
        module = importlib.import_module(parts[1])
    except Exception as error:
        raise UsageError(
            f"{name} cannot be loaded: {type(error).__name__}: {_line(error)}",
            hint=f"is {parts[1].replace('.', '/')}.py in this folder, or installed?",
        ) from error
    if not hasattr(module, parts[2]):
        own = [word for word, value in vars(module).items() if callable(value) and not word.startswith("_")]
        raise UsageError(
            f"{parts[1]} has no function {parts[2]}", hint=f"it has {', '.join(sorted(own)[:8]) or 'none'}"
        )
    return getattr(module, parts[2])


def _line(error: BaseException) -> str:
    """Return the message of an error in one line, and the last line of a user's file that led to it."""
    passed = (__file__, importlib.__file__)
    trace = traceback.extract_tb(error.__traceback__)
    frames = [f for f in trace if f.filename not in passed and not f.filename.startswith("<")]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return " ".join(str(error).split())[:200] + where
