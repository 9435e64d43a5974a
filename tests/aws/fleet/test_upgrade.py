"""An upgrade replaces servers one by one, returns from a bad release, and can be repeated anywhere."""

from __future__ import annotations

import functools
from datetime import datetime, timedelta, timezone
from typing import Any

import botocore.session
import pytest
from botocore.validate import ParamValidator

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.upgrade import (
    find_failed_launch,
    upgrade,
)
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import VERSION_PARAMETER, ResourceNames

SETTINGS, NAMES = PlatformSettings(), ResourceNames()
START = datetime(2026, 11, 23, 9, 0, tzinfo=timezone.utc)
TEMPLATE = {"LaunchTemplateId": "lt-1", "LaunchTemplateName": "servers"}
BROKEN = "i-0broken"
REASON = "Instance failed to complete user's Lifecycle Action: was abandoned"


@functools.cache
def model_of(service: str) -> Any:
    """Return the API's own description."""
    return botocore.session.get_session().get_service_model(service)


class Interrupted(Exception):
    """The operator's machine went away."""


class FakeAws:
    """Three servers, and an instance refresh as AWS runs it: one step each time that somebody waits.

    Every call is checked against the API's own description, so that a misspelt argument is found.
    """

    def __init__(self, *, newest: int = 2, bad: bool = False, mixed: bool = False, servers: int = 3) -> None:
        self.now = START
        self.newest, self.bad, self.mixed = str(newest), bad, mixed
        self.group = self.recorded = "1"
        self.servers = ["1"] * servers
        self.refreshes: list[dict[str, Any]] = []
        self.activities: list[dict[str, Any]] = []
        self.firing: set[str] = set()
        self.calls: list[str] = []
        self.least_serving = servers
        self.interrupt_at = -1
        self.unlisted = 0
        self.waits = 0

    def account(self) -> Account:
        return Account("ap-northeast-2", lambda service, region: FakeClient(self, service))

    def called(self, service: str, method: str, arguments: dict[str, Any]) -> dict[str, Any]:
        model = model_of(service)
        operation = "".join(word.capitalize() for word in method.split("_"))
        report = ParamValidator().validate(arguments, model.operation_model(operation).input_shape)
        assert not report.has_errors(), report.generate_report()
        self.calls.append(method)
        found: dict[str, Any] = getattr(self, method)(**arguments)
        return found

    def sleep(self, seconds: float) -> None:
        self.waits += 1
        if self.waits == self.interrupt_at:
            raise Interrupted
        self.now += timedelta(seconds=seconds)
        self._advance()

    def _advance(self) -> None:
        refresh = self.refreshes[-1] if self.refreshes else {"Status": ""}
        if refresh["Status"] == "Pending":
            refresh["Status"] = "InProgress"
        elif refresh["Status"] == "InProgress":
            if self.firing:
                refresh.update(Status="RollbackInProgress", StatusReason="an alarm fired")
            elif self.bad:
                self.activities.append(
                    {
                        "Description": f"Launching a new EC2 instance: {BROKEN}", "StatusCode": "Cancelled",
                        "StatusMessage": REASON, "StartTime": self.now, "ActivityId": "a",
                    }
                )  # fmt: skip
            else:
                old = [at for at, version in enumerate(self.servers) if version != self.newest]
                if old:
                    self.servers[old[0]] = self.newest  # the new one was in service before
                refresh["PercentageComplete"] = 100 * self.servers.count(self.newest) // len(self.servers)
                if len(old) <= 1:
                    refresh["Status"], self.group = "Successful", self.newest
        elif refresh["Status"] == "RollbackInProgress":
            refresh["Status"] = "RollbackSuccessful"
            self.servers = ["1"] * len(self.servers)

    def _specification(self, version: str) -> dict[str, Any]:
        plain = {**TEMPLATE, "Version": version}
        if not self.mixed:
            return {"LaunchTemplate": plain}
        overrides = [{"InstanceType": "c7i.large"}, {"InstanceType": "m7i.large"}]
        template = {"LaunchTemplateSpecification": plain, "Overrides": overrides}
        return {"MixedInstancesPolicy": {"LaunchTemplate": template}}

    def describe_auto_scaling_groups(self, **_: Any) -> dict[str, Any]:
        instances = [
            {"InstanceId": f"i-{at}", "LaunchTemplate": {"Version": version}}
            for at, version in enumerate(self.servers)
        ]
        group = {"AutoScalingGroupName": NAMES.group, "Instances": instances}
        return {"AutoScalingGroups": [{**group, **self._specification(self.group)}]}

    def describe_launch_templates(self, **_: Any) -> dict[str, Any]:
        return {"LaunchTemplates": [{"LatestVersionNumber": int(self.newest)}]}

    def describe_instance_refreshes(self, InstanceRefreshIds: Any = None, **_: Any) -> dict[str, Any]:
        if InstanceRefreshIds and self.unlisted:
            self.unlisted -= 1
            return {"InstanceRefreshes": []}
        wanted = InstanceRefreshIds or [each["InstanceRefreshId"] for each in self.refreshes]
        found = [dict(each) for each in self.refreshes if each["InstanceRefreshId"] in wanted]
        for each in found:
            if each["Status"] == "Pending":
                del each["StartTime"]
        return {"InstanceRefreshes": found}

    def describe_alarms(self, AlarmNames: list[str], **_: Any) -> dict[str, Any]:
        states = {name: "ALARM" if name in self.firing else "OK" for name in AlarmNames}
        return {"MetricAlarms": [{"AlarmName": n, "StateValue": state} for n, state in states.items()]}

    def describe_scaling_activities(self, **_: Any) -> dict[str, Any]:
        return {"Activities": list(reversed(self.activities))}

    def get_console_output(self, InstanceId: str, **_: Any) -> dict[str, Any]:
        assert InstanceId == BROKEN
        return {"Output": "kernel line\r\nrse-pf: first boot: failed: SystemExit: no package\r\n"}

    def start_instance_refresh(self, DesiredConfiguration: Any, Preferences: Any, **_: Any) -> dict[str, Any]:
        assert not self.refreshes or self.refreshes[-1]["Status"] not in ("Pending", "InProgress")
        identity = f"refresh-{len(self.refreshes) + 1}"
        self.refreshes.append(
            {
                "InstanceRefreshId": identity, "Status": "Pending", "StartTime": self.now,
                "DesiredConfiguration": DesiredConfiguration, "Preferences": Preferences,
            }
        )  # fmt: skip
        return {"InstanceRefreshId": identity}

    def rollback_instance_refresh(self, **_: Any) -> dict[str, Any]:
        self.refreshes[-1]["Status"] = "RollbackInProgress"
        return {}

    def update_auto_scaling_group(self, **arguments: Any) -> dict[str, Any]:
        self.group = arguments["LaunchTemplate"]["Version"]
        return {}

    def describe_stacks(self, **_: Any) -> dict[str, Any]:
        parameters = {VERSION_PARAMETER: self.recorded, "NetworkVpc": "vpc-1"}
        rows = [{"ParameterKey": key, "ParameterValue": value} for key, value in parameters.items()]
        return {"Stacks": [{"StackStatus": "UPDATE_COMPLETE", "Parameters": rows}]}

    def update_stack(self, Parameters: list[dict[str, Any]], UsePreviousTemplate: bool, **_: Any) -> Any:
        assert UsePreviousTemplate
        assert {"ParameterKey": "NetworkVpc", "UsePreviousValue": True} in Parameters
        (ours,) = [each for each in Parameters if each["ParameterKey"] == VERSION_PARAMETER]
        self.recorded = ours["ParameterValue"]
        return {}


class FakeClient:
    """One service of `FakeAws`."""

    def __init__(self, aws: FakeAws, service: str) -> None:
        self._aws, self._service = aws, service

    def can_paginate(self, _: str) -> bool:
        return False

    def __getattr__(self, method: str) -> Any:
        return lambda **arguments: self._aws.called(self._service, method, arguments)


def run(aws: FakeAws, settings: PlatformSettings = SETTINGS) -> tuple[Any, list[str]]:
    told: list[str] = []
    ended = upgrade(
        aws.account(), settings, report_progress=told.append, sleep=aws.sleep, now=lambda: aws.now
    )
    return ended, told


@pytest.mark.parametrize("mixed", [False, True])
def test_a_good_release_replaces_every_server_and_the_stack_names_it(mixed: bool) -> None:
    aws = FakeAws(mixed=mixed)

    ended, told = run(aws)

    assert (ended.version, ended.replaced, ended.reason) == ("2", True, "")
    assert aws.servers == ["2", "2", "2"]
    assert aws.recorded == "2", "the next deployment would return the group to the old version"
    assert told[-1] == "the stack names version 2"
    assert "running: 33 %" in told
    (refresh,) = aws.refreshes
    assert refresh["Preferences"]["MinHealthyPercentage"] == 100
    assert refresh["Preferences"]["AutoRollback"]
    assert refresh["Preferences"]["SkipMatching"]
    assert NAMES.alarm("errors") in refresh["Preferences"]["AlarmSpecification"]["Alarms"]


def test_a_release_whose_first_server_does_not_get_ready_is_taken_back_at_once_and_says_why() -> None:
    aws = FakeAws(bad=True)

    ended, told = run(aws)

    assert not ended.replaced
    assert ended.reason == f"rolled back: {REASON}"
    assert ended.console == ("rse-pf: first boot: failed: SystemExit: no package",)
    assert aws.servers == ["1", "1", "1"]
    assert (aws.group, aws.recorded) == ("1", "1")
    assert len(aws.activities) == 1, "more than one machine of a broken release was launched"
    assert aws.calls.count("rollback_instance_refresh") == 1
    assert "update_stack" not in aws.calls
    assert told[-1].startswith("rolled back")


def test_an_alarm_that_fires_meanwhile_takes_the_release_back() -> None:
    aws = FakeAws()
    aws.newest = "2"
    advance = aws._advance

    def fire() -> None:
        advance()
        if aws.servers.count("2") == 1:
            aws.firing.add(NAMES.alarm("errors"))

    aws._advance = fire  # type: ignore[method-assign]

    ended, _ = run(aws)

    assert ended.reason == "rolled back: an alarm fired"
    assert aws.recorded == "1"


def test_an_alarm_that_fires_before_does_not_forbid_the_release_that_cures_it() -> None:
    aws = FakeAws()
    aws.firing.add(NAMES.alarm("unhealthy"))
    start = aws.start_instance_refresh

    def started(**arguments: Any) -> dict[str, Any]:
        aws.firing.clear()
        return start(**arguments)

    aws.start_instance_refresh = started  # type: ignore[method-assign]

    ended, told = run(aws)

    assert ended.replaced
    assert told[0] == "alarm unhealthy fires already, so it does not end this upgrade"
    watched = aws.refreshes[0]["Preferences"]["AlarmSpecification"]["Alarms"]
    assert NAMES.alarm("unhealthy") not in watched
    assert NAMES.alarm("errors") in watched


@pytest.mark.parametrize("at", range(1, 5))
def test_an_interrupted_upgrade_is_followed_and_finished_by_the_next(at: int) -> None:
    aws = FakeAws()
    aws.interrupt_at = at
    with pytest.raises(Interrupted):
        run(aws)
    for _ in range(at):
        aws.now += timedelta(seconds=30)
        aws._advance()

    ended, _ = run(aws)

    assert ended.reason == ""
    assert aws.servers == ["2", "2", "2"]
    assert (aws.group, aws.recorded) == ("2", "2")
    assert len(aws.refreshes) == 1, "a second refresh was started beside the first"


def with_an_earlier_refresh(aws: FakeAws) -> FakeAws:
    wanted = {"LaunchTemplate": {**TEMPLATE, "Version": "1"}}
    started = START - timedelta(days=1)
    aws.refreshes.append(
        {
            "InstanceRefreshId": "refresh-1", "Status": "Successful", "StartTime": started,
            "PercentageComplete": 100, "DesiredConfiguration": wanted,
        }
    )  # fmt: skip
    return aws


def test_a_refresh_that_has_not_started_is_not_taken_for_the_successful_one_before() -> None:
    aws = with_an_earlier_refresh(FakeAws())

    ended, told = run(aws)

    assert (ended.version, aws.servers, aws.recorded) == ("2", ["2", "2", "2"], "2")
    assert told[1] == "running: 0 %"


def test_a_parked_fleet_gets_the_version_without_a_refresh() -> None:
    aws = FakeAws(servers=0)

    ended, _ = run(aws)

    assert (aws.group, aws.recorded, ended.reason) == ("2", "2", "")
    assert aws.refreshes == []


def test_a_launch_that_failed_for_want_of_capacity_does_not_take_the_release_back() -> None:
    launch = {"Description": "Launching a new EC2 instance", "StartTime": START, "StatusCode": "Failed"}

    assert find_failed_launch([{**launch, "StatusMessage": "Insufficient capacity."}], START) is None
    assert find_failed_launch([{**launch, "StatusMessage": REASON}], START + timedelta(seconds=1)) is None
    assert find_failed_launch([{**launch, "StatusMessage": REASON}], START) is not None


@pytest.mark.parametrize(
    "change",
    [
        {"StatusCode": "Successful"},
        {"StatusCode": "InProgress"},
        {"Description": "Terminating EC2 instance: i-1"},
    ],
)
def test_only_a_launch_that_has_failed_takes_the_release_back(change: dict[str, str]) -> None:
    launch = {
        "Description": "Launching a new EC2 instance", "StartTime": START, "StatusCode": "Cancelled",
        "StatusMessage": REASON,
    }  # fmt: skip

    assert (
        find_failed_launch([launch, {**launch, "StartTime": START + timedelta(seconds=1)}], START) == launch
    )
    assert find_failed_launch([{**launch, **change}], START) is None


@pytest.mark.parametrize(
    ("bad", "code", "last"), [(False, 0, "all servers run version 2"), (True, 1, "  | rse-pf")]
)
def test_the_verb_tells_the_end_and_its_code_tells_a_release_that_was_taken_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], bad: bool, code: int, last: str
) -> None:
    aws = FakeAws(bad=bad)
    monkeypatch.setattr("rse_pf.aws.account.open_account", lambda region: aws.account())
    monkeypatch.setattr("rse_pf.cli.cloud.upgrade.time.sleep", aws.sleep)

    class Clock(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> datetime:  # type: ignore[override]
            return aws.now

    monkeypatch.setattr("rse_pf.cli.cloud.upgrade.datetime", Clock)

    assert main(["cloud", "upgrade"]) == code

    assert capsys.readouterr().out.splitlines()[-1].startswith(last)
