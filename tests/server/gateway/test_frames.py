"""The frame layer: what a robot may send, and what ends its socket."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.config import SessionSettings
from rse_pf.server.gateway.frames import CloseBorder, CloseSocket, FrameAssembler, Received, SendPong

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0, 1, 2, 8, 9, 10
LIMITS = SessionSettings(max_message_bytes=2000, max_fragments=4)


def assembler() -> FrameAssembler:
    return FrameAssembler(LIMITS, max_control_per_s=3.0)


def frame_bytes(opcode: int, fin: bool, payload: bytes, mask: bytes = b"\0\0\0\0") -> bytes:
    size = len(payload)
    if size < 126:
        length = bytes([128 | size])
    elif size < 65536:
        length = bytes([128 | 126]) + size.to_bytes(2, "big")
    else:
        length = bytes([128 | 127]) + size.to_bytes(8, "big")
    masked = bytes(byte ^ mask[i % 4] for i, byte in enumerate(payload))
    return bytes([(128 if fin else 0) | opcode]) + length + mask + masked


@pytest.mark.parametrize(
    ("opcode", "fin", "rsv", "payload", "code"),
    [
        (TEXT, True, True, b"", 1002),
        (CONTINUATION, True, False, b"", 1002),
        (3, True, False, b"", 1002),
        (11, True, False, b"", 1002),
        (PING, False, False, b"", 1002),
        (PING, True, False, b"x" * 126, 1002),
        (TEXT, True, False, b"\xc3", 1007),
        (BINARY, True, False, b"x" * 2001, 1009),
        (CLOSE, True, False, b"", 1000),
        (CLOSE, True, False, b"\x03", 1002),
        (CLOSE, True, False, (1005).to_bytes(2, "big"), 1002),
        (CLOSE, True, False, (999).to_bytes(2, "big"), 1002),
        (CLOSE, True, False, (1000).to_bytes(2, "big") + b"\xff", 1002),
        (CLOSE, True, False, (4999).to_bytes(2, "big") + b"bye", 4999),
    ],
)
def test_a_broken_rule_closes_with_its_code(opcode, fin, rsv, payload, code):
    decision = assembler().receive(opcode, fin, rsv, payload, 0.0)

    assert isinstance(decision, CloseSocket)
    assert decision.code == code


def test_control_frames_have_a_rate_that_recovers():
    frames = assembler()

    assert all(frames.receive(PONG, True, False, b"", 5.0) is None for _ in range(3))
    assert isinstance(frames.receive(PING, True, False, b"", 5.4), SendPong)
    assert frames.receive(PING, True, False, b"", 5.5) == CloseSocket(1008, "too many control frames")


messages = st.lists(
    st.tuples(st.binary(max_size=300), st.integers(0, 3), st.binary(min_size=4, max_size=4)), max_size=6
)


def stream_of(sent: list[tuple[bytes, int, bytes]]) -> bytes:
    stream = b""
    for data, cuts, mask in sent:
        size = len(data) // (cuts + 1) + 1
        pieces = [data[k * size : (k + 1) * size] for k in range(cuts + 1)]
        for k, piece in enumerate(pieces):
            stream += frame_bytes(BINARY if k == 0 else CONTINUATION, k == cuts, piece, mask)
    return stream


def parsed(stream: bytes) -> list[bytes]:
    """Unmask and assemble a whole stream with a parser that is nothing like the product's."""
    frames, found, i = FrameAssembler(SessionSettings(), max_control_per_s=1000.0), [], 0
    while i < len(stream):
        size = stream[i + 1] & 127
        start = i + 2
        if size == 126:
            size, start = int.from_bytes(stream[start : start + 2], "big"), start + 2
        mask, start = stream[start : start + 4], start + 4
        payload = bytes(byte ^ mask[k % 4] for k, byte in enumerate(stream[start : start + size]))
        decision = frames.receive(stream[i] & 15, bool(stream[i] & 128), False, payload, 0.0)
        if isinstance(decision, Received):
            found.append(decision.data)
        i = start + size
    return found


@given(sent=messages, cuts=st.lists(st.integers(0, 3000), max_size=20), junk=st.binary(max_size=40))
def test_the_stream_is_read_alike_wherever_it_is_cut(sent, cuts, junk):
    request = b"GET /ws HTTP/1.1\r\nHost: a\r\n\r\n"
    talk = stream_of(sent) + frame_bytes(CLOSE, True, b"")
    stream = request + talk + junk
    borders = sorted({min(cut, len(stream)) for cut in cuts} | {0, len(stream)})
    border, taken = CloseBorder(), b""

    for start, end in itertools.pairwise(borders):
        piece = memoryview(stream)[start:end]
        taken += bytes(piece[: border.bytes_to_close(piece, len(piece))])

    assert taken == request + talk
    assert border.shut
    assert parsed(talk[: -len(frame_bytes(CLOSE, True, b""))]) == [data for data, _, _ in sent]


@given(size=st.sampled_from([0, 1, 125, 126, 65535, 65536]), cut=st.integers(1, 13))
def test_long_frames_are_walked_over_even_when_their_head_is_cut(size, cut):
    data = frame_bytes(BINARY, True, b"\x88" * size) + frame_bytes(CLOSE, True, b"\x03\xe8") + b"more"
    border = CloseBorder(upgraded=True)
    pieces = [memoryview(data)[:cut], memoryview(data)[cut:]]

    assert sum(border.bytes_to_close(piece, len(piece)) for piece in pieces) == len(data) - 4


def test_a_new_message_inside_of_a_message_is_refused():
    frames = assembler()
    frames.receive(TEXT, False, False, b"a", 0.0)

    assert frames.receive(TEXT, True, False, b"b", 0.0) == CloseSocket(1002, "a message inside of a message")


def test_empty_fragments_count():
    frames = assembler()
    frames.receive(BINARY, False, False, b"", 0.0)
    decisions = [frames.receive(CONTINUATION, False, False, b"", 0.0) for _ in range(4)]

    assert decisions == [None, None, None, CloseSocket(1009, "too many fragments")]


def test_the_size_limit_holds_for_all_fragments_together():
    frames = assembler()
    frames.receive(BINARY, False, False, b"x" * 1500, 0.0)

    assert frames.receive(CONTINUATION, True, False, b"x" * 501, 0.0) == CloseSocket(1009, "message too big")
