"""A merge of many keyframes while robots request poses, and a crash of its server half-way.

    python -m benchmarks data.jobs [--robots 20] [--keyframes 50] [--seconds 20] [--recordings DIR]


Two local servers behind the balancer; robots request 5 poses per second (200 matches, 30 % wrong, every
frame kept).  First without merges, then one merge after the other, then a merge's server is killed
with -9 when its job reports half.  Without recordings the keyframes come from the simulated world.

Defends: pose p99 during the merges <= 1.3 x before; the killed merge ends on the other server, and its
result has the same digest as an undisturbed one.  Start it in the ordinary scheduling class: under
``chrt -i 0`` jobs have no lower priority than robots, and the ratio is meaningless.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

import client_sdk
from benchmarks.data.windows import poses
from benchmarks.frame.registry import Bar, benchmark
from client_sdk.datasets import open_dataset
from client_sdk.frontend import Frame, FrontEndOptions, extract
from client_sdk.simulator import render_frames, true_trajectory
from rse_pf.config import PlatformSettings
from rse_pf.experiments.load.scenario import LoadScenario
from rse_pf.experiments.load.swarm import Swarm
from rse_pf.geometry import Array, inverse
from rse_pf.identity import RobotId, object_name
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.maps.format import Keyframe, MapVersion, encode_map
from rse_pf.object_store import digest_of, open_store
from rse_pf.services.mapping.merge import MergeReply
from rse_pf.wire import as_type

BAR = 1.3
HALF = 0.4
"""Share at which the server is killed: matching goes from 0.1 to 0.8."""
SETTLE_S = 2.0
FRAME_STEP = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    robots: int = 20
    fps: float = 5.0
    keyframes: int = 50
    seconds: Annotated[float, "of each phase"] = 20.0
    recordings: Annotated[Path | None, "folder of recordings; without it, the simulated world"] = None


def frames_of(recordings: Path | None, count: int) -> Iterator[tuple[Frame, Array]]:
    """Yield *count* frames and their true poses: the red kitchen, or the simulated world."""
    if recordings is None:
        truth = true_trajectory(0, 1, count * 2, 7)
        for row, frame in enumerate(render_frames(0, 1, count * 2, 7)):
            if row % 2 == 0:
                yield frame, truth.T_world_camera[row]
        return
    dataset = open_dataset(recordings / "7scenes_redkitchen")
    assert dataset.truth is not None
    stamps = np.asarray(dataset.truth.timestamps_s)
    for row in itertools.islice(itertools.cycle(range(0, 250, FRAME_STEP)), count):
        frame = dataset.read(row)
        nearest = int(np.argmin(np.abs(stamps - frame.timestamp_s)))
        yield frame, np.asarray(dataset.truth.T_world_camera)[nearest]


def two_maps(recordings: Path | None, count: int) -> list[bytes]:
    """Return two robots' encoded maps with *count* keyframes in all, each in a world of its own."""
    kept: tuple[list[Keyframe], list[Keyframe]] = ([], [])
    firsts: list[Array] = []
    for number, (frame, T_world_camera) in enumerate(frames_of(recordings, count)):
        mine = kept[number % 2]
        if not mine:
            firsts.append(inverse(T_world_camera))
        features = extract(frame, FrontEndOptions())
        mine.append(
            Keyframe(
                id=len(mine), robot=f"robot-{number % 2}", timestamp_s=frame.timestamp_s, camera=frame.camera,
                T_world_camera=firsts[number % 2] @ T_world_camera, pixels=features.pixels.astype(np.float32),
                descriptors=features.descriptors, points_camera=features.points_camera.astype(np.float32),
            )
        )  # fmt: skip
    return [encode_map(MapVersion(keyframes=tuple(keyframes))) for keyframes in kept]


class Bench:
    """One run: a platform, robots that stream, and robots that merge."""

    def __init__(self, args: Options, cloud: LocalPlatform, maps: list[bytes]) -> None:
        self.args = args
        self.cloud = cloud
        self.maps = maps

    def request(self, robot: str, **options: float) -> dict[str, Any]:
        """Store the maps as objects of *robot*, and return the request that names them."""
        store = open_store(f"dir:{self.cloud.state / 'objects'}")
        for data in self.maps:
            store.put(object_name(RobotId("default", robot), digest_of(data)), data)
        request: dict[str, Any] = {"maps": [{"object": digest_of(data)} for data in self.maps]}
        if options:
            request["options"] = options
        return request

    def robot(self, name: str) -> client_sdk.Robot:
        """Return the robot *name*, to be connected."""
        return client_sdk.connect(self.cloud.url, token=self.cloud.issue_token(name))

    async def merges(self, until_s: float) -> list[float]:
        """Merge again and again, each time a little differently, and return how long each took (s)."""
        took: list[float] = []
        async with self.robot("mapper") as robot:
            while time.monotonic() < until_s:
                request = self.request("mapper", cauchy=3.0 + 0.001 * len(took))
                began = time.monotonic()
                await robot.call("merge", request, on_progress=lambda done, what: None)
                took.append(time.monotonic() - began)
        return took

    async def run_undisturbed(self) -> tuple[str, Any, float]:
        """Return the digest of the result, the result, and how long it took (s)."""
        async with self.robot("reference") as robot:
            began = time.monotonic()
            answer = await robot.call("merge", self.request("reference"), on_progress=lambda done, what: None)
            return answer.object, answer.reply, time.monotonic() - began

    async def run_killed(self) -> dict[str, Any]:
        """Kill the server of a merge half-way; return where and when it ended."""
        half = asyncio.Event()
        heard: list[tuple[float, float, str]] = []

        def hear(done: float, what: str) -> None:
            heard.append((time.monotonic(), done, what))
            if done >= HALF:
                half.set()

        async with self.robot("victim") as robot:
            first = robot.stats.server
            task = asyncio.create_task(robot.call("merge", self.request("victim"), on_progress=hear))
            await asyncio.wait({task, asyncio.ensure_future(half.wait())}, return_when="FIRST_COMPLETED")
            was_under_way = not task.done()
            self.cloud.kill(first)
            began = time.monotonic()
            answer = await task
            told_s = max((stamp for stamp, done, _ in heard if stamp > began), default=began)
            return {
                "killed": first, "ended_on": answer.server, "was_under_way": was_under_way,
                "s_after_kill": time.monotonic() - began, "last_progress_s": told_s - began,
                "object": answer.object,
            }  # fmt: skip


async def run(args: Options) -> dict[str, Any]:
    """Return every figure of the table."""
    maps = two_maps(args.recordings, args.keyframes)
    settings = PlatformSettings.from_dict({"local": {"servers": 2}})
    with tempfile.TemporaryDirectory() as folder:
        async with LocalPlatform(settings, state=Path(folder), port=0, servers=2) as cloud:
            bench = Bench(args, cloud, maps)
            origin = time.monotonic()
            options = LoadScenario(robots=args.robots, fps=args.fps, join_every_s=0.02)
            swarm = Swarm(
                options, url=cloud.url, token_of=cloud.issue_token, session=settings.session, origin=origin
            )
            async with swarm:
                await swarm.start()
                await swarm.wait_joined(30.0)
                await asyncio.sleep(SETTLE_S)
                before = time.monotonic() - origin
                await asyncio.sleep(args.seconds)
                during = time.monotonic() - origin
                took = await bench.merges(time.monotonic() + args.seconds)
                after = time.monotonic() - origin
                reference, reply, alone_s = await bench.run_undisturbed()
                death = await bench.run_killed()
                result = await swarm.finish()
    poses_of = [poses(result.commands, before, during), poses(result.commands, during, after)]
    return {
        "keyframes": args.keyframes, "map_bytes": [len(data) for data in maps], "merges_s": took,
        "merge_alone_s": alone_s, "joined": _read_joins(reply), "before": poses_of[0], "during": poses_of[1],
        "ratio": poses_of[1]["p99_ms"] / poses_of[0]["p99_ms"], "death": death,
        "same_digest": death["object"] == reference, "late_sends_ms": result.late_sends_ms_p99,
    }  # fmt: skip


def _read_joins(reply: Any) -> Any:
    """Return which maps the result holds; None where the reply was too large for a message."""
    return None if reply is None else as_type(reply, MergeReply).joined


@benchmark(
    Bar("ratio", at_most=BAR, unit="times the p99"),
    Bar("same_digest", equals=True),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Measure poses beside merges; a run in the idle class says nothing of the ratio."""
    is_idle_class = os.sched_getscheduler(0) == os.SCHED_IDLE
    return {"is_idle_class": is_idle_class, **asyncio.run(run(args))}
