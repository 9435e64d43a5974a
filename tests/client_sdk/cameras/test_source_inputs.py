"""Folders, data sets and videos as people have them: what is read, what is left out, what is refused."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.cameras import open_camera, read_intrinsics
from client_sdk.cameras.source import FrameSource
from rse_pf.errors import UsageError

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

LENS: dict[str, Any] = {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}
DEPTH: dict[str, Any] = {**LENS, "depth_scale": 1000}
STEP = 20
"""Grey levels between the images of two rows."""


def image(path: Path, row: int, kind: type = np.uint8) -> None:
    """Write an image that shows its row: as a level of grey, or as depth, 1 m and 0.1 m for each row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    level = STEP * row if kind is np.uint8 else 1000 + 100 * row
    cv2.imwrite(str(path), np.full((48, 64), level, kind))


def folder_of(path: Path, colours: Sequence[str], depths: Sequence[str] = (), **lens: Any) -> Path:
    """Write a folder whose images have these names, in the order of their rows."""
    for row, name in enumerate(colours):
        image(path / name, row)
    for row, name in enumerate(depths):
        image(path / name, row, np.uint16)
    (path / "intrinsics.json").write_text(json.dumps({**(DEPTH if depths else LENS), **lens}))
    return path


def tum(path: Path, stamps: Sequence[str], truth: Sequence[float] = ()) -> Path:
    """Write a folder in TUM layout with these stamps."""
    names = [[f"{kind}/{row}.png" for row in range(len(stamps))] for kind in ("rgb", "depth")]
    folder_of(path, *names)
    for kind, files in zip(("rgb", "depth"), names, strict=True):
        lines = [f"{stamp} {name}\n" for stamp, name in zip(stamps, files, strict=True)]
        (path / f"{kind}.txt").write_text("".join(lines))
    if truth:
        (path / "groundtruth.txt").write_text("".join(f"{stamp} 0 0 0 0 0 0 1\n" for stamp in truth))
    return path


def rows_of(source: FrameSource) -> list[tuple[float, int, int]]:
    """Return the time, the row of the colour and the row of the depth (-1 without) of each frame."""
    with source:
        return [
            (
                round(frame.timestamp_s, 6),
                round(float(frame.rgb[20, 20, 0]) / STEP),
                round(10 * float(frame.depth_m[20, 20]) - 10) if frame.depth_m.any() else -1,
            )
            for frame in source
        ]


def paired(*stamps_s: float) -> list[tuple[float, int, int]]:
    return [(stamp_s, row, row) for row, stamp_s in enumerate(stamps_s)]


@pytest.mark.parametrize(
    ("colours", "depths"),
    [
        (["rgb/a_1.png", "rgb/a_2.png", "rgb/a_10.png"],
         ["depth/b_0001.png", "depth/b_0002.png", "depth/b_0010.png"]),
        (["rgb_0.png", "rgb_1.png", "rgb_2.png"], ["depth_0.png", "depth_1.png", "depth_2.png"]),
        (["color/0.png", "color/1.png", "color/2.png"], ["depths/0.png", "depths/1.png", "depths/2.png"]),
        (["frame-0.color.png", "frame-1.color.png", "frame-2.color.png"],
         ["frame-0.depth.png", "frame-1.depth.png", "frame-2.depth.png"]),
        (["image/01-00000.png", "image/02-33369.png", "image/03-66738.png"],
         ["depth/01-08000.png", "depth/02-41369.png", "depth/03-74738.png"]),
        (["rgb_0/0.png", "rgb_0/1.png", "rgb_0/2.png"], ["depth_0/0.png", "depth_0/1.png", "depth_0/2.png"]),
        (["results/frame0.png", "results/frame1.png", "results/frame2.png"],
         ["results/depth0.png", "results/depth1.png", "results/depth2.png"]),
        (["images/cam0_7.png", "images/cam0_8.png", "images/cam0_9.png"],
         ["depth/d7.png", "depth/d8.png", "depth/d9.png"]),
    ],
)  # fmt: skip
def test_depth_is_paired_by_name_or_number(tmp_path: Path, colours: list[str], depths: list[str]) -> None:
    assert rows_of(open_camera(folder_of(tmp_path, colours, depths))) == paired(0.0, 0.1, 0.2)


@pytest.mark.parametrize(
    ("names", "stamps_s"),
    [
        (["IMG_20240131_120100.png", "IMG_20240131_120100_1.png", "IMG_20240131_120100_2.png",
          "IMG_20240131_120100_10.png"], [0.0, 0.1, 0.2, 0.3]),
        (["9.png", "10.png", "11.png"], [0.0, 0.1, 0.2]),
        (["1.5.png", "1.75.png", "2.0.png"], [1.5, 1.75, 2.0]),
        (["5.900000000.png", "5.950000000.png", "6.0.png", "6.50000000.png", "6.100000000.png"],
         [5.9, 5.95, 6.0, 6.05, 6.1]),
        (["1700000000000.png", "1700000000100.png"], [1700000000.0, 1700000000.1]),
        (["a_1700000000000.125.png", "a_1700000000100.250.png"], [1.7e9 + 125e-6, 1.7e9 + 0.10025]),
        (["5000.5.png", "5033.5.png", "5066.5.png"], [5.0005, 5.0335, 5.0665]),
        (["img_1700000000000000000.png", "img_1700000000250000000.png"], [1700000000.0, 1700000000.25]),
    ],
)  # fmt: skip
def test_names_are_ordered_by_their_numbers_or_are_times(
    tmp_path: Path, names: list[str], stamps_s: list[float]
) -> None:
    found = rows_of(open_camera(folder_of(tmp_path, names)))
    assert [row for _, row, _ in found] == list(range(len(names)))
    assert [stamp_s for stamp_s, _, _ in found] == pytest.approx(stamps_s)


@pytest.mark.parametrize(
    ("fields", "numbers"),
    [
        ({"k1": 0.1, "k2": -0.2, "p1": 0.01, "p2": 0.02}, (0.1, -0.2, 0.01, 0.02, 0.0)),
        ({"distortion_coefficients": [0.1, -0.2, 0.01, 0.02]}, (0.1, -0.2, 0.01, 0.02)),
        ({"camera_model": "pinhole", "distortion_model": "equidistant", "D": [0.1, 0.2, 0.3, 0.4]},
         (0.1, 0.2, 0.3, 0.4)),
    ],
)  # fmt: skip
def test_other_names_of_fields_are_read(
    tmp_path: Path, fields: dict[str, Any], numbers: tuple[float, ...]
) -> None:
    model = "fisheye" if "distortion_model" in fields else "radial-tangential"
    ours = folder_of(tmp_path / "ours", ["0.png"], model=model, distortion=numbers)
    others = folder_of(tmp_path / "others", ["0.png"], **fields)
    noise = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    for path in (ours, others):
        cv2.imwrite(str(path / "0.png"), noise)
    with open_camera(ours) as first, open_camera(others) as second:
        assert np.array_equal(next(first).rgb, next(second).rgb)


@pytest.mark.parametrize("is_listed", [False, True])
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera_intrinsic.json",
         '{"width": 64, "height": 48, "intrinsic_matrix": [50, 0, 0, 0, 51, 0, 30, 20, 1]}'),
        ("calibration.txt", "50 51 30 20\n"),
        ("intrinsics.txt", "50 0 30\n0 51 20\n0 0 1\n"),
        ("intrinsic/intrinsic_color.txt", "50 0 30 0\n0 51 20 0\n0 0 1 0\n0 0 0 1\n"),
    ],
)  # fmt: skip
def test_the_camera_that_a_folder_states_is_used(
    tmp_path: Path, name: str, text: str, is_listed: bool
) -> None:
    tum(tmp_path, ["0", "0.1"])
    (tmp_path / "intrinsics.json").unlink()
    for row in range(2):
        cv2.imwrite(str(tmp_path / f"depth/{row}.png"), np.full((48, 64), 5000, np.uint16))
    for file in () if is_listed else ("rgb.txt", "depth.txt"):
        (tmp_path / file).unlink()
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)

    with open_camera(tmp_path) as source:
        camera, depth_m = source.camera, next(source).depth_m
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 51.0, 30.0, 20.0)
    assert (camera.width, camera.height) == (64, 48)
    units_per_m = 5000 if is_listed else 1000  # TUM's and most cameras'
    assert float(depth_m[20, 20]) == pytest.approx(5000 / units_per_m)
    assert any(f"{units_per_m} units a metre are assumed" in note for note in source.notes)


def _open3d(path: Path) -> Path:
    (folder_of(path, ["0.png"]) / "intrinsics.json").write_text(
        json.dumps({"width": 64, "height": 48, "intrinsic_matrix": [60, 0, 0, 0, 60, 0, 31.5, 23.5, 1]})
    )
    return path


def _exif(path: Path) -> Path:
    colours, depths = ["rgb/0.jpg"], ["depth/0.png"]
    folder_of(path, colours, depths)
    half = np.zeros((48, 64), np.uint8)
    half[:24, :32] = 200
    cv2.imwrite(str(path / "rgb/0.jpg"), half)
    data = (path / "rgb/0.jpg").read_bytes()
    tiff = bytes.fromhex("4d4d002a00000008000101120003000000010003000000000000")
    body = b"Exif\x00\x00" + tiff
    exif = b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body
    (path / "rgb/0.jpg").write_bytes(data[:2] + exif + data[2:])
    (path / "rgb.txt").write_text("0 rgb/0.jpg\n")
    (path / "depth.txt").write_text("0 depth/0.png\n")
    return path


def _grey16(path: Path) -> Path:
    cv2.imwrite(
        str(folder_of(path, ["0.png"]) / "0.png"), np.tile(np.arange(64, dtype=np.uint16) * 64, (48, 1))
    )
    return path


@pytest.mark.parametrize(
    ("make", "pixel", "level"),
    [(_open3d, (20, 20), 0), (_exif, (10, 10), 200), (_exif, (40, 50), 0), (_grey16, (0, 32), 130)],
)
def test_pixels_are_read_as_they_are_stored(
    tmp_path: Path, make: Callable[[Path], Path], pixel: tuple[int, int], level: int
) -> None:
    with open_camera(make(tmp_path)) as source:
        assert int(next(source).rgb[pixel][0]) == pytest.approx(level, abs=8)


def _association(path: Path, *, depth_first: bool) -> Path:
    tum(path, ["0.0", "0.1", "0.2"])
    rows = [[f"{row / 10} rgb/{row}.png", f"{row / 10} depth/{row}.png"] for row in range(3)]
    lines = [" ".join(reversed(row) if depth_first else row) for row in rows]
    (path / "associations.txt").write_text("\n".join(lines))
    for name in ("rgb.txt", "depth.txt"):
        (path / name).unlink()
    return path


def _windows_lists(path: Path) -> Path:
    tum(path, ["0.0", "0.1", "0.2"])
    for name in ("rgb.txt", "depth.txt"):
        text = "# timestamp filename\n" + (path / name).read_text()
        (path / name).write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    return path


def _companions_of_macos(path: Path) -> Path:
    folder_of(path, [f"rgb/{row}.png" for row in range(3)], [f"depth/{row}.png" for row in range(3)])
    for image_file in (*(path / "rgb").iterdir(), *(path / "depth").iterdir()):
        image_file.with_name(f"._{image_file.name}").write_bytes(b"Mac OS X")
    return path


@pytest.mark.parametrize(
    "make",
    [
        lambda path: _association(path, depth_first=False),
        lambda path: _association(path, depth_first=True),
        _windows_lists,
        _companions_of_macos,
        lambda path: tum(path, ["0", "100000000", "200000000"]),
    ],
)
def test_lists_are_read_as_programs_write_them(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    source = open_camera(make(tmp_path))
    assert rows_of(source) == paired(0.0, 0.1, 0.2)
    assert source.log.doubts == ()


def _damaged(path: Path, harm: Callable[[Path], object]) -> Path:
    names = [f"rgb/{row}.jpg" for row in range(4)]
    folder_of(path, names, [f"depth/{row}.png" for row in range(4)])
    harm(path / "rgb/1.jpg")
    return path


def _cut(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def kitti(path: Path, numbers: Sequence[int], times: int, poses: int) -> Path:
    for number in numbers:
        (path / "image_0").mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path / "image_0" / f"{number:06}.png"), np.full((30, 90), STEP * number, np.uint8))
    (path / "calib.txt").write_text("P0: 70 0 44 0 0 71 14 0 0 0 1 0\n")
    (path / "times.txt").write_text("".join(f"{row / 10}\n" for row in range(times)))
    (path / "poses.txt").write_text("".join(f"1 0 0 {row} 0 1 0 0 0 0 1 5\n" for row in range(poses)))
    return path


@pytest.mark.parametrize(
    ("make", "stamps_s", "name", "line"),
    [
        (lambda path: _damaged(path, lambda file: file.write_bytes(b"")), [0.0, 0.2, 0.3],
         "left-out", "1 image left out, damaged or empty: 1.jpg"),
        (lambda path: _damaged(path, _cut), [0.0, 0.2, 0.3], "left-out", "1 image left out"),
        (lambda path: _damaged(path, os.remove), [0.0, 0.1, 0.2], "", ""),
        (lambda path: tum(path, ["0", "0.1", "0.1", "0.2"]), [0.0, 0.1, 0.2],
         "equal-stamps", "1 of 4 images have the time stamp of the image before, first 0.100000 s"),
        (lambda path: tum(path, ["0", "0.1", "0.05", "0.15"]), [0.0, 0.1],
         "time-order", "the clock goes back by 0.050 s after 0.100000 s"),
        (lambda path: tum(path, ["0", "0.1"], truth=(50.0, 50.1)), [0.0, 0.1],
         "reference-times", "covers 50.000..50.100 s, the images 0.000..0.100 s"),
        (lambda path: folder_of(path, ["0.png", "1.png"], ["depth/1.png"]), [0.1],
         "left-out", "1 of 2 images of "),
        (lambda path: kitti(path, (3, 4, 6), 8, 8), [0.3, 0.4, 0.6], "", ""),
    ],
)  # fmt: skip
def test_what_is_left_out_is_named(
    tmp_path: Path, make: Callable[[Path], Path], stamps_s: list[float], name: str, line: str
) -> None:
    source = open_camera(make(tmp_path))
    assert [stamp_s for stamp_s, _, _ in rows_of(source)] == pytest.approx(stamps_s)
    doubts = {doubt.name.value: doubt.sentence for doubt in source.log.doubts}
    assert set(doubts) == ({name} if name else set())
    assert line in doubts.get(name, "")


def test_poses_of_kitti_belong_to_the_numbers_of_images(tmp_path: Path) -> None:
    from client_sdk.datasets import open_dataset

    whole = open_dataset(kitti(tmp_path / "whole", (3, 4, 6), 8, 8)).truth
    cut = open_dataset(kitti(tmp_path / "cut", (7, 8, 9), 3, 3))
    assert whole is not None
    assert cut.truth is not None
    assert whole.T_world_camera[:, 0, 3].tolist() == [3.0, 4.0, 6.0]
    assert cut.truth.T_world_camera[:, 0, 3].tolist() == [0.0, 1.0, 2.0]
    assert any("joined in their order" in note for note in cut.notes)


def _pair_videos(path: Path, lefts: int, rights: int, **options: Any) -> FrameSource:
    for name, frames in (("left", lefts), ("right", rights)):
        writer = cv2.VideoWriter(str(path / f"{name}.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
        for row in range(frames):
            writer.write(np.full((48, 64, 3), STEP * row, np.uint8))
        writer.release()
    right = np.eye(4)
    right[0, 3] = 0.1
    cameras = [{**LENS, "name": "left", "T_body_camera": np.eye(4).tolist()},
               {**LENS, "name": "right", "T_body_camera": right.tolist()}]  # fmt: skip
    (path / "rig.json").write_text(json.dumps({"cameras": cameras}))
    names = f"{path / 'left.avi'},{path / 'right.avi'}"
    return open_camera(names, intrinsics=path / "rig.json", **options)


@pytest.mark.parametrize("rights", [5, 3, 12])
def test_two_videos_of_different_lengths_are_refused(tmp_path: Path, rights: int) -> None:
    with pytest.raises(UsageError) as refused:
        _pair_videos(tmp_path, 6, rights)
    assert f"left.avi has 6 images until 0.500 s, {tmp_path / 'right.avi'} {rights} " in refused.value.message
    assert "--camera left" in refused.value.hint


def test_two_videos_of_one_length_are_joined(tmp_path: Path) -> None:
    source = _pair_videos(tmp_path, 5, 5)
    assert source.log.doubts == ()
    assert len(rows_of(source)) == 5


def _pair_folders(path: Path, lost: Sequence[int], names: str = "{}") -> FrameSource:
    """Return pairs of a camera that moves down; the numbers of right images skip none that was lost."""
    texture = np.kron(np.random.default_rng(5).integers(0, 256, (90, 60)), np.ones((6, 6))).astype(np.uint8)
    rights = [row for row in range(40) if row not in lost]
    for number, right in enumerate(rights):
        for side, row, column in (("left", number, 30), ("right", right, 40)):
            folder = path / names.format(side)
            folder.mkdir(exist_ok=True)
            cv2.imwrite(str(folder / f"{number:03}_{side}.png"), texture[5 * row :][:240, column:][:, :320])
    lens = {"fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5, "width": 320, "height": 240}
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 0.1
    cameras = [{**lens, "name": name, "T_body_camera": pose.tolist()}
               for name, pose in zip(("left", "right"), poses, strict=True)]  # fmt: skip
    (path / "rig.json").write_text(json.dumps({"cameras": cameras}))
    return open_camera(path)


@pytest.mark.parametrize(("lost", "most"), [((15,), 30), ((12, 13, 14), 25)])
def test_a_pair_whose_camera_loses_an_image_ends_there(
    tmp_path: Path, lost: Sequence[int], most: int
) -> None:
    frames = []
    with (
        _pair_folders(tmp_path, lost) as source,
        pytest.raises(UsageError, match="fit each other at the start, but no longer at") as refused,
    ):
        frames.extend(source)
    assert lost[0] < len(frames) <= most
    assert "--camera left" in refused.value.hint


def _sensor(path: Path, model: str) -> Path:
    from tests.client_sdk.datasets.test_rig_recordings import write_euroc

    file = write_euroc(path) / "mav0/cam0/sensor.yaml"
    file.write_text(f"{file.read_text()}distortion_model: {model}\n")
    return path


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (lambda path: folder_of(path, ["0.png"], distorsion=[0.1]), "the field 'distorsion' is not known"),
        (lambda path: folder_of(path, ["0.png"], k4=0.1), "a lens of model radial-tangential has no k4"),
        (lambda path: folder_of(path, ["0.png"], model="omni"), "the lens model 'omni' is not known"),
        (lambda path: folder_of(path, ["0.png"], camera_model="omni", distortion_model="none"),
         "the lens model 'omni' is not known"),
        (lambda path: folder_of(path, ["0.png"], camera_model="equidistant", distortion_model="radtan"),
         "model is fisheye and, as distortion_model, radial-tangential"),
        (lambda path: folder_of(path, ["0.png"], cx=65.0), "the principal point (65, 23.5) lies outside"),
        (lambda path: folder_of(path, ["0.png"], fx=600.0, fy=600.0), "a field of view of 6 degrees"),
        (lambda path: folder_of(path, ["0.png"], width=128), "images of 64x48 px, "),
        (lambda path: folder_of(path, ["0.png"], ["depth/0.png"], depth_scale=None, k1=0) and
         cv2.imwrite(str(path / "depth/0.png"), np.full((48, 64), 9000, np.uint16)) and path,
         "is 9 m at assumed 1000 units a metre"),
        (lambda path: tum(path, ["0", "0.2", "0.1", "0.3", "0.2"]), "2 of 5 time stamps are earlier"),
        (lambda path: kitti(path, (0, 1, 2), 2, 5),
         "not match: 3 images with numbers up to 000002, 2 lines in times.txt, 5 lines in poses.txt"),
        (lambda path: (tum(path, ["0"]) / "intrinsics.json").rename(path / "calibration.txt") and
         (path / "calibration.txt").write_text("50 51 30 20 0.1") and path,
         "calibration.txt holds 5 numbers, neither fx fy cx cy nor a matrix"),
        (lambda path: _sensor(path, "double-sphere"), "the lens model 'double-sphere' is not known"),
    ],
)  # fmt: skip
def test_contradictions_are_refused_in_one_line(
    tmp_path: Path, make: Callable[[Path], Path], line: str
) -> None:
    with pytest.raises(UsageError) as refused:
        open_camera(make(tmp_path))
    assert line in refused.value.message
    assert "\n" not in refused.value.message
    assert refused.value.hint


@pytest.mark.parametrize("model", ["equidistant", "radial-tangential", "none"])
def test_the_lens_model_of_euroc_is_read(tmp_path: Path, model: str) -> None:
    with open_camera(_sensor(tmp_path, model), imu=False) as source:
        assert next(source).rgb.shape == (48, 64, 3)


def test_a_camchain_of_one_camera_belongs_to_a_folder_of_images(tmp_path: Path) -> None:
    pytest.importorskip("yaml", reason="pip install 'rse-pf[vision]'")
    folder = folder_of(tmp_path, ["0.png"])
    (folder / "camchain.yaml").write_text(
        "cam0: {camera_model: pinhole, distortion_model: radtan, distortion_coeffs: [0, 0, 0, 0], "
        "intrinsics: [61, 61, 31, 23], resolution: [64, 48]}"
    )
    with open_camera(folder, intrinsics=folder / "camchain.yaml") as source:
        assert next(source).camera.fx == 61.0


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("opencv.yaml", "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n  rows: 3\n"),
        ("ros.yaml", "image_width: 64\ncamera_matrix: {rows: 3, cols: 3}\n"),
        ("orbslam3.yaml", '%YAML:1.0\n\nCamera.type: "PinHole"\nCamera1.fx: 60\n'),
        ("cameras.txt", "# Camera list\n1 OPENCV 64 48 60 60 32 24 0 0 0 0\n"),
    ],
)
def test_calibrations_of_other_programs_name_the_way_to_intrinsics(
    tmp_path: Path, name: str, text: str
) -> None:
    pytest.importorskip("yaml", reason="pip install 'rse-pf[vision]'")
    (folder_of(tmp_path, ["0.png"]) / name).write_text(text)
    with pytest.raises(UsageError) as refused:
        open_camera(tmp_path, intrinsics=tmp_path / name)
    assert "intrinsics.json" in refused.value.hint


def test_a_projection_without_a_distortion_model_keeps_its_projection(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, ["0.png"], camera_model="equidistant", distortion_model="none")

    assert read_intrinsics(folder / "intrinsics.json").model == "fisheye"
