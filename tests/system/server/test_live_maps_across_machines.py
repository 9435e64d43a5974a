"""Two servers on two machines share live maps over TCP and a store, and offer other machines nothing else.

The machines are network namespaces; the test is the robots' side of both.  The ports are those that the
template's firewall opens.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from server.live_map.test_served import keyframe

import client_sdk
from rse_pf.config import PlatformSettings
from rse_pf.config.settings import LIVE_PORTS
from rse_pf.processes.ipc import FrameReader, encode_message
from rse_pf.server.live_map.connection_security import (
    TOKEN_S,
    ConnectionClaims,
    client_context,
    internal_key,
    make_token,
)
from rse_pf.server.live_map.lease import LeaseRecord, decode_lease, lease_name
from rse_pf.storage.object_store import DirectoryStore
from tests.kit.guarded_server import KEY

pytestmark = [pytest.mark.slow, pytest.mark.system]

WAIT_S = 60.0
SETTINGS = PlatformSettings()
LISTENING = "0A"
LOOPBACK = ("0100007F", "00000000000000000000000001000000")


def ip(*words: str) -> bool:
    return subprocess.run(["ip", *words], capture_output=True, check=False).returncode == 0


@dataclass
class Machine:
    """A namespace with one server; *address* is its own for robots."""

    space: str
    address: str
    name: str
    folder: Path
    process: subprocess.Popen[bytes] | None = None

    @property
    def log(self) -> str:
        return (self.folder / f"{self.name}.log").read_text()

    def serve(self) -> None:
        """Start a server as the units of a machine on AWS start it, on the common store."""
        announce = self.folder / f"{self.name}.json"
        with (self.folder / f"{self.name}.log").open("ab") as log:
            self.process = subprocess.Popen(
                ["ip", "netns", "exec", self.space, sys.executable, "-m", "rse_pf.cli.main", "serve",
                 "--host", "0.0.0.0", "--control-host", "0.0.0.0", "--live-host", "0.0.0.0", "--workers", "1",
                 "--keys", str(self.folder / "keys.json"), "--server-id", self.name,
                 "--store", f"dir:{self.folder / 'store'}", "--announce", str(announce)],
                stdout=subprocess.DEVNULL, stderr=log, start_new_session=True,
            )  # fmt: skip
        end_s = time.monotonic() + WAIT_S
        while not announce.exists():
            assert self.process.poll() is None, self.log
            assert time.monotonic() < end_s, self.log
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(0.05)

    def kill(self) -> None:
        """End all processes of the server at once, as a machine that fails ends them."""
        if self.process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()

    def open_ports(self) -> set[int]:
        """Return the ports on which other machines can connect to this one."""
        found = set()
        for table in ("tcp", "tcp6"):
            shown = subprocess.run(
                ["ip", "netns", "exec", self.space, "cat", f"/proc/net/{table}"], capture_output=True,
                text=True, check=True,
            )  # fmt: skip
            for line in shown.stdout.splitlines()[1:]:
                local, state = line.split()[1], line.split()[3]
                address, _, port = local.partition(":")
                if state == LISTENING and address not in LOOPBACK:
                    found.add(int(port, 16))
        return found


@pytest.fixture
def machines(tmp_path: Path) -> Iterator[tuple[Machine, Machine]]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and ip(8)")
    number = os.getpid() % 200 + 20
    names = [f"rse-pf-live-{number}{each}" for each in "ab"]
    (tmp_path / "store").mkdir()
    (tmp_path / "keys.json").write_text(KEY.key_set().to_json())
    made = [
        Machine(names[at], f"10.{212 + at}.{number}.2", f"server-{'ab'[at]}", tmp_path) for at in range(2)
    ]
    steps: list[tuple[str, ...]] = [("netns", "add", each) for each in names]
    for at, each in enumerate(names):
        near = f"rsel{number}{'ab'[at]}"
        steps += [
            ("link", "add", near, "type", "veth", "peer", "name", "robots", "netns", each),
            ("address", "add", f"10.{212 + at}.{number}.1/24", "dev", near),
            ("link", "set", near, "up"),
            ("-n", each, "address", "add", f"{made[at].address}/24", "dev", "robots"),
        ]
    steps.append(("-n", names[0], "link", "add", "servers", "type", "veth", "peer", "name", "servers",
                  "netns", names[1]))  # fmt: skip
    for at, each in enumerate(names):
        steps += [
            ("-n", each, "address", "add", f"10.214.{number}.{at + 1}/24", "dev", "servers"),
            *(("-n", each, "link", "set", device, "up") for device in ("lo", "robots", "servers")),
            ("-n", each, "route", "add", "default", "via", f"10.214.{number}.{2 - at}"),
        ]
    try:
        failed = next((step for step in steps if not ip(*step)), None)
        if failed is not None:
            pytest.skip(f"the kernel does not take: ip {' '.join(failed)}")
        for machine in made:
            machine.serve()
        yield made[0], made[1]
    finally:
        for machine in made:
            machine.kill()
            ip("netns", "delete", machine.space)
        for at in range(2):
            ip("link", "delete", f"rsel{number}{'ab'[at]}")


def robot(machine: Machine, name: str) -> client_sdk.Robot:
    token = KEY.issue(name, now=time.time(), token_id=name, settings=SETTINGS.auth)
    url = f"ws://{machine.address}:{SETTINGS.serving.port}/ws"
    return client_sdk.connect(url, token=token, codec="bin", random=random.Random(name))


async def add(sender: client_sdk.Robot, number: int) -> int:
    """Send a keyframe; return how many of its robot the map holds then."""
    answer = await sender.call("live-keyframe", keyframe(number), deadline_s=WAIT_S)
    return int(answer.reply["number"])


async def shown(reader: client_sdk.Robot) -> dict[str, Any]:
    reply: dict[str, Any] = (await reader.call("live-show", {"map": "m"}, deadline_s=WAIT_S)).reply
    return reply


def kept(show: dict[str, Any]) -> dict[str, int]:
    """Return how many keyframes of each robot a map holds."""
    return {each["robot"]: each["keyframes"] for each in show["robots"]}


async def first_words(record: LeaseRecord, address: str, key: bytes, *, tls: bool = True) -> Any:
    """Return what an owner answers to a worker with *key*; None if it hangs up."""
    reader, writer = await asyncio.open_connection(
        address, record.port, ssl=client_context() if tls else None
    )
    try:
        claims = ConnectionClaims(
            tenant="default", map_name="m", epoch=record.epoch, certificate=record.certificate,
            expires_s=time.time() + TOKEN_S,
        )  # fmt: skip
        writer.write(encode_message(["hello", make_token(key, claims)]))
        frames = FrameReader(1 << 16)
        while data := await asyncio.wait_for(reader.read(1 << 16), WAIT_S):
            if not tls:
                return None  # an alert of TLS
            for message in frames.feed(data):
                return message
    except OSError:
        pass
    finally:
        writer.transport.abort()
    return None


async def test_a_map_goes_on_when_the_machine_of_its_owner_fails(machines: tuple[Machine, Machine]) -> None:
    here, there = machines
    store = DirectoryStore(here.folder / "store")

    async with contextlib.AsyncExitStack() as robots:
        second = await robots.enter_async_context(robot(there, "second"))
        first = await robots.enter_async_context(robot(here, "first"))
        assert [await add(first, 0), await add(first, 1)] == [1, 2]
        assert await add(second, 0) == 1
        assert (await shown(second))["server"] == here.name, here.log
        record = decode_lease("lease", store.get(lease_name("default", "m")))
        assert (record.address.startswith("10.214."), record.port) == (True, SETTINGS.live.first_port)

        here.kill()

        assert await add(second, 1) == 2
        now = await shown(second)
        assert (now["server"], kept(now)) == (there.name, {"first": 2, "second": 2}), there.log


async def test_other_machines_reach_the_ports_of_the_firewall_only_and_owners_only_with_the_key(
    machines: tuple[Machine, Machine],
) -> None:
    here = machines[0]
    store = DirectoryStore(here.folder / "store")
    live = range(SETTINGS.live.first_port, SETTINGS.live.first_port + LIVE_PORTS)

    async with robot(here, "first") as first:
        assert await add(first, 0) == 1
        record = decode_lease("lease", store.get(lease_name("default", "m")))
        key = internal_key(store)
        assert await first_words(record, here.address, key) == ["welcome"]
        refused = await first_words(record, here.address, bytes(32))
        assert refused[:3] == ["refused", 0, "unauthorized"]
        assert await first_words(record, here.address, key, tls=False) is None
        assert kept(await shown(first)) == {"first": 1}
    for each in machines:
        ports = each.open_ports()
        serving = {SETTINGS.serving.port, SETTINGS.serving.control_port}
        assert serving <= ports <= serving | set(live), each.name
    assert set(live) & here.open_ports()
