"""Give commands of a robot a trace id, which servers, jobs and the burst function write to their logs.

The id is a W3C ``traceparent``.  Inside of an OpenTelemetry span it is the id of that span, so that a trace
of the robot's program continues in the logs of the cloud.  OpenTelemetry is used if the program has imported
it, and is never imported here.

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

OPENTELEMETRY_MODULE = "opentelemetry.trace"
MAX_ID_CHARACTERS = 64
"""Longest trace id that is sent, in characters; a longer one is cut.  A traceparent of W3C version 00 has
55."""
_trace_id: ContextVar[str] = ContextVar("rse_pf_trace", default="")


def new_trace() -> str:
    """Return a random ``traceparent``: version 00, 16 bytes for the trace, 8 for the span, flag sampled."""
    return f"00-{secrets.token_hex(16)}-{secrets.token_hex(8)}-01"


@contextlib.contextmanager
def traced(trace: str = "") -> Iterator[str]:
    """Send the id *trace*, by default a new one, with all commands of a ``with`` block; yield the id.

    A longer *trace* is cut to its first `MAX_ID_CHARACTERS`.  The id takes precedence over an OpenTelemetry
    span and over the id of an outer ``with traced()`` block.
    """
    trace_id = (trace or new_trace())[:MAX_ID_CHARACTERS]
    earlier = _trace_id.set(trace_id)
    try:
        yield trace_id
    finally:
        _trace_id.reset(earlier)


def current_trace() -> str:
    """Return the trace id of the `traced` block, else of the OpenTelemetry span, else an empty text."""
    return _trace_id.get() or _read_opentelemetry_span()


def _read_opentelemetry_span() -> str:
    module = sys.modules.get(OPENTELEMETRY_MODULE)
    if module is None:
        return ""
    context = module.get_current_span().get_span_context()
    if not context.is_valid:
        return ""
    return f"00-{context.trace_id:032x}-{context.span_id:016x}-{int(context.trace_flags):02x}"
