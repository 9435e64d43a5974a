"""What is said by HTTP about photos and maps: a lens, where a photo was taken, and a map seen from above."""

from __future__ import annotations

from typing import Literal

import msgspec

from rse_pf.errors import BadRequest

__all__ = ["Lens", "MapOutline", "PhotoLocation"]

_MAX_DISTORTION = 1e3


class Lens(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Intrinsics of a photo, px, for an image of *width* by *height*; 0 is the photo's own size.

    *distortion* has 0, 4 or 5 numbers in OpenCV's order, and of a fisheye 0 or 4.

    Raises:
        BadRequest: Numbers are too many or too large, or only one of width and height is given.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 0
    height: int = 0
    distortion: tuple[float, ...] = ()
    model: Literal["radial-tangential", "fisheye"] = "radial-tangential"

    def __post_init__(self) -> None:
        counts = (0, 4) if self.model == "fisheye" else (0, 4, 5)
        if len(self.distortion) not in counts or not all(
            abs(each) <= _MAX_DISTORTION for each in self.distortion
        ):
            raise BadRequest(
                f"{len(self.distortion)} distortion numbers, or one that is not within {_MAX_DISTORTION:g}",
                hint="send k1,k2,p1,p2,k3, or k1,k2,k3,k4 of a fisheye",
            )
        if (self.width > 0) != (self.height > 0) or min(self.width, self.height) < 0:
            raise BadRequest(
                f"intrinsics of an image of {self.width}x{self.height} px",
                hint="send width and height, or neither of them",
            )


class PhotoLocation(msgspec.Struct, frozen=True, kw_only=True):
    """Where a photo was taken in version *version* of a map.

    ``verdict`` is ok; weak, with a *reason*; or lost, with a reason and without a pose.  ``T_map_camera`` is
    4x4, metres, and ``covariance`` 6x6 that of the twist (metres, radians) on the left of it.  From it come
    *position_sigma_m* and *turn_sigma_deg*, the standard deviations of the camera's place and direction in
    space.  *inliers* and
    *rmse_px* are those of the best keyframe; *keyframes* are the ids of those that agree, best first.
    """

    version: str
    verdict: str
    reason: str = ""
    T_map_camera: list[list[float]] | None = None
    covariance: list[list[float]] | None = None
    position_sigma_m: float | None = None
    turn_sigma_deg: float | None = None
    inliers: int = 0
    rmse_px: float = 0.0
    keyframes: list[int] = []


class MapOutline(msgspec.Struct, frozen=True, kw_only=True):
    """Version *version* of a map from above: places of its keyframes and of some of its points, metres.

    A position of the map is at ``top_view`` (2x3) times the position.
    """

    version: str
    top_view: list[list[float]]
    keyframes: list[list[float]]
    points: list[list[float]]
