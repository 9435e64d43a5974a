"""The demo: robots build point-cloud maps through the PnP service, on one machine.

Starts the local platform with real servers behind a real balancer, runs every robot as a process,
and leaves maps, trajectories, pictures and a report.  Promises to leave nothing running.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import shutil
import time
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.frontend import FrontEndOptions
from client_sdk.mapping import read_ply
from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.experiments.demo import report as demo_report
from rse_pf.experiments.demo.merge import MERGED_MAP, write_merged
from rse_pf.experiments.demo.merge_client import merge_there, tenths
from rse_pf.experiments.demo.parent_pipe import TokenWanted
from rse_pf.experiments.demo.robot import Failed, Finished, Progress, Ready, RobotSpec, run_robot
from rse_pf.experiments.plots.map_image import PathOfRobot, draw_map
from rse_pf.experiments.results.report import EventLog, environment, write_commands, write_json
from rse_pf.local.control.platform import LocalPlatform

__all__ = ["DemoOptions", "run_demo"]

_DEFAULT_FRAMES = 80
_MERGE_FRAMES = 150
"""So far that each of three robots comes to see what the next one saw at its start."""
_LOST_AFTER_S = 5.0
_START_TIMEOUT_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """What the command line says; ``data`` None means the rendered world."""

    data: Path | None = None
    robots: int = 3
    rate_hz: float = 5.0
    engine: str = "poselib"
    codec: str = "zlib"
    out: Path = Path("out")
    frames: int | None = None
    seed: int = 0
    frontend: str = "standard"
    merge: bool = False
    quiet: bool = False


@dataclass(slots=True, kw_only=True)
class _Robot:
    """A robot's process as its parent sees it."""

    spec: RobotSpec
    process: Any
    pipe: Connection
    finished: Finished | None = None


def run_demo(options: DemoOptions, settings: PlatformSettings) -> int:
    """Run the demo and return the exit code: 0 if every command came to an end."""
    folder = _fresh_folder(options.out)
    chosen = settings.replace(pnp={"engine": options.engine})
    with (folder / "events.jsonl").open("w", encoding="utf-8") as file:
        report = asyncio.run(_run(options, chosen, folder, EventLog(file)))
    print(demo_report.closing_lines(report, folder))
    return 0 if report["commands"]["lost"] == 0 else 1


async def _run(
    options: DemoOptions, settings: PlatformSettings, folder: Path, events: EventLog
) -> dict[str, Any]:
    before = environment(settings)
    origin = time.monotonic()

    def now() -> float:
        return time.monotonic() - origin

    def tell(event: Mapping[str, Any]) -> None:
        events.write(now(), str(event["event"]), **{k: v for k, v in event.items() if k != "event"})

    with _screen(options) as screen:
        screen.say("starting the platform: Envoy and two servers")
        async with LocalPlatform(
            settings, port=0, state=folder / "platform", name="demo", on_event=tell, data=options.merge
        ) as cloud:
            pids = ", ".join(f"{server.name} {server.pid}" for server in cloud.servers)
            screen.say(f"running at {cloud.url}: {pids} (kill -9 one, and watch the robots go on)")
            samples = asyncio.create_task(_sample(cloud, folder / "samples.csv", now))
            robots = [
                _start(options, settings, folder, cloud.url, number) for number in range(options.robots)
            ]
            try:
                await _play(robots, cloud, screen, events, now)
            finally:
                samples.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await samples
                _end(robots)
            finished = [robot.finished for robot in robots if robot.finished is not None]
            if len(finished) < len(robots):
                raise CommandFailed(
                    "a robot ended before its last frame", hint=f"look at {folder}/platform/*.log"
                )
            merged = None
            if options.merge:
                screen.say("merging the maps")
                merged = await asyncio.to_thread(_merge, settings, folder, finished, cloud, screen)
                events.write(now(), "merged", joined=merged["joined"])
    for secret in ("key.json", "keys.json"):
        (folder / "platform" / secret).unlink(missing_ok=True)
    screen.say("drawing the maps")
    return _judge(options, folder, finished, before, merged)


def _start(options: DemoOptions, settings: PlatformSettings, folder: Path, url: str, number: int) -> _Robot:
    name = _name(number)
    (folder / name).mkdir()
    frontend = FrontEndOptions.wide_baseline() if options.frontend == "wide-baseline" else FrontEndOptions()
    spec = RobotSpec(
        name=name,
        number=number,
        robots=options.robots,
        url=url,
        codec=options.codec,
        rate_hz=options.rate_hz,
        folder=folder / name,
        data=options.data,
        frames=options.frames or (_MERGE_FRAMES if options.merge else _DEFAULT_FRAMES),
        seed=options.seed,
        frontend=frontend,
        session=settings.session,
        merge=options.merge,
        data_settings=settings.data if options.merge else None,
    )
    context = multiprocessing.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=run_robot, args=(spec, theirs), name=name, daemon=True)
    process.start()
    theirs.close()
    return _Robot(spec=spec, process=process, pipe=mine)


async def _play(
    robots: list[_Robot], cloud: LocalPlatform, screen: _Screen, events: EventLog, now: Callable[[], float]
) -> None:
    """Wait until all are ready, start them together, follow them to their end."""
    inboxes = [_messages(robot.pipe) for robot in robots]
    screen.phase("rendering the world" if robots[0].spec.data is None else "reading the recording", robots)
    await asyncio.gather(*(_until_ready(*pair, cloud, screen) for pair in zip(robots, inboxes, strict=True)))
    began = time.monotonic() + 0.2
    events.write(now(), "robots-start", robots=len(robots))
    screen.say("the robots start")
    screen.phase("mapping", robots)
    for robot in robots:
        robot.pipe.send(began)
    await asyncio.gather(
        *(_until_finished(*pair, cloud, screen) for pair in zip(robots, inboxes, strict=True))
    )
    events.write(now(), "robots-end")


async def _until_ready(
    robot: _Robot, inbox: AsyncIterator[Any], cloud: LocalPlatform, screen: _Screen
) -> None:
    async for message in inbox:
        if isinstance(message, Ready):
            screen.total(robot.spec.name, message.frames)
            return
        _handle(robot, message, cloud, screen)
    raise CommandFailed(f"{robot.spec.name} ended before it was ready")


async def _until_finished(
    robot: _Robot, inbox: AsyncIterator[Any], cloud: LocalPlatform, screen: _Screen
) -> None:
    async for message in inbox:
        if isinstance(message, Finished):
            robot.finished = message
            return
        _handle(robot, message, cloud, screen)
    raise CommandFailed(f"{robot.spec.name} ended before its last frame")


def _handle(robot: _Robot, message: Any, cloud: LocalPlatform, screen: _Screen) -> None:
    if isinstance(message, Progress):
        screen.advance(robot.spec.name, message)
    elif isinstance(message, TokenWanted):
        robot.pipe.send(cloud.issue_token(robot.spec.name))
    elif isinstance(message, Failed):
        what, _, hint = message.report.partition("\n  hint: ")
        raise CommandFailed(f"{robot.spec.name}: {what}", hint=hint)


async def _messages(pipe: Connection) -> AsyncIterator[Any]:
    """Yield what comes through *pipe* until the other side closes it."""
    loop = asyncio.get_running_loop()
    readable = asyncio.Event()
    number = pipe.fileno()  # a pipe that was closed while we waited does not tell it any more
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


async def _sample(cloud: LocalPlatform, path: Path, now: Callable[[], float]) -> None:
    """Write what the servers say of themselves twice a second."""
    with path.open("w", encoding="utf-8") as file:
        file.write("time,server,pid,robots,requests,queue,in_flight,cpu_s\n")
        while True:
            for status in await cloud.status():
                row = [
                    status.get(name, "")
                    for name in ("server", "pid", "robots", "requests", "queue", "in_flight", "cpu_s")
                ]
                file.write(f"{now():.3f}," + ",".join(str(value) for value in row) + "\n")
            file.flush()
            await asyncio.sleep(0.5)


def _end(robots: list[_Robot]) -> None:
    for robot in robots:
        robot.process.join(timeout=_LOST_AFTER_S if robot.finished else 0.0)
        if robot.process.is_alive():
            robot.process.kill()
            robot.process.join()
        robot.pipe.close()


def _merge(
    settings: PlatformSettings, folder: Path, finished: list[Finished], cloud: LocalPlatform, screen: _Screen
) -> dict[str, Any]:
    """Merge on the platform the maps that the robots have committed."""
    names = [_name(number) for number in range(len(finished))]
    url, token = cloud.url, cloud.issue_token("operator")
    section = write_merged(
        folder,
        names,
        [robot.trajectory for robot in finished],
        [robot.truth for robot in finished],
        lambda _: merge_there(url, token, names, settings.session, tenths(screen.say)),
    )
    section["keyframes_uploaded"] = sum(robot.stats["keyframes_uploaded"] for robot in finished)
    return section


def _name(number: int) -> str:
    return f"robot-{number + 1}"


def _judge(
    options: DemoOptions,
    folder: Path,
    finished: list[Finished],
    before: dict[str, Any],
    merged: dict[str, Any] | None,
) -> dict[str, Any]:
    commands = [command for robot in finished for command in robot.commands]
    write_commands(folder / "commands.csv", commands)
    after = [round(value, 2) for value in os.getloadavg()]
    asked = {**{name: getattr(options, name) for name in ("rate_hz", "engine", "codec", "seed", "frontend")}}
    asked["data"] = None if options.data is None else options.data.name
    report = demo_report.make_report(finished, commands, asked, before, after)
    if merged is not None:
        report["merged"] = merged
    write_json(folder / "report.json", report)
    (folder / "report.md").write_text(demo_report.as_markdown(report), encoding="utf-8")
    paths = [
        PathOfRobot(name=_name(number), T_world_camera=robot.trajectory.T_world_camera)
        for number, robot in enumerate(finished)
    ]
    clouds = [read_ply(folder / path.name / "map.ply") for path in paths]
    for path, (points, colours), robot in zip(paths, clouds, finished, strict=True):
        caption = f"{path.name}: {robot.frames} frames, {robot.lost_frames} lost, {len(points):,} points"
        draw_map(folder / path.name / "map.png", points, colours, [path], caption)
    # Robots that merge start in worlds of their own: side by side in one picture they would tell a lie.
    if len(paths) > 1 and not options.merge and all(robot.truth is not None for robot in finished):
        points = np.concatenate([points for points, _ in clouds])
        colours = np.concatenate([colours for _, colours in clouds])
        caption = f"{len(paths)} robots, {sum(robot.frames for robot in finished)} frames, one world"
        draw_map(folder / "map.png", points, colours, paths, caption)
    return report


def _fresh_folder(folder: Path) -> Path:
    """Make *folder*; what an earlier run left in it is replaced, anything else is not touched."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", hint="name a folder with --out")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / "events.jsonl").exists():
            raise UsageError(f"{folder} holds other files", hint="name an empty folder with --out")
        for old in [folder / "platform", *folder.glob("robot-*")]:
            shutil.rmtree(old, ignore_errors=True)
        written = ("report.json", "report.md", "commands.csv", "samples.csv", "map.png")
        for name in (*written, "map_merged.png", "merged.ply", MERGED_MAP):
            (folder / name).unlink(missing_ok=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write {folder}: {error.strerror}", hint="name another --out") from error
    return folder.resolve()


class _Screen:
    """Progress bars, or nothing."""

    def __init__(self, progress: Any | None) -> None:
        self._progress = progress
        self._tasks: dict[str, Any] = {}
        self._lost: dict[str, int] = {}

    def say(self, text: str) -> None:
        """Print one line."""
        if self._progress is not None:
            self._progress.console.print(text, highlight=False)

    def phase(self, name: str, robots: list[_Robot]) -> None:
        """Start the bars of a phase anew."""
        if self._progress is None:
            return
        for robot in robots:
            key = robot.spec.name
            total = self._progress.tasks[self._tasks[key]].total if key in self._tasks else robot.spec.frames
            if key in self._tasks:
                self._progress.reset(self._tasks[key], total=total, description=f"{key}  {name}")
            else:
                self._tasks[key] = self._progress.add_task(f"{key}  {name}", total=total)

    def total(self, name: str, frames: int) -> None:
        """Tell how many frames a robot has."""
        if self._progress is not None:
            self._progress.update(self._tasks[name], total=frames)

    def advance(self, name: str, progress: Progress) -> None:
        """Move a robot's bar."""
        if self._progress is not None:
            self._progress.update(self._tasks[name], completed=progress.frames)


@contextlib.contextmanager
def _screen(options: DemoOptions) -> Any:
    if options.quiet:
        yield _Screen(None)
        return
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    columns = (TextColumn("{task.description:<34}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Bars(*columns) as progress:
        yield _Screen(progress)
