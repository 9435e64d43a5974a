"""What an operator asks for at ``/record``: begin, read or end a recording of requests to a service.

Only a server whose control port asks for a token records: what robots send is for its operator.
"""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.backend.supervisor.orders import RecordOrder
from rse_pf.control_http import ControlRequest

__all__ = ["NOT_FOR_YOU", "WRONG_RECORDING", "RecordQuery", "may_record", "record_query"]

NOT_FOR_YOU = "start the server with a --control-token, and ask from its machine"
_MAX_CALLS, _MAX_S, _MAX_MIB = 10_000, 3600.0, 64
"""Requests, time and memory of each worker that an operator may have recorded."""
WRONG_RECORDING = f"name a service, a count to {_MAX_CALLS}, seconds to {_MAX_S:g}, or only a recording"


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordQuery:
    """A recording that begins, or the number of one that *ends*."""

    service: str
    calls: int
    seconds: float
    max_bytes: int
    ends: int | None

    def order(self, number: int) -> RecordOrder:
        """Return the order to the workers."""
        return RecordOrder(
            number, service=self.service, calls=self.calls, max_bytes=self.max_bytes,
            seconds=self.seconds, ends=self.ends,
        )  # fmt: skip


def may_record(ask: ControlRequest, token: str | None) -> bool:
    """Return whether *ask*, which carries *token* if the port has one, may record."""
    return token is not None and ask.is_local


def record_query(ask: ControlRequest) -> RecordQuery:
    """Return the query in *ask*; raises ValueError if a parameter is no number, or too large."""
    query = RecordQuery(
        service=ask.query.get("service", ""),
        calls=int(ask.query.get("count", "0")),
        seconds=float(ask.query.get("seconds", "60")),
        max_bytes=int(ask.query.get("mib", "16")) << 20,
        ends=int(ask.query["recording"]) if "recording" in ask.query else None,
    )
    is_fine = 0 <= query.calls <= _MAX_CALLS and 0 < query.seconds <= _MAX_S
    is_fine = is_fine and 0 < query.max_bytes <= _MAX_MIB << 20
    if not is_fine or (query.ends is None) != (query.calls > 0 and query.service != ""):
        raise ValueError(WRONG_RECORDING)
    return query
