"""The body of the HTTP reply of a server that refuses a WebSocket handshake, as a robot reads it.

Firewalls, load balancers and login pages answer with 401 and 403, too.  A robot recognises the reply of our
servers by the member ``platform``, so that it does not take another reply for a refusal of its token.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

__all__ = ["CUT_OFF", "PLATFORM", "RefusedHandshake", "refusal_body", "refusal_in"]

PLATFORM = "rse-pf"
"""Value of the member ``platform`` in the body of each refusal."""
CUT_OFF = "cut-off"
"""Value of the member ``cause`` if the token was issued before the cut-off that an operator set: the time
from which tokens of its robot are accepted."""
_MAX_BODY_BYTES = 4096  # a longer body is not that of one of our servers
_MAX_TEXT_CHARACTERS = 300  # most characters of a message or a hint that are shown to a user
_MAX_UNIX_S = 1e11  # Unix times from here on, after the year 5000, are ignored


@dataclass(frozen=True, slots=True, kw_only=True)
class RefusedHandshake:
    """Why a server refused a handshake.

    ``cause`` is empty unless the token was signed with the key of an enrolled robot.  ``valid_from_s`` is the
    cut-off from which tokens of the robot are accepted, in Unix seconds of the server; None without one.
    """

    message: str
    hint: str
    cause: str = ""
    valid_from_s: float | None = None


def refusal_body(code: str, message: str, hint: str, **members: Any) -> bytes:
    """Return the JSON body of a refusal.

    *members*, such as ``cause``, are added for a robot whose token was signed with an enrolled key.
    """
    body = {"platform": PLATFORM, "code": code, "message": message, "hint": hint, **members}
    return json.dumps(body, separators=(",", ":")).encode()


def refusal_in(body: bytes, code: str) -> RefusedHandshake | None:
    """Return the refusal in the *body* of an HTTP reply, if one of our servers sent it with this *code*.

    None for any other body.  Texts that are not printable, and implausible times, are left out.
    """
    if len(body) > _MAX_BODY_BYTES:
        return None
    try:
        members = json.loads(body)
    except (ValueError, RecursionError):
        return None
    if not isinstance(members, dict) or members.get("platform") != PLATFORM or members.get("code") != code:
        return None
    return RefusedHandshake(
        message=_text(members.get("message")),
        hint=_text(members.get("hint")),
        cause=_text(members.get("cause")),
        valid_from_s=_unix_s(members.get("valid_from_s")),
    )


def _text(value: object) -> str:
    text = value[:_MAX_TEXT_CHARACTERS] if isinstance(value, str) else ""
    return text if text.isprintable() else ""


def _unix_s(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < _MAX_UNIX_S:
        return None
    return float(value)
