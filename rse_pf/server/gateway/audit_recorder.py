"""Record the authentication of robots: accepted and refused handshakes, renewals, and revoked connections.

`AuditRecorder` collects notes (entries before they are written) in a worker, and sends them to the
supervisor, where `ServerAudit` writes them to the audit log.  A handshake never waits for the log.  Refusals
beyond a rate (`RefusalLimiter`) are counted, and only their number is written.  Names from an unverified
token are recorded as claimed.
"""

from __future__ import annotations

import time
from asyncio import AbstractEventLoop, TimerHandle
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from rse_pf.audit.entry import Entry, RefusalLimiter, Value
from rse_pf.audit.log import SYNC_S, AuditLog
from rse_pf.auth.claimed import claimed_by
from rse_pf.auth.tokens import Claims, KeySet
from rse_pf.server.gateway.handshake import Accepted, Rejected
from rse_pf.server.worker_context import Clocks

__all__ = ["AuditRecorder", "ServerAudit"]

_MAX_NOTES = 500  # notes in one message to the supervisor, which may have 1 MiB
_SUM_UP_S = 10.0  # seconds from a refusal that is only counted to the entry with the counts
_UNAUTHORIZED = 401  # HTTP status of a handshake that is rejected for its token


class AuditRecorder:
    """Collects the notes of one worker for the audit log, and sends them to the supervisor in batches.

    If the worker crashes, the notes of the last `SYNC_S` seconds are lost.
    """

    def __init__(
        self,
        clocks: Clocks,
        *,
        loop: AbstractEventLoop,
        send: Callable[..., None],
        is_on: bool = True,
        refusals: RefusalLimiter | None = None,
    ) -> None:
        """Hold nothing yet.

        Args:
            clocks: The clocks of the worker: monotonic for the rate limit, wall for the time of a note.
            loop: The event loop of the worker, which sends the batches.
            send: Sends its keyword arguments as a message to the supervisor.
            is_on: Whether the server has an audit log; otherwise nothing is collected.
            refusals: Limits how many refusals are recorded one by one; None means the default limits.
        """
        self._clocks = clocks
        self._loop = loop
        self._send_message = send
        self._is_on = is_on
        self._refusals = refusals or RefusalLimiter()
        self._held: list[dict[str, Any]] = []
        self._next: TimerHandle | None = None
        self._sum: TimerHandle | None = None

    def record_verdict(
        self, verdict: Accepted | Rejected, source: str, token: str, keys: KeySet | None = None
    ) -> None:
        """Record that a handshake from the address *source* was accepted, or rejected for its *token*.

        Rejections for other causes, and robots without a token, are not recorded.  *keys* has the roster,
        from which the tenant of a robot that signs its own tokens is read.
        """
        if isinstance(verdict, Accepted):
            if verdict.claims is not None:
                fields = _token_fields(verdict.claims)
                self._note("auth.accepted", str(verdict.claims.robot), **fields, source=source)
        elif verdict.status == _UNAUTHORIZED and self._may_record(verdict.reason):
            self._note("auth.refused", "", reason=verdict.reason, source=source, **claimed_by(token, keys))

    def record_renewal(self, before: Claims, claims: Claims) -> None:
        """Record that a connection got a fresh token, unless its id is that of the token *before*."""
        if claims.token_id != before.token_id:
            self._note("auth.renewed", str(claims.robot), **_token_fields(claims))

    def record_refused_renewal(self, before: Claims | None, reason: str) -> None:
        """Record that a fresh token was refused for *reason*, on the connection with the claims *before*."""
        if self._may_record(reason):
            self._note("auth.renewal-refused", "" if before is None else str(before.robot), reason=reason)

    def record_cut_off(self, claims: Claims, reason: str) -> None:
        """Record that a connection was closed because its token is no longer valid, for *reason*."""
        self._note("auth.cut-off", str(claims.robot), **_token_fields(claims), reason=reason)

    def flush(self) -> None:
        """Send all collected notes, and the counts of refusals, to the supervisor now."""
        self._sum_up()
        self._send()

    def _may_record(self, reason: str) -> bool:
        """Return whether a refusal for *reason* gets a note of its own; otherwise only count it."""
        if not self._is_on:
            return False
        may = self._refusals.take(reason, self._clocks.monotonic())
        if not may and self._sum is None:
            self._sum = self._loop.call_later(_SUM_UP_S, self._sum_up)
        return may

    def _sum_up(self) -> None:
        """Add one note with the numbers of the refusals that were only counted, by reason."""
        self._sum = None
        counted = self._refusals.summary()
        if counted:
            self._note("auth.refused-many", "", **counted)

    def _note(self, action: str, subject: str, /, **detail: Value) -> None:
        """Add a note to the next batch, which is sent within `SYNC_S`."""
        if not self._is_on:
            return
        note = {"time": self._clocks.wall(), "action": action, "subject": subject, "detail": detail}
        self._held.append(note)
        if self._next is None:
            self._next = self._loop.call_later(SYNC_S, self._send)

    def _send(self) -> None:
        self._next = None
        held, self._held = self._held, []
        for first in range(0, len(held), _MAX_NOTES):
            self._send_message(event="audit", notes=held[first : first + _MAX_NOTES])


class ServerAudit:
    """The audit log of one server, a context manager; without a folder nothing is recorded."""

    def __init__(self, folder: Path | None, server_id: str, *, on_problem: Callable[[str], None]) -> None:
        """Open nothing yet; entering the context opens the log, or raises ConfigurationError.

        Args:
            folder: The folder of the audit log; None records nothing.
            server_id: The name of the server, which is the actor of its entries.
            on_problem: Called with a sentence when the log cannot be written.
        """
        self._log = (
            None
            if folder is None
            else AuditLog(folder, server_id, wall_clock=time.time, on_problem=on_problem)
        )

    def note(self, action: str, **detail: Value) -> None:
        """Record that this server did *action*, such as ``server.drain``, with the fields *detail*."""
        if self._log is not None:
            self._log.record(action, **detail)

    def add(self, notes: Iterable[dict[str, Any]]) -> None:
        """Record the *notes* that a worker sent."""
        if self._log is not None:
            self._log.add(Entry(actor=self._log.who, **note) for note in notes)

    def __enter__(self) -> ServerAudit:
        if self._log is not None:
            self._log.open().start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._log is not None:
            self._log.close()


def _token_fields(claims: Claims) -> dict[str, str]:
    return {"token": claims.token_id, "key": claims.key_id}
