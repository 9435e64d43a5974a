"""What each robot of a server that is behind is told that it may send."""

from __future__ import annotations

import itertools

import pytest

from rse_pf.backend.scheduling.robot_shares import TOLD_S, RobotShares
from rse_pf.identity import RobotId

ROBOTS = [RobotId("default", f"r{number}") for number in range(10)]


def window(shares: RobotShares, ends_s: float, started: int, refused: int = 0) -> float:
    """Let one window of a second end, in which all robots sent; return the share a second of each."""
    send(shares)
    shares.judge(ends_s, started, refused)
    return shares.per_s


def send(shares: RobotShares, times: int = 1, robots: list[RobotId] = ROBOTS) -> None:
    for robot in robots * times:
        shares.note(robot)


def begun(*, served_per_s: float = 0.0) -> RobotShares:
    shares = RobotShares()
    shares.note_free(0.0, served_per_s)
    shares.begin(0.0)
    send(shares)
    return shares


def test_the_first_share_is_an_equal_part_of_what_can_be_served() -> None:
    assert window(begun(), 1.0, 100, refused=100) == pytest.approx(10.0)
    assert window(begun(served_per_s=200.0), 1.0, 100) == pytest.approx(20.0)


def test_robots_of_one_name_in_two_tenants_have_a_share_each() -> None:
    shares = RobotShares()
    send(shares, robots=[RobotId("acme", "r"), RobotId("rival", "r")])
    shares.note_free(1.0, 200.0)
    shares.begin(1.0)

    assert shares.per_s == pytest.approx(100.0)


@pytest.mark.parametrize("behind_s", [1.0, 1.3])
def test_robots_are_told_a_share_as_soon_as_the_server_falls_behind(behind_s: float) -> None:
    shares = RobotShares()
    send(shares)
    shares.note_free(1.0, 200.0)
    shares.begin(behind_s)
    assert shares.per_s == pytest.approx(20.0)

    newcomers = [RobotId("default", f"new{number}") for number in range(40)]
    send(shares, robots=newcomers)
    shares.judge(behind_s + 0.1, 10, 90)
    assert shares.per_s == pytest.approx(5.0), "those that joined count before the window ends"


def test_all_that_are_connected_count_until_a_window_was_counted() -> None:
    shares = RobotShares(connected=50)
    shares.note_free(0.0, 200.0)
    shares.begin(0.0)
    assert shares.per_s == pytest.approx(4.0)

    assert window(shares, 1.0, 200) == pytest.approx(20.0), "the others are idle"


def test_a_robot_that_disconnects_leaves_its_share_to_the_others() -> None:
    shares = begun(served_per_s=200.0)
    assert window(shares, 1.0, 200) == pytest.approx(20.0)
    for robot in ROBOTS[:6]:
        shares.forget(robot)
    shares.judge(1.1, 0, 0)

    assert shares.per_s == pytest.approx(50.0)


def test_what_is_served_before_counts_at_its_most_however_long_ago() -> None:
    shares = RobotShares()
    shares.note_free(0.0, 200.0)
    for second in range(1000):
        shares.note_free(float(second), 1.0)
    shares.begin(1000.0)

    assert window(shares, 1001.0, 100) == pytest.approx(20.0)


def test_only_windows_in_which_commands_were_refused_lower_what_can_be_served() -> None:
    shares = begun(served_per_s=200.0)
    assert window(shares, 1.0, 98, refused=2) == pytest.approx(20.0)
    assert window(shares, 2.0, 90, refused=10) == pytest.approx(0.95 * 20.0)


def test_robots_that_were_told_too_little_are_not_told_less_and_less() -> None:
    shares = begun(served_per_s=200.0)
    told = [window(shares, float(second), 50, refused=50) for second in range(1, 11)]

    assert told[-1] == pytest.approx(0.5 * 0.95**10 * 20.0)
    assert told[-1] > 50 / len(ROBOTS), "with as much as is served it would be ever less"


def test_shares_grow_until_a_tenth_is_refused_by_bounded_factors_and_in_windows_only() -> None:
    shares = begun()
    full = window(shares, 1.0, 100, refused=900)
    shares.judge(1.5, 50, 450)
    assert shares.per_s == full, "robots have hardly heard of it"
    shares.judge(1.9, 0, 0)
    assert window(shares, 2.0, 50, refused=450) == pytest.approx(0.85 * full)
    grown = window(shares, 3.0, 100)
    assert grown == pytest.approx(1.25 * 0.85 * full)
    assert window(shares, 4.0, 100, refused=100 / 9) == pytest.approx(grown)


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


def rooms(shares: RobotShares, brought: list[tuple[int, int]]) -> list[bool]:
    found = []
    for interval, (started, refused) in enumerate(brought, 1):
        shares.judge(1.0 + 0.1 * interval, started, refused)
        found.append(shares.has_room)
    return found


def fast_robots(*, sent_per_s: int, served_per_s: float) -> RobotShares:
    """Let ten robots send before the server falls behind."""
    shares = RobotShares()
    shares.note_free(0.0, 0.0)
    send(shares, times=sent_per_s)
    shares.note_free(1.0, served_per_s)
    shares.begin(1.0)
    return shares


def test_there_is_room_after_two_intervals_with_hardly_a_refusal_if_all_can_be_served() -> None:
    shares = fast_robots(sent_per_s=10, served_per_s=100.0)
    assert shares.is_enough
    assert rooms(shares, [(8, 0), (8, 0), (10, 0), (8, 1), (8, 0), (0, 0)]) == [
        False, True, True, False, False, True,
    ]  # fmt: skip


def test_room_for_all_that_free_robots_send_is_doubted_for_longer_while_it_would_not_do() -> None:
    shares = fast_robots(sent_per_s=20, served_per_s=100.0)
    assert not shares.is_enough
    assert rooms(shares, [(8, 0)] * 6 + [(9, 0)]) == [False] * 5 + [True, False]


def test_what_free_robots_send_is_not_learned_from_those_that_keep_to_a_rate() -> None:
    shares = fast_robots(sent_per_s=20, served_per_s=100.0)
    for second in range(2, 12):
        assert window(shares, float(second), 100, refused=12)
        assert not shares.is_enough

    free = fast_robots(sent_per_s=20, served_per_s=100.0)
    for second in range(2, 20):
        send(free, times=5)
        free.note_free(float(second), 50.0)
    free.begin(20.0)
    assert free.is_enough, "without overload they send less for long"


def test_a_share_that_is_as_much_as_free_robots_send_is_enough() -> None:
    shares = fast_robots(sent_per_s=12, served_per_s=100.0)
    assert not shares.is_enough
    window(shares, 2.0, 100)
    window(shares, 3.0, 100)

    assert shares.is_enough


def test_what_can_be_served_is_enough_for_few_robots_although_shares_were_lowered() -> None:
    shares = fast_robots(sent_per_s=20, served_per_s=100.0)
    for second in range(2, 8):
        window(shares, float(second), 50, refused=50)
    assert not shares.is_enough
    for robot in ROBOTS[:8]:
        shares.forget(robot)
    shares.judge(7.1, 0, 0)

    assert shares.per_s < 20.0
    assert shares.is_enough


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
