"""Figures are drawn from complete and empty records; a missing extra is named before a run."""

from __future__ import annotations

import math
import sys

import pytest

from rse_pf.errors import MissingExtra
from rse_pf.extensions.experiments.plots.figures import (
    draw_elasticity,
    require_matplotlib,
)
from rse_pf.extensions.experiments.results.records import CommandRecord, Records, run_sample
from rse_pf.local.control.monitor import ServerSample

PNG = b"\x89PNG\r\n\x1a\n"
ASKED = {
    "time": 0.0, "action": "experiment", "kind": "elasticity", "scenario": "kill", "robots": 9, "fps": 5.0,
    "speed": 30.0, "join_every_s": 0.667, "min_servers": 2, "period_s": 2.0, "busy_periods": 2,
    "busy_cpu_percent": 70.0, "origin_s": 0.0, "deadline_s": 5.0,
}  # fmt: skip


def fleet(seconds=60):
    """A fleet that grows, loses a server and shrinks again; shaped like a run, measured nowhere."""
    events = [
        ASKED,
        {"time": 0.0, "action": "phase", "phase": "joining"},
        {"time": 12.0, "action": "grow", "servers": 1, "reason": "CPU at 80 %"},
        {"time": 30.0, "action": "fault", "fault": "kill -9", "server": "server-1", "watch_s": 6.0},
        {"time": 45.0, "action": "phase", "phase": "leaving"},
        {"time": 55.0, "action": "shrink", "servers": 1, "reason": "idle"},
    ]
    readings = []
    for step in range(seconds):
        servers = 2 if step < 14 or step > 56 else 3
        load = min(step, 20) * 10 if step < 45 else 1
        readings.append(
            run_sample(time_s=float(step), healthy_servers=servers - (30 <= step < 33),
                servers=tuple(
                    ServerSample(
                        name=f"server-{n + 1}", pid=n, state="healthy", robots=9 // servers,
                        cpu_percent=load / servers + 6 * math.sin(step + n),
                    )
                    for n in range(servers)
                ),
            )
        )  # fmt: skip
    commands = []
    for number in range(45 * 45):
        planned = number / 45
        slow = 400.0 if 30 < planned < 31 else 12 + 3 * math.sin(number)
        code = "busy" if 11 < planned < 13 and number % 7 == 0 else "ok"
        commands.append(
            CommandRecord(
                id=number, robot=f"robot-{number % 9}", planned=planned, sent=planned,
                answered=planned + slow / 1000, server="server-1", code=code, round_trip_ms=slow,
                up_ms=2.0, queue_ms=1.0, compute_ms=slow - 6, down_ms=2.0,
            )
        )  # fmt: skip
    return Records(commands=commands, events=events, samples=readings)


EMPTY = Records(commands=[], events=[ASKED], samples=[])


def is_drawn(path):
    return path.read_bytes().startswith(PNG) and path.stat().st_size > 10_000


@pytest.mark.parametrize(
    "runs", [{"with rebalancing": fleet()}, {"with": fleet(), "without": fleet()}, {"": EMPTY}]
)
def test_draws_elasticity_of_one_run_two_runs_and_an_empty_one(tmp_path, runs):
    draw_elasticity(tmp_path / "fig8.png", runs)

    assert is_drawn(tmp_path / "fig8.png")


def test_a_missing_extra_is_named_before_anything_runs(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtra, match="matplotlib is not installed"):
        require_matplotlib()
