"""The HTTP answer of a server that refuses a handshake, and the mark by which a robot knows that it is ours.

Firewalls, load balancers and login pages answer with 401 and 403, too.  A robot that took theirs as final
would stay away for ever after a minute in which somebody else answered.
"""

from __future__ import annotations

import json

__all__ = ["PLATFORM", "is_refusal_of_ours", "refusal_body"]

PLATFORM = "rse-pf"
"""Value of the member ``platform`` in the body of each refusal."""
_MAX_BODY_BYTES = 4096


def refusal_body(code: str, message: str, hint: str) -> bytes:
    """Return the JSON body of a refusal."""
    told = {"platform": PLATFORM, "code": code, "message": message, "hint": hint}
    return json.dumps(told, separators=(",", ":")).encode()


def is_refusal_of_ours(body: bytes, code: str) -> bool:
    """Return whether *body* is the refusal *code* of one of our servers."""
    if len(body) > _MAX_BODY_BYTES:
        return False
    try:
        told = json.loads(body)
    except (ValueError, RecursionError):
        return False
    return isinstance(told, dict) and told.get("platform") == PLATFORM and told.get("code") == code
