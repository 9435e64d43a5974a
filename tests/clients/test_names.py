"""The table of names in docs/clients.md: every name exists in the client of its language."""

from __future__ import annotations

import inspect
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

import client_sdk
from rse_pf.pnp import PnpSolution
from tests.client_web.test_failures import against, echo

REPOSITORY = Path(__file__).resolve().parents[2]
TYPES = (REPOSITORY / "client_web" / "rse-pf.d.ts").read_text("utf-8")
PAGE = (REPOSITORY / "docs" / "clients.md").read_text("utf-8")
TABLE = PAGE.partition("| Thing | Python | C++ | JavaScript |")[2].partition("\n\n")[0]
PYTHON, CPP, JAVASCRIPT = (
    [
        name[1]
        for row in TABLE.splitlines()[2:]
        if (name := re.match(r"`([\w.]+)`$", row.split("|")[k].strip()))
    ]
    for k in (2, 3, 4)
)
COMPILE_S = 300.0


def test_the_table_has_a_name_in_each_language() -> None:
    assert min(len(PYTHON), len(CPP), len(JAVASCRIPT)) > 15


@pytest.mark.parametrize("name", PYTHON)
def test_in_python(name: str) -> None:
    first, *members = name.split(".")
    owner: Any = PnpSolution if first == "PnpSolution" else getattr(client_sdk, first)
    for member in members:
        assert member in {*dir(owner), *inspect.signature(owner).parameters}
        owner = getattr(owner, member, None)


def test_in_javascript() -> None:
    """The names are in the types, and those of the types are what the client returns."""
    program = """
    const robot = await connect(url, { token: "t" });
    const answer = await robot.call("echo", 1);
    const error = await robot.call("echo", 1n).catch((failed) => failed);
    const found = { Robot: robot, Answer: answer, Stats: robot.stats, RsePfError: error };
    for (const name in found) found[name] = Object.keys(found[name]);
    say(found);
    """
    members = {
        name: re.findall(r"^  (?:readonly )?(\w+)(?=[?:<(])", body, re.MULTILINE)
        for name, body in re.findall(
            r"^export (?:interface|class) (\w+)[^{]*\{\n(.*?)^\}", TYPES, re.M | re.S
        )
    }
    members["RsePfError"] = [each for each in members["RsePfError"] if each != "constructor"]

    for name, returned in against(echo, program).items():
        assert sorted(set(returned) - {"name"}) == sorted(members[name])
    for owner, _, member in (name.partition(".") for name in JAVASCRIPT):
        assert member in members[owner] if member else f"function {owner}(" in TYPES


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_in_cpp() -> None:
    """A class that inherits a name and makes it public compiles, whatever kind of member that name is."""
    lines = (name.split(".") for name in CPP)
    uses = [f"struct N{k} : rse_pf::{a} {{ using rse_pf::{a}::{b}; }};" for k, (a, b) in enumerate(lines)]
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler: sh scripts/client_cpp.sh names the packages")

    made = subprocess.run(
        [compiler, "-std=c++17", "-fsyntax-only", f"-I{REPOSITORY}/client_cpp/include", "-x", "c++", "-"],
        input="\n".join(["#include <rse_pf/rse_pf.hpp>", *uses]),
        capture_output=True, text=True, timeout=COMPILE_S, check=False,
    )  # fmt: skip

    missing = re.search(r"fatal error: (\S+): No such file", made.stderr)
    if missing:
        pytest.skip(f"no {missing[1]}: sh scripts/client_cpp.sh names the packages")
    assert made.returncode == 0, made.stderr[-3000:]
