"""Depths of stereo pairs, and what a tracker makes of them, in a rendered world whose truth is exact."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Frame, FrontEndOptions, PoseQuery, extract, load_opencv, points_at
from client_sdk.mapper import Mapper
from client_sdk.simulator import SIMULATED_CAMERA, make_world, render_pairs, true_trajectory
from client_sdk.stereo.depth import noise_of, stereo_points
from client_sdk.stereo.view import StereoView
from client_sdk.tracking.tracker import Tracker
from client_sdk.trajectory_error import accuracy
from rse_pf.geometry import Camera, inverse, transform
from rse_pf.maps.format import decode_map
from rse_pf.pnp import DepthNoise
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import tracked

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

SEED, FRAMES, BASELINE_M = 5, 24, 0.11
TRUTH = true_trajectory(0, 3, FRAMES, SEED)


@pytest.fixture(scope="module")
def pairs() -> Sequence[Frame]:
    """The frames of a stereo camera in a rendered room."""
    return list(render_pairs(TRUTH, make_world(SEED), (SEED,), BASELINE_M))


def drive(frames: Sequence[Frame], **options: object) -> Mapper:
    """Return a mapper that has tracked the frames."""
    mapper = Mapper(ask=solve, **options)  # type: ignore[arg-type]
    tracked(mapper, frames)
    return mapper


def test_a_stereo_drive_is_tracked_in_metres(pairs: Sequence[Frame]) -> None:
    mapper = drive(pairs, keyframes_of="drone")

    found = accuracy(mapper.trajectory, TRUTH)

    assert mapper.lost_frames == 0
    assert mapper.scale == "metric, by stereo"
    assert found.ate_m <= 0.005 * TRUTH.length_m
    assert accuracy(mapper.trajectory, TRUTH, with_scale=True).scale == pytest.approx(1.0, abs=0.01)
    assert mapper.depth_noise.growth_per_m == pytest.approx(0.2 / (525.0 * BASELINE_M), rel=0.6)
    assert len(mapper.map) > 500
    assert mapper.report()["scale"] == "metric, by stereo"
    assert mapper.encoded_map()


@pytest.mark.parametrize(("disparity_px", "is_far"), [(2.0, False), (1.5, False), (0.5, True)])
def test_what_is_farther_than_a_disparity_of_a_pixel_has_no_depth(disparity_px: float, is_far: bool) -> None:
    blocks = np.random.default_rng(1).integers(0, 256, (48, 64))
    left = np.kron(blocks, np.ones((10, 10))).astype(np.uint8)
    whole, part = divmod(disparity_px, 1.0)
    near, farther = (np.roll(left, -int(whole) - step, axis=1) for step in (0, 1))
    right = np.rint((1.0 - part) * near + part * farther).astype(np.uint8)
    pixels = np.stack(np.meshgrid(np.arange(100, 540, 10), np.arange(100, 380, 10)), axis=-1).reshape(-1, 2)

    points = stereo_points(
        np.repeat(left[..., None], 3, axis=2), StereoView(right, BASELINE_M), SIMULATED_CAMERA,
        pixels.astype(np.float64),
    )  # fmt: skip

    z = points[np.isfinite(points[:, 2]), 2]
    if is_far:
        assert len(z) == 0
    else:
        expected_m = SIMULATED_CAMERA.fx * BASELINE_M / disparity_px
        assert len(z) > 0.5 * len(pixels)
        assert np.median(z) == pytest.approx(expected_m, rel=0.02)


def test_the_cloud_of_a_stereo_drive_lies_on_the_walls(pairs: Sequence[Frame]) -> None:
    mapper = drive(pairs[:1])

    points, colours = mapper.map.points()
    z = points[:, 2]

    assert len(points) == len(colours) > 200
    assert float(z.max()) < 12.0
    assert mapper.trajectory.T_world_camera[0] == pytest.approx(np.eye(4))


def test_a_pair_of_another_baseline_has_another_scale(pairs: Sequence[Frame]) -> None:
    """The f b of another camera is not noticed by the pictures, but by who knows the path."""
    wrong = [
        replace(frame, stereo=StereoView(frame.stereo.gray, 2.0 * BASELINE_M))
        for frame in pairs
        if frame.stereo is not None
    ]

    scale = accuracy(drive(wrong[:12]).trajectory, TRUTH, with_scale=True).scale

    assert scale == pytest.approx(0.5, abs=0.02)


def test_depths_beyond_a_kinects_are_kept_with_their_noise() -> None:
    camera = Camera(fx=700.0, fy=700.0, cx=159.5, cy=59.5, width=320, height=120)
    rng = np.random.default_rng(3)
    left = np.kron(rng.integers(0, 256, (30, 90)), np.ones((4, 4))).astype(np.uint8)[:, :330]
    frame = Frame(
        timestamp_s=0.0, rgb=np.repeat(left[:, :320, None], 3, axis=2),
        depth_m=np.zeros((120, 320), dtype=np.float32), camera=camera,
        stereo=StereoView(np.ascontiguousarray(left[:, 4:324]), 0.5),
    )  # fmt: skip

    z = extract(frame, FrontEndOptions()).points_camera[:, 2]

    assert np.isfinite(z).mean() > 0.5
    assert float(np.nanmedian(z)) == pytest.approx(87.5, rel=0.01)
    assert np.sqrt(frame.depth_noise.variance_m2(np.array([87.5]))) == pytest.approx(2.2, rel=0.05)
    assert frame.depth_noise != DepthNoise()


def test_the_noise_of_the_query_is_that_of_the_pair(pairs: Sequence[Frame]) -> None:
    tracker = Tracker()
    tracker.prepare(pairs[0])
    query = tracker.prepare(pairs[1])

    assert isinstance(query, PoseQuery)
    assert query.depth_noise == tracker.noise.noise
    assert pairs[0].stereo is not None
    assert tracker.noise.model == noise_of(pairs[0].stereo, SIMULATED_CAMERA)
    assert len(query.correspondences) <= 250
    assert query.correspondences.depths_m.any()


def test_the_depths_of_a_pair_are_those_of_the_world(pairs: Sequence[Frame]) -> None:
    """Points of one frame, seen in the next one by the true motion, have its depths."""
    first, second = pairs[4], pairs[5]
    features = extract(first, FrontEndOptions())
    T_second_first = inverse(TRUTH.T_world_camera[5]) @ TRUTH.T_world_camera[4]
    expected = transform(T_second_first, features.points_camera)
    pixels = SIMULATED_CAMERA.project(np.nan_to_num(expected, nan=1.0))

    measured = points_at(second, pixels, FrontEndOptions())
    relative = measured[:, 2] / expected[:, 2] - 1.0

    assert np.isfinite(relative).sum() > 200
    assert abs(float(np.nanmedian(relative))) < 0.005


async def test_a_robot_without_answers_loses_its_place_and_no_more(pairs: Sequence[Frame]) -> None:
    async def silent(query: PoseQuery) -> PoseAnswer:
        from rse_pf.errors import Disconnected

        raise Disconnected("gone", hint="none")

    mapper = Mapper(ask=silent)

    assert [(await mapper.track(frame)).lost for frame in pairs[:3]] == [False, True, True]


LACKING_PX = 0.3


@pytest.fixture(scope="module")
def lacking(pairs: Sequence[Frame]) -> list[Frame]:
    """The same frames, with disparities that are 0.3 px too small."""
    cv2, made = load_opencv(), []
    moved = np.array([[1.0, 0.0, LACKING_PX], [0.0, 1.0, 0.0]])
    for frame in pairs:
        assert frame.stereo is not None
        size = (frame.camera.width, frame.camera.height)
        gray = cv2.warpAffine(frame.stereo.gray, moved, size, flags=cv2.INTER_CUBIC)
        made.append(replace(frame, stereo=StereoView(gray, BASELINE_M)))
    return made


def test_a_saved_drive_is_corrected_by_what_its_disparities_lack(
    lacking: Sequence[Frame], tmp_path: Path
) -> None:
    mapper = drive(lacking, keyframes_of="drone")
    before, cloud = accuracy(mapper.trajectory, TRUTH), mapper.map.points()[0]

    report = mapper.save(tmp_path)

    after = accuracy(mapper.trajectory, TRUTH)
    assert before.ate_m > 0.01
    assert after.ate_m < 0.4 * before.ate_m
    assert report["disparity_offset_px"] == pytest.approx(LACKING_PX, abs=0.15)
    made = decode_map(mapper.encoded_map())
    for keyframe in made.keyframes:
        row = int(np.argmin(np.abs(mapper.trajectory.timestamps_s - keyframe.timestamp_s)))
        np.testing.assert_allclose(keyframe.T_world_camera, mapper.trajectory.T_world_camera[row], atol=1e-5)
    moved = mapper.map.points()[0]
    assert len(moved) == pytest.approx(len(cloud), rel=0.05)
    far = [float(np.median(np.linalg.norm(points, axis=1))) for points in (moved, cloud)]
    assert far[0] < 0.99 * far[1]
    asyncio.run(mapper.track(replace(lacking[-1], timestamp_s=lacking[-1].timestamp_s + 0.1)))
    assert mapper.lost_frames == 0
    np.testing.assert_allclose(
        mapper.trajectory.positions[-1], mapper.trajectory.positions[-2], atol=0.01
    )  # fmt: skip


@pytest.mark.parametrize("holds_world", [False, True])
def test_a_good_calibration_and_a_live_map_keep_their_poses(
    holds_world: bool, pairs: Sequence[Frame], lacking: Sequence[Frame], tmp_path: Path
) -> None:
    mapper = drive(lacking if holds_world else pairs, holds_world=holds_world)
    before = mapper.trajectory.T_world_camera.copy()

    report = mapper.save(tmp_path)

    assert "disparity_offset_px" not in report
    np.testing.assert_array_equal(mapper.trajectory.T_world_camera, before)
