"""Write ``docs/asyncapi.json``, the machine-readable protocol, from the message types.

Fields come from `rse_pf.wire.messages`, payloads from the registry of services, ports and paths from the
settings.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ROBOTS_PATH
from rse_pf.services.builtin import builtin_services
from rse_pf.wire import PROTOCOL_VERSION, SUBPROTOCOLS, FromRobot, FromServer

__all__ = ["asyncapi_document", "main"]

# Reference to a schema of the document by its name.
_REF = "#/components/schemas/{name}"


def asyncapi_document() -> dict[str, Any]:
    """Return the AsyncAPI 3.0 document of protocol version 1."""
    settings = PlatformSettings()
    services = list(builtin_services(settings))
    up, down = get_args(FromRobot), get_args(FromServer)
    payloads = [kind for service in services for kind in (service.request_type, service.reply_type)]
    _, schemas = msgspec.json.schema_components(
        [*up, *down, *payloads], schema_hook=_array_schema, ref_template=_REF
    )
    document = {
        "asyncapi": "3.0.0",
        "info": {
            "title": "RSE-PF robots and servers",
            "version": f"{PROTOCOL_VERSION}.0.0",
            "description": "docs/protocol.md says in words what this file says in schemas.",
            "license": {"name": "Apache-2.0"},
        },
        "defaultContentType": "application/json",
        "servers": {
            "local": {"host": f"127.0.0.1:{settings.local.port}", "protocol": "ws", "security": [_scheme()]}
        },
        "channels": {
            "robot": {
                "address": ROBOTS_PATH,
                "messages": {kind.__name__: _message_ref(kind) for kind in (*up, *down)},
                "bindings": {"ws": {"headers": _handshake()}},
            }
        },
        "operations": {
            "fromRobot": _operation("receive", up),
            "fromServer": _operation("send", down),
        },
        "components": {
            "messages": {
                kind.__name__: {
                    "summary": (kind.__doc__ or "").split("\n")[0],
                    "payload": {"$ref": _REF.format(name=kind.__name__)},
                }
                for kind in (*up, *down)
            },
            "schemas": schemas,
            "securitySchemes": {"robotToken": {"type": "http", "scheme": "bearer", "bearerFormat": "JWT"}},
        },
        "x-services": {
            service.name: {
                "summary": service.summary,
                "request": {"$ref": _REF.format(name=service.request_type.__name__)},
                "reply": {"$ref": _REF.format(name=service.reply_type.__name__)},
            }
            for service in services
        },
    }
    plain: dict[str, Any] = json.loads(json.dumps(document))
    return plain


def main() -> None:
    """Write ``docs/asyncapi.json``."""
    path = Path(__file__).resolve().parents[1] / "docs" / "asyncapi.json"
    path.write_text(json.dumps(asyncapi_document(), indent=1) + "\n", encoding="utf-8")


def _array_schema(kind: type[Any]) -> dict[str, Any]:
    if kind is not np.ndarray:
        raise NotImplementedError
    return {"type": "array", "items": {"type": "number"}, "description": "flat, row-major"}


def _message_ref(kind: type[Any]) -> dict[str, str]:
    return {"$ref": f"#/components/messages/{kind.__name__}"}


def _operation(action: str, kinds: tuple[type[Any], ...]) -> dict[str, Any]:
    messages = [{"$ref": f"#/channels/robot/messages/{kind.__name__}"} for kind in kinds]
    return {"action": action, "channel": {"$ref": "#/channels/robot"}, "messages": messages}


def _scheme() -> dict[str, str]:
    return {"$ref": "#/components/securitySchemes/robotToken"}


def _handshake() -> dict[str, Any]:
    return {
        "type": "object",
        "properties": {
            "Authorization": {"type": "string", "pattern": "^Bearer .+"},
            "Sec-WebSocket-Protocol": {"type": "string", "enum": list(SUBPROTOCOLS.values())},
        },
    }


if __name__ == "__main__":
    main()
