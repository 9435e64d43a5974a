"""The static files of the page, which are read once at the start; no other file is served."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["STATIC", "StaticFile", "page_files", "vendored"]

# Folder of the static files.
STATIC = Path(__file__).parent / "static"
# Media types of the files that are served, by suffix; files with other suffixes are not served.
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True, slots=True)
class StaticFile:
    """One file with its media type and its ETag, which is a hash of its content."""

    media_type: str
    data: bytes
    etag: str


def page_files() -> dict[str, StaticFile]:
    """Return the files of the page by URL path; ``/`` is ``index.html``."""
    files = {
        f"/{file.relative_to(STATIC).as_posix()}": _read(file)
        for file in sorted(STATIC.rglob("*"))
        if file.suffix in _TYPES
    }
    return {**files, "/": files["/index.html"]}


def vendored() -> list[Mapping[str, Any]]:
    """Return the third-party packages in the page: version, licence, and the digest of each file."""
    packages: list[Mapping[str, Any]] = json.loads((STATIC / "vendor" / "vendored.json").read_text("utf-8"))
    return packages


def _read(file: Path) -> StaticFile:
    data = file.read_bytes()
    return StaticFile(_TYPES[file.suffix], data, f'"{hashlib.sha256(data).hexdigest()[:32]}"')
