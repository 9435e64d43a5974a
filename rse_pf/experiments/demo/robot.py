"""One robot of the demo, in a process of its own: frames in, a map and its records out.

It is what a user's robot would be: the public SDK, a token, and nothing of the platform.  Promises
to talk to its parent through one pipe only, and to leave its files even if frames were lost.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.frontend import Frame, FrontEndOptions, PoseQuery, TrackedFrame, Tracker
from client_sdk.mapping import MapOptions, PointMap, Trajectory, write_ply, write_trajectory
from rse_pf.config import DataSettings, SessionSettings
from rse_pf.errors import RsePfError
from rse_pf.experiments.demo.keyframes import MAP_FILE, KeyframeKeeper, KeyframeUploads
from rse_pf.experiments.demo.parent_pipe import ParentPipe
from rse_pf.experiments.results.report import CommandRecord
from rse_pf.geometry import Array
from rse_pf.pnp import PnpOptions

__all__ = ["Failed", "Finished", "Progress", "Ready", "RobotSpec", "run_robot"]

_PRUNE_READINGS = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotSpec:
    """What the parent tells a robot before it starts."""

    name: str
    number: int
    robots: int
    url: str
    codec: str
    rate_hz: float
    folder: Path
    data: Path | None
    frames: int
    seed: int
    frontend: FrontEndOptions
    session: SessionSettings
    merge: bool = False
    """Whether it keeps its keyframes and starts in a world of its own, not at its true pose."""
    data_settings: DataSettings | None = None
    """How it uploads keyframes and map to the data service; None if the platform has none."""


@dataclass(frozen=True, slots=True)
class Ready:
    """The robot has its frames and is connected."""

    frames: int


@dataclass(frozen=True, slots=True)
class Progress:
    """A frame is loaded, or (while playing) done."""

    frames: int
    lost: bool = False


@dataclass(frozen=True, slots=True)
class Failed:
    """The robot cannot go on."""

    report: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """What a robot leaves to its parent; its map and trajectory are in its folder."""

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
    stats: dict[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class _Diary:
    """What the robot writes down as it goes."""

    commands: list[CommandRecord] = field(default_factory=list)
    tracked: list[TrackedFrame] = field(default_factory=list)
    weak_poses: int = 0
    asking: bool = False
    """Whether a live pose is on its way: keyframes wait."""


def run_robot(spec: RobotSpec, pipe: Connection) -> None:
    """Load the frames, connect, wait for the start, play; the entry point of the process."""
    parent = ParentPipe(pipe)
    parent.listen()
    try:
        asyncio.run(_run(spec, parent))
    except RsePfError as error:
        parent.send(Failed(error.report()))
    except KeyboardInterrupt:
        pass


async def _run(spec: RobotSpec, pipe: ParentPipe) -> None:
    from client_sdk import connect

    frames, truth, truth_kind = await asyncio.to_thread(_load, spec, pipe)

    async def token() -> str:
        return await asyncio.to_thread(pipe.fresh_token)

    async with connect(spec.url, token=token, codec=spec.codec, settings=spec.session) as robot:
        pipe.send(Ready(len(frames)))
        began = await asyncio.to_thread(pipe.wait_start)
        start = np.eye(4) if truth is None or spec.merge else truth.T_world_camera[0]
        tracker = Tracker(spec.frontend, T_world_start=start)
        point_map = PointMap(MapOptions())
        diary = _Diary()
        keeper = _keeper(spec, pipe.token, lambda: diary.asking)
        first_s = time.monotonic()
        for row, frame in enumerate(frames):
            planned = began + (row + spec.number / spec.robots) / spec.rate_hz
            await asyncio.sleep(max(0.0, planned - time.monotonic()))
            done = await _track(robot, tracker, frame, planned, began, spec, diary)
            if done.T_world_camera is not None:
                await asyncio.to_thread(point_map.add, frame, done.T_world_camera)
                if keeper is not None:
                    await asyncio.to_thread(keeper.see, done)
            diary.tracked.append(done)
            pipe.send(Progress(row + 1, done.lost))
        took_s = time.monotonic() - first_s
        trajectory = _trajectory(diary.tracked)
        await asyncio.to_thread(_write, spec.folder, point_map, trajectory, keeper)
        pipe.send(
            Finished(
                frames=tracker.frames,
                lost_frames=tracker.lost_frames,
                keyframes=tracker.keyframes,
                weak_poses=diary.weak_poses,
                map_points=len(point_map),
                fps=tracker.frames / max(took_s, 1e-9),
                matches=[done.matches for done in diary.tracked[1:]],
                inliers=[done.inliers for done in diary.tracked[1:]],
                commands=diary.commands,
                trajectory=trajectory,
                truth=truth,
                truth_kind=truth_kind,
                stats={
                    "reconnects": robot.stats.reconnects,
                    "resent": robot.stats.resent,
                    "keyframes_uploaded": 0 if keeper is None else keeper.uploaded,
                },
            )
        )


async def _track(
    robot: Any,
    tracker: Tracker,
    frame: Frame,
    planned: float,
    began: float,
    spec: RobotSpec,
    diary: _Diary,
) -> TrackedFrame:
    """Ask the cloud until the frame has a pose or is lost."""
    step = await asyncio.to_thread(tracker.prepare, frame)
    while isinstance(step, PoseQuery):
        T_camera_world, inliers = await _solve(robot, step, planned, began, spec, diary)
        step = await asyncio.to_thread(tracker.accept, step, T_camera_world, inliers)
    return step


async def _solve(
    robot: Any, query: PoseQuery, planned: float, began: float, spec: RobotSpec, diary: _Diary
) -> tuple[Array | None, int]:
    options = PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations)
    sent = time.monotonic()
    record = CommandRecord(
        id=len(diary.commands) + 1,
        robot=spec.name,
        planned=round(planned - began, 6),
        sent=round(sent - began, 6),
        answered=None,
        server="",
        code="",
    )
    diary.asking = True
    try:
        answer = await robot.solve_pnp(
            query.correspondences.points_world,
            query.correspondences.pixels,
            query.camera,
            options,
            deadline_s=spec.session.answer_timeout_s,
            keep=True,
        )
    except RsePfError as error:
        diary.commands.append(replace(record, answered=_since(began), code=error.code))
        return None, 0
    finally:
        diary.asking = False
    diary.commands.append(
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
    diary.weak_poses += answer.solution.verdict == "weak"
    return answer.solution.T_camera_world, len(answer.solution.inliers)


def _since(began: float) -> float:
    return round(time.monotonic() - began, 6)


def _load(spec: RobotSpec, pipe: ParentPipe) -> tuple[Any, Trajectory | None, str]:
    """Return frames, truth and what kind of truth it is; rendered frames are made beforehand."""
    if spec.data is not None:
        from client_sdk.datasets import open_dataset

        recording = open_dataset(spec.data).thinned(spec.rate_hz).share(spec.number, spec.robots)
        return recording, recording.truth, recording.truth_kind
    from client_sdk.simulator import render_frames, true_trajectory

    truth = true_trajectory(spec.number, spec.robots, spec.frames, spec.seed)
    frames: list[Frame] = []
    for frame in render_frames(spec.number, spec.robots, spec.frames, spec.seed):
        frames.append(frame)
        pipe.send(Progress(len(frames)))
    return frames, truth, "ground truth"


def _trajectory(tracked: Iterable[TrackedFrame]) -> Trajectory:
    posed = [done for done in tracked if done.T_world_camera is not None]
    poses = [done.T_world_camera for done in posed]
    return Trajectory(
        np.array([done.frame.timestamp_s for done in posed]),
        np.array(poses, dtype=np.float64).reshape(-1, 4, 4),
    )


def _keeper(spec: RobotSpec, token: Callable[[], str], is_busy: Callable[[], bool]) -> KeyframeKeeper | None:
    if not spec.merge:
        return None
    if spec.data_settings is None:
        return KeyframeKeeper(spec.name, spec.frontend)
    uploads = KeyframeUploads(spec.url, token, spec.folder / "spool", spec.data_settings, is_busy)
    return KeyframeKeeper(spec.name, spec.frontend, uploads)


def _write(folder: Path, point_map: PointMap, trajectory: Trajectory, keeper: KeyframeKeeper | None) -> None:
    points, colours = point_map.points(min_readings=_PRUNE_READINGS)
    write_ply(folder / "map.ply", points, colours)
    write_trajectory(folder / "trajectory.txt", trajectory)
    if keeper is not None:
        data = keeper.encoded_map(points, colours)
        (folder / MAP_FILE).write_bytes(data)
        keeper.share(data)
