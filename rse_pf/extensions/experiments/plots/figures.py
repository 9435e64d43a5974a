"""The figures of the experiments: measured values on the axes of the RSE-PF paper, with the paper's numbers.

Each public ``draw_`` function takes the records of runs or the figures of a report and writes one PNG file
with Matplotlib; no window opens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.errors import MissingExtra
from rse_pf.extensions.experiments.results.live_error import (
    LiveDrive,
    alignment_errors,
    correction_delays_ms,
    final_trajectory,
    online_trajectory,
)
from rse_pf.extensions.experiments.results.records import CommandRecord, Records, parameters_of
from rse_pf.extensions.experiments.results.summary import PAPER, ROUND_TRIP_PARTS
from rse_pf.maps.format import MapVersion

__all__ = ["draw_elasticity", "draw_latency", "draw_live", "draw_robustness", "require_matplotlib"]

# Colours of the curves and bars.
_BLUE = "#1f5fa8"
_ORANGE = "#d9822b"
_GREEN = "#3a8f4d"
_RED = "#c0392b"
_GREY = "#8a8f98"
# Colours and names of the parts of a round trip.
_PARTS_COLOURS = {"up_ms": "#7aa6d6", "queue_ms": _ORANGE, "compute_ms": _GREEN, "down_ms": _BLUE}
_PARTS_NAMES = {"up_ms": "up", "queue_ms": "queue", "compute_ms": "compute", "down_ms": "down"}
# Legend of the paper's transmission time, which the paper does not divide into up and down.
_TRANSMISSION = "transmission, not split"
# Number of bins of equal width along the time axis over which round trips and failures are aggregated.
_TIME_BINS = 80
# Upper limit of the CPU axis: a server with emulated cores limits the requests that it starts, not the CPU
# time that they use, so that peaks exceed 100 %.
_MAX_CPU_PERCENT = 170.0
_DPI = 130  # resolution of the PNG files, in dots per inch


def require_matplotlib() -> None:
    """Raise MissingExtra if Matplotlib is not installed; experiments call this before a run, not after it."""
    _pyplot()


def draw_elasticity(path: Path, runs: Mapping[str, Records]) -> None:
    """Draw one column of three plots for each elasticity run.

    From top to bottom: mean CPU and number of healthy servers (the paper's Fig. 8), round trips, and robots
    on each server.

    Args:
        path: Path of the PNG.
        runs: Records of elasticity runs by caption, such as "with rebalancing".
    """
    figure, axes = _pyplot().subplots(
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
        parameters = parameters_of(records)
        _servers(axes[0][column], records, parameters)
        _round_trips(axes[1][column], records)
        _robots(axes[2][column], records)
        axes[0][column].set_title(
            f"{caption}: {parameters['robots']} robots x {parameters['fps']:g} fps, one joins every "
            f"{parameters['join_every_s']:.3g} s, speed {parameters['speed']:g}",
            fontsize=10,
        )
        axes[2][column].set_xlabel("time, s")
    _save(figure, path, "RSE-PF, elasticity (axes of the paper's Fig. 8)")


def draw_latency(path: Path, figures: Mapping[str, Any], caption: str) -> None:
    """Draw the latency experiment into the PNG *path*, with *caption* as its title.

    Left: the mean round trip of the paper and that of the run as stacked bars of its parts.  Right: p50, p95,
    p99 and maximum of the run's round trips.  *figures* are those of `latency_figures`.
    """
    figure, (bars, shares) = _pyplot().subplots(
        1, 2, figsize=(10.5, 4.8), layout="constrained", width_ratios=(1.1, 1.0)
    )
    _stack_bars(bars, figures)
    trip = figures["round_trip_ms"]
    names = ("p50", "p95", "p99", "max")
    values = [trip[name] or 0.0 for name in names]
    drawn = shares.barh(names[::-1], values[::-1], color=_BLUE, height=0.55)
    shares.bar_label(drawn, fmt="%.1f ms", padding=-60, fontsize=9, color="white")
    shares.axvline(PAPER["round_trip_ms"], color=_RED, linestyle="--", linewidth=1.2)
    shares.text(
        PAPER["round_trip_ms"],
        1.01,
        "mean of the paper",
        color=_RED,
        fontsize=8,
        ha="center",
        transform=shares.get_xaxis_transform(),
    )
    limit = 1.18 * max(*values, PAPER["round_trip_ms"])
    shares.set(xlim=(0, limit), xlabel="round trip, ms (the paper gives the mean only)")
    _plain(bars, shares)
    _save(figure, path, caption)


def draw_robustness(path: Path, runs: Mapping[str, Records], rows: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw one plot per run of a fault: the round trip of each command over its planned send time.

    *runs* and *rows* have the same keys, the names of the runs; a row holds the figures of its run.  The
    title of a plot says whether all targets of the fault were met.
    """
    columns = 1 if len(runs) == 1 else 2
    lines = -(-len(runs) // columns)
    figure, axes = _pyplot().subplots(
        lines, columns, figsize=(6.4 * columns, 2.7 * lines), squeeze=False, layout="constrained"
    )
    for axis, (name, records) in zip(axes.flat, runs.items(), strict=False):
        _fault(axis, name, records, rows[name])
    for axis in list(axes.flat)[len(runs) :]:
        axis.set_visible(False)
    _save(
        figure,
        path,
        "RSE-PF, robustness: each dot is a command, a line the start (red) or end (green) of a fault",
    )


def draw_live(
    path: Path, drives: Sequence[LiveDrive], version: MapVersion | None, live: Mapping[str, Any]
) -> None:
    """Draw a run with a live map into the PNG *path*, as three plots.

    Left: the path of each robot in the map, dotted while the robot was not yet aligned with it, with the
    poses that the robot reported while it drove as dots.  Middle: the error of those reported poses over
    time.  Right: the cumulative distribution of the time from a keyframe to the correction of it.  *version*
    is the map that was published at the end, or None if there is none; *live* are the figures of
    `live_figures`.
    """
    figure, (paths, errors, delays) = _pyplot().subplots(
        1, 3, figsize=(16.0, 4.8), layout="constrained", width_ratios=(1.2, 1.1, 1.1)
    )
    colours = (_BLUE, _ORANGE, _GREEN, _RED, "#7b4fa3", "#4aa3a2")
    final = [final_trajectory(drive, version) for drive in drives]
    across, up = _widest_axes([trajectory.positions for trajectory in final if len(trajectory)])
    for row, (drive, path_in_map) in enumerate(zip(drives, final, strict=True)):
        colour = colours[row % len(colours)]
        aligned = {frame["stamp"] for frame in drive.frames if frame["T_map"] is not None}
        was_aligned = np.array([stamp in aligned for stamp in path_in_map.timestamps_s], dtype=bool)
        positions = path_in_map.positions
        for shown, style, label in (
            (~was_aligned, ":", ""), (was_aligned, "-", drive.name)
        ):  # fmt: skip
            line = np.where(shown[:, None], positions[:, [across, up]], np.nan)
            paths.plot(line[:, 0], line[:, 1], style, color=colour, linewidth=1.6, label=label or None)
        given = online_trajectory(drive).positions
        paths.plot(given[:, across], given[:, up], ".", color=colour, markersize=2.5, alpha=0.5)
    paths.set(
        aspect="equal", xlabel="m", ylabel="m", title="paths: dotted before the join; dots: as given out"
    )
    paths.legend(fontsize=8)
    for row, (times_s, distances_cm) in enumerate(alignment_errors(drives, version)):
        errors.plot(times_s, distances_cm, color=colours[row % len(colours)], linewidth=1.2)
    errors.set(xlabel="time, s", ylabel="cm", title="error of the poses as given out")
    found_ms = np.sort(correction_delays_ms(drives))
    if len(found_ms):
        delays.step(found_ms, np.arange(1, len(found_ms) + 1) / len(found_ms), where="post", color=_BLUE)
    delay = live["correction_ms"]
    delays.set(
        xlabel="ms", ylabel="share", ylim=(0, 1.02),
        title=f"keyframe to correction: p50 {delay['p50']}, p99 {delay['p99']}, n {delay['n']}",
    )  # fmt: skip
    _plain(paths, errors, delays)
    _save(figure, path, "RSE-PF, live map")


def _widest_axes(positions: Sequence[Any]) -> tuple[int, int]:
    """Return the two world axes with the largest extent of *positions*, ascending; (0, 2) without any."""
    if not positions:
        return 0, 2
    spread = np.ptp(np.concatenate(positions), axis=0)
    first, second = sorted(int(axis) for axis in np.argsort(spread)[1:])
    return first, second


def _servers(axis: Any, records: Records, parameters: Mapping[str, Any]) -> None:
    known = [(r.time, r.cpu_percent) for r in records.samples if r.cpu_percent is not None]
    times, cpu = zip(*known, strict=True) if known else ((), ())
    axis.plot(times, cpu, color=_GREY, linewidth=0.8, alpha=0.55)
    means = _period_means(times, cpu, float(parameters["period_s"]))
    axis.plot(times, means, color=_BLUE, label="mean CPU", linewidth=1.6)
    limit = float(parameters["busy_cpu_percent"])
    axis.axhline(limit, color=_RED, linestyle="--", linewidth=1, label=f"{limit:g} %, as in the paper")
    axis.set_ylim(0, min(max(125.0, max(cpu, default=0.0) * 1.2), _MAX_CPU_PERCENT))
    axis.set_ylabel("mean CPU utilization, %", color=_BLUE)
    count = axis.twinx()
    count.step(
        [r.time for r in records.samples],
        [r.healthy_servers for r in records.samples],
        where="post",
        color=_ORANGE,
        linewidth=1.8,
        label="healthy servers",
    )
    count.set_ylim(0, 1.3 * max((r.healthy_servers for r in records.samples), default=1) + 1)
    count.yaxis.get_major_locator().set_params(integer=True)
    count.set_ylabel("healthy server count", color=_ORANGE)
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
    count.spines["top"].set_visible(False)
    _plain(axis)


def _round_trips(axis: Any, records: Records) -> None:
    """Draw p50 and p99 of the round trips, ms, per bin of planned send time, and failures as bars.

    A third line is the largest median of a single robot in each bin.  The bars count answers with an error;
    commands without an answer are not drawn.
    """
    done = [
        command for command in records.commands if command.code == "ok" and command.round_trip_ms is not None
    ]
    edges, bins = _bin_commands(done, records.commands)
    middle = (edges[:-1] + edges[1:]) / 2
    for percent, colour, width in ((50, _BLUE, 1.6), (99, _ORANGE, 1.2)):
        values = [np.percentile([c.round_trip_ms or 0.0 for c in b], percent) if b else np.nan for b in bins]
        axis.plot(middle, values, color=colour, linewidth=width, label=f"all robots, p{percent}")
    worst = [_worst_robot(b) for b in bins]
    axis.plot(middle, worst, color=_RED, linewidth=0.8, alpha=0.7, label="slowest robot, p50")
    failed = [command.planned for command in records.commands if command.code not in ("ok", "")]
    if failed:
        counts, _ = np.histogram(failed, edges)
        bars = axis.twinx()
        bars.bar(middle, counts, width=np.diff(edges), color=_RED, alpha=0.15, label="failures")
        bars.set(ylim=(0, 4 * max(counts.max(), 1)), yticks=[0, int(counts.max())])
        bars.set_ylabel("failures", color=_RED, fontsize=8)
        bars.spines["top"].set_visible(False)
    axis.axhline(
        PAPER["round_trip_ms"], color=_GREY, linestyle=":", linewidth=1, label="mean of the paper, 156 ms"
    )
    _log_ms(axis, [c.round_trip_ms or 0.0 for c in done])
    axis.set_ylabel("round trip, ms")
    axis.legend(fontsize=7.5, ncols=2, loc="upper center", framealpha=0.9)
    _phase_lines(axis, records)
    _plain(axis)


def _robots(axis: Any, records: Records) -> None:
    by_server = [{server.name: server.robots for server in sample.servers} for sample in records.samples]
    names = sorted({name for robots in by_server for name in robots}, key=_server_number)
    times = [sample.time for sample in records.samples]
    for name in names:
        axis.plot(times, [robots.get(name, np.nan) for robots in by_server], linewidth=1.3, label=name)
    most = max((count for robots in by_server for count in robots.values()), default=1)
    axis.set(ylabel="robots on each server", ylim=(0, 1.45 * max(most, 1)))
    if names:
        axis.legend(fontsize=7, ncols=min(5, len(names)), loc="upper center", framealpha=0.9)
    _phase_lines(axis, records)
    _plain(axis)


def _phase_lines(axis: Any, records: Records) -> None:
    for event in records.events:
        if event["action"] == "phase":
            axis.axvline(event["time"], color=_GREY, linewidth=0.6, linestyle=":")


def _server_number(name: str) -> tuple[int, str]:
    tail = name.rpartition("-")[2]
    return (int(tail) if tail.isdigit() else 0, name)


def _bin_commands(
    commands: Sequence[CommandRecord], among: Sequence[CommandRecord]
) -> tuple[Any, list[list[CommandRecord]]]:
    """Return the edges of `_TIME_BINS` bins of equal width, and for each bin the *commands* planned in it.

    The bins span the planned send times of *among*, which includes commands that *commands* does not.
    """
    planned = [record.planned for record in among] or [0.0, 1.0]
    edges = np.linspace(min(planned), max(planned) + 1e-6, _TIME_BINS + 1)
    bins: list[list[CommandRecord]] = [[] for _ in range(_TIME_BINS)]
    for command in commands:
        place = int(np.searchsorted(edges, command.planned, side="right")) - 1
        bins[min(max(place, 0), _TIME_BINS - 1)].append(command)
    return edges, bins


def _worst_robot(commands: Sequence[CommandRecord]) -> float:
    by_robot: dict[str, list[float]] = {}
    for command in commands:
        by_robot.setdefault(command.robot, []).append(command.round_trip_ms or 0.0)
    return max((float(np.median(values)) for values in by_robot.values()), default=float("nan"))


def _period_means(times: Sequence[float], values: Sequence[float], period_s: float) -> list[float]:
    """Return for each of *times* the mean of the *values* in the *period_s* seconds up to that time."""
    at, known = np.array(times), np.array(values)
    return [float(known[(at > t - period_s) & (at <= t)].mean()) for t in times]


def _stack_bars(axis: Any, figures: Mapping[str, Any]) -> None:
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
    axis.bar(1, rest, bottom=bottom, color=_GREY, width=0.55, label=f"in the robot, {rest:.1f} ms")
    totals = (PAPER["round_trip_ms"], bottom + rest)
    for place, total in enumerate(totals):
        axis.text(place, total + 2, f"{total:.1f} ms", ha="center", fontweight="bold", fontsize=10)
    axis.set_xticks([0, 1], ["the paper\nShenzhen to Seoul", "here\nemulated link"])
    axis.set(xlim=(-0.5, 2.7), ylim=(0, 1.15 * max(totals)), ylabel="mean round trip, ms")
    axis.legend(fontsize=8, loc="center right", frameon=False)


def _inside(axis: Any, x: float, y: float, text: str, colour: str = "black") -> None:
    axis.text(x, y, text, ha="center", va="center", fontsize=9, color=colour)


def _fault(axis: Any, name: str, records: Records, row: Mapping[str, Any]) -> None:
    answered = [
        command for command in records.commands if command.code == "ok" and command.round_trip_ms is not None
    ]
    other = [command for command in records.commands if command.code != "ok"]
    axis.scatter(
        [command.planned for command in answered],
        [command.round_trip_ms or 0.0 for command in answered],
        s=2,
        color=_BLUE,
        alpha=0.35,
        linewidths=0,
    )
    if other:
        axis.scatter(
            [command.planned for command in other],
            [command.round_trip_ms or 5000.0 for command in other],
            s=9,
            color=_RED,
            marker="x",
            linewidths=0.8,
        )
    for event in records.events:
        if event["action"] in ("fault", "healed", "control-plane-back"):
            axis.axvline(event["time"], color=_RED if event["action"] == "fault" else _GREEN, linewidth=1)
    met = all(bar["held"] for bar in row.get("bars", {}).values())
    outage_s, commands = row["gap_s"]["p99"], row["commands"]
    outage = "" if outage_s is None else f"outage p99 {outage_s:.2f} s, "
    verdict = "all targets met" if met else "a target missed"
    axis.set_title(
        f"{name}: {outage}{commands['lost']} lost, {commands['failed']} failed; {verdict}",
        fontsize=9,
        color="black" if met else _RED,
    )
    _log_ms(axis, [command.round_trip_ms or 0.0 for command in answered])
    axis.set_ylabel("round trip, ms", fontsize=8)
    axis.set_xlabel("planned time, s", fontsize=8)
    axis.tick_params(labelsize=8)
    _plain(axis)


def _log_ms(axis: Any, values: Sequence[float]) -> None:
    """Give *axis* a logarithmic y scale for *values* in ms, with space for a legend above them."""
    low, high = min(values, default=1.0), max(values, default=1.0)
    axis.set(yscale="log", ylim=(max(low / 2, 0.3), max(4 * high, 1000.0)))
    axis.yaxis.set_major_formatter("{x:g}")


def _plain(*axes: Any) -> None:
    for axis in axes:
        axis.grid(alpha=0.25, linewidth=0.5)
        axis.spines["top"].set_visible(False)


def _save(figure: Any, path: Path, title: str) -> None:
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=_DPI)
    _pyplot().close(figure)


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise MissingExtra("matplotlib", "experiments") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot

    return matplotlib.pyplot
