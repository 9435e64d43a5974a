"""The data service's routes as data: what may be asked, by whom, and what comes back.

The dispatcher and the OpenAPI document both read this table, so neither can say what the other does not.
Promises no input and no output here; `rse_pf.data_server.handlers` does what a route names.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import msgspec

from rse_pf.data_server.http import HttpFailure
from rse_pf.maps.registry import MapRecord

__all__ = [
    "ROUTES",
    "Commit",
    "Field",
    "MapName",
    "MapPage",
    "MapVersionInfo",
    "MoveHead",
    "ObjectPage",
    "Route",
    "ServiceHealth",
    "StoredObject",
    "Upload",
    "UploadBegin",
]

BYTES = "application/octet-stream"


class StoredObject(msgspec.Struct, frozen=True, kw_only=True):
    """An object: its sha256 and its length."""

    digest: str
    size: int


class ObjectPage(msgspec.Struct, frozen=True, kw_only=True):
    """Objects of this robot, sorted by digest; ask again with ``after`` = *next* unless it is null."""

    objects: list[StoredObject]
    next: str | None = None


class UploadBegin(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An object that will come in parts."""

    size: int


class Direct(msgspec.Struct, frozen=True, kw_only=True):
    """Where all bytes may be PUT at once, with exactly these headers and no token, for a short time."""

    url: str
    headers: dict[str, str]
    life_s: int


class Upload(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An upload: it is done, and durable, when *offset* is *size*.

    Where *direct* is given the bytes may go straight to the bucket; begin the upload again afterwards.
    """

    digest: str
    size: int
    offset: int
    part_bytes: int
    direct: Direct | None = None


class MapName(msgspec.Struct, frozen=True, kw_only=True):
    """A map of this tenant."""

    name: str
    head: str


class MapPage(msgspec.Struct, frozen=True, kw_only=True):
    """All maps of this tenant."""

    maps: list[MapName]


class MapVersionInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A version of a map with its id."""

    id: str
    record: MapRecord


class Commit(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Make an uploaded object the next version; *parent* is the head as the robot knows it."""

    digest: str
    parent: str | None = None
    note: str = ""


class MoveHead(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Let the head name *version*, if it still names *expected*."""

    version: str
    expected: str


class ServiceHealth(msgspec.Struct, frozen=True, kw_only=True):
    """How the service is."""

    status: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """A header or query parameter."""

    name: str
    place: str
    doc: str
    whole_number: bool = False
    required: bool = False
    most: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """One thing that may be asked.

    *scope* None is open to all; *body* and *replies* hold a msgspec type, ``bytes``, or None for nothing.
    """

    operation: str
    method: str
    path: str
    doc: str
    scope: str | None
    replies: dict[int, Any]
    fields: tuple[Field, ...] = ()
    body: Any = None

    @property
    def pattern(self) -> re.Pattern[str]:
        """What a path must match as a whole; its groups are the parameters."""
        return re.compile(re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]*)", re.escape(self.path)))


_RANGE = Field(name="Range", place="header", doc="one range of bytes, as bytes=START-END")
_OFFSET = Field(
    name="Upload-Offset", place="header", doc="where this part begins", whole_number=True, required=True
)
_DIRECT = Field(
    name="X-Accept-Direct", place="header",
    doc="1: 307 with a signed address in Location will do, if the store has such", whole_number=True,
)  # fmt: skip
_AFTER = Field(name="after", place="query", doc="only objects behind this digest")
_LIMIT = Field(name="limit", place="query", doc="at most so many", whole_number=True, most=1000)

_BAD, _NOT_FOUND, _CONFLICT = {400: HttpFailure}, {404: HttpFailure}, {409: HttpFailure}
_STORING = {408: HttpFailure, 413: HttpFailure, 503: HttpFailure, 507: HttpFailure}
_OBJECT, _UPLOAD = "/data/v1/objects/{digest}", "/data/v1/uploads/{digest}"
_MAP, _VERSION = "/data/v1/maps/{name}/versions", "/data/v1/maps/{name}/versions/{version}"

ROUTES: tuple[Route, ...] = (
    Route(
        operation="healthz", method="GET", path="/data/healthz", scope=None,
        doc="Say that the process lives", replies={200: ServiceHealth},
    ),
    Route(
        operation="readyz", method="GET", path="/data/readyz", scope=None,
        doc="Say whether the store answers", replies={200: ServiceHealth, 503: HttpFailure},
    ),
    Route(
        operation="document", method="GET", path="/data/openapi.json", scope=None,
        doc="Return this document", replies={200: dict},
    ),
    Route(
        operation="list_objects", method="GET", path="/data/v1/objects", scope="data:read",
        doc="List this robot's objects", fields=(_AFTER, _LIMIT), replies={200: ObjectPage, **_BAD},
    ),
    Route(
        operation="get_object", method="GET", path=_OBJECT, scope="data:read", fields=(_RANGE, _DIRECT),
        doc="Return an object or one range of it",
        replies={200: bytes, 206: bytes, 307: None, 416: HttpFailure, **_NOT_FOUND},
    ),
    Route(
        operation="head_object", method="HEAD", path=_OBJECT, scope="data:read",
        doc="Return an object's size", replies={200: None, 404: None},
    ),
    Route(
        operation="put_object", method="PUT", path=_OBJECT, scope="data:write", body=bytes,
        doc="Store an object of at most data.part_bytes; 201 means it is durable, 200 it was there",
        replies={200: StoredObject, 201: StoredObject, **_BAD, **_NOT_FOUND, **_STORING},
    ),
    Route(
        operation="delete_object", method="DELETE", path=_OBJECT, scope="data:write",
        doc="Remove an object; a missing one is no error", replies={204: None, **_NOT_FOUND},
    ),
    Route(
        operation="begin_upload", method="PUT", path=_UPLOAD, scope="data:write", body=UploadBegin,
        doc="Begin an upload in parts, or learn how far it has come",
        replies={200: Upload, **_BAD, **_NOT_FOUND, **_CONFLICT, **_STORING},
    ),
    Route(
        operation="get_upload", method="GET", path=_UPLOAD, scope="data:write",
        doc="Learn how far an upload has come", replies={200: Upload, **_NOT_FOUND},
    ),
    Route(
        operation="head_upload", method="HEAD", path=_UPLOAD, scope="data:write",
        doc="Learn how far an upload has come, from the header Upload-Offset", replies={200: None, 404: None},
    ),
    Route(
        operation="append_part", method="PATCH", path=_UPLOAD, scope="data:write", fields=(_OFFSET,),
        body=bytes,
        doc="Add a part; 201 means that it was the last and the object is durable",
        replies={200: Upload, 201: Upload, **_BAD, **_NOT_FOUND, **_CONFLICT, **_STORING},
    ),
    Route(
        operation="abandon_upload", method="DELETE", path=_UPLOAD, scope="data:write",
        doc="Forget an upload and its parts", replies={204: None, **_NOT_FOUND},
    ),
    Route(
        operation="list_maps", method="GET", path="/data/v1/maps", scope="maps:read",
        doc="List the maps of this tenant", replies={200: MapPage},
    ),
    Route(
        operation="list_versions", method="GET", path=_MAP, scope="maps:read",
        doc="List the versions of a map, oldest first",
        replies={200: list[MapVersionInfo], **_BAD, **_NOT_FOUND},
    ),
    Route(
        operation="commit_version", method="POST", path=_MAP, scope="maps:write", body=Commit,
        doc="Make an uploaded object the next version and the head of a map",
        replies={201: MapVersionInfo, **_BAD, **_NOT_FOUND, **_CONFLICT, **_STORING},
    ),
    Route(
        operation="show_version", method="GET", path=_VERSION, scope="maps:read",
        doc="Return what is known of a version; head is the newest",
        replies={200: MapVersionInfo, **_BAD, **_NOT_FOUND},
    ),
    Route(
        operation="get_version", method="GET", path=_VERSION + "/content", scope="maps:read",
        fields=(_RANGE, _DIRECT), doc="Return the bytes of a version",
        replies={200: bytes, 206: bytes, 307: None, 416: HttpFailure, **_BAD, **_NOT_FOUND},
    ),
    Route(
        operation="move_head", method="PUT", path="/data/v1/maps/{name}/head", scope="maps:write",
        body=MoveHead,
        doc="Move the head to another version, as a rollback does",
        replies={200: MapVersionInfo, **_BAD, **_NOT_FOUND, **_CONFLICT, **_STORING},
    ),
)  # fmt: skip
"""Everything that may be asked."""
