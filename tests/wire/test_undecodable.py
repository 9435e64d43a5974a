"""A command that is refused before it is decoded is answered with its id, and its robot goes on."""

from __future__ import annotations

import zlib
from typing import Any

import msgspec
import pytest
from clients.undecodable import BINARY, JSON, Kind
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.config import SessionSettings
from rse_pf.wire import CODECS, Codec, Command, Failure, Hello, Subscribe, make_codec
from rse_pf.wire.envelope import undecodable_id
from rse_pf.wire.server_codec import make_server_codec
from rse_pf.wire.server_session import MAX_BAD_MESSAGES, Close, SendRefusal, ServerSession, Submit
from tests.kit import server_sessions

LIMITS = SessionSettings()
GOOD = Command(id=1, service="echo", payload=1)
KINDS = [(name, kind) for name in CODECS for kind in (BINARY if name == "bin" else JSON)]


def bytes_of(codec: Codec, kind: Kind, identity: int) -> bytes:
    """Return the message of *kind* as the SDK would encode it."""
    return codec.encode(
        Command(
            id=identity, service=kind.service, payload=msgspec.Raw(kind.payload), stream=kind.stream, seq=3,
            deadline_ms=250.0, trace=kind.trace,
        )
    )  # fmt: skip


def opened(codec: str) -> ServerSession:
    made = ServerSession(codec=make_server_codec(codec), robot="r", server="s", session="x", limits=LIMITS)
    server_sessions.receive(made, made.codec.encode(Hello()), 0.0)
    return made


def refusal(decisions: list[Any]) -> Failure:
    """Return the one failure that was sent, and check that its bytes say the same."""
    (sent,) = decisions
    assert isinstance(sent, SendRefusal)
    return sent.failure


@pytest.mark.parametrize(("codec", "kind"), KINDS, ids=[f"{codec}-{kind.name}" for codec, kind in KINDS])
def test_a_command_that_cannot_be_decoded_is_answered_with_its_id(codec: str, kind: Kind) -> None:
    server = opened(codec)

    failure = refusal(server_sessions.receive(server, bytes_of(server.codec, kind, 7), 1.0))

    assert (failure.id, failure.code in kind.codes) == (7, True), failure
    assert failure.message
    assert failure.hint
    assert server.in_flight == 0
    assert server.codec.decode_from_server(server.codec.encode(failure)) == failure
    assert server_sessions.receive(server, server.codec.encode(GOOD), 2.0) == [Submit(GOOD)]


@pytest.mark.parametrize("codec", CODECS)
def test_any_number_of_such_commands_leaves_the_connection_open(codec: str) -> None:
    server = opened(codec)
    kind = (BINARY if codec == "bin" else JSON)[1]

    answered = [
        refusal(server_sessions.receive(server, bytes_of(server.codec, kind, n), 1.0)).id for n in range(100)
    ]

    assert answered == list(range(100))
    assert (server.state, server.suspicion) == ("open", 100)
    for number in range(100):
        server_sessions.receive(server, server.codec.encode(Command(id=number, service="echo")), 2.0)
        server.in_flight = 0
    assert server.suspicion == 0


@pytest.mark.parametrize("codec", CODECS)
def test_a_subscription_that_cannot_be_decoded_is_answered_with_its_id(codec: str) -> None:
    server = opened(codec)

    failure = refusal(
        server_sessions.receive(server, server.codec.encode(Subscribe(id=9, topic="t" * 129)), 1.0)
    )

    assert (failure.id, failure.code) == (9, "bad-message")


def encoded(codec: str, fields: dict[str, Any]) -> bytes:
    """Return *fields*, in their order, as a message of *codec*."""
    if codec == "bin":
        return msgspec.msgpack.encode(fields)
    text = msgspec.json.encode(fields)
    return zlib.compress(text) if codec == "zlib" else text


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "fields",
    [
        {"type": "cancel", "id": 7, "x": [[]]},
        {"type": "unsubscribe", "id": 7},
        {"type": "result", "id": 7},
        {"type": "command", "id": -1},
        {"type": "command", "id": 2**53},
        {"type": "command", "id": "7"},
        {"type": "command", "id": True},
        {"type": "command", "id": None},
        {"type": "command", "id": [7]},
        {"type": "command", "payload": [1], "id": 7},
        {"type": "command", "service": "x" * 600, "id": 7},
        {"type": ["command"], "id": 7},
        {"id": 7},
        {},
        {"payload": {"type": "command", "id": 7}},
        {"service": '{"type":"command","id":7,', "x": [1]},
    ],
)
def test_an_id_that_cannot_be_told_is_not_guessed(codec: str, fields: dict[str, Any]) -> None:
    assert undecodable_id(make_codec(codec), encoded(codec, fields)) is None


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("names", [("id", "type"), ("stream", "seq", "keep", "trace", "type", "id")])
def test_fields_in_another_order_are_read_up_to_the_first_list(codec: str, names: tuple[str, ...]) -> None:
    values = {"type": "command", "id": 7, "stream": 'a"\\', "seq": -1.5, "keep": None, "trace": "\u00e9"}

    message = encoded(codec, {**{name: values[name] for name in names}, "payload": [1]})

    assert undecodable_id(make_codec(codec), message) == 7


def test_of_a_damaged_stream_the_fields_before_the_damage_count() -> None:
    whole = zlib.compress(
        b'{"type":"command","id":7,"service":"echo","payload":"' + bytes(range(32, 127)) * 9
    )

    assert undecodable_id(make_codec("zlib"), whole[:-4] + b"????") == 7
    assert undecodable_id(make_codec("zlib"), b"????" + whole) is None


@pytest.mark.parametrize("codec", CODECS)
@given(data=st.binary(max_size=700))
def test_any_bytes_have_an_id_or_none(codec: str, data: bytes) -> None:
    found = undecodable_id(make_codec(codec), data)

    assert found is None or 0 <= found < 2**53


def test_messages_without_an_id_still_close_the_connection() -> None:
    server = opened("json")

    decisions = [server_sessions.receive(server, b"{", 1.0) for _ in range(MAX_BAD_MESSAGES + 1)]

    assert [refusal(each).id for each in decisions[:-1]] == [None] * MAX_BAD_MESSAGES
    assert isinstance(decisions[-1][-1], Close)


def test_before_hello_no_id_is_read() -> None:
    server = ServerSession(codec=make_codec("json"), robot="r", server="s", session="x", limits=LIMITS)

    assert (
        refusal(
            server_sessions.receive(server, b'{"type":"command","id":7,"service":"x","payload":NaN}', 1.0)
        ).id
        is None
    )
