"""Figures of an elasticity run: counts, replacements, and the check of every scale-out."""

from __future__ import annotations

import pytest

from rse_pf.extensions.experiments.paper.elasticity import (
    CpuCost,
    crashes,
    elasticity_figures,
)
from rse_pf.extensions.experiments.results.records import Records

ASKED = {
    "time": 0.0, "action": "experiment", "kind": "elasticity", "min_servers": 2, "period_s": 2.0,
    "busy_periods": 2, "busy_cpu_percent": 70.0, "origin_s": 1000.0,
}  # fmt: skip


def event(time_s, action, **details):
    return {"time": time_s, "action": action, **details}


def run(events):
    return Records(commands=[], events=[ASKED, *events], samples=[])


def test_two_crashes_need_two_replacements():
    events = [
        event(10.0, "server-gone", server="server-1", pid=11),
        event(10.0, "server-gone", server="server-2", pid=12),
        event(10.1, "server-launched", server="server-3"),
        event(12.0, "server-healthy", server="server-3"),
    ]

    assert [each["replaced_in_s"] for each in crashes(events)] == [2.0, None]
    assert elasticity_figures(run(events))["replaced_in_s"] is None


def test_the_emulated_cores_make_all_robots_need_five_servers_at_the_limit():
    cost = CpuCost(command_s=0.002, idle_s_per_s=0.01, commands=400)

    size = cost.emulated_cores(commands_per_s=500.0, busy_percent=70.0)

    cpu_percent_of_five = 100.0 * (500.0 * 0.002 + 5 * 0.01) / (5 * size)
    assert cpu_percent_of_five == pytest.approx(70.0, abs=0.05)
