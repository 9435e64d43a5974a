"""The control plane's page: one document, nothing else, and nothing for a web page of another origin."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping

import pytest

from rse_pf.errors import UsageError
from rse_pf.local.control.control_port import serve_control_port

SOON_S = 10.0
TOKEN = "0123456789abcdef" * 4
CARRIED = b"Authorization: Bearer %s\r\n" % TOKEN.encode()


def answer(request: bytes) -> bytes:
    async def run() -> bytes:
        async def page() -> tuple[str, bytes]:
            return "application/json", b'{"platform": "a"}'

        def drain(query: Mapping[str, str]) -> AsyncIterator[Mapping[str, object]]:
            if query["server"] != "server-1":
                raise UsageError(f"no server named {query['server']!r} is running")
            return steps()

        server = await serve_control_port({"/status": page}, {"/drain": drain}, TOKEN)
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        try:
            writer.write(request)
            writer.write_eof()
            return await asyncio.wait_for(reader.read(), SOON_S)
        finally:
            writer.close()
            server.close()

    return asyncio.run(run())


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET /elsewhere HTTP/1.1\r\n%s\r\n" % CARRIED, b"404"),
        (b"POST /status HTTP/1.1\r\n%s\r\n" % CARRIED, b"405"),
        (b"GET /status HTTP/1.1\r\nOrigin: http://example.org\r\n%s\r\n" % CARRIED, b"403"),
        (b"GET /status HTTP/1.1\r\nHost: x\r\n\r\n", b"401"),
        (b"GET /status HTTP/1.1\r\nAuthorization: Bearer %s\r\n\r\n" % TOKEN[:-1].encode(), b"401"),
    ],
)
def test_everything_else_is_refused(request_: bytes, status: bytes) -> None:
    told = answer(request_)

    assert told.split(b" ")[1] == status
    assert b"platform" not in told


@pytest.mark.parametrize("broken", [b"", b"nonsense\r\n\r\n", b"GET /status"])
def test_a_broken_question_ends_its_own_connection(broken: bytes) -> None:
    assert answer(broken) == b""


async def steps() -> AsyncIterator[dict[str, object]]:
    yield {"event": "drain-start", "server": "server-1"}
    yield {"event": "operation-over"}


@pytest.mark.parametrize("header", [b"", b"Origin: https://example.org\r\n%s" % CARRIED])
def test_an_operation_without_the_token_or_from_a_web_page_does_nothing(header: bytes) -> None:
    told = answer(b"POST /drain?server=server-1 HTTP/1.1\r\n%s\r\n" % header)

    assert told.split(b" ")[1] in (b"401", b"403")
    assert b"drain-start" not in told
