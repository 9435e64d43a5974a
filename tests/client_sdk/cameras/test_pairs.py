"""Stereo cameras as sources: folders of pairs, side-by-side images, two videos."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.cameras import Intrinsics, Rig, RigCamera, open_camera, write_rig
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
FRAMES = 12


def moved(x: float) -> Array:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


RIG = Rig(
    cameras=tuple(
        RigCamera(name=name, lens=Intrinsics(camera=CAMERA), T_body_camera=moved(x))
        for name, x in (("left", 0.0), ("right", 0.1))
    )
)


def images(folder: Path) -> Path:
    for side, value in (("left", 100), ("right", 200)):
        (folder / side).mkdir()
        for row in range(FRAMES):
            cv2.imwrite(str(folder / side / f"{row}.png"), np.full((48, 64), value + row, np.uint8))
    write_rig(folder / "rig.json", RIG)
    return folder


def video(path: Path, values: list[int]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64 * len(values), 48))
    for _ in range(FRAMES):
        writer.write(np.hstack([np.full((48, 64, 3), value, np.uint8) for value in values]))
    writer.release()
    return path


def test_a_folder_of_pairs_gives_all_of_them_in_order(tmp_path: Path) -> None:
    with open_camera(images(tmp_path)) as source:
        assert (source.has_stereo, source.has_depth) == (True, False)
        frames = list(source)

    assert [int(frame.rgb[0, 0, 0]) for frame in frames] == list(range(100, 100 + FRAMES))
    assert [int(frame.stereo.gray[0, 0]) for frame in frames if frame.stereo] == list(
        range(200, 200 + FRAMES)
    )
    assert frames[0].stereo is not None
    assert frames[0].stereo.baseline_m == pytest.approx(0.1)


@pytest.mark.parametrize("is_beside", [True, False])
def test_videos_of_both_cameras_are_paired(tmp_path: Path, is_beside: bool) -> None:
    if is_beside:
        word = str(video(tmp_path / "both.avi", [100, 200]))
    else:
        word = f"{video(tmp_path / 'a.avi', [100])},{video(tmp_path / 'b.avi', [200])}"

    with open_camera(word, intrinsics=RIG) as source:
        frames = list(source)

    assert len(frames) == FRAMES
    assert frames[3].stereo is not None
    assert int(frames[3].rgb[5, 5, 0]) == pytest.approx(100, abs=3)
    assert int(frames[3].stereo.gray[5, 5]) == pytest.approx(200, abs=3)


def test_images_without_a_partner_are_left_out(tmp_path: Path) -> None:
    folder = images(tmp_path)
    whole = [frame.timestamp_s for frame in open_camera(folder)]
    (folder / "right" / "3.png").unlink()
    with open_camera(folder) as pairs:
        assert [frame.timestamp_s for frame in pairs] == whole[:3] + whole[4:]
    (doubt,) = pairs.log.doubts
    assert doubt.sentence.endswith("left out, without a right image: 3.png")


def test_images_of_another_size_are_one_line(tmp_path: Path) -> None:
    folder = images(tmp_path)
    cv2.imwrite(str(folder / "left" / "0.png"), np.zeros((48, 48), np.uint8))
    with pytest.raises(UsageError, match=r"images of 48x48 px, .*rig.json is for 64x48 px"):
        open_camera(folder)


@pytest.mark.parametrize(
    ("source", "options", "says"),
    [
        ("pair", {"intrinsics": RIG.left.lens}, "is a stereo pair, and the intrinsics of"),
        ("pair", {"imu": True}, "is no recording, and only recordings"),
        ("colours", {"imu": True}, "is no recording, and only recordings"),
        ("realsense", {"imu": True}, "realsense is no recording, and only recordings"),
        ("realsense", {"camera": "stereo"}, "realsense is one camera with depth"),
        ("realsense", {"intrinsics": RIG}, "realsense is one camera with depth"),
        ("drive.bag", {}, "is a bag"),
    ],
)
def test_what_a_source_cannot_give_or_use_is_refused(
    tmp_path: Path, source: str, options: dict[str, Any], says: str
) -> None:
    (tmp_path / "pair").mkdir()
    images(tmp_path / "pair")
    (tmp_path / "drive.bag").touch()
    place = source if source.startswith("realsense") else tmp_path / source.replace("colours", "pair/left")

    with pytest.raises(UsageError, match=says) as refused:
        open_camera(place, **options)

    assert refused.value.hint


def test_a_source_whose_facts_contradict_each_other_is_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[str] = []
    module = importlib.import_module("client_sdk.cameras.open_camera")
    opened = module.open_video(str(video(tmp_path / "both.avi", [100, 200])))
    monkeypatch.setattr(module, "open_video", lambda name: replace(opened, close=lambda: closed.append(name)))
    narrow = Intrinsics(camera=Camera(fx=6000.0, fy=6000.0, cx=31.5, cy=23.5, width=64, height=48))
    rig = Rig(cameras=tuple(replace(camera, lens=narrow) for camera in RIG.cameras))

    with pytest.raises(UsageError, match="field of view"):
        open_camera(tmp_path / "both.avi", intrinsics=rig)

    assert closed == [str(tmp_path / "both.avi")]
