"""What a failed attempt to connect means for the next one, and how an address is shown.

Nothing here opens a socket.  `foreign_answers` names the cause if somebody else than our servers answered.
Only a refusal with the mark of our servers concerns the robot itself: it may last, so it is reported, and
the robot tries again much later.  Nothing ends a robot for good.
"""

from __future__ import annotations

import errno
import os
import socket
import ssl
from collections.abc import Mapping
from urllib.parse import SplitResult, urlsplit

from client_sdk.network.peer_diagnosis import (
    HttpAnswer,
    explain_answer,
    explain_bytes,
    explain_certificate,
    explain_silence,
    is_of_tls_server,
    parse_answer,
)
from client_sdk.network.peer_probe import Probed
from rse_pf.errors import ConnectError, Forbidden, RsePfError, Unauthorized, UsageError
from rse_pf.wire.refusal import CUT_OFF, RefusedHandshake, refusal_in

__all__ = [
    "CHECK_ADDRESS",
    "CHECK_RUNNING",
    "ISSUE",
    "DialError",
    "dial_error_of",
    "explain_unconnected",
    "hide_password",
    "show_wrong_url",
    "split_address",
    "unconnected_error",
    "unreachable",
    "untrusted_error",
]

CHECK_RUNNING = "is the platform running? start it with rse-pf local start"
CHECK_ADDRESS = "check host, port and path of the URL: another kind of WebSocket server answers there"
ISSUE = (
    "a token of rse-pf token issue is valid for 15 minutes: issue another one, or give the robot a key by "
    "rse-pf robot enrol; if it has one, rse-pf robot list shows whether it was disabled or has a newer key"
)
_MAX_RETRY_AFTER_S = 300.0
_WRONG_ADDRESS = (400, 404, 405, 407, 410, 426)
"""Statuses that come again until somebody changes the URL, the proxy, or a program at the address."""
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
    return DialError(explain_unconnected(address, error), is_unanswered=not is_answered)


def explain_unconnected(address: str, error: OSError) -> ConnectError:
    """Return what it means that there is no TCP connection to *address*."""
    cause, parts = error.strerror or str(error) or type(error).__name__, urlsplit(address)
    hint = CHECK_RUNNING
    if isinstance(error, socket.gaierror):
        cause = f"the name {parts.hostname} does not resolve: {cause}"
        hint = "check the host in the URL, and the name server (DNS) of this network"
    elif error.errno in _ANSWERED:
        cause = os.strerror(error.errno)  # asyncio writes a tuple of the address instead
    else:
        hint = f"check the network of this robot, and that firewalls let it reach {parts.netloc}"
    return ConnectError(f"cannot connect to {address}: {cause}", hint=hint)


def unreachable(
    address: str,
    error: Exception,
    *,
    first_bytes: bytes = b"",
    probed: Probed | None = None,
    within_s: float | None = None,
) -> DialError:
    """Return the error of an attempt that was connected and got no HTTP/1.1 answer from *address*.

    Args:
        address: The URL as shown to users.
        error: Of the attempt.
        first_bytes: That the peer sent, and that are no HTTP/1.1.
        probed: What the peer shows when it is asked again; None if it was not.
        within_s: How long the attempt waited for the answer, None if that is unknown.
    """
    if first_bytes:
        is_wrong = parse_answer(first_bytes) is None
        return DialError(explain_bytes(address, first_bytes), is_late=True, is_wrong_address=is_wrong)
    known = probed or Probed()
    explained = explain_silence(
        address, error, certificate=known.certificate, data=known.data, within_s=within_s
    )
    has_other = bool(known.data) and not is_of_tls_server(known.data)
    is_wrong = known.certificate is not None if address.startswith("ws:") else has_other
    return DialError(explained, is_late=True, is_wrong_address=is_wrong)


def untrusted_error(
    address: str, error: ssl.SSLCertVerificationError, *, issuer: str = "", is_enrolled: bool = False
) -> DialError:
    """Return the error of a server whose certificate this robot does not trust, or not now.

    A later attempt may succeed: in some networks another machine answers first, and clocks are set.
    """
    explained = explain_certificate(address, error, issuer=issuer, is_enrolled=is_enrolled)
    return DialError(explained, is_wrong_address=True)


def dial_error_of(address: str, status: int, headers: Mapping[str, str], body: bytes = b"") -> DialError:
    """Return the error of an HTTP *status* that came instead of a WebSocket.

    Args:
        address: The URL as shown to users.
        status: HTTP status of the handshake.
        headers: Of the answer, with any letters of their names.
        body: Of the answer; 401 and 403 concern this robot only with the mark of our servers in it.
    """
    lower = {name.lower(): value for name, value in headers.items()}
    retry_after = lower.get("retry-after", "")
    after_s = float(retry_after) if retry_after.isdecimal() else 0.0
    after_s = min(after_s, _MAX_RETRY_AFTER_S)
    if status in (401, 403):
        refusal = refusal_in(body, Unauthorized.code if status == 401 else Forbidden.code)
        if refusal is not None:
            return DialError(
                _refusal_error(address, status, refusal),
                is_refusal=True, after_s=after_s, cause=refusal.cause, valid_from_s=refusal.valid_from_s,
            )  # fmt: skip
    error = explain_answer(address, HttpAnswer(status=status, headers=lower, body=body))
    return DialError(error, after_s=after_s, is_wrong_address=status in _WRONG_ADDRESS)


def _refusal_error(address: str, status: int, handshake: RefusedHandshake) -> RsePfError:
    if status == 403:
        return Forbidden(f"{address} forbids this robot to connect", hint="ask the operator")
    if handshake.cause:
        return Unauthorized(handshake.message, hint=handshake.hint)
    return Unauthorized("the token is missing, wrong or expired", hint=ISSUE)


def split_address(url: str, schemes: tuple[str, ...], error: UsageError) -> SplitResult:
    """Return the parts of *url*; raises *error* unless scheme, host and port can be used."""
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018 - it is read when it is asked for
        (parts.hostname or "").encode("idna")  # refuses empty labels, and those of more than 63 letters
    except ValueError:  # UnicodeError is a ValueError, too
        raise error from None
    if parts.scheme not in schemes or not parts.hostname:
        raise error
    return parts


def show_wrong_url(url: str) -> str:
    """Return what may be shown of a text that may be no URL: nothing of user name, password and query."""
    scheme, separator, rest = str(url).rpartition("@")[0].partition("://")
    shown = str(url).rpartition("@")[2].partition("?")[0]
    return f"{scheme}://{shown}" if separator and rest else shown


def hide_password(url: str) -> str:
    """Return *url* without user name and password; raises UsageError if it is no WebSocket address."""
    hint = "write ws://HOST:PORT/ws or wss://HOST/ws"
    error = UsageError(f"{show_wrong_url(url)!r} is not a WebSocket address", hint=hint)
    parts = split_address(url, ("ws", "wss"), error)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
