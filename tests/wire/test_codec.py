"""The codecs of a server: messages of our robots, and malformed input."""

from __future__ import annotations

import contextlib
import time
import tracemalloc
import zlib
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, LimitExceeded, ProtocolError
from rse_pf.limits.budget import MESSAGE_CONTAINERS, MESSAGE_DEPTH
from rse_pf.wire import (
    CODECS,
    SUBPROTOCOLS,
    Command,
    Failure,
    Hello,
    Limits,
    Move,
    Ping,
    Pong,
    Result,
    Welcome,
    codec_for,
    make_codec,
)
from rse_pf.wire.server_codec import make_server_codec

LIMITS = SessionSettings()

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
words = st.text(st.characters(exclude_categories=["Cs"]), max_size=64)
finite = st.floats(allow_nan=False, allow_infinity=False)
counters = st.integers(0, 2**53 - 1)
plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | finite | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)
FROM_ROBOT: dict[type[Any], st.SearchStrategy[Any]] = {
    Hello: st.builds(
        Hello, protocol=st.integers(0, 99), sdk=words,
        capabilities=st.lists(words, max_size=32).map(tuple),
    ),
    Command: st.builds(
        Command, id=counters, service=words, payload=plain, stream=words, seq=counters, keep=st.booleans(),
        deadline_ms=st.none() | st.floats(0, 3.6e6), trace=words,
    ),
    Ping: st.builds(Ping, sent_s=finite),
}  # fmt: skip
FROM_SERVER: dict[type[Any], st.SearchStrategy[Any]] = {
    Welcome: st.builds(
        Welcome, server=texts, session=texts, robot=texts, protocol=st.integers(0, 99), clock_s=finite,
        limits=st.builds(Limits, max_message_bytes=counters, max_in_flight=counters),
    ),
    Result: st.builds(
        Result, id=counters, reply=plain, server=texts, queue_ms=finite, compute_ms=finite,
        received_s=finite, sent_s=finite,
    ),
    Failure: st.builds(
        Failure, id=st.none() | counters, code=texts, message=texts, hint=texts,
        retry_after_ms=st.none() | finite, server=texts, trace=texts,
    ),
    Move: st.builds(Move, reason=texts, within_ms=finite),
    Pong: st.builds(Pong, sent_s=finite, received_s=finite, answered_s=finite),
}  # fmt: skip


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("kind", FROM_ROBOT)
@given(data=st.data())
@settings(max_examples=50)
def test_robot_messages_survive_encoding(name: str, kind: type[Any], data: st.DataObject) -> None:
    message = data.draw(FROM_ROBOT[kind])
    codec = make_server_codec(name)

    assert codec.decode_from_robot(codec.encode(message)) == message


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("kind", FROM_SERVER)
@given(data=st.data())
@settings(max_examples=50)
def test_server_messages_survive_encoding(name: str, kind: type[Any], data: st.DataObject) -> None:
    message = data.draw(FROM_SERVER[kind])
    codec = make_server_codec(name)

    assert codec.decode_from_server(codec.encode(message)) == message


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("inflatable", [False, True])
@given(data=st.binary(max_size=300))
@settings(max_examples=300)
@example(b"")
@example(b"\x81" * 300)
@example(b"\xdf\xff\xff\xff\xff")
@example(b"\xc9\xff\xff\xff\xff\x01")
def test_random_bytes_give_a_message_or_a_protocol_error(name: str, inflatable: bool, data: bytes) -> None:
    codec = make_server_codec(name)
    sent = zlib.compress(data) if inflatable else data
    for decode in (codec.decode_from_robot, codec.decode_from_server):
        try:
            decode(sent)
        except ProtocolError as error:
            report = error.report()
        else:
            continue
        assert "hint" in report


@given(message=FROM_ROBOT[Command], cut=st.integers(0, 400), flip=st.integers(0, 3200))
@pytest.mark.parametrize("name", CODECS)
def test_damaged_messages_give_a_message_or_a_protocol_error(
    name: str, message: Command, cut: int, flip: int
) -> None:
    codec = make_server_codec(name)
    data = bytearray(codec.encode(message))
    data[flip // 8 % len(data)] ^= 1 << flip % 8
    for damaged in (bytes(data), bytes(data[:cut])):
        try:
            decoded = codec.decode_from_robot(damaged)
        except ProtocolError:
            continue
        assert isinstance(decoded, Hello | Command | Ping)


def refused(name: str, data: bytes, limits: SessionSettings = LIMITS) -> ProtocolError:
    with pytest.raises(ProtocolError) as caught:
        make_server_codec(name, limits).decode_from_robot(data)
    return caught.value


def command(payload: str) -> bytes:
    return b'{"type":"command","id":1,"service":"echo","payload":' + payload.encode() + b"}"


def deflated(data: bytes, wbits: int) -> bytes:
    stream = zlib.compressobj(wbits=wbits)
    return stream.compress(data) + stream.flush()


def payload_of(name: str, data: bytes) -> Any:
    message = make_server_codec(name).decode_from_robot(data)
    assert isinstance(message, Command)
    return message.payload


@pytest.mark.parametrize(
    "payload",
    ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "9" * 5000, "01", "1.", "'x'", "[1,]", '{"a":1,}',
     '"\\ud800"', '"\\udc00x"', '"\\x41"', '"\n"', "nul", "/* */ 1", ""],
)  # fmt: skip
def test_json_beyond_the_standard_is_a_bad_message(payload: str) -> None:
    assert isinstance(refused("json", command(payload)), BadMessage)


@pytest.mark.parametrize("data", [b"\xff", b'"\xed\xa0\x80"', b'"\xc0\xaf"'])
def test_text_that_is_not_utf8_is_a_bad_message(data: bytes) -> None:
    assert isinstance(refused("json", command('"x"').replace(b'"x"', data)), BadMessage)


def test_of_duplicate_keys_the_last_one_counts() -> None:
    assert payload_of("json", command('{"a":1,"a":2}')) == {"a": 2}


def test_unknown_fields_are_ignored_for_compatibility() -> None:
    assert payload_of("json", command('5,"colour":{"deep":[1]}')) == 5


@pytest.mark.parametrize(
    "fields",
    ['"id":-1,"service":"a"', '"id":9007199254740992,"service":"a"', '"id":1.5,"service":"a"',
     '"id":"1","service":"a"', '"id":true,"service":"a"', '"id":1', '"service":"a"', '"id":1,"service":5',
     f'"id":1,"service":"{"x" * 65}"',
     '"id":1,"service":"a","deadline_ms":-1', '"id":1,"service":"a","deadline_ms":1e9',
     '"id":1,"service":"a","seq":-1', '"id":1,"service":"a","keep":1',
     f'"id":1,"service":"a","trace":"{"x" * 65}"'],
)  # fmt: skip
def test_a_command_whose_fields_do_not_fit_is_a_bad_message(fields: str) -> None:
    error = refused("json", b'{"type":"command",' + fields.encode() + b"}")

    assert isinstance(error, BadMessage)
    assert "docs/protocol.md" in error.hint


@pytest.mark.parametrize("data", [b"[]", b"1", b"{}", b'{"type":"welcome"}', b'{"type":7}', b'{"type":"x"}'])
def test_server_messages_from_a_robot_are_bad_messages(data: bytes) -> None:
    assert isinstance(refused("json", data), BadMessage)


@pytest.mark.parametrize("name", CODECS)
def test_a_message_above_the_limit_is_refused_unread(name: str) -> None:
    error = refused(name, b"\0" * (LIMITS.max_message_bytes + 1))

    assert isinstance(error, LimitExceeded)
    assert str(LIMITS.max_message_bytes) in error.message


BOMBS = {
    "zeros": zlib.compress(b"\0" * 200_000_000, 9),
    "brackets": zlib.compress(b"[" * 200_000_000, 9),
    "just above the size": zlib.compress(np.random.default_rng(1).bytes(2000) + b" " * 1_050_000, 1),
    "ratio": zlib.compress(command('"' + "x" * 900_000 + '"'), 9),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_a_bomb_is_refused_in_little_memory_and_time(bomb: str) -> None:
    data = BOMBS[bomb][: LIMITS.max_message_bytes]
    tracemalloc.start()
    try:
        started = time.thread_time()
        error = refused("zlib", data)
        took_s = time.thread_time() - started
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert isinstance(error, LimitExceeded)
    assert peak < 4 * LIMITS.max_inflated_bytes
    assert took_s < 0.05


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\x78", zlib.compress(command("1"))[:-1], zlib.compress(command("1")) + b"x",
        zlib.compress(command("1")) * 2, deflated(command("1"), -15),
        deflated(command("1"), 31),
    ],
    ids=["empty", "header", "cut", "more behind", "two streams", "raw deflate", "gzip"],
)  # fmt: skip
def test_anything_but_one_whole_zlib_stream_is_a_bad_message(data: bytes) -> None:
    assert isinstance(refused("zlib", data), BadMessage)


def nested(depth: int) -> Any:
    value: Any = 1
    for level in range(depth):
        value = [value] if level % 2 else {"a": value}
    return value


@pytest.mark.parametrize("name", CODECS)
def test_the_depth_limit_is_kept_to_the_level_in_every_codec(name: str) -> None:
    codec = make_server_codec(name)
    deepest = MESSAGE_DEPTH - 1  # the message itself is the first level

    message = Command(id=1, service="echo", payload=nested(deepest))
    assert codec.decode_from_robot(codec.encode(message)) == message
    error = refused(name, codec.encode(Command(id=1, service="echo", payload=nested(deepest + 1))))
    assert isinstance(error, LimitExceeded)
    assert str(MESSAGE_DEPTH) in error.message


@pytest.mark.parametrize(
    "text", ["[" * 200, '"' + "[{" * 100, "\\" * 99 + "[" * 99, '\\"[' * 99, '{"[":"' + "]" * 99 + '"}']
)
@pytest.mark.parametrize("name", CODECS)
def test_brackets_inside_strings_are_not_depth(name: str, text: str) -> None:
    codec = make_server_codec(name)
    message = Command(id=1, service="echo", payload={text: [text, "x", {"y": text}]})

    assert codec.decode_from_robot(codec.encode(message)) == message


@pytest.mark.parametrize("name", CODECS)
def test_closing_brackets_inside_a_string_hide_no_depth(name: str) -> None:
    deep: Any = 1
    for _ in range(40):
        deep = [deep]
    data = make_server_codec(name).encode(Command(id=1, service="echo", payload={"a": "]" * 60, "b": deep}))

    for codec in (make_server_codec(name), make_codec(name)):
        with pytest.raises(LimitExceeded):
            codec.decode_from_robot(data)


def test_a_damaged_stream_that_inflates_to_much_is_a_bad_message() -> None:
    letters = np.random.default_rng(1).integers(97, 123, 6000).astype(np.uint8).tobytes().decode()
    data = zlib.compress(command(f'"{50 * letters}"'))
    wrong = data[:-1] + bytes([data[-1] ^ 1])

    assert len(data) < 16_384
    for codec in (make_server_codec("zlib"), make_codec("zlib")):
        assert isinstance(codec.decode_from_robot(data), Command)
        with pytest.raises(BadMessage):
            codec.decode_from_robot(wrong)


@pytest.mark.parametrize("padding", ['"\\\\"', '"\\\\\\""', '"\\""'])
def test_quotes_and_backslashes_hide_no_depth(padding: str) -> None:
    deep = "[" * 40 + padding + "]" * 40

    assert isinstance(refused("json", command(f"[{padding},{deep}]")), LimitExceeded)


def test_more_lists_than_allowed_are_refused_and_those_in_strings_do_not_count() -> None:
    most = MESSAGE_CONTAINERS - 2  # the message and its payload are boxes too
    flat = "[" + "[]," * (most - 1) + "[]]"

    assert len(payload_of("json", command(flat))) == most
    assert "lists" in refused("json", command(flat[:-1] + ",{}]")).message
    assert payload_of("json", command('["' + "[{" * most + '"]')) == ["[{" * most]


HEAVY = {
    "brackets": command("[" * 250_000),
    "flat brackets": command("[" + "[]," * 80_000 + "[]]"),
    "quotes": command("[" + '"",' * 80_000 + '"",' + "[" * 20 + "]" * 21),
    "backslashes": command('"' + "\\\\" * 120_000 + '"'),
    "long integers": command("[" + ("9" * 4300 + ",") * 55 + "1]"),
    "numbers": command("[" + "1," * 120_000 + "1]"),
    "unknown field": command("1,\"x\":" + "[" * 200_000),
}  # fmt: skip


@pytest.mark.parametrize("name", HEAVY)
def test_no_message_within_the_size_limit_takes_long(name: str) -> None:
    data = HEAVY[name]
    assert len(data) <= LIMITS.max_message_bytes
    codec = make_server_codec("json")
    took_s = []
    for _ in range(3):
        started = time.thread_time()
        with contextlib.suppress(ProtocolError):
            codec.decode_from_robot(data)
        took_s.append(time.thread_time() - started)

    assert min(took_s) < 0.03, "three times the 10 ms that we promise, for slow machines"


@pytest.mark.parametrize("depth", [900, 5000, 250_000])
@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1a", b"\x81\x91"])
def test_deep_messagepack_is_refused_or_skipped_and_never_a_crash(depth: int, opening: bytes) -> None:
    deep = (opening * depth)[:250_000]
    start = msgspec.msgpack.encode({"type": "command", "id": 1, "service": "echo"})
    before = bytes([start[0] + 1]) + start[1:]

    assert isinstance(refused("bin", before + b"\xa7payload" + deep + b"\x01"), ProtocolError)
    with contextlib.suppress(ProtocolError):  # an unknown field is skipped, so it may be deep
        make_server_codec("bin").decode_from_robot(before + b"\xa7unknown" + deep + b"\x01")


@pytest.mark.parametrize("value", [object(), {1, object()}, nested(3000)], ids=["object", "set", "deep"])
@pytest.mark.parametrize("name", CODECS)
def test_a_message_that_cannot_be_encoded_is_a_bad_message_of_its_sender(name: str, value: Any) -> None:
    with pytest.raises(BadMessage):
        make_server_codec(name).encode(Result(id=1, reply=value))


@pytest.mark.parametrize(
    ("offered", "name"),
    [
        ([SUBPROTOCOLS["bin"]], "bin"),
        (["rse-pf.v9.bin", SUBPROTOCOLS["json"], SUBPROTOCOLS["bin"]], "json"),
        (["chat"], None),
        ([], None),
    ],
)
def test_the_first_sub_protocol_that_both_speak_is_chosen(offered: list[str], name: str | None) -> None:
    assert codec_for(offered) == name
