"""What each robot of a server that is behind is told that it may send."""

from __future__ import annotations

import itertools

import pytest

from rse_pf.backend.scheduling.robot_shares import RobotShares
from rse_pf.identity import RobotId

ROBOTS = [RobotId("default", f"r{number}") for number in range(10)]


def window(
    shares: RobotShares, ends_s: float, started: int, *, less: bool = False, more: bool = False
) -> float:
    """Let one window of a second end, in which all robots sent; return the share a second of each."""
    shares.sent.update(ROBOTS)
    shares.judge(ends_s, started, less=less, more=more)
    return shares.per_s


def test_a_share_is_an_equal_part_of_what_a_full_server_serves() -> None:
    shares = RobotShares()
    shares.begin(0.0)

    assert window(shares, 1.0, 100, less=True) == pytest.approx(0.9 * 10.0)
    assert window(shares, 2.0, 50, less=True) == pytest.approx(0.81 * 5.0)


def test_little_demand_lowers_no_share_and_raises_it_slowly() -> None:
    shares = RobotShares()
    shares.begin(0.0)
    full = window(shares, 1.0, 100, less=True)

    assert window(shares, 2.0, 20, more=True) == pytest.approx(1.03 * full)
    assert window(shares, 3.0, 0) == pytest.approx(1.03 * full)
    assert window(shares, 4.0, 200) == pytest.approx(2 * 1.03 * full), "so many can be served"


def test_shares_keep_within_bounds() -> None:
    shares = RobotShares()
    shares.begin(0.0)
    for second in range(1, 100):
        window(shares, float(second), 100, less=True)
    assert shares.per_s == pytest.approx(0.2 * 10.0)
    for second in range(100, 300):
        window(shares, float(second), 100, more=True)
    assert shares.per_s == pytest.approx(4.0 * 10.0)


def test_what_robots_are_told_together_is_spread_by_a_quarter() -> None:
    shares = RobotShares()
    factors = sorted(shares.next_spread() for _ in range(20))

    assert factors[0] >= 0.75
    assert factors[-1] <= 1.25
    assert max(b - a for a, b in itertools.pairwise(factors)) < 0.06
