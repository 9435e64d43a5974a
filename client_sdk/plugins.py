"""Plug-ins of a tracker: a user's own feature extractor, motion model, place recognition and optimiser.

A feature extractor is a function from an image to `FoundFeatures`::

    def sift(rgb):
        keypoints, descriptors = SIFT.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
        scores = [keypoint.response for keypoint in keypoints]
        pixels = cv2.KeyPoint_convert(keypoints)
        return FoundFeatures(pixels=pixels, scores=scores, descriptors=descriptors)

    mapper = robot.mapper(features=sift)

Each function of a user is wrapped by a class of this module, which checks every value that it returns.  The
functions run on the robot only, and their errors reach the caller of the mapper as a UsageError.
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
from client_sdk.wheel_odometry import WheelMotion, WheelOdometry
from rse_pf.errors import BadRequest, UsageError
from rse_pf.geometry import Array, Camera, rigid
from rse_pf.maps.descriptors import MAX_DESCRIPTOR_SIZE, ORB, DescriptorKind, Descriptors
from rse_pf.slam.place_recognition import PlaceVector

__all__ = [
    "CheckedFeatures",
    "FeaturesFunction",
    "FeaturesPlugin",
    "FoundFeatures",
    "LoopsFunction",
    "LoopsPlugin",
    "MotionFunction",
    "MotionPlugin",
    "OptimiserFunction",
    "OptimiserPlugin",
    "Plugins",
    "load_features",
    "load_function",
]

_MAX_FOUND_FEATURES = 100_000
"""Largest number of features that a user's extractor may return for one image; with more, which would take
too much time and memory, a UsageError is raised."""
_MOTION_HISTORY_POSES = 10
"""Largest number of poses that a user's motion model is given, the newest ones; older poses are dropped."""
_MIN_PLACE_SIZE = 8
"""Smallest length of the vector that a user's place recogniser returns; a shorter one, which would not
distinguish places, raises a UsageError."""
_MAX_PLACE_SIZE = 4096
"""Largest length of the vector that a user's place recogniser returns; a longer one, which would take too
much memory for each keyframe, raises a UsageError."""
_CLIP_RMS = 4.0
"""When a float descriptor becomes int8, its numbers are clipped at this many times their root mean square;
the limit becomes 127."""

_PARTS_HINT = "see docs/own_parts.md"
_FEATURES_HINT = (
    "return FoundFeatures with a pixel, a score and a descriptor for each feature; cv2.KeyPoint_convert "
    "makes pixels of keypoints"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FoundFeatures:
    """Features of one image, in any order, as a user's feature extractor returns them.

    Attributes:
        pixels: ``(n, 2)``, column and row; the centre of the first pixel is (0, 0).
        scores: ``(n,)``, strength; the tracker uses the features with the highest scores.
        descriptors: ``(n, d)``: uint8 for binary descriptors (Hamming distance), int8 or floats for vectors
            (Euclidean distance).  Float vectors are scaled to length 1 and rounded to int8.  None is allowed
            only if n is 0.
        orientations_deg: ``(n,)``, angle of each feature in the image, clockwise from the x axis; None if the
            detector measures none: then a match may be rotated by any angle.
        sizes: ``(n,)``, scale of each feature, above 0, 1 for the finest; None if the detector measures none:
            then a match may have any change of scale.
    """

    pixels: npt.ArrayLike
    scores: npt.ArrayLike
    descriptors: npt.ArrayLike | None
    orientations_deg: npt.ArrayLike | None = None
    sizes: npt.ArrayLike | None = None


FeaturesFunction = Callable[[npt.NDArray[np.uint8]], FoundFeatures]
"""A feature extractor: takes an ``(h, w, 3)`` uint8 image, red first.  The function's attribute ``name``,
else its ``__name__``, in lower case, is the name of the kind of features: maps hold features of one kind
only."""
MotionFunction = Callable[[Array, Array, float], npt.ArrayLike]
"""A motion model: takes ``(k,)`` times in seconds and ``(k, 4, 4)`` poses ``T_world_camera`` of the newest
tracked frames, ten at most, oldest first, and the time of the next frame; returns the predicted ``(4, 4)``
``T_world_camera`` of that frame."""
LoopsFunction = Callable[[npt.NDArray[np.uint8]], npt.ArrayLike]
"""A place recogniser: takes an ``(h, w, 3)`` uint8 image, red first, and returns a vector of 8 to 4,096
numbers; the smaller the angle between the vectors of two images, the likelier both show the same place."""
OptimiserFunction = Callable[[Bundle, Camera, int], tuple[npt.ArrayLike, npt.ArrayLike]]
"""A bundle adjustment: takes a bundle of a camera without depth, the camera's intrinsics and the number of
iterations; returns the adjusted ``(c, 4, 4)`` poses ``T_camera_world`` and ``(p, 3)`` points.  Poses of fixed
cameras must be returned as they are, which is not checked."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CheckedFeatures:
    """Features of one image of a user's extractor after all checks, highest score first.

    Attributes:
        pixels: ``(n, 2)``, column and row.
        scores: ``(n,)``.
        descriptors: ``(n, d)``, uint8 or int8.
        orientations: ``(n, 2)``, cosine and sine of the angle in the image.
        sizes: ``(n,)``, scale, 1 for the finest.
    """

    pixels: Array
    scores: Array
    descriptors: Descriptors
    orientations: Array
    sizes: Array


class FeaturesPlugin:
    """A user's feature extractor with its checks.

    ``name`` is the name of its features, in lower case.  ``kind``, ``is_oriented`` and ``is_scaled`` (the
    kind of its descriptors, and whether it measures orientations and sizes) are those of the first image with
    features, and every later image must have the same; before that image they are placeholders:
    ORB, False and False.
    """

    def __init__(self, function: FeaturesFunction) -> None:
        """Wrap a function; it is not called yet.

        Raises:
            UsageError: The object cannot be called, or has no name that features can have.
        """
        self._function = _check_callable("features", function)
        self.name = str(
            getattr(function, "name", None) or getattr(function, "__name__", type(function).__name__)
        ).lower()
        self.kind: DescriptorKind = ORB
        self.is_oriented = False
        self.is_scaled = False
        self._is_kind_known = False
        try:
            DescriptorKind(self.name, "uint8", ORB.size)
        except BadRequest as error:
            raise UsageError(error.message, hint="set the function's name: function.name = 'mine'") from error
        if self.name == ORB.name:
            raise UsageError("features named orb are the built-in ones", hint="give yours another name")

    def __call__(self, rgb: npt.NDArray[np.uint8]) -> CheckedFeatures:
        """Return all features of an ``(h, w, 3)`` uint8 image, highest score first.

        Raises:
            UsageError: The function failed, or the returned values cannot be features.
        """
        found = _call_user(f"features function {self.name}", self._function, rgb)
        return self._check(found, rgb.shape)

    def _check(self, found: Any, shape: tuple[int, ...]) -> CheckedFeatures:
        if not isinstance(found, FoundFeatures):
            raise self._refusal(f"returned {type(found).__name__}, not FoundFeatures")
        # 1. Check pixels, scores and descriptors.
        pixels = self._check_numbers("pixels", found.pixels, (-1, 2))
        n = len(pixels)
        if n > _MAX_FOUND_FEATURES:
            raise self._refusal(f"returned {n} features, above {_MAX_FOUND_FEATURES}")
        if not n:
            nothing = np.empty(0)
            return CheckedFeatures(
                pixels=np.empty((0, 2)),
                scores=nothing,
                descriptors=self.kind.empty(),
                orientations=np.empty((0, 2)),
                sizes=nothing,
            )
        scores = self._check_numbers("scores", found.scores, (n,))
        descriptors = self._check_descriptors(found.descriptors, n)
        # 2. Compare the kind of the features with that of the first image.
        has_fields = found.orientations_deg is not None, found.sizes is not None
        kind = DescriptorKind(self.name, str(descriptors.dtype), descriptors.shape[1])
        if self._is_kind_known and kind != self.kind:
            raise self._refusal(f"returned {kind} after {self.kind}")
        if self._is_kind_known and has_fields != (self.is_oriented, self.is_scaled):
            raise self._refusal("returned orientations_deg or sizes for some images only")
        self.kind, self._is_kind_known = kind, True
        self.is_oriented, self.is_scaled = has_fields
        # 3. Check orientations and sizes; missing ones become 0 degrees and 1.
        angles = np.zeros(n)
        if found.orientations_deg is not None:
            angles = np.radians(self._check_numbers("orientations_deg", found.orientations_deg, (n,)))
        sizes = np.ones(n) if found.sizes is None else self._check_numbers("sizes", found.sizes, (n,))
        if not (sizes > 0.0).all():
            raise self._refusal("returned sizes that are not above 0")
        # 4. Refuse pixels outside the image, and sort by score.
        is_inside = ((pixels >= -0.5) & (pixels <= np.array([shape[1], shape[0]]) - 0.5)).all(axis=1)
        if not is_inside.all():
            raise self._refusal(f"returned {int((~is_inside).sum())} pixels outside the image")
        best_first = np.argsort(-scores, kind="stable")
        return CheckedFeatures(
            pixels=pixels[best_first],
            scores=scores[best_first],
            descriptors=descriptors[best_first],
            orientations=np.stack([np.cos(angles), np.sin(angles)], axis=1)[best_first],
            sizes=sizes[best_first],
        )

    def _check_numbers(self, field: str, given: npt.ArrayLike, shape: tuple[int, ...]) -> Array:
        return _check_array(f"features function {self.name}", field, given, shape, _FEATURES_HINT)

    def _check_descriptors(self, given: npt.ArrayLike | None, n: int) -> Descriptors:
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
        scale = 127.0 * max(1.0, math.sqrt(array.shape[1]) / _CLIP_RMS)
        scaled: Descriptors = np.rint(np.clip(vectors / lengths[:, None] * scale, -127.0, 127.0))
        return scaled.astype(np.int8)

    def _refusal(self, why: str) -> UsageError:
        return UsageError(f"the features function {self.name} {why}", hint=_FEATURES_HINT)


class MotionPlugin:
    """A user's motion model with its checks, and the newest poses that it is given."""

    def __init__(self, function: MotionFunction) -> None:
        """Wrap a function; raises UsageError if it cannot be called."""
        self._function = _check_callable("motion", function)
        self._recent: deque[tuple[float, Array]] = deque(maxlen=_MOTION_HISTORY_POSES)

    def add(self, timestamp_s: float, T_world_camera: Array) -> None:
        """Add the pose of a tracked frame; only the ten newest poses are kept."""
        self._recent.append((timestamp_s, T_world_camera))

    def clear(self) -> None:
        """Forget all poses: tracking was lost, or the poses were moved to another world or adjusted."""
        self._recent.clear()

    def predict(self, timestamp_s: float) -> Array | None:
        """Predict ``T_world_camera`` ``(4, 4)`` of the frame at *timestamp_s*; None while no pose is known.

        Raises:
            UsageError: The function failed, or returned no rigid pose.
        """
        if not self._recent:
            return None
        stamps_s = np.array([stamp_s for stamp_s, _ in self._recent])
        poses = np.array([pose for _, pose in self._recent])
        returned = _call_user("motion function", self._function, stamps_s, poses, timestamp_s)
        T_world_camera = rigid(_check_array("motion function", "poses", returned, (4, 4)))
        if T_world_camera is None:
            raise UsageError(
                "the motion function returned a matrix that is no pose",
                hint="return T_world_camera: a rotation, a translation in metres, and 0 0 0 1",
            )
        return T_world_camera


class LoopsPlugin:
    """A user's place recogniser with its checks; all of its vectors must be as long as the first one."""

    def __init__(self, function: LoopsFunction) -> None:
        """Wrap a function; raises UsageError if it cannot be called."""
        self._function = _check_callable("loops", function)
        self._size = 0

    def __call__(self, rgb: npt.NDArray[np.uint8]) -> PlaceVector:
        """Compute the unit vector that describes the place of an ``(h, w, 3)`` image.

        Raises:
            UsageError: The function failed, or returned a vector of another length, of zeros, or of fewer
                than 8 or more than 4,096 numbers.
        """
        vector = _check_array(
            "loops function", "place vectors", _call_user("loops function", self._function, rgb), (-1,)
        )
        length = float(np.linalg.norm(vector))
        self._size = self._size or len(vector)
        is_fit = len(vector) == self._size and _MIN_PLACE_SIZE <= len(vector) <= _MAX_PLACE_SIZE
        if not (is_fit and length > 0.0):
            raise UsageError(
                f"the loops function returned a vector of {len(vector)} numbers with a norm of {length:g}",
                hint=f"return a vector of {_MIN_PLACE_SIZE} to {_MAX_PLACE_SIZE} numbers, always as many, "
                "not all 0",
            )
        return (vector / length).astype(np.float32)


class OptimiserPlugin:
    """A user's bundle adjustment with its checks; takes the place of `client_sdk.monocular.bundle.adjust`."""

    def __init__(self, function: OptimiserFunction) -> None:
        """Wrap a function that adjusts a bundle; raises UsageError if it cannot be called."""
        self._function = _check_callable("optimiser", function)

    def __call__(self, bundle: Bundle, camera: Camera, *, iterations: int = 8) -> tuple[Array, Array]:
        """Return adjusted poses ``T_camera_world`` ``(c, 4, 4)`` and points ``(p, 3)`` of a bundle.

        Whether they fit the pixels better than before is not checked.

        Raises:
            UsageError: The function failed, or returned poses or points of other shapes, or no rigid poses.
        """
        returned = _call_user("optimiser function", self._function, bundle, camera, iterations)
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise UsageError(
                f"the optimiser function returned {type(returned).__name__}, not poses and points",
                hint="return T_camera_world and points_world of the bundle, adjusted",
            )
        poses = _check_array("optimiser function", "poses", returned[0], bundle.T_camera_world.shape)
        points = _check_array("optimiser function", "points", returned[1], bundle.points_world.shape)
        rigid_poses = [rigid(pose) for pose in poses]
        if any(pose is None for pose in rigid_poses):
            raise UsageError(
                "the optimiser function returned a matrix that is no pose", hint="keep rotations orthonormal"
            )
        return np.array(rigid_poses).reshape(-1, 4, 4), points


def _check_callable(argument: str, function: Any) -> Any:
    if not callable(function):
        raise UsageError(f"{argument}= takes a function, not a {type(function).__name__}", hint=_PARTS_HINT)
    return function


def _call_user(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a user's function; turn its exception into a UsageError that names the line which raised it.

    KeyboardInterrupt passes as it is.
    """
    try:
        return function(*arguments)
    except (Exception, asyncio.CancelledError, SystemExit) as error:  # also those that end a task or a thread
        raise UsageError(
            f"the {name} failed: {type(error).__name__}: {_describe_error(error)}",
            hint="call the function without a mapper to find the cause, or see docs/own_parts.md",
        ) from error


def _check_array(
    function: str, values: str, given: Any, shape: tuple[int, ...], hint: str = _PARTS_HINT
) -> Array:
    """Return what a user's function gave as finite float64 numbers of *shape*, in which -1 is any length.

    Without numbers, *given* may have any shape if the first length of *shape* is -1.  *function* and *values*
    name the function and the values in the UsageError for anything else.
    """
    statement = f"the {function} returned {values}"
    try:
        array = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{statement} that are no numbers", hint=hint) from error
    if not array.size and shape[0] == -1:
        return np.empty((0, *shape[1:]))
    if not _has_shape(array, shape):
        wanted = f"{shape}".replace("-1", "n")
        raise UsageError(f"{statement} of shape {array.shape}, not {wanted}", hint=hint)
    if not np.isfinite(array).all():
        raise UsageError(f"{statement} that are not finite", hint=hint)
    return array


def _has_shape(array: Array, shape: tuple[int, ...]) -> bool:
    """Return whether an array has a shape, in which -1 stands for any length."""
    return array.ndim == len(shape) and all(
        wanted in (-1, length) for length, wanted in zip(array.shape, shape, strict=True)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plugins:
    """The parts of a tracker that a user replaces, and the IMU and the wheels whose motions the tracker uses.

    Attributes:
        features: Feature extractor; None for ORB.
        motion: Motion model; None for a constant velocity.
        loops: Place recogniser; None for the VLAD vector of the descriptors.
        optimiser: Bundle adjustment of a camera without depth; None for the built-in one.
        inertial: The IMU of the camera, which the mapper sets with the first samples; None without one.
        wheels: The wheel odometry of the robot; None without one.
    """

    features: FeaturesPlugin | None = None
    motion: MotionPlugin | None = None
    loops: LoopsPlugin | None = None
    optimiser: OptimiserPlugin | None = None
    inertial: ImuEstimator | None = None
    wheels: WheelOdometry | None = None

    @classmethod
    def wrap(
        cls,
        *,
        features: FeaturesFunction | None = None,
        motion: MotionFunction | None = None,
        loops: LoopsFunction | None = None,
        optimiser: OptimiserFunction | None = None,
    ) -> Plugins:
        """Return the plug-ins of a user's functions, None for the built-in parts.

        Raises:
            UsageError: An argument cannot be called, or the features have no name.
        """
        return cls(
            features=None if features is None else FeaturesPlugin(features),
            motion=None if motion is None else MotionPlugin(motion),
            loops=None if loops is None else LoopsPlugin(loops),
            optimiser=None if optimiser is None else OptimiserPlugin(optimiser),
        )

    def predict_pose(self, timestamp_s: float) -> Array | None:
        """Predict ``T_world_camera`` ``(4, 4)`` by the user's motion model.

        None without a motion model, and while it has been given no pose since the last `forget_poses`.

        Raises:
            UsageError: The user's function failed, or returned no rigid pose.
        """
        return None if self.motion is None else self.motion.predict(timestamp_s)

    def predict_motion(
        self, T_last_next: Array, last_s: float, next_s: float, *, is_metric: bool = True
    ) -> Array:
        """Replace a predicted motion by that of the wheels, and its rotation by the gyroscope's, if known.

        *T_last_next* may be changed in place; the prediction is returned.

        Args:
            T_last_next: ``(4, 4)``, predicted pose of the next camera in the frame of the last one.
            last_s: Time of the last pose, in seconds.
            next_s: Time of the next frame, in seconds.
            is_metric: Whether lengths are metres; the wheels are not used otherwise.
        """
        wheel_motion = self.wheel_motion(last_s, next_s) if is_metric else None
        if wheel_motion is not None:
            T_last_next = wheel_motion.T_camera_begin_end
        R_last_next = None if self.inertial is None else self.inertial.camera_rotation(last_s, next_s)
        if R_last_next is not None:
            T_last_next[:3, :3] = R_last_next
        return T_last_next

    def wheel_motion(self, begin_s: float, end_s: float) -> WheelMotion | None:
        """Return the motion by the wheels between two times, in seconds; None if they do not tell it."""
        return None if self.wheels is None else self.wheels.motion(begin_s, end_s)

    def on_plane(self, T_world_camera: Array) -> Array:
        """Return the pose ``(4, 4)`` with the base of a planar robot in its plane; others are unchanged."""
        return T_world_camera if self.wheels is None else self.wheels.on_plane(T_world_camera)

    def add_pose(self, timestamp_s: float, T_world_camera: Array) -> None:
        """Store the pose of a tracked frame, from which the user's motion model predicts later poses."""
        if self.motion is not None:
            self.motion.add(timestamp_s, T_world_camera)

    def forget_poses(self) -> None:
        """Drop the poses that the user's motion model would be given, because they fit later ones no longer.

        Tracking was lost, or the poses were moved to another world or adjusted.  The model predicts again
        after the next `add_pose`.
        """
        if self.motion is not None:
            self.motion.clear()


def load_features(name: str | None) -> FeaturesFunction | None:
    """Load the feature extractor that ``module:function`` names, without calling it; None for None.

    Raises:
        UsageError: There is no such function, or it has no name that features can have.
    """
    if name is None:
        return None
    function: FeaturesFunction = load_function(name)
    FeaturesPlugin(function)
    return function


_FUNCTION_NAME = re.compile(r"([A-Za-z_][\w.]*):([A-Za-z_]\w*)")


def load_function(name: str) -> Any:
    """Import and return the object that ``module:function`` names; whether it can be called is not checked.

    The working directory is put first on ``sys.path``, where it stays.

    Raises:
        UsageError: The name is malformed, its module cannot be imported, or has no such attribute.
    """
    parts = _FUNCTION_NAME.fullmatch(name)
    if parts is None:
        raise UsageError(f"{name!r} names no function", hint="write module:function, such as sift:sift")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        module = importlib.import_module(parts[1])
    except Exception as error:
        raise UsageError(
            f"{name} cannot be loaded: {type(error).__name__}: {_describe_error(error)}",
            hint=f"is {parts[1].replace('.', '/')}.py in this folder, or installed?",
        ) from error
    if not hasattr(module, parts[2]):
        functions = [
            word for word, value in vars(module).items() if callable(value) and not word.startswith("_")
        ]
        raise UsageError(
            f"{parts[1]} has no function {parts[2]}",
            hint=f"it has {', '.join(sorted(functions)[:8]) or 'none'}",
        )
    return getattr(module, parts[2])


def _describe_error(error: BaseException) -> str:
    """Return an error's message in one line of at most 200 characters, then the file and line that raised it.

    File and line are the last ones of the traceback that are not in this module or in the import system.
    """
    own_files = (__file__, importlib.__file__)
    trace = traceback.extract_tb(error.__traceback__)
    frames = [f for f in trace if f.filename not in own_files and not f.filename.startswith("<")]
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return " ".join(str(error).split())[:200] + where
