"""Run a comparison: track every recording with each configuration, and write table, JSON and image."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from client_sdk.datasets import Dataset
from client_sdk.frontend import load_opencv
from client_sdk.source_facts import unresolved
from client_sdk.trajectory import write_trajectory
from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.extensions.experiments.compare.configurations import Configuration
from rse_pf.extensions.experiments.compare.evo_figures import evo_ate_cm, evo_command
from rse_pf.extensions.experiments.compare.report import (
    drive_heading,
    make_report,
    row_of,
    runs_line,
    table_lines,
    tolerance_line,
)
from rse_pf.extensions.experiments.compare.solvers import InProcessSolver, MeteredSolver, platform_solver
from rse_pf.extensions.experiments.compare.tracking_run import TrackingRun, track
from rse_pf.extensions.experiments.plots.trajectory_image import DrawnPath, Panel, draw_trajectories
from rse_pf.extensions.experiments.results.result_folder import environment, load_average, write_json
from rse_pf.terminal import show, show_progress

__all__ = ["CompareOptions", "run_compare"]

REPORT = "compare.json"  # name of the file with the report
PICTURE = "compare.png"  # name of the file with the image of the trajectories
TRAJECTORIES = "trajectories"  # name of the folder with the trajectories
# Characters of names that are replaced by "_" in file names.
_NOT_PLAIN = re.compile(r"[^\w.-]")


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareOptions:
    """Options of ``rse-pf compare``.

    ``runs`` is the number of repetitions of each run; ``platform`` solves the poses by a platform that is
    started on this machine, instead of in this process.
    """

    configurations: Sequence[Configuration]
    drives: Sequence[Dataset]
    runs: int = 1
    out: Path = Path("out-compare")
    platform: bool = False
    accepted: tuple[str, ...] = ()
    """Names of findings about the recordings that the user accepts (``--accept``); they are not shown."""


def run_compare(options: CompareOptions, settings: PlatformSettings) -> int:
    """Run the comparison, write its results to ``options.out``, and print them; return 0.

    Raises:
        CommandFailed: No frame of a run got a pose; the results are written before.
    """
    _make_folder(options.out)
    load_opencv().setNumThreads(1)
    for drive in options.drives:
        show(*(f"note: {drive.name}: {note}" for note in drive.notes))
    doubts = _doubts(options)
    show(*doubts)
    before = environment(settings)
    rows, panels = asyncio.run(_compare(options, settings))
    solved_by = "a platform on this machine" if options.platform else "the service in this process"
    report = make_report(rows, options.configurations, solved_by, before, load_average())
    report["source"] = _doubts(options)
    write_json(options.out / REPORT, report)
    draw_trajectories(options.out / PICTURE, panels)
    show(
        *(line for line in report["source"] if line not in doubts),
        tolerance_line(),
        runs_line(rows, is_platform=options.platform),
        f"CPU of a frame: robot without reading its image, OpenCV on one thread; server: "
        f"{'as its answers state' if options.platform else 'with the codec'}; load average "
        f"{before['load_average'][0]:g} before, {load_average()[0]:g} after",
        f"results: {options.out}/{REPORT}, {PICTURE}, {TRAJECTORIES}/",
    )
    empty = [
        f"{row['configuration']} on {row['recording']}" for row in rows if not row["figures"]["posed"][0]
    ]
    if empty:
        raise CommandFailed(
            f"no frame got a pose: {', '.join(empty)}",
            hint="rse-pf check RECORDING says what is wrong with it",
        )
    return 0


def _doubts(options: CompareOptions) -> list[str]:
    """Return a line for each finding about the recordings that the user has not accepted."""
    logs = {drive.name: drive.log for drive in options.drives}
    return [doubt.line() for log in logs.values() for doubt in unresolved(log.doubts, options.accepted)]


async def _compare(
    options: CompareOptions, settings: PlatformSettings
) -> tuple[list[dict[str, Any]], list[Panel]]:
    """Run all configurations on all drives; print the table of each drive once it is complete.

    Return the rows of the report, and a panel of the image for each drive.
    """
    evo = evo_command()
    rows: list[dict[str, Any]] = []
    panels: list[Panel] = []
    async with _solvers(options, settings) as solver:
        for drive in options.drives:
            of_drive: list[dict[str, Any]] = []
            first_runs: list[TrackingRun] = []
            for configuration in options.configurations:
                runs = [
                    await _run(options, configuration, drive, solver(), number)
                    for number in range(1, options.runs + 1)
                ]
                evos = [
                    None if evo is None or run.errors is None else evo_ate_cm(evo, run.errors) for run in runs
                ]
                of_drive.append(row_of(configuration, drive, runs, evos))
                first_runs.append(runs[0])
            show_progress("", is_over=False)
            show("", drive_heading(drive, of_drive), *table_lines(of_drive))
            show(
                *(
                    f"  {row['configuration']}: {row['why_no_errors']}"
                    for row in of_drive
                    if row["why_no_errors"]
                )
            )
            rows += of_drive
            panels.append(_panel(drive, of_drive, first_runs))
    show("")
    return rows, panels


@asynccontextmanager
async def _solvers(
    options: CompareOptions, settings: PlatformSettings
) -> AsyncIterator[Callable[[], MeteredSolver]]:
    """Yield a function that returns the solver of the next run.

    In this process each run has a solver of its own; with a platform all runs share one.
    """
    if not options.platform:
        yield lambda: InProcessSolver(settings)
        return
    async with platform_solver(settings, options.out / "platform") as solver:
        yield lambda: solver


async def _run(
    options: CompareOptions, configuration: Configuration, drive: Dataset, solver: MeteredSolver, number: int
) -> TrackingRun:
    """Track *drive* once with *configuration*, and write the trajectory of run *number* to a file."""

    def progress(frames: int) -> None:
        doing = f"{drive.name_at_rate}: {configuration.name}, run {number}"
        show_progress(f"{doing}, frame {frames} of {len(drive)}", is_over=False)

    run = await track(configuration, drive, solver, progress)
    name = f"{drive.name}-{drive.rate_hz:.3g}hz-{configuration.name}-{number}.txt"
    path = options.out / TRAJECTORIES / _NOT_PLAIN.sub("_", name)
    body = drive.T_body_camera
    write_trajectory(path, run.trajectory, is_metric=run.is_metric, T_body_camera=body)
    return run


def _panel(drive: Dataset, rows: Sequence[Mapping[str, Any]], runs: Sequence[TrackingRun]) -> Panel:
    """Return the panel of a drive with the path of each configuration.

    Paths are aligned with the true one; without a truth each path is in the frame of its own first camera.
    """
    paths = []
    for row, run in zip(rows, runs, strict=True):
        ate_cm = row["figures"]["ate_cm"][0]
        label = row["configuration"] if ate_cm is None else f"{row['configuration']} {ate_cm:.2f} cm"
        paths.append(DrawnPath(name=label, path=run.trajectory if run.errors is None else run.errors.aligned))
    truths = [run.errors.truth for run in runs if run.errors is not None]
    is_metric = bool(truths) or all(run.is_metric for run in runs)
    truth = max(truths, key=len) if truths else None
    unit = "m" if is_metric else "units"
    return Panel(title=drive.name_at_rate, truth=truth, paths=tuple(paths), unit=unit)


def _make_folder(folder: Path) -> None:
    try:
        (folder / TRAJECTORIES).mkdir(parents=True, exist_ok=True)
        for name in (REPORT, PICTURE):
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write {folder}: {error.strerror}", hint="name another --out") from error
