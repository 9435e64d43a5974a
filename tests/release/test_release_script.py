"""`make release`: the same bytes again, nothing too much, nothing missing, and true notes."""

from __future__ import annotations

import importlib.util
import io
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

FILES = {"pyproject.toml", "rse_pf/a.py", "rse_pf/services/templates/lua/service.lua", "examples/robots/x.py"}
OURS = "rse_pf-1.2.0-py3-none-any.whl"
CORE = "rse_pf_native-1.2.0-py3-none-manylinux_2_28_x86_64.whl"
INFORMATION = ("METADATA", "WHEEL", "RECORD", "licenses/LICENSE", "entry_points.txt", "top_level.txt")
HELD = [name for name in FILES if name.startswith("rse_pf/")]
HELD += [f"rse_pf-1.2.0.dist-info/{name}" for name in INFORMATION]
SDIST = [f"rse_pf-1.2.0/{name}" for name in (*FILES, "PKG-INFO", "setup.cfg", "rse_pf.egg-info/SOURCES.txt")]


@pytest.fixture(scope="module")
def script(repository: Path) -> Any:
    """The module scripts/release.py."""
    spec = importlib.util.spec_from_file_location("release_script", repository / "scripts" / "release.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look it up
    spec.loader.exec_module(module)
    return module


def wheel(folder: Path, names: Iterable[str], name: str = OURS, mode: int = 0o644) -> Path:
    folder.mkdir(exist_ok=True)
    with zipfile.ZipFile(folder / name, "w") as archive:
        for each in names:
            entry = zipfile.ZipInfo(each)
            entry.external_attr = mode << 16
            archive.writestr(entry, each)
    return folder / name


def sdist(folder: Path, names: Iterable[str], *, mtime: float = 0.0, owner: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    with tarfile.open(folder / "rse_pf-1.2.0.tar.gz", "w:gz") as archive:
        for each in names:
            entry = tarfile.TarInfo(each)
            entry.size, entry.mtime, entry.uname, entry.mode = len(each), mtime, owner, 0o600
            archive.addfile(entry, io.BytesIO(each.encode()))
    return folder / "rse_pf-1.2.0.tar.gz"


def test_a_packed_sdist_depends_on_names_and_contents_only(script: Any, tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
    one = sdist(tmp_path / "one", sorted(SDIST), mtime=1.7e9, owner="ann")
    two = sdist(tmp_path / "two", sorted(SDIST, reverse=True), mtime=1.8e9, owner="bob")

    packed = [
        script.repacked(each, tmp_path / into, 1_600_000_000) for each, into in ((one, "a"), (two, "b"))
    ]
    later = script.repacked(one, tmp_path / "c", 1_600_000_001)

    assert packed[0].read_bytes() == packed[1].read_bytes()
    assert packed[0].read_bytes() != later.read_bytes()
    with tarfile.open(packed[0]) as archive:
        assert archive.getnames() == sorted(SDIST)
        assert {(each.mtime, each.uname, each.mode) for each in archive} == {(1_600_000_000, "", 0o644)}
        held = archive.extractfile(SDIST[0])
        assert held is not None
        assert held.read().decode() == SDIST[0]


def test_a_link_in_an_sdist_is_refused(script: Any, tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "rse_pf-1.2.0.tar.gz", "w:gz") as archive:
        link = tarfile.TarInfo("rse_pf-1.2.0/a")
        link.type, link.linkname = tarfile.SYMTYPE, "elsewhere"
        archive.addfile(link)
    (tmp_path / "made").mkdir()

    with pytest.raises(script.ReleaseError, match="neither a file nor a folder"):
        script.repacked(tmp_path / "rse_pf-1.2.0.tar.gz", tmp_path / "made", 1_600_000_000)


def test_complete_packages_have_no_complaints(script: Any, tmp_path: Path) -> None:
    core = [f"rse_pf_native/{name}" for name in ("__init__.py", "librse_pf_native.so")]
    core += [f"rse_pf_native-1.2.0.dist-info/{name}" for name in INFORMATION[:4]]

    assert script.complaints(wheel(tmp_path / "ours", HELD), FILES) == []
    assert script.complaints(wheel(tmp_path / "core", core, CORE), FILES) == []
    assert script.complaints(sdist(tmp_path / "sdist", SDIST), FILES) == []


@pytest.mark.parametrize(
    ("missing", "added", "complaint"),
    [
        ("rse_pf/services/templates/lua/service.lua", "", "service.lua is missing"),
        ("rse_pf-1.2.0.dist-info/licenses/LICENSE", "", "licenses/LICENSE is missing"),
        ("", "tests/test_a.py", "tests/test_a.py does not belong"),
        ("", "rse_pf/__pycache__/a.cpython-311.pyc", "a.cpython-311.pyc does not belong"),
    ],
)
def test_a_wheel_with_too_little_or_too_much_is_refused(
    script: Any, tmp_path: Path, missing: str, added: str, complaint: str
) -> None:
    names = [name for name in HELD if name != missing] + ([added] if added else [])

    (told,) = script.complaints(wheel(tmp_path / "w", names), FILES)

    assert complaint in told


def test_an_sdist_without_an_example_or_with_a_test_is_refused(script: Any, tmp_path: Path) -> None:
    names = [name for name in SDIST if "examples" not in name] + ["rse_pf-1.2.0/tests/test_a.py"]

    assert script.complaints(sdist(tmp_path / "s", names), FILES) == [
        "examples/robots/x.py is missing",
        "tests/test_a.py does not belong into it",
    ]


def test_a_package_that_is_too_large_is_refused(
    script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(script.MAX_BYTES, ".whl", 100)

    (told,) = script.complaints(wheel(tmp_path / "w", HELD), FILES)

    assert told.endswith("bytes are more than 100")


def test_the_entries_that_differ_are_named(script: Any, tmp_path: Path) -> None:
    first, second = wheel(tmp_path / "a", ["x", "y"]), wheel(tmp_path / "b", ["x", "z"])
    other_mode = wheel(tmp_path / "c", ["x", "y"], mode=0o600)

    assert script.differences(first, second) == "y, z"
    assert script.differences(first, other_mode) == "x, y"


def test_the_section_of_a_version_is_also_that_of_its_previews(script: Any) -> None:
    changelog = "# Changelog\n\n## 1.3.0\n\n- later\n\n## 1.2.0\n\n- now\n\n### Names\n\nrows\n\n## 1.1.0\n"

    assert script.changes_of("1.2.0", changelog) == "- now\n\n### Names\n\nrows"
    assert script.changes_of("1.2.0.dev0", changelog) == script.changes_of("1.2.0", changelog)
    for absent in ("1.4.0", "1.1.0"):
        with pytest.raises(script.ReleaseError, match=f"no section {absent}"):
            script.changes_of(absent, changelog)


def test_the_version_of_this_tree_has_its_section(script: Any, repository: Path) -> None:
    origin = script._origin([])

    assert script.changes_of(origin.version, (repository / "CHANGELOG.md").read_text(encoding="utf-8"))


def test_what_is_shipped_is_what_git_tracks_of_the_packages_and_of_their_readers(
    script: Any, repository: Path
) -> None:
    names = script.shipped(script.tracked_files(repository))

    assert {"LICENSE", "README.md", "CHANGELOG.md", "rse_pf/py.typed", "client_sdk/py.typed"} <= names
    assert "rse_pf/services/custom/templates/python/service.json" in names
    assert {"examples/services/icp-python/service.py", "docs/protocol.md"} <= names
    assert {name.partition("/")[0] for name in names if "/" in name} == {
        "rse_pf", "client_sdk", "lambda_pnp", "ros_bridge", "docs", "examples",
    }  # fmt: skip


def test_outside_of_git_the_same_kinds_of_files_are_taken(script: Any, tmp_path: Path) -> None:
    for name in (
        "pyproject.toml",
        "rse_pf/a.py",
        "rse_pf/__pycache__/a.pyc",
        "native/build/x.o",
        "tests/b.py",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("", encoding="utf-8")
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=False)

    assert script.tracked_files(tmp_path) == ["pyproject.toml", "rse_pf/a.py"]


@pytest.mark.parametrize("wrong", ["yesterday", "-1", "315532799"])
def test_a_time_that_no_zip_file_can_hold_is_refused(
    script: Any, monkeypatch: pytest.MonkeyPatch, wrong: str
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", wrong)

    with pytest.raises(script.ReleaseError, match=f"SOURCE_DATE_EPOCH is '{wrong}'"):
        script._origin([])


@pytest.mark.parametrize("changed", [0, 2])
def test_the_notes_say_what_is_published_and_from_which_commit(script: Any, changed: int) -> None:
    sizes = {OURS: 100, CORE: 200, "rse_pf-1.2.0.tar.gz": 300}
    sums = {name: name[-8:] * 8 for name in sizes}
    origin = script.Origin(version="1.2.0", commit="abc123", changed=changed, epoch_s=1_600_000_000)

    text = script.notes(origin, "- all is new", sizes, sums)

    assert all(f"| `{name}` | {size} | `{sums[name]}` |" in text for name, size in sizes.items())
    assert f"pip install ./{OURS} ./{CORE}" in text
    assert "SOURCE_DATE_EPOCH=1600000000" in text
    assert "commit `abc123`" in text
    assert ("do not publish" in text) == bool(changed)
    assert text.endswith("- all is new\n")
