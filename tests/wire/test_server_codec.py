"""The codecs of a server and those of a robot: the same verdicts, the same values bit by bit."""

from __future__ import annotations

import json
import random
import zlib
from typing import Any

import msgspec
import numpy as np
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadMessage, RsePfError
from rse_pf.pnp import PnpOptions
from rse_pf.pnp.problems import make_problem
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpRequest, make_request
from rse_pf.services.pnp_reader import pnp_reader
from rse_pf.wire import CODECS, Codec, Command, Ping, Result, as_type, make_codec
from rse_pf.wire.arrays import json_encode_hook
from rse_pf.wire.server_codec import make_server_codec

REGISTRY = builtin_services(PlatformSettings())
SERVER = {name: make_server_codec(name, read_first=pnp_reader(REGISTRY, name)) for name in CODECS}
ROBOT = {name: make_codec(name) for name in CODECS}
CAMERA = '{"fx":525.5,"fy":525,"cx":319.5,"cy":239.5,"width":640,"height":480}'
HEAD = '{"type":"command","id":7,"service":"pnp","payload":{"camera":' + CAMERA
_TOKENS = (
    b"[", b"]", b"{", b'"', b"\\", b",", b"-", b"e", b"0", b"\xc7", b"e300", b"." + b"7" * 19,
)  # fmt: skip
_encode = msgspec.json.Encoder(enc_hook=json_encode_hook).encode


def command_of(numbers: str, pixels: str = "1.5,2.5") -> bytes:
    return (HEAD + f',"points_world":[{numbers}],"pixels":[{pixels}]' + "}}").encode()


def outcome(codec: Codec, data: bytes) -> tuple[str, bytes]:
    """Return what became of *data*: the code of an error, or the message with the request of `pnp`."""
    try:
        message = codec.decode_from_robot(data)
    except RsePfError as error:
        return error.code, b""
    if not isinstance(message, Command) or message.service != "pnp":
        return "message", _encode(message)
    try:
        request = as_type({} if message.payload is None else message.payload, PnpRequest)
    except RsePfError as error:
        return f"request {error.message}", _encode(msgspec.structs.replace(message, payload=None))
    # msgspec leaves out a default by its identity, and an equal number may be another object.
    options = None if request.options is None else msgspec.structs.asdict(request.options)
    plain = {
        name: value for name, value in msgspec.structs.asdict(request).items() if value is not msgspec.UNSET
    }
    plain["options"] = options
    return "request", _encode(msgspec.structs.replace(message, payload=plain))


def assert_alike(codec: str, data: bytes) -> None:
    assert outcome(SERVER[codec], data) == outcome(ROBOT[codec], data), data[:2000]


def payload_type(codec: str, data: bytes) -> type[Any]:
    message = SERVER[codec].decode_from_robot(data)
    assert isinstance(message, Command)
    return type(message.payload)


def sample(codec: str, n: int = 20, options: PnpOptions | None = None, *, deep: bool = False) -> bytes:
    problem = make_problem(seed=n, n=n)
    request = make_request(
        problem.points_world,
        problem.pixels,
        problem.camera,
        options,
        binary=codec == "bin",
        depths_m=np.linspace(0.0, 4.0, n) if deep else None,
    )
    return make_codec(codec).encode(
        Command(id=n, service="pnp", payload=request, stream="front", seq=3, deadline_ms=250.0, trace="t-1")
    )


@pytest.mark.parametrize("codec", ["json", "zlib"])
@pytest.mark.parametrize("options", [None, PnpOptions(inlier_px=4.0, engine="opencv"), PnpOptions()])
def test_a_plain_command_is_read_as_its_request_and_means_the_same(
    codec: str, options: PnpOptions | None
) -> None:
    data = sample(codec, 200, options, deep=options is None)

    assert payload_type(codec, data) is PnpRequest
    assert_alike(codec, data)


NUMBERS = (
    "0", "-0", "0.0", "-0.0", "1", "-1", "1e3", "1E+3", "1e-3", "12.5e1", "0.1", "0.3",
    "1.7976931348623157e308", "1e309", "-1e999", "5e-324", "2.2250738585072011e-308",
    "2.2250738585072014e-308", "1e-400", "1e22", "1e23", "9007199254740993", "9007199254740992.5",
    "123456789012345678", "12345678901234567890", "0.1000000000000000055511151231257827", "8.5",
    "7.2057594037927933e16", "1e100", "1.1e100", "1e0", "1e00001", "0e5", "0.000e-9", "00", "01", "-01", "+1",
    ".5", "5.", "1e", "1e+", "-", "--1", "0x10", "NaN", "Infinity", "-Infinity", "nan", "true", "null", '"1"',
    "[1]", "{}", "1 2", "", ",", "1,", ",1", "1,,2", " 1 , 2 ", "1\t,\n2\r", "1\x0b", "١", "1e-22",
    "1e-23", "4.35", "0.29999999999999998",
)  # fmt: skip


@pytest.mark.parametrize("number", NUMBERS)
def test_a_number_is_validated_and_read_alike(number: str) -> None:
    assert_alike("json", command_of(f"1.25,{number},-3"))
    assert_alike("json", command_of(number))


# Variants of one command that are no plain ones, or hardly.
CHANGES = {
    "duplicate points": ('"pixels":', '"points_world":[1,2,3],"pixels":'),
    "unknown field": ('"id":7', '"id":7,"new":1'),
    "unknown field of the payload": ('"pixels":', '"new":[1],"pixels":'),
    "depths first": ('"pixels":', '"depths_m":[1],"pixels":'),
    "depths": ("2.5]", '2.5],"depths_m":[0, 1.25]'),
    "depths twice": ("2.5]", '2.5],"depths_m":[1],"depths_m":[2]'),
    "no depths": ("2.5]", '2.5],"depths_m":null'),
    "empty depths": ("2.5]", '2.5],"depths_m":[]'),
    "depths and options": ("2.5]", '2.5],"options":null,"depths_m":[3]'),
    "a depth noise": ("2.5]", '2.5],"depths_m":[1],"depth_noise":null'),
    "unknown field of the camera": ('"fx":', '"k1":0,"fx":'),
    "pixels first": (HEAD[HEAD.index("{", 5) :], HEAD[HEAD.index("{", 5) :] + ',"pixels":[1.5,2.5]'),
    "an escape": ('"pnp"', '"p\\u006ep"'),
    "another service": ('"pnp"', '"icp"'),
    "another type": ('"command"', '"hello"'),
    "no id": ('"id":7,', ""),
    "a negative id": ('"id":7', '"id":-7'),
    "a real id": ('"id":7', '"id":7.0'),
    "a large id": ('"id":7', '"id":9007199254740992'),
    "the largest id": ('"id":7', '"id":9007199254740991'),
    "a text for a number": ('"width":640', '"width":"640"'),
    "a real width": ('"width":640', '"width":640.0'),
    "an absurd camera": ('"fx":525.5', '"fx":0.001'),
    "a null camera": (CAMERA, "null"),
    "no camera": ('"camera":' + CAMERA + ",", ""),
    "a stream": ('"id":7', '"id":7,"stream":"a b","seq":4,"keep":true'),
    "a list for a stream": ('"id":7', '"id":7,"stream":[1,2]'),
    "a stream beyond ASCII": ('"id":7', '"id":7,"stream":"\u00e9\U0001f916"'),
    "a long stream": ('"id":7', '"id":7,"stream":"' + 65 * "x" + '"'),
    "the longest stream": ('"id":7', '"id":7,"stream":"' + 64 * "x" + '"'),
    "a control character": ('"id":7', '"id":7,"trace":"a\x01"'),
    "a deadline": ('"id":7', '"id":7,"deadline_ms":250'),
    "no deadline": ('"id":7', '"id":7,"deadline_ms":null'),
    "a deadline too far": ('"id":7', '"id":7,"deadline_ms":3.7e6'),
    "a negative deadline": ('"id":7', '"id":7,"deadline_ms":-1e-300'),
    "no options": ('"pixels":', '"options":null,"pixels":'),
    "empty options": ('"pixels":', '"options":{},"pixels":'),
    "an unknown engine": ('"pixels":', '"options":{"engine":"magic"},"pixels":'),
    "an engine": ('"pixels":', '"options":{"engine":"opencv","confidence":0.9},"pixels":'),
    "no engine": ('"pixels":', '"options":{"engine":null,"max_iterations":50},"pixels":'),
    "a bad option": ('"pixels":', '"options":{"inlier_px":0},"pixels":'),
    "real iterations": ('"pixels":', '"options":{"max_iterations":1.5},"pixels":'),
    "spaces": (":", " :\n "),
    "bytes behind": ("}}", "}}x"),
    "spaces behind": ("}}", "}} \n"),
    "cut off": ("}}", "}"),
    "brackets in a stream": ('"id":7', '"id":7,"stream":"' + "[{" * 20 + '"'),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_command_means_the_same_or_is_refused_alike(change: str) -> None:
    data = command_of("1,2.5,3").decode()
    old, new = CHANGES[change]
    assert old in data

    assert_alike("json", data.replace(old, new).encode())
    assert_alike("zlib", zlib.compress(data.replace(old, new).encode()))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"id":7', '"new":"text","id":7'),
        ('"pixels":', '"new":"text","pixels":'),
        ('"fx":', '"new":"text","fx":'),
        ('"fx":', '"fx":"text","fx":'),
        ('"pixels":', '"camera":"text","pixels":'),
        ('"pixels":', '"options":{"engine":"text"},"pixels":'),
    ],
)
def test_a_request_has_no_text_that_is_not_in_its_known_fields(old: str, new: str) -> None:
    data = command_of("1,2.5,3").decode()
    assert payload_type("json", data.encode()) is PnpRequest

    assert payload_type("json", data.replace(old, new, 1).encode()) is dict


def mutated(data: bytes, draw: random.Random) -> bytes:
    """Return *data* with a few bytes changed, removed, doubled or replaced by parts of itself."""
    parts = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 4))):
        at = draw.randrange(len(parts) + 1)
        match draw.randrange(5):
            case 0:
                parts[at : at + 1] = bytes([draw.randrange(256)])
            case 1:
                del parts[at : at + draw.choice((1, 2, 8, 64))]
            case 2:
                parts[at:at] = parts[at : at + draw.choice((1, 4, 32))]
            case 3:
                parts[at : at + 1] = draw.choice(_TOKENS)
            case _:
                begin = draw.randrange(len(parts) + 1)
                parts[at : at + 8] = parts[begin : begin + draw.choice((4, 8))]
        if not parts:
            return b"{"
    return bytes(parts)


@pytest.mark.parametrize("codec", CODECS)
def test_damaged_messages_get_the_same_verdict(codec: str) -> None:
    draw = random.Random(11)
    seeds = [sample(codec), sample(codec, deep=True), sample(codec, 4, PnpOptions(inlier_px=3.0))]

    for number in range(1500):
        data = seeds[number % len(seeds)]
        if codec == "zlib" and number % 3:
            data = zlib.compress(mutated(zlib.decompress(data), draw), draw.choice((0, 1, 6)))
        assert_alike(codec, data if codec == "zlib" and number % 3 else mutated(data, draw))


@pytest.mark.parametrize("codec", CODECS)
def test_a_short_message_is_read_at_once_and_a_longer_one_is_not(codec: str) -> None:
    wire = SERVER[codec]
    texts = [command_of("1,2.5,3"), json.dumps({"type": "ping", "sent_s": 1.5, "x": "y" * 500}).encode()]
    messages = [zlib.compress(text) if codec == "zlib" else text for text in texts]
    messages = [sample("bin"), make_codec("bin").encode(Ping(sent_s=1.5))] if codec == "bin" else messages
    for data in messages:
        text = zlib.decompress(data) if codec == "zlib" else data
        for max_bytes in (1, len(text) - 1, len(text), len(text) + 1, 10**6):
            got = wire.decode_short_from_robot(data, max_bytes)

            assert (got is None) == (len(text) > max_bytes)
            assert got is None or isinstance(got, Command if data is messages[0] else Ping)
    if codec == "zlib":
        for wrong in (b"", b"{}", messages[0][:-1], messages[0] + b"x", messages[0][:-1] + b"x"):
            with pytest.raises(BadMessage):
                wire.decode_short_from_robot(wrong, 10**6)


def deflated(text: bytes, draw: random.Random) -> bytes:
    stream = zlib.compressobj(
        draw.randrange(10), zlib.DEFLATED, draw.choice((9, 12, 15)), draw.randint(1, 9), draw.randrange(5)
    )
    half = draw.randrange(len(text) + 1)
    mode = draw.choice((zlib.Z_NO_FLUSH, zlib.Z_SYNC_FLUSH, zlib.Z_FULL_FLUSH, zlib.Z_PARTIAL_FLUSH))
    return stream.compress(text[:half]) + stream.flush(mode) + stream.compress(text[half:]) + stream.flush()


def test_streams_are_inflated_or_refused_as_by_zlib() -> None:
    draw = random.Random(2)
    texts = [b"", b"0", b"1" * 3000, draw.randbytes(500), b"12.5,-3.25," * 300, b"ab" * 4000]
    texts += [sample("json", 40), json.dumps({"type": "ping", "sent_s": 1.5, "x": "ab" * 3000}).encode()]
    seen = set()
    for number in range(4000):
        data = deflated(texts[number % len(texts)], draw)
        assert_alike("zlib", data)
        damaged = mutated(data, draw)
        if damaged[0] >> 4 <= 7:  # isal does not look at the size of the window
            assert_alike("zlib", damaged)
        seen.add(outcome(SERVER["zlib"], damaged)[0])
    assert {"message", "request", "bad-message"} <= seen


@pytest.mark.parametrize("codec", CODECS)
def test_a_reply_to_a_request_is_the_one_to_its_payload(codec: str) -> None:
    texts = []
    for wire in (SERVER[codec], ROBOT[codec]):
        command = wire.decode_from_robot(sample(codec, 60))
        assert isinstance(command, Command)
        data = wire.encode(dispatch(REGISTRY, command, lambda: 0.0))
        assert isinstance(ROBOT[codec].decode_from_server(data), Result)
        texts.append(zlib.decompress(data) if codec == "zlib" else data)

    assert texts[0] == texts[1]


@pytest.mark.parametrize("part", ["camera", "points_world", "pixels", "depths_m", "options", "depth_noise"])
@pytest.mark.parametrize("value", ["{}", '{"a":1}', "[{}]", '"x"', "true", "[[1],[2]]", "null"])
@pytest.mark.parametrize("brackets", ["", "[", "[["])
def test_a_part_of_another_kind_is_a_message_that_the_service_refuses_or_reads(
    part: str, value: str, brackets: str
):
    trace = f'"trace":"{brackets}",'
    data = (
        '{"type":"command","id":1,"service":"pnp",' + trace + '"payload":{"' + part + '":' + value + "}}"
    ).encode()

    assert outcome(SERVER["json"], data) == outcome(ROBOT["json"], data)


def test_the_largest_request_of_pnp_is_read():
    problem = make_problem(seed=1, n=5000)
    request = make_request(
        problem.points_world, problem.pixels, problem.camera, PnpOptions(), depths_m=np.full(5000, 12.345)
    )
    data = ROBOT["json"].encode(Command(id=1, service="pnp", payload=request))

    message = SERVER["json"].decode_from_robot(data)

    assert isinstance(message, Command)
    assert as_type(message.payload, PnpRequest).depths_m.size == 5000
