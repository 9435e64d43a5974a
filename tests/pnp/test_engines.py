"""Both PnP engines: correct poses, equal poses for equal requests, and errors of this package only."""

from __future__ import annotations

import sys
import threading

import numpy as np
import pytest

from rse_pf.errors import MissingExtra
from rse_pf.geometry import pose_difference
from rse_pf.pnp import PnpOptions, available_engines, engines, solve_pnp
from rse_pf.pnp.problems import make_problem
from tests.kit.native_reference import EVERY


def right(solution, problem):
    metres, degrees = pose_difference(solution.T_camera_world, problem.T_camera_world)
    return metres < 0.1 and degrees < 2.0


def share_right(engine, *, n, outlier_ratio, problems):
    good = 0
    for seed in range(problems):
        problem = make_problem(seed=seed, n=n, outlier_ratio=outlier_ratio)
        solution = solve_pnp(problem.points_world, problem.pixels, problem.camera, PnpOptions(engine=engine))
        good += right(solution, problem) and solution.verdict == "ok"
    return good / problems


@EVERY
@pytest.mark.parametrize("n", [100, 200])
@pytest.mark.parametrize("outlier_ratio", [0.1, 0.3, 0.5])
def test_both_engines_are_right_at_up_to_half_wrong_matches(engine, n, outlier_ratio):
    assert share_right(engine, n=n, outlier_ratio=outlier_ratio, problems=60) >= 0.995


def test_the_engines_agree_with_each_other():
    for seed in range(20):
        problem = make_problem(seed=seed, outlier_ratio=0.4)

        poses = [
            solve_pnp(problem.points_world, problem.pixels, problem.camera, PnpOptions(engine=engine))
            for engine in available_engines()
        ]

        metres, degrees = pose_difference(poses[0].T_camera_world, poses[1].T_camera_world)
        assert metres < 0.01
        assert degrees < 0.2


@EVERY
def test_the_same_request_gives_the_same_pose_whatever_was_solved_before_and_in_any_thread(engine):
    problem = make_problem(seed=11, outlier_ratio=0.6)
    options = PnpOptions(engine=engine)
    poses = []

    def solve():
        solution = solve_pnp(problem.points_world, problem.pixels, problem.camera, options)
        poses.append(solution.T_camera_world)

    solve()
    other = make_problem(seed=12)
    solve_pnp(other.points_world, other.pixels, other.camera, options)
    solve()
    threads = [threading.Thread(target=solve) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=20)

    assert len(poses) == 5
    assert all(np.array_equal(pose, poses[0]) for pose in poses)


@EVERY
def test_a_plane_is_solved_right_or_not_at_all(engine):
    """Guard against an old fault: EPnP found a plane's second minimum, and its pose was ok."""
    rng = np.random.default_rng(3)
    for seed in range(30):
        problem = make_problem(seed=seed, n=80, outlier_ratio=0.0)
        tilt = rng.uniform(-0.6, 0.6, 2)
        flat = np.column_stack([rng.uniform(-0.8, 0.8, (80, 2)), np.full(80, 3.0)])
        flat[:, 2] += flat[:, :2] @ tilt
        pixels = problem.camera.project(flat) + rng.normal(size=(80, 2))

        solution = solve_pnp(flat, pixels, problem.camera, PnpOptions(engine=engine))

        metres, degrees = pose_difference(solution.T_camera_world, np.eye(4))
        assert solution.verdict == "weak" or (metres < 0.1 and degrees < 2.0)


def test_without_opencv_its_engine_names_the_pip_command(monkeypatch):
    make = engines.ENGINES["opencv"]
    make.cache_clear()
    monkeypatch.setitem(sys.modules, "cv2", None)
    try:
        with pytest.raises(MissingExtra) as caught:
            engines.engine_for("opencv")
        assert "pip install 'rse-pf[" in caught.value.hint
        assert available_engines() == ("native",)
    finally:
        make.cache_clear()
