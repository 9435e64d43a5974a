"""What a refused request says about itself: for logs only, never for a decision.

Nothing here was verified: anybody can write any name into a token.  Each value is bounded; logs escape it.
"""

from __future__ import annotations

import base64
import re
from typing import Any

import msgspec

__all__ = ["claimed_by", "source_address"]

_MAX_TOKEN = 8192
_MAX_CLAIM = 64
_ADDRESS = re.compile(r"[0-9a-fA-F.:]{2,45}|\[[0-9a-fA-F.:]{2,45}\]:\d{1,5}")


class _Claimed(msgspec.Struct):
    """The claims of a token that nobody verified; they may be of any type."""

    sub: Any = None
    tenant: Any = None
    jti: Any = None


def claimed_by(token: str) -> dict[str, str]:
    """Return ``claimed_robot``, ``claimed_tenant`` and ``claimed_token``, as far as *token* names them."""
    try:
        _, payload, _ = token[:_MAX_TOKEN].split(".")
        claimed = msgspec.json.decode(base64.urlsafe_b64decode(payload + "=="), type=_Claimed)
    except (ValueError, msgspec.MsgspecError, RecursionError):
        return {}
    claims = {
        "claimed_robot": claimed.sub,
        "claimed_tenant": claimed.tenant,
        "claimed_token": claimed.jti,
    }
    return {name: value[:_MAX_CLAIM] for name, value in claims.items() if isinstance(value, str) and value}


def source_address(peer: str, forwarded_for: str, trusted_proxies: int) -> str:
    """Return the address that a request came from.

    Args:
        peer: The other end of the TCP connection.
        forwarded_for: The ``x-forwarded-for`` headers, joined; each trusted proxy appended one entry, and
            whatever stands before those may be a lie.  An entry that is no address is a lie, too.
        trusted_proxies: How many proxies stand in front.
    """
    entries = [entry.strip() for entry in forwarded_for.split(",") if entry.strip()]
    address = entries[-trusted_proxies] if 0 < trusted_proxies <= len(entries) else peer
    return address if _ADDRESS.fullmatch(address) else peer
