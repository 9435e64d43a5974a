"""The runtime of services in C and C++: load a shared library and call it by ``include/rse_pf_service.h``.

The version of the interface is compared before any other call.  Memory that the library passes out is copied,
and given back at once.  What the library claims about that memory (sizes, types, shapes) is checked before it
is read.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rse_pf.errors import (
    BadRequest,
    CommandFailed,
    ConfigurationError,
    DegenerateGeometry,
    InternalError,
    RsePfError,
)
from rse_pf.services.custom.installed import InstalledService
from rse_pf.wire.arrays import json_encode_hook

__all__ = ["INCLUDE_FOLDER", "CppRuntime"]

INCLUDE_FOLDER = Path(__file__).parent / "include"
"""Folder of the C interface ``rse_pf_service.h`` and the C++ layer ``rse_pf_service.hpp``."""

_ABI = 1  # RSE_PF_SERVICE_ABI, the version of the C interface
_FLOAT64 = 1  # RSE_PF_FLOAT64, the type of a field that holds an array of doubles
_TEXT = 2  # RSE_PF_TEXT, the type of a field that holds UTF-8
_MAX_RANK = 4  # most axes of an array, the size of ``shape`` in the C struct
# Most fields of a reply.  A larger count is a defect of the library and becomes InternalError: reading its
# fields could access memory that the library did not allocate.
_MAX_FIELDS = 1024
_MAX_BYTES = 1 << 28  # largest reply, snapshot or field in bytes: a larger one becomes InternalError
_ERRORS: dict[int, type[RsePfError]] = {1: BadRequest, 2: CommandFailed, 3: DegenerateGeometry}
"""Error of each code of ``enum rse_pf_status`` but success; any other code becomes CommandFailed."""


class _Field(ctypes.Structure):
    """The C struct ``rse_pf_field``."""

    _fields_ = (
        ("name", ctypes.c_char_p),
        ("type", ctypes.c_uint32),
        ("rank", ctypes.c_uint32),
        ("shape", ctypes.c_uint64 * _MAX_RANK),
        ("count", ctypes.c_uint64),
        ("data", ctypes.c_void_p),
    )


class CppRuntime:
    """A loaded library, and the state that its ``rse_pf_service_open`` passed out.

    ``rse_pf_service_close`` is never called: the state is released when the process of the sandbox exits.

    Attributes:
        has_snapshots: Whether the library exports ``rse_pf_service_snapshot`` and ``rse_pf_service_restore``.
    """

    def __init__(self, service: InstalledService, scratch: Path) -> None:
        """Load the library of *service* and open it with the private folder *scratch*.

        Raises:
            ConfigurationError: The library cannot be loaded, lacks a function, has another interface version,
                or fails to open.
        """
        self._name = service.name
        try:
            self._library = ctypes.CDLL(str(service.entry_path))
        except OSError as error:
            raise ConfigurationError(
                f"{service.name}: the library cannot be loaded: {error}",
                hint="build it on a system like the server's, and install what it links to",
            ) from error
        self._check_abi()
        self._call_arrays = self._find("rse_pf_service_call_arrays")
        self._call_bytes = self._find("rse_pf_service_call")
        if self._call_arrays is None and self._call_bytes is None:
            raise self._missing_export("rse_pf_service_call_arrays or rse_pf_service_call")
        self._free = self._require("rse_pf_service_free", result=None)
        self._error = self._find("rse_pf_service_error")
        if self._error is not None:
            self._error.restype = ctypes.c_char_p
        self._snapshot = self._find("rse_pf_service_snapshot")
        self._restore = self._find("rse_pf_service_restore")
        self.has_snapshots = self._snapshot is not None and self._restore is not None
        self._state = ctypes.c_void_p()
        code = self._require("rse_pf_service_open")(str(scratch).encode(), ctypes.byref(self._state))
        if code != 0:
            raise ConfigurationError(
                f"{service.name}: rse_pf_service_open returned {code}, not RSE_PF_OK (0)",
                hint="see enum rse_pf_status in rse_pf_service.h, and why this function of the service fails",
            )

    def call(self, payload: Any) -> Any:
        """Return the library's reply to *payload*.

        If the library exports ``rse_pf_service_call_arrays``, payload and reply are maps from names to
        numbers, arrays and texts; otherwise each is any JSON value.
        """
        return (
            self._call_with_bytes(payload) if self._call_arrays is None else self._call_with_arrays(payload)
        )

    def snapshot(self) -> bytes:
        """Return the state of the library as bytes; only for a library with ``has_snapshots``.

        Raises:
            RsePfError: The library returns an error code, or passes out a snapshot that is too large.
        """
        return self._read_bytes(self._snapshot, self._state)

    def restore(self, data: bytes) -> None:
        """Replace the state of the library by the snapshot *data*; only with ``has_snapshots``."""
        self._check(self._restore(self._state, data, ctypes.c_uint64(len(data))))

    def _call_with_bytes(self, payload: Any) -> Any:
        request = msgspec.json.encode(payload, enc_hook=json_encode_hook)
        reply = self._read_bytes(self._call_bytes, self._state, request, ctypes.c_uint64(len(request)))
        try:
            return msgspec.json.decode(reply)
        except msgspec.DecodeError as error:
            raise InternalError(
                f"service {self._name!r} replied with text that is not JSON: {error}",
                hint="pass JSON out of rse_pf_service_call, or use rse_pf_service_call_arrays",
            ) from error

    def _call_with_arrays(self, payload: Any) -> Any:
        request, buffers = _encode_fields(payload)
        reply, count = ctypes.POINTER(_Field)(), ctypes.c_uint32()
        code = self._call_arrays(
            self._state, request, ctypes.c_uint32(len(request)), ctypes.byref(reply), ctypes.byref(count)
        )
        del buffers  # They must live until here: the library reads the memory of the request.
        self._check(code)
        try:
            if count.value > _MAX_FIELDS or (count.value and not reply):
                raise InternalError(
                    f"service {self._name!r} replied with {count.value} fields{'' if reply else ' at NULL'}",
                    hint=f"pass out the address of the fields, not NULL, and at most {_MAX_FIELDS} fields",
                )
            return dict(_decode_field(reply[i], self._name) for i in range(count.value))
        finally:
            self._free(self._state, reply)

    def _read_bytes(self, function: Any, *arguments: Any) -> bytes:
        """Call a function that passes out bytes, give them back to the library, and return a copy of them.

        Raises:
            RsePfError: The function returns an error code.
            InternalError: The bytes are too many, or at NULL.
        """
        data, size = ctypes.POINTER(ctypes.c_uint8)(), ctypes.c_uint64()
        self._check(function(*arguments, ctypes.byref(data), ctypes.byref(size)))
        try:
            if size.value > _MAX_BYTES or (size.value and not data):
                what = "a snapshot" if function is self._snapshot else "a reply"
                raise InternalError(
                    f"service {self._name!r} passed out {what} of {size.value} bytes"
                    f"{'' if data else ' at NULL'}",
                    hint=f"set the data and its size together, at most {_MAX_BYTES} bytes",
                )
            return ctypes.string_at(data, size.value)
        finally:
            self._free(self._state, data)

    def _check(self, code: int) -> None:
        """Raise the error of a code of ``enum rse_pf_status``, with the text of the library; 0 is success."""
        if code == 0:
            return
        text = self._error(self._state) if self._error is not None else None
        reason = (text or b"").decode("utf-8", "replace")[:500]
        kind = _ERRORS.get(code, CommandFailed)
        raise kind(f"{self._name}: {reason or f'returned the code {code} without a text'}")

    def _check_abi(self) -> None:
        function = self._require("rse_pf_service_abi", result=ctypes.c_uint32)
        if (version := function()) != _ABI:
            raise ConfigurationError(
                f"{self._name} was built for interface {version}, this server has {_ABI}",
                hint="build it again with this version's rse_pf_service.h",
            )

    def _find(self, name: str) -> Any:
        return getattr(self._library, name, None)

    def _require(self, name: str, result: Any = ctypes.c_int) -> Any:
        function = self._find(name)
        if function is None:
            raise self._missing_export(name)
        function.restype = result
        return function

    def _missing_export(self, name: str) -> ConfigurationError:
        return ConfigurationError(
            f"{self._name}: the library does not export {name}", hint="see rse_pf_service.h"
        )


def _encode_fields(payload: Any) -> tuple[Any, list[Any]]:
    """Return *payload* as an array of C fields, and the buffers to which they point.

    The caller keeps the buffers as long as the fields are read.

    Raises:
        BadRequest: The payload is not an object, or a field is neither text nor finite numbers.
    """
    if not isinstance(payload, Mapping):
        raise BadRequest("the request is not an object of fields", hint='send {"name": value}')
    fields, buffers = (_Field * len(payload))(), []
    for field, (name, value) in zip(fields, payload.items(), strict=True):
        field.name = str(name).encode()
        if isinstance(value, str):
            data: Any = value.encode()
            field.type, field.count = _TEXT, len(data)
            field.data = ctypes.cast(ctypes.c_char_p(data), ctypes.c_void_p)
            buffers.append(data)
            continue
        array = _as_array(str(name), value)
        field.type, field.rank, field.count = _FLOAT64, array.ndim, array.size
        field.shape[: array.ndim] = array.shape
        field.data = array.ctypes.data
        buffers.append(array)
    return fields, buffers


def _as_array(name: str, value: Any) -> Any:
    try:
        array = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadRequest(
            f"field {name!r} is neither numbers nor text", hint="send a number, text, or lists of numbers"
        ) from error
    array = array.reshape(np.shape(value))  # ascontiguousarray turns a scalar into an array of one element.
    if array.ndim > _MAX_RANK or not np.isfinite(array).all():
        raise BadRequest(
            f"field {name!r} has more than {_MAX_RANK} axes, or a number that is not finite",
            hint=f"send finite numbers in lists that are nested at most {_MAX_RANK} levels deep",
        )
    return array


def _decode_field(field: Any, service: str) -> tuple[str, Any]:
    """Return name and value of a field of a reply: a text, a float, or a flat float64 array.

    One number of rank 0 becomes a float.  All other numbers become an array ``(count,)``: the shape in the C
    field must hold ``count`` numbers, but the robot does not receive it, since arrays are flat in messages.

    Raises:
        InternalError: The description of the field is invalid.
    """
    name = (field.name or b"").decode("utf-8", "replace")
    problem = _find_problem(field)
    if problem:
        raise InternalError(
            f"service {service!r} replied with a field {name!r} {problem}", hint="see rse_pf_service.h"
        )
    if field.type == _TEXT:
        return name, ctypes.string_at(field.data, field.count).decode("utf-8", "replace")
    values = np.frombuffer(ctypes.string_at(field.data, field.count * 8), np.float64)
    return name, float(values[0]) if field.rank == 0 and values.size == 1 else values


def _find_problem(field: Any) -> str:
    """Return what is wrong with the description of a field, an empty text if nothing is."""
    if field.name is None:
        return "without a name"
    if field.type not in (_FLOAT64, _TEXT):
        return f"of type {field.type}, not of RSE_PF_FLOAT64 or RSE_PF_TEXT"
    if field.count * (8 if field.type == _FLOAT64 else 1) > _MAX_BYTES:
        return f"of {field.count} values, which is too large"
    if field.count and not field.data:
        return f"of {field.count} values at NULL"
    if field.rank > _MAX_RANK:
        return f"of rank {field.rank}, above {_MAX_RANK}"
    if field.type == _FLOAT64 and field.rank and field.count != math.prod(field.shape[: field.rank]):
        return f"of {field.count} values, which its shape does not hold"
    return ""
