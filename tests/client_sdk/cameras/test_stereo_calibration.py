"""The calibration of a pair, from rendered boards."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.cameras.board import Board
from client_sdk.cameras.stereo_calibration import PairViews, calibrate_pair
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.geometry import Array, exp_se3, inverse

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

BOARD = Board.parse("7x5", 40.0)
K = np.array([[500.0, 0.0, 325.0], [0.0, 505.0, 236.0], [0.0, 0.0, 1.0]])
T_LEFT_RIGHT = exp_se3(np.array([0.12, 0.002, -0.001, 0.01, -0.015, 0.005]))
SEEN = [(0.35 * np.cos(turn), 0.5 * np.sin(turn), 0.1 * turn) for turn in np.linspace(0, 6, 16)]


def drawn(T_camera_board: Array) -> np.ndarray:
    """Return a grey image of the board, which a homography maps into it."""
    squares = np.indices((BOARD.rows + 1, BOARD.columns + 1)).sum(axis=0) % 2
    picture = np.kron(255 * squares, np.ones((40, 40))).astype(np.uint8)
    metres = BOARD.square_m / 40
    to_board = np.array([[metres, 0, metres / 2], [0, metres, metres / 2], [0, 0, 1]])
    H = K @ T_camera_board[:3, [0, 1, 3]] @ to_board
    return cv2.warpPerspective(picture, H, (640, 480), flags=cv2.INTER_AREA, borderValue=255)


def views(T_left_right: Array) -> PairViews:
    found = PairViews(BOARD)
    for row, (x, y, z) in enumerate(SEEN):
        T_left_board = exp_se3(np.array([-0.1 + 0.01 * (row % 4), -0.12 + 0.008 * (row % 5), 0.75, x, y, z]))
        found.add(drawn(T_left_board), drawn(inverse(T_left_right) @ T_left_board))
    return found


def test_the_place_of_the_right_camera_is_found() -> None:
    found = calibrate_pair(views(T_LEFT_RIGHT))

    assert found.views >= 8
    assert found.rms_px < 0.5
    assert found.baseline_m == pytest.approx(0.12, abs=0.001)
    right = found.rig.right
    assert right is not None
    np.testing.assert_allclose(right.T_body_camera, T_LEFT_RIGHT, atol=0.004)
    assert found.rig.left.lens.camera.fx == pytest.approx(500.0, rel=0.01)


def test_exchanged_cameras_are_refused() -> None:
    with pytest.raises(UsageError, match="the cameras are swapped"):
        calibrate_pair(views(inverse(T_LEFT_RIGHT)))


def test_a_camera_that_saw_no_board_is_named() -> None:
    empty = PairViews(BOARD)
    empty.add(np.zeros((48, 64), np.uint8), np.zeros((48, 64), np.uint8))

    with pytest.raises(CommandFailed, match="the left camera: 0 usable views"):
        calibrate_pair(empty)
