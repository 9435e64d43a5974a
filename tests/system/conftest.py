"""Start real backend servers and talk to them; everything ends with the test."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import select
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import websockets
from websockets.asyncio.client import ClientConnection

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.wire import SUBPROTOCOLS, Command, Hello, make_codec

_SERVE = """
import json, sys
from pathlib import Path
from rse_pf.auth.tokens import KeySet
from rse_pf.server.supervisor import serve
from rse_pf.config import PlatformSettings
o = json.loads(sys.argv[1])
sys.exit(serve(PlatformSettings.from_dict(o["settings"]), keys=o["keys"] and KeySet.from_json(o["keys"]),
    server_id=o["server"], announce=Path(o["announce"]), conformance_echo=o["echo"], services=o["services"],
    audit=o["audit"] and Path(o["audit"])))
"""

_SERVICES = """
import ctypes, time
from typing import Any
import msgspec
from rse_pf.service import Registry
from rse_pf.services import echo

class Work(msgspec.Struct, frozen=True, kw_only=True):
    rest_s: float = 0.0
    burn_s: float = 0.0
    fill: int = 0
    fail: bool = False

class Done(msgspec.Struct, frozen=True, kw_only=True):
    filling: str = ""

def make(settings):
    registry = Registry()
    echo.register(registry)

    @registry.service("work")
    def work(request: Work) -> Done:
        if request.fail:
            raise ZeroDivisionError("secret of the service")
        time.sleep(request.rest_s)
        end = time.thread_time() + request.burn_s
        while time.thread_time() < end:
            pass
        return Done(filling="x" * request.fill)

    @registry.service("crash")
    def crash(request: Work) -> Done:
        ctypes.string_at(0)
        return Done()

    return registry
"""

KEY = SigningKey.from_seed(b"k" * 32, "test-key")
START_S = 30.0


class Server:
    """A backend server in processes of its own."""

    def __init__(self, process: subprocess.Popen[str], announce: Path, settings: PlatformSettings) -> None:
        self.process = process
        self.settings = settings
        self.lines: list[dict[str, Any]] = []
        self.text = ""
        self._heard = threading.Condition()
        self.listener = threading.Thread(target=self._listen, daemon=True)
        self.listener.start()
        self.wait_for_log("server-ready", START_S)
        self.identity = json.loads(announce.read_text())
        self.port: int = self.identity["port"]
        self.workers: list[int] = self.identity["workers"]
        self.url = f"ws://127.0.0.1:{self.port}/ws"

    def _listen(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self._heard:
                self.text += line
                if line.startswith("{"):
                    self.lines.append(json.loads(line))
                self._heard.notify_all()

    def wait_for_log(self, event: str, within_s: float = 5.0) -> dict[str, Any]:
        """Return the first log line of *event*, as soon as it is written."""

        def found() -> list[dict[str, Any]]:
            return [line for line in self.lines if line["event"] == event]

        with self._heard:
            assert self._heard.wait_for(found, within_s), f"no {event} in:\n{self.text}"
            return found()[0]

    def http(self, path: str, method: str = "GET") -> tuple[int, dict[str, str], bytes]:
        """Ask the control port."""
        url = f"http://127.0.0.1:{self.identity['control_port']}{path}"
        try:
            with urllib.request.urlopen(urllib.request.Request(url, method=method), timeout=5) as answer:
                return answer.status, dict(answer.headers), answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, dict(error.headers), error.read()

    def status(self) -> dict[str, Any]:
        """Return /status."""
        return json.loads(self.http("/status")[2])

    def token(self, robot: str = "robot-1", **more: Any) -> str:
        """Return a token that this server accepts."""
        return KEY.issue(robot, now=time.time(), token_id="t-1", settings=self.settings.auth, **more)

    @contextlib.asynccontextmanager
    async def robot(self, codec: str = "bin", *, hello: bool = True, token: str = "", **options: Any):
        """Open a robot's socket; the welcome is in ``robot.welcome``."""
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        async with websockets.connect(
            self.url, subprotocols=[SUBPROTOCOLS[codec]], compression=None, ping_interval=None,
            additional_headers=headers, close_timeout=1, **options,
        ) as socket:  # fmt: skip
            robot = Robot(socket, codec)
            if hello:
                await robot.send(Hello())
                robot.welcome = await robot.receive()
            yield robot

    def end(self) -> None:
        """Kill what is left."""
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        self.listener.join(5)
        assert self.process.stderr is not None
        self.process.stderr.close()


class Robot:
    """The smallest client: messages in, messages out."""

    def __init__(self, socket: ClientConnection, codec: str) -> None:
        self.socket = socket
        self.codec = make_codec(codec)
        self.welcome: Any = None

    async def send(self, message: Any) -> None:
        data = self.codec.encode(message)
        await self.socket.send(data.decode() if self.codec.is_text else data)

    async def receive(self, within_s: float = 5.0) -> Any:
        data = await asyncio.wait_for(self.socket.recv(decode=False), within_s)
        return self.codec.decode_from_server(data)

    async def ask(self, identity: int, service: str, payload: Any = None, **more: Any) -> Any:
        await self.send(Command(id=identity, service=service, payload=payload, **more))
        return await self.receive()


def wait_gone(pid: int, within_s: float = 5.0) -> None:
    """Wait until process *pid* has ended."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        assert select.select([handle], [], [], within_s)[0], f"process {pid} still lives"
    finally:
        os.close(handle)


@pytest.fixture
def gone():
    """The function that waits for a process to end."""
    return wait_gone


@pytest.fixture
def start_server(tmp_path):
    """Return a function that starts a server; settings groups are its keyword arguments."""
    (tmp_path / "served_in_tests.py").write_text(_SERVICES)
    started: list[Server] = []

    def start(
        *, keys: bool = False, echo: bool = False, audit: Path | None = None, **groups: dict[str, Any]
    ) -> Server:
        groups["serving"] = {"port": 0, "control_port": 0, "workers": 1, **groups.get("serving", {})}
        groups["auth"] = {"required": keys, **groups.get("auth", {})}
        announce = tmp_path / f"announce-{len(started)}.json"
        order = {
            "settings": groups, "keys": KEY.key_set().to_json() if keys else None, "echo": echo,
            "server": f"server-{len(started)}", "announce": str(announce), "services": "served_in_tests:make",
            "audit": audit and str(audit),
        }  # fmt: skip
        process = subprocess.Popen(
            [sys.executable, "-c", _SERVE, json.dumps(order)],
            env={**os.environ, "PYTHONPATH": str(tmp_path)}, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            server = Server(process, announce, PlatformSettings.from_dict(groups))
        except BaseException:
            process.kill()
            process.wait()
            raise
        started.append(server)
        return server

    yield start
    for server in started:
        server.end()
