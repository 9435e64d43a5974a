"""The native solver: no worse than PoseLib, evidence of the oracle, and equal bytes for equal requests."""

from __future__ import annotations

import math
import os
import re
import shutil
import subprocess

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rse_pf import native
from rse_pf.errors import (
    BadRequest,
    ConfigurationError,
    MissingExtra,
)
from rse_pf.pnp import PnpOptions, WeakLimits, engines
from rse_pf.pnp.native_solver import NativeSolver, native_solver, open_solver
from rse_pf.pnp.problems import KINECT, make_problem
from tests.kit.native_reference import (
    accepted,
    case,
    compare,
    degenerate,
    mean_normalised_error,
    outcome,
    same_bytes,
)
from tests.oracles import pose_evidence

COMPILER = os.environ.get("CXX", "g++")
OPTIONS = engines.native_options(PnpOptions(), WeakLimits())


@pytest.fixture
def solver() -> NativeSolver:
    """The solver of the native core."""
    return native_solver()


def solve(solver, problem, **changes):
    options = msgspec.structs.replace(OPTIONS, **changes)
    return accepted(solver.evaluate(problem.points_world, problem.pixels, problem.camera, options))


def assert_no_worse_than_poselib(report):
    """Require PoseLib's success and accuracy, no wrong pose that is ok, and equal bytes without AVX2."""
    total = report["all"]
    assert total["native right"] >= total["poselib right"] - 0.0005 * total["n"]
    assert total["native right and ok"] >= total["poselib right and ok"]
    assert total.get("native wrong and ok", 0) == 0
    for row in report["kinds"].values():
        assert row["native right"] >= row["poselib right"] - 0.005 * row["n"]
    ours, theirs = report["error_mm"]["native"], report["error_mm"]["poselib"]
    assert ours[0] <= 1.02 * theirs[0], "median"
    assert ours[1] <= 1.05 * theirs[1], "95th percentile"
    assert report["other_bytes_without_avx2"] == 0


def test_no_less_success_and_accuracy_than_poselib_and_the_same_bytes_without_avx2(solver):
    report = compare(map(case, range(100)))

    assert_no_worse_than_poselib(report)
    assert report["all"]["native right"] > 80


@pytest.mark.slow
def test_no_less_success_and_accuracy_than_poselib_on_ten_thousand_problems(solver):
    assert_no_worse_than_poselib(compare(map(case, range(10_000))))


@pytest.mark.parametrize("make", [case, degenerate])
def test_the_evidence_is_that_of_the_oracle(solver, make):
    # The last five have a second pose near the first, by the distance that pose_difference measures.
    for each in map(make, [*range(100), 331, 471, 667, 681, 849]):
        rows = (each.points_world, each.pixels, each.camera)
        if not all(np.isfinite(values).all() and np.abs(values).max() <= 1e6 for values in rows[:2]):
            continue
        ours = solver.evaluate(*rows, OPTIONS)
        if len(ours.inliers) < 4:
            continue
        expected = pose_evidence.evidence(ours.T_camera_world, *rows, OPTIONS.inlier_px)

        assert np.array_equal(ours.inliers, expected.inliers)
        assert ours.independent_inliers == expected.independent_inliers
        assert ours.rmse_px == pytest.approx(expected.rmse_px, rel=1e-6, abs=1e-6)
        assert ours.log10_false_alarms == pytest.approx(expected.log10_false_alarms, rel=1e-9)
        assert ours.radius_px == pytest.approx(expected.radius_px, rel=1e-9, abs=1e-4)
        # For inliers with a ratio above 0.15 the core computes a lower bound only.
        assert min(0.15, ours.inlier_width_to_length) == pytest.approx(
            min(0.15, expected.inlier_width_to_length), abs=1e-4
        )
        if ours.refusal is None:
            deviation = np.sqrt(np.diag(expected.covariance))
            difference = (ours.covariance - expected.covariance) / np.outer(deviation, deviation)
            assert np.abs(difference).max() < 1e-5
            assert ours.second_pose_rmse_px == pytest.approx(expected.second_pose_rmse_px, rel=1e-6)


@pytest.mark.parametrize("make", [case, degenerate])
def test_a_pose_that_is_given_has_the_evidence_of_the_same_pose_that_was_estimated(solver, make):
    for each in map(make, range(60)):
        rows = (each.points_world, each.pixels, each.camera, OPTIONS)
        try:
            estimated = solver.evaluate(*rows)
        except BadRequest:
            continue
        if not len(estimated.inliers):
            continue

        given = solver.evaluate(*rows, estimated.T_camera_world)

        assert np.array_equal(given.inliers, estimated.inliers)
        assert (given.reason, str(given.refusal)) == (estimated.reason, str(estimated.refusal))


def test_the_covariance_predicts_the_error(solver):
    """Normalised error squared is chi-square with 6 degrees: mean 6, standard error sqrt(12 / n)."""
    assert abs(mean_normalised_error(300, 0.3) - 6.0) < 4.0 * math.sqrt(12.0 / 300)


@pytest.mark.slow
@pytest.mark.parametrize("outlier_ratio", [0.0, 0.3])
def test_the_mean_normalised_error_squared_is_six(solver, outlier_ratio):
    assert abs(mean_normalised_error(1000, outlier_ratio) - 6.0) <= 0.6


def test_a_world_far_from_its_origin_has_the_same_pose(solver):
    problem = make_problem(seed=1, outlier_ratio=0.5)
    shift = np.array([4.0e5, -7.0e5, 9.0e4])

    near = solve(solver, problem)
    far = solver.evaluate(problem.points_world + shift, problem.pixels, KINECT, OPTIONS)

    np.testing.assert_allclose(far.T_camera_world[:3, :3], near.T_camera_world[:3, :3], atol=1e-6)
    moved_back = far.T_camera_world[:3, 3] + far.T_camera_world[:3, :3] @ shift
    np.testing.assert_allclose(moved_back, near.T_camera_world[:3, 3], atol=1e-6)


def test_wrong_points_at_the_limit_of_what_is_allowed_do_not_spoil_the_others(solver):
    problem = make_problem(seed=4, outlier_ratio=0.4)
    points = problem.points_world.copy()
    points[~problem.is_inlier] *= 1e5

    found = solver.evaluate(points, problem.pixels, KINECT, OPTIONS)

    np.testing.assert_allclose(found.T_camera_world, problem.T_camera_world, atol=0.02)


numbers = st.floats(width=64, allow_nan=True, allow_infinity=True, allow_subnormal=True)
mild = st.floats(-10, 700, allow_nan=False)


@settings(max_examples=120, deadline=None)
@given(data=st.data(), n=st.integers(4, 40))
def test_any_numbers_give_finite_evidence_or_a_typed_error(data, n):
    opened = native_solver()
    elements = data.draw(st.sampled_from([numbers, mild, st.integers(-3, 3).map(float)]))
    points = data.draw(hnp.arrays(np.float64, (n, 3), elements=elements))
    pixels = data.draw(hnp.arrays(np.float64, (n, 2), elements=elements))

    def with_lanes(lanes):
        options = msgspec.structs.replace(OPTIONS, lanes=lanes)
        return outcome(lambda: accepted(opened.evaluate(points, pixels, KINECT, options)))

    wide = with_lanes("avx512")
    for narrow in (with_lanes("avx2"), with_lanes("portable")):
        assert narrow[:2] == wide[:2]
        assert same_bytes(narrow[2], wide[2])
    if wide[2] is not None:
        assert np.isfinite(wide[2].T_camera_world).all()
        assert np.isfinite(wide[2].covariance).all()


def test_the_file_needs_the_c_library_of_2018_and_nothing_else():
    """Debian 10, Amazon Linux 2023 and every later system have it."""
    if shutil.which("readelf") is None:
        pytest.skip("no readelf")
    listed = subprocess.run(
        ["readelf", "--wide", "--dynamic", "--version-info", str(native.find_library())],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    versions = [tuple(map(int, each.split("."))) for each in re.findall(r"GLIBC_(\d+\.\d+)", listed)]

    assert set(re.findall(r"NEEDED.*\[(.+)\]", listed)) <= {"libc.so.6", "ld-linux-x86-64.so.2"}
    assert "GLIBCXX" not in listed
    assert max(versions) <= (2, 28)


def test_the_checks_in_cpp_pass(repository):
    if shutil.which(COMPILER) is None:
        pytest.skip(f"no C++ compiler ({COMPILER})")
    done = subprocess.run(
        ["make", "-C", str(repository / "native"), f"CXX={COMPILER}", "check"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip

    assert done.returncode == 0, done.stdout + done.stderr


def test_a_missing_library_is_one_error_that_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(native, "find_library", lambda: None)

    with pytest.raises(MissingExtra, match="the native core is not installed") as caught:
        native.load_core(open_solver)

    assert caught.value.hint == (
        "make native in a checkout; or pip install its folder native, then pip install 'rse-pf[vision]'"
    )


def test_a_file_that_is_no_library_is_refused_with_the_command_that_builds_one(tmp_path):
    path = tmp_path / "librse_pf_native.so"
    path.write_bytes(b"no library")

    with pytest.raises(ConfigurationError, match="cannot be loaded") as caught:
        open_solver(path)

    assert "make native" in caught.value.hint
