"""Replay a recording: list what went wrong, solve commands again, and show why a pose was bad.

FILE is what rse-pf local --record wrote, or a folder of such files.  Without --command it lists what went
wrong, worst first.  With --command it solves the very same bytes again, says whether the answer is equal to
the byte, and shows the evidence for its verdict.  --all solves everything again, as a test of this version,
and exits with 1 if an answer is different.

examples:
  rse-pf replay recordings
  rse-pf replay recordings --command 0123456789abcdef:42 --html pose.html
  rse-pf replay recordings --command 0123456789abcdef:42 --inlier-px 4
  rse-pf replay recordings --all --engine native --json
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rse_pf.command_line.extras import require
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import at_work, counted, show, show_json

if TYPE_CHECKING:
    from rse_pf.extensions.recording.replay.limited import LimitedReplay
    from rse_pf.extensions.recording.replay.report import Attempt, CommandReport
    from rse_pf.extensions.recording.replay.run import Overview
    from rse_pf.extensions.recording.replay.solving import Overrides

__all__ = ["ACTION"]

_MAX_PRINTED = 20  # largest number of troubles, and of changed answers, that are printed
_REPORTS_IN_PAGE = 5  # number of the worst commands whose reports are in the HTML file
_MAX_TROUBLES_IN_JSON = 500  # largest number of troubles in JSON
# Names of the PnP engines that ``--engine`` accepts.
_ENGINES = ("native", "opencv")
# Pattern of the id of a command: ``CONNECTION:ID`` or ``ID``.
_IDENTITY = re.compile(r"([0-9a-f]{16}:)?\d{1,16}")


@dataclass(frozen=True, kw_only=True)
class ReplayRequest:
    """The options of ``rse-pf replay``."""

    file: Path = option(metavar="FILE", help="a recording, or a folder of recordings")
    command: str | None = option(
        "--command", metavar="ID", help="show this command: CONNECTION:ID, or ID if only one command has it"
    )
    all: bool = option("--all", help="solve every command again, and show which answers changed")
    engine: str | None = option(
        "--engine", choices=_ENGINES, help="solve with this engine instead of the recorded one"
    )
    inlier_px: float | None = option(
        "--inlier-px", metavar="PX", help="use this limit of the reprojection error of inliers"
    )
    max_iterations: int | None = option(
        "--max-iterations", metavar="N", help="use this number of RANSAC iterations"
    )
    html: Path | None = option("--html", metavar="PAGE", help="write the report to one HTML file")
    json: bool = option("--json", help="print JSON; all commands are solved again")


def replay_recording(request: ReplayRequest, settings: PlatformSettings) -> int:
    """Run ``rse-pf replay``; return the exit code, 1 if an answer differs that should be equal, else 0."""
    require("replay")
    from rse_pf.extensions.recording.replay.limited import LimitedReplay

    overrides = _overrides(request)
    _check(request)
    with LimitedReplay(settings) as replay:
        if request.command is not None:
            return _show_one(request, request.command, replay, overrides)
        return _show_all(request, replay, overrides)


def _check(request: ReplayRequest) -> None:
    """Raise UsageError for options that contradict each other or the files, before any work."""
    path = request.file
    if request.command is not None and request.all:
        raise UsageError("--command is one command, and --all is all of them", hint="leave one of them out")
    if request.command is not None and not _IDENTITY.fullmatch(request.command):
        raise UsageError(
            f"{request.command[:60]!r} is not the id of a command",
            hint="write CONNECTION:ID, as rse-pf replay FILE lists them",
        )
    page = request.html
    if page is not None and not page.parent.is_dir():
        raise UsageError(f"--html: there is no folder {page.parent}", hint="create it, or choose another")
    if page is not None and (page.is_dir() or (page.exists() and path.exists() and page.samefile(path))):
        raise UsageError(f"--html: {page} is a folder, or the recording", hint="choose another file")


def _overrides(request: ReplayRequest) -> Overrides:
    """Return the solver options of the request; raises UsageError for a number out of range."""
    from rse_pf.errors import BadRequest
    from rse_pf.extensions.recording.replay.solving import Overrides

    if request.inlier_px is not None and not math.isfinite(request.inlier_px):
        raise UsageError(
            f"--inlier-px {request.inlier_px} is not a number of pixels", hint="try 2, 4, 8 or 16"
        )
    chosen = Overrides(
        engine=request.engine, inlier_px=request.inlier_px, max_iterations=request.max_iterations
    )
    try:
        chosen.of(None)
    except BadRequest as error:
        raise UsageError(
            f"--{error.message.replace('_', '-')}", hint="leave it out for the recorded one"
        ) from None
    return chosen


# --- output for a whole recording ---


def _show_all(request: ReplayRequest, replay: LimitedReplay, overrides: Overrides) -> int:
    solve = bool(request.all or request.json or overrides.changes)
    with at_work("reading the recording"):
        overview = replay.overview(
            request.file,
            solve=solve,
            overrides=overrides,
            worst=_MAX_TROUBLES_IN_JSON if request.json else _MAX_PRINTED,
        )
        reports = []
        if request.html is not None:
            reports = [
                replay.command(request.file, each.id, overrides)
                for each in overview.troubles[:_REPORTS_IN_PAGE]
            ]
    if request.html is not None:
        _write_page(request.html, reports, overview, request.file.name)
    if request.json:
        import msgspec

        show_json(msgspec.to_builtins(overview), indent=2)
    else:
        _show_overview(overview, request)
    return 1 if solve and overview.different and not overrides.changes else 0


def _show_overview(overview: Overview, request: ReplayRequest) -> None:
    show(
        f"{counted(overview.commands, 'command')} of {counted(overview.robots, 'robot')} "
        f"in {overview.seconds:.1f} s, {counted(overview.files, 'file')}"
    )
    for name in overview.cut[:3]:
        show(f"note: {name} is cut off or still being written; read up to its last whole chunk")
    if overview.left_out:
        show(f"note: {counted(overview.left_out, 'message')} cannot be read and was left out")
    if overview.was_solved:
        show(f"solved again: {overview.equal} equal to the byte, {overview.different} different")
        for why, count in overview.not_solved.items():
            show(f"not solved again: {count}: {why}")
        for each in overview.changed[:_MAX_PRINTED]:
            show(f"  {each.id}  {each.what}")
        if len(overview.changed) > _MAX_PRINTED:
            show(f"  and {overview.different - _MAX_PRINTED} more; --json lists them")
    bad = sum(overview.by_kind.values())
    if not bad:
        show("no command went wrong; whether calibration, times and images are right, rse-pf check says")
        return
    counts = ", ".join(f"{count} {kind}" for kind, count in overview.by_kind.items())
    show("", f"went wrong: {counts}; worst first:")
    for trouble in overview.troubles:
        show(f"  {trouble.kind:<10} {trouble.id}  {trouble.robot}  {trouble.what}")
    if bad > len(overview.troubles):
        show(f"  and {bad - len(overview.troubles)} more; --json lists up to {_MAX_TROUBLES_IN_JSON}")
    show("", f"look at one: rse-pf replay {request.file} --command {overview.troubles[0].id}")


# --- output for one command ---


def _show_one(request: ReplayRequest, command: str, replay: LimitedReplay, overrides: Overrides) -> int:
    with at_work("solving the command again"):
        report = replay.command(request.file, command, overrides, with_picture=request.html is not None)
    if request.html is not None:
        _write_page(request.html, [report], None, request.file.name)
    if request.json:
        show_json(_report_json(report), indent=2)
    else:
        _show_report(report)
    return 1 if not report.is_equal and not report.why_not else 0


def _show_report(report: CommandReport) -> None:
    verdict = f"{report.verdict}: {report.reason}" if report.reason else report.verdict
    show(f"command {report.id} of {report.robot}, service {report.service}: {verdict}")
    if report.hint:
        show(f"  hint: {report.hint}")
    if report.round_trip_ms is not None:
        show(
            f"answered in {report.round_trip_ms:.1f} ms: {report.queue_ms:.1f} ms in the queue, "
            f"{report.compute_ms:.1f} ms of work"
        )
    if report.why_not:
        show(f"cannot be solved again: {report.why_not}")
    elif report.is_equal:
        show("solved again: equal to the byte, but for times and places")
    else:
        show(f"solved again: DIFFERENT: {report.difference}")
    if report.matches:
        show(
            f"{report.matches} matches, {report.inliers} inliers, {report.rmse_px:.2f} px, "
            f"engine {report.engine or 'none'}"
        )
    if report.rules:
        show("", "rules of the evidence:")
        for rule in report.rules:
            says = "kept" if rule.is_satisfied else ("REFUSES" if rule.refuses else "WEAK")
            relation = "at least" if rule.at_least else "at most"
            unit = f" {rule.unit}" if rule.unit else ""
            show(
                f"  {says:<8} {rule.name:<18} {rule.about}: {rule.measured:.4g}{unit}, "
                f"{relation} {rule.limit:.4g}{unit}"
            )
    if report.tried is not None:
        _show_attempts("what you asked for:", [report.tried], report.tried_name)
    _show_attempts("engines:", report.engines, "")
    _show_attempts("other options:", report.options, "")


def _show_attempts(title: str, attempts: Any, name: str) -> None:
    if not attempts:
        return
    show("", title)
    for attempt in attempts:
        show(f"  {attempt.name or name:<24} {_attempt(attempt)}")


def _attempt(attempt: Attempt) -> str:
    verdict = f"{attempt.verdict} ({attempt.reason})" if attempt.reason else attempt.verdict
    if not attempt.inliers:
        return verdict
    moved = ""
    if attempt.moved_m is not None and attempt.moved_deg is not None:
        moved = f", {1e3 * attempt.moved_m:.3g} mm and {attempt.moved_deg:.3g} deg from the recorded pose"
    return f"{verdict}, {attempt.inliers} inliers, {attempt.rmse_px:.2f} px{moved}"


def _report_json(report: CommandReport) -> dict[str, Any]:
    import msgspec

    plain: dict[str, Any] = msgspec.to_builtins(msgspec.structs.replace(report, picture_png=b""))
    plain.pop("picture_png")
    was_solved = not report.why_not
    return {
        "commands": 1, "equal": int(was_solved and report.is_equal),
        "different": int(was_solved and not report.is_equal),
        **plain,
    }  # fmt: skip


def _write_page(path: Path, reports: Any, overview: Overview | None, name: str) -> None:
    from rse_pf.extensions.recording.replay.page import html_page

    try:
        path.write_text(html_page(reports, overview=overview, title=f"Replay of {name}"), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror}", hint="choose another file") from error


ACTION = Action(request=ReplayRequest, run=replay_recording)
