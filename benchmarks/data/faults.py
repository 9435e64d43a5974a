"""Uploads through the load balancer while robots request poses and the data server is killed repeatedly.

    python -m benchmarks data.faults [--uploads 200] [--kills 3] [--robots 20] [--seconds 15]

One local platform (two servers, one data server) behind the load balancer; robots request 5 poses per
second (200 matches, 30 % wrong, every frame kept).  First without uploads; then a process of four robots
uploads objects of 1 MiB as fast as possible, and the data server is killed with SIGKILL at each quarter; then
the same robots upload at the rate of keyframes (`data.background_bytes_per_s` each).

The uploading robots run at the lowest priority: in the field their work costs a server nothing.

Defends: service back <= 5 s after each kill; every upload that was acknowledged is readable with the right
digest; no partial object; p99 of poses unchanged while robots upload.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import random
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.data.windows import poses
from benchmarks.frame.registry import Bar, benchmark
from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.config import PlatformSettings
from rse_pf.experiments.load.scenario import LoadScenario
from rse_pf.experiments.load.swarm import Swarm
from rse_pf.local.control.control_plane import ControlOptions
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.object_store import DirectoryStore, digest_of
from rse_pf.token_bucket import TokenBucket

MIB = 1 << 20
UPLOADERS = 4
_LOWEST_PRIORITY = 19
"""Niceness of the uploading robots, which in the field have their own computers."""
BACK_S, RATIO = 5.0, 1.1
SETTLE_S = 2.0
TIMEOUT_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments."""

    uploads: int = 200
    size_kib: int = 1024
    kills: int = 3
    robots: int = 20
    fps: float = 5.0
    seconds: Annotated[float, "before, and of the paced uploads"] = 15.0


def content(number: int, size: int) -> bytes:
    """Return the bytes of upload *number*."""
    return np.random.default_rng(number).bytes(size)


def upload_all(
    pipe: Connection, url: str, tokens: list[str], numbers: list[int], size: int, bytes_per_s: float
) -> None:
    """Upload from robots in this process after a message on *pipe*; send each acknowledged digest.

    *bytes_per_s* is the rate of each robot; 0 means as fast as possible.
    """
    os.nice(_LOWEST_PRIORITY)
    pipe.recv()
    lock = threading.Lock()

    def robot(row: int) -> None:
        part_bytes = size // 4 if not bytes_per_s else 64 * 1024
        options = DataOptions(part_bytes=part_bytes, first_pause_s=0.05, random=random.Random(row))
        client = DataClient(url, tokens[row], options)
        rate = TokenBucket(bytes_per_s, burst=0.0) if bytes_per_s else None
        for number in numbers[row::UPLOADERS]:
            if rate is not None:
                time.sleep(rate.spend(size, time.monotonic()))  # the rate is a parameter of the measurement
            began = time.monotonic()
            digest = client.upload(content(number, size))
            with lock:
                pipe.send((digest, time.monotonic() - began))
        client.close()

    with ThreadPoolExecutor(UPLOADERS) as pool:
        for upload in [pool.submit(robot, row) for row in range(UPLOADERS)]:
            upload.result()
    pipe.send(None)


class Uploads:
    """The uploading process as the platform's loop sees it."""

    def __init__(self, cloud: LocalPlatform, numbers: list[int], size: int, bytes_per_s: float = 0.0) -> None:
        self.acknowledged: list[tuple[str, float]] = []
        self.is_complete = False
        self._received = asyncio.Event()
        self._pipe, theirs = multiprocessing.get_context("spawn").Pipe()
        tokens = [cloud.issue_token(f"uploader-{row}") for row in range(UPLOADERS)]
        self._process = multiprocessing.get_context("spawn").Process(
            target=upload_all, args=(theirs, cloud.url, tokens, numbers, size, bytes_per_s)
        )
        self._process.start()
        theirs.close()
        asyncio.get_running_loop().add_reader(self._pipe.fileno(), self._receive)

    def begin(self) -> None:
        """Let the robots upload."""
        self._pipe.send("begin")

    def _receive(self) -> None:
        try:
            while self._pipe.poll():
                message = self._pipe.recv()
                self.is_complete = self.is_complete or message is None
                if message is not None:
                    self.acknowledged.append(message)
        except EOFError:
            self.is_complete = True
        if self.is_complete:
            asyncio.get_running_loop().remove_reader(self._pipe.fileno())
        self._received.set()

    async def until(self, condition: Callable[[], bool]) -> None:
        """Wait until *condition* holds or the uploads have ended; raises TimeoutError."""
        while not condition() and not self.is_complete:
            self._received.clear()
            await asyncio.wait_for(self._received.wait(), TIMEOUT_S)

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join()
        self._pipe.close()


async def kill_during_uploads(cloud: LocalPlatform, uploads: Uploads, kills: int, count: int) -> list[float]:
    """Kill the data server at equal shares of the uploads; return when it was ready again (s)."""
    back: list[float] = []
    for kill in range(kills):
        share = (kill + 1) * count // (kills + 1)
        await uploads.until(lambda share=share: len(uploads.acknowledged) >= share)  # type: ignore[misc]
        before = cloud.data_servers.process.mark
        began = time.monotonic()
        cloud.data_servers.process.send(signal.SIGKILL)
        while cloud.data_servers.process.mark == before or not await cloud.data_servers.is_ready():
            if time.monotonic() - began > TIMEOUT_S:
                raise TimeoutError("the data server was not replaced")
            await asyncio.sleep(0.01)  # polls, with a deadline
        back.append(time.monotonic() - began)
    return back


def judge(cloud: LocalPlatform, acknowledged: list[str], wanted: set[str]) -> dict[str, Any]:
    """Read everything back through the balancer and in the store."""
    tokens = {f"uploader-{row}": cloud.issue_token(f"uploader-{row}") for row in range(UPLOADERS)}
    readable = set()
    for token in tokens.values():
        client = DataClient(cloud.url, token)
        for digest, _ in list(client.objects()):
            if digest_of(client.download(digest)) == digest:
                readable.add(digest)
        client.close()
    store = DirectoryStore(cloud.state / "objects")
    stored = [info.name for info in store.list("objects/")]
    wrong = [name for name in stored if digest_of(store.get(name)) != name.rpartition("/")[2]]
    return {
        "acknowledged": len(acknowledged), "missing": len(set(acknowledged) - readable),
        "never_acknowledged": len(wanted - set(acknowledged)), "partial_objects": len(wrong),
        "open_uploads": len(list(store.list("uploads/"))),
    }  # fmt: skip


async def run(args: Options) -> dict[str, Any]:
    """Return every figure of the table."""
    size, settings = args.size_kib * 1024, PlatformSettings()
    with tempfile.TemporaryDirectory() as folder:
        cloud = LocalPlatform(
            settings, state=Path(folder), port=0, servers=2, data=True, control=ControlOptions(elastic=True)
        )
        async with cloud:
            began = time.monotonic()
            options = LoadScenario(robots=args.robots, fps=args.fps, join_every_s=0.02)
            swarm = Swarm(
                options, url=cloud.url, token_of=cloud.issue_token, session=settings.session, origin=began
            )
            async with swarm:
                await swarm.start()
                await swarm.wait_joined(60.0)
                uploads = Uploads(cloud, list(range(args.uploads)), size)
                rate = settings.data.background_bytes_per_s
                count = UPLOADERS * int(args.seconds * rate / size)
                slow = Uploads(cloud, list(range(args.uploads, args.uploads + count)), size, rate)
                await asyncio.sleep(SETTLE_S)
                times = [time.monotonic() - began]
                await asyncio.sleep(args.seconds)
                times.append(time.monotonic() - began)
                uploads.begin()
                back_s = await kill_during_uploads(cloud, uploads, args.kills, args.uploads)
                await uploads.until(lambda: False)
                uploads.close()
                times.append(time.monotonic() - began)
                slow.begin()
                await slow.until(lambda: False)
                slow.close()
                times.append(time.monotonic() - began)
                result = await swarm.finish()
            both = [*uploads.acknowledged, *slow.acknowledged]
            wanted = {digest_of(content(number, size)) for number in range(args.uploads + count)}
            verdict = await asyncio.to_thread(judge, cloud, [digest for digest, _ in both], wanted)
    rows = [poses(result.commands, *times[i : i + 2]) for i in range(3)]
    names = ("before", f"{args.uploads} uploads, {args.kills} kills", f"{count} paced uploads")
    return {
        "poses": dict(zip(names, rows, strict=True)), "back_s": back_s,
        "p99_ratio": [row["p99_ms"] / rows[0]["p99_ms"] for row in rows[1:]], "objects": verdict,
        "upload_s": times[2] - times[1], "longest_upload_s": max(s for _, s in uploads.acknowledged),
        "mib_per_s": args.uploads * size / MIB / (times[2] - times[1]),
        "late_sends_ms": result.late_sends_ms_p99,
    }  # fmt: skip


@benchmark(
    Bar("back_s.*", at_most=BACK_S, unit="s"),
    Bar("p99_ratio.*", at_most=RATIO, unit="times before"),
    Bar("objects.missing", equals=0),
    Bar("objects.partial_objects", equals=0),
)
def run_benchmark(args: Options) -> dict[str, Any]:
    """Measure poses beside uploads and kills."""
    return asyncio.run(run(args))
