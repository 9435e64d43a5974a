"""The files of the page, read once at the start; nothing else is ever served."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["STATIC", "StaticFile", "page_files", "vendored"]

STATIC = Path(__file__).parent / "static"
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True, slots=True)
class StaticFile:
    """One file as it is sent."""

    media_type: str
    data: bytes
    etag: str


def page_files() -> dict[str, StaticFile]:
    """Return the files of the page by path; ``/`` is its beginning."""
    files = {
        f"/{file.relative_to(STATIC).as_posix()}": _read(file)
        for file in sorted(STATIC.rglob("*"))
        if file.suffix in _TYPES
    }
    return {**files, "/": files["/index.html"]}


def vendored() -> list[Mapping[str, Any]]:
    """Return the packages of others that the page contains: version, licence, and the digest of each file."""
    packages: list[Mapping[str, Any]] = json.loads((STATIC / "vendor" / "vendored.json").read_text("utf-8"))
    return packages


def _read(file: Path) -> StaticFile:
    data = file.read_bytes()
    return StaticFile(_TYPES[file.suffix], data, f'"{hashlib.sha256(data).hexdigest()[:32]}"')
