"""Readers of EuRoC and KITTI, on generated files with values computed by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from client_sdk.datasets import open_dataset
from client_sdk.datasets.rig_recordings import is_euroc, is_kitti, open_euroc, open_kitti
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, exp_se3, inverse

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

T_BS = exp_se3(np.array([0.1, -0.2, 0.3, 0.2, 0.1, -1.4]))
SENSOR = """# a camera
T_BS:
  cols: 4
  rows: 4
  data: [{data}]
resolution: [64, 48]
intrinsics: [60.0, 61.0, 31.5, 23.5] #fu, fv, cu, cv
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""
IMU = """#IMU
T_BS:
  data: [{data}]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04     # [ rad / s / sqrt(Hz) ]
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""
T_LEFT_RIGHT = exp_se3(np.array([0.2, 0.001, -0.002, 0.01, 0.05, -0.02]))
T_BI = exp_se3(np.array([0.01, 0.02, 0.03, 0.3, -0.2, 0.1]))
FIRST_NS = 1_403_636_579_763_555_584


def write_euroc(folder: Path, frames: int = 3) -> Path:
    stamps = [FIRST_NS + 50_000_000 * row for row in range(frames)]
    write_camera(folder / "mav0" / "cam0", T_BS, stamps, step=10)
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    half = np.sqrt(0.5)
    rows = [f"{stamp},{row},2,3,{half},0,0,{half},0,0,0" for row, stamp in enumerate(stamps)]
    (truth / "data.csv").write_text("\n".join(["#timestamp, p, q", *rows]) + "\n")
    return folder


def write_camera(folder: Path, pose: Array, stamps: list[int], *, step: int) -> None:
    (folder / "data").mkdir(parents=True)
    (folder / "sensor.yaml").write_text(SENSOR.format(data=numbers(pose)))
    lines = ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png\r" for stamp in stamps)]
    (folder / "data.csv").write_text("\n".join(lines) + "\n")
    for row, stamp in enumerate(stamps):
        cv2.imwrite(str(folder / "data" / f"{stamp}.png"), np.full((48, 64), step * row, np.uint8))


def numbers(pose: Array) -> str:
    return ",\n  ".join(", ".join(repr(float(value)) for value in row) for row in pose)


def write_right_and_imu(folder: Path, frames: int = 3) -> Path:
    """Add a right camera, 0.2 m beside the left one and turned by 3 degrees, and an IMU of 200 Hz."""
    stamps = [FIRST_NS + 50_000_000 * row for row in range(frames)]
    write_camera(folder / "mav0" / "cam1", T_BS @ T_LEFT_RIGHT, stamps, step=20)
    imu = folder / "mav0" / "imu0"
    imu.mkdir()
    (imu / "sensor.yaml").write_text(IMU.format(data=numbers(T_BI)))
    rows = [f"{FIRST_NS + 5_000_000 * row},{row},0,0,0,0,9.81" for row in range(-10, 10 * frames + 20)]
    (imu / "data.csv").write_text("\n".join(["#timestamp [ns],w,a", *rows]) + "\n")
    return folder


def write_kitti(folder: Path, frames: int = 3, poses: Path | None = None) -> Path:
    (folder / "image_0").mkdir(parents=True)
    for row in range(frames):
        cv2.imwrite(str(folder / "image_0" / f"{row:06}.png"), np.full((30, 90), row, np.uint8))
    (folder / "calib.txt").write_text("P0: 70 0 44 0 0 71 14 0 0 0 1 0\nP1: 70 0 44 -9 0 71 14 0 0 0 1 0\n")
    (folder / "times.txt").write_text("".join(f"{row / 10}\n" for row in range(frames)))
    path = poses or folder / "poses.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"1 0 0 {row} 0 1 0 0 0 0 1 5\n" for row in range(frames)))
    return folder


def test_euroc_gives_the_left_camera_and_its_own_true_poses(tmp_path: Path) -> None:
    folder = write_euroc(tmp_path / "MH_01")

    dataset = open_euroc(folder)

    assert is_euroc(folder)
    assert (dataset.name, len(dataset), dataset.has_depth) == ("MH_01", 3, False)
    assert np.diff(dataset.timestamps_s) == pytest.approx([0.05, 0.05], abs=1e-6)
    assert dataset.timestamps_s[0] == pytest.approx(FIRST_NS / 1e9, abs=1e-6)
    assert list(dataset)[2].rgb[5, 5].tolist() == [20, 20, 20]
    assert not next(iter(dataset)).depth_m.any()
    turned = np.array([[0, -1, 0, 2], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    assert dataset.truth is not None
    np.testing.assert_allclose(dataset.truth.T_world_camera[2], turned @ T_BS, atol=1e-12)
    np.testing.assert_allclose(dataset.T_body_camera, T_BS)
    assert all(np.array_equal(frame.T_body_camera, T_BS) for frame in dataset)


def test_a_stereo_pair_of_euroc_is_rectified_and_its_truth_turned_with_it(tmp_path: Path) -> None:
    folder = write_right_and_imu(write_euroc(tmp_path / "MH_01"))

    dataset = open_euroc(folder)
    alone = open_euroc(folder, camera="left", imu=False)

    assert (dataset.sensors, alone.sensors) == ("stereo + IMU", "one lens")
    frame = list(dataset)[2]
    assert frame.stereo is not None
    assert (int(frame.rgb[24, 32, 0]), int(frame.stereo.gray[24, 32])) == (20, 40)
    assert frame.stereo.baseline_m == pytest.approx(np.linalg.norm(T_LEFT_RIGHT[:3, 3]), abs=1e-9)
    assert dataset.T_body_camera is not None
    assert dataset.truth is not None
    assert alone.truth is not None
    # The rectified camera sits where the left one sits, and its x points at the right one.
    T_left_rectified = inverse(T_BS) @ dataset.T_body_camera
    np.testing.assert_allclose(T_left_rectified[:3, 3], 0.0, atol=1e-12)
    across = T_LEFT_RIGHT[:3, 3] / np.linalg.norm(T_LEFT_RIGHT[:3, 3])
    np.testing.assert_allclose(T_left_rectified[:3, 0], across, atol=1e-9)
    np.testing.assert_allclose(
        dataset.truth.T_world_camera, alone.truth.T_world_camera @ T_left_rectified, atol=1e-9
    )


def test_frames_carry_the_imu_since_the_frame_before(tmp_path: Path) -> None:
    folder = write_right_and_imu(write_euroc(tmp_path / "MH_01", frames=5), frames=5)

    dataset = open_euroc(folder)
    first, second, third = dataset.thinned(10.0)

    assert first.imu is not None
    assert second.imu is not None
    assert third.imu is not None
    assert first.imu.gyro[:, 0].tolist() == [0]
    assert second.imu.gyro[:, 0].tolist() == list(range(21))
    assert third.imu.gyro[:, 0].tolist() == list(range(20, 41))
    assert second.imu.timestamps_s[[0, -1]] == pytest.approx([first.timestamp_s, second.timestamp_s])
    model = second.imu.model
    assert (model.rate_hz, model.gyro_noise, model.accel_walk) == (200.0, 1.6968e-4, 3e-3)
    assert dataset.T_body_camera is not None
    np.testing.assert_allclose(model.T_imu_camera, inverse(T_BI) @ dataset.T_body_camera, atol=1e-9)


def test_left_images_without_a_right_one_are_left_out_and_counted(tmp_path: Path) -> None:
    folder = write_right_and_imu(write_euroc(tmp_path / "MH_01"))
    data = folder / "mav0/cam1/data.csv"
    lines = data.read_text().splitlines()
    data.write_text("\n".join([lines[0], *lines[2:]]))

    dataset = open_euroc(folder)

    assert (len(dataset), len(open_euroc(folder, camera="left"))) == (2, 3)
    (doubt,) = dataset.log.doubts
    assert doubt.sentence == "1 of 3 images of MH_01's left camera have no right one, and are left out"
    assert [int(frame.rgb[24, 32, 0]) for frame in dataset] == [10, 20]


def test_what_a_recording_has_not_is_said_by_the_option(tmp_path: Path) -> None:
    euroc, kitti = write_euroc(tmp_path / "e"), write_kitti(tmp_path / "k")

    with pytest.raises(UsageError, match="has no cam1"):
        open_dataset(euroc, camera="stereo")
    with pytest.raises(UsageError, match="has no imu0"):
        open_dataset(euroc, imu=True)
    with pytest.raises(UsageError, match="has no image_1"):
        open_dataset(kitti, camera="stereo")
    with pytest.raises(UsageError, match="has no IMU"):
        open_dataset(kitti, imu=True)


def test_the_right_camera_of_kitti_sits_to_the_right(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / "06")
    (folder / "image_1").mkdir()
    for row in range(3):
        cv2.imwrite(str(folder / "image_1" / f"{row:06}.png"), np.full((30, 90), 10 * row, np.uint8))

    dataset = open_dataset(folder)
    frame = list(dataset)[1]

    assert (dataset.sensors, dataset.T_body_camera) == ("stereo", None)
    assert frame.stereo is not None
    assert frame.stereo.baseline_m == pytest.approx(9 / 70)
    assert (int(frame.rgb[5, 5, 0]), int(frame.stereo.gray[5, 5])) == (1, 10)
    assert dataset.truth is not None
    assert dataset.truth.positions.tolist() == [[0, 0, 5], [1, 0, 5], [2, 0, 5]]


@pytest.mark.parametrize("is_apart", [False, True])
def test_kitti_gives_the_left_camera_and_its_poses(tmp_path: Path, is_apart: bool) -> None:
    apart = tmp_path / "poses" / "06.txt" if is_apart else None
    folder = write_kitti(tmp_path / "sequences" / "06", poses=apart)

    dataset = open_kitti(folder)

    assert is_kitti(folder)
    assert (dataset.name, dataset.timestamps_s, dataset.has_depth) == ("06", (0.0, 0.1, 0.2), False)
    camera = dataset.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width) == (70.0, 71.0, 44.0, 14.0, 90)
    assert dataset.truth is not None
    assert dataset.truth.positions.tolist() == [[0, 0, 5], [1, 0, 5], [2, 0, 5]]
    assert dataset.T_body_camera is None


def test_recordings_without_truth_are_read(tmp_path: Path) -> None:
    euroc, kitti = write_euroc(tmp_path / "e"), write_kitti(tmp_path / "k")
    (euroc / "mav0/state_groundtruth_estimate0/data.csv").unlink()
    (kitti / "poses.txt").unlink()

    assert (open_euroc(euroc).truth, open_euroc(euroc).truth_kind) == (None, "none")
    assert open_kitti(kitti).truth is None


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("mav0/cam0/sensor.yaml", "intrinsics: [1, 2, 3]\n", "does not describe a camera"),
        ("mav0/cam0/sensor.yaml", SENSOR.format(data="1, x"), "no number"),
        ("mav0/cam0/data.csv", "#\n12\n", "less than 2 values"),
        ("mav0/cam0/data.csv", "#\n", "has no images"),
        ("mav0/cam0/data.csv", "2,b.png\n1,a.png\n", "1 of 2 time stamps are earlier"),
        ("mav0/cam0/data.csv", "x,a.png\n", "no number"),
        ("mav0/cam0/data.csv", "1,../a.png\n", "no image of its folder"),
        ("mav0/cam0/data.csv", "1,/etc/a.png\n", "no image of its folder"),
        ("mav0/state_groundtruth_estimate0/data.csv", "1,2,3\n", "less than 8 values"),
    ],
)
def test_a_broken_file_of_euroc_is_one_line(tmp_path: Path, file: str, text: str, says: str) -> None:
    folder = write_euroc(tmp_path / "x")
    (folder / file).write_text(text)

    with pytest.raises(UsageError, match=says):
        open_euroc(folder)


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("calib.txt", "P0: 1 2\n", "12 numbers of P0"),
        ("calib.txt", "", "12 numbers of P0"),
        ("times.txt", "0.0\nx\n", "no number"),
        ("times.txt", "0.0\nnan\n", "not finite"),
        ("times.txt", "0.2\n0.1\n0.0\n", "2 of 3 time stamps are earlier"),
        ("poses.txt", "1 2 3\n", "12 in each line"),
    ],
)
def test_a_broken_file_of_kitti_is_one_line(tmp_path: Path, file: str, text: str, says: str) -> None:
    folder = write_kitti(tmp_path / "x")
    (folder / file).write_text(text)

    with pytest.raises(UsageError, match=says):
        open_kitti(folder)
