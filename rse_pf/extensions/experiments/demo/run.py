"""The demo: robots build point-cloud maps through the PnP service, on one machine.

`run_demo` starts the local platform (real servers behind a real load balancer), runs every robot as a
process, and writes maps, trajectories, figures and a report.  Every process that it started has exited when
it returns.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from client_sdk.point_map import read_ply
from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed
from rse_pf.extensions.experiments.child_process import (
    ChildFailed,
    ChildReady,
    IssuedToken,
    TokenRequest,
    end_process,
    start_process,
)
from rse_pf.extensions.experiments.demo.live import LIVE_NAME, fetch_live_map, show_live_map
from rse_pf.extensions.experiments.demo.live_faults import Disturbance, LiveFault
from rse_pf.extensions.experiments.demo.merge import MERGED_MAP, merge_on_platform, print_tenths, write_merged
from rse_pf.extensions.experiments.demo.report import closing_lines, demo_page, is_lost, make_report
from rse_pf.extensions.experiments.demo.robot import (
    DemoOptions,
    FrameDone,
    RobotFinished,
    RobotSpec,
    run_robot,
)
from rse_pf.extensions.experiments.harness import Harness
from rse_pf.extensions.experiments.results.live_error import (
    LIVE_MAP,
    live_figures,
    read_live_drives,
    read_live_map,
)
from rse_pf.extensions.experiments.results.records import COMMANDS, robot_names, write_commands
from rse_pf.extensions.experiments.results.result_folder import (
    RUN_FILES,
    environment,
    fresh_folder,
    load_average,
    write_json,
)
from rse_pf.geometry import Array
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.maps.format import MapVersion
from rse_pf.maps.map_image import RobotPath, draw_map
from rse_pf.terminal import show_page

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

__all__ = ["DemoOptions", "run_demo"]

T = TypeVar("T")

# Time after which the process of a robot that has finished and does not exit is killed, in seconds.
_EXIT_TIMEOUT_S = 5.0
# Time between the order to start and the start of the robots, in seconds.
_START_DELAY_S = 0.2
# Time between the order to start and the start with a live map, in seconds: the map server starts and robots
# join.
_LIVE_START_DELAY_S = 3.0


@dataclass(slots=True, kw_only=True)
class _Robot:
    """What the parent knows about the process of a robot; ``bar`` is its progress bar."""

    spec: RobotSpec
    process: Any
    pipe: Connection
    bar: TaskID
    finished: RobotFinished | None = None


def run_demo(
    options: DemoOptions, settings: PlatformSettings, fault: LiveFault | None = None, *, kind: str = "demo"
) -> int:
    """Run the demo, inject *fault* if given, write results to ``options.out``, and print the main figures.

    *kind* names the experiment in the records.

    Return 1 if a command got no final answer, or if more than half of the frames got no pose; else 0.
    """
    folder = fresh_folder(
        options.out,
        [
            *RUN_FILES,
            "map.png",
            "map_merged.png",
            "merged.ply",
            MERGED_MAP,
            LIVE_MAP,
            "live.png",
            "failing-store",
            "robot-[1-9]",
            "robot-[1-9][0-9]",
        ],
    )
    chosen = settings.replace(pnp={"engine": options.engine})
    if fault is not None:
        chosen = fault.settings(chosen)
    report = asyncio.run(_run(options, chosen, folder, fault, kind))
    show_page(closing_lines(report, folder, options.shown))
    return 1 if is_lost(report) else 0


async def _run(
    options: DemoOptions,
    settings: PlatformSettings,
    folder: Path,
    fault: LiveFault | None,
    kind: str,
) -> dict[str, Any]:
    before = environment(settings)
    with _progress_bars(options.quiet) as screen:
        screen.print("starting the platform: Envoy and two backend servers")
        async with AsyncExitStack() as stack:
            if fault is not None:
                stack.enter_context(fault.environment(folder / "failing-store"))
            harness = await stack.enter_async_context(
                Harness(folder, settings, data=options.merge or options.live, elastic=False)
            )
            platform = harness.platform
            disturbance = None
            if fault is not None:
                disturbance = await stack.enter_async_context(fault.disturb(platform, folder, harness.log))
            pids = ", ".join(f"{server.name} {server.pid}" for server in platform.servers)
            screen.print(f"running at {platform.url}: {pids}")
            screen.print("kill -9 one of these processes: the robots continue on the other server")
            robots = [
                _start(
                    RobotSpec(
                        name=name,
                        number=number,
                        url=platform.url if disturbance is None else disturbance.url_of(number),
                        folder=folder / name,
                        options=options,
                        session=settings.session,
                        has_offload=fault is not None and fault.has_offload,
                    ),
                    screen,
                )
                for number, name in enumerate(robot_names(options.robots))
            ]
            try:
                await _follow(robots, harness, screen, kind, disturbance)
                if disturbance is not None:
                    await disturbance.finish()
            finally:
                _end(robots)
            finished = [robot.finished for robot in robots if robot.finished is not None]
            merged = None
            if options.merge:
                screen.print("merging the maps")
                merged = await asyncio.to_thread(_merge, settings, folder, finished, platform, screen)
                harness.log("merged", joined=merged["joined"])
            if options.live:
                token = platform.issue_token("operator")
                if fault is not None:
                    shown = await show_live_map(platform.url, token, settings.session)
                    harness.log("final-map", **shown)
                screen.print("publishing the live map")
                why = await fetch_live_map(platform.url, token, folder, settings.session)
                harness.log("published", trouble=why)
    screen.print("drawing the maps")
    return _write_results(options, folder, finished, before, merged)


def _start(spec: RobotSpec, screen: Progress) -> _Robot:
    spec.folder.mkdir()
    process, pipe = start_process(run_robot, spec, spec.name)
    phase = "rendering the world" if spec.options.data is None else "reading the recording"
    bar = screen.add_task(f"{spec.name}  {phase}", total=spec.options.frame_count)
    return _Robot(spec=spec, process=process, pipe=pipe, bar=bar)


async def _follow(
    robots: list[_Robot],
    harness: Harness,
    screen: Progress,
    kind: str,
    disturbance: Disturbance | None,
) -> None:
    """Wait until all robots are ready, start them at the same time, and wait until all have finished.

    The fault of *disturbance* is injected while they drive.  The parameters of the run are recorded as those
    of the experiment *kind*.
    """
    options, platform = robots[0].spec.options, harness.platform
    inboxes = [_messages(robot.pipe) for robot in robots]
    ready = await asyncio.gather(
        *(_wait_for(ChildReady, *pair, platform, screen) for pair in zip(robots, inboxes, strict=True))
    )
    harness.log(
        "experiment",
        kind=kind,
        robots=len(robots),
        fps=options.rate_hz,
        frames={robot.spec.name: message.frames for robot, message in zip(robots, ready, strict=True)},
        **({} if disturbance is None else disturbance.parameters),
    )
    start_after_s = _LIVE_START_DELAY_S if options.live else _START_DELAY_S
    began = time.monotonic() + start_after_s
    harness.log("robots-start", robots=len(robots), after_s=start_after_s)
    screen.print("the robots start")
    if disturbance is not None:
        frames = max(message.frames for message in ready)
        disturbance.begin(start_after_s, frames / options.rate_hz)
    for robot, message in zip(robots, ready, strict=True):
        screen.reset(robot.bar, description=f"{robot.spec.name}  mapping", total=message.frames)
        robot.pipe.send(began)
    finished = await asyncio.gather(
        *(_wait_for(RobotFinished, *pair, platform, screen) for pair in zip(robots, inboxes, strict=True))
    )
    for robot, figures in zip(robots, finished, strict=True):
        robot.finished = figures
    harness.log("robots-end")


async def _wait_for(
    kind: type[T], robot: _Robot, inbox: AsyncIterator[Any], platform: LocalPlatform, screen: Progress
) -> T:
    """Handle the messages of *robot* until one of type *kind* arrives, and return that message.

    Raises:
        CommandFailed: The robot failed, or its process exited.
    """
    async for message in inbox:
        if isinstance(message, kind):
            return message
        if isinstance(message, FrameDone):
            screen.update(robot.bar, completed=message.frames)
        elif isinstance(message, TokenRequest):
            robot.pipe.send(IssuedToken(message.robot, platform.issue_token(message.robot)))
        elif isinstance(message, ChildFailed):
            raise message.error(robot.spec.name)
    raise CommandFailed(
        f"the process of {robot.spec.name} exited early", hint="check the memory of this machine"
    )


async def _messages(pipe: Connection) -> AsyncIterator[Any]:
    """Yield the messages of *pipe* until the other side closes it."""
    loop = asyncio.get_running_loop()
    readable = asyncio.Event()
    number = pipe.fileno()  # stored for the end, when the pipe is closed and has no file number any more
    loop.add_reader(number, readable.set)
    try:
        while True:
            while pipe.poll():
                try:
                    message = pipe.recv()
                except EOFError:
                    return
                yield message
            readable.clear()
            if not pipe.poll():
                await readable.wait()
    finally:
        loop.remove_reader(number)


def _end(robots: list[_Robot]) -> None:
    for robot in robots:
        end_process(robot.process, robot.pipe, _EXIT_TIMEOUT_S if robot.finished else 0.0)


def _merge(
    settings: PlatformSettings,
    folder: Path,
    finished: list[RobotFinished],
    platform: LocalPlatform,
    screen: Progress,
) -> dict[str, Any]:
    """Merge the maps that the robots have committed, on the platform; return the figures for the report."""
    names = robot_names(len(finished))
    url, token = platform.url, platform.issue_token("operator")
    return write_merged(
        folder,
        names,
        [robot.trajectory for robot in finished],
        [robot.truth for robot in finished],
        lambda _: merge_on_platform(url, token, names, settings.session, print_tenths(screen.print)),
    )


def _write_results(
    options: DemoOptions,
    folder: Path,
    finished: list[RobotFinished],
    before: dict[str, Any],
    merged: dict[str, Any] | None,
) -> dict[str, Any]:
    commands = [command for robot in finished for command in robot.commands]
    write_commands(folder / COMMANDS, commands)
    named = ("rate_hz", "engine", "codec", "seed", "frontend", "features")
    asked = {name: getattr(options, name) for name in named}
    asked["data"] = None if options.data is None else options.data.name
    report = make_report(finished, commands, asked, before, load_average())
    if merged is not None:
        report["merged"] = merged
    names = robot_names(len(finished))
    checks = {
        name: robot.check for name, robot in zip(names, finished, strict=True) if robot.check is not None
    }
    if checks:
        report["checks"] = checks
    if options.live:
        drives = read_live_drives(folder, names)
        live_map = read_live_map(folder)
        report["live"] = live_figures(drives, live_map)
        if live_map is not None:
            report |= {"store": f"dir:{folder / 'platform' / 'objects'}", "map": LIVE_NAME}
            if len(live_map.points):
                _draw_live_map(folder, live_map)
    write_json(folder / "report.json", report)
    (folder / "report.md").write_text(demo_page(report), encoding="utf-8")
    paths = [
        RobotPath(name=name, T_world_camera=robot.trajectory.T_world_camera)
        for name, robot in zip(names, finished, strict=True)
    ]
    clouds = [read_ply(folder / path.name / "map.ply") for path in paths]
    for path, (points, colours), robot in zip(paths, clouds, finished, strict=True):
        caption = f"{path.name}: {robot.frames} frames, {robot.lost_frames} lost, {len(points):,} points"
        draw_map(folder / path.name / "map.png", points, colours, [path], caption)
    # With --merge or --live each robot starts in a world frame of its own, and its cloud stays in that frame:
    # there is no picture of all clouds.
    in_one_frame = not options.merge and not options.live
    if len(paths) > 1 and in_one_frame and all(robot.truth is not None for robot in finished):
        points = np.concatenate([points for points, _ in clouds])
        colours = np.concatenate([colours for _, colours in clouds])
        caption = f"{len(paths)} robots, {sum(robot.frames for robot in finished)} frames, one world"
        draw_map(folder / "map.png", points, colours, paths, caption)
    return report


def _draw_live_map(folder: Path, version: MapVersion) -> None:
    """Draw ``map.png``: the cloud of a live map, with the poses of each robot's keyframes as its path."""
    by_robot: dict[str, list[Array]] = {}
    for keyframe in version.keyframes:
        by_robot.setdefault(keyframe.robot, []).append(keyframe.T_world_camera)
    paths = [RobotPath(name=name, T_world_camera=np.array(poses)) for name, poses in sorted(by_robot.items())]
    caption = f"{len(paths)} robots, {len(version.keyframes)} keyframes, {len(version.points):,} points"
    draw_map(folder / "map.png", version.points, version.colours, paths, f"live map: {caption}")


def _progress_bars(quiet: bool) -> Progress:
    """Return the display of progress bars below lines of text; with *quiet* it prints nothing."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    text = TextColumn("{task.description:<34}")
    columns = (text, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=Console(quiet=quiet, highlight=False))
