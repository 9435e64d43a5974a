"""A prepared payload is the same message to the server."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from rse_pf.errors import BadMessage
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import PnpRequest, make_request
from rse_pf.wire import CODECS, Command, as_type, make_codec
from rse_pf.wire.preencoded import encode_command, preencode


def request(codec: str) -> PnpRequest:
    problem = make_problem(seed=3)
    return make_request(problem.points_world, problem.pixels, problem.camera, binary=codec == "bin")


def command(payload: object) -> Command:
    return Command(
        id=2**40, service="pnp", payload=payload, stream="pose", seq=9, keep=True, deadline_ms=5.5, trace="ü"
    )


@pytest.mark.parametrize("name", CODECS)
def test_the_server_decodes_the_same_command_as_if_it_had_been_encoded_whole(name: str) -> None:
    codec, payload = make_codec(name), request(name)

    got = codec.decode_from_robot(encode_command(codec, command(preencode(codec, payload))))
    whole = codec.decode_from_robot(codec.encode(command(payload)))

    assert isinstance(got, Command)
    assert isinstance(whole, Command)
    assert msgspec.structs.replace(got, payload=None) == msgspec.structs.replace(whole, payload=None)
    mine, theirs = as_type(got.payload, PnpRequest), as_type(whole.payload, PnpRequest)
    np.testing.assert_array_equal(mine.points_world, theirs.points_world)
    np.testing.assert_array_equal(mine.pixels, theirs.pixels)


@pytest.mark.parametrize("name", CODECS)
def test_a_preencoded_message_is_at_most_two_percent_longer(name: str) -> None:
    codec, payload = make_codec(name), request(name)
    prepared = encode_command(codec, command(preencode(codec, payload)))
    assert len(prepared) <= 1.02 * len(codec.encode(command(payload)))


def test_a_payload_of_another_codec_is_refused() -> None:
    zlib = make_codec("zlib")
    with pytest.raises(BadMessage, match="encoded for bin"):
        encode_command(zlib, command(preencode(make_codec("bin"), {"value": 1})))
