"""The refinement with depths equals its definition in NumPy, and has the same bytes without AVX2."""

from __future__ import annotations

import threading

import msgspec
import numpy as np
import pytest

from rse_pf import native
from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, exp_se3, transform
from rse_pf.pnp import DepthNoise, PnpSolution, refine_with_depth
from rse_pf.pnp.problems import KINECT
from tests.oracles import pose_fit

NOISE = DepthNoise()


class Problem(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Correspondences of two depth images, and the pose that PnP estimated from their pixels."""

    solution: PnpSolution
    points: Array
    pixels: Array
    depths_m: Array

    @property
    def arguments(self) -> tuple[Array, Array, Array]:
        return self.points, self.pixels, self.depths_m


def problem(seed: int, n: int | None = None) -> Problem:
    """Return a problem of 4 to 300 rows; some rows have no depth, and some are outliers."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 300)) if n is None else n
    T = exp_se3(rng.normal(size=6) * ([0.15] * 3 + [0.08] * 3))
    depth_m = rng.uniform(1.5, 4.5, n)
    points = KINECT.back_project(rng.uniform(80.0, [560.0, 400.0], (n, 2)), depth_m)
    seen = transform(T, points)
    depths_m = seen[:, 2] + rng.normal(size=n) * 0.01
    depths_m[rng.random(n) < rng.choice([0.0, 0.3, 0.9, 1.0])] = 0.0
    inliers = np.flatnonzero(rng.random(n) < 0.8)
    solution = PnpSolution(
        T_camera_world=exp_se3(rng.normal(size=6) * 0.003) @ T,
        inliers=inliers if len(inliers) >= 4 else np.arange(n), rmse_px=float(rng.uniform(1.0, 2.5)),
        covariance=np.eye(6), verdict="ok", reason="", engine="native",
    )  # fmt: skip
    return Problem(
        solution=solution, points=points * (1.0 + 0.003 * rng.normal(size=(n, 1))),
        pixels=KINECT.project(seen) + rng.normal(size=(n, 2)), depths_m=depths_m,
    )  # fmt: skip


def refined(case: Problem, *, portable: bool = False) -> PnpSolution:
    return refine_with_depth(case.solution, *case.arguments, KINECT, NOISE, portable=portable)


def same_bytes(one: PnpSolution, other: PnpSolution) -> bool:
    numbers = [
        (each.T_camera_world.tobytes(), each.covariance.tobytes(), each.rmse_px) for each in (one, other)
    ]
    return numbers[0] == numbers[1]


def test_poses_are_those_of_the_definition() -> None:
    unchanged = 0
    for seed in range(80):
        case = problem(seed)
        expected = pose_fit.refine_with_depth(case.solution, *case.arguments, KINECT, NOISE)

        found = refined(case)

        if expected is None:
            unchanged += 1
            assert found is case.solution
            continue
        np.testing.assert_allclose(found.T_camera_world, expected.T_camera_world, rtol=0, atol=1e-9)
        scale = np.abs(expected.covariance).max()
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=0, atol=1e-7 * scale)
        assert found.rmse_px == pytest.approx(expected.rmse_px, rel=1e-9)
    assert 0 < unchanged < 40


def test_avx2_changes_no_byte() -> None:
    for seed in range(300):
        assert same_bytes(refined(problem(seed)), refined(problem(seed), portable=True))


@pytest.mark.parametrize("n", [4, 5, 6, 7, 8, 511, 512, 513, 1100])
def test_any_number_of_rows_fits_the_workspace(n: int) -> None:
    case = problem(3, n)
    case = msgspec.structs.replace(
        case, solution=msgspec.structs.replace(case.solution, inliers=np.arange(n)),
        depths_m=np.maximum(case.depths_m, 1.0),
    )  # fmt: skip

    assert np.isfinite(refined(case).T_camera_world).all()


@pytest.mark.parametrize(
    "change",
    [
        {"depths_m": np.full(50, -1e-9)},
        {"depths_m": np.full(50, np.nan)},
        {"depths_m": np.full(50, 1000.1)},
        {"depths_m": np.zeros(49)},
        {"points": np.zeros((50, 3))},
        {"points": np.full((50, 3), np.inf)},
        {"points": np.ones((49, 3))},
        {"points": np.ones((50, 2))},
        {"pixels": np.full((50, 2), np.nan)},
        {"pixels": np.ones(100)},
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, Array]) -> None:
    with pytest.raises(BadRequest, match="depths_m"):
        refined(msgspec.structs.replace(problem(1, 50), **change))


def test_absurd_numbers_give_a_finite_pose_or_an_error() -> None:
    rng = np.random.default_rng(5)
    for seed in range(300):
        case = problem(seed)
        scale = 10.0 ** rng.uniform(-12, 8, 3)
        spoilt = rng.random(len(case.points)) < 0.3
        points, pixels = case.points.copy(), case.pixels.copy()
        points[spoilt] *= scale[0]
        pixels[spoilt] *= scale[1]
        spoilt_case = msgspec.structs.replace(
            case, points=points, pixels=pixels, depths_m=np.minimum(1e3, case.depths_m * scale[2])
        )
        try:
            found = refined(spoilt_case)
        except BadRequest:
            continue
        assert np.isfinite(found.T_camera_world).all()
        assert np.isfinite(found.covariance).all()
        assert (np.diag(found.covariance) > 0.0).all()


def test_threads_do_not_share_memory() -> None:
    cases = [problem(seed, 200) for seed in range(20, 28)]
    expected = [refined(case) for case in cases]
    wrong: list[int] = []

    def check(which: int) -> None:
        for _ in range(200):
            if not same_bytes(refined(cases[which]), expected[which]):
                wrong.append(which)

    threads = [threading.Thread(target=check, args=(which,)) for which in range(len(cases))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert not wrong


def test_numbers_at_odd_addresses_are_copied_for_the_library():
    numbers = np.arange(5.0)
    moved = np.frombuffer(b"\0" + numbers.tobytes(), np.uint8)[1:].view(np.float64)

    assert not moved.flags.aligned
    assert native.aligned(moved).flags.aligned
    assert native.aligned(moved).tolist() == numbers.tolist()
    assert native.aligned(numbers) is numbers
