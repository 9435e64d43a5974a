"""What a failed attempt to connect means for the next one, and how an address is shown.

Nothing here opens a socket.  Between a robot and its servers stand firewalls, load balancers and login pages
that answer with HTTP statuses of their own.  Only a refusal with the mark of our servers concerns the robot
itself: it may last, so the robot is told, and tries again much later.  Nothing ends a robot for good.
"""

from __future__ import annotations

import errno
import ssl
from urllib.parse import urlsplit

from rse_pf.errors import ConnectError, Forbidden, RsePfError, Unauthorized, UsageError
from rse_pf.wire.refusal import CUT_OFF, RefusedHandshake, refusal_in

__all__ = [
    "CHECK_ADDRESS",
    "CHECK_RUNNING",
    "ISSUE",
    "DialError",
    "dial_error_of",
    "hide_password",
    "unconnected_error",
    "unreachable",
    "untrusted_error",
]

CHECK_RUNNING = "is the platform running? start it with rse-pf local start"
CHECK_ADDRESS = "is it an RSE-PF server?"
ISSUE = (
    "a token of rse-pf token issue is valid for 15 minutes: issue another one, or give the robot a key by "
    "rse-pf robot enrol; if it has one, rse-pf robot list shows whether it was disabled or has a newer key"
)
_MAX_RETRY_AFTER_S = 300.0
_TIMES = (9, 10)
"""Of X509_verify_cert_error_string(3): not yet valid, expired."""
_ANSWERED = (errno.ECONNREFUSED, errno.ECONNRESET, errno.ECONNABORTED)
_FOR_ANY_TOKEN = ("disabled", CUT_OFF, "not-yet-valid")


class DialError(Exception):
    """A failed connection attempt: its error, and what it means for the next one.

    ``is_refusal`` means that a server refused this robot and may do so for long, ``is_wrong_address`` that
    the URL is probably wrong, ``is_unanswered`` that nobody accepted the TCP connection or nothing left this
    machine, ``is_late`` that a server may still accept it, and ``valid_from_s`` the Unix time from which
    tokens are accepted.  ``refuses_any`` means that another token, signed now, would be refused as well.
    """

    def __init__(
        self,
        error: RsePfError,
        *,
        after_s: float = 0.0,
        is_wrong_address: bool = False,
        is_refusal: bool = False,
        is_unanswered: bool = False,
        is_late: bool = False,
        cause: str = "",
        valid_from_s: float | None = None,
    ) -> None:
        super().__init__(error.message)
        self.error = error
        self.after_s = after_s
        self.is_wrong_address = is_wrong_address
        self.is_refusal = is_refusal
        self.is_unanswered = is_unanswered
        self.is_late = is_late
        self.refuses_any = cause in _FOR_ANY_TOKEN
        self.valid_from_s = valid_from_s


def unconnected_error(address: str, error: OSError) -> DialError:
    """Return the error of an attempt without a TCP connection to *address*."""
    is_answered = error.errno in _ANSWERED
    return DialError(_unreachable(address, error), is_unanswered=not is_answered)


def unreachable(address: str, error: Exception) -> DialError:
    """Return the error of an attempt that was connected and got no HTTP answer from *address*."""
    return DialError(_unreachable(address, error), is_late=True)


def _unreachable(address: str, error: Exception) -> ConnectError:
    cause = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return ConnectError(f"cannot connect to {address}: {cause}", hint=CHECK_RUNNING)


def untrusted_error(address: str, error: ssl.SSLCertVerificationError) -> DialError:
    """Return the error of a server whose certificate this robot does not trust, or not now.

    A later attempt may succeed: in some networks another machine answers first, and clocks are set.
    """
    hint = "connect by the file of rse-pf robot enrol ROBOT --out FILE, made by this platform"
    if error.verify_code in _TIMES:
        hint = "check the clock of this robot; a platform renews its certificate by itself"
    why = error.verify_message.rstrip(".")
    message = f"{address} shows a certificate that this robot does not trust: {why}"
    return DialError(ConnectError(message, hint=hint), is_wrong_address=True)


def dial_error_of(address: str, status: int, retry_after: str, body: bytes = b"") -> DialError:
    """Return the error of an HTTP *status* that came instead of a WebSocket.

    Args:
        address: The URL as shown to users.
        status: HTTP status of the handshake.
        retry_after: The header ``Retry-After``, empty if there was none.
        body: Of the answer; 401 and 403 concern this robot only with the mark of our servers in it.
    """
    after_s = float(retry_after) if retry_after.isdecimal() else 0.0
    after_s = min(after_s, _MAX_RETRY_AFTER_S)
    if status in (401, 403):
        refusal = refusal_in(body, Unauthorized.code if status == 401 else Forbidden.code)
        if refusal is None:
            return DialError(_not_ours(address, status), after_s=after_s)
        return DialError(
            _refusal_error(address, status, refusal),
            is_refusal=True, after_s=after_s, cause=refusal.cause, valid_from_s=refusal.valid_from_s,
        )  # fmt: skip
    is_client_error = 300 <= status < 500 and status != 429
    hint = "check the URL: it ends with the path of the servers, /ws"
    error = ConnectError(
        f"{address} answers {status}", hint=hint if is_client_error else "it is full or not ready; try later"
    )
    return DialError(error, after_s=after_s, is_wrong_address=status in (400, 404))


def _not_ours(address: str, status: int) -> RsePfError:
    hint = "a firewall or a login page between robot and platform answered: ask who runs the network"
    return ConnectError(f"{address} answers {status}, and it is not an RSE-PF server that says so", hint=hint)


def _refusal_error(address: str, status: int, handshake: RefusedHandshake) -> RsePfError:
    if status == 403:
        return Forbidden(f"{address} forbids this robot to connect", hint="ask the operator")
    if handshake.cause:
        return Unauthorized(handshake.message, hint=handshake.hint)
    return Unauthorized("the token is missing, wrong or expired", hint=ISSUE)


def hide_password(url: str) -> str:
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
