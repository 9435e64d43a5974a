"""The idle timer on fake hours: what counts as idle, and what it does then."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Sequence
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.fleet.metrics import dimensions_of
from rse_pf.aws.lifecycle.deployment import read_deployment
from rse_pf.aws.lifecycle.idle import Hour, is_idle, park_if_idle
from rse_pf.aws.lifecycle.plan import plan_park, plan_resume
from rse_pf.errors import ConfigurationError
from tests.kit.account_on_moto import NAMES, SETTINGS, Formation, Killer, account_of

SILENT = Hour(requests=None, robots=None)
IDLE = Hour(requests=0.0, robots=0.0)
VISITED = Hour(requests=1.0, robots=0.0)
BUSY = Hour(requests=9000.0, robots=3.0)
CONNECTED = Hour(requests=0.0, robots=1.0)
NOW = datetime(2030, 1, 2, 18, 20, tzinfo=timezone.utc)


@pytest.mark.parametrize(
    ("hours", "idle"),
    [
        ([IDLE] * 24, True),
        ([BUSY, *[IDLE] * 24], True),
        ([*[IDLE] * 23, BUSY], False),
        ([*[IDLE] * 22, CONNECTED, IDLE], False),
        ([*[IDLE] * 22, VISITED, IDLE], False),
        ([*[IDLE] * 22, SILENT, IDLE], False),
        ([IDLE] * 23, False),
        ([], False),
    ],
)
def test_idle_is_every_hour_of_which_it_is_known_that_nobody_came(hours: Sequence[Hour], idle: bool) -> None:
    assert is_idle(hours) is idle


def publish(region: str, hours: dict[int, tuple[float, float]]) -> None:
    """Publish requests and robots as agents do, so many hours before NOW."""
    data: list[dict[str, Any]] = [
        {
            "MetricName": name, "Dimensions": dimensions_of(NAMES.group), "Value": value,
            "Timestamp": NOW.replace(minute=10) - timedelta(hours=back),
        }
        for back, values in hours.items()
        for name, value in zip(("Requests", "Robots"), values, strict=True)
    ]  # fmt: skip
    account_of(region, Killer()).client("cloudwatch").put_metric_data(Namespace="RsePf", MetricData=data)


@pytest.fixture
def topic(region: str) -> str:
    """A deployment that is up, and its topic."""
    tools = Formation(region, Killer())
    tools.deploy(NAMES.stack("Backend"))
    arn: str = account_of(region, Killer()).client("sns").create_topic(Name="events")["TopicArn"]
    return arn


def test_after_the_last_idle_hour_the_servers_end_and_resume_brings_them_back(
    region: str, topic: str
) -> None:
    settings, account = SETTINGS, account_of(region, Killer())
    publish(region, {25: (500.0, 2.0), **dict.fromkeys(range(1, 25), (0.0, 0.0))})

    early = park_if_idle(account, settings, now=NOW - timedelta(hours=1), topic=topic)
    still_up = read_deployment(account, settings)
    told = park_if_idle(account, settings, now=NOW, topic=topic)
    again = park_if_idle(account, settings, now=NOW + timedelta(hours=1), topic=topic)

    assert "was used" in early
    assert still_up.note is None
    assert "is parked now" in told
    assert "is parked since 2030-01-02T18:20" in again
    found = read_deployment(account, settings)
    assert found.note is not None
    assert (found.note.by, found.stage) == ("timer", "parked")
    assert [(each.max_servers, each.instances) for each in found.groups.values()] == [(0, 0)]
    assert found.note.groups[NAMES.group].max_servers == 10
    assert plan_park(found, deep=False) == []
    assert plan_resume(found, has_packages=True)[0].action == "fill"


def test_a_mail_that_cannot_be_sent_changes_nothing_and_the_next_hour_parks(region: str, topic: str) -> None:
    account, settings = account_of(region, Killer()), SETTINGS
    publish(region, dict.fromkeys(range(25), (0.0, 0.0)))

    with pytest.raises(ConfigurationError, match="sns publish"):
        park_if_idle(account, settings, now=NOW, topic=topic + "-gone")
    between = read_deployment(account, settings)
    told = park_if_idle(account, settings, now=NOW + timedelta(hours=1), topic=topic)

    assert between.note is None
    assert [each.max_servers for each in between.groups.values()] == [10]
    assert "is parked now" in told
    found = read_deployment(account, settings)
    assert (found.stage, found.note and found.note.groups[NAMES.group].max_servers) == ("parked", 10)


def test_a_deployment_whose_agents_are_silent_is_not_parked(region: str, topic: str) -> None:
    told = park_if_idle(account_of(region, Killer()), SETTINGS, now=NOW, topic=topic)

    assert "have no metrics" in told


@pytest.mark.parametrize("module", ["rse_pf.aws.lifecycle.idle", "rse_pf.aws.canary.handler"])
def test_a_function_needs_no_package_that_the_lock_of_functions_lacks(module: str, repository: Path) -> None:
    locked = set(re.findall(r"^([a-z0-9-]+)==", (repository / "locks/lambda.txt").read_text(), re.M))
    code = (
        f"import sys, {module}\n"
        "files = {name.partition('.')[0]: getattr(of, '__file__', '') for name, of in sys.modules.items()}\n"
        "found = [name for name, file in files.items() if 'site-packages' in (file or '')]\n"
        "print(*sorted(found))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )

    optional = (
        "_",
        "rse_pf",
        "typing_extensions",
        "python_socks",
    )  # msgspec and websockets work without them
    loaded = {name for name in told.stdout.split() if not name.startswith(optional)}
    assert loaded <= {name.replace("-", "_") for name in locked}, "the runtime itself has botocore only"
