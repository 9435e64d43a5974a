"""The robustness experiment: the faults of the paper's Sect. 6.2, each on a platform of its own.

Every fault is a real one (a signal, a cut link) under a load of real PnP problems.  The records of each run
stay in a folder of their own, and the report says for each target whether the run met it.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.harness import Harness, generator_of
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.paper.control_plane_fault import run_control_plane_fault
from rse_pf.extensions.experiments.paper.elasticity import crashes, slowest_replacement_s
from rse_pf.extensions.experiments.paper.fault_scenarios import SCENARIOS
from rse_pf.extensions.experiments.plots.figures import draw_robustness, require_matplotlib
from rse_pf.extensions.experiments.results.bars import bars_blocks, missed_bars, with_bars
from rse_pf.extensions.experiments.results.markdown import about_run, failures, number, page, slashed, table
from rse_pf.extensions.experiments.results.records import (
    CommandRecord,
    Event,
    Records,
    parameters_of,
    read_records,
)
from rse_pf.extensions.experiments.results.rerun import RERUN, rerun_plan
from rse_pf.extensions.experiments.results.result_folder import (
    RUN_FILES,
    finish_report,
    fresh_folder,
    load_average,
)
from rse_pf.extensions.experiments.results.summary import (
    PAPER,
    outage_figures,
    percent_answered,
    percentiles,
    robots_on,
    summary_of,
)
from rse_pf.local.control.monitor import MonitorSample
from rse_pf.terminal import show

__all__ = [
    "BARS",
    "RobustnessOptions",
    "robustness_figures",
    "robustness_page",
    "run_robustness",
    "time_until_even_s",
]

# Name of the file, in the folder ``out``, with the image of the robustness experiment.
FIGURE = "robustness.png"
# Seconds under load before the fault.
_BEFORE_FAULT_S = 4.0
# Longest wait until all robots have joined, in seconds.
_JOIN_TIMEOUT_S = 60.0
# Name of the link profile, one without delay, for faults that cut the link.
_NO_DELAY = "none"
# Faults of the short run with which ``verify --rerun`` checks this experiment.
_SHORT_FAULTS = ("kill", "wifi")
# Number of robots of the short run with which ``verify --rerun`` checks this experiment.
_SHORT_ROBOTS = "20"


@dataclass(frozen=True, slots=True, kw_only=True)
class RobustnessOptions:
    """Options of the experiment; ``speed`` divides the duration of the faults and nothing else."""

    out: Path
    robots: int = 100
    fps: float = 5.0
    speed: float = 1.0
    codec: str = "zlib"
    only: tuple[str, ...] = ()
    repeat: int = 1
    seed: int = 0


def run_robustness(options: RobustnessOptions, settings: PlatformSettings) -> int:
    """Run the faults, write records, report and figure to ``options.out``, and print a line for each run.

    Return 1 if a command was lost or answered twice, else 0.
    """
    require_matplotlib()
    # One server must be able to serve the robots of another one: give it a worker for each of two cores.
    settings = settings.replace(
        serving={"workers": max(settings.serving.workers, min(2, os.cpu_count() or 1))}
    )
    folder = fresh_folder(
        options.out, [*RUN_FILES, FIGURE, *SCENARIOS, *(f"{name}-[1-9]*" for name in SCENARIOS)]
    )
    load_before = load_average()
    runs: dict[str, dict[str, Any]] = {}
    for scenario in options.only or [name for name, fault in SCENARIOS.items() if not fault.slow]:
        for repetition in range(options.repeat):
            name = scenario if options.repeat == 1 else f"{scenario}-{repetition + 1}"
            (folder / name).mkdir()
            asyncio.run(_run(options, settings, folder / name, scenario, options.seed + len(runs)))
            runs[name] = robustness_figures(read_records(folder / name))
            show(_line(name, runs[name]))
    records = {name: read_records(folder / name) for name in runs}
    report = {
        "experiment": "robustness",
        "asked": {**asdict(options), "out": options.out.name},
        "runs": runs,
        "generator": {name: generator_of(record) for name, record in records.items()},
        "paper": PAPER,
        RERUN: _rerun_plan(options.only or tuple(SCENARIOS)),
    }
    finish_report(folder, report, robustness_page, settings, load_before)
    draw_robustness(folder / FIGURE, records, runs)
    show(f"wrote {FIGURE}, report.json, report.md and the raw records to {options.out}")
    return int(any(run["commands"]["lost"] or run["commands"]["twice"] for run in runs.values()))


def _rerun_plan(faults: Sequence[str]) -> dict[str, Any]:
    """Return the plan of a short run: "kill" and "wifi" if among *faults*, else the first, with 20 robots."""
    short = [name for name in _SHORT_FAULTS if name in faults] or [faults[0]]
    bars = {f"{name}/{figure}": bar for name in short for figure, bar in BARS.get(name, _NO_LOSS).items()}
    return rerun_plan(["--robots", _SHORT_ROBOTS, "--only", ",".join(short)], bars)


async def _run(
    options: RobustnessOptions, settings: PlatformSettings, folder: Path, name: str, seed: int
) -> None:
    scenario, session = SCENARIOS[name], settings.session
    seconds = scenario.seconds / options.speed
    if scenario.needs_link:  # a cut must be longer than the time in which robots detect a lost connection
        seconds = max(seconds, 2 * (session.ping_interval_s + session.ping_timeout_s))
    parameters = {
        "kind": "robustness",
        "scenario": name,
        "robots": options.robots,
        "fps": options.fps,
        "seconds": seconds,
        "deadline_s": session.answer_timeout_s,
        "seed": seed,
    }
    robots = LoadScenario(
        robots=options.robots,
        fps=options.fps,
        codec=options.codec,
        seed=options.seed,
        deadline_s=session.answer_timeout_s,
        link=_NO_DELAY if scenario.needs_link else None,
    )
    if scenario.inject is None:
        await run_control_plane_fault(folder, settings, parameters, robots, seconds)
        return
    async with (
        Harness(folder, settings, parameters, servers=scenario.servers) as harness,
        harness.swarm(robots) as swarm,
    ):
        harness.link = swarm.link
        await swarm.start()
        await swarm.wait_joined(_JOIN_TIMEOUT_S)
        harness.log("joined")
        await harness.run_for(_BEFORE_FAULT_S)
        await scenario.inject(harness, seconds, seed)
        await harness.save_result(await swarm.finish())


def _line(name: str, run: Mapping[str, Any]) -> str:
    commands, outage, missed = run["commands"], run["gap_s"], missed_bars(run)
    return (
        f"{name:<15} {commands['sent']} commands, {commands['lost']} lost, {commands['twice']} twice, "
        f"{commands['failed']} failed; outage p50 {outage['p50']} s, p99 {outage['p99']} s; "
        + (f"missed targets: {', '.join(missed)}" if missed else "all targets met")
    )


# Targets of every scenario: no command is lost or answered twice.
_NO_LOSS = {"commands/lost": (0, "<="), "commands/twice": (0, "<=")}
# Targets of scenarios during which no command may be lost, answered twice or fail.
_NO_FAILURE = {**_NO_LOSS, "commands/failed": (0, "<=")}

BARS: dict[str, dict[str, tuple[float, str]]] = {
    "kill": {
        **_NO_FAILURE,
        "gap_s/p99": (1.0, "<="),
        "out_of_rotation_s": (1.5, "<="),
        "replaced_in_s": (5.0, "<="),
    },
    "stop": {**_NO_FAILURE, "gap_s/p99": (2.0, "<="), "replaced_in_s": (10.0, "<=")},
    "balancer": {**_NO_FAILURE, "gap_s/p99": (2.0, "<=")},
    "control-plane": {**_NO_FAILURE, "not_adopted": (0, "<="), "adopted": (1, ">=")},
    "wifi": {
        **_NO_LOSS,
        "noticed_s/max": (6.0, "<="),
        "server_noticed_s": (6.0, "<="),
        "first_answer_after_heal_s/p99": (2.0, "<="),
        "stale_as_fresh": (0, "<="),
    },
    "scale-in": {**_NO_FAILURE, "gap_s/p99": (0.5, "<="), "drains": (1, ">=")},
    "roll": {**_NO_FAILURE, "gap_s/p99": (0.5, "<="), "drains": (2, ">=")},
    "scale-out": {**_NO_LOSS, "answered_percent": (99.9, ">="), "evened_out_s": (15.0, "<=")},
    "random": {
        **_NO_LOSS,
        "answered_within_1_s_percent": (99.0, ">="),
        "memory_percent": (5.0, "<="),
        "descriptors_percent": (5.0, "<="),
    },
}
"""The targets of each scenario: limit and comparison that must hold, by the path of the figure."""

# Largest deviation of a server's robots from the mean of all servers that counts as even, as a ratio.
_MAX_EVEN_DEVIATION = 0.2
# Time between the decision of the SDK to deliver an answer and the time stamp in the record, in seconds.
_DELIVERY_DELAY_S = 0.05


def robustness_figures(records: Records) -> dict[str, Any]:
    """Return the figures of the run of one fault, and for each target whether it was met (``held``).

    Raises:
        UsageError: The events do not hold the parameters of the run.
    """
    scenario = str(parameters_of(records)["scenario"])
    summary = summary_of(records)
    faults = [event for event in records.events if event["action"] == "fault"]
    crash_rows = crashes(records.events)
    figures: dict[str, Any] = {
        "scenario": scenario,
        "commands": summary["commands"],
        "failures_by_code": summary["failures_by_code"],
        "wrong_poses": summary["wrong_poses"],
        "answered_percent": percent_answered(records.commands),
        "answered_within_1_s_percent": percent_answered(records.commands, 1000.0),
        "round_trip_ms": summary["round_trip_ms"],
        "gap_s": _outages(records, faults),
        "out_of_rotation_s": _out_of_rotation_s(records.events, faults),
        "crashes": len(crash_rows),
        "replaced_in_s": slowest_replacement_s(crash_rows),
        "drains": sum(event["action"] == "drain-over" for event in records.events),
        "balancer_back_s": _after(records.events, "balancer-gone", "balancer-back"),
        **_scenario_figures(scenario, records, faults),
    }
    bars = BARS.get(scenario, _NO_LOSS)
    return with_bars(figures, bars)


def robustness_page(report: Mapping[str, Any]) -> str:
    """Return the text of ``report.md``: a table of figures, and each target with whether it was met."""
    runs: Mapping[str, Mapping[str, Any]] = report["runs"]
    rows = [
        [
            name,
            *(run["commands"][count] for count in ("sent", "lost", "twice")),
            failures(run),
            slashed(run["gap_s"], "p50", "p99"),
            number(run["out_of_rotation_s"]),
            number(run["replaced_in_s"]),
            _other_figures(run),
        ]
        for name, run in runs.items()
    ]
    met, bars = bars_blocks(runs)
    head = (
        "fault, sent, lost, twice, failed, outage p50 / p99 s, out of rotation s, replaced s, other figures"
    )
    return page(
        "# RSE-PF experiment: robustness",
        f"{report['asked']['robots']} robots x {report['asked']['fps']:g} fps, real PnP problems; {met}",
        table(head.split(", "), rows),
        bars,
        "Outage: the longest time between two answers, of the robots on the affected server (of all "
        "robots where the fault affects all). At 5 fps it is 0.2 s without any fault.",
        about_run(report),
    )


def time_until_even_s(samples: Sequence[MonitorSample], since_s: float) -> float | None:
    """Return the seconds from *since_s* until the robots were evenly distributed over the healthy servers.

    Even means that the number of robots of each server is within 20 % of the mean, or within one robot of it,
    until the end of the samples.  The result is None if that was never reached.
    """
    reached = None
    for sample in samples:
        if sample.time < since_s:
            continue
        counts = [server.robots for server in sample.servers if server.state == "healthy"]
        if not sum(counts):
            continue  # no robot is connected any more
        mean = sum(counts) / len(counts)
        # A server has a whole number of robots: a deviation of one is always accepted.
        even = all(abs(count - mean) <= max(_MAX_EVEN_DEVIATION * mean, 1.0) for count in counts)
        if not even:
            reached = None
        elif reached is None:
            reached = round(sample.time - since_s, 3)
    return reached


def _other_figures(run: Mapping[str, Any]) -> str:
    names = (
        "adopted", "not_adopted", "balancer_back_s", "evened_out_s", "stale_as_fresh", "server_noticed_s",
        "memory_percent", "descriptors_percent",
    )  # fmt: skip
    shown = [f"{name} {run[name]}" for name in names if run.get(name) is not None]
    if "noticed_s" in run:
        shown.append(f"noticed by robots after at most {number(run['noticed_s']['max'])} s")
        shown.append(f"first answer after the heal p99 {number(run['first_answer_after_heal_s']['p99'])} s")
    return ", ".join(shown)


def _scenario_figures(scenario: str, records: Records, faults: Sequence[Event]) -> dict[str, Any]:
    if scenario == "control-plane":
        return _adoption(records.events)
    if scenario == "wifi":
        return _measure_cut(records, faults)
    if scenario == "scale-out":
        new = [event for event in records.events if event["action"] == "server-healthy"]
        since = [float(event["time"]) for event in new if faults and event["time"] >= faults[0]["time"]]
        return {"evened_out_s": time_until_even_s(records.samples, since[-1]) if since else None}
    if scenario == "random":
        return _growth(records.events)
    return {}


def _outages(records: Records, faults: Sequence[Event]) -> dict[str, Any]:
    """Return how many robots *faults* affected, and p50, p99 and maximum of their longest outages (s).

    A fault of a server affects the robots connected to that server, every other fault affects all robots.
    """
    if not faults:
        return {"robots": 0, "p50": None, "p99": None, "max": None}
    everyone = {command.robot for command in records.commands}
    hit: set[str] = set()
    for fault in faults:
        server = fault.get("server")
        hit |= everyone if server is None else robots_on(records.commands, str(server), float(fault["time"]))
    start_s, end_s = float(faults[0]["time"]), float(faults[-1]["time"]) + float(faults[-1]["watch_s"])
    return outage_figures(records.commands, hit, start_s=start_s, end_s=end_s)


def _out_of_rotation_s(events: Sequence[Event], faults: Sequence[Event]) -> float | None:
    """Return the longest time (s) from a fault of a server until the load balancer took it out of rotation.

    None if no fault had a server, or if a server stayed in rotation.
    """
    times = []
    for fault in faults:
        if fault.get("server") is None:
            continue
        out = [
            float(event["time"]) - float(fault["time"])
            for event in events
            if event["action"] == "server-out"
            and event["server"] == fault["server"]
            and event["time"] >= fault["time"]
        ]
        if not out:
            return None
        times.append(out[0])
    return round(max(times), 3) if times else None


def _adoption(events: Sequence[Event]) -> dict[str, Any]:
    """Return how many processes ran before and after the fault, how many only before, and its length (s)."""
    ran: dict[str, set[int]] = {"before": set(), "after": set()}
    for event in events:
        if event["action"] == "processes":
            ran[str(event["when"])] = set(event["pids"])
    return {
        "adopted": len(ran["before"] & ran["after"]),
        "not_adopted": len(ran["before"] - ran["after"]),
        "control_plane_down_s": _after(events, "fault", "control-plane-back"),
    }


def _measure_cut(records: Records, faults: Sequence[Event]) -> dict[str, Any]:
    """Return the figures of a cut link, in seconds.

    The figures are the times until robots and servers noticed the cut, and the times from its end to the
    first answer of each robot.  ``stale_as_fresh`` counts answers that were delivered after their deadline.
    """
    healed = [float(event["time"]) for event in records.events if event["action"] == "healed"]
    noticed: dict[str, float] = {}
    for event in records.events:
        if event["action"] == "link-lost" and faults and event["time"] >= faults[0]["time"]:
            noticed.setdefault(str(event["robot"]), float(event["time"]) - float(faults[0]["time"]))
    first = _first_answers(records.commands, healed[0]) if healed else []
    deadline_s = float(parameters_of(records)["deadline_s"]) + _DELIVERY_DELAY_S
    stale = sum(
        command.code == "ok" and command.answered is not None and command.answered - command.sent > deadline_s
        for command in records.commands
    )
    return {
        "noticed_s": _spread(list(noticed.values())),
        "server_noticed_s": _after(records.events, "fault", "servers-empty")
        or _time_until_empty_s(records.samples, faults),
        "first_answer_after_heal_s": _spread(first),
        "stale_as_fresh": stale,
    }


def _spread(values: Sequence[float]) -> dict[str, Any]:
    figures = percentiles(values)
    return {name: figures[name] for name in ("n", "p50", "p99", "max")}


def _time_until_empty_s(samples: Sequence[MonitorSample], faults: Sequence[Event]) -> float | None:
    """Return the seconds from the first fault until no server had a robot; None if that never happened."""
    for sample in samples:
        after = bool(faults) and sample.time >= faults[0]["time"]
        if after and sample.servers and not any(server.robots for server in sample.servers):
            return round(sample.time - float(faults[0]["time"]), 3)
    return None


def _first_answers(commands: Sequence[CommandRecord], healed_s: float) -> list[float]:
    first: dict[str, float] = {}
    for command in commands:
        if command.code == "ok" and command.answered is not None and command.answered >= healed_s:
            after = command.answered - healed_s
            first[command.robot] = min(first.get(command.robot, after), after)
    return list(first.values())


def _growth(events: Sequence[Event]) -> dict[str, Any]:
    """Return the growth of memory and of file descriptors per process during the run, in percent.

    Both are None if the event ``resources`` is missing before or after the faults.
    """
    seen = {str(event["when"]): event for event in events if event["action"] == "resources"}
    if not {"before", "after"} <= set(seen):
        return {"memory_percent": None, "descriptors_percent": None}
    before, after = seen["before"], seen["after"]

    def grown(name: str) -> float:
        then = float(before[name]) / float(before["processes"])
        return round(100.0 * (float(after[name]) / float(after["processes"]) - then) / then, 2)

    return {"memory_percent": grown("memory_bytes"), "descriptors_percent": grown("descriptors")}


def _after(events: Sequence[Event], first: str, then: str) -> float | None:
    """Return the longest time (s) from an event *first* to the next event *then*.

    None if there is no such pair, or if the last *first* is not followed by a *then*.
    """
    waits, began = [], None
    for event in events:
        if event["action"] == first and began is None:
            began = float(event["time"])
        elif event["action"] == then and began is not None:
            waits.append(float(event["time"]) - began)
            began = None
    return round(max(waits), 3) if waits and began is None else None
