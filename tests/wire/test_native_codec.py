"""The native codec and the Python one: the same verdicts, the same values bit by bit."""

from __future__ import annotations

import json
import math
import random
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from fuzz.damage import run_damaged
from fuzz.meter import Meter
from fuzz.native_targets import native, outcome
from fuzz.samples import samples
from rse_pf.budget import Budget, check_json, check_msgpack, inflate_within
from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.errors import BadMessage, ConfigurationError, LimitExceeded, RsePfError
from rse_pf.geometry import Camera
from rse_pf.pnp import PnpOptions
from rse_pf.pnp.problems import make_problem
from rse_pf.service import Registry, dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpReply, PnpRequest, make_request, wire_types
from rse_pf.wire import CODECS, Command, Ping, Result, make_codec
from rse_pf.wire.native_codec import NativeReader, PnpTypes, native_codec, open_codec

NATIVE = native_codec()
pytestmark = pytest.mark.skipif(NATIVE is None, reason="the native core is not built: make -C native")

BUDGET = Budget.of_messages(SessionSettings())
# Long numbers count as several values.
MANY_VALUES = replace(BUDGET, values=10**7)
TYPES = PnpTypes(PnpRequest, Camera, PnpOptions, PnpReply)
ORDER_OF_LENGTHS = (16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15)
CAMERA = '{"fx":525.5,"fy":525,"cx":319.5,"cy":239.5,"width":640,"height":480}'
HEAD = '{"type":"command","id":7,"service":"pnp","payload":{"camera":' + CAMERA


class OwnRequest(msgspec.Struct):
    """A request of a service that has the platform's name."""

    camera: dict[str, float]


class OwnReply(msgspec.Struct):
    """Its reply."""

    width: float


def command_of(numbers: str, pixels: str = "1.5,2.5") -> bytes:
    return (HEAD + f',"points_world":[{numbers}],"pixels":[{pixels}]' + "}}").encode()


def assert_alike(codec: str, data: bytes) -> None:
    fast, plain = make_codec(codec, pnp=TYPES), make_codec(codec, use_native=False)
    assert outcome(fast, data) == outcome(plain, data), data[:2000]


def is_fast(codec: str, data: bytes) -> bool:
    assert NATIVE is not None
    return isinstance(NativeReader(NATIVE, codec, BUDGET, TYPES).read(data), Command)


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


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("options", [None, PnpOptions(inlier_px=4.0, engine="opencv"), PnpOptions()])
def test_a_plain_command_is_read_at_once_and_means_the_same(codec: str, options: PnpOptions | None) -> None:
    data = sample(codec, 200, options, deep=options is None)

    assert is_fast(codec, data)
    assert_alike(codec, data)


NUMBERS = (
    "0", "-0", "0.0", "-0.0", "1", "-1", "1e3", "1E+3", "1e-3", "12.5e1", "0.1", "0.3",
    "1.7976931348623157e308", "1e309", "-1e999", "5e-324", "2.2250738585072011e-308",
    "2.2250738585072014e-308", "1e-400", "1e22", "1e23", "9007199254740993", "9007199254740992.5",
    "123456789012345678", "12345678901234567890", "1" * 30, "1" * 400,
    "0.1000000000000000055511151231257827", "8.5", "7.2057594037927933e16", "1e100", "1.1e100", "1e0",
    "1e00001", "0e5", "0.000e-9", "00", "01", "-01", "+1", ".5", "5.", "1e", "1e+", "-", "--1", "0x10",
    "NaN", "Infinity", "-Infinity", "nan", "true", "null", '"1"', "[1]", "{}", "1 2", "", ",", "1,", ",1",
    "1,,2", " 1 , 2 ", "1\t,\n2\r", "1\x0b", "١", "1e-22", "1e-23", "123456789012345680000", "4.35",
    "0.29999999999999998",
)  # fmt: skip


@pytest.mark.parametrize("number", NUMBERS)
def test_a_number_is_judged_and_read_as_before(number: str) -> None:
    assert_alike("json", command_of(f"1.25,{number},-3"))
    # Near the end of a message numbers are read in another way.
    assert_alike("json", command_of(f"1.25,{number}," + "-3," * 20 + "0"))
    assert_alike("json", command_of(number))


def test_random_decimals_are_the_nearest_doubles() -> None:
    draw = random.Random(5)
    texts = []
    for _ in range(20_000):
        value = struct.unpack("d", draw.randbytes(8))[0]
        size = draw.choice(
            (value, draw.uniform(-1e3, 1e3), draw.uniform(-1, 1) * 10.0 ** draw.randint(-40, 40))
        )
        if math.isfinite(size) and 1e-290 < abs(size) < 1e99:
            texts += [repr(size), f"{size:.{draw.randint(0, 17)}g}"]
    texts += [f"{draw.randrange(10**18)}e{draw.randint(-60, 60)}" for _ in range(5000)]
    assert NATIVE is not None
    for begin in range(0, len(texts), 8000):
        some = texts[begin : begin + 8000]

        command = NativeReader(NATIVE, "json", MANY_VALUES, TYPES).read(command_of(",".join(some)))

        assert isinstance(command, Command)
        assert command.payload.points_world.tobytes() == np.array([float(text) for text in some]).tobytes()


# Variants of one command that are no plain ones, or hardly.
CHANGES = {
    "duplicate id": ('"id":7', '"id":7,"id":8'),
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
                parts[at : at + 1] = draw.choice(
                    (
                        b"[",
                        b"]",
                        b"{",
                        b'"',
                        b"\\",
                        b",",
                        b"-",
                        b"e",
                        b"0",
                        b"\xc7",
                        b"e300",
                        b"." + b"7" * 19,
                    )
                )
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
    fast, plain = make_codec(codec, pnp=TYPES), make_codec(codec, use_native=False)
    texts = [command_of("1,2.5,3"), json.dumps({"type": "ping", "sent_s": 1.5, "x": "y" * 500}).encode()]
    messages = [zlib.compress(text) if codec == "zlib" else text for text in texts]
    messages = [sample("bin"), make_codec("bin").encode(Ping(sent_s=1.5))] if codec == "bin" else messages
    for data in messages:
        text = zlib.decompress(data) if codec == "zlib" else data
        for max_bytes in (1, len(text) - 1, len(text), len(text) + 1, 10**6):
            expected = plain.decode_short_from_robot(data, max_bytes)
            got = fast.decode_short_from_robot(data, max_bytes)

            assert (got is None) == (expected is None) == (len(text) > max_bytes)
            if got is not None and data is messages[0]:
                assert isinstance(got, Command)
                assert isinstance(got.payload, PnpRequest)
            elif got is not None:
                assert got == expected
    if codec == "zlib":
        for wrong in (b"", b"{}", messages[0][:-1], messages[0] + b"x", messages[0][:-1] + b"x"):
            with pytest.raises(BadMessage) as refused:
                plain.decode_short_from_robot(wrong, 10**6)
            with pytest.raises(BadMessage, match=refused.value.message):
                fast.decode_short_from_robot(wrong, 10**6)


def test_inputs_of_the_fuzz_target_get_the_same_verdict() -> None:
    meter = Meter()

    for data in samples("native"):
        native(data, meter)
    run_damaged("native", lambda data: native(data, meter), first=3, inputs=600)

    assert meter.calls > 600


def corpus() -> Iterator[bytes]:
    folder = Path(__file__).parents[2] / "fuzz" / "corpus" / "codec"
    yield from (path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file())
    yield from (b"", b"[" * 20, b"[" * 8000, b"[[]" * 8000, b'["]",' * 30, b'{"a":' * 17, b"[0]" * 7001)
    yield from (
        b'"' + b"[" * 9000 + b'"',
        b'"\\"[' * 5000,
        b'\\\\"[[' * 4000,
        b"0," * 30_000,
        b'"",' * 30_001,
    )
    yield from (b'["' + b"\\u0041" * 60_000 + b'"]', b'["' + b"x" * 900_000 + b'"]', b'"\xc3\xa9' * 90_000)
    yield from (
        b'"' + b"," * 40_000 + b'"',
        b'"x\\"' * 80_000,
        b"\xdf\xff\xff\xff\xff",
        b"\x91" * 40,
        b"\xc1" * 9000,
    )
    yield from (b"\xdd\x00\x01\x00\x00" + b"\x01" * 65536, b"\xdc\x7f\xff" + b"\xcb12345678" * 32767, b"\xd9")
    yield from (
        b"\x93" + b"\xc4\xff" * 3,
        b"\xdd" + struct.pack(">I", 29_000) + b"\xa1x" * 29_000,
        b"\x90" * 9000,
    )
    yield b"\xdc\x1b\x58" + b"\x90" * 7000
    yield from (b"5e-324,1E300," * 90, b'["' + b"1e23 " * 4000 + b'",1e23,9007199254740993.0]', b"1" * 70_000)
    yield from (b"[" + b"-0.00012345678901234567e-05," * 900, b"1e+0023,1e-00000000300,1.5e20e300," * 90)
    # Marks in a string, behind an escaped quote and behind an escaped backslash.
    yield from (b'["\\"' + b"[" * 8000 + b'"]', b'["\\"' + b"," * 40_000 + b'"]', b'["\\\\"' + b"," * 40_000)


@pytest.mark.parametrize("name", ["json", "bin"])
def test_the_guards_give_the_verdicts_of_the_python_ones(name: str) -> None:
    assert NATIVE is not None
    budgets = [
        BUDGET,
        replace(BUDGET, depth=5, containers=40, values=200, mixed_values=200),
    ]
    draw = random.Random(3)

    def verdict(check: Any, *args: Any) -> str:
        try:
            check(*args)
        except RsePfError as error:
            return f"{error.code}: {error.message}"
        return "passed"

    seen = set()
    for data in corpus():
        for text in (data, mutated(data, draw), mutated(data, draw)):
            for budget in budgets:
                if name == "json":
                    expected = verdict(check_json, text, budget)
                elif len(text) <= budget.containers and 6 * len(text) <= budget.mixed_values:
                    continue  # the Python guard leaves it to the decoder
                else:
                    expected = verdict(check_msgpack, text, budget)
                assert verdict(NativeReader(NATIVE, name, budget, None).check, text) == expected, text[:200]
                seen.add(expected[:24])
    assert len(seen) >= 4, seen


def deflated(text: bytes, draw: random.Random) -> bytes:
    stream = zlib.compressobj(
        draw.randrange(10), zlib.DEFLATED, draw.choice((9, 12, 15)), draw.randint(1, 9), draw.randrange(5)
    )
    half = draw.randrange(len(text) + 1)
    mode = draw.choice((zlib.Z_NO_FLUSH, zlib.Z_SYNC_FLUSH, zlib.Z_FULL_FLUSH, zlib.Z_PARTIAL_FLUSH))
    return stream.compress(text[:half]) + stream.flush(mode) + stream.compress(text[half:]) + stream.flush()


def inflated(data: bytes, budget: Budget, *, native: bool) -> tuple[str, bytes]:
    assert NATIVE is not None
    try:
        if not native:
            return "read", bytes(inflate_within(data, budget))
        found = NativeReader(NATIVE, "zlib", budget, None).read(data)
        return ("unknown", b"") if found is None else ("read", bytes(found))  # type: ignore[arg-type]
    except RsePfError as error:
        return f"{error.code}: {error.message}", b""


def test_streams_are_inflated_or_refused_as_by_zlib() -> None:
    draw = random.Random(2)
    # Nothing here exceeds a count, so that only inflating is judged.
    limits = SessionSettings(max_message_bytes=2048, max_inflated_bytes=9000)
    budget = replace(Budget.of_messages(limits), inflate_ratio=5.0)
    texts = [
        b"",
        b"0",
        b"1" * 3000,
        draw.randbytes(500),
        sample("json", 40),
        b"12.5,-3.25," * 300,
        b"ab" * 4000,
    ]
    seen = set()
    for number in range(4000):
        data = deflated(texts[number % len(texts)], draw)
        if number % 2:
            data = mutated(data, draw)
        expected, got = inflated(data, budget, native=False), inflated(data, budget, native=True)
        if got[0] != "unknown":
            assert got == expected, data.hex()
        seen.add(expected[0][:30])
    assert len(seen) >= 4, seen


def bytes_of_bits(bits: str) -> bytes:
    bits += "0" * (-len(bits) % 8)
    return bytes(int(bits[at : at + 8][::-1], 2) for at in range(0, len(bits), 8))


def number(value: int, bits: int) -> str:
    """Return *value* as a field of a deflate block, lowest bit first."""
    return "".join(str(value >> bit & 1) for bit in range(bits))


def dynamic(literals: int, distances: int, used: tuple[int, ...], lengths: str) -> str:
    """Return a last block with codes for *literals* and *distances*; the *used* length codes have one bit."""
    own = "".join("100" if symbol in used else "000" for symbol in ORDER_OF_LENGTHS[:18])
    return "1" + "01" + number(literals - 257, 5) + number(distances - 1, 5) + number(14, 4) + own + lengths


# With the fixed codes of RFC 1951, Sect. 3.2.6, and with codes of their own.
BLOCKS = {
    "a match": "1" + "10" + "10010001" + "0000001" + "00000" + "0000000",
    "a block of no kind": "1" + "11",
    "a stored block whose sizes differ": "1"
    + "00"
    + "00000"
    + number(1, 16)
    + number(0xFFFF, 16)
    + number(7, 8),
    "a length that is not defined": "1" + "10" + "10010001" + "11000110" + "00000" + "0000000",
    "a distance that is not defined": "1" + "10" + "10010001" + "0000001" + "11110" + "0000000",
    "a distance before the beginning": "1" + "10" + "10010001" + "0000001" + "00001" + "0000000",
    "287 literals": dynamic(
        287, 1, (18, 1), "1" + number(127, 7) + "1" + number(107, 7) + "0" + "1" + number(18, 7) + "00"
    ),
    "31 distances": dynamic(
        257, 31, (18, 1), "1" + number(127, 7) + "1" + number(107, 7) + "00" + "1" + number(19, 7)
    ),
    "no end": dynamic(257, 1, (18, 1), "1" + number(127, 7) + "1" + number(108, 7) + "0"),
    "a repetition of nothing": dynamic(257, 1, (16, 1), "1" + "00" + "0" * 300),
    "a repetition past the end": dynamic(257, 1, (18, 1), 2 * ("1" + number(127, 7))),
    "three codes of one bit": dynamic(257, 1, (18, 1, 0), "0" * 300),
    "one code for the lengths": dynamic(257, 1, (1,), "0" * 300),
    "no code for the lengths": dynamic(257, 1, (), "0" * 300),
}


@pytest.mark.parametrize("block", BLOCKS)
def test_a_malformed_block_is_refused_as_by_zlib(block: str) -> None:
    data = b"\x78\x9c" + bytes_of_bits(BLOCKS[block])
    ends = (b"", b"\0" * 12, zlib.adler32(b"aaaa").to_bytes(4, "big"))
    for end in ends:
        expected = inflated(data + end, BUDGET, native=False)

        assert inflated(data + end, BUDGET, native=True) == expected
        assert (expected == ("read", b"aaaa")) == (block == "a match" and end == ends[2])


@pytest.mark.parametrize("first", [0x78, 0x38, 0x88, 0x79])
def test_a_short_stream_is_refused_as_by_zlib(first: int) -> None:
    """With a dictionary, too, whose name zlib reads before it refuses the stream."""
    for second in range(256):
        for size in range(7):
            data = (bytes([first, second]) + b"\x2c\x00\x97\x01\x02")[:size]

            assert inflated(data, BUDGET, native=True) == inflated(data, BUDGET, native=False), data


def test_a_stream_of_many_tiny_blocks_is_refused() -> None:
    # A block with codes of its own and nothing in it (RFC 1951, Sect. 3.2.7): 256 zeros, one bit for the end.
    lengths = "".join("100" if symbol in (18, 1) else "000" for symbol in ORDER_OF_LENGTHS[:18])
    block = "0" + "01" + "00000" + "00000" + "0111" + lengths + "1" + "1111111" + "1" + "1101011" + "00" + "0"
    for count in (70, 20_000):
        stream = b"\x78\x9c" + bytes_of_bits(block * count)

        with pytest.raises(LimitExceeded, match="tiny blocks"):
            make_codec("zlib").decode_from_robot(stream)


def test_the_blocks_of_the_smallest_encoder_are_no_tiny_ones() -> None:
    draw = random.Random(1)
    text = json.dumps({"type": "ping", "sent_s": 1.5, "more": [draw.random() for _ in range(9000)]}).encode()
    for strategy in (zlib.Z_DEFAULT_STRATEGY, zlib.Z_HUFFMAN_ONLY):
        stream = zlib.compressobj(1, zlib.DEFLATED, 9, 1, strategy)

        assert make_codec("zlib").decode_from_robot(stream.compress(text) + stream.flush())


@pytest.mark.parametrize("codec", CODECS)
def test_a_reply_to_a_typed_command_is_the_one_to_a_plain_command(codec: str) -> None:
    registry = builtin_services(PlatformSettings())
    replies = []
    for use_native in (False, True):
        wire = make_codec(codec, pnp=wire_types(registry), use_native=use_native)
        command = wire.decode_from_robot(sample(codec, 60))
        assert isinstance(command, Command)
        data = wire.encode(dispatch(registry, command, lambda: 0.0))
        replies.append(zlib.decompress(data) if codec == "zlib" else data)
        answer = wire.decode_from_server(data)
        assert isinstance(answer, Result), answer

    assert replies[0] == replies[1]


def test_every_byte_can_be_deflated() -> None:
    assert NATIVE is not None
    text = bytes(range(256)) * 5

    assert zlib.decompress(NATIVE.deflate(text)) == text
    assert zlib.decompress(NATIVE.deflate(b"")) == b""


def test_a_deflated_reply_is_no_longer_than_before() -> None:
    registry = builtin_services(PlatformSettings())
    wire, old = make_codec("zlib", pnp=wire_types(registry)), make_codec("zlib", use_native=False)
    command = wire.decode_from_robot(sample("zlib", 200))
    assert isinstance(command, Command)
    result = dispatch(registry, command, lambda: 0.0)

    assert len(wire.encode(result)) <= 1.05 * len(old.encode(result))


def test_a_server_with_a_pnp_of_its_own_gets_plain_payloads() -> None:
    registry = Registry()

    @registry.service("pnp")
    def pnp(request: OwnRequest) -> OwnReply:
        """Return the width."""
        return OwnReply(request.camera["width"])

    wire = make_codec("json", pnp=wire_types(registry))
    command = wire.decode_from_robot(sample("json"))

    assert isinstance(command, Command)
    assert isinstance(command.payload, dict)
    assert wire_types(Registry()) is None


@pytest.mark.parametrize("options", [{"kind": "per_robot_state"}, {"limited": True}])
def test_what_runs_in_another_process_gets_plain_payloads(options: dict[str, Any]) -> None:
    registry = Registry()

    @registry.service("pnp", **options)
    def pnp(request: PnpRequest) -> OwnReply:
        """Return the width."""
        return OwnReply(request.camera.width)

    assert wire_types(registry) is None


def test_a_file_that_is_no_library_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.so").write_bytes(b"no library")

    with pytest.raises(ConfigurationError, match="cannot be loaded"):
        open_codec(tmp_path / "x.so")


def test_json_dumps_of_a_robot_without_the_sdk_is_read_at_once() -> None:
    plain = json.dumps(json.loads(command_of("1,2.5,-3e-2")))

    assert is_fast("json", plain.encode())
    assert_alike("json", plain.encode())
