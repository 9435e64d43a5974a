"""Live sockets stand on a token: they end with it, when it is revoked, and when a newer one comes.

`TokenWatch` does it in a worker, `TrustPoller` in the supervisor that reads the control room for all of them.
Promises that no token and no reason beyond "revoked" reaches a robot, and that what cannot be read leaves
everything as it was known.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rse_pf.auth.tokens import Claims, KeySet, standing_problem
from rse_pf.backend.gateway.audit_recorder import AuditRecorder
from rse_pf.backend.gateway.connection import RobotConnection
from rse_pf.backend.gateway.dispatcher import Dispatcher
from rse_pf.backend.gateway.handshake import HandshakePolicy
from rse_pf.backend.log import JsonLog
from rse_pf.backend.ports import Handle, Loop
from rse_pf.wire.server_session import CLOSE_REPLACED, CLOSE_REVOKED, CLOSE_TOKEN_OVER

__all__ = ["TokenWatch"]


class TokenWatch:
    """The claims of one worker's connections; the core tells who comes and goes."""

    def __init__(
        self,
        core: Dispatcher,
        door: HandshakePolicy,
        *,
        loop: Loop,
        log: JsonLog,
        tell: Callable[..., None],
        witness: AuditRecorder,
    ) -> None:
        """Serve *core*.

        Args:
            core: Its connections stand or fall here.
            door: Judges fresh tokens, and gets new keys.
            loop: For the ends of tokens.
            log: One line for each socket that is ended.
            tell: Says something to the supervisor.
            witness: Records fresh tokens, and sockets that lose their standing.
        """
        self._core = core
        self._door = door
        self._loop = loop
        self._log = log
        self._tell = tell
        self._witness = witness
        self._of_number: dict[int, RobotConnection] = {}
        self._ends: dict[RobotConnection, Handle] = {}

    def trust(self, keys: KeySet) -> None:
        """Believe *keys* from now on, and end every connection that they no longer support."""
        self._door.keys = keys
        for connection in list(self._core.connections):
            problem = "" if connection.claims is None else standing_problem(connection.claims, keys)
            if problem and not connection.assembler.closed:
                self._log.info("revoked", robot=connection.robot, reason=problem)
                if connection.claims is not None:
                    self._witness.cut_off(connection.claims, problem)
                connection.close(CLOSE_REVOKED, "revoked")

    def connected(self, connection: RobotConnection) -> None:
        """Know a connection whose handshake is done."""
        if connection.claims is not None:
            self._of_number[connection.number] = connection
        self._end_in_time(connection)

    def arrived(self, connection: RobotConnection) -> None:
        """Tell that a robot said Hello; its older connections end."""
        self._say("arrived", connection)

    def left(self, connection: RobotConnection) -> None:
        """Forget a connection."""
        timer = self._ends.pop(connection, None)
        if timer is not None:
            timer.cancel()
        if self._of_number.pop(connection.number, None) is not None:
            self._say("left", connection)

    def replace(self, number: int) -> None:
        """End the connection *number*: the robot has a newer one.  One that is moving gets its time first."""
        connection = self._of_number.get(number)
        if connection is None or connection.assembler.closed:
            return
        left_s = connection.moving_until_s - self._core.clocks.monotonic()
        if left_s > 0:
            self._loop.call_later(left_s, partial(self._say, "stays", connection))
            return
        self._log.info("replaced", robot=connection.robot)
        connection.close(CLOSE_REPLACED, "replaced")

    def renew(self, connection: RobotConnection, token: str) -> None:
        """Judge a fresh token of a live connection, and move its end or leave it."""
        core, before = self._core, connection.claims
        now, wall_s = core.clocks.monotonic(), core.clocks.wall()
        claims = self._door.renewed(token, wall_s)
        if isinstance(claims, Claims) and before is not None and _is_same_robot(before, claims):
            connection.claims = claims
            self._witness.renewed(before, claims)
            token_s = self._door.ends_s(claims, wall_s) - wall_s
            connection.expires_s = now + token_s
            self._end_in_time(connection)
            core.metrics.handshakes["renewed"] += 1
        else:
            token_s = None
            core.metrics.handshakes["renewal-refused"] += 1
            reason = claims if isinstance(claims, str) else "wrong-robot"
            self._log.info("renewal-refused", robot=connection.robot, reason=reason)
            self._witness.renewal_refused(before, reason)
        if connection.session is not None:
            connection.apply(connection.session.renewed(token_s), now)

    def _end_in_time(self, connection: RobotConnection) -> None:
        timer = self._ends.pop(connection, None)
        if timer is not None:
            timer.cancel()
        if connection.expires_s is not None:
            left_s = connection.expires_s - self._core.clocks.monotonic()
            self._ends[connection] = self._loop.call_later(max(0.0, left_s), partial(self._end, connection))

    def _end(self, connection: RobotConnection) -> None:
        if not connection.assembler.closed:
            connection.close(CLOSE_TOKEN_OVER, "token-over")

    def _say(self, event: str, connection: RobotConnection) -> None:
        claims = connection.claims
        if claims is not None and (event == "left" or connection in self._core.connections):
            self._tell(event=event, tenant=claims.tenant, robot=claims.robot, number=connection.number)


def _is_same_robot(before: Claims, after: Claims) -> bool:
    return (before.tenant, before.robot) == (after.tenant, after.robot)
