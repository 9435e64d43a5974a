"""Kinds of commands that a server refuses before it has decoded them, as each client can send them.

A kind is the bytes of a payload that is put into a command as they are, or a field of the command that the
payload is sent with.  Every kind is refused with ``bad-message`` or ``too-large``.
"""

from __future__ import annotations

import base64
import struct
from dataclasses import dataclass, field
from typing import Any

__all__ = ["BINARY", "JSON", "Kind", "as_input"]

_LONG_WORD = "w" * 65


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind: the encoded *payload*, and what else the command has."""

    name: str
    payload: bytes
    service: str = "echo"
    trace: str = ""
    stream: str = ""
    codes: tuple[str, ...] = field(default=("bad-message", "too-large"))


def _json() -> tuple[Kind, ...]:
    texts: dict[str, bytes] = {
        "60,000 values": b"[" + b",".join([b"1"] * 60_000) + b"]",
        "30 levels of lists": b"[" * 30 + b"]" * 30,
        "30 levels of objects": b'{"a":' * 30 + b"1" + b"}" * 30,
        "8,000 lists": b"[" + b",".join([b"[]"] * 8_000) + b"]",
        "8,000 objects": b"[" + b",".join([b"{}"] * 8_000) + b"]",
        "a text that takes much memory": b'"' + "\u00e9".encode() * 128_000 + b'"',
        "a text that inflates to 300,000 bytes": b'"' + b"a" * 300_000 + b'"',
        "numbers of 40 digits": b"[" + b",".join([b"1" * 40] * 3_000) + b"]",
        "UTF-8 that is invalid": b'"\xff\xfe"',
        "UTF-8 that is cut off": b'"\xe2\x82"',
        "a name that is invalid UTF-8": b'{"\xc3(":1}',
        "a surrogate as UTF-8": b'"\xed\xa0\x80"',
        "NaN": b"NaN",
        "Infinity": b"Infinity",
        "-Infinity": b"[1,-Infinity]",
        "a number out of range": b"[1e999]",
        "a hexadecimal number": b"0x10",
        "a leading zero": b"[01]",
        "a plus sign": b"+1",
        "no digit before the point": b"[.5]",
        "no digit behind the point": b"[1.]",
        "no digit in the exponent": b"[1e]",
        "single quotes": b"'x'",
        "a comma too many": b"[1,]",
        "two commas": b"[1,,2]",
        "a list that is not closed": b"[1",
        "an object that is not closed": b'{"a":1',
        "the wrong bracket": b"[1}",
        "a bracket too many": b"1}",
        "a comment": b"1/* one */",
        "a word": b"undefined",
        "True": b"True",
        "a control character": b'"\x00"',
        "an escape that is unknown": b'"\\q"',
        "half of an escape": b'"\\u12"',
        "a lone surrogate": b'"\\ud800"',
        "a text that is not closed": b'"abc',
        "a name without quotes": b"{a:1}",
        "a name that is a number": b"{1:2}",
        "a name without a value": b'{"a"}',
        "no payload": b"",
        "a deadline that is a text": b'1,"deadline_ms":"soon"',
        "a deadline before now": b'1,"deadline_ms":-1',
        "a deadline of years": b'1,"deadline_ms":1e300',
        "a sequence number that is negative": b'1,"seq":-1',
        "a sequence number that is a text": b'1,"seq":"x"',
        "keep as a number": b'1,"keep":1',
        "a trace that is a number": b'1,"trace":5',
        "a service that is a list": b'1,"service":[]',
    }
    return (*(Kind(name, text) for name, text in texts.items()), *_fields(b"1"))


def _binary() -> tuple[Kind, ...]:
    payloads: dict[str, bytes] = {
        "60,000 values": b"\xdd" + struct.pack(">I", 60_000) + b"\x01" * 60_000,
        "40,000 values of two kinds": b"\xdd" + struct.pack(">I", 40_000) + b"\x01\xc0" * 20_000,
        "30 levels of lists": b"\x91" * 30 + b"\xc0",
        "30 levels of objects": b"\x81\xa1a" * 30 + b"\xc0",
        "3,000 levels of lists": b"\x91" * 3_000 + b"\xc0",
        "8,000 lists": b"\xdd" + struct.pack(">I", 8_000) + b"\x90" * 8_000,
        "8,000 objects": b"\xdd" + struct.pack(">I", 8_000) + b"\x80" * 8_000,
        "a text of 300,000 bytes": b"\xdb" + struct.pack(">I", 300_000) + b"a" * 300_000,
        "UTF-8 that is invalid": b"\xa2\xff\xfe",
        "UTF-8 that is cut off": b"\xa2\xe2\x82",
        "a long text that is invalid UTF-8": b"\xd9\x28" + b"\xff" * 40,
        "a surrogate as UTF-8": b"\xa3\xed\xa0\x80",
        "a name that is invalid UTF-8": b"\x81\xa2\xc3(\x01",
        "the byte that MessagePack never uses": b"\xc1",
        "that byte in a list": b"\x92\x01\xc1",
        "that byte as a name": b"\x81\xc1\x01",
        "an object as a name": b"\x81\x80\x01",
        "an extension of type 0": b"\xd4\x00\x01",
        "an extension of type 4": b"\xd5\x04\x01\x02",
        "an extension of type 5": b"\xd6\x05\x01\x02\x03\x04",
        "an extension of type 127": b"\xd7\x7f" + bytes(8),
        "an extension of type -5": b"\xd8\xfb" + bytes(16),
        "an extension of one byte of length": b"\xc7\x03\x09\x01\x02\x03",
        "an extension of two bytes of length": b"\xc8\x00\x03\x09\x01\x02\x03",
        "an extension of four bytes of length": b"\xc9\x00\x00\x00\x03\x09\x01\x02\x03",
        "an array of float32 of three bytes": b"\xc7\x03\x01\x01\x02\x03",
        "an array of uint32 of five bytes": b"\xc7\x05\x02\x01\x02\x03\x04\x05",
        "an array of float64 of four bytes": b"\xd6\x03\x01\x02\x03\x04",
        "an array of float64 in a list": b"\x91\xd6\x03\x01\x02\x03\x04",
        "an extension that is longer than the message": b"\xc9\x7f\xff\xff\xff\x01",
        "a text that is longer than the message": b"\xdb\x7f\xff\xff\xff",
        "a text of 16 bits that is longer than the message": b"\xda\xff\xff",
        "a text of 8 bits that is longer than the message": b"\xd9\xff",
        "bytes that are longer than the message": b"\xc6\x7f\xff\xff\xff",
        "bytes of 16 bits that are longer than the message": b"\xc5\xff\xff",
        "a list that is longer than the message": b"\xdd\x7f\xff\xff\xff",
        "a list of 16 bits that is longer than the message": b"\xdc\xff\xff",
        "an object that is longer than the message": b"\xdf\x7f\xff\xff\xff",
        "an object of 16 bits that is longer than the message": b"\xde\xff\xff",
        "two values": b"\x01\x01",
        "a value and an object": b"\x01\x80",
        "a value and a text": b"\xc0\xa3abc",
        "no payload": b"",
    }
    return (*(Kind(name, each) for name, each in payloads.items()), *_fields(b"\x01"))


def _fields(payload: bytes) -> tuple[Kind, ...]:
    return (
        Kind("a service of 65 letters", payload, service=_LONG_WORD),
        Kind("a trace of 65 letters", payload, trace=_LONG_WORD),
        Kind("a stream of 65 letters", payload, stream=_LONG_WORD),
    )


JSON, BINARY = _json(), _binary()


def as_input() -> dict[str, Any]:
    """Return the kinds as the drivers of clients read them: payloads in base64."""
    return {
        encoding: [
            {
                "name": kind.name, "payload": base64.b64encode(kind.payload).decode(),
                "service": kind.service, "trace": kind.trace, "stream": kind.stream, "codes": kind.codes,
            }
            for kind in kinds
        ]
        for encoding, kinds in (("json", JSON), ("bin", BINARY))
    }  # fmt: skip
