"""Maps of drives are kept where the other verbs find them, and can be localised in, merged and extended."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk.trajectory import Trajectory, write_trajectory
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.local.processes import ProcessMark, mark_of
from rse_pf.local.state import PlatformState, settings_file
from rse_pf.maps.format import decode_map, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore
from tests.cli.maps.test_from_camera import PLATFORM
from tests.cli.maps.test_from_camera import folder as video_folder
from tests.kit.flat_world import CAMERA, STEP_M, frame_at

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")
from tests.kit.tum_recording import write_tum  # noqa: E402

__all__ = ["video_folder"]
LENS = ("--camera", f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}")


@pytest.fixture
def folder(video_folder: Path) -> Path:
    """The working folder, with a recording of six frames, a token, and a platform that answers."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(6)
    frames = (frame_at(row, depth=True) for row in range(6))
    write_tum(video_folder / "drive", frames, Trajectory(np.arange(6) / 10, poses))
    return video_folder


def report_of(folder: str) -> dict[str, Any]:
    report: dict[str, Any] = json.loads(Path(folder, "report.json").read_text())
    return report


def take_photo(row: int) -> str:
    cv2.imwrite("photo.png", np.ascontiguousarray(frame_at(row, depth=False).rgb[:, :, ::-1]))
    return "photo.png"


def test_the_map_of_a_drive_is_found_localised_in_merged_and_extended(
    folder: Path, state_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("gtsam", reason="pip install 'rse-pf[maps]'")
    for name in ("one", "two"):
        assert main(["map", "from-camera", "drive", "--out", name, *PLATFORM]) == 0

    report = report_of("one")
    assert report["store"] == f"dir:{state_home / 'rse-pf' / 'default' / 'objects'}"
    assert report["map"] == "one"
    assert "map: one in dir:" in capsys.readouterr().out

    assert main(["map", "localise", "one", take_photo(3), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "ok"
    np.testing.assert_allclose(found["position_m"], [3 * STEP_M, 0.0, 0.0], atol=0.01)
    assert main(["map", "merge", "one", "two", "--into", "both"]) in (0, 1), capsys.readouterr().err
    assert "joined" in capsys.readouterr().out
    assert main(["map", "live", "start", "hall", "--from", "both"]) == 0
    assert "hall has begun with" in capsys.readouterr().out


def test_the_map_of_a_video_in_metres_can_be_localised_in(
    video_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 0, 3] = 5 * STEP_M * np.arange(60)
    write_trajectory(Path("odometry.txt"), Trajectory(np.arange(60) / 10, poses))
    words = ["v.avi", "--intrinsics", "i.json", "--scale", "odometry:odometry.txt", *PLATFORM]

    assert main(["map", "from-camera", *words, "--objects", "own", "--map", "hall"]) == 0

    report = report_of("out-camera")
    assert (report["store"], report["map"]) == (f"dir:{Path('own').absolute()}", "hall")
    assert main(["map", "localise", "hall", take_photo(4), *LENS, "--json", "--store", report["store"]]) == 0
    (found,) = json.loads(last_json(capsys))
    np.testing.assert_allclose(found["position_m"], [4 * 5 * STEP_M, 0.0, 0.0], atol=0.05)


def test_a_map_up_to_scale_is_not_kept_and_the_report_says_why(
    video_folder: Path, state_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["v.avi", "--intrinsics", "i.json", "--frames", "7", *PLATFORM]

    assert main(["map", "from-camera", *words]) == 0

    assert report_of("out-camera")["map"] is None
    assert report_of("out-camera")["map_reason"] == "its scale is not known"
    assert "not in a store: its scale is not known" in capsys.readouterr().out
    assert MapRegistry(DirectoryStore(state_home / "rse-pf/default/objects")).names() == []


def test_a_second_drive_is_the_next_version(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        assert main(["map", "from-camera", "drive", "--map", "hall", *PLATFORM]) == 0

    assert main(["map", "show", "hall", "--json"]) == 0
    shown = json.loads(last_json(capsys))
    assert (shown["number"], shown["author"]) == (2, "rse-pf map from-camera")


def test_a_drive_is_kept_for_the_tenant_that_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["map", "from-camera", "drive", "--map", "hall", "--tenant", "acme", *PLATFORM]
    assert main(words) == 0
    assert "see rse-pf map show hall --tenant acme" in capsys.readouterr().out

    assert main(["map", "show", "hall", "--tenant", "acme"]) == 0
    assert main(["map", "show", "hall"]) == 1


def test_the_store_of_the_one_platform_that_runs_is_found(
    tmp_path: Path, state_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("default", "lab"):
        (state_home / "rse-pf" / name / "objects").mkdir(parents=True)
    lab = state_home / "rse-pf" / "lab"
    commit(lab / "objects", "attic")
    own = mark_of(os.getpid())
    assert own is not None
    state = PlatformState(
        name="lab", control_plane=own, url="ws://h", settings_digest="", settings_file="", key_file=""
    )
    assert main(["map", "list"]) == 0
    assert capsys.readouterr().out == "no maps\n"

    replace(state, control_plane=ProcessMark(pid=own.pid, began="another")).write(lab)  # it was killed
    assert main(["map", "list"]) == 0
    assert capsys.readouterr().out == "no maps\n"

    state.write(lab)
    assert main(["map", "list"]) == 0
    assert "attic" in capsys.readouterr().out

    replace(state, name="default").write(lab.with_name("default"))
    assert main(["map", "list"]) == 2
    assert "several platforms run on this machine: default, lab" in capsys.readouterr().err
    (lab.with_name("default") / "platform.json").unlink()

    commit(tmp_path / "far", "cellar")
    settings = PlatformSettings().replace(data={"store": f"dir:{tmp_path}/far"})
    settings_file(lab).write_text(json.dumps({"context": {"rse-pf": settings.to_dict()}}))
    assert main(["map", "list"]) == 0
    assert "cellar" in capsys.readouterr().out


def test_maps_of_a_named_platform_are_found_whether_it_runs_or_not(
    state_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, kept in (("default", "cellar"), ("lab", "attic")):
        (state_home / "rse-pf" / name / "objects").mkdir(parents=True)
        commit(state_home / "rse-pf" / name / "objects", kept)

    assert main(["map", "list", "--name", "lab"]) == 0
    assert "attic" in capsys.readouterr().out
    assert main(["map", "list", "--name", "nowhere"]) == 2
    error = capsys.readouterr().err
    assert "there is no platform 'nowhere'" in error
    assert "default, lab" in error
    assert main(["map", "list", "--name", "lab", "--store", "dir:x"]) == 2
    assert "name two stores" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["", "Hall", "a/b", "hall\nx", "../x", "h" * 65])
def test_a_wrong_name_of_a_map_is_refused_before_the_drive(
    folder: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", "from-camera", "drive", "--map", name, *PLATFORM]) == 2

    error = capsys.readouterr().err
    assert "is not a valid name of a map" in error
    assert len(error.splitlines()) == 2


def commit(objects: Path, name: str) -> None:
    from tests.kit.sample_maps import make_map

    data = encode_map(make_map())
    assert decode_map(data).keyframes
    MapRegistry(DirectoryStore(objects)).commit(name, data, parent=None, author="test", created_s=0.0)


def last_json(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the JSON at the end of what was printed."""
    out = capsys.readouterr().out
    starts = [out.find(mark) for mark in ("\n[\n", "\n{\n")]
    return out[max(starts) + 1 :]
