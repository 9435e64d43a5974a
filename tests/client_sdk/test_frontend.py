"""Features, matches and the tracker's decisions, on pictures whose motion is known exactly."""

from __future__ import annotations

import json
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from client_sdk.datasets import open_dataset
from client_sdk.frontend import (
    Features,
    Frame,
    FrontEndOptions,
    PoseQuery,
    TrackedFrame,
    Tracker,
    extract,
    match,
    round_for_wire,
)
from client_sdk.mapping import Trajectory
from rse_pf.errors import PnpError, UsageError
from rse_pf.experiments.results.trajectory_error import absolute_error, relative_error
from rse_pf.geometry import Array, Camera, inverse, pose_difference, transform
from rse_pf.pnp import PnpOptions, refine_with_depth, solve_pnp
from rse_pf.services.pnp import make_request
from rse_pf.wire import Command, make_codec

cv2 = pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

RECORDED = Path(__file__).parents[3] / "shared" / "data"
CAMERA = Camera(fx=500.0, fy=500.0, cx=159.5, cy=119.5, width=320, height=240)
OPTIONS = FrontEndOptions()
_rng = np.random.default_rng(5)
WALL = np.kron(_rng.integers(0, 256, (60, 120)), np.ones((8, 8))).astype(np.uint8)
PX_M = 2.0 / 500.0
"""Width of a pixel on the wall 2 m away; on the shelf 1 m away it is half of that."""


def wall_frame(shift_px: int, timestamp_s: float = 0.0) -> Frame:
    """Return the view of a wall (upper half) and a nearer shelf after moving *shift_px* to the right."""
    wall = WALL[100:220, 100 + shift_px : 420 + shift_px]
    shelf = WALL[300:420, 100 + 2 * shift_px : 420 + 2 * shift_px]
    rgb = np.repeat(np.vstack((wall, shelf))[..., None], 3, axis=2)
    depth_m = np.repeat(np.float32([2.0, 1.0]), 120)[:, None] * np.ones(320, np.float32)
    return Frame(timestamp_s=timestamp_s, rgb=rgb, depth_m=depth_m, camera=CAMERA)


def blank_frame() -> Frame:
    rgb = np.full((240, 320, 3), 128, np.uint8)
    return Frame(timestamp_s=0.0, rgb=rgb, depth_m=np.full((240, 320), 2.0, np.float32), camera=CAMERA)


def answer(query: PoseQuery) -> tuple[Array | None, int]:
    options = PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations)
    found = query.correspondences
    try:
        solution = solve_pnp(found.points_world, found.pixels, query.camera, options)
    except PnpError:
        return None, 0
    solution = refine_with_depth(solution, found.points_world, found.pixels, found.depths_m, query.camera)
    return solution.T_camera_world, len(solution.inliers)


def pushed(metres: float) -> Array:
    """Return ``T_camera_reference`` of a camera that moved along x."""
    pose = np.eye(4)
    pose[0, 3] = -metres
    return pose


def run(
    tracker: Tracker, frame: Frame, solve: Callable[[PoseQuery], tuple[Array | None, int]]
) -> TrackedFrame:
    step = tracker.prepare(frame)
    while isinstance(step, PoseQuery):
        step = tracker.accept(step, *solve(step))
    return step


def test_matches_of_a_known_motion_agree_with_it():
    before, after = extract(wall_frame(0), OPTIONS), extract(wall_frame(16), OPTIONS)

    found = match(before, after, OPTIONS)

    expected = CAMERA.project(transform(pushed(16 * PX_M), found.points_world))
    errors = np.linalg.norm(expected - found.pixels, axis=1)
    assert len(found) > 150
    assert np.mean(errors < 3.0) > 0.85
    assert np.median(errors) < 1.0


def test_matches_carry_the_depth_of_the_frame_in_millimetres():
    frame = wall_frame(16)
    frame.depth_m[:, :] += np.float32(0.12345)
    frame.depth_m[:, 200:] = 0.0

    found = match(extract(wall_frame(0), OPTIONS), extract(frame, OPTIONS), OPTIONS)

    x, y = found.pixels.T
    clear = (np.abs(y - 119.5) > 2.0) & (np.abs(x - 199.5) > 2.0)  # away from the edges of depth
    expected = np.where(x > 199.5, 0.0, np.where(y < 119.5, 2.123, 1.123))
    np.testing.assert_array_equal(found.depths_m[clear], expected[clear])
    assert 0 < np.count_nonzero(found.depths_m[clear]) < np.count_nonzero(clear)


def test_frames_without_matches_have_no_depths():
    found = match(extract(blank_frame(), OPTIONS), extract(blank_frame(), OPTIONS), OPTIONS)

    assert found.depths_m.shape == (0,)


def test_points_are_where_the_depth_says():
    features = extract(wall_frame(0), OPTIONS)

    known = np.isfinite(features.points_camera[:, 2])
    np.testing.assert_array_equal(
        features.points_camera[known, 2], np.where(features.pixels[known, 1] < 119.5, 2.0, 1.0)
    )
    np.testing.assert_allclose(CAMERA.project(features.points_camera[known]), features.pixels[known])


@pytest.mark.parametrize(
    ("patch", "expected"),
    [
        ([[2, 2, 2], [2, 2, 2], [2, 2, 2]], 2.0),
        ([[0, 0, 0], [0, 2, 2], [2, 2, 2.05]], 2.0),  # five readings
        ([[0, 0, 0], [0, 0, 2], [2, 2, 2]], np.nan),  # four
        ([[2, 2, 2], [2, 2, 2], [2, 2, 2.2]], np.nan),  # spread over 5 %
        ([[0, 0, 0], [0, 0, 0], [0, 0, 0]], np.nan),
        ([[7, 7, 7], [7, 7, 7], [7, 7, 7]], np.nan),  # beyond 6 m
        ([[0.2, 0.2, 0.2], [0.2, 0.2, 0.2], [0.2, 0.2, 0.2]], np.nan),  # nearer than 0.3 m
    ],
)
def test_a_depth_is_used_only_on_a_surface(patch: list[list[float]], expected: float):
    frame = wall_frame(0)
    frame.depth_m[:] = np.tile(np.array(patch, np.float32), (80, 107))[:, :320]

    points = extract(frame, OPTIONS).points_camera

    found = points[:, 2]  # a 3x3 window of a tiling holds the same nine numbers everywhere
    np.testing.assert_allclose(found, np.full(len(found), expected), rtol=0.03)


def test_no_pixel_is_matched_twice_and_the_best_are_kept():
    features = extract(wall_frame(0), OPTIONS)
    doubled = Features(
        pixels=np.vstack((features.pixels, features.pixels)),
        descriptors=np.vstack((features.descriptors, features.descriptors)),
        points_camera=np.vstack((features.points_camera, features.points_camera)),
    )

    every = match(doubled, features, OPTIONS)
    some = match(doubled, features, FrontEndOptions(max_matches=50))

    there = Counter(map(tuple, np.round(features.pixels, 2)))  # some features share a pixel
    assert all(count <= there[pixel] for pixel, count in Counter(map(tuple, every.pixels)).items())
    assert len(every) > 100
    assert len(some) == 50


def test_numbers_are_rounded_for_the_wire():
    points, pixels = round_for_wire(np.array([[1.23456, -0.00004, 2.0]]), np.array([[10.126, 5.0]]))
    assert points.tolist() == [[1.2346, -0.0, 2.0]]
    assert pixels.tolist() == [[10.13, 5.0]]
    found = match(extract(wall_frame(0), OPTIONS), extract(wall_frame(7), OPTIONS), OPTIONS)
    again = round_for_wire(found.points_world, found.pixels)
    np.testing.assert_array_equal(found.points_world, again[0])
    np.testing.assert_array_equal(found.pixels, again[1])


def test_the_same_frame_gives_the_same_matches():
    first, second = (
        match(extract(wall_frame(0), OPTIONS), extract(wall_frame(9), OPTIONS), OPTIONS) for _ in "ab"
    )
    np.testing.assert_array_equal(first.points_world, second.points_world)
    np.testing.assert_array_equal(first.pixels, second.pixels)


def test_a_chain_of_frames_follows_the_motion_and_keeps_keyframes():
    tracker = Tracker()

    tracked = [run(tracker, wall_frame(shift), answer) for shift in range(0, 63, 9)]

    for number, each in enumerate(tracked):
        assert each.T_world_camera is not None
        moved, _ = pose_difference(each.T_world_camera, inverse(pushed(number * 9 * PX_M)))
        assert moved < 0.01
    assert [each.keyframe for each in tracked] == [
        True,
        False,
        False,
        False,
        False,
        False,
        True,
    ]  # at 0.216 m
    assert (tracker.frames, tracker.lost_frames, tracker.keyframes) == (7, 0, 2)


def test_a_start_pose_is_where_the_trajectory_begins():
    start = inverse(pushed(3.0))
    tracker = Tracker(T_world_start=start)

    assert run(tracker, wall_frame(0), answer).T_world_camera is start
    second = run(tracker, wall_frame(5), lambda query: (pushed(0.02), 400))

    np.testing.assert_allclose(second.T_world_camera, start @ inverse(pushed(0.02)))


@pytest.mark.parametrize(
    "bad", [(pushed(0.02), 11), (pushed(0.6), 400), (None, 0), (np.full((4, 4), np.nan), 400)]
)
def test_a_bad_pose_is_asked_for_again_against_the_keyframe(bad: tuple[Array | None, int]):
    tracker = Tracker()
    run(tracker, wall_frame(0), answer)
    run(tracker, wall_frame(10), answer)

    first = tracker.prepare(wall_frame(20))
    assert isinstance(first, PoseQuery)
    second = tracker.accept(first, *bad)
    assert isinstance(second, PoseQuery)
    assert (first.against, second.against) == ("frame", "keyframe")
    tracked = tracker.accept(second, pushed(0.08), 200)

    assert isinstance(tracked, TrackedFrame)
    np.testing.assert_allclose(tracked.T_world_camera, inverse(pushed(0.08)))


def test_a_frame_that_fails_twice_is_lost_and_the_next_one_finds_the_last_good_one():
    tracker = Tracker()
    run(tracker, wall_frame(0), answer)
    run(tracker, wall_frame(10), answer)

    lost = run(tracker, wall_frame(20), lambda query: (None, 0))
    found = run(tracker, wall_frame(30), answer)

    assert lost.lost
    assert lost.T_world_camera is None
    assert tracker.lost_frames == 1
    assert found.T_world_camera is not None
    assert pose_difference(found.T_world_camera, inverse(pushed(30 * PX_M)))[0] < 0.01


def test_a_frame_without_features_is_lost_without_a_query():
    tracker = Tracker()
    assert run(tracker, blank_frame(), answer).lost  # nothing to start from
    assert not run(tracker, wall_frame(0), answer).lost
    assert isinstance(tracker.prepare(blank_frame()), TrackedFrame)
    assert tracker.lost_frames == 2


def test_the_keyframe_chain_asks_the_keyframe_first():
    tracker = Tracker(FrontEndOptions(chain="keyframe"))
    run(tracker, wall_frame(0), answer)
    run(tracker, wall_frame(10), answer)

    step = tracker.prepare(wall_frame(20))

    assert isinstance(step, PoseQuery)
    assert step.against == "keyframe"


def test_one_query_at_a_time():
    tracker = Tracker()
    run(tracker, wall_frame(0), answer)
    query = tracker.prepare(wall_frame(10))
    assert isinstance(query, PoseQuery)
    with pytest.raises(UsageError, match="open"):
        tracker.prepare(wall_frame(20))
    tracker.accept(query, *answer(query))
    with pytest.raises(UsageError, match="not the open one"):
        tracker.accept(query, None)


def test_options_that_cannot_work_and_frames_that_do_not_fit_are_refused():
    for bad in ({"min_inliers": 3}, {"ratio": 0.0}, {"max_matches": 5}, {"max_depth_m": 0.1}):
        with pytest.raises(UsageError):
            FrontEndOptions(**bad)
    with pytest.raises(UsageError, match="do not fit"):
        Frame(
            timestamp_s=0.0,
            rgb=np.zeros((4, 4, 3), np.uint8),
            depth_m=np.zeros((4, 4), np.float32),
            camera=CAMERA,
        )


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
@pytest.mark.parametrize(
    "preset", [FrontEndOptions(), FrontEndOptions.wide_baseline()], ids=["default", "wide"]
)
def test_a_command_with_all_matches_is_below_10_kb(codec: str, preset: FrontEndOptions):
    options = preset.sent_with(codec)
    n = options.max_matches
    rng = np.random.default_rng(5)
    # Random digits, of which only the columns ascend; a sign or three digits wherever there can be.
    camera = Camera(fx=525.25, fy=525.25, cx=719.75, cy=539.75, width=1440, height=1080)
    pixels = np.column_stack([np.sort(rng.uniform(100.0, 700.0, n)), rng.uniform(100.0, 530.0, n)])
    depth_m = rng.uniform(3.0, options.max_depth_m, n)
    request = make_request(
        camera.back_project(pixels, depth_m), pixels, camera,
        PnpOptions(inlier_px=options.inlier_px, max_iterations=options.max_iterations),
        depths_m=depth_m + rng.normal(size=n) * 0.01, binary=codec == "bin",
    )  # fmt: skip
    command = Command(id=10**6, service="pnp", payload=request, stream="pose", keep=True, trace="f" * 32)

    assert len(make_codec(codec).encode(command)) < 10_000


def test_an_unknown_codec_is_refused():
    with pytest.raises(UsageError, match="no codec named 'xml'"):
        FrontEndOptions().sent_with("xml")


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate_hz", "ate_cm", "rpe_cm", "rpe_deg"), [(5, 3.4, 1.6, 0.55), (10, 3.4, 1.1, 0.4)]
)
def test_the_red_kitchen_is_tracked_as_well_as_when_it_was_measured(rate_hz, ate_cm, rpe_cm, rpe_deg):
    if not (RECORDED / "7scenes_redkitchen").exists():
        pytest.skip(f"no recordings at {RECORDED}")
    dataset = open_dataset(RECORDED / "7scenes_redkitchen")
    tracker, sizes, sizes_with_depths = Tracker(), [], []

    def solve(query: PoseQuery) -> tuple[Array | None, int]:
        found = query.correspondences
        lists = {"points": found.points_world.ravel().tolist(), "pixels": found.pixels.ravel().tolist()}
        sizes.append(_deflated_bytes(lists))
        sizes_with_depths.append(_deflated_bytes(lists | {"depths": found.depths_m.tolist()}))
        return answer(query)

    tracked = [run(tracker, frame, solve) for frame in dataset.thinned(rate_hz)]

    assert tracker.lost_frames == 0
    assert dataset.truth is not None
    stamps = np.array([each.frame.timestamp_s for each in tracked])
    estimate = Trajectory(stamps, np.array([each.T_world_camera for each in tracked]))
    relative = relative_error(estimate, dataset.truth)
    assert 100 * absolute_error(estimate, dataset.truth).rmse_m <= ate_cm
    assert 100 * relative.rmse_m <= rpe_cm
    assert relative.rmse_deg <= rpe_deg
    assert np.median(sizes) < 5_000
    assert max(sizes_with_depths) < 10_000
    assert np.median(sizes_with_depths) < 1.2 * np.median(sizes)


def _deflated_bytes(lists: dict[str, list[float]]) -> int:
    return len(zlib.compress(json.dumps(lists, separators=(",", ":")).encode()))


@pytest.mark.data
def test_the_five_wide_views_of_the_nyu_dining_room_are_joined():
    if not (RECORDED / "nyu_dining_room").exists():
        pytest.skip(f"no recordings at {RECORDED}")
    dataset = open_dataset(RECORDED / "nyu_dining_room")
    tracker = Tracker(FrontEndOptions.wide_baseline())

    poses = [run(tracker, frame, answer).T_world_camera for frame in dataset]

    assert dataset.truth is not None
    reference = dataset.truth.T_world_camera
    for row, (limit_m, limit_deg) in enumerate([(0.10, 1.5)] * 3 + [(0.025, 0.5)]):
        first, second = poses[row], poses[row + 1]
        assert first is not None
        assert second is not None
        expected = inverse(reference[row]) @ reference[row + 1]
        metres, degrees = pose_difference(inverse(first) @ second, expected)
        assert metres <= limit_m
        assert degrees <= limit_deg
