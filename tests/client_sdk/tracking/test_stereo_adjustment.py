"""All keyframes of a stereo drive adjusted together with what its disparities lack."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.stereo.depth import with_offset
from client_sdk.tracking.keyframe_map import KeyframeMap, View
from client_sdk.tracking.landmark_matching import NO_LANDMARK, LazyPlaceVector
from client_sdk.tracking.stereo_adjustment import adjust_stereo
from rse_pf.geometry import Array, Camera, exp_se3, inverse, transform
from rse_pf.slam.stereo import stereo_noise
from rse_pf.slam.tracking import Features

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

CAMERA = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
F_BASELINE, OFFSET_PX, SCALE = 60.0, 0.3, 1.02


def drive(offset_px: float, keyframes: int = 8, noise_px: float = 0.05) -> tuple[KeyframeMap, Array, Array]:
    """Return a map whose path is 2 % too long, the true ``T_world_camera``, and the true landmarks."""
    rng = np.random.default_rng(4)
    points = CAMERA.back_project(rng.uniform([60, 60], [580, 420], (300, 2)), rng.uniform(4.0, 20.0, 300))
    steps = np.arange(keyframes)[:, None] * np.array([0.15, 0.02, 0.25, 0.004, -0.006, 0.002])
    truth = exp_se3(steps)
    known = KeyframeMap(100)
    landmarks = np.full(len(points), NO_LANDMARK)
    for number, T in enumerate(truth):
        seen = transform(inverse(T), points)
        pixels = CAMERA.project(seen) + rng.normal(0.0, 0.3, (len(points), 2))
        disparities = F_BASELINE / seen[:, 2] - offset_px + rng.normal(0.0, noise_px, len(points))
        features = Features(
            pixels=pixels, descriptors=np.zeros((len(points), 32), dtype=np.uint8),
            orientations=np.tile([1.0, 0.0], (len(points), 1)), sizes=np.ones(len(points)),
            points_camera=CAMERA.back_project(pixels, F_BASELINE / disparities),
            distinctiveness=np.zeros(len(points), dtype=np.int32),
        )  # fmt: skip
        view = View(
            features=features,
            shutter_displacements=np.zeros((len(points), 3)),
            camera=CAMERA,
            place_vector=LazyPlaceVector(lambda: np.ones(4, np.float32)),
            is_stereo=True,
            timestamp_s=0.5 * number,
        )
        tracked = T.copy()
        tracked[:3, 3] *= SCALE
        landmarks = known.add_keyframe(view, tracked, landmarks, stereo_noise(F_BASELINE, 0.1))
    return known, truth, points


@pytest.mark.parametrize("offset_px", [OFFSET_PX, -OFFSET_PX])
def test_the_offset_of_disparities_and_the_metres_are_found(offset_px: float) -> None:
    known, truth, points = drive(offset_px)

    found = adjust_stereo(known, F_BASELINE)

    assert found is not None
    assert found.offset_px == pytest.approx(offset_px, abs=4.0 * found.deviation_px + 0.01)
    assert found.deviation_px < 0.05
    poses = known.poses
    assert np.abs(poses[:, :3, 3] - truth[:, :3, 3]).max() < 0.01  # 4 cm before
    landmarks, _ = known.landmarks_around(truth[0])
    assert np.median(np.linalg.norm(landmarks.points - points, axis=1) / points[:, 2]) < 0.03
    measured = known.views[3].features.points_camera[:, 2]
    expected = transform(inverse(truth[3]), points)[:, 2]
    assert abs(np.median(F_BASELINE / measured - F_BASELINE / expected)) < 0.06  # 0.3 before


def test_noise_of_disparities_looks_like_no_offset_of_them() -> None:
    found = [adjust_stereo(drive(each, noise_px=0.4)[0], F_BASELINE) for each in (OFFSET_PX, -OFFSET_PX)]

    # The noise taken at the measured depths makes this -0.06, at the expected ones 0.07.
    assert None not in found
    assert abs(np.mean([each.offset_px for each in found if each is not None])) < 0.025


def test_poses_between_keyframes_move_with_them() -> None:
    known, _truth, _ = drive(OFFSET_PX)
    found = adjust_stereo(known, F_BASELINE)
    between = exp_se3(3.5 * np.array([0.15, 0.02, 0.25, 0.004, -0.006, 0.002]))
    tracked = between.copy()
    tracked[:3, 3] *= SCALE

    assert found is not None
    moved = found.moved(np.array([1.75]), tracked[None])[0]

    np.testing.assert_allclose(moved[:3, 3], between[:3, 3], atol=0.01)


def test_a_good_calibration_moves_nothing() -> None:
    known, _, _ = drive(0.0)
    before = known.poses[3].copy()

    found = adjust_stereo(known, F_BASELINE)

    assert found is not None
    assert not found.is_clear
    np.testing.assert_array_equal(known.poses[3], before)


@pytest.mark.parametrize("offset_px", [OFFSET_PX, -OFFSET_PX])
def test_what_an_offset_costs_is_what_the_path_moves_by(offset_px: float) -> None:
    known, _, _ = drive(offset_px)
    tracked = known.poses[:, :3, 3]

    found = adjust_stereo(known, F_BASELINE)

    assert found is not None
    assert found.is_clear
    assert found.growth_per_px < 0.0  # with more pixels points are nearer, and paths shorter
    reach_m = float(np.sqrt(np.square(tracked - tracked.mean(axis=0)).sum(axis=1).mean()))
    assert found.bend_m_per_px == pytest.approx(abs(found.growth_per_px) * reach_m, rel=0.3)
    assert 0.0 < found.noise_m < 0.05


def test_few_keyframes_stay_where_they_are() -> None:
    known, _, _ = drive(OFFSET_PX, keyframes=4)
    before = known.poses[3].copy()

    assert adjust_stereo(known, F_BASELINE) is None
    np.testing.assert_array_equal(known.poses[3], before)


def test_an_offset_moves_points_along_their_rays() -> None:
    points = np.array([[1.0, 2.0, 10.0], [0.0, 1.0, 100.0], [np.nan] * 3])

    nearer, farther = with_offset(points, F_BASELINE, 0.5), with_offset(points, F_BASELINE, -0.6)

    np.testing.assert_allclose(nearer[0], points[0] * (6.0 / 6.5))
    np.testing.assert_allclose(farther[0], points[0] * (6.0 / 5.4))
    assert np.isnan(farther[1:]).all()
    assert np.isnan(nearer[2]).all()
