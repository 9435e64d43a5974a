"""A weekend of 60 hours without a robot, and a schedule for Monday: the templates on fake time, on moto.

What AWS does is written here: scheduled actions and schedules of the template at their times, unless the
group suspended them, and the hourly rule where the template has one.
"""

from __future__ import annotations

import json
import re
import zoneinfo
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from typing import Any

import pytest

from rse_pf.aws.fleet.metrics import dimensions_of
from rse_pf.aws.lifecycle import idle
from rse_pf.aws.lifecycle.deployment import ParkNote, read_note, read_sizes
from rse_pf.aws.lifecycle.execution import StepContext, carry_out
from rse_pf.aws.lifecycle.parking import empty_group, silence_alarms, write_note
from rse_pf.aws.lifecycle.plan import Step
from rse_pf.config.cloud_layout import RESUME_FIELD
from tests.kit.account_on_moto import NAMES, Formation, Killer, account_of
from tests.kit.emulated_aws import REGION, emulated_aws
from tests.stacks.test_alarm_states import alarms_in, states, well

Assembly = Any

SEOUL = zoneinfo.ZoneInfo("Asia/Seoul")
FRIDAY = datetime(2030, 1, 4, 20, tzinfo=SEOUL)
MONDAY = datetime(2030, 1, 7, 8, tzinfo=SEOUL)
DAYS = ("SUN", "MON", "TUE", "WED", "THU", "FRI", "SAT")
_CRON = re.compile(r"(?:cron\()?(\d+) (\d+) [?*] \* ([\w,]+)(?: \*\))?")


def is_due(cron: str, zone: str, now: datetime) -> bool:
    """Return whether *cron*, of Auto Scaling or of EventBridge Scheduler, begins at this minute."""
    found = _CRON.fullmatch(cron)
    assert found is not None, cron
    local = now.astimezone(zoneinfo.ZoneInfo(zone))
    day = int(local.strftime("%w"))
    days = found[3].split(",")
    return (local.minute, local.hour) == (int(found[1]), int(found[2])) and bool(
        {str(day), DAYS[day]} & set(days)
    )


class Platform:
    """One deployment on moto, and the events that its templates make."""

    def __init__(self, assembly: Assembly, region: str) -> None:
        self.assembly = assembly
        self.account = account_of(region, Killer())
        self.settings = assembly.settings.replace(cloud={"region": region})
        Formation(region, Killer()).deploy(NAMES.stack("Backend"))
        self.topic: str = self.account.client("sns").create_topic(Name="events")["TopicArn"]
        rules = assembly.all("AWS::Events::Rule")
        self.parks = any(each.get("ScheduleExpression") == "rate(1 hour)" for each in rules)
        self.told: list[str] = []

    def group(self) -> dict[str, Any]:
        groups = self.account.client("autoscaling").describe_auto_scaling_groups()["AutoScalingGroups"]
        return next(dict(each) for each in groups if each["AutoScalingGroupName"] == NAMES.group)

    def alarms_act(self) -> bool:
        alarms = self.account.client("cloudwatch").describe_alarms()["MetricAlarms"]
        return bool(alarms) and all(each["ActionsEnabled"] for each in alarms)

    def hour(self, now: datetime) -> None:
        """Let an hour pass that ends at *now*; then comes what is due."""
        group = self.group()
        if group["DesiredCapacity"]:
            self._publish(now - timedelta(minutes=30))
        suspended = {each["ProcessName"] for each in group["SuspendedProcesses"]}
        for action in self.assembly.all("AWS::AutoScaling::ScheduledAction"):
            if is_due(action["Recurrence"], action["TimeZone"], now) and "ScheduledActions" not in suspended:
                self.account.client("autoscaling").update_auto_scaling_group(
                    AutoScalingGroupName=NAMES.group, MinSize=action["MinSize"],
                    DesiredCapacity=max(action["MinSize"], group["DesiredCapacity"]),
                )  # fmt: skip
        for each in self.assembly.all("AWS::Scheduler::Schedule"):
            if is_due(each["ScheduleExpression"], each["ScheduleExpressionTimezone"], now):
                least = json.loads(each["Target"]["Input"])[RESUME_FIELD]
                self.told.append(
                    idle.resume_if_parked(self.account, self.settings, least=least, topic=self.topic)
                )
        if self.parks:
            utc = now.astimezone(timezone.utc)
            self.told.append(idle.park_if_idle(self.account, self.settings, now=utc, topic=self.topic))

    def _publish(self, at: datetime) -> None:
        """Publish what agents do when there is no robot but the canary, which is not counted."""
        data = [
            {"MetricName": name, "Dimensions": dimensions_of(NAMES.group), "Value": value, "Timestamp": at}
            for name, value in (("Requests", 0.0), ("Robots", 0.0))
        ]
        self.account.client("cloudwatch").put_metric_data(Namespace="RsePf", MetricData=data)

    def weekend(self) -> None:
        for hour in range(1, 61):
            self.hour(FRIDAY + timedelta(hours=hour))

    def assert_up(self) -> None:
        """Eight servers are wanted, everything may start more, and alarms act and would fire."""
        group = self.group()
        assert (group["MinSize"], group["DesiredCapacity"]) == (8, 8)
        assert group["SuspendedProcesses"] == []
        assert self.alarms_act()
        assert read_note(self.account, NAMES) is None
        none = {**well(self.assembly, 60), "GroupDesiredCapacity": [8.0], "HealthyHostCount": [0.0]}
        assert states(alarms_in(self.assembly)["few-servers"], [none] * 8)[-1] == "ALARM"


@pytest.fixture
def production(
    assembly: Assembly, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Platform]:
    """A deployment with TLS and a schedule for Monday at eight, on Friday evening."""
    if assembly.settings.cloud.allow_insecure:
        pytest.skip("a trial")
    with emulated_aws(monkeypatch, request.node.nodeid):
        yield Platform(assembly, REGION)


def test_after_a_weekend_without_robots_production_has_its_servers_on_monday_at_eight(
    production: Platform,
) -> None:
    production.weekend()

    production.assert_up()
    assert production.told == ["rse-pf is not parked"]


def test_a_platform_that_is_to_park_itself_is_resumed_by_its_schedule(production: Platform) -> None:
    production.parks = True

    production.weekend()

    assert any("is parked now" in each for each in production.told)
    production.assert_up()
    production.hour(MONDAY + timedelta(hours=1))
    production.assert_up()


def park(platform: Platform, *, deep: bool = False) -> None:
    """Do what rse-pf cloud park does."""
    sizes = read_sizes(platform.account, NAMES)
    write_note(platform.account, NAMES, ParkNote(groups=sizes, since="Friday", deep=deep))
    silence_alarms(platform.account, NAMES)
    empty_group(platform.account, NAMES.group)


def test_a_platform_that_its_operator_parked_is_resumed_by_its_schedule(production: Platform) -> None:
    park(production)

    production.hour(MONDAY - timedelta(hours=1))
    assert production.group()["MaxSize"] == 0
    production.hour(MONDAY)

    production.assert_up()


def test_a_resume_by_hand_makes_up_for_the_entries_that_were_due_meanwhile(production: Platform) -> None:
    park(production)
    world = StepContext(
        account=production.account, settings=production.settings, tools=Formation("", Killer()),
        report_progress=production.told.append, now=lambda: MONDAY + timedelta(hours=2),
    )  # fmt: skip

    carry_out([Step("fill"), Step("alert"), Step("forget")], world)

    production.assert_up()
