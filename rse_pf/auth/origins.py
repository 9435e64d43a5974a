"""Decide which web pages may use the platform, by the header ``Origin`` that browsers send.

Only browsers send this header, and no script of a web page can change it.  A request needs a valid token
nevertheless.
"""

from __future__ import annotations

import re

from rse_pf.errors import Forbidden

__all__ = ["CARRIER_PREFIX", "ORIGIN_HINT", "AllowedOrigins", "carried_token"]

CARRIER_PREFIX = "rse-pf.token."
"""Beginning of a WebSocket sub-protocol that carries a robot's token; for clients such as web pages, which
cannot set the header Authorization."""
ORIGIN_HINT = "add the origin to serving.allowed_origins"
# An origin of HTTP; the group is its host with port.
_WEB = re.compile(r"https?://(.+)")


class AllowedOrigins:
    """The allowed origins: those of ``serving.allowed_origins``, and that of the platform itself."""

    __slots__ = ("_listed",)

    def __init__(self, listed: str) -> None:
        self._listed = frozenset(listed.lower().split())

    def allows(self, origin: str, host: str) -> bool:
        """Return whether a request with the headers ``Origin`` and ``Host`` is allowed.

        Args:
            origin: Value of ``Origin``.  "" (absent) is allowed, because no web page sent the request.
            host: Value of ``Host``, "" if absent.  An origin with the same host is allowed, because the page
                was loaded from the platform itself.
        """
        if not origin:
            return True
        origin = origin.lower()
        own = _WEB.fullmatch(origin)
        return origin in self._listed or (own is not None and own[1] == host.lower())

    def check(self, origin: str, host: str) -> None:
        """Raise Forbidden if `allows` does not allow a request with these values of the two headers."""
        if not self.allows(origin, host):
            raise Forbidden("web pages of this origin are not allowed", hint=ORIGIN_HINT)


def carried_token(authorization: str, offered: list[str]) -> str:
    """Return the token of a WebSocket handshake, "" if there is none.

    Args:
        authorization: Value of the header ``Authorization``, "" if absent.  If it is not empty, *offered* is
            ignored; with another scheme than Bearer there is no token.
        offered: The offered sub-protocols; the first one that begins with `CARRIER_PREFIX` carries the token.
    """
    if authorization:
        scheme, _, token = authorization.partition(" ")
        return token.strip() if scheme.lower() == "bearer" else ""
    carriers = (subprotocol for subprotocol in offered if subprotocol.startswith(CARRIER_PREFIX))
    return next(carriers, CARRIER_PREFIX)[len(CARRIER_PREFIX) :]
