"""Read the unverified names in a refused token: for logs only, never for a decision.

Anybody can write any name into a token.  Each value has a bounded length; logs escape it.
"""

from __future__ import annotations

import base64
import contextlib
import re
from typing import Any, TypeVar

import msgspec

from rse_pf.auth.roster import ROBOT_KEY
from rse_pf.auth.tokens import KeySet

__all__ = ["claimed_by", "source_address"]

_MAX_TOKEN = 8192  # characters of a token that are read
_MAX_CLAIM = 64  # characters of each returned value
# An IPv4 or IPv6 address, the latter perhaps in brackets with a port.
_ADDRESS = re.compile(r"[0-9a-fA-F.:]{2,45}|\[[0-9a-fA-F.:]{2,45}\]:\d{1,5}")


_T = TypeVar("_T", bound=msgspec.Struct)


class _Header(msgspec.Struct):
    """The header of a token that was not verified."""

    kid: Any = None


class _Claimed(msgspec.Struct):
    """The claims of a token that was not verified; their values may have any type."""

    sub: Any = None
    tenant: Any = None
    jti: Any = None


def claimed_by(token: str, keys: KeySet | None = None) -> dict[str, str]:
    """Return the names in the unverified *token* as fields for a log; no fields if it is malformed.

    The fields are ``claimed_robot``, ``claimed_tenant``, ``claimed_token`` (the token's id) and, if the token
    names a robot's own key, ``claimed_key``.  A value that the token lacks is left out.  For a robot's own
    key the tenant is that of the key in the roster; it is left out if the key is not enrolled.

    Args:
        token: The token of a request.
        keys: The key set with the roster; None if the server has none.
    """
    parts = token[:_MAX_TOKEN].split(".")
    if len(parts) != 3:
        return {}
    key_id, claimed = _decode(parts[0], _Header).kid, _decode(parts[1], _Claimed)
    tenant, robot_key = claimed.tenant, None
    if isinstance(key_id, str) and key_id.startswith(ROBOT_KEY):
        enrolled = None if keys is None else keys.robot_of(key_id)
        tenant, robot_key = None if enrolled is None else enrolled.tenant, key_id
    claims = {
        "claimed_robot": claimed.sub,
        "claimed_tenant": tenant,
        "claimed_token": claimed.jti,
        "claimed_key": robot_key,
    }
    return {name: value[:_MAX_CLAIM] for name, value in claims.items() if isinstance(value, str) and value}


def _decode(part: str, kind: type[_T]) -> _T:
    """Return a *part* of a token decoded as *kind*; with all members None if the part is malformed."""
    with contextlib.suppress(ValueError, msgspec.MsgspecError, RecursionError):
        return msgspec.json.decode(base64.urlsafe_b64decode(part + "=="), type=kind)
    return kind()


def source_address(peer: str, forwarded_for: str, trusted_proxies: int) -> str:
    """Return the address of the client that sent a request.

    Args:
        peer: Address of the other end of the TCP connection, returned if the headers hold no client address.
        forwarded_for: The ``x-forwarded-for`` headers, joined by commas.  Each trusted proxy appends one
            entry; earlier entries may be forged and are ignored.
        trusted_proxies: Number of proxies between clients and this server that append an entry.
    """
    entries = [entry.strip() for entry in forwarded_for.split(",") if entry.strip()]
    address = entries[-trusted_proxies] if 0 < trusted_proxies <= len(entries) else peer
    return address if _ADDRESS.fullmatch(address) else peer
