"""The OpenAPI document of the data service, made from its routes.

Promises to describe what the dispatcher does, because both read `rse_pf.data_server.routes`.
"""

from __future__ import annotations

import functools
import json
import re
from typing import Any

import msgspec

from rse_pf.data_server.http import HttpFailure
from rse_pf.data_server.routes import BYTES, ROUTES, Field, Route

__all__ = ["openapi", "openapi_page"]

_DIGEST = {"type": "string", "pattern": "^[0-9a-f]{64}$"}
_PATH_SCHEMAS: dict[str, dict[str, Any]] = {
    "digest": _DIGEST,
    "name": {"type": "string", "pattern": "^[a-z0-9][a-z0-9-]{0,63}$"},
    "version": {"type": "string", "pattern": "^(head|[0-9a-f]{6,64})$"},
}
_JSON = "application/json"
_WORDS = {
    307: "It is at the signed address in Location; ask there without the token",
    200: "Done", 201: "Stored durably", 204: "Done, nothing to say", 206: "A range", 400: "Not understood",
    401: "No valid token", 403: "The token's scopes do not allow this", 404: "Not there, or not yours",
    408: "The body was too slow", 409: "Changed meanwhile", 413: "Larger than a limit or the quota",
    416: "Outside of the object", 503: "Come again later", 507: "The disk is full; nothing was stored",
}  # fmt: skip


def openapi() -> dict[str, Any]:
    """Return the document as JSON values, OpenAPI 3.1."""
    types = {kind for route in ROUTES for kind in (route.body, *route.replies.values())} | {HttpFailure}
    structs = sorted((kind for kind in types if _is_struct(kind)), key=lambda kind: kind.__name__)
    listed = [kind for kind in types if kind not in (None, bytes, dict) and not _is_struct(kind)]
    _, components = msgspec.json.schema_components(
        [*structs, *listed], ref_template="#/components/schemas/{name}"
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
    """Return ``docs/openapi.json``."""
    return json.dumps(openapi(), indent=1, sort_keys=True) + "\n"


def _operation(route: Route) -> dict[str, Any]:
    replies = dict(route.replies)
    if route.scope is not None:
        failure = None if route.method == "HEAD" else HttpFailure
        replies |= {401: failure, 403: failure, 503: failure}
    made: dict[str, Any] = {
        "operationId": route.operation,
        "summary": route.doc,
        "responses": {
            str(status): _response(status, kind, route) for status, kind in sorted(replies.items())
        },
    }
    parameters = [_path_parameter(name) for name in re.findall(r"{(\w+)}", route.path)]
    parameters += [_parameter(field) for field in route.fields]
    if parameters:
        made["parameters"] = parameters
    if route.body is not None:
        made["requestBody"] = {"required": True, "content": _content(route.body)}
    if route.scope is not None:
        made["security"] = [{"robot": []}]
        made["description"] = f"Token scope `{route.scope}`; a token without scopes may do everything."
    return made


def _response(status: int, kind: Any, route: Route) -> dict[str, Any]:
    made: dict[str, Any] = {"description": _WORDS[status]}
    if kind is not None:
        made["content"] = _content(kind)
    if route.operation == "head_upload" and status == 200:
        made["headers"] = {"Upload-Offset": {"schema": {"type": "integer"}}}
    return made


def _content(kind: Any) -> dict[str, Any]:
    if kind is bytes:
        return {BYTES: {"schema": {"type": "string", "format": "binary"}}}
    if kind is dict:
        return {_JSON: {"schema": {"type": "object"}}}
    (schema,), _ = msgspec.json.schema_components([kind], ref_template="#/components/schemas/{name}")
    return {_JSON: {"schema": schema}}


def _path_parameter(name: str) -> dict[str, Any]:
    return {"name": name, "in": "path", "required": True, "schema": _PATH_SCHEMAS[name]}


def _parameter(field: Field) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "integer", "minimum": 0} if field.whole_number else {"type": "string"}
    if field.most is not None:
        schema |= {"minimum": 1, "maximum": field.most}
    return {
        "name": field.name, "in": field.place, "required": field.required, "description": field.doc,
        "schema": schema,
    }  # fmt: skip


def _is_struct(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, msgspec.Struct)
