"""Mutated HTTP requests: what `rse_pf.http_head` accepts, `h11` understands in the same way.

    python -m fuzz.http_twin [--count 1000000] [--seed 1]

A request is accepted when its head and its whole body are.  `h11` must then accept it, too, with the same
method, target, headers and body, and find its end at the same byte.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from dataclasses import dataclass

import h11

from rse_pf.http_head import BadRequestBytes, ChunkedBody, parse_head

__all__ = ["Request", "Tally", "compare", "mutated", "read_by_h11", "read_by_us"]

_LINES = (
    b"Host: x", b"Host: y:80", b"Content-Length: 5", b"Content-Length: 0", b"Transfer-Encoding: chunked",
    b"Transfer-Encoding: identity", b"Connection: close", b"Connection: keep-alive, upgrade",
    b"Expect: 100-continue", b"Authorization: Bearer e30.e30.AA", b"Range: bytes=0-3",
    b"X-Forwarded-For: 10.0.0.1", b"Upload-Offset: 0", b"Upgrade: websocket", b"Accept: */*",
    b"X: \xc3\xa4", b"X:", b" folded", b"\tfolded",
)  # fmt: skip
_BODIES = (b"", b"hello", b"5\r\nhello\r\n0\r\n\r\n", b"0\r\n\r\n", b"5;a=b\r\nhello\r\n0\r\nX: y\r\n\r\n")
_STARTS = (
    b"GET / HTTP/1.1",
    b"PUT /data/v1/objects/ab?x=%20y HTTP/1.1",
    b"POST /a HTTP/1.1",
    b"HEAD /b HTTP/1.0",
)
_TOKENS = (
    b"\r\n", b"\n", b"\r", b"\0", b"\t", b"\x0b", b"\x0c", b" ", b":", b",", b";", b"0x", b"+", b"-1",
    b"\x7f", b"\x80", b"\xff", b"\xa0", b"chunked", b"Content-Length", b"Transfer-Encoding",
    b"\r\n\r\n", b"HTTP/1.1", b"HTTP/1.0", b"99999999999999999999", b"1_0", b"http://x/", b"*", b"\x85",
    b"[", b"/", b"\x1f",
)  # fmt: skip
_SLOW_S = 0.1


@dataclass(frozen=True, slots=True)
class Request:
    """A request with its body, and the bytes behind it."""

    method: bytes
    target: bytes
    headers: tuple[tuple[bytes, bytes], ...]
    body: bytes
    rest: bytes


@dataclass(slots=True)
class Tally:
    """What came of all samples: how many were accepted by whom, and the slowest reading in seconds."""

    samples: int = 0
    accepted: int = 0
    by_h11: int = 0
    slowest_s: float = 0.0


def mutated(source: random.Random) -> bytes:
    """Return a request, most often with some bytes changed."""
    lines = [source.choice(_STARTS), *source.choices(_LINES, k=source.randrange(6))]
    if source.random() < 0.9:
        lines.append(b"Host: a")
    body = source.choice(_BODIES)
    if source.random() < 0.5:  # a frame that fits the body
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


def read_by_us(data: bytes) -> Request | None:
    """Return the first request in *data*; None if it is refused or not complete."""
    end = data.find(b"\r\n\r\n") + 4
    if end < 4:
        return None
    try:
        head = parse_head(data[:end])
        if head.body_bytes is None:
            pieces, rest = ChunkedBody().decode(data[end:])
            body = b"".join(pieces)
        else:
            body, rest = data[end : end + head.body_bytes], data[end + head.body_bytes :]
            if len(body) < head.body_bytes:
                return None
    except BadRequestBytes:
        return None
    return None if rest is None else Request(head.method, head.target, tuple(head.headers), body, rest)


def read_by_h11(data: bytes) -> Request | None:
    """Return the same as `read_by_us`, as `h11` understands it."""
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
    return Request(request.method, request.target, headers, body, bytes(connection.trailing_data[0]))


def compare(data: bytes, tally: Tally) -> str:
    """Count one sample; return what is wrong, empty if nothing is."""
    began = time.thread_time()
    ours = read_by_us(data)
    took_s = time.thread_time() - began
    theirs = read_by_h11(data)
    tally.samples += 1
    tally.accepted += ours is not None
    tally.by_h11 += theirs is not None
    tally.slowest_s = max(tally.slowest_s, took_s)
    if took_s > _SLOW_S:
        return f"took {took_s:.3f} s: {data!r}"
    return f"{data!r}: {ours} and not {theirs}" if ours is not None and ours != theirs else ""


def main() -> int:
    """Compare many samples and print the tally."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    source, tally = random.Random(options.seed), Tally()
    for _ in range(options.count):
        if problem := compare(mutated(source), tally):
            print(problem)
            return 1
    print(tally)
    return 0


if __name__ == "__main__":
    sys.exit(main())
