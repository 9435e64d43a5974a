"""The report of a comparison: ``compare.json`` and the table in the terminal.

The functions format figures; the figures of a run are computed in `tracking_run`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from client_sdk.datasets import Dataset
from client_sdk.trajectory_error import MAX_TRUTH_GAP_S, SAME_STAMP_S, STEP_S
from rse_pf.extensions.experiments.compare.configurations import Configuration
from rse_pf.extensions.experiments.compare.tracking_run import TrackingRun

__all__ = ["drive_heading", "make_report", "row_of", "runs_line", "table_lines", "tolerance_line"]

_COLUMNS = (
    ("posed", "posed", "d"), ("longest_gap_s", "gap s", ".2f"), ("ate_cm", "ATE cm", ".2f"),
    ("evo_ate_cm", "evo cm", ".2f"), ("ate_online_cm", "online cm", ".2f"), ("rpe_cm", "RPE cm", ".2f"),
    ("rpe_deg", "RPE deg", ".2f"), ("bytes_a_frame", "B/frame", ".0f"),
    ("bytes_a_keyframe", "B/keyframe", ".0f"),
    ("keyframes", "keyframes", "d"), ("robot_ms", "robot ms", ".1f"), ("server_ms", "server ms", ".1f"),
)  # fmt: skip
"""The columns of the table in the terminal: name of the figure, heading, and format specification."""


def row_of(
    configuration: Configuration,
    drive: Dataset,
    runs: Sequence[TrackingRun],
    evo_ate_cm: Sequence[float | None],
) -> dict[str, Any]:
    """Return the row of ``compare.json`` for *configuration* on *drive*.

    ``figures`` holds the least and the largest value of each figure over *runs*; *evo_ate_cm* has the ATE of
    evo for each run, None where there is none.
    """
    figures: dict[str, Any] = {name: _spread([run.figures[name] for run in runs]) for name in runs[0].figures}
    if any(value is not None for value in evo_ate_cm):
        figures["evo_ate_cm"] = _spread(evo_ate_cm)
    for name in runs[0].times_ms:
        figures[f"{name}_ms"] = _spread([run.times_ms[name] for run in runs])
    return {
        "configuration": configuration.name,
        "recording": drive.name,
        "sensors": drive.sensors,
        "rate_hz": round(drive.rate_hz, 3),
        "alignment": "SE(3)" if runs[0].is_metric else "Sim(3)",
        "truth": drive.truth_kind,
        "frame_of_truth": "camera" if drive.T_body_camera is None else "body",
        "runs": len(runs),
        "same_poses_in_all_runs": len({run.digest for run in runs}) == 1 if len(runs) > 1 else None,
        "poses_digest": [run.digest for run in runs],
        "why_no_errors": runs[0].why,
        "figures": figures,
    }


def make_report(
    rows: Sequence[Mapping[str, Any]],
    configurations: Sequence[Configuration],
    solved_by: str,
    environment: Mapping[str, Any],
    load_after: Sequence[float],
) -> dict[str, Any]:
    """Return the content of ``compare.json``: rows, parameters of the errors, configurations, environment."""
    return {
        "experiment": "compare",
        "solved_by": solved_by,
        "truth_at_frames": "interpolated on the twist between the two true poses around a frame",
        "max_truth_gap_s": MAX_TRUTH_GAP_S,
        "same_stamp_s": SAME_STAMP_S,
        "rpe_step_s": STEP_S,
        "configurations": {
            each.name: {
                "source": each.source or "built in",
                "depth": each.depth,
                "slots": sorted(each.slots),
                "frontend": asdict(each.frontend),
                "monocular": asdict(each.monocular),
            }
            for each in configurations
        },
        "rows": list(rows),
        "environment": {**environment, "load_average_after": list(load_after)},
    }


def drive_heading(drive: Dataset, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the line above the table of a drive: name, sensors, frames, duration, truth and alignment."""
    stamps_s = drive.timestamps_s
    kinds = list(dict.fromkeys(row["alignment"] for row in rows))
    frames = f"{drive.name_at_rate}, {drive.sensors}: {len(drive)} frames, {stamps_s[-1] - stamps_s[0]:.1f} s"
    if drive.truth is None:
        return f"{frames}; no truth"
    where = "" if drive.T_body_camera is None else " of the body"
    return f"{frames}; {drive.truth_kind}{where}, {' and '.join(kinds)}"


def table_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the lines of the table of one drive, with aligned columns.

    A column without any value is left out.
    """
    shown = [
        column for column in _COLUMNS
        if any(row["figures"].get(column[0], (None,))[0] is not None for row in rows)
    ]  # fmt: skip
    with_kind = len({row["alignment"] for row in rows}) > 1
    cells = [["", *(heading for _, heading, _ in shown)]]
    for row in rows:
        name = f"{row['configuration']} ({row['alignment']})" if with_kind else row["configuration"]
        cells.append([name, *(_cell(row["figures"], column, form) for column, _, form in shown)])
    widths = [max(len(line[place]) for line in cells) for place in range(len(cells[0]))]
    return [
        "  ".join(["", cell.ljust(widths[0]), *map(str.rjust, others, widths[1:])]) for cell, *others in cells
    ]


def tolerance_line() -> str:
    """Return the line that says how ATE and RPE are computed, for the terminal."""
    return (
        f"ATE of the whole trajectory, RPE over {STEP_S:g} s; truth interpolated between true poses at most "
        f"{MAX_TRUTH_GAP_S:g} s apart, or within {1e3 * SAME_STAMP_S:g} ms; a lost frame lowers posed"
    )


def runs_line(rows: Sequence[Mapping[str, Any]], *, is_platform: bool) -> str:
    """Return the line that says whether the poses of repeated runs are the same, for the terminal."""
    runs = rows[0]["runs"]
    if runs == 1:
        how = "as the platform's answers arrive" if is_platform else "without a clock or network"
        return f"1 run each, solved {how}; --runs 3 shows whether the poses are the same each time"
    different = [row for row in rows if not row["same_poses_in_all_runs"]]
    if not different:
        return f"{runs} runs each, with the same poses to the last bit: deterministic, only times differ"
    count = f"{len(different)} of {len(rows)} rows differ between runs"
    return f"{runs} runs each; {count}: the least and the largest value are shown"


def _cell(figures: Mapping[str, Any], name: str, form: str) -> str:
    least, most = figures.get(name, (None, None))
    if least is None:
        return "-"
    first, last = (format(int(v) if form == "d" else v, form) for v in (least, most))
    written = first if first == last else f"{first} to {last}"
    return f"{written} of {int(figures['frames'][0])}" if name == "posed" else written


def _spread(values: Sequence[float | int | None]) -> tuple[float | int | None, float | int | None]:
    known = [value for value in values if value is not None]
    if not known:
        return None, None
    least, most = min(known), max(known)
    return round(least, 6), round(most, 6)
