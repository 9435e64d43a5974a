"""The codecs of servers and of the Lambda: isal inflates and deflates short messages, simdjson parses JSON.

They read the messages of `rse_pf.wire.codec` in half of the time, but refuse a field of the message that is
there twice, and integers of more than 64 bits.
"""

from __future__ import annotations

from functools import partial
from typing import Any, get_args

import msgspec
import numpy as np

from rse_pf.budget import Budget, check_json_containers, check_json_counts
from rse_pf.config import SessionSettings
from rse_pf.errors import BadMessage, MissingExtra, RsePfError
from rse_pf.wire.codec import Codec, as_type, check_codec, decode_guarded, json_codec, make_codec
from rse_pf.wire.messages import Command, FromRobot

__all__ = ["PnpTypes", "make_server_codec"]

_COMMAND_FIELDS = frozenset(("type", *Command.__struct_fields__))
_KINDS: dict[Any, Any] = {kind.__struct_config__.tag: kind for kind in get_args(FromRobot)}

_HINT = "is this the sub-protocol that was agreed?"


class PnpTypes:
    """The request of the service `pnp`, which stands above this package.

    Attributes:
        request: Its type.
        arrays: The fields that hold arrays.
        objects: The other fields, with the fields of the objects that they hold.
        fields: All of them.
    """

    def __init__(self, request: type[Any], **objects: type[Any]) -> None:
        """Take the type of the *request*, and the types of its fields that are *objects*."""
        self.request = request
        self.fields = frozenset(request.__struct_fields__)
        self.objects = {name: frozenset(kind.__struct_fields__) for name, kind in objects.items()}
        self.arrays = self.fields.difference(objects)


def make_server_codec(
    name: str, limits: SessionSettings | None = None, *, pnp: PnpTypes | None = None
) -> Codec:
    """Return the codec called *name* of a server.

    Args:
        name: ``zlib``, ``json`` or ``bin``.
        limits: What is accepted from robots.
        pnp: The types of the platform's own service `pnp`, where it is offered: the payload of a command in
            JSON is decoded to its request at once, without an object for each number.

    Raises:
        UnsupportedProtocol: There is no such codec.
        MissingExtra: isal or pysimdjson is not installed.
    """
    check_codec(name)
    session = limits or SessionSettings()
    if name == "bin":
        return make_codec(name, session)
    try:
        from isal import isal_zlib
    except ImportError as error:
        raise MissingExtra("isal", "backend") from error
    reader = _JsonReader(Budget.of_messages(session), pnp)
    return json_codec(session, is_compressed=name == "zlib", zlib_library=isal_zlib, read=reader.read)


class _JsonReader:
    """Reads messages of robots."""

    def __init__(self, budget: Budget, pnp: PnpTypes | None) -> None:
        try:
            import simdjson
        except ImportError as error:
            raise MissingExtra("pysimdjson", "backend") from error
        self._budget, self._pnp = budget, pnp
        # One for each text: a parser keeps the memory of its longest text, and serves one thread at a time.
        self._new_parser = simdjson.Parser
        self._object, self._array = simdjson.Object, simdjson.Array

    def read(self, text: bytes | bytearray) -> FromRobot:
        """Return the message in *text*; raises BadMessage or LimitExceeded."""
        check_json_counts(text, self._budget)
        try:
            document = self._new_parser().parse(text)
            fields = self._pnp_fields(document, text) or self._fields(document, text)
        except (RuntimeError, ValueError) as error:  # RuntimeError: an integer of more than 64 bits
            check_json_containers(text, self._budget)
            raise BadMessage(f"not a message: {error}", hint=_HINT) from error
        name = fields.get("type")
        # Of a union, which an unknown type means, msgspec makes a new converter each time.
        kind = _KINDS.get(name, FromRobot) if isinstance(name, str) else FromRobot
        message: FromRobot = decode_guarded(partial(msgspec.convert, type=kind), fields)
        return message

    def _fields(self, document: Any, text: bytes | bytearray) -> dict[str, Any]:
        """Return the fields of any message."""
        check_json_containers(text, self._budget)
        if not isinstance(document, self._object):
            raise BadMessage("a message is not a JSON object", hint=_HINT)
        fields: dict[str, Any] = document.as_dict()
        if len(fields) < len(document):
            raise BadMessage("a message has a field twice", hint="compare it with docs/protocol.md")
        return fields

    def _pnp_fields(self, document: Any, text: bytes | bytearray) -> dict[str, Any] | None:
        """Return the fields of a `pnp` command, its payload as a request; None if it is not a plain one.

        In a plain one no field is unknown or repeated, no list is in a list, which simdjson would flatten,
        and the request is valid.
        """
        types = self._pnp
        if types is None or not isinstance(document, self._object) or document.get("service") != "pnp":
            return None
        payload = document.get("payload")
        if not isinstance(payload, self._object):
            return None
        names, parts = list(document), list(payload)
        are_known = _are_distinct(names, _COMMAND_FIELDS) and _are_distinct(parts, types.fields)
        if not are_known or text.count(b"[") != len(types.arrays.intersection(parts)):
            return None
        try:
            request = {name: self._plain(payload[name], name, types) for name in parts}
            fields = {name: document[name] for name in names if name != "payload"}
            return {**fields, "payload": as_type(request, types.request)}
        except (RsePfError, TypeError, ValueError):  # the service refuses the payload, and says why
            return None

    def _plain(self, value: Any, name: str, types: PnpTypes) -> Any:
        """Return a field of a request as plain values; raises TypeError or ValueError for another kind."""
        if isinstance(value, self._array):
            return np.frombuffer(value.as_buffer(of_type="d"))
        if not isinstance(value, self._object):
            return value
        plain = value.as_dict()
        if len(plain) < len(value) or not types.objects.get(name, frozenset()).issuperset(plain):
            raise ValueError(f"{name} is no object, or has unknown or repeated fields")
        return plain


def _are_distinct(names: list[str], known: frozenset[str]) -> bool:
    """Return whether all *names* are *known*, and none is there twice."""
    return len(set(names)) == len(names) and known.issuperset(names)
