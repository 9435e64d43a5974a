"""Choice among several regions by round trips, on a fake clock."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from client_sdk.network.region_choice import RegionChoice

NEAR, FAR = 0, 1
HOLD_S = 60.0


class Drive:
    """A robot that uses one of two regions and pings both every two seconds."""

    def __init__(self, *, current: int = NEAR, now: float = 0.0) -> None:
        self.choice = RegionChoice(2, hold_s=HOLD_S)
        self.current, self.now = current, now
        self.changes: list[tuple[float, int]] = []

    def measure(self, near_ms: float, far_ms: float, *, for_s: float) -> Drive:
        until = self.now + for_s
        while self.now < until:
            for region, round_trip_ms in ((NEAR, near_ms), (FAR, far_ms)):
                if math.isfinite(round_trip_ms):
                    self.choice.add_round_trip(region, round_trip_ms / 1e3)
                    better = self.choice.find_nearer_region(self.current, (NEAR, FAR), self.now)
                    if better is not None:
                        self.current = better
                        self.changes.append((self.now, better))
            self.now += 2.0
        return self


def test_one_late_pong_is_no_slow_region():
    choice = RegionChoice(2, hold_s=HOLD_S)
    for round_trip_s in (0.03, 2.0, 0.03):
        choice.add_round_trip(NEAR, round_trip_s)

    assert choice.round_trip_s(NEAR) == 0.03


def test_a_region_that_gets_slow_is_left_after_a_minute_and_not_before():
    drive = Drive().measure(30, 130, for_s=300).measure(400, 130, for_s=58)
    assert drive.changes == []

    drive.measure(400, 130, for_s=10)

    assert [region for _, region in drive.changes] == [FAR]
    assert 360.0 <= drive.changes[0][0] <= 366.0


@pytest.mark.parametrize(
    "pieces",
    [
        pytest.param([(400, 130, 50), (30, 130, 10)] * 30, id="slow now and then"),
        pytest.param([(30, 24, 90), (24, 30, 90)] * 60, id="about equally far"),
        pytest.param([(12, 2, 600)], id="a small gain, however large its share"),
    ],
)
def test_a_region_is_kept(pieces):
    drive = Drive()
    for near_ms, far_ms, for_s in pieces:
        drive.measure(near_ms, far_ms, for_s=for_s)

    assert drive.changes == []


def test_a_small_share_is_no_reason_to_change_however_much_time_it_is():
    assert Drive().measure(400, 310, for_s=600).changes == []
    assert len(Drive().measure(400, 290, for_s=600).changes) == 1


def test_a_change_begins_the_comparison_anew():
    choice = RegionChoice(2, hold_s=HOLD_S)
    chosen = []
    for now in range(0, 2 * int(HOLD_S) + 2, 2):  # a robot that cannot follow stays in NEAR
        choice.add_round_trip(NEAR, 0.4)
        choice.add_round_trip(FAR, 0.13)
        chosen.append(choice.find_nearer_region(NEAR, [NEAR, FAR], float(now)))

    assert [2 * row for row, region in enumerate(chosen) if region is not None] == [HOLD_S]


def test_two_regions_that_take_turns_every_minute_cause_at_most_one_change_a_minute():
    drive = Drive()
    for _ in range(30):
        drive.measure(400, 30, for_s=70).measure(30, 400, for_s=70)

    assert len(drive.changes) >= 2
    assert all(later - before >= HOLD_S for (before, _), (later, _) in pairwise(drive.changes))


def test_a_region_that_is_lost_again_and_again_has_to_prove_itself_longer_each_time():
    drive, returned_after_s = Drive(current=FAR), []
    for _ in range(6):
        drive.choice.add_loss(NEAR, drive.now)
        drive.current = FAR
        drive.choice.restart_comparison()
        lost_s, before = drive.now, len(drive.changes)
        drive.measure(30, 130, for_s=1000)
        returned_after_s.append([at - lost_s for at, _ in drive.changes[before:]])

    assert [round(each[0], -1) for each in returned_after_s[:4]] == [60, 120, 240, 480]
    assert max(each[0] for each in returned_after_s if each) <= 16 * HOLD_S + 10


def test_losses_of_the_last_hour_count_and_no_older_ones():
    drive = Drive(current=FAR)
    for second in range(3):
        drive.choice.add_loss(NEAR, float(second))
    drive.now = 4000.0

    drive.measure(30, 130, for_s=120)

    assert [round(at - 4000.0, -1) for at, _ in drive.changes] == [60]


def test_a_robot_that_was_suspended_has_measured_nothing_meanwhile():
    drive = Drive().measure(400, 130, for_s=4)
    drive.now += 3600.0

    drive.measure(400, 130, for_s=50)

    assert drive.changes == []


def test_a_region_that_was_not_measured_since_its_loss_is_no_better_one():
    choice = RegionChoice(2, hold_s=HOLD_S)
    choice.add_round_trip(NEAR, 0.03)
    choice.add_loss(NEAR, 10.0)
    choice.add_round_trip(FAR, 0.13)

    assert choice.round_trip_s(NEAR) == math.inf
    assert choice.nearest([NEAR, FAR]) == FAR
    assert choice.find_nearer_region(FAR, [NEAR, FAR], 100.0) is None
