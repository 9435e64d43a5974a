"""Measure the floor plan of a live map while robots on wheels drive through one rendered building.

    python -m benchmarks live.floor_plan [--robots 3] [--building rooms] [--length-m 40] [--rounds 1]

Each robot is a process, which renders its frames first, then drives in a local platform with one server.
Each asks for the plan four times a second, as the bridge of ROS does.

``right_percent`` are the shares of correct cells in the last plan, after one alignment of the poses of all
robots with the truth (their error is ``ate_cm``): of all seen cells, the free and the
occupied ones.  A free cell is right if its centre is free in the building, an occupied cell if it is at most
a cell from a wall or furniture.  ``correction_ms`` is the time from a correction of a robot's alignment that
moves this robot by half a cell, or joins it to the map, until another robot has a plan that contains it.
``bytes_per_s`` are those of requests for plans and replies in the codec ``zlib``, with 100 for each message.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import multiprocessing
import os
import tempfile
import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from client_sdk import connect
from client_sdk.frontend import Frame
from client_sdk.live import LiveMapper
from client_sdk.robot import Robot
from client_sdk.simulator.base import T_BASE_CAMERA, drive_route, render_base
from client_sdk.simulator.building import BUILDINGS, Building, make_building
from client_sdk.trajectory import Trajectory
from client_sdk.trajectory_error import align, matched_poses, residuals_m, rms
from client_sdk.wheel_odometry import OdometryReading
from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.errors import RsePfError
from rse_pf.geometry import Array, inverse, transform
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.slam.occupancy import FREE, OCCUPIED, OccupancyGrid
from rse_pf.wire import Command, Result, make_codec
from rse_pf.wire.live_map import FLOOR_PLAN

MAP = "floor"
ASK_S = 0.25  # time between two requests for the plan, as in the bridge
MAX_AGE_S = 2.0  # age of a plan of a map that only grows
ROBOT_NICE = 5  # niceness of robots, which are other computers in the field
HALF_CELL_M = 0.025  # a correction that moves a robot less far changes no plan at once
OVERHEAD_BYTES = 100  # bytes of TCP, TLS and WebSocket for each message
LAST_ASK_S = 20.0  # longest time after the drive in which the plan may still change
START_APART_S = (
    1.0  # time from the start of a robot to that of the next one, so that the first begins the map
)


@dataclass(slots=True)
class Records:
    """What one robot received: times are those of the machine's monotonic clock.

    ``corrections`` are (time, position in the log, robot), ``plans`` (time, position in the log of a plan).
    """

    corrections: list[tuple[float, int, str]] = field(default_factory=list)
    plans: list[tuple[float, int]] = field(default_factory=list)
    bytes: int = 0
    changed_bytes: list[int] = field(default_factory=list)
    took_s: float = 0.0
    plan: OccupancyGrid | None = None
    lost_frames: int = 0
    keyframes: int = 0
    is_aligned: bool = False
    path: Trajectory | None = None
    truth: Trajectory | None = None


def run_robot(number: int, building_name: str, length_m: float, seed: int, pipe: Connection) -> None:
    """Render the drive of a robot, wait for the address and a token, drive, and send the records."""
    os.nice(ROBOT_NICE)
    building = make_building(building_name, 0)
    driven = drive_route(building, building.route(seed, length_m))
    frames = list(render_base(building, driven.truth, (seed, 37)))
    pipe.send("rendered")
    url, token, begin_s, rate_hz = pipe.recv()
    wheels = [
        [OdometryReading(timestamp_s=stamp_s, T_odom_base=pose) for stamp_s, pose in batch]
        for batch in driven.odometry(seed)
    ]
    drive = list(zip(frames, wheels, strict=False))
    records = asyncio.run(_drive(f"robot-{number}", drive, url, token, begin_s, rate_hz, pipe))
    records.truth = driven.truth
    pipe.send(records)


async def _drive(
    name: str,
    drive: list[tuple[Frame, list[OdometryReading]]],
    url: str,
    token: str,
    begin_s: float,
    rate_hz: float,
    pipe: Connection,
) -> Records:
    records = Records()
    async with connect(url, token=token) as robot:
        _count_bytes(robot, records)
        async with robot.live_map(MAP, depth=True, T_base_camera=T_BASE_CAMERA) as mapper:
            await asyncio.sleep(begin_s - time.monotonic())
            tasks = [
                asyncio.create_task(_follow(robot, mapper, name, records)),
                asyncio.create_task(_ask(mapper, records)),
            ]
            for row, (frame, readings) in enumerate(drive):
                await asyncio.sleep(begin_s + row / rate_hz - time.monotonic())
                await mapper.track(frame, odometry=readings)
            pipe.send("driven")
            await asyncio.to_thread(pipe.recv)
            records.took_s = time.monotonic() - begin_s
            records.lost_frames, records.keyframes = mapper.lost_frames, mapper.keyframes
            records.is_aligned, records.path = mapper.aligned, mapper.map_trajectory
            end_s = time.monotonic() + LAST_ASK_S
            while time.monotonic() < end_s and mapper.report()["live"]["points"]["waiting"]:
                await asyncio.sleep(ASK_S)
            end_s = time.monotonic() + LAST_ASK_S
            while records.plan is None and time.monotonic() < end_s:
                with contextlib.suppress(RsePfError):
                    records.plan = await mapper.floor_plan()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
    return records


def _count_bytes(robot: Robot, records: Records) -> None:
    """Record the size of each request for a plan and of its reply, and the plans with their times."""
    call, codec = robot.call, make_codec("zlib", SessionSettings())

    async def recorded(service: str, request: Any, *rest: Any, **more: Any) -> Any:
        answer = await call(service, request, *rest, **more)
        if service == FLOOR_PLAN:
            sent = codec.encode(Command(id=1000, service=service, payload=request, deadline_ms=5000.0))
            reply = codec.encode(Result(id=1000, reply=answer.reply, server="server-1", compute_ms=100.0))
            records.bytes += len(sent) + len(reply) + 2 * OVERHEAD_BYTES
            records.plans.append((time.monotonic(), answer.reply.version))
            if answer.reply.cells:
                records.changed_bytes.append(len(reply))
        return answer

    setattr(robot, "call", recorded)  # noqa: B010  mypy refuses the assignment to a method


async def _ask(mapper: LiveMapper, records: Records) -> None:
    while True:
        with contextlib.suppress(RsePfError):
            await mapper.floor_plan(max_age_s=MAX_AGE_S)
        await asyncio.sleep(ASK_S)


async def _follow(robot: Robot, mapper: LiveMapper, name: str, records: Records) -> None:
    """Record each correction of another robot that joins it, or moves it by half a cell."""
    before: dict[str, Array] = {}
    async for key, update in robot.subscribe(f"live/{MAP}"):
        if not key.startswith("alignment/") or not update["aligned"]:
            continue
        other, T = update["robot"], np.array(update["T_map_odom"]).reshape(4, 4)
        pose = mapper.others[other].T_map_camera if other in mapper.others else None
        moved_m = math.inf
        if other in before and pose is not None:
            moved_m = float(np.linalg.norm((T @ inverse(before[other]) @ pose - pose)[:3, 3]))
        before[other] = T
        if moved_m >= HALF_CELL_M and other != name:
            records.corrections.append((time.monotonic(), update["version"], other))


def right_percent(plan: OccupancyGrid, building: Building, T_building_map: Array) -> dict[str, Any]:
    """Return the shares of correct cells, and the numbers of free and occupied ones."""
    size_m = plan.resolution_m
    T = T_building_map @ inverse(plan.T_grid_world)

    def centres(state: int) -> Array:
        rows, columns = np.nonzero(plan.cells == state)
        x_m, y_m = plan.origin_m[0] + (columns + 0.5) * size_m, plan.origin_m[1] + (rows + 0.5) * size_m
        return transform(T, np.column_stack((x_m, y_m, np.zeros(len(x_m)))))

    apart_m = {
        state: np.array([building.distance_m(x, y) for x, y, _ in centres(state).tolist()])
        for state in (FREE, OCCUPIED)
    }
    free, occupied = apart_m[FREE] > 0.0, apart_m[OCCUPIED] <= size_m
    return {
        "all": 100.0 * float(np.r_[free, occupied].mean()),
        "free": 100.0 * float(free.mean()),
        "occupied": 100.0 * float(occupied.mean()),
        "occupied_in_the_wall": 100.0 * float((apart_m[OCCUPIED] <= size_m / 2).mean()),
        "free_cells": len(free),
        "occupied_cells": len(occupied),
    }


def aligned_map(records: list[Records]) -> tuple[Array, float]:
    """Return the pose ``(4, 4)`` of the map in the building by the poses of all robots, and their ATE, cm."""
    estimated, true = [], []
    for each in records:
        matched = None if each.path is None else matched_poses(each.path, each.truth)
        if each.path is not None and matched is not None:
            estimated.append(each.path.T_world_camera[matched[0], :3, 3])
            true.append((matched[1] @ T_BASE_CAMERA)[:, :3, 3])
    points, wanted = np.concatenate(estimated), np.concatenate(true)
    return align(points, wanted)[1], 100.0 * rms(residuals_m(points, wanted))


def delays_ms(records: list[Records]) -> list[float]:
    """Return the time from each correction until its receiver had a plan that contains it."""
    delays = []
    for robot in records:
        for at_s, version, _ in robot.corrections:
            later = [plan_s for plan_s, position in robot.plans if plan_s >= at_s and position >= version]
            if later:
                delays.append(1000.0 * (min(later) - at_s))
    return delays


async def _round(building: str, seeds: list[int], length_m: float, rate_hz: float) -> dict[str, Any]:
    context = multiprocessing.get_context("spawn")
    pipes, processes = [], []
    for number, seed in enumerate(seeds):
        pipe, child = context.Pipe()
        process = context.Process(target=run_robot, args=(number, building, length_m, seed, child))
        process.start()
        child.close()  # so that the end of a robot that fails is noticed
        pipes.append(pipe)
        processes.append(process)
    try:
        for pipe in pipes:
            await asyncio.to_thread(pipe.recv)
        with tempfile.TemporaryDirectory() as folder:
            settings = PlatformSettings()
            async with LocalPlatform(settings, state=Path(folder), servers=1, port=0, data=True) as cloud:
                begin_s = time.monotonic() + 3.0
                for number, pipe in enumerate(pipes):
                    token = cloud.issue_token(f"robot-{number}")
                    pipe.send((cloud.url, token, begin_s + number * START_APART_S, rate_hz))
                for order in ("driven", None):
                    records = [await asyncio.to_thread(pipe.recv) for pipe in pipes]
                    if order:
                        for pipe in pipes:
                            pipe.send("stop")
    finally:
        for process in processes:
            process.terminate()
    world, T_building_map, error_cm = make_building(building, 0), *aligned_map(records)
    rows = [right_percent(each.plan, world, T_building_map) for each in records if each.plan is not None]
    figures = {
        "aligned": sum(each.is_aligned for each in records),
        "keyframes": sum(each.keyframes for each in records),
        "lost_frames": sum(each.lost_frames for each in records),
        "ate_cm": error_cm,
        "plans": len(rows),
        "right_percent": rows[0] if rows else None,
        "corrections": sum(len(each.corrections) for each in records),
        "correction_ms": spread(delays_ms(records)),
        "bytes_per_s": [round(each.bytes / each.took_s) for each in records],
        "change_bytes": spread([size for each in records for size in each.changed_bytes]),
    }
    say(figures)
    return {**figures, "delays_ms": delays_ms(records)}


@benchmark(
    Bar("rounds.*.right_percent.all", at_least=95.0, unit="%"),
    Bar("rounds.*.right_percent.occupied", at_least=90.0, unit="%"),
    Bar("correction_ms.p99", at_most=1000.0, unit="ms"),
    Bar("rounds.*.bytes_per_s.*", at_most=20_000, unit="B/s"),
)
def run_benchmark(
    *,
    robots: int = 3,
    building: Annotated[str, "the building", BUILDINGS] = "rooms",
    length_m: Annotated[float, "least length of each drive, metres"] = 40.0,
    rate_hz: Annotated[float, "images that a robot tracks in a second; 5 are real time"] = 5.0,
    rounds: int = 1,
    first: Annotated[int, "seed of the first drive"] = 0,
) -> dict[str, Any]:
    """Drive the robots; the drives of each round differ."""
    made = []
    for turn in range(rounds):
        seeds = [first + turn * robots + number for number in range(robots)]
        made.append(asyncio.run(_round(building, seeds, length_m, rate_hz)))
    delays = [delay for row in made for delay in row.pop("delays_ms")]
    return {"correction_ms": spread(delays), "rounds": made}
