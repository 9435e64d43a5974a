"""The HTTP interface of the data service: its routes, their JSON types, and its OpenAPI document.

The application and the OpenAPI document both read the table `ROUTES`, so they cannot disagree.  No request
is handled here; `rse_pf.data_server.handlers` has one method for each route.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.config.front_door import LOCALISE_PATH
from rse_pf.data_server.http import HttpFailure
from rse_pf.maps.photos import MapOutline, PhotoLocation
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
    "PresignedPut",
    "Route",
    "ServiceHealth",
    "StoredObject",
    "Upload",
    "UploadBegin",
    "openapi",
    "openapi_page",
]

BYTES = "application/octet-stream"


class StoredObject(msgspec.Struct, frozen=True, kw_only=True):
    """An object: its digest (sha256, hexadecimal) and its length in bytes."""

    digest: str
    size: int


class ObjectPage(msgspec.Struct, frozen=True, kw_only=True):
    """One page of this robot's objects, sorted by digest.

    The next page is requested with ``after`` = *next*; *next* is null on the last page.
    """

    objects: list[StoredObject]
    next: str | None = None


class UploadBegin(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The length in bytes of an object that will be sent in parts."""

    size: int


class PresignedPut(msgspec.Struct, frozen=True, kw_only=True):
    """A URL of the bucket for one PUT of the whole object, with exactly these headers and without a token.

    It is valid for *life_s* seconds.
    """

    url: str
    headers: dict[str, str]
    life_s: int


class Upload(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The state of an upload: the next part begins at byte *offset* and has at most *part_bytes* bytes.

    The object is stored durably when *offset* equals *size*.  If *direct* is there, the robot may instead PUT
    the object directly to the bucket, and then begins the upload again, which completes it.
    """

    digest: str
    size: int
    offset: int
    part_bytes: int
    direct: PresignedPut | None = None


class MapName(msgspec.Struct, frozen=True, kw_only=True):
    """A map of this tenant, with the id of its head, the current version."""

    name: str
    head: str


class MapPage(msgspec.Struct, frozen=True, kw_only=True):
    """All maps of this tenant, with their heads."""

    maps: list[MapName]


class MapVersionInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A version of a map: its id, which names it in paths, and its record."""

    id: str
    record: MapRecord


class Commit(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Make the uploaded object *digest* the next version of a map.

    *parent* is the id of the head that the robot last read, null for the first version.
    """

    digest: str
    parent: str | None = None
    note: str = ""


class MoveHead(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Move the head of a map to *version* if the head still is *expected*."""

    version: str
    expected: str


class Pruned(msgspec.Struct, frozen=True, kw_only=True):
    """The number of versions that were removed, and of bytes that no longer count against the quota."""

    removed: int
    freed_bytes: int


class ServiceHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The state of the service: ``ok`` or ``ready``."""

    status: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """A parameter of a request: *place* is ``header`` or ``query``, *doc* and *schema* describe its value."""

    name: str
    place: str
    doc: str
    required: bool = False
    schema: Mapping[str, Any] = field(default_factory=lambda: {"type": "string"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """One operation of the service.

    Attributes:
        operation: Name of the method of `Handlers` that handles it.
        scope: Scope that the token needs; None needs no token.
        replies: Type of the reply's body by status: a msgspec type, ``bytes``, or None for no body.
        fields: Headers and query parameters, besides the parameters of *path*.
        body: Type of the request's body, as in *replies*.
        cost: Number of tokens that a request takes from the bucket of its robot.
    """

    operation: str
    method: str
    path: str
    doc: str
    scope: str | None
    replies: dict[int, Any]
    fields: tuple[Field, ...] = ()
    body: Any = None
    cost: float = 1.0

    @property
    def pattern(self) -> re.Pattern[str]:
        """The pattern that the whole path of a request must match; its groups are the path parameters."""
        return re.compile(re.sub(r"\\{(\w+)\\}", r"(?P<\1>[^/]*)", re.escape(self.path)))


# Numbers of tokens that requests take from the bucket of their robot; all other requests take one.
PHOTO_COST = 10.0  # cost of localising a photo, which is decoded and matched
_LIST_COST = 5.0  # cost of a list, which reads many names of the store
_COMMIT_COST = 20.0  # cost of a commit or of pruning versions, which read whole maps or many records
_WHOLE_NUMBER = {"type": "integer", "minimum": 0}
_RANGE = Field(name="Range", place="header", doc="one range of bytes, as bytes=START-END")
_IF_RANGE = Field(name="If-Range", place="header", doc="the ETag for which the range holds; else all bytes")
_CONDITIONS = (
    Field(name="If-Match", place="header", doc="ETags, of which the object must have one, or *"),
    Field(name="If-None-Match", place="header", doc="ETags, of which the object must have none, or *"),
)
_OFFSET = Field(
    name="Upload-Offset", place="header", doc="where this part begins", schema=_WHOLE_NUMBER, required=True
)
_DIRECT = Field(
    name="X-Accept-Direct", place="header",
    doc="1: the answer may be 307 with a presigned URL in Location", schema=_WHOLE_NUMBER,
)  # fmt: skip
_AFTER = Field(name="after", place="query", doc="only objects with a greater digest")
_KEEP = Field(
    name="keep", place="query", doc="how many of the newest versions stay, besides the head", required=True,
    schema={"type": "integer", "minimum": 1},
)  # fmt: skip
_LIMIT = Field(
    name="limit",
    place="query",
    doc="maximum number of objects",
    schema={"type": "integer", "minimum": 1, "maximum": 1000},
)

_PIXELS = {"type": "number"}
_LENS_FIELDS = (
    *(
        Field(name=name, place="query", doc=f"{name} of the camera, px", required=True, schema=_PIXELS)
        for name in ("fx", "fy", "cx", "cy")
    ),
    *(
        Field(
            name=name, place="query", doc=f"{name} that fx fy cx cy are for, px (default: the photo's)",
            schema={"type": "integer", "minimum": 1},
        )
        for name in ("width", "height")
    ),
    Field(name="distortion", place="query", doc="k1,k2,p1,p2[,k3], or k1,k2,k3,k4 of a fisheye"),
    Field(name="model", place="query", doc="of the lens: radial-tangential (the default) or fisheye"),
)  # fmt: skip

# Replies by status that several routes share.
_FAILED_CONDITION = {412: HttpFailure}
_READ_REPLIES = {200: bytes, 206: bytes, 304: None, 307: None, 416: HttpFailure, **_FAILED_CONDITION}
_BAD_REQUEST, _NOT_FOUND, _CONFLICT = {400: HttpFailure}, {404: HttpFailure}, {409: HttpFailure}
_STORE_REPLIES = {408: HttpFailure, 413: HttpFailure, 503: HttpFailure, 507: HttpFailure}
_PROCESS_REPLIES = {408: HttpFailure, 413: HttpFailure, 503: HttpFailure}
_OBJECT, _UPLOAD = "/data/v1/objects/{digest}", "/data/v1/uploads/{digest}"
_MAP, _VERSION = "/data/v1/maps/{name}/versions", "/data/v1/maps/{name}/versions/{version}"

_LOCALISE = LOCALISE_PATH + "{name}"

ROUTES: tuple[Route, ...] = (
    Route(
        operation="healthz", method="GET", path="/data/healthz", scope=None,
        doc="Return 200 while the process is alive", replies={200: ServiceHealth},
    ),
    Route(
        operation="readyz", method="GET", path="/data/readyz", scope=None,
        doc="Return 200 while the store answers", replies={200: ServiceHealth, 503: HttpFailure},
    ),
    Route(
        operation="document", method="GET", path="/data/openapi.json", scope=None,
        doc="Return this document", replies={200: dict},
    ),
    Route(
        operation="list_objects", method="GET", path="/data/v1/objects", scope="data:read",
        cost=_LIST_COST,
        doc="List this robot's objects", fields=(_AFTER, _LIMIT), replies={200: ObjectPage, **_BAD_REQUEST},
    ),
    Route(
        operation="get_object", method="GET", path=_OBJECT, scope="data:read",
        fields=(_RANGE, _IF_RANGE, *_CONDITIONS, _DIRECT), doc="Return an object or one range of it",
        replies={**_READ_REPLIES, **_NOT_FOUND},
    ),
    Route(
        operation="head_object", method="HEAD", path=_OBJECT, scope="data:read",
        fields=_CONDITIONS, doc="Return an object's size",
        replies={200: None, 304: None, 404: None, 412: None},
    ),
    Route(
        operation="put_object", method="PUT", path=_OBJECT, scope="data:write", body=bytes,
        fields=_CONDITIONS,
        doc="Store an object of at most data.part_bytes; 201 means that it is durable, 200 that it existed",
        replies={
            200: StoredObject, 201: StoredObject, **_BAD_REQUEST, **_NOT_FOUND, **_FAILED_CONDITION,
            **_STORE_REPLIES,
        },
    ),
    Route(
        operation="delete_object", method="DELETE", path=_OBJECT, scope="data:write",
        fields=_CONDITIONS, doc="Remove an object; a missing one is no error",
        replies={204: None, **_NOT_FOUND, **_FAILED_CONDITION},
    ),
    Route(
        operation="begin_upload", method="PUT", path=_UPLOAD, scope="data:write", body=UploadBegin,
        doc="Begin an upload in parts, or return the state of the open one",
        replies={200: Upload, **_BAD_REQUEST, **_NOT_FOUND, **_CONFLICT, **_STORE_REPLIES},
    ),
    Route(
        operation="get_upload", method="GET", path=_UPLOAD, scope="data:write",
        doc="Return the state of an upload", replies={200: Upload, **_NOT_FOUND},
    ),
    Route(
        operation="head_upload", method="HEAD", path=_UPLOAD, scope="data:write",
        doc="Return the offset of an upload in the header Upload-Offset", replies={200: None, 404: None},
    ),
    Route(
        operation="append_part", method="PATCH", path=_UPLOAD, scope="data:write", fields=(_OFFSET,),
        body=bytes,
        doc="Add a part; 201 means that it was the last one and the object is durable",
        replies={200: Upload, 201: Upload, **_BAD_REQUEST, **_NOT_FOUND, **_CONFLICT, **_STORE_REPLIES},
    ),
    Route(
        operation="abandon_upload", method="DELETE", path=_UPLOAD, scope="data:write",
        doc="Remove an upload and its parts", replies={204: None, **_NOT_FOUND},
    ),
    Route(
        operation="list_maps", method="GET", path="/data/v1/maps", scope="maps:read",
        cost=_LIST_COST, doc="List the maps of this tenant", replies={200: MapPage},
    ),
    Route(
        operation="list_versions", method="GET", path=_MAP, scope="maps:read",
        cost=_LIST_COST, doc="List the versions of a map, oldest first",
        replies={200: list[MapVersionInfo], **_BAD_REQUEST, **_NOT_FOUND},
    ),
    Route(
        operation="commit_version", method="POST", path=_MAP, scope="maps:write", body=Commit,
        cost=_COMMIT_COST,
        doc="Make an uploaded object the next version and the head of a map",
        replies={201: MapVersionInfo, **_BAD_REQUEST, **_NOT_FOUND, **_CONFLICT, **_STORE_REPLIES},
    ),
    Route(
        operation="prune_versions", method="DELETE", path=_MAP, scope="maps:write", cost=_COMMIT_COST,
        fields=(_KEEP,), doc="Remove all but the newest versions of a map",
        replies={200: Pruned, **_BAD_REQUEST, **_NOT_FOUND, 503: HttpFailure},
    ),
    Route(
        operation="show_version", method="GET", path=_VERSION, scope="maps:read",
        doc="Return the record of a version; head is the newest one",
        replies={200: MapVersionInfo, **_BAD_REQUEST, **_NOT_FOUND},
    ),
    Route(
        operation="get_version", method="GET", path=_VERSION + "/content", scope="maps:read",
        fields=(_RANGE, _IF_RANGE, *_CONDITIONS, _DIRECT), doc="Return the bytes of a version",
        replies={**_READ_REPLIES, **_BAD_REQUEST, **_NOT_FOUND},
    ),
    Route(
        operation="move_head", method="PUT", path="/data/v1/maps/{name}/head", scope="maps:write",
        body=MoveHead,
        doc="Move the head to another version, as a rollback does",
        replies={200: MapVersionInfo, **_BAD_REQUEST, **_NOT_FOUND, **_CONFLICT, **_STORE_REPLIES},
    ),
    Route(
        operation="localise", method="POST", path=_LOCALISE, scope="maps:localise", body=bytes,
        cost=PHOTO_COST, fields=_LENS_FIELDS, doc="Return where a photo, JPEG or PNG, was taken in a map",
        replies={200: PhotoLocation, 501: HttpFailure, **_BAD_REQUEST, **_NOT_FOUND, **_PROCESS_REPLIES},
    ),
    Route(
        operation="outline", method="GET", path=_LOCALISE, scope="maps:localise", cost=PHOTO_COST,
        doc="Return a map as it is seen from above",
        replies={200: MapOutline, 501: HttpFailure, **_BAD_REQUEST, **_NOT_FOUND, **_PROCESS_REPLIES},
    ),
)  # fmt: skip
"""All routes; the method of `Handlers` with the name *operation* handles a route."""

# JSON schema of each path parameter.
_PATH_SCHEMAS: dict[str, dict[str, Any]] = {
    "digest": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
    "name": {"type": "string", "pattern": "^[a-z0-9][a-z0-9-]{0,63}$"},
    "version": {"type": "string", "pattern": "^(head|[0-9a-f]{6,64})$"},
}
_JSON = "application/json"
# The description of each HTTP status in the OpenAPI document.
_DESCRIPTIONS = {
    304: "The client has it: its ETag is in If-None-Match",
    412: "If-Match or If-None-Match does not hold; nothing was read or changed",
    307: "The object is at the presigned URL in Location; send no token there",
    200: "Done", 201: "Stored durably", 204: "Done, no content", 206: "The requested range",
    400: "Invalid request", 401: "No valid token", 403: "The token's scopes do not allow this",
    404: "Does not exist, or belongs to another robot", 408: "The body was too slow",
    409: "Changed by another request", 413: "Larger than a limit or the quota",
    416: "The range is outside of the object",
    429: "More requests than one robot may send; see Retry-After",
    501: "The server lacks a package that this needs", 503: "Unavailable; retry later",
    507: "The disk is full; nothing was stored",
}  # fmt: skip


def openapi() -> dict[str, Any]:
    """Return the OpenAPI 3.1 document of the service, as values that JSON can hold."""
    types = {kind for route in ROUTES for kind in (route.body, *route.replies.values())} - {None, bytes, dict}
    _, components = msgspec.json.schema_components(
        [HttpFailure, *sorted(types, key=str)], ref_template="#/components/schemas/{name}"
    )
    paths: dict[str, dict[str, Any]] = {}
    for route in ROUTES:
        paths.setdefault(route.path, {})[route.method.lower()] = _operation(route)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "RSE-PF data service",
            "version": "1",
            "description": "Images, keyframes, clouds and maps of robots, by HTTP (paper, Sect. 5.2).",
        },
        "paths": paths,
        "components": {
            "schemas": dict(sorted(components.items())),
            "securitySchemes": {"robot": {"type": "http", "scheme": "bearer", "bearerFormat": "JWT"}},
        },
    }


@functools.cache
def openapi_page() -> str:
    """Return the OpenAPI document as JSON text, as ``rse-pf data --openapi`` prints it."""
    return json.dumps(openapi(), indent=1, sort_keys=True) + "\n"


def _operation(route: Route) -> dict[str, Any]:
    replies = dict(route.replies)
    if route.scope is not None:
        failure = None if route.method == "HEAD" else HttpFailure
        replies |= {401: failure, 403: failure, 429: failure, 503: failure}
    document: dict[str, Any] = {
        "operationId": route.operation,
        "summary": route.doc,
        "responses": {
            str(status): _response(status, kind, route) for status, kind in sorted(replies.items())
        },
    }
    parameters = [
        {"name": name, "in": "path", "required": True, "schema": _PATH_SCHEMAS[name]}
        for name in re.findall(r"{(\w+)}", route.path)
    ]
    parameters += [
        {
            "name": field.name, "in": field.place, "required": field.required, "description": field.doc,
            "schema": field.schema,
        }
        for field in route.fields
    ]  # fmt: skip
    if parameters:
        document["parameters"] = parameters
    if route.body is not None:
        document["requestBody"] = {"required": True, "content": _content(route.body)}
    if route.scope is not None:
        document["security"] = [{"robot": []}]
        document["description"] = f"Token scope `{route.scope}`; a token without scopes may do everything."
    return document


def _response(status: int, kind: Any, route: Route) -> dict[str, Any]:
    document: dict[str, Any] = {"description": _DESCRIPTIONS[status]}
    if kind is not None:
        document["content"] = _content(kind)
    if route.operation == "head_upload" and status == 200:
        document["headers"] = {"Upload-Offset": {"schema": {"type": "integer"}}}
    return document


def _content(kind: Any) -> dict[str, Any]:
    if kind is bytes:
        return {BYTES: {"schema": {"type": "string", "format": "binary"}}}
    if kind is dict:
        return {_JSON: {"schema": {"type": "object"}}}
    (schema,), _ = msgspec.json.schema_components([kind], ref_template="#/components/schemas/{name}")
    return {_JSON: {"schema": schema}}
