"""Alignments of a robot in a live map, as updates and relocalisations change them."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.live.alignments import Alignments
from rse_pf.errors import BadMessage
from rse_pf.geometry import exp_se3
from rse_pf.wire.live_map import RelocaliseReply
from tests.kit.fake_live_map import alignment

FIRST, SECOND = exp_se3([1.0, 0, 0, 0, 0, 0]), exp_se3([1.1, 0, 0, 0, 0, 0])


@pytest.fixture
def known() -> Alignments:
    alignments = Alignments()
    alignments.identify_robot("me", 3)
    return alignments


def test_only_a_change_of_the_alignment_is_a_correction(known: Alignments) -> None:
    first = known.apply_update("alignment/me", alignment("me", FIRST, segment=3))
    again = known.apply_update("alignment/me", alignment("me", FIRST, segment=3))
    second = known.apply_update("alignment/me", alignment("me", SECOND, segment=3))
    lost = known.apply_update("alignment/me", alignment("me", None, segment=3, reason="a closure is gone"))

    assert first is not None
    assert again is None
    assert second is not None
    np.testing.assert_array_equal(second.before, FIRST)
    np.testing.assert_array_equal(second.after, SECOND)
    assert lost is not None
    assert lost.after is None
    assert known.get(0).reason == "a closure is gone"


def test_a_relocalisation_never_replaces_an_alignment_of_the_map(known: Alignments) -> None:
    known.apply_update("alignment/me", alignment("me", FIRST, segment=3))

    late = known.apply_relocalisation(
        0, np.eye(4), RelocaliseReply(verdict="ok", T_map_camera=SECOND.ravel())
    )

    assert late is None
    np.testing.assert_array_equal(known.get(0).T_map_odom, FIRST)


def test_segments_of_earlier_runs_and_of_other_robots_are_ignored(known: Alignments) -> None:
    assert known.apply_update("alignment/me", alignment("me", FIRST, segment=2)) is None
    assert known.apply_update("alignment/other", alignment("other", FIRST, segment=3)) is None
    assert known.get(0).by == "nothing"


def test_a_damaged_pose_changes_nothing(known: Alignments) -> None:
    damaged = {**alignment("me", FIRST, segment=3), "T_map_odom": [1.0, 2.0]}

    with pytest.raises(BadMessage, match="2 numbers, not 16 finite"):
        known.apply_update("alignment/me", damaged)

    assert known.get(0).by == "nothing"


def test_a_relocalisation_with_a_scale_gives_the_keyframe_the_pose_of_the_reply(known: Alignments) -> None:
    pose = exp_se3([2.0, 1.0, 0, 0, 0, 0.4])
    reply = RelocaliseReply(verdict="ok", T_map_camera=SECOND.ravel(), scale=0.25)

    known.apply_relocalisation(0, pose, reply)

    np.testing.assert_allclose(known.get(0).pose_in_map(pose), SECOND, atol=1e-12)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_scale_changes_nothing(known: Alignments, scale: float) -> None:
    with pytest.raises(BadMessage, match="a scale"):
        known.apply_update("alignment/me", {**alignment("me", FIRST, segment=3), "scale": scale})

    assert known.get(0).by == "nothing"
