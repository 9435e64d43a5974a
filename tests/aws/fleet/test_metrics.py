"""CloudWatch gets the numbers of the server's own page, under the names that the alarms use."""

from __future__ import annotations

from typing import Any

import pytest

from rse_pf.aws.fleet.metrics import ServerMetrics, datums, dimensions_of, read_page
from rse_pf.config import PlatformSettings
from rse_pf.scaling.alarms import NAMESPACE, alarms_of
from rse_pf.scaling.operator_alarms import STORE_ERRORS, operator_alarms


def page(answers: list[tuple[str, float]], **gauges: float) -> str:
    metrics = pytest.importorskip("rse_pf.server.metrics")
    worker = metrics.Metrics()
    for service, duration_s in answers:
        worker.count_answer(service, "ok", duration_s)
    worker.bytes_in, worker.bytes_out = 1000, 70
    worker.gauges = gauges
    return metrics.render(metrics.merge([worker.snapshot()])).decode()


def named(found: list[dict[str, Any]]) -> dict[str, Any]:
    return {each["MetricName"]: each for each in found}


def test_a_page_of_a_real_server_is_read_completely() -> None:
    text = page(
        [("pnp", 0.0004), ("pnp", 0.015), ("echo", 9.0)], robots=3.0, in_flight=2.0, queue_oldest_s=0.25
    )

    reading = read_page(text)

    assert (reading.robots, reading.in_flight, reading.queue_ms) == (3.0, 2.0, 250.0)
    assert (reading.requests, reading.bytes_in, reading.bytes_out) == (3.0, 1000.0, 70.0)
    assert reading.answers[20.0] == 2.0
    assert reading.answers[10_000.0] == 3.0


def test_crashes_of_native_code_are_published_as_their_increase_and_only_while_there_are_any() -> None:
    before, now = (read_page(page([], worker_crashes=count)) for count in (2, 3))

    began, followed = named(datums(before, now, "group", "i-1")), named(datums(now, now, "group", "i-1"))

    assert began["NativeCrashes"]["Value"] == 1
    assert "NativeCrashes" not in followed


@pytest.mark.parametrize(("free_percent", "is_low"), [(0.0, True), (9.9, True), (10.0, False), (None, False)])
def test_a_disk_with_less_than_a_tenth_free_is_published(free_percent: float | None, is_low: bool) -> None:
    gauges = {} if free_percent is None else {"disk_free_percent": free_percent}
    now = read_page(page([], **gauges))

    assert ("DiskLow" in named(datums(now, now, "group", "i-1"))) == is_low


def test_every_series_of_an_operator_alarm_that_we_publish_is_published_by_a_server_in_trouble() -> None:
    wanted = {
        series.metric
        for alarm in operator_alarms(PlatformSettings())
        for series in alarm.series
        if series.namespace == NAMESPACE
    }

    told = named(
        datums(
            ServerMetrics(),
            ServerMetrics(worker_crashes=3, disk_free_percent=9.9),
            "rse-pf",
            "i-1",
        )
    )

    assert wanted - set(told) == {STORE_ERRORS}, "another task publishes that"


def test_every_series_that_an_alarm_reads_is_published_with_the_groups_name() -> None:
    settings = PlatformSettings.from_dict({"scaling": {"max_robots_per_server": 9}})
    wanted = {
        metric.metric
        for alarm in alarms_of(settings.scaling)
        for metric in alarm.metrics
        if metric.namespace == NAMESPACE
    }
    told = datums(ServerMetrics(), ServerMetrics(), "rse-pf", "i-1")

    assert wanted == {"Requests", "Robots"}
    assert wanted <= set(named(told))
    *of_group, of_server = told
    for each in of_group:
        assert each["Dimensions"] == [{"Name": "AutoScalingGroupName", "Value": "rse-pf"}]
    assert (of_server["MetricName"], of_server["Dimensions"]) == ("Robots", dimensions_of("rse-pf", "i-1"))
    assert dimensions_of("rse-pf", "i-1")[1:] == [{"Name": "InstanceId", "Value": "i-1"}]


def test_counters_are_published_as_the_increase_since_the_last_sample() -> None:
    before = ServerMetrics(requests=100, bytes_in=10, answers={1.0: 90, 2.0: 100})
    now = ServerMetrics(requests=130, bytes_in=15, robots=4, answers={1.0: 95, 2.0: 130})

    published = named(datums(before, now, "group", "i-1"))

    assert published["Requests"]["Value"] == 30
    assert published["BytesIn"]["Value"] == 5
    assert published["Robots"]["Value"] == 4
    assert (published["AnswerMs"]["Values"], published["AnswerMs"]["Counts"]) == ([1.0, 2.0], [5, 25])


def test_a_restarted_server_counts_from_zero_again() -> None:
    published = named(
        datums(
            ServerMetrics(requests=100, answers={1.0: 100}),
            ServerMetrics(requests=7, answers={1.0: 7}),
            "group",
            "i-1",
        )
    )

    assert published["Requests"]["Value"] == 7
    assert published["AnswerMs"]["Counts"] == [7]
