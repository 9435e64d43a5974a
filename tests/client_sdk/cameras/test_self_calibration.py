"""Calibration without a board: rendered drives of a known lens, and drives that cannot determine a lens."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.cameras.self_calibration import calibrate_from_motion
from client_sdk.cameras.view_selection import select_views
from client_sdk.rigs.rig_file import read_intrinsics
from client_sdk.simulator.drive import true_trajectory
from client_sdk.simulator.renderer import Renderer
from client_sdk.simulator.world import make_world
from rse_pf.cli.main import main
from rse_pf.command_line import extras
from rse_pf.errors import CommandFailed
from rse_pf.geometry import Array, Camera, exp_se3

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
pytest.importorskip("pycolmap", reason="pip install 'rse-pf[calibrate]'")

_Image = npt.NDArray[np.uint8]

CAMERA = Camera(fx=300.0, fy=300.0, cx=190.0, cy=136.0, width=384, height=288)
K = np.array([[300.0, 0.0, 190.0], [0.0, 300.0, 136.0], [0.0, 0.0, 1.0]])


def turn(yaw: float, pitch: float) -> Array:
    R: Array = exp_se3([0, 0, 0, pitch, yaw, 0])[:3, :3]
    return R


def picture() -> _Image:
    """Return a texture of patches of many sizes."""
    rng = np.random.default_rng(1)
    total = sum(
        cv2.resize(rng.uniform(0, 255, (side, side)), (1600, 1600), interpolation=cv2.INTER_CUBIC)
        for side in (20, 50, 130, 330)
    )
    scaled: _Image = cv2.normalize(total, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    return scaled


def warped(H: Array) -> _Image:
    image: _Image = cv2.warpPerspective(
        picture(), H, (CAMERA.width, CAMERA.height), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT
    )
    return image


def turning_camera(count: int) -> list[_Image]:
    far = np.array([[500.0, 0.0, 800.0], [0.0, 500.0, 800.0], [0.0, 0.0, 1.0]])
    turns = [turn(0.4 * np.sin(0.3 * row), 0.2 * np.cos(0.4 * row)) for row in range(count)]
    return [warped(K @ R.T @ np.linalg.inv(far)) for R in turns]


def camera_above_a_plane(count: int) -> list[_Image]:
    texture = np.array([[4 / 1600, 0.0, -2.0], [0.0, 4 / 1600, -2.0], [0.0, 0.0, 2.0]])
    views = []
    for row in range(count):
        position = np.array([0.08 * row - 0.8, 0.2 * np.sin(0.5 * row), 0.3 * np.sin(0.4 * row)])
        plane = texture - np.outer(position, [0.0, 0.0, 1.0])
        views.append(warped(K @ turn(0.3 * np.sin(0.5 * row), 0.3 * np.cos(0.4 * row)).T @ plane))
    return views


@pytest.mark.timeout(300)
def test_a_drive_gives_the_lens_with_its_uncertainty(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images, out = tmp_path / "images", tmp_path / "intrinsics.json"
    images.mkdir()
    painter = Renderer(make_world(0), CAMERA)
    start = true_trajectory(0, 1, 1, 0).T_world_camera[0]
    for row in range(24):
        swing = np.sin(0.4 * row)
        move = [0.08 * (row - 12), 0.15 * swing, 0.2 * np.cos(0.4 * row), 0.1 * swing, 0.02 * (12 - row), 0.0]
        image = painter.draw(start @ exp_se3(move))[0].astype(np.uint8)
        cv2.imwrite(str(images / f"{row:03}.png"), image)

    code = main(["camera", "calibrate", str(images), "--out", str(out)])

    camera = read_intrinsics(out).camera
    deviations = json.loads(out.read_text())["standard_deviations"]
    assert code == 0
    assert [camera.fx, camera.fy] == pytest.approx([300.0, 300.0], rel=0.02)
    assert (camera.width, camera.height) == (384, 288)
    assert 0 < deviations["f"] < 9.0
    assert "+-" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("views", "reason"),
    [(turning_camera, "the camera only turns"), (camera_above_a_plane, "the scene is flat")],
)
def test_motion_that_does_not_determine_the_lens_is_refused_with_its_kind(views: object, reason: str) -> None:
    assert callable(views)
    with pytest.raises(CommandFailed, match=reason):
        calibrate_from_motion(views(20))


def test_a_camera_that_stands_still_is_refused() -> None:
    views, images = select_views([turning_camera(1)[0]] * 30)

    assert (len(views), images) == (1, 30)
    with pytest.raises(CommandFailed, match="the camera moves too little: 1 views"):
        calibrate_from_motion(views)


def test_the_sharper_of_two_near_images_becomes_a_view() -> None:
    wide = cv2.GaussianBlur(picture(), (5, 5), 1.0)
    shifts = [0, 13, 16, 40]  # of 384 px: 3.4 and 4.2 % of the width, then 10.4 %
    images = [np.ascontiguousarray(wide[:288, shift : shift + 384]) for shift in shifts]
    images[1] = cv2.GaussianBlur(images[1], (9, 9), 3.0)

    views, _ = select_views(images)

    assert [any(np.array_equal(view, image) for view in views) for image in images] == [
        True,
        False,
        True,
        True,
    ]


def test_without_the_extra_the_verb_names_it_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    video = tmp_path / "drive.mp4"
    video.touch()
    found = extras.importlib.util.find_spec
    monkeypatch.setattr(
        extras.importlib.util, "find_spec", lambda name: None if name == "pycolmap" else found(name)
    )

    assert main(["camera", "calibrate", str(video)]) == 2
    assert "  hint: pip install 'rse-pf[calibrate]'" in capsys.readouterr().err
