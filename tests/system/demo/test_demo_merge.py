"""demo --merge through the whole platform: data by HTTP, the merge as a job, one map at the end."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from client_sdk.point_map import read_ply
from client_sdk.trajectory import read_trajectory
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore

pytestmark = pytest.mark.system

for package in ("gtsam", "PIL", "cv2", "uvicorn"):
    pytest.importorskip(package, reason="the extras maps, demo and data are needed")


def demo(out: Path, *options: str, within_s: float) -> tuple[dict[str, Any], str]:
    command = [sys.executable, "-m", "rse_pf.cli.main", "demo", "--merge", "--quiet", "--out", str(out)]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=within_s, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads((out / "report.json").read_text())["merged"], done.stdout


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_robots_without_a_shared_view_are_not_joined_and_the_reason_is_printed(tmp_path: Path) -> None:
    out = tmp_path / "out"

    merged, said = demo(out, "--robots", "2", "--frames", "5", "--rate", "20", within_s=220)

    assert merged["joined"] == ["robot-1"]
    (left_out,) = merged["not_joined"]
    assert left_out["robot"] == "robot-2"
    assert f"robot-2 not joined: {left_out['reason']}" in said
    assert merged["merged_by"] in ("server-1", "server-2")
    maps = MapRegistry(DirectoryStore(out / "platform" / "objects"))
    assert maps.names() == ["merged", "robot-1", "robot-2"]
    assert all(maps.load(name).keyframes for name in ("robot-1", "robot-2"))
    assert maps.head("merged").id == merged["map"]["version"]
    assert {each.robot for each in maps.load("merged").keyframes} == {"robot-1"}
    assert (out / "map_merged.png").read_bytes().startswith(b"\x89PNG")
    assert not (out / "robot-2" / "merged_trajectory.txt").exists()


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.timeout(400)
def test_three_robots_in_the_red_kitchen_end_in_one_map_within_the_limits(tmp_path: Path) -> None:
    recording = Path(__file__).parents[3].parent / "shared" / "data" / "7scenes_redkitchen"
    if not recording.is_dir():
        pytest.skip(f"there is no recording {recording}")
    out = tmp_path / "out"

    merged, said = demo(out, "--recording", str(recording), "--rate", "10", "--robots", "3", within_s=380)

    assert merged["joined"] == ["robot-1", "robot-2", "robot-3"]
    assert merged["ate_cm"] <= 4.5
    assert all(each["cm"] <= 7.0 and each["deg"] <= 2.5 for each in merged["origins"])
    assert f"{merged['loop_closures_between_robots']} loop closures between robots" in said
    assert len(read_ply(out / "merged.ply")[0]) == merged["points"] > 100_000
    paths = [read_trajectory(out / name / "merged_trajectory.txt") for name in merged["joined"]]
    assert sum(len(path) for path in paths) == merged["frames"] == 250
