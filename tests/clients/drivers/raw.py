"""A robot of one file, written from docs/protocol.md alone: nothing of the platform is imported."""

import asyncio
import contextlib
import json
import os
import random
import sys
import time

import websockets

AGAIN = ("busy", "worker-lost", "disconnected", "internal", "quota")  # section 5
ENDS = {4401: "unauthorized", 4403: "forbidden", 4400: "protocol", 4406: "unsupported", 4409: "conflict"}
SOCKET_ERRORS = (OSError, EOFError, asyncio.TimeoutError, websockets.WebSocketException)


class Robot:
    def __init__(self):
        self.url, self.token, self.ids = os.environ["RSE_PF_URL"], os.environ["RSE_PF_TOKEN"], 0
        self.waiting, self.pushed, self.tasks, self.sent = {}, asyncio.Queue(), set(), 0
        self.known, self.codes, self.times, self.over = set(), {}, [], ""
        self.socket, self.server, self.limits, self.next_s = None, "", {}, 0.0
        self.ready = asyncio.Event()

    def spawn(self, work):
        self.tasks.add(task := asyncio.ensure_future(work))
        task.add_done_callback(self.tasks.discard)

    async def open(self, other_than=""):
        headers = {"Authorization": f"Bearer {self.token}"}
        options = {"compression": None, "ping_interval": None, "proxy": None, "open_timeout": 2}
        socket = await websockets.connect(
            self.url, subprotocols=["rse-pf.v1.json"], additional_headers=headers, max_size=1 << 20, **options
        )
        await socket.send(json.dumps({"type": "hello", "capabilities": ["progress", "updates"]}))
        welcome = json.loads(await asyncio.wait_for(socket.recv(), 5))
        if welcome.get("server", other_than) == other_than:
            await socket.close()
            raise OSError("the same server")
        self.socket, self.server, self.limits = socket, welcome["server"], welcome["limits"]
        self.ready.set()
        self.spawn(self.read(socket))
        self.spawn(self.ping(socket))

    async def stay_connected(self):
        attempt = 0
        while not self.over:
            await asyncio.sleep(random.uniform(0, min(1.0, 0.1 * 2**attempt)))
            attempt += 1
            try:
                await self.open()
            except websockets.InvalidStatus as error:
                if error.response.status_code in (401, 403):
                    self.over = json.loads(error.response.body)["code"]
            except SOCKET_ERRORS:
                pass
            else:
                for command in list(self.waiting.values()):  # again, with the same ids
                    await self.put(command["message"])
                return

    async def read(self, socket):
        try:
            async for text in socket:
                message = json.loads(text)
                if message["type"] == "pong":
                    socket.pong_s = time.monotonic()
                elif message["type"] == "move":
                    self.spawn(self.move(socket, time.monotonic() + message["within_ms"] / 1e3))
                elif message["type"] in ("result", "failure") and message.get("id") in self.known:
                    self.end(message)
                else:
                    self.pushed.put_nowait(message)
        except websockets.WebSocketException:
            pass
        if socket is self.socket:
            self.ready.clear()
            self.over = ENDS.get(socket.close_code, "")
            await self.stay_connected()

    async def ping(self, socket):
        while socket.close_code is None and socket is self.socket:
            sent_s = time.monotonic()
            await self.put({"type": "ping", "sent_s": sent_s})
            await asyncio.sleep(3)
            if getattr(socket, "pong_s", 0.0) < sent_s:
                socket.transport.abort()

    async def move(self, old, end_s):
        while old is self.socket and time.monotonic() < end_s:
            try:
                await self.open(other_than=self.server)
            except SOCKET_ERRORS:
                await asyncio.sleep(random.uniform(0.05, 0.2))
        self.pushed.put_nowait({"type": "moved", "server": self.server})
        left = set(self.waiting)
        while left & set(self.waiting) and time.monotonic() < end_s:
            await asyncio.sleep(0.01)
        await old.close()
        for identity in left & set(self.waiting):
            await self.put(self.waiting[identity]["message"])

    async def put(self, message):
        with contextlib.suppress(websockets.WebSocketException):  # what is unanswered is sent again
            await self.socket.send(json.dumps(message))

    def send_again(self, message):
        self.spawn(self.put(message))

    async def call(self, service, payload, **more):
        await self.ready.wait()
        while len(self.waiting) >= self.limits["max_in_flight"] or time.monotonic() < self.next_s:
            await asyncio.sleep(0.005)
        pace = max(1.0, self.limits.get("max_commands_per_s", 1000.0) - 2)  # pings count, too
        self.next_s = max(self.next_s, time.monotonic() - 8 / pace) + 1 / pace
        self.ids += 1
        message = {"type": "command", "id": self.ids, "service": service, "payload": payload, **more}
        future = asyncio.get_running_loop().create_future()
        self.waiting[self.ids] = {"message": message, "future": future, "at": time.monotonic()}
        self.known.add(self.ids)
        self.sent += 1
        if "deadline_ms" in more:
            late = {"type": "failure", "id": self.ids, "code": "expired"}
            asyncio.get_running_loop().call_later(more["deadline_ms"] / 1e3, self.end, late)
        await self.put(message)
        return await future

    def end(self, message):
        command, code = self.waiting.get(message["id"]), message.get("code", "ok")
        if command is not None and code in AGAIN:
            wait_s = (message.get("retry_after_ms") or 100) / 1e3
            asyncio.get_running_loop().call_later(wait_s, self.send_again, command["message"])
        elif command is not None:  # else it was answered before, or is too late
            del self.waiting[message["id"]]
            self.times.append(1e3 * (time.monotonic() - command["at"]))
            self.codes[code] = self.codes.get(code, 0) + 1
            if not command["future"].done():
                command["future"].set_result(message)


if __name__ == "__main__":
    from raw_scenarios import run  # what the harness asks for, and nothing of the protocol

    run(Robot, sys.argv[1])
