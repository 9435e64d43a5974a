"""Percentiles of the last minute come from histograms that count since the start of each server."""

from __future__ import annotations

import math

from rse_pf.extensions.fleet_page.feeds.percentiles import LastMinute


def test_a_server_that_restarted_or_left_is_not_counted_backwards() -> None:
    minute = LastMinute()
    minute.add("server-1", {0.001: 500.0, math.inf: 500.0}, now_s=0.0)
    minute.add("server-1", {0.001: 3.0, math.inf: 3.0}, now_s=5.0)
    minute.add("server-1", {0.001: 7.0, math.inf: 7.0}, now_s=10.0)
    minute.add("server-2", {0.001: 900.0, math.inf: 900.0}, now_s=10.0)

    assert minute.document(now_s=10.0, servers=["server-1"])["count"] == 4
