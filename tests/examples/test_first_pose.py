"""The first robot of each client asks a platform for one pose, in JavaScript and C++; both have few lines."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.examples.conftest import ExamplePlatform
from tests.kit.example_page import REPOSITORY

pytestmark = pytest.mark.system
NODE = Path(sys.executable).with_name("node")
IN_JAVASCRIPT = REPOSITORY / "client_web" / "examples" / "first_pose.mjs"
IN_CPP = REPOSITORY / "client_cpp" / "examples" / "first_pose.cpp"
IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
MAX_LINES = 60
COMPILE_S = 300.0


def check_pose(platform: ExamplePlatform, *program: str | Path) -> None:
    """Run *program* with the address and a token of *platform*: it prints the identity and its evidence."""
    token = platform.cloud.issue_token("robot-9", None)
    done = platform.run([*map(str, program), platform.cloud.url, token])

    assert (done.returncode, done.stderr) == (0, "")
    *rows, last = done.stdout.splitlines()
    assert [float(value) for row in rows for value in row.split()] == pytest.approx(IDENTITY, abs=1e-3)
    assert re.fullmatch(r"ok, 27 inliers, [0-9.]+ ms by server-1", last)


@pytest.mark.skipif(not NODE.exists(), reason="no Node: make setup installs it")
def test_in_javascript(platform: ExamplePlatform) -> None:
    check_pose(platform, NODE, IN_JAVASCRIPT)


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_in_cpp(platform: ExamplePlatform, tmp_path: Path) -> None:
    program = tmp_path / "first_pose"
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler: sh scripts/client_cpp.sh names the packages")
    words = [compiler, "-std=c++17", f"-I{REPOSITORY / 'client_cpp' / 'include'}", str(IN_CPP)]
    made = subprocess.run(
        [*words, "-o", str(program), "-lssl", "-lcrypto", "-pthread"],
        capture_output=True, text=True, timeout=COMPILE_S, check=False,
    )  # fmt: skip
    missing = re.search(r"fatal error: (\S+): No such file", made.stderr)
    if missing:
        pytest.skip(f"no {missing[1]}: sh scripts/client_cpp.sh names the packages")
    assert made.returncode == 0, made.stderr[-3000:]

    check_pose(platform, program)


@pytest.mark.parametrize("program", [IN_JAVASCRIPT, IN_CPP, REPOSITORY / "examples/robots/ten_lines.py"])
def test_it_is_short(program: Path) -> None:
    assert len(program.read_text("utf-8").splitlines()) <= MAX_LINES
