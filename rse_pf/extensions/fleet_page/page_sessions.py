"""The keys and sessions with which users view the page, or operate the platform from it.

A key opens one session and is invalid afterwards.  Keys and sessions are in memory only.  A browser stores
its session for one origin, which includes the port, and sends it in a header.  Unlike a cookie, the session
is not sent to other services of the same machine, and pages of other origins cannot send it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from rse_pf.errors import Forbidden, Unauthorized

__all__ = ["KEY_LIFE_S", "MAX_SESSIONS", "PageSessions", "Role"]

Role = Literal["view", "operate"]

KEY_LIFE_S = 3600.0
"""Time after which a key that was not used becomes invalid, in seconds."""
MAX_SESSIONS = 32
"""Largest number of sessions; above it, the least recently used one ends."""
# Largest number of unused keys; above it, the oldest one becomes invalid.
_MAX_KEYS = 64
# A session that was not used for this long ends, in seconds.
_MAX_IDLE_S = 12 * 3600.0
# Hint of errors about keys and sessions of users.
_NEW_KEY_HINT = "get a new address with: rse-pf fleet"
# Hint of errors about keys of operators.
_NEW_OPERATOR_KEY_HINT = "get one with: rse-pf fleet --operate"


@dataclass(slots=True)
class _Session:
    role: Role
    used_s: float


class PageSessions:
    """The unused keys, and the open sessions with their roles; only digests of both are stored."""

    def __init__(self, *, secret: Callable[[], str]) -> None:
        """Start without keys and sessions; *secret* returns a new random text at each call."""
        self._secret = secret
        self._keys: dict[bytes, tuple[Role, float]] = {}
        self._sessions: dict[bytes, _Session] = {}

    def new_key(self, role: Role, *, now_s: float) -> str:
        """Return a key that opens one session of *role* within `KEY_LIFE_S`."""
        key = self._secret()
        self._keys[_digest(key)] = (role, now_s + KEY_LIFE_S)
        while len(self._keys) > _MAX_KEYS:
            del self._keys[next(iter(self._keys))]
        return key

    def open(self, key: str, *, now_s: float) -> tuple[str, Role]:
        """Open a session with *key*, which becomes invalid; return the session and its role.

        Raises:
            Unauthorized: The key is unknown, was used already, or has expired.
        """
        role = self._take_key(key, now_s)
        if role is None:
            raise Unauthorized("this key is unknown, was used already, or is too old", hint=_NEW_KEY_HINT)
        session = self._secret()
        self._sessions[_digest(session)] = _Session(role, now_s)
        while len(self._sessions) > MAX_SESSIONS:
            del self._sessions[min(self._sessions, key=lambda name: self._sessions[name].used_s)]
        return session, role

    def promote(self, session: str, key: str, *, now_s: float) -> None:
        """Give *session* the role "operate", by an operator's *key*, which becomes invalid.

        Raises:
            Unauthorized: There is no such session, or the key is not valid.
            Forbidden: The key is for the role "view".
        """
        self.role_of(session, now_s=now_s)
        role = self._take_key(key, now_s)
        if role is None:
            raise Unauthorized(
                "this key is unknown, was used already, or is too old", hint=_NEW_OPERATOR_KEY_HINT
            )
        if role != "operate":
            raise Forbidden("this key allows to view the page only", hint=_NEW_OPERATOR_KEY_HINT)
        self._sessions[_digest(session)].role = "operate"

    def role_of(self, session: str, *, now_s: float) -> Role:
        """Return the role of *session*, and extend its life.

        Raises Unauthorized if it does not exist or expired.
        """
        entry = self._sessions.get(_digest(session))
        if entry is not None and now_s - entry.used_s > _MAX_IDLE_S:
            del self._sessions[_digest(session)]
            entry = None
        if entry is None:
            raise Unauthorized("this page has no session", hint=_NEW_KEY_HINT)
        entry.used_s = now_s
        return entry.role

    def check_operator(self, session: str, *, now_s: float) -> None:
        """Raise Forbidden if the role of *session* is "view", Unauthorized if there is no such session."""
        if self.role_of(session, now_s=now_s) != "operate":
            raise Forbidden("only an operator may do this", hint=_NEW_OPERATOR_KEY_HINT)

    def _take_key(self, key: str, now_s: float) -> Role | None:
        role, until_s = self._keys.pop(_digest(key), (None, 0.0))
        return role if now_s <= until_s else None


def _digest(text: str) -> bytes:
    """Return the SHA-256 by which a secret is looked up, so that the look-up's time reveals nothing of it."""
    return hashlib.sha256(text.encode("utf-8", "replace")).digest()
