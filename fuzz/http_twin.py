"""Compare the HTTP parser of `rse_pf.http.connections` with that of `h11` on mutated requests.

    python -m fuzz.http_twin [--count 100000] [--seed 1]

A request is accepted if its head and its whole body are accepted.  `h11` must then accept the request as
well, with the same method, target, headers and body.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import sys
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import h11
import uvicorn
from uvicorn.server import ServerState

from rse_pf.http.connections import bounded_protocol

__all__ = ["Request", "compare", "disagreement"]

# Header lines of random requests, well-formed and malformed.
_LINES = (
    b"Host: x", b"Host: y:80", b"Content-Length: 5", b"Content-Length: 0", b"Transfer-Encoding: chunked",
    b"Transfer-Encoding: identity", b"Connection: close", b"Connection: keep-alive, upgrade",
    b"Expect: 100-continue", b"Authorization: Bearer e30.e30.AA", b"Range: bytes=0-3",
    b"X-Forwarded-For: 10.0.0.1", b"Upload-Offset: 0", b"Upgrade: websocket", b"Accept: */*",
    b"X: \xc3\xa4", b"X:", b" folded", b"\tfolded",
)  # fmt: skip
# Bodies of random requests.
_BODIES = (b"", b"hello", b"5\r\nhello\r\n0\r\n\r\n", b"0\r\n\r\n", b"5;a=b\r\nhello\r\n0\r\nX: y\r\n\r\n")
# Request lines of random requests.
_STARTS = (
    b"GET / HTTP/1.1",
    b"PUT /data/v1/objects/ab?x=%20y HTTP/1.1",
    b"POST /a HTTP/1.1",
    b"HEAD /b HTTP/1.0",
)
# Bytes that mutations insert.
_TOKENS = (
    b"\r\n", b"\n", b"\r", b"\0", b"\t", b"\x0b", b"\x0c", b" ", b":", b",", b";", b"0x", b"+", b"-1",
    b"\x7f", b"\x80", b"\xff", b"\xa0", b"chunked", b"Content-Length", b"Transfer-Encoding",
    b"\r\n\r\n", b"HTTP/1.1", b"HTTP/1.0", b"99999999999999999999", b"1_0", b"http://x/", b"*", b"\x85",
    b"[", b"/", b"\x1f",
)  # fmt: skip
_LOOP_ROUNDS = 4  # rounds of the event loop in which the application reads and answers a request


@dataclass(frozen=True, slots=True)
class Request:
    """An HTTP request as a parser understands it: method, target, headers and body."""

    method: bytes
    target: bytes
    headers: tuple[tuple[bytes, bytes], ...]
    body: bytes


def mutated(source: random.Random) -> bytes:
    """Return the bytes of a random request, most often with some bytes changed."""
    lines = [source.choice(_STARTS), *source.choices(_LINES, k=source.randrange(6))]
    if source.random() < 0.9:
        lines.append(b"Host: a")
    body = source.choice(_BODIES)
    if source.random() < 0.5:  # a Content-Length that fits the body
        lines.append(b"Transfer-Encoding: chunked" if b"\r\n" in body else b"Content-Length: %d" % len(body))
    source.shuffle(rest := lines[1:])
    data = bytearray(b"\r\n".join([lines[0], *rest]) + b"\r\n\r\n" + body)
    for _ in range(source.choice((0, 1, 1, 1, 2, 3))):
        at = source.randrange(len(data) + 1)
        kind = source.randrange(5)
        if kind == 0:
            data[at : at + 1] = bytes((source.randrange(256),))
        elif kind == 1:
            data[at:at] = source.choice(_TOKENS)
        elif kind == 2:
            del data[at : at + source.choice((1, 1, 2, 8))]
        elif kind == 3:
            piece = data[at : at + source.randrange(40)]
            data[source.randrange(len(data) + 1) : 0] = piece
        else:
            data[at : at + 1] = source.choice(_TOKENS)
    return bytes(data)


async def requests_served(pieces: list[bytes]) -> list[Request]:
    """Return the requests that our HTTP protocol passes to its application, from one connection.

    *pieces* are received one after another.  Malformed requests are not among those returned.
    """
    served: list[Request] = []

    async def application(scope: Any, receive: Any, send: Any) -> None:
        body, more = b"", True
        while more:
            message = await receive()
            if message["type"] == "http.disconnect":
                return
            body, more = body + message["body"], message["more_body"]
        target = scope["raw_path"] + b"?" * bool(scope["query_string"]) + scope["query_string"]
        served.append(Request(scope["method"].encode(), target, tuple(scope["headers"]), body))
        await send({"type": "http.response.start", "status": 204})
        await send({"type": "http.response.body"})

    config = uvicorn.Config(application, lifespan="off", log_config=None, ws="none")
    protocol = bounded_protocol(most_idle=1)(
        config=config, server_state=ServerState(), app_state={}, _loop=asyncio.get_running_loop()
    )
    closed = asyncio.Event()
    ignored = "set_write_buffer_limits", "write", "pause_reading", "resume_reading", "get_extra_info"
    transport: dict[str, Callable[..., Any]] = {name: lambda *_: None for name in ignored}
    transport |= {"close": closed.set, "abort": closed.set, "is_closing": closed.is_set}
    protocol.connection_made(SimpleNamespace(**transport))
    for piece in pieces:
        protocol.data_received(piece)
        for _ in range(_LOOP_ROUNDS):
            await asyncio.sleep(0)
    protocol.connection_lost(None)
    await asyncio.sleep(0)
    return served


def read_by_h11(data: bytes) -> Request | None:
    """Return the first request in *data* as `h11` understands it; None if it is refused or incomplete."""
    connection = h11.Connection(h11.SERVER)
    connection.receive_data(data)
    request: h11.Request | None = None
    body = b""
    try:
        while True:
            event = connection.next_event()
            if isinstance(event, h11.Request):
                request = event
            elif isinstance(event, h11.Data):
                body += event.data
            elif isinstance(event, h11.EndOfMessage) and request is not None:
                break
            else:
                return None
    except h11.RemoteProtocolError:
        return None
    headers = tuple((bytes(name), bytes(value)) for name, value in request.headers)
    return Request(request.method, request.target, headers, body)


async def disagreement(data: bytes, pieces: list[bytes]) -> tuple[bool, str]:
    """Return whether the request in *data* is accepted, and how `h11` disagrees; empty if both agree.

    *pieces* are the parts in which *data* arrives.
    """
    served = await requests_served(pieces)
    expected = read_by_h11(data)
    is_alike = served == [expected] or not served
    return bool(served), "" if is_alike else f"{data!r}: {served} and not {expected}"


async def compare(count: int, seed: int) -> tuple[int, list[str]]:
    """Return how many of *count* mutated requests are accepted, and the disagreements with `h11`."""
    source = random.Random(seed)
    accepted, problems = 0, []
    for _ in range(count):
        data = mutated(source)
        cuts = sorted(source.randrange(len(data) + 1) for _ in range(source.randrange(4)))
        pieces = [data[start:end] for start, end in zip([0, *cuts], [*cuts, None], strict=True)]
        is_accepted, problem = await disagreement(data, [piece for piece in pieces if piece])
        accepted += is_accepted
        problems += [problem] if problem else []
    return accepted, problems


def main() -> int:
    """Compare many mutated requests, and print the disagreements of both parsers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    accepted, problems = asyncio.run(compare(options.count, options.seed))
    print(*problems, f"{options.count} samples, {accepted} accepted", sep="\n")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
