"""Figures of a fault: the affected robots, their outages, and the missed targets."""

from __future__ import annotations

import pytest

from rse_pf.extensions.experiments.paper.robustness import robustness_figures
from rse_pf.extensions.experiments.results.bars import bars_blocks
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


def test_the_page_counts_and_names_the_targets_that_were_missed():
    runs = {
        "kill": robustness_figures(run("kill", KILL, [*HIT, *OTHER])),
        "kill-2": robustness_figures(run("kill", KILL, [*HIT, *OTHER, unanswered(None, "")])),
    }

    count, table = bars_blocks(runs)

    assert count == "11 of 12 targets met."
    assert [line for line in table if "missed" in line] == [
        "| kill-2 | commands/lost | 1 | <= 0 | **missed** |"
    ]
