"""Plans of `CloudFirst`: who computes a command, and when each of them is asked."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from client_sdk.offloading.offload_policy import CloudFirst
from rse_pf.errors import CommandFailed, ConnectError, Disconnected, PnpError

seconds = st.floats(1e-4, 10)


def plan(offload=None, **changes):
    values = {"deadline_s": 0.2, "connected": True, "expected_round_trip_s": 0.05, "robot_solve_s": 0.01}
    return (offload or CloudFirst(slack_s=0.02)).plan(**{**values, **changes})


@given(deadline_s=seconds, mine_s=seconds, round_trip_s=st.none() | seconds, connected=st.booleans())
def test_a_fallback_always_leaves_the_robot_its_time_or_starts_at_once(
    deadline_s, mine_s, round_trip_s, connected
):
    decided = plan(
        deadline_s=deadline_s, robot_solve_s=mine_s, expected_round_trip_s=round_trip_s, connected=connected
    )

    assert decided.robot_after_s == 0.0 or decided.robot_after_s + mine_s < deadline_s


def test_the_robot_mends_what_the_cloud_broke_but_not_what_the_command_broke():
    assert CloudFirst.can_recover("busy")
    assert CloudFirst.can_recover("worker-lost")
    assert CloudFirst.can_recover(Disconnected.code)
    assert CloudFirst.can_recover(ConnectError.code)
    for code in ("degenerate", "no-consensus", "too-few", "bad-request", "stale", PnpError.code):
        assert not CloudFirst.can_recover(code)
    assert not CloudFirst.can_recover(CommandFailed.code)


def test_a_late_server_leaves_the_burst_function_its_time_before_the_robots_own():
    decided = plan(burst_s=0.03)

    assert decided.where == "both"
    assert decided.robot_after_s == pytest.approx(0.16)
    assert decided.burst_after_s == pytest.approx(0.16 - 2 * 0.03)
    assert plan(burst_s=0.03, expected_round_trip_s=0.12).burst_after_s == pytest.approx(0.12)
    assert plan(burst_s=0.03, expected_round_trip_s=0.19).burst_after_s == pytest.approx(0.13)
    assert plan(burst_s=0.03, expected_round_trip_s=None).burst_after_s == pytest.approx(0.10)


@pytest.mark.parametrize("changes", [{"connected": False}, {"expected_round_trip_s": 0.3}])
def test_without_a_server_that_is_in_time_the_burst_function_is_asked_at_once_and_the_robot_last(changes):
    decided = plan(burst_s=0.05, **changes)

    assert (decided.burst_after_s, decided.robot_after_s) == (0.0, pytest.approx(0.16))
    assert decided.where == ("both" if decided.why.startswith("the cloud takes") else "robot")


def test_a_robot_without_a_solver_has_two_places():
    decided = plan(robot_can=False, burst_s=0.05, connected=False)

    assert (decided.where, decided.burst_after_s) == ("cloud", 0.0)


@given(
    deadline_s=seconds, mine_s=seconds, burst_s=st.none() | seconds, round_trip_s=st.none() | seconds,
    connected=st.booleans(), can=st.booleans(),
)  # fmt: skip
def test_no_place_is_asked_when_it_cannot_be_in_time(
    deadline_s, mine_s, burst_s, round_trip_s, connected, can
):
    decided = plan(
        deadline_s=deadline_s, robot_solve_s=mine_s, burst_s=burst_s, robot_can=can,
        expected_round_trip_s=round_trip_s, connected=connected,
    )  # fmt: skip

    if decided.burst_after_s is not None:
        assert decided.burst_after_s + burst_s <= deadline_s
        if can and decided.robot_after_s:
            assert decided.burst_after_s + burst_s <= decided.robot_after_s + 1e-9
