"""When a command starts without a place in the queue, and when in the event loop."""

from __future__ import annotations

from rse_pf.server.scheduling.scheduler import Scheduler
from tests.kit.admitted_commands import queued


def compute(scheduler: Scheduler, wait_s: float, spent_s: float, now: float, *, alone: bool) -> None:
    """Let one command arrive *wait_s* before *now*, start at *now* and take *spent_s*."""
    work = queued("a", at=now - wait_s)
    if alone:
        assert scheduler.start_unqueued(work, now)
        scheduler.finish_unqueued(work, now + spent_s)
    else:
        scheduler.submit(work)
        started, refusals = scheduler.start(now)
        assert (started, refusals) == (work, [])
        scheduler.done(work, now + spent_s)
    assert work.started_s == now


def test_services_that_answer_within_a_millisecond_stay_in_the_loop_although_others_wait() -> None:
    scheduler = Scheduler()

    def runs_inline_when_another_waits() -> bool:
        scheduler.submit(queued("a"))
        scheduler.submit(queued("b"))
        started, _ = scheduler.start(0.0)
        assert started is not None
        inline = scheduler.runs_inline(cheap=True, size_bytes=1)
        scheduler.leave("a")
        scheduler.leave("b")
        scheduler.done(started, 0.0005)
        return inline

    assert not runs_inline_when_another_waits(), "nothing is known of the services yet"
    for _ in range(30):
        compute(scheduler, 0.0, 0.0005, 0.0, alone=True)
    assert runs_inline_when_another_waits()
    compute(scheduler, 0.0, 0.2, 0.0, alone=True)
    assert runs_inline_when_another_waits(), "the process was interrupted once"
    for _ in range(10):
        compute(scheduler, 0.0, 0.002, 0.0, alone=True)
    assert not runs_inline_when_another_waits()
