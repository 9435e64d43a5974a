"""rse-pf map: the actions that need the extras for maps: merge, localise and view."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rse_pf.cli.main import main
from rse_pf.geometry import Camera, pose_difference
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore
from tests.kit.synthetic_maps import make_world

for package in ("gtsam", "PIL", "cv2"):
    pytest.importorskip(package, reason="the extras maps, local and vision are needed")

WORLD = make_world(1)
WALL_M = 2.0


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with maps a and b of one hall, and c of another."""
    maps = MapRegistry(DirectoryStore(tmp_path / "store"))
    walks = {
        "a": WORLD.walk("robot-a", np.linspace(0.0, 0.5, 13), seed=1)[0],
        "b": WORLD.walk("robot-b", np.linspace(0.3, 0.8, 13), seed=2)[0],
        "c": make_world(2).walk("robot-c", np.linspace(0.0, 0.3, 8), seed=3)[0],
    }
    for name, version in walks.items():
        maps.commit(name, encode_map(version), parent=None, author=name, created_s=1e9)
    return tmp_path / "store"


def run(store: Path, *words: str) -> int:
    return main(["map", *words, "--store", f"dir:{store}"])


def test_merge_makes_one_map_and_names_what_was_joined(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(store, "merge", "a", "b", "--into", "hall") == 0

    said = capsys.readouterr().out
    assert "hall is now version 1" in said
    assert "joined      a, b\n" in said
    version = MapRegistry(DirectoryStore(store)).load("hall")
    assert len(version.keyframes) == 26
    assert any(edge.kind == "merge" for edge in version.edges)


def test_merging_into_an_existing_map_adds_a_version_after_its_head(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(store, "merge", "a", "b", "--into", "a") == 0

    records = MapRegistry(DirectoryStore(store)).versions("a")
    assert [each.number for each in records] == [1, 2]
    assert records[1].parent == records[0].id
    assert records[1].note == "merged a, b"


def test_maps_that_were_not_joined_are_named_and_the_exit_code_is_1(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(store, "merge", "a", "b", "c", "--into", "hall", "--json") == 1

    made = json.loads(capsys.readouterr().out)
    assert made["joined"] == ["a", "b"]
    assert [each["map"] for each in made["not_joined"]] == ["c"]
    assert made["not_joined"][0]["reason"]


def test_maps_that_cannot_be_joined_write_nothing(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(store, "merge", "a", "c", "--into", "hall") == 1

    said = capsys.readouterr().err
    assert "nothing was written" in said
    assert "hint:" in said
    assert "hall" not in MapRegistry(DirectoryStore(store)).names()


def test_an_older_version_can_be_merged(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    maps = MapRegistry(DirectoryStore(store))
    first = maps.head("a")
    strange = make_world(2).walk("robot-a", np.linspace(0.0, 0.3, 8), seed=3)[0]
    maps.commit("a", encode_map(strange), parent=first.id, author="a", created_s=2e9)

    assert run(store, "merge", f"a@{first.id[:8]}", "b", "--into", "hall") == 0


SHIFT_PX = 16
"""The camera moves to the right by so many pixels, in front of a wall."""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, Path]:
    """A store whose map "room" is one view of a wall; an image from further right, and its true pose."""
    from PIL import Image

    from client_sdk.frontend import Frame, FrontEndOptions, extract

    folder = tmp_path_factory.mktemp("rendered")
    camera = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)
    blocks = np.random.default_rng(1).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    wall = np.kron(blocks, np.ones((8, 8, 1), dtype=np.uint8))
    truth = np.eye(4)
    truth[0, 3] = SHIFT_PX * WALL_M / camera.fx
    depth_m = np.full((480, 640), WALL_M, dtype=np.float32)
    found = extract(
        Frame(timestamp_s=0.0, rgb=wall[:, :640], depth_m=depth_m, camera=camera), FrontEndOptions()
    )
    keyframe = Keyframe(
        id=7, robot="robot-1", timestamp_s=0.0, T_world_camera=np.eye(4), camera=camera,
        pixels=found.pixels.astype(np.float32), descriptors=found.descriptors,
        points_camera=found.points_camera.astype(np.float32),
    )  # fmt: skip
    maps = MapRegistry(DirectoryStore(folder / "store"))
    data = encode_map(MapVersion(keyframes=(keyframe,)))
    maps.commit("room", data, parent=None, author="a", created_s=1e9)
    Image.fromarray(wall[:, SHIFT_PX : SHIFT_PX + 640]).save(folder / "frame.png")
    return folder / "store", truth, folder / "frame.png"


def test_localise_uses_the_camera_of_the_map_for_an_image(
    rendered: tuple[Path, np.ndarray, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    store, truth, image = rendered

    assert run(store, "localise", "room", str(image), "--json") == 0

    (found,) = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "ok"
    assert found["inliers"] >= 30
    assert found["keyframes"] == [7]
    moved_m, turned_deg = pose_difference(np.array(found["T_map_camera"]), truth)
    assert moved_m <= 0.01
    assert found["position_sigma_m"] > 0.0
    assert moved_m <= 3.0 * found["position_sigma_m"]
    assert turned_deg <= 3.0 * found["turn_sigma_deg"]


def test_localise_prints_a_line_for_each_frame_and_exits_with_1_if_none_has_a_pose(
    rendered: tuple[Path, np.ndarray, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    store, _, image = rendered
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.png")

    assert run(store, "localise", "room", str(image), str(tmp_path / "noise.png")) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "ok" in lines[0]
    assert "sigma" in lines[0]
    assert "inliers" in lines[0]
    assert "lost" in lines[1]
    assert lines[2] == "1 of 2 found"

    assert run(store, "localise", "room", str(tmp_path / "noise.png")) == 1


def test_an_image_of_another_size_needs_its_camera(
    rendered: tuple[Path, np.ndarray, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    store, _, image = rendered
    with Image.open(image) as whole:
        whole.resize((320, 240)).save(tmp_path / "small.png")

    assert run(store, "localise", "room", str(tmp_path / "small.png")) == 2
    assert "--camera fx,fy,cx,cy" in capsys.readouterr().err
    assert run(store, "localise", "room", str(tmp_path / "small.png"), "--camera", "1,2,x") == 2

    assert (
        run(store, "localise", "room", str(tmp_path / "small.png"), "--camera", "262.5,262.5,159.5,119.5")
        == 0
    )
