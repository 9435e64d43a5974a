"""Calibrate a camera from images of a calibration board, and refuse a calibration that is too uncertain.

Devices are opened, and images read, by `client_sdk.cameras.open_camera`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from client_sdk.cameras.board import Board, find_corners
from client_sdk.frontend import load_opencv
from client_sdk.rigs.intrinsics import Intrinsics
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.geometry import Array, Camera

__all__ = ["BoardViews", "calibrate"]

MIN_VIEWS = 8  # a calibration of one camera or of a stereo pair with fewer views of the board is refused
_MAX_FOCAL_DEVIATION_PERCENT = 2.0
"""Largest standard deviation of the focal length, in percent of it, of a calibration that is not refused:
with a larger one the views are too similar."""
_MIN_TILT_DEG = 20.0
"""A calibration is refused if the normals of the board in no two of its views differ by this angle: then
focal length and distance of the board cannot be separated, and even a small standard deviation of the focal
length proves nothing."""
_MIN_MOTION_SHARE = 0.05
"""An image is a new view only if, compared with each earlier view, some corner has moved by this fraction of
the image width; otherwise it is counted as similar and not used."""
_MAX_VIEW_ERROR_FACTOR = 2.5
"""A view is left out if its reprojection error is above this many times the median of all views, and also
above `_MAX_GOOD_VIEW_ERROR_PX`."""
_MAX_GOOD_VIEW_ERROR_PX = 0.1  # a view with at most this reprojection error is never left out


@dataclass(slots=True, eq=False)
class BoardViews:
    """The views of one board by one camera, collected image by image.

    Attributes:
        board: The calibration board.
        size: Width and height of the images, px; None before the first image.
        images: Number of images that were searched for the board.
        similar: Number of images that show the board, but nearly as an earlier view does.
        views: For each view, the pixels ``(corners, 2)`` of the corners in `Board.points`.
    """

    board: Board
    size: tuple[int, int] | None = None
    images: int = 0
    similar: int = 0
    views: list[Array] = field(default_factory=list)

    def add(self, gray: npt.NDArray[np.uint8]) -> bool:
        """Find the board in a grey image ``(h, w)``, and return whether the image is a new view of the board.

        A new view is added to *views*; an image without the board, or too similar to an earlier view, is only
        counted.

        Raises:
            UsageError: The image has another size than the images before.
        """
        size = (int(gray.shape[1]), int(gray.shape[0]))
        if self.size not in (None, size):
            assert self.size is not None
            raise UsageError(
                f"an image is {size[0]}x{size[1]} px, those before are {self.size[0]}x{self.size[1]} px",
                hint="calibrate with images of one size, which is the size that the robot will use",
            )
        self.size = size
        self.images += 1
        corners = find_corners(gray, self.board)
        if corners is None:
            return False
        min_motion_px = _MIN_MOTION_SHARE * size[0]
        if any(np.linalg.norm(corners - view, axis=1).max() < min_motion_px for view in self.views):
            self.similar += 1
            return False
        self.views.append(corners)
        return True


def calibrate(views: BoardViews, *, max_rms_px: float = 1.0, depth_scale: float | None = None) -> Intrinsics:
    """Return the radial-tangential intrinsics that explain the views of a board best.

    Views with a far larger error than the others are left out, unless fewer than 8 views would remain;
    ``rms_px`` and ``views`` of the result are the error and the number of the views that were used.

    Args:
        views: The views of the board, which do not change.
        max_rms_px: Largest root mean square reprojection error, px, of a calibration that is accepted.
        depth_scale: Units of the camera's depth images per metre, which is copied into the result.

    Raises:
        CommandFailed: There are too few views, they are too similar, or the error is above *max_rms_px*.
        MissingExtra: OpenCV is not installed.

    Source:
        Zhang, PAMI 2000, as OpenCV implements it.
    """
    board = views.board
    if len(views.views) < MIN_VIEWS:
        similar = f", and {views.similar} that are too similar to these" if views.similar else ""
        raise CommandFailed(
            f"{len(views.views)} usable views of the board in {views.images} images{similar}; "
            f"a calibration needs {MIN_VIEWS}",
            hint=f"show the {board.columns}x{board.rows} corners, sharp, from many sides; check --board",
        )
    # 1. Calibrate with all views.
    cv2 = load_opencv()
    points = [board.points for _ in views.views]
    pixels = [corners.astype(np.float32) for corners in views.views]
    rms_px, K, distortion, rotations, _, deviations, _, view_errors_px = cv2.calibrateCameraExtended(
        points, pixels, views.size, None, None
    )
    # 2. If enough views remain, calibrate again without those whose error is far larger than that of the
    #    others, such as blurred ones.
    max_error_px = max(_MAX_VIEW_ERROR_FACTOR * float(np.median(view_errors_px)), _MAX_GOOD_VIEW_ERROR_PX)
    good_rows = np.flatnonzero(view_errors_px.ravel() <= max_error_px)
    if MIN_VIEWS <= len(good_rows) < len(points):
        points, pixels = [points[row] for row in good_rows], [pixels[row] for row in good_rows]
        rms_px, K, distortion, rotations, _, deviations, _, _ = cv2.calibrateCameraExtended(
            points, pixels, views.size, None, None
        )
    # 3. Refuse a calibration that does not fit, or is not determined by these views.
    if not rms_px <= max_rms_px:
        raise CommandFailed(
            f"the reprojection error is {rms_px:.2f} px, above {max_rms_px:g} px",
            hint="keep board and camera still in each view, and the board flat; check --board",
        )
    focal_deviation_percent = 100 * float(max(deviations.ravel()[:2]) / K[0, 0])
    normals = np.array([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    tilt_deg = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))))
    if not focal_deviation_percent <= _MAX_FOCAL_DEVIATION_PERCENT or tilt_deg < _MIN_TILT_DEG:
        raise CommandFailed(
            f"the views are too similar: the board is tilted by {tilt_deg:.0f} deg in all, and the focal "
            f"length is uncertain by {focal_deviation_percent:.1f} %",
            hint="tilt the board by 20 to 45 degrees to all sides, and show it near the corners of the image",
        )
    assert views.size is not None
    camera = Camera(
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        width=views.size[0],
        height=views.size[1],
    )
    return Intrinsics(
        camera=camera,
        distortion=tuple(float(value) for value in distortion.ravel()[:5]),
        depth_scale=depth_scale,
        rms_px=float(rms_px),
        views=len(points),
    )
