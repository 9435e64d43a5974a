"""Figures of an elasticity run: counts, replacements, and the check of every scale-out."""

from __future__ import annotations

import pytest

from rse_pf.errors import UsageError
from rse_pf.experiments.paper.elasticity import (
    CpuCost,
    crashes,
    elasticity_figures,
    find_unjustified_scale_outs,
)
from rse_pf.experiments.results.records import Records, run_sample
from rse_pf.local.control.monitor import ServerSample

ASKED = {
    "time": 0.0, "action": "experiment", "kind": "elasticity", "min_servers": 2, "period_s": 2.0,
    "busy_periods": 2, "busy_cpu_percent": 70.0, "origin_s": 1000.0,
}  # fmt: skip


def reading(time_s, *cpu_percents, healthy=None, warming=()):
    servers = tuple(
        ServerSample(
            name=f"server-{n + 1}",
            pid=100 + n,
            state="healthy",
            robots=10,
            cpu_percent=cpu,
            warming=n in warming,
        )
        for n, cpu in enumerate(cpu_percents)
    )
    return run_sample(
        time_s=time_s, healthy_servers=len(servers) if healthy is None else healthy, servers=servers
    )


def event(time_s, action, **details):
    return {"time": time_s, "action": action, **details}


def grow(time_s, reason="CPU at 80 %"):
    return event(time_s, "grow", servers=1, reason=reason)


def run(events=(), samples=(), commands=()):
    return Records(commands=list(commands), events=[ASKED, *events], samples=list(samples))


BUSY = [reading(t / 2, 80.0, 80.0) for t in range(1, 20)]
"""80 % throughout, twice a second, from 0 to 9.5 s."""


def test_two_crashes_need_two_replacements():
    events = [
        event(10.0, "server-gone", server="server-1", pid=11),
        event(10.0, "server-gone", server="server-2", pid=12),
        event(10.1, "server-launched", server="server-3"),
        event(12.0, "server-healthy", server="server-3"),
    ]

    assert [each["replaced_in_s"] for each in crashes(events)] == [2.0, None]
    assert elasticity_figures(run(events=events))["replaced_in_s"] is None


def test_a_drained_server_did_not_crash():
    events = [event(1.0, "drain-start", server="server-1"), event(2.0, "server-gone", server="server-1")]

    assert elasticity_figures(run(events=events))["crashes"] == 0


def test_a_scale_out_without_enough_busy_periods_is_reported():
    calm = [reading(t / 2, 80.0 if t > 4 else 40.0) for t in range(1, 20)]

    wrong = find_unjustified_scale_outs(run(events=[grow(4.05)], samples=calm))

    assert wrong == ["at 4.05 s: 40.0 %, 80.0 % before it, 70 % is required"]


def test_a_scale_out_without_samples_is_reported():
    assert "none" in find_unjustified_scale_outs(run(events=[grow(30.0)], samples=BUSY))[0]


def test_a_run_without_parameters_is_refused():
    with pytest.raises(UsageError, match="which experiment"):
        elasticity_figures(Records(commands=[], events=[], samples=[]))


def test_the_emulated_cores_make_all_robots_need_five_servers_at_the_limit():
    cost = CpuCost(command_s=0.002, idle_s_per_s=0.01, commands=400)

    size = cost.emulated_cores(commands_per_s=500.0, busy_percent=70.0)

    cpu_percent_of_five = 100.0 * (500.0 * 0.002 + 5 * 0.01) / (5 * size)
    assert cpu_percent_of_five == pytest.approx(70.0, abs=0.05)


def test_counts_scale_outs_for_load_but_not_replacements():
    judged = elasticity_figures(
        run(
            events=[
                grow(4.0), grow(5.0, "fewer than scaling.min_servers"), event(9.0, "shrink", servers=1),
                event(9.1, "shrink", servers=1),
            ],
            samples=[reading(1.0, 10, 10), reading(5.0, 10, 10, 10, 10), reading(9.9, 1, 1)],
        )
    )  # fmt: skip

    assert (judged["scale_outs"], judged["scale_ins"]) == (1, 2)
    assert (judged["min_servers"], judged["max_servers"], judged["final_servers"]) == (2, 4, 2)
    assert judged["healthy_servers_series"] == [[1.0, 2], [5.0, 4], [9.9, 2]]
    assert judged["cpu_percent_series"] == [[1.0, 10.0], [5.0, 10.0], [9.9, 1.0]]


def test_the_mean_cpu_excludes_servers_that_warm_up_or_did_not_answer():
    assert reading(1.0, 80.0, 10.0, None, warming=(1,)).cpu_percent == 80.0
    assert reading(1.0, None).cpu_percent is None


def test_a_crash_is_replaced_by_the_next_server_that_was_launched_after_it():
    events = [
        event(1.0, "server-launched", server="server-3"),
        event(9.9, "fault", fault="kill", server="server-1", pid=11),
        event(10.0, "server-gone", server="server-1", pid=11, exit_code=-9),
        event(10.1, "server-launched", server="server-4"),
        event(11.0, "server-healthy", server="server-3"),
        event(12.4, "server-healthy", server="server-4"),
    ]

    found = crashes(events)

    assert found == [{"server": "server-1", "pid": 11, "time": 9.9, "by": "server-4", "replaced_in_s": 2.5}]
