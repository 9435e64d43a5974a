"""Why a connection attempt failed, and whether another attempt can succeed."""

from __future__ import annotations

from urllib.parse import urlsplit

from rse_pf.errors import ConnectError, Forbidden, RsePfError, Unauthorized, UsageError

__all__ = ["DialError", "dial_error_of", "shown_address"]

_MAX_RETRY_AFTER_S = 30.0


class DialError(Exception):
    """A failed connection attempt: its error, how long to wait, and whether a further attempt is of use.

    ``is_final`` means that no later attempt can succeed, ``is_wrong_address`` that the URL is probably wrong.
    """

    def __init__(
        self,
        error: RsePfError,
        *,
        after_s: float = 0.0,
        is_wrong_address: bool = False,
        is_final: bool = False,
    ) -> None:
        super().__init__(error.message)
        self.error = error
        self.after_s = after_s
        self.is_wrong_address = is_wrong_address
        self.is_final = is_final


def dial_error_of(address: str, status: int, retry_after: str) -> DialError:
    """Return the error of an HTTP *status* that came instead of a WebSocket.

    Args:
        address: The URL as shown to users.
        status: HTTP status of the handshake.
        retry_after: The header ``Retry-After``, empty if there was none.
    """
    if status == 401:
        message = "the token is missing, wrong or expired"
        return DialError(Unauthorized(message, hint="issue one: rse-pf token issue ROBOT"), is_final=True)
    if status == 403:
        message = f"{address} forbids this robot to connect"
        return DialError(Forbidden(message, hint="ask the operator"), is_final=True)
    is_client_error = 400 <= status < 500 and status != 429
    hint = "check the URL: it ends with the path of the servers, /ws"
    error = ConnectError(
        f"{address} answers {status}", hint=hint if is_client_error else "it is full or not ready; try later"
    )
    after_s = float(retry_after) if retry_after.isdecimal() else 0.0
    return DialError(error, after_s=min(after_s, _MAX_RETRY_AFTER_S), is_wrong_address=status in (400, 404))


def shown_address(url: str) -> str:
    """Return *url* without user name and password; raises UsageError if it is no WebSocket address."""
    parts = urlsplit(url)
    try:
        port = parts.port
    except ValueError:
        port = -1
    if parts.scheme not in ("ws", "wss") or not parts.hostname or port == -1:
        raise UsageError(
            f"{url!r} is not a WebSocket address", hint="write ws://HOST:PORT/ws or wss://HOST/ws"
        )
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
