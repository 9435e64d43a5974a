"""Play, on one machine, what stands before the function on AWS: firewall, load balancer and Lambda.

    python -m lambda_pnp.local_front FOLDER [--port P] [--parent PID]

FOLDER is that of a local platform: its settings and its public keys.  Requests become the events of a load
balancer.  Each execution answers one command at a time; an idle one is used again, and no more than
``cloud.lambda_concurrency`` exist.  It is for trials and measurements: it listens on loopback only.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import contextlib
import re
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from lambda_pnp.answering import Answering
from lambda_pnp.keys import KeyCache
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.config.front_door import BEARER_PATTERN, BURST_PATH
from rse_pf.errors import NotFound, RsePfError
from rse_pf.linux import die_with_parent, set_process_name
from rse_pf.silent_connections import BACKLOG, FIRST_REQUEST_S, KEEP_ALIVE_S, SilentConnections
from rse_pf.terminal import show, show_error, show_json

__all__ = ["LocalFront", "answering_of", "read_beside"]

_HOST = "127.0.0.1"
_TIMEOUT_S = 10.0
_MAX_HEAD_BYTES = 16384
_MAX_BODY_BYTES = 1_048_576
"""Of a request that an ALB passes on to a function."""
_TOKEN = re.compile(BEARER_PATTERN)
_REASONS = {
    200: "OK", 400: "Bad Request", 401: "Unauthorized", 404: "Not Found", 413: "Payload Too Large",
    502: "Bad Gateway",
}  # fmt: skip


class LocalFront:
    """The firewall, the load balancer and the executions of one function.

    Attributes:
        url: Where commands are posted, once it listens.
        answered: Requests that an execution answered; ``refused`` those that met none.
        executions: How many were started.
    """

    def __init__(
        self, make: Callable[[], Answering], *, most: int, first_request_s: float = FIRST_REQUEST_S
    ) -> None:
        """Describe the front; nothing listens yet.

        Args:
            make: Starts an execution.
            most: How many there may be at a time.
            first_request_s: A connection whose first request is not complete by then is cut.
        """
        self.url = ""
        self.answered = self.refused = self.executions = 0
        self._make = make
        self._most = most
        self._first_request_s = first_request_s
        self._idle: list[Answering] = []
        self._threads = ThreadPoolExecutor(most, "execution")
        self._writers: set[asyncio.StreamWriter] = set()
        self._server: asyncio.Server | None = None
        self._silent: SilentConnections[asyncio.StreamWriter] | None = None

    async def start(self, port: int = 0) -> None:
        """Listen on loopback; port 0 takes a free one."""
        self._silent = SilentConnections(
            call_later=asyncio.get_running_loop().call_later, seconds=self._first_request_s
        )
        self._server = await asyncio.start_server(
            self._serve, _HOST, port, limit=_MAX_HEAD_BYTES, backlog=BACKLOG
        )
        self.url = f"http://{_HOST}:{self._server.sockets[0].getsockname()[1]}{BURST_PATH}"

    async def stop(self) -> None:
        """Stop listening and end every connection."""
        assert self._server is not None
        self._server.close()
        for writer in self._writers:
            writer.transport.abort()
        await self._server.wait_closed()
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert self._silent is not None
        self._writers.add(writer)
        self._silent.enter(writer, writer.transport.abort)
        try:
            while True:
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), KEEP_ALIVE_S)
                if not await self._exchange(head, reader, writer):
                    return
        except (OSError, EOFError, asyncio.LimitOverrunError, asyncio.TimeoutError):
            return
        finally:
            self._silent.leave(writer)
            self._writers.discard(writer)
            writer.transport.abort()

    async def _exchange(
        self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> bool:
        """Answer one request; return whether another may follow on the connection."""
        first, *lines = head.decode("latin-1").split("\r\n")
        headers: dict[str, list[str]] = {}
        for line in lines:
            name, colon, value = line.partition(":")
            if colon:
                headers.setdefault(name.strip().lower(), []).append(value.strip())
        size = headers.get("content-length", ["0"])[0]
        if not size.isdecimal() or int(size) > _MAX_BODY_BYTES or "transfer-encoding" in headers:
            await _write(writer, 413, {"connection": "close"}, b"")
            return False
        body = await asyncio.wait_for(reader.readexactly(int(size)), _TIMEOUT_S)
        assert self._silent is not None
        self._silent.leave(writer)
        status, response_headers, answer = await self._answer_request(first, headers, body)
        await _write(writer, status, response_headers, answer)
        return True

    async def _answer_request(
        self, first: str, headers: dict[str, list[str]], body: bytes
    ) -> tuple[int, dict[str, str], bytes]:
        method, _, rest = first.partition(" ")
        path = rest.partition(" ")[0].partition("?")[0]
        if not path.startswith(BURST_PATH):
            return 404, {}, b""
        if not all(_TOKEN.fullmatch(value) for value in headers.get("authorization", [""])):
            return 401, {}, b""
        if path != BURST_PATH or method != "POST":
            return 404, {}, b""
        execution = self._idle.pop() if self._idle else None
        if execution is None and self.executions >= self._most:
            self.refused += 1
            return 502, {}, b""
        is_cold = execution is None
        self.executions += is_cold
        event = {
            "requestContext": {"elb": {"targetGroupArn": "arn:local"}},
            "httpMethod": method,
            "path": path,
            "multiValueHeaders": headers,
            "body": base64.b64encode(body).decode(),
            "isBase64Encoded": True,
        }
        loop = asyncio.get_running_loop()
        used, answer = await loop.run_in_executor(self._threads, self._run, execution, event)
        self._idle.append(used)
        self.answered += 1
        response_headers = {name: str(values[0]) for name, values in answer["multiValueHeaders"].items()}
        return int(answer["statusCode"]), response_headers, base64.b64decode(answer["body"])

    def _run(self, execution: Answering | None, event: dict[str, Any]) -> tuple[Answering, dict[str, Any]]:
        began, is_cold = time.monotonic(), execution is None
        execution = execution or self._make()
        init_ms = (time.monotonic() - began) * 1e3 if is_cold else 0.0
        answer = execution.answer(
            event, now_s=time.time(), left_ms=_TIMEOUT_S * 1e3, clock=time.monotonic
        ).as_http(event, init_ms=init_ms, cold=is_cold)
        return execution, answer


async def _write(writer: asyncio.StreamWriter, status: int, headers: dict[str, str], body: bytes) -> None:
    lines = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    head = f"HTTP/1.1 {status} {_REASONS.get(status, 'Status')}\r\n{lines}content-length: {len(body)}\r\n\r\n"
    writer.write(head.encode() + body)
    await writer.drain()


def answering_of(settings: PlatformSettings, folder: Path) -> Callable[[], Answering]:
    """Return what starts executions with the keys in *folder*."""

    def make() -> Answering:
        keys = KeyCache(
            lambda: read_beside(folder), settings.scaling.period_s,
            read_control=lambda name: read_beside(folder, f"control/{name}"),
        )  # fmt: skip
        return Answering(settings, keys)

    return make


def read_beside(folder: Path, name: str = "keys.json") -> str:
    """Return a file of a platform; raises NotFound if there is none."""
    try:
        return (folder / name).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise NotFound(f"there is no {name} in {folder}") from error


async def _run(folder: Path, port: int) -> None:
    settings = load_settings(folder / "settings.json")
    front = LocalFront(answering_of(settings, folder), most=settings.cloud.lambda_concurrency)
    await front.start(port)
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    show_json({"url": front.url})
    sys.stdout = sys.stderr  # what the function logs; nobody reads more than the first line of the output
    await stopped.wait()
    await front.stop()


def main() -> int:
    """Serve until a signal; print the address as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--parent", type=int, default=0)
    args = parser.parse_args()
    if args.parent:
        die_with_parent(args.parent)
    set_process_name("rse-pf-burst")
    try:
        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(_run(args.folder, args.port))
    except RsePfError as error:
        show_error(error)
        return 2
    except OSError as error:
        show(f"cannot listen on port {args.port}: {error.strerror}", "  hint: name another port", error=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
