"""Places of the recordings: the bars of `benchmarks/live/places.py` that take seconds, not minutes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.live.places import (
    SMALL,
    PlacedMap,
    View,
    kitchen_map,
    recall_rows,
    relocalise_row,
    space_out,
    verdicts_of,
    views_of,
)
from benchmarks.maps.recordings import RED_KITCHEN
from client_sdk.datasets import open_dataset
from rse_pf.slam.keyframe import MAX_FEATURES

pytest.importorskip("cv2", reason="needs the extra 'vision'")
pytest.importorskip("gtsam", reason="needs the extra 'maps'")

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def recorded(recordings: Path, name: str) -> list[View]:
    dataset = open_dataset(recordings / name)
    poses = [None] * len(dataset) if dataset.truth is None else list(dataset.truth.T_world_camera)
    return views_of(name, dataset, poses)


@pytest.fixture(scope="module")
def kitchen(recordings: Path) -> list[View]:
    return recorded(recordings, RED_KITCHEN)


@pytest.fixture(scope="module")
def known(recordings: Path, kitchen: list[View]) -> tuple[PlacedMap, np.ndarray]:
    return kitchen_map(recordings, kitchen)


def test_no_keyframe_of_the_kitchen_is_larger_than_the_limit(kitchen):
    heads_bytes = 108 + 3 * 8 + 38 + 8 + 4
    assert max(view.size_bytes for view in kitchen) <= heads_bytes + 38 * MAX_FEATURES


def test_the_vocabulary_of_rendered_worlds_finds_the_places_of_the_kitchen(kitchen):
    dense = [kitchen[row] for row in space_out([view.T for view in kitchen], range(len(kitchen)))]

    row = recall_rows(dense, kitchen[::3])[RED_KITCHEN]

    assert row["n"] >= 40
    assert row["found_percent"] >= 97.5
    assert row["of_all_percent"] >= 95.0


def test_each_fifth_frame_of_the_kitchen_finds_its_place(known, kitchen):
    row = relocalise_row(known[0], kitchen, known[1])

    assert row["verdicts"]["ok"] >= 0.8 * 50
    (map_m, map_deg), (truth_m, truth_deg) = row["by_map_m_deg"]["median"], row["by_truth_m_deg"]["median"]
    assert map_m <= 0.01
    assert map_deg <= 0.5
    assert truth_m <= 0.035
    assert truth_deg <= 2.0


def test_views_of_other_recordings_have_no_place_in_the_kitchen(known, recordings):
    foreign = [view for name in SMALL for view in recorded(recordings, name)]

    assert verdicts_of(known[0], foreign) == {"none no-pose": len(foreign)}
