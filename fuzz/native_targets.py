"""The fuzz targets of the native codec: it says and answers what the Python codec does, bit by bit."""

from __future__ import annotations

import zlib
from typing import Any

import msgspec
import numpy as np

from fuzz.checks import expect
from fuzz.meter import Meter
from rse_pf.config import PlatformSettings
from rse_pf.errors import ProtocolError, RsePfError
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpRequest, wire_types
from rse_pf.wire import CODECS, Codec, Command, as_type, make_codec

__all__ = ["answer", "answered", "native", "outcome"]

_REGISTRY = builtin_services(PlatformSettings())
_TYPES = wire_types(_REGISTRY)
_PAIRS = {name: (make_codec(name, use_native=False), make_codec(name, pnp=_TYPES)) for name in CODECS}
_PLAIN = {name: make_codec(name, pnp=wire_types(_REGISTRY, stays_plain=True)) for name in CODECS}
_KINDS = ("bin", "json", "zlib", "zlib")
_ONLY_NATIVE = "a zlib stream of many tiny blocks"


def native(data: bytes, meter: Meter) -> None:
    """Compare both codecs; the first byte selects one, and the fourth choice deflates the rest."""
    if not data:
        return
    kind, body = data[0] % 4, data[1:]
    plain, fast = _PAIRS[_KINDS[kind]]
    body = zlib.compress(body, 1) if kind == 3 else body
    found = meter.call(lambda sent: outcome(fast, sent), body, ProtocolError)
    if _ONLY_NATIVE not in found:
        expect(found == outcome(plain, body), "the native codec and the Python one do not agree")


def answer(data: bytes, meter: Meter) -> None:
    """Compare the bytes of an answer of the native core with those of Python; kinds as in `native`."""
    if not data:
        return
    name, body = _KINDS[data[0] % 4], data[1:]
    body = zlib.compress(body, 1) if data[0] % 4 == 3 else body
    found = meter.call(lambda sent: answered(_PLAIN[name], sent, name), body, ProtocolError)
    if _ONLY_NATIVE not in found:
        expect(found == answered(_PAIRS[name][0], body, name), "the native answer is not that of Python")


def answered(codec: Codec, data: bytes, name: str) -> tuple[Any, ...]:
    """Return the bytes that answer *data* in the codec *name*, all times 0; an error if it is not decoded.

    Both are deflated by the native core, which is the only one that has the code of replies.
    """
    try:
        message = codec.decode_from_robot(data)
    except RsePfError as error:
        return ("refused", error.code, error.message, error.hint)
    if not isinstance(message, Command) or message.service != "pnp":
        return ("message",)
    reply = dispatch(_REGISTRY, message, lambda: 0.0, server="s-1")
    return ("answered", _PLAIN[name].encode(reply))


def outcome(codec: Codec, data: bytes) -> tuple[Any, ...]:
    """Return what became of *data*: an error, or the message, and the arrays of a `pnp` request as bytes."""
    try:
        message = codec.decode_from_robot(data)
        if not isinstance(message, Command) or message.service != "pnp":
            return ("message", repr(message))
        plain = repr(msgspec.structs.replace(message, payload=None))
        try:
            request = as_type({} if message.payload is None else message.payload, PnpRequest)
        except RsePfError as error:
            return ("request refused", plain, error.code, error.message, error.hint)
    except RsePfError as error:
        return ("refused", error.code, error.message, error.hint)
    depths = request.depths_m
    return (
        "read", plain, repr(request.camera), repr(request.options), request.points_world.tobytes(),
        request.pixels.tobytes(), depths.tobytes() if isinstance(depths, np.ndarray) else not depths,
    )  # fmt: skip
