"""The search for landmarks around a first pose of a view."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from rse_pf.geometry import Array, exp_se3, pose_difference, transform
from rse_pf.maps.format import Keyframe
from rse_pf.services.mapping.localise import LocaliseOptions, locate
from rse_pf.services.mapping.photo import location_of
from rse_pf.services.mapping.place import MapIndex
from rse_pf.slam.guided_search import GuidedPose, MapLandmarks, search_around
from rse_pf.slam.relative_pose import View, landmarks_of_keyframe
from tests.kit.synthetic_maps import make_world

WORLD = make_world(1)
TRUTH = WORLD.pose(0.31)
TURNS = (0.27, 0.29, 0.32, 0.34, 0.36)


def keyframe_at(turn: float, number: int = 0) -> Keyframe:
    """Return a keyframe of the hall at its true pose."""
    pose = WORLD.pose(turn)
    return WORLD.keyframe(number, "map", pose, pose, np.random.default_rng(7 + number))


MAP = [keyframe_at(turn, number) for number, turn in enumerate(TURNS)]


def view_at(turn: float) -> View:
    keyframe = keyframe_at(turn, 90)
    return View(
        camera=keyframe.camera, pixels=keyframe.pixels.astype(np.float64), descriptors=keyframe.descriptors
    )


VIEW = view_at(0.31)


def search(first: Array, count: int | None = None) -> GuidedPose | None:
    """Search *count* landmarks of the map, or all, around a first pose of `VIEW`."""
    landmarks = [landmarks_of_keyframe(keyframe) for keyframe in MAP]
    poses = [keyframe.T_world_camera for keyframe in MAP]
    points = [transform(T, found.points_camera) for T, found in zip(poses, landmarks, strict=True)]
    around = MapLandmarks(
        points_map=np.concatenate(points)[:count],
        descriptors=np.concatenate([found.descriptors for found in landmarks])[:count],
    )
    return search_around(first, around, VIEW, min_inliers=7, inlier_px=6.0)


def thinned(keyframe: Keyframe) -> Keyframe:
    """Return a keyframe with every twentieth of its features."""
    rows = slice(keyframe.id, None, 20)
    return replace(
        keyframe,
        pixels=keyframe.pixels[rows],
        descriptors=keyframe.descriptors[rows],
        points_camera=keyframe.points_camera[rows],
    )


def test_a_first_pose_is_made_exact() -> None:
    found = search(TRUTH @ exp_se3([0.06, -0.04, 0.05, 0.01, 0.02, 0.0]))

    assert found is not None
    assert found.is_sure
    metres, degrees = pose_difference(found.T_map_camera, TRUTH)
    assert metres < 0.01
    assert degrees < 0.2


@pytest.mark.parametrize("twist", [[0.6, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 3.0, 0.0]])
def test_a_first_pose_elsewhere_finds_nothing(twist: list[float]) -> None:
    assert search(TRUTH @ exp_se3(twist)) is None


def test_keyframes_with_few_matches_each_place_a_view_together() -> None:
    sparse = [thinned(keyframe_at(turn, number)) for number, turn in enumerate(np.linspace(0.25, 0.37, 8))]

    found = locate(MapIndex(sparse), VIEW, LocaliseOptions(min_inliers=15))

    assert found.inliers < 15
    assert (found.verdict, found.reason) == ("ok", "")
    assert found.T_map_camera is not None
    assert pose_difference(found.T_map_camera, TRUTH)[0] < 0.02


@pytest.mark.parametrize("factor", [0.9, 0.95, 1.05, 1.1])
def test_a_wrong_focal_length_is_within_three_sigmas_of_a_pose_that_is_ok(factor: float) -> None:
    right = VIEW.camera
    camera = msgspec.structs.replace(right, fx=factor * right.fx, fy=factor * right.fy)

    found = locate(MapIndex(MAP), replace(VIEW, camera=camera))

    assert found.T_map_camera is not None
    sigma_m = location_of(found, "version").position_sigma_m
    assert sigma_m is not None
    moved_m = pose_difference(found.T_map_camera, TRUTH)[0]
    assert found.verdict != "ok" or moved_m <= max(0.05, 3.0 * sigma_m)
