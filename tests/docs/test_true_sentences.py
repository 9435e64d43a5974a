"""Pages name the clients, shells and objects that exist, and no others."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from scripts.site.pages import sdk_page

CLIENTS = {"client_sdk": "Python", "client_web": "JavaScript", "client_cpp": "C++"}


def test_alternatives_name_each_client_that_there_is(repository: Path) -> None:
    page = (repository / "docs/explanation/alternatives.md").read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| Which clients are there\? .*\| (.*?) \|$", page, re.MULTILINE)
    folders = {path.name for path in repository.glob("client_*") if path.is_dir()}

    assert folders == set(CLIENTS)
    assert set(row.partition(";")[0].split(", ")) == set(CLIENTS.values())


def test_the_page_of_ros_names_each_shell(repository: Path) -> None:
    page = (repository / "docs/ros.md").read_text(encoding="utf-8")
    source = (repository / "ros_bridge/__main__.py").read_text(encoding="utf-8")
    (choices,) = re.findall(r'"shell", choices=\((.*?)\)', source)
    shells = set(re.findall(r"\w+", choices)) - {"where"}

    assert set(re.findall(r"^\| `rse-pf-ros (\w+)` \|", page, re.MULTILINE)) == shells


@pytest.mark.parametrize("page", ["docs/help/faq.md", "README.md", "docs/explanation/alternatives.md"])
def test_no_page_denies_what_is_there(repository: Path, page: str) -> None:
    text = " ".join((repository / page).read_text(encoding="utf-8").split())

    denied = r"no (ROS|ROS 2) (node|bridge)|there is no ROS|not run against a ROS|no stereo|no IMU\b"
    assert not re.search(denied, text)


@pytest.mark.parametrize("name", ["Frame", "TrackedFrame", "Answer", "Stats"])
def test_the_reference_lists_the_fields_of_dataclasses(name: str) -> None:
    (directive,) = re.findall(rf"^::: client_sdk\.{name}\n((?: .*\n)+)", sdk_page(), re.MULTILINE)

    assert "show_if_no_docstring: true" in directive


def test_the_format_of_maps_names_its_objects(repository: Path) -> None:
    page = (repository / "docs/data.md").read_text(encoding="utf-8")

    assert "`pose` is `T_world_camera`" in page
    assert "`step`\nis `T_a_b`" in page


def test_pages_say_truly_what_make_installs(repository: Path) -> None:
    """Where make has installed what elsewhere some extras install, its lock has their packages."""
    toml = pytest.importorskip("tomllib", reason="Python 3.10 reads no TOML")
    text = (repository / "pyproject.toml").read_text(encoding="utf-8")
    extras = toml.loads(text)["project"]["optional-dependencies"]

    def packages(names: set[str]) -> set[str]:
        wanted = [line for name in names for line in extras[name]]
        own = {name for line in wanted for name in re.findall(r"rse-pf\[([\w,]+)\]", line)}
        found = {re.split(r"[\[><=; ]", line)[0] for line in wanted} - {"rse-pf"}
        return found | (packages({each for name in own for each in name.split(",")}) if own else set())

    locks = {"demo": "demo", "setup": "dev"}
    claim = re.compile(
        r"((?:`make \w+`(?: and )?)+) ha(?:s|ve) (?:installed|made)[^.;]*;[^.;]*?"
        r"install the extras? ((?:`\w+`(?:, | and )?)+)"
    )
    seen = {}
    for page in (repository / "docs").rglob("*.md"):
        for made, named in claim.findall(" ".join(page.read_text(encoding="utf-8").split())):
            for target in re.findall(r"make (\w+)", made):
                lock = (repository / f"locks/{locks[target]}.txt").read_text(encoding="utf-8")
                installed = set(re.findall(r"^([\w-]+)==", lock, re.MULTILINE))
                seen[page.name] = packages(set(re.findall(r"`(\w+)`", named))) - installed

    assert {"bags.md", "cameras.md", "ros.md"} <= seen.keys()
    assert {name: missing for name, missing in seen.items() if missing} == {}
