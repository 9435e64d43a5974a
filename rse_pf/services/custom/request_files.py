"""Files of requests to a service: one recorded request as JSON, or many as JSON Lines under a head.

Text that a person can read and edit.  Arrays and bytes, which JSON lacks, are objects with a name that
begins with ``$``; numbers survive exactly.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.files import OWNER_ONLY, replace_file
from rse_pf.services.custom.recording import RecordedCall

__all__ = ["RequestFile", "from_json", "read_requests", "to_json", "write_requests"]

_FORMAT, _VERSION = "rse-pf-requests", 1
_ARRAY, _BYTES, _MAP = "$array", "$bytes", "$map"
_DTYPES = {"float32": np.float32, "float64": np.float64, "uint32": np.uint32}
_MAX_BYTES = 1 << 28
_HINT = "make one with: rse-pf service record NAME --out FILE"


@dataclass(frozen=True, slots=True, kw_only=True)
class RequestFile:
    """Requests in the order of the file.

    ``service`` is empty in a file of one request.  Each of ``calls`` has a name for a person and an object
    with ``request`` and perhaps ``reply``, ``failure`` and ``tolerance``.
    """

    service: str
    calls: Sequence[tuple[str, Mapping[str, Any]]]


def write_requests(path: Path, service: str, calls: Sequence[RecordedCall]) -> None:
    """Replace *path* by the recording of *service*; only its owner can read it.

    Raises:
        UsageError: It cannot be written.
    """
    lines: list[dict[str, Any]] = [
        {"format": _FORMAT, "version": _VERSION, "service": service, "requests": len(calls)}
    ]
    for call in calls:
        answer = {"reply": to_json(call.reply)} if call.failure is None else {"failure": call.failure}
        line = {"request": to_json(call.request), **answer, "compute_ms": round(call.compute_ms, 3)}
        lines.append(line | ({"secrets": call.secrets} if call.secrets else {}))
    try:
        replace_file(path, "".join(json.dumps(line) + "\n" for line in lines), mode=OWNER_ONLY)
    except OSError as error:
        raise UsageError(
            f"cannot write {path}: {error.strerror}", hint="name another file with --out"
        ) from error


def read_requests(path: Path) -> RequestFile:
    """Return the requests in *path*: a recording, or one recorded request.

    Raises:
        UsageError: It cannot be read, or is neither.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise UsageError(f"{path} is larger than {_MAX_BYTES >> 20} MiB", hint="record fewer requests")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint=_HINT) from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path} is not a file of requests: it is no text", hint=_HINT) from error
    first, _, rest = text.partition("\n")
    head = _object(first, path, 1, is_head=True)
    if head is None or head.get("format") != _FORMAT:
        return RequestFile(service="", calls=[(path.name, _call(_object(text, path, 0), path, 1))])
    if head.get("version") != _VERSION:
        raise UsageError(
            f"{path} is of version {head.get('version')}, this program reads {_VERSION}",
            hint="record it again",
        )
    lines = [(number, line) for number, line in enumerate(rest.splitlines(), 2) if line.strip()]
    calls = [
        (f"{path.name} number {count}", _call(_object(line, path, number), path, number))
        for count, (number, line) in enumerate(lines, 1)
    ]
    return RequestFile(service=str(head.get("service", "")), calls=calls)


def to_json(value: Any) -> Any:
    """Return *value* of a message as JSON can hold it; `from_json` undoes it."""
    if isinstance(value, np.ndarray):
        kind = value.dtype.name if value.dtype.name in _DTYPES else "float64"
        return {_ARRAY: kind, "values": value.astype(_DTYPES[kind]).ravel().tolist()}
    if isinstance(value, bytes | bytearray | memoryview):
        return {_BYTES: base64.b64encode(value).decode("ascii")}
    if isinstance(value, Mapping):
        if all(isinstance(key, str) for key in value) and not any(key.startswith("$") for key in value):
            return {key: to_json(each) for key, each in value.items()}
        return {_MAP: [[to_json(key), to_json(each)] for key, each in value.items()]}
    if isinstance(value, list | tuple):
        return [to_json(each) for each in value]
    return value


def from_json(value: Any) -> Any:
    """Return what `to_json` was given; raises ValueError, KeyError or TypeError for what it never returns."""
    if isinstance(value, list):
        return [from_json(each) for each in value]
    if not isinstance(value, dict):
        return value
    if _ARRAY in value:
        return np.array(value["values"], _DTYPES[value[_ARRAY]])
    if _BYTES in value:
        return base64.b64decode(value[_BYTES], validate=True)
    if _MAP in value:
        return {from_json(key): from_json(each) for key, each in value[_MAP]}
    return {key: from_json(each) for key, each in value.items()}


def _object(text: str, path: Path, number: int, *, is_head: bool = False) -> dict[str, Any] | None:
    """Return the object of one line (0: of the whole file); None for a head that is none."""
    where = f"{path}, line {number}" if number else str(path)
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        if is_head:
            return None
        raise UsageError(f"{where} is not JSON: {error}", hint=_HINT) from error
    return found if isinstance(found, dict) else None


def _call(found: dict[str, Any] | None, path: Path, number: int) -> dict[str, Any]:
    if found is None or "request" not in found:
        raise UsageError(
            f"{path}, line {number} holds no request", hint='write {"request": {...}, "reply": {...}}'
        )
    try:
        return {name: from_json(value) for name, value in found.items()}
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise UsageError(f"{path}, line {number} holds no request: {error!r}", hint=_HINT) from error
