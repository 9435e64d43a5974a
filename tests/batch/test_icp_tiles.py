"""Overlapping clouds of two maps give links between keyframes, tile by tile."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from rse_pf.extensions.batch.icp_tiles import align_tiles
from rse_pf.geometry import Camera, exp_se3, inverse, pose_difference, transform
from rse_pf.maps.format import Keyframe, MapVersion
from rse_pf.slam.loop_closures import Atlas
from tests.kit.synthetic_maps import make_room

pytest.importorskip("small_gicp", reason="the extra maps is not installed")

CAMERA = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)


def a_map(T_world_camera: np.ndarray) -> MapVersion:
    nothing = np.empty((0, 2), dtype=np.float32)
    keyframe = Keyframe(
        id=0, robot="r", timestamp_s=0.0, T_world_camera=T_world_camera, camera=CAMERA, pixels=nothing,
        descriptors=np.empty((0, 32), dtype=np.uint8), points_camera=np.empty((0, 3), dtype=np.float32),
    )  # fmt: skip
    return MapVersion(keyframes=(keyframe,))


def test_a_small_error_between_two_maps_is_measured() -> None:
    truth = exp_se3(np.array([0.4, 0.2, 0.0, 0.0, 0.0, 0.3]))
    guess = truth @ exp_se3(np.array([0.03, -0.02, 0.02, 0.0, 0.01, 0.0]))
    target = make_room(1, points=12_000)
    source = transform(inverse(truth), make_room(2, points=12_000))
    atlas = Atlas.of([a_map(np.eye(4)), a_map(np.eye(4))])

    links, _ = align_tiles(atlas, (target, source), guess)

    assert links
    for link in links:
        metres, degrees = pose_difference(link.T_a_b, truth)
        assert metres < 0.01
        assert degrees < 0.5


def test_clouds_that_do_not_overlap_give_no_link() -> None:
    far = np.eye(4)
    far[0, 3] = 50.0
    cloud = make_room(1, points=5_000)
    atlas = Atlas.of([a_map(np.eye(4)), a_map(np.eye(4))])

    assert align_tiles(atlas, (cloud, cloud), far) == ([], Counter())
