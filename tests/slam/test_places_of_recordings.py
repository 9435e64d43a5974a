"""Places of the recordings: those of the kitchen are found again, and nothing of another recording is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rse_pf.experiments.results.trajectory_error import align
from rse_pf.geometry import pose_difference, rotation_angle_deg
from rse_pf.slam.keyframe import MAX_FEATURES
from tests.recorded_drives import RED_KITCHEN
from tests.slam.recorded_maps import alignment_of_poses
from tests.slam.recorded_places import PlacedMap, View, kitchen_map, recall, space_out, views_of

pytest.importorskip("cv2", reason="needs the extra 'vision'")
pytest.importorskip("gtsam", reason="needs the extra 'maps'")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

FOREIGN = ("tum_fr1_xyz_start", "redwood_living_room", "nyu_dining_room")


@pytest.fixture(scope="module")
def kitchen(recordings: Path) -> list[View]:
    return views_of(recordings, RED_KITCHEN)


@pytest.fixture(scope="module")
def known(recordings: Path, kitchen: list[View]) -> tuple[PlacedMap, np.ndarray]:
    return kitchen_map(recordings, kitchen)


def test_no_keyframe_of_the_kitchen_is_larger_than_the_limit(kitchen):
    heads_bytes = 108 + 3 * 8 + 38 + 8 + 4
    assert max(view.size_bytes for view in kitchen) <= heads_bytes + 38 * MAX_FEATURES


def test_the_vocabulary_of_rendered_worlds_finds_the_places_of_the_kitchen(kitchen):
    dense = [kitchen[row] for row in space_out([view.T for view in kitchen], range(len(kitchen)))]

    scores = recall(dense, kitchen[::3])

    assert len(scores) >= 40
    is_found, share = np.mean(scores, axis=0)
    assert is_found >= 0.975
    assert share >= 0.95


def test_each_fifth_frame_of_the_kitchen_finds_its_place(known, kitchen):
    placed, T_map_camera = known
    T_truth = np.array([view.T for view in kitchen])
    # Positions and rotations are compared with the truth after an alignment of their own.
    _, T_map_world = align(T_truth[:, :3, 3], T_map_camera[:, :3, 3])
    rotation = alignment_of_poses(T_truth, T_map_camera)[:3, :3]

    by_map, by_truth = [], []
    for row in range(0, len(kitchen), 5):
        found = placed.find(kitchen[row])
        if found.verdict == "ok":
            T = found.T_map_camera
            by_map.append(pose_difference(T, T_map_camera[row]))
            away_m = np.linalg.norm(T[:3, 3] - (T_map_world @ T_truth[row])[:3, 3])
            by_truth.append((away_m, rotation_angle_deg(T[:3, :3].T @ rotation @ T_truth[row, :3, :3])))

    assert len(by_map) >= 0.8 * 50
    (map_m, map_deg), (truth_m, truth_deg) = np.median(by_map, axis=0), np.median(by_truth, axis=0)
    assert map_m <= 0.01
    assert map_deg <= 0.5
    assert truth_m <= 0.035
    assert truth_deg <= 2.0


def test_views_of_other_recordings_have_no_place_in_the_kitchen(known, recordings):
    for view in (view for name in FOREIGN for view in views_of(recordings, name)):
        found = known[0].find(view)
        assert (found.verdict, found.reason) == ("none", "no-pose")
