"""Calibrate a stereo pair from images of a board that both cameras see.

Each camera is calibrated and judged as one alone is; then its place beside the other one is found.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from client_sdk.cameras.board import Board
from client_sdk.cameras.calibration import BoardViews, calibrate
from client_sdk.frontend import load_opencv
from client_sdk.rigs.rectification import Rectification
from client_sdk.rigs.rig import Rig, RigCamera
from rse_pf.errors import CommandFailed
from rse_pf.geometry import inverse

__all__ = ["PairViews", "StereoCalibration", "calibrate_pair"]

_MIN_PAIRS = 8
_MIN_CORNERS = 6


@dataclass(frozen=True, slots=True, eq=False)
class StereoCalibration:
    """A rig whose body is the left camera, and how well it explains *views* that both cameras saw."""

    rig: Rig
    baseline_m: float
    rms_px: float
    views: int


@dataclass(slots=True, eq=False)
class PairViews:
    """Views of one board by both cameras, collected pair by pair."""

    board: Board
    left: BoardViews = field(init=False)
    right: BoardViews = field(init=False)
    pairs: list[tuple[int, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.left, self.right = BoardViews(self.board), BoardViews(self.board)

    def add(self, left: npt.NDArray[np.uint8], right: npt.NDArray[np.uint8]) -> bool:
        """Look for the board in two grey images; return whether both have a new view of it.

        Raises:
            UsageError: An image has another size than those before.
        """
        new = self.left.add(left), self.right.add(right)
        if all(new):
            self.pairs.append((len(self.left.found) - 1, len(self.right.found) - 1))
        return all(new)


def calibrate_pair(views: PairViews, *, max_rms_px: float = 1.0) -> StereoCalibration:
    """Return the rig that explains all views best.

    Raises:
        CommandFailed: One camera cannot be calibrated, both saw the board too rarely, the error is above
            *max_rms_px*, or the cameras are no pair.
        UsageError: The right camera is not beside the left one.
        MissingExtra: OpenCV is not installed.

    Source:
        Zhang, PAMI 2000, and Bouguet, as OpenCV's ``stereoCalibrate`` implements it.
    """
    lenses = []
    for side, each in (("left", views.left), ("right", views.right)):
        try:
            lenses.append(calibrate(each, max_rms_px=max_rms_px))
        except CommandFailed as error:
            raise CommandFailed(f"the {side} camera: {error.message}", hint=error.hint) from error
    points, lefts, rights = [], [], []
    for row, other in views.pairs:
        numbers, mine, theirs = np.intersect1d(
            views.left.found[row][0], views.right.found[other][0], return_indices=True
        )
        if len(numbers) >= _MIN_CORNERS:
            points.append(views.board.points[numbers])
            lefts.append(views.left.found[row][1][mine].astype(np.float32))
            rights.append(views.right.found[other][1][theirs].astype(np.float32))
    if len(points) < _MIN_PAIRS:
        raise CommandFailed(
            f"both cameras see the board in {len(points)} views at once; a pair needs {_MIN_PAIRS}",
            hint="hold the board where both cameras see it whole, still, from many sides",
        )
    cv2 = load_opencv()
    models = [(lens.camera.matrix, np.array(lens.distortion)) for lens in lenses]
    camera = lenses[0].camera
    rms_px, _, _, _, _, R, t, _, _ = cv2.stereoCalibrate(
        points, lefts, rights, *models[0], *models[1], (camera.width, camera.height),
        flags=cv2.CALIB_FIX_INTRINSIC,
    )  # fmt: skip
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
