"""The headers by which a browser lets a web page of another origin use the data service (CORS).

`rse_pf.auth.origins` decides which origins are allowed.  The browser never sends cookies or other credentials
of its own: the page sets the header ``Authorization`` itself.
"""

from __future__ import annotations

import dataclasses

from rse_pf.data_server.http import HttpReply, HttpRequest

__all__ = ["is_preflight", "preflight_reply", "shared_reply"]

# The headers that a web page may send with its requests.
_REQUEST_HEADERS = (
    "authorization, content-type, if-match, if-none-match, if-range, range, upload-offset, x-accept-direct"
)
# The headers of replies that a web page may read, besides those that browsers always allow.
_READABLE_HEADERS = "content-range, etag, retry-after, upload-offset"
_PREFLIGHT_TTL_S = 600  # seconds for which a browser caches the reply to a preflight request


def is_preflight(request: HttpRequest) -> bool:
    """Return whether *request* is a CORS preflight: a browser asks whether a page may send a request."""
    named = request.headers
    return request.method == "OPTIONS" and "origin" in named and "access-control-request-method" in named


def preflight_reply(methods: list[str]) -> HttpReply:
    """Return the reply to a preflight request for a path with the HTTP *methods*: 204 and the CORS headers.

    A browser caches it for ten minutes.

    Source:
        WHATWG Fetch, Sect. 3.3.
    """
    headers = {
        "Access-Control-Allow-Methods": ", ".join(methods),
        "Access-Control-Allow-Headers": _REQUEST_HEADERS,
        "Access-Control-Max-Age": str(_PREFLIGHT_TTL_S),
    }
    return HttpReply(status=204, headers=headers)


def shared_reply(reply: HttpReply, origin: str) -> HttpReply:
    """Return *reply* with the headers that let a page of the allowed *origin* read it.

    Without an origin ("") the reply is returned unchanged.
    """
    if not origin:
        return reply
    shared = {
        "Access-Control-Allow-Origin": origin,
        "Access-Control-Expose-Headers": _READABLE_HEADERS,
        "Vary": "Origin",
    }
    return dataclasses.replace(reply, headers={**reply.headers, **shared})
