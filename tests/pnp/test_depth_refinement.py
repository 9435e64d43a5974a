"""Refinement of poses with depths: smaller errors, a correct covariance, and no harm from wrong depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array, inverse, pose_difference
from rse_pf.pnp import (
    DepthNoise,
    PnpOptions,
    PnpSolution,
    refine_with_depth,
    solve_pnp,
)
from rse_pf.pnp.problems import KINECT
from tests.kit.two_views import TwoViews, make_two_views

_NOISE = DepthNoise()
_options = PnpOptions(inlier_px=5.0)


@pytest.fixture(autouse=True, params=["native", "opencv"])
def options(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each test with the poses of both engines."""
    monkeypatch.setitem(globals(), "_options", PnpOptions(inlier_px=5.0, engine=request.param))


def two_views(seed: int, *, missing: float = 0.1) -> TwoViews:
    return make_two_views(seed=seed, missing_ratio=missing)


def solved(views: TwoViews) -> PnpSolution:
    return solve_pnp(views.points_reference, views.pixels, KINECT, _options)


def refined(views: TwoViews, noise: DepthNoise = _NOISE) -> PnpSolution:
    return refine_with_depth(
        solved(views), views.points_reference, views.pixels, views.depths_m, KINECT, noise
    )


def error_m(T_camera_reference: Array, views: TwoViews) -> float:
    return pose_difference(inverse(T_camera_reference), inverse(views.T_camera_reference))[0]


def normalised_error2(solution: PnpSolution, views: TwoViews) -> float:
    """Return xi^T covariance^-1 xi of the small twist that leads to the true pose."""
    error = views.T_camera_reference @ inverse(solution.T_camera_world)
    R = error[:3, :3]
    turned = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    xi = np.concatenate([error[:3, 3], turned])
    return float(xi @ np.linalg.solve(solution.covariance, xi))


def test_depth_on_both_sides_makes_the_error_smaller():
    views = [two_views(seed) for seed in range(60)]

    by_pnp = np.median([error_m(solved(each).T_camera_world, each) for each in views])
    by_depth = np.median([error_m(refined(each).T_camera_world, each) for each in views])

    assert by_depth < 0.85 * by_pnp


@pytest.mark.parametrize("missing", [0.1, 0.8])
def test_the_covariance_is_consistent_with_the_error(missing: float):
    views = [two_views(seed, missing=missing) for seed in range(200)]

    mean = np.mean([normalised_error2(refined(each), each) for each in views])

    # 6 in theory; its standard deviation over 200 problems is 0.25.
    assert 5.0 < mean < 7.2


def test_rows_without_depth_take_part_with_their_pixel():
    views = two_views(3)
    half = replace(views, depths_m=np.where(np.arange(len(views.points_reference)) % 2, views.depths_m, 0.0))

    with_half, with_all = refined(half), refined(views)

    assert np.trace(with_all.covariance) < np.trace(with_half.covariance) < np.trace(solved(views).covariance)


def test_a_fifth_of_wrong_depths_does_not_spoil_the_pose():
    views = [two_views(seed) for seed in range(40)]
    spoilt = [replace(each, depths_m=_with_wrong_depths(each.depths_m)) for each in views]

    by_pnp = np.median([error_m(solved(each).T_camera_world, each) for each in views])
    by_depth = np.median([error_m(refined(each).T_camera_world, each) for each in spoilt])

    assert by_depth < by_pnp


def _with_wrong_depths(depths_m: Array) -> Array:
    wrong = depths_m.copy()
    wrong[::5] += np.where(wrong[::5] > 0.0, 0.8, 0.0)
    return wrong


@pytest.mark.parametrize("factor", [0.5, 3.0, 100.0])
def test_depths_in_a_wrong_unit_do_not_spoil_the_pose(factor: float):
    views = two_views(7)

    found = refined(replace(views, depths_m=views.depths_m * factor))

    assert error_m(found.T_camera_world, views) < 0.02


def test_the_noise_of_the_right_sensor_gives_the_smaller_error():
    views = [two_views(seed) for seed in range(40)]
    wrong = DepthNoise(base_m=0.1)

    right, other = (
        np.median([error_m(refined(each, noise).T_camera_world, each) for each in views])
        for noise in (_NOISE, wrong)
    )

    assert right < 0.9 * other


def test_points_behind_the_reference_camera_are_refused():
    views = two_views(9)
    points = views.points_reference.copy()
    points[0, 2] = -1.0
    with pytest.raises(BadRequest, match="reference camera"):
        refine_with_depth(solved(views), points, views.pixels, views.depths_m, KINECT)


@pytest.mark.parametrize("name", ["base_m", "growth_per_m", "from_m"])
@pytest.mark.parametrize("value", [-1.0, np.nan, 1e9])
def test_noise_out_of_range_is_refused(name: str, value: float):
    with pytest.raises(BadRequest, match=name):
        DepthNoise(**{name: value})
