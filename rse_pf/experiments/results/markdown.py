"""The experiments' reports as Markdown: ours beside the paper's numbers, misses as plainly as hits.

Promises to format only: every figure comes from a report that the raw records can give again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

__all__ = ["elasticity_markdown", "latency_markdown", "map_markdown", "robustness_markdown"]

Report = Mapping[str, Any]


def elasticity_markdown(report: Report, runs: Mapping[str, Report]) -> str:
    """Return ``report.md`` of an elasticity run, a column for each run."""
    asked = report["asked"]
    cost = report.get("cost")
    columns = [name or "here" for name in runs]
    rows: list[tuple[str, list[Any]]] = []

    def row(what: str, value: Any) -> None:
        rows.append((what, [value(run) for run in runs.values()]))

    row("scale-outs / scale-ins", lambda run: f"{run['scale_outs']} / {run['scale_ins']}")
    row(
        "servers: min / most seen / at the end",
        lambda run: _slashed(run, "min_servers", "max_servers", "final_servers"),
    )
    row("crashes (kill -9)", lambda run: run["crashes"])
    row("replacement serving after, s", lambda run: _dash(run["replaced_in_s"]))
    row("commands sent / answered", lambda run: _slashed(run["commands"], "sent", "answered"))
    row("failed, by code", lambda run: f"{run['commands']['failed']} {_codes(run)}".strip())
    row("lost / answered twice", lambda run: _slashed(run["commands"], "lost", "twice"))
    row("round trip p50 / p95 / p99 ms", lambda run: _three(run["round_trip_ms"]))
    for phase in ("joining", "full", "crash"):
        row(
            f"  while {phase}: p50 / p95 / p99 ms",
            lambda run, phase=phase: _three(run["phases"].get(phase, {}).get("round_trip_ms", {})),
        )
    lines = [
        "# RSE-PF experiment: elasticity (the paper's Fig. 8)",
        "",
        f"{asked['robots']} robots x {asked['fps']:g} fps; time compressed {asked['speed']:g}x "
        "(joining interval, the policy's periods, idle time and warm-up; nothing else).",
        "",
        f"Server size {report['size']:g} cores"
        + (
            f", chosen because one command costs {1000 * cost['command_s']:.2f} ms of CPU."
            if cost
            else ", as asked for."
        ),
        "",
        *_table(["what", *columns], [[what, *values] for what, values in rows]),
        "",
        "The paper: a robot every 20 s up to a hundred, out above 70 % CPU, in after 5 min idle, one crash; "
        "no figure for p99, recovery or loss.",
        "",
        _around(report),
        "",
    ]
    return "\n".join(lines)


def latency_markdown(report: Report) -> str:
    """Return ``report.md`` of a latency run."""
    paper, trip = report["paper"], report["round_trip_ms"]
    link = report["asked"]["link"]
    transmission = paper["round_trip_ms"] - paper["compute_ms"]
    rows = [
        ["round trip, mean ms", _dash(trip["mean"]), f"{paper['round_trip_ms']} (abstract: 153)"],
        ["round trip p50 / p95 / p99 ms", _three(trip), "not given"],
        ["up, mean ms", _dash(report["up_ms"]["mean"]), f"up and down: {transmission:.2f} (near 130)"],
        ["queue, mean ms", _dash(report["queue_ms"]["mean"]), "not given"],
        ["compute, mean ms", _dash(report["compute_ms"]["mean"]), paper["compute_ms"]],
        ["down, mean ms", _dash(report["down_ms"]["mean"]), ""],
        ["the robot's own, mean ms", _dash(report["rest_ms_mean"]), ""],
        ["round trip p50 minus the link's delay, ms", _dash(report["over_the_link_ms_p50"]), ""],
        ["answered within 150 ms, %", _dash(report["answered_within_150_ms_percent"]), ""],
        [
            "frames per second, mean / least robot",
            _slashed(report["fps_per_robot"], "mean", "least"),
            "near 5",
        ],
        ["lost / failed", f"{report['commands']['lost']} / {report['commands']['failed']}", "not given"],
    ]
    lines = [
        "# RSE-PF experiment: latency (the paper's Sect. 6.2)",
        "",
        f"{report['asked']['robots']} robots x {report['asked']['fps']:g} fps, "
        + (f"link profile `{link}`." if link else "no link between robots and platform."),
        "",
        *_table(["what", "here", "the paper"], rows),
        "",
        "The paper gives two means: 153 ms in the abstract and the conclusion, 156.36 ms in Sect. 6.2.",
        "",
        _around(report),
        "",
    ]
    return "\n".join(lines)


def robustness_markdown(report: Report) -> str:
    """Return ``report.md`` of the faults: a table of figures, and each bar held or missed."""
    runs: Mapping[str, Report] = report["runs"]
    figures = [
        [
            name,
            run["commands"]["sent"],
            run["commands"]["lost"],
            run["commands"]["twice"],
            f"{run['commands']['failed']} {_codes(run)}".strip(),
            f"{_dash(run['gap_s']['p50'])} / {_dash(run['gap_s']['p99'])}",
            _dash(run["out_of_rotation_s"]),
            _dash(run["replaced_in_s"]),
            _others(run),
        ]
        for name, run in runs.items()
    ]
    bars = [
        [name, what, _dash(bar["value"]), bar["bar"], "held" if bar["held"] else "**missed**"]
        for name, run in runs.items()
        for what, bar in run["bars"].items()
    ]
    held = sum(row[-1] == "held" for row in bars)
    head = [
        "fault",
        "sent",
        "lost",
        "twice",
        "failed",
        "gap p50 / p99 s",
        "out after s",
        "replaced after s",
        "also",
    ]
    lines = [
        "# RSE-PF experiment: robustness",
        "",
        f"{report['asked']['robots']} robots x {report['asked']['fps']:g} fps, real PnP, balanced; "
        f"{held} of {len(bars)} bars held.",
        "",
        *_table(head, figures),
        "",
        *_table(["fault", "figure", "measured", "bar", ""], bars),
        "",
        "Gap: the longest silence between two answers, of the robots on the server that was hit (of all "
        "robots where the fault hits all). At 5 fps it is 0.2 s without any fault.",
        "",
        _around(report),
        "",
    ]
    return "\n".join(lines)


def map_markdown(report: Report) -> str:
    """Return ``report.md`` of a mapping run."""
    names = ("frames", "lost_frames", "fps_per_robot", "path_m", "ate_cm", "rpe_cm", "rpe_deg", "map_points")
    robots = range(len(report["frames"]))
    rows = [[f"robot-{n + 1}", *(_dash(report[name][n]) for name in names)] for n in robots]
    lines = [
        "# RSE-PF experiment: map (the paper's Fig. 7)",
        "",
        *_table(["robot", *names], rows),
        "",
        f"Round trip p50 / p95 / p99: {_three(report['round_trip_ms'])} ms; {report['commands']['sent']} "
        f"commands, {report['commands']['lost']} lost. The paper shows one robot's cloud, near 5 fps, and "
        "measures no error.",
        "",
        _around(report),
        "",
    ]
    return "\n".join(lines)


def _others(run: Report) -> str:
    names = (
        "adopted", "not_adopted", "balancer_back_s", "evened_out_s", "stale_as_fresh", "server_noticed_s",
        "memory_percent", "descriptors_percent",
    )  # fmt: skip
    told = [f"{name} {run[name]}" for name in names if run.get(name) is not None]
    if "noticed_s" in run:
        told.append(f"noticed by robots {_dash(run['noticed_s']['max'])} s")
        told.append(f"first answer after heal p99 {_dash(run['first_answer_after_heal_s']['p99'])} s")
    return ", ".join(told)


def _around(report: Report) -> str:
    around = report["environment"]
    generator = report.get("generator") or {}
    told = "".join(
        f" Generator ({name or 'run'}): {100 * each['cpu_s'] / max(each['wall_s'], 1e-9):.0f} % of a core, "
        f"{each['wrong_poses']} wrong poses."
        for name, each in generator.items()
    )
    versions = ", ".join(f"{name} {value}" for name, value in around["versions"].items())
    return (
        f"Load average before {around['load_average']}, after {around['load_average_after']}; "
        f"{around['cores']} cores, {around['system']}, Python {around['python']}; {versions}; settings "
        f"{around['settings_digest']}.{told}"
    )


def _table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    return [
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(str(value) for value in row) + " |" for row in rows),
    ]


def _three(values: Mapping[str, Any]) -> str:
    return " / ".join(_dash(values.get(name)) for name in ("p50", "p95", "p99"))


def _slashed(values: Mapping[str, Any], *names: str) -> str:
    return " / ".join(_dash(values[name]) for name in names)


def _dash(value: Any) -> str:
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _codes(run: Report) -> str:
    codes = run["failures_by_code"]
    return "(" + ", ".join(f"{code} {count}" for code, count in codes.items()) + ")" if codes else ""
