"""Commands on the pages are commands of this checkout: what can run here runs, the rest at least parses.

`docs/operations.md` has a test of its own, which runs it on an emulator.
"""

from __future__ import annotations

import ast
import importlib
import json
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.cli.main import VERBS, main, parser_of, verb_module
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore
from tests.kit.documentation_pages import PAGES
from tests.kit.removed_extensions import installed_commands, is_removed

OTHER_PROGRAMS = (
    "npx", "node", "aws", "dask", "python", "sh", ".", "grep", "sudo", "g++", "cmake", "mkdir",
    "build/first_pose", "client_cpp/build/rse_pf_tum_robot", "roscore", "roslaunch", "rosbag",
    "rse-pf-ros", "export", "pip", "python3.11", "ros2", "sleep", "umask", "curl", "kill",
)  # fmt: skip
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
IN_A_LINE = re.compile(r"`((?:rse-pf|make) [^`]*)`")
RUN_HERE = "|".join(
    f"rse-pf map {action}" for action in ("list", "show", "diff", "rollback", "prune", "export")
)
SOON_S = 60.0


def page(repository: Path, name: str) -> str:
    return (repository / name).read_text(encoding="utf-8")


def commands(text: str) -> list[str]:
    """Return the commands in the blocks of a page, without comments and redirections."""
    blocks = [block.replace("\\\n", " ") for language, block in BLOCK.findall(text) if not language]
    lines = [line for block in blocks for line in block.splitlines()]
    bare = [line.partition(" #")[0].partition(" > ")[0].strip() for line in lines if line.strip()]
    return [re.sub(r"^\w+=\$\((.*)\)$", r"\1", line) for line in bare]


def complaint(repository: Path, command: str) -> str:
    """Return what is wrong with a command; empty if the command line would understand it."""
    first, *words = shlex.split(re.sub(r"^(\w+=(\$\([^)]*\)|\S)+ )+", "", command))
    if first == "make":
        makefile = (repository / "Makefile").read_text(encoding="utf-8")
        targets = [word for word in words if not re.match(r"\w+=", word)]
        return (
            "" if all(re.search(rf"^{re.escape(one)}:", makefile, re.M) for one in targets) else "no target"
        )
    if first != "rse-pf":
        return "" if first in OTHER_PROGRAMS else "no program of ours"
    if is_removed(" ".join(words)):
        return ""
    if not words or words[0] not in VERBS:
        return "no verb"
    try:
        parser_of(words[0]).parse_args(words[1:])
    except UsageError as error:
        return error.message
    except SystemExit:  # the help page was printed
        return ""
    return ""


def half_a_complaint(command: str) -> str:
    """Return what is wrong with a command of which a sentence names a part only."""
    _, verb, *words = shlex.split(command)
    if is_removed(" ".join((verb, *words))):
        return ""
    if verb not in VERBS:
        return "no verb"
    parser, known = parser_of(verb), set[str]()
    while True:
        if parser.default_action and words[:1] and words[0].startswith("-"):
            words = [parser.default_action, *words]
        known |= {option for action in parser._actions for option in action.option_strings}
        positional = [each.choices for each in parser._actions if not each.option_strings and each.choices]
        if not positional or not words or words[0].startswith("-"):
            break
        choices = positional[0]
        if words[0] not in choices:
            return f"{words[0]} is none of {', '.join(map(str, choices))}"
        if not isinstance(choices, dict):
            break
        parser, words = choices[words[0]], words[1:]
    return " ".join(word for word in words if word.startswith("--") and word.partition("=")[0] not in known)


@pytest.mark.parametrize("name", PAGES)
def test_every_command_in_a_block_is_understood(repository: Path, name: str) -> None:
    found = commands(page(repository, name))

    assert {command: why for command in found if (why := complaint(repository, command))} == {}
    fewest = {"README.md": 2, "docs/data.md": 10, "docs/security.md": 3, "docs/services.md": 5}
    assert len(found) >= {**fewest, "docs/operations.md": 20}.get(name, 0)


@pytest.mark.parametrize("name", PAGES)
def test_every_command_in_a_sentence_exists(repository: Path, name: str) -> None:
    text = BLOCK.sub("", page(repository, name))
    found = {" ".join(each.split()) for each in IN_A_LINE.findall(text)}

    wrong = {
        each: why
        for each in found
        if (why := complaint(repository, each) if each.startswith("make") else half_a_complaint(each))
    }
    assert wrong == {}


@pytest.mark.parametrize("verb", VERBS)
def test_every_example_on_a_help_page_is_understood(repository: Path, verb: str) -> None:
    text = verb_module(verb).__doc__ or ""
    lines = text.partition("examples:")[2].splitlines()
    found = [line.strip().partition(" > ")[0] for line in lines if line.strip().startswith("rse-pf ")]

    assert {command: why for command in found if (why := complaint(repository, command))} == {}


@pytest.mark.parametrize("name", PAGES)
def test_every_python_block_is_python_whose_imports_are_there(repository: Path, name: str) -> None:
    for language, block in BLOCK.findall(page(repository, name)):
        if language != "python":
            continue
        tree = compile(
            block.replace(", ...}", "}"), name, "exec", ast.PyCF_ONLY_AST | ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
        )
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                module = importlib.import_module(node.module)
                assert [each.name for each in node.names if not hasattr(module, each.name)] == []


def kitchen(keyframes: int) -> bytes:
    """Return a map with so many keyframes in a row."""
    poses = [np.eye(4) for _ in range(keyframes)]
    for number, pose in enumerate(poses):
        pose[0, 3] = number
    camera = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
    frames = tuple(
        Keyframe(
            id=number, robot="robot-1", timestamp_s=float(number), T_world_camera=pose, camera=camera,
            pixels=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 32), np.uint8),
            points_camera=np.zeros((0, 3), np.float32),
        )
        for number, pose in enumerate(poses)
    )  # fmt: skip
    points = np.random.default_rng(7).uniform(-2, 2, (500, 3)).astype(np.float32)
    return encode_map(MapVersion(keyframes=frames, points=points, colours=np.full((500, 3), 90, np.uint8)))


def test_the_commands_about_maps_run_on_a_store(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On the page the version is called 3f9bd1."""
    monkeypatch.chdir(tmp_path)
    maps = MapRegistry(DirectoryStore(tmp_path / "objects"))
    first = maps.commit("kitchen", kitchen(2), parent=None, author="robot-1", created_s=1e9, note="first")
    maps.commit("kitchen", kitchen(3), parent=first.id, author="robot-1", created_s=2e9, note="second")
    found = [each for each in commands(page(repository, "docs/data.md")) if re.match(RUN_HERE, each)]

    for command in installed_commands(found):
        words = shlex.split(command.replace("3f9bd1", first.id[:6]))
        assert main([*words[1:], "--store", "dir:objects"]) == 0, f"{command}: {capsys.readouterr().err}"

    assert len(found) == 6
    assert Path("kitchen.png").stat().st_size > 0


def test_the_commands_about_services_write_install_and_list_one(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    wanted = ("rse-pf service new", "rse-pf service install", "rse-pf service list")
    found = [each for each in commands(page(repository, "docs/services.md")) if each.startswith(wanted)]

    for command in found:
        assert main(shlex.split(command)[1:]) == 0, f"{command}: {capsys.readouterr().err}"

    assert len(found) == 3
    assert "centroid" in capsys.readouterr().out


@pytest.mark.system
def test_the_data_service_starts_as_the_page_says_and_ends_by_a_signal(
    repository: Path, tmp_path: Path
) -> None:
    (command,) = [
        each for each in commands(page(repository, "docs/data.md")) if each.startswith("rse-pf data")
    ]
    keys = SigningKey.from_seed(b"p" * 32, "page").key_set().to_json()
    (tmp_path / "keys.json").write_text(keys)
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "rse_pf.cli.main", *shlex.split(command)[1:]], cwd=tmp_path, stderr=log
        )
    try:
        end = time.monotonic() + SOON_S
        while not (tmp_path / "data.json").exists():
            assert process.poll() is None, (tmp_path / "log").read_text()
            assert time.monotonic() < end
            time.sleep(0)
        assert json.loads((tmp_path / "data.json").read_text())["port"] > 0
        process.send_signal(signal.SIGTERM)
        assert process.wait(SOON_S) == 0
    finally:
        process.kill()
        process.wait()
