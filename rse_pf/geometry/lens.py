"""The lens model: a camera with the distortion of its lens, and the table of all models.

This module alone calls the distortion functions of OpenCV, and alone knows which of them belong to a model.
All other code holds a `Lens` and asks it.  To add a camera model, add an entry to `_MODELS`.  OpenCV is
imported when a function needs it, so that a robot without OpenCV can still hold a `Lens`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rse_pf.errors import InvalidCamera
from rse_pf.geometry.camera import Camera
from rse_pf.geometry.transforms import Array
from rse_pf.images import load_opencv

__all__ = ["LENS_MODELS", "Lens", "LensModel", "find_lens_model", "rectify_stereo_pair"]

MAX_STATED_COEFFICIENT = 1e3
"""Largest absolute value of a distortion coefficient in a file or a request.

The coefficients of real lenses are far below.  A larger number is refused: it is probably another intrinsic,
such as a focal length, at the position of a coefficient.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class LensModel:
    """A lens model: its names, its coefficients, and where OpenCV computes with them.

    ``K`` is a ``(3, 3)`` camera matrix in pixels, and ``coefficients`` ``(m,)`` are in OpenCV's order.

    Attributes:
        name: Identifier of the model in files and requests of this platform.
        aliases: Names that ROS, Kalibr, EuRoC, COLMAP, ORB-SLAM3 and nerfstudio give to the same model, in
            lower case with ``_`` for spaces.
        coefficient_names: Coefficients that files and requests can state, in OpenCV's order.
        coefficient_counts: Numbers of coefficients that OpenCV's functions for this model take.  A `Lens` may
            also have none, in which case OpenCV receives four zeros.
        is_perspective: Whether the model without coefficients is a pinhole camera.
        plausible_field_of_view_deg: Smallest and largest field of view that is accepted for such a lens; 0
            and infinity are no limits.
        field_of_view_rad: Maps the quotient of an image side and the focal length, both in pixels, to the
            field of view along this side in radians, without distortion.
        part_of_opencv: Maps the module ``cv2`` to the module with the functions of this model.
        distort_points: ``(cv2, rays (n, 2), K, coefficients)`` to ``(n, 1, 2)``: the distorted pixels of
            points ``(x, y, 1)`` of the camera frame.
        rectification_margin: Name of the option of OpenCV's ``stereoRectify`` that is set to 0, so that the
            rectified images hold only pixels that their camera sees.
    """

    name: str
    aliases: frozenset[str]
    coefficient_names: tuple[str, ...]
    coefficient_counts: tuple[int, ...]
    is_perspective: bool
    plausible_field_of_view_deg: tuple[float, float]
    field_of_view_rad: Callable[[float], float]
    part_of_opencv: Callable[[Any], Any]
    distort_points: Callable[..., Array]
    rectification_margin: str

    def check_coefficients(self, coefficients: tuple[float, ...]) -> None:
        """Refuse coefficients that OpenCV's functions do not take.

        Raises:
            InvalidCamera: Their number is not one of ``coefficient_counts`` or 0, or one is not finite.
        """
        counts = (0, *self.coefficient_counts)
        if len(coefficients) not in counts or not all(map(math.isfinite, coefficients)):
            raise InvalidCamera(
                f"{len(coefficients)} distortion numbers do not fit the lens model {self.name}, which takes "
                f"{', '.join(map(str, counts))} finite numbers",
                hint=f"give {' '.join(self.coefficient_names)}",
            )

    def check_stated_coefficients(self, coefficients: tuple[float, ...]) -> None:
        """Refuse coefficients that a file or a request may not state, although OpenCV would take them.

        Raises:
            InvalidCamera: There are more coefficients than ``coefficient_names``, the absolute value of one
                is above `MAX_STATED_COEFFICIENT`, or `check_coefficients` refuses them.
        """
        self.check_coefficients(coefficients)
        largest = max(map(abs, coefficients), default=0.0)
        if len(coefficients) > len(self.coefficient_names) or largest > MAX_STATED_COEFFICIENT:
            raise InvalidCamera(
                f"{len(coefficients)} distortion numbers, of which the largest is {largest:g}, are given; "
                f"the lens model {self.name} has up to {len(self.coefficient_names)} numbers, each of up to "
                f"{MAX_STATED_COEFFICIENT:g}",
                hint=f"give {' '.join(self.coefficient_names)}",
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """A camera, the model of its lens, and the distortion coefficients in OpenCV's order.

    ``model`` is a name of `LENS_MODELS`: ``radial-tangential`` with k1 k2 p1 p2 [k3 ...], or ``fisheye`` with
    k1 k2 k3 k4.  Without coefficients, a radial-tangential lens is a pinhole, and a fisheye has the exact
    equidistant projection.

    Raises:
        InvalidCamera: The model is not known, or the coefficients do not fit the model.
    """

    camera: Camera
    distortion: tuple[float, ...] = ()
    model: str = "radial-tangential"

    def __post_init__(self) -> None:
        if self.model not in LENS_MODELS:
            raise InvalidCamera(
                f"no lens model {self.model!r}", hint=f"write one of {', '.join(LENS_MODELS)}"
            )
        LENS_MODELS[self.model].check_coefficients(self.distortion)

    @property
    def is_pinhole(self) -> bool:
        """Whether images of this lens have no distortion, so that nothing needs to be undistorted."""
        return LENS_MODELS[self.model].is_perspective and not any(self.distortion)

    @property
    def field_of_view_deg(self) -> float:
        """The larger one of the horizontal and the vertical field of view, without distortion, degrees."""
        camera = self.camera
        side_per_focal_length = max(camera.width / camera.fx, camera.height / camera.fy)
        return math.degrees(LENS_MODELS[self.model].field_of_view_rad(side_per_focal_length))

    @property
    def plausible_field_of_view_deg(self) -> tuple[float, float]:
        """The smallest and the largest field of view that is accepted for a lens of this model, degrees.

        A source with another one is refused, because its focal length is probably wrong.  A fisheye lens has
        no limits: 0 and infinity.
        """
        return LENS_MODELS[self.model].plausible_field_of_view_deg

    @property
    def coefficients(self) -> Array:
        """The distortion coefficients ``(m,)`` in OpenCV's order; four zeros if the lens states none."""
        return np.array(self.distortion or (0.0, 0.0, 0.0, 0.0))

    def undistort_pixels(self, pixels: Array) -> Array:
        """Return ``(n, 2)`` distorted pixels as pixels of the pinhole camera with the same intrinsics.

        The distortion is inverted iteratively.  Far from the centre of the image this may not converge, and
        no error is raised.  A caller that needs to know applies `distort_pixels` to the result, and compares
        it with *pixels*.

        Raises:
            MissingExtra: OpenCV is not installed.
        """
        return self._undistort(pixels, self.camera.matrix)

    def distort_pixels(self, pixels: Array) -> Array:
        """Return ``(n, 2)`` pixels of the pinhole camera with the same intrinsics as distorted pixels.

        Raises:
            MissingExtra: OpenCV is not installed.
        """
        camera = self.camera
        rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        return (
            LENS_MODELS[self.model]
            .distort_points(load_opencv(), rays, camera.matrix, self.coefficients)
            .reshape(-1, 2)
        )

    def unit_rays(self, pixels: Array) -> Array:
        """Return the ``(n, 3)`` directions, of length 1 in the camera frame, of ``(n, 2)`` distorted pixels.

        Raises:
            MissingExtra: OpenCV is not installed.
        """
        points = self._undistort(pixels, None)
        rays = np.column_stack((points, np.ones(len(points))))
        directions: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return directions

    def undistortion_maps(self, camera: Camera, rotation: Array | None = None) -> tuple[Any, Any]:
        """Return the two maps with which ``cv2.remap`` converts images of this lens to images of *camera*.

        Each map is float32 with the shape ``(height, width)`` of the new image, and holds for each of its
        pixels the x coordinate (first map) or the y coordinate (second map) in the distorted image.

        Args:
            camera: The pinhole camera of the new images.
            rotation: ``(3, 3)``, maps directions in the frame of this lens's camera to the frame of *camera*;
                None for the identity.

        Raises:
            MissingExtra: OpenCV is not installed.
        """
        cv2 = load_opencv()
        maps: tuple[Any, Any] = (
            LENS_MODELS[self.model]
            .part_of_opencv(cv2)
            .initUndistortRectifyMap(
                self.camera.matrix,
                self.coefficients,
                np.eye(3) if rotation is None else rotation,
                camera.matrix,
                (camera.width, camera.height),
                cv2.CV_32FC1,
            )
        )
        return maps

    def _undistort(self, pixels: Array, K_new: Array | None) -> Array:
        """Return ``(n, 2)`` distorted pixels as pixels of a pinhole camera with the camera matrix *K_new*.

        With None the result are coordinates on the plane z = 1 of the camera frame.
        """
        contiguous = np.ascontiguousarray(pixels).reshape(-1, 1, 2)
        points: Array = (
            LENS_MODELS[self.model]
            .part_of_opencv(load_opencv())
            .undistortPoints(contiguous, self.camera.matrix, self.coefficients, None, None, K_new)
            .reshape(-1, 2)
        )
        return points


def find_lens_model(name: str) -> LensModel | None:
    """Return the model with this name or alias, in any case, with spaces or ``_``; None if there is none."""
    name = name.lower().replace(" ", "_")
    return next((model for model in LENS_MODELS.values() if name in {model.name, *model.aliases}), None)


def rectify_stereo_pair(
    left: Lens, right: Lens, T_right_left: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the rotations and projections that rectify a stereo pair of two lenses of one model and size.

    The model and the size of *left* are taken for both; whether *right* has the same is not checked.

    Args:
        left: The left lens.
        right: The right lens.
        T_right_left: ``(4, 4)``, metres, maps points of the left camera's frame into the right one's.

    Returns:
        The ``(3, 3)`` rotations from the left and the right camera to the rectified ones, and the ``(3, 4)``
        projections of both rectified cameras, in pixels; ``P[0, 3]`` of the right one is minus fx (pixels)
        times the baseline (metres).

    Raises:
        MissingExtra: OpenCV is not installed.

    Source:
        Bouguet's method, as ``cv2.stereoRectify`` and ``cv2.fisheye.stereoRectify`` implement it.
    """
    cv2, model = load_opencv(), LENS_MODELS[left.model]
    R1, R2, P1, P2, *_ = model.part_of_opencv(cv2).stereoRectify(
        left.camera.matrix,
        left.coefficients,
        right.camera.matrix,
        right.coefficients,
        (left.camera.width, left.camera.height),
        T_right_left[:3, :3],
        T_right_left[:3, 3],
        flags=cv2.CALIB_ZERO_DISPARITY,
        **{model.rectification_margin: 0.0},
    )
    return (R1, R2), (P1, P2)


def _distort_radial_tangential(cv2: Any, rays: Array, K: Array, coefficients: Array) -> Any:
    points = np.column_stack([rays, np.ones(len(rays))])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, coefficients)[0]


def _distort_fisheye(cv2: Any, rays: Array, K: Array, coefficients: Array) -> Any:
    return cv2.fisheye.distortPoints(rays.reshape(-1, 1, 2), K, coefficients)


# All lens models: radial-tangential (Brown 1966), and equidistant fisheye (Kannala and Brandt 2006).
_MODELS = (
    LensModel(
        name="radial-tangential",
        aliases=frozenset(
            (
                "radtan",
                "plumb_bob",
                "brown_conrady",
                "opencv",
                "rational_polynomial",
                "rational_polynomial_thin_prism",
            )
        ),
        coefficient_names=("k1", "k2", "p1", "p2", "k3"),
        coefficient_counts=(4, 5, 8, 12, 14),
        is_perspective=True,
        # A field of view below 20 degrees results from a wrong unit of fx, or from a lens too long for SLAM.
        # No lens that this model describes has a field of view above 140 degrees.
        plausible_field_of_view_deg=(20.0, 140.0),
        field_of_view_rad=lambda side_per_focal_length: 2.0 * math.atan(side_per_focal_length / 2.0),
        part_of_opencv=lambda cv2: cv2,
        distort_points=_distort_radial_tangential,
        rectification_margin="alpha",
    ),
    LensModel(
        name="fisheye",
        aliases=frozenset(("equidistant", "kannala_brandt4", "kannalabrandt8", "opencv_fisheye")),
        coefficient_names=("k1", "k2", "k3", "k4"),
        coefficient_counts=(4,),
        is_perspective=False,
        # No limits: an image may show a small crop of the image circle of a fisheye lens, or all of it.
        plausible_field_of_view_deg=(0.0, math.inf),
        field_of_view_rad=lambda side_per_focal_length: side_per_focal_length,
        part_of_opencv=lambda cv2: cv2.fisheye,
        distort_points=_distort_fisheye,
        rectification_margin="balance",
    ),
)

LENS_MODELS: Mapping[str, LensModel] = {model.name: model for model in _MODELS}
"""All lens models, by their attribute ``name`` (not by their aliases)."""
