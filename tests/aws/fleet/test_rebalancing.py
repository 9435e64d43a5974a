"""Agents that know only sums spread the robots of all servers, and then leave them alone."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path

import pytest

from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.fleet.metrics import ROBOTS, dimensions_of
from rse_pf.aws.fleet.task import AgentState, Phase
from rse_pf.aws.fleet.tasks import rebalancing, server_metrics, spot_notice
from rse_pf.aws.fleet.tasks.rebalancing import read_totals
from rse_pf.config import PlatformSettings
from rse_pf.scaling.alarms import CPU, NAMESPACE
from tests.kit.delayed_cloudwatch import DELAY_S, DelayedCloudWatch
from tests.kit.fake_machine import FakeMachine, agent_context

FAST = PlatformSettings.from_dict({"scaling": {"profile": "fast"}})
PAPER = PlatformSettings()


class FakeFleet:
    """Servers with agents on one fake clock; a robot that moves goes to the server with the fewest."""

    def __init__(
        self, robots: list[int], settings: PlatformSettings, folder: Path, *, moves: bool = True
    ) -> None:
        self.robots = robots
        self.asked = 0
        self.machines = [FakeMachine() for _ in robots]
        self.cloudwatch = DelayedCloudWatch(self.machines[0].clock)
        self.agents = []
        self.log: list[str] = []
        for at, machine in enumerate(self.machines):
            machine.instance_id = lambda at=at: f"i-{at}"  # type: ignore[misc]
            machine.page = lambda at=at: f"rse_pf_robots {self.robots[at]}\n"  # type: ignore[misc]
            machine.move = self._mover(at) if moves else lambda robots, spread_s: robots  # type: ignore[method-assign]
            context = agent_context(
                machine, folder, clients={"cloudwatch": self.cloudwatch}, settings=settings,
                log=lambda event, **fields: self.log.append(event), state=AgentState(phase=Phase.SERVING),
            )  # fmt: skip
            self.agents.append(Agent(context, (server_metrics.task, rebalancing.task)))

    def _mover(self, at: int) -> Callable[[int, float], int]:
        def move(robots: int, spread_s: float) -> int:
            self.asked += robots
            for _ in range(robots):
                self.robots[at] -= 1
                self.robots[self.robots.index(min(self.robots))] += 1
            return robots

        return move

    def run(self, seconds: int) -> None:
        for _ in range(seconds):
            for machine, agent in zip(self.machines, self.agents, strict=True):
                agent.step()
                machine.sleep(1.0)

    def is_even(self) -> bool:
        even = sum(self.robots) / len(self.robots)
        return all(0.8 * even <= each <= 1.2 * even for each in self.robots)


def test_an_empty_server_gets_its_share_within_a_minute_and_then_nothing_moves(tmp_path: Path) -> None:
    fleet = FakeFleet([60, 60, 0], FAST, tmp_path)

    fleet.run(60)
    assert fleet.is_even()
    assert sum(fleet.robots) == 120
    asked = fleet.asked
    fleet.run(600)

    assert fleet.asked == asked, "robots moved although all servers were even"
    assert asked <= 40
    assert "failed" not in fleet.log


def test_the_papers_profile_spreads_them_within_four_of_its_periods(tmp_path: Path) -> None:
    fleet = FakeFleet([60, 60, 0], PAPER, tmp_path)

    fleet.run(240)

    assert fleet.is_even()


def test_nothing_moves_while_robots_still_arrive(tmp_path: Path) -> None:
    fleet = FakeFleet([10, 10, 0], FAST, tmp_path)
    for _ in range(6):
        fleet.run(10)
        fleet.robots[0] += 10

    assert fleet.asked == 0


def test_fast_metrics_are_of_high_resolution_and_hold_the_cpu_after_the_warm_up(tmp_path: Path) -> None:
    fleet = FakeFleet([1], FAST, tmp_path)
    (machine,) = fleet.machines
    warm_up_s = FAST.scaling.warm_up_s
    for _ in range(warm_up_s + 30):
        busy, there = machine.cpu
        machine.cpu = (busy + 0.75, there + 1.0)
        fleet.run(1)

    data = [datum for _, datum in fleet.cloudwatch.data]
    cpu = [datum for datum in data if datum["MetricName"] == CPU]
    assert {datum["StorageResolution"] for datum in data} == {1}
    assert {datum["Value"] for datum in cpu} == {75.0}
    assert len(cpu) in (3, 4)
    times = [int(datum["Timestamp"].timestamp()) for datum in cpu]
    assert [at % 10 for at in times] == [0] * len(times)
    assert len(set(times)) == len(times), "a period was published twice"
    published = [
        machine.wall_clock() - machine.clock() + visible_s - DELAY_S
        for visible_s, datum in fleet.cloudwatch.data
        if datum["MetricName"] == CPU
    ]
    assert all(0 <= at_s - begin_s - 10 < 2 for at_s, begin_s in zip(published, times, strict=True))


def test_the_emulator_answers_the_agents_query(region: str) -> None:
    cloudwatch = make_client("cloudwatch", region)
    end_s = int(datetime.now(timezone.utc).timestamp()) // 60 * 60
    for at, robots in ((end_s - 120, 60), (end_s - 60, 60), (end_s - 60, 3)):
        cloudwatch.put_metric_data(
            Namespace=NAMESPACE,
            MetricData=[
                {
                    "MetricName": ROBOTS, "Dimensions": dimensions_of("rse-pf"), "Value": robots,
                    "Unit": "Count", "Timestamp": datetime.fromtimestamp(at, timezone.utc),
                }
            ],
        )  # fmt: skip

    totals = read_totals(cloudwatch, "rse-pf", 60, float(end_s))

    assert [(each.robots, each.servers) for each in totals] == [(63, 2), (60, 1)]


@pytest.mark.parametrize(("notice", "drains"), [("interruption", True), ("rebalance", False)])
def test_an_interruption_drains_the_server_within_five_seconds_and_a_recommendation_is_noted_once(
    tmp_path: Path, notice: str, drains: bool
) -> None:
    machine = FakeMachine()
    log: list[tuple[str, float]] = []
    settings = PlatformSettings.from_dict({"cloud": {"spot": True}})
    context = agent_context(
        machine, tmp_path, settings=settings, state=AgentState(phase=Phase.SERVING),
        log=lambda event, **fields: log.append((event, machine.now_s)),
    )  # fmt: skip
    agent = Agent(context, (spot_notice.task,))
    for _ in range(40):
        machine.notice = notice if machine.now_s >= 110 else ""
        agent.step()
        machine.sleep(1.0)

    assert [event for event, _ in log] == ["spot-notice", *(["drained"] if drains else [])]
    assert log[0][1] - 110 <= 5
    assert len(machine.waits) == drains
    assert context.state.phase is (Phase.LEAVING if drains else Phase.SERVING)
