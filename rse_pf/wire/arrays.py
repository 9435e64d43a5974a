"""Numeric arrays inside messages: flat JSON lists, or raw little-endian bytes in MessagePack.

A field annotated ``Array`` is decoded to a flat float64 array, whatever the encoding was.  Only finite
numbers are accepted: no strings, no booleans, no nested lists.
"""

from __future__ import annotations

import math
import struct
import sys
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadMessage, BadRequest

__all__ = ["Array", "binary_encode_hook", "decode_hook", "extension_hook", "json_encode_hook", "reshaped"]

Array = np.ndarray
"""Annotation of an array field of a message; an array travels flat, in row-major order."""

# By type number of a MessagePack extension: the type of the array's elements.
_EXTENSIONS: dict[int, np.dtype[Any]] = {1: np.dtype("<f4"), 2: np.dtype("<u4"), 3: np.dtype("<f8")}
_F4 = 1  # extension of a float32 array
_U4 = 2  # extension of a uint32 array
_F8 = 3  # extension of a float64 array
_IS_LITTLE_ENDIAN = sys.byteorder == "little"
# The extension of each element type that needs no conversion on a little-endian machine.
_KINDS = {np.dtype(np.float32): _F4, np.dtype(np.uint32): _U4, np.dtype(np.float64): _F8}


def json_encode_hook(value: Any) -> Any:
    """Return a numeric array as a flat list for JSON; raises BadMessage for any other type."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        return value.tolist() if value.ndim == 1 else value.ravel().tolist()
    raise _unknown_type_error(value)


def binary_encode_hook(value: Any) -> Any:
    """Return a numeric array as a MessagePack extension; raises BadMessage for any other type.

    A float32 array stays float32, integers become uint32 if all of them fit, and all else becomes float64.
    """
    if isinstance(value, np.ndarray):
        kind = _KINDS.get(value.dtype)
        if kind is not None and _IS_LITTLE_ENDIAN:
            return msgspec.msgpack.Ext(kind, value.tobytes())
        if kind is None and value.dtype.kind in "fiu":
            kind = _U4 if _fits_uint32(value) else _F8
        if kind is not None:
            return msgspec.msgpack.Ext(kind, value.astype(_EXTENSIONS[kind], copy=False).tobytes())
    raise _unknown_type_error(value)


def extension_hook(kind: int, data: memoryview) -> npt.NDArray[Any]:
    """Return the array in the *data* of a MessagePack extension with the type number *kind*.

    Raises:
        BadMessage: The type number is unknown, or the data hold a part of a number.
    """
    dtype = _EXTENSIONS.get(kind)
    if dtype is None:
        raise BadMessage(
            f"MessagePack extension {kind} is unknown", hint="use 1 float32, 2 uint32 or 3 float64"
        )
    if len(data) % dtype.itemsize:
        raise BadMessage(
            f"{len(data)} bytes do not hold whole {dtype.itemsize}-byte numbers",
            hint="send the array's raw little-endian bytes",
        )
    return np.frombuffer(data, dtype)


def decode_hook(kind: type[Any], value: Any) -> Any:
    """Return *value*, the decoded field of a message with the annotation *kind*, as a flat float64 array.

    Raises:
        BadMessage: *kind* is not `Array`, or *value* is not an array or list of finite numbers.
    """
    if kind is not np.ndarray:
        raise BadMessage(f"{kind.__name__} cannot be encoded in a message")
    if type(value) is np.ndarray and value.dtype.kind in "fiu":
        is_flat = value.dtype == np.float64 and value.ndim == 1 and value.flags.carray
        array = value if is_flat else value.astype(np.float64).ravel()
    elif isinstance(value, list):
        array = _from_list(value)
    else:
        raise BadMessage(f"expected an array of numbers, got {type(value).__name__}", hint="send a flat list")
    # The sum of squares is finite only if every number is finite; vdot overflows without a warning.
    if not math.isfinite(np.vdot(array, array)):
        raise BadMessage(
            "an array holds a number that is not finite or out of range", hint="send finite numbers only"
        )
    return array


def reshaped(name: str, array: npt.NDArray[np.float64], columns: int) -> npt.NDArray[np.float64]:
    """Return a flat *array* as ``(n, columns)``.

    Raises:
        BadRequest: The length is not a multiple of *columns*.
    """
    if array.size % columns:
        raise BadRequest(
            f"{name} has {array.size} numbers, which is not a multiple of {columns}",
            hint=f"send {columns} numbers for each row",
        )
    return array.reshape(-1, columns)


def _from_list(numbers: list[Any]) -> npt.NDArray[np.float64]:
    """Return a list of numbers as a float64 array; raises BadMessage for strings, booleans and lists in it.

    The two loops over the list are in C, which is faster than numpy's conversion with a check of types.
    """
    try:
        floats = msgspec.convert(numbers, list[float])
    except msgspec.ValidationError as error:
        raise BadMessage(
            f"an array holds values that are not numbers: {error}", hint="send a flat list"
        ) from error
    buffer = bytearray(8 * len(floats))
    struct.pack_into(f"{len(floats)}d", buffer, 0, *floats)
    return np.frombuffer(buffer, np.float64)


def _fits_uint32(value: npt.NDArray[Any]) -> bool:
    return value.dtype.kind != "f" and value.min(initial=0) >= 0 and bool(value.max(initial=0) < 2**32)


def _unknown_type_error(value: Any) -> BadMessage:
    return BadMessage(f"{type(value).__name__} cannot be encoded in a message")
