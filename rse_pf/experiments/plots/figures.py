"""The experiments' pictures, with the paper's axes and the paper's numbers beside ours.

The only file that draws with matplotlib; each function takes records or figures and writes one PNG.
Promises no window, no font of its own, and nothing in a picture that is not in the records.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.errors import MissingExtra
from rse_pf.experiments.results.records import RecordedSample, Records, asked_of
from rse_pf.experiments.results.report import PAPER, ROUND_TRIP_PARTS, CommandRecord

__all__ = ["draw_elasticity", "draw_latency", "draw_robustness", "require_matplotlib"]

_BLUE, _ORANGE, _GREEN, _RED, _GREY = "#1f5fa8", "#d9822b", "#3a8f4d", "#c0392b", "#8a8f98"
_PARTS_COLOURS = {"up_ms": "#7aa6d6", "queue_ms": _ORANGE, "compute_ms": _GREEN, "down_ms": _BLUE}
_PARTS_NAMES = {"up_ms": "up", "queue_ms": "queue", "compute_ms": "compute", "down_ms": "down"}
_TRANSMISSION = "transmission, the paper's: not split"
_BINS = 80
_MAX_PERCENT = 170.0  # an emulated size bounds what is begun, not what is spent: peaks go beyond 100 %
_DPI = 130


def require_matplotlib() -> None:
    """Raise MissingExtra unless pictures can be drawn; asked before a run, not after it."""
    _pyplot()


def draw_elasticity(path: Path, runs: Mapping[str, Records]) -> None:
    """Draw the paper's Fig. 8 and, below it, what the robots felt; a column for each run.

    Args:
        path: The PNG.
        runs: Records of elasticity runs by caption, such as "with rebalancing".
    """
    pyplot = _pyplot()
    figure, axes = pyplot.subplots(
        3,
        len(runs),
        figsize=(9.5 * len(runs) if len(runs) == 1 else 7.0 * len(runs), 9.0),
        sharex="col",
        sharey="row",
        squeeze=False,
        layout="constrained",
        height_ratios=(1.25, 1.0, 0.8),
    )
    for column, (caption, records) in enumerate(runs.items()):
        asked = asked_of(records)
        _servers(axes[0][column], records, asked)
        _round_trips(axes[1][column], records)
        _robots(axes[2][column], records)
        axes[0][column].set_title(
            f"{caption}: {asked['robots']} robots x {asked['fps']:g} fps, a robot every "
            f"{asked['join_every_s']:.3g} s, speed {asked['speed']:g}",
            fontsize=10,
        )
        axes[2][column].set_xlabel("time, s")
    figure.suptitle("RSE-PF, elasticity (axes of the paper's Fig. 8)", fontsize=12)
    figure.savefig(path, dpi=_DPI)
    pyplot.close(figure)


def draw_latency(path: Path, figures: Mapping[str, Any], caption: str) -> None:
    """Draw the mean round trip as stacked bars, the paper's and ours, and ours as a distribution."""
    pyplot = _pyplot()
    figure, (bars, shares) = pyplot.subplots(
        1, 2, figsize=(10.5, 4.8), layout="constrained", width_ratios=(1.1, 1.0)
    )
    _stacked_bars(bars, figures)
    trip = figures["round_trip_ms"]
    names = ("p50", "p95", "p99", "max")
    values = [trip[name] or 0.0 for name in names]
    drawn = shares.barh(names[::-1], values[::-1], color=_BLUE, height=0.55)
    shares.bar_label(drawn, fmt="%.1f ms", padding=-60, fontsize=9, color="white")
    shares.axvline(PAPER["round_trip_ms"], color=_RED, linestyle="--", linewidth=1.2)
    shares.text(
        PAPER["round_trip_ms"],
        1.01,
        "the paper's mean",
        color=_RED,
        fontsize=8,
        ha="center",
        transform=shares.get_xaxis_transform(),
    )
    shares.set_xlim(0, 1.18 * max(*values, PAPER["round_trip_ms"]))
    shares.set_xlabel("round trip, ms (the paper has the mean only)")
    _plain(bars, shares)
    figure.suptitle(caption, fontsize=11)
    figure.savefig(path, dpi=_DPI)
    pyplot.close(figure)


def draw_robustness(path: Path, runs: Mapping[str, Records], rows: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw, fault by fault, the round trips around it, each command a dot, and whether its bars held."""
    pyplot = _pyplot()
    columns = 1 if len(runs) == 1 else 2
    lines = -(-len(runs) // columns)
    figure, axes = pyplot.subplots(
        lines, columns, figsize=(6.4 * columns, 2.7 * lines), squeeze=False, layout="constrained"
    )
    for axis, (name, records) in zip(axes.flat, runs.items(), strict=False):
        _fault(axis, name, records, rows[name])
    for axis in list(axes.flat)[len(runs) :]:
        axis.set_visible(False)
    figure.suptitle("RSE-PF, robustness: each dot a command", fontsize=11)
    figure.savefig(path, dpi=_DPI)
    pyplot.close(figure)


# --- elasticity ------------------------------------------------------------------------------


def _servers(axis: Any, records: Records, asked: Mapping[str, Any]) -> None:
    known = [(r.time, r.cpu_percent) for r in records.readings if r.cpu_percent is not None]
    times, cpu = zip(*known, strict=True) if known else ((), ())
    axis.plot(times, cpu, color=_GREY, linewidth=0.8, alpha=0.55)
    axis.plot(
        times, _smooth(times, cpu, float(asked["period_s"])), color=_BLUE, label="mean CPU", linewidth=1.6
    )
    limit = float(asked["busy_cpu_percent"])
    axis.axhline(limit, color=_RED, linestyle="--", linewidth=1, label=f"{limit:g} %, as in the paper")
    axis.set_ylim(0, min(max(125.0, max(cpu, default=0.0) * 1.2), _MAX_PERCENT))
    axis.set_ylabel("mean CPU utilization, %", color=_BLUE)
    count = axis.twinx()
    count.step(
        [r.time for r in records.readings],
        [r.healthy_servers for r in records.readings],
        where="post",
        color=_ORANGE,
        linewidth=1.8,
        label="healthy servers",
    )
    most = max((r.healthy_servers for r in records.readings), default=1)
    count.set_ylim(0, 1.3 * most + 1)
    count.yaxis.get_major_locator().set_params(integer=True)
    count.set_ylabel("healthy server count", color=_ORANGE)
    count.spines["top"].set_visible(False)
    marks = {
        "grow": ("^", _GREEN, "scale out"),
        "shrink": ("v", _GREY, "scale in"),
        "fault": ("x", _RED, "kill -9"),
    }
    for action, (marker, colour, label) in marks.items():
        at = [event["time"] for event in records.events if event["action"] == action]
        if at:
            axis.scatter(
                at, [3.0] * len(at), marker=marker, color=colour, s=45, label=label, zorder=5, clip_on=False
            )
    _phase_lines(axis, records)
    handles = [*axis.get_legend_handles_labels()[0], *count.get_legend_handles_labels()[0]]
    axis.legend(handles=handles, fontsize=7.5, ncols=3, loc="upper center", framealpha=0.9)
    _plain(axis)


def _round_trips(axis: Any, records: Records) -> None:
    """Draw percentiles over bins of planned time, and the median robot's own p99."""
    done = [each for each in records.commands if each.code == "ok" and each.round_trip_ms is not None]
    edges, bins = _binned(done, records.commands)
    middle = (edges[:-1] + edges[1:]) / 2
    for percent, colour, width in ((50, _BLUE, 1.6), (99, _ORANGE, 1.2)):
        values = [np.percentile([c.round_trip_ms or 0.0 for c in b], percent) if b else np.nan for b in bins]
        axis.plot(middle, values, color=colour, linewidth=width, label=f"all robots, p{percent}")
    worst = [_worst_robot(b) for b in bins]
    axis.plot(middle, worst, color=_RED, linewidth=0.8, alpha=0.7, label="the robot worst off, its p50")
    failed = [each.planned for each in records.commands if each.code not in ("ok", "")]
    if failed:
        counts, _ = np.histogram(failed, edges)
        rug = axis.twinx()
        rug.bar(middle, counts, width=np.diff(edges), color=_RED, alpha=0.15, label="failures")
        rug.set_ylabel("failures", color=_RED, fontsize=8)
        rug.set_ylim(0, 4 * max(counts.max(), 1))
        rug.set_yticks([0, int(counts.max())])
        rug.spines["top"].set_visible(False)
    axis.axhline(
        PAPER["round_trip_ms"], color=_GREY, linestyle=":", linewidth=1, label="paper's mean, 156 ms"
    )
    _log_ms(axis, [c.round_trip_ms or 0.0 for c in done])
    axis.set_ylabel("round trip, ms")
    axis.legend(fontsize=7.5, ncols=2, loc="upper center", framealpha=0.9)
    _phase_lines(axis, records)
    _plain(axis)


def _robots(axis: Any, records: Records) -> None:
    names = sorted(
        {each.server for reading in records.readings for each in reading.servers}, key=_server_number
    )
    for name in names:
        known = [(r.time, _robots_of(r, name)) for r in records.readings]
        times = [time_s for time_s, _ in known]
        axis.plot(times, [np.nan if n is None else n for _, n in known], linewidth=1.3, label=name)
    axis.set_ylabel("robots on each server")
    most = max((each.robots for r in records.readings for each in r.servers), default=1)
    axis.set_ylim(0, 1.45 * max(most, 1))
    if names:
        axis.legend(fontsize=7, ncols=min(5, len(names)), loc="upper center", framealpha=0.9)
    _phase_lines(axis, records)
    _plain(axis)


def _phase_lines(axis: Any, records: Records) -> None:
    for event in records.events:
        if event["action"] == "phase":
            axis.axvline(event["time"], color=_GREY, linewidth=0.6, linestyle=":")


def _robots_of(reading: RecordedSample, name: str) -> int | None:
    for each in reading.servers:
        if each.server == name:
            return each.robots
    return None


def _server_number(name: str) -> tuple[int, str]:
    tail = name.rpartition("-")[2]
    return (int(tail) if tail.isdigit() else 0, name)


def _binned(
    commands: Sequence[CommandRecord], among: Sequence[CommandRecord]
) -> tuple[Any, list[list[CommandRecord]]]:
    """Return the edges of equal bins over all of *among*, and which of *commands* fall into each."""
    planned = [each.planned for each in among] or [0.0, 1.0]
    edges = np.linspace(min(planned), max(planned) + 1e-6, _BINS + 1)
    bins: list[list[CommandRecord]] = [[] for _ in range(_BINS)]
    for command in commands:
        place = int(np.searchsorted(edges, command.planned, side="right")) - 1
        bins[min(max(place, 0), _BINS - 1)].append(command)
    return edges, bins


def _worst_robot(commands: Sequence[CommandRecord]) -> float:
    by_robot: dict[str, list[float]] = {}
    for command in commands:
        by_robot.setdefault(command.robot, []).append(command.round_trip_ms or 0.0)
    return max((float(np.median(values)) for values in by_robot.values()), default=float("nan"))


def _smooth(times: Sequence[float], values: Sequence[float], period_s: float) -> list[float]:
    """Return, at each time, the mean of the period before it: what the monitor averages."""
    at, known = np.array(times), np.array(values)
    return [float(known[(at > t - period_s) & (at <= t)].mean()) for t in times]


# --- latency and robustness ------------------------------------------------------------------


def _stacked_bars(axis: Any, figures: Mapping[str, Any]) -> None:
    transmission = PAPER["round_trip_ms"] - PAPER["compute_ms"]
    axis.bar(0, transmission, color="#c9ced6", width=0.55, label=_TRANSMISSION)
    axis.bar(0, PAPER["compute_ms"], bottom=transmission, color=_PARTS_COLOURS["compute_ms"], width=0.55)
    _inside(axis, 0, transmission / 2, f"{transmission:.1f}")
    _inside(axis, 0, transmission + PAPER["compute_ms"] / 2, f"{PAPER['compute_ms']:.1f}")
    bottom = 0.0
    for name in ROUND_TRIP_PARTS:
        mean = figures[name]["mean"] or 0.0
        label = f"{_PARTS_NAMES[name]}, here {mean:.1f} ms"
        axis.bar(1, mean, bottom=bottom, color=_PARTS_COLOURS[name], width=0.55, label=label)
        if mean > 0.04 * PAPER["round_trip_ms"]:
            _inside(axis, 1, bottom + mean / 2, f"{mean:.1f}", colour="white")
        bottom += mean
    rest = max((figures["round_trip_ms"]["mean"] or 0.0) - bottom, 0.0)
    axis.bar(1, rest, bottom=bottom, color=_GREY, width=0.55, label=f"the robot's own, {rest:.1f} ms")
    totals = (PAPER["round_trip_ms"], bottom + rest)
    for place, total in enumerate(totals):
        axis.text(place, total + 2, f"{total:.1f} ms", ha="center", fontweight="bold", fontsize=10)
    axis.set_xticks([0, 1], ["the paper\nShenzhen to Seoul", "here\nlink profile"])
    axis.set_ylim(0, 1.15 * max(totals))
    axis.set_xlim(-0.5, 2.4)
    axis.set_ylabel("mean round trip, ms")
    axis.legend(fontsize=8, loc="center right", frameon=False)


def _inside(axis: Any, x: float, y: float, text: str, colour: str = "black") -> None:
    axis.text(x, y, text, ha="center", va="center", fontsize=9, color=colour)


def _fault(axis: Any, name: str, records: Records, row: Mapping[str, Any]) -> None:
    answered = [each for each in records.commands if each.code == "ok" and each.round_trip_ms is not None]
    other = [each for each in records.commands if each.code != "ok"]
    axis.scatter(
        [each.planned for each in answered],
        [each.round_trip_ms or 0.0 for each in answered],
        s=2,
        color=_BLUE,
        alpha=0.35,
        linewidths=0,
    )
    if other:
        axis.scatter(
            [each.planned for each in other],
            [each.round_trip_ms or 5000.0 for each in other],
            s=9,
            color=_RED,
            marker="x",
            linewidths=0.8,
        )
    for event in records.events:
        if event["action"] in ("fault", "healed", "control-plane-back"):
            axis.axvline(event["time"], color=_RED if event["action"] == "fault" else _GREEN, linewidth=1)
    bars = row.get("bars", {})
    held = all(bar["held"] for bar in bars.values())
    gap = row["gap_s"]["p99"]
    told = "" if gap is None else f"gap p99 {gap:.2f} s, "
    commands = row["commands"]
    axis.set_title(
        f"{name}: {told}{commands['lost']} lost, {commands['failed']} failed: "
        f"{'all bars held' if held else 'a bar missed'}",
        fontsize=9,
        color="black" if held else _RED,
    )
    _log_ms(axis, [each.round_trip_ms or 0.0 for each in answered])
    axis.set_ylabel("round trip, ms", fontsize=8)
    axis.set_xlabel("planned at, s", fontsize=8)
    axis.tick_params(labelsize=8)
    _plain(axis)


def _log_ms(axis: Any, values: Sequence[float]) -> None:
    """Scale *axis* from 1 ms to well above the largest value, so that a legend finds room."""
    axis.set_yscale("log")
    axis.set_ylim(max(min(values, default=1.0) / 2, 0.3), max(4 * max(values, default=1.0), 1000.0))
    axis.yaxis.set_major_formatter("{x:g}")


def _plain(*axes: Any) -> None:
    for axis in axes:
        axis.grid(alpha=0.25, linewidth=0.5)
        axis.spines["top"].set_visible(False)


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtra("matplotlib", "experiments") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot

    return matplotlib.pyplot
