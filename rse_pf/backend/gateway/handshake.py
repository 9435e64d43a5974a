"""Judge a WebSocket handshake: path, capacity, token and sub-protocol, before anything is accepted.

Every rejection has a fixed body; the cause of a rejected token goes to the log only.  What a robot sent and
the time come in, `Accepted` or `Rejected` goes out.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rse_pf.auth.tokens import Claims, KeySet, token_problem, verify_token
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import HEALTH_PATH
from rse_pf.errors import Unauthorized
from rse_pf.identity import DEFAULT_TENANT, RobotId
from rse_pf.wire import SUBPROTOCOLS, codec_for

__all__ = ["HEALTH", "Accepted", "HandshakePolicy", "Rejected"]

HEALTH = "health"
"""Result of a request for the health page."""

_RETRY_AFTER_S = 2
_JSON = {"Content-Type": "application/json"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Accepted:
    """A robot that may upgrade to WebSocket.  ``expires_s`` is Unix time; None never expires."""

    robot: RobotId
    codec: str
    subprotocol: str
    expires_s: float | None = None
    claims: Claims | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rejected:
    """An HTTP answer instead of the upgrade.  ``reason`` is for the log and never sent."""

    status: int
    body: bytes
    result: str
    reason: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)


def _offered_token(offered: list[str]) -> str:
    """Return the token among the offered sub-protocols, as the header has it; a browser sets no header."""
    return next((f"Bearer {each[7:]}" for each in offered if each.startswith("bearer.")), "")


def _rejection(status: int, code: str, message: str, hint: str, **headers: str) -> Rejected:
    body = json.dumps({"code": code, "message": message, "hint": hint}, separators=(",", ":")).encode()
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Rejected(status=status, body=body, result=code, headers={**_JSON, **named})


class HandshakePolicy:
    """The rules of one worker for handshakes."""

    def __init__(
        self, settings: PlatformSettings, keys: KeySet | None, *, conformance_echo: bool = False
    ) -> None:
        self._settings = settings
        self.keys = keys
        self._conformance_echo = conformance_echo
        path = settings.serving.path
        self._path = path.encode()
        self._healthy = Rejected(status=200, body=b'{"status":"ok"}', result=HEALTH, headers=_JSON)
        self.defect = _rejection(500, "internal", "the handshake failed", "try again")
        self._not_found = _rejection(404, "not-found", "nothing is served here", f"connect to {path}")
        self._full = _rejection(
            503, "full", "this server serves as many robots as it may", "try again later",
            Retry_After=str(_RETRY_AFTER_S),
        )  # fmt: skip
        self.too_fast = _rejection(
            429, "quota", "too many messages, or handshakes of this address", "wait, and slow down",
            Retry_After=str(max(1, math.ceil(settings.session.rate_ban_s))),
        )  # fmt: skip
        self._no_token = _rejection(
            401, "unauthorized", "the token is missing or not valid",
            "issue one with rse-pf token issue ROBOT", WWW_Authenticate="Bearer",
        )  # fmt: skip
        self._no_subprotocol = _rejection(
            400, "unsupported", "no sub-protocol that this server speaks was offered",
            f"offer one of {', '.join(SUBPROTOCOLS.values())}",
        )  # fmt: skip

    def judge(
        self,
        *,
        path: bytes,
        authorization: str,
        offered: list[str],
        is_full: bool,
        anonymous: str,
        now_s: float,
    ) -> Accepted | Rejected:
        """Return which robot is accepted, or the HTTP answer that rejects it.

        Args:
            path: As requested, with its query.
            authorization: The header, "" if absent.
            offered: Sub-protocols, in the robot's order.
            is_full: Whether the worker has as many robots as it may.
            anonymous: Name of a robot where no token is required.
            now_s: Unix seconds.
        """
        unnamed = RobotId(DEFAULT_TENANT, anonymous)
        if self._conformance_echo:
            return Accepted(robot=unnamed, codec="", subprotocol="")
        if path == HEALTH_PATH.encode():
            return self._healthy
        if path.split(b"?")[0] != self._path:
            return self._not_found
        if is_full:
            return self._full
        claims = None
        if self.keys is not None:
            scheme, _, token = (authorization or _offered_token(offered)).partition(" ")
            verified = self.verified(token.strip(), now_s) if scheme.lower() == "bearer" else "unknown"
            if isinstance(verified, str):
                return replace(self._no_token, reason=verified)
            claims = verified
        codec = codec_for(offered)
        if codec is None:
            return self._no_subprotocol
        accepted = Accepted(robot=unnamed, codec=codec, subprotocol=SUBPROTOCOLS[codec])
        if claims is None:
            return accepted
        expires_s = self.ends_s(claims, now_s)
        return replace(accepted, robot=claims.robot, expires_s=expires_s, claims=claims)

    def ends_s(self, claims: Claims, now_s: float) -> float:
        """Return when a connection with *claims* ends, in Unix seconds; an expired token has its leeway."""
        leeway_s = self._settings.auth.leeway_s
        return claims.expires_s if now_s < claims.expires_s else claims.expires_s + leeway_s

    def verified(self, token: str, now_s: float) -> Claims | str:
        """Return the claims of *token*, or why it is refused, which goes to the log only."""
        if self.keys is None:
            return "no-keys"
        try:
            return verify_token(token, keys=self.keys, now=now_s, settings=self._settings.auth)
        except Unauthorized as error:
            return token_problem(error)
