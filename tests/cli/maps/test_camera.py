"""The verb camera: boards that are printed, found and calibrated with, on views of a known camera."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from client_sdk.cameras.board import Board, find_corners
from client_sdk.cameras.calibration import BoardViews, calibrate
from client_sdk.rigs.rig_file import read_intrinsics
from rse_pf.cli.main import main
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.geometry import Array, Camera, exp_se3, transform
from tests.kit.removed_extensions import skip_if_removed

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=310.0, fy=305.0, cx=165.0, cy=117.0, width=320, height=240)
BOARD = Board(columns=7, rows=5, square_m=0.03)


def view(
    T_camera_board: Array, board: Board = BOARD, picture: npt.NDArray[np.uint8] | None = None
) -> npt.NDArray[np.uint8]:
    """Return a grey image of the printed board, whose first square begins at the origin."""
    if picture is None:
        squares = np.indices((board.rows + 1, board.columns + 1)).sum(axis=0) % 2
        picture = np.kron(squares * 255, np.ones((24, 24))).astype(np.uint8)
    padded = np.pad(picture, 24, constant_values=255)
    height, width = padded.shape
    scale = board.square_m / (picture.shape[0] / (board.rows + 1))
    corners = np.float64([[0, 0], [width, 0], [width, height], [0, height]]) * scale - 24 * scale
    seen = CAMERA.project(transform(T_camera_board, np.column_stack((corners, np.zeros(4)))))
    source = np.float32([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
    H = cv2.getPerspectiveTransform(source, seen.astype(np.float32))
    big = cv2.warpPerspective(padded, H, (320, 240), flags=cv2.INTER_AREA, borderValue=160)
    image: npt.NDArray[np.uint8] = cv2.GaussianBlur(big, (3, 3), 0.6)
    return image


def poses(count: int, *, tilted: bool = True, seed: int = 3) -> list[Array]:
    rng = np.random.default_rng(seed)
    made = []
    for row in range(count):
        turn = rng.uniform(-0.5, 0.5, 3) if tilted else np.array([0.0, 0.0, 0.02 * row])
        centre = exp_se3([-0.12, -0.09, 0.0, 0, 0, 0])
        there = exp_se3([*rng.uniform(-0.05, 0.05, 2), 0.36 + 0.02 * (row % 4), *(0.0, 0.0, 0.0)])
        made.append(there @ exp_se3([0, 0, 0, *turn]) @ centre)
    return made


def save_views(folder: Path, count: int, *, tilted: bool = True) -> list[str]:
    paths = []
    for row, pose in enumerate(poses(count, tilted=tilted)):
        paths.append(str(folder / f"{row:02}.png"))
        cv2.imwrite(paths[-1], view(pose))
    return paths


def test_calibrates_a_camera_from_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "intrinsics.json"
    images = save_views(tmp_path, 12)

    code = main(["camera", "calibrate", *images, "--board", "7x5", "--square-mm", "30", "--out", str(out)])

    found = read_intrinsics(out)
    assert code == 0
    assert [found.camera.fx, found.camera.fy] == pytest.approx([310.0, 305.0], rel=0.01)
    assert [found.camera.cx, found.camera.cy] == pytest.approx([165.0, 117.0], abs=3.0)
    assert found.rms_px is not None
    assert found.rms_px < 0.3
    assert "reprojection error" in capsys.readouterr().out
    assert json.loads(out.read_text())["views"] == found.views


def test_a_calibration_of_a_video_reads_the_lens_as_it_is(tmp_path: Path) -> None:
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for pose in poses(12):
        writer.write(cv2.cvtColor(view(pose), cv2.COLOR_GRAY2BGR))
    writer.release()
    out = tmp_path / "i.json"

    assert main(["camera", "calibrate", str(tmp_path / "v.avi"), "--board", "7x5", "--out", str(out)]) == 0
    assert read_intrinsics(out).camera.fx == pytest.approx(310.0, rel=0.02)


def test_refuses_too_few_views_views_that_are_alike_and_large_errors(tmp_path: Path) -> None:
    few, flat, good = (BoardViews(BOARD) for _ in range(3))
    for pose in poses(3):
        few.add(view(pose))
    for pose in poses(10, tilted=False):
        flat.add(view(pose))
    for pose in poses(10):
        good.add(view(pose))

    with pytest.raises(CommandFailed, match=r"3 usable views .* in 3 images; a calibration needs 8"):
        calibrate(few)
    with pytest.raises(CommandFailed, match=r"too similar: the board is tilted by \d deg"):
        calibrate(flat)
    with pytest.raises(CommandFailed, match=r"above 0\.001 px"):
        calibrate(good, max_rms_px=0.001)


def test_the_same_view_twice_counts_once() -> None:
    views = BoardViews(BOARD)

    assert [views.add(view(poses(1)[0])) for _ in range(3)] == [True, False, False]
    assert (views.images, views.similar) == (3, 2)
    with pytest.raises(UsageError, match="160x120 px"):
        views.add(np.zeros((120, 160), np.uint8))


def test_the_pdf_has_the_true_size(tmp_path: Path) -> None:
    assert (
        main(["camera", "board", "--board", "7x5", "--square-mm", "30", "--out", str(tmp_path / "b.pdf")])
        == 0
    )

    data = (tmp_path / "b.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data)
    assert box is not None
    size_mm = [float(each) / 72 * 25.4 for each in box.groups()]
    assert size_mm == pytest.approx([8 * 30 + 20, 6 * 30 + 20], abs=0.1)
    start = int(data.split(b"startxref\n")[1].split()[0])
    assert data[start:].startswith(b"xref")

    page = np.full([round(size / 25.4 * 72) for size in size_mm[::-1]], 255, np.uint8)
    for words in re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", data):
        x, y, width, height = (float(word) for word in words)
        rows = slice(round(len(page) - y - height), round(len(page) - y))
        page[rows, round(x) : round(x + width)] = 0
    found = find_corners(page, BOARD)
    assert found is not None
    wanted_mm = 1e3 * BOARD.points[:, :2] + 10.0
    np.testing.assert_allclose((found + 0.5) / 72 * 25.4, wanted_mm, atol=0.5)


def test_check_says_size_rate_depth_and_blur(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    skip_if_removed("camera check")
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for pose in poses(4):
        writer.write(cv2.cvtColor(view(pose), cv2.COLOR_GRAY2BGR))
    writer.release()
    gray = tmp_path / "gray"
    gray.mkdir()
    for row in range(3):
        cv2.imwrite(str(gray / f"{row}.png"), np.full((48, 64), 128, np.uint8))

    sharp, empty = (
        main(["camera", "check", str(tmp_path / "v.avi"), "--json"]),
        main(["camera", "check", str(gray)]),
    )

    out = capsys.readouterr().out
    figures = json.loads(out.splitlines()[0])
    assert (sharp, empty) == (0, 1)
    assert (figures["width"], figures["rate_hz"], figures["with_depth"], figures["blurred"]) == (
        320,
        10.0,
        0,
        0,
    )
    assert "3 of the first 3 frames are blurred or empty: frames 1-3" in out


def test_check_says_that_a_recording_has_pairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    skip_if_removed("camera check")
    kitti = tmp_path / "06"
    for camera in ("image_0", "image_1"):
        (kitti / camera).mkdir(parents=True)
        for row in range(3):
            cv2.imwrite(str(kitti / camera / f"{row:06}.png"), np.full((48, 64), 128, np.uint8))
    (kitti / "times.txt").write_text("0.0\n0.1\n0.2\n")
    (kitti / "calib.txt").write_text("P0: 60 0 32 0 0 60 24 0 0 0 1 0\nP1: 60 0 32 -30 0 60 24 0 0 0 1 0\n")

    main(["camera", "check", str(kitti)])
    main(["camera", "check", str(kitti), "--json"])

    line, _, figures = capsys.readouterr().out.splitlines()
    assert line.endswith("64x48 px, 10.0 frames per second, a stereo pair")
    assert (json.loads(figures)["with_stereo"], json.loads(figures)["with_depth"]) == (3, 0)
