"""What the metrics of a fleet say when given robots send commands: for tests of the scaling rules.

The commands pass through the gateway of a real worker, on a loop whose time does not move by itself.  Both
ways to the rules are read: the page of /metrics, as the agent of a cloud server publishes it, and the
numbers of /status, as the monitor of one machine adds them up.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from rse_pf.aws.fleet.metrics import datums, read_page
from rse_pf.server.metrics import merge, render
from rse_pf.wire import Command
from tests.kit.worker_parts import worker_parts

__all__ = ["Robot", "Traffic", "measure_traffic"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Robot:
    """A robot that connects in each of *active* periods, sends one command and leaves.

    ``stays`` keeps it connected between its commands; ``works`` is whether the server offers its service.
    """

    name: str
    scopes: tuple[str, ...] = ()
    active: Sequence[int] = range(1_000_000)
    stays: bool = False
    works: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Traffic:
    """What was measured in one period: as published to CloudWatch, and as the local monitor adds it up."""

    cloud: dict[str, float]
    local_requests: int
    local_robots: int


def measure_traffic(robots: Sequence[Robot], periods: int) -> list[Traffic]:
    """Return what a fleet of one loaded server reports in each of *periods*."""
    measured = []
    with ExitStack() as stack:
        worker = stack.enter_context(worker_parts())
        connected = {
            robot.name: worker.join(robot.name, scopes=robot.scopes)[0] for robot in robots if robot.stays
        }
        before, before_requests = read_page(_page(worker.dispatcher.snapshot())), 0
        for period in range(periods):
            for robot in robots:
                if period not in robot.active:
                    continue
                connection = connected.get(robot.name) or worker.join(robot.name, scopes=robot.scopes)[0]
                service = "echo" if robot.works else "no-such-service"
                worker.say(connection, Command(id=period + 1, service=service, payload={"value": 1}))
                worker.loop.advance()
                if not robot.stays:
                    worker.dispatcher.disconnect(connection)
            merged = merge([worker.dispatcher.snapshot()])
            now, requests = read_page(render(merged).decode()), sum(count for *_, count in merged["requests"])
            points = {
                datum["MetricName"]: datum["Value"]
                for datum in datums(before, now, "rse-pf", "i-1")
                if "Value" in datum
            }
            measured.append(
                Traffic(
                    cloud=points,
                    local_requests=requests - before_requests,
                    local_robots=int(merged["gauges"]["robots"]),
                )
            )
            before, before_requests = now, requests
    return measured


def _page(snapshot: dict[str, object]) -> str:
    return render(merge([snapshot])).decode()
