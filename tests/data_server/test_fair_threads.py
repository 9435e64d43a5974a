"""Work of one robot never keeps the others waiting for long, and unwanted work is not done."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator

import pytest

from rse_pf.data_server.fair_threads import FairThreads, while_wanted
from rse_pf.errors import Disconnected
from rse_pf.identity import RobotId

TIMEOUT_S = 30.0
ROBOT, OTHER = RobotId("acme", "robot-1"), RobotId("rival", "robot-1")


@pytest.fixture
def threads() -> Iterator[FairThreads]:
    made = FairThreads()
    yield made
    made.close()


class Gate:
    """Work that stops until it is let go."""

    def __init__(self) -> None:
        self.entered = threading.Semaphore(0)
        self.open = threading.Event()

    def work(self) -> str:
        self.entered.release()
        assert self.open.wait(TIMEOUT_S)
        return "done"

    async def wait_entered(self, count: int = 1) -> None:
        for _ in range(count):
            assert await asyncio.to_thread(self.entered.acquire, timeout=TIMEOUT_S)


async def test_two_tenants_never_have_all_of_a_few_threads() -> None:
    gate, few = Gate(), FairThreads(3)

    robots = [RobotId(tenant, f"robot-{number}") for number in range(4) for tenant in ("acme", "umbrella")]
    flood = [asyncio.ensure_future(few.run(robot, gate.work)) for robot in robots]
    await gate.wait_entered(2)
    assert await asyncio.wait_for(few.run(OTHER, int, "5"), TIMEOUT_S) == 5
    assert not gate.entered.acquire(blocking=False)
    gate.open.set()
    await asyncio.wait_for(asyncio.gather(*flood), TIMEOUT_S)
    few.close()


async def test_a_robot_is_served_beside_the_flood_of_another(threads: FairThreads) -> None:
    gate = Gate()

    work = [asyncio.ensure_future(threads.run(ROBOT, gate.work)) for _ in range(50)]
    await gate.wait_entered()
    assert await asyncio.wait_for(threads.run(OTHER, int, "5"), TIMEOUT_S) == 5
    assert not gate.entered.acquire(blocking=False)
    gate.open.set()
    await asyncio.wait_for(asyncio.gather(*work), TIMEOUT_S)


async def test_unwanted_work_is_not_started_and_running_work_ends_at_its_next_step() -> None:
    threads, gate = FairThreads(1), Gate()
    steps: list[int] = []
    ended = threading.Event()

    def endless() -> None:
        try:
            for step in while_wanted(iter(int, 1)):
                steps.append(step)
                gate.entered.release()
                gate.open.wait(TIMEOUT_S)
        except Disconnected:
            ended.set()
            raise

    runs = asyncio.ensure_future(threads.run(ROBOT, endless))
    waits = asyncio.ensure_future(threads.run(OTHER, steps.append, 5))
    await gate.wait_entered()
    for each in (runs, waits):
        each.cancel()
    await asyncio.gather(runs, waits, return_exceptions=True)
    gate.open.set()
    assert await asyncio.to_thread(ended.wait, TIMEOUT_S)
    assert await asyncio.wait_for(threads.run(OTHER, int, "1"), TIMEOUT_S) == 1
    threads.close()
    assert steps == [0]


async def test_a_robot_and_a_tenant_never_have_all_threads(threads: FairThreads) -> None:
    gate = Gate()

    robots = [RobotId("acme", f"robot-{number % 12}") for number in range(96)]
    flood = [asyncio.ensure_future(threads.run(robot, gate.work)) for robot in robots]
    one = [asyncio.ensure_future(threads.run(OTHER, gate.work)) for _ in range(8)]
    await gate.wait_entered(7)
    assert not gate.entered.acquire(blocking=False), "of eight, six for the tenant, one for the other"
    gate.open.set()
    assert await asyncio.wait_for(asyncio.gather(*flood, *one), TIMEOUT_S) == ["done"] * 104


async def test_a_call_that_waits_is_cancelled_when_the_threads_are_closed() -> None:
    gate, threads = Gate(), FairThreads(1)

    runs = asyncio.ensure_future(threads.run(ROBOT, gate.work))
    waits = asyncio.ensure_future(threads.run(OTHER, int, "1"))
    await gate.wait_entered()
    closing = asyncio.ensure_future(asyncio.to_thread(threads.close))

    with pytest.raises(asyncio.CancelledError):
        await asyncio.wait_for(waits, TIMEOUT_S)
    gate.open.set()
    assert await asyncio.wait_for(runs, TIMEOUT_S) == "done"
    await closing
