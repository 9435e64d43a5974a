"""A fake client of live maps, and a fake connection of a robot."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from rse_pf.auth.tokens import Claims
from rse_pf.config import SessionSettings
from rse_pf.errors import Conflict, RsePfError
from rse_pf.identity import RobotId
from rse_pf.wire import Hello, make_codec
from rse_pf.wire.server_session import ServerSession
from tests.kit import server_sessions

OnUpdate = Callable[[str, str, dict[str, Any]], None]


class FakeLiveMapClient:
    """A client whose maps count the keyframes of each robot, unless ``answer`` returns another reply."""

    def __init__(self, on_update: OnUpdate) -> None:
        self.on_update = on_update
        self.asked: list[tuple[str, str, RobotId, str, Any, float]] = []
        self.watched: list[tuple[str, str]] = []
        self.may_start: dict[tuple[str, str], bool] = {}
        self.unwatched: list[tuple[str, str]] = []
        self.maps: dict[str, list[dict[str, Any]]] = {}
        self.answer: Callable[[str, Any], dict[str, Any] | RsePfError | None] | None = None
        self.gave_up = self.closed = False
        self._next: dict[tuple[str, str, RobotId], int] = {}

    def cpu_by_tenant(self) -> dict[str, float]:
        return {}

    async def request(
        self,
        tenant: str,
        map_name: str,
        robot: RobotId,
        operation: str,
        payload: Any,
        deadline_s: float,
    ) -> dict[str, Any]:
        self.asked.append((tenant, map_name, robot, operation, payload, deadline_s))
        await asyncio.sleep(0)
        if self.answer is not None:
            answer = self.answer(operation, payload)
            if answer is None:
                await asyncio.Event().wait()
            if isinstance(answer, RsePfError):
                raise answer
            assert answer is not None
            return answer
        key = (tenant, map_name, robot)
        next_number = self._next.get(key, 0)
        if payload.number > next_number:
            raise Conflict(f"the next keyframe is {next_number}", hint="send the earlier ones first")
        self._next[key] = max(next_number, payload.number + 1)
        return {"number": self._next[key], "version": len(self.asked)}

    async def list_maps(self, tenant: str) -> list[dict[str, Any]]:
        return self.maps.get(tenant, [])

    def watch(self, tenant: str, map_name: str, *, may_start: bool) -> None:
        self.watched.append((tenant, map_name))
        self.may_start[tenant, map_name] = may_start

    def unwatch(self, tenant: str, map_name: str) -> None:
        self.unwatched.append((tenant, map_name))

    def give_up(self) -> None:
        self.gave_up = True

    async def close(self) -> None:
        self.closed = True


class FakeReader:
    """One robot's connection; keeps what was written, decoded."""

    def __init__(self, name: str = "r", *, tenant: str = "default", codec: str = "json") -> None:
        self.robot = RobotId(tenant, name)
        self.claims: Claims | None = None
        self.codec = make_codec(codec)
        self.session: ServerSession | None = ServerSession(
            codec=self.codec, robot=name, server="s", session="x", limits=SessionSettings()
        )
        server_sessions.receive(self.session, self.codec.encode(Hello(capabilities=("updates",))), 0.0)
        self.is_connected = True
        self.unsent_bytes = 0
        self.max_unsent: int | None = None
        self.written: list[Any] = []

    def bound_unsent(self, max_bytes: int) -> None:
        self.max_unsent = max_bytes

    def write(self, data: bytes) -> None:
        self.written.append(self.codec.decode_from_server(data))

    def refuse_updates(self, identity: int, error: RsePfError) -> None:
        assert self.session is not None
        self.write(self.session.refuse_updates(identity, error).data)
