"""The tracker with depth: its order of attempts, segments and joins, and recordings that turn quickly."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame, FrontEndOptions, MonocularOptions, PoseQuery, TrackedFrame
from client_sdk.tracking.monocular_tracker import MonocularTracker
from client_sdk.tracking.tracker import Tracker
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import accuracy
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, pose_difference
from tests.kit.flat_world import DEPTHS_M, STEP_M, covered, foreign, frame_at
from tests.kit.tracked_drives import NO_ANSWER, Answer, run, run_all, solve

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

RECORDED = Path(__file__).parents[4] / "shared" / "data"


def frame(row: int) -> Frame:
    return frame_at(row, depth=True)


def both(row: int) -> Frame:
    """Return a frame whose left half is of the place, and whose right half is of another one."""
    here, there = frame(row), foreign(frame(row))
    return replace(here, rgb=np.concatenate([here.rgb[:, :160], there.rgb[:, 160:]], axis=1))


def at(row: int) -> Array:
    pose = np.eye(4)
    pose[0, 3] = row * STEP_M
    return pose


def assert_at(tracked: TrackedFrame, row: int, T_start: Array | None = None) -> None:
    assert tracked.T_world_camera is not None
    expected = at(row) if T_start is None else T_start @ at(row)
    metres, degrees = pose_difference(tracked.T_world_camera, expected)
    assert metres < 0.01
    assert degrees < 0.5


def test_poses_follow_the_motion_and_a_keyframe_is_far_from_every_other_one() -> None:
    tracker = Tracker()

    there = run_all(tracker, map(frame, range(12)))
    made = tracker.keyframes
    back = run_all(tracker, map(frame, range(10, -1, -1)))

    for row, tracked in enumerate(there):
        assert_at(tracked, row)
    for row, tracked in zip(range(10, -1, -1), back, strict=True):
        assert_at(tracked, row)
    assert 2 <= made <= 5  # 0.35 m in steps of 0.15
    assert tracker.keyframes == made
    assert (tracker.frames, tracker.lost_frames) == (23, 0)


def test_a_start_pose_is_where_the_trajectory_begins() -> None:
    start = inverse(at(90))
    tracker = Tracker(T_world_start=start)

    assert run(tracker, frame(0)).T_world_camera is start
    assert_at(run(tracker, frame(1)), 1, start)


@pytest.mark.parametrize("bad", [NO_ANSWER, (at(40), 400), (np.full((4, 4), np.nan), 400), (at(0), 19)])
def test_a_bad_answer_is_followed_by_the_last_frame_and_then_by_keyframes(bad: Answer) -> None:
    tracker = Tracker()
    run_all(tracker, map(frame, range(3)))
    asked: list[str] = []

    def answer(query: PoseQuery) -> Answer:
        asked.append(query.against)
        return bad if len(asked) < 3 else solve(query)

    tracked = run(tracker, frame(3), answer)

    assert asked == ["map", "frame", "keyframe"]
    assert_at(tracked, 3)


def test_a_lost_frame_has_no_pose_and_the_next_one_is_found_again() -> None:
    tracker = Tracker()
    run_all(tracker, map(frame, range(3)))

    lost = run(tracker, frame(3), lambda query: NO_ANSWER)
    found = run(tracker, frame(4))

    assert lost.lost
    assert tracker.lost_frames == 1
    assert_at(found, 4)


def test_a_frame_without_features_is_lost_without_a_query() -> None:
    tracker = Tracker()
    assert run(tracker, covered(frame(0))).lost  # nothing to start from
    assert not run(tracker, frame(0)).lost
    assert isinstance(tracker.prepare(covered(frame(1))), TrackedFrame)
    assert tracker.lost_frames == 2


def test_a_camera_that_was_carried_elsewhere_with_a_covered_lens_is_found_in_its_first_frame() -> None:
    tracker = Tracker(FrontEndOptions(segment_after=3))
    run_all(tracker, map(frame, range(25)))

    while_covered = run_all(tracker, (covered(frame(row)) for row in range(25, 65)))
    found = run(tracker, replace(frame(2), timestamp_s=8.0))

    assert all(tracked.lost for tracked in while_covered)
    assert_at(found, 2)
    assert found.segment == 0


@pytest.mark.parametrize("tracker", [Tracker(), MonocularTracker()], ids=["depth", "one lens"])
def test_a_place_that_the_camera_cannot_have_reached_is_not_recognised_until_it_can(
    tracker: Tracker | MonocularTracker,
) -> None:
    """Another place looks the same."""
    shown = frame if isinstance(tracker, Tracker) else functools.partial(frame_at, depth=False)
    run_all(tracker, map(shown, range(30)))
    run_all(tracker, (covered(shown(row)) for row in range(30, 33)))

    soon = run(tracker, replace(shown(2), timestamp_s=3.3))
    run_all(tracker, (covered(shown(row)) for row in range(34, 64)))
    later = run(tracker, replace(shown(2), timestamp_s=9.0))

    assert soon.lost
    assert not later.lost
    assert later.segment == 0


@pytest.mark.parametrize(
    "tracker",
    [Tracker(FrontEndOptions(segment_after=3)), MonocularTracker(MonocularOptions(segment_after=3))],
    ids=["depth", "one lens"],
)
def test_a_segment_out_of_reach_is_joined_once_the_camera_has_moved_farther_than_the_places_are_apart(
    tracker: Tracker | MonocularTracker,
) -> None:
    shown = functools.partial(frame_at, depth=isinstance(tracker, Tracker))
    run_all(tracker, map(shown, range(35)))
    back = [replace(shown(row), timestamp_s=3.5 + 0.1 * n) for n, row in enumerate(range(66, 2, -1))]

    run_all(tracker, back[:31])
    assert tracker.joins == []
    run_all(tracker, back[31:])

    assert [(join.segment, join.into) for join in tracker.joins] == [(1, 0)]


def test_a_camera_that_moves_half_a_metre_between_two_images_is_tracked() -> None:
    tracker = Tracker()

    for row in (0, 18, 36, 54):
        assert_at(run(tracker, frame(row)), row)


@pytest.mark.parametrize(("row", "is_found"), [(45, True), (4, False)])
def test_an_unclear_place_is_accepted_only_if_the_camera_moved_less_than_the_distance_of_what_it_sees(
    row: int, is_found: bool
) -> None:
    tracker = Tracker()
    run_all(tracker, map(frame, range(67)))
    run_all(tracker, (covered(frame(row)) for row in range(30)))

    def doubtful(query: PoseQuery) -> Answer:
        pose, _ = solve(query)
        return pose, int(0.4 * len(query.correspondences))

    shown = run(tracker, frame(row), doubtful)

    assert min(DEPTHS_M) > (66 - 45) * STEP_M
    assert np.median(DEPTHS_M) < (66 - 4) * STEP_M
    assert not shown.lost if is_found else shown.lost


def test_a_video_that_was_cut_has_two_segments_which_are_joined_where_they_overlap() -> None:
    tracker = Tracker(FrontEndOptions(segment_after=3))
    run_all(tracker, map(frame, range(20)))

    cut = run_all(tracker, (foreign(frame(row)) for row in range(8)))
    assert [tracked.lost for tracked in cut[:3]] == [True] * 3
    assert {tracked.segment for tracked in cut[3:]} == {1}
    assert all("not joined" in tracked.reason for tracked in cut[3:])
    assert tracker.joins == []

    # Seen one after the other, so that the second segment shows a place of the first.
    joined = run_all(tracker, [both(7)] * 12)

    assert len(tracker.joins) == 1
    assert (tracker.joins[0].segment, tracker.joins[0].into) == (1, 0)
    assert joined[-1].segment == 0
    assert joined[-1].reason == ""
    assert_at(joined[-1], 7)


def test_a_camera_that_is_back_in_the_first_segment_keeps_its_poses_when_the_other_one_is_joined() -> None:
    tracker = Tracker(FrontEndOptions(segment_after=3))
    run_all(tracker, map(frame, range(20)))
    run_all(tracker, (foreign(frame(row)) for row in range(8)))
    back = run(tracker, frame(7))
    assert back.segment == 0

    shown = run_all(tracker, [both(7)] * 12)

    assert [(join.segment, join.into) for join in tracker.joins] == [(1, 0)]
    for tracked in shown:
        assert tracked.segment == 0
        assert_at(tracked, 7)


def test_a_weak_pose_never_becomes_a_keyframe() -> None:
    weak, strong = Tracker(), Tracker()
    for row in range(15):
        for tracker, is_weak in ((weak, row > 0), (strong, False)):
            step = tracker.prepare(frame(row))
            while isinstance(step, PoseQuery):
                step = tracker.accept(step, *solve(step), is_weak=is_weak)
            assert_at(step, row)

    assert weak.keyframes == 1
    assert strong.keyframes > 2


def test_the_map_is_thinned_and_still_known() -> None:
    tracker = Tracker(FrontEndOptions(max_keyframes=4, keyframe_m=0.05))
    run_all(tracker, map(frame, range(40)))
    back = run_all(tracker, (frame(row) for row in range(38, 25, -1)))

    assert tracker.keyframes > 8
    assert tracker._segments[0].keyframe_count <= 4
    for row, tracked in zip(range(38, 25, -1), back, strict=True):
        assert_at(tracked, row)


def test_one_query_at_a_time() -> None:
    tracker = Tracker()
    run(tracker, frame(0))
    query = tracker.prepare(frame(1))
    assert isinstance(query, PoseQuery)
    with pytest.raises(UsageError, match="open"):
        tracker.prepare(frame(2))
    with pytest.raises(UsageError, match="open"):
        tracker.restart(np.eye(4))
    tracker.accept(query, *solve(query))
    with pytest.raises(UsageError, match="not the open one"):
        tracker.accept(query, None)


def test_rotations_stay_rotations_over_a_long_drive() -> None:
    tracker = Tracker()
    poses = [run(tracker, frame(abs(20 - row % 40))).T_world_camera for row in range(200)]

    for pose in poses:
        assert pose is not None
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rate_hz", "most_lost", "ate_cm"),
    [("tum_fr1_rpy_start", 10, 1, 3.1), ("tum_fr1_rpy_start", 5, 1, 4.0), ("7scenes_redkitchen", 5, 0, 3.6)],
)
def test_recordings_that_turn_quickly_are_not_lost(
    name: str, rate_hz: float, most_lost: int, ate_cm: float
) -> None:
    if not (RECORDED / name).exists():
        pytest.skip(f"no recording {name} at {RECORDED}")
    dataset = open_dataset(RECORDED / name).thinned(rate_hz)
    tracker = Tracker()

    tracked = run_all(tracker, dataset)

    posed = [(each.frame.timestamp_s, each.T_world_camera) for each in tracked if not each.lost]
    estimate = Trajectory(np.array([stamp for stamp, _ in posed]), np.array([pose for _, pose in posed]))
    assert dataset.truth is not None
    assert tracker.lost_frames <= most_lost
    assert 100 * accuracy(estimate, dataset.truth).ate_m <= ate_cm


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rate_hz", "most_lost"),
    [
        ("7scenes_redkitchen", 1, 0),
        ("euroc_mh01_start", 2, 0),
        ("euroc_mh01_start", 1, 1),  # the lost image shares 29 % of its view with the one before
        ("kitti_06_start", 2, 0),
    ],
)
def test_recordings_with_one_or_two_images_a_second_are_not_lost(
    name: str, rate_hz: float, most_lost: int
) -> None:
    if not (RECORDED / name).exists():
        pytest.skip(f"no recording {name} at {RECORDED}")
    tracker = Tracker()

    tracked = run_all(tracker, open_dataset(RECORDED / name).thinned(rate_hz))

    assert tracker.lost_frames <= most_lost
    assert {shown.segment for shown in tracked} == {0}


@pytest.mark.data
def test_the_five_wide_views_of_the_nyu_dining_room_are_joined() -> None:
    if not (RECORDED / "nyu_dining_room").exists():
        pytest.skip(f"no recordings at {RECORDED}")
    dataset = open_dataset(RECORDED / "nyu_dining_room")
    tracker = Tracker(FrontEndOptions.wide_baseline())

    poses = [run(tracker, shown).T_world_camera for shown in dataset]

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


def test_a_place_is_not_recognised_by_a_patch_that_looks_alike_while_all_else_is_missing() -> None:
    """A wallpaper that repeats gives matches at another wall."""
    tracker = Tracker()
    run_all(tracker, map(frame, range(25)))
    run_all(tracker, (covered(frame(row)) for row in range(3)))
    here, there = frame(12), foreign(frame(12))
    rgb = there.rgb.copy()
    rgb[60:200, 60:130] = here.rgb[60:200, 60:130]
    answers: list[Answer] = []

    def answer(query: PoseQuery) -> Answer:
        answers.append(solve(query))
        return answers[-1]

    patch = run(tracker, replace(here, timestamp_s=2.8, rgb=rgb), answer)

    assert any(pose is not None and inliers >= 40 for pose, inliers in answers)
    assert patch.lost
    assert_at(run(tracker, frame(12)), 12)


def test_a_place_is_recognised_though_something_near_hides_most_of_it() -> None:
    tracker = Tracker()
    run_all(tracker, map(frame, range(25)))
    run_all(tracker, (covered(frame(row)) for row in range(3)))
    here, hand = frame(12), foreign(frame(40))
    rgb, depth_m = here.rgb.copy(), here.depth_m.copy()
    rgb[:, 80:], depth_m[:, 80:] = hand.rgb[:, 80:], 0.4

    assert_at(run(tracker, replace(here, timestamp_s=8.0, rgb=rgb, depth_m=depth_m)), 12)
