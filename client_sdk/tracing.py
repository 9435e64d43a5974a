"""Give the commands of a robot a trace id, which servers, jobs and the function write to their logs.

The id is a W3C ``traceparent``.  Inside of a span of OpenTelemetry it is that span's, so that a trace of the
robot's own program goes on in the cloud's logs; OpenTelemetry is used where the program has imported it, and
never imported here.

    with traced() as trace:
        answer = await robot.solve_pnp(...)

Source:
    W3C Trace Context, https://www.w3.org/TR/trace-context/, Sect. 3.2.
"""

from __future__ import annotations

import contextlib
import secrets
import sys
from collections.abc import Iterator
from contextvars import ContextVar

__all__ = ["current_trace", "new_trace", "traced"]

_OPENTELEMETRY = "opentelemetry.trace"
_MAX_CHARACTERS = 64
_TRACE: ContextVar[str] = ContextVar("rse_pf_trace", default="")


def new_trace() -> str:
    """Return a fresh ``traceparent``: version, 16 random bytes of the trace, 8 of the span, sampled."""
    return f"00-{secrets.token_hex(16)}-{secrets.token_hex(8)}-01"


@contextlib.contextmanager
def traced(trace: str = "") -> Iterator[str]:
    """Give each command that is asked for inside of it *trace*, by default a new one; yields the id."""
    given = (trace or new_trace())[:_MAX_CHARACTERS]
    before = _TRACE.set(given)
    try:
        yield given
    finally:
        _TRACE.reset(before)


def current_trace() -> str:
    """Return the id for a command that is asked for now: of `traced`, else of the current span, else none."""
    return _TRACE.get() or _of_current_span()


def _of_current_span() -> str:
    module = sys.modules.get(_OPENTELEMETRY)
    if module is None:
        return ""
    context = module.get_current_span().get_span_context()
    if not context.is_valid:
        return ""
    return f"00-{context.trace_id:032x}-{context.span_id:016x}-{int(context.trace_flags):02x}"
