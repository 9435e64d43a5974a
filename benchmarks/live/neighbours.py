"""Robots of a live map beside a slow reader, a sender of garbage, another tenant, and a flood of photos.

    python -m benchmarks live.neighbours [--rounds 3] [--seconds 6] [--kinds photos]

One local platform with two servers.  Three robots share a live map: each sends a keyframe of generated
features 2.5 times a second and asks for a pose (200 matches) 10 times a second.  Quiet windows and windows
with one neighbour take turns; the neighbour is a process of its own: ten connections that subscribe to the
same map and read nothing; five robots that send keyframes of random bytes 20 times a second each; two robots
of another tenant with the same load in a map of the same name, which count what they see of the first tenant;
one robot of that tenant that sends photos, and hostile images, over four connections.

Defends: p99 of poses and of acknowledgements of keyframes at most 1.2 times that of the quiet windows, and
nothing of a foreign map.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import secrets
import tempfile
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from benchmarks.hostile.attacks import AttackTarget, frame
from benchmarks.hostile.photos import send_photos
from benchmarks.maps.photos import world_of
from client_sdk import connect
from client_sdk.robot import Robot
from client_sdk.transfer.data_client import DataClient
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.geometry import Camera, exp_se3
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.firewall import ensure_key
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import make_request
from rse_pf.slam.keyframe import Keyframe, KeyframeFeatures, encode_keyframe, make_features
from rse_pf.wire import Hello, Subscribe, make_codec
from rse_pf.wire.live_map import live_topic
from rse_pf.wire.server_session import UPDATES

__all__ = [
    "NEIGHBOURS",
]

RATIO = 1.2
MAP = "lab"
POSE_HZ, KEYFRAME_HZ = 10.0, 2.5
NEIGHBOURS = ("slow-reader", "garbage", "tenant", "photos")
HOME, RIVAL = "home", "rival"
_WARM_S = 8.0
_LOWEST_PRIORITY = 19
_SILENT, _GARBAGE, _CONNECTIONS = 10, 5, 4
_CAMERA = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}


class Driver:
    """A robot that asks for poses and sends keyframes; times are seconds of the monotonic clock."""

    def __init__(self, robot: Robot, number: int) -> None:
        self.poses: list[tuple[float, float]] = []
        self.keyframes: list[tuple[float, float]] = []
        self.seen: list[str] = []
        self._robot, self._rng = robot, np.random.default_rng(number)
        problem = make_problem(seed=number, n=200, outlier_ratio=0.3)
        self._pose = make_request(problem.points_world, problem.pixels, problem.camera)
        self._failed = 0

    async def drive(self) -> None:
        """Work until cancelled."""
        await asyncio.gather(self._ask_poses(), self._send_keyframes(), self._listen())

    async def _ask_poses(self) -> None:
        due = time.monotonic()
        while True:
            due = max(due + 1.0 / POSE_HZ, time.monotonic())
            await asyncio.sleep(due - time.monotonic())
            self.poses.append(await self._time("pnp", self._pose))

    async def _send_keyframes(self) -> None:
        number, due = 0, time.monotonic()
        while True:
            due = max(due + 1.0 / KEYFRAME_HZ, time.monotonic())
            await asyncio.sleep(due - time.monotonic())
            keyframe = Keyframe(
                timestamp_s=number / KEYFRAME_HZ, T_odom_camera=exp_se3([0.1 * number, 0, 0, 0, 0, 0]),
                camera=Camera(**_CAMERA), features=self._features(),
            )  # fmt: skip
            request = {
                "map": MAP, "segment": 0, "number": number, "keyframe": encode_keyframe(keyframe)
            }  # fmt: skip
            took = await self._time("live-keyframe", request)
            if np.isfinite(took[1]):
                self.keyframes.append(took)
                number += 1

    async def _listen(self) -> None:
        async for key, value in self._robot.subscribe(live_topic(MAP)):
            self.seen.append(f"{key} {value}")

    async def _time(self, service: str, request: Any) -> tuple[float, float]:
        began = time.monotonic()
        try:
            await self._robot.call(service, request, deadline_s=5.0, keep=True)
        except RsePfError:
            self._failed += 1
            return began, float("nan")
        return began, 1e3 * (time.monotonic() - began)

    def _features(self) -> KeyframeFeatures:
        rng = self._rng
        return make_features(
            rng.uniform([0, 0], [640, 480], (600, 2)), rng.uniform(0.5, 5.0, 600),
            rng.integers(0, 256, (600, 32), dtype=np.uint8),
        )  # fmt: skip


def run_neighbour(kind: str, url: str, tokens: Sequence[str], seconds: float, pipe: Connection) -> None:
    """Be a neighbour for *seconds* after each order of *pipe*; entry point of a process."""
    while pipe.recv() == "go":
        pipe.send(asyncio.run(_neighbour(kind, url, tokens, seconds)))


async def _neighbour(kind: str, url: str, tokens: Sequence[str], seconds: float) -> int:
    if kind == "slow-reader":
        return await _read_nothing(AttackTarget(url, tuple(tokens)), seconds)
    if kind == "garbage":
        counts = await asyncio.gather(*(_send_garbage(url, token, seconds) for token in tokens))
        return sum(counts)
    if kind == "photos":
        return await asyncio.to_thread(_flood_with_photos, url, tokens[0], Path(tokens[1]), seconds)
    return await _drive_beside(url, tokens, seconds)


async def _read_nothing(target: AttackTarget, seconds: float) -> int:
    codec = make_codec("bin")
    writers = []
    for token in target.tokens:
        reader, writer = await target.open_tcp()
        writer.write(target.head(token, "bin"))
        await reader.readuntil(b"\r\n\r\n")
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        writer.write(frame(codec.encode(Hello(capabilities=(UPDATES,)))))
        writer.write(frame(codec.encode(Subscribe(id=1, topic=live_topic(MAP)))))
        writers.append(writer)
    await asyncio.sleep(seconds)
    for writer in writers:
        writer.transport.abort()
    return 0


async def _send_garbage(url: str, token: str, seconds: float) -> int:
    """Return how many keyframes of random bytes were sent."""
    sent, until = 0, time.monotonic() + seconds
    async with connect(url, token=token, codec="bin") as robot:
        while time.monotonic() < until:
            sent += 1
            request = {
                "map": MAP, "segment": 0, "number": sent, "keyframe": os.urandom(30_000)
            }  # fmt: skip
            try:
                await robot.call("live-keyframe", request, deadline_s=1.0, keep=True)
            except RsePfError:
                await asyncio.sleep(1.0 / 20)
    return sent


def _flood_with_photos(url: str, token: str, photo: Path, seconds: float) -> int:
    """Return how many photos were localised."""
    os.nice(_LOWEST_PRIORITY)  # in the field it costs a server nothing
    until, begun = time.monotonic() + seconds, multiprocessing.Event()
    address, tokens = urlsplit(url), [token] * _CONNECTIONS
    sent = send_photos(
        address.port or 80, tokens, photo.read_bytes(), lambda: time.monotonic() > until, begun
    )
    return sent["photo 200 ok"]


def _commit_rooms(url: str, token: str, folder: Path) -> None:
    """Commit the map of the photos, and write a photo of it."""
    keyframes, photos = world_of(0)
    with contextlib.closing(DataClient(f"http://{urlsplit(url).netloc}", token)) as client:
        client.update_map("rooms", encode_map(MapVersion(keyframes=tuple(keyframes))))
    (folder / "photo.jpg").write_bytes(photos[1].jpeg)


async def _drive_beside(url: str, tokens: Sequence[str], seconds: float) -> int:
    """Return how many updates named a robot of the other tenant."""
    async with connect(url, token=tokens[0]) as a, connect(url, token=tokens[1]) as b:
        drivers = [Driver(a, 10), Driver(b, 11)]
        tasks = [asyncio.ensure_future(driver.drive()) for driver in drivers]
        await asyncio.sleep(seconds)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return sum(HOME in line for driver in drivers for line in driver.seen)


async def measure(rounds: int, seconds: float, kinds: Sequence[str], folder: Path) -> dict[str, Any]:
    """Return p99 in quiet windows and beside each neighbour of *kinds*."""
    settings = PlatformSettings()
    has_data = "photos" in kinds
    async with LocalPlatform(
        settings, servers=2, port=0, state=folder / "platform", data=has_data
    ) as platform:
        key = ensure_key(platform.state, seed=secrets.token_bytes(32), key_id="unused")

        def token(robot: str, tenant: str) -> str:
            return key.issue(
                robot, now=time.time(), token_id=secrets.token_hex(8), settings=settings.auth, tenant=tenant
            )

        tokens = {
            "slow-reader": [token(f"{HOME}-slow-{row}", HOME) for row in range(_SILENT)],
            "garbage": [token(f"{HOME}-garbage-{row}", HOME) for row in range(_GARBAGE)],
            "tenant": [token(f"{RIVAL}-{row}", RIVAL) for row in range(2)],
            "photos": [token(f"{RIVAL}-phone", RIVAL), str(folder / "photo.jpg")],
        }
        if has_data:
            await asyncio.to_thread(_commit_rooms, platform.url, tokens["photos"][0], folder)
        context = multiprocessing.get_context("spawn")
        pipes = {}
        for kind in kinds:
            pipes[kind], theirs = context.Pipe()
            context.Process(
                target=run_neighbour, args=(kind, platform.url, tokens[kind], seconds, theirs), daemon=True
            ).start()
        async with (
            connect(platform.url, token=token(f"{HOME}-1", HOME)) as a,
            connect(platform.url, token=token(f"{HOME}-2", HOME)) as b,
            connect(platform.url, token=token(f"{HOME}-3", HOME)) as c,
        ):
            drivers = [Driver(robot, number) for number, robot in enumerate((a, b, c))]
            tasks = [asyncio.ensure_future(driver.drive()) for driver in drivers]
            await asyncio.sleep(_WARM_S)
            windows: dict[str, list[tuple[float, float]]] = {"quiet": []}
            counted: dict[str, int] = dict.fromkeys(NEIGHBOURS, 0)
            for _ in range(rounds):
                for kind in kinds:
                    began = time.monotonic()
                    await asyncio.sleep(seconds)
                    windows["quiet"].append((began, time.monotonic()))
                    began = time.monotonic()
                    pipes[kind].send("go")
                    counted[kind] += await asyncio.to_thread(pipes[kind].recv)
                    windows.setdefault(kind, []).append((began, time.monotonic()))
            for task in tasks:
                task.cancel()
            ended = await asyncio.gather(*tasks, return_exceptions=True)
        for pipe in pipes.values():
            pipe.send("end")
    for error in ended:
        if not isinstance(error, asyncio.CancelledError):
            raise RuntimeError(f"a robot ended early: {error!r}")
    figures = {name: _figures(drivers, spans) for name, spans in windows.items()}
    return {
        "windows": figures,
        "ratios": {
            kind: {
                what: round(figures[kind][what]["p99"] / figures["quiet"][what]["p99"], 3)
                for what in ("poses_ms", "keyframes_ms")
            }
            for kind in kinds
        },
        "garbage_keyframes_sent": counted["garbage"],
        "photos_localised": counted["photos"],
        "updates_of_a_foreign_map": counted["tenant"],
        "foreign_robots_in_the_map": sum(RIVAL in line for driver in drivers for line in driver.seen),
    }


def _figures(drivers: Sequence[Driver], spans: Sequence[tuple[float, float]]) -> dict[str, Any]:
    def within(rows: Sequence[tuple[float, float]]) -> dict[str, Any]:
        values = np.array([ms for at, ms in rows if any(low <= at < high for low, high in spans)])
        return {"failed": int(np.isnan(values).sum()), **spread(values[~np.isnan(values)])}

    return {
        "poses_ms": within([row for driver in drivers for row in driver.poses]),
        "keyframes_ms": within([row for driver in drivers for row in driver.keyframes]),
    }


@benchmark(
    Bar("ratios.*.poses_ms", at_most=1.2, unit="times the p99"),
    Bar("ratios.*.keyframes_ms", at_most=1.2, unit="times the p99"),
    Bar("updates_of_a_foreign_map", equals=0),
    Bar("foreign_robots_in_the_map", equals=0),
)
def run_benchmark(
    *, rounds: int = 3, seconds: float = 6.0, kinds: Annotated[list[str] | None, "default: all"] = None
) -> dict[str, Any]:
    """Drive beside each neighbour."""
    with tempfile.TemporaryDirectory() as folder:
        return asyncio.run(measure(rounds, seconds, kinds or NEIGHBOURS, Path(folder)))
