"""Calibrate a camera from images of a board: intrinsics, distortion, and how good they are.

It judges the result and refuses one that a robot should not use; it opens no camera.
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

_MIN_VIEWS = 8
_MAX_FOCAL_PERCENT = 2.0
"""Largest standard deviation of the focal length: above it the views are too alike."""
_MIN_TILT_DEG = 20.0
"""Smallest angle that must lie between the boards of two views."""
_NEW_VIEW_SHARE = 0.05
"""A view is new if its corners moved by more than this share of the image's width."""


@dataclass(slots=True, eq=False)
class BoardViews:
    """Views of one board by one camera, collected image by image."""

    board: Board
    size: tuple[int, int] | None = None
    images: int = 0
    alike: int = 0
    found: list[tuple[npt.NDArray[np.int64], Array]] = field(default_factory=list)

    def add(self, gray: npt.NDArray[np.uint8]) -> bool:
        """Look for the board in a grey image; return whether this is a new view of it.

        Raises:
            UsageError: The image has another size than those before.
        """
        size = (int(gray.shape[1]), int(gray.shape[0]))
        if self.size not in (None, size):
            assert self.size is not None
            raise UsageError(
                f"an image is {size[0]}x{size[1]} px, those before are {self.size[0]}x{self.size[1]} px",
                hint="calibrate with images of one size: that which the robot will use",
            )
        self.size = size
        self.images += 1
        corners = find_corners(gray, self.board)
        if corners is None:
            return False
        if any(self._is_alike(corners, other) for other in self.found):
            self.alike += 1
            return False
        self.found.append(corners)
        return True

    def _is_alike(
        self, one: tuple[npt.NDArray[np.int64], Array], other: tuple[npt.NDArray[np.int64], Array]
    ) -> bool:
        _, rows, other_rows = np.intersect1d(one[0], other[0], return_indices=True)
        assert self.size is not None
        if not len(rows):
            return False
        moved = np.linalg.norm(one[1][rows] - other[1][other_rows], axis=1).max()
        return bool(moved < _NEW_VIEW_SHARE * self.size[0])


def calibrate(views: BoardViews, *, max_rms_px: float = 1.0, depth_scale: float | None = None) -> Intrinsics:
    """Return the intrinsics that explain all views best.

    Raises:
        CommandFailed: There are too few views, they are too alike, or the error is above *max_rms_px*.
        MissingExtra: OpenCV is not installed.

    Source:
        Zhang, PAMI 2000, as OpenCV implements it.
    """
    board = views.board
    if len(views.found) < _MIN_VIEWS:
        alike = f", {views.alike} of them too like others" if views.alike else ""
        raise CommandFailed(
            f"{len(views.found)} usable views of the board in {views.images} images{alike}; "
            f"a calibration needs {_MIN_VIEWS}",
            hint=f"show the {board.columns}x{board.rows} corners, sharp, from many sides; check --board",
        )
    cv2 = load_opencv()
    points = [board.points[numbers] for numbers, _ in views.found]
    pixels = [corners.astype(np.float32) for _, corners in views.found]
    rms_px, K, distortion, turns, _, deviations, _, each_px = cv2.calibrateCameraExtended(
        points, pixels, views.size, None, None
    )
    # Views that were blurred or half found are far worse than the others: leave them out once.
    good_rows = np.flatnonzero(each_px.ravel() <= max(2.5 * float(np.median(each_px)), 0.1))
    if _MIN_VIEWS <= len(good_rows) < len(points):
        points, pixels = [points[row] for row in good_rows], [pixels[row] for row in good_rows]
        rms_px, K, distortion, turns, _, deviations, _, _ = cv2.calibrateCameraExtended(
            points, pixels, views.size, None, None
        )
    if not rms_px <= max_rms_px:
        raise CommandFailed(
            f"the reprojection error is {rms_px:.2f} px, above {max_rms_px:g} px",
            hint="keep board and camera still in each view, and the board flat; check --board",
        )
    uncertain_percent = 100 * float(max(deviations.ravel()[:2]) / K[0, 0])
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    tilt_deg = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))))
    # Without a tilt the focal length follows the distance, and its deviation says nothing.
    if not uncertain_percent <= _MAX_FOCAL_PERCENT or tilt_deg < _MIN_TILT_DEG:
        raise CommandFailed(
            f"the views are too alike: the board is tilted by {tilt_deg:.0f} deg in all, and the focal "
            f"length is uncertain by {uncertain_percent:.1f} %",
            hint="tilt the board by 20 to 45 degrees to all sides, and show it near the corners of the image",
        )
    assert views.size is not None
    camera = Camera(
        fx=float(K[0, 0]), fy=float(K[1, 1]), cx=float(K[0, 2]), cy=float(K[1, 2]),
        width=views.size[0], height=views.size[1],
    )  # fmt: skip
    return Intrinsics(
        camera=camera,
        distortion=tuple(float(value) for value in distortion.ravel()[:5]),
        depth_scale=depth_scale,
        rms_px=float(rms_px),
        views=len(points),
    )
