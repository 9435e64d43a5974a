"""The monitor on known numbers: CPU against a server's size, counts of an interval, whole periods."""

from __future__ import annotations

import pytest

from rse_pf.local.control.monitor import (
    MonitorSample,
    Observed,
    Periods,
    ServerSample,
    monitor_sample,
    server_sample,
)

STATUS = {
    "cpu_s": 10.0,
    "requests": 100,
    "robots": 7,
    "queue": 3,
    "queue_oldest_s": 0.0125,
    "in_flight": 1,
    "bytes_in": 1000,
    "bytes_out": 50,
}


def observed(at_s: float, **more: float) -> Observed:
    return Observed(at_s=at_s, status={name: value + more.get(name, 0) for name, value in STATUS.items()})


def one(before: Observed | None, now: Observed | None, capacity: float = 1.0) -> ServerSample:
    silent = ServerSample(name="server-1", pid=5, state="healthy")
    return server_sample(silent, before, now, capacity=capacity)


def server(name: str, cpu_percent: float | None, *, state: str = "healthy", **more: object) -> ServerSample:
    return ServerSample(name=name, pid=1, state=state, cpu_percent=cpu_percent, **more)  # type: ignore[arg-type]


def sample_of(
    time_s: float, cpu_percent: float | None, *, requests: int = 0, robots: int = 0
) -> MonitorSample:
    servers = [server("server-1", cpu_percent, requests=requests, robots=robots)]
    return monitor_sample(time_s, servers, frozenset({"server-1"}))


def test_cpu_is_relative_to_the_size_and_to_the_time_between_two_answers() -> None:
    sample = one(observed(100.0), observed(102.0, cpu_s=0.25), capacity=0.25)

    assert sample.cpu_percent == 50.0


def test_the_mean_leaves_out_who_warms_up_and_who_does_not_answer() -> None:
    servers = [server("a", 80.0), server("b", 40.0), server("c", 0.0, warming=True), server("d", None)]

    assert monitor_sample(1.0, servers, frozenset()).cpu_percent == 60.0
    assert monitor_sample(1.0, servers[2:], frozenset()).cpu_percent is None


def test_a_sample_is_the_mean_over_time_of_one_period_and_the_sum_of_its_requests() -> None:
    periods = Periods(10.0, keep=4)
    over = [
        periods.add(sample_of(time_s, cpu, requests=count, robots=4))
        for time_s, cpu, count in ((100.0, 50.0, 9), (102.0, 10.0, 1), (110.01, 90.0, 2), (111.0, 70.0, 4))
    ]

    (sample,) = periods.samples(111.0)

    assert over == [False, False, True, False], "the first sample speaks for no time"
    assert sample.start_s == 100.0
    assert sample.cpu_percent == pytest.approx((2.0 * 10.0 + 8.01 * 90.0) / 10.01)
    assert (sample.requests, sample.robots_per_server) == (3, pytest.approx(4.0))


def test_a_period_that_goes_on_or_was_hardly_watched_gives_no_sample() -> None:
    periods = Periods(10.0, keep=4)
    for time_s in (106.0, 109.9, 111.0, 119.0):
        periods.add(sample_of(time_s, 50.0))

    assert periods.samples(119.0) == ()
    assert [sample.start_s for sample in periods.samples(120.0)] == [110.0]


def test_counts_are_those_of_the_interval_and_levels_are_those_of_now() -> None:
    sample = one(observed(100.0), observed(101.0, requests=40, bytes_in=500, bytes_out=5, robots=2))

    assert (sample.requests, sample.bytes_in, sample.bytes_out) == (40, 500, 5)
    assert (sample.robots, sample.queue, sample.queue_ms, sample.in_flight) == (9, 3, 12.5, 1)


def test_healthy_is_who_passes_our_checks_and_gets_robots_from_the_balancer() -> None:
    servers = [server("a", 1.0), server("b", 1.0), server("c", 1.0, state="draining")]

    assert monitor_sample(1.0, servers, frozenset({"a", "c"})).healthy_servers == 1
