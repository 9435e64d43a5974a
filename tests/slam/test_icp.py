"""ICP recovers small offsets, and otherwise returns the initial pose with a reason."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rse_pf.geometry import Array, exp_se3, pose_difference
from rse_pf.slam.icp import IcpOptions, align_clouds
from tests.kit.default_cases import first_by_default
from tests.kit.synthetic_maps import make_room as full_room

pytest.importorskip("small_gicp", reason="the extra maps is not installed")


def make_room(seed: int, *, walls: int = 3) -> Array:
    """Return a room with few points, for fast tests."""
    return full_room(seed, points=6000, walls=walls)


def offset(seed: int, metres: float, degrees: float) -> Array:
    """Return a motion with this translation and rotation in a random direction."""
    rng = np.random.default_rng(seed)
    t, r = rng.normal(size=3), rng.normal(size=3)
    return exp_se3(
        np.concatenate([metres * t / np.linalg.norm(t), math.radians(degrees) * r / np.linalg.norm(r)])
    )


@pytest.mark.parametrize("seed", first_by_default(3, range(6)))
def test_recovers_five_centimetres_and_three_degrees_between_overlapping_clouds(seed: int) -> None:
    target, source = make_room(seed), make_room(seed + 100)
    source = source[source[:, 0] < 2.6]

    found = align_clouds(target, source, offset(seed, 0.05, 3.0))

    metres, degrees = pose_difference(found.T_target_source, np.eye(4))
    assert found.verdict == "ok", found.reason
    assert metres <= 0.01
    assert degrees <= 0.5


@pytest.mark.parametrize("walls", [1, 2])
def test_clouds_that_may_slide_on_their_surfaces_are_refused(walls: int) -> None:
    start = offset(1, 0.03, 1.0)

    found = align_clouds(make_room(1, walls=walls), make_room(2, walls=walls), start)

    assert (found.verdict, found.reason) == ("refused", "sliding")
    np.testing.assert_array_equal(found.T_target_source, start)


def test_clouds_that_hardly_overlap_are_refused_with_the_start() -> None:
    far = exp_se3([3.0, 3.0, 3.0, 0.0, 0.0, 0.0])

    found = align_clouds(make_room(1), make_room(2), far)

    assert found.verdict == "refused"
    assert found.reason in ("little-overlap", "not-converged")
    np.testing.assert_array_equal(found.T_target_source, far)


@pytest.mark.parametrize("seed", first_by_default(3, (0, 2, 3, 1, 4, 5, 6, 7)))
def test_an_answer_called_ok_is_never_farther_from_the_truth_than_its_start(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = offset(seed, float(rng.uniform(0.005, 0.5)), float(rng.uniform(0.2, 25.0)))
    target, source = make_room(seed), make_room(seed + 50)
    source = source[source[:, 1] < rng.uniform(1.0, 4.0)]

    found = align_clouds(target, source, start)

    before, after = pose_difference(start, np.eye(4)), pose_difference(found.T_target_source, np.eye(4))
    assert after[0] <= before[0] + 1e-3
    assert after[1] <= before[1] + 0.05


def test_a_jump_beyond_the_limit_is_refused() -> None:
    found = align_clouds(make_room(1), make_room(2), offset(3, 0.08, 1.0), IcpOptions(max_motion_m=0.02))

    assert (found.verdict, found.reason) == ("refused", "jumped")
