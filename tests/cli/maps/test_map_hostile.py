"""rse-pf map over hostile maps that a robot stored: one clear line with a hint, no traceback (T26, T33)."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from pathlib import Path

import pytest

from rse_pf.cli.main import main
from rse_pf.maps.describe import MapSummary
from rse_pf.maps.registry import MapContent, MapOrigin, MapRegistry
from rse_pf.storage.object_store import DirectoryStore, digest_of
from tests.kit.hostile_maps import DAMAGED_PROVENANCE, DECODABLE, hostile_maps

_CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with one map for each hostile one, as a data server without any check would have kept them."""
    folder = tmp_path_factory.mktemp("hostile") / "store"
    summary = MapSummary(keyframes=1, edges=0, points=0, robots=("robot-1",))
    held = DirectoryStore(folder)
    maps = MapRegistry(held)
    for number, data in enumerate(hostile_maps().values()):
        held.put("object", data)
        maps.commit_object(
            f"map-{number}", "object", summary, MapContent(digest_of(data), len(data)),
            MapOrigin(parent=None, author="robot-1", created_s=1e9),
            charged=lambda record, size: nullcontext(),
        )  # fmt: skip
    return folder


def run(store: Path, *words: str) -> int:
    return main(["map", *words, "--store", f"dir:{store}"])


@pytest.mark.parametrize("verb", ["show", "export", "localise", "diff"])
def test_every_hostile_map_is_one_clear_line(
    verb: str, store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = {"export": ["--format", "g2o", "--out", str(tmp_path / "map.g2o")], "diff": ["head"]}
    for number, name in enumerate(hostile_maps()):
        if verb != "show" and number % 7 and name not in DECODABLE:
            continue  # they load a map in the same way
        if verb == "localise":
            code = run(store, "localise", f"map-{number}", str(tmp_path / "none.png"))
        else:
            code = run(store, verb, f"map-{number}", *words.get(verb, []))
        said = capsys.readouterr()

        assert not _CONTROL.search(said.out + said.err), name
        assert "Traceback" not in said.err, name
        if name not in DECODABLE:
            assert code != 0, name
            assert "hint:" in said.err, name
            assert len(said.err) < 700, name
        elif verb == "show":
            assert (code != 0) == (name in DAMAGED_PROVENANCE), (name, said.err)


def test_a_hostile_map_is_shown_as_json_or_refused(store: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, name in enumerate(hostile_maps()):
        if name not in DECODABLE:
            continue
        code = run(store, "show", f"map-{number}", "--json")
        said = capsys.readouterr().out
        assert (code != 0) == (name in DAMAGED_PROVENANCE), name
        if code == 0:
            assert json.loads(said)["keyframes"] == 1
