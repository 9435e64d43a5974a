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

    assert not re.search(r"no (ROS|ROS 2) (node|bridge)|there is no ROS|no stereo|no IMU\b", text)


@pytest.mark.parametrize("name", ["Frame", "TrackedFrame", "Answer", "Stats"])
def test_the_reference_lists_the_fields_of_dataclasses(name: str) -> None:
    (directive,) = re.findall(rf"^::: client_sdk\.{name}\n((?: .*\n)+)", sdk_page(), re.MULTILINE)

    assert "show_if_no_docstring: true" in directive


def test_the_format_of_maps_names_its_objects(repository: Path) -> None:
    page = (repository / "docs/data.md").read_text(encoding="utf-8")

    assert "`pose` is `T_world_camera`" in page
    assert "`step`\nis `T_a_b`" in page
