"""The paper's rule of thumb as decisions."""

from __future__ import annotations

import pytest

from client_sdk.offload import CloudFirst


def plan(**changes):
    values = {"deadline_s": 0.2, "connected": True, "expected_round_trip_s": 0.05, "robot_solve_s": 0.01}
    return CloudFirst().plan(**{**values, **changes})


def test_asks_the_cloud_and_keeps_just_enough_time_for_itself():
    decided = plan()
    assert decided.where == "cloud"
    assert decided.robot_after_s == pytest.approx(0.2 - 1.25 * 0.01)


def test_solves_at_once_without_a_connection():
    assert plan(connected=False).where == "robot"


def test_starts_both_at_once_when_the_cloud_is_known_to_be_too_slow():
    decided = plan(expected_round_trip_s=0.3)
    assert decided.robot_after_s == 0.0
    assert "300 ms" in decided.why


def test_knows_nothing_yet_and_asks_the_cloud():
    assert plan(expected_round_trip_s=None, robot_solve_s=None).where == "cloud"


def test_a_deadline_shorter_than_its_own_solver_starts_at_once():
    assert plan(deadline_s=0.005).robot_after_s == 0.0
