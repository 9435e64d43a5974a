"""Diagnose what answers at an address when it is no RSE-PF server, from the facts that an attempt collected.

Login pages, proxies and firewalls stand between a robot and its servers, and another program may use the
port. Each ``explain_`` function takes one kind of fact (HTTP answer, first bytes, silence, certificate,
answer of a proxy) and returns a typed error: a sentence with the cause, and a hint with the action that
helps.
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
    "HttpAnswer",
    "explain_answer",
    "explain_bytes",
    "explain_certificate",
    "explain_proxy",
    "explain_silence",
    "is_tls_server_answer",
    "parse_answer",
]

OTHER_SCHEME = {"ws": "wss", "wss": "ws", "http": "https", "https": "http"}
"""For each URL scheme the one that differs in TLS only."""
WEB_SCHEME = {"ws": "http", "wss": "https", "http": "http", "https": "https"}
"""For each URL scheme the one by which a web browser opens the same host."""
DEFAULT_PORTS = {"http": 80, "https": 443}
SECURE_SCHEMES = ("wss", "https")
CHECK_PORT = "check host and port of the URL: no RSE-PF server answers there"
STATUS_LINE = re.compile(rb"HTTP/(\d(?:\.\d)?) +(\d{3})\b[^\r\n]*")
"""First line of an HTTP answer; the groups are the version and the status."""
FOREIGN_STATUSES = (101, 301, 302, 303, 308, 407, 511)
"""HTTP statuses that login pages and proxies send and the data service never does; it redirects by 307
only."""
TLS_WANTED = re.compile(rb"https|\bssl\b|\btls\b", re.IGNORECASE)
"""Words by which a 400 of nginx, Apache or Go is recognised as their answer to plain HTTP at a TLS port."""
LOGIN_WORDS = re.compile(
    r"\blog[ -]?[io]n\b|\bsign[ -]?in\b|\bo?auth2?\b|\bsso\b|captive|portal|password|<form"
    r"|http-equiv=.?refresh",
    re.IGNORECASE,
)
"""Words in an address or a page by which a login page (captive portal) is recognised."""
PAGE_TITLE = re.compile(r"<title[^>]*>(.*?)</title", re.IGNORECASE | re.DOTALL)
TLS_INSPECTORS = re.compile(
    r"proxy|inspect|intercept|firewall|gateway|filter|decrypt"
    r"|zscaler|netskope|forti|blue ?coat|sophos|palo ?alto",
    re.IGNORECASE,
)
"""Words in the names of certificate authorities with which companies decrypt and inspect TLS."""
LOCAL_AUTHORITY = "RSE-PF authority"
"""First words of the name of the certificate authority that rse-pf local --lan makes."""
MAX_SHOWN_TEXT = 60
"""Longest text of another program that an error message shows, in characters: a page title or a banner."""
MAX_SHOWN_ADDRESS = 200
"""Longest address of another program that an error message shows, in characters; a user has to open it."""
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
    "check that the servers of the platform run; {retry}",
)
CAUSE_AND_HINT = {
    401: NO_SERVER_OF_OURS,
    403: NO_SERVER_OF_OURS,
    407: (
        ": a proxy asks for a user name and a password",
        "set {variable}=http://USER:PASSWORD@PROXY:PORT",
    ),
    413: (
        ": a proxy on the way limits the size of uploads",
        "let the proxy in front of the platform pass bodies of 1 MiB (nginx: client_max_body_size)",
    ),
    426: (
        ": a proxy on the way removed the header Upgrade",
        "let the proxy in front of the platform pass on the headers Upgrade and Connection",
    ),
    429: (": too many attempts to connect", "{retry}"),
    451: NO_SERVER_OF_OURS,
    502: NO_SERVER_BEHIND_PROXY,
    503: (": the platform is full, or is starting", "{retry}"),
    504: NO_SERVER_BEHIND_PROXY,
    511: (": this network lets nothing pass before a login", "{login}"),
}
"""Cause and hint of the HTTP statuses that have one usual cause; the fields of a hint are filled in later:
when to try again, where to log in, and the environment variable that names the proxy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HttpAnswer:
    """An HTTP answer; ``headers`` has lower-case names, ``version`` is that of HTTP."""

    status: int
    headers: Mapping[str, str]
    body: bytes = b""
    version: str = "1.1"

    @property
    def shown_status(self) -> str:
        """Status and phrase for an error message, such as ``404 Not Found``; the version unless it is 1.1."""
        try:
            phrase = f" {HTTPStatus(self.status).phrase}"
        except ValueError:
            phrase = ""
        return f"{self.status}{phrase}" + (f" in HTTP/{self.version}" if self.version != "1.1" else "")

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

    @property
    def is_login(self) -> bool:
        """Whether a login page or a proxy answers like this, whatever the request was."""
        return self.status in FOREIGN_STATUSES or (self.status < 300 and self.is_foreign)


def parse_answer(data: bytes) -> HttpAnswer | None:
    """Return the HTTP answer, of any version, at the beginning of *data*; None if *data* is not HTTP."""
    matched = STATUS_LINE.match(data)
    if matched is None:
        return None
    head, _, body = data.replace(b"\r\n", b"\n").partition(b"\n\n")
    lines = (line.partition(":") for line in head.decode("latin-1").split("\n")[1:])
    headers = {name.strip().lower(): value.strip() for name, _, value in lines}
    return HttpAnswer(status=int(matched[2]), headers=headers, body=body, version=matched[1].decode())


def explain_answer(address: str, answer: HttpAnswer) -> ConnectError:
    """Return the error for an HTTP *answer* of *address* that no RSE-PF server sends.

    The cause is sought in the status first, then in headers and body.
    """
    status, statement = answer.status, f"{address} answers {answer.shown_status}"
    # 1. Recognise a wrong scheme in the URL, and a 400 of RSE-PF for headers that a proxy on the way removed.
    if status == 400 and TLS_WANTED.search(answer.body) and not _is_tls_address(address):
        return _explain_tls(address)
    if status == 400 and refusal_in(answer.body, "bad-message") is not None:
        status = 426
    # 2. Look up the cause of a status that has one usual cause.
    retry = _retry_hint(answer)
    if status in CAUSE_AND_HINT:
        cause, hint = CAUSE_AND_HINT[status]
        variable = f"{WEB_SCHEME[urlsplit(address).scheme].upper()}_PROXY"
        hint = hint.format(retry=retry, login=_login_hint(address), variable=variable)
        return ConnectError(f"{statement}{cause}", hint=hint)
    # 3. Explain redirects and pages by their target or content.
    if 300 <= status < 400:
        return _explain_redirect(address, answer)
    if 200 <= status < 300 or status == 101:
        return _explain_success(address, answer)
    # 4. Report that the server failed, or that another program answers.
    if status >= 500 and status not in (501, 505):
        return ConnectError(f"{statement}: the server failed", hint=f"see the log of the server; {retry}")
    server = _shorten(answer.headers.get("server", ""))
    sender = f" (a server that calls itself {server!r})" if server else ""
    has_server_path = urlsplit(address).path.rstrip("/").endswith("/ws") or not address.startswith("ws")
    hint = CHECK_PORT if has_server_path else "let the URL end with the path of the servers, /ws"
    return ConnectError(statement + sender, hint=hint)


def explain_bytes(address: str, data: bytes) -> ConnectError:
    """Return the error for the first bytes, *data*, that *address* sent instead of a WebSocket handshake."""
    answer = parse_answer(data)
    if answer is not None:
        return explain_answer(address, answer)
    if is_tls_server_answer(data):
        return _explain_tls(address)
    text = _shorten("".join(chr(byte) if 32 <= byte < 127 else " " for byte in data))
    sent = repr(text) if text else f"the bytes {data[:16].hex(' ')}"
    return ConnectError(f"another program answers at {address}: it sends {sent}", hint=CHECK_PORT)


def explain_silence(
    address: str, error: Exception, *, certificate: bytes | None, data: bytes, within_s: float | None = None
) -> ConnectError:
    """Return the error for an *address* that accepted a connection and sent no answer that can be read.

    Args:
        address: The URL as shown to users.
        error: What ended the attempt.
        certificate: What the peer showed to a second connection with TLS (DER), None if it speaks no TLS.
        data: First bytes of its answer to a connection without TLS, which is made if it speaks no TLS.
        within_s: How many seconds the attempt waited for the answer, None if unknown.
    """
    answer = parse_answer(data)
    is_http = answer is not None
    # 1. Compare the scheme of the URL with the peer: one of both uses TLS, and the other does not.
    if not _is_tls_address(address) and (certificate is not None or is_tls_server_answer(data)):
        return _explain_tls(address)
    if _is_tls_address(address) and certificate is None and is_http and not is_tls_server_answer(data):
        hint = f"write {OTHER_SCHEME[urlsplit(address).scheme]}:// in the URL, or a port that speaks TLS"
        return ConnectError(f"{address} speaks HTTP without TLS", hint=hint)
    # 2. Explain what another program answered to the second connection.
    if answer is not None and answer.is_login:
        # A login page may close the first connection before it has read the request.
        return explain_answer(address, answer)
    if data and not is_http and not is_tls_server_answer(data):
        return explain_bytes(address, data)
    # 3. Explain a failed TLS handshake.
    if isinstance(error, ssl.SSLError) and not isinstance(error, ssl.SSLEOFError):
        reason = (error.reason or str(error)).replace("_", " ").lower()
        hint = CHECK_PORT
        if "alert" in reason:
            hint = (
                "ask who runs the server or the firewall there why it refuses TLS 1.2 and newer from this "
                "robot"
            )
        return ConnectError(f"{address} ends the TLS handshake: {reason}", hint=hint)
    # 4. Report a peer that is slow (HTTP or TLS is spoken there), or that speaks another protocol.
    is_late = isinstance(error, (TimeoutError, asyncio.TimeoutError))
    within = "" if within_s is None else f" within {within_s:g} s"
    cause = f"sends no answer{within}" if is_late else "closed the connection without an answer"
    if is_http or certificate is not None:
        return ConnectError(f"{address} {cause}", hint="try again; see the load of the server")
    hint = (
        "check host and port of the URL; on the platform, rse-pf local status shows whether its servers run"
    )
    return ConnectError(f"{address} {cause}, as a program of another protocol does", hint=hint)


def explain_certificate(
    address: str, error: ssl.SSLCertVerificationError, *, issuer: str, is_enrolled: bool
) -> ConnectError:
    """Return the error for a TLS certificate that this robot does not trust, with a hint for each cause.

    Args:
        address: The URL as shown to users.
        error: Error of the TLS handshake.
        issuer: Name of the authority that signed the certificate, empty if unknown.
        is_enrolled: Whether the robot trusts the authority in its enrolment file and no other.
    """
    cause = error.verify_message.rstrip(".")
    authority = _shorten(issuer)
    issued_by = f" (issued by {authority!r})" if authority else ""
    message = f"{address} shows a certificate that this robot does not trust: {cause}{issued_by}"
    if error.verify_code in TIME_ERRORS:
        hint = "check the clock of this robot; a platform renews its certificate by itself"
    elif error.verify_code in NAME_ERRORS:
        hint = "write a host name in the URL for which the certificate was made"
    elif TLS_INSPECTORS.search(authority) and is_enrolled:
        hint = f"ask who runs the network to exempt {urlsplit(address).hostname} from the inspection of TLS"
    elif TLS_INSPECTORS.search(authority):
        hint = f"a proxy of the network inspects TLS: set SSL_CERT_FILE to the certificate of {authority!r}"
    elif is_enrolled:
        hint = "enrol again: rse-pf robot enrol ROBOT --out FILE, with --authority and its authority's file"
    elif authority.startswith(LOCAL_AUTHORITY):
        hint = (
            "connect by the file of rse-pf robot enrol ROBOT --out FILE, made by this platform; if you did, "
            "enrol again with --authority and the file of that authority"
        )
    else:
        hint = (
            "connect by the file of rse-pf robot enrol ROBOT --out FILE; with a certificate of your own, add "
            "--authority and the file of its authority"
        )
        if authority:
            hint += f"; if {authority!r} is a proxy of the network, set SSL_CERT_FILE to its certificate"
    return ConnectError(message, hint=hint)


def explain_proxy(
    address: str, proxy: str, variable: str, answer: HttpAnswer | None, *, has_credentials: bool
) -> ConnectError:
    """Return the error for an HTTP proxy that opens no tunnel to *address*.

    Args:
        address: The URL of the platform as shown to users.
        proxy: Address of the proxy without user name and password.
        variable: Environment variable that names the proxy, such as ``HTTPS_PROXY``.
        answer: Answer of the proxy to CONNECT; None if the proxy sent nothing that is HTTP.
        has_credentials: Whether the variable holds a user name.
    """
    host = urlsplit(address).hostname
    if answer is None:
        hint = f"correct {variable}, or name {host} in NO_PROXY"
        return ConnectError(f"{proxy}, which {variable} names, does not answer as a proxy", hint=hint)
    message = f"the proxy {proxy}, which {variable} names, answers {answer.shown_status} for {address}"
    if answer.status == 407 and has_credentials:
        hint = f"correct the user name and the password in {variable}"
    elif answer.status == 407:
        hint = f"set {variable}=http://USER:PASSWORD@HOST:PORT"
    elif answer.status == 511 or 300 <= answer.status < 400:
        hint = _login_hint(proxy)
    elif answer.status in (500, 502, 503, 504):
        hint = f"check host and port of the URL; if the proxy is not needed there, name {host} in NO_PROXY"
    elif answer.status in (401, 403):
        hint = f"ask who runs the proxy to allow CONNECT to it, or name {host} in NO_PROXY"
    else:
        hint = f"correct {variable}, or name {host} in NO_PROXY"
    return ConnectError(message, hint=hint)


def is_tls_server_answer(data: bytes) -> bool:
    """Return whether *data* is how TLS servers answer plain HTTP: a TLS record, or a 400 about TLS."""
    answer = parse_answer(data)
    if answer is not None:
        return answer.status == 400 and TLS_WANTED.search(answer.body) is not None
    return len(data) > 1 and data[0] in TLS_RECORD_TYPES and data[1] == 3


def _explain_tls(address: str) -> ConnectError:
    scheme = urlsplit(address).scheme
    hint = f"write {OTHER_SCHEME[scheme]}:// in the URL"
    return ConnectError(f"{address} speaks TLS, and {scheme}:// means a connection without TLS", hint=hint)


def _explain_redirect(address: str, answer: HttpAnswer) -> ConnectError:
    statement, parts = f"{address} answers {answer.shown_status}", urlsplit(address)
    web, location = parts._replace(scheme=WEB_SCHEME[parts.scheme]), answer.headers.get("location", "")
    try:
        target = urlsplit(urljoin(web.geturl(), location))
    except ValueError:
        location = ""
    if not location:
        return ConnectError(statement, hint=CHECK_PORT)
    target_host = target.netloc.rpartition("@")[2]
    shown_target = _shorten(f"{target.scheme}://{target_host}{target.path}", MAX_SHOWN_ADDRESS)
    statement += f", a redirect to {shown_target}"
    is_same_host = target.hostname == web.hostname and target.scheme in DEFAULT_PORTS
    if not is_same_host or LOGIN_WORDS.search(f"{target.path}?{target.query}") is not None:
        return ConnectError(f"{statement}: a login page", hint=_login_hint(shown_target))
    if target.scheme == "https" and web.scheme == "http":
        secure_url = f"{OTHER_SCHEME[parts.scheme]}://{target_host}{parts.path}"
        hint = f"write {_shorten(secure_url, MAX_SHOWN_ADDRESS)}: TLS is required there"
        return ConnectError(statement, hint=hint)
    return ConnectError(statement, hint=CHECK_PORT)


def _explain_success(address: str, answer: HttpAnswer) -> ConnectError:
    statement = f"{address} answers {answer.shown_status}"
    if not answer.is_page:
        content_type = _shorten(answer.headers.get("content-type", ""))
        shown_type = f" ({content_type})" if content_type else ""
        return ConnectError(f"{statement}{shown_type} as no RSE-PF server does", hint=CHECK_PORT)
    text = answer.body.decode("utf-8", "replace")
    title = PAGE_TITLE.search(text)
    shown_title = f" {_shorten(title[1])!r}" if title and _shorten(title[1]) else ""
    if LOGIN_WORDS.search(text):
        return ConnectError(f"{statement} with a login page{shown_title}", hint=_login_hint(address))
    hint = (
        f"open {_web_page(address)} in a web browser: log in there, or correct the URL if it is another site"
    )
    return ConnectError(f"{statement} with a web page{shown_title}, perhaps a login page", hint=hint)


def _login_hint(address: str) -> str:
    return f"open {_web_page(address)} in a web browser of this network, log in, and connect again"


def _web_page(address: str) -> str:
    """Return the address that a web browser opens: for ``ws:`` and ``wss:`` the host without the path."""
    parts = urlsplit(address)
    if parts.scheme in ("ws", "wss"):
        return f"{WEB_SCHEME[parts.scheme]}://{parts.netloc}/"
    return address


def _retry_hint(answer: HttpAnswer) -> str:
    retry_after = answer.headers.get("retry-after", "")
    is_number = retry_after.isdecimal() and len(retry_after) < 7
    return f"try again in {int(retry_after)} s" if is_number else "try again later"


def _is_tls_address(address: str) -> bool:
    return urlsplit(address).scheme in SECURE_SCHEMES


def _shorten(text: str, max_shown: int = MAX_SHOWN_TEXT) -> str:
    """Return a text of another program as one line of at most *max_shown* printable characters."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text[: 8 * max_shown]).split())
    return line if len(line) <= max_shown else f"{line[: max_shown - 3]}..."
