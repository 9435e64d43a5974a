"""The verbs map from-bag and map to-bag: a bag becomes a map, and a map a bag."""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import client_sdk
from client_sdk.bags import BagKind, BagWriter
from client_sdk.bags.bag_file import open_bag_file
from client_sdk.bags.message_types import CAMERA_INFO, IMAGE, PATH, POINT_CLOUD, POSE, TF
from client_sdk.point_map import write_ply
from client_sdk.trajectory import Trajectory, read_trajectory, write_trajectory
from rse_pf.cli.main import main
from tests.cli.maps.test_from_camera import PLATFORM, SolvingRobot
from tests.kit.flat_world import CAMERA, STEP_M, frame_at
from tests.kit.small_bags import camera_info, raw_image, stamp_of, transforms

pytest.importorskip("cv2", reason="pip install 'rse-pf[bags]'")
pytest.importorskip("rosbags", reason="pip install 'rse-pf[bags]'")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a bag of six frames, a token, and a platform that answers at ws://p/ws."""

    @contextlib.asynccontextmanager
    async def connect(url: str, **options: Any) -> AsyncIterator[SolvingRobot]:
        yield SolvingRobot()

    monkeypatch.setattr(client_sdk, "connect", connect, raising=False)
    monkeypatch.chdir(tmp_path)
    K = np.array([CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1.0])
    with BagWriter(Path("drive.bag"), "ros1") as w:
        for row in range(6):
            frame, stamp = frame_at(row, depth=True), stamp_of(row)
            info = camera_info(w, stamp, k=K, width=CAMERA.width, height=CAMERA.height)
            moved = transforms(w, stamp, "world", "eye", (STEP_M * row, 0, 0))
            w.write("/cam/camera_info", CAMERA_INFO, stamp, info)
            w.write("/cam/image", IMAGE, stamp, raw_image(w, stamp, frame.rgb, "rgb8"))
            w.write("/cam/depth", IMAGE, stamp, raw_image(w, stamp, frame.depth_m, "32FC1"))
            w.write("/tf", TF, stamp, moved)
    Path("token").write_text("secret\n")
    return tmp_path


@pytest.fixture
def stereo_bag(folder: Path) -> Path:
    """A bag of a pair without depth: the right camera sits where the left one is a step later."""
    K = np.array([CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1.0])
    with BagWriter(folder / "pair.bag", "ros1") as w:
        for row in range(6):
            stamp = stamp_of(row)
            for side, ahead in (("left", 0), ("right", 1)):
                P = np.zeros((3, 4))
                P[:, :3] = CAMERA.matrix
                P[0, 3] = -CAMERA.fx * STEP_M * ahead
                info = camera_info(w, stamp, k=K, p=P.ravel(), width=CAMERA.width, height=CAMERA.height)
                image = raw_image(w, stamp, frame_at(row + ahead, depth=False).rgb, "rgb8")
                w.write(f"/{side}/camera_info", CAMERA_INFO, stamp, info)
                w.write(f"/{side}/image_rect_color", IMAGE, stamp, image)
            moved = transforms(w, stamp, "world", "eye", (STEP_M * row, 0, 0))
            w.write("/tf", TF, stamp, moved)
    return folder / "pair.bag"


def test_a_bag_of_a_stereo_pair_becomes_a_map_in_metres(
    stereo_bag: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["map", "from-bag", "pair.bag", *PLATFORM])

    out = capsys.readouterr().out
    assert code == 0, out
    report = json.loads(Path("out-bag/report.json").read_text())
    assert report["topics"] == {"colour": "/left/image_rect_color", "right": "/right/image_rect_color"}
    assert report["unit"] == "m"
    assert report["ate_cm"] < 1.0
    assert "left: /left/image_rect_color, rgb8, 6 messages" in out


def test_a_bag_becomes_a_map_with_its_error_against_tf(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["map", "from-bag", "drive.bag", *PLATFORM])

    out = capsys.readouterr().out
    assert code == 0, out
    report = json.loads(Path("out-bag/report.json").read_text())
    assert report["topics"] == {"colour": "/cam/image", "depth": "/cam/depth"}
    assert report["truth"] == "ground truth"
    assert report["ate_cm"] < 1.0
    assert len(read_trajectory(Path("out-bag/trajectory.txt"))) == 6
    assert {"map.ply", "map.png"} <= {each.name for each in Path("out-bag").iterdir()}
    assert "colour: /cam/image, rgb8, 6 messages" in out


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_results_become_a_bag_of_poses_path_and_cloud(folder: Path, kind: BagKind) -> None:
    Path("out").mkdir()
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (0.0, 1.0, 2.0)
    write_trajectory(Path("out/trajectory.txt"), Trajectory(np.array([10.0, 10.5, 11.0]), poses))
    points = np.array([[1, 2, 3], [4, 5, 6]], dtype=np.float32)
    write_ply(Path("out/map.ply"), points, np.array([[255, 1, 2], [3, 4, 5]], dtype=np.uint8))
    file = {"ros1": "map.bag", "sqlite3": "map.db3", "mcap": "map.mcap"}[kind]

    assert main(["map", "to-bag", "out", "--out", file]) == 0

    with open_bag_file(Path(file)) as bag:
        counts = {topic.name: (topic.kind, topic.messages) for topic in bag.topics}
        assert counts == {
            "/robot/pose": (POSE, 3), "/robot/path": (PATH, 1), "/tf": (TF, 3), "/map": (POINT_CLOUD, 1)
        }  # fmt: skip
        seen = [bag.parse(raw) for raw in bag.messages(["/robot/pose"])]
        assert [each.pose.position.x for each in seen] == [0.0, 1.0, 2.0]
        assert [raw.log_ns for raw in bag.messages(["/robot/pose"])] == [10 * 10**9, 105 * 10**8, 11 * 10**9]
        (cloud,) = [bag.parse(raw) for raw in bag.messages(["/map"])]
        rows = cloud.data.view([("xyz", "<f4", (3,)), ("rgb", "<u4")])
        assert np.array_equal(rows["xyz"], points)
        assert rows["rgb"].tolist() == [0xFF0102, 0x030405]
    assert main(["map", "to-bag", "out", "--out", file]) == 2  # it is there already
    assert not list(Path().glob(".bag-*"))
