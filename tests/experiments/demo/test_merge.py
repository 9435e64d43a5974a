"""The end of a demo: the maps of the robots become one map, without those that could not be joined."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.point_map import read_ply
from client_sdk.trajectory import Trajectory, read_trajectory
from rse_pf.extensions.experiments.demo.merge import MAP_FILE, MERGED_MAP, write_merged
from rse_pf.maps.format import MapVersion, decode_map, encode_map
from rse_pf.services.mapping.merge import MergeReply, MergeRequest, merge_maps
from tests.kit.synthetic_maps import make_world

for package in ("gtsam", "PIL", "cv2"):
    pytest.importorskip(package, reason="the extras maps, local and vision are needed")

WORLD = make_world(1)


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
    return merge_maps(MergeRequest(maps=list(maps))), {"merged_by": "this test"}


def merge(folder: Path, paths: list[Trajectory], truths: list[Trajectory | None]) -> dict[str, Any]:
    names = [f"robot-{number + 1}" for number in range(len(paths))]
    return write_merged(folder, names, paths, truths, merge_here)


def test_robots_that_share_views_end_in_one_map_and_others_are_left_out(tmp_path: Path) -> None:
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
