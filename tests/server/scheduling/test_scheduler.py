"""The scheduler: one command of a robot at a time, fresh within a stream, and never too late."""

from __future__ import annotations

import pytest

from rse_pf.server.scheduling.scheduler import INLINE_BYTES, Scheduler
from tests.kit.admitted_commands import AdmittedScheduler, queued


def run_order(scheduler: Scheduler, count: int) -> list[tuple[str, int]]:
    order = []
    for _ in range(count):
        started, _ = scheduler.start(0.0)
        assert started is not None
        order.append((started.robot.name, started.command.id))
        scheduler.done(started, 0.0)
    return order


def test_one_robot_never_has_two_commands_running():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1), 0.0)
    scheduler.submit(queued("a", 2), 0.0)
    first, _ = scheduler.start(0.0)

    assert scheduler.start(0.0) == (None, [])
    assert first is not None
    scheduler.done(first, 0.0)
    second, _ = scheduler.start(0.0)
    assert second is not None
    assert second.command.id == 2


def test_an_older_frame_does_not_replace_a_newer_one():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 2, stream="cam", seq=2), 0.0)

    (refusal,) = scheduler.submit(queued("a", 1, stream="cam", seq=1), 0.0)

    assert (refusal.queued.command.id, refusal.error.code) == (1, "stale")
    assert run_order(scheduler, 1) == [("a", 2)]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"stream": "cam", "keep": True}, {"stream": "cam"}),
        ({"stream": "cam"}, {"stream": "cam", "keep": True}),
        ({"stream": "left"}, {"stream": "right"}),
        ({"stream": ""}, {"stream": ""}),
    ],
)
def test_kept_frames_other_streams_and_no_stream_are_not_replaced(first, second):
    scheduler = AdmittedScheduler(max_queue=4)

    assert scheduler.submit(queued("a", 1, **first), 0.0) == []
    assert scheduler.submit(queued("a", 2, **second), 0.0) == []
    assert run_order(scheduler, 2) == [("a", 1), ("a", 2)]


def test_only_a_small_cheap_command_that_is_alone_runs_inline():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1), 0.0)
    scheduler.start(0.0)

    assert scheduler.runs_inline(cheap=True, size_bytes=INLINE_BYTES)
    assert not scheduler.runs_inline(cheap=True, size_bytes=INLINE_BYTES + 1)
    assert not scheduler.runs_inline(cheap=False, size_bytes=1)
    scheduler.submit(queued("b", 1), 0.0)
    assert not scheduler.runs_inline(cheap=True, size_bytes=1)
    scheduler.start(0.0)
    assert not scheduler.runs_inline(cheap=True, size_bytes=1)


@pytest.mark.parametrize(
    ("waited_s", "within_s", "code"),
    [(0.18, 0.25, ""), (0.19, 0.25, "busy"), (0.3, 0.25, "expired"), (8.4, 10.0, ""), (8.6, 10.0, "busy")],
)
def test_a_queued_command_is_given_up_once_it_would_come_too_late(waited_s, within_s, code):
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", within=within_s), 0.0)

    started, refusals = scheduler.start(waited_s)

    assert [refusal.error.code for refusal in refusals] == ([code] if code else [])
    assert (started is None) == bool(code)
    assert scheduler.waiting == 0


def test_a_frame_that_may_replace_a_waiting_one_is_never_refused():
    scheduler = Scheduler()
    for number in range(200):
        scheduler.submit(queued(f"turns{number}", at=0.1 * number))
        started, _ = scheduler.start(0.1 * number + 0.1)
        assert started is not None
        scheduler.done(started, 0.1 * number + 0.1)
    scheduler.submit(queued("a", 1, stream="cam", seq=1, within=0.25))
    robot, other = (queued(name).robot for name in "ab")

    assert scheduler.unread_pause_s(robot, 0.25) == 0.0
    assert scheduler.unread_pause_s(other, 0.25) > 0.0
    newer = queued("a", 2, stream="cam", seq=2, within=0.25)
    assert scheduler.backlog(newer) == (0, 0.0)


def test_a_frame_that_replaces_a_waiting_one_does_not_make_the_expected_wait_shorter():
    scheduler = Scheduler()
    for begin in range(400):  # each position in the queue takes one second, and each frame waits for a tenth
        for seq, at in enumerate((0.0, 0.9)):
            scheduler.submit(queued("a", at=begin + at, within=60.0, stream="cam", seq=seq))
        started, _ = scheduler.start(begin + 1.0)
        assert started is not None
        scheduler.done(started, begin + 1.0)
    scheduler.submit(queued("a", at=400.0))

    assert scheduler.backlog(queued("b", at=400.0, within=2.0)).pause_s > 0.0
    assert scheduler.backlog(queued("b", at=400.0, within=6.0)).pause_s == 0.0
