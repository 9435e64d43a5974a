"""The rolling shutter is undone, and the camera's readout time is estimated from its images."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.frontend import Features, Frame, FrontEndOptions
from client_sdk.tracking import tracker as tracker_module
from client_sdk.tracking.rolling_shutter import (
    ReadoutEstimate,
    rotation_rate,
    shutter_displacements,
    undo_rolling_shutter,
)
from client_sdk.tracking.tracker import Tracker
from rse_pf.geometry import Array, exp_se3, inverse, pose_difference, transform
from rse_pf.pnp.problems import KINECT
from rse_pf.slam.descriptors import measure_distinctiveness
from rse_pf.slam.tracking import Observations, fit_readout_change
from tests.kit.tracked_drives import run

READOUT_S, INTERVAL_S = 0.03, 1.0 / 30.0
RATE = np.array([0.9, -1.1, 0.4])
IMAGE, DEPTH = np.zeros((480, 640, 3), np.uint8), np.ones((480, 640), np.float32)


def pose_at(times_s: Array) -> Array:
    """Return the ``(n, 4, 4)`` poses ``T_world_camera`` of a camera that nods and looks around."""
    twists = np.zeros((2, len(times_s), 6))
    twists[0, :, 4] = np.radians(20.0 * np.sin(3.0 * times_s))
    twists[1, :, 3] = np.radians(14.0 * np.sin(5.0 * times_s))
    return exp_se3(twists[0]) @ exp_se3(twists[1])


class Room:
    """Points all around a camera, whose features are what a camera with a rolling shutter would find."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.rng = rng
        rays = rng.uniform([-1.6, -1.2, 1.0], [1.6, 1.2, 1.0], (1500, 3))
        self.points = rays * rng.uniform(1.5, 4.0, (1500, 1))
        self.descriptors = rng.integers(0, 256, (1500, 32), dtype=np.uint8)

    def features(self, time_s: float, readout_s: float) -> Features:
        seen_s = np.full(len(self.points), time_s)
        for _ in range(4):  # the row at which a point is read says when, and that says the row
            local = np.einsum("nji,nj->ni", pose_at(seen_s)[:, :3, :3], self.points)
            pixels = KINECT.project(local)
            seen_s = time_s + readout_s * np.clip((pixels[:, 1] - 239.5) / 480.0, -0.5, 0.5)
        inside = (local[:, 2] > 0.5) & (pixels > 8).all(axis=1) & (pixels < (632, 472)).all(axis=1)
        rows = np.flatnonzero(inside)
        pixels = pixels[rows] + 0.3 * self.rng.normal(size=(len(rows), 2))
        depth_m = local[rows, 2] + 0.004 * self.rng.normal(size=len(rows))
        return Features(
            pixels=pixels,
            descriptors=self.descriptors[rows],
            sizes=np.ones(len(rows)),
            points_camera=KINECT.back_project(pixels, depth_m),
            orientations=np.tile([1.0, 0.0], (len(rows), 1)),
            distinctiveness=measure_distinctiveness(self.descriptors[rows], pixels),
        )


def drive(monkeypatch: pytest.MonkeyPatch, readout_s: float, frames: int) -> tuple[Tracker, list[Array]]:
    """Track a camera; return the tracker, and the poses."""
    room, tracker, poses = Room(3), Tracker(), []
    for number in range(frames):
        poses.append(track(monkeypatch, tracker, number, room.features(number * INTERVAL_S, readout_s)))
    return tracker, poses


def track(monkeypatch: pytest.MonkeyPatch, tracker: Tracker, number: int, features: Features) -> Array:
    """Track the image that shows the features; return its pose."""

    def extract(frame: Frame, options: FrontEndOptions, plugin: object = None) -> Features:
        return features

    monkeypatch.setattr(tracker_module, "extract", extract)
    shown = Frame(timestamp_s=number * INTERVAL_S, rgb=IMAGE, depth_m=DEPTH, camera=KINECT)
    pose = run(tracker, shown).T_world_camera
    assert pose is not None
    return pose


def test_features_of_a_turning_camera_are_where_a_global_shutter_shows_them() -> None:
    rng = np.random.default_rng(1)
    points = KINECT.back_project(rng.uniform([20, 20], [620, 460], (200, 2)), rng.uniform(1.0, 4.0, 200))
    shares = np.linspace(-0.5, 0.5, 200)
    rotations = exp_se3(np.concatenate([np.zeros((200, 3)), shares[:, None] * READOUT_S * RATE], axis=1))
    read = np.einsum("nij,nj->ni", inverse(rotations)[:, :3, :3], points)
    pixels = KINECT.project(read)
    # The row of a pixel says when it was read, so the points are placed by it.
    shares = (pixels[:, 1] - 239.5) / 480.0
    rotations = exp_se3(np.concatenate([np.zeros((200, 3)), shares[:, None] * READOUT_S * RATE], axis=1))
    true = np.einsum("nij,nj->ni", rotations[:, :3, :3], read)
    raw = Features(
        pixels=pixels, descriptors=np.zeros((200, 32), np.uint8), points_camera=read,
        orientations=np.ones((200, 2)), sizes=np.ones(200), distinctiveness=np.full(200, 256, np.int32),
    )  # fmt: skip

    corrected = undo_rolling_shutter(raw, KINECT, READOUT_S * RATE)

    np.testing.assert_allclose(corrected.points_camera, true, atol=1e-5)
    np.testing.assert_allclose(corrected.pixels, KINECT.project(true), atol=1e-2)
    assert np.abs(corrected.pixels - pixels).max() > 5.0
    assert undo_rolling_shutter(raw, KINECT, np.zeros(3)) is raw
    longer = (
        undo_rolling_shutter(raw, KINECT, (READOUT_S + 1e-3) * RATE).points_camera - corrected.points_camera
    )
    np.testing.assert_allclose(
        longer, 1e-3 * shutter_displacements(raw, corrected.points_camera, KINECT, RATE), atol=1e-6
    )  # fmt: skip


def test_the_rotation_rate_is_that_at_the_second_pose() -> None:
    def turned(angle: float) -> Array:
        return exp_se3([1.0, 2.0, 3.0, 0.0, angle, 0.0])

    steady = rotation_rate(turned(0.3), turned(0.5), 0.1, np.zeros(3))
    faster = rotation_rate(turned(0.3), turned(0.5), 0.1, np.array([0.0, 1.0, 0.0]))

    np.testing.assert_allclose(steady, [0.0, 2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(faster, [0.0, 2.5, 0.0], atol=1e-12)


@pytest.mark.parametrize("planted_s", [0.0, 0.012, -0.02])
def test_a_wrong_readout_time_is_measured_together_with_the_pose(planted_s: float) -> None:
    rng = np.random.default_rng(5)
    points = KINECT.back_project(rng.uniform([20, 20], [620, 460], (150, 2)), rng.uniform(1.0, 4.0, 150))
    motions = ((KINECT.project(points)[:, 1] - 239.5) / 480.0)[:, None] * np.cross(RATE, points)
    shown = transform(exp_se3([0.004, -0.002, 0.003, 0.002, 0.001, -0.003]), points + planted_s * motions)
    observed = Observations(
        points=points, covariances=np.tile(1e-6 * np.eye(3), (150, 1, 1)),
        pixels=KINECT.project(shown) + 0.3 * rng.normal(size=(150, 2)), pixel_sigmas_px=np.ones(150),
        depths_m=shown[:, 2], depth_sigmas_m=np.full(150, 0.01),
    )  # fmt: skip

    measured_s, information = fit_readout_change(observed, motions, KINECT, np.eye(4))

    assert abs(measured_s - planted_s) < 0.002
    assert 1e5 < information < 1e8
    assert fit_readout_change(observed, np.tile([0.1, 0.0, 0.2], (150, 1)), KINECT, np.eye(4)) == (
        0.0,
        0.0,
    )  # a motion


def test_the_readout_estimate_is_limited_and_ignores_a_stationary_camera() -> None:
    estimate = ReadoutEstimate()

    assert estimate.update(0.03, 1e6, np.full(3, 1e-3)) == 0.0
    assert estimate.update(0.03, 0.0, RATE) == 0.0
    for _ in range(50):
        estimate.update(0.03 - estimate.readout_s, 1e6, RATE)
    assert abs(estimate.readout_s - 0.03) < 0.001
    for _ in range(500):
        estimate.update(-0.1, 1e6, RATE)
    assert estimate.readout_s == 0.0
    for _ in range(500):
        estimate.update(0.1, 1e6, RATE)
    assert estimate.readout_s == 0.05


@pytest.mark.parametrize(("readout_s", "most_m", "most_deg"), [(0.0, 0.005, 0.2), (READOUT_S, 0.02, 0.7)])
def test_a_camera_that_looks_around_is_tracked_whatever_its_shutter(
    monkeypatch: pytest.MonkeyPatch, readout_s: float, most_m: float, most_deg: float
) -> None:
    tracker, poses = drive(monkeypatch, readout_s, 90)

    true = pose_at(np.arange(len(poses)) * INTERVAL_S)
    errors = [pose_difference(*pair) for pair in zip(poses, inverse(true[0]) @ true, strict=True)]
    assert abs(tracker.readout.readout_s - readout_s) < 0.003
    assert max(metres for metres, _ in errors) < most_m
    assert max(degrees for _, degrees in errors) < most_deg
    assert tracker.last_features is not None
    assert (tracker.last_features.pixels == tracker._raw.features.pixels).all() == (
        tracker.readout.readout_s == 0.0
    )


def test_a_cut_in_a_video_is_no_rotation(monkeypatch: pytest.MonkeyPatch) -> None:
    tracker, _ = drive(monkeypatch, READOUT_S, 90)
    elsewhere_s = np.pi / 6.0

    pose = track(monkeypatch, tracker, 90, Room(3).features(elsewhere_s, 0.0))

    first, now = pose_at(np.array([0.0, elsewhere_s]))
    _, apart_deg = pose_difference(pose, inverse(first) @ now)
    assert pose_difference(inverse(first) @ now, np.eye(4))[1] > 15.0
    assert apart_deg < 1.0
    assert not tracker._state.rotation_rate.any()
