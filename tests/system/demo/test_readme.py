"""The robot of the first pose, run, and the verbs and targets that the first pages name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.pnp.problems import make_problem

pytestmark = pytest.mark.system


FIRST = "docs/start/first_pose.md"


def blocks(repository: Path, language: str) -> list[str]:
    text = (repository / FIRST).read_text(encoding="utf-8")
    found = re.findall(r"^```(\w*)\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    return [block for kind, block in found if kind == language]


async def test_the_robot_in_ten_lines_gets_its_pose(repository, tmp_path, capsys):
    (code,) = blocks(repository, "python")
    problem = make_problem(seed=5, camera=make_problem(seed=0).camera)

    async with LocalPlatform(PlatformSettings(), state=tmp_path / "platform", servers=1, port=0) as cloud:
        names: dict = {}
        mine = code.replace("127.0.0.1:8700", f"127.0.0.1:{cloud.port}")
        assert mine != code
        exec(compile(mine, FIRST, "exec"), names)
        token = cloud.issue_token("robot-1")
        await names["main"](token, problem.points_world, problem.pixels)

    assert capsys.readouterr().out.split()[0] in ("ok", "weak")
