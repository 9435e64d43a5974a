"""Calibrate a stereo pair from images of a calibration board that both cameras see.

The intrinsics of each camera are calibrated first.  They do not change when the pose between both cameras is
estimated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from client_sdk.cameras.board import Board
from client_sdk.cameras.calibration import MIN_VIEWS, BoardViews, calibrate
from client_sdk.frontend import load_opencv
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig, RigCamera
from rse_pf.errors import CommandFailed
from rse_pf.geometry import inverse

__all__ = ["PairViews", "StereoCalibration", "calibrate_pair"]


@dataclass(frozen=True, slots=True, eq=False)
class StereoCalibration:
    """A calibrated stereo rig, and the error of the calibration.

    Attributes:
        rig: The rig; the frame of its body is that of the left camera.
        baseline_m: Distance between both cameras, metres.
        rms_px: Root mean square reprojection error over both images, px.
        views: Number of pairs of views that were used.
    """

    rig: Rig
    baseline_m: float
    rms_px: float
    views: int


@dataclass(slots=True, eq=False)
class PairViews:
    """The views of one board by both cameras, collected pair by pair.

    Attributes:
        board: The calibration board.
        left: Views of the left camera.
        right: Views of the right camera.
        pairs: Indices of the views of the left and the right camera that were taken together.
    """

    board: Board
    left: BoardViews = field(init=False)
    right: BoardViews = field(init=False)
    pairs: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.left, self.right = BoardViews(self.board), BoardViews(self.board)

    def add(self, left: npt.NDArray[np.uint8], right: npt.NDArray[np.uint8]) -> bool:
        """Find the board in two grey images ``(h, w)``, and return whether both are new views of the board.

        If both are, they become a pair.  If only one is, it is used for the intrinsics of its camera, but not
        for the pose between the cameras.

        Raises:
            UsageError: An image has another size than the images of this camera before.
        """
        are_new = self.left.add(left), self.right.add(right)
        if all(are_new):
            self.pairs.append((len(self.left.views) - 1, len(self.right.views) - 1))
        return all(are_new)


def calibrate_pair(views: PairViews, *, max_rms_px: float = 1.0) -> StereoCalibration:
    """Return the stereo rig that explains the views of a board best.

    Args:
        views: The views of the board by both cameras.
        max_rms_px: Largest root mean square reprojection error, px, of a calibration that is accepted, for
            each camera and for the pair.

    Raises:
        CommandFailed: One camera cannot be calibrated, both see the board in too few views, or the error is
            above *max_rms_px*.
        UsageError: The cameras differ in image size, or the right camera is not right of the left one.
        MissingExtra: OpenCV is not installed.

    Source:
        Zhang, PAMI 2000, and Bouguet, as OpenCV's ``stereoCalibrate`` implements it.
    """
    # 1. Calibrate the intrinsics of each camera.
    lenses = []
    for side, views_of_side in (("left", views.left), ("right", views.right)):
        try:
            lenses.append(calibrate(views_of_side, max_rms_px=max_rms_px))
        except CommandFailed as error:
            raise CommandFailed(f"the {side} camera: {error.message}", hint=error.hint) from error
    # 2. Take the pairs of views that show the board to both cameras.
    points = [views.board.points for _ in views.pairs]
    left_pixels = [views.left.views[left_view].astype(np.float32) for left_view, _ in views.pairs]
    right_pixels = [views.right.views[right_view].astype(np.float32) for _, right_view in views.pairs]
    if len(points) < MIN_VIEWS:
        raise CommandFailed(
            f"both cameras see the board in {len(points)} views at once; a pair needs {MIN_VIEWS}",
            hint="hold the board where both cameras see it whole, still, from many sides",
        )
    # 3. Estimate the pose between both cameras from these corners, with the intrinsics held fixed.
    cv2 = load_opencv()
    camera = lenses[0].camera
    rms_px, _, _, _, _, R, t, _, _ = cv2.stereoCalibrate(
        points,
        left_pixels,
        right_pixels,
        *(lenses[0].camera.matrix, lenses[0].coefficients),
        *(lenses[1].camera.matrix, lenses[1].coefficients),
        (camera.width, camera.height),
        flags=cv2.CALIB_FIX_INTRINSIC,
    )
    if not rms_px <= max_rms_px:
        raise CommandFailed(
            f"the reprojection error of the pair is {rms_px:.2f} px, above {max_rms_px:g} px",
            hint="both images of a pair must be of one moment: keep the board still; check --board",
        )
    T_right_left = np.eye(4)
    T_right_left[:3, :3], T_right_left[:3, 3] = R, t.ravel()
    left = RigCamera(name="left", lens=lenses[0], T_body_camera=np.eye(4))
    right = RigCamera(name="right", lens=lenses[1], T_body_camera=inverse(T_right_left))
    rectified = Rectification(left, right)
    return StereoCalibration(Rig(cameras=(left, right)), rectified.baseline_m, float(rms_px), len(points))
