"""Files of rigs: our own, and those of Kalibr; hostile ones are one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from client_sdk.cameras import Intrinsics, Rig, RigCamera, RigImu, read_rig, write_rig
from client_sdk.rigs.rig_file import read_calibration
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_se3, inverse

CAMERA = Camera(fx=400.0, fy=401.0, cx=320.0, cy=240.0, width=640, height=480)
LENS = Intrinsics(camera=CAMERA, distortion=(0.1, -0.02, 0.003, 0.001), model="fisheye")
T_LEFT_RIGHT = exp_se3(np.array([0.11, 0.001, 0.0, 0.01, 0.02, 0.005]))
T_IMU_LEFT = exp_se3(np.array([0.05, -0.02, 0.01, 0.3, -1.2, 0.4]))
RIG = Rig(
    cameras=(
        RigCamera(name="left", lens=LENS, T_body_camera=T_IMU_LEFT),
        RigCamera(name="right", lens=LENS, T_body_camera=T_IMU_LEFT @ T_LEFT_RIGHT, time_offset_s=0.01),
    ),
    imu=RigImu(
        T_body_imu=np.eye(4), gyro_noise=1.7e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3,
        rate_hz=200.0, max_gyro=17.0,
    ),
)  # fmt: skip
CAMCHAIN = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.02, 0.003, 0.001]
  distortion_model: equidistant
  intrinsics: [400.0, 401.0, 320.0, 240.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
{imu0}cam1:
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.02, 0.003, 0.001]
  distortion_model: equidistant
  intrinsics: [400.0, 401.0, 320.0, 240.0]
  resolution: [640, 480]
{imu1}  T_cn_cnm1: {right_left}
"""
IMU = """imu0:
  accelerometer_noise_density: 0.002
  accelerometer_random_walk: 0.003
  gyroscope_noise_density: 0.00017
  gyroscope_random_walk: 2.0e-05
  update_rate: 200.0
"""


def rows(pose: Array) -> str:
    return json.dumps(pose.tolist())


def nested_aliases(name: str) -> str:
    """Return a camchain of some hundred bytes, of which *name* unfolds to 10^9 numbers."""
    lists = [
        f"a{row}: &a{row} [" + ", ".join([f"*a{row - 1}" if row else "1"] * 10) + "]" for row in range(9)
    ]
    camera = {"camera_model": "pinhole", "intrinsics": "[1, 1, 1, 1]", "resolution": "[2, 2]", name: "*a8"}
    return "\n".join([*lists, "cam0:", *(f"  {key}: {value}" for key, value in camera.items())])


def camchain(folder: Path, *, with_imu: bool) -> Path:
    poses = {"imu0": T_IMU_LEFT, "imu1": T_IMU_LEFT @ T_LEFT_RIGHT}
    lines = {
        name: f"  T_cam_imu: {rows(inverse(pose))}\n  timeshift_cam_imu: 0.004\n" if with_imu else ""
        for name, pose in poses.items()
    }
    path = folder / ("x-camchain-imucam.yaml" if with_imu else "camchain.yaml")
    path.write_text(CAMCHAIN.format(right_left=rows(inverse(T_LEFT_RIGHT)), **lines))
    (folder / "x-imu.yaml").write_text(IMU)
    return path


def test_a_rig_is_read_as_it_was_written(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig.json", RIG)

    read = read_rig(tmp_path / "rig.json")

    assert [(each.name, each.lens, each.time_offset_s) for each in read.cameras] == [
        ("left", LENS, 0.0), ("right", LENS, 0.01),
    ]  # fmt: skip
    for one, other in zip(read.cameras, RIG.cameras, strict=True):
        np.testing.assert_array_equal(one.T_body_camera, other.T_body_camera)
    assert read.imu is not None
    assert (read.imu.gyro_noise, read.imu.max_gyro, read.imu.max_accel) == (1.7e-4, 17.0, np.inf)


@pytest.mark.parametrize("with_imu", [False, True])
def test_a_camchain_of_kalibr_gives_the_right_camera_beside_the_left_one(
    tmp_path: Path, with_imu: bool
) -> None:
    pytest.importorskip("yaml", reason="pip install 'rse-pf[vision]'")

    rig = read_rig(camchain(tmp_path, with_imu=with_imu))

    assert rig.right is not None
    assert (rig.left.lens, rig.left.name, rig.right.name) == (LENS, "left", "right")
    np.testing.assert_allclose(
        inverse(rig.left.T_body_camera) @ rig.right.T_body_camera, T_LEFT_RIGHT, atol=1e-12
    )
    np.testing.assert_allclose(rig.left.T_body_camera, T_IMU_LEFT if with_imu else np.eye(4), atol=1e-12)
    assert (rig.imu is not None) == with_imu
    if rig.imu is not None:
        assert (rig.imu.accel_walk, rig.imu.rate_hz, rig.left.time_offset_s) == (0.003, 200.0, 0.004)


def test_intrinsics_alone_are_distinguished_from_a_rig(tmp_path: Path) -> None:
    path = tmp_path / "one.json"
    path.write_text('{"fx": 400, "fy": 401, "cx": 320, "cy": 240, "width": 640, "height": 480}')

    assert isinstance(read_calibration(path), Intrinsics)
    with pytest.raises(UsageError, match="one camera, and no rig"):
        read_rig(path)


NUMBERS = '"fx": 400, "fy": 401, "cx": 320, "cy": 240, "width": 640, "height": 480'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{", "not a file of intrinsics"),
        ("[" * 100_000, "not a file of intrinsics"),
        ('{"cameras": 3}', "not a file of intrinsics"),
        ('{"cameras": []}', "0 cameras"),
        ('{"cameras": [{"name": "a"}]}', "has no fx"),
        ('{"cameras": [{"name": "a", NUMBERS}]}' , "has no T_body_camera"),
        ('{"cameras": [{"name": "a", NUMBERS, "T_body_camera": [[1]]}]}' , "no rigid motion"),
        (
            '{"cameras": [{"name": "a", NUMBERS, "T_body_camera": '
            "[[1,0,0,NaN],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}" ,
            "no rigid motion",
        ),
        (
            '{"cameras": [{"name": "a", NUMBERS, "T_body_camera": '
            "[[1,0,0,1e9],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}" ,
            "no rigid motion within 10 m",
        ),
        (
            '{"cameras": [{"name": "a", NUMBERS, "time_offset_s": 40, "T_body_camera": '
            "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}" ,
            "time offset 40 s of a is not within 1 s",
        ),
        ('{"cameras": [{"name": "a", NUMBERS, "model": "omni"}]}', "lens model .omni. is not known"),
    ],
)  # fmt: skip
def test_a_broken_rig_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "rig.json"
    path.write_text(text.replace("NUMBERS", NUMBERS))

    with pytest.raises(UsageError, match=says) as told:
        read_rig(path)
    assert told.value.hint


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: [", "not a camchain of Kalibr"),
        ("- 1", "not a camchain of Kalibr"),
        ("[" * 100_000, "not a camchain of Kalibr"),
        ("a: &a [1]\n" * 3 + "cam0: *a", "not a camchain of Kalibr"),
        ("cam0: &a [*a, *a]", "aliases"),
        (nested_aliases("T_cam_imu"), "aliases"),
        (nested_aliases("camera_model"), "aliases"),
        ("cam0: {camera_model: [" + "1, " * 50_000 + "]}", r"model \[1, 1, .{20,40} with"),
        ("cam0: {camera_model: omni}", "model omni"),
        ("cam0: {camera_model: pinhole, distortion_model: radtan}", "has no intrinsics"),
        ("!!python/object/apply:os.system ['true']", "not a camchain of Kalibr"),
        ("cam1: {}", "no camera cam0"),
        (" " * 300_000, "longer than 262144 bytes"),
    ],
)
def test_a_hostile_camchain_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    pytest.importorskip("yaml", reason="pip install 'rse-pf[vision]'")
    path = tmp_path / "camchain.yaml"
    path.write_text(text)

    with pytest.raises(UsageError, match=says) as told:
        read_rig(path)
    assert told.value.hint
