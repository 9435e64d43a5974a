"""Decide which web pages may use the platform, by the header ``Origin`` that browsers send.

Only browsers send the header, and no script of a page can change it.  It does not replace a token.
"""

from __future__ import annotations

import re

from rse_pf.errors import Forbidden

__all__ = ["CARRIER_PREFIX", "ORIGIN_HINT", "AllowedOrigins", "carried_token"]

CARRIER_PREFIX = "rse-pf.token."
"""A sub-protocol with this beginning carries the token of a robot that cannot set a header."""
ORIGIN_HINT = "add the origin to serving.allowed_origins"
_WEB = re.compile(r"https?://(.+)")


class AllowedOrigins:
    """The origins of ``serving.allowed_origins``, and the platform's own."""

    __slots__ = ("_listed",)

    def __init__(self, listed: str) -> None:
        self._listed = frozenset(listed.lower().split())

    def allows(self, origin: str, host: str) -> bool:
        """Return whether a request with these two headers is allowed.

        Args:
            origin: ``Origin``, "" if absent: then the request comes from no web page.
            host: ``Host``, "" if absent; a page that was loaded from there is the platform's own.
        """
        if not origin:
            return True
        origin = origin.lower()
        own = _WEB.fullmatch(origin)
        return origin in self._listed or (own is not None and own[1] == host.lower())

    def check(self, origin: str, host: str) -> None:
        """Raise Forbidden if a request with these two headers is not allowed."""
        if not self.allows(origin, host):
            raise Forbidden("web pages of this origin are not allowed", hint=ORIGIN_HINT)


def carried_token(authorization: str, offered: list[str]) -> str:
    """Return the token of a handshake, "" if there is none.

    Args:
        authorization: The header, "" if absent; if it is there, it alone counts.
        offered: Sub-protocols; the first one that begins with `CARRIER_PREFIX` carries the token.
    """
    if authorization:
        scheme, _, token = authorization.partition(" ")
        return token.strip() if scheme.lower() == "bearer" else ""
    carriers = (subprotocol for subprotocol in offered if subprotocol.startswith(CARRIER_PREFIX))
    return next(carriers, CARRIER_PREFIX)[len(CARRIER_PREFIX) :]
