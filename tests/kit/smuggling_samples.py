"""Requests that two readers may understand differently; most hide a second one, which asks for `HIDDEN`.

`SAMPLES` is what the tests send; `REFUSED` are those that no reader may take for a request at all.
Source: RFC 9112, sections 2.2, 3.2, 5.2, 6.3, 7.1, 11.2; J. Kettle, "HTTP desync attacks", 2019.
"""

from __future__ import annotations

__all__ = ["HIDDEN", "REFUSED", "SAMPLES", "SECOND", "put", "upgrade"]

HIDDEN = b"/ws?hidden"
SECOND = b"GET " + HIDDEN + b" HTTP/1.1\r\nHost: x\r\n\r\n"
_OBJECT = b"/data/v1/objects/" + b"a" * 64
_CHUNKED, _END = b"Transfer-Encoding: chunked", b"0\r\n\r\n"
_UPGRADE = (
    b"Upgrade: websocket", b"Connection: Upgrade", b"Sec-WebSocket-Version: 13",
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", b"Sec-WebSocket-Protocol: rse-pf.v1.bin",
)  # fmt: skip


def put(
    *lines: bytes,
    body: bytes = b"",
    start: bytes = b"PUT " + _OBJECT + b" HTTP/1.1",
    host: bytes = b"Host: x",
) -> bytes:
    """Return a request to the data service."""
    return b"\r\n".join([start, host, b"Authorization: Bearer TOKEN", *lines]) + b"\r\n\r\n" + body


def upgrade(
    *lines: bytes, body: bytes = b"", start: bytes = b"GET /ws HTTP/1.1", host: bytes = b"Host: x"
) -> bytes:
    """Return a handshake."""
    return put(*_UPGRADE, *lines, body=body, start=start, host=host)


def _size(count: int) -> bytes:
    return b"Content-Length: %d" % count


def _samples() -> dict[str, bytes]:
    made: dict[str, bytes] = {}
    hidden, both = len(SECOND), len(_END + SECOND)
    for to, make in (("data", put), ("ws", upgrade)):
        of = {
            "CL and TE, TE ends first": make(_size(both), _CHUNKED, body=_END + SECOND),
            "TE and CL, CL ends first": make(
                _CHUNKED, _size(4), body=b"%x\r\n" % hidden + SECOND + b"\r\n" + _END
            ),
            "TE folded": make(b"Transfer-Encoding:\r\n chunked", body=_END + SECOND),
            "TE folded and CL": make(_size(both), b"Transfer-Encoding:\r\n chunked", body=_END + SECOND),
            "TE in a folded line": make(b"X: y\r\n Transfer-Encoding: chunked", _size(0)),
            "TE with a space before the colon": make(
                _size(both), b"Transfer-Encoding : chunked", body=_END + SECOND
            ),
            "TE xchunked": make(_size(both), b"Transfer-Encoding: xchunked", body=_END + SECOND),
            "TE chunked, identity": make(b"Transfer-Encoding: chunked, identity", body=_END + SECOND),
            "TE identity": make(_size(both), b"Transfer-Encoding: identity", body=_END + SECOND),
            "two TE": make(_CHUNKED, b"Transfer-Encoding: x", body=_END + SECOND),
            "TE behind a vertical tab": make(
                _size(both), b"Transfer-Encoding: \x0bchunked", body=_END + SECOND
            ),
            "two CL": make(_size(0), _size(hidden), body=SECOND),
            "CL as a list": make(b"Content-Length: 0, %d" % hidden, body=SECOND),
            "CL with a sign": make(b"Content-Length: +%d" % hidden, body=SECOND),
            "CL in hex": make(b"Content-Length: 0x%x" % hidden, body=SECOND),
            "CL below zero": make(b"Content-Length: -1", body=SECOND),
            "CL with a space inside": make(b"Content-Length: 1 0", body=SECOND),
            "CL of 2^64": make(b"Content-Length: 18446744073709551616", body=SECOND),
            "chunk with a sign": make(_CHUNKED, body=b"+0\r\n\r\n" + SECOND),
            "chunk with 0x": make(_CHUNKED, body=b"0x0\r\n\r\n" + SECOND),
            "chunk of 2^64": make(_CHUNKED, body=b"10000000000000000\r\n" + SECOND),
            "chunk that ends in LF": make(_CHUNKED, body=b"0\n\n" + SECOND),
            "chunk extension with LF": make(_CHUNKED, body=b"0;x\ny\r\n\r\n" + SECOND),
            "chunk longer than it says": make(_CHUNKED, body=b"1\r\nXX\r\n" + _END + SECOND),
            "lines that end in LF": make(_size(0)).replace(b"\r\n", b"\n") + SECOND,
            "LF in a value": make(b"A: b\nTransfer-Encoding: chunked", body=_END + SECOND),
            "CR in a value": make(b"A: b\rTransfer-Encoding: chunked", body=_END + SECOND),
            "NUL in a value": make(b"A: b\0c", body=SECOND),
            "head that ends in LF": make(_size(0))[:-2] + b"\n" + SECOND,
            "two hosts": make(b"Host: y", _size(0)),
            "no host": make(_size(0), host=b"X: x"),
            "host with a path": make(_size(0), host=b"Host: x/ws"),
            "host folded": make(_size(0), host=b"Host:\r\n x"),
            "line without a colon": make(b"nonsense", _size(0)),
            "space before the first header": make(_size(0)).replace(b"\r\n", b"\r\n ", 1),
            "no name": make(b": x", _size(0)),
            "CL with an underscore": make(b"Content_Length: %d" % hidden, _size(0)),
            "head of 100 kB": make(b"A: " + b"a" * 100_000, _size(0)),
            "1000 headers": make(*[b"A%d: b" % number for number in range(1000)], _size(0)),
            "CL hop by hop": make(_size(hidden), b"Connection: Content-Length", body=SECOND),
        }
        made.update({f"{to}: {name}": data for name, data in of.items()})
    made.update(
        {
            "absolute form to data": put(_size(0), start=b"PUT http://other" + _OBJECT + b" HTTP/1.1"),
            "absolute form to ws": upgrade(start=b"GET http://other/ws HTTP/1.1"),
            "absolute form to a control page": put(start=b"GET http://127.0.0.1/metrics HTTP/1.1"),
            "space in the path": put(_size(0), start=b"PUT /data/ /ws HTTP/1.1"),
            "fragment in the path": put(_size(0), start=b"PUT /data/v1/objects#/../ws HTTP/1.1"),
            "asterisk": put(start=b"OPTIONS * HTTP/1.1"),
            "CONNECT": put(body=SECOND, start=b"CONNECT x:80 HTTP/1.1"),
            "CONNECT to ws": put(body=SECOND, start=b"CONNECT /ws HTTP/1.1"),
            "HTTP/0.9": b"GET /ws\r\n\r\n" + SECOND,
            "HTTP/1.0": upgrade(body=SECOND, start=b"GET /ws HTTP/1.0"),
            "HTTP/1.2": upgrade(body=SECOND, start=b"GET /ws HTTP/1.2"),
            "HTTP/2.0": upgrade(body=SECOND, start=b"GET /ws HTTP/2.0"),
            "preface of HTTP/2": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + SECOND,
            "method in small letters": upgrade(body=SECOND, start=b"get /ws HTTP/1.1"),
            "TRACE": upgrade(body=SECOND, start=b"TRACE /ws HTTP/1.1"),
            "upgrade with a body": upgrade(_size(hidden), body=SECOND),
            "upgrade with chunks": upgrade(_CHUNKED, body=b"%x\r\n" % hidden + SECOND + b"\r\n" + _END),
            "upgrade with no chunk": upgrade(_CHUNKED, body=_END + SECOND),
            "request right after an upgrade": upgrade(body=SECOND),
            "upgrade right after an upgrade": upgrade(body=upgrade(start=b"GET " + HIDDEN + b" HTTP/1.1")),
            "request right after an upgrade of another version": upgrade(body=SECOND).replace(
                b"Version: 13", b"Version: 777"
            ),
            "request right after an upgrade to nonsense": upgrade(body=SECOND).replace(
                b"Upgrade: websocket", b"Upgrade: nonsense"
            ),
            "request right after an upgrade to h2c": put(
                b"Upgrade: h2c", b"Connection: Upgrade, HTTP2-Settings", b"HTTP2-Settings: AAMAAABkAARAAAAA",
                body=SECOND, start=b"GET /ws HTTP/1.1",
            ),
            "empty lines first": b"\r\n\r\n" + upgrade(body=SECOND),
            "request right after a request": put(_size(0), body=SECOND),
        }
    )  # fmt: skip
    return made


SAMPLES = _samples()
REFUSED = frozenset(
    name
    for name in SAMPLES
    if name.partition(": ")[2]
    in {
        "CL and TE, TE ends first", "TE and CL, CL ends first", "TE folded and CL",
        "TE with a space before the colon", "TE xchunked", "TE chunked, identity", "TE identity", "two TE",
        "TE behind a vertical tab", "two CL", "CL as a list", "CL with a sign", "CL in hex", "CL below zero",
        "CL with a space inside", "CL of 2^64", "NUL in a value", "no host", "host with a path",
        "line without a colon", "space before the first header", "no name", "CL with an underscore",
        "head of 100 kB", "1000 headers",
    }
) | {
    "space in the path", "fragment in the path", "CONNECT to ws", "HTTP/0.9", "HTTP/1.0", "HTTP/1.2",
    "HTTP/2.0", "preface of HTTP/2", "method in small letters", "request right after an upgrade to nonsense",
}  # fmt: skip
"""What the load balancer must not hand on at all."""
