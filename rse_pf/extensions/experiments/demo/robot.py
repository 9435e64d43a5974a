"""One robot of the demo, in a process of its own: it tracks frames and writes its map and its records.

As a user's robot does, it uses the public SDK and a token, and no code of the platform.  It writes its files
even if frames were lost.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Frame, FrontEndOptions, PoseQuery, TrackedFrame
from client_sdk.live import LiveMapper, LiveOptions
from client_sdk.mapper import Mapper
from client_sdk.offloading.offload_policy import CloudFirst
from client_sdk.plugins import load_features
from client_sdk.point_map import write_ply
from client_sdk.pose_answers import ask_robot
from client_sdk.robot import Robot
from client_sdk.source_facts import unresolved
from client_sdk.trajectory import Trajectory, write_trajectory
from client_sdk.transfer.data_client import DataClient
from rse_pf.command_line.extras import is_installed
from rse_pf.config import SessionSettings
from rse_pf.errors import CommandFailed, RsePfError, UsageError, error_of_system
from rse_pf.extensions.experiments.child_process import ChildFailed, ChildReady, ParentPipe
from rse_pf.extensions.experiments.demo.live import LIVE_NAME, LiveRecorder
from rse_pf.extensions.experiments.demo.merge import MAP_FILE
from rse_pf.extensions.experiments.results.records import TRUTH, CommandRecord

if TYPE_CHECKING:
    from client_sdk.check.drive_check import DriveCheck
    from client_sdk.datasets import CameraChoice, Dataset

__all__ = ["DemoOptions", "FrameDone", "RobotFinished", "RobotSpec", "run_robot"]

# Niceness of the processes of robots: they share the machine with the servers, which must have priority.
_ROBOT_NICE = 5
# Smallest number of measurements of a point that is written to the cloud.
_MIN_MEASUREMENTS = 2
# Time, in seconds, before the deadline of a command at which a robot begins to solve the pose itself; long,
# because all robots and servers share one machine.
_OWN_SOLUTION_LEAD_S = 0.2
# Number of frames of each robot in the rendered world.
_DEFAULT_FRAMES = 80
# Number of frames of each robot in the rendered world if the maps of the robots are merged.
_MERGED_FRAMES = 150


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """Options of the demo.

    ``data`` None means the rendered world; ``camera`` and ``imu`` None mean the sensors that the recording
    has.
    """

    data: Path | None = None
    camera: CameraChoice | None = None
    imu: bool | None = None
    robots: int = 3
    rate_hz: float = 5.0
    engine: str = "native"
    codec: str = "zlib"
    out: Path = Path("out")
    frames: int | None = None
    seed: int = 0
    frontend: str = "standard"
    features: str | None = None
    merge: bool = False
    live: bool = False
    quiet: bool = False
    check: bool = False
    """Whether the drive of each robot over a recording is checked, as by ``rse-pf check``."""
    accepted: tuple[str, ...] = ()
    """Names of findings about the recording that the user accepts (``--accept``)."""
    shown: tuple[str, ...] = ()
    """Lines of findings about the recording that were printed before the drive."""

    @property
    def frame_count(self) -> int:
        """The number of frames of each robot in the rendered world.

        With --merge or --live the default is so large that each robot also sees a part of the next robot's
        path.
        """
        from client_sdk.simulator import frames_to_overlap

        if self.frames or not (self.merge or self.live):
            return self.frames or _DEFAULT_FRAMES
        return max(_MERGED_FRAMES, frames_to_overlap(self.robots))

    def share(self, robot: int) -> Dataset:
        """Return the part of the recording, or the rendered drive, that robot *robot* (from 0) plays.

        Raises UsageError.
        """
        from client_sdk.datasets import open_dataset
        from client_sdk.simulator import rendered_drive

        if self.data is None:
            return rendered_drive(robot, self.robots, self.frame_count, self.seed)
        recording = open_dataset(self.data, camera=self.camera, imu=self.imu)
        return recording.thinned(self.rate_hz).share(robot, self.robots)

    @property
    def frontend_options(self) -> FrontEndOptions:
        """The options of the robots' trackers."""
        wide = self.frontend == "wide-baseline"
        standard = FrontEndOptions.live() if self.live else FrontEndOptions()
        options = FrontEndOptions.wide_baseline() if wide else standard
        return options.sent_with(self.codec)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotSpec:
    """The description of one robot for its process.

    ``number`` counts from 0, ``folder`` is that of its files.
    """

    name: str
    number: int
    url: str
    folder: Path
    options: DemoOptions
    session: SessionSettings
    has_offload: bool = False
    """Whether the robot solves poses itself if the cloud does not answer, and stores keyframes on disk."""


@dataclass(frozen=True, slots=True)
class FrameDone:
    """Message of a robot to its parent: ``frames`` frames were rendered or, after the start, tracked."""

    frames: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotFinished:
    """Last message of a robot to its parent: its figures; its map and trajectory are in its folder.

    If ``is_metric`` is False, the unit of the trajectory is unknown.
    """

    frames: int
    lost_frames: int
    keyframes: int
    weak_poses: int
    map_points: int
    fps: float
    matches: list[int]
    inliers: list[int]
    commands: list[CommandRecord]
    trajectory: Trajectory
    truth: Trajectory | None
    truth_kind: str
    frames_before_start: int = 0
    """Number of frames before the first pose: a camera without depth must move first."""
    not_started_because: str = ""
    """Why a robot with a camera without depth has no pose at all; empty if it has one."""
    stats: dict[str, Any] = field(default_factory=dict)
    is_metric: bool = True
    check: dict[str, Any] | None = None
    """The result of the check of the drive; None if the drive was not checked."""


@dataclass(slots=True)
class _Drive:
    """The records of the robot while it drives: its commands, tracked frames, and number of weak poses."""

    commands: list[CommandRecord] = field(default_factory=list)
    tracked: list[TrackedFrame] = field(default_factory=list)
    weak_poses: int = 0


def run_robot(spec: RobotSpec, pipe: Connection) -> None:
    """Load the frames, connect, wait for the start, track all frames and report; entry point of the process.

    An error is sent to the parent as `ChildFailed`.
    """
    os.nice(_ROBOT_NICE)
    parent = ParentPipe(pipe, spec.name)
    parent.listen()
    try:
        asyncio.run(_run(spec, parent))
    except RsePfError as error:
        parent.send(ChildFailed(error.report()))
    except OSError as error:
        parent.send(ChildFailed(error_of_system(error).report()))
    except KeyboardInterrupt:
        pass


async def _run(spec: RobotSpec, pipe: ParentPipe) -> None:
    from client_sdk import connect

    options = spec.options
    recording = await asyncio.to_thread(_load, spec, pipe)
    truth = recording.truth

    async def token() -> str:
        return await asyncio.to_thread(pipe.fresh_token)

    offload = CloudFirst(slack_s=_OWN_SOLUTION_LEAD_S) if spec.has_offload else None
    async with connect(
        spec.url, token=token, codec=options.codec, settings=spec.session, offload=offload
    ) as robot:
        began = planned = 0.0
        drive = _Drive()

        async def ask(query: PoseQuery) -> PoseAnswer:
            return await _solve(robot, query, planned, began, spec, drive)

        mapper: Mapper | LiveMapper
        async with AsyncExitStack() as stack:
            if options.live:
                shared = LiveMapper(
                    robot, LIVE_NAME, ask=ask, options=options.frontend_options,
                    live=LiveOptions().sent_with(options.codec), features=load_features(options.features),
                    spool=spec.folder / "spool" if spec.has_offload else None, store=robot.store_object,
                )  # fmt: skip
                mapper = await stack.enter_async_context(shared)
            else:
                start = np.eye(4) if truth is None or options.merge else truth.T_world_camera[0]
                mapper = Mapper(
                    ask=ask, depth=recording.has_depth, options=options.frontend_options, T_world_start=start,
                    keyframes_of=spec.name if options.merge else "", features=load_features(options.features),
                )  # fmt: skip
            pipe.send(ChildReady(len(recording)))
            began = planned = await asyncio.to_thread(pipe.wait_start)
            recorder = LiveRecorder(shared, time.monotonic, began).start() if options.live else None
            check = _make_check(options, recording)
            first_s = time.monotonic()
            waiting = iter(recording)
            following: asyncio.Future[Any] = asyncio.ensure_future(asyncio.to_thread(next, waiting, None))
            for row in range(len(recording)):
                frame: Frame | None = await following
                if frame is None:  # the recording skips damaged images, so that there may be fewer frames
                    break
                planned = began + (row + spec.number / options.robots) / options.rate_hz
                await asyncio.sleep(max(0.0, planned - time.monotonic()))
                # The next frame is read while this one is tracked, as a camera's driver would.
                following = asyncio.ensure_future(asyncio.to_thread(next, waiting, None))
                done = await mapper.track(frame)
                if recorder is not None:
                    recorder.frame(done)
                drive.tracked.append(done)
                if check is not None:
                    await asyncio.to_thread(check.add, frame, done)
                pipe.send(FrameDone(row + 1))
            took_s = time.monotonic() - first_s
        if recorder is not None:
            await recorder.finish(spec.folder)
        trajectory = mapper.trajectory
        await asyncio.to_thread(_write, spec.folder, mapper, trajectory, truth)
        if isinstance(mapper, Mapper) and options.merge:
            await asyncio.to_thread(_upload_map, spec, mapper, pipe.token)
        pipe.send(
            RobotFinished(
                frames=mapper.frames,
                lost_frames=mapper.lost_frames,
                frames_before_start=mapper.frames_before_start,
                not_started_because=mapper.start_reason,
                keyframes=mapper.keyframes,
                weak_poses=drive.weak_poses,
                map_points=len(mapper.map),
                fps=mapper.frames / max(took_s, 1e-9),
                matches=[done.matches for done in drive.tracked[1:]],
                inliers=[done.inliers for done in drive.tracked[1:]],
                commands=drive.commands,
                trajectory=trajectory,
                truth=truth,
                truth_kind=recording.truth_kind,
                stats={"reconnects": robot.stats.reconnects, "resent": robot.stats.resent},
                is_metric=_is_metric(mapper),
                check=await asyncio.to_thread(_checked, check, mapper, recording, options.accepted),
            )
        )


def _make_check(options: DemoOptions, recording: Dataset) -> DriveCheck | None:
    """Return a check of the drive over a recording; None if none is wanted, or the extension was removed."""
    if not (options.check and options.data is not None and is_installed("client_sdk.check")):
        return None
    from client_sdk.check.drive_check import DriveCheck

    return DriveCheck(is_thinned=int(np.ptp(recording.rows)) >= len(recording))


def _checked(
    check: DriveCheck | None, mapper: Mapper | LiveMapper, recording: Dataset, accepted: Sequence[str]
) -> dict[str, Any] | None:
    """Return the result of *check*; None without a check.

    The keyframes of *mapper* may be changed, so this is called after the files of the robot were written.
    """
    if check is None:
        return None
    from client_sdk.check.motion import MotionReference

    reference = MotionReference.of_truth(recording)
    tracked = mapper if isinstance(mapper, Mapper) else None
    return check.finish(tracked, reference, unresolved(recording.log.doubts, accepted), accepted)


def _is_metric(mapper: Mapper | LiveMapper) -> bool:
    """Return whether the odometry is in metres; that of a camera without depth in a live map never is."""
    return mapper.scale.startswith("metric") and getattr(mapper, "metres_per_unit", 1.0) == 1.0


async def _solve(
    robot: Robot, query: PoseQuery, planned: float, began: float, spec: RobotSpec, drive: _Drive
) -> PoseAnswer:
    """Request the pose of *query* from the platform, record the command in *drive*, and return the answer.

    A failure is recorded and raised.
    """
    sent = time.monotonic()
    record = CommandRecord(
        id=len(drive.commands) + 1,
        robot=spec.name,
        planned=round(planned - began, 6),
        sent=round(sent - began, 6),
        answered=None,
        server="",
        code="",
    )
    try:
        answer = await ask_robot(robot.solve_pnp, spec.session.answer_timeout_s)(query)
    except RsePfError as error:
        drive.commands.append(replace(record, answered=_since(began), code=error.code))
        raise
    drive.commands.append(
        replace(
            record,
            answered=_since(began),
            server=answer.server,
            code="ok",
            source=answer.source,
            payload_bytes=answer.payload_bytes,
            round_trip_ms=answer.round_trip_ms,
            up_ms=answer.up_ms,
            queue_ms=answer.queue_ms,
            compute_ms=answer.compute_ms,
            down_ms=answer.down_ms,
        )
    )
    drive.weak_poses += answer.solution.verdict == "weak"
    return answer


def _since(began: float) -> float:
    return round(time.monotonic() - began, 6)


def _load(spec: RobotSpec, pipe: ParentPipe) -> Dataset:
    """Return the recording that the robot plays; a rendered one is rendered here, before the start."""
    recording = spec.options.share(spec.number)
    for row in recording.rows if spec.options.data is None else ():
        recording.read(row)
        pipe.send(FrameDone(row + 1))
    return recording


def _write(
    folder: Path, mapper: Mapper | LiveMapper, trajectory: Trajectory, truth: Trajectory | None
) -> None:
    """Write cloud and trajectory of the robot, and its truth if that is known."""
    points, colours = mapper.map.points(min_readings=_MIN_MEASUREMENTS)
    write_ply(folder / "map.ply", points, colours)
    write_trajectory(
        folder / "trajectory.txt",
        trajectory,
        is_metric=_is_metric(mapper),
        T_body_camera=mapper.T_body_camera,
    )
    if truth is not None:
        write_trajectory(folder / TRUTH, truth)


def _upload_map(spec: RobotSpec, mapper: Mapper, token: Callable[[], str]) -> None:
    """Write the robot's keyframes and cloud to its folder, and commit them as the map of the robot's name.

    Raises:
        CommandFailed: No keyframe has a pose in metres.
    """
    try:
        encoded = mapper.encoded_map()
    except UsageError as error:
        raise CommandFailed(
            "no keyframe has a pose in metres, so there is nothing to merge",
            hint="let the robot have depth, and play more frames",
        ) from error
    (spec.folder / MAP_FILE).write_bytes(encoded)
    client = DataClient(spec.url, token)
    try:
        client.update_map(spec.name, encoded, note="a drive of the demo")
    finally:
        client.close()
