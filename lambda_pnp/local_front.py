"""Emulate on one machine the firewall, the load balancer and the Lambda around the function.

    python -m lambda_pnp.local_front FOLDER [--port P] [--parent PID]

FOLDER is the folder of a local platform, with its settings and public keys.  Requests become the events of a
load balancer.  Each execution environment of the function answers one command at a time; an idle one is used
again, and at most ``cloud.lambda_concurrency`` exist.  The program is for trials and measurements: it listens
on loopback only.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import re
import signal
import socket
import sys
import time
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from lambda_pnp.answering import Answering
from lambda_pnp.keys import KeyCache
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.config.front_door import BEARER_PATTERN, BURST_PATH
from rse_pf.errors import NotFound, RsePfError
from rse_pf.http.connections import bounded_protocol
from rse_pf.http.unauthenticated import BACKLOG, MAX_SILENT
from rse_pf.processes.linux import die_with_parent, set_process_name
from rse_pf.terminal import show, show_error, show_json

__all__ = ["LocalFront", "answering_of", "read_platform_file"]

_HOST = "127.0.0.1"
_EXECUTION_TIMEOUT_S = 10.0  # time limit of an execution, as in stacks/serverless_stack.py, and of a body
_STOP_TIMEOUT_S = 1  # seconds in which requests in progress may complete when the program stops
_MAX_BODY_BYTES = 1_048_576  # longest request body that an ALB passes on to a function
_TOKEN = re.compile(BEARER_PATTERN)
_Receive = Callable[[], Awaitable[Mapping[str, Any]]]


class LocalFront:
    """The firewall, the load balancer and the executions of one function, as an ASGI application.

    Attributes:
        answered: Number of requests that an execution answered.
        refused: Number of requests for which no execution was free.
        executions: Number of execution environments that were started.
    """

    def __init__(self, make: Callable[[], Answering], *, most: int) -> None:
        """Describe the front; no execution environment is started yet.

        Args:
            make: Starts an execution environment.
            most: Largest number of execution environments; each answers one request at a time.
        """
        self.answered = self.refused = self.executions = 0
        self._make = make
        self._most = most
        self._idle: list[Answering] = []
        self._threads = ThreadPoolExecutor(most, "execution")

    async def __call__(
        self,
        scope: Mapping[str, Any],
        receive: _Receive,
        send: Callable[[Mapping[str, Any]], Awaitable[None]],
    ) -> None:
        """Answer one request, or refuse it as the firewall or the load balancer would."""
        status, headers, body = await self._answer(scope, receive)
        fields = [(name.encode(), value.encode()) for name, value in headers.items()]
        fields.append((b"content-length", b"%d" % len(body)))
        await send({"type": "http.response.start", "status": status, "headers": fields})
        await send({"type": "http.response.body", "body": body})

    def close(self) -> None:
        """Drop the requests that wait for an execution; running executions are not awaited."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _answer(self, scope: Mapping[str, Any], receive: _Receive) -> tuple[int, dict[str, str], bytes]:
        method, path = scope["method"], scope["path"]
        headers: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1"), []).append(value.decode("latin-1"))
        try:
            body = await asyncio.wait_for(_read_body(headers, receive), _EXECUTION_TIMEOUT_S)
        except asyncio.TimeoutError:
            return 408, {}, b""
        if body is None:
            return 413, {}, b""
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
            event, now_s=time.time(), left_ms=_EXECUTION_TIMEOUT_S * 1e3, clock=time.monotonic
        ).as_http(event, init_ms=init_ms, cold=is_cold)
        return execution, answer


async def _read_body(headers: Mapping[str, list[str]], receive: _Receive) -> bytes | None:
    """Return the whole body; None if it is longer than `_MAX_BODY_BYTES`, or if the client disconnected."""
    if int(headers.get("content-length", ["0"])[0]) > _MAX_BODY_BYTES:
        return None
    body, is_complete = b"", False
    while not is_complete:
        part = await receive()
        body += part.get("body", b"")
        if part["type"] != "http.request" or len(body) > _MAX_BODY_BYTES:
            return None
        is_complete = not part.get("more_body", False)
    return body


def answering_of(settings: PlatformSettings, folder: Path) -> Callable[[], Answering]:
    """Return a function that makes an `Answering` with *settings* and with the public keys in *folder*."""

    def make() -> Answering:
        keys = KeyCache(
            lambda: read_platform_file(folder), settings.scaling.period_s,
            read_control=lambda name: read_platform_file(folder, f"control/{name}"),
        )  # fmt: skip
        return Answering(settings, keys)

    return make


def read_platform_file(folder: Path, name: str = "keys.json") -> str:
    """Return the text of the file *name* in the folder of a local platform; raises NotFound."""
    try:
        return (folder / name).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise NotFound(f"there is no {name} in {folder}") from error


def _serve(folder: Path, port: int) -> None:
    """Emulate the function for the platform in *folder* until SIGTERM or SIGINT; print the URL as JSON."""
    protocol = bounded_protocol(most_idle=MAX_SILENT)
    import uvicorn

    settings = load_settings(folder / "settings.json")
    front = LocalFront(answering_of(settings, folder), most=settings.cloud.lambda_concurrency)
    config = uvicorn.Config(
        front, http=protocol, ws="none", lifespan="off", access_log=False, log_level="warning",
        backlog=BACKLOG, server_header=False, date_header=False, proxy_headers=False,
        timeout_graceful_shutdown=_STOP_TIMEOUT_S,
    )  # fmt: skip
    for number in (signal.SIGTERM, signal.SIGINT):
        # uvicorn sends the signal to its own process again when it has stopped; this handler ignores that.
        signal.signal(number, lambda number, frame: None)
    with socket.create_server((_HOST, port), backlog=BACKLOG) as listening:
        # asyncio sets TCP_NODELAY only on sockets that name their protocol.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        show_json({"url": f"http://{_HOST}:{listening.getsockname()[1]}{BURST_PATH}"})
        # The log of the function goes to stderr: the reader of stdout reads only the line with the URL.
        sys.stdout = sys.stderr
        try:
            uvicorn.Server(config).run(sockets=[listening])
        finally:
            front.close()


def main() -> int:
    """Run the emulation until SIGTERM or SIGINT; return 0, or 2 after an error that was printed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--parent", type=int, default=0)
    args = parser.parse_args()
    if args.parent:
        die_with_parent(args.parent)
    set_process_name("rse-pf-burst")
    try:
        _serve(args.folder, args.port)
    except RsePfError as error:
        show_error(error)
        return 2
    except OSError as error:
        show(f"cannot listen on port {args.port}: {error.strerror}", "  hint: name another port", error=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
