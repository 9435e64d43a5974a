"""The record of robots whose bytes ended processes: it counts for that robot alone, within a window."""

from __future__ import annotations

from rse_pf.identity import RobotId
from rse_pf.limits.crash_record import BLOCK_S, WINDOW_S, CrashRecord

ALICE, NAMESAKE = RobotId("acme", "robot-1"), RobotId("rival", "robot-1")


def test_the_second_crash_keeps_a_robot_out_for_a_while():
    record = CrashRecord()

    blocks = [record.note_crash(ALICE, 0.0), record.note_crash(ALICE, 1.0)]

    assert blocks == [False, True]
    refusal = record.refusal(ALICE, 1.0)
    assert refusal is not None
    assert refusal.retry_after_ms == BLOCK_S * 1e3
    assert record.refusal(ALICE, 1.0 + BLOCK_S) is None


def test_after_its_rest_a_robot_needs_as_many_crashes_again():
    record = CrashRecord()
    record.note_crash(ALICE, 0.0)
    record.note_crash(ALICE, 0.0)

    assert not record.note_crash(ALICE, BLOCK_S)
    assert record.refusal(ALICE, BLOCK_S) is None
    assert record.note_crash(ALICE, BLOCK_S)


def test_crashes_that_lie_far_apart_do_not_count_together():
    record = CrashRecord()

    assert not any(record.note_crash(ALICE, number * (WINDOW_S + 1.0)) for number in range(5))
