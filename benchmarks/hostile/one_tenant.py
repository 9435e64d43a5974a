"""A robot with every scope of its tenant attacks, while a robot of another tenant drives, asks and stores.

    python -m benchmarks hostile.one_tenant [--pairs 10] [--seconds 60] [--only NAME]

One local platform with two servers and a quota of 64 MiB for a tenant.  The measured robot asks for a pose
(200 matches) ten times a second, sends a keyframe 2.5 times a second and stores 64 KiB once a second.  A pair
is two windows of the same length.  In one window a fair neighbour, a robot of another tenant, uses its full
quota (19 commands and 20 requests a second, a live map of its own); in the other window a neighbour attacks.
The order of the two windows alternates.  Each neighbour is a process of its own at the lowest priority, since
in the field it would run on another machine.

Attacks: ``leave`` (keyframe, live-leave, again and again), ``maps`` (a keyframe and a subscription to each of
eight maps), ``keyframes`` (of one map, as fast as they are answered), ``descriptors`` (keyframes of 20 kinds
that no robot makes), ``topics`` (rosbridge: latched and throttled messages of 250 kB), ``objects`` (of eight
bytes), ``versions`` (of one map), ``jobs`` (long ones).

Defends the promise that no robot, whatever it sends, raises the p99 of another tenant by more than 1.5 times.
The bars are stricter.  For each attack the median over the pairs of the ratio of p99 (attack over fair
neighbour) is at most 1.3 for poses, keyframes and objects, of which none is refused.  The attacker's tenant
stores at most its quota and 64 MiB.  Servers and map servers take at most 64 MiB more memory than with the
fair neighbour; an attack with several maps may also have two map servers on each server.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import http.client
import itertools
import json
import multiprocessing
import os
import secrets
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from websockets.asyncio.client import connect as connect_websocket
from websockets.exceptions import WebSocketException

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import median_ratio, percentile
from benchmarks.server.serving import resident_mib
from client_sdk import connect
from client_sdk.robot import Robot
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.geometry import Camera, exp_se3
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.firewall import ensure_key
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import make_request
from rse_pf.slam.keyframe import SentKeyframe, encode_keyframe, make_features
from rse_pf.storage.object_store import DirectoryStore, digest_of
from rse_pf.storage.quotas import stored_by_tenant
from rse_pf.wire.live_map import live_topic

__all__ = ["ATTACKS", "measure"]

HOME = "home"  # tenant of the measured robot
RIVAL = "rival"  # tenant of the attacking robot
QUOTA_BYTES = 64 << 20  # storage quota of each tenant
MAX_P99_RATIO = 1.3  # largest ratio of the p99 during an attack to the p99 with a fair neighbour
MAX_GROWTH_MIB = 64.0  # most memory, and most storage beyond the quota, that an attack may take
MAP_SERVERS_MIB = 4 * 120.0  # memory of the map servers of an attack with several maps, two on each server
POSE_HZ = 10.0  # poses per second for which the measured robot asks
KEYFRAME_HZ = 2.5  # keyframes per second that the measured robot sends
PUT_HZ = 1.0  # objects per second that the measured robot stores
FAIR_COMMANDS_HZ = 19.0  # commands per second of a fair neighbour: nearly its full rate limit
FAIR_PUT_HZ = 20.0  # objects per second that a fair neighbour stores
_WARM_S = 5.0  # time for which the measured robot runs before the first window
_REST_S = 1.0  # pause between two windows
_DEADLINE_S = 5.0  # longest wait for an answer, and for the exit of a neighbour
_LOWEST_PRIORITY = 19  # nice value of a neighbour's process
# Intrinsics of the camera in requests, px.
_CAMERA = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}
# A pose graph of two poses with one edge, as the payload of a long job.
_GRAPH = "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n" + (
    "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
)


def keyframe(name: str, number: int, features: int = 600) -> dict[str, Any]:
    """Return the request with keyframe *number* of a robot that drives straight past random features."""
    rng = np.random.default_rng(number)
    made = SentKeyframe(
        timestamp_s=number / KEYFRAME_HZ, T_odom_camera=exp_se3([0.1 * number, 0, 0, 0, 0, 0]),
        camera=Camera(**_CAMERA),
        features=make_features(
            rng.uniform([0, 0], [640, 480], (features, 2)), rng.uniform(0.5, 5.0, features),
            rng.integers(0, 256, (features, 32), dtype=np.uint8),
        ),
    )  # fmt: skip
    return {"map": name, "segment": 0, "number": number, "keyframe": encode_keyframe(made)}


class DataClient:
    """A blocking client with one connection to the data service."""

    def __init__(self, url: str, token: str) -> None:
        self._at = url.split("/")[2]
        self._headers = {"Authorization": f"Bearer {token}"}
        self._connection = http.client.HTTPConnection(self._at, timeout=_DEADLINE_S)
        self._lock = threading.Lock()

    def ask(self, method: str, path: str, body: bytes) -> tuple[int, bytes]:
        """Send a request; return the HTTP status (0: the connection failed) and the content of the answer."""
        with self._lock:
            try:
                self._connection.request(method, path, body, self._headers)
                answer = self._connection.getresponse()
                return answer.status, answer.read()
            except (OSError, http.client.HTTPException):
                self._connection.close()
                return 0, b""

    def close(self) -> None:
        """Close the connection when the request that another thread makes has ended."""
        with self._lock:
            self._connection.close()

    def put(self, data: bytes) -> int:
        """Store *data* as an object; return the HTTP status."""
        return self.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data)[0]


class Measured:
    """The measured robot; ``rows`` has time (s), kind, duration (ms) and result code of each request."""

    def __init__(self, robot: Robot, data: DataClient) -> None:
        self.rows: list[tuple[float, str, float, str]] = []
        self._robot, self._data = robot, data
        problem = make_problem(seed=1, n=200, outlier_ratio=0.3)
        self._pose = make_request(problem.points_world, problem.pixels, problem.camera)
        self._number = 0

    async def drive(self) -> None:
        """Ask for poses, send keyframes and store objects until cancelled."""
        await asyncio.gather(
            self._each(POSE_HZ, "pose", self._ask_pose),
            self._each(KEYFRAME_HZ, "keyframe", self._send_keyframe),
            self._each(PUT_HZ, "object", self._put),
        )

    async def _each(self, rate_hz: float, kind: str, act: Callable[[], Awaitable[str]]) -> None:
        due = time.monotonic()
        while True:
            due = max(due + 1.0 / rate_hz, time.monotonic())
            await asyncio.sleep(due - time.monotonic())
            began = time.monotonic()
            code = await act()
            self.rows.append((began, kind, 1e3 * (time.monotonic() - began), code))

    async def _ask_pose(self) -> str:
        return await _code(self._robot.call("pnp", self._pose, deadline_s=_DEADLINE_S, keep=True))

    async def _send_keyframe(self) -> str:
        request = keyframe("victim", self._number)
        code = await _code(self._robot.call("live-keyframe", request, deadline_s=_DEADLINE_S, keep=True))
        self._number += code == "ok"
        return code

    async def _put(self) -> str:
        status = await asyncio.to_thread(self._data.put, os.urandom(65_536))
        return "ok" if status == 201 else str(status)


async def _code(answer: Awaitable[Any]) -> str:
    try:
        await answer
    except RsePfError as error:
        return error.code
    return "ok"


# --- neighbours ----------------------------------------------------------------------------------

Neighbour = Callable[[Robot, "_Place"], Awaitable[None]]


class _Place:
    """The platform's address and the token of a neighbour: a robot of another tenant, fair or hostile.

    ``codes`` counts the neighbour's requests by service and result, such as ``pnp ok`` or ``PUT 201``.
    """

    def __init__(self, url: str, token: str) -> None:
        self.url, self.token = url, token
        self.codes: Counter[str] = Counter()
        self.tag = secrets.token_hex(3)

    async def call(self, robot: Robot, service: str, request: Any) -> str:
        code = await _code(robot.call(service, request, deadline_s=_DEADLINE_S, keep=True))
        self.codes[f"{service} {code}"] += 1
        return code


async def _fair(robot: Robot, place: _Place) -> None:
    problem = make_problem(seed=2, n=200, outlier_ratio=0.3)
    pose = make_request(problem.points_world, problem.pixels, problem.camera)
    data, number = DataClient(place.url, place.token), 0

    async def commands() -> None:
        nonlocal number
        for count in itertools.count():
            if count % 8:
                await place.call(robot, "pnp", pose)
            else:
                number += await place.call(robot, "live-keyframe", keyframe(place.tag, number)) == "ok"
            await asyncio.sleep(1.0 / FAIR_COMMANDS_HZ)

    async def puts() -> None:
        while True:
            place.codes[f"PUT {await asyncio.to_thread(data.put, os.urandom(8192))}"] += 1
            await asyncio.sleep(1.0 / FAIR_PUT_HZ)

    await asyncio.gather(commands(), puts())


async def _leave(robot: Robot, place: _Place) -> None:
    number = 0
    while True:
        number += await place.call(robot, "live-keyframe", keyframe(place.tag, number, 894)) == "ok"
        await place.call(robot, "live-leave", {"map": place.tag})


async def _maps(robot: Robot, place: _Place) -> None:
    async def listen(name: str) -> None:
        async for _ in robot.subscribe(live_topic(name)):
            pass

    listening = []
    try:
        for number in itertools.count():
            name = f"{place.tag}-{number % 8}"
            await place.call(robot, "live-keyframe", keyframe(name, number // 8))
            if number < 8:
                listening.append(asyncio.ensure_future(listen(name)))
    finally:
        for listener in listening:
            listener.cancel()
        await asyncio.gather(*listening, return_exceptions=True)


async def _keyframes(robot: Robot, place: _Place) -> None:
    number = 0
    while True:
        most = 8 if number else 1  # the first keyframe creates the map
        requests = [keyframe(place.tag, number + socket_number, 894) for socket_number in range(most)]
        codes = await asyncio.gather(*(place.call(robot, "live-keyframe", request) for request in requests))
        number += codes.count("ok")


async def _descriptors(robot: Robot, place: _Place) -> None:
    from tests.slam.test_descriptor_kinds import HOSTILE_KEYFRAMES

    kinds = [
        {"map": place.tag, "segment": 0, "number": 0, "keyframe": data} for data in HOSTILE_KEYFRAMES.values()
    ]
    while True:
        await asyncio.gather(*(place.call(robot, "live-keyframe", request) for request in kinds))


async def _topics(robot: Robot, place: _Place) -> None:
    text = "x" * 250_000
    headers = {"Authorization": f"Bearer {place.token}"}
    address = f"{place.url.rpartition('/')[0]}/rosbridge"
    for number in itertools.count():
        try:
            async with connect_websocket(address, additional_headers=headers, compression=None) as socket:
                for topic in (f"/t{number}-{row}" for row in range(20)):
                    asked = {
                        "op": "subscribe",
                        "topic": topic,
                        "throttle_rate": 3_600_000,
                        "queue_length": 100,
                    }
                    await socket.send(json.dumps(asked))
                    for _ in range(4):
                        said = {"op": "publish", "topic": topic, "latch": True, "msg": {"data": text}}
                        await socket.send(json.dumps(said))
                    await socket.send(json.dumps({"op": "unsubscribe", "topic": topic}))
                    place.codes["topics"] += 1
        except (WebSocketException, OSError) as error:
            place.codes[f"closed: {error}"[:60]] += 1
        await asyncio.sleep(0.1)  # the pause of a client before it connects again: part of the load


async def _in_threads(place: _Place, act: Callable[[DataClient], int]) -> None:
    async def work() -> None:
        client = DataClient(place.url, place.token)
        while True:
            place.codes[f"HTTP {await asyncio.to_thread(act, client)}"] += 1

    await asyncio.gather(*(work() for _ in range(8)))


async def _objects(robot: Robot, place: _Place) -> None:
    await _in_threads(place, lambda client: client.put(os.urandom(8)))


async def _versions(robot: Robot, place: _Place) -> None:
    head: str | None = None

    def commit(client: DataClient) -> int:
        nonlocal head
        data = encode_map(MapVersion(keyframes=(), provenance={"filler": os.urandom(500_000).hex()}))
        status = client.put(data)
        if status != 201:
            return status
        body = json.dumps({"digest": digest_of(data), "parent": head}).encode()
        status, answer = client.ask("POST", f"/data/v1/maps/{place.tag}/versions", body)
        with contextlib.suppress(ValueError, KeyError):
            head = json.loads(answer)["id"]
        client.ask("DELETE", f"/data/v1/objects/{digest_of(data)}", b"")
        return status

    client = DataClient(place.url, place.token)
    while True:
        place.codes[f"HTTP {await asyncio.to_thread(commit, client)}"] += 1


async def _jobs(robot: Robot, place: _Place) -> None:
    async def work(lane: int) -> None:
        for number in itertools.count():
            graph = f"{_GRAPH}# {place.tag} {lane} {number}\n" + _GRAPH * 50
            await place.call(robot, "optimise", {"g2o": graph, "options": {"max_iterations": 50}})

    await asyncio.gather(*(work(lane) for lane in range(8)))


# Name of the fair neighbour, which keeps its limits.
FAIR = "fair"
# The attacks by name.
ATTACKS: dict[str, Neighbour] = {
    "leave": _leave, "maps": _maps, "keyframes": _keyframes, "topics": _topics, "objects": _objects,
    "versions": _versions, "jobs": _jobs, "descriptors": _descriptors,
}  # fmt: skip


def run_neighbour(name: str, url: str, token: str, seconds: float, pipe: Connection) -> None:
    """Run the neighbour *name* for *seconds* after each order in *pipe*; entry point of a process."""
    os.nice(_LOWEST_PRIORITY)
    work = {FAIR: _fair, **ATTACKS}[name]
    while pipe.recv() == "go":
        pipe.send(asyncio.run(_run_bounded(work, url, token, seconds)))


async def _run_bounded(work: Neighbour, url: str, token: str, seconds: float) -> dict[str, int]:
    place = _Place(url, token)
    until = time.monotonic() + seconds
    async with contextlib.AsyncExitStack() as stack:
        robot = connect(url, token=token, codec="bin")
        if work is not _topics:  # a second connection of the robot would close the first
            await stack.enter_async_context(robot)
        task = asyncio.ensure_future(work(robot, place))
        await asyncio.wait({task}, timeout=until - time.monotonic())
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        if task.done() and not task.cancelled() and task.exception() is not None:
            place.codes[f"ended by {task.exception()!r}"[:100]] += 1
    return dict(place.codes)


# --- the measurement -----------------------------------------------------------------------------


async def measure(names: Sequence[str], pairs: int, seconds: float, folder: Path) -> list[dict[str, Any]]:
    """Return a row for each attack: ratios of p99, refused requests, and growth of memory and storage."""
    settings = PlatformSettings().replace(
        data={"tenant_quota_bytes": QUOTA_BYTES}, serving={"rosbridge": True}
    )
    context = multiprocessing.get_context("spawn")
    rows = []
    for name in names:
        state = folder / name
        async with LocalPlatform(settings, servers=2, port=0, state=state, data=True) as platform:
            key = ensure_key(platform.state, seed=secrets.token_bytes(32), key_id="unused")
            issue = functools.partial(key.issue, settings=settings.auth)

            def token(robot: str, tenant: str, issue: Any = issue) -> str:
                return str(issue(robot, now=time.time(), token_id=secrets.token_hex(8), tenant=tenant))

            neighbours = {}
            for kind, tenant in ((FAIR, "fair"), (name, RIVAL)):
                pipe, theirs = context.Pipe()
                arguments = (kind, platform.url, token(kind, tenant), seconds, theirs)
                process = context.Process(target=run_neighbour, args=arguments, daemon=True)
                process.start()
                neighbours[kind] = pipe, process
            robot_token = token("robot-1", HOME)
            async with connect(platform.url, token=robot_token, codec="bin") as robot:
                data = DataClient(platform.url, robot_token)
                measured = Measured(robot, data)
                driving = asyncio.ensure_future(measured.drive())
                await asyncio.sleep(_WARM_S)
                row = await _pairs(name, pairs, neighbours, measured, platform, state)
                driving.cancel()
                await asyncio.gather(driving, return_exceptions=True)
                await asyncio.to_thread(data.close)
            for pipe, process in neighbours.values():
                pipe.send("end")
                process.join(_DEADLINE_S)
        rows.append(row)
    return rows


async def _pairs(
    name: str, pairs: int, neighbours: dict[str, Any], measured: Measured, platform: LocalPlatform,
    state: Path,
) -> dict[str, Any]:  # fmt: skip
    windows: list[dict[str, tuple[float, float]]] = []
    codes: dict[str, Counter[str]] = {FAIR: Counter(), name: Counter()}
    began_s = time.monotonic()
    servers = [mark.pid for mark in platform.backend_servers.marks.values()]
    most = dict.fromkeys((FAIR, name), 0.0)
    for number in range(pairs):
        rows = {}
        for kind in (FAIR, name) if number % 2 else (name, FAIR):
            began = time.monotonic()
            neighbours[kind][0].send("go")
            codes[kind].update(await asyncio.to_thread(neighbours[kind][0].recv))
            rows[kind] = began, time.monotonic()
            most[kind] = max(most[kind], resident_mib(servers))
            await asyncio.sleep(_REST_S)
        windows.append(rows)
    store = DirectoryStore(_store_of(state))
    return {
        "attack": name, "pairs": pairs,
        "ratios": {
            what: median_ratio(
                [_tail_ms(measured, [window[name]], what) for window in windows],
                [_tail_ms(measured, [window[FAIR]], what) for window in windows],
            )
            for what in ("pose", "keyframe", "object")
        },
        "p99_ms": {
            what: [_tail_ms(measured, [window[kind] for window in windows], what) for kind in (FAIR, name)]
            for what in ("pose", "keyframe", "object")
        },
        "n": dict(Counter(what for _, what, _, _ in measured.rows)),
        "refused": dict(
            Counter(
                f"{what} {code}"
                for at, what, _, code in measured.rows
                if code != "ok" and at >= began_s
            )
        ),
        "neighbours": {kind: dict(code) for kind, code in codes.items()},
        "stored_mib": round(stored_by_tenant(store, RIVAL).charged_bytes / 2**20, 1),
        "memory_mib": round(most[name] - most[FAIR], 1),
    }  # fmt: skip


def _store_of(state: Path) -> Path:
    """Return the folder below *state* in which the platform stores objects."""
    return next(path.parent for path in state.rglob("accounts") if path.is_dir())


def _tail_ms(measured: Measured, spans: Sequence[tuple[float, float]], what: str) -> float:
    values = [
        ms
        for at, kind, ms, _ in measured.rows
        if kind == what and any(low <= at < high for low, high in spans)
    ]
    return percentile(values, 99)


@benchmark(
    *(
        Bar(f"*.ratios.{what}", at_most=MAX_P99_RATIO, unit="times the p99")
        for what in ("pose", "keyframe", "object")
    ),
    Bar("*.refused", equals={}),
    Bar("*.stored_mib", at_most=QUOTA_BYTES / 2**20 + MAX_GROWTH_MIB, unit="MiB"),
    Bar("*.memory_without_owners_mib", at_most=MAX_GROWTH_MIB, unit="MiB"),
)
def run_benchmark(
    *, pairs: int = 10, seconds: float = 60.0, only: Annotated[tuple[str, ...], "attacks", ATTACKS] = ()
) -> dict[str, Any]:
    """Measure the effect of each attack."""
    with tempfile.TemporaryDirectory() as folder:
        rows = asyncio.run(measure(list(only or ATTACKS), pairs, seconds, Path(folder)))
    for row in rows:
        owners_mib = MAP_SERVERS_MIB if row["attack"] == "maps" else 0.0
        row["memory_without_owners_mib"] = row["memory_mib"] - owners_mib
    return {row["attack"]: row for row in rows}
