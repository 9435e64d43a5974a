"""Percentiles of the last minute come from histograms that count since the start of each server."""

from __future__ import annotations

import math

import pytest

from rse_pf.extensions.fleet_page.feeds.percentiles import LastMinute, buckets_of, percentile

PAGE = """
# TYPE rse_pf_duration_seconds histogram
rse_pf_duration_seconds_bucket{le="0.001",service="pnp"} 10.0
rse_pf_duration_seconds_bucket{le="0.002",service="pnp"} 30.0
rse_pf_duration_seconds_bucket{le="+Inf",service="pnp"} 40.0
rse_pf_duration_seconds_bucket{le="0.001",service="echo"} 5.0
rse_pf_duration_seconds_bucket{le="0.002",service="echo"} 5.0
rse_pf_duration_seconds_bucket{le="+Inf",service="echo"} 5.0
rse_pf_duration_seconds_sum{service="pnp"} 1.0
"""


def test_all_services_are_added_up() -> None:
    assert buckets_of(PAGE) == {0.001: 15.0, 0.002: 35.0, math.inf: 45.0}
    assert buckets_of("nothing") == {}


def test_a_percentile_is_interpolated_within_its_bucket() -> None:
    buckets = {0.001: 50.0, 0.002: 100.0, math.inf: 100.0}

    assert percentile(buckets, 0.5) == pytest.approx(0.001)
    assert percentile(buckets, 0.75) == pytest.approx(0.0015)
    assert percentile({0.001: 0.0, math.inf: 10.0}, 0.99) == 0.001
    assert percentile({}, 0.5) is None


def test_only_the_last_minute_counts() -> None:
    minute = LastMinute()
    minute.add("server-1", {0.001: 100.0, math.inf: 100.0}, now_s=0.0)
    for second in range(5, 100, 5):
        minute.add("server-1", {0.001: 100.0, 0.002: 100.0 + second, math.inf: 100.0 + second}, now_s=second)

    told = minute.document(now_s=95.0, servers=["server-1"])

    assert told["count"] == 60
    assert told["covered_s"] == 60.0
    assert told["p50_ms"] == pytest.approx(1.5)


def test_a_server_that_restarted_or_left_is_not_counted_backwards() -> None:
    minute = LastMinute()
    minute.add("server-1", {0.001: 500.0, math.inf: 500.0}, now_s=0.0)
    minute.add("server-1", {0.001: 3.0, math.inf: 3.0}, now_s=5.0)
    minute.add("server-1", {0.001: 7.0, math.inf: 7.0}, now_s=10.0)
    minute.add("server-2", {0.001: 900.0, math.inf: 900.0}, now_s=10.0)

    assert minute.document(now_s=10.0, servers=["server-1"])["count"] == 4
