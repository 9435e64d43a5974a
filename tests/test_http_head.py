"""A request has one meaning or is refused: heads, lengths and chunks, compared with `h11`."""

from __future__ import annotations

import random

import pytest
from hostile.smuggling_samples import SAMPLES

from fuzz.http_twin import Tally, compare, mutated, read_by_us
from rse_pf.http_head import MAX_HEAD_BYTES, MAX_HEADERS, BadRequestBytes, ChunkedBody, parse_head

SAMPLES_OF_A_TEST = 5000


def head(*lines: bytes, start: bytes = b"GET /a?b HTTP/1.1", host: bytes = b"Host: x") -> bytes:
    return b"\r\n".join([start, host, *lines]) + b"\r\n\r\n"


@pytest.mark.parametrize("seed", range(4))
def test_what_is_accepted_is_understood_alike_by_h11(seed: int) -> None:
    source, tally = random.Random(seed), Tally()

    problems = [compare(mutated(source), tally) for _ in range(SAMPLES_OF_A_TEST)]

    assert [problem for problem in problems if problem] == []
    assert tally.accepted > 0.08 * tally.samples, "samples that nobody accepts compare nothing"


def test_the_samples_of_smuggling_are_understood_alike_by_h11() -> None:
    tally = Tally()

    assert {name for name, data in SAMPLES.items() if compare(data, tally)} == set()


def test_a_head_is_read_into_its_parts() -> None:
    lines = b"X-A:  b c\t", b"Connection: Upgrade, close", b"Expect: 100-Continue", b"Content-Length: 7"
    read = parse_head(head(*lines))

    assert (read.method, read.target, read.body_bytes) == (b"GET", b"/a?b", 7)
    assert read.headers[:2] == [(b"host", b"x"), (b"x-a", b"b c")]
    assert read.closes
    assert read.expects_continue
    assert not parse_head(head(b"Connection: upgrade")).closes


BAD = {
    "no host": head(host=b"A: b"), "two hosts": head(b"HOST: y"),
    "two lengths": head(b"Content-Length: 1", b"Content-Length: 1"),
    "length and coding": head(b"Content-Length: 1", b"Transfer-Encoding: chunked"),
    "list of lengths": head(b"Content-Length: 1, 1"), "sign": head(b"Content-Length: +1"),
    "underscore": head(b"Content-Length: 1_0"), "empty length": head(b"Content-Length:"),
    "19 digits": head(b"Content-Length: 1000000000000000000"),
    "coding": head(b"Transfer-Encoding: gzip, chunked"), "folded": head(b"A: b", b" c"),
    "space before the colon": head(b"A : b"), "no colon": head(b"A"), "no name": head(b": b"),
    "bare LF": head(b"A: b\nB: c"), "bare CR": head(b"A: b\rc"), "NUL": head(b"A: b\0c"),
    "vertical tab": head(b"A: \x0bb"), "DEL": head(b"A: \x7f"), "HTTP/1.0": head(start=b"GET / HTTP/1.0"),
    "HTTP/2.0": head(start=b"GET / HTTP/2.0"), "absolute": head(start=b"GET http://x/ HTTP/1.1"),
    "asterisk": head(start=b"OPTIONS * HTTP/1.1"), "two spaces": head(start=b"GET  / HTTP/1.1"),
    "small letters": head(start=b"get / HTTP/1.1"), "letter above ASCII": head(start=b"GET /\xe4 HTTP/1.1"),
    "65 lines": head(*[b"A: b"] * MAX_HEADERS), "16 KiB": head(b"A: " + b"b" * MAX_HEAD_BYTES),
    "empty line first": b"\r\n" + head(), "no lines": b"GET / HTTP/1.1\r\n\r\n",
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_head_with_two_meanings_is_refused(name: str) -> None:
    with pytest.raises(BadRequestBytes):
        parse_head(BAD[name])


def test_a_head_may_have_64_lines_and_16_kib() -> None:
    assert len(parse_head(head(*[b"A: b"] * (MAX_HEADERS - 1))).headers) == MAX_HEADERS
    longest = head(b"A: ".ljust(MAX_HEAD_BYTES - len(head(b"")), b"b"))
    assert len(longest) == MAX_HEAD_BYTES
    assert parse_head(longest)


@pytest.mark.parametrize("size", [1, 2, 3, 100])
def test_a_body_in_chunks_is_the_same_however_it_is_cut(size: int) -> None:
    data = b"5\r\nhello\r\n10\r\n" + b"x" * 16 + b"\r\n0\r\n\r\n"
    body, found, rest = ChunkedBody(), b"", None
    for at in range(0, len(data), size):
        assert rest is None
        pieces, rest = body.decode(data[at : at + size])
        found += b"".join(pieces)

    assert (found, rest) == (b"hello" + b"x" * 16, b"")


@pytest.mark.parametrize(
    "data",
    [b"5;a=b\r\n", b"+5\r\n", b"0x5\r\n", b" 5\r\n", b"5 \r\n", b"5\n", b"\r\n", b"g\r\n", b"1" * 17,
     b"1\r\nab", b"0\r\nX: y\r\n\r\n", b"5\rX", b"1\r\na\n"],
)  # fmt: skip
def test_a_chunk_with_two_meanings_is_refused(data: bytes) -> None:
    with pytest.raises(BadRequestBytes):
        ChunkedBody().decode(data)


def test_what_follows_a_request_is_no_part_of_it() -> None:
    read = read_by_us(head(b"Content-Length: 2") + b"abGET")

    assert read is not None
    assert (read.body, read.rest) == (b"ab", b"GET")
