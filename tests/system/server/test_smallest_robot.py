"""A robot with the three packages of the wheel and no other gets poses, and errors where there is none."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.system

BASE = ("numpy", "websockets", "msgspec")
ROBOT = """
import asyncio, importlib.util, json, sys

import numpy as np
from client_sdk import connect
from rse_pf.errors import RsePfError
from rse_pf.pnp.problems import make_degenerate, make_problem

good, wrong = make_problem(seed=2), make_problem(seed=9, n=60, outlier_ratio=0.8)
few = make_problem(seed=2, n=9, outlier_ratio=0.0)
QUESTIONS = {
    "good": good, "mostly wrong": wrong, "nine matches": few,
    "one point": make_degenerate("coincident", seed=1), "noise": make_degenerate("noise", seed=1),
    "not finite": make_degenerate("nan", seed=1),
}

async def main(url, token):
    foreign = [name for name in ("cv2", "cryptography", "picows") if importlib.util.find_spec(name)]
    answers = {"foreign": foreign}
    async with connect(url, token=token) as robot:
        for name, asked in QUESTIONS.items():
            try:
                answer = await robot.solve_pnp(asked.points_world, asked.pixels, asked.camera, deadline_s=5.0)
            except RsePfError as error:
                answers[name] = {"code": error.code, "hint": bool(error.hint)}
                continue
            solution = answer.solution
            answers[name] = {
                "source": answer.source, "verdict": str(solution.verdict), "reason": solution.reason,
                "is_right": bool(np.abs(solution.T_camera_world - asked.T_camera_world).max() < 0.05),
                "has_covariance": bool(np.linalg.eigvalsh(solution.covariance).min() > 0.0),
            }
    print(json.dumps(answers))

asyncio.run(main(*sys.argv[1:]))
"""


@pytest.fixture
def packages(tmp_path: Path, repository: Path) -> Path:
    """A folder of packages with the three that the wheel requires, and the two that a robot imports."""
    folder = tmp_path / "packages"
    folder.mkdir()
    for name in BASE:
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.submodule_search_locations is not None
        (folder / name).symlink_to(spec.submodule_search_locations[0])
    for name in ("client_sdk", "rse_pf"):
        (folder / name).symlink_to(repository / name)
    return folder


def ask(server: Any, packages: Path) -> dict[str, Any]:
    """Return what a robot gets for each question that can import nothing but *packages*."""
    ended = subprocess.run(
        [sys.executable, "-S", "-c", ROBOT, server.url, server.token()],
        env={"PYTHONPATH": str(packages)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    answers: dict[str, Any] = json.loads(ended.stdout)
    return answers


def test_a_robot_with_three_packages_gets_poses_with_their_quality_and_typed_errors(
    start_server, tmp_path: Path, packages: Path
) -> None:
    builtin = "from rse_pf.services.builtin import builtin_services as make\n"
    (tmp_path / "served_in_tests.py").write_text(builtin)

    answers = ask(start_server(keys=True), packages)

    pose = {"source": "cloud", "is_right": True, "has_covariance": True}
    assert answers == {
        "foreign": [],
        "good": {**pose, "verdict": "ok", "reason": ""},
        "mostly wrong": {**pose, "verdict": "weak", "reason": "low-inlier-ratio"},
        "nine matches": {**pose, "verdict": "weak", "reason": "few-inliers"},
        "one point": {"code": "degenerate", "hint": True},
        "noise": {"code": "no-consensus", "hint": True},
        "not finite": {"code": "bad-request", "hint": True},
    }
