"""Explain what answers at an address when it is no RSE-PF server, from what the failed attempt received.

Login pages, proxies and firewalls stand between a robot and its servers, and another program may use the
port.  Each ``explain_`` function takes one kind of evidence (HTTP answer, no HTTP answer, certificate) and
returns a typed error: a sentence with the cause, and a hint with the action that helps.
"""

from __future__ import annotations

import asyncio
import re
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from urllib.parse import urljoin, urlsplit

from rse_pf.errors import ConnectError
from rse_pf.wire.refusal import refusal_in

__all__ = [
    "WEB_SCHEME",
    "HttpAnswer",
    "explain_answer",
    "explain_certificate",
    "explain_no_answer",
    "is_plain_peer",
    "shorten",
]

OTHER_SCHEME = {"ws": "wss", "wss": "ws", "http": "https", "https": "http"}
"""For each URL scheme the one that differs in TLS only."""
WEB_SCHEME = {"ws": "http", "wss": "https", "http": "http", "https": "https"}
"""For each URL scheme that of plain HTTP at the same port: for a web browser, for the data service, and for
the name of the variable of a proxy (``ws:`` uses ``HTTP_PROXY``)."""
CHECK_PORT = "check host and port of the URL: no RSE-PF server answers there"
FOREIGN_STATUSES = (101, 301, 302, 303, 308, 407, 511)
"""HTTP statuses by which an answer is recognised as that of a login page or a proxy: the data service of the
platform never sends them, and redirects by 307 only."""
TLS_WANTED = re.compile(rb"https|\bssl\b|\btls\b", re.IGNORECASE)
"""Words by which a 400 of nginx, Apache or Go is recognised as their answer to plain HTTP at a TLS port."""
NO_TLS_REASONS = ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "PACKET_LENGTH_TOO_LONG")
"""Reasons of OpenSSL for the failure of a TLS handshake with a peer that sent plain text."""
MAX_SHOWN_TEXT = 200
"""Longest text of another program, a banner or an address, that an error message shows, in characters; a
longer text is cut."""
TLS_RECORD_TYPES = range(0x14, 0x18)
"""First byte of a TLS record (RFC 8446, 5.1): change of cipher, alert, handshake, data."""
TIME_ERRORS = (9, 10)
"""Codes of X509_verify_cert_error_string(3) for certificates that are not yet valid or expired."""
NAME_ERRORS = (62, 64)
"""Codes of X509_verify_cert_error_string(3) for certificates of another host name or IP address."""

NO_SERVER_OF_OURS = (
    ", and it is not an RSE-PF server that says so",
    "a firewall or a login page between robot and platform answered: ask who runs the network",
)
NO_SERVER_BEHIND_PROXY = (
    ": a proxy in front of the platform reaches no server",
    "check that the servers of the platform run; try again later",
)
CAUSE_AND_HINT = {
    401: NO_SERVER_OF_OURS,
    403: NO_SERVER_OF_OURS,
    413: (
        ": a proxy on the way limits the size of uploads",
        "let the proxy in front of the platform pass bodies of 1 MiB (nginx: client_max_body_size)",
    ),
    426: (
        ": a proxy on the way removed the header Upgrade",
        "let the proxy in front of the platform pass on the headers Upgrade and Connection",
    ),
    429: (": too many attempts to connect", "try again later"),
    451: NO_SERVER_OF_OURS,
    502: NO_SERVER_BEHIND_PROXY,
    503: (": the platform is full, or is starting", "try again later"),
    504: NO_SERVER_BEHIND_PROXY,
}
"""Cause and hint of the HTTP statuses that have one usual cause."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HttpAnswer:
    """An HTTP answer; ``headers`` has lower-case names."""

    status: int
    headers: Mapping[str, str]
    body: bytes = b""

    @property
    def shown_status(self) -> str:
        """Status and phrase for an error message, such as ``404 Not Found``."""
        try:
            return f"{self.status} {HTTPStatus(self.status).phrase}"
        except ValueError:
            return str(self.status)

    @property
    def is_page(self) -> bool:
        """Whether the body is a page for a web browser."""
        content_type = self.headers.get("content-type", "").lower()
        return "html" in content_type or (not content_type and self.body.lstrip()[:1] == b"<")

    @property
    def is_foreign(self) -> bool:
        """Whether a login page or proxy sent this; the data service writes JSON and binary data only."""
        is_text = self.headers.get("content-type", "").lower().startswith("text/")
        return self.status in FOREIGN_STATUSES or is_text or self.is_page


def explain_answer(address: str, answer: HttpAnswer) -> ConnectError:
    """Return the error for an HTTP *answer* of *address* that is neither a success nor a typed failure.

    A load balancer, a proxy, a login page or another program has sent the answer.
    """
    status, statement = answer.status, f"{address} answers {answer.shown_status}"
    # 1. Recognise a wrong scheme in the URL.
    if status == 400 and TLS_WANTED.search(answer.body) and not _is_tls_address(address):
        return _explain_tls(address)
    # 2. If a proxy on the way removed headers, an RSE-PF server answers 400 ``bad-message``: explain this as
    # 426.
    if status == 400 and refusal_in(answer.body, "bad-message") is not None:
        status = 426
    # 3. Look up the cause of a status that has one usual cause.
    if status in CAUSE_AND_HINT:
        cause, hint = CAUSE_AND_HINT[status]
        return ConnectError(f"{statement}{cause}", hint=hint)
    # 4. Report a redirect or a web page, as a login page (captive portal) sends it, with its address.
    if 300 <= status < 400:
        target = _redirect_target(address, answer)
        hint = f"open {target} in a web browser: log in there, or write its host and scheme in the URL"
        return ConnectError(f"{statement}, a redirect to {target}, perhaps a login page", hint=hint)
    if status == 511 or (status < 300 and answer.is_page):
        parts = urlsplit(address)
        page = f"{WEB_SCHEME[parts.scheme]}://{parts.netloc}/"
        hint = f"open {page} in a web browser: log in there, or correct the URL if it is another site"
        return ConnectError(f"{statement} with a web page, perhaps a login page", hint=hint)
    # 5. Report another program.
    if status < 300:
        return ConnectError(f"{statement} as no RSE-PF server does", hint=CHECK_PORT)
    server = shorten(answer.headers.get("server", ""))
    sender = f" (a server that calls itself {server!r})" if server else ""
    return ConnectError(statement + sender, hint=CHECK_PORT)


def explain_no_answer(
    address: str, error: Exception, *, first_bytes: bytes = b"", within_s: float | None = None
) -> ConnectError:
    """Return the error for an *address* that accepted a connection and sent no HTTP answer that can be read.

    Args:
        address: The URL as shown to users.
        error: What ended the attempt.
        first_bytes: What the peer sent instead; empty if it sent nothing.
        within_s: How many seconds the attempt waited for the answer, None if unknown.
    """
    # 1. Report a peer that sent TLS, or the text of another program.
    if _is_tls_record(first_bytes):
        return _explain_tls(address)
    if first_bytes:
        text = shorten("".join(chr(byte) if 32 <= byte < 127 else " " for byte in first_bytes))
        sent = repr(text) if text else f"the bytes {first_bytes[:16].hex(' ')}"
        return ConnectError(f"another program answers at {address}: it sends {sent}", hint=CHECK_PORT)
    # 2. Explain a failed TLS handshake.
    if is_plain_peer(error):
        hint = f"write {OTHER_SCHEME[urlsplit(address).scheme]}:// in the URL, or a port that speaks TLS"
        return ConnectError(f"{address} does not speak TLS", hint=hint)
    if isinstance(error, ssl.SSLError) and not isinstance(error, ssl.SSLEOFError):
        reason = (error.reason or str(error)).replace("_", " ").lower()
        hint = "ask who runs the server there why it refuses TLS 1.2 and newer from this robot"
        return ConnectError(f"{address} ends the TLS handshake: {reason}", hint=hint)
    # 3. Report a peer that is slow, speaks another protocol, or expects TLS.
    within = "" if within_s is None else f" within {within_s:g} s"
    is_late = isinstance(error, (TimeoutError, asyncio.TimeoutError))
    cause = f"sends no answer{within}" if is_late else "closed the connection without an answer"
    hint = "check host and port of the URL, and whether rse-pf local status shows running servers"
    if not _is_tls_address(address):
        hint += f"; write {OTHER_SCHEME[urlsplit(address).scheme]}:// if they use TLS"
    return ConnectError(f"{address} {cause}", hint=hint)


def explain_certificate(
    address: str, error: ssl.SSLCertVerificationError, *, is_enrolled: bool
) -> ConnectError:
    """Return the error for a TLS certificate that this robot does not trust.

    Args:
        address: The URL as shown to users.
        error: Error of the TLS handshake.
        is_enrolled: Whether the robot trusts the authority in its enrolment file and no other.
    """
    cause = error.verify_message.rstrip(".")
    message = f"{address} shows a certificate that this robot does not trust: {cause}"
    if error.verify_code in TIME_ERRORS:
        hint = "check the clock of this robot; a platform renews its certificate by itself"
    elif error.verify_code in NAME_ERRORS:
        hint = "write a host name in the URL for which the certificate was made"
    elif is_enrolled:
        hint = "enrol again: rse-pf robot enrol ROBOT --out FILE, with --authority and its authority's file"
    else:
        hint = (
            "connect by the file of rse-pf robot enrol ROBOT --out FILE, with --authority for a certificate "
            "of your own; if a proxy of the network inspects TLS, set SSL_CERT_FILE to its certificate"
        )
    return ConnectError(message, hint=hint)


def is_plain_peer(error: Exception) -> bool:
    """Return whether *error* says that a peer answered a TLS handshake in plain text."""
    return isinstance(error, ssl.SSLError) and error.reason in NO_TLS_REASONS


def shorten(text: str) -> str:
    """Return a text of another program as one line of at most `MAX_SHOWN_TEXT` printable characters."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text[: 8 * MAX_SHOWN_TEXT]).split())
    return line if len(line) <= MAX_SHOWN_TEXT else f"{line[: MAX_SHOWN_TEXT - 3]}..."


def _redirect_target(address: str, answer: HttpAnswer) -> str:
    """Return where a redirect leads, without user name, password and query, to be shown in errors."""
    parts = urlsplit(address)
    web = parts._replace(scheme=WEB_SCHEME[parts.scheme]).geturl()
    try:
        target = urlsplit(urljoin(web, answer.headers.get("location", "")))
    except ValueError:
        return shorten(web)
    return shorten(f"{target.scheme}://{target.netloc.rpartition('@')[2]}{target.path}")


def _is_tls_record(data: bytes) -> bool:
    return len(data) > 1 and data[0] in TLS_RECORD_TYPES and data[1] == 3


def _explain_tls(address: str) -> ConnectError:
    scheme = urlsplit(address).scheme
    hint = f"write {OTHER_SCHEME[scheme]}:// in the URL"
    return ConnectError(f"{address} speaks TLS, and {scheme}:// means a connection without TLS", hint=hint)


def _is_tls_address(address: str) -> bool:
    return urlsplit(address).scheme in ("wss", "https")
