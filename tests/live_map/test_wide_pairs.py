"""Links of wide baselines in the red kitchen: enough are believed and right, and none is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.live.wide_pairs import judge_pairs, kitchen_sights

pytestmark = [pytest.mark.data, pytest.mark.slow]

for package in ("cv2", "faiss"):
    pytest.importorskip(package)


def test_a_seventh_of_the_pairs_two_seconds_apart_is_believed_and_right(recordings: Path) -> None:
    judged = judge_pairs(kitchen_sights(recordings), gap=20, spacing=5)

    right, _, wrong = judged.count(judged.believed)

    assert judged.pairs == 230
    assert right >= 0.15 * judged.pairs
    assert wrong == 0
