"""The map services on the red-kitchen recording: what needs no platform."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rse_pf.slam.map_merge import MergeOptions, merge_versions
from tests.slam.recorded_maps import (
    cloud_distances,
    joined_poses,
    localise_every_fifth,
    origin_errors,
    plant_wrong_links,
    robots_of,
)

pytestmark = [pytest.mark.data, pytest.mark.slow]

for package in ("faiss", "gtsam", "cv2", "poselib"):
    pytest.importorskip(package)


def test_three_robots_become_one_map_within_the_bar(recordings: Path) -> None:
    robots = robots_of(recordings)

    merged = merge_versions([robot.version for robot in robots.runs])

    assert merged.joined == (0, 1, 2)
    assert robots.ate_m(joined_poses(robots.runs, merged)) <= 0.033
    for metres, degrees in origin_errors(robots, merged):
        assert metres <= 0.07
        assert degrees <= 2.5
    median_m, share = cloud_distances(robots, merged)
    assert median_m <= 0.015
    assert share >= 0.85


@pytest.mark.parametrize("seed", [0, 1])
def test_wrong_loops_change_the_error_by_less_than_a_tenth(recordings: Path, seed: int) -> None:
    robots = robots_of(recordings)
    versions = [robot.version for robot in robots.runs]

    clean = robots.ate_m(joined_poses(robots.runs, merge_versions(versions)))
    merged = merge_versions(versions, propose=plant_wrong_links(0.1, seed))

    assert merged.joined == (0, 1, 2)
    assert robots.ate_m(joined_poses(robots.runs, merged)) <= 1.1 * clean


def test_closing_loops_reduces_the_error_of_one_robot(recordings: Path) -> None:
    robots = robots_of(recordings, cuts=((0, 250),))
    versions = [robot.version for robot in robots.runs]

    without = merge_versions(versions, MergeOptions(close_loops=False))
    merged = merge_versions(versions)

    ate_m = robots.ate_m(joined_poses(robots.runs, merged))
    assert merged.loops >= 3
    assert ate_m <= 0.030
    assert ate_m <= robots.ate_m(joined_poses(robots.runs, without))


def test_two_recordings_that_share_no_view_are_not_joined(recordings: Path) -> None:
    kitchen = robots_of(recordings, cuts=((0, 84),)).runs[0]
    desk = robots_of(recordings, cuts=((0, 10),), name="tum_fr1_xyz_start").runs[0]

    merged = merge_versions([kitchen.version, desk.version])

    assert merged.joined == (0,)
    assert merged.not_joined[0][0] == 1


def test_every_fifth_frame_is_found_in_a_map_of_the_others(recordings: Path) -> None:
    found, errors = localise_every_fifth(recordings)

    assert found >= 0.60
    median_m, median_deg = np.median(errors, axis=0)
    assert median_m <= 0.03
    assert median_deg <= 2.0
    assert not ((errors[:, 0] > 0.10) | (errors[:, 1] > 5.0)).any()
    assert np.isfinite(errors).all()
