"""Close the connections of a worker whose token expires or is revoked, or whose robot has a newer connection.

A robot gets only the close code, and no further reason.  A fresh token on an open connection renews it.
"""

from __future__ import annotations

from asyncio import TimerHandle
from collections.abc import Callable
from functools import partial

from rse_pf.auth.tokens import Claims, KeySet, claims_problem, renewed_claims
from rse_pf.server.gateway.audit_recorder import AuditRecorder
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.gateway.handshake import HandshakePolicy
from rse_pf.server.worker_context import WorkerContext
from rse_pf.wire.server_session import CLOSE_REPLACED, CLOSE_REVOKED, CLOSE_TOKEN_OVER

__all__ = ["TokenWatch"]


class TokenWatch:
    """Watches the tokens of all connections of one worker; the dispatcher calls `watch` and `forget`."""

    def __init__(
        self,
        context: WorkerContext,
        connections: set[RobotConnection],
        handshake: HandshakePolicy,
        *,
        send: Callable[..., None],
        recorder: AuditRecorder,
    ) -> None:
        """Watch *connections*.

        Args:
            context: The clocks, event loop, log and metrics of the worker.
            connections: The live connections of this worker; the dispatcher adds and removes them.
            handshake: Verifies fresh tokens; `trust` replaces its keys.
            send: Sends its keyword arguments as an event of a robot to the supervisor.
            recorder: Records fresh tokens, and connections closed for revoked tokens, for the audit log.
        """
        self.connections = connections
        self._handshake = handshake
        self._context = context
        self._send_event = send
        self._recorder = recorder
        self._by_number: dict[int, RobotConnection] = {}
        self._timers: dict[RobotConnection, TimerHandle] = {}
        self._stays: dict[RobotConnection, TimerHandle] = {}

    def trust(self, keys: KeySet) -> None:
        """Verify tokens with *keys* from now on, and close every connection whose token they do not allow.

        Open connections of enrolled robots take the scopes and quotas of the present roster.
        """
        self._handshake.keys = keys
        for connection in list(self.connections):
            claims = connection.claims
            if claims is None or connection.is_closing:
                continue
            problem = claims_problem(claims, keys)
            if problem:
                self._revoke(connection, claims, problem)
            else:
                connection.claims = renewed_claims(claims, keys)

    def watch(self, connection: RobotConnection, expires_s: float | None) -> None:
        """Watch a new connection, and close it at *expires_s* (monotonic s); None sets no such time."""
        claims, keys = connection.claims, self._handshake.keys
        if claims is not None:
            self._by_number[connection.number] = connection
            problem = "" if keys is None else claims_problem(claims, keys)
            if problem:  # the keys changed between the handshake and this call
                self._context.loop.call_soon(self._revoke, connection, claims, problem)
            elif keys is not None:
                connection.claims = renewed_claims(claims, keys)
        self._end_at(connection, expires_s)

    def report_hello(self, connection: RobotConnection) -> None:
        """Report to the supervisor that a robot sent its Hello, so that its older connections are closed."""
        self._report("arrived", connection)

    def forget(self, connection: RobotConnection) -> None:
        """Forget a closed connection, and report to the supervisor that its robot has left."""
        self._end_at(connection, None)
        _cancel(self._stays, connection)
        if self._by_number.pop(connection.number, None) is not None:
            self._report("left", connection)

    def replace(self, number: int) -> None:
        """Close the connection *number*, because its robot has a newer connection to this server.

        If the robot was asked to move, its time to move is awaited first: then the supervisor gets the event
        ``stays``, and calls this again.
        """
        connection = self._by_number.get(number)
        if connection is None or connection.is_closing:
            return
        left_s = connection.moving_until_s - self._context.clocks.monotonic()
        if left_s > 0:
            self._stay(connection, left_s)
            return
        self._context.log.info("replaced", robot=connection.robot)
        connection.close(CLOSE_REPLACED, "replaced")

    def renew(self, connection: RobotConnection, token: str) -> None:
        """Verify a fresh *token* of an open connection, and answer the robot.

        A valid token of the same robot sets the claims and the expiry of the connection; otherwise both stay
        as they are.
        """
        before, clocks = connection.claims, self._context.clocks
        now, wall_s = clocks.monotonic(), clocks.wall()
        claims = self._handshake.claims_or_problem(token, wall_s)
        token_s = None
        if isinstance(claims, Claims) and before is not None and before.robot == claims.robot:
            connection.claims = claims
            self._recorder.record_renewal(before, claims)
            token_s = self._handshake.ends_s(claims, wall_s) - wall_s
            self._end_at(connection, now + token_s)
            self._context.metrics.handshakes["renewed"] += 1
        else:
            self._context.metrics.handshakes["renewal-refused"] += 1
            reason = claims if isinstance(claims, str) else "wrong-robot"
            self._context.log.info("renewal-refused", robot=connection.robot, reason=reason)
            self._recorder.record_refused_renewal(before, reason)
        connection.answer_renewal(token_s)

    def _end_at(self, connection: RobotConnection, expires_s: float | None) -> None:
        """Set the timer that closes *connection* at *expires_s* (monotonic s); None only removes it."""
        _cancel(self._timers, connection)
        if expires_s is not None:
            left_s = max(0.0, expires_s - self._context.clocks.monotonic())
            self._timers[connection] = self._context.loop.call_later(left_s, partial(self._end, connection))

    def _stay(self, connection: RobotConnection, left_s: float) -> None:
        """Report to the supervisor after *left_s* seconds that *connection*, asked to move, is still open."""
        _cancel(self._stays, connection)
        self._stays[connection] = self._context.loop.call_later(
            left_s, partial(self._report, "stays", connection)
        )

    def _revoke(self, connection: RobotConnection, claims: Claims, problem: str) -> None:
        """Close *connection* because its token is no longer valid for *problem*; log and record this."""
        if not connection.is_closing:
            self._context.log.info("revoked", robot=connection.robot, reason=problem)
            self._recorder.record_cut_off(claims, problem)
            connection.close(CLOSE_REVOKED, "revoked")

    def _end(self, connection: RobotConnection) -> None:
        """Close *connection*, because its token has expired."""
        if not connection.is_closing:
            connection.close(CLOSE_TOKEN_OVER, "token-over")

    def _report(self, event: str, connection: RobotConnection) -> None:
        """Send ``arrived``, ``stays`` or ``left`` to the supervisor, for a connection with a token."""
        claims = connection.claims
        if claims is not None and (event == "left" or connection in self.connections):
            self._send_event(event=event, robot=claims.robot, number=connection.number)


def _cancel(timers: dict[RobotConnection, TimerHandle], connection: RobotConnection) -> None:
    """Cancel and remove the timer of *connection*, if it has one."""
    timer = timers.pop(connection, None)
    if timer is not None:
        timer.cancel()
