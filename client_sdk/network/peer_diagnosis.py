"""The cause of a failed connection, from the facts: status line, headers, first bytes, or certificate.

Between a robot and its servers stand login pages, proxies and firewalls, and another program may have the
port.  Each function returns the error for one kind of fact: a sentence, and the action that helps.
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
    "is_of_tls_server",
    "parse_answer",
]

_OTHER_SCHEME = {"ws": "wss", "wss": "ws", "http": "https", "https": "http"}
_WEB_SCHEME = {"ws": "http", "wss": "https", "http": "http", "https": "https"}
_DEFAULT_PORTS = {"http": 80, "https": 443}
_SECURE = ("wss", "https")
_CHECK_PORT = "check host and port of the URL: no RSE-PF server answers there"
_STATUS_LINE = re.compile(rb"HTTP/(\d(?:\.\d)?) +(\d{3})\b[^\r\n]*")
_FOREIGN_STATUSES = (101, 301, 302, 303, 308, 407, 511)
"""Of login pages and proxies; the data service redirects by 307 only, to presigned addresses."""
_TLS_WANTED = re.compile(rb"https|\bssl\b|\btls\b", re.IGNORECASE)
"""In the 400 of nginx, Apache and Go for plain HTTP at a TLS port."""
_LOGIN = re.compile(
    r"\blog[ -]?[io]n\b|\bsign[ -]?in\b|\bo?auth2?\b|\bsso\b|captive|portal|password|<form"
    r"|http-equiv=.?refresh",
    re.IGNORECASE,
)
_TITLE = re.compile(r"<title[^>]*>(.*?)</title", re.IGNORECASE | re.DOTALL)
_INSPECTORS = re.compile(
    r"proxy|inspect|intercept|firewall|gateway|filter|decrypt"
    r"|zscaler|netskope|forti|blue ?coat|sophos|palo ?alto",
    re.IGNORECASE,
)
"""Names of authorities with which companies inspect TLS."""
_OUR_AUTHORITY = "RSE-PF authority"
"""Begin of the name of the authority that rse-pf local --lan makes."""
_MAX_SHOWN = 60
"""Characters of a foreign text that an error message shows: a title or a banner, still in one line."""
_MAX_ADDRESS = 200
"""Characters of a foreign address that is shown whole, so that a user can open it."""
_TLS_RECORDS = range(0x14, 0x18)
"""Record types of RFC 8446, 5.1."""
_TIMES = (9, 10)
"""Of X509_verify_cert_error_string(3): not yet valid, expired."""
_NAMES = (62, 64)
"""Of the same list: the certificate is for another host name, for another address."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HttpAnswer:
    """An HTTP answer; the names of ``headers`` are in lower case."""

    status: int
    headers: Mapping[str, str]
    body: bytes = b""
    version: str = "1.1"

    @property
    def shown(self) -> str:
        """Status and phrase, and the version if it is not the usual one."""
        try:
            phrase = f" {HTTPStatus(self.status).phrase}"
        except ValueError:
            phrase = ""
        return f"{self.status}{phrase}" + (f" in HTTP/{self.version}" if self.version != "1.1" else "")

    @property
    def is_page(self) -> bool:
        """Whether the body is a page for a web browser."""
        kind = self.headers.get("content-type", "").lower()
        return "html" in kind or (not kind and self.body.lstrip()[:1] == b"<")

    @property
    def is_foreign(self) -> bool:
        """Whether no data service sends this, which writes JSON or binary data: a login page, or a proxy."""
        is_text = self.headers.get("content-type", "").lower().startswith("text/")
        return self.status in _FOREIGN_STATUSES or is_text or self.is_page

    @property
    def is_login(self) -> bool:
        """Whether a login page or a proxy sends this whatever is asked for."""
        return self.status in _FOREIGN_STATUSES or (self.status < 300 and self.is_foreign)


def parse_answer(data: bytes) -> HttpAnswer | None:
    """Return the HTTP answer of any version that *data* begins with, None if it is not HTTP."""
    matched = _STATUS_LINE.match(data)
    if matched is None:
        return None
    head, _, body = data.replace(b"\r\n", b"\n").partition(b"\n\n")
    lines = (line.partition(":") for line in head.decode("latin-1").split("\n")[1:])
    headers = {name.strip().lower(): value.strip() for name, _, value in lines}
    return HttpAnswer(status=int(matched[2]), headers=headers, body=body, version=matched[1].decode())


def explain_answer(address: str, answer: HttpAnswer) -> ConnectError:
    """Return what it means that *address* answers as no RSE-PF server does."""
    status, says = answer.status, f"{address} answers {answer.shown}"
    later = _later(answer)
    if status == 407:
        variable = f"{_WEB_SCHEME[urlsplit(address).scheme].upper()}_PROXY"
        hint = f"set {variable}=http://USER:PASSWORD@PROXY:PORT"
        return ConnectError(f"{says}: a proxy asks for a user name and a password", hint=hint)
    if status == 511:
        return ConnectError(f"{says}: this network lets nothing pass before a login", hint=_log_in(address))
    if 300 <= status < 400:
        return _explain_redirect(address, answer)
    if 200 <= status < 300 or status == 101:
        return _explain_success(address, answer)
    if status in (401, 403, 451):
        hint = "a firewall or a login page between robot and platform answered: ask who runs the network"
        return ConnectError(f"{says}, and it is not an RSE-PF server that says so", hint=hint)
    if status == 400 and _TLS_WANTED.search(answer.body) and not _is_secure(address):
        return _explain_tls(address)
    if status == 426 or (status == 400 and refusal_in(answer.body, "bad-message") is not None):
        hint = "let the proxy before the platform pass on the headers Upgrade and Connection"
        return ConnectError(f"{says}: a proxy on the way removed the header Upgrade", hint=hint)
    if status == 413:
        hint = "let the proxy before the platform pass bodies of 1 MiB (nginx: client_max_body_size)"
        return ConnectError(f"{says}: a proxy on the way limits the size of uploads", hint=hint)
    if status == 429:
        return ConnectError(f"{says}: too many attempts to connect", hint=later)
    if status == 503:
        return ConnectError(f"{says}: the platform is full or starts", hint=later)
    if status in (502, 504):
        hint = f"check that the servers of the platform run; {later}"
        return ConnectError(f"{says}: a proxy before the platform reaches no server", hint=hint)
    if status >= 500 and status not in (501, 505):
        return ConnectError(f"{says}: the server failed", hint=f"see the log of the server; {later}")
    server = _clean(answer.headers.get("server", ""))
    by = f" (a server that calls itself {server!r})" if server else ""
    if urlsplit(address).path.rstrip("/").endswith("/ws") or not address.startswith("ws"):
        return ConnectError(says + by, hint=_CHECK_PORT)
    return ConnectError(says + by, hint="check the URL: it ends with the path of the servers, /ws")


def explain_bytes(address: str, data: bytes) -> ConnectError:
    """Return what it means that *address* answers with *data* instead of a WebSocket."""
    answer = parse_answer(data)
    if answer is not None:
        return explain_answer(address, answer)
    if is_of_tls_server(data):
        return _explain_tls(address)
    text = _clean("".join(chr(byte) if 32 <= byte < 127 else " " for byte in data))
    sent = repr(text) if text else f"the bytes {data[:16].hex(' ')}"
    return ConnectError(f"another program answers at {address}: it sends {sent}", hint=_CHECK_PORT)


def explain_silence(
    address: str, error: Exception, *, certificate: bytes | None, data: bytes, within_s: float | None = None
) -> ConnectError:
    """Return what it means that *address* accepted a connection and sent no answer that can be read.

    Args:
        address: As shown to users.
        error: Of the attempt.
        certificate: That a second attempt with TLS was shown, None if the peer does not speak TLS.
        data: The peer's answer to a second attempt without TLS.
        within_s: How long the attempt waited for the answer, None if that is unknown.
    """
    answer = parse_answer(data)
    is_http = answer is not None
    if not _is_secure(address) and (certificate is not None or is_of_tls_server(data)):
        return _explain_tls(address)
    if _is_secure(address) and certificate is None and is_http and not is_of_tls_server(data):
        hint = f"write {_OTHER_SCHEME[urlsplit(address).scheme]}:// in the URL, or a port that speaks TLS"
        return ConnectError(f"{address} speaks HTTP without TLS", hint=hint)
    if answer is not None and answer.is_login:
        return explain_answer(address, answer)  # it closed before it had read the first request
    if data and not is_http and not is_of_tls_server(data):
        return explain_bytes(address, data)
    if isinstance(error, ssl.SSLError) and not isinstance(error, ssl.SSLEOFError):
        reason = (error.reason or str(error)).replace("_", " ").lower()
        refused = (
            "ask who runs the server or the firewall there why it refuses TLS 1.2 and newer from this robot"
        )
        hint = refused if "alert" in reason else _CHECK_PORT
        return ConnectError(f"{address} ends the TLS handshake: {reason}", hint=hint)
    is_late = isinstance(error, (TimeoutError, asyncio.TimeoutError))
    within = "" if within_s is None else f" within {within_s:g} s"
    cause = f"sends no answer{within}" if is_late else "closed the connection without an answer"
    if is_http or certificate is not None:  # in the scheme of the address: the others were explained above
        return ConnectError(f"{address} {cause}", hint="try again; see the load of the server")
    hint = (
        "check host and port of the URL; on the platform, rse-pf local status shows whether its servers run"
    )
    return ConnectError(f"{address} {cause}, as a program of another protocol does", hint=hint)


def explain_certificate(
    address: str, error: ssl.SSLCertVerificationError, *, issuer: str, is_enrolled: bool
) -> ConnectError:
    """Return what it means that a certificate of *issuer* is not trusted; the name is empty if unknown.

    ``is_enrolled`` says that the robot trusts the authority of its enrolment, and no other.
    """
    why = error.verify_message.rstrip(".")
    by = _clean(issuer)
    of = f" (issued by {by!r})" if by else ""
    message = f"{address} shows a certificate that this robot does not trust: {why}{of}"
    if error.verify_code in _TIMES:
        hint = "check the clock of this robot; a platform renews its certificate by itself"
    elif error.verify_code in _NAMES:
        hint = "write a host in the URL for which the certificate is made"
    elif _INSPECTORS.search(by) and is_enrolled:
        hint = f"ask who runs the network to exempt {urlsplit(address).hostname} from the inspection of TLS"
    elif _INSPECTORS.search(by):
        hint = f"a proxy of the network inspects TLS: set SSL_CERT_FILE to the certificate of {by!r}"
    elif is_enrolled:
        hint = "enrol again: rse-pf robot enrol ROBOT --out FILE, with --authority and its authority's file"
    elif by.startswith(_OUR_AUTHORITY):
        hint = (
            "connect by the file of rse-pf robot enrol ROBOT --out FILE, made by this platform; if you did, "
            "enrol again with --authority and the file of that authority"
        )
    else:
        hint = (
            "connect by the file of rse-pf robot enrol ROBOT --out FILE; with a certificate of your own, add "
            "--authority and the file of its authority"
        )
        if by:
            hint += f"; if {by!r} is a proxy of the network, set SSL_CERT_FILE to its certificate"
    return ConnectError(message, hint=hint)


def explain_proxy(
    address: str, proxy: str, variable: str, answer: HttpAnswer | None, *, has_credentials: bool
) -> ConnectError:
    """Return what it means that *proxy*, named in *variable*, opens no tunnel to *address*."""
    host = urlsplit(address).hostname
    if answer is None:
        hint = f"correct {variable}, or name {host} in NO_PROXY"
        return ConnectError(f"{proxy} of {variable} does not answer as a proxy", hint=hint)
    message = f"the proxy {proxy} of {variable} answers {answer.shown} for {address}"
    if answer.status == 407 and has_credentials:
        hint = f"correct the user name and the password in {variable}"
    elif answer.status == 407:
        hint = f"set {variable}=http://USER:PASSWORD@HOST:PORT"
    elif answer.status == 511 or 300 <= answer.status < 400:
        hint = _log_in(proxy)
    elif answer.status in (500, 502, 503, 504):
        hint = f"check host and port of the URL; if the proxy is not needed there, name {host} in NO_PROXY"
    elif answer.status in (401, 403):
        hint = f"ask who runs the proxy to allow CONNECT to it, or name {host} in NO_PROXY"
    else:
        hint = f"correct {variable}, or name {host} in NO_PROXY"
    return ConnectError(message, hint=hint)


def is_of_tls_server(data: bytes) -> bool:
    """Return whether *data* is how a TLS server answers plain HTTP: a TLS record, or a 400 that says so."""
    answer = parse_answer(data)
    if answer is not None:
        return answer.status == 400 and _TLS_WANTED.search(answer.body) is not None
    return len(data) > 1 and data[0] in _TLS_RECORDS and data[1] == 3


def _explain_tls(address: str) -> ConnectError:
    scheme = urlsplit(address).scheme
    hint = f"write {_OTHER_SCHEME[scheme]}:// in the URL"
    return ConnectError(f"{address} speaks TLS, and {scheme}:// means none", hint=hint)


def _explain_redirect(address: str, answer: HttpAnswer) -> ConnectError:
    says, parts = f"{address} answers {answer.shown}", urlsplit(address)
    web, location = parts._replace(scheme=_WEB_SCHEME[parts.scheme]), answer.headers.get("location", "")
    try:
        target = urlsplit(urljoin(web.geturl(), location))
    except ValueError:
        location = ""
    if not location:
        return ConnectError(says, hint=_CHECK_PORT)
    shown = _clean(f"{target.scheme}://{target.netloc.rpartition('@')[2]}{target.path}", _MAX_ADDRESS)
    says += f", a redirect to {shown}"
    if target.hostname == web.hostname and target.scheme in _DEFAULT_PORTS:
        is_login = _LOGIN.search(f"{target.path}?{target.query}") is not None
        if not is_login and target.scheme == "https" and web.scheme == "http":
            secure = f"{_OTHER_SCHEME[parts.scheme]}://{target.netloc.rpartition('@')[2]}{parts.path}"
            return ConnectError(says, hint=f"write {_clean(secure, _MAX_ADDRESS)}: TLS is required there")
        if not is_login:
            return ConnectError(says, hint=_CHECK_PORT)
    return ConnectError(f"{says}: a login page", hint=_log_in(shown))


def _explain_success(address: str, answer: HttpAnswer) -> ConnectError:
    says = f"{address} answers {answer.shown}"
    if not answer.is_page:
        kind = _clean(answer.headers.get("content-type", ""))
        return ConnectError(
            f"{says}{f' ({kind})' if kind else ''} as no RSE-PF server does", hint=_CHECK_PORT
        )
    text = answer.body.decode("utf-8", "replace")
    title = _TITLE.search(text)
    of = f" {_clean(title[1])!r}" if title and _clean(title[1]) else ""
    if _LOGIN.search(text):
        return ConnectError(f"{says} with a login page{of}", hint=_log_in(address))
    hint = (
        f"open {_web_page(address)} in a web browser: log in there, or correct the URL if it is another site"
    )
    return ConnectError(f"{says} with a web page{of}, perhaps a login page", hint=hint)


def _log_in(where: str) -> str:
    return f"open {_web_page(where)} in a web browser of this network, log in, and connect again"


def _web_page(address: str) -> str:
    """Return *address* for a browser; of servers, which have no page at their path, the host alone."""
    parts = urlsplit(address)
    if parts.scheme in ("ws", "wss"):
        return f"{_WEB_SCHEME[parts.scheme]}://{parts.netloc}/"
    return address


def _later(answer: HttpAnswer) -> str:
    after = answer.headers.get("retry-after", "")
    return f"try again in {int(after)} s" if after.isdecimal() and len(after) < 7 else "try again later"


def _is_secure(address: str) -> bool:
    return urlsplit(address).scheme in _SECURE


def _clean(text: str, max_shown: int = _MAX_SHOWN) -> str:
    """Return a foreign *text* in one short line that holds no control characters."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text[: 8 * max_shown]).split())
    return line if len(line) <= max_shown else f"{line[: max_shown - 3]}..."
