"""The tracker without depth: starts, segments, joins with their scale, and loops."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from client_sdk.datasets.rig_recordings import open_kitti
from client_sdk.frontend import Frame, MonocularOptions, PoseQuery, TrackedFrame
from client_sdk.tracking.landmark_map import LandmarkMap, MonocularView
from client_sdk.tracking.landmark_matching import NO_LANDMARK, make_place_vector
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import accuracy
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_se3, inverse, pose_difference, transform
from rse_pf.slam.descriptors import measure_distinctiveness
from rse_pf.slam.tracking import Features
from tests.kit.flat_world import CAMERA, covered, foreign, frame_at
from tests.kit.tracked_drives import run, run_all, solve

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

OPTIONS = MonocularOptions(segment_after=3)


def frame(row: int, stamp_s: float) -> Frame:
    return replace(frame_at(row, depth=False), timestamp_s=stamp_s)


def assert_places(path: Trajectory, rows: dict[float, int], tolerance: float = 0.05) -> None:
    """Check that positions are those of the rows of the frames, in one unit of length."""
    x = path.positions[:, 0]
    wanted = np.array([rows[round(float(stamp_s), 6)] for stamp_s in path.timestamps_s], dtype=float)
    steps = np.polyfit(wanted, x, 1)
    assert np.abs(x - np.polyval(steps, wanted)).max() < tolerance * abs(steps[0]) * np.ptp(wanted)


def replace_focal(fx: float) -> Camera:
    return Camera(fx=fx, fy=fx, cx=CAMERA.cx, cy=CAMERA.cy, width=CAMERA.width, height=CAMERA.height)


def test_a_start_that_waited_for_a_view_which_is_gone_begins_at_the_next_one() -> None:
    tracker = MonocularTracker(OPTIONS)

    # The camera looks elsewhere for a moment, and then moves on; frames 0 and 1 are of no use.
    shown = [
        foreign(frame(0, 0.0)),
        foreign(frame(0, 0.1)),
        *(frame(row, 0.2 + row / 10) for row in range(8)),
    ]
    done = run_all(tracker, shown)

    assert done[-1].status == "tracked"
    assert len(tracker.trajectory()) == 8
    assert tracker.trajectory().timestamps_s[0] == pytest.approx(0.2)


def test_the_motion_before_the_start_is_that_of_the_first_frames_after_it() -> None:
    tracker = MonocularTracker(OPTIONS)

    done = run_all(tracker, (frame(row, row / 10) for row in range(10)))

    first = next(row for row, tracked in enumerate(done) if tracked.status == "tracked")
    assert [tracked.status for tracked in done[first:]] == ["tracked"] * (10 - first)
    assert_places(tracker.trajectory(), {row / 10: row for row in range(10)})


def test_a_second_place_gets_a_segment_of_its_own_and_is_never_joined() -> None:
    tracker = MonocularTracker(OPTIONS)
    run_all(tracker, (frame(row, row / 10) for row in range(10)))

    cut = run_all(tracker, (foreign(frame(row, 1.0 + row / 10)) for row in range(14)))

    assert {tracked.status for tracked in cut[:3]} == {"lost"}
    assert [tracked.segment for tracked in cut[6:]] == [1] * 8
    assert all("not joined" in tracked.reason for tracked in cut[6:])
    assert tracker.joins == []
    assert tracker.segments == (0, 1)
    assert tracker.lost_frames == 0  # those before the second start were placed by it
    assert len(tracker.trajectory(0)) == 10
    assert len(tracker.trajectory(1)) == 14


def test_a_camera_that_is_back_goes_on_in_the_first_segment() -> None:
    tracker = MonocularTracker(OPTIONS)
    run_all(tracker, (frame(row, row / 10) for row in range(10)))
    run_all(tracker, (foreign(frame(row, 1.0 + row / 10)) for row in range(14)))

    back = run(tracker, frame(6, 3.0))

    assert (back.segment, back.status, back.reason) == (0, "tracked", "")


def test_a_covered_lens_begins_no_segment_and_the_map_goes_on_after_it() -> None:
    tracker = MonocularTracker(OPTIONS)
    run_all(tracker, (frame(row, row / 10) for row in range(10)))

    while_covered = run_all(tracker, (covered(frame(0, 1.0 + row / 10)) for row in range(30)))
    uncovered = run(tracker, frame(3, 4.0))

    assert {tracked.status for tracked in while_covered} == {"lost"}
    assert (uncovered.status, uncovered.segment) == ("tracked", 0)
    assert tracker.lost_frames == 30
    assert_places(tracker.trajectory(), {**{row / 10: row for row in range(10)}, 4.0: 3})


def test_a_segment_that_reaches_a_known_place_is_joined_in_the_unit_of_the_older_one() -> None:
    tracker = MonocularTracker(OPTIONS, T_world_start=exp_se3([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    run_all(tracker, (frame(row, row / 10) for row in range(8)))
    tracker.rescale(3.0)  # so that the units differ
    rows = {row / 10: row for row in range(8)}

    # Not observed for 5 s: 52 frames on, where nothing of before is in view; then the way back to it.
    back = list(range(60, 3, -1))
    done, seen_there, unjoined_there = [], 0, 0
    for number, row in enumerate(back):
        rows[round(6.0 + number / 10, 6)] = row
        step = tracker.prepare(frame(row, 6.0 + number / 10))
        while isinstance(step, PoseQuery):
            answer = solve(step)
            if step.against == "segment" and answer[1] >= max(40, 0.5 * len(step.correspondences)):
                seen_there += 1
            step = tracker.accept(step, *answer)
        if not tracker.joins:
            unjoined_there = seen_there
        done.append(step)

    assert unjoined_there >= 1  # a single image could be wrong
    assert [(join.segment, join.into) for join in tracker.joins] == [(1, 0)]
    assert 2.0 < tracker.joins[0].scale < 4.5
    assert tracker.segments == (0,)
    assert (done[-1].segment, done[-1].reason) == (0, "")
    path = tracker.trajectory()
    assert len(path) == len(rows)
    assert_places(path, rows)
    assert np.median(np.abs(path.positions[:, 1:] - [0.0, 1.0])) < 0.05 * np.ptp(path.positions[:, 0])


def test_an_older_place_that_is_seen_again_moves_what_drifted_away_from_it() -> None:
    tracker = MonocularTracker(OPTIONS)
    there = run_all(tracker, (frame(row, row / 10) for row in range(45)))
    step_of = position(there[20])[0] / 20

    # The left of these pictures shows rows 22 and more: the estimate has drifted by 23 rows.
    def both(row: int) -> Frame:
        here, before = frame(row, row / 10), frame(row - 23, 0.0)
        return replace(here, rgb=np.concatenate([before.rgb[:, :150], here.rgb[:, 150:]], axis=1))

    run_all(tracker, (both(row) for row in range(45, 58)))

    assert tracker.loops == 1
    assert tracker.length_factor == pytest.approx(tracker.loop_scales[0])
    path = tracker.trajectory()
    assert path.positions[0] == pytest.approx(np.zeros(3), abs=2 * step_of)
    assert path.positions[-1, 0] < 47 * step_of  # and not 57


def test_one_query_at_a_time_and_one_camera() -> None:
    tracker = MonocularTracker(OPTIONS)
    run_all(tracker, (frame(row, row / 10) for row in range(8)))

    query = tracker.prepare(frame(8, 0.8))
    assert isinstance(query, PoseQuery)
    with pytest.raises(UsageError, match="query"):
        tracker.prepare(frame(9, 0.9))
    while isinstance(query, PoseQuery):
        query = tracker.accept(query, None)
    assert query.status == "lost"
    with pytest.raises(UsageError, match="another one"):
        tracker.prepare(replace(frame(9, 0.9), camera=replace_focal(600.0)))


def position(tracked: TrackedFrame) -> Array:
    assert tracked.T_world_camera is not None
    at: Array = tracked.T_world_camera[:3, 3]
    return at


@pytest.mark.slow
def test_a_car_that_drives_forward_is_posed_from_its_first_frame(recordings: Path) -> None:
    drive = open_kitti(recordings / "kitti_00_left_start")
    assert drive.truth is not None
    tracker = MonocularTracker()

    run_all(tracker, islice(drive, 40))

    path = tracker.trajectory()
    assert len(path) >= 38
    assert tracker.segments == (0,)
    error_m = accuracy(path, drive.truth, with_scale=True).ate_m
    assert error_m <= 0.015 * np.linalg.norm(drive.truth.positions[39])


def map_of(poses: Array, world: Array) -> LandmarkMap:
    """Return a map whose keyframes see all of *world*, with one descriptor for each point."""
    made = LandmarkMap(CAMERA)
    descriptors = np.random.default_rng(3).integers(0, 256, (len(world), 32), dtype=np.uint8)
    for pose in poses:
        pixels = CAMERA.project(transform(pose, world))
        image = Features(
            pixels=pixels, descriptors=descriptors, orientations=np.tile([1.0, 0.0], (len(world), 1)),
            sizes=np.ones(len(world)), points_camera=np.full((len(world), 3), np.nan),
            distinctiveness=measure_distinctiveness(descriptors, pixels),
        )  # fmt: skip
        colours = np.zeros((len(world), 3), dtype=np.uint8)
        place = make_place_vector(image.descriptors, np.empty((0, 0, 3), dtype=np.uint8), None)
        made.add_keyframe(
            MonocularView(features=image, colours=colours, place_vector=place),
            pose,
            np.full(len(world), NO_LANDMARK),
        )
    rows = np.arange(len(world))
    made.add_landmarks(world, (0, rows), (1, rows))
    return made


def side_by_side(count: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(4)
    world = np.column_stack((rng.uniform(-0.5, 0.5, 60), rng.uniform(-0.4, 0.4, 60), rng.uniform(2, 3, 60)))
    return np.stack([exp_se3([-0.02 * row, 0.0, 0.0, 0.0, 0.0, 0.0]) for row in range(count)]), world


def test_a_map_that_moves_sees_its_points_at_the_same_pixels() -> None:
    poses, world = side_by_side(3)
    made = map_of(poses, world)

    made.move(exp_se3([1.0, 2.0, 3.0, 0.2, 0.1, 0.3]), 2.5)

    for keyframe in made.keyframes:
        seen = CAMERA.project(transform(keyframe.T_camera_world, made.points))
        np.testing.assert_allclose(seen, keyframe.view.features.pixels, atol=1e-6)


def test_a_map_is_bent_by_all_at_its_newer_end_and_by_nothing_at_its_older_one() -> None:
    poses, world = side_by_side(11)
    made = map_of(poses, world)
    T, scale = exp_se3([0.1, 0.0, 0.2, 0.0, 0.1, 0.0]), 1.3

    made.bend(0, 10, T, scale)

    np.testing.assert_allclose(made.keyframes[0].T_camera_world, poses[0], atol=1e-9)
    centres = [inverse(keyframe.T_camera_world)[:3, 3] for keyframe in made.keyframes]
    before = inverse(poses[10])[:3, 3]
    np.testing.assert_allclose(centres[10], transform(T, scale * before[None])[0], atol=1e-9)
    _, turned_deg = pose_difference(made.keyframes[5].T_camera_world, poses[5])
    assert turned_deg == pytest.approx(np.degrees(0.05), abs=1e-6)
    middle = 0.5 * (before + centres[10])
    apart = np.linalg.norm(centres[5] - middle) / np.linalg.norm(inverse(poses[5])[:3, 3] - before)
    assert apart == pytest.approx(scale**0.5)


def test_two_landmarks_at_one_feature_become_one_that_all_keyframes_see() -> None:
    poses, world = side_by_side(4)
    made = map_of(poses, world)
    rows = np.arange(len(world))
    made.add_landmarks(world + 1e-4, (2, rows), (3, rows))  # the same points, seen by two others

    made.fuse(3, made.landmarks_of(0), 3.0)

    count = 2 * len(world) - int(made.is_alive.sum())
    assert count > 50
    assert made.count_shared_landmarks(2)[0] == made.count_shared_landmarks(3)[0] == count


def test_new_landmarks_are_found_near_and_far_by_the_depths_of_those_around_them() -> None:
    """The image moves by 100 px where the world is near, by 25 px where it is far, and 30 px are searched."""
    rng = np.random.default_rng(6)
    left_px, count = np.repeat([(5.0, 105.0), (185.0, 285.0)], 60, axis=0), 120
    pixels = np.column_stack([rng.uniform(*left_px.T), rng.uniform(5.0, 235.0, count)])
    world = CAMERA.back_project(pixels, np.repeat([1.0, 4.0], 60))
    first, second = exp_se3([0.2, 0.0, 0.0, 0.0, 0.0, 0.0]), np.eye(4)
    made, free = map_of(np.stack([first, second]), world), np.arange(count) % 3 > 0
    for keyframe in made.keyframes:
        keyframe.landmarks[free] = NO_LANDMARK

    made.extend(1)

    found = made.keyframes[1].landmarks[free]
    assert (found != NO_LANDMARK).mean() > 0.95
    assert (found == made.keyframes[0].landmarks[free]).all()
    known = found != NO_LANDMARK
    np.testing.assert_allclose(made.points[found[known]], world[free][known], atol=1e-6)
