"""A command that is ended at any moment is finished by the same command, and nothing is left unnoticed."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timezone

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle.deployment import Deployment, read_deployment
from rse_pf.aws.lifecycle.execution import StepContext, carry_out
from rse_pf.aws.lifecycle.plan import Step, plan_down, plan_park, plan_resume, plan_up
from rse_pf.aws.lifecycle.proof import prove
from tests.kit.account_on_moto import NAMES, SETTINGS, Formation, Killed, Killer, account_of

Plan = Callable[[Deployment], list[Step]]

UP: Plan = lambda found: plan_up(found, has_packages=True)  # noqa: E731
PARK: Plan = lambda found: plan_park(found, deep=False)  # noqa: E731
DEEP: Plan = lambda found: plan_park(found, deep=True)  # noqa: E731
RESUME: Plan = lambda found: plan_resume(found, has_packages=True) if found.note else []  # noqa: E731
DOWN: Plan = lambda found: plan_down(found, delete_data=False)  # noqa: E731
ERASE: Plan = lambda found: plan_down(found, delete_data=True)  # noqa: E731

COMMANDS: dict[str, tuple[list[Plan], Plan, str]] = {
    "up": ([], UP, "up"),
    "park": ([UP], PARK, "parked"),
    "park --deep": ([UP], DEEP, "deeply parked"),
    "resume": ([UP, PARK], RESUME, "up"),
    "resume from deep": ([UP, DEEP], RESUME, "up"),
    "down": ([UP], DOWN, "absent"),
    "down, parked": ([UP, PARK], DOWN, "absent"),
    "down --delete-data": ([UP], ERASE, "absent"),
}
"""What happens before, the command, and the stage at which it ends."""

MOST_POLLS = 50


def run(region: str, plan: Plan, killer: Killer) -> Account:
    """Run one command as a new process would: it knows nothing but the account."""
    account = account_of(region, killer)
    polls: list[float] = []

    def sleep(duration_s: float) -> None:
        polls.append(duration_s)
        assert len(polls) < MOST_POLLS, "it waits for what does not happen"

    world = StepContext(
        account=account,
        settings=SETTINGS,
        tools=Formation(region, killer),
        report_progress=lambda text: None,
        sleep=sleep,
    )
    carry_out(plan(read_deployment(account, SETTINGS)), world)
    return account


def check_end(region: str, command: str) -> None:
    """Compare what stands with what the command promises."""
    account, stage = account_of(region, Killer()), COMMANDS[command][2]
    found = read_deployment(account, SETTINGS)
    proof = prove(account, NAMES, now=datetime.now(timezone.utc))

    assert found.stage == stage
    if stage == "up":
        (group,) = found.groups.values()
        assert (group.min_servers, group.wanted_servers, group.max_servers) == (2, 2, 10)
        (row,) = account.client("autoscaling").describe_auto_scaling_groups()["AutoScalingGroups"]
        assert row["SuspendedProcesses"] == []
    if stage == "parked":
        assert {(size.max_servers, size.instances) for size in found.groups.values()} == {(0, 0)}
    if stage in ("up", "parked"):
        (alarm,) = account.client("cloudwatch").describe_alarms()["MetricAlarms"]
        assert alarm["ActionsEnabled"] == (stage == "up")
    if stage in ("absent", "deeply parked"):
        assert proof.left == ()
        assert set(found.stacks) == (set() if "delete-data" in command else {"Data"})
        assert len(proof.kept) == (0 if "delete-data" in command else 4)


def fill(region: str) -> None:
    """Put two versions of an object and a deletion into a bucket, if there is one."""
    from rse_pf.aws.clients import make_client

    s3 = make_client("s3", region)
    for bucket in [each["Name"] for each in s3.list_buckets()["Buckets"]][:1]:
        s3.put_bucket_versioning(Bucket=bucket, VersioningConfiguration={"Status": "Enabled"})
        for body in (b"1", b"2"):
            s3.put_object(Bucket=bucket, Key="k", Body=body)
        s3.delete_object(Bucket=bucket, Key="k")


def end_at(region: str, command: str, at: int) -> bool:
    """Run *command* so that it ends before its change number *at*, then again; return whether it ended."""
    before, plan, _ = COMMANDS[command]
    for each in before:
        run(region, each, Killer())
    fill(region)
    killer, was_killed = Killer(at), True
    try:
        run(region, plan, killer)
        was_killed = False
    except Killed:
        run(region, plan, Killer())
    check_end(region, command)
    return was_killed


def test_parking_that_is_ended_between_note_and_group_is_finished_by_the_same_command(region: str) -> None:
    assert end_at(region, "park", 3)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_wherever_a_command_is_ended_the_same_command_finishes(
    monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    moto = pytest.importorskip("moto", reason="run make setup")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    ends = 0
    while True:
        with moto.mock_aws():
            if not end_at("ap-northeast-2", command, ends + 1):
                break
        ends += 1

    assert ends >= 4, "every change was an end once"


@pytest.mark.slow
def test_locked_audit_logs_stay_and_are_reported_with_their_date(region: str) -> None:
    run(region, UP, Killer())
    s3 = account_of(region, Killer()).client("s3")
    where = {"LocationConstraint": region}
    s3.create_bucket(
        Bucket="locked-auditlogs", CreateBucketConfiguration=where, ObjectLockEnabledForBucket=True
    )
    s3.put_bucket_tagging(
        Bucket="locked-auditlogs", Tagging={"TagSet": [{"Key": "rse-pf", "Value": NAMES.prefix}]}
    )
    s3.put_object(
        Bucket="locked-auditlogs", Key="audit/a", Body=b"x", ObjectLockMode="GOVERNANCE",
        ObjectLockRetainUntilDate=datetime(2040, 1, 1, tzinfo=timezone.utc),
    )  # fmt: skip
    told: list[str] = []
    account = account_of(region, Killer())
    world = StepContext(
        account=account, settings=SETTINGS, tools=Formation(region, Killer()), report_progress=told.append,
        sleep=lambda duration_s: None,
    )  # fmt: skip

    carry_out(ERASE(read_deployment(account, SETTINGS)), world)

    (line,) = [each for each in told if "object lock" in each]
    assert line.startswith("locked-auditlogs stays: object lock keeps 1 audit logs, the last until 20")
    proof = prove(account, NAMES, now=datetime.now(timezone.utc))
    assert [each.name for each in proof.kept] == ["locked-auditlogs"]
