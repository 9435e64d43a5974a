"""The HTTP reply of a server that refuses a handshake, and the member by which a robot recognises it.

Firewalls, load balancers and login pages answer with 401 and 403, too.  Without this member a robot would
take their replies for refusals of its token.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

__all__ = ["CUT_OFF", "PLATFORM", "RefusedHandshake", "refusal_body", "refusal_in"]

PLATFORM = "rse-pf"
"""Value of the member ``platform`` in the body of each refusal."""
CUT_OFF = "cut-off"
"""The cause of a token that was issued before the time from which those of its robot are accepted."""
_MAX_BODY_BYTES = 4096  # a longer body is none of ours
_MAX_TEXT_CHARACTERS = 300  # of the message and the hint, which are shown to a user
_MAX_UNIX_S = 1e11  # beyond the year 5000: no time of a cut-off


@dataclass(frozen=True, slots=True, kw_only=True)
class RefusedHandshake:
    """The reason of a server.

    ``cause`` is empty unless the token was signed with the key of an enrolled robot.  ``valid_from_s`` is the
    time from which tokens are accepted after a cut-off, in Unix seconds of the server.
    """

    message: str
    hint: str
    cause: str = ""
    valid_from_s: float | None = None


def refusal_body(code: str, message: str, hint: str, **members: Any) -> bytes:
    """Return the JSON body of a refusal; *members* are further members, for a robot that proved its key."""
    body = {"platform": PLATFORM, "code": code, "message": message, "hint": hint, **members}
    return json.dumps(body, separators=(",", ":")).encode()


def refusal_in(body: bytes, code: str) -> RefusedHandshake | None:
    """Return the refusal in *body* if it has this *code* and is of one of our servers, else None."""
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
