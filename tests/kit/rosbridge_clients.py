"""Clients of a rosbridge server: what they send, and what they receive."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

from tests.kit.guarded_server import GuardedServer

PATIENCE_S = 30.0


class Client:
    """One WebSocket."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket

    async def send(self, *operations: Any) -> None:
        """Send operations, as values or as texts."""
        for each in operations:
            await self.socket.send(each if isinstance(each, str | bytes) else json.dumps(each))

    async def receive(self) -> Any:
        """Return the next message."""
        return json.loads(await asyncio.wait_for(self.socket.recv(), PATIENCE_S))

    async def ask(self, *operations: Any) -> Any:
        """Send operations and return the next message."""
        await self.send(*operations)
        return await self.receive()

    async def data(self, count: int = 1) -> list[Any]:
        """Return the field ``data`` of the next *count* messages of topics."""
        return [(await self.receive())["msg"]["data"] for _ in range(count)]

    async def settle(self) -> Any:
        """Wait until what was sent before is executed; return what came instead, if something did."""
        answer = await self.ask(call("/rosapi/topics", "settled"))
        return None if answer.get("id") == "settled" else answer

    async def close_code(self) -> int | None:
        """Wait until the server has closed the connection, and return the code."""
        await asyncio.wait_for(self.socket.wait_closed(), PATIENCE_S)
        return self.socket.close_code


class Bridge:
    """A rosbridge server, and its clients."""

    def __init__(self, server: GuardedServer, port: int) -> None:
        self.server = server
        self.url = f"ws://127.0.0.1:{port}/rosbridge"
        self._clients: list[Client] = []

    async def client(self, robot: str = "", **claims: Any) -> Client:
        """Connect a robot with its token in the header; without *robot* it is a new one."""
        return await self.open(self.server.token(robot or f"robot-{len(self._clients)}", **claims))

    async def open(self, token: str = "", **options: Any) -> Client:
        """Connect with *token* in the header, or without one."""
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        headers |= options.pop("headers", {})
        made = Client(
            await connect(self.url, additional_headers=headers, compression=None, proxy=None, **options)
        )
        self._clients.append(made)
        return made

    async def close(self) -> None:
        """Close all clients."""
        await asyncio.gather(*(each.socket.close() for each in self._clients))


def auth(token: str) -> dict[str, Any]:
    """Return the message by which roslibjs shows a token."""
    return {
        "op": "auth", "mac": token, "client": "", "dest": "", "rand": "", "t": 0.5, "level": "", "end": 1.0,
    }  # fmt: skip


def call(service: str = "/echo", identity: Any = "call:1", **more: Any) -> dict[str, Any]:
    """Return a call of *service*."""
    return {"op": "call_service", "id": identity, "service": service, **more}


def subscribe(topic: str = "/chat", identity: Any = "s:1", **more: Any) -> dict[str, Any]:
    """Return a subscription."""
    return {"op": "subscribe", "id": identity, "topic": topic, **more}


def publish(data: Any, topic: str = "/chat", **more: Any) -> dict[str, Any]:
    """Return a message of *topic*."""
    return {"op": "publish", "topic": topic, "msg": {"data": data}, **more}
