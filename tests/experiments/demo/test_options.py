"""The options of a demo: how far robots drive when nobody says it."""

from __future__ import annotations

import pytest

from client_sdk.simulator import frames_to_overlap
from rse_pf.extensions.experiments.demo.robot import DemoOptions


@pytest.mark.parametrize("robots", [1, 2, 3, 8])
def test_robots_that_merge_drive_far_enough_to_see_what_others_saw(robots: int) -> None:
    options = DemoOptions(robots=robots, merge=True)

    assert options.frame_count >= max(150, frames_to_overlap(robots))
    assert DemoOptions(robots=robots, merge=True, frames=7).frame_count == 7
    assert DemoOptions(robots=robots).frame_count == 80


def test_robots_of_a_live_map_take_the_strongest_features() -> None:
    assert not DemoOptions(live=True).frontend_options.is_spread
    assert DemoOptions().frontend_options.is_spread
