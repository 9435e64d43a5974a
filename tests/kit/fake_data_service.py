"""A data service in this process: requests are ASGI calls, and its clock is a variable."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.data_server import DataServer
from rse_pf.data_server.robot_processes import max_map_bytes
from rse_pf.identity import RobotId
from rse_pf.maps.describe import MapSummary, describe_map
from rse_pf.storage.object_store import ObjectStore

NOW = 1_700_000_000.0
KEY = SigningKey.from_seed(b"k" * 32, "key-1")


class Answer:
    """A response."""

    def __init__(self, status: int, headers: Mapping[str, str], body: bytes) -> None:
        self.status, self.headers, self.body = status, headers, body

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Service:
    """The application with its own store and clock."""

    def __init__(self, settings: PlatformSettings, store: ObjectStore, localiser: Any = None) -> None:
        self.settings, self.store, self.localiser = settings, store, localiser
        self.now = 0.0
        self.wall = NOW
        self.lines: list[dict[str, Any]] = []
        self.restart()

    def restart(self) -> None:
        self.app = DataServer(
            self.settings, self.store, keys=KEY.key_set, log=self.lines.append,
            clock=lambda: self.now, wall_clock=lambda: self.wall, describe=self.describe,
            pause=self.pause, localiser=self.localiser,
        )  # fmt: skip

    async def pause(self, seconds: float) -> None:
        """Let the pause before a refusal pass at once."""
        self.now += seconds

    def describe(self, robot: RobotId, name: str) -> MapSummary:
        """Count what a map holds in this process; a data server has a process with limits for it."""
        return describe_map(self.store.get(name), max_map_bytes(self.settings))

    def token(self, robot: str = "robot-1", tenant: str = "default", scopes: tuple[str, ...] = ()) -> str:
        return KEY.issue(
            robot, now=self.wall, token_id="t", settings=self.settings.auth, scopes=scopes, tenant=tenant
        )

    def ask(
        self,
        method: str,
        path: str,
        body: bytes | Iterable[Mapping[str, Any]] = b"",
        *,
        robot: str = "robot-1",
        token: str | None = None,
        headers: Mapping[str, str] | None = None,
        query: str = "",
        tenant: str = "default",
    ) -> Answer:
        """Send one request and return its response, which must be well-formed."""
        if isinstance(body, bytes):
            messages = [{"type": "http.request", "body": body, "more_body": False}]
        else:
            messages = list(body)
        sent: list[Mapping[str, Any]] = []
        bearer = self.token(robot, tenant) if token is None else token
        frame = {} if body == b"" else {"transfer-encoding": "chunked"}
        named = {"authorization": f"Bearer {bearer}", **frame, **(headers or {})}
        scope = {
            "type": "http", "method": method, "path": path, "query_string": query.encode("latin-1"),
            "headers": [(k.lower().encode("latin-1"), v.encode("latin-1")) for k, v in named.items()],
        }  # fmt: skip

        async def receive() -> Mapping[str, Any]:
            if not messages:
                await asyncio.Event().wait()
            message = messages.pop(0)
            self.now += message.get("after_s", 0.0)
            return message

        async def send(message: Mapping[str, Any]) -> None:
            sent.append(message)

        asyncio.run(self.app(scope, receive, send))
        if not sent:
            return Answer(0, {}, b"")
        assert sent[0]["type"] == "http.response.start"
        assert not sent[-1].get("more_body")
        return Answer(
            sent[0]["status"],
            {name.decode(): value.decode() for name, value in sent[0]["headers"]},
            b"".join(message.get("body", b"") for message in sent[1:]),
        )


class HttpServer:
    """A service on a port of this machine, for HTTP clients; one request at a time.  A context manager."""

    def __init__(self, service: Service) -> None:
        lock = threading.Lock()

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def answer(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                path, _, query = self.path.partition("?")
                headers = {name: value for name, value in self.headers.items() if name != "Authorization"}
                token = self.headers.get("Authorization", "").removeprefix("Bearer ")
                with lock:
                    made = service.ask(self.command, path, body, token=token, headers=headers, query=query)
                self.send_response(made.status)
                for name, value in {**made.headers, "content-length": str(len(made.body))}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(made.body)

            do_GET = do_PUT = do_PATCH = do_DELETE = do_POST = answer

            def log_message(self, *_: object) -> None:
                """Log nothing."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True)
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> HttpServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(10)


def small_settings(**data: Any) -> PlatformSettings:
    """Return settings whose limits a test can reach."""
    limits = {"part_bytes": 4096, "max_object_bytes": 20_000, "quota_bytes": 50_000, **data}
    return PlatformSettings().replace(data=limits)
