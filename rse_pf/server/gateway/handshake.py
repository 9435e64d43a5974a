"""Accept or reject a WebSocket handshake by path, origin, capacity, token and sub-protocol, in this order.

Every rejection has a fixed body, and the cause of a rejected token is logged only.  Exception: a robot whose
token was signed with its own enrolled key gets the cause in the body.  The head of the request and the time
go in, `Accepted` or `Rejected` comes out.  The head is also parsed here, so that a rejection needs no
WebSocket library.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from http import HTTPStatus

from rse_pf.auth.origins import ORIGIN_HINT, AllowedOrigins, carried_token
from rse_pf.auth.tokens import (
    Claims,
    KeySet,
    ProvenRefusal,
    proven_refusal,
    token_problem,
    verify_token,
)
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import HEALTH_PATH, ROBOTS_PATH
from rse_pf.errors import Unauthorized
from rse_pf.identity import DEFAULT_TENANT, RobotId
from rse_pf.server.gateway.rate_limits import RATE_BAN_S
from rse_pf.wire import SUBPROTOCOLS, codec_for
from rse_pf.wire.refusal import CUT_OFF, refusal_body

__all__ = [
    "HEALTH", "Accepted", "HandshakePolicy", "Rejected", "RequestHead",
    "banned_rejection",
]  # fmt: skip

HEALTH = "health"
"""``Rejected.result`` of a request for the health page, which is answered with status 200."""

_RETRY_AFTER_S = 2  # seconds after which a robot may try a full server again: robots may have left by then
_HEALTH_PATH = HEALTH_PATH.encode()
_NO_KEYS = "no-keys"  # why a fresh token is refused by a server that requires no tokens
_JSON = {"Content-Type": "application/json"}
_HEAD = re.compile(
    rb"GET ([\x21-\x7e\x80-\xff]+) HTTP/1\.1((?:\r\n[0-9A-Za-z!#$%&'*+.^_`|~-]+:[\t\x20-\x7e\x80-\xff]*)*)"
)
"""The head of a GET request by RFC 9112, without its empty line; obsolete line folding does not match."""
_MAX_HEADERS = 128  # headers of one request: far more than robots, browsers and proxies send
_SINGLE = (b"content-length", b"sec-websocket-key", b"sec-websocket-version")  # headers that occur once only
_WEBSOCKET_KEY = re.compile(rb"[A-Za-z0-9+/]{22}==")  # 16 random bytes in base64: RFC 6455, 4.1
_VERSIONS = (b"13", b"8", b"7")  # WebSocket versions that are accepted: RFC 6455, and two drafts of it
_TOO_LONG = b"HTTP/1.1 431 Request Header Fields Too Large\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class Accepted:
    """The result of an accepted handshake: the robot, and the codec of its messages.

    ``expires_s`` is the Unix time (s) at which the connection is closed; None if no token is required.
    ``codec`` is "" for a connection that echoes messages.
    """

    robot: RobotId
    codec: str
    subprotocol: str
    expires_s: float | None = None
    claims: Claims | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected:
    """The HTTP answer to a handshake that is rejected, or to a request for the health page.

    ``result`` is the label under which the metric ``rse_pf_handshakes_total`` counts it.  ``reason`` is
    logged and never sent.
    """

    status: int
    body: bytes
    result: str
    reason: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)
    answer: bytes = field(default=b"", compare=False, repr=False)
    """The bytes of the whole HTTP answer; the connection is closed after them."""


class RequestHead:
    """The path and headers of a valid HTTP request; values of a repeated header are joined by commas."""

    __slots__ = ("_headers", "path", "websocket_key")

    def __init__(self, path: bytes, headers: dict[bytes, bytes]) -> None:
        self.path = path
        self._headers = headers
        self.websocket_key = self._read_key()
        """The header Sec-WebSocket-Key; empty if the request is no valid upgrade to WebSocket."""

    @classmethod
    def parse(cls, data: bytes) -> RequestHead | None:
        """Return the request head in *data*; None if it is not valid, no GET, or announces a body.

        *data* does not contain the empty line that ends the head.

        Source:
            RFC 9112, 3 and 5; RFC 6455, 4.2.1.
        """
        request_line = _HEAD.fullmatch(data)
        if request_line is None:
            return None
        lines = request_line[2].split(b"\r\n")
        if len(lines) - 1 > _MAX_HEADERS:
            return None
        headers: dict[bytes, bytes] = {}
        for line in lines[1:]:
            name, _, value = line.partition(b":")
            name = name.lower()
            if name in headers:
                if name in _SINGLE:
                    return None
                value = headers[name] + b"," + value.strip(b" \t")
            headers[name] = value.strip(b" \t")
        length = headers.get(b"content-length", b"0")
        if b"transfer-encoding" in headers or not length or length.strip(b"0"):
            return None
        return cls(request_line[1], headers)

    def text(self, name: bytes) -> str:
        """Return the value of the header *name*, given in lower case; "" if there is no such header."""
        value = self._headers.get(name)
        return "" if value is None else value.decode("ascii", "surrogateescape")

    def words(self, name: bytes) -> list[str]:
        """Return the comma-separated entries of the header *name*; one empty entry if there is no header."""
        text = self.text(name)
        return [word.strip() for word in text.split(",")] if "," in text else [text]

    def token(self) -> str:
        """Return the robot's token from the header Authorization or a sub-protocol; "" if there is none."""
        return carried_token(self.text(b"authorization"), self.words(b"sec-websocket-protocol"))

    def _read_key(self) -> bytes:
        """Return the key of a valid upgrade to WebSocket (RFC 6455, 4.2.1), or an empty one."""
        headers = self._headers
        key = headers.get(b"sec-websocket-key", b"")
        options = headers.get(b"connection", b"").lower()
        is_upgrade = (
            headers.get(b"upgrade", b"").lower() == b"websocket"
            and (options == b"upgrade" or b"upgrade" in options.translate(None, b" \t").split(b","))
            and headers.get(b"sec-websocket-version") in _VERSIONS
            and _WEBSOCKET_KEY.fullmatch(key)
        )
        return key if is_upgrade else b""


def _rejection(status: int, code: str, message: str, hint: str, **headers: str) -> Rejected:
    """Return a rejection with a JSON body; *headers* are further HTTP headers, with ``_`` for ``-``."""
    body = refusal_body(code, message, hint)
    return _http_answer(status, code, body, {**_JSON, **{k.replace("_", "-"): v for k, v in headers.items()}})


def banned_rejection(seconds: float) -> Rejected:
    """Return the rejection, with status 429, of a robot that is banned for *seconds* more."""
    wait_s = math.ceil(seconds)
    rejected = _rejection(
        429, "quota", f"this robot was cut off, and is refused for another {wait_s} s",
        "wait, and slow down; the server's log says why", Retry_After=str(wait_s),
    )  # fmt: skip
    return replace(rejected, reason="robot-cut-off")


def _proven_rejection(proven: ProvenRefusal, now_s: float) -> Rejected | None:
    """Return the rejection of a token with a valid signature of an enrolled robot, with the cause.

    The body also has the server's clock.  None if the cause is one that not even such a robot gets.
    """
    members: dict[str, float] = {"server_s": round(now_s, 3)}
    cause = proven.cause
    if cause == "disabled":
        message, hint = "this robot is disabled", "the operator allows it again by rse-pf robot enable ROBOT"
    elif cause == "revoked":
        message, hint = "this token is revoked", "sign another one"
    elif cause == "issued-too-early":
        cause, members["valid_from_s"] = CUT_OFF, proven.valid_from_s or 0.0
        message = f"tokens issued before {_utc(members['valid_from_s'])} are revoked"
        message += f", and this one was issued {-proven.off_s:.0f} s before the server's present time"
        hint = "sign another one; if it is refused, too, the clock of this robot is behind by so much: set it"
    elif cause == "not-yet-valid":
        message = f"the clock of this robot is {proven.off_s:.0f} s ahead of the server's"
        hint = "set the clock of this robot"
    elif cause == "expired":
        message = f"the token expired {proven.off_s:.0f} s ago by the server's clock"
        hint = "sign another one; if it is refused, too, the clock of this robot is behind: set it"
    else:
        return None
    body = refusal_body(Unauthorized.code, message, hint, cause=cause, **members)
    return _http_answer(401, Unauthorized.code, body, {**_JSON, "WWW-Authenticate": "Bearer"})


def _utc(unix_s: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(unix_s))


def _http_answer(status: int, result: str, body: bytes, headers: Mapping[str, str]) -> Rejected:
    """Return a rejection with the whole HTTP answer, which closes the connection."""
    lines = {**headers, "Content-Length": str(len(body)), "Connection": "close"}
    head = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    answer = f"HTTP/1.1 {status} {HTTPStatus(status).phrase}\r\n{head}\r\n".encode() + body
    return Rejected(status=status, body=body, result=result, headers=headers, answer=answer)


class HandshakePolicy:
    """Decides about the handshakes of one worker; ``keys`` verify tokens, None if none are required."""

    def __init__(
        self, settings: PlatformSettings, keys: KeySet | None, *, conformance_echo: bool = False
    ) -> None:
        """Prepare the rejections; with *conformance_echo* every handshake is accepted, to echo messages."""
        self._settings = settings
        self.keys = keys
        self._conformance_echo = conformance_echo
        self._path = ROBOTS_PATH.encode()
        self._origins = AllowedOrigins(settings.serving.allowed_origins)
        self._healthy = _http_answer(200, HEALTH, b'{"status":"ok"}', _JSON)
        self.defect = _rejection(500, "internal", "the handshake failed", "try again")
        self._not_found = _rejection(404, "not-found", "nothing is served here", f"connect to {ROBOTS_PATH}")
        self._full = _rejection(
            503, "full", "this server serves as many robots as it may", "try again later",
            Retry_After=str(_RETRY_AFTER_S),
        )  # fmt: skip
        self.too_fast = _rejection(
            429, "quota", "too many handshakes of this address", "wait, and slow down",
            Retry_After=str(max(1, math.ceil(RATE_BAN_S))),
        )  # fmt: skip
        self._no_token = _rejection(
            401, "unauthorized", "the token is missing or not valid",
            "issue one with rse-pf token issue ROBOT", WWW_Authenticate="Bearer",
        )  # fmt: skip
        self._forbidden = _rejection(
            403, "forbidden", "web pages of this origin are not allowed", ORIGIN_HINT
        )
        self.no_request = _rejection(
            400, "bad-message", "this is not a request for a WebSocket", "send an upgrade as in RFC 6455"
        )
        self.too_long = Rejected(status=431, body=b"", result="too-long", answer=_TOO_LONG)
        self._no_subprotocol = _rejection(
            400, "unsupported", "no sub-protocol that this server speaks was offered",
            f"offer one of {', '.join(SUBPROTOCOLS.values())}",
        )  # fmt: skip

    def decide(
        self, head: RequestHead, *, is_full: bool, anonymous: str, now_s: float
    ) -> Accepted | Rejected:
        """Return the accepted robot, or the HTTP answer that rejects the handshake.

        Args:
            head: The head of the request.
            is_full: Whether the worker has as many connections as it may, so that this one is rejected.
            anonymous: Name that the robot gets if no token is required.
            now_s: Present time, Unix seconds.
        """
        if self._conformance_echo:
            return Accepted(robot=RobotId(DEFAULT_TENANT, anonymous), codec="", subprotocol="")
        if head.path == _HEALTH_PATH:
            return self._healthy
        if head.path.partition(b"?")[0] != self._path:
            return self._not_found
        if not self._origins.allows(head.text(b"origin"), head.text(b"host")):
            return self._forbidden
        if is_full:
            return self._full
        codec = codec_for(head.words(b"sec-websocket-protocol")) or ""
        verdict: Accepted | Rejected
        if self.keys is None:
            robot = RobotId(DEFAULT_TENANT, anonymous)
            verdict = Accepted(robot=robot, codec=codec, subprotocol=SUBPROTOCOLS.get(codec, ""))
        else:
            verdict = self._with_token(head.token(), self.keys, now_s, codec=codec)
        return self._no_subprotocol if not codec and isinstance(verdict, Accepted) else verdict

    def _with_token(self, token: str, keys: KeySet, now_s: float, *, codec: str) -> Accepted | Rejected:
        """Return the robot of *token* as accepted, or the rejection if the token is not valid at *now_s*."""
        try:
            claims = verify_token(token, keys=keys, now=now_s, settings=self._settings.auth)
        except Unauthorized as error:
            proven = proven_refusal(error)
            refused = None if proven is None else _proven_rejection(proven, now_s)
            return replace(refused or self._no_token, reason=token_problem(error))
        return Accepted(
            robot=claims.robot, codec=codec, subprotocol=SUBPROTOCOLS.get(codec, ""),
            expires_s=self.ends_s(claims, now_s), claims=claims,
        )  # fmt: skip

    def ends_s(self, claims: Claims, now_s: float) -> float:
        """Return the Unix time (s) at which a connection with *claims* is closed.

        For a token that has expired within ``auth.leeway_s``, it is the end of that leeway.
        """
        leeway_s = self._settings.auth.leeway_s
        return claims.expires_s if now_s < claims.expires_s else claims.expires_s + leeway_s

    def claims_or_problem(self, token: str, now_s: float) -> Claims | str:
        """Return the claims of a fresh *token*, or the cause of its refusal, which is for the log only."""
        if self.keys is None:
            return _NO_KEYS
        try:
            return verify_token(token, keys=self.keys, now=now_s, settings=self._settings.auth)
        except Unauthorized as error:
            return token_problem(error)
