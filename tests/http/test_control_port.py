"""The control port's small HTTP server."""

from __future__ import annotations

import asyncio

import pytest

from rse_pf.http.control_port import ControlReply, ControlRequest, serve_control

pytestmark = pytest.mark.system


def talk(*requests: bytes) -> tuple[list[ControlRequest], bytes]:
    """Send *requests* over one connection; return what was asked and all that came back."""
    asked: list[ControlRequest] = []

    async def answer(ask: ControlRequest) -> ControlReply:
        asked.append(ask)
        return ControlReply(body=b"hello", headers={"X-A": "b"})

    async def run() -> bytes:
        async with await serve_control("127.0.0.1", 0, answer) as server:
            reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            writer.write(b"".join(requests))
            writer.write_eof()
            got = await asyncio.wait_for(reader.read(), 5)
            writer.close()
            return got

    return asked, asyncio.run(run())


def test_requests_share_a_connection():
    asked, got = talk(
        b"GET /a?x=1&y=2 HTTP/1.1\r\nHost: h\r\n\r\n",
        b"POST /b HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc",
        b"HEAD /c HTTP/1.1\r\n\r\n",
    )

    assert [(a.method, a.path, a.query) for a in asked] == [
        ("GET", "/a", {"x": "1", "y": "2"}), ("POST", "/b", {}), ("GET", "/c", {}),
    ]  # fmt: skip
    assert got.count(b"HTTP/1.1 200 OK") == 3
    assert got.count(b"hello") == 2
    assert got.count(b"X-A: b") == 3


def test_old_clients_and_close_end_the_connection():
    for request in (b"GET / HTTP/1.0\r\n\r\n", b"GET / HTTP/1.1\r\nConnection: close\r\n\r\n"):
        asked, got = talk(request, b"GET /again HTTP/1.1\r\n\r\n")

        assert len(asked) == 1
        assert b"Connection: close" in got


def test_a_page_of_a_browser_is_not_local():
    asked, _ = talk(b"POST /drain HTTP/1.1\r\nOrigin: http://evil\r\n\r\n", b"POST /drain HTTP/1.1\r\n\r\n")

    assert [a.is_local for a in asked] == [False, True]


@pytest.mark.parametrize(
    "request_bytes",
    [
        b"nonsense\r\n\r\n",
        b"GET / HTTP/1.1\r\nContent-Length: x\r\n\r\n",
        b"POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-Length: 99999999\r\n\r\n",
        b"GET /" + b"x" * 20000 + b" HTTP/1.1\r\n\r\n",
    ],
)
def test_malformed_input_is_never_answered_as_a_request(request_bytes):
    asked, got = talk(request_bytes)

    assert asked == []
    assert b"200 OK" not in got
