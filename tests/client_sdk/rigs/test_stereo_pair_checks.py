"""Rigs that are wrong are named in one line; healthy ones raise nothing."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from client_sdk.datasets import Dataset, open_dataset
from client_sdk.frontend import Frame
from client_sdk.rigs.stereo_pair_checks import check_stereo_pairs
from client_sdk.simulator.renderer import Renderer
from client_sdk.simulator.world import make_world
from client_sdk.stereo.view import StereoView
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_se3

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

SHARED = Path(__file__).parents[4] / "shared" / "data"
needs_recordings = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data has no recordings here")
CAMERA = Camera(fx=260.0, fy=260.0, cx=159.5, cy=119.5, width=320, height=240)
BASELINE_M = 0.12
STEP_S = 0.1


@pytest.fixture(scope="module")
def drive() -> list[Frame]:
    """Twelve pairs of a rendered room; the camera nods, so that rows move."""
    painter = Renderer(make_world(3), CAMERA)
    right = np.eye(4)
    right[0, 3] = BASELINE_M
    start = np.array(
        [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, -1.0, 0.0, 1.2], [0.0, 0.0, 0.0, 1.0]]
    )
    frames = []
    for row in range(12):
        nod = 0.06 * np.sin(1.1 * row)
        pose = start @ exp_se3(np.array([0.0, 0.0, 0.03 * row, nod, 0.01 * row, 0.0]))
        images = [gray(painter, pose), gray(painter, pose @ right)]
        frames.append(
            Frame(
                timestamp_s=row * STEP_S, rgb=np.repeat(images[0][:, :, None], 3, axis=2),
                depth_m=np.zeros((240, 320), np.float32), camera=CAMERA,
                stereo=StereoView(images[1], BASELINE_M),
            )
        )  # fmt: skip
    return frames


def gray(painter: Renderer, pose: Array) -> np.ndarray:
    colour = painter.draw(pose)[0]
    return cv2.cvtColor(np.clip(colour, 0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)


def swapped(frames: list[Frame], row: int) -> Frame:
    pair = frames[row].stereo
    assert pair is not None
    left = np.repeat(pair.gray[:, :, None], 3, axis=2)
    return replace(frames[row], rgb=left, stereo=StereoView(frames[row].rgb[:, :, 0].copy(), BASELINE_M))


def late(frames: list[Frame], row: int) -> Frame:
    return replace(frames[row], stereo=frames[min(row + 1, len(frames) - 1)].stereo)


def early(frames: list[Frame], row: int) -> Frame:
    return replace(frames[row], stereo=frames[max(row - 1, 0)].stereo)


def lowered(frames: list[Frame], row: int) -> Frame:
    pair = frames[row].stereo
    assert pair is not None
    return replace(frames[row], stereo=StereoView(np.roll(pair.gray, 3, axis=0), BASELINE_M))


def pairs(frames: list[Frame], fault: Callable[[list[Frame], int], Frame]) -> list[tuple[Frame, Frame]]:
    return [(fault(frames, row), frames[row + 1]) for row in range(len(frames) - 1)]


def test_a_healthy_pair_raises_nothing(drive: list[Frame]) -> None:
    check_stereo_pairs(pairs(drive, lambda frames, row: frames[row]), "room")


def test_a_pair_without_texture_raises_nothing(drive: list[Frame]) -> None:
    blank = [
        replace(each, rgb=np.zeros_like(each.rgb), stereo=StereoView(np.zeros((240, 320), np.uint8), 0.1))
        for each in drive
    ]

    check_stereo_pairs(pairs(blank, swapped), "dark")


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (swapped, "the cameras are swapped"),
        (late, "ms after the left one: the cameras are not synchronised"),
        (early, "ms before the left one: the cameras are not synchronised"),
        (lowered, "the rectification does not fit"),
    ],
)
def test_a_wrong_pair_is_named_in_one_line(
    drive: list[Frame], fault: Callable[[list[Frame], int], Frame], says: str
) -> None:
    with pytest.raises(UsageError, match=says) as told:
        check_stereo_pairs(pairs(drive, fault), "room")
    assert told.value.hint
    assert told.value.message.startswith("room: ")


@needs_recordings
@pytest.mark.parametrize("name", ["euroc_mh01_start", "kitti_06_start"])
def test_real_pairs_raise_nothing(name: str) -> None:
    open_dataset(SHARED / name).check()


def euroc_with(folder: Path, change: Callable[[Path], None]) -> Dataset:
    """Return EuRoC's part with files of its sensors that *change* has written to."""
    source = SHARED / "euroc_mh01_start" / "mav0"
    for name in ("cam0", "cam1"):
        (folder / "mav0" / name).mkdir(parents=True)
        (folder / "mav0" / name / "data").symlink_to(source / name / "data")
        for file in ("sensor.yaml", "data.csv"):
            shutil.copy(source / name / file, folder / "mav0" / name / file)
    change(folder / "mav0")
    return open_dataset(folder)


def exchange(folder: Path) -> None:
    """Give each camera the images of the other."""
    one, other = (folder / name / "data" for name in ("cam0", "cam1"))
    paths = one.readlink(), other.readlink()
    one.unlink()
    other.unlink()
    one.symlink_to(paths[1])
    other.symlink_to(paths[0])


def invert(folder: Path) -> None:
    """Write the pose of the body in each camera, as if ``T_BS`` meant that."""
    from client_sdk.rigs.benchmark_files import read_euroc_camera
    from rse_pf.geometry import inverse

    for name in ("cam0", "cam1"):
        path = folder / name / "sensor.yaml"
        text = path.read_text()
        numbers = ", ".join(map(repr, inverse(read_euroc_camera(path, name).T_body_camera).ravel().tolist()))
        begin, end = text.index("data: ["), text.index("]")
        path.write_text(f"{text[:begin]}data: [{numbers}{text[end:]}")


def millimetres(folder: Path) -> None:
    path = folder / "cam1" / "sensor.yaml"
    path.write_text(path.read_text().replace("-0.0198435579556", "-19.8435579556"))


@needs_recordings
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (exchange, "the cameras are swapped"),
        (invert, "is not beside|swapped|does not fit"),
        (millimetres, "in millimetres"),
    ],
)
def test_wrong_files_of_a_real_rig_are_named(
    tmp_path: Path, change: Callable[[Path], None], says: str
) -> None:
    with pytest.raises(UsageError, match=says):
        euroc_with(tmp_path / "MH_01", change).check()
