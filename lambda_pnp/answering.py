"""Answer one HTTP event of AWS Lambda; keys, settings and time are arguments.

No body is decoded before the token is verified.  Every event, whatever it holds, gets a result or an error
with a code.
"""

from __future__ import annotations

import base64
import json
import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from msgspec import structs

from lambda_pnp.keys import KeyCache, read_object
from rse_pf.auth.roster import scopes_allow
from rse_pf.auth.tokens import verify_token
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import (
    BadMessage,
    Expired,
    Forbidden,
    LimitExceeded,
    RsePfError,
    Unauthorized,
    UnsupportedProtocol,
)
from rse_pf.service import Registry, dispatch, failure_of
from rse_pf.services import pnp
from rse_pf.services.pnp_reader import pnp_reader
from rse_pf.wire import SUBPROTOCOLS, Codec, Command, Failure, codec_for
from rse_pf.wire.envelope import undecodable_id
from rse_pf.wire.server_codec import make_server_codec

__all__ = ["Answering", "LambdaAnswer", "load_answering"]

_ROOT = Path(__file__).resolve().parents[1]
_SERVER_NAME = "lambda"  # the id of the server in answers of this function
# Longest period between two fetches of keys, roster and deny list, in seconds: for about this time the
# function may still accept a revoked token.
_MAX_STALE_S = 30.0
# Most headers of one request; robots send about ten.
_MAX_HEADERS = 200
# Scope that every token needs; the body of a request without it is not decoded.
_REQUIRED_SCOPE = "services:pnp"
# Headers that the function uses, so that a request must not repeat them.
_USED_HEADERS = ("authorization", "content-type")


@dataclass(frozen=True, slots=True, kw_only=True)
class LambdaAnswer:
    """One answer: HTTP status, content type and body."""

    status: int
    content_type: str
    body: bytes

    def as_http(self, event: object, *, init_ms: float, cold: bool) -> dict[str, Any]:
        """Return this answer as the response of the function to *event*.

        Args:
            event: The event; a load balancer wants headers in the form of the event: single values or lists.
            init_ms: Time of the cold start in ms, 0 without one; becomes the header x-rse-pf-init-ms.
            cold: Whether this execution environment was new; becomes the header x-rse-pf-cold.
        """
        headers = {
            "content-type": self.content_type,
            "x-rse-pf-init-ms": f"{init_ms:.1f}",
            "x-rse-pf-cold": str(cold).lower(),
        }
        has_lists = isinstance(event, Mapping) and "multiValueHeaders" in event
        return {
            "statusCode": self.status,
            **(
                {"multiValueHeaders": {name: [value] for name, value in headers.items()}}
                if has_lists
                else {"headers": headers}
            ),
            "isBase64Encoded": True,
            "body": base64.b64encode(self.body).decode(),
        }


class Answering:
    """Answers the events of one execution environment, with its keys and settings, by the PnP service."""

    def __init__(
        self,
        settings: PlatformSettings,
        keys: KeyCache,
        *,
        log: Callable[..., None] | None = None,
    ) -> None:
        self._settings = settings
        self._log = log or _to_stderr
        self._keys = keys
        self._registry = Registry()
        pnp.register(self._registry, settings.pnp)
        self._codecs: dict[str, Codec] = {
            name: make_server_codec(name, settings.session, read_first=pnp_reader(self._registry, name))
            for name in SUBPROTOCOLS
        }

    def answer(
        self, event: Mapping[str, Any], *, now_s: float, left_ms: float, clock: Callable[[], float]
    ) -> LambdaAnswer:
        """Return the answer to *event*: 400 or 401 without a valid head, else 200 with a result or failure.

        Args:
            event: Event of a load balancer or a Function URL.
            now_s: Unix time, with which the token is verified.
            left_ms: Time before Lambda ends this execution; an answer that is later is Expired.
            clock: Monotonic seconds.
        """
        arrived = clock()
        try:
            headers, body = _read(event)
            kind, _, token = headers.get("authorization", "").partition(" ")
            claims = verify_token(
                token.strip() if kind.lower() == "bearer" else "",
                keys=self._keys.at(arrived), now=now_s, settings=self._settings.auth,
            )  # fmt: skip
            codec = self._codec(headers.get("content-type", ""))
        except RsePfError as error:
            return _error_answer(error)
        try:
            if not scopes_allow(claims.scopes, _REQUIRED_SCOPE):
                raise _forbidden_error(_REQUIRED_SCOPE)
            data = self._decode(body)
        except RsePfError as error:
            return self._encode(codec, failure_of(error, server=_SERVER_NAME))
        try:
            message = codec.decode_from_robot(data)
            if not isinstance(message, Command):
                raise BadMessage(
                    "this is not a command", hint="send commands only; this function has no sessions"
                )
        except RsePfError as error:
            failure = failure_of(error, server=_SERVER_NAME)
            return self._encode(codec, structs.replace(failure, id=undecodable_id(codec, data)))
        allowed_ms = self._settings.session.answer_timeout_s * 1e3
        allowed_ms = min(left_ms, allowed_ms if message.deadline_ms is None else message.deadline_ms)
        if (clock() - arrived) * 1e3 >= allowed_ms:
            return self._encode(codec, self._deadline_failure(message))
        if not scopes_allow(claims.scopes, f"services:{message.service}"):
            forbidden = _forbidden_error(f"services:{message.service}")
            return self._encode(codec, failure_of(forbidden, message, server=_SERVER_NAME))
        answer = dispatch(self._registry, message, clock, server=_SERVER_NAME)
        if (clock() - arrived) * 1e3 > allowed_ms:
            answer = self._deadline_failure(message)
        self._log(
            event="command", robot=str(claims.robot), service=message.service, id=message.id,
            trace=message.trace, code=answer.code if isinstance(answer, Failure) else "ok",
            took_ms=round((clock() - arrived) * 1e3, 3),
        )  # fmt: skip
        return self._encode(codec, answer)

    def _codec(self, content_type: str) -> Codec:
        subprotocol = content_type.partition(";")[0].strip().removeprefix("application/")
        name = codec_for([subprotocol])
        if name is None:
            raise UnsupportedProtocol(
                "the request names no supported sub-protocol",
                hint=f"set Content-Type to one of {', '.join(SUBPROTOCOLS.values())}",
            )
        return self._codecs[name]

    def _decode(self, body: str | bytes) -> bytes:
        """Return the bytes of *body*; decode a ``str`` as base64.

        Raises:
            LimitExceeded: A ``str`` is longer than the base64 of ``session.max_message_bytes``.
            BadMessage: A ``str`` is not base64.
        """
        if isinstance(body, bytes):
            return body
        max_bytes = self._settings.session.max_message_bytes
        if len(body) > 4 * (max_bytes // 3 + 1):
            raise LimitExceeded(f"the body is longer than {max_bytes} bytes", hint="send smaller messages")
        try:
            return base64.b64decode(body, validate=True)
        except ValueError as error:
            raise BadMessage("the body is not base64", hint="send the bytes of one message") from error

    @staticmethod
    def _deadline_failure(command: Command) -> Any:
        error = Expired("the deadline passed before the answer was ready", hint="set a longer deadline_s")
        return failure_of(error, command, server=_SERVER_NAME)

    @staticmethod
    def _encode(codec: Codec, message: Any) -> LambdaAnswer:
        return LambdaAnswer(
            status=200, content_type=f"application/{SUBPROTOCOLS[codec.name]}", body=codec.encode(message)
        )


def _to_stderr(**fields: Any) -> None:
    sys.stderr.write(json.dumps(fields) + "\n")


def _forbidden_error(right: str) -> Forbidden:
    return Forbidden(f"this token does not hold the scope {right}", hint="issue one that does")


def _error_answer(error: RsePfError) -> LambdaAnswer:
    body = {"code": error.code, "message": error.message, "hint": error.hint}
    status = 401 if isinstance(error, Unauthorized) else 400
    return LambdaAnswer(status=status, content_type="application/json", body=json.dumps(body).encode())


def _read(event: object) -> tuple[dict[str, str], str | bytes]:
    """Return the headers of *event*, with names in small letters, and its body.

    The body is a ``str`` if *event* says that it is base64, else bytes.

    Raises:
        BadMessage: *event* is not an event of a load balancer or a Function URL.
    """
    if not isinstance(event, Mapping):
        raise _bad_event("it is not an object")
    headers, body = _headers(event), event.get("body") or ""
    if not isinstance(body, str):
        raise _bad_event("its body is not a text")
    if event.get("isBase64Encoded"):
        return headers, body
    try:
        return headers, body.encode()
    except UnicodeEncodeError as error:
        raise _bad_event("its body is not UTF-8") from error


def _headers(event: Mapping[Any, Any]) -> dict[str, str]:
    """Return the headers of *event*, with names in small letters; repeated headers are left out.

    Raises:
        BadMessage: Names or values are no texts, there are too many headers, or one of `_USED_HEADERS` is
            repeated.
    """
    lists = event.get("multiValueHeaders")
    headers = lists or event.get("headers") or {}
    if not isinstance(headers, Mapping) or len(headers) > _MAX_HEADERS:
        raise _bad_event(f"its headers are not an object of at most {_MAX_HEADERS} texts")
    lowered: dict[str, str] = {}
    for name, value in headers.items():
        if lists and isinstance(value, list) and len(value) == 1:
            (value,) = value
        if not isinstance(name, str) or not (isinstance(value, str) or (lists and isinstance(value, list))):
            raise _bad_event("a header is not a text")
        if name.lower() in lowered or not isinstance(value, str):
            if name.lower() in _USED_HEADERS:
                raise _bad_event(f"there is more than one {name.lower()}")
            continue
        lowered[name.lower()] = value
    return lowered


def _bad_event(problem: str) -> BadMessage:
    return BadMessage(
        f"this is not an event of a load balancer or a Function URL: {problem}",
        hint="call the function by the address of the platform",
    )


def load_answering() -> Answering:
    """Return the `Answering` of a new execution environment, with the settings in the package.

    The keys are read from the artifact bucket at the first request.
    """
    settings = load_settings(_ROOT / "settings.json")

    def read(control: str = "") -> str:
        return read_object(os.environ, datetime.now(timezone.utc), control)

    period_s = min(_MAX_STALE_S, settings.scaling.period_s)
    return Answering(settings, KeyCache(read, period_s, read_control=read))
