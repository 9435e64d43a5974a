"""Servers publish how many jobs wait and run, and the alarms of job servers act on these numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rse_pf.aws.fleet.task import AgentContext
from rse_pf.aws.fleet.tasks import job_metrics
from rse_pf.config import PlatformSettings
from rse_pf.errors import SettingsError
from rse_pf.scaling.job_alarms import JOB_IDLE_S, JOBS, JOBS_WAITING, job_alarms_of

WITH = {"cloud": {"job_servers": 4}, "serving": {"offer_jobs": True}}


def published(settings: PlatformSettings, page: str) -> list[dict[str, Any]]:
    """Return what one call of the task publishes."""
    calls: list[dict[str, Any]] = []
    context: Any = SimpleNamespace(
        settings=settings, machine=SimpleNamespace(page=lambda: page),
        clients={"cloudwatch": SimpleNamespace(put_metric_data=lambda **data: calls.append(data))},
    )  # fmt: skip
    made: AgentContext = context
    job_metrics.task(made).call()
    return [each for call in calls for each in call["MetricData"]]


def test_the_counts_of_a_real_page_are_published_for_the_group_of_job_servers() -> None:
    metrics = pytest.importorskip("rse_pf.backend.metrics")
    worker = metrics.Metrics()
    worker.gauges = {"jobs": 3.0, "jobs_pending": 2.0}
    page = metrics.render(metrics.merge([worker.snapshot(), worker.snapshot()])).decode()

    found = {each["MetricName"]: each for each in published(PlatformSettings.from_dict(WITH), page)}

    assert {name: each["Value"] for name, each in found.items()} == {JOBS: 6.0, JOBS_WAITING: 4.0}
    assert found[JOBS]["Dimensions"] == [{"Name": "AutoScalingGroupName", "Value": "rse-pf-jobs"}]


def test_nothing_is_published_without_job_servers() -> None:
    assert published(PlatformSettings(), "rse_pf_jobs 3\n") == []


def test_the_alarms_read_what_is_published() -> None:
    waiting, idle = job_alarms_of(PlatformSettings.from_dict(WITH).cloud)

    assert {metric.metric for alarm in (waiting, idle) for metric in alarm.metrics} == {JOBS, JOBS_WAITING}
    assert waiting.steps[0].change > 0 > idle.steps[0].change
    assert idle.period_s * idle.periods == JOB_IDLE_S


def test_job_servers_need_servers_that_offer_jobs() -> None:
    with pytest.raises(SettingsError, match=r"serving\.offer_jobs") as caught:
        PlatformSettings.from_dict({"cloud": {"job_servers": 4}})

    assert "set serving.offer_jobs to true" in caught.value.hint
