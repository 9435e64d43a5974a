"""Parts of a batch job: their names, their results as bytes, and which of them are done.

Nothing here is pickled: a part and its result are MessagePack with declared fields and arrays of known types.
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
"""Of the names of parts and inputs in the store; no robot can name an object below it."""
_FORMAT = 1
"""Changes when a part computes something else from the same inputs."""
_TYPES = {"f8": "<f8", "f4": "<f4", "i8": "<i8", "u1": "|u1"}
Array = npt.NDArray[Any]


class Part(msgspec.Struct, frozen=True, kw_only=True):
    """One unit of work: what is computed, from which objects, with which arguments."""

    kind: str
    inputs: tuple[str, ...]
    """Names of objects in the store, all of them named by their contents or by how they were computed."""
    arguments: dict[str, Any] = {}

    @property
    def name(self) -> str:
        """Return the name of the result in the store."""
        plain = msgspec.msgpack.encode(
            [_FORMAT, self.kind, self.inputs, self.arguments], order="deterministic"
        )
        return f"{PREFIX}/parts/{self.kind}-{hashlib.sha256(plain).hexdigest()}"


@dataclass(frozen=True, slots=True, kw_only=True)
class PartResult:
    """Arrays by name, and how often something happened by its reason."""

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
    """Return *result* as bytes; the same result gives the same bytes."""
    arrays = {}
    for name, each in result.arrays.items():
        kind = f"{each.dtype.kind}{each.dtype.itemsize}"
        data = np.ascontiguousarray(each, dtype=_TYPES[kind]).tobytes()
        arrays[name] = _Array(kind, each.shape, data)
    return msgspec.msgpack.encode(_Result(arrays=arrays, counts=dict(result.counts)), order="deterministic")


def decode_result(name: str, data: bytes) -> PartResult:
    """Return the result in *data*, the object *name*; raises StoreError."""
    try:
        plain = msgspec.msgpack.decode(data, type=_Result)
        arrays = {
            key: np.frombuffer(each.data, dtype=_TYPES[each.type]).reshape(each.shape)
            for key, each in plain.arrays.items()
        }
    except (msgspec.MsgspecError, KeyError, ValueError) as error:
        raise StoreError(f"{name!r} is no result of a part", hint="delete it, and run again") from error
    return PartResult(arrays=arrays, counts=plain.counts)


def put_input(store: ObjectStore, result: PartResult) -> str:
    """Store arrays that parts read, under their digest; return the name."""
    data = encode_result(result)
    name = f"{PREFIX}/inputs/{digest_of(data)}"
    if not _exists(store, name):
        store.put(name, data)
    return name


def read_result(store: ObjectStore, name: str) -> PartResult:
    """Return the result or input *name*; raises NotFound or StoreError."""
    return decode_result(name, store.get(name))


def is_done(store: ObjectStore, part: Part) -> bool:
    """Return whether the result of *part* is stored."""
    return _exists(store, part.name)


def delete_parts(store: ObjectStore, names: Sequence[str]) -> None:
    """Delete results and inputs that are no longer needed."""
    for name in names:
        if name.startswith(f"{PREFIX}/"):
            store.delete(name)


def _exists(store: ObjectStore, name: str) -> bool:
    try:
        store.head(name)
    except NotFound:
        return False
    return True
