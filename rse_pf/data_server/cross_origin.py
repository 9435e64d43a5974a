"""The headers by which a browser lets a web page of another origin use the data service (CORS).

Which origins are allowed is decided in `rse_pf.auth.origins`.  No cookie and no other credential of the
browser is ever allowed along: the page sends its token itself.
"""

from __future__ import annotations

import dataclasses

from rse_pf.data_server.http import HttpReply, HttpRequest

__all__ = ["is_preflight", "preflight_reply", "shared_reply"]

_SENT = (
    "authorization, content-type, if-match, if-none-match, if-range, range, upload-offset, x-accept-direct"
)
_EXPOSED = "content-range, etag, retry-after, upload-offset"
_PREFLIGHT_LIFE_S = 600  # a browser does not ask again for this time


def is_preflight(request: HttpRequest) -> bool:
    """Return whether *request* is a CORS preflight request of a browser."""
    named = request.headers
    return request.method == "OPTIONS" and "origin" in named and "access-control-request-method" in named


def preflight_reply(methods: list[str]) -> HttpReply:
    """Return the answer for a path that has *methods*; a browser keeps it for ten minutes.

    Source:
        WHATWG Fetch, Sect. 3.3.
    """
    headers = {
        "Access-Control-Allow-Methods": ", ".join(methods),
        "Access-Control-Allow-Headers": _SENT,
        "Access-Control-Max-Age": str(_PREFLIGHT_LIFE_S),
    }
    return HttpReply(status=204, headers=headers)


def shared_reply(reply: HttpReply, origin: str) -> HttpReply:
    """Return *reply* so that a page of the allowed *origin* may read it; "" changes nothing."""
    if not origin:
        return reply
    shared = {
        "Access-Control-Allow-Origin": origin,
        "Access-Control-Expose-Headers": _EXPOSED,
        "Vary": "Origin",
    }
    return dataclasses.replace(reply, headers={**reply.headers, **shared})
