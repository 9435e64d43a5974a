"""What each robot of a server that is behind is told that it may send."""

from __future__ import annotations

import itertools

import pytest

from rse_pf.backend.scheduling.robot_shares import TOLD_S, RobotShares
from rse_pf.identity import RobotId

ROBOTS = [RobotId("default", f"r{number}") for number in range(10)]


def window(shares: RobotShares, ends_s: float, started: int, refused: int = 0) -> float:
    """Let one window of a second end, in which all robots sent; return the share a second of each."""
    shares.sent.update(ROBOTS)
    shares.judge(ends_s, started, refused)
    return shares.per_s


def begun(*, served_per_s: float = 0.0) -> RobotShares:
    shares = RobotShares()
    shares.note_free(served_per_s)
    shares.begin(0.0)
    return shares


def test_the_first_share_is_an_equal_part_of_what_can_be_served() -> None:
    assert window(begun(), 1.0, 100, refused=100) == pytest.approx(10.0)
    assert window(begun(served_per_s=200.0), 1.0, 100, refused=100) == pytest.approx(0.95 * 20.0)


def test_what_is_served_before_counts_at_its_most_however_long_ago() -> None:
    shares = RobotShares()
    shares.note_free(200.0)
    for _ in range(1000):
        shares.note_free(1.0)
    shares.begin(0.0)

    assert window(shares, 1.0, 100) == pytest.approx(0.95 * 20.0)


def test_robots_that_were_told_too_little_are_not_told_less_and_less() -> None:
    shares = begun(served_per_s=200.0)
    told = [window(shares, float(second), 50, refused=50) for second in range(1, 11)]

    assert told[-1] == pytest.approx(0.5 * 0.95**10 * 20.0)
    assert told[-1] > 50 / len(ROBOTS), "with as much as is served it would be ever less"


def test_a_share_changes_in_windows_only_and_by_bounded_factors() -> None:
    shares = begun()
    full = window(shares, 1.0, 100, refused=900)
    shares.judge(1.5, 50, 450)
    assert shares.per_s == full, "robots have hardly heard of it"
    shares.judge(1.9, 0, 0)
    assert window(shares, 2.0, 50, refused=450) == pytest.approx(0.85 * full)
    assert window(shares, 3.0, 100) == pytest.approx(1.1 * 0.85 * full)


def test_shares_keep_within_bounds() -> None:
    shares = begun()
    for second in range(1, 100):
        window(shares, float(second), 100, refused=900)
    assert shares.per_s == pytest.approx(0.5 * 10.0)
    for second in range(100, 300):
        window(shares, float(second), 100)
    assert shares.per_s == pytest.approx(4.0 * 10.0)


def test_nobody_is_told_less_than_is_heard_before_it_ends() -> None:
    shares = begun()

    assert 1.0 / window(shares, 1.0, 2, refused=100) < TOLD_S


def test_there_is_room_after_two_intervals_with_little_to_do_and_hardly_a_refusal() -> None:
    shares = begun(served_per_s=100.0)
    rooms = []
    for interval, (started, refused) in enumerate(
        [(8, 0), (8, 0), (9, 0), (8, 0), (8, 1), (0, 0), (0, 0)], 1
    ):
        shares.judge(0.1 * interval, started, refused)
        rooms.append(shares.has_room)

    assert rooms == [False, True, False, False, False, False, True]


def test_a_server_that_falls_behind_has_no_room() -> None:
    shares = begun(served_per_s=100.0)
    shares.judge(0.1, 0, 0)
    shares.judge(0.2, 0, 0)
    assert shares.has_room
    shares.begin(0.3)
    assert not shares.has_room
    shares.judge(0.4, 0, 0)
    assert not shares.has_room


def test_what_robots_are_told_together_is_spread_by_half() -> None:
    shares = RobotShares()
    factors = sorted(shares.next_spread() for _ in range(20))

    assert 0.5 <= factors[0] < 0.6
    assert 1.4 < factors[-1] <= 1.5
    assert max(b - a for a, b in itertools.pairwise(factors)) < 0.12
