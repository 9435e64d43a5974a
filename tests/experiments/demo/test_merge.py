"""The end of a demo: the robots' files become one map, and what was not joined stays out of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.frontend import Frame, FrontEndOptions, TrackedFrame
from client_sdk.mapping import Trajectory, read_ply, read_trajectory
from rse_pf.config import ServiceSettings
from rse_pf.errors import CommandFailed
from rse_pf.experiments.demo.keyframes import MAP_FILE, KeyframeKeeper
from rse_pf.experiments.demo.merge import MERGED_MAP, write_merged
from rse_pf.geometry import Camera
from rse_pf.maps.format import MapVersion, decode_map, encode_map
from rse_pf.services.mapping.merge import MergeReply, MergeRequest, merge_maps
from rse_pf.services.synthetic_maps import make_world

for package in ("faiss", "gtsam", "PIL", "cv2"):
    pytest.importorskip(package, reason="the extras maps, local and vision are needed")

WORLD = make_world(1)
CAMERA = Camera(fx=200.0, fy=200.0, cx=159.5, cy=119.5, width=320, height=240)


def demo_folder(folder: Path, maps: list[MapVersion]) -> list[Trajectory]:
    """Write robots' maps with a small cloud each; return their paths: a frame a keyframe."""
    paths = []
    for number, version in enumerate(maps):
        own = folder / f"robot-{number + 1}"
        own.mkdir()
        cloud = np.random.default_rng(number).uniform((-1, -1, 2), (1, 1, 4), (50, 3))
        whole = MapVersion(
            keyframes=version.keyframes,
            points=cloud.astype(np.float32),
            colours=np.full((50, 3), 40 * number, np.uint8),
        )
        (own / MAP_FILE).write_bytes(encode_map(whole))
        stamps = np.array([each.timestamp_s for each in version.keyframes])
        paths.append(
            Trajectory(
                stamps, np.array([each.T_world_camera for each in version.keyframes]).reshape(-1, 4, 4)
            )
        )
    return paths


def merge_here(maps: Sequence[bytes]) -> tuple[MergeReply, dict[str, Any]]:
    return merge_maps(MergeRequest(maps=list(maps)), ServiceSettings()), {"merged_by": "this test"}


def merge(folder: Path, paths: list[Trajectory], truths: list[Trajectory | None]) -> dict[str, Any]:
    names = [f"robot-{number + 1}" for number in range(len(paths))]
    return write_merged(folder, names, paths, truths, merge_here)


def test_robots_that_share_views_end_in_one_map_and_strangers_stay_out(tmp_path: Path) -> None:
    a, truth_a = WORLD.walk("robot-1", np.linspace(0.0, 0.5, 13), seed=1)
    b, truth_b = WORLD.walk("robot-2", np.linspace(0.3, 0.8, 13), seed=2)
    stranger, truth_s = make_world(2).walk("robot-3", np.linspace(0.0, 0.3, 8), seed=3)
    paths = demo_folder(tmp_path, [a, b, stranger])
    truths = [Trajectory(p.timestamps_s, t) for p, t in zip(paths, (truth_a, truth_b, truth_s), strict=True)]

    section = merge(tmp_path, paths, list(truths))

    assert section["joined"] == ["robot-1", "robot-2"]
    (left_out,) = section["not_joined"]
    assert left_out["robot"] == "robot-3"
    assert left_out["reason"]
    assert section["ate_cm"] < 5.0
    assert section["links_between_robots"] >= 3
    merged = decode_map((tmp_path / MERGED_MAP).read_bytes())
    assert {each.robot for each in merged.keyframes} == {"robot-1", "robot-2"}
    points, colours = read_ply(tmp_path / "merged.ply")
    assert 0 < len(points) <= 100
    assert set(np.unique(colours)) == {0, 40}
    assert len(read_trajectory(tmp_path / "robot-2" / "merged_trajectory.txt")) == 13
    assert not (tmp_path / "robot-3" / "merged_trajectory.txt").exists()
    assert (tmp_path / "map_merged.png").read_bytes().startswith(b"\x89PNG")


def test_a_robot_without_keyframes_is_named(tmp_path: Path) -> None:
    a, _ = WORLD.walk("robot-1", np.linspace(0.0, 0.2, 4), seed=1)
    paths = demo_folder(tmp_path, [a, MapVersion(keyframes=())])

    with pytest.raises(CommandFailed, match="robot-2 made no keyframe"):
        merge(tmp_path, paths, [None, None])


def tracked(*, keyframe: bool, seed: int = 0) -> TrackedFrame:
    rgb = np.kron(np.random.default_rng(seed).integers(0, 256, (24, 32, 3)), np.ones((10, 10, 1))).astype(
        np.uint8
    )
    frame = Frame(timestamp_s=1.5, rgb=rgb, depth_m=np.full((240, 320), 2.0, np.float32), camera=CAMERA)
    return TrackedFrame(frame=frame, T_world_camera=np.eye(4), keyframe=keyframe, inliers=9, matches=9)


class Listener:
    """Stands in for the data service."""

    def __init__(self) -> None:
        self.handed: list[bytes] = []
        self.maps: dict[str, bytes] = {}

    def keyframe(self, data: bytes) -> None:
        self.handed.append(data)

    def finish(self, robot: str, data: bytes) -> int:
        self.maps[robot] = data
        return len(self.handed)


def test_a_robot_keeps_its_keyframes_and_hands_each_over_once() -> None:
    others = Listener()
    keeper = KeyframeKeeper("robot-1", FrontEndOptions(), others)

    for step in (tracked(keyframe=True), tracked(keyframe=False, seed=1), tracked(keyframe=True, seed=2)):
        keeper.see(step)

    assert len(keeper) == len(others.handed) == 2
    version = decode_map(keeper.encoded_map(np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8)))
    assert [each.id for each in version.keyframes] == [0, 1]
    assert version.provenance["robot"] == "robot-1"
    (sent,) = decode_map(others.handed[1]).keyframes
    assert len(sent.pixels) > 50
    np.testing.assert_array_equal(sent.descriptors, version.keyframes[1].descriptors)
    np.testing.assert_allclose(sent.points_camera[:, 2], 2.0, atol=1e-4)

    whole = encode_map(version)
    keeper.share(whole)
    assert others.maps == {"robot-1": whole}
    assert keeper.uploaded == 2
