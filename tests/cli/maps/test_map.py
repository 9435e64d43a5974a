"""rse-pf map: what each action prints, writes and refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rse_pf.cli.main import main
from rse_pf.geometry import Camera
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore


def make(keyframes: int) -> bytes:
    rng = np.random.default_rng(keyframes)
    frames = []
    for n in range(keyframes):
        pose = np.eye(4)
        pose[0, 3] = n
        frames.append(
            Keyframe(
                id=n, robot="robot-1", timestamp_s=float(n), T_world_camera=pose,
                camera=Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480),
                pixels=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 32), np.uint8),
                points_camera=np.zeros((0, 3), np.float32),
            )
        )  # fmt: skip
    points = rng.uniform(-2, 2, (500, 3)).astype(np.float32)
    colours = np.full((500, 3), 90, np.uint8)
    return encode_map(MapVersion(keyframes=tuple(frames), points=points, colours=colours))


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store with map "hall" of two versions: of 2 and of 3 keyframes."""
    maps = MapRegistry(DirectoryStore(tmp_path / "store"))
    first = maps.commit("hall", make(2), parent=None, author="robot-1", created_s=1e9, note="first")
    maps.commit("hall", make(3), parent=first.id, author="robot-1", created_s=2e9, note="second")
    return tmp_path / "store"


def run(store: Path, *words: str) -> int:
    return main(["map", *words, "--store", f"dir:{store}"])


def asked(capsys: pytest.CaptureFixture[str], store: Path, *words: str) -> object:
    assert run(store, *words, "--json") == 0
    return json.loads(capsys.readouterr().out)


def test_diff_rollback_and_show_all_agree(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    versions = asked(capsys, store, "show", "hall", "--all")
    first, second = (each["id"] for each in versions)  # type: ignore[attr-defined]
    assert asked(capsys, store, "diff", "hall", first[:8])["added"] == [2]  # type: ignore[index]

    assert asked(capsys, store, "rollback", "hall", first[:8]) == {"was": second, "head": first}

    again = asked(capsys, store, "show", "hall", "--all")
    assert [each["head"] for each in again] == [True, False]  # type: ignore[attr-defined]


def test_prune_removes_old_versions_and_says_how_many_bytes_are_free(
    store: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = (each["id"] for each in asked(capsys, store, "show", "hall", "--all"))  # type: ignore[attr-defined]

    assert run(store, "prune", "hall", "--keep", "1") == 0

    assert "1 version of hall removed, " in (said := capsys.readouterr().out)
    assert first[:12] in said
    assert [each["id"] for each in asked(capsys, store, "show", "hall", "--all")] == [second]  # type: ignore[attr-defined]
    assert asked(capsys, store, "prune", "hall", "--keep", "1") == {"freed_bytes": 0, "removed": []}


def test_a_store_in_memory_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", "list", "--store", "memory:"]) == 2
    assert "dir:PATH" in capsys.readouterr().err
