"""Figures of a fault: the affected robots, their outages, and the missed targets."""

from __future__ import annotations

import pytest

from rse_pf.extensions.experiments.paper.robustness import robustness_figures, robustness_page
from rse_pf.extensions.experiments.results.records import CommandRecord, Records


def event(time_s, action, **details):
    return {"time": time_s, "action": action, **details}


def asked(scenario, **more):
    return event(0.0, "experiment", kind="robustness", scenario=scenario, deadline_s=5.0, **more)


def steady(robot, server, start_s, end_s, *, silent=(0.0, 0.0), other=None):
    """Five answers a second, none in *silent*, after which *other* answers."""
    commands = []
    for number in range(int(start_s * 5), int(end_s * 5)):
        planned = number / 5
        answered = planned + 0.01
        by = server
        if silent[0] <= planned < silent[1]:
            answered, by = silent[1] + 0.01, other or server
        elif planned >= silent[1] > 0:
            by = other or server
        commands.append(
            CommandRecord(
                id=number, robot=robot, planned=planned, sent=planned, answered=answered, server=by,
                code="ok", round_trip_ms=1000 * (answered - planned),
            )
        )  # fmt: skip
    return commands


def run(scenario, events, commands, samples=()):
    return Records(commands=commands, events=[asked(scenario), *events], samples=list(samples))


KILL = [
    event(4.0, "fault", fault="kill -9", server="server-1", pid=11, watch_s=6.0),
    event(4.2, "server-gone", server="server-1", pid=11),
    event(4.3, "server-out", server="server-1"),
    event(4.3, "server-launched", server="server-3"),
    event(6.5, "server-healthy", server="server-3"),
]
HIT = steady("hit", "server-1", 0, 12, silent=(4.0, 4.8), other="server-2")
OTHER = steady("other", "server-2", 0, 12)


def unanswered(answered, code):
    return CommandRecord(id=999, robot="hit", planned=5, sent=5, answered=answered, server="", code=code)


@pytest.mark.parametrize(
    ("events", "commands", "missed"),
    [
        (KILL[:-1], [*HIT, *OTHER], "replaced_in_s"),
        ([e for e in KILL if e["action"] != "server-out"], [*HIT, *OTHER], "out_of_rotation_s"),
        (KILL, [*steady("hit", "server-1", 0, 12, silent=(4.0, 5.4)), *OTHER], "gap_s/p99"),
        (KILL, [*HIT, *OTHER, OTHER[0]], "commands/twice"),
        (KILL, [*HIT, *OTHER, unanswered(None, "")], "commands/lost"),
        (KILL, [*HIT, *OTHER, unanswered(10.0, "expired")], "commands/failed"),
    ],
)
def test_each_target_of_a_kill_can_be_missed(events, commands, missed):
    bars = robustness_figures(run("kill", events, commands))["bars"]

    assert [name for name, bar in bars.items() if not bar["held"]] == [missed]


def test_a_figure_that_was_not_measured_misses_its_target():
    bars = robustness_figures(run("kill", [], OTHER))["bars"]

    assert not bars["replaced_in_s"]["held"]
    assert not bars["gap_s/p99"]["held"]


@pytest.mark.parametrize(("after", "not_adopted"), [([1, 2, 3], 0), ([1, 2, 9], 1)])
def test_adoption_compares_the_processes_before_and_after(after, not_adopted):
    events = [
        event(3.0, "processes", when="before", pids=[1, 2, 3]),
        event(4.0, "fault", fault="kill -9 of the control plane", watch_s=5.0),
        event(8.0, "control-plane-back"),
        event(8.1, "processes", when="after", pids=after),
    ]

    judged = robustness_figures(run("control-plane", events, OTHER))

    assert judged["not_adopted"] == not_adopted
    assert judged["control_plane_down_s"] == pytest.approx(4.0)
    assert judged["bars"]["not_adopted"]["held"] is (not_adopted == 0)


def test_growth_of_memory_is_per_process():
    events = [
        event(1.0, "resources", when="before", memory_bytes=200, descriptors=20, processes=2),
        event(9.0, "resources", when="after", memory_bytes=330, descriptors=30, processes=3),
    ]

    judged = robustness_figures(run("random", events, OTHER))

    assert (judged["memory_percent"], judged["descriptors_percent"]) == (10.0, 0.0)
    assert not judged["bars"]["memory_percent"]["held"]
    assert judged["bars"]["descriptors_percent"]["held"]


def test_a_missed_target_is_reported_as_missed():
    counts = {"sent": 10, "answered": 9, "failed": 1, "lost": 0, "twice": 0}
    bars = {
        "gap_s/p99": {"value": 1.5, "bar": "<= 1", "held": False},
        "commands/lost": {"value": 0, "bar": "<= 0", "held": True},
    }
    run = {
        "commands": counts, "failures_by_code": {"busy": 1}, "gap_s": {"p50": 0.4, "p99": 1.5},
        "out_of_rotation_s": None, "replaced_in_s": 3.0, "bars": bars,
    }  # fmt: skip
    around = {
        "load_average": [0], "load_average_after": [0], "cores": 2, "system": "s", "python": "3",
        "versions": {}, "settings_digest": "d",
    }  # fmt: skip

    page = robustness_page({"asked": {"robots": 1, "fps": 5.0}, "runs": {"kill": run}, "environment": around})

    assert "| kill | gap_s/p99 | 1.5 | <= 1 | **missed** |" in page
    assert "| kill | commands/lost | 0 | <= 0 | met |" in page
    assert "1 of 2 targets met" in page
    assert "(busy 1)" in page
