"""The example pnp-lua, the paper's design, finds the same pose as the service ``pnp``."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rse_pf.errors import DegenerateGeometry
from rse_pf.geometry import pose_difference
from rse_pf.pnp import solve_pnp
from rse_pf.pnp.problems import make_problem
from rse_pf.services.custom.installed import read_service
from rse_pf.services.custom.runtime import Runtime, open_runtime

EXAMPLE = Path(__file__).parents[3] / "examples" / "services" / "pnp-lua"
pytest.importorskip("lupa", reason="the extra services is not installed")


@pytest.fixture(scope="module")
def pnp_lua(tmp_path_factory: pytest.TempPathFactory) -> Runtime:
    """Build the example and load it."""
    if shutil.which("cmake") is None:
        pytest.skip("cmake is not installed")
    folder = tmp_path_factory.mktemp("pnp") / "pnp-lua"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("build"))
    for command in (["cmake", "-S", ".", "-B", "build"], ["cmake", "--build", "build"]):
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return open_runtime(read_service(folder), folder)


def request_of(seed: int, **options: float) -> tuple[dict[str, object], object]:
    """Return a request and the problem it came from."""
    problem = make_problem(seed=seed, **options)
    c = problem.camera
    camera = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
    points, pixels = problem.points_world.ravel().tolist(), problem.pixels.ravel().tolist()
    return {"camera": camera, "points_world": points, "pixels": pixels}, problem


@pytest.mark.parametrize("seed", range(8))
def test_it_agrees_with_the_platforms_solver_when_a_third_of_the_matches_is_wrong(
    pnp_lua: Runtime, seed: int
) -> None:
    request, problem = request_of(seed)

    reply = pnp_lua.call(request)

    ours = solve_pnp(problem.points_world, problem.pixels, problem.camera)
    T = np.reshape(reply["T_camera_world"], (4, 4))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    metres, degrees = pose_difference(T, ours.T_camera_world)
    assert metres <= 0.01
    assert degrees <= 0.2
    assert abs(reply["inliers"] - len(ours.inliers)) <= 8


def test_the_recorded_request_has_the_platforms_pose(pnp_lua: Runtime) -> None:
    recorded = json.loads((EXAMPLE / "requests" / "example.json").read_text())
    _, problem = request_of(3)

    reply = pnp_lua.call(recorded["request"])

    np.testing.assert_allclose(reply["T_camera_world"], recorded["reply"]["T_camera_world"], atol=1e-6)
    ours = solve_pnp(problem.points_world, problem.pixels, problem.camera)
    metres, degrees = pose_difference(np.reshape(reply["T_camera_world"], (4, 4)), ours.T_camera_world)
    assert (metres <= 0.01, degrees <= 0.2) == (True, True)


def test_points_that_all_lie_in_one_place_are_degenerate(pnp_lua: Runtime) -> None:
    request, _ = request_of(1)

    with pytest.raises(DegenerateGeometry):
        pnp_lua.call({**request, "points_world": [0.0, 0.0, 2.0] * 200})
