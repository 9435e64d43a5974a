"""The parts of a batch job: their names, their encoding, and their results in the object store.

A part and its result are encoded as MessagePack with declared fields and arrays of known types, never
pickled.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import NotFound, StoreError
from rse_pf.storage.object_store import ObjectStore, digest_of

__all__ = [
    "PREFIX",
    "Part",
    "PartResult",
    "decode_part",
    "decode_result",
    "delete_parts",
    "encode_part",
    "encode_result",
    "is_done",
    "put_input",
    "read_result",
]

PREFIX = "batch"
"""First part of the names of all results and inputs in the store.

Robots cannot use names that begin with it.
"""
# Version of the computations; it must be raised when a part computes another result from the same inputs.
_COMPUTATION_VERSION = 1
# Types of arrays in results: the kind and size in bytes of numpy, and the stored byte order.
_ARRAY_TYPES = {"f8": "<f8", "f4": "<f4", "i8": "<i8", "u1": "|u1"}
Array = npt.NDArray[Any]


class Part(msgspec.Struct, frozen=True, kw_only=True):
    """One unit of work: the kind of its computation (a key of `part_kinds._KINDS`), inputs and arguments."""

    kind: str
    inputs: tuple[str, ...]
    """Names of objects in the store.

    An object never changes: its name is a hash of its content or computation.
    """
    arguments: dict[str, Any] = {}

    @property
    def name(self) -> str:
        """Return the name of the result in the store: the kind, and a hash of kind, inputs and arguments."""
        plain = msgspec.msgpack.encode(
            [_COMPUTATION_VERSION, self.kind, self.inputs, self.arguments], order="deterministic"
        )
        return f"{PREFIX}/parts/{self.kind}-{hashlib.sha256(plain).hexdigest()}"


@dataclass(frozen=True, slots=True, kw_only=True)
class PartResult:
    """The result of a part: arrays by name, and counts, such as those of rejected pairs by reason."""

    arrays: Mapping[str, Array] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)


class _Array(msgspec.Struct, frozen=True, array_like=True):
    type: str
    shape: tuple[int, ...]
    data: bytes


class _Result(msgspec.Struct, frozen=True, kw_only=True):
    arrays: dict[str, _Array]
    counts: dict[str, int]


encode_part: Callable[[Part], bytes] = msgspec.msgpack.Encoder().encode
decode_part: Callable[[bytes], Part] = msgspec.msgpack.Decoder(Part).decode


def encode_result(result: PartResult) -> bytes:
    """Return *result* as MessagePack; equal results give equal bytes."""
    arrays = {}
    for name, each in result.arrays.items():
        kind = f"{each.dtype.kind}{each.dtype.itemsize}"
        data = np.ascontiguousarray(each, dtype=_ARRAY_TYPES[kind]).tobytes()
        arrays[name] = _Array(kind, each.shape, data)
    return msgspec.msgpack.encode(_Result(arrays=arrays, counts=dict(result.counts)), order="deterministic")


def decode_result(name: str, data: bytes) -> PartResult:
    """Return the result in *data*, the content of the object *name*; raises StoreError if it is malformed."""
    try:
        plain = msgspec.msgpack.decode(data, type=_Result)
        arrays = {
            key: np.frombuffer(each.data, dtype=_ARRAY_TYPES[each.type]).reshape(each.shape)
            for key, each in plain.arrays.items()
        }
    except (msgspec.MsgspecError, KeyError, ValueError) as error:
        raise StoreError(f"{name!r} is no result of a part", hint="delete it, and run again") from error
    return PartResult(arrays=arrays, counts=plain.counts)


def put_input(store: ObjectStore, result: PartResult) -> str:
    """Store *result*, arrays that parts read as input, unless it is stored; return the object's name."""
    data = encode_result(result)
    name = f"{PREFIX}/inputs/{digest_of(data)}"
    if not _exists(store, name):
        store.put(name, data)
    return name


def read_result(store: ObjectStore, name: str) -> PartResult:
    """Return the result or input in the object *name*; raises NotFound, or StoreError if it is malformed."""
    return decode_result(name, store.get(name))


def is_done(store: ObjectStore, part: Part) -> bool:
    """Return whether the result of *part* is stored."""
    return _exists(store, part.name)


def delete_parts(store: ObjectStore, names: Sequence[str]) -> None:
    """Delete those of the objects *names* that are results or inputs of parts; other names are ignored."""
    for name in names:
        if name.startswith(f"{PREFIX}/"):
            store.delete(name)


def _exists(store: ObjectStore, name: str) -> bool:
    try:
        store.head(name)
    except NotFound:
        return False
    return True
