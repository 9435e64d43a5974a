"""The refinement with depth in the native core: the poses of numpy, the same bytes with and without AVX2."""

from __future__ import annotations

import threading

import msgspec
import numpy as np
import pytest

from rse_pf import native
from rse_pf.geometry import Array, exp_se3, transform
from rse_pf.pnp import PnpSolution, refine_with_depth
from rse_pf.pnp.depth_refinement import refine_by_numpy
from rse_pf.pnp.native_depth import DepthCore, RefinedPose, depth_core, open_depth
from rse_pf.pnp.problems import KINECT

LIBRARY = native.find_library()
needs_library = pytest.mark.skipif(
    depth_core() is None, reason="the native core is not built: make -C native"
)
NOISE = (0.0012, 0.0019, 0.4)


@pytest.fixture(params=["avx2", "portable"])
def core(request: pytest.FixtureRequest) -> DepthCore:
    assert LIBRARY is not None
    return open_depth(LIBRARY, portable=request.param == "portable")


class Problem(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Matches of two depth images, and the pose that their pixels gave."""

    solution: PnpSolution
    points: Array
    pixels: Array
    depths_m: Array

    @property
    def arguments(self) -> tuple[Array, Array, Array]:
        return self.points, self.pixels, self.depths_m


def problem(seed: int, n: int | None = None) -> Problem:
    """Return a problem of 4 to 300 rows, of which some have no depth and some are no inliers."""
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


def refined(core: DepthCore, case: Problem) -> RefinedPose | str:
    return core.refine(case.solution, *case.arguments, KINECT, NOISE)


@needs_library
def test_the_poses_are_those_of_numpy(core: DepthCore) -> None:
    kept = 0
    for seed in range(80):
        case = problem(seed)
        expected = refine_by_numpy(case.solution, *case.arguments, KINECT)

        found = refined(core, case)

        if isinstance(found, str):
            kept += 1
            assert (found, expected) == ("kept", case.solution)
            continue
        np.testing.assert_allclose(found.T_camera_reference, expected.T_camera_world, rtol=0, atol=1e-9)
        scale = np.abs(expected.covariance).max()
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=0, atol=1e-7 * scale)
        assert found.rmse_px == pytest.approx(expected.rmse_px, rel=1e-9)
    assert 0 < kept < 40


@needs_library
def test_avx2_changes_no_byte() -> None:
    assert LIBRARY is not None
    cores = open_depth(LIBRARY), open_depth(LIBRARY, portable=True)
    for seed in range(300):
        first, second = (refined(core, problem(seed)) for core in cores)
        if isinstance(first, str) or isinstance(second, str):
            assert first == second
            continue
        assert first.T_camera_reference.tobytes() == second.T_camera_reference.tobytes()
        assert first.covariance.tobytes() == second.covariance.tobytes()
        assert first.rmse_px == second.rmse_px


@needs_library
@pytest.mark.parametrize("n", [4, 5, 6, 7, 8, 511, 512, 513, 1100])
def test_any_number_of_rows_fits_the_workspace(core: DepthCore, n: int) -> None:
    case = problem(3, n)
    case = msgspec.structs.replace(
        case, solution=msgspec.structs.replace(case.solution, inliers=np.arange(n)),
        depths_m=np.maximum(case.depths_m, 1.0),
    )  # fmt: skip

    assert refined(core, case) != "refused"


@needs_library
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
def test_what_does_not_fit_is_refused(core: DepthCore, change: dict[str, Array]) -> None:
    assert refined(core, msgspec.structs.replace(problem(1, 50), **change)) == "refused"


@needs_library
@pytest.mark.parametrize("row", [-1, 50, 2**62, -(2**62)])
def test_row_numbers_outside_the_arrays_are_refused(core: DepthCore, row: int) -> None:
    case = problem(1, 50)
    inliers = np.array([0, 1, 2, 3, row])

    assert refined(
        core, msgspec.structs.replace(case, solution=msgspec.structs.replace(case.solution, inliers=inliers))
    ) == "refused"  # fmt: skip


@needs_library
def test_no_inliers_at_all_keep_the_pose(core: DepthCore) -> None:
    case = problem(1, 50)
    none = msgspec.structs.replace(case.solution, inliers=np.empty(0, dtype=np.intp))

    assert refined(core, msgspec.structs.replace(case, solution=none)) == "kept"


@needs_library
def test_absurd_numbers_give_a_finite_pose_or_none(core: DepthCore) -> None:
    rng = np.random.default_rng(5)
    for seed in range(300):
        case = problem(seed)
        scale = 10.0 ** rng.uniform(-12, 8, 3)
        spoilt = rng.random(len(case.points)) < 0.3
        points, pixels = case.points.copy(), case.pixels.copy()
        points[spoilt] *= scale[0]
        pixels[spoilt] *= scale[1]
        found = refined(
            core,
            msgspec.structs.replace(
                case, points=points, pixels=pixels, depths_m=np.minimum(1e3, case.depths_m * scale[2])
            ),
        )
        if not isinstance(found, str):
            assert np.isfinite(found.T_camera_reference).all()
            assert np.isfinite(found.covariance).all()
            assert (np.diag(found.covariance) > 0.0).all()


@needs_library
def test_threads_do_not_share_memory() -> None:
    core = depth_core()
    assert core is not None
    cases = [problem(seed, 200) for seed in range(20, 28)]
    expected = [refined(core, case) for case in cases]
    wrong: list[int] = []

    def check(which: int) -> None:
        for _ in range(200):
            found, right = refined(core, cases[which]), expected[which]
            same = found == right if isinstance(right, str) else (
                not isinstance(found, str)
                and found.T_camera_reference.tobytes() == right.T_camera_reference.tobytes()
            )  # fmt: skip
            if not same:
                wrong.append(which)

    threads = [threading.Thread(target=check, args=(which,)) for which in range(len(cases))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert not wrong


@needs_library
def test_solutions_of_the_native_engine_are_refined_natively() -> None:
    case = problem(2, 100)
    core = depth_core()
    assert core is not None
    native_pose = refined(core, case)
    assert isinstance(native_pose, RefinedPose)

    found = refine_with_depth(case.solution, *case.arguments, KINECT)
    other = refine_with_depth(
        msgspec.structs.replace(case.solution, engine="opencv"), *case.arguments, KINECT
    )

    assert found.T_camera_world.tobytes() == native_pose.T_camera_reference.tobytes()
    assert (
        other.T_camera_world.tobytes()
        == refine_by_numpy(case.solution, *case.arguments, KINECT).T_camera_world.tobytes()
    )


def test_numbers_at_odd_addresses_are_copied_for_the_library():
    numbers = np.arange(5.0)
    moved = np.frombuffer(b"\0" + numbers.tobytes(), np.uint8)[1:].view(np.float64)

    assert not moved.flags.aligned
    assert native.aligned(moved).flags.aligned
    assert native.aligned(moved).tolist() == numbers.tolist()
    assert native.aligned(numbers) is numbers
