"""Alignments of a robot in a live map, as updates and relocalisations change them."""

from __future__ import annotations

import pytest

from client_sdk.live.alignments import Alignments
from rse_pf.errors import BadMessage
from rse_pf.geometry import exp_se3
from tests.kit.fake_live_map import alignment

FIRST, SECOND = exp_se3([1.0, 0, 0, 0, 0, 0]), exp_se3([1.1, 0, 0, 0, 0, 0])


@pytest.fixture
def known() -> Alignments:
    alignments = Alignments()
    alignments.identify_robot("me", 3)
    return alignments


def test_segments_of_earlier_runs_and_of_other_robots_are_ignored(known: Alignments) -> None:
    assert known.apply_update("alignment/me", alignment("me", FIRST, segment=2)) is None
    assert known.apply_update("alignment/other", alignment("other", FIRST, segment=3)) is None
    assert known.get(0).by == "nothing"


def test_a_damaged_pose_changes_nothing(known: Alignments) -> None:
    damaged = {**alignment("me", FIRST, segment=3), "T_map_odom": [1.0, 2.0]}

    with pytest.raises(BadMessage, match="2 numbers, not 16 finite"):
        known.apply_update("alignment/me", damaged)

    assert known.get(0).by == "nothing"


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_scale_changes_nothing(known: Alignments, scale: float) -> None:
    with pytest.raises(BadMessage, match="a scale"):
        known.apply_update("alignment/me", {**alignment("me", FIRST, segment=3), "scale": scale})

    assert known.get(0).by == "nothing"
