"""The rules by which the trials of relocalisation are judged."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.maps.trials import Depths, Scene, Shown, Trial, interruptions, judge, share_seen
from client_sdk.frontend import Frame
from rse_pf.geometry import Array, Camera, exp_se3

CAMERA = Camera(fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240)
SHOWN = [Shown(None if row < 2 else row, row / 2) for row in range(7)]
BEGUN = Trial(scene="s", kind="covered", at_s=0.0, first_s=None, found_s=None, last_s=3.0, wrong=())


def at(x: float, turned_deg: float = 0.0) -> Array:
    return exp_se3([x, 0.0, 0.0, 0.0, np.radians(turned_deg), 0.0])


def judged(poses: list[Array | None], is_mapped: list[bool]) -> Trial:
    truth = [None if image.row is None else at(0.0) for image in SHOWN]
    return judge(BEGUN, SHOWN, poses, truth, is_mapped)


def test_a_pose_within_a_second_of_the_first_mapped_image_is_found() -> None:
    mapped = [False, False, False, True, True, True, True]

    in_time = judged([None] * 5 + [at(0.1)] * 2, mapped)
    late = judged([None] * 6 + [at(0.1)], mapped)

    assert (in_time.first_s, in_time.found_s, in_time.is_judged, in_time.is_found) == (1.5, 2.5, True, True)
    assert (late.found_s, late.is_judged, late.is_found) == (3.0, True, False)


def test_a_trial_that_ends_within_a_second_or_shows_nothing_mapped_is_not_judged() -> None:
    assert not judged([None] * 7, [False] * 7).is_judged
    assert not judged([None] * 6 + [at(0.0)], [False] * 5 + [True] * 2).is_judged


@pytest.mark.parametrize(
    ("pose", "is_wrong"), [(at(0.19, 4.9), False), (at(0.21), True), (at(0.0, 5.1), True)]
)
def test_a_pose_off_by_20_cm_or_5_degrees_is_wrong_and_finds_nothing(pose: Array, is_wrong: bool) -> None:
    trial = judged([None] * 2 + [pose] * 5, [False] * 2 + [True] * 5)

    assert len(trial.wrong) == (5 if is_wrong else 0)
    assert trial.is_found != is_wrong


def test_a_pose_while_the_lens_is_covered_is_wrong() -> None:
    assert judged([None, at(0.0), *[None] * 5], [False] * 7).wrong == ((np.inf, np.inf),)


def depths(x: float, turned_deg: float = 0.0, wall_m: float = 2.0) -> Depths:
    """Return what a camera sees of a wall, when it moves along it and turns by little."""
    return Depths(
        depths_m=np.full((30, 40), wall_m, dtype=np.float32), T_world_camera=at(x, turned_deg), camera=CAMERA
    )


def test_an_image_is_seen_where_another_one_measured_the_same_depths_from_much_the_same_place() -> None:
    here = depths(0.0)

    assert share_seen(here, here) == 1.0
    assert share_seen(depths(0.6), here) == pytest.approx(0.7, abs=0.1)  # of 2.1 m of wall
    assert share_seen(depths(3.0), here) == 0.0  # beside it
    assert share_seen(depths(0.0, wall_m=1.5), here) == 0.0  # something near hid the wall
    assert share_seen(depths(0.0, turned_deg=180.0), here) == 0.0


def scene(*, is_short: bool) -> Scene:
    def read(row: int) -> Frame:
        raise AssertionError(row)

    poses = np.stack([at(0.02 * row) for row in range(100)])
    return Scene(read=read, stamps_s=np.arange(100) / 10, T_world_camera=poses, every=2, is_short=is_short)


def test_after_a_cover_time_has_passed_and_after_a_cut_the_stamps_go_on() -> None:
    shown = dict(interruptions(scene(is_short=False), 40))

    covered = shown["covered"]
    assert [image.row for image in covered[:15]] == [None] * 15
    assert covered[15].row == 72
    assert covered[15].stamp_s == pytest.approx(7.2)
    assert shown["cut"][0].row == 92
    assert shown["cut"][0].stamp_s == pytest.approx(4.2)


def test_a_camera_is_moved_to_images_that_were_not_mapped_and_lie_30_cm_away() -> None:
    (moved,) = (shown for kind, shown in interruptions(scene(is_short=False), 40) if kind == "moved")

    rows = [image.row for image in moved]
    assert all(row is not None and row % 2 == 1 for row in rows)
    assert rows[0] is not None
    assert 0.02 * (40 - rows[0]) >= 0.3


def test_a_short_recording_is_shown_to_and_fro_after_the_cover() -> None:
    (later, before) = (shown for _, shown in interruptions(scene(is_short=True), 96))

    assert [image.row for image in later[15:21]] == [97, 98, 99, 99, 98, 97]
    assert [image.row for image in before[15:18]] == [95, 94, 93]
