"""Record the authentication of robots: accepted and refused handshakes, renewals, and revoked connections.

`AuditRecorder` collects notes in a worker; `ServerAudit` writes them in the supervisor.  A handshake never
waits for the log.  Refusals beyond a rate are counted instead of written one by one, and the names in an
unverified token are recorded as claimed.
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

_MAX_NOTES = 500  # in one message, so that it stays below the 1 MiB that a line of the channel may have
_SUM_UP_S = 10.0  # counted refusals are written as one entry this often
_UNAUTHORIZED = 401


class AuditRecorder:
    """The notes of one worker, sent to the supervisor in batches; those that wait are lost if it crashes."""

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
            clocks: Monotonic for the rate, wall for the entries.
            loop: For the time of the next batch.
            send: Sends a message to the supervisor.
            is_on: Whether anything is recorded.
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
        """Record the verdict on a handshake with *token* from the address *source*, which *keys* gave."""
        if isinstance(verdict, Accepted):
            if verdict.claims is not None:
                fields = _token_fields(verdict.claims)
                self._note("auth.accepted", str(verdict.claims.robot), **fields, source=source)
        elif verdict.status == _UNAUTHORIZED and self._may_record(verdict.reason):
            self._note("auth.refused", "", reason=verdict.reason, source=source, **claimed_by(token, keys))

    def record_renewal(self, before: Claims, claims: Claims) -> None:
        """Record the fresh token of a live connection; the same token again is not recorded."""
        if claims.token_id != before.token_id:
            self._note("auth.renewed", str(claims.robot), **_token_fields(claims))

    def record_refused_renewal(self, before: Claims | None, reason: str) -> None:
        """Record that the fresh token of a live connection was refused."""
        if self._may_record(reason):
            self._note("auth.renewal-refused", "" if before is None else str(before.robot), reason=reason)

    def record_cut_off(self, claims: Claims, reason: str) -> None:
        """Record that a live connection was ended because its token is no longer valid."""
        self._note("auth.cut-off", str(claims.robot), **_token_fields(claims), reason=reason)

    def flush(self) -> None:
        """Send the notes that are held, now."""
        self._sum_up()
        self._send()

    def _may_record(self, reason: str) -> bool:
        if not self._is_on:
            return False
        may = self._refusals.take(reason, self._clocks.monotonic())
        if not may and self._sum is None:
            self._sum = self._loop.call_later(_SUM_UP_S, self._sum_up)
        return may

    def _sum_up(self) -> None:
        self._sum = None
        counted = self._refusals.summary()
        if counted:
            self._note("auth.refused-many", "", **counted)

    def _note(self, action: str, subject: str, /, **detail: Value) -> None:
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
    """The audit log of one server; without a folder for it, nothing is recorded."""

    def __init__(self, folder: Path | None, server_id: str, *, on_problem: Callable[[str], None]) -> None:
        """Open nothing yet; entering raises ConfigurationError if the log cannot be kept."""
        self._log = (
            None
            if folder is None
            else AuditLog(folder, server_id, wall_clock=time.time, on_problem=on_problem)
        )

    def note(self, action: str, **detail: Value) -> None:
        """Record an action of this server."""
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
