"""What clients and the data server exchange about photos and maps by HTTP.

A photo is localised in a map: the request states the lens, the reply the pose of the camera.  An outline
shows a map from above.
"""

from __future__ import annotations

import msgspec

from rse_pf.errors import BadRequest, InvalidCamera

__all__ = ["MapOutline", "PhotoLens", "PhotoLocation"]


class PhotoLens(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The camera and lens that took a photo, as the query of a request states them.

    ``fx``, ``fy``, ``cx`` and ``cy`` are in pixels of an image of ``width`` by ``height`` pixels.  If
    ``width`` and ``height`` are 0, they are in pixels of the photo.  ``model`` is a name of
    `rse_pf.geometry.LENS_MODELS`.  ``distortion`` holds the coefficients of this model in OpenCV's order; it
    is empty for a lens without distortion.

    Raises:
        BadRequest: The model is not known, the coefficients do not fit the model, or only one of width and
            height is given.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 0
    height: int = 0
    distortion: tuple[float, ...] = ()
    model: str = "radial-tangential"

    def __post_init__(self) -> None:
        # Imported with the first photo: numpy would take a third of the start of a data server.
        from rse_pf.geometry import LENS_MODELS

        model = LENS_MODELS.get(self.model)
        if model is None:
            raise BadRequest(
                f"no lens model {self.model!r}", hint=f"send model={' or model='.join(LENS_MODELS)}"
            )
        try:
            model.check_stated_coefficients(self.distortion)
        except InvalidCamera as error:
            raise BadRequest(error.message, hint=error.hint) from error
        if (self.width > 0) != (self.height > 0) or min(self.width, self.height) < 0:
            raise BadRequest(
                f"the intrinsics are for an image of {self.width}x{self.height} px",
                hint="send width and height above 0, or neither of them",
            )


class PhotoLocation(msgspec.Struct, frozen=True, kw_only=True):
    """Where a photo was taken, in the frame of version ``version`` of a map.

    ``verdict`` is ``ok``, ``weak`` with a ``reason``, or ``lost``, which has a reason and no pose
    (`rse_pf.slam.localise` calls this verdict ``none``).
    ``T_map_camera`` is the 4x4 pose of the camera, metres.  ``covariance`` is the 6x6 covariance of the twist
    (metres, then radians) that perturbs the pose on its left.  ``position_sigma_m`` and ``turn_sigma_deg``
    are standard deviations of the position and of the orientation of the camera: the root of the summed
    variances of the three axes.  ``inliers`` and ``rmse_px`` belong to the best keyframe.  ``keyframes`` are
    the ids of the keyframes that agree on the pose, best first.
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
    """Version ``version`` of a map, seen from above, metres.

    ``top_view`` is the 2x3 matrix that projects a position of the map into the plane seen from above.
    ``keyframes`` and ``points`` hold 2D positions of keyframes and of points of the cloud: of all of them, or
    of an even selection where there are more than `rse_pf.services.mapping.photo` draws.
    """

    version: str
    top_view: list[list[float]]
    keyframes: list[list[float]]
    points: list[list[float]]
