"""Turn a failed attempt to connect into a `DialError`: an error for the user, and facts for the next attempt.

Nothing here opens a socket.  `client_sdk.network.peer_diagnosis` explains answers of machines that are no
RSE-PF servers.  A 401 or 403 concerns the robot itself only if its body has the JSON member by which RSE-PF
servers mark it (`rse_pf.wire.refusal`): it is then a refusal, which is reported, and the robot tries again
after a long pause.
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
    explain_certificate,
    explain_no_answer,
    is_plain_peer,
)
from rse_pf.errors import Conflict, ConnectError, Forbidden, RsePfError, Unauthorized, UsageError
from rse_pf.wire.refusal import CUT_OFF, RefusedHandshake, refusal_in

__all__ = [
    "ANSWERED_ERRNOS",
    "CHECK_ADDRESS",
    "CHECK_RUNNING",
    "DialError",
    "explain_tcp_failure",
    "hide_password",
    "http_status_error",
    "no_answer_error",
    "replaced_connection_error",
    "revoked_token_error",
    "show_wrong_url",
    "split_address",
    "tcp_error",
    "untrusted_certificate_error",
]

CHECK_RUNNING = "start the platform by rse-pf local start, or check host and port of the URL"
"""Hint for an address where no program listens, or where the platform closes connections at once."""
CHECK_ADDRESS = "check host, port and path of the URL: a WebSocket server of another program answers there"
"""Hint for an address where a WebSocket server does not speak the protocol of RSE-PF."""
RENEWAL_HINT = (
    "issue another token by rse-pf token issue (it is valid for 15 minutes), or give the robot a key by "
    "rse-pf robot enrol; for a robot with a key, rse-pf robot list shows whether it was disabled or has a "
    "newer key"
)
"""Hint for a token that is expired, revoked or wrong."""
MAX_RETRY_AFTER_S = 300.0
"""Longest wait that a robot accepts from the header Retry-After; a longer one is cut to this, so that a wrong
answer cannot keep the robot away."""
WRONG_ADDRESS_STATUSES = (400, 404, 405, 407, 410, 426)
"""HTTP statuses that every attempt gets until somebody changes the URL, the proxy, or the program there, so
that a first connect raises its error at once."""
ANSWERED_ERRNOS = (errno.ECONNREFUSED, errno.ECONNRESET, errno.ECONNABORTED)
"""Errors of a TCP connection that a machine at the address caused: it is there, and answered."""
SHORT_REFUSAL_S = 2.0
"""If the servers will accept this robot within this many seconds, their refusal is not reported: commands and
a first connect wait until then."""
REFUSALS_OF_ANY_TOKEN = ("disabled", CUT_OFF, "not-yet-valid")
"""Causes in a refusal because of which a token signed now would be refused as well, so that the robot does
not repeat the attempt at once with a second token."""


class DialError(Exception):
    """A failed attempt to connect, with what it means for the next attempt.

    Attributes:
        error: The typed error for the user.
        retry_after_s: How long the server asked the robot to wait; 0 if it asked for nothing.
        is_wrong_address: Whether the URL, a proxy or a program at the address has to change first.
        is_refusal: Whether an RSE-PF server refused this robot, perhaps for a long time.
        is_unanswered: Whether nobody accepted the TCP connection, or no packet left this machine.
        may_be_accepted_late: Whether a stalled server may still accept this attempt; it would then close a
            newer connection of this robot.
        refuses_any_token: Whether another token, signed now, would be refused as well.
        valid_from_s: Unix time from which new tokens are accepted, None if unknown.
    """

    def __init__(
        self,
        error: RsePfError,
        *,
        retry_after_s: float = 0.0,
        is_wrong_address: bool = False,
        is_refusal: bool = False,
        is_unanswered: bool = False,
        may_be_accepted_late: bool = False,
        cause: str = "",
        valid_from_s: float | None = None,
    ) -> None:
        """Set the attributes; *cause* is the cause that the body of a refusal names, empty without one."""
        super().__init__(error.message)
        self.error = error
        self.retry_after_s = retry_after_s
        self.is_wrong_address = is_wrong_address
        self.is_refusal = is_refusal
        self.is_unanswered = is_unanswered
        self.may_be_accepted_late = may_be_accepted_late
        self.refuses_any_token = cause in REFUSALS_OF_ANY_TOKEN
        self.valid_from_s = valid_from_s

    def valid_in_s(self, unix_s: float) -> float | None:
        """Return in how many seconds from *unix_s* new tokens are accepted, None if unknown."""
        return None if self.valid_from_s is None else self.valid_from_s - unix_s

    def is_lasting_refusal(self, unix_s: float) -> bool:
        """Return whether a server refuses this robot, and accepts no token within two seconds from
        *unix_s*."""
        valid_in_s = self.valid_in_s(unix_s)
        return self.is_refusal and (valid_in_s is None or valid_in_s > SHORT_REFUSAL_S)


def tcp_error(address: str, error: OSError) -> DialError:
    """Return the error of an attempt that got no TCP connection to *address*."""
    is_answered = error.errno in ANSWERED_ERRNOS
    return DialError(explain_tcp_failure(address, error), is_unanswered=not is_answered)


def explain_tcp_failure(address: str, error: OSError) -> ConnectError:
    """Return the typed error, with a hint, for a TCP connection to *address* that failed with *error*."""
    cause, parts = error.strerror or str(error) or type(error).__name__, urlsplit(address)
    hint = CHECK_RUNNING
    if isinstance(error, socket.gaierror):
        cause = f"the name {parts.hostname} does not resolve: {cause}"
        hint = "check the host in the URL, and the name server (DNS) of this network"
    elif error.errno in ANSWERED_ERRNOS:
        cause = os.strerror(error.errno)  # the text of the error itself repeats the address
    else:
        hint = f"check the network of this robot, and that firewalls let it reach {parts.netloc}"
    return ConnectError(f"cannot connect to {address}: {cause}", hint=hint)


def no_answer_error(
    address: str,
    error: Exception,
    *,
    first_bytes: bytes = b"",
    within_s: float | None = None,
) -> DialError:
    """Return the error of an attempt that had a TCP connection and got no HTTP/1.1 answer from *address*.

    Args:
        address: The URL as shown to users.
        error: What ended the attempt.
        first_bytes: What the peer sent instead of HTTP/1.1; empty if it sent nothing.
        within_s: How many seconds the attempt waited for the answer, None if unknown.
    """
    explained = explain_no_answer(address, error, first_bytes=first_bytes, within_s=within_s)
    is_other_protocol = bool(first_bytes) and not first_bytes.startswith(b"HTTP/")
    is_wrong_address = is_other_protocol or is_plain_peer(error)
    return DialError(explained, may_be_accepted_late=True, is_wrong_address=is_wrong_address)


def untrusted_certificate_error(
    address: str, error: ssl.SSLCertVerificationError, *, is_enrolled: bool = False
) -> DialError:
    """Return the error of a TLS certificate that this robot does not trust.

    Args:
        address: The URL as shown to users.
        error: Error of the TLS handshake.
        is_enrolled: Whether the robot trusts the authority in its enrolment file and no other.
    """
    explained = explain_certificate(address, error, is_enrolled=is_enrolled)
    return DialError(explained, is_wrong_address=True)


def http_status_error(address: str, status: int, headers: Mapping[str, str], body: bytes = b"") -> DialError:
    """Return the error of a WebSocket handshake that was answered with an HTTP *status* other than 101.

    Args:
        address: The URL as shown to users.
        status: HTTP status of the answer.
        headers: Headers of the answer; upper and lower case do not matter.
        body: Body of the answer; an RSE-PF server writes the reason of a 401 or 403 into it.
    """
    lower = {name.lower(): value for name, value in headers.items()}
    retry_after = lower.get("retry-after", "")
    retry_after_s = float(retry_after) if retry_after.isdecimal() else 0.0
    retry_after_s = min(retry_after_s, MAX_RETRY_AFTER_S)
    if status in (401, 403):
        refusal = refusal_in(body, Unauthorized.code if status == 401 else Forbidden.code)
        if refusal is not None:
            return DialError(
                _refusal_error(address, status, refusal),
                is_refusal=True,
                retry_after_s=retry_after_s,
                cause=refusal.cause,
                valid_from_s=refusal.valid_from_s,
            )
    error = explain_answer(address, HttpAnswer(status=status, headers=lower, body=body))
    is_wrong_address = status in WRONG_ADDRESS_STATUSES
    return DialError(error, retry_after_s=retry_after_s, is_wrong_address=is_wrong_address)


def revoked_token_error(valid_from_s: float | None) -> DialError:
    """Return the error of a connection that its server closed because the token was revoked.

    *valid_from_s* is the Unix time from which newly signed tokens are accepted; None if the robot has one
    fixed token, which stays revoked.
    """
    error = Unauthorized("the token was revoked, or the robot was disabled", hint=RENEWAL_HINT)
    return DialError(error, is_refusal=True, valid_from_s=valid_from_s)


def replaced_connection_error() -> DialError:
    """Return the error of a connection that another program replaced by connecting as the same robot."""
    message = "another connection of this robot replaced this one"
    return DialError(Conflict(message, hint="give every robot a token of its own"), is_refusal=True)


def _refusal_error(address: str, status: int, refusal: RefusedHandshake) -> RsePfError:
    if status == 403:
        return Forbidden(f"{address} forbids this robot to connect", hint="ask the operator of the platform")
    if refusal.cause:
        return Unauthorized(refusal.message, hint=refusal.hint)
    return Unauthorized("the token is missing, wrong or expired", hint=RENEWAL_HINT)


def split_address(url: str, schemes: tuple[str, ...], error: UsageError) -> SplitResult:
    """Return the parts of *url*; raise the caller's *error* if scheme, host or port cannot be used."""
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018 - urllib checks the port only when it is read
        (parts.hostname or "").encode("idna")  # raises for host names with empty or too long labels
    except ValueError:  # UnicodeError is a ValueError, too
        raise error from None
    if parts.scheme not in schemes or not parts.hostname:
        raise error
    return parts


def show_wrong_url(url: str) -> str:
    """Return a perhaps malformed *url* without user name, password and query, to be shown in errors."""
    scheme, separator, rest = str(url).rpartition("@")[0].partition("://")
    shown = str(url).rpartition("@")[2].partition("?")[0]
    return f"{scheme}://{shown}" if separator and rest else shown


def hide_password(url: str) -> str:
    """Return scheme, host, port and path of the WebSocket address *url*, without user name and password.

    Raises:
        UsageError: *url* is no WebSocket address.
    """
    hint = "write ws://HOST:PORT/ws or wss://HOST/ws"
    error = UsageError(f"{show_wrong_url(url)!r} is not a WebSocket address", hint=hint)
    parts = split_address(url, ("ws", "wss"), error)
    return f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
