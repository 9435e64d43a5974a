"""The scenarios: what happens to a client, and what it must have done in the end."""

from __future__ import annotations

import asyncio
import hashlib
import json
import math
import os
import shutil
import struct
import subprocess
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driver import Driver, Missed
from link import Link
from undecodable import as_input
from websockets.asyncio.client import connect

import client_sdk
from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.auth.roster import EnrolledRobot
from rse_pf.auth.tokens import ISSUER, SigningKey
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.errors import Unauthorized
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.storage.object_store import DirectoryStore

__all__ = ["SCENARIOS", "Bench", "Missed", "Scenario"]

GOLDEN = Path(__file__).resolve().parents[1] / "wire" / "golden"
LIVE_MAP = "shared"
CUT_S = 5.0
SHORT_TOKEN_S = 6.0
"""From when the client has started."""
BUSY_S = 2.5
SLOW_S = 4.0
"""The link carries 2 kB a second for so long: less than what is asked for."""
SLOW_BYTES_PER_S = 2000.0
FRAGMENT_BYTES = (4096, 512)
"""Up, and down, where messages are smaller."""
LEAST_KINDS = 40
"""Of commands that cannot be decoded."""
STREAM_PER_S = 10
GOES_ON_S = 30.0
CUT_OFF_BACK_S, BACK_S = 5.0, 45.0
"""When a robot is back after a cut-off or once its clock is right, and after all else."""
CLOCK_S = 120.0
SHIFT_SOURCE = Path(__file__).parent / "clock_shift.c"


class Bench:
    """The platform, and what is the same for every client."""

    def __init__(self, cloud: LocalPlatform, *, origin: str, folder: Path) -> None:
        self.cloud, self.origin, self._folder = cloud, origin, folder
        self.tokens: list[str] = []
        self._inputs = folder / "input.json"
        self._has_map = False
        self.token_ends_s = 0.0
        self.away_s = 20.0
        self._own_key: dict[str, str] = {}
        self._access = AccessControlStore(DirectoryStore(folder / "p"))
        self._clock, self._shift = folder / "clock", folder / "clock_shift.so"

    def link(self) -> Link:
        """Return a network to the load balancer."""
        return Link(self.cloud.port)

    def token(self, robot: str, ttl_s: float | None = None) -> str:
        """Return a fresh token, which is looked for in all files at the end."""
        made = self.cloud.issue_token(robot, ttl_s)
        self.tokens.append(made)
        return made

    def environment(self, robot: str, link: Link, scenario: Scenario, starts_s: float) -> dict[str, str]:
        """Return what the driver of *robot* reads, which takes *starts_s* to start."""
        life_s = None if scenario.token_s is None else scenario.token_s + starts_s
        self.token_ends_s = time.monotonic() + (life_s or math.inf)
        poses = json.loads((GOLDEN / "poses.json").read_text(encoding="utf-8"))
        given = {
            "commands": [
                {"service": each["command"]["service"], "payload": each["command"]["payload"]}
                for each in poses.values()
            ],
            "expected": [each["reply"] for each in poses.values()],
            "golden": str(GOLDEN / "messages.json"),
            "long": {"service": "optimise", "payload": {"g2o": ring(robot)}},
            "undecodable": as_input(),
        }
        shifted = {}
        if scenario.driven == "returns":
            given["own_key"] = self.enrol(robot)
            shifted = self.shifted_clock()
        self._inputs.write_text(json.dumps(given), encoding="utf-8")
        return {
            "RSE_PF_URL": f"ws://127.0.0.1:{link.port}/ws",
            "RSE_PF_TOKEN": self.token(robot, life_s),
            "RSE_PF_INPUT": str(self._inputs), "RSE_PF_SECONDS": str(BUSY_S), "RSE_PF_MAP": LIVE_MAP,
            "RSE_PF_DATA_URL": f"http://127.0.0.1:{self.cloud.port}", "RSE_PF_ORIGIN": self.origin, **shifted,
        }  # fmt: skip

    def enrol(self, robot: str) -> dict[str, str]:
        """Enrol *robot* with a key of its own; return the key and the claims that its tokens have."""
        auth, key = self.cloud.settings.auth, SigningKey.of_robot(os.urandom(32))
        private = json.loads(key.to_json())
        enrolled = EnrolledRobot(robot=robot, x=private["x"])
        self._access.change_roster(lambda roster: roster.enrolled(enrolled))
        self._own_key = {**private, "sub": robot, "iss": ISSUER, "aud": auth.audience}
        return self._own_key

    async def until_enrolled(self) -> None:
        """Wait until each server accepts the robot that was enrolled last."""
        own, auth = self._own_key, self.cloud.settings.auth
        key = SigningKey.from_json(json.dumps(own))
        waiting = [server.port for server in self.cloud.servers]
        while waiting:
            token = key.issue(own["sub"], now=time.time(), token_id=os.urandom(8).hex(), settings=auth)
            try:
                async with client_sdk.connect(f"ws://127.0.0.1:{waiting[0]}/ws", token=token):
                    del waiting[0]
            except Unauthorized:
                await asyncio.sleep(0.1)  # polls, with the deadline of the scenario

    def shifted_clock(self) -> dict[str, str]:
        """Return the environment of a program whose wall clock `set_clock` sets; raises Missed."""
        compiler = shutil.which("cc")
        if compiler is None:
            raise Missed("no C compiler: sudo apt-get install gcc")
        if not self._shift.exists():
            words = [compiler, "-shared", "-fPIC", "-o", str(self._shift), str(SHIFT_SOURCE), "-ldl"]
            subprocess.run(words, check=True, timeout=60)
        self._clock.write_bytes(struct.pack("d", 0.0))
        return {"LD_PRELOAD": str(self._shift), "RSE_PF_CLOCK": str(self._clock)}

    def set_clock(self, shift_s: float) -> None:
        """Set the clock of the driver to *shift_s* ahead of this machine's."""
        with self._clock.open("r+b") as file:
            file.write(struct.pack("d", shift_s))

    def cut_off(self, robot: str) -> float:
        """Revoke the tokens of *robot* as ``token revoke --all-of``; return when later ones are valid."""
        from_s = float(int(time.time()) + 1)
        self._access.change_deny_list(lambda denied: denied.with_tokens_before("default", robot, from_s))
        return from_s

    async def restore(self) -> None:
        """Have two servers that take robots again."""
        missing = 2 - len(self.cloud.servers)
        if missing > 0:
            await self.cloud.grow(missing, "for the next scenario")

    async def server_of_robots(self) -> str:
        """Return the name of the server that the one robot is connected to."""
        for server in self.cloud.servers:
            status = await self.cloud.backend_servers.status(server)
            if status is not None and status["robots"]:
                return server.name
        raise Missed("no server has the robot")

    async def ask_to_move(self, name: str) -> None:
        """Ask the robots of a server to move, as the rebalancer does."""
        server = next(each for each in self.cloud.servers if each.name == name)
        key = read_control_token(self._folder / "p" / "control.token")
        reader, writer = await asyncio.open_connection("127.0.0.1", server.control_port)
        writer.write(
            f"POST /move?robots=1&spread_s=0.1 HTTP/1.1\r\nHost: x\r\nAuthorization: {bearer(key)}\r\n"
            "Content-Length: 0\r\nConnection: close\r\n\r\n".encode()
        )
        answer = await reader.read(65536)
        writer.close()
        if b" 200 " not in answer.split(b"\r\n")[0] and b" 202 " not in answer.split(b"\r\n")[0]:
            raise Missed(f"the server moves nobody: {answer[:100]!r}")

    def revoke(self, robot: str) -> None:
        """Deny the robot, as rse-pf robot disable does."""
        self._access.change_deny_list(lambda denied: denied.with_robot("default", robot, time.time()))

    def enable(self, robot: str) -> None:
        """Allow the robot again."""
        self._access.change_deny_list(lambda denied: denied.without_robot("default", robot))

    async def live_map(self) -> None:
        """Start the live map that clients subscribe to, once."""
        if not self._has_map:
            robot = client_sdk.connect(self.cloud.url, token=self.token("operator"))
            async with robot:
                await robot.call("live-start", {"map": LIVE_MAP}, deadline_s=30.0)
            self._has_map = True

    def tokens_in_files(self) -> list[str]:
        """Return the files of the platform, its logs among them, that hold a part of a token."""
        parts = [part.encode() for token in self.tokens for part in token.split(".")[1:]]
        found = []
        for file in self._folder.rglob("*"):
            if file.is_file():
                data = file.read_bytes()
                found += [file.name] if any(part in data for part in parts) else []
        return found


def ring(seed: str, poses: int = 300) -> str:
    """Return a pose graph as g2o text: a circle whose closure is off by a little."""
    off_m = int(hashlib.sha256(seed.encode()).hexdigest()[:6], 16) / 1e9
    lines = []
    for i in range(poses):
        angle = 2 * math.pi * i / poses
        half = angle / 2
        lines.append(
            f"VERTEX_SE3:QUAT {i} {math.cos(angle) + off_m:.7f} {math.sin(angle):.7f} 0 "
            f"0 0 {math.sin(half):.7f} {math.cos(half):.7f}"
        )
    step = 2 * math.pi / poses
    x, y = math.sin(step), 1 - math.cos(step)
    turn = f"0 0 {math.sin(step / 2):.7f} {math.cos(step / 2):.7f}"
    ones = " ".join("1" if row == column else "0" for row in range(6) for column in range(row, 6))
    for i in range(poses):
        lines.append(f"EDGE_SE3:QUAT {i} {(i + 1) % poses} {y:.7f} {x:.7f} 0 {turn} {ones}")
    return "\n".join(lines) + "\n"


Run = Callable[[Bench, Driver, Link, str], Awaitable[dict[str, Any]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """One row of the table: what the driver is started with, and the run that judges it."""

    driven: str
    run: Run
    meaning: str
    token_s: float | None = None


SCENARIOS: dict[str, Scenario] = {}


def scenario(name: str, meaning: str, token_s: float | None = None) -> Callable[[Run], Run]:
    """Register a run under *name*; what stands before a slash is the scenario of the driver."""

    def register(run: Run) -> Run:
        SCENARIOS[name] = Scenario(driven=name.split("/")[0], run=run, meaning=meaning, token_s=token_s)
        return run

    return register


def must(holds: bool, what: str) -> None:
    """Raise Missed with *what* unless it holds."""
    if not holds:
        raise Missed(what)


def figures_of(done: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of a last line, and check that nothing was lost or answered twice."""
    must(done.get("lost") == 0, f"lost {done.get('lost')} of {done.get('sent')}")
    must(done.get("twice") == 0, f"answered twice: {done.get('twice')}")
    return {name: value for name, value in done.items() if name != "event"}


@scenario("golden", "decodes every golden message")
async def golden(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    return figures_of(await driver.done())


@scenario("pnp", "poses are those of the golden commands, within 1e-6")
async def pnp(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    figures = figures_of(await driver.done())
    must(figures["answered"] >= 3, f"answered {figures['answered']}")
    return figures


@scenario("typed-error", "an unknown service and three points have codes and hints")
async def typed_error(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    figures = figures_of(await driver.done())
    codes = figures["codes"]
    must(codes.get("unknown-service") == 1, f"codes {codes}")
    must(bool({"too-few", "bad-request"} & set(codes)), f"codes {codes}")
    return figures


@scenario("undecodable", "a command that cannot be decoded ends with the server's reason within 1 s")
async def undecodable(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    figures = figures_of(await driver.done(85))
    must(figures["kinds"] >= LEAST_KINDS, f"{figures['kinds']} kinds")
    must(figures["wrong"] == [], f"wrong: {figures['wrong'][:5]}")
    must(link.connections == 1, f"{link.connections} connections")
    return figures


@scenario("busy", "offers 4x its limits: paced, nothing lost, one connection")
async def busy(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    figures = figures_of(await driver.done(BUSY_S + 40))
    least = 0.5 * BUSY_S * bench.cloud.settings.session.max_commands_per_s
    must(link.connections == 1, f"{link.connections} connections")
    must(figures["codes"].get("ok", figures["answered"]) >= least, f"answered {figures['answered']}")
    return figures


async def stall(bench: Bench, seconds: float = 0.5) -> None:
    """Stop all servers for a while, as a hang would."""
    names = [server.name for server in bench.cloud.servers]
    for name in names:
        bench.cloud.pause(name)
    try:
        await asyncio.sleep(seconds)
    finally:
        for name in names:
            bench.cloud.resume(name)


@scenario("deadline", "commands expire while the servers are stalled")
async def deadline(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    await stall(bench)
    figures = figures_of(await driver.done())
    must(figures["codes"].get("expired", 0) >= 1, f"codes {figures['codes']}")
    return figures


@scenario("newest", "of the commands of a stream that wait, the newest is answered")
async def newest(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    await stall(bench, 0.9)  # longer than a client's pause between two bursts
    figures = figures_of(await driver.done())
    must(figures["codes"].get("stale", 0) >= 1, f"codes {figures['codes']}")
    must(figures.get("newest_ok", True) is True, "the newest was not answered")
    return figures


async def streamed(
    bench: Bench, driver: Driver, fault: Callable[[], Awaitable[None]], link: Link
) -> dict[str, Any]:
    """Let *fault* happen within a stream; return the figures at its end."""
    await driver.ready()
    await driver.until_answered(STREAM_PER_S, "a stream of answers", 15)
    await fault()
    after = driver.answered + 2 * STREAM_PER_S
    began = time.monotonic()
    await driver.until_answered(after, "answers after the fault", GOES_ON_S)
    back_s = time.monotonic() - began
    driver.say(do="stop")
    figures = figures_of(await driver.done())
    return {**figures, "connections": link.connections, "twenty_more_s": round(back_s, 2)}


@scenario("stream/kill", "a server is killed: nothing lost, nothing twice")
async def kill(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    async def fault() -> None:
        bench.cloud.kill(await bench.server_of_robots())

    figures = await streamed(bench, driver, fault, link)
    if not is_bridged(robot):
        must(figures["connections"] >= 2, "no second connection")
        return figures
    return moved(driver, robot, figures)


@scenario("stream/drain", "its server is drained: it moves, nothing lost")
async def drain(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    async def fault() -> None:
        await bench.cloud.drain(await bench.server_of_robots())

    return moved(driver, robot, await streamed(bench, driver, fault, link))


@scenario("stream/move", "it is asked to move: nothing lost")
async def move(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    async def fault() -> None:
        await bench.ask_to_move(await bench.server_of_robots())
        if not is_bridged(robot):
            await driver.until(lambda event: event.get("event") == "moved", "moved", 15)

    return moved(driver, robot, await streamed(bench, driver, fault, link))


def is_bridged(robot: str) -> bool:
    """Return whether *robot* speaks rosbridge: its server then moves in its place."""
    return robot.startswith("roslib")


def moved(driver: Driver, robot: str, figures: dict[str, Any]) -> dict[str, Any]:
    """Check that a client moved, or that a client of rosbridge kept its connection; return *figures*."""
    if is_bridged(robot):
        must(figures["connections"] == 1, f"{figures['connections']} connections")
    else:
        must(any(each.get("event") == "moved" for each in driver.events), "no event moved")
    return figures


@scenario("stream/wifi", "the network carries nothing for 5 s: nothing lost, nothing twice")
async def wifi(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    return await streamed(bench, driver, lambda: link.cut(CUT_S), link)


@scenario("stream/fragments", "messages come in fragments, of 4 KiB up")
async def fragments(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    link.fragment_bytes = FRAGMENT_BYTES

    async def fault() -> None:
        must(link.fragments > 0, "nothing was cut into fragments")

    return {**await streamed(bench, driver, fault, link), "fragments": link.fragments}


@scenario("stream/slow", "it reads 2 kB a second for 4 s: nothing lost, nothing twice")
async def slow(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    async def fault() -> None:
        link.down_bytes_per_s = SLOW_BYTES_PER_S
        await asyncio.sleep(SLOW_S)
        link.down_bytes_per_s = None

    return await streamed(bench, driver, fault, link)


@scenario("renew", "a fresh token: the connection outlives the first one", SHORT_TOKEN_S)
async def renew(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    async def fault() -> None:
        driver.say(do="renew", token=bench.token(robot))
        await asyncio.sleep(max(0.0, bench.token_ends_s + 2.0 - time.monotonic()))

    figures = await streamed(bench, driver, fault, link)
    must(figures["connections"] == 1, f"{figures['connections']} connections")
    return figures


@scenario("expired", "its token expires: a typed end", SHORT_TOKEN_S)
async def expired(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    figures = figures_of(await driver.done(60))
    must("unauthorized" in figures["codes"], f"codes {figures['codes']}")
    return figures


@scenario("revoked", "it is revoked: a typed end, and it does not come back")
async def revoked(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    bench.revoke(robot)
    figures = figures_of(await driver.done(30))
    ends = {"unauthorized", "forbidden", "auth", "revoked"}
    must(bool(ends & set(figures["codes"])), f"codes {figures['codes']}")
    must(link.connections == 1, f"{link.connections} connections")
    return {**figures, "connections": link.connections}


@scenario("not-finite", "NaN and Infinity of a LaserScan and a NavSatFix arrive, as null")
async def not_finite(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    ranges = [1.0, math.nan, math.inf, -math.inf]
    scan = {"op": "publish", "topic": "/scan", "type": "sensor_msgs/LaserScan", "msg": {"ranges": ranges}}
    fix = {"op": "publish", "topic": "/fix", "type": "sensor_msgs/NavSatFix", "msg": {"latitude": math.nan}}
    token = {"Authorization": f"Bearer {bench.token(f'{robot}-sensor')}"}
    address = f"ws://127.0.0.1:{bench.cloud.port}/rosbridge"
    async with connect(address, additional_headers=token, proxy=None) as sensor:
        for message in (scan, fix):
            await sensor.send(json.dumps(message))  # which writes NaN and Infinity, as roslibpy does
        return figures_of(await driver.done(20))


async def is_back(driver: Driver, from_s: float, within_s: float) -> dict[str, Any]:
    """Wait for answers on another connection; return how long after *from_s*, monotonic, they came."""
    await driver.until(lambda event: event.get("event") == "back", "connected again", within_s + 5.0)
    back_s = time.monotonic() - from_s
    await driver.until_answered(driver.answered + 3, "answers", 5)
    must(back_s <= within_s, f"back after {back_s:.1f} s")
    driver.say(do="stop")
    return {**figures_of(await driver.done()), "back_s": round(back_s, 2)}


async def is_refused(driver: Driver, word: str) -> None:
    """Wait until it was told that it is refused, by a reason with *word*."""
    event = await driver.until(lambda event: event.get("event") == "refused", "the reason of a refusal", 15)
    must(word in event["why"], f"told {event['why']!r}")


@scenario("returns/cut-off", "it signs its tokens and those until now are revoked: back within 5 s")
async def cut_off(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    await driver.until_answered(3, "answers", 15)
    await asyncio.sleep(os.urandom(1)[0] / 256)  # at any moment of a second
    valid_s = bench.cut_off(robot)
    return await is_back(driver, time.monotonic() + max(0.0, valid_s - time.time()), CUT_OFF_BACK_S)


@scenario("returns/disabled", "disabled and told so, and enabled again: back within 45 s")
async def disabled(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    bench.revoke(robot)
    await is_refused(driver, "this robot is disabled")
    bench.enable(robot)
    return await is_back(driver, time.monotonic(), BACK_S)


@scenario("returns/clock-ahead", "its clock is 120 s ahead: told so, and back within 5 s once it is set")
async def clock_ahead(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    bench.set_clock(CLOCK_S)
    link.drop()
    await is_refused(driver, "ahead of the server")
    bench.set_clock(0.0)
    return await is_back(driver, time.monotonic(), CUT_OFF_BACK_S)


@scenario("returns/clock-behind", "its clock is behind a cut-off: told so, and back 5 s after it is set")
async def clock_behind(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    bench.set_clock(-CLOCK_S)
    bench.cut_off(robot)
    await is_refused(driver, "before the server's present time")
    bench.set_clock(0.0)
    return await is_back(driver, time.monotonic(), CUT_OFF_BACK_S)


@scenario("returns/away", "the platform is away for a while: back within 45 s")
async def away(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await driver.ready()
    await link.away(bench.away_s)
    return await is_back(driver, time.monotonic(), BACK_S)


@scenario("updates", "a subscription to a live map has its first update")
async def updates(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    await bench.live_map()
    return figures_of(await driver.done())


@scenario("progress", "a long service tells its progress, and is cancelled")
async def progress(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    figures = figures_of(await driver.done(40))
    must(figures["codes"].get("cancelled") == 1, f"codes {figures['codes']}")
    return figures


@scenario("data", "bytes are stored and read back")
async def data(bench: Bench, driver: Driver, link: Link, robot: str) -> dict[str, Any]:
    return figures_of(await driver.done())
