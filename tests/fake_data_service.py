"""A data service in this process: requests go in as ASGI calls, time stands still."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterable, Mapping
from typing import Any

from rse_pf.auth import SigningKey
from rse_pf.data_server import DataServer
from rse_pf.objects import ObjectStore
from rse_pf.settings import PlatformSettings

NOW = 1_700_000_000.0
KEY = SigningKey.from_seed(b"k" * 32, "key-1")


class Answer:
    """What came back."""

    def __init__(self, status: int, headers: Mapping[str, str], body: bytes) -> None:
        self.status, self.headers, self.body = status, headers, body

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Service:
    """The application with a store and a clock of its own."""

    def __init__(self, settings: PlatformSettings, store: ObjectStore) -> None:
        self.settings, self.store = settings, store
        self.now = 0.0
        self.wall = NOW
        self.lines: list[dict[str, Any]] = []
        self.restart()

    def restart(self) -> None:
        self.app = DataServer(
            self.settings, self.store, keys=KEY.key_set, log=self.lines.append,
            clock=lambda: self.now, wall_clock=lambda: self.wall,
        )  # fmt: skip

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
        """Send one request, and insist on a well-formed answer."""
        if isinstance(body, bytes):
            messages = [{"type": "http.request", "body": body, "more_body": False}]
        else:
            messages = list(body)
        sent: list[Mapping[str, Any]] = []
        bearer = self.token(robot, tenant) if token is None else token
        named = {"authorization": f"Bearer {bearer}", **(headers or {})}
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


def small_settings(**data: Any) -> PlatformSettings:
    """Return settings whose limits a test can reach."""
    limits = {"part_bytes": 4096, "max_object_bytes": 20_000, "quota_bytes": 50_000, **data}
    return PlatformSettings().replace(data=limits)
